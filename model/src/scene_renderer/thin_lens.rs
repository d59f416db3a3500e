//! Pinhole pictures and thin-lens focal stacks by ray tracing.
//!
//! A ray is a straight line in (x, y, dioptre), so one traced ray belongs to every focus plane: it lands in the pixel
//! where it crosses that plane. Each ray is traced once and added to all planes; and because a narrow pupil is a part
//! of a wider one, the aperture is cut into rings between the pupils asked for, and each ring's rays serve every pupil
//! that holds it, weighted by area.

use holod_calibration::{Dioptres, DisplayGeometry, PupilDiameter, Resolution};
use rand::Rng;
use rayon::prelude::*;

use super::random::{mix, ray_stream};
use super::surface::{Bounds, Ray, Surface};

const TILE: i32 = 16;
/// Aperture points prepared for each stratum of a ring.
const POINTS_PER_STRATUM: usize = 64;
/// Rows of tiles whose accumulators exist at once.
const BANDS_AT_ONCE: usize = 16;
const PINHOLE_SAMPLES: usize = 4;

/// Surfaces that a tile's rays can meet, nearest first.
fn candidates<'a>(surfaces: &'a [Surface], window: &Bounds, depth: f32, aperture: f32) -> Vec<&'a Surface> {
    let mut near: Vec<&Surface> = surfaces.iter().filter(|s| s.reachable(window, depth, aperture)).collect();
    near.sort_by(|a, b| b.depth_near.total_cmp(&a.depth_near));
    near
}

/// Colour and depth of the nearest surface along a ray; black at infinity where there is none.
#[inline(always)]
fn trace(surfaces: &[&Surface], ray: &Ray) -> ([f32; 4], f32) {
    let mut nearest = f32::NEG_INFINITY;
    let mut colour = [0.0, 0.0, 0.0, 1.0];
    for surface in surfaces {
        if surface.depth_near <= nearest {
            break;
        }
        if let Some((depth, texel)) = surface.hit(ray, nearest) {
            nearest = depth;
            colour = *texel;
        }
    }
    (colour, nearest)
}

/// The picture through a pinhole, [3, height, width] in linear light, averaged over each pixel, and the depth in
/// dioptres of each pixel's central ray, [height, width].
pub(super) fn pinhole(surfaces: &[Surface], resolution: Resolution) -> (Vec<f32>, Vec<f32>) {
    let Resolution { width, height } = resolution;
    let rows: Vec<(Vec<[f32; 3]>, Vec<f32>)> = (0..height)
        .into_par_iter()
        .map(|row| {
            let top = row as f32 - 0.5 * height as f32;
            let half_width = 0.5 * width as f32;
            let window = Bounds { left: -half_width, right: half_width, top, bottom: top + 1.0 };
            let surfaces = candidates(surfaces, &window, 0.0, 0.0);
            let look = |x0: f32, y0: f32| trace(&surfaces, &Ray { x0, y0, ax: 0.0, ay: 0.0 });
            (0..width)
                .map(|column| {
                    let left = column as f32 - half_width;
                    let mut sum = [0.0; 3];
                    for sample in 0..PINHOLE_SAMPLES * PINHOLE_SAMPLES {
                        let dx = ((sample % PINHOLE_SAMPLES) as f32 + 0.5) / PINHOLE_SAMPLES as f32;
                        let dy = ((sample / PINHOLE_SAMPLES) as f32 + 0.5) / PINHOLE_SAMPLES as f32;
                        let (colour, _) = look(left + dx, top + dy);
                        (0..3).for_each(|c| sum[c] += colour[c]);
                    }
                    let (_, depth) = look(left + 0.5, top + 0.5);
                    (sum.map(|c| c / (PINHOLE_SAMPLES * PINHOLE_SAMPLES) as f32), depth.max(0.0))
                })
                .unzip()
        })
        .collect();
    let mut image = vec![0.0; 3 * width * height];
    let mut depth = Vec::with_capacity(width * height);
    for (row, (colours, depths)) in rows.into_iter().enumerate() {
        for (column, colour) in colours.into_iter().enumerate() {
            (0..3).for_each(|c| image[(c * height + row) * width + column] = colour[c]);
        }
        depth.extend(depths);
    }
    (image, depth)
}

/// A part of the aperture between two radii, cut into strata of equal area; radii in pixels per dioptre.
struct Ring {
    outer: f32,
    /// Share of a ray in a sum over the aperture: the ring's area over its number of rays.
    weight: f32,
    strata: usize,
    points: Vec<[f32; 2]>,
}

impl Ring {
    fn new(inner: f32, outer: f32, rays: usize, key: u64) -> Self {
        let radial_over_tangential = (outer - inner) / (std::f32::consts::PI * (outer + inner));
        let radial = ((rays as f32 * radial_over_tangential).sqrt().round() as usize).clamp(1, rays);
        let tangential = rays.div_ceil(radial);
        let strata = radial * tangential;
        let mut random = ray_stream(key);
        let mut unit = || (random.next_u32() >> 8) as f32 / 16_777_216.0;
        let mut points = Vec::with_capacity(strata * POINTS_PER_STRATUM);
        for stratum in 0..strata {
            for _ in 0..POINTS_PER_STRATUM {
                let along = ((stratum / tangential) as f32 + unit()) / radial as f32;
                let radius = (inner * inner + along * (outer * outer - inner * inner)).sqrt();
                let around = ((stratum % tangential) as f32 + unit()) / tangential as f32;
                let (sin, cos) = (std::f32::consts::TAU * around).sin_cos();
                points.push([radius * cos, radius * sin]);
            }
        }
        Self { outer, weight: (outer * outer - inner * inner) / strata as f32, strata, points }
    }
}

/// Sums of colour and weight, [planes, rows, width], for rows from `first_row`.
struct Band {
    first_row: i32,
    rows: i32,
    sums: Vec<[f32; 4]>,
}

/// Thin-lens images for each pupil, [planes, 3, height, width] each, in linear light. At least `rays` rays reach each
/// pixel of each plane on average. Also the number of rays traced. Depends on `key`, never on the number of threads.
pub(super) fn focal_stacks(
    surfaces: &[Surface],
    resolution: Resolution,
    pupils: &[PupilDiameter],
    focus: &[Dioptres],
    rays: usize,
    key: u64,
) -> (Vec<Vec<f32>>, u64) {
    let Resolution { width, height } = resolution;
    let pixel_angle_rad = DisplayGeometry::DEFAULT.pixel_angle_rad();
    let radius = |pupil: &PupilDiameter| (0.5 * pupil.metres().0 / pixel_angle_rad) as f32;
    let mut order: Vec<usize> = (0..pupils.len()).collect();
    order.sort_by(|&a, &b| pupils[a].mm().total_cmp(&pupils[b].mm()));

    let focus: Vec<f32> = focus.iter().map(|f| f.0 as f32).collect();
    let lowest = focus.iter().copied().fold(f32::INFINITY, f32::min);
    let highest = focus.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let middle = 0.5 * (lowest + highest);

    let mut total = vec![[0.0f32; 4]; focus.len() * width * height];
    let mut stacks = vec![Vec::new(); pupils.len()];
    let mut traced = 0;
    let mut inner = 0.0;
    for (ring_index, &pupil_index) in order.iter().enumerate() {
        let outer = radius(&pupils[pupil_index]);
        if ring_index == 0 || outer > inner {
            let ring_key = mix(key) ^ ring_index as u64;
            let ring = Ring::new(inner, outer, rays.max(1), ring_key);
            let lens = Lens {
                surfaces,
                resolution,
                ring,
                focus: &focus,
                middle,
                reach: 0.5 * (highest - lowest),
                key: ring_key,
            };
            traced += lens.add_ring(&mut total);
            inner = outer;
        }
        let mut stack = vec![0.0; focus.len() * 3 * width * height];
        for (plane, sums) in total.chunks_exact(width * height).enumerate() {
            for (pixel, sum) in sums.iter().enumerate() {
                let share = if sum[3] > 0.0 { 1.0 / sum[3] } else { 0.0 };
                (0..3).for_each(|c| stack[(plane * 3 + c) * width * height + pixel] = sum[c] * share);
            }
        }
        stacks[pupil_index] = stack;
    }
    (stacks, traced)
}

/// One ring's work.
struct Lens<'a> {
    surfaces: &'a [Surface],
    resolution: Resolution,
    ring: Ring,
    focus: &'a [f32],
    /// The depth at which rays start on a pixel grid, and the distance in dioptres from it to the outermost planes.
    middle: f32,
    reach: f32,
    key: u64,
}

impl Lens<'_> {
    /// Pixels by which the picture must be exceeded at the middle depth.
    fn margin(&self) -> i32 {
        (self.ring.outer * self.reach).ceil() as i32 + 1
    }

    /// Traces the ring's rays and adds them to `total`, [planes, height, width]. Returns their number.
    fn add_ring(&self, total: &mut [[f32; 4]]) -> u64 {
        let (width, height) = (self.resolution.width, self.resolution.height);
        let first = -self.margin().div_euclid(TILE) - 1;
        let last = (height as i32 + self.margin()).div_euclid(TILE);
        let bands: Vec<i32> = (first..=last).collect();
        let mut traced = 0;
        for group in bands.chunks(BANDS_AT_ONCE) {
            let done: Vec<(Band, u64)> = group.par_iter().map(|&band| self.trace_band(band)).collect();
            for (band, rays) in done {
                traced += rays;
                let rows = band.rows as usize * width;
                if rows == 0 {
                    continue;
                }
                for (plane, sums) in band.sums.chunks_exact(rows).enumerate() {
                    let start = (plane * height + band.first_row as usize) * width;
                    for (to, from) in total[start..start + rows].iter_mut().zip(sums) {
                        (0..4).for_each(|c| to[c] += from[c]);
                    }
                }
            }
        }
        traced
    }

    fn trace_band(&self, band: i32) -> (Band, u64) {
        let (width, height) = (self.resolution.width as i32, self.resolution.height as i32);
        let margin = self.margin();
        let first_row = (band * TILE - margin).clamp(0, height);
        let rows = ((band + 1) * TILE + margin).clamp(0, height) - first_row;
        let plane_size = (rows * width) as usize;
        let mut sums = vec![[0.0f32; 4]; self.focus.len() * plane_size];
        let mut traced = 0;
        if rows == 0 {
            return (Band { first_row, rows, sums }, 0);
        }
        let (half_width, half_height) = (0.5 * width as f32, 0.5 * height as f32);
        for tile in -margin.div_euclid(TILE) - 1..=(width + margin).div_euclid(TILE) {
            let window = Bounds {
                left: (tile * TILE) as f32 - half_width,
                top: (band * TILE) as f32 - half_height,
                right: ((tile + 1) * TILE) as f32 - half_width,
                bottom: ((band + 1) * TILE) as f32 - half_height,
            };
            let surfaces = candidates(self.surfaces, &window, self.middle, self.ring.outer);
            let mut random = ray_stream(self.key ^ ((band as u64) << 40) ^ (((tile as u64) & 0xffff) << 20));
            for pixel in 0..TILE * TILE {
                let (left, top) = (tile * TILE + pixel % TILE, band * TILE + pixel / TILE);
                for stratum in 0..self.ring.strata {
                    let bits = random.next_u64();
                    let x = left as f32 + (bits & 0xffff) as f32 / 65536.0;
                    let y = top as f32 + ((bits >> 16) & 0xffff) as f32 / 65536.0;
                    let point = (bits >> 32) as usize % POINTS_PER_STRATUM;
                    let [ax, ay] = self.ring.points[stratum * POINTS_PER_STRATUM + point];
                    let spread = (ax.abs() * self.reach, ay.abs() * self.reach);
                    if x + spread.0 < 0.0
                        || x - spread.0 >= width as f32
                        || y + spread.1 < first_row as f32
                        || y - spread.1 >= (first_row + rows) as f32
                    {
                        continue;
                    }
                    let ray =
                        Ray { x0: x - half_width - ax * self.middle, y0: y - half_height - ay * self.middle, ax, ay };
                    let (colour, _) = trace(&surfaces, &ray);
                    traced += 1;
                    let weight = self.ring.weight;
                    for (plane, &focus) in self.focus.iter().enumerate() {
                        let column = (x + ax * (focus - self.middle)).floor_to_i32();
                        let row = (y + ay * (focus - self.middle)).floor_to_i32() - first_row;
                        if (0..width).contains(&column) && (0..rows).contains(&row) {
                            let sum = &mut sums[plane * plane_size + (row * width + column) as usize];
                            (0..3).for_each(|c| sum[c] += weight * colour[c]);
                            sum[3] += weight;
                        }
                    }
                }
            }
        }
        (Band { first_row, rows, sums }, traced)
    }
}

trait FloorToI32 {
    /// `floor() as i32` without a library call on processors whose baseline has no rounding instruction.
    fn floor_to_i32(self) -> i32;
}

impl FloorToI32 for f32 {
    #[inline(always)]
    fn floor_to_i32(self) -> i32 {
        const BIAS: f32 = 1024.0;
        (self + BIAS) as i32 - BIAS as i32
    }
}

/// Mean linear light of the pinhole picture, from a coarse grid of rays.
pub(super) fn mean_light(surfaces: &[Surface], resolution: Resolution) -> f32 {
    const GRID: usize = 64;
    let everything =
        Bounds { left: f32::NEG_INFINITY, top: f32::NEG_INFINITY, right: f32::INFINITY, bottom: f32::INFINITY };
    let surfaces = candidates(surfaces, &everything, 0.0, 0.0);
    let at = |k: usize, length: usize| ((k as f32 + 0.5) / GRID as f32 - 0.5) * length as f32;
    let mut sum = 0.0;
    for row in 0..GRID {
        for column in 0..GRID {
            let ray = Ray { x0: at(column, resolution.width), y0: at(row, resolution.height), ax: 0.0, ay: 0.0 };
            let (colour, _) = trace(&surfaces, &ray);
            sum += colour[0] + colour[1] + colour[2];
        }
    }
    sum / (3 * GRID * GRID) as f32
}

//! Pinhole pictures and thin-lens focal stacks.
//!
//! A ray is a straight line in (x, y, dioptre), so one traced ray belongs to every focus plane: it lands in the pixel
//! where it crosses that plane. All rays through one aperture point form a [`View`] on a grid of one ray a pixel; at each
//! focus plane the view is displaced as a whole, so that each pixel gets exactly one ray of it, and adding views is adding
//! rows of numbers. Nothing is divided by a random weight: energy is kept exactly.
//!
//! `points` says which aperture points these are, and where in its pixel each view's ray is.
//!
//! A narrow pupil is a part of a wider one, so the aperture is cut into rings between the pupils asked for, and each
//! ring's rays serve every pupil that holds it, weighted by area.

use holod_calibration::{Dioptres, DisplayGeometry, PupilDiameter, Resolution};
use rayon::prelude::*;

use super::points::{ViewPoint, view_points};
use super::random::mix;
use super::surface::Surface;
use super::view::{Aim, Grid, View, nearest_first};

/// Views that exist at once, unless there are more threads.
const VIEWS_AT_ONCE: usize = 8;

/// Where in each pixel the pinhole picture is sampled.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum PixelSamples {
    /// The centres of a grid of 4 by 4.
    Grid,
    /// A Fibonacci lattice of 55 points: finer by far for edges of any direction.
    Lattice,
}

impl PixelSamples {
    fn points(self) -> Vec<[f32; 2]> {
        match self {
            Self::Grid => (0..16).map(|k| [((k % 4) as f32 + 0.5) / 4.0, ((k / 4) as f32 + 0.5) / 4.0]).collect(),
            Self::Lattice => (0..55).map(|k| [(k as f32 + 0.5) / 55.0, ((k * 34 % 55) as f32 + 0.5) / 55.0]).collect(),
        }
    }
}

/// The picture through a pinhole, [3, height, width] in linear light, averaged over each pixel, and the depth in
/// dioptres of each pixel's central ray, [height, width].
pub(super) fn pinhole(surfaces: &[Surface], resolution: Resolution, samples: PixelSamples) -> (Vec<f32>, Vec<f32>) {
    let Resolution { width, height } = resolution;
    let order = nearest_first(surfaces);
    let (left, top) = (-0.5 * width as f32, -0.5 * height as f32);
    let grid = Grid { left, top, step: 1.0, columns: width, rows: height };
    let mut view = View::new(grid);
    let points = samples.points();
    let mut image = vec![0.0; 3 * width * height];
    for [dx, dy] in &points {
        view.draw(&order, (left + dx, top + dy), Aim::PINHOLE);
        for (sums, colours) in image.chunks_exact_mut(width * height).zip(&view.colours) {
            sums.iter_mut().zip(colours).for_each(|(sum, colour)| *sum += colour);
        }
    }
    image.iter_mut().for_each(|sum| *sum /= points.len() as f32);
    view.draw(&order, (left + 0.5, top + 0.5), Aim::PINHOLE);
    (image, view.depth.into_iter().map(|depth| depth.max(0.0)).collect())
}

/// Mean linear light of the pinhole picture, from a coarse grid of rays.
pub(super) fn mean_light(surfaces: &[Surface], resolution: Resolution) -> f32 {
    const GRID: usize = 64;
    let (width, height) = (resolution.width as f32, resolution.height as f32);
    let step = width.max(height) / GRID as f32;
    let cells = |length: f32| (length / step).ceil() as usize;
    let grid = Grid { left: 0.0, top: 0.0, step, columns: cells(width), rows: cells(height) };
    let mut view = View::new(grid);
    view.draw(&nearest_first(surfaces), (0.5 * (step - width), 0.5 * (step - height)), Aim::PINHOLE);
    view.colours.iter().flatten().sum::<f32>() / (3 * grid.columns * grid.rows) as f32
}

/// Thin-lens images for each pupil in linear light, from `rays` rays for each pixel and ring. `finish` is given each
/// pupil's place in `pupils`, and its images [planes, 3, height, width] times a number, with that number's inverse.
/// Returns the number of rays traced. Depends on `key`, never on the number of threads.
pub(super) fn focal_stacks(
    surfaces: &[Surface],
    resolution: Resolution,
    pupils: &[PupilDiameter],
    focus: &[Dioptres],
    rays: usize,
    key: u64,
    mut finish: impl FnMut(usize, &[f32], f32),
) -> u64 {
    let pixel_angle_rad = DisplayGeometry::DEFAULT.pixel_angle_rad();
    let radius = |pupil: &PupilDiameter| (0.5 * pupil.metres().0 / pixel_angle_rad) as f32;
    let mut order: Vec<usize> = (0..pupils.len()).collect();
    order.sort_by(|&a, &b| pupils[a].mm().total_cmp(&pupils[b].mm()));

    let focus: Vec<f32> = focus.iter().map(|f| f.0 as f32).collect();
    let lowest = focus.iter().copied().fold(f32::INFINITY, f32::min);
    let highest = focus.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let lens = Lens {
        surfaces: nearest_first(surfaces),
        resolution,
        middle: 0.5 * (lowest + highest),
        reach: 0.5 * (highest - lowest),
        focus,
    };
    let lifts: Vec<f32> = lens.focus.iter().map(|focus| focus - lens.middle).collect();
    let mut total = vec![0.0f32; lens.focus.len() * 3 * resolution.pixels()];
    let mut traced = 0;
    let (mut inner, mut area) = (0.0, 0.0);
    for (ring, &pupil) in order.iter().enumerate() {
        let outer = radius(&pupils[pupil]);
        if ring == 0 || outer > inner {
            let points = view_points(inner, outer, rays.max(1), &lifts, mix(key) ^ ring as u64);
            let ring_area = outer * outer - inner * inner;
            traced += lens.add(&points, ring_area / points.len() as f32, outer, &mut total);
            area += ring_area;
            inner = outer;
        }
        finish(pupil, &total, 1.0 / area);
    }
    traced
}

/// What the views of all rings have in common.
struct Lens<'a> {
    surfaces: Vec<&'a Surface>,
    resolution: Resolution,
    focus: Vec<f32>,
    /// The depth of the views' grids, and the distance in dioptres from it to the outermost planes.
    middle: f32,
    reach: f32,
}

impl Lens<'_> {
    /// Draws the views and adds them, times `weight`, to `total`, [planes, 3, height, width]. Returns the number of rays.
    fn add(&self, points: &[ViewPoint], weight: f32, outer: f32, total: &mut [f32]) -> u64 {
        let Resolution { width, height } = self.resolution;
        // Pixels by which a view must exceed the picture to fill it at every plane.
        let margin = (outer * self.reach).ceil() as usize + 1;
        let (columns, rows) = (width + 2 * margin, height + 2 * margin);
        let (left, top) = (-0.5 * width as f32 - margin as f32, -0.5 * height as f32 - margin as f32);
        let grid = Grid { left, top, step: 1.0, columns, rows };
        let mut views: Vec<View> =
            (0..points.len().min(VIEWS_AT_ONCE.max(rayon::current_num_threads()))).map(|_| View::new(grid)).collect();
        for batch in points.chunks(views.len()) {
            views.par_iter_mut().zip(batch).for_each(|(view, point)| {
                let aim = Aim { ax: point.ax, ay: point.ay, grid_depth: self.middle };
                view.draw(&self.surfaces, (left + point.dx, top + point.dy), aim);
            });
            total.par_chunks_mut(width).enumerate().for_each(|(line, sums)| {
                let (plane, channel, row) = (line / (3 * height), line / height % 3, line % height);
                let lift = self.focus[plane] - self.middle;
                for (view, point) in views.iter().zip(batch) {
                    // The pixel that a sample lands in, counted from the sample's own.
                    let right = (point.dx + point.ax * lift).floor() as isize;
                    let down = (point.dy + point.ay * lift).floor() as isize;
                    let from_row = (row + margin).wrapping_add_signed(-down);
                    let start = from_row * columns + margin.wrapping_add_signed(-right);
                    let colours = &view.colours[channel][start..start + width];
                    sums.iter_mut().zip(colours).for_each(|(sum, colour)| *sum += weight * colour);
                }
            });
        }
        (points.len() * columns * rows) as u64
    }
}

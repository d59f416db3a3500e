//! Pinhole pictures and thin-lens focal stacks.
//!
//! A ray is a straight line in (x, y, dioptre), so one traced ray belongs to every focus plane: it lands in the pixel
//! where it crosses that plane. All rays through one aperture point form a [`View`] on a grid of one ray a pixel; at
//! each focus plane the view is displaced as a whole, so that each pixel gets exactly one ray of it, and adding views
//! is adding rows of numbers. Nothing is divided by a random weight: energy is kept exactly.
//!
//! `points` says which aperture points these are, and where in its pixel each view's ray is.
//!
//! An [`Adder`] draws and adds views: [`CpuAdder`] here, and on a graphics processor `thin_lens.wgsl` with `view.wgsl`.
//!
//! A narrow pupil is a part of a wider one, so the aperture is cut into rings between the pupils asked for, and each
//! ring's rays serve every pupil that holds it, weighted by area.

use std::convert::Infallible;

use holod_calibration::{Dioptres, DisplayGeometry, PupilDiameter, Resolution};
use rayon::prelude::*;

use super::grid::Grid;
use super::points::{ViewPoint, view_points};
use super::random::mix;
use super::surface::Surface;
use super::view::{Aim, View, nearest_first};

/// Views that exist at once on the processor, unless there are more threads.
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

/// Sums of views, on whatever machine they are drawn.
pub(super) trait Adder {
    type Error;

    /// Draws the views of these aperture points, none of which is farther than `outer` from the middle, and adds them,
    /// times `weight`, to the sums. Returns the number of rays.
    fn add(&mut self, points: &[ViewPoint], weight: f32, outer: f32) -> Result<u64, Self::Error>;

    /// The sums, [planes, 3, height, width].
    fn sums(&mut self) -> Result<&[f32], Self::Error>;
}

/// Thin-lens images for each pupil in linear light, from `rays` rays for each pixel and ring. `finish` is given each
/// pupil's place in `pupils`, and its images [planes, 3, height, width] times a number, with that number's inverse.
/// Returns the number of rays traced. Depends on `key`, never on the number of threads.
pub(super) fn focal_stacks<A: Adder>(
    lens: &Lens,
    adder: &mut A,
    pupils: &[PupilDiameter],
    rays: usize,
    key: u64,
    mut finish: impl FnMut(usize, &[f32], f32),
) -> Result<u64, A::Error> {
    let mut order: Vec<usize> = (0..pupils.len()).collect();
    order.sort_by(|&a, &b| pupils[a].mm().total_cmp(&pupils[b].mm()));
    let lifts: Vec<f32> = lens.lifts().collect();
    let mut traced = 0;
    let (mut inner, mut area) = (0.0, 0.0);
    for (ring, &pupil) in order.iter().enumerate() {
        let outer = Lens::radius(pupils[pupil]);
        if ring == 0 || outer > inner {
            let points = view_points(inner, outer, rays.max(1), &lifts, mix(key) ^ ring as u64);
            let ring_area = outer * outer - inner * inner;
            traced += adder.add(&points, ring_area / points.len() as f32, outer)?;
            area += ring_area;
            inner = outer;
        }
        finish(pupil, adder.sums()?, 1.0 / area);
    }
    Ok(traced)
}

/// What the views of all rings have in common.
pub(super) struct Lens<'a> {
    /// From the nearest to the farthest.
    pub(super) surfaces: Vec<&'a Surface>,
    pub(super) resolution: Resolution,
    focus: Vec<f32>,
    /// The depth of the views' grids, and the distance in dioptres from it to the outermost planes.
    pub(super) middle: f32,
    reach: f32,
}

impl<'a> Lens<'a> {
    pub(super) fn new(surfaces: &'a [Surface], resolution: Resolution, focus: &[Dioptres]) -> Self {
        let focus: Vec<f32> = focus.iter().map(|f| f.0 as f32).collect();
        let lowest = focus.iter().copied().fold(f32::INFINITY, f32::min);
        let highest = focus.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let (middle, reach) = (0.5 * (lowest + highest), 0.5 * (highest - lowest));
        Self { surfaces: nearest_first(surfaces), resolution, focus, middle, reach }
    }

    /// A pupil's radius in pixels per dioptre.
    pub(super) fn radius(pupil: PupilDiameter) -> f32 {
        (0.5 * pupil.metres().0 / DisplayGeometry::DEFAULT.pixel_angle_rad()) as f32
    }

    /// The planes' distances in dioptres from the views' grids.
    pub(super) fn lifts(&self) -> impl ExactSizeIterator<Item = f32> {
        self.focus.iter().map(|focus| focus - self.middle)
    }

    pub(super) fn planes(&self) -> usize {
        self.focus.len()
    }

    /// Pixels by which a view through points up to `outer` from the middle must exceed the picture on each side to fill
    /// it at every plane.
    pub(super) fn margin(&self, outer: f32) -> usize {
        (outer * self.reach).ceil() as usize + 1
    }

    /// A view's grid, before it is moved by its point's offset.
    pub(super) fn grid(&self, margin: usize) -> Grid {
        let Resolution { width, height } = self.resolution;
        Grid {
            left: -0.5 * width as f32 - margin as f32,
            top: -0.5 * height as f32 - margin as f32,
            step: 1.0,
            columns: width + 2 * margin,
            rows: height + 2 * margin,
        }
    }

    /// Which of a view's samples lands in the picture's first pixel at a plane; the others follow in order.
    pub(super) fn first_sample(point: &ViewPoint, lift: f32, margin: usize, columns: usize) -> usize {
        // The pixel that a sample lands in, counted from the sample's own.
        let right = (point.dx + point.ax * lift).floor() as isize;
        let down = (point.dy + point.ay * lift).floor() as isize;
        margin.wrapping_add_signed(-down) * columns + margin.wrapping_add_signed(-right)
    }
}

/// Sums on the processor.
pub(super) struct CpuAdder<'a> {
    lens: &'a Lens<'a>,
    total: Vec<f32>,
}

impl<'a> CpuAdder<'a> {
    pub(super) fn new(lens: &'a Lens<'a>) -> Self {
        Self { lens, total: vec![0.0; lens.planes() * 3 * lens.resolution.pixels()] }
    }
}

impl Adder for CpuAdder<'_> {
    type Error = Infallible;

    fn add(&mut self, points: &[ViewPoint], weight: f32, outer: f32) -> Result<u64, Infallible> {
        let Resolution { width, height } = self.lens.resolution;
        let margin = self.lens.margin(outer);
        let grid = self.lens.grid(margin);
        let lifts: Vec<f32> = self.lens.lifts().collect();
        let mut views: Vec<View> =
            (0..points.len().min(VIEWS_AT_ONCE.max(rayon::current_num_threads()))).map(|_| View::new(grid)).collect();
        for batch in points.chunks(views.len()) {
            views.par_iter_mut().zip(batch).for_each(|(view, point)| {
                let aim = Aim { ax: point.ax, ay: point.ay, grid_depth: self.lens.middle };
                view.draw(&self.lens.surfaces, (grid.left + point.dx, grid.top + point.dy), aim);
            });
            self.total.par_chunks_mut(width).enumerate().for_each(|(line, sums)| {
                let (plane, channel, row) = (line / (3 * height), line / height % 3, line % height);
                for (view, point) in views.iter().zip(batch) {
                    let start = Lens::first_sample(point, lifts[plane], margin, grid.columns) + row * grid.columns;
                    let colours = &view.colours[channel][start..start + width];
                    sums.iter_mut().zip(colours).for_each(|(sum, colour)| *sum += weight * colour);
                }
            });
        }
        Ok((points.len() * grid.columns * grid.rows) as u64)
    }

    fn sums(&mut self) -> Result<&[f32], Infallible> {
        Ok(&self.total)
    }
}

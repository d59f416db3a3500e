//! Soft shadows, baked: each surface darkens what lies behind it, the more blurred the farther that is.

use super::grid::Grid;
use super::random::Random;
use super::surface::{Shape, Surface};
use super::view::{Aim, View};

/// A blurred silhouette, displaced by where the light comes from.
struct Shadow {
    grid: Grid,
    darkness: Vec<f32>,
}

impl Shadow {
    /// Darkness, 0..=1, at a direction.
    fn at(&self, x: f32, y: f32) -> f32 {
        let u = (x - self.grid.left) / self.grid.step;
        let v = (y - self.grid.top) / self.grid.step;
        if u < 0.0 || v < 0.0 {
            return 0.0;
        }
        let (column, row) = (u as usize, v as usize);
        if column + 1 >= self.grid.columns || row + 1 >= self.grid.rows {
            return 0.0;
        }
        let (along, down) = (u - column as f32, v - row as f32);
        let value = |dc: usize, dr: usize| self.darkness[(row + dr) * self.grid.columns + column + dc];
        let top = value(0, 0) + (value(1, 0) - value(0, 0)) * along;
        let bottom = value(0, 1) + (value(1, 1) - value(0, 1)) * along;
        top + (bottom - top) * down
    }
}

/// The shadow that `surface` throws on something `gap` dioptres behind it.
fn shadow(surface: &Surface, (light_x, light_y): (f32, f32), gap: f32, strength: f32) -> Shadow {
    let blur_px = 2.0 + 14.0 * gap;
    let step = (0.4 * blur_px).max(1.5);
    let margin = blur_px + 2.0 * step;
    let (left, top, right, bottom) = surface.extent();
    let cells = |length: f32| ((length + 2.0 * margin) / step).ceil() as usize + 1;
    let grid =
        Grid { left: left - margin, top: top - margin, step, columns: cells(right - left), rows: cells(bottom - top) };
    let mut view = View::new(grid);
    view.draw(&[surface], (grid.left, grid.top), Aim::PINHOLE);
    let mut darkness: Vec<f32> = view.depth.iter().map(|d| if d.is_finite() { strength } else { 0.0 }).collect();
    for _ in 0..2 {
        blur(&mut darkness, grid.columns, grid.rows);
    }
    // The light is far away to one side: the shadow moves with the gap.
    let (right, down) = (light_x * 24.0 * gap, light_y * 24.0 * gap);
    Shadow { grid: Grid { left: grid.left + right, top: grid.top + down, ..grid }, darkness }
}

/// A box of 3 by 3 cells.
fn blur(values: &mut [f32], columns: usize, rows: usize) {
    let at = |values: &[f32], column: isize, row: isize| {
        let inside = (0..columns as isize).contains(&column) && (0..rows as isize).contains(&row);
        if inside { values[row as usize * columns + column as usize] } else { 0.0 }
    };
    let across: Vec<f32> = (0..columns * rows)
        .map(|k| {
            let (column, row) = ((k % columns) as isize, (k / columns) as isize);
            (-1..=1).map(|d| at(values, column + d, row)).sum::<f32>() / 3.0
        })
        .collect();
    for (k, value) in values.iter_mut().enumerate() {
        let (column, row) = ((k % columns) as isize, (k / columns) as isize);
        *value = (-1..=1).map(|d| at(&across, column, row + d)).sum::<f32>() / 3.0;
    }
}

/// Lets each surface but the first `receivers_only` throw a shadow on every surface that lies behind it.
pub(super) fn cast(random: &mut Random, surfaces: &mut [Surface], receivers_only: usize) {
    let light = (random.between(-1.0, 1.0), random.between(0.2, 1.0));
    let strength = random.between(0.3, 0.75);
    for caster in receivers_only..surfaces.len() {
        let depth = 0.5 * (surfaces[caster].depth_near + surfaces[caster].depth_far);
        for receiver in 0..surfaces.len() {
            let middle = 0.5 * (surfaces[receiver].depth_near + surfaces[receiver].depth_far);
            // Shadows on what is far behind are too soft and weak to be seen.
            let gap = depth - middle;
            let long = surfaces[receiver].depth_near - surfaces[receiver].depth_far > 1.0;
            if receiver == caster
                || (!long && !(0.03..1.2).contains(&gap))
                || matches!(surfaces[receiver].shape, Shape::Mesh(_))
            {
                continue;
            }
            // Floors and walls are touched near the caster's own depth.
            let gap = if long { 0.15 } else { gap };
            let shadow = shadow(&surfaces[caster], light, gap, strength / (1.0 + gap));
            surfaces[receiver].darken(&shadow.grid, |x, y, behind| if behind < depth { shadow.at(x, y) } else { 0.0 });
        }
    }
}

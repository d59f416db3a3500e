//! One view of a scene: a ray through one point of the aperture for each sample of a regular grid.
//!
//! Rays through one aperture point are parallel in (x, y, dioptre), so a view is an oblique parallel projection of that
//! space, and surfaces are drawn into it row by row with a depth buffer: planes and ellipsoids by their equations,
//! meshes triangle by triangle. Every sample gets exactly what its ray meets first.

use super::grid::Grid;
use super::surface::{Mesh, Ray, Shape, Surface};

/// The aperture point that a view's rays pass through, in pixels per dioptre, and the depth at which they pass the
/// grid.
#[derive(Clone, Copy)]
pub(super) struct Aim {
    pub(super) ax: f32,
    pub(super) ay: f32,
    pub(super) grid_depth: f32,
}

impl Aim {
    /// Through the pupil's centre.
    pub(super) const PINHOLE: Self = Self { ax: 0.0, ay: 0.0, grid_depth: 0.0 };
}

/// Colour and depth of the nearest surface along each ray; black at minus infinity where there is none.
pub(super) struct View {
    pub(super) grid: Grid,
    /// Depths in dioptres, [rows, columns].
    pub(super) depth: Vec<f32>,
    /// [rows, columns] each: red, green, blue.
    pub(super) colours: [Vec<f32>; 3],
    /// Projected vertices of the mesh being drawn.
    projected: Vec<[f32; 2]>,
}

/// The surfaces in the order in which they are best drawn: nearest first, so that little is drawn twice.
pub(super) fn nearest_first(surfaces: &[Surface]) -> Vec<&Surface> {
    let mut order: Vec<&Surface> = surfaces.iter().collect();
    order.sort_by(|a, b| b.depth_near.total_cmp(&a.depth_near));
    order
}

impl View {
    pub(super) fn new(grid: Grid) -> Self {
        let samples = grid.columns * grid.rows;
        let colours = std::array::from_fn(|_| vec![0.0; samples]);
        Self { grid, depth: vec![f32::NEG_INFINITY; samples], colours, projected: Vec::new() }
    }

    /// Draws the surfaces anew, in the order given, on a grid whose first sample is at (left, top).
    pub(super) fn draw(&mut self, surfaces: &[&Surface], (left, top): (f32, f32), aim: Aim) {
        (self.grid.left, self.grid.top) = (left, top);
        self.depth.fill(f32::NEG_INFINITY);
        self.colours.iter_mut().for_each(|channel| channel.fill(0.0));
        for surface in surfaces {
            match &surface.shape {
                Shape::Mesh(mesh) => self.draw_mesh(surface, mesh, aim),
                Shape::Plane { .. } | Shape::Ellipsoid { .. } => self.draw_shape(surface, aim),
            }
        }
    }

    fn draw_shape(&mut self, surface: &Surface, aim: Aim) {
        let bounds = &surface.bounds;
        let shift = |a: f32| {
            let (near, far) = (a * (surface.depth_near - aim.grid_depth), a * (surface.depth_far - aim.grid_depth));
            (near.min(far), near.max(far))
        };
        let ((low_x, high_x), (low_y, high_y)) = (shift(aim.ax), shift(aim.ay));
        let (columns, rows) =
            self.grid.within(bounds.left - high_x, bounds.right - low_x, bounds.top - high_y, bounds.bottom - low_y);
        for row in rows {
            let y0 = self.grid.y(row) - aim.ay * aim.grid_depth;
            let start = row * self.grid.columns;
            let span = start + columns.start..start + columns.end;
            let [red, green, blue] = &mut self.colours;
            let pixels = self.depth[span.clone()]
                .iter_mut()
                .zip(&mut red[span.clone()])
                .zip(&mut green[span.clone()])
                .zip(&mut blue[span]);
            // Two loops, so that the shape is not asked for at each sample.
            macro_rules! draw_row {
                ($depth_along:expr) => {
                    for (column, (((depth, red), green), blue)) in columns.clone().zip(pixels) {
                        let ray = Ray { x0: self.grid.x(column) - aim.ax * aim.grid_depth, y0, ax: aim.ax, ay: aim.ay };
                        let hit: Option<f32> = $depth_along(&ray);
                        let Some(hit) = hit else { continue };
                        if hit <= *depth {
                            continue;
                        }
                        if let Some(texel) = surface.texel_at(ray.x0 + ray.ax * hit, ray.y0 + ray.ay * hit) {
                            *depth = hit;
                            (*red, *green, *blue) = (texel[0], texel[1], texel[2]);
                        }
                    }
                };
            }
            if let Shape::Plane { cx, cy, depth, gx, gy } = surface.shape {
                let share = 1.0 / (1.0 - gx * aim.ax - gy * aim.ay);
                draw_row!(|ray: &Ray| Some((depth + gx * (ray.x0 - cx) + gy * (ray.y0 - cy)) * share));
            } else {
                draw_row!(|ray: &Ray| surface.shape.depth_along(ray));
            }
        }
    }

    fn draw_mesh(&mut self, surface: &Surface, mesh: &Mesh, aim: Aim) {
        let mut projected = std::mem::take(&mut self.projected);
        projected.clear();
        projected.extend(mesh.vertices.iter().map(|v| {
            let lift = v.depth - aim.grid_depth;
            [v.x - aim.ax * lift, v.y - aim.ay * lift]
        }));
        for corners in &mesh.triangles {
            let [a, b, c] = corners.map(|corner| projected[corner as usize]);
            let twice_area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
            if twice_area == 0.0 {
                continue;
            }
            let share = 1.0 / twice_area;
            let (columns, rows) = self.grid.within(
                a[0].min(b[0]).min(c[0]),
                a[0].max(b[0]).max(c[0]),
                a[1].min(b[1]).min(c[1]),
                a[1].max(b[1]).max(c[1]),
            );
            let [va, vb, vc] = corners.map(|corner| &mesh.vertices[corner as usize]);
            for row in rows {
                let y = self.grid.y(row);
                for column in columns.clone() {
                    let x = self.grid.x(column);
                    // Shares of the corners b and c.
                    let at_b = ((x - a[0]) * (c[1] - a[1]) - (y - a[1]) * (c[0] - a[0])) * share;
                    let at_c = ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) * share;
                    let at_a = 1.0 - at_b - at_c;
                    if at_a < 0.0 || at_b < 0.0 || at_c < 0.0 {
                        continue;
                    }
                    let sample = row * self.grid.columns + column;
                    let depth = va.depth * at_a + vb.depth * at_b + vc.depth * at_c;
                    if depth <= self.depth[sample] {
                        continue;
                    }
                    let (u, v) = (va.u * at_a + vb.u * at_b + vc.u * at_c, va.v * at_a + vb.v * at_b + vc.v * at_c);
                    if let Some(texel) = surface.texel_at(u, v) {
                        self.depth[sample] = depth;
                        (0..3).for_each(|channel| self.colours[channel][sample] = texel[channel]);
                    }
                }
            }
        }
        self.projected = projected;
    }
}

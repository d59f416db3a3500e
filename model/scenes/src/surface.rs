//! Surfaces in the space (x, y, dioptre), where the rays of a thin lens are straight lines.
//!
//! x and y are the angles seen from the pupil's centre, in panel pixels from the middle of the picture. A ray through
//! the aperture point a (in pixels per dioptre: metres over the angle of a pixel) that meets the focus plane F at
//! (x_F, y_F) passes depth D at x_F + a_x·(D − F), y_F + a_y·(D − F). Planes of the world stay planes.

use super::grid::Grid;
use super::texture::{Pattern, Rgb};

/// Texels in a pixel's width.
pub(super) const TEXELS_PER_PIXEL: f32 = 2.0;
const OPAQUE: f32 = 0.5;

/// A straight line: (x, y) = (x0, y0) + (ax, ay)·D.
#[derive(Clone, Copy)]
pub(super) struct Ray {
    pub(super) x0: f32,
    pub(super) y0: f32,
    pub(super) ax: f32,
    pub(super) ay: f32,
}

/// Where a surface lies.
#[derive(Clone)]
pub(super) enum Shape {
    /// D = depth + gx·(x − cx) + gy·(y − cy).
    Plane { cx: f32, cy: f32, depth: f32, gx: f32, gy: f32 },
    /// Axis-parallel in this space; radii in pixels and dioptres.
    Ellipsoid { cx: f32, cy: f32, depth: f32, rx: f32, ry: f32, rd: f32 },
    /// Triangles, seen from either side.
    Mesh(Mesh),
}

/// A corner of triangles: direction, depth, and where on the texture it is, in pixels.
#[derive(Clone, Copy)]
pub(super) struct Vertex {
    pub(super) x: f32,
    pub(super) y: f32,
    pub(super) depth: f32,
    pub(super) u: f32,
    pub(super) v: f32,
}

#[derive(Clone)]
pub(super) struct Mesh {
    pub(super) vertices: Vec<Vertex>,
    pub(super) triangles: Vec<[u32; 3]>,
}

impl Shape {
    /// Depth of the first hit of a ray; a mesh is drawn, never asked.
    #[inline(always)]
    pub(super) fn depth_along(&self, ray: &Ray) -> Option<f32> {
        match *self {
            Self::Plane { cx, cy, depth, gx, gy } => {
                if gx == 0.0 && gy == 0.0 {
                    return Some(depth);
                }
                Some((depth + gx * (ray.x0 - cx) + gy * (ray.y0 - cy)) / (1.0 - gx * ray.ax - gy * ray.ay))
            }
            Self::Ellipsoid { cx, cy, depth, rx, ry, rd } => {
                let (px, py) = ((ray.x0 + ray.ax * depth - cx) / rx, (ray.y0 + ray.ay * depth - cy) / ry);
                let (qx, qy) = (ray.ax / rx, ray.ay / ry);
                let a = qx * qx + qy * qy + 1.0 / (rd * rd);
                let b = px * qx + py * qy;
                let discriminant = b * b - a * (px * px + py * py - 1.0);
                (discriminant >= 0.0).then(|| depth + (discriminant.sqrt() - b) / a)
            }
            Self::Mesh(_) => None,
        }
    }

    /// Depth seen from the pupil's centre in direction (x, y).
    pub(super) fn depth_at(&self, x: f32, y: f32) -> Option<f32> {
        self.depth_along(&Ray { x0: x, y0: y, ax: 0.0, ay: 0.0 })
    }
}

/// A rectangle of directions, in pixels.
#[derive(Clone, Copy, Debug)]
pub(super) struct Bounds {
    pub(super) left: f32,
    pub(super) top: f32,
    pub(super) right: f32,
    pub(super) bottom: f32,
}

/// A shape and its baked look: linear colour, and a mask that cuts its outline and holes.
pub(super) struct Surface {
    pub(super) shape: Shape,
    pub(super) bounds: Bounds,
    /// Nearest and farthest depth within the outline.
    pub(super) depth_near: f32,
    pub(super) depth_far: f32,
    pub(super) columns: i32,
    pub(super) rows: i32,
    /// [rows, columns] of red, green, blue and the painted share.
    pub(super) texels: Vec<[f32; 4]>,
}

impl Surface {
    /// Bakes `paint`, which gives colour where the surface is and nothing where it is cut away.
    pub(super) fn bake(shape: Shape, bounds: Bounds, paint: impl Fn(f32, f32) -> Option<Rgb>) -> Self {
        let (mut depth_near, mut depth_far) = (f32::NEG_INFINITY, f32::INFINITY);
        let (columns, rows, texels) = bake_texels(bounds, |x, y| {
            let (colour, depth) = (paint(x, y)?, shape.depth_at(x, y)?);
            depth_near = depth_near.max(depth);
            depth_far = depth_far.min(depth);
            Some(colour)
        });
        if let Shape::Ellipsoid { depth, rd, .. } = shape {
            (depth_near, depth_far) = (depth + rd, depth - rd);
        }
        // Rays of the aperture's edge meet a slanted plane a little outside the depths of its texel centres.
        Self { shape, bounds, depth_near: depth_near + 0.02, depth_far: depth_far - 0.02, columns, rows, texels }
    }

    /// Bakes `paint`, a function of the place (u, v) on a mesh's texture, within `bounds` of u and v.
    pub(super) fn bake_mesh(mesh: Mesh, bounds: Bounds, paint: impl Fn(f32, f32) -> Option<Rgb>) -> Self {
        let depths = || mesh.vertices.iter().map(|vertex| vertex.depth);
        let (depth_near, depth_far) = (depths().fold(0.0, f32::max), depths().fold(f32::INFINITY, f32::min));
        let (columns, rows, texels) = bake_texels(bounds, paint);
        Self { shape: Shape::Mesh(mesh), bounds, depth_near, depth_far, columns, rows, texels }
    }

    /// Left, top, right and bottom of the directions that the surface may cover, seen from the pupil's centre.
    pub(super) fn extent(&self) -> (f32, f32, f32, f32) {
        match &self.shape {
            Shape::Mesh(mesh) => mesh.vertices.iter().fold(
                (f32::INFINITY, f32::INFINITY, f32::NEG_INFINITY, f32::NEG_INFINITY),
                |(left, top, right, bottom), v| (left.min(v.x), top.min(v.y), right.max(v.x), bottom.max(v.y)),
            ),
            Shape::Plane { .. } | Shape::Ellipsoid { .. } => {
                (self.bounds.left, self.bounds.top, self.bounds.right, self.bounds.bottom)
            }
        }
    }

    /// Takes away the share of light that `darkness` gives for a direction and depth, within the rectangle of `grid`.
    pub(super) fn darken(&mut self, grid: &Grid, darkness: impl Fn(f32, f32, f32) -> f32) {
        let bounds = self.bounds;
        let range = |low: f32, high: f32, count: i32| {
            let texel = |place: f32| ((place * TEXELS_PER_PIXEL) as i32).clamp(0, count);
            texel(low)..texel(high + 1.0)
        };
        let (width, height) = (grid.columns as f32 * grid.step, grid.rows as f32 * grid.step);
        let columns = range(grid.left - bounds.left, grid.left + width - bounds.left, self.columns);
        for row in range(grid.top - bounds.top, grid.top + height - bounds.top, self.rows) {
            for column in columns.clone() {
                let x = bounds.left + (column as f32 + 0.5) / TEXELS_PER_PIXEL;
                let y = bounds.top + (row as f32 + 0.5) / TEXELS_PER_PIXEL;
                let Some(depth) = self.shape.depth_at(x, y) else { continue };
                let light = 1.0 - darkness(x, y, depth);
                let texel = &mut self.texels[(row * self.columns + column) as usize];
                (0..3).for_each(|c| texel[c] *= light);
            }
        }
    }

    /// Multiplies every colour by `gain`, up to 1.
    pub(super) fn scale_light(&mut self, gain: f32) {
        for texel in &mut self.texels {
            (0..3).for_each(|c| texel[c] = (texel[c] * gain).min(1.0));
        }
    }

    /// Makes every colour white.
    #[cfg(test)]
    pub(super) fn whiten(&mut self) {
        for texel in &mut self.texels {
            texel[..3].fill(1.0);
        }
    }

    /// The colour at a place on the surface, (x, y) or a mesh's (u, v); nothing where it is cut away.
    #[inline(always)]
    pub(super) fn texel_at(&self, x: f32, y: f32) -> Option<&[f32; 4]> {
        let u = (x - self.bounds.left) * TEXELS_PER_PIXEL;
        let v = (y - self.bounds.top) * TEXELS_PER_PIXEL;
        // Truncation towards zero maps -0.99 to 0, so the sign is asked first.
        if u < 0.0 || v < 0.0 {
            return None;
        }
        let (column, row) = (u as i32, v as i32);
        if column >= self.columns || row >= self.rows {
            return None;
        }
        let texel = &self.texels[(row * self.columns + column) as usize];
        (texel[3] >= OPAQUE).then_some(texel)
    }
}

/// Columns, rows and texels: each the mean of four samples that are painted, and the share of those as the fourth
/// number.
fn bake_texels(bounds: Bounds, mut paint: impl FnMut(f32, f32) -> Option<Rgb>) -> (i32, i32, Vec<[f32; 4]>) {
    let columns = ((bounds.right - bounds.left) * TEXELS_PER_PIXEL).ceil().max(1.0) as i32;
    let rows = ((bounds.bottom - bounds.top) * TEXELS_PER_PIXEL).ceil().max(1.0) as i32;
    let mut texels = Vec::with_capacity((columns * rows) as usize);
    for row in 0..rows {
        for column in 0..columns {
            let mut sum = [0.0; 4];
            for sample in 0..4 {
                let offset = [0.25, 0.75];
                let x = bounds.left + (column as f32 + offset[sample & 1]) / TEXELS_PER_PIXEL;
                let y = bounds.top + (row as f32 + offset[sample >> 1]) / TEXELS_PER_PIXEL;
                if let Some(colour) = paint(x, y) {
                    (0..3).for_each(|c| sum[c] += colour[c]);
                    sum[3] += 1.0;
                }
            }
            if sum[3] > 0.0 {
                (0..3).for_each(|c| sum[c] /= sum[3]);
            }
            sum[3] *= 0.25;
            texels.push(sum);
        }
    }
    (columns, rows, texels)
}

/// How a pattern is laid on a surface.
pub(super) struct Paint {
    pub(super) pattern: Pattern,
    /// Centre and direction of the pattern.
    pub(super) cx: f32,
    pub(super) cy: f32,
    pub(super) angle: f32,
    /// Brightness changes by this share from the centre over `shade_length`, along x and y.
    pub(super) shade: (f32, f32),
    pub(super) shade_length: f32,
}

impl Paint {
    pub(super) fn plain(pattern: Pattern, cx: f32, cy: f32) -> Self {
        Self { pattern, cx, cy, angle: 0.0, shade: (0.0, 0.0), shade_length: 1.0 }
    }

    pub(super) fn colour(&self, x: f32, y: f32) -> Rgb {
        let (dx, dy) = (x - self.cx, y - self.cy);
        let (sin, cos) = self.angle.sin_cos();
        let light = 1.0 + (self.shade.0 * dx + self.shade.1 * dy) / self.shade_length;
        let light = light.clamp(0.1, 1.5);
        self.pattern.colour(dx * cos + dy * sin, dy * cos - dx * sin).map(|c| (c * light).clamp(0.0, 1.0))
    }
}

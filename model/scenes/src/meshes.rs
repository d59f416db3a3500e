//! Procedural meshes: solids of revolution and prisms, tori, and lumps with bumps, turned at random and shaded.

use holod_model::scene_shard::SceneKind;

use super::families::pattern;
use super::random::Random;
use super::surface::{Bounds, Mesh, Surface, Vertex};
use super::texture::{Rgb, fractal_noise};

type Vector = [f32; 3];

/// A closed surface over (around, along) in 0..1 each, of about unit radius; z is towards the viewer.
enum Form {
    /// Turned or, with few sides, faceted: radius and height along the outline.
    Revolution { outline: Vec<[f32; 2]>, sides: u32, flat: bool },
    /// A ring whose tube has this radius; the ring's is 1.
    Torus { tube: f32 },
    /// A sphere displaced by noise.
    Lump { bumps: f32, scale: f32, seed: u32 },
}

impl Form {
    fn random(random: &mut Random) -> Self {
        let height = random.between(0.6, 1.5);
        match random.below(8) {
            0 => Self::Torus { tube: random.between(0.18, 0.45) },
            1..=2 => {
                Self::Lump { bumps: random.between(0.1, 0.6), scale: random.between(0.3, 1.2), seed: random.seed() }
            }
            3 => {
                let waist = random.between(0.25, 0.9);
                let neck = random.between(0.2, 0.7);
                let outline =
                    vec![[0.0, -height], [0.7, -height], [1.0, -0.4 * height], [waist, 0.5 * height], [neck, height]];
                Self::Revolution { outline, sides: 24, flat: false }
            }
            shape => {
                let top = [0.0, 1.0, random.between(0.2, 0.8)][(shape % 3) as usize];
                let outline = if random.chance(0.25) {
                    vec![[0.0, -height], [1.0, random.between(-0.3, 0.3)], [0.0, height]]
                } else {
                    vec![[0.0, -height], [1.0, -height], [top, height], [0.0, height]]
                };
                let flat = random.chance(0.6);
                Self::Revolution { outline, sides: if flat { 3 + random.below(6) } else { 24 }, flat }
            }
        }
    }

    /// Cells around and along.
    fn cells(&self) -> (u32, u32) {
        match self {
            Self::Revolution { outline, sides, .. } => (*sides, outline.len() as u32 - 1),
            Self::Torus { .. } => (28, 14),
            Self::Lump { .. } => (28, 18),
        }
    }

    fn point(&self, around: f32, along: f32) -> Vector {
        let (sin, cos) = (std::f32::consts::TAU * around).sin_cos();
        match self {
            Self::Revolution { outline, .. } => {
                let place = along * (outline.len() - 1) as f32;
                let segment = (place as usize).min(outline.len() - 2);
                let share = place - segment as f32;
                let [radius, height] =
                    [0, 1].map(|k| outline[segment][k] + share * (outline[segment + 1][k] - outline[segment][k]));
                [radius * cos, height, radius * sin]
            }
            Self::Torus { tube } => {
                let (tube_sin, tube_cos) = (std::f32::consts::TAU * along).sin_cos();
                let radius = 1.0 + tube * tube_cos;
                [radius * cos, tube * tube_sin, radius * sin]
            }
            Self::Lump { bumps, scale, seed } => {
                let (polar_sin, polar_cos) = (std::f32::consts::PI * along).sin_cos();
                let [x, y, z] = [polar_sin * cos, -polar_cos, polar_sin * sin];
                let bump = fractal_noise((x + 0.7 * z + 9.0) / scale, (y - 0.6 * z + 9.0) / scale, 3, *seed) - 0.5;
                let radius = 0.9 + bumps * bump;
                [radius * x, radius * y, radius * z]
            }
        }
    }

    /// The outward normal, of the facet where facets are flat.
    fn normal(&self, around: f32, along: f32) -> Vector {
        const STEP: f32 = 0.004;
        let (cells_around, cells_along) = self.cells();
        let middle = |place: f32, cells: u32| {
            let cells = cells as f32;
            ((place * cells).floor().clamp(0.0, cells - 1.0) + 0.5) / cells
        };
        let (around, along) = match self {
            Self::Revolution { flat: true, .. } => (middle(around, cells_around), middle(along, cells_along)),
            Self::Revolution { .. } => (around, middle(along, cells_along)),
            Self::Torus { .. } | Self::Lump { .. } => (around, along.clamp(2.0 * STEP, 1.0 - 2.0 * STEP)),
        };
        let difference = |a: Vector, b: Vector| [0, 1, 2].map(|k| a[k] - b[k]);
        let s = difference(self.point(around + STEP, along), self.point(around - STEP, along));
        let t = difference(self.point(around, along + STEP), self.point(around, along - STEP));
        // Around and then along turn so that this points outwards for every form above.
        normalised([t[1] * s[2] - t[2] * s[1], t[2] * s[0] - t[0] * s[2], t[0] * s[1] - t[1] * s[0]])
    }
}

fn normalised(v: Vector) -> Vector {
    let length = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt().max(1e-9);
    v.map(|component| component / length)
}

/// A random rotation, as three rows.
fn rotation(random: &mut Random) -> [Vector; 3] {
    // A uniform quaternion.
    let (u, a, b) =
        (random.unit(), random.between(0.0, std::f32::consts::TAU), random.between(0.0, std::f32::consts::TAU));
    let (x, y) = ((1.0 - u).sqrt() * a.sin(), (1.0 - u).sqrt() * a.cos());
    let (z, w) = (u.sqrt() * b.sin(), u.sqrt() * b.cos());
    [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]
}

/// A solid around (cx, cy, depth) of about `size` pixels' radius, within 0 and `near` dioptres.
pub(super) fn solid(
    random: &mut Random,
    kind: SceneKind,
    (cx, cy): (f32, f32),
    depth: f32,
    size: f32,
    near: f32,
) -> Surface {
    let form = Form::random(random);
    let turn = rotation(random);
    let turned = |v: Vector| turn.map(|row| row[0] * v[0] + row[1] * v[1] + row[2] * v[2]);
    // The farthest that a form reaches from its centre.
    const REACH: f32 = 1.9;
    let half_depth = random.between(0.05, 0.7).min(depth.max(0.02)).min((near - depth).max(0.02));
    let depth = depth.clamp(half_depth, near - half_depth);
    let (cells_around, cells_along) = form.cells();
    // The texture is as large as the surface, roughly.
    let (width, height) = ((4.0 * size).max(8.0), (2.6 * size).max(8.0));
    let mut vertices = Vec::new();
    for along in 0..=cells_along {
        for around in 0..=cells_around {
            let (s, t) = (around as f32 / cells_around as f32, along as f32 / cells_along as f32);
            let [x, y, z] = turned(form.point(s, t));
            let lift = half_depth * z / REACH;
            // Perspective: what is nearer is larger.
            let zoom = 1.0 + 0.3 * lift / near;
            vertices.push(Vertex {
                x: cx + size * x * zoom,
                y: cy + size * y * zoom,
                depth: depth + lift,
                // Never beyond the last texel.
                u: s * (width - 0.5),
                v: t * (height - 0.5),
            });
        }
    }
    let mut triangles = Vec::new();
    for along in 0..cells_along {
        for around in 0..cells_around {
            let corner = along * (cells_around + 1) + around;
            let below = corner + cells_around + 1;
            triangles.extend([[corner, corner + 1, below], [corner + 1, below + 1, below]]);
        }
    }
    let pattern = pattern(random, kind);
    let light = normalised([random.between(-0.8, 0.8), random.between(-1.0, 0.3), 1.0]);
    let ambient = random.between(0.12, 0.4);
    let (highlight, hardness) =
        (if random.chance(0.5) { random.between(0.2, 0.9) } else { 0.0 }, random.log_between(8.0, 80.0));
    let half_way = normalised([light[0], light[1], light[2] + 1.0]);
    let bounds = Bounds { left: 0.0, right: width, top: 0.0, bottom: height };
    Surface::bake_mesh(Mesh { vertices, triangles }, bounds, |u, v| {
        let normal = turned(form.normal(u / (width - 0.5), v / (height - 0.5)));
        let towards = |d: Vector| (normal[0] * d[0] + normal[1] * d[1] + normal[2] * d[2]).max(0.0);
        let lambert = ambient + (1.0 - ambient) * towards(light);
        let gloss = highlight * towards(half_way).powf(hardness);
        let colour: Rgb = pattern.colour(u, v);
        Some(colour.map(|c| (c * lambert + gloss).min(1.0)))
    })
}

//! Random scenes, drawn from a seed: what the network learns from and is tested on.

use holod_calibration::{DisplayGeometry, PupilDiameter, Resolution};
use holod_model::scene_shard::{Marks, SceneKind};

use super::families::{bright_and_dark, colour, marks, pattern};
use super::random::{Random, hash_unit, mix, stream};
use super::stage::{Reach, Stage};
use super::surface::{Bounds, Paint, Shape, Surface};
use super::texture::{Pattern, blend};
use super::thin_lens::{Lens, mean_light};
use super::{meshes, rooms, shadow};

/// A random scene: a background or a room, cards with print, and 15 to 40 primitives, more in a picture larger than 256
/// by 256 pixels.
pub(super) fn random_surfaces(
    kind: SceneKind,
    seed: u64,
    index: u64,
    resolution: Resolution,
    widest: PupilDiameter,
) -> Vec<Surface> {
    let mut random = Random::new(mix(seed) ^ stream(kind), index);
    let area = resolution.pixels() as f32 / (256.0 * 256.0);
    let stage = Stage {
        half_width: 0.5 * resolution.width as f32,
        half_height: 0.5 * resolution.height as f32,
        scale: if area < 1.0 { area.sqrt() } else { area.powf(0.25) },
        near: DisplayGeometry::DEFAULT.depth_near.0 as f32,
        kind,
        reach: Reach::of_radius(Lens::radius(widest)),
    };
    let more = area.sqrt().max(1.0);
    let mut surfaces = Vec::new();
    if random.chance(0.5) {
        surfaces.extend(rooms::room(&mut random, &stage));
    } else {
        surfaces.push(background(&mut random, &stage));
        if random.chance(0.4) {
            surfaces.push(ground(&mut random, &stage));
        }
    }
    let walls = surfaces.len();
    // Print near, far and anywhere.
    for (chance, low, high) in [(0.6, 0.72, 1.0), (0.35, 0.0, 0.3), (0.5, 0.0, 1.0)] {
        for _ in 0..more.round() as u32 {
            if random.chance(chance) {
                let depth = random.between(low, high) * stage.near;
                surfaces.push(marked_card(&mut random, &stage, depth));
            }
        }
    }
    let count = walls + ((12 + random.below(26)) as f32 * more) as usize;
    while surfaces.len() < count {
        primitive(&mut random, &stage, &mut surfaces);
    }
    if random.chance(0.8) {
        shadow::cast(&mut random, &mut surfaces, walls);
    }
    let target = random.between(0.15, 0.4);
    // Clipping at 1 takes some light away, so the gain is found in steps.
    for _ in 0..3 {
        let gain = (target / mean_light(&surfaces, resolution).max(1e-3)).clamp(0.3, 3.0);
        surfaces.iter_mut().for_each(|surface| surface.scale_light(gain));
    }
    surfaces
}

fn primitive(random: &mut Random, stage: &Stage, surfaces: &mut Vec<Surface>) {
    let cx = random.between(-1.05, 1.05) * stage.half_width;
    let cy = random.between(-1.05, 1.05) * stage.half_height;
    let depth = random.between(0.0, 1.0) * stage.near;
    let size = random.log_between(9.0, 58.0) * stage.scale;
    match random.below(26) {
        0..=10 => surfaces.push(card(random, stage, (cx, cy), depth, size)),
        11..=12 => surfaces.push(ellipsoid(random, stage, (cx, cy), depth, size * 0.8)),
        13..=16 => surfaces.push(meshes::solid(random, stage.kind, (cx, cy), depth, size * 0.7, stage.near)),
        17..=18 => boxed(random, stage, (cx, cy), depth, size * 0.8, surfaces),
        19..=20 => surfaces.push(rod(random, stage, (cx, cy), depth)),
        21 => surfaces.push(lattice(random, stage, (cx, cy), depth, size)),
        22..=23 => surfaces.push(strands(random, stage, (cx, cy), depth, size)),
        _ => surfaces.push(sparks(random, stage, (cx, cy), depth, size)),
    }
}

/// A plane through (cx, cy, depth), fronto-parallel or slanted so that it stays in the depth range within `radius`.
fn plane(random: &mut Random, stage: &Stage, (cx, cy): (f32, f32), depth: f32, radius: f32, slanted: f32) -> Shape {
    if !random.chance(slanted) {
        return Shape::Plane { cx, cy, depth, gx: 0.0, gy: 0.0 };
    }
    // One in four runs through most of the depth that there is around it.
    let most = if random.chance(0.25) { 1.4 } else { 0.7 };
    let half_span = random.between(0.05, most).min(depth).min(stage.near - depth);
    let slope = (half_span / radius).min(stage.reach.steepest);
    let (sin, cos) = random.between(0.0, std::f32::consts::TAU).sin_cos();
    Shape::Plane { cx, cy, depth, gx: slope * cos, gy: slope * sin }
}

fn card(random: &mut Random, stage: &Stage, (cx, cy): (f32, f32), depth: f32, size: f32) -> Surface {
    let outline = Outline::random(random, size);
    let shape = plane(random, stage, (cx, cy), depth, 1.5 * size, 0.4);
    let pattern = pattern(random, stage.kind);
    let paint = Paint {
        pattern,
        cx: cx + random.between(-40.0, 40.0),
        cy: cy + random.between(-40.0, 40.0),
        angle: if random.chance(0.5) { outline.turn() } else { random.between(0.0, std::f32::consts::TAU) },
        shade: (random.between(-0.3, 0.3), random.between(-0.3, 0.3)),
        shade_length: 2.0 * size,
    };
    let reach = 1.5 * size + 1.0;
    let bounds = Bounds { left: cx - reach, right: cx + reach, top: cy - reach, bottom: cy + reach };
    Surface::bake(shape, bounds, |x, y| outline.holds(x - cx, y - cy).then(|| paint.colour(x, y)))
}

/// A card with fine marks, dark on bright more often than not: paper, the hardest thing to refocus.
fn marked_card(random: &mut Random, stage: &Stage, depth: f32) -> Surface {
    let (hw, hh) = (random.between(26.0, 60.0) * stage.scale, random.between(22.0, 55.0) * stage.scale);
    let cx = random.between(-0.8, 0.8) * stage.half_width;
    let cy = random.between(-0.8, 0.8) * stage.half_height;
    let shape = plane(random, stage, (cx, cy), depth, hw.hypot(hh), 0.3);
    let pattern = marks(random, stage.kind);
    let turn = random.between(-0.4, 0.4);
    let paint = Paint {
        pattern,
        cx,
        cy,
        angle: turn,
        shade: (random.between(-0.15, 0.15), random.between(-0.15, 0.15)),
        shade_length: hw + hh,
    };
    let outline = Outline::Rectangle { half_width: hw, half_height: hh, turn };
    let reach = hw.hypot(hh) + 1.0;
    let bounds = Bounds { left: cx - reach, right: cx + reach, top: cy - reach, bottom: cy + reach };
    Surface::bake(shape, bounds, |x, y| outline.holds(x - cx, y - cy).then(|| paint.colour(x, y)))
}

fn ellipsoid(random: &mut Random, stage: &Stage, (cx, cy): (f32, f32), depth: f32, size: f32) -> Surface {
    let (rx, ry) = (size, size * random.between(0.7, 1.4));
    let rd = random.between(0.05, 0.6).min((stage.near - depth).max(0.02)).min(depth.max(0.02));
    let shape = Shape::Ellipsoid { cx, cy, depth: depth.clamp(rd, stage.near - rd), rx, ry, rd };
    let paint = Paint::plain(pattern(random, stage.kind), cx, cy);
    let (light_x, light_y, ambient) = (random.between(-0.7, 0.7), random.between(-0.8, 0.3), random.between(0.1, 0.4));
    let highlight = if random.chance(0.4) { random.between(0.2, 0.8) } else { 0.0 };
    let bounds = Bounds { left: cx - rx, right: cx + rx, top: cy - ry, bottom: cy + ry };
    Surface::bake(shape, bounds, |x, y| {
        let (nx, ny) = ((x - cx) / rx, (y - cy) / ry);
        let nz = (1.0 - nx * nx - ny * ny).max(0.0).sqrt();
        let lambert =
            ((nx * light_x + ny * light_y + nz) / (1.0 + light_x * light_x + light_y * light_y).sqrt()).max(0.0);
        let gloss = highlight * lambert.powi(40);
        Some(paint.colour(x, y).map(|c| (c * (ambient + (1.0 - ambient) * lambert) + gloss).min(1.0)))
    })
}

/// A box in true perspective: its front, and the sides that face the axis.
fn boxed(random: &mut Random, stage: &Stage, (cx, cy): (f32, f32), depth: f32, size: f32, surfaces: &mut Vec<Surface>) {
    let (hw, hh) = (size, size * random.between(0.6, 1.5));
    let back = depth * random.between(0.4, 0.85);
    let front = Paint::plain(pattern(random, stage.kind), cx, cy);
    let side = Paint::plain(pattern(random, stage.kind), cx, cy);
    let dim = random.between(0.35, 0.8);
    let rectangle = Bounds { left: cx - hw, right: cx + hw, top: cy - hh, bottom: cy + hh };
    let shape = Shape::Plane { cx, cy, depth, gx: 0.0, gy: 0.0 };
    surfaces.push(Surface::bake(shape, rectangle, |x, y| Some(front.colour(x, y))));
    // The side through an edge at e holds the world's X = e/depth, so its depth at x is depth·x/e.
    for edge in [cx - hw, cx + hw] {
        let faces_axis = (edge < cx) == (edge > 0.0);
        if faces_axis && (depth / edge).abs() < stage.reach.steepest {
            let other = edge * back / depth;
            let shape = Shape::Plane { cx: 0.0, cy: 0.0, depth: 0.0, gx: depth / edge, gy: 0.0 };
            let bounds = Bounds { left: edge.min(other), right: edge.max(other), ..rectangle };
            let bounds = Bounds {
                top: bounds.top.min(bounds.top * back / depth),
                bottom: bounds.bottom.max(bounds.bottom * back / depth),
                ..bounds
            };
            surfaces.push(Surface::bake(shape, bounds, |x, y| {
                let shrink = x / edge;
                let inside = y > rectangle.top * shrink && y < rectangle.bottom * shrink;
                inside.then(|| side.colour(x, y / shrink).map(|c| c * dim))
            }));
        }
    }
    for edge in [cy - hh, cy + hh] {
        let faces_axis = (edge < cy) == (edge > 0.0);
        if faces_axis && (depth / edge).abs() < stage.reach.steepest {
            let other = edge * back / depth;
            let shape = Shape::Plane { cx: 0.0, cy: 0.0, depth: 0.0, gx: 0.0, gy: depth / edge };
            let bounds = Bounds {
                left: rectangle.left.min(rectangle.left * back / depth),
                right: rectangle.right.max(rectangle.right * back / depth),
                top: edge.min(other),
                bottom: edge.max(other),
            };
            surfaces.push(Surface::bake(shape, bounds, |x, y| {
                let shrink = y / edge;
                let inside = x > rectangle.left * shrink && x < rectangle.right * shrink;
                inside.then(|| side.colour(x / shrink, y).map(|c| c * dim * 0.8))
            }));
        }
    }
}

fn rod(random: &mut Random, stage: &Stage, (cx, cy): (f32, f32), depth: f32) -> Surface {
    let half_length = random.between(25.0, 130.0) * stage.scale;
    let half_width = random.log_between(0.7, 4.0);
    let shape = plane(random, stage, (cx, cy), depth, half_length, 0.6);
    let (light, dark) = bright_and_dark(random);
    let colour = if random.chance(0.5) { light } else { dark };
    let turn = random.between(0.0, std::f32::consts::PI);
    let (sin, cos) = turn.sin_cos();
    let outline = Outline::Rectangle { half_width: half_length, half_height: half_width, turn };
    let (ex, ey) = (half_length * cos.abs() + half_width + 1.0, half_length * sin.abs() + half_width + 1.0);
    let bounds = Bounds { left: cx - ex, right: cx + ex, top: cy - ey, bottom: cy + ey };
    Surface::bake(shape, bounds, |x, y| {
        let across = (y - cy) * cos - (x - cx) * sin;
        outline.holds(x - cx, y - cy).then(|| colour.map(|c| c * (1.0 - 0.4 * across / half_width)))
    })
}

/// Bars with holes between them.
fn lattice(random: &mut Random, stage: &Stage, (cx, cy): (f32, f32), depth: f32, size: f32) -> Surface {
    let period = random.log_between(7.0, 26.0);
    let bar = period * random.between(0.12, 0.4);
    let crossed = random.chance(0.6);
    let turn = random.between(0.0, std::f32::consts::PI);
    let (sin, cos) = turn.sin_cos();
    let shape = plane(random, stage, (cx, cy), depth, 1.5 * size, 0.4);
    let paint = Paint::plain(pattern(random, stage.kind), cx, cy);
    let reach = 1.5 * size;
    let bounds = Bounds { left: cx - reach, right: cx + reach, top: cy - reach, bottom: cy + reach };
    let outline = Outline::Rectangle { half_width: size, half_height: size, turn };
    Surface::bake(shape, bounds, |x, y| {
        let (dx, dy) = (x - cx, y - cy);
        let (u, v) = (dx * cos + dy * sin, dy * cos - dx * sin);
        let on_bar = u.rem_euclid(period) < bar || (crossed && v.rem_euclid(period) < bar);
        (on_bar && outline.holds(dx, dy)).then(|| paint.colour(x, y))
    })
}

/// Grass, hair or wires: bent strokes that share a plane and taper.
fn strands(random: &mut Random, stage: &Stage, (cx, cy): (f32, f32), depth: f32, size: f32) -> Surface {
    let size = size.max(16.0);
    let shape = plane(random, stage, (cx, cy), depth, 1.5 * size, 0.5);
    let (light, dark) = bright_and_dark(random);
    let wires = random.chance(0.4);
    let count = if wires { 2 + random.below(5) } else { 12 + random.below(30) };
    let thickest = if wires { random.log_between(0.5, 1.2) } else { random.log_between(0.6, 1.6) };
    // Each starts at a foot, leans and bends as it goes up: x = foot + lean·t + bend·t².
    let strokes: Vec<[f32; 6]> = (0..count)
        .map(|_| {
            let foot = random.between(-0.9, 0.9) * size;
            let spread = if wires { 0.5 } else { 0.25 };
            let (lean, bend) = (random.between(-spread, spread) * size, random.between(-spread, spread) * size);
            [foot, lean, bend, random.between(0.5, 1.0), thickest * random.between(0.6, 1.0), random.unit()]
        })
        .collect();
    let turn = if wires { random.between(0.0, std::f32::consts::TAU) } else { random.between(-0.4, 0.4) };
    let (sin, cos) = turn.sin_cos();
    let reach = 1.9 * size;
    let bounds = Bounds { left: cx - reach, right: cx + reach, top: cy - reach, bottom: cy + reach };
    Surface::bake(shape, bounds, |x, y| {
        let (u, v) = ((x - cx) * cos + (y - cy) * sin, (y - cy) * cos - (x - cx) * sin);
        // Along the strands, from 0 at the foot.
        let t = 0.5 - 0.5 * v / size;
        if !(0.0..=1.0).contains(&t) {
            return None;
        }
        let on = strokes.iter().find(|[foot, lean, bend, height, width, _]| {
            let taper = if wires { 1.0 } else { 1.0 - t / height };
            t < *height && (u - foot - lean * t - bend * t * t).abs() < width * taper.max(0.25)
        })?;
        Some(blend(dark, light, (0.3 + 0.7 * t) * (0.4 + 0.6 * on[5])))
    })
}

/// Small bright dots that float before whatever is behind them.
fn sparks(random: &mut Random, stage: &Stage, (cx, cy): (f32, f32), depth: f32, size: f32) -> Surface {
    let size = size.max(12.0);
    let shape = plane(random, stage, (cx, cy), depth, 1.5 * size, 0.4);
    let radius = random.log_between(0.7, 2.5);
    let (light, dark) = (colour(random, 1.0), [0.0; 3]);
    let cell = radius * random.between(5.0, 14.0);
    let dots = Pattern::Dots { ground: dark, mark: light, cell, radius, presence: 0.7, seed: random.seed() };
    let reach = 1.5 * size;
    let bounds = Bounds { left: cx - reach, right: cx + reach, top: cy - reach, bottom: cy + reach };
    Surface::bake(shape, bounds, |x, y| Some(dots.colour(x, y)).filter(|colour| *colour != dark))
}

fn background(random: &mut Random, stage: &Stage) -> Surface {
    let depth = if random.chance(0.7) { 0.0 } else { random.between(0.0, 0.35) };
    let mut paint = Paint::plain(pattern(random, stage.kind), random.between(-50.0, 50.0), random.between(-50.0, 50.0));
    paint.angle = random.between(0.0, std::f32::consts::TAU);
    paint.shade = (random.between(-0.4, 0.4), random.between(-0.4, 0.4));
    paint.shade_length = 2.0 * stage.half_width;
    let dim = random.between(0.35, 1.0);
    let shape = Shape::Plane { cx: 0.0, cy: 0.0, depth, gx: 0.0, gy: 0.0 };
    let bounds = Bounds {
        left: -stage.half_width - stage.reach.overscan_px,
        right: stage.half_width + stage.reach.overscan_px,
        top: -stage.half_height - stage.reach.overscan_px,
        bottom: stage.half_height + stage.reach.overscan_px,
    };
    Surface::bake(shape, bounds, |x, y| Some(paint.colour(x, y).map(|c| c * dim)))
}

/// A floor, ceiling or wall that runs from the background to the near end.
fn ground(random: &mut Random, stage: &Stage) -> Surface {
    let side = random.below(5);
    let (half_along, half_across) = match side {
        0..=2 => (stage.half_height, stage.half_width),
        _ => (stage.half_width, stage.half_height),
    };
    let horizon = random.between(-0.3, 0.5) * half_along;
    let nearest = random.between(0.6, 1.0) * stage.near;
    let pattern = pattern(random, stage.kind);
    let dim = random.between(0.5, 1.0);
    Slope { pattern, side, half_along, half_across, horizon, nearest, dim }.surface(stage.reach)
}

/// A plane seen in perspective.
pub(super) struct Slope {
    pub(super) pattern: Pattern,
    /// 0 to 2 below, 3 right, 4 left.
    pub(super) side: u32,
    pub(super) half_along: f32,
    pub(super) half_across: f32,
    /// Where its depth is 0, and whence it grows to `nearest` at the picture's edge.
    pub(super) horizon: f32,
    pub(super) nearest: f32,
    pub(super) dim: f32,
}

impl Slope {
    pub(super) fn surface(self, reach: Reach) -> Surface {
        let Self { pattern, side, half_along, half_across, horizon, nearest, dim } = self;
        const FARTHEST: f32 = 0.12;
        let rate = (nearest / (half_along - horizon)).min(reach.steepest_wall);
        let start = horizon + FARTHEST / rate;
        let end = half_along + reach.overscan_px;
        let across = half_across + reach.overscan_px;
        let (gx, gy, cx, cy) = match side {
            3 => (rate, 0.0, horizon, 0.0),
            4 => (-rate, 0.0, -horizon, 0.0),
            _ => (0.0, rate, 0.0, horizon),
        };
        let bounds = match side {
            3 => Bounds { left: start, right: end, top: -across, bottom: across },
            4 => Bounds { left: -end, right: -start, top: -across, bottom: across },
            _ => Bounds { left: -across, right: across, top: start, bottom: end },
        };
        let average = (0..400).fold([0.0; 3], |sum, k| {
            let colour = pattern.colour((k % 20) as f32 * 7.3, (k / 20) as f32 * 9.1);
            std::array::from_fn(|c| sum[c] + colour[c] / 400.0)
        });
        // The pattern's own scale holds at 2 dioptres; where it shrinks below the texels it fades into its average.
        let paint = move |x: f32, y: f32| {
            let (along, across) = match side {
                3 => (x, y),
                4 => (-x, y),
                _ => (y, x),
            };
            let depth = rate * (along - horizon);
            let shrunk = 2.0 / depth;
            let colour = pattern.colour(across * shrunk, -4.0 / (rate * depth));
            let fade = (1.6 / (shrunk * shrunk)).clamp(0.0, 1.0);
            Some(blend(average, colour, fade).map(|c| c * dim))
        };
        Surface::bake(Shape::Plane { cx, cy, depth: 0.0, gx, gy }, bounds, paint)
    }
}

/// The cut of a card around its centre.
enum Outline {
    Rectangle {
        half_width: f32,
        half_height: f32,
        turn: f32,
    },
    Ellipse {
        rx: f32,
        ry: f32,
        turn: f32,
    },
    Ring {
        outer: f32,
        inner: f32,
    },
    /// Half-planes: direction and distance.
    Polygon {
        sides: Vec<(f32, f32, f32)>,
        turn: f32,
    },
}

impl Outline {
    fn random(random: &mut Random, size: f32) -> Self {
        let turn = if random.chance(0.4) { 0.0 } else { random.between(0.0, std::f32::consts::TAU) };
        match random.below(10) {
            0..=4 => {
                let half_height = size * random.between(0.35, 1.1);
                Self::Rectangle { half_width: size, half_height, turn }
            }
            5..=6 => Self::Ellipse { rx: size, ry: size * random.between(0.5, 1.0), turn },
            7 => Self::Ring { outer: size, inner: size * random.between(0.4, 0.85) },
            _ => {
                let count = 3 + random.below(4);
                let sides = (0..count)
                    .map(|side| {
                        let jitter = random.between(-0.25, 0.25);
                        let angle = turn + std::f32::consts::TAU * (side as f32 + jitter) / count as f32;
                        let distance = size * random.between(0.45, 0.75);
                        (angle.cos(), angle.sin(), distance)
                    })
                    .collect();
                Self::Polygon { sides, turn }
            }
        }
    }

    fn turn(&self) -> f32 {
        match *self {
            Self::Rectangle { turn, .. } | Self::Ellipse { turn, .. } | Self::Polygon { turn, .. } => turn,
            Self::Ring { .. } => 0.0,
        }
    }

    fn holds(&self, dx: f32, dy: f32) -> bool {
        match self {
            &Self::Rectangle { half_width, half_height, turn } => {
                let (sin, cos) = turn.sin_cos();
                (dx * cos + dy * sin).abs() < half_width && (dy * cos - dx * sin).abs() < half_height
            }
            &Self::Ellipse { rx, ry, turn } => {
                let (sin, cos) = turn.sin_cos();
                ((dx * cos + dy * sin) / rx).powi(2) + ((dy * cos - dx * sin) / ry).powi(2) < 1.0
            }
            &Self::Ring { outer, inner } => (inner * inner..outer * outer).contains(&(dx * dx + dy * dy)),
            Self::Polygon { sides, .. } => sides.iter().all(|(nx, ny, distance)| dx * nx + dy * ny < *distance),
        }
    }
}

/// The refocus test: two cards of fine marks, which `random` draws, one near on the left and one far on the right.
pub(super) fn refocus_cards(
    dark_on_bright: bool,
    mut random: Random,
    resolution: Resolution,
    widest: PupilDiameter,
) -> Vec<Surface> {
    let Reach { overscan_px, .. } = Reach::of_radius(Lens::radius(widest));
    let (half_width, half_height) = (0.5 * resolution.width as f32, 0.5 * resolution.height as f32);
    let scale = resolution.width.min(resolution.height) as f32 / 256.0;
    let backdrop = [0.12, 0.12, 0.12];
    let wall = Bounds {
        left: -half_width - overscan_px,
        right: half_width + overscan_px,
        top: -half_height - overscan_px,
        bottom: half_height + overscan_px,
    };
    let flat = |depth| Shape::Plane { cx: 0.0, cy: 0.0, depth, gx: 0.0, gy: 0.0 };
    let mut surfaces = vec![Surface::bake(flat(0.0), wall, |_, _| Some(backdrop))];
    let (light, dark) = ([0.8, 0.8, 0.8], [0.03, 0.03, 0.03]);
    let (ground, mark) = if dark_on_bright { (light, dark) } else { (dark, light) };
    for (side, depth) in [(-1.0, 2.5), (1.0, 0.25)] {
        let margin = 10.0 * scale;
        let (inner, outer) = (side * margin, side * (half_width - margin));
        let bounds = Bounds {
            left: inner.min(outer),
            right: inner.max(outer),
            top: margin - half_height,
            bottom: half_height - margin,
        };
        let middle = 0.5 * (inner + outer);
        let text = |height: f32, weight: f32, seed| Pattern::Text { ground, mark, height, weight, seed };
        let parts = [
            text(22.0, 3.5, random.seed()),
            text(13.0, 2.2, random.seed()),
            Pattern::Dots { ground, mark, cell: 9.0, radius: 2.0, presence: 0.7, seed: random.seed() },
            Pattern::Ticks { ground, mark, cell: 11.0, width: 2.5, seed: random.seed() },
        ];
        let quarter = (bounds.bottom - bounds.top) / parts.len() as f32;
        surfaces.push(Surface::bake(flat(depth), bounds, |x, y| {
            let part = (((y - bounds.top) / quarter) as usize).min(parts.len() - 1);
            let (u, v) = (x - middle, y - bounds.top - quarter * part as f32);
            let rim = (x - bounds.left).min(bounds.right - x).min(y - bounds.top).min(bounds.bottom - y) < 4.0;
            Some(if rim { ground } else { parts[part].colour(u, v) })
        }));
    }
    surfaces
}

/// Bright marks, which `random` draws, in the lower half of a black picture: on the left they stand at 2.5 dioptres, on
/// the right at 0.25.
pub(super) fn bright_marks(
    marks: Marks,
    mut random: Random,
    resolution: Resolution,
    widest: PupilDiameter,
) -> Vec<Surface> {
    let Reach { overscan_px, .. } = Reach::of_radius(Lens::radius(widest));
    const CELL_PX: f32 = 24.0;
    let (half_width, half_height) = (0.5 * resolution.width as f32, 0.5 * resolution.height as f32);
    let black = |left, top, right, bottom, depth, paint: &dyn Fn(f32, f32) -> f32| {
        let shape = Shape::Plane { cx: 0.0, cy: 0.0, depth, gx: 0.0, gy: 0.0 };
        Surface::bake(shape, Bounds { left, top, right, bottom }, |x, y| Some([paint(x, y); 3]))
    };
    let (across, down) = (half_width + overscan_px, half_height + overscan_px);
    let mut surfaces = vec![black(-across, -down, across, down, 0.0, &|_, _| 0.0)];
    // Nothing is cut off, and what is out of focus stays in the picture.
    let margin = 0.5 * CELL_PX;
    let (columns, rows) =
        (((half_width - 2.0 * margin) / CELL_PX) as i32, ((half_height - 3.0 * margin) / CELL_PX) as i32);
    for (side, depth) in [(-1.0, 2.5), (1.0, 0.25)] {
        let inner = side * margin;
        let left = inner.min(inner + side * columns as f32 * CELL_PX);
        let (right, top) = (left + columns as f32 * CELL_PX, 2.0 * margin);
        let seed = random.seed();
        let paint = |x: f32, y: f32| {
            let (u, v) = ((x - left) / CELL_PX, (y - top) / CELL_PX);
            let (column, row) = (u.floor() as i32, v.floor() as i32);
            let unit = |which: i32| hash_unit(8 * column + which, row, seed);
            // From the mark's middle, which is somewhere in the middle of its cell.
            let (dx, dy) = (u - column as f32 - 0.4 - 0.2 * unit(0), v - row as f32 - 0.4 - 0.2 * unit(1));
            let (dx, dy) = (CELL_PX * dx, CELL_PX * dy);
            match marks {
                // As large as a pixel to as large as nine.
                Marks::Dots => f32::from(dx.hypot(dy) < 0.6 + 1.1 * unit(2)),
                // 1 to 2 px wide and 14 long; in every other cell on a diagonal.
                Marks::Lines => {
                    let turns =
                        if (column + row) % 2 == 0 { 0.125 + 0.25 * (unit(2) * 2.0).floor() } else { 0.5 * unit(2) };
                    let (sin, cos) = (std::f32::consts::TAU * turns).sin_cos();
                    let (along, beside) = (dx * cos + dy * sin, dy * cos - dx * sin);
                    f32::from(beside.abs() < 0.5 + 0.5 * unit(3) && along.abs() < 7.0)
                }
                // Of 2 to 100 % of the light, most of them faint.
                Marks::Stars => {
                    let light = 0.02 + 0.98 * unit(2) * unit(2);
                    if dx.hypot(dy) < 3.0 { light * (-(dx * dx + dy * dy) / 1.3).exp() } else { 0.0 }
                }
            }
        };
        surfaces.push(black(left, top, right, top + rows as f32 * CELL_PX, depth, &paint));
    }
    surfaces
}

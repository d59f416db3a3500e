//! The built-in demonstration scene, composed by hand for a picture 512 pixels high and scaled to others.

use holod_calibration::Resolution;

use super::compose::Slope;
use super::stage::Reach;
use super::surface::{Bounds, Paint, Shape, Surface};
use super::texture::{Pattern, Rgb, fractal_noise};

const PAPER: Rgb = [0.72, 0.69, 0.60];
const INK: Rgb = [0.03, 0.03, 0.05];
const SLATE: Rgb = [0.03, 0.05, 0.09];
const CHALK: Rgb = [0.78, 0.82, 0.80];

/// Angles of the composition in units of the picture: x from -1 at the left to 1 at the right, y likewise downwards,
/// and lengths in `unit`, the same along both.
struct Stage {
    half_width: f32,
    half_height: f32,
    unit: f32,
}

/// The demonstration's surfaces for a picture of `resolution`.
pub(super) fn surfaces(resolution: Resolution) -> Vec<Surface> {
    let stage = Stage {
        half_width: 0.5 * resolution.width as f32,
        half_height: 0.5 * resolution.height as f32,
        unit: resolution.width.min(resolution.height) as f32 / 512.0,
    };
    let mut surfaces = vec![sky(&stage), floor(&stage)];
    surfaces.extend(hills(&stage));
    surfaces.push(near_card(&stage));
    surfaces.push(far_card(&stage));
    surfaces.push(ball(&stage, (0.03, 0.20), 58.0, 1.2));
    surfaces.push(hoop(&stage, (0.10, -0.62), 44.0, 1.8));
    surfaces.push(wire(&stage));
    surfaces
}

fn facing(depth: f32) -> Shape {
    Shape::Plane { cx: 0.0, cy: 0.0, depth, gx: 0.0, gy: 0.0 }
}

fn around(cx: f32, cy: f32, half_width: f32, half_height: f32) -> Bounds {
    Bounds { left: cx - half_width, right: cx + half_width, top: cy - half_height, bottom: cy + half_height }
}

/// An evening sky with stars, at infinity.
fn sky(stage: &Stage) -> Surface {
    let unit = stage.unit;
    let stars = Pattern::Dots {
        ground: [0.0; 3],
        mark: [0.9, 0.9, 0.75],
        cell: 34.0 * unit,
        radius: 1.7 * unit.max(0.7),
        presence: 0.7,
        seed: 5,
    };
    let bounds =
        around(0.0, 0.0, stage.half_width + Reach::USUAL.overscan_px, stage.half_height + Reach::USUAL.overscan_px);
    let (low, high): (Rgb, Rgb) = ([0.55, 0.26, 0.16], [0.03, 0.06, 0.18]);
    Surface::bake(facing(0.0), bounds, |x, y| {
        let height = (0.45 - y / stage.half_height).clamp(0.0, 1.4) / 1.4;
        let cloud = 0.75 + 0.5 * fractal_noise(x / (120.0 * unit), y / (40.0 * unit), 4, 11);
        let star = stars.colour(x, y);
        Some(std::array::from_fn(|c| {
            let glow = (low[c] * (1.0 - height).powi(2) + high[c]) * cloud;
            (glow + star[c] * height * height * 1.3).min(1.0)
        }))
    })
}

/// Two ridges below the sky, at 0.08 and 0.16 dioptres.
fn hills(stage: &Stage) -> Vec<Surface> {
    let unit = stage.unit;
    [(0.08, 0.05, [0.10, 0.07, 0.14], 3), (0.16, 0.16, [0.05, 0.06, 0.07], 8)]
        .map(|(depth, level, colour, seed): (f32, f32, Rgb, u32)| {
            let middle = 0.25 * stage.half_height;
            let bounds = around(0.0, middle, stage.half_width + Reach::USUAL.overscan_px, 0.45 * stage.half_height);
            Surface::bake(facing(depth), bounds, |x, y| {
                let ridge =
                    level * stage.half_height - 90.0 * unit * (fractal_noise(x / (130.0 * unit), 0.5, 4, seed) - 0.5);
                let texture = 0.6 + 0.8 * fractal_noise(x / (9.0 * unit), y / (9.0 * unit), 3, seed);
                (y > ridge).then(|| colour.map(|c| c * texture))
            })
        })
        .into()
}

/// A checkered floor from the hills to the viewer's feet.
fn floor(stage: &Stage) -> Surface {
    let pattern = Pattern::Checker { a: [0.50, 0.46, 0.38], b: [0.07, 0.10, 0.11], period: 62.0 * stage.unit };
    Slope {
        pattern,
        side: 0,
        half_along: stage.half_height,
        half_across: stage.half_width,
        horizon: 0.22 * stage.half_height,
        nearest: 2.7,
        dim: 0.9,
    }
    .surface(Reach::USUAL)
}

/// Paper with print at 2.5 dioptres, on the left.
fn near_card(stage: &Stage) -> Surface {
    let unit = stage.unit;
    let (cx, cy) = (-0.53 * stage.half_width, -0.06 * stage.half_height);
    let lines = |height: f32, weight: f32, y: f32, lines: Vec<&'static str>| {
        let pattern = Pattern::Words { ground: PAPER, mark: INK, height: height * unit, weight: weight * unit, lines };
        Paint::plain(pattern, cx, cy + y * unit)
    };
    let title = lines(38.0, 6.0, -108.0, vec!["NEAR"]);
    let subtitle = lines(14.0, 2.4, -62.0, vec!["40 CM  2.5 DPT"]);
    let text = lines(
        11.0,
        2.0,
        6.0,
        vec!["LIGHT THAT ENTERS", "A WIDER PUPIL", "BLURS MORE OF", "WHAT THE EYE IS", "NOT FOCUSED ON"],
    );
    let chart = Pattern::Ticks { ground: PAPER, mark: INK, cell: 13.0 * unit, width: 2.6 * unit, seed: 2 };
    let stamp = Pattern::Stripes { a: [0.55, 0.06, 0.05], b: PAPER, period: 7.0 * unit, duty: 0.5, sine: false };
    let bounds = around(cx, cy, 108.0 * unit, 152.0 * unit);
    Surface::bake(facing(2.5), bounds, |x, y| {
        let (dx, dy) = ((x - cx) / unit, (y - cy) / unit);
        Some(if dx.abs() > 100.0 || dy.abs() > 144.0 {
            [0.30, 0.12, 0.06]
        } else if dy < -78.0 {
            title.colour(x, y)
        } else if dy < -48.0 {
            subtitle.colour(x, y)
        } else if dy < 62.0 {
            text.colour(x, y)
        } else if dx.abs() > 90.0 || !(76.0..136.0).contains(&dy) {
            PAPER
        } else if dx < 14.0 {
            chart.colour((dx + 90.0) * unit, (dy - 74.0) * unit)
        } else if (dx - 56.0).hypot(dy - 106.0) < 29.0 {
            stamp.colour(x - cx + dy * 0.4 * unit, y)
        } else {
            PAPER
        })
    })
}

/// A board with chalk at 0.25 dioptres, on the right.
fn far_card(stage: &Stage) -> Surface {
    let unit = stage.unit;
    let (cx, cy) = (0.55 * stage.half_width, -0.16 * stage.half_height);
    let lines = |height: f32, weight: f32, y: f32, lines: Vec<&'static str>| {
        let pattern =
            Pattern::Words { ground: SLATE, mark: CHALK, height: height * unit, weight: weight * unit, lines };
        Paint::plain(pattern, cx, cy + y * unit)
    };
    let title = lines(38.0, 6.0, -76.0, vec!["FAR"]);
    let subtitle = lines(14.0, 2.4, -30.0, vec!["4 M  0.25 DPT"]);
    let text = lines(11.0, 2.0, 22.0, vec!["FOCUS HERE AND", "THE PRINTED CARD", "ON THE LEFT", "DISSOLVES"]);
    let dots =
        Pattern::Dots { ground: SLATE, mark: CHALK, cell: 11.0 * unit, radius: 2.4 * unit, presence: 0.7, seed: 4 };
    let board = around(cx, cy, 104.0 * unit, 116.0 * unit);
    Surface::bake(facing(0.25), board, |x, y| {
        let (dx, dy) = ((x - cx) / unit, (y - cy) / unit);
        Some(if dx.abs() > 97.0 || dy.abs() > 109.0 {
            [0.42, 0.30, 0.14]
        } else if dy < -46.0 {
            title.colour(x, y)
        } else if dy < -14.0 {
            subtitle.colour(x, y)
        } else if dy < 62.0 {
            text.colour(x, y)
        } else if dx.abs() < 88.0 && (69.0..102.0).contains(&dy) {
            dots.colour((dx + 88.0) * unit, (dy - 69.0) * unit)
        } else {
            SLATE
        })
    })
}

fn ball(stage: &Stage, (cx, cy): (f32, f32), radius: f32, depth: f32) -> Surface {
    let (cx, cy, radius) = (cx * stage.half_width, cy * stage.half_height, radius * stage.unit);
    let shape = Shape::Ellipsoid { cx, cy, depth, rx: radius, ry: radius, rd: 0.12 };
    Surface::bake(shape, around(cx, cy, radius, radius), |x, y| {
        let (nx, ny) = ((x - cx) / radius, (y - cy) / radius);
        let nz = (1.0 - nx * nx - ny * ny).max(0.0).sqrt();
        let around_axis = (nx * 0.94 + ny * 0.34).atan2(nz);
        let along_axis = ny * 0.94 - nx * 0.34;
        let segment = (around_axis / std::f32::consts::PI * 8.0 + 20.5).floor() as i32;
        let paint: Rgb = match segment.rem_euclid(3) {
            _ if along_axis.abs() < 0.06 => [0.9, 0.85, 0.7],
            0 => [0.75, 0.10, 0.06],
            1 => [0.85, 0.55, 0.07],
            _ => [0.08, 0.25, 0.55],
        };
        let light = (0.35 * nx - 0.6 * ny + 0.72 * nz).max(0.0);
        let gloss = 0.7 * light.powi(50);
        Some(paint.map(|c| (c * (0.18 + 0.9 * light) + gloss).min(1.0)))
    })
}

/// A ring that floats.
fn hoop(stage: &Stage, (cx, cy): (f32, f32), radius: f32, depth: f32) -> Surface {
    let (cx, cy, radius) = (cx * stage.half_width, cy * stage.half_height, radius * stage.unit);
    Surface::bake(facing(depth), around(cx, cy, radius, radius), |x, y| {
        let distance = (x - cx).hypot(y - cy) / radius;
        let sector = ((y - cy).atan2(x - cx) / std::f32::consts::PI * 8.0 + 16.0) as i32;
        let paint: Rgb = if sector % 2 == 0 { [0.10, 0.55, 0.42] } else { [0.80, 0.80, 0.72] };
        let round = 1.0 - 4.0 * ((distance - 0.82) / 0.36).powi(2);
        (0.68..0.96).contains(&distance).then(|| paint.map(|c| c * (0.35 + 0.65 * round)))
    })
}

/// A cable that comes from the far right to the near left, above everything, with a mark at equal steps of depth.
fn wire(stage: &Stage) -> Surface {
    let (right, left) = (0.98 * stage.half_width, -0.98 * stage.half_width);
    let rate = 2.4 / (left - right);
    let y0 = -0.86 * stage.half_height;
    let shape = Shape::Plane { cx: right, cy: 0.0, depth: 0.15, gx: rate, gy: 0.0 };
    let bounds = Bounds { left, right, top: y0 - 14.0 * stage.unit, bottom: y0 + 14.0 * stage.unit };
    Surface::bake(shape, bounds, |x, y| {
        let depth = 0.15 + rate * (x - right);
        let size = stage.unit * (0.5 + 0.5 * depth / 2.55);
        let from_mark = (depth / 0.3 - (depth / 0.3).round()) * 0.3 / rate;
        let dy = y - y0;
        let on_mark = from_mark.hypot(dy) < 10.0 * size;
        let on_cable = dy.abs() < 2.2 * size;
        match (on_mark, on_cable) {
            (true, _) => Some([0.9, 0.55, 0.12]),
            (false, true) => Some([0.45, 0.45, 0.45]),
            (false, false) => None,
        }
    })
}

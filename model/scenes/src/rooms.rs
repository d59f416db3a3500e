//! A room in true perspective: a back wall, and side walls, floor and ceiling that run from it to the viewer.

use super::families::pattern;
use super::random::Random;
use super::stage::Stage;
use super::surface::{Bounds, Shape, Surface};
use super::texture::{Pattern, Rgb, blend};

/// Floors and walls are cut here, in dioptres: their pattern has shrunk to nothing.
const FARTHEST: f32 = 0.06;

/// One to four sides of a room and its back wall. All lines that lead away from the viewer meet in one point.
pub(super) fn room(random: &mut Random, stage: &Stage) -> Vec<Surface> {
    let vanishing = (random.between(-0.35, 0.35) * stage.half_width, random.between(-0.35, 0.35) * stage.half_height);
    let back = if random.chance(0.3) { 0.0 } else { random.log_between(0.1, 0.8) };
    let mut surfaces = Vec::new();
    let everywhere = Bounds {
        left: -stage.half_width - stage.reach.overscan_px,
        right: stage.half_width + stage.reach.overscan_px,
        top: -stage.half_height - stage.reach.overscan_px,
        bottom: stage.half_height + stage.reach.overscan_px,
    };
    let wall = pattern(random, stage.kind);
    let (turn, dim) = (if random.chance(0.6) { 0.0f32 } else { random.between(-0.3, 0.3) }, random.between(0.3, 1.0));
    let (sin, cos) = turn.sin_cos();
    let shape = Shape::Plane { cx: 0.0, cy: 0.0, depth: back, gx: 0.0, gy: 0.0 };
    surfaces.push(Surface::bake(shape, everywhere, |x, y| {
        let (x, y) = (x - vanishing.0, y - vanishing.1);
        Some(wall.colour(x * cos + y * sin, y * cos - x * sin).map(|c| c * dim))
    }));
    let present: [bool; 4] = [random.chance(0.9), random.chance(0.5), random.chance(0.5), random.chance(0.5)];
    for (side, _) in present.iter().enumerate().filter(|(_, present)| **present) {
        let pattern = pattern(random, stage.kind);
        let nearest = random.between(1.2, stage.near);
        let lamp = (random.between(0.6, 1.0), random.between(0.0, 0.4));
        surfaces.push(side_wall(stage, side, vanishing, back, nearest, pattern, lamp));
    }
    surfaces
}

/// `side`: 0 floor, 1 ceiling, 2 right, 3 left. The depth is `nearest` at the picture's edge. `lamp`: how bright the
/// near end is, and the far end's share of it.
fn side_wall(
    stage: &Stage,
    side: usize,
    vanishing: (f32, f32),
    back: f32,
    nearest: f32,
    pattern: Pattern,
    lamp: (f32, f32),
) -> Surface {
    let (upright, sign) = (side < 2, if side.is_multiple_of(2) { 1.0 } else { -1.0 });
    let (centre_along, centre_across, half_along) = if upright {
        (vanishing.1, vanishing.0, stage.half_height)
    } else {
        (vanishing.0, vanishing.1, stage.half_width)
    };
    // Depth grows in proportion to the distance from the vanishing point: a plane of the world beside the viewer.
    let rate = (nearest / (half_along - sign * centre_along)).min(stage.reach.steepest_wall);
    let slope = sign * rate;
    let (gx, gy) = if upright { (0.0, slope) } else { (slope, 0.0) };
    let shape = Shape::Plane { cx: vanishing.0, cy: vanishing.1, depth: 0.0, gx, gy };
    let start = centre_along + sign * back.max(FARTHEST) / rate;
    let end = sign * (half_along + stage.reach.overscan_px);
    let (low, high) = (start.min(end), start.max(end));
    let (across_x, across_y) =
        (stage.half_width + stage.reach.overscan_px, stage.half_height + stage.reach.overscan_px);
    let bounds = if upright {
        Bounds { left: -across_x, right: across_x, top: low, bottom: high }
    } else {
        Bounds { left: low, right: high, top: -across_y, bottom: across_y }
    };
    let average: Rgb = (0..400).fold([0.0; 3], |sum, k| {
        let colour = pattern.colour((k % 20) as f32 * 7.3, (k / 20) as f32 * 9.1);
        std::array::from_fn(|c| sum[c] + colour[c] / 400.0)
    });
    Surface::bake(shape, bounds, |x, y| {
        let (along, across) = if upright { (y, x) } else { (x, y) };
        let depth = slope * (along - centre_along);
        // The pattern has its own scale at 2 dioptres, and fades into its average where it shrinks below the texels.
        let shrunk = 2.0 / depth;
        let colour = pattern.colour((across - centre_across) * shrunk, -4.0 / (rate * depth));
        let fade = (1.6 / (shrunk * shrunk)).clamp(0.0, 1.0);
        let light = lamp.0 * (lamp.1 + (1.0 - lamp.1) * (depth / stage.near).clamp(0.0, 1.0).sqrt());
        // Corners with the back wall are darker.
        let corner = 1.0 - 0.35 * (-(depth - back.max(FARTHEST)) / 0.08).exp();
        Some(blend(average, colour, fade).map(|c| c * light * corner))
    })
}

//! Procedural surface patterns, in linear light.
//!
//! A pattern is a function of a point in pixels; it knows nothing of sampling. The surface that wears it bakes it into
//! texels of half a pixel with several samples each, which band-limits it.

use super::glyphs;
use super::random::{hash, hash_unit};

/// Linear red, green, blue.
pub(super) type Rgb = [f32; 3];

pub(super) fn blend(a: Rgb, b: Rgb, share: f32) -> Rgb {
    std::array::from_fn(|c| a[c] + (b[c] - a[c]) * share)
}

/// A cosine of a spectral texture: wave vector in radians per pixel, phase, amplitude.
pub(super) struct Wave {
    pub(super) kx: f32,
    pub(super) ky: f32,
    pub(super) phase: f32,
    pub(super) amplitude: f32,
}

/// What a surface is painted with. Lengths are pixels.
pub(super) enum Pattern {
    Flat(Rgb),
    /// From `a` to `b` along x over `length`, centred on the origin.
    Gradient {
        a: Rgb,
        b: Rgb,
        length: f32,
    },
    Checker {
        a: Rgb,
        b: Rgb,
        period: f32,
    },
    Stripes {
        a: Rgb,
        b: Rgb,
        period: f32,
        duty: f32,
        sine: bool,
    },
    /// Value noise of several octaves.
    Noise {
        a: Rgb,
        b: Rgb,
        scale: f32,
        octaves: u32,
        contrast: f32,
        seed: u32,
    },
    /// At most one round mark in each cell.
    Dots {
        ground: Rgb,
        mark: Rgb,
        cell: f32,
        radius: f32,
        presence: f32,
        seed: u32,
    },
    /// Lines of random words.
    Text {
        ground: Rgb,
        mark: Rgb,
        height: f32,
        weight: f32,
        seed: u32,
    },
    /// These words, centred on the origin, repeated downwards by line.
    Words {
        ground: Rgb,
        mark: Rgb,
        height: f32,
        weight: f32,
        lines: Vec<&'static str>,
    },
    /// Convex polygons, at most one in each cell, each in a colour between `a` and `b`.
    Polygons {
        ground: Rgb,
        a: Rgb,
        b: Rgb,
        cell: f32,
        seed: u32,
    },
    /// Strokes in random directions, one in each cell.
    Ticks {
        ground: Rgb,
        mark: Rgb,
        cell: f32,
        width: f32,
        seed: u32,
    },
    /// Bricks in a running bond, each of its own brightness.
    Bricks {
        brick: Rgb,
        mortar: Rgb,
        width: f32,
        height: f32,
        joint: f32,
        seed: u32,
    },
    /// Rings around the origin.
    Rings {
        a: Rgb,
        b: Rgb,
        period: f32,
    },
    /// Bands of three colours, crossed.
    Plaid {
        a: Rgb,
        b: Rgb,
        c: Rgb,
        period: f32,
    },
    /// Polygonal cells around scattered points, each of its own bright colour.
    Mosaic {
        cell: f32,
        saturation: f32,
        seed: u32,
    },
    /// Noise of natural pictures: luminance whose logarithm has an amplitude spectrum of 1/f, and fainter chrominance
    /// of the same spectrum along blue-yellow and red-green.
    Natural {
        mean: f32,
        tint: Rgb,
        contrast: f32,
        chroma: f32,
        seed: u32,
    },
    /// Discs that hide one another, as many of each size as looks alike at every scale.
    DeadLeaves {
        hue: Rgb,
        saturation: f32,
        largest: f32,
        seed: u32,
    },
    /// A sum of cosines whose amplitudes fall as 1/f, as in natural pictures.
    Spectral {
        a: Rgb,
        b: Rgb,
        waves: Vec<Wave>,
    },
    /// Rings around a far-off axis, warped by noise.
    Wood {
        a: Rgb,
        b: Rgb,
        ring: f32,
        warp: f32,
        seed: u32,
    },
    /// Veins along zeros of a warped sine.
    Marble {
        a: Rgb,
        b: Rgb,
        scale: f32,
        warp: f32,
        seed: u32,
    },
    /// Threads over and under.
    Weave {
        a: Rgb,
        b: Rgb,
        period: f32,
    },
}

impl Pattern {
    /// The colour at a point.
    pub(super) fn colour(&self, x: f32, y: f32) -> Rgb {
        match *self {
            Self::Flat(colour) => colour,
            Self::Gradient { a, b, length } => blend(a, b, (x / length + 0.5).clamp(0.0, 1.0)),
            Self::Checker { a, b, period } => {
                let odd = ((x / period).floor() as i32 + (y / period).floor() as i32) & 1 == 1;
                if odd { a } else { b }
            }
            Self::Stripes { a, b, period, duty, sine } => match (x / period).rem_euclid(1.0) {
                phase if sine => blend(a, b, 0.5 + 0.5 * (std::f32::consts::TAU * phase).sin()),
                phase if phase < duty => a,
                _ => b,
            },
            Self::Noise { a, b, scale, octaves, contrast, seed } => {
                let value = fractal_noise(x / scale, y / scale, octaves, seed);
                blend(a, b, (0.5 + (value - 0.5) * contrast).clamp(0.0, 1.0))
            }
            Self::Dots { ground, mark, cell, radius, presence, seed } => {
                if is_in_dot(x, y, cell, radius, presence, seed) { mark } else { ground }
            }
            Self::Text { ground, mark, height, weight, seed } => {
                if stroke_distance_in_text(x, y, height, seed) < 0.5 * weight { mark } else { ground }
            }
            Self::Words { ground, mark, height, weight, ref lines } => {
                let distance = stroke_distance_in_words(x, y, height, lines);
                if distance.is_some_and(|distance| distance < 0.5 * weight) { mark } else { ground }
            }
            Self::Polygons { ground, a, b, cell, seed } => {
                shade_of_polygon(x, y, cell, seed).map_or(ground, |shade| blend(a, b, shade))
            }
            Self::Ticks { ground, mark, cell, width, seed } => {
                if is_on_tick(x, y, cell, width, seed) {
                    mark
                } else {
                    ground
                }
            }
            Self::Bricks { brick, mortar, width, height, joint, seed } => {
                brightness_of_brick(x, y, [width, height], joint, seed)
                    .map_or(mortar, |brightness| brick.map(|c| c * brightness))
            }
            Self::Rings { a, b, period } => {
                let is_first = (x.hypot(y) / period).rem_euclid(1.0) < 0.5;
                if is_first { a } else { b }
            }
            Self::Plaid { a, b, c, period } => {
                let band = |place: f32| colour_of_band([a, b, c], place / period);
                blend(band(x), band(y), 0.5)
            }
            Self::Mosaic { cell, saturation, seed } => {
                let (column, row) = nearest_point(x, y, cell, seed);
                colour_of_tile(column, row, saturation, seed)
            }
            Self::Natural { mean, tint, contrast, chroma, seed } => {
                let luminance = mean * (contrast * pink_noise(x, y, seed)).exp();
                let balance = pink_chroma(x, y, chroma, seed);
                std::array::from_fn(|c| (luminance * tint[c] * balance[c]).clamp(0.0, 1.0))
            }
            Self::DeadLeaves { hue, saturation, largest, seed } => {
                highest_leaf(x, y, saturation, largest, seed).unwrap_or(hue.map(|c| 0.3 * c))
            }
            Self::Spectral { a, b, ref waves } => {
                let sum: f32 = waves.iter().map(|w| w.amplitude * (w.kx * x + w.ky * y + w.phase).cos()).sum();
                blend(a, b, (0.5 + sum).clamp(0.0, 1.0))
            }
            Self::Wood { a, b, ring, warp, seed } => blend(a, b, darkness_of_wood(x, y, ring, warp, seed)),
            Self::Marble { a, b, scale, warp, seed } => {
                let bend = fractal_noise(x / scale, y / scale, 4, seed) * warp;
                let vein = ((x + 0.6 * y) / scale * 2.0 + bend).sin().abs();
                blend(a, b, vein.powf(0.6))
            }
            Self::Weave { a, b, period } => {
                let (is_first, brightness) = thread_on_top(x / period, y / period);
                blend([0.0; 3], if is_first { a } else { b }, brightness)
            }
        }
    }
}

/// Column and row of the square cell around a point.
fn cell_at(x: f32, y: f32, cell: f32) -> (i32, i32) {
    ((x / cell).floor() as i32, (y / cell).floor() as i32)
}

/// Whether a point is on the short line of its cell, which lies at a direction of its own.
fn is_on_tick(x: f32, y: f32, cell: f32, width: f32, seed: u32) -> bool {
    let (column, row) = cell_at(x, y, cell);
    let (sin, cos) = (std::f32::consts::PI * hash_unit(column, row, seed)).sin_cos();
    let (dx, dy) = (x - (column as f32 + 0.5) * cell, y - (row as f32 + 0.5) * cell);
    (dx * sin - dy * cos).abs() < 0.5 * width && (dx * cos + dy * sin).abs() < 0.38 * cell
}

/// The brightness, 0.55 to 1, of the brick at a point; none in a joint.
fn brightness_of_brick(x: f32, y: f32, [width, height]: [f32; 2], joint: f32, seed: u32) -> Option<f32> {
    let row = (y / height).floor();
    let shifted = x + 0.5 * width * (row as i32 & 1) as f32;
    let column = (shifted / width).floor();
    let is_inside = y - row * height > joint && shifted - column * width > joint;
    is_inside.then(|| 0.55 + 0.45 * hash_unit(column as i32, row as i32, seed))
}

/// The first and the second colour in turn, and between them narrow bands of the third; the place is in periods.
fn colour_of_band([a, b, between]: [Rgb; 3], place: f32) -> Rgb {
    match place.rem_euclid(1.0) {
        t if t < 0.4 => a,
        t if t < 0.5 => between,
        t if t < 0.9 => b,
        _ => between,
    }
}

fn colour_of_tile(column: i32, row: i32, saturation: f32, seed: u32) -> Rgb {
    let bright = 0.15 + 0.85 * hash_unit(column, row, seed ^ 2);
    let vivid = |salt| 1.0 - saturation * hash_unit(column, row, seed ^ salt);
    [bright * vivid(3), bright * vivid(4), bright * vivid(5)]
}

/// Factors of red, green and blue around 1, whose differences along blue-yellow and red-green are pink noise.
fn pink_chroma(x: f32, y: f32, chroma: f32, seed: u32) -> Rgb {
    let blue_yellow = chroma * pink_noise(x, y, seed ^ 0x51);
    let red_green = 0.5 * chroma * pink_noise(x, y, seed ^ 0xa7);
    [1.0 + blue_yellow + red_green, 1.0 + blue_yellow - red_green, 1.0 - blue_yellow]
}

/// From early wood, 0, to late wood, 1, in rings this wide, with the grain along x.
fn darkness_of_wood(x: f32, y: f32, ring: f32, warp: f32, seed: u32) -> f32 {
    let bend = fractal_noise(x / (8.0 * ring), y / (2.0 * ring), 3, seed) * warp;
    let fibre = fractal_noise(x / 24.0, y / 1.6, 2, seed ^ 9);
    let phase = ((x * 0.15).hypot(y + 3.0 * ring) / ring + bend).rem_euclid(1.0);
    (phase * phase * 0.75 + 0.35 * fibre).clamp(0.0, 1.0)
}

/// Whether the thread on top is one of the first kind, and how bright its rounding is there, 0.25 to 1; the point is in
/// widths of a thread.
fn thread_on_top(u: f32, v: f32) -> (bool, f32) {
    let is_first = (u.floor() as i32 + v.floor() as i32) & 1 == 0;
    let across = if is_first { u.rem_euclid(1.0) } else { v.rem_euclid(1.0) };
    (is_first, 0.25 + 0.75 * (std::f32::consts::PI * across).sin())
}

/// Whether a point is in the dot of its cell, which this share of all cells have.
fn is_in_dot(x: f32, y: f32, cell: f32, radius: f32, presence: f32, seed: u32) -> bool {
    let (column, row) = cell_at(x, y, cell);
    if hash_unit(column, row, seed) > presence {
        return false;
    }
    let room = (cell - 2.0 * radius).max(0.0);
    let centre_x = column as f32 * cell + radius + room * hash_unit(column, row, seed ^ 1);
    let centre_y = row as f32 * cell + radius + room * hash_unit(column, row, seed ^ 2);
    (x - centre_x).powi(2) + (y - centre_y).powi(2) < radius * radius
}

/// Pixels from a point to the nearest stroke of its letter, in lines of random ones that are `height` high.
fn stroke_distance_in_text(x: f32, y: f32, height: f32, seed: u32) -> f32 {
    let (unit, line) = (height / 6.0, (y / (height * 1.7)).floor() as i32);
    let column = (x / (unit * 5.6)).floor() as i32;
    let letter = match hash(column, line, seed) % 44 {
        n @ 0..26 => b'A' + n as u8,
        n @ 26..36 => b'0' + (n - 26) as u8,
        _ => b' ',
    };
    let local_x = (x - column as f32 * unit * 5.6) / unit - 0.8;
    let local_y = (y - line as f32 * height * 1.7) / unit - 1.6;
    glyphs::stroke_distance(letter, local_x, local_y) * unit
}

/// The same in these lines, centred on the origin; none around them.
fn stroke_distance_in_words(x: f32, y: f32, height: f32, lines: &[&'static str]) -> Option<f32> {
    let (unit, pitch) = (height / 6.0, height * 1.7);
    let from_top = y + 0.5 * pitch * lines.len() as f32;
    let line = (from_top / pitch).floor();
    if line < 0.0 || line >= lines.len() as f32 {
        return None;
    }
    let text = lines[line as usize].as_bytes();
    let from_left = x + 0.5 * unit * 5.6 * text.len() as f32;
    let column = (from_left / (unit * 5.6)).floor();
    if column < 0.0 || column >= text.len() as f32 {
        return None;
    }
    let local_x = (from_left - column * unit * 5.6) / unit - 0.8;
    let local_y = (from_top - line * pitch) / unit - 2.1;
    Some(glyphs::stroke_distance(text[column as usize], local_x, local_y) * unit)
}

/// The shade, 0 to 1, of the polygon of its cell that a point is in, if it is in one.
fn shade_of_polygon(x: f32, y: f32, cell: f32, seed: u32) -> Option<f32> {
    let (column, row) = cell_at(x, y, cell);
    let random = |salt: u32| hash_unit(column, row, seed ^ salt);
    if random(1) < 0.3 {
        return None;
    }
    let sides = 3 + (random(2) * 3.0) as u32;
    let inradius = cell * (0.12 + 0.12 * random(3));
    let turn = std::f32::consts::TAU * random(4);
    let (dx, dy) = (x - (column as f32 + 0.5) * cell, y - (row as f32 + 0.5) * cell);
    let inside = (0..sides).all(|side| {
        let (sin, cos) = (turn + std::f32::consts::TAU * side as f32 / sides as f32).sin_cos();
        dx * cos + dy * sin < inradius
    });
    inside.then(|| random(5))
}

/// The cell that holds the nearest of points that are scattered one to a cell.
fn nearest_point(x: f32, y: f32, cell: f32, seed: u32) -> (i32, i32) {
    let (column, row) = cell_at(x, y, cell);
    let (mut nearest, mut owner) = (f32::INFINITY, (0, 0));
    for (c, r) in (-1..=1).flat_map(|dr| (-1..=1).map(move |dc| (column + dc, row + dr))) {
        let px = (c as f32 + hash_unit(c, r, seed)) * cell - x;
        let py = (r as f32 + hash_unit(c, r, seed ^ 1)) * cell - y;
        if px * px + py * py < nearest {
            (nearest, owner) = (px * px + py * py, (c, r));
        }
    }
    owner
}

/// The colour of the topmost leaf at a point, if there is one. Each size of leaves has a lattice of its own with one in
/// each cell; the leaf with the highest number is on top. A leaf is no wider than a cell, so that of each size only four
/// can be here.
fn highest_leaf(x: f32, y: f32, saturation: f32, largest: f32, seed: u32) -> Option<Rgb> {
    let (mut highest, mut colour) = (-1.0, None);
    let mut diameter = largest;
    let mut salt = seed;
    while diameter > 2.0 {
        let (column, row) = ((x / diameter - 0.5).floor() as i32, (y / diameter - 0.5).floor() as i32);
        for (c, r) in [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(dc, dr)| (column + dc, row + dr)) {
            let bits = hash(c, r, salt);
            let part = |shift: u32| ((bits >> shift) & 0xff) as f32 / 255.0;
            let radius = 0.5 * diameter * (0.55 + 0.15 * part(0));
            let room = diameter - 2.0 * radius;
            let centre_x = c as f32 * diameter + radius + room * part(8) - x;
            let centre_y = r as f32 * diameter + radius + room * part(16) - y;
            let height = hash_unit(c, r, salt ^ 0x35);
            if height > highest && centre_x * centre_x + centre_y * centre_y < radius * radius {
                highest = height;
                let bright = 0.03 + 0.9 * part(24) * part(24);
                let tone = |salt_of: u32| 1.0 - saturation * hash_unit(c, r, salt ^ salt_of);
                colour = Some([bright * tone(1), bright * tone(2), bright * tone(3)]);
            }
        }
        diameter /= 1.7;
        salt = salt.wrapping_add(0x9e37);
    }
    colour
}

/// Value noise in 0..1, the sum of `octaves` of it, each at twice the frequency and 0.55 of the amplitude.
pub(super) fn fractal_noise(x: f32, y: f32, octaves: u32, seed: u32) -> f32 {
    let (mut sum, mut weight, mut amplitude, mut frequency) = (0.0, 0.0, 1.0, 1.0);
    for octave in 0..octaves {
        sum += amplitude * value_noise(x * frequency, y * frequency, seed.wrapping_add(octave * 7919));
        weight += amplitude;
        amplitude *= 0.55;
        frequency *= 2.03;
    }
    sum / weight
}

/// Noise of zero mean and about unit variance whose octaves, from 2 to 256 px, have equal power: an amplitude spectrum
/// of 1/f.
fn pink_noise(x: f32, y: f32, seed: u32) -> f32 {
    let mut sum = 0.0;
    let mut period = 256.0;
    for octave in 0..8 {
        sum += value_noise(x / period + 0.37 * octave as f32, y / period, seed.wrapping_add(octave * 7919)) - 0.5;
        period *= 0.5;
    }
    // Smooth value noise has a standard deviation of about 0.21 an octave.
    sum / (0.21 * 8f32.sqrt())
}

fn value_noise(x: f32, y: f32, seed: u32) -> f32 {
    let (fx, fy) = (x.floor(), y.floor());
    let (column, row) = (fx as i32, fy as i32);
    let smooth = |t: f32| t * t * (3.0 - 2.0 * t);
    let (u, v) = (smooth(x - fx), smooth(y - fy));
    let top = hash_unit(column, row, seed) * (1.0 - u) + hash_unit(column + 1, row, seed) * u;
    let bottom = hash_unit(column, row + 1, seed) * (1.0 - u) + hash_unit(column + 1, row + 1, seed) * u;
    top * (1.0 - v) + bottom * v
}

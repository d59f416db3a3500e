//! Test patterns for a bench: what a panel can be sent to see that it, its lasers and its optics do what they should.
//!
//! **Frame of reference.** x runs to the right and y up, from the panel's centre, as an eye in the display sees the
//! panel; angles run from x to y. What a bench's relays and mirrors turn is turned back by the rig's
//! `panel.orientation`; where that is wrong, the first pattern shows it.
//!
//! **Where light goes.** A pattern of period Λ sends the light of wavelength λ into orders m at the angles
//! asin(m·λ/Λ). In the focal plane of the eyepiece, where the viewer's pupil is, order m is a spot f·tan(asin(m·λ/Λ))
//! from the axis. The stop of the display's relay is one for all colours and set for the longest wavelength λ₀ of the
//! bench's lasers: it lets frequencies below λ₀/4pλ through, p the pixels' pitch: periods above four pixels of λ₀, and
//! shorter ones of others.
//!
//! **How much light.** An order's share is that of the phases of the levels which the panel is sent, so that a short
//! stroke and a table of few levels count, under the envelope sinc²(p/Λₘ) of pixels without gaps, Λₘ = Λ/m across and
//! up. The panel is taken as flat: what its flatness adds to a phase, the panel takes away again.
//!
//! **Light and dark.** A phase panel has neither. Where a pattern shall look bright ([`Pattern::Dots`],
//! [`Pattern::CrossHair`]) its phase is 0; where it shall look dark, neighbouring pixels stand π apart as on a
//! chessboard, and their light goes to the corners of the spectrum, which the stop takes away. A camera that looks
//! through the eyepiece, focused at infinity, sees it.

use std::f64::consts::{FRAC_PI_2, PI, TAU};
use std::fmt;

use holod_calibration::rig::{PanelMode, Rig};
use holod_calibration::{Colour, DisplayGeometry, Metres, PerColour, Resolution};
use serde::{Deserialize, Serialize};

use crate::fields::LevelsFrame;
use crate::levels::PanelEncoder;

/// Depth of a sinusoidal grating, crest to trough, that sends most light into its first orders: J₁ is largest at half
/// of it.
const SINUSOIDAL_DEPTH_RAD: f64 = 3.6824;
/// Radius of the circle of [`Pattern::FieldIdentity`]'s spots as a share of the largest that passes the stop.
const IDENTITY_RADIUS_SHARE: f64 = 0.75;
/// Pixels across the smallest lens.
const LENS_DIAMETER_MIN_PX: f64 = 16.0;
/// Samples of a period from which the light in its orders is worked out.
const ORDER_SAMPLES: usize = 4096;

/// A test pattern. As JSON it is `{"kind":"grating","period_px":8,"profile":"blazed"}`: names carry their units, and a
/// figure that has a usual value may be left out.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
#[allow(missing_docs, reason = "the variants say what their fields are")]
pub enum Pattern {
    /// One level everywhere, as it is: neither table nor flatness is applied.
    Level { level: u16 },
    /// Upright lines of two levels, as they are, half a period each: sin² of half the phase between the levels is the
    /// light in the first orders, from which a panel's look-up table is measured.
    TwoLevels {
        levels: [u16; 2],
        /// Pixels across one line of each, even.
        period_px: usize,
    },
    /// Squares of two phases.
    Checkerboard {
        /// Pixels across two squares, even.
        period_px: usize,
        /// The squares' difference of phase in radians; π leaves no light in the zero order.
        depth_rad: f64,
    },
    /// Parallel lines, which send the light to one side.
    Grating {
        /// Pixels across one line.
        period_px: f64,
        /// Where the first order goes, degrees from x to y.
        #[serde(default)]
        angle_deg: f64,
        profile: Profile,
        /// Largest less smallest phase, radians; the profile's own ([`Profile::depth_rad`]) when left out.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        depth_rad: Option<f64>,
    },
    /// A lens within a circle, in a flat surround.
    Lens {
        /// Distance from the panel to the focus; negative for a lens that diverges.
        #[serde(rename = "focal_length_m")]
        focal_length: Metres,
        /// Diameter; the largest that neither aliases nor leaves the panel when left out.
        #[serde(rename = "diameter_m", default, skip_serializing_if = "Option::is_none")]
        diameter: Option<Metres>,
    },
    /// A grid of bright dots on black, for a camera: to find its focus, scale, rotation and distortion. The dot at the
    /// centre is twice as wide; those next to it on the right and two above it are left out, so that a picture that is
    /// turned or mirrored is known.
    Dots {
        /// Pixels from dot to dot.
        spacing_px: usize,
        diameter_px: usize,
    },
    /// Bright lines on black that cross at the optical axis, with a square in the upper right quarter.
    CrossHair {
        /// The width of a line, pixels.
        line_px: usize,
    },
    /// A blaze of another direction in each colour's field: red to the right, green up, blue to the left, with periods
    /// that put the three lasers' spots on one circle. A laser that meets another colour's field lands in that field's
    /// direction, and nearer to the axis or farther from it by the ratio of the wavelengths.
    FieldIdentity {
        /// The circle's radius in the eyepiece's focal plane; three quarters of what passes the stop when left out.
        #[serde(rename = "radius_m", default, skip_serializing_if = "Option::is_none")]
        radius: Option<Metres>,
    },
}

/// The shape of a grating's lines.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Profile {
    /// Half at one phase, half at the other.
    Binary,
    /// A ramp from 0 to the depth across each line.
    Blazed,
    /// A sine, its crests `depth_rad` above its troughs.
    Sinusoidal,
}

/// Where and in which colours a pattern is drawn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Placement {
    /// The optical axis in pixels from the panel's centre, x and y: the middle of lens, dots and cross-hair.
    pub axis_px: [f64; 2],
    /// The colours that have the pattern; the others are flat.
    pub colours: PerColour<bool>,
}

/// Light that leaves the panel in one direction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Order {
    /// Orders across and up; a grating's own order is the first.
    pub number: [i32; 2],
    /// Angle to the axis.
    pub angle_deg: f64,
    /// Where it meets the eyepiece's focal plane, x and y.
    pub position: [Metres; 2],
    /// Its share of the light, 0..=1, from pixels without gaps.
    pub share: f64,
    /// Whether the stop of the relay lets it through.
    pub passes_stop: bool,
}

/// Why a pattern cannot be drawn on a bench.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("the pattern's {what} is {found}; expected {expected}")]
pub struct PatternError {
    what: &'static str,
    found: String,
    expected: String,
}

impl Placement {
    /// Around `axis_px`, in `colours`; in all of them where none is named.
    pub fn new(axis_px: [f64; 2], colours: &[Colour]) -> Self {
        let is_drawn = |colour| colours.is_empty() || colours.contains(&colour);
        Self { axis_px, colours: PerColour(Colour::ALL.map(is_drawn)) }
    }
}

impl Profile {
    /// Depth in radians that sends most light into the first order.
    pub const fn depth_rad(self) -> f64 {
        match self {
            Self::Binary => PI,
            Self::Blazed => TAU,
            Self::Sinusoidal => SINUSOIDAL_DEPTH_RAD,
        }
    }

    const fn name(self) -> &'static str {
        match self {
            Self::Binary => "binary",
            Self::Blazed => "blazed",
            Self::Sinusoidal => "sinusoidal",
        }
    }

    /// Phase in radians at the place `lines`, counted in lines.
    fn phase_rad(self, lines: f64, depth_rad: f64) -> f64 {
        let part = lines.rem_euclid(1.0);
        match self {
            Self::Binary => f64::from(part >= 0.5) * depth_rad,
            Self::Blazed => part * depth_rad,
            Self::Sinusoidal => 0.5 * depth_rad * (TAU * part).sin(),
        }
    }
}

impl Default for Placement {
    /// The panel's centre, every colour.
    fn default() -> Self {
        Self::new([0.0; 2], &[])
    }
}

/// The pattern in words, such as "dots of 16 px, 60 px apart".
impl fmt::Display for Pattern {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::Level { level } => write!(f, "level {level} everywhere"),
            Self::TwoLevels { levels: [first, second], period_px } => {
                write!(f, "lines of the levels {first} and {second}, {period_px} px across both")
            }
            Self::Checkerboard { period_px, depth_rad } => {
                write!(f, "checkerboard, {period_px} px across two squares, {:.3} π deep", depth_rad / PI)
            }
            Self::Grating { period_px, angle_deg, profile, depth_rad } => {
                let depth = depth_rad.unwrap_or(profile.depth_rad()) / PI;
                let profile = profile.name();
                write!(f, "{profile} grating, {period_px} px a line, first order at {angle_deg}°, {depth:.3} π deep")
            }
            // To a nanometre, beyond which millimetres of metres are rounding.
            Self::Lens { focal_length, .. } => write!(f, "lens, f = {} mm", (focal_length.0 * 1e9).round() / 1e6),
            Self::Dots { spacing_px, diameter_px } => write!(f, "dots of {diameter_px} px, {spacing_px} px apart"),
            Self::CrossHair { line_px } => write!(f, "cross-hair, lines of {line_px} px"),
            Self::FieldIdentity { .. } => f.write_str("field identity: red to the right, green up, blue to the left"),
        }
    }
}

impl Pattern {
    /// Draws the pattern into every colour of `placement`, and a flat phase into the others. Patterns of phases go
    /// through `encoder`, whose patterns have the size that is drawn, and `optics` are the bench's.
    ///
    /// # Errors
    /// [`PatternError`] where it cannot be drawn on this bench; the frame is then as it was.
    ///
    /// # Panics
    /// Where the frame has another size than the encoder was made for.
    pub fn draw(
        &self,
        placement: &Placement,
        encoder: &PanelEncoder,
        optics: &DisplayGeometry,
        frame: &mut LevelsFrame,
    ) -> Result<(), PatternError> {
        let optics = DisplayGeometry { resolution: encoder.pattern_resolution(), ..*optics };
        let [x_px, y_px] = placement.axis_px;
        let [most_x_px, most_y_px] = [optics.resolution.width, optics.resolution.height].map(|px| px as f64 / 2.0);
        if !(x_px.abs() <= most_x_px && y_px.abs() <= most_y_px) {
            let expected = format!("a place on the panel: at most {most_x_px} px across and {most_y_px} px up or down");
            return Err(wrong("axis", format!("{x_px},{y_px}"), expected));
        }
        if let PanelMode::Monochrome(only) = frame.layout().mode
            && !placement.colours[only]
        {
            let named: Vec<&str> =
                placement.colours.iter().filter(|(_, drawn)| **drawn).map(|(colour, _)| colour.name()).collect();
            return Err(wrong("colour", named.join(","), format!("{only}: the panel shows {only} alone")));
        }
        if let Some((levels, half_px)) = self.bare_levels(&optics)? {
            let top = ((1u32 << frame.layout().packing.bit_depth()) - 1) as u16;
            if let Some(level) = levels.into_iter().find(|&level| level > top) {
                return Err(wrong("level", level.to_string(), format!("0 to {top}, the panel's levels")));
            }
            encoder.encode_flat(frame);
            let Resolution { width, height } = encoder.panel_resolution();
            let row: Vec<u16> = (0..width).map(|column| levels[column / half_px % 2]).collect();
            for (colour, _) in placement.colours.iter().filter(|(_, drawn)| **drawn) {
                frame.field_mut(colour).write(&row.repeat(height));
            }
            return Ok(());
        }
        let flat = vec![0.0; optics.resolution.pixels()];
        let [red, green, blue] = Colour::ALL.map(|colour| match placement.colours[colour] {
            true => self.phase_rad(placement.axis_px, &optics, colour),
            false => Ok(flat.clone()),
        });
        let phases_rad = [red?, green?, blue?];
        encoder.encode(PerColour([&phases_rad[0], &phases_rad[1], &phases_rad[2]]), frame);
        Ok(())
    }

    /// The levels of a pattern that is none of phases, and the columns that each of them has in turn.
    fn bare_levels(&self, optics: &DisplayGeometry) -> Result<Option<([u16; 2], usize)>, PatternError> {
        match *self {
            Self::Level { level } => Ok(Some(([level; 2], optics.resolution.width))),
            Self::TwoLevels { levels, period_px } => {
                checked_even_period(period_px, optics)?;
                Ok(Some((levels, period_px / 2)))
            }
            _ => Ok(None),
        }
    }

    /// The phase in [0, 2π) of each pixel of `optics.resolution` in `colour`'s field, row-major from the upper left.
    ///
    /// # Errors
    /// [`PatternError`] where it cannot be drawn on this bench, and for [`Pattern::Level`] and [`Pattern::TwoLevels`],
    /// which have no phases.
    pub fn phase_rad(
        &self,
        axis_px: [f64; 2],
        optics: &DisplayGeometry,
        colour: Colour,
    ) -> Result<Vec<f32>, PatternError> {
        let pitch_m = optics.pixel_pitch.0;
        let wavelength_m = optics.wavelengths[colour].0;
        match *self {
            Self::Level { .. } | Self::TwoLevels { .. } => {
                Err(wrong("kind", self.to_string(), "a pattern of phases".into()))
            }
            Self::Checkerboard { period_px, depth_rad } => {
                checked_checkerboard(period_px, depth_rad, optics)?;
                let square_px = period_px / 2;
                let of_pixel = |row: usize, column: usize| (row / square_px + column / square_px) % 2;
                Ok(by_pixel(optics, |row, column| of_pixel(row, column) as f64 * depth_rad))
            }
            Self::Grating { period_px, angle_deg, profile, depth_rad } => {
                checked_period(period_px, optics)?;
                let depth_rad = checked_depth(depth_rad.unwrap_or(profile.depth_rad()))?;
                let [cosine, sine] = direction(checked_angle(angle_deg)?);
                let lines = |x_px: f64, y_px: f64| (x_px * cosine + y_px * sine) / period_px;
                Ok(by_place(optics, [0.0; 2], |x_px, y_px| profile.phase_rad(lines(x_px, y_px), depth_rad)))
            }
            Self::Lens { focal_length: Metres(focal_length_m), .. } => {
                let radius_px = 0.5 * self.lens_diameter(optics, colour)?.0 / pitch_m;
                let bend = -PI * pitch_m * pitch_m / (wavelength_m * focal_length_m);
                Ok(by_place(optics, axis_px, |x_px, y_px| {
                    let squared = x_px * x_px + y_px * y_px;
                    if squared <= radius_px * radius_px { bend * squared } else { 0.0 }
                }))
            }
            Self::Dots { spacing_px, diameter_px } => {
                checked_size("dots' spacing", spacing_px, 8, optics.resolution.width.max(optics.resolution.height))?;
                checked_size("dots' diameter", diameter_px, 4, spacing_px / 2)?;
                let spacing_px = spacing_px as f64;
                Ok(light_and_dark(optics, axis_px, |x_px, y_px| {
                    let [across, up] = [x_px, y_px].map(|place_px| (place_px / spacing_px).round());
                    let (dx_px, dy_px) = (x_px - across * spacing_px, y_px - up * spacing_px);
                    let left_out = [(1.0, 0.0), (0.0, 2.0)].contains(&(across, up));
                    let wide = if (across, up) == (0.0, 0.0) { 2.0 } else { 1.0 };
                    !left_out && dx_px.hypot(dy_px) <= 0.5 * wide * diameter_px as f64
                }))
            }
            Self::CrossHair { line_px } => {
                let shorter_px = optics.resolution.width.min(optics.resolution.height);
                checked_size("line's width", line_px, 2, shorter_px / 16)?;
                let line_px = line_px as f64;
                let in_mark = |place_px: f64| (2.0 * line_px..4.0 * line_px).contains(&place_px);
                Ok(light_and_dark(optics, axis_px, |x_px, y_px| {
                    x_px.abs() <= 0.5 * line_px || y_px.abs() <= 0.5 * line_px || in_mark(x_px) && in_mark(y_px)
                }))
            }
            Self::FieldIdentity { .. } => self.identity_grating(optics, colour)?.phase_rad([0.0; 2], optics, colour),
        }
    }

    /// Where the light of `laser` goes that meets the pattern of `field`, strongest orders of the pattern first. Empty
    /// for [`Pattern::Lens`], [`Pattern::Dots`] and [`Pattern::CrossHair`], which are no gratings.
    ///
    /// The panel is `rig`'s, for which `encoder` was made. Its stroke in wavelengths is taken to shrink as the
    /// wavelength grows.
    ///
    /// # Errors
    /// As [`Self::phase_rad`].
    pub fn orders(
        &self,
        rig: &Rig,
        encoder: &PanelEncoder,
        field: Colour,
        laser: Colour,
    ) -> Result<Vec<Order>, PatternError> {
        let optics = &rig.geometry;
        let shown_rad = |phases_rad: &[f64]| -> Vec<f64> {
            let [field_m, laser_m] = [field, laser].map(|colour| optics.wavelengths[colour].0);
            let wrapped_rad: Vec<f32> = phases_rad.iter().map(|phase_rad| phase_rad.rem_euclid(TAU) as f32).collect();
            let shown_rad = encoder.shown_when_flat(field, &wrapped_rad);
            shown_rad.into_iter().map(|shown_rad| f64::from(shown_rad) * field_m / laser_m).collect()
        };
        let order = |number: [i32; 2], per_px: [f64; 2], share: f64| {
            Order::at(rig, laser, number, per_px, share * per_px.map(pixels_envelope).iter().product::<f64>())
        };
        match *self {
            Self::Level { .. } => Ok(vec![order([0, 0], [0.0; 2], 1.0)]),
            Self::TwoLevels { levels, period_px } => {
                checked_even_period(period_px, optics)?;
                let phase_rad = |level: u16| {
                    let expected = format!("one that lut_file.{field} has; to measure it anew, take that file out");
                    encoder.phase_of_level(field, level).ok_or_else(|| wrong("level", level.to_string(), expected))
                };
                let [first_rad, second_rad] = [phase_rad(levels[0])?, phase_rad(levels[1])?].map(f64::from);
                let [field_m, laser_m] = [field, laser].map(|colour| optics.wavelengths[colour].0);
                let half_rad = 0.5 * (second_rad - first_rad) * field_m / laser_m;
                let per_px = 1.0 / period_px as f64;
                let share = (2.0 / (period_px as f64 * (PI * per_px).sin()) * half_rad.sin()).powi(2);
                let sides = [1, -1].map(|number| order([number, 0], [f64::from(number) * per_px, 0.0], share));
                Ok(sides.into_iter().chain([order([0, 0], [0.0; 2], half_rad.cos().powi(2))]).collect())
            }
            Self::Checkerboard { period_px, depth_rad } => {
                checked_checkerboard(period_px, depth_rad, optics)?;
                let shown_rad = shown_rad(&[0.0, depth_rad]);
                let half_rad = 0.5 * (shown_rad[1] - shown_rad[0]);
                let per_px = 1.0 / period_px as f64;
                // Half of the samples of a period at each phase, in a row and in a column.
                let in_first = 2.0 / (period_px as f64 * (PI * per_px).sin());
                let diagonals = [[1, 1], [-1, 1], [-1, -1], [1, -1]].map(|number| {
                    let share = (in_first * in_first * half_rad.sin()).powi(2);
                    order(number, number.map(|number| f64::from(number) * per_px), share)
                });
                Ok(std::iter::once(order([0, 0], [0.0; 2], half_rad.cos().powi(2))).chain(diagonals).collect())
            }
            Self::Grating { period_px, angle_deg, profile, depth_rad } => {
                checked_period(period_px, optics)?;
                let depth_rad = checked_depth(depth_rad.unwrap_or(profile.depth_rad()))?;
                let [cosine, sine] = direction(checked_angle(angle_deg)?);
                // Along one side of the panel each line falls on the same few places of pixels; otherwise on all.
                let along = match [cosine, sine] {
                    [side, 0.0] => Some((side, optics.resolution.width)),
                    [0.0, side] => Some((side, optics.resolution.height)),
                    _ => None,
                };
                let places: Vec<f64> = match along {
                    Some((side, side_px)) => {
                        // As many as are nearly whole lines.
                        let lines = (ORDER_SAMPLES as f64 / period_px).floor();
                        let places_px = 0..(lines * period_px).round() as usize;
                        places_px.map(|px| side * (px as f64 - middle(side_px)) / period_px).collect()
                    }
                    None => (0..ORDER_SAMPLES).map(|part| (part as f64 + 0.5) / ORDER_SAMPLES as f64).collect(),
                };
                let drawn_rad: Vec<f64> = places.iter().map(|&lines| profile.phase_rad(lines, depth_rad)).collect();
                let shown_rad = shown_rad(&drawn_rad);
                let orders = [1, 0, -1, 2, -2].map(|number| {
                    let per_px = [cosine, sine].map(|along| f64::from(number) / period_px * along);
                    order([number, 0], per_px, share_of(&shown_rad, &places, number))
                });
                Ok(orders.to_vec())
            }
            Self::Lens { .. } | Self::Dots { .. } | Self::CrossHair { .. } => Ok(Vec::new()),
            Self::FieldIdentity { .. } => self.identity_grating(optics, field)?.orders(rig, encoder, field, laser),
        }
    }

    /// The diameter of a lens in `colour`'s field.
    ///
    /// # Errors
    /// [`PatternError`] where it would alias, leave the panel or be too small, and for patterns that are no lens.
    pub fn lens_diameter(&self, optics: &DisplayGeometry, colour: Colour) -> Result<Metres, PatternError> {
        let Self::Lens { focal_length: Metres(focal_length_m), diameter } = *self else {
            return Err(wrong("kind", format!("{self:?}"), "a lens".into()));
        };
        if !(focal_length_m.is_finite() && focal_length_m != 0.0) {
            return Err(wrong("focal length", format!("{focal_length_m} m"), "a length other than 0".into()));
        }
        let pitch_m = optics.pixel_pitch.0;
        let panel_m = optics.resolution.width.min(optics.resolution.height) as f64 * pitch_m;
        // Beyond it neighbouring pixels would differ by more than half a wave.
        let unaliased_m = optics.wavelengths[colour].0 * focal_length_m.abs() / pitch_m;
        let least_m = LENS_DIAMETER_MIN_PX * pitch_m;
        if unaliased_m < least_m {
            let shortest_mm = 1e3 * least_m * pitch_m / optics.wavelengths[colour].0;
            let expected = format!("{shortest_mm:.2} mm at least in {colour}, for {LENS_DIAMETER_MIN_PX} px of lens");
            return Err(wrong("focal length", format!("{:.2} mm", 1e3 * focal_length_m), expected));
        }
        let largest_m = unaliased_m.min(panel_m);
        match diameter {
            None => Ok(Metres(largest_m)),
            Some(Metres(diameter_m)) if (least_m..=largest_m).contains(&diameter_m) => Ok(Metres(diameter_m)),
            Some(Metres(diameter_m)) => {
                let why = if unaliased_m < panel_m { "beyond which it aliases" } else { "the panel's own size" };
                let expected = format!("{:.3} to {:.3} mm in {colour}, {why}", 1e3 * least_m, 1e3 * largest_m);
                Err(wrong("lens diameter", format!("{:.3} mm", 1e3 * diameter_m), expected))
            }
        }
    }

    /// The blaze of [`Pattern::FieldIdentity`] in `colour`'s field.
    fn identity_grating(&self, optics: &DisplayGeometry, colour: Colour) -> Result<Self, PatternError> {
        let Self::FieldIdentity { radius } = *self else {
            return Err(wrong("kind", format!("{self:?}"), "the field identity".into()));
        };
        let (pitch_m, focal_length_m) = (optics.pixel_pitch.0, optics.eyepiece_focal_length.0);
        let shortest_m = optics.wavelengths.0.map(|wavelength| wavelength.0).into_iter().fold(f64::MAX, f64::min);
        let largest_m = radius_of(shortest_m / (4.0 * pitch_m), focal_length_m);
        let radius_m = radius.map_or(IDENTITY_RADIUS_SHARE * largest_m, |radius| radius.0);
        if !(radius_m > 0.0 && radius_m < largest_m) {
            let expected = format!(
                "above 0 and below the {:.3} mm that pass the stop whichever laser lights a field",
                1e3 * largest_m
            );
            return Err(wrong("radius", format!("{:.3} mm", 1e3 * radius_m), expected));
        }
        let sine = (radius_m / focal_length_m).atan().sin();
        let angle_deg = match colour {
            Colour::Red => 0.0,
            Colour::Green => 90.0,
            Colour::Blue => 180.0,
        };
        let period_px = optics.wavelengths[colour].0 / (sine * pitch_m);
        Ok(Self::Grating { period_px, angle_deg, profile: Profile::Blazed, depth_rad: None })
    }
}

impl Order {
    /// The order with frequencies in cycles per pixel, x and y.
    fn at(rig: &Rig, laser: Colour, number: [i32; 2], per_px: [f64; 2], share: f64) -> Self {
        let optics = &rig.geometry;
        let frequencies = per_px.map(|along| along / optics.pixel_pitch.0);
        let [fx, fy] = frequencies;
        let sine = (optics.wavelengths[laser].0 * fx.hypot(fy)).min(1.0);
        let radius_m = radius_of(sine, optics.eyepiece_focal_length.0);
        let direction = if fx.hypot(fy) > 0.0 { frequencies.map(|along| along / fx.hypot(fy)) } else { [0.0; 2] };
        let stop = stop_frequency(rig, laser);
        Self {
            number,
            angle_deg: sine.asin().to_degrees(),
            position: direction.map(|along| Metres(along * radius_m)),
            share,
            passes_stop: fx.abs() < stop && fy.abs() < stop,
        }
    }
}

/// The greatest frequency of `colour` that the stop of the relay lets through, cycles per metre across or up.
pub fn stop_frequency(rig: &Rig, colour: Colour) -> f64 {
    let [set_for, passed] = [rig.stop_colour(), colour].map(|colour| rig.geometry.wavelengths[colour].0);
    set_for / passed / (4.0 * rig.geometry.pixel_pitch.0)
}

/// Share of the light of a whole pixel, without gaps, that goes where the frequency is `per_px` along one side.
fn pixels_envelope(per_px: f64) -> f64 {
    let half_turns = PI * per_px;
    if half_turns == 0.0 { 1.0 } else { (half_turns.sin() / half_turns).powi(2) }
}

/// Share of the light in order `order` of points with these phases at `places`, counted in lines.
fn share_of(phases_rad: &[f64], places: &[f64], order: i32) -> f64 {
    let (mut re, mut im) = (0.0, 0.0);
    for (&shown_rad, &lines) in phases_rad.iter().zip(places) {
        let phase_rad = shown_rad - TAU * f64::from(order) * lines;
        re += phase_rad.cos();
        im += phase_rad.sin();
    }
    (re * re + im * im) / (places.len() * places.len()) as f64
}

/// Distance from the axis, in the focal plane of a lens, of light whose angle to the axis has this sine.
fn radius_of(sine: f64, focal_length_m: f64) -> f64 {
    focal_length_m * sine.asin().tan()
}

fn wrong(what: &'static str, found: String, expected: String) -> PatternError {
    PatternError { what, found, expected }
}

fn checked_period(period_px: f64, optics: &DisplayGeometry) -> Result<f64, PatternError> {
    let longest_px = optics.resolution.width.max(optics.resolution.height) as f64;
    if (2.0..=longest_px).contains(&period_px) {
        return Ok(period_px);
    }
    Err(wrong("period", format!("{period_px} px"), format!("2 to {longest_px} px")))
}

fn checked_depth(depth_rad: f64) -> Result<f64, PatternError> {
    if depth_rad > 0.0 && depth_rad <= TAU {
        return Ok(depth_rad);
    }
    Err(wrong("depth", format!("{:.3} π", depth_rad / PI), "above 0 and up to 2 π".into()))
}

fn checked_angle(angle_deg: f64) -> Result<f64, PatternError> {
    if angle_deg.is_finite() {
        return Ok(angle_deg);
    }
    Err(wrong("angle", format!("{angle_deg}°"), "a number of degrees".into()))
}

fn checked_size(what: &'static str, found_px: usize, min_px: usize, max_px: usize) -> Result<(), PatternError> {
    if (min_px..=max_px).contains(&found_px) {
        return Ok(());
    }
    Err(wrong(what, format!("{found_px} px"), format!("{min_px} to {max_px} px")))
}

fn checked_checkerboard(period_px: usize, depth_rad: f64, optics: &DisplayGeometry) -> Result<(), PatternError> {
    checked_depth(depth_rad)?;
    checked_even_period(period_px, optics)
}

fn checked_even_period(period_px: usize, optics: &DisplayGeometry) -> Result<(), PatternError> {
    checked_period(period_px as f64, optics)?;
    if period_px.is_multiple_of(2) {
        return Ok(());
    }
    Err(wrong("period", format!("{period_px} px"), "an even number of pixels".into()))
}

fn by_pixel(optics: &DisplayGeometry, phase_rad: impl Fn(usize, usize) -> f64) -> Vec<f32> {
    let width = optics.resolution.width;
    let phase = |pixel: usize| phase_rad(pixel / width, pixel % width).rem_euclid(TAU) as f32;
    (0..optics.resolution.pixels()).map(phase).collect()
}

/// x and y of the direction, of which one is exactly 0 along a side of the panel: rounding would decide otherwise where
/// a line's edge falls on the middle of a pixel.
fn direction(angle_deg: f64) -> [f64; 2] {
    let (sine, cosine) = angle_deg.to_radians().sin_cos();
    [cosine, sine].map(|along| if along.abs() < 1e-12 { 0.0 } else { along })
}

/// The place of the middle of a row of this many pixels.
fn middle(pixels: usize) -> f64 {
    0.5 * (pixels as f64 - 1.0)
}

/// Phases by the pixels' places, x and y from `axis_px`.
fn by_place(optics: &DisplayGeometry, axis_px: [f64; 2], phase_rad: impl Fn(f64, f64) -> f64) -> Vec<f32> {
    let (middle_x, middle_y) = (middle(optics.resolution.width), middle(optics.resolution.height));
    by_pixel(optics, |row, column| phase_rad(column as f64 - middle_x - axis_px[0], middle_y - row as f64 - axis_px[1]))
}

/// Phases that look bright through the stop where `bright` says so, and dark elsewhere.
fn light_and_dark(optics: &DisplayGeometry, axis_px: [f64; 2], bright: impl Fn(f64, f64) -> bool) -> Vec<f32> {
    let mut phases_rad = by_place(optics, axis_px, |x_px, y_px| if bright(x_px, y_px) { 0.0 } else { FRAC_PI_2 });
    let width = optics.resolution.width;
    for (pixel, phase_rad) in phases_rad.iter_mut().enumerate() {
        if (pixel / width + pixel % width) % 2 == 1 && *phase_rad > 0.0 {
            *phase_rad = (TAU - FRAC_PI_2) as f32;
        }
    }
    phases_rad
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fields::FrameLayout;
    use holod_calibration::Resolution;
    use holod_calibration::rig::{LevelPhase, OutOfStroke};
    use holod_fft::num_complex::Complex64;
    use holod_fft::{FftDirection, Real};

    const BENCH: DisplayGeometry = DisplayGeometry::DEFAULT;
    const SIZE: Resolution = Resolution { width: 192, height: 160 };

    fn bench(resolution: Resolution) -> DisplayGeometry {
        DisplayGeometry { resolution, ..BENCH }
    }

    /// What the default panel shows of a pattern: phase to levels and back.
    fn shown(pattern: &Pattern, placement: &Placement, size: Resolution, colour: Colour) -> Vec<Complex64> {
        let panel = Rig::default().panel;
        let encoder = PanelEncoder::new(&panel, size, size).unwrap();
        let mut frame = LevelsFrame::new(FrameLayout::new(&panel, size));
        pattern.draw(placement, &encoder, &bench(size), &mut frame).unwrap();
        let phases_rad = encoder.decode(colour, &frame.unpack_colour(colour).levels);
        phases_rad.into_iter().map(|phase_rad| Complex64::cis(f64::from(phase_rad))).collect()
    }

    /// The spectrum [height, width] with a sum of squares of 1 for a field of amplitude 1.
    fn spectrum(mut field: Vec<Complex64>, size: Resolution) -> Vec<Complex64> {
        transform(&mut field, size, FftDirection::Forward);
        let pixels = size.pixels() as f64;
        field.into_iter().map(|value| value / pixels).collect()
    }

    fn transform(field: &mut [Complex64], size: Resolution, direction: FftDirection) {
        f64::plan(size.width, direction).process(field);
        let columns = f64::plan(size.height, direction);
        for column in 0..size.width {
            let mut values: Vec<_> = field.iter().skip(column).step_by(size.width).copied().collect();
            columns.process(&mut values);
            for (row, value) in values.into_iter().enumerate() {
                field[row * size.width + column] = value;
            }
        }
    }

    /// Share of the light at the frequency `per_px`, x and y up: Fourier's integral there, between the bins too.
    fn share_at(field: &[Complex64], size: Resolution, per_px: [f64; 2]) -> f64 {
        let turn = |index: usize| {
            let (row, column) = (index / size.width, index % size.width);
            Complex64::cis(-TAU * (column as f64 * per_px[0] - row as f64 * per_px[1]))
        };
        let sum: Complex64 = field.iter().enumerate().map(|(index, &value)| value * turn(index)).sum();
        (sum / size.pixels() as f64).norm_sqr()
    }

    /// On the default bench.
    fn orders(pattern: &Pattern, field: Colour, laser: Colour) -> Result<Vec<Order>, PatternError> {
        orders_on(&Rig::default(), pattern, field, laser)
    }

    fn orders_on(rig: &Rig, pattern: &Pattern, field: Colour, laser: Colour) -> Result<Vec<Order>, PatternError> {
        let encoder = PanelEncoder::new(&rig.panel, rig.resolution(), rig.resolution()).unwrap();
        pattern.orders(rig, &encoder, field, laser)
    }

    /// The pixels' own, which points at their places do not have.
    fn envelope(per_px: [f64; 2]) -> f64 {
        let sinc = |x: f64| if x == 0.0 { 1.0 } else { (PI * x).sin() / (PI * x) };
        (sinc(per_px[0]) * sinc(per_px[1])).powi(2)
    }

    fn grating(period_px: f64, angle_deg: f64, profile: Profile) -> Pattern {
        Pattern::Grating { period_px, angle_deg, profile, depth_rad: None }
    }

    #[test]
    fn a_blaze_sends_its_light_into_the_first_order_in_its_direction() {
        for (period_px, angle_deg) in [(8.0, 0.0), (8.0, 90.0), (8.0, 180.0), (16.0, -90.0), (7.3, 30.0), (12.0, 225.0)]
        {
            let pattern = grating(period_px, angle_deg, Profile::Blazed);
            let seen = shown(&pattern, &Placement::default(), SIZE, Colour::Green);
            let at =
                |degrees: f64| [degrees.to_radians().cos(), degrees.to_radians().sin()].map(|part| part / period_px);
            let first = share_at(&seen, SIZE, at(angle_deg));
            assert!(first >= 0.95, "{period_px} px at {angle_deg}: {first}");
            // Canary: the other side is dark.
            assert!(share_at(&seen, SIZE, at(angle_deg + 180.0)) < 0.01);
            let own = orders(&pattern, Colour::Green, Colour::Green).unwrap()[0];
            // Rounding to 256 levels takes a little.
            let expected = envelope(at(angle_deg));
            assert!((own.share - expected).abs() < 2e-4 && own.number == [1, 0], "{own:?}: {expected}");
            let direction_deg = own.position[1].0.atan2(own.position[0].0).to_degrees();
            let turned_deg = (direction_deg - angle_deg + 180.0).rem_euclid(360.0) - 180.0;
            assert!(turned_deg.abs() < 1e-6, "{direction_deg}");
        }
        // Eight pixels are bin 192/8 from the left, upwards bin 160/8 from the bottom of the transform.
        for (angle_deg, bin) in [(0.0, 24), (90.0, (160 - 20) * 192)] {
            let pattern = grating(8.0, angle_deg, Profile::Blazed);
            let seen = spectrum(shown(&pattern, &Placement::default(), SIZE, Colour::Green), SIZE);
            assert!(seen[bin].norm_sqr() >= 0.95, "{angle_deg}: {}", seen[bin].norm_sqr());
        }
    }

    #[test]
    fn gratings_share_their_light_as_their_orders_say() {
        let sinusoidal = grating(32.0, 0.0, Profile::Sinusoidal);
        let shallow =
            Pattern::Grating { period_px: 32.0, angle_deg: 90.0, profile: Profile::Blazed, depth_rad: Some(PI) };
        // Lines of an odd number of pixels are not half and half.
        let odd = [(3.0, 0.0), (3.0, 180.0), (5.0, 90.0), (9.6, 0.0)];
        let odd = odd.map(|(period_px, angle_deg)| grating(period_px, angle_deg, Profile::Binary));
        let even = grating(32.0, 0.0, Profile::Binary);
        for pattern in [even, sinusoidal, shallow].into_iter().chain(odd) {
            let seen = shown(&pattern, &Placement::default(), SIZE, Colour::Red);
            for order in orders(&pattern, Colour::Red, Colour::Red).unwrap() {
                let per_px = order.position.map(|place| {
                    let sine = order.angle_deg.to_radians().sin();
                    let radius = order.position[0].0.hypot(order.position[1].0).max(1e-12);
                    place.0 / radius * sine * BENCH.pixel_pitch.0 / BENCH.wavelengths[Colour::Red].0
                });
                let share = share_at(&seen, SIZE, per_px) * envelope(per_px);
                assert!((share - order.share).abs() < 0.012, "{pattern:?} {:?}: {share} {}", order.number, order.share);
            }
        }
        // The textbook's figures: (2/π)², J₁² at its largest, and half of the first order for half a blaze.
        let first = |pattern: &Pattern| orders(pattern, Colour::Red, Colour::Red).unwrap()[0].share;
        assert!((first(&grating(64.0, 0.0, Profile::Binary)) - 0.4053).abs() < 1e-3);
        assert!((first(&sinusoidal) - 0.3386 * envelope([1.0 / 32.0, 0.0])).abs() < 1e-3);
        assert!((first(&shallow) - 0.4053).abs() < 2e-3);
        // One pixel of three, or two of five, less the others.
        let middle = |pattern: &Pattern| orders(pattern, Colour::Red, Colour::Red).unwrap()[1].share;
        assert!((middle(&odd[0]) - 1.0 / 9.0).abs() < 1e-3 && (middle(&odd[2]) - 0.04).abs() < 1e-3);
    }

    /// The share of each order, by its number.
    fn share_of_order(orders: &[Order], number: [i32; 2]) -> f64 {
        orders.iter().find(|order| order.number == number).unwrap().share
    }

    #[test]
    fn no_light_is_told_twice() {
        let green = |pattern: &Pattern| orders(pattern, Colour::Green, Colour::Green).unwrap();
        for (pattern, expected) in [
            (grating(2.0, 0.0, Profile::Binary), [([1, 0], 0.4053), ([-1, 0], 0.4053)]),
            (grating(3.0, 0.0, Profile::Blazed), [([1, 0], 0.6839), ([-2, 0], 0.1710)]),
        ] {
            let orders = green(&pattern);
            for (number, share) in expected {
                let told = share_of_order(&orders, number);
                assert!((told - share).abs() < 1e-3, "{pattern:?} {number:?}: {told}");
            }
            assert!(orders.iter().map(|order| order.share).sum::<f64>() < 1.0, "{orders:?}");
        }
        let finest = green(&Pattern::Checkerboard { period_px: 2, depth_rad: PI });
        assert!(finest.iter().map(|order| order.share).sum::<f64>() < 1.0, "{finest:?}");
    }

    #[test]
    fn shares_are_those_of_the_levels_that_are_drawn() {
        let blaze = grating(8.0, 0.0, Profile::Blazed);
        let mut rig = Rig::default();
        rig.panel.stroke_rad = PerColour([1.4 * PI; 3]);
        for (out_of_stroke, first, middle) in [
            (OutOfStroke::Nearest, 0.924, 0.008),
            (OutOfStroke::Zero, 0.860, 0.034),
            (OutOfStroke::Clip, 0.774, 0.063),
            (OutOfStroke::Scale, 0.738, 0.141),
        ] {
            rig.panel.out_of_stroke = out_of_stroke;
            let orders = orders_on(&rig, &blaze, Colour::Red, Colour::Red).unwrap();
            let told = [[1, 0], [0, 0]].map(|number| share_of_order(&orders, number));
            let expected = [first * envelope([0.125, 0.0]), middle];
            assert!(
                told.iter().zip(expected).all(|(told, share)| (told - share).abs() < 2e-3),
                "{told:?} {expected:?}"
            );
        }
        // Scaled to 0.7 π.
        let board = Pattern::Checkerboard { period_px: 16, depth_rad: PI };
        let middle = orders_on(&rig, &board, Colour::Red, Colour::Red).unwrap()[0].share;
        assert!((middle - (0.35 * PI).cos().powi(2)).abs() < 5e-3, "{middle}");
        // Twelve levels of a circle that does not hold the eight phases of the lines.
        let mut coarse = Rig::default();
        let level = |step: u16| LevelPhase { level: 20 * step, phase_rad: f64::from(step) * TAU / 12.0 };
        coarse.panel.lut[Colour::Red] = Some((0..12).map(level).collect());
        let [first, ..] = orders_on(&coarse, &blaze, Colour::Red, Colour::Red).unwrap()[..] else { panic!() };
        assert!((first.share / envelope([0.125, 0.0]) - 0.96).abs() < 0.03, "{first:?}");
    }

    #[test]
    fn a_stop_set_for_one_laser_lets_its_own_half_band_through() {
        let mut rig = Rig::default();
        rig.lasers.power_mw = PerColour([0.0, 1.0, 0.0]);
        for (period_px, passes) in [(4.01, true), (3.99, false)] {
            let lines = grating(period_px, 0.0, Profile::Blazed);
            assert_eq!(orders_on(&rig, &lines, Colour::Green, Colour::Green).unwrap()[0].passes_stop, passes);
        }
    }

    #[test]
    fn a_colour_that_the_panel_never_shows_is_refused() {
        let mut panel = Rig::default().panel;
        panel.mode = PanelMode::Monochrome(Colour::Green);
        let encoder = PanelEncoder::new(&panel, SIZE, SIZE).unwrap();
        let mut frame = LevelsFrame::new(encoder.layout());
        let mut drawn = |colours: &[Colour]| {
            let placement = Placement::new([0.0; 2], colours);
            Pattern::Level { level: 200 }.draw(&placement, &encoder, &BENCH, &mut frame)
        };
        let error = drawn(&[Colour::Red]).unwrap_err().to_string();
        assert_eq!(error, "the pattern's colour is red; expected green: the panel shows green alone");
        drawn(&[]).unwrap();
        drawn(&[Colour::Green]).unwrap();
    }

    #[test]
    fn a_checkerboard_has_four_diagonal_orders_and_no_middle() {
        let pattern = Pattern::Checkerboard { period_px: 32, depth_rad: PI };
        let seen = shown(&pattern, &Placement::default(), SIZE, Colour::Blue);
        let told = orders(&pattern, Colour::Blue, Colour::Blue).unwrap();
        assert!(told[0].share < 1e-4 && share_at(&seen, SIZE, [0.0; 2]) < 1e-3);
        assert_eq!(told.len(), 5);
        for order in &told[1..] {
            let per_px = order.number.map(|number| f64::from(number) / 32.0);
            let share = share_at(&seen, SIZE, per_px) * envelope(per_px);
            assert!((share - order.share).abs() < 0.004 && (order.share - 0.1643).abs() < 1e-3, "{share}");
        }
        // With squares of one pixel all of it is beyond the stop.
        let finest = Pattern::Checkerboard { period_px: 2, depth_rad: PI };
        let told = orders(&finest, Colour::Blue, Colour::Blue).unwrap();
        assert!(told[1..].iter().all(|order| !order.passes_stop) && told[0].passes_stop);
        // A stroke that is too short for the laser leaves light in the middle: half of π leaves half.
        let half = Pattern::Checkerboard { period_px: 32, depth_rad: FRAC_PI_2 };
        let seen = shown(&half, &Placement::default(), SIZE, Colour::Blue);
        assert!((share_at(&seen, SIZE, [0.0; 2]) - 0.5).abs() < 1e-3);
    }

    #[test]
    fn orders_are_where_the_grating_equation_puts_them() {
        // 8 px of 8 µm and 520 nm: 8.125 mrad, 0.325 mm at f = 40 mm.
        let green = orders(&grating(8.0, 0.0, Profile::Blazed), Colour::Green, Colour::Green).unwrap();
        assert!((green[0].angle_deg - (520e-9f64 / 64e-6).asin().to_degrees()).abs() < 1e-9);
        assert!((green[0].position[0].0 - 0.325e-3).abs() < 1e-7 && green[0].position[1].0.abs() < 1e-15);
        assert!((green[2].position[0].0 + 0.325e-3).abs() < 1e-7, "order -1 is on the other side");
        let red = orders(&grating(8.0, 0.0, Profile::Blazed), Colour::Red, Colour::Red).unwrap();
        assert!(red[0].passes_stop && !red[3].passes_stop, "the second order is at the edge of the stop, set for red");
        assert!(green[3].passes_stop, "which green's lies within");
        for (period_px, passes) in [(2.83, true), (2.82, false)] {
            // 638 nm over 450 nm of the four pixels.
            let blue = orders(&grating(period_px, 90.0, Profile::Blazed), Colour::Blue, Colour::Blue).unwrap();
            assert_eq!(blue[0].passes_stop, passes, "{period_px} px");
        }
        // The same field lit by red light goes farther out, and no longer all into the first order.
        let red = orders(&grating(8.0, 0.0, Profile::Blazed), Colour::Green, Colour::Red).unwrap();
        assert!((red[0].position[0].0 / green[0].position[0].0 - 638.0 / 520.0).abs() < 1e-3);
        // Eight pixels a line.
        let sinc = |x: f64| (PI * x).sin() / (PI * x);
        let expected = |miss: f64| (sinc(miss) / sinc(miss / 8.0)).powi(2);
        let expected = expected(1.0 - 520.0 / 638.0) * envelope([0.125, 0.0]);
        assert!((red[0].share - expected).abs() < 2e-3, "{}", red[0].share);
    }

    /// Share of the light within `radius_px` of the middle after propagation over `u_m`, of that within the lens.
    fn focused(
        field: &[Complex64],
        size: Resolution,
        u_m: f64,
        wavelength_m: f64,
        lens_px: f64,
        radius_px: f64,
    ) -> f64 {
        let place = |index: usize| {
            let x = (index % size.width) as f64 - 0.5 * (size.width as f64 - 1.0);
            let y = (index / size.width) as f64 - 0.5 * (size.height as f64 - 1.0);
            x.hypot(y)
        };
        let mut field: Vec<_> = field
            .iter()
            .enumerate()
            .map(|(index, &value)| if place(index) <= lens_px { value } else { Complex64::ZERO })
            .collect();
        let all: f64 = field.iter().map(|value| value.norm_sqr()).sum();
        transform(&mut field, size, FftDirection::Forward);
        let frequency = |bin: usize, bins: usize| {
            let signed = if 2 * bin < bins { bin as f64 } else { bin as f64 - bins as f64 };
            signed / (bins as f64 * BENCH.pixel_pitch.0)
        };
        for (index, value) in field.iter_mut().enumerate() {
            let fx = frequency(index % size.width, size.width);
            let fy = frequency(index / size.width, size.height);
            *value *= Complex64::cis(-PI * wavelength_m * u_m * (fx * fx + fy * fy));
        }
        transform(&mut field, size, FftDirection::Inverse);
        let near = field.iter().enumerate().filter(|(index, _)| place(*index) <= radius_px);
        near.map(|(_, value)| value.norm_sqr()).sum::<f64>() / (all * (size.pixels() * size.pixels()) as f64)
    }

    #[test]
    fn a_lens_focuses_at_its_focal_length() {
        let size = Resolution { width: 256, height: 256 };
        let lens = Pattern::Lens { focal_length: Metres(25e-3), diameter: None };
        for colour in [Colour::Red, Colour::Blue] {
            let wavelength_m = BENCH.wavelengths[colour].0;
            let diameter_px = lens.lens_diameter(&bench(size), colour).unwrap().0 / BENCH.pixel_pitch.0;
            let unaliased_px = wavelength_m * 25e-3 / (8e-6 * 8e-6);
            assert!((diameter_px - unaliased_px).abs() < 1e-6, "{diameter_px}");
            let field = shown(&lens, &Placement::default(), size, colour);
            // Airy: 84 % within 1.22 λf/D, here a little more than one pixel.
            let radius_px = 1.3 * 1.22 * 25e-3 / diameter_px * wavelength_m / (8e-6 * 8e-6);
            let light = |u_m| focused(&field, size, u_m, wavelength_m, 0.5 * diameter_px, radius_px);
            assert!(light(25e-3) > 0.7, "{colour}: {}", light(25e-3));
            assert!(light(20e-3) < 0.2 && light(-25e-3) < 0.05, "{colour}: {} {}", light(20e-3), light(-25e-3));
        }
    }

    #[test]
    fn lenses_that_alias_or_leave_the_panel_are_refused() {
        let error = |focal_mm: f64, diameter_mm: Option<f64>| {
            let diameter = diameter_mm.map(|mm| Metres(mm / 1e3));
            let lens = Pattern::Lens { focal_length: Metres(focal_mm / 1e3), diameter };
            lens.phase_rad([0.0; 2], &BENCH, Colour::Green).expect_err("a fault").to_string()
        };
        assert_eq!(
            error(1.0, None),
            "the pattern's focal length is 1.00 mm; expected 1.97 mm at least in green, for 16 px of lens"
        );
        assert_eq!(
            error(50.0, Some(4.0)),
            "the pattern's lens diameter is 4.000 mm; expected 0.128 to 3.250 mm in green, beyond which it aliases"
        );
        assert!(error(5e3, Some(9.0)).ends_with("0.128 to 8.640 mm in green, the panel's own size"));
        assert!(error(0.0, None).contains("other than 0"));
    }

    /// What passes the stop of the relay.
    fn through_the_stop(field: Vec<Complex64>, size: Resolution) -> Vec<f64> {
        let mut seen = spectrum(field, size);
        let inside = |bin: usize, bins: usize| bin.min(bins - bin) * 4 < bins;
        for (index, value) in seen.iter_mut().enumerate() {
            if !(inside(index % size.width, size.width) && inside(index / size.width, size.height)) {
                *value = Complex64::ZERO;
            }
        }
        transform(&mut seen, size, FftDirection::Inverse);
        seen.into_iter().map(|value| value.norm_sqr()).collect()
    }

    #[test]
    fn dots_are_bright_where_they_are_and_dark_where_they_are_left_out() {
        let placement = Placement::new([0.5, 0.5], &[]);
        let dots = Pattern::Dots { spacing_px: 32, diameter_px: 12 };
        let seen = through_the_stop(shown(&dots, &placement, SIZE, Colour::Green), SIZE);
        // The axis is pixel (96, 79) from the upper left.
        let at = |across: isize, up: isize| seen[((79 - 32 * up) * 192 + 96 + 32 * across) as usize];
        let mut left_out = Vec::new();
        for (across, up) in (-2..=2).flat_map(|across| (-2..=2).map(move |up| (across, up))) {
            let bright = at(across, up);
            if bright < 0.1 {
                left_out.push((across, up));
            } else {
                assert!(bright > 0.7, "{across} {up}: {bright}");
            }
        }
        assert_eq!(left_out, [(0, 2), (1, 0)]);
        let between = seen[(79 - 16) * 192 + 96 + 16];
        assert!(between < 0.02, "{between}");
        // The middle dot is 12 pixels in radius, the others 6.
        assert!(seen[79 * 192 + 96 + 9] > 0.5 && seen[79 * 192 + 96 - 32 + 9] < 0.3);
    }

    #[test]
    fn a_cross_hair_crosses_at_the_axis_and_marks_the_upper_right() {
        let placement = Placement::new([20.5, -10.5], &[]);
        let cross = Pattern::CrossHair { line_px: 6 };
        let seen = through_the_stop(shown(&cross, &placement, SIZE, Colour::Red), SIZE);
        let (column, row) = (96 + 20, 79 + 11);
        let at = |right: isize, up: isize| seen[((row - up) * 192 + column + right) as usize];
        assert!(at(0, 0) > 0.7 && at(-80, 0) > 0.6 && at(0, 60) > 0.6);
        assert!(at(18, 18) > 0.6, "the mark: {}", at(18, 18));
        assert!(at(-18, 18) < 0.05 && at(18, -18) < 0.05 && at(-18, -18) < 0.05);
    }

    #[test]
    fn each_field_has_a_direction_and_each_laser_a_place() {
        let identity = Pattern::FieldIdentity { radius: None };
        let radius_m = 0.75 * 450e-9 / 32e-6 * 40e-3;
        let expected = [(Colour::Red, [1.0, 0.0]), (Colour::Green, [0.0, 1.0]), (Colour::Blue, [-1.0, 0.0])];
        for (field, direction) in expected {
            let own = orders(&identity, field, field).unwrap()[0];
            for (place, part) in own.position.iter().zip(direction) {
                assert!((place.0 - part * radius_m).abs() < 1e-7, "{field} {own:?}");
            }
            assert!(own.passes_stop && own.share < 1.0);
            for laser in Colour::ALL {
                let order = orders(&identity, field, laser).unwrap()[0];
                let ratio = BENCH.wavelengths[laser].0 / BENCH.wavelengths[field].0;
                let reached_m = order.position[0].0 * direction[0] + order.position[1].0 * direction[1];
                assert!((reached_m / radius_m - ratio).abs() < 1e-3, "{field} lit by {laser}");
                assert!(order.passes_stop && order.share > 0.5, "{field} lit by {laser}: {order:?}");
            }
            // What the panel shows: nearly all in one order, at the frequency that puts it there.
            let seen = shown(&identity, &Placement::default(), SIZE, field);
            let per_px = direction.map(|part| part * radius_m / 40e-3 * 8e-6 / BENCH.wavelengths[field].0);
            let share = share_at(&seen, SIZE, per_px);
            assert!(share >= 0.95, "{field}: {share}");
            assert!((own.share - envelope(per_px)).abs() < 1e-3, "{field}: {own:?}");
        }
        // Just within it the longest wavelength passes in the field of the shortest, just beyond it would not.
        let widest = Pattern::FieldIdentity { radius: Some(Metres(0.56e-3)) };
        let red_in_blue = orders(&widest, Colour::Blue, Colour::Red).unwrap()[0];
        assert!(red_in_blue.passes_stop, "{red_in_blue:?}");
        let too_far = Pattern::FieldIdentity { radius: Some(Metres(0.57e-3)) };
        let error = orders(&too_far, Colour::Red, Colour::Red).unwrap_err().to_string();
        assert!(error.contains("below the 0.563 mm that pass the stop whichever laser"), "{error}");
    }

    #[test]
    fn a_level_is_sent_as_it_is_and_other_colours_stay_flat() {
        let mut panel = Rig::default().panel;
        let size = Resolution { width: 6, height: 4 };
        panel.flatness_rad[Colour::Blue] = Some(vec![1.0; size.pixels()]);
        let encoder = PanelEncoder::new(&panel, size, size).unwrap();
        let mut frame = LevelsFrame::new(FrameLayout::new(&panel, size));
        let placement = Placement::new([0.0; 2], &[Colour::Red]);
        Pattern::Level { level: 200 }.draw(&placement, &encoder, &BENCH, &mut frame).unwrap();
        let levels = Colour::ALL.map(|colour| frame.unpack_colour(colour).levels);
        assert_eq!(levels, [vec![200; 24], vec![0; 24], vec![41; 24]]);
        let before = frame.clone();
        let error = Pattern::Level { level: 256 }.draw(&placement, &encoder, &BENCH, &mut frame).unwrap_err();
        assert_eq!(error.to_string(), "the pattern's level is 256; expected 0 to 255, the panel's levels");
        assert_eq!(frame, before);
    }

    #[test]
    fn two_levels_share_the_light_by_the_phase_between_them() {
        // A stroke of 2·255/256 π: 64 levels are half a π.
        for (levels, phase_rad) in
            [([0, 0], 0.0), ([0, 64], 0.5 * PI), ([200, 72], PI), ([0, 255], TAU * 255.0 / 256.0)]
        {
            let pattern = Pattern::TwoLevels { levels, period_px: 32 };
            let seen = shown(&pattern, &Placement::default(), SIZE, Colour::Green);
            let told = orders(&pattern, Colour::Green, Colour::Green).unwrap();
            let first: f64 = 4.0 / (PI * PI) * (0.5 * phase_rad).sin().powi(2);
            assert!((told[0].share - first).abs() < 4e-3, "{levels:?}: {told:?}");
            for order in &told {
                let per_px = order.number.map(|number| f64::from(number) / 32.0);
                let share = share_at(&seen, SIZE, per_px) * envelope(per_px);
                assert!((order.share - share).abs() < 1e-4, "{levels:?}: {order:?}, drawn {share}");
            }
        }
        let blue_light = orders(&Pattern::TwoLevels { levels: [0, 64], period_px: 32 }, Colour::Green, Colour::Blue);
        let phase_rad: f64 = 0.5 * PI * 520.0 / 450.0;
        let first = 4.0 / (PI * PI) * (0.5 * phase_rad).sin().powi(2);
        assert!((blue_light.unwrap()[0].share - first).abs() < 4e-3);
    }

    #[test]
    fn two_levels_are_sent_as_they_are() {
        let mut panel = Rig::default().panel;
        let size = Resolution { width: 6, height: 2 };
        panel.flatness_rad[Colour::Red] = Some(vec![1.0; size.pixels()]);
        let encoder = PanelEncoder::new(&panel, size, size).unwrap();
        let mut frame = LevelsFrame::new(FrameLayout::new(&panel, size));
        let mut draw = |levels: [u16; 2], period_px: usize| {
            let pattern = Pattern::TwoLevels { levels, period_px };
            pattern.draw(&Placement::default(), &encoder, &BENCH, &mut frame).map_err(|error| error.to_string())
        };
        let refused = |drawn: Result<(), String>| drawn.unwrap_err();
        assert_eq!(refused(draw([0, 256], 4)), "the pattern's level is 256; expected 0 to 255, the panel's levels");
        assert!(refused(draw([0, 9], 3)).ends_with("expected an even number of pixels"));
        draw([3, 250], 4).unwrap();
        assert_eq!(frame.unpack_colour(Colour::Red).levels, [3, 3, 250, 250, 3, 3].repeat(2));
    }

    #[test]
    fn a_level_without_a_phase_says_how_it_is_measured() {
        let mut rig = Rig::default();
        let level = |level: u16| LevelPhase { level, phase_rad: f64::from(level) * TAU / 64.0 };
        rig.panel.lut[Colour::Green] = Some([0, 16, 32, 48].map(level).to_vec());
        let lines = Pattern::TwoLevels { levels: [0, 17], period_px: 32 };
        let error = orders_on(&rig, &lines, Colour::Green, Colour::Green).unwrap_err().to_string();
        assert!(error.contains("level is 17") && error.contains("take that file out"), "{error}");
    }

    #[test]
    fn an_axis_off_the_panel_is_refused() {
        let lens = Pattern::Lens { focal_length: Metres(0.3), diameter: None };
        let encoder = PanelEncoder::new(&Rig::default().panel, BENCH.resolution, BENCH.resolution).unwrap();
        let mut frame = LevelsFrame::new(encoder.layout());
        let mut drawn = |axis_px| lens.draw(&Placement::new(axis_px, &[]), &encoder, &BENCH, &mut frame);
        let error = drawn([5000.0, 0.0]).unwrap_err().to_string();
        assert!(error.contains("axis is 5000,0") && error.contains("at most 960 px across and 540 px"), "{error}");
        assert!(drawn([0.0, -541.0]).is_err() && drawn([f64::NAN, 0.0]).is_err());
        drawn([960.0, -540.0]).unwrap();
    }

    #[test]
    fn figures_that_no_panel_can_show_are_refused() {
        let gratings = [
            (grating(1.9, 0.0, Profile::Binary), "period is 1.9 px; expected 2 to 1920 px"),
            (grating(f64::NAN, 0.0, Profile::Binary), "period is NaN px"),
            (Pattern::Checkerboard { period_px: 7, depth_rad: PI }, "period is 7 px; expected an even number"),
            (
                Pattern::Checkerboard { period_px: 8, depth_rad: 7.0 },
                "depth is 2.228 π; expected above 0 and up to 2 π",
            ),
            (Pattern::Dots { spacing_px: 16, diameter_px: 9 }, "dots' diameter is 9 px; expected 4 to 8 px"),
            (Pattern::CrossHair { line_px: 1 }, "line's width is 1 px; expected 2 to 67 px"),
        ];
        for (pattern, part) in gratings {
            let error = pattern.phase_rad([0.0; 2], &BENCH, Colour::Green).unwrap_err().to_string();
            assert!(error.contains(part), "{error}");
        }
    }

    #[test]
    fn figures_carry_their_units() {
        for (json, pattern) in [
            (
                r#"{"kind":"lens","focal_length_m":-0.25}"#,
                Pattern::Lens { focal_length: Metres(-0.25), diameter: None },
            ),
            (
                r#"{"kind":"lens","focal_length_m":0.3,"diameter_m":0.002}"#,
                Pattern::Lens { focal_length: Metres(0.3), diameter: Some(Metres(0.002)) },
            ),
            (
                r#"{"kind":"two-levels","levels":[0,128],"period_px":32}"#,
                Pattern::TwoLevels { levels: [0, 128], period_px: 32 },
            ),
            (r#"{"kind":"field-identity","radius_m":0.0005}"#, Pattern::FieldIdentity { radius: Some(Metres(5e-4)) }),
            (
                r#"{"kind":"grating","period_px":6.5,"angle_deg":90.0,"profile":"binary"}"#,
                Pattern::Grating { period_px: 6.5, angle_deg: 90.0, profile: Profile::Binary, depth_rad: None },
            ),
        ] {
            assert_eq!(serde_json::from_str::<Pattern>(json).unwrap(), pattern);
            assert_eq!(serde_json::to_string(&pattern).unwrap(), json);
        }
        let short = r#"{"kind":"grating","period_px":8,"profile":"blazed"}"#;
        let told = serde_json::from_str::<Pattern>(short).unwrap().to_string();
        assert_eq!(told, "blazed grating, 8 px a line, first order at 0°, 2.000 π deep");
        for wrong in [
            r#"{"kind":"lens","focal_length_mm":300}"#,
            r#"{"kind":"stripes"}"#,
            r#"{"kind":"level","level":-1}"#,
            r#"{"kind":"grating","period_px":8,"profile":"round"}"#,
            "{}",
        ] {
            assert!(serde_json::from_str::<Pattern>(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn lengths_are_told_without_what_rounding_leaves() {
        let lens = |mm: f64| Pattern::Lens { focal_length: Metres(mm / 1e3), diameter: None }.to_string();
        assert_eq!([30.1, -250.0].map(lens), ["lens, f = 30.1 mm", "lens, f = -250 mm"]);
    }

    #[test]
    fn all_colours_are_drawn_where_none_is_named() {
        assert_eq!(Placement::new([1.0, 2.0], &[]).colours, PerColour([true; 3]));
        assert_eq!(Placement::new([1.0, 2.0], &[Colour::Blue, Colour::Red]).colours, PerColour([true, false, true]));
    }
}

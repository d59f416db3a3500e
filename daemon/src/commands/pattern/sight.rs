//! What is to be seen on the bench while a test pattern is shown.

use std::fmt;
use std::ops::RangeInclusive;
use std::path::PathBuf;

use holod_calibration::rig::{PanelMode, Rig};
use holod_calibration::{Colour, Metres};
use holod_slm_output::PanelEncoder;
use holod_slm_output::patterns::{Order, Pattern, PatternError, Placement, stop_frequency};
use serde::Serialize;

/// Orders with less light are left out, but for the middle.
const SHARE_MIN: f64 = 5e-4;

/// Where usual cameras focus.
const CAMERA_DPT: RangeInclusive<f64> = 0.0..=10.0;

/// What a person with a camera or a photodiode sees.
#[derive(Serialize)]
pub(super) struct Sight {
    /// The pattern in words.
    pattern: String,
    rig: String,
    /// The files that were written.
    #[serde(serialize_with = "crate::results::paths_text")]
    pub(super) files: Vec<PathBuf>,
    /// Where light falls in the eyepiece's focal plane, spot by spot.
    spots: Vec<Spot>,
    /// What else there is to know.
    notes: Vec<String>,
}

/// One spot in the eyepiece's focal plane.
#[derive(Serialize)]
struct Spot {
    laser: &'static str,
    order: [i32; 2],
    share: f64,
    angle_deg: f64,
    x_mm: f64,
    y_mm: f64,
    passes_stop: bool,
}

impl Sight {
    /// What is seen on `rig`, for whose panel `encoder` was made.
    pub(super) fn of(
        pattern: &Pattern,
        placement: &Placement,
        rig: &Rig,
        encoder: &PanelEncoder,
    ) -> Result<Self, PatternError> {
        let optics = &rig.geometry;
        let shown = |colour: Colour| {
            placement.colours[colour] && !matches!(rig.panel.mode, PanelMode::Monochrome(only) if only != colour)
        };
        let fields: Vec<Colour> = Colour::ALL.into_iter().filter(|&colour| shown(colour)).collect();
        let mut spots = Vec::new();
        for &field in &fields {
            let orders = pattern.orders(rig, encoder, field, field)?;
            let seen = orders.iter().filter(|order| order.share >= SHARE_MIN || order.number == [0, 0]);
            spots.extend(seen.map(|order| Spot::of(field, order)));
        }
        let mut notes = pattern_notes(pattern, placement, rig, encoder, &fields)?;
        let unnamed = Colour::ALL.into_iter().filter(|&colour| !placement.colours[colour]).map(Colour::name);
        let unnamed: Vec<_> = unnamed.collect();
        if !unnamed.is_empty() {
            notes.push(format!("--output shows it with no light of {}", unnamed.join(" and ")));
        }
        if !spots.is_empty() {
            if !matches!(pattern, Pattern::Level { .. }) {
                notes.push(
                    "the light is that of the levels which the panel is sent, on pixels without gaps (a fill factor of \
                     1); the rest of it goes to orders that are not listed"
                        .into(),
                );
            }
            let longest = rig.stop_colour();
            notes.push(format!(
                "the stop of the relay, one for all colours and set for {longest}, lets spots up to {:.3} mm right, \
                 left, up and down through",
                1e3 * optics.eyebox()[longest].0 / 4.0
            ));
        }
        Ok(Self { pattern: pattern.to_string(), rig: rig.name.clone(), files: Vec::new(), spots, notes })
    }
}

/// What to look for and how, by the kind of pattern.
fn pattern_notes(
    pattern: &Pattern,
    placement: &Placement,
    rig: &Rig,
    encoder: &PanelEncoder,
    fields: &[Colour],
) -> Result<Vec<String>, PatternError> {
    let optics = &rig.geometry;
    let width_mrad = |width_px: usize| width_px as f64 * optics.pixel_angle_rad() * 1e3;
    let notes = match *pattern {
        Pattern::Level { .. } => vec!["no pattern of phases: all light stays in the middle".into()],
        Pattern::TwoLevels { .. } => vec![
            "measure the power of one first order, behind a hole that keeps the middle away: it is largest where the \
             levels are π apart, and least where they are 0 or 2π apart; `holod lut` makes the table of it"
                .into(),
        ],
        Pattern::Checkerboard { .. } => vec![
            "turn --depth until the middle is darkest: there the panel's own depth is π, and any other figure is the \
             stroke's error"
                .into(),
        ],
        Pattern::Grating { .. } => {
            vec!["light on the opposite side means that panel.phase_sign or panel.orientation is wrong".into()]
        }
        Pattern::Lens { focal_length, .. } => {
            let of_field = |&field| lens_note(pattern, focal_length.0, placement.axis_px, rig, field);
            let mut notes = fields.iter().map(of_field).collect::<Result<Vec<_>, _>>()?;
            notes.push(focus_note(focal_length, rig));
            notes
        }
        Pattern::Dots { spacing_px, .. } => vec![
            format!("focus the camera at infinity: dots {:.2} mrad apart, bright on black", width_mrad(spacing_px)),
            "the middle dot is twice as wide; the one right of it and the second above it are left out".into(),
            "where others are missing, correct panel.orientation of the rig file".into(),
        ],
        Pattern::CrossHair { line_px } => {
            let [x_px, y_px] = placement.axis_px;
            vec![format!(
                "focus the camera at infinity: lines {:.2} mrad wide cross {x_px} px right of the panel's centre and \
                 {y_px} px above it; the square is up and to the right",
                width_mrad(line_px)
            )]
        }
        Pattern::FieldIdentity { .. } => identity_notes(pattern, rig, encoder, fields)?,
    };
    Ok(notes)
}

/// Where a lens focuses, and whether a camera in the display sees it sharp.
fn focus_note(Metres(focal_length_m): Metres, rig: &Rig) -> String {
    let eyepiece_m = rig.geometry.eyepiece_focal_length.0;
    let focus_dpt = focal_length_m / (eyepiece_m * eyepiece_m);
    let side = if focal_length_m > 0.0 { "in front of" } else { "behind" };
    let seen = if CAMERA_DPT.contains(&focus_dpt) {
        format!("a camera in the display sees it sharp at {focus_dpt:.2} dioptres")
    } else {
        let greatest_mm = 1e3 * CAMERA_DPT.end() * eyepiece_m * eyepiece_m;
        format!(
            "at {focus_dpt:.2} dioptres, where no usual camera in the display is sharp; focal lengths of up to \
             {greatest_mm:.1} mm are within {} dioptres",
            CAMERA_DPT.end()
        )
    };
    // Depth grows by the square of a relay's magnification.
    let from_image_mm = 1e3 * focal_length_m.abs() * rig.relay_magnification.powi(2);
    format!("the focus is {from_image_mm:.2} mm {side} the panel's image: {seen}")
}

/// What of a lens is left by panel and stop, and how sharp that makes its focus.
fn lens_note(
    pattern: &Pattern,
    focal_length_m: f64,
    axis_px: [f64; 2],
    rig: &Rig,
    field: Colour,
) -> Result<String, PatternError> {
    let optics = &rig.geometry;
    let diameter_m = pattern.lens_diameter(optics, field)?.0;
    let wave_m2 = optics.wavelengths[field].0 * focal_length_m.abs();
    // What the stop passes are slopes of the phase, in x and in y.
    let passed_m = 2.0 * wave_m2 * stop_frequency(rig, field);
    let panel_px = [optics.resolution.width, optics.resolution.height];
    // Across and up: what of `size_m` around the axis lies on the panel.
    let on_panel_m = |size_m: f64| {
        [0, 1].map(|side| {
            let axis_m = axis_px[side] * optics.pixel_pitch.0;
            let edge_m = 0.5 * panel_px[side] as f64 * optics.pixel_pitch.0;
            (0.5 * size_m).min(edge_m - axis_m) + (0.5 * size_m).min(edge_m + axis_m)
        })
    };
    let lies_m = on_panel_m(diameter_m);
    let (on_panel, left_m) = match lies_m.iter().any(|lies_m| *lies_m < diameter_m * (1.0 - 1e-9)) {
        true => (format!(", of which {:.3} x {:.3} mm lie on the panel", 1e3 * lies_m[0], 1e3 * lies_m[1]), lies_m),
        false => (String::new(), [diameter_m; 2]),
    };
    let through_m = on_panel_m(diameter_m.min(passed_m));
    let (passed, left_m) = match (diameter_m > passed_m, on_panel.is_empty()) {
        (true, true) => (format!(", of which the stop passes a square of {:.3} mm", 1e3 * passed_m), through_m),
        (true, false) => {
            (format!(", of which the stop passes {:.3} x {:.3} mm", 1e3 * through_m[0], 1e3 * through_m[1]), through_m)
        }
        (false, _) => (String::new(), left_m),
    };
    let radius_um = |width_m: f64| 1e6 * wave_m2 / width_m;
    let focus = match (on_panel.is_empty(), passed.is_empty()) {
        (true, true) => format!("a radius of {:.1} µm", 1.22 * radius_um(diameter_m)),
        (true, false) => format!("a radius of {:.1} µm", radius_um(passed_m)),
        (false, _) => {
            format!("a radius of {:.1} µm across and {:.1} µm up", radius_um(left_m[0]), radius_um(left_m[1]))
        }
    };
    Ok(format!("{field}: a lens of {:.3} mm{on_panel}{passed}; its focus has {focus}", 1e3 * diameter_m))
}

/// Where the diode goes, and what it sees when lasers and fields are exchanged.
fn identity_notes(
    pattern: &Pattern,
    rig: &Rig,
    encoder: &PanelEncoder,
    fields: &[Colour],
) -> Result<Vec<String>, PatternError> {
    let mut notes = Vec::new();
    for &field in fields {
        let own = pattern.orders(rig, encoder, field, field)?[0];
        let radius_mm = radius_m(&own) * 1e3;
        let mut nearest_mm = f64::INFINITY;
        let mut strays = Vec::new();
        for laser in Colour::ALL.into_iter().filter(|&laser| laser != field) {
            let stray = pattern.orders(rig, encoder, field, laser)?[0];
            let stray_mm = radius_m(&stray) * 1e3;
            nearest_mm = nearest_mm.min((stray_mm - radius_mm).abs());
            strays.push(format!("{laser} light would be {stray_mm:.3} mm from the axis, {:.0} %", stray.share * 100.0));
        }
        let way = match field {
            Colour::Red => "right of",
            Colour::Green => "above",
            Colour::Blue => "left of",
        };
        notes.push(format!(
            "{field}'s field: put the photodiode {radius_mm:.3} mm {way} the axis, behind a hole of less than {:.3} mm: only \
             {field} light on {field}'s field meets it; {}, beside the hole",
            2.0 * nearest_mm,
            strays.join(" and ")
        ));
    }
    notes.push(
        "with a wider hole, look at the diode and at the laser's drive on one oscilloscope: the diode's pulse must lie within \
         that of its own colour's laser, once in each colour frame"
            .into(),
    );
    notes.push("a spot on the opposite side, or up where it should be down, means that the relay inverts or phase_sign is wrong".into());
    Ok(notes)
}

fn radius_m(order: &Order) -> f64 {
    order.position[0].0.hypot(order.position[1].0)
}

impl Spot {
    fn of(laser: Colour, order: &Order) -> Self {
        // Whole micrometres and no negative zero.
        let rounded_mm = |place: Metres| (place.0 * 1e6).round() / 1e3 + 0.0;
        Self {
            laser: laser.name(),
            order: order.number,
            share: order.share,
            angle_deg: order.angle_deg,
            x_mm: rounded_mm(order.position[0]),
            y_mm: rounded_mm(order.position[1]),
            passes_stop: order.passes_stop,
        }
    }
}

impl fmt::Display for Sight {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}, on {}", self.pattern, self.rig)?;
        for file in &self.files {
            writeln!(f, "written: {}", file.display())?;
        }
        if !self.spots.is_empty() {
            writeln!(
                f,
                "in the eyepiece's focal plane, from the axis, x to the viewer's right and y up; angles as light leaves the panel:"
            )?;
            writeln!(f, "  laser   order   light      angle         x          y")?;
        }
        for spot in &self.spots {
            writeln!(
                f,
                "  {:6} {:+},{:+}  {:5.1} %  {:7.3}°  {:+.3} mm  {:+.3} mm{}",
                spot.laser,
                spot.order[0],
                spot.order[1],
                spot.share * 100.0,
                spot.angle_deg,
                spot.x_mm,
                spot.y_mm,
                if spot.passes_stop { "" } else { "  stopped" }
            )?;
        }
        self.notes.iter().try_for_each(|note| writeln!(f, "- {note}"))
    }
}

#[cfg(test)]
mod tests {
    use holod_calibration::PerColour;

    use super::*;

    fn encoder_of(rig: &Rig) -> PanelEncoder {
        PanelEncoder::new(&rig.panel, rig.resolution(), rig.resolution()).unwrap()
    }

    #[test]
    fn a_lens_beside_the_panels_middle_is_as_sharp_as_what_of_it_is_on_the_panel() {
        let rig = Rig::default();
        let notes = |axis_px: [f64; 2], focal_length_m: f64| {
            let placement = Placement { axis_px, colours: PerColour([false, true, false]) };
            let pattern = Pattern::Lens { focal_length: Metres(focal_length_m), diameter: None };
            Sight::of(&pattern, &placement, &rig, &encoder_of(&rig)).unwrap().notes.join("\n")
        };
        // 8.64 mm; of its right half the 160 px between its axis and the edge. 520 nm · 1 m over 5.6 and 8.64 mm.
        let cut = notes([800.0, 0.0], 1.0);
        assert!(
            cut.contains(
                "a lens of 8.640 mm, of which 5.600 x 8.640 mm lie on the panel; its focus has a radius of 92.9 µm across \
                 and 60.2 µm up"
            ),
            "{cut}"
        );
        let whole = notes([420.0, 0.0], 1.0);
        assert!(whole.contains("a lens of 8.640 mm; its focus has a radius of 73.4 µm"), "{whole}");
        // At the edge half of the stop's square of 1.994 mm is left across.
        let both = notes([960.0, 0.0], 0.05);
        assert!(
            both.contains("1.625 x 3.250 mm lie on the panel, of which the stop passes 0.997 x 1.994 mm")
                && both.contains("26.1 µm across and 13.0 µm up"),
            "{both}"
        );
    }

    #[test]
    fn a_lens_is_as_sharp_as_what_the_stop_leaves_of_it() {
        let rig = Rig::default();
        let placement = Placement { axis_px: [0.0; 2], colours: PerColour([false, true, false]) };
        let lens_notes = |diameter_mm: Option<f64>| {
            let pattern =
                Pattern::Lens { focal_length: Metres(0.05), diameter: diameter_mm.map(|mm| Metres(1e-3 * mm)) };
            Sight::of(&pattern, &placement, &rig, &encoder_of(&rig)).unwrap().notes.join("\n")
        };
        // Of 520 nm and 8 µm: λf/p is 3.25 mm. The stop is set for 638 nm, which passes 1.99 mm.
        let largest = lens_notes(None);
        assert!(
            largest.contains("a lens of 3.250 mm, of which the stop passes a square of 1.994 mm; ")
                && largest.contains("its focus has a radius of 13.0 µm"),
            "{largest}"
        );
        // D = f/40² mm².
        assert!(largest.contains("at 31.25 dioptres, where no usual camera"), "{largest}");
        assert!(largest.contains("focal lengths of up to 16.0 mm are within 10 dioptres"), "{largest}");
        // Airy's disc: 1.22 · 520 nm · 50 mm / 1 mm.
        let small = lens_notes(Some(1.0));
        assert!(small.contains("a lens of 1.000 mm; its focus has a radius of 31.7 µm"), "{small}");
        for (focal_length_mm, sharp) in [(0.016, true), (0.0161, false), (-0.01, false)] {
            let pattern = Pattern::Lens { focal_length: Metres(focal_length_mm), diameter: None };
            let notes = Sight::of(&pattern, &placement, &rig, &encoder_of(&rig)).unwrap().notes.join("\n");
            assert_eq!(notes.contains("a camera in the display sees it sharp at 10.00 dioptres"), sharp, "{notes}");
        }
    }
}

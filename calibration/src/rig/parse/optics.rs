//! `[optics]`.

use super::figures::shown;
use crate::rig::reader::Span;
use crate::toml_reader::{Found, Section};
use crate::{Dioptres, DisplayGeometry, Metres, PerColour, Resolution};

/// What each colour's figure in `optics.wavelengths_nm` may be.
pub const WAVELENGTH: Span =
    Span::new(380.0, 780.0, "nm").slips(&[("metres", 1e9), ("micrometres", 1e3), ("ångströms", 0.1)]);
/// What `optics.eyepiece_focal_length_mm` may be.
pub const FOCAL_LENGTH: Span = Span::new(5.0, 500.0, "mm").slips(&[("metres", 1e3), ("micrometres", 1e-3)]);
const MAGNIFICATION: Span = Span::new(0.1, 10.0, "").slips(&[("percent", 1e-2)]);
const DEPTH_M: Span = Span::new(1.0 / DEPTH_DPT.max, 100.0, "m").slips(&[("millimetres", 1e-3)]).or_infinite();
/// What `optics.depth_far_dpt` and `optics.depth_near_dpt` may be.
pub const DEPTH_DPT: Span = Span::new(0.0, 20.0, "dioptres");
/// Below this a volume's two ends look alike to any eye.
const DEPTH_RANGE_MIN_DPT: f64 = 0.1;

pub(super) fn read_optics(
    optics: &Section<'_>,
    pixels: Option<(Resolution, Metres)>,
) -> Option<(DisplayGeometry, f64)> {
    let wavelengths_nm = optics.numbers("wavelengths_nm", WAVELENGTH, PerColour([true; 3]));
    let focal_length_mm = optics.required_number("eyepiece_focal_length_mm", FOCAL_LENGTH);
    let magnification = match optics.number("relay_magnification", MAGNIFICATION) {
        None if !optics.has("relay_magnification") => Some(optics.assumed("relay_magnification", 1.0)),
        read => read,
    };
    let depth_far = read_depth(optics, ["depth_far_m", "depth_far_dpt"], DisplayGeometry::DEFAULT.depth_far);
    let depth_near = read_depth(optics, ["depth_near_m", "depth_near_dpt"], DisplayGeometry::DEFAULT.depth_near);

    if let [Some(red), Some(green), Some(blue)] = &wavelengths_nm.0
        && !(red.value > green.value && green.value > blue.value)
    {
        let found = format!("{}, {} and {} nm", red.value, green.value, blue.value);
        let expected = "red longer than green, green longer than blue";
        optics.fault_at("wavelengths_nm", red.line, &found, expected, "put each under its own colour");
    }
    if let (Some(far), Some(near)) = (&depth_far, &depth_near) {
        let range_dpt = near.value.0 - far.value.0;
        let line = near.line.or(far.line);
        let found = format!("near {} and far {} dioptres", shown(near.value.0), shown(far.value.0));
        if range_dpt < 0.0 {
            let advice = "exchange the near and the far end";
            optics.fault_at("depth_near", line, &found, "the near end nearer than the far end", advice);
        } else if range_dpt < DEPTH_RANGE_MIN_DPT {
            let expected = format!("ends at least {DEPTH_RANGE_MIN_DPT} dioptres apart");
            let advice = "depths are in metres or dioptres: 35 cm is depth_near_m = 0.35";
            optics.fault_at("depth_near", line, &found, &expected, advice);
        }
    }
    let [Some(red), Some(green), Some(blue)] = wavelengths_nm.0 else { return None };
    let (resolution, pixel_pitch) = pixels?;
    let (focal_length_mm, magnification) = (focal_length_mm?.value, magnification?);
    let from_panel_mm = focal_length_mm / magnification.value;
    if !(FOCAL_LENGTH.min..=FOCAL_LENGTH.max).contains(&from_panel_mm) {
        let found = format!("{}, which makes {} mm of the eyepiece", shown(magnification.value), shown(from_panel_mm));
        let expected = format!("from {} to {} mm, seen from the panel", FOCAL_LENGTH.min, FOCAL_LENGTH.max);
        let advice = "write the size of the panel's image over that of the panel";
        magnification.fault(&found, &expected, advice);
    }
    let geometry = DisplayGeometry {
        resolution,
        pixel_pitch,
        wavelengths: PerColour([red, green, blue]).map(|wavelength_nm| Metres(wavelength_nm.value / 1e9)),
        eyepiece_focal_length: Metres(from_panel_mm / 1e3),
        depth_far: depth_far?.value,
        depth_near: depth_near?.value,
    };
    Some((geometry, magnification.value))
}

/// One end of the depth range, in metres or in dioptres; `default` where the rig file gives neither.
fn read_depth<'a>(
    optics: &Section<'a>,
    [key_m, key_dpt]: [&'static str; 2],
    default: Dioptres,
) -> Option<Found<'a, Dioptres>> {
    if !optics.has(key_m) && !optics.has(key_dpt) {
        return Some(optics.assumed(key_dpt, default));
    }
    let metres = optics.number(key_m, DEPTH_M);
    let dioptres = optics.number(key_dpt, DEPTH_DPT);
    if optics.has(key_m) && optics.has(key_dpt) {
        let line = dioptres.as_ref().or(metres.as_ref()).and_then(|depth| depth.line);
        let expected = "the depth once, in metres or in dioptres";
        optics.fault_at(key_dpt, line, &format!("{key_m} as well"), expected, "take one of the two out");
    }
    let metres = metres.map(|found| found.with(Dioptres(1.0 / found.value)));
    metres.or(dioptres.map(|found| found.with(Dioptres(found.value))))
}

//! `[panel]` as a phase modulator: its levels, and the phases that they give.

use std::f64::consts::{PI, TAU};
use std::path::Path;

use twox_hash::XxHash3_64;

use super::figures::shown;
use crate::rig::files::{PICTURE_BYTES_MAX, TEXT_BYTES_MAX, read_bytes, text_of};
use crate::rig::flatness::{self, GrayScale};
use crate::rig::meaning::is_in_order;
use crate::rig::reader::Span;
use crate::rig::{LevelPhase, Orientation, OutOfStroke, Packing, PanelMode, PhaseSign, Provenance, TableFile, lut};
use crate::toml_reader::{Found, Section};
use crate::{Colour, PerColour, Resolution};

const BIT_DEPTH: Span = Span::new(8.0, 16.0, "bits");
const STROKE: Span = Span::new(0.5, 6.0, "π").slips(&[("radians", 1.0 / PI), ("degrees", 1.0 / 180.0)]);
const GRAY_OF_2PI: Span = Span::new(16.0, 65536.0, "");
/// By how much a stated stroke may differ from that of a measured table.
const STROKE_TOLERANCE: f64 = 0.02;

/// The bits of a level and where they travel on the video link.
pub(super) fn read_levels(panel: &Section<'_>, mode: Option<PanelMode>) -> Option<(u8, Packing)> {
    let bits = panel.required_integer("bit_depth", BIT_DEPTH);
    let packings = Packing::ALL.map(|packing| (packing.name(), packing));
    let packing = panel.choice("packing", &packings, false);
    let bits = bits?;
    let fitting: Vec<Packing> =
        Packing::ALL.into_iter().filter(|packing| usize::from(packing.bit_depth()) == bits.value).collect();
    let names = fitting.iter().map(|packing| format!("\"{}\"", packing.name())).collect::<Vec<_>>().join(" or ");
    let Some(&first) = fitting.first() else {
        let advice = "holod sends levels of 8, 10 or 16 bits";
        bits.fault(bits.value, "8, 10 or 16", advice);
        return None;
    };
    let bit_depth = first.bit_depth();
    let line = packing.as_ref().and_then(|packing| packing.line);
    let packing = match packing {
        Some(packing) if packing.value.bit_depth() == bit_depth => packing.value,
        Some(packing) => {
            let found = format!("\"{}\", which carries {} bits", packing.value.name(), packing.value.bit_depth());
            let expected = format!("{names}, as bit_depth is {bit_depth}");
            let advice = "correct packing or bit_depth: the panel's manual says which bits it reads";
            panel.fault_at("packing", line.or(bits.line), &found, &expected, advice);
            return None;
        }
        None if bit_depth == Packing::Gray.bit_depth() => Packing::Gray,
        // A packing that is there and faulty has been reported.
        None if panel.has("packing") => return None,
        None => {
            let expected = format!("{names}, as bit_depth is {bit_depth}");
            let advice = "add packing to [panel]: the panel's manual says which bits it reads";
            panel.fault_at("packing", bits.line, "nothing", &expected, advice);
            return None;
        }
    };
    if mode == Some(PanelMode::ChannelPacked) && !packing.fits_a_channel() {
        let found = format!("\"{}\" in mode \"{}\"", packing.name(), PanelMode::ChannelPacked.name());
        let advice = format!("write mode = \"{}\", or 8 bits with \"gray\"", PanelMode::FieldSequential.name());
        let expected = "\"gray\" or \"gray10\", as red, green and blue each carry a field of their own";
        panel.fault_at("packing", line.or(bits.line), &found, expected, advice);
        return None;
    }
    Some((bit_depth, packing))
}

/// The panel as a phase modulator.
pub(super) struct Phase {
    pub(super) orientation: Orientation,
    pub(super) sign: PhaseSign,
    pub(super) stroke_rad: PerColour<f64>,
    pub(super) out_of_stroke: OutOfStroke,
    pub(super) lut: PerColour<Option<Vec<LevelPhase>>>,
    pub(super) flatness_rad: PerColour<Option<Vec<f32>>>,
}

pub(super) fn read_phase(
    panel: &Section<'_>,
    levels: Option<(u8, Packing)>,
    resolution: Option<Resolution>,
    folder: &Path,
    provenance: &mut Provenance,
) -> Option<Phase> {
    let signs = [("positive", PhaseSign::Positive), ("negative", PhaseSign::Negative)];
    let sign = panel.choice("phase_sign", &signs, true);
    let lut_paths = panel.texts("lut_file", "a CSV file's path");
    let needs_stroke = PerColour(lut_paths.0.each_ref().map(Option::is_none));
    let stroke_pi = panel.numbers("stroke_pi", STROKE, needs_stroke);
    let orientations = Orientation::ALL.map(|orientation| (orientation.name(), orientation));
    let orientation = panel.choice("orientation", &orientations, false);
    let ways = OutOfStroke::ALL.map(|way| (way.name(), way));
    let out_of_stroke = panel.choice("out_of_stroke", &ways, false);
    let flatness_paths = panel.texts("flatness_file", "a PNG or BMP file's path");
    let grays_of_2pi = panel.numbers("flatness_2pi_gray", GRAY_OF_2PI, PerColour([false; 3]));
    let subtracted = read_flatness_sign(panel);

    let mut lut = PerColour([const { None }; 3]);
    let mut flatness_rad = PerColour([const { None }; 3]);
    let mut stroke_rad =
        PerColour(stroke_pi.0.each_ref().map(|stroke| stroke.as_ref().map(|stroke| stroke.value * PI)));
    for colour in Colour::ALL {
        if let (Some(path), Some((bit_depth, _))) = (&lut_paths[colour], levels) {
            let file = folder.join(path.value);
            let read = read_bytes(&file, "text", TEXT_BYTES_MAX).and_then(|bytes| {
                let xxh3 = XxHash3_64::oneshot(&bytes);
                Ok((lut::read(&file, &text_of(bytes, &file)?, bit_depth)?, xxh3))
            });
            let read = path.of_file(read);
            let (table, xxh3) = read.unzip();
            lut[colour] = table;
            if let Some(table) = &lut[colour] {
                let range = table_range(table);
                check_lut(path, range, sign.as_ref().map(|sign| sign.value), stroke_pi[colour].as_ref());
                stroke_rad[colour] = Some(range.either().abs());
            }
            provenance.lut_files[colour] = xxh3.map(|xxh3| TableFile { path: file, xxh3 });
        }
        if let (Some(path), Some(resolution)) = (&flatness_paths[colour], resolution) {
            let file = folder.join(path.value);
            let gray_of_2pi = grays_of_2pi[colour].as_ref().map(|gray| gray.value);
            let read = read_bytes(&file, "picture", PICTURE_BYTES_MAX).and_then(|bytes| {
                let scale = GrayScale { gray_of_2pi, subtracted };
                Ok((flatness::read(&file, &bytes, resolution, scale)?, XxHash3_64::oneshot(&bytes)))
            });
            let read = path.of_file(read);
            let (picture, xxh3) = read.unzip();
            flatness_rad[colour] = picture;
            provenance.flatness_files[colour] = xxh3.map(|xxh3| TableFile { path: file, xxh3 });
        }
        if let (None, Some(gray)) = (&flatness_paths[colour], &grays_of_2pi[colour]) {
            let advice = format!("name {colour}'s picture in flatness_file, or take this out");
            gray.fault("a gray of no picture", "a flatness_file for it", advice);
        }
    }
    let stroke_rad = PerColour([stroke_rad.0[0]?, stroke_rad.0[1]?, stroke_rad.0[2]?]);
    let out_of_stroke = out_of_stroke.map_or(OutOfStroke::default(), |way| way.value);
    let orientation = orientation.map_or(Orientation::default(), |orientation| orientation.value);
    Some(Phase { orientation, sign: sign?.value, stroke_rad, out_of_stroke, lut, flatness_rad })
}

/// Whether the flatness pictures show what is to be taken off.
fn read_flatness_sign(panel: &Section<'_>) -> bool {
    let signs = [("add", false), ("subtract", true)];
    let sign = panel.choice("flatness_sign", &signs, false);
    if let Some(sign) = sign.as_ref().filter(|_| !panel.has("flatness_file")) {
        let advice = "name the pictures in flatness_file, or take this out";
        sign.fault("a sign of no picture", "a flatness_file for it", advice);
    }
    sign.is_some_and(|sign| sign.value)
}

/// By how much the phases of a table differ.
#[derive(Clone, Copy)]
enum TableRange {
    /// The phase rises or falls throughout, by this much from the lowest level to the highest.
    Signed(f64),
    /// The phases come in no order; the lowest and the highest are this far apart.
    Unordered(f64),
}

impl TableRange {
    fn either(self) -> f64 {
        match self {
            Self::Signed(range_rad) | Self::Unordered(range_rad) => range_rad,
        }
    }
}

fn table_range(table: &[LevelPhase]) -> TableRange {
    let phases = || table.iter().map(|entry| entry.phase_rad);
    if is_in_order(table) {
        return TableRange::Signed(table[table.len() - 1].phase_rad - table[0].phase_rad);
    }
    TableRange::Unordered(phases().fold(f64::MIN, f64::max) - phases().fold(f64::MAX, f64::min))
}

/// Judges a measured table against what the rig file says in words.
fn check_lut(path: &Found<'_, &str>, range: TableRange, sign: Option<PhaseSign>, stroke_pi: Option<&Found<'_, f64>>) {
    let range_pi = range.either() / PI;
    if range_pi.abs() < STROKE.min || range_pi.abs() > STROKE.max {
        let expected = format!("a range of {} to {} π", STROKE.min, STROKE.max);
        let found = format!("a table whose phase changes by {} π", shown(range_pi));
        path.fault(&found, &expected, "give its phases in radians: multiply turns by 2π, multiples of π by π");
        return;
    }
    let found = format!("a table whose phase goes by {} π from the lowest level to the highest", shown(range_pi));
    let is_stroke = |range_pi: f64, stroke_pi: f64| (range_pi.abs() / stroke_pi - 1.0).abs() <= STROKE_TOLERANCE;
    if let Some(stroke) = stroke_pi.filter(|stroke| !is_stroke(range_pi, stroke.value)) {
        let expected = format!("the {} π that stroke_pi states", shown(stroke.value));
        let other_unit = [("multiples of π", PI), ("turns", TAU)]
            .into_iter()
            .find(|(_, unit_rad)| is_stroke(range_pi * unit_rad, stroke.value));
        let advice = match other_unit {
            Some((unit, unit_rad)) => format!("its phases look like {unit}: multiply them by {unit_rad:.5}"),
            None => "take stroke_pi out: the table says it".into(),
        };
        path.fault(&found, &expected, advice);
    }
    let TableRange::Signed(range_rad) = range else { return };
    let (expected, other) = match sign {
        Some(PhaseSign::Positive) if range_rad < 0.0 => ("a rising table, as phase_sign is \"positive\"", "negative"),
        Some(PhaseSign::Negative) if range_rad > 0.0 => ("a falling table, as phase_sign is \"negative\"", "positive"),
        _ => return,
    };
    let advice = format!("write phase_sign = \"{other}\", or turn the table round");
    path.fault(found, expected, advice);
}

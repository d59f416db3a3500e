//! `[tracker]`.

use super::figures::milliseconds;
use crate::PupilDiameter;
use crate::rig::reader::Span;
use crate::rig::{Eye, Rig, Tracker};
use crate::toml_reader::{Fault, Section};

pub(in crate::rig) const SCALE: Span =
    Span::new(1e-4, 100.0, "mm per unit").slips(&[("metres", 1e3), ("micrometres", 1e-3)]);
const FALLBACK: Span = Span::new(1.0, 9.0, "mm").slips(&[("metres", 1e3), ("micrometres", 1e-3)]);
/// A sample is judged with its successors, so that none is known sooner.
const HOLD: Span = Span::new(150.0, 60_000.0, "ms").slips(&[("seconds", 1e3)]);

pub(super) fn read_tracker(
    tracker: &Section<'_>,
    read_spec: &dyn Fn(&str) -> Result<String, Vec<Fault>>,
) -> Option<Tracker> {
    let default = Rig::default().tracker;
    let spec = tracker.text("spec", "a tracker spec, as on the command line").and_then(|spec| {
        let read = read_spec(spec.value);
        read.map_err(|faults| {
            for fault in faults {
                spec.fault(&fault.found, &fault.expected, fault.advice);
            }
        })
        .ok()
    });
    let eye = tracker.choice("eye", &Eye::NAMES, false);
    let scale = tracker.number("scale_mm_per_unit", SCALE);
    let fallback_mm = tracker.number("fallback_mm", FALLBACK);
    let hold_ms = tracker.number("hold_ms", HOLD);
    Some(Tracker {
        spec,
        eye: eye.map_or(default.eye, |eye| eye.value),
        scale: scale.map(|scale| scale.value),
        fallback: fallback_mm.map_or(default.fallback, |mm| PupilDiameter::from_mm(mm.value as f32)),
        hold: hold_ms.map_or(default.hold, |ms| milliseconds(ms.value)),
    })
}

//! The engine and the optics against the vectors that the trainer wrote (model/golden/README.md).

use std::collections::BTreeSet;
use std::path::Path;

use holod_calibration::{Colour, Dioptres, DisplayGeometry, Metres, PupilDiameter, Resolution};
use num_complex::{Complex32, Complex64};
use safetensors::SafeTensors;

use super::{CpuEngine, FocalStackEngine, Precision, reference};
use crate::files::BenchOptics;
use crate::optics::{DoublePhase, Eye, Propagator, SimulatedEye};
use crate::scene::FocalStack;
use crate::worst::worst;
use crate::{ComplexHologram, PhasePattern, RgbdFrame, Weights};

/// Largest difference allowed between a stage of the double-precision reference and its golden map, relative to the
/// map's largest value: both are exact but for the rounding of the stored F32.
const REFERENCE_TOLERANCE: f64 = 1e-5;
/// The same for what single precision computed through all the layers.
const ENGINE_TOLERANCE: f64 = 5e-5;
/// Largest difference of a phase, radians, where the amplitude is not near 0 or the constant, where acos and arg are
/// steep.
const PHASE_TOLERANCE_RAD: f64 = 2e-3;

struct Golden {
    bytes: Vec<u8>,
    folder: std::path::PathBuf,
}

impl Golden {
    fn open(name: &str) -> Self {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("golden");
        Self { bytes: std::fs::read(folder.join(name)).unwrap(), folder }
    }

    fn values(&self, name: &str) -> Option<Vec<f64>> {
        let tensors = SafeTensors::deserialize(&self.bytes).unwrap();
        let tensor = tensors.tensor(name).ok()?;
        Some(tensor.data().as_chunks().0.iter().map(|&bytes| f64::from(f32::from_le_bytes(bytes))).collect())
    }

    /// Real parts, then imaginary parts.
    fn complex(&self, name: &str) -> Option<Vec<Complex64>> {
        let values = self.values(name)?;
        let (real, imaginary) = values.split_at(values.len() / 2);
        Some(real.iter().zip(imaginary).map(|(&re, &im)| Complex64::new(re, im)).collect())
    }

    /// The tensors that a network's own stages must reproduce.
    fn stages(&self) -> BTreeSet<String> {
        let tensors = SafeTensors::deserialize(&self.bytes).unwrap();
        let own = |name: &&str| {
            let stage = name.rsplit('.').next().unwrap_or_default();
            ["encoded", "layer_", "offsets_", "carried"].iter().any(|kind| stage.starts_with(kind))
        };
        tensors.names().into_iter().filter(own).map(Into::into).collect()
    }

    fn metadata(&self, key: &str) -> String {
        let (_, header) = SafeTensors::read_metadata(&self.bytes).unwrap();
        header.metadata().as_ref().unwrap()[key].clone()
    }

    fn weights(&self) -> Weights {
        let name: String = serde_json::from_str(&self.metadata("weights")).unwrap();
        let beside = self.folder.join(&name);
        let path = if beside.exists() { beside } else { self.folder.join("../weights").join(name) };
        Weights::load(&path).unwrap()
    }

    /// The bench that the vectors are for.
    fn bench(&self, resolution: Resolution) -> DisplayGeometry {
        serde_json::from_str::<BenchOptics>(&self.metadata("optics")).unwrap().geometry(resolution)
    }

    fn frame(&self) -> RgbdFrame {
        let tensors = SafeTensors::deserialize(&self.bytes).unwrap();
        let shape = tensors.tensor("depth").unwrap().shape().to_vec();
        let single = |name| self.values(name).unwrap().into_iter().map(|value| value as f32).collect();
        RgbdFrame {
            resolution: Resolution { width: shape[1], height: shape[0] },
            amplitude: single("amplitude"),
            depth_normalised: single("depth"),
        }
    }

    fn focal_stack(&self) -> FocalStack {
        let RgbdFrame { resolution, amplitude, .. } = self.frame();
        let bench = self.bench(resolution);
        FocalStack {
            resolution,
            amplitude,
            focuses: FocalStackEngine::focuses(&self.weights(), &bench).unwrap(),
            pupil: self.pupil(),
        }
    }

    fn pupil(&self) -> PupilDiameter {
        PupilDiameter::from_mm(self.values("pupil_mm").unwrap()[0] as f32)
    }
}

fn widen(values: &[Complex32]) -> Vec<Complex64> {
    values.iter().map(|value| Complex64::new(value.re.into(), value.im.into())).collect()
}

/// Largest difference relative to the golden's largest value; infinite where anything is NaN.
fn error(actual: &[Complex64], golden: &[Complex64]) -> f64 {
    assert_eq!(actual.len(), golden.len());
    let largest = golden.iter().map(|value| value.norm()).fold(0.0, f64::max);
    worst(actual.iter().zip(golden).map(|(a, g)| (a - g).norm() / largest))
}

/// Asserts that `actual` is `golden` within `tolerance`, and that one wrong value would have been seen.
fn assert_matches(what: &str, actual: &[Complex64], golden: &[Complex64], tolerance: f64) {
    let found = error(actual, golden);
    assert!(found <= tolerance, "{what}: {found}");
    let mut spoiled = golden.to_vec();
    let largest = spoiled.iter().map(|value| value.norm()).fold(0.0, f64::max);
    spoiled[golden.len() / 3] += 3.0 * tolerance * largest;
    assert!(error(actual, &spoiled) > tolerance, "{what}: the comparison is blind");
}

fn real(values: &[f64]) -> Vec<Complex64> {
    values.iter().map(|&value| Complex64::new(value, 0.0)).collect()
}

fn check(name: &str) {
    let golden = Golden::open(name);
    let (weights, frame, pupil) = (golden.weights(), golden.frame(), golden.pupil());
    let bench = golden.bench(frame.resolution);
    let field = golden.complex("field").unwrap();
    check_stages(name, &golden, &reference::run(&weights, &bench, &frame, pupil));

    let mut engine = CpuEngine::new(&weights, &bench, frame.resolution, Precision::Single).unwrap();
    let mut hologram = ComplexHologram::dark(frame.resolution);
    engine.render(&frame, pupil, &mut hologram).unwrap();
    assert_matches(&format!("{name} engine"), &widen(&hologram.field), &field, ENGINE_TOLERANCE);
    #[cfg(feature = "gpu")]
    {
        let on_gpu = super::gpu::tests::hologram_of(&weights, &bench, &frame, pupil);
        assert_matches(&format!("{name} engine on the GPU"), &widen(&on_gpu.field), &field, ENGINE_TOLERANCE);
    }
    check_optics(name, &golden);
}

fn check_focal_stack(name: &str) {
    let golden = Golden::open(name);
    let (weights, stack) = (golden.weights(), golden.focal_stack());
    let bench = golden.bench(stack.resolution);
    check_stages(name, &golden, &reference::run_focal_stack(&weights, &bench, &stack));
    let mut engine = FocalStackEngine::new(&weights, &bench, stack.resolution, Precision::Single).unwrap();
    let mut hologram = ComplexHologram::dark(stack.resolution);
    engine.render(&stack, &mut hologram).unwrap();
    let field = golden.complex("field").unwrap();
    assert_matches(&format!("{name} engine"), &widen(&hologram.field), &field, ENGINE_TOLERANCE);
    check_optics(name, &golden);
}

/// Compares each stage of the reference, and its field.
fn check_stages(name: &str, golden: &Golden, trace: &reference::Trace) {
    let mut unused = golden.stages();
    let mut stage = |what: &str, actual: &[Complex64], expected: Option<Vec<Complex64>>| {
        if let Some(expected) = expected {
            assert_matches(&format!("{name} {what}"), actual, &expected, REFERENCE_TOLERANCE);
            unused.remove(what);
        }
    };
    let map = |what: &str| golden.values(what).map(|values| real(&values));
    for reference::Stage { name: what, value } in &trace.stages {
        match value {
            reference::Value::Encoded(encoded) => stage(what, &real(&encoded.values), map(what)),
            reference::Value::Light(light) => stage(what, light, golden.complex(what)),
            reference::Value::Layer(layer, offsets) => {
                stage(what, &real(&layer.values), map(what));
                if let Some(offsets) = offsets {
                    let what = what.replace("layer_", "offsets_");
                    stage(&what, &real(&offsets.values), map(&what));
                }
            }
        }
    }
    assert_eq!(unused, BTreeSet::new(), "{name}: golden stages that nothing was compared with");
    let field = golden.complex("field").unwrap();
    assert_matches(&format!("{name} field"), &trace.field, &field, REFERENCE_TOLERANCE);
}

/// Compares what double phase, propagation and the simulated eye make of the golden field.
fn check_optics(name: &str, golden: &Golden) {
    let (weights, pupil, field) = (golden.weights(), golden.pupil(), golden.complex("field").unwrap());
    let resolution = golden.frame().resolution;
    let bench = golden.bench(resolution);
    let golden_hologram = ComplexHologram {
        resolution,
        field: field.iter().map(|value| Complex32::new(value.re as f32, value.im as f32)).collect(),
    };
    check_phase(name, golden, &golden_hologram, weights.config().amplitude_constant);

    let distance_m: f64 = golden.metadata("asm_distance_m").parse().unwrap();
    for (what, mut propagator) in [
        ("asm_padded", Propagator::new(&bench, resolution)),
        ("asm_circular", Propagator::repeating(&bench, resolution)),
    ] {
        let mut propagated = golden_hologram.clone();
        for colour in Colour::ALL {
            propagator.propagate(propagated.plane_mut(colour), colour, Metres(distance_m));
        }
        let expected = golden.complex(what).unwrap();
        assert_matches(&format!("{name} {what}"), &widen(&propagated.field), &expected, ENGINE_TOLERANCE);
    }

    let focus_dpt: Vec<f64> = serde_json::from_str(&golden.metadata("focus_dpt")).unwrap();
    let eyes = focus_dpt.into_iter().map(|focus_dpt| Eye { pupil, focus: Dioptres(focus_dpt) });
    let phases = golden.values("phase").unwrap().into_iter().map(|phase| phase as f32).collect();
    let pattern = PhasePattern { resolution, phase_rad: phases };
    let constant = weights.config().amplitude_constant;
    let mut simulated = SimulatedEye::repeating(&bench, resolution);
    for (planes_before, eye) in eyes.enumerate() {
        let (field, panel) = (simulated.view_field(&golden_hologram, eye), simulated.view(&pattern, constant, eye));
        for (what, seen) in [("eye_field", field), ("eye_panel", panel)] {
            let expected = golden.values(what).unwrap();
            let plane = &expected[planes_before * seen.pixels.len()..][..seen.pixels.len()];
            let seen: Vec<f64> = seen.pixels.iter().map(|&light| light.into()).collect();
            assert_matches(&format!("{name} {what}"), &real(&seen), &real(plane), ENGINE_TOLERANCE);
        }
    }
}

fn check_phase(name: &str, golden: &Golden, hologram: &ComplexHologram, amplitude_constant: f32) {
    let mut pattern = PhasePattern::flat(hologram.resolution);
    let report = DoublePhase::new(hologram.resolution, amplitude_constant).encode(hologram, &mut pattern);
    let clipped_share = report.clipped_share.0.into_iter().map(f64::from).sum::<f64>() / 3.0;
    assert!((clipped_share - golden.values("clipped_share").unwrap()[0]).abs() < 1e-3);
    let mut expected = golden.values("phase").unwrap();
    let amplitudes: Vec<f32> = hologram.field.iter().map(|value| value.norm() / amplitude_constant).collect();
    let largest_error = |expected: &[f64]| {
        let judged = amplitudes.iter().zip(&pattern.phase_rad).zip(expected).filter(|((a, _), _)| **a < 0.99);
        worst(judged.map(|((_, &phase), &golden)| (Complex64::cis(phase.into()) - Complex64::cis(golden)).norm()))
    };
    assert!(largest_error(&expected) < PHASE_TOLERANCE_RAD, "{name} phase: {}", largest_error(&expected));
    let judged = amplitudes.iter().position(|a| (0.1..0.9).contains(a)).unwrap();
    expected[judged] += 0.01;
    assert!(largest_error(&expected) > PHASE_TOLERANCE_RAD, "{name} phase: the comparison is blind");
}

#[test]
fn a_narrow_half_band_network_matches_its_golden_vectors() {
    check("direct-narrow.safetensors");
}

#[test]
fn a_narrow_network_on_the_full_grid_matches_its_golden_vectors() {
    check("direct-narrow-full.safetensors");
}

#[test]
fn a_narrow_expected_stack_network_matches_its_golden_vectors() {
    check("expected-stack-narrow.safetensors");
}

#[test]
fn a_narrow_network_that_refines_its_stack_matches_its_golden_vectors() {
    check("expected-stack-narrow-refined.safetensors");
}

#[test]
fn a_narrow_focal_stack_network_matches_its_golden_vectors() {
    check_focal_stack("focal-stack-narrow.safetensors");
}

#[test]
fn the_built_in_network_matches_its_golden_vectors() {
    check("expected-stack-shipped.safetensors");
}

#[test]
fn the_small_built_in_network_matches_its_golden_vectors() {
    check("expected-stack-shipped-small.safetensors");
}

#[test]
fn the_fast_built_in_network_matches_its_golden_vectors() {
    check("expected-stack-shipped-fast.safetensors");
}

//! A running frame loop must not allocate: counts every allocation of the process while frames are rendered.

use std::path::Path;

use holod_calibration::{DisplayGeometry, PupilDiameter, Resolution};
use holod_model::engine::Precision;
use holod_model::optics::DoublePhase;
use holod_model::{ComplexHologram, CpuEngine, PhasePattern, RgbdFrame, Weights, WorkerPool};
use holod_tests::counting::{self, Counting};

#[global_allocator]
static COUNTING: Counting = Counting;

#[test]
fn frames_do_not_allocate() {
    let golden = concat!(env!("CARGO_MANIFEST_DIR"), "/golden/");
    for name in ["direct-narrow", "expected-stack-narrow", "expected-stack-narrow-refined"] {
        check(&Weights::load(&Path::new(golden).join(format!("{name}.weights.safetensors"))).unwrap());
    }
    check(&Weights::builtin());
    check(&Weights::builtin_small());
}

fn check(weights: &Weights) {
    check_at(weights, Resolution { width: 10, height: 7 });
    // Lines of 17 samples, which no radix divides, and of 30, which take two passes.
    check_at(weights, Resolution { width: 34, height: 60 });
}

fn check_at(weights: &Weights, resolution: Resolution) {
    for precision in [Precision::Single, Precision::Half] {
        check_in(precision, weights, resolution);
    }
}

fn check_in(precision: Precision, weights: &Weights, resolution: Resolution) {
    let engine = CpuEngine::new(weights, &DisplayGeometry::DEFAULT, resolution, precision).unwrap();
    let double_phase = DoublePhase::new(resolution, weights.config().amplitude_constant);
    let frame = RgbdFrame {
        resolution,
        amplitude: vec![0.5; 3 * resolution.pixels()],
        depth_normalised: (0..resolution.pixels()).map(|index| index as f32 / resolution.pixels() as f32).collect(),
    };
    let buffers = (ComplexHologram::dark(resolution), PhasePattern::flat(resolution));
    let job = (engine, double_phase, buffers, PupilDiameter::from_mm(3.0));
    let mut pool = WorkerPool::new("test", 2, job, move |(engine, double_phase, (hologram, pattern), pupil)| {
        engine.render(&frame, *pupil, hologram).unwrap();
        double_phase.encode(hologram, pattern);
    })
    .unwrap();
    let mut frames = |count: usize| {
        for index in 0..count {
            // The pupil changes with every frame, so the modulation is computed anew.
            let pupil = PupilDiameter::from_mm(2.0 + index as f32 / count as f32);
            pool.with(|job| job.3 = pupil);
            pool.run();
        }
    };
    // As many as are judged: each worker has waited for work by then, which takes memory the first time.
    frames(130);
    let before = counting::everywhere();
    frames(130);
    assert_eq!(counting::everywhere() - before, 0);

    drop(std::hint::black_box(Box::new(1)));
    assert!(counting::everywhere() > before, "the counter counts");
}

//! What weights reached when they were judged on several benches.

use holod_calibration::{DisplayGeometry, PupilDiameter};
use serde::Deserialize;

/// What weights reached on a bench that they were judged on.
#[derive(Clone, Debug, PartialEq)]
pub struct JudgedBench {
    /// The bench's name in the evaluation.
    pub name: String,
    /// What was reached there for the pupil whose blur is most like the one that was asked for.
    pub judged: Judged,
}

/// Means over held-out scenes, after double phase and rounding to levels.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
pub struct Judged {
    /// Blur over the depth range for the pupil at which this was judged.
    pub volume_blur_px: f64,
    /// Over all focuses and pixels.
    pub psnr_db: f64,
    /// Where the circle of confusion is less than 2 px.
    pub psnr_in_focus_db: f64,
    /// 1 for the full refocus of the true images, 0 for one picture at every focus.
    pub slope: f64,
    /// PSNR over that of a hologram of smooth phase.
    pub over_smooth_phase_db: f64,
}

impl JudgedBench {
    /// Of the benches in a file's metrics the one that is most like `bench` in its diffraction, at the blur that is
    /// most like that of `pupil` on `bench`.
    pub(super) fn nearest(metrics: &serde_json::Value, bench: &DisplayGeometry, pupil: PupilDiameter) -> Option<Self> {
        let apart = |found: f64, wanted: f64| (found / wanted).ln().abs();
        let mean = |fresnel_px2: &[f64; 3]| fresnel_px2.iter().sum::<f64>() / 3.0;
        let (fresnel_px2, blur_px) = (mean(&bench.volume_fresnel_px2().0), bench.largest_coc_px(pupil));
        let benches: Vec<BenchMetrics> = serde_json::from_value(metrics.get("benches")?.clone()).ok()?;
        let distance = |of: &BenchMetrics| apart(mean(&of.volume_fresnel_px2), fresnel_px2);
        let nearest = benches.into_iter().min_by(|a, b| distance(a).total_cmp(&distance(b)))?;
        let distance = |of: &Judged| apart(of.volume_blur_px, blur_px);
        let judged = nearest.rows.into_iter().min_by(|a, b| distance(a).total_cmp(&distance(b)))?;
        Some(Self { name: nearest.bench, judged })
    }
}

#[derive(Deserialize)]
struct BenchMetrics {
    bench: String,
    volume_fresnel_px2: [f64; 3],
    rows: Vec<Judged>,
}

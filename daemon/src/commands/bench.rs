//! `holod bench`: medians per stage, beside the arithmetic peak of the machine's cores measured in the same run.

use std::time::{Duration, Instant};

use holod_calibration::{Colour, PerColour, PupilDiameter, Resolution};
use holod_model::ComplexHologram;
use holod_model::engine::fma_peak;
use holod_model::optics::{DoublePhase, PhasePattern};
use holod_slm_output::fields::FrameLayout;
use holod_slm_output::{LevelsFrame, PanelEncoder};
use serde::Serialize;

use crate::cli::BenchArgs;
use crate::failure::{Exit, Failure};
use crate::{report, setup};

#[derive(Serialize)]
struct Report {
    resolution: String,
    threads: usize,
    peak_gflop_per_s: f64,
    stages: Vec<Stage>,
    frame_ms: f64,
    network_gflop: f64,
    network_share_of_peak: f64,
}

#[derive(Serialize)]
struct Stage {
    name: String,
    median_ms: f64,
    gflop: f64,
    share_of_peak: Option<f64>,
}

pub(super) fn bench(args: &BenchArgs) -> Result<(), Failure> {
    let rig = setup::rig_with_network(&args.rig, &args.network)?;
    let weights = setup::weights(&rig)?;
    let resolution = args.resolution;
    if resolution.width > rig.resolution().width || resolution.height > rig.resolution().height {
        return Err(Failure::new(
            Exit::Usage,
            format!("--resolution: found {resolution}, expected at most the panel's {}", rig.resolution()),
        ));
    }
    let mut engine = setup::engine(args.backend, &weights, resolution)?;
    let frame = setup::sample_frame(resolution);
    let mut hologram = ComplexHologram::dark(resolution);
    let mut pattern = PhasePattern::flat(resolution);
    let mut double_phase = DoublePhase::new(resolution, weights.config().amplitude_constant);
    let encoder =
        PanelEncoder::new(&rig.panel, rig.resolution(), resolution).map_err(Failure::because(Exit::Config))?;
    let mut levels = LevelsFrame::new(FrameLayout::new(&rig.panel, rig.resolution()));
    let threads = std::thread::available_parallelism().map_or(1, usize::from);

    let pupil = PupilDiameter::from_mm(3.0);
    let mut laps: Vec<Vec<(String, Duration, u64)>> = Vec::new();
    let (mut frames, mut peaks) = (Vec::new(), Vec::new());
    // The first lap warms caches and is thrown away.
    for _ in 0..=args.repeat {
        peaks.push(fma_peak(threads));
        let began = Instant::now();
        engine.render(&frame, pupil, &mut hologram).map_err(Failure::because(Exit::Software))?;
        let mut lap: Vec<(String, Duration, u64)> =
            engine.last_timings().stages.iter().map(|s| (s.name.clone(), s.duration, s.flop)).collect();
        let rendered = Instant::now();
        double_phase.encode(&hologram, &mut pattern);
        let encoded = Instant::now();
        encoder.encode(PerColour(Colour::ALL.map(|colour| pattern.plane(colour))), &mut levels);
        let done = Instant::now();
        lap.push(("double phase".into(), encoded - rendered, 0));
        lap.push(("panel levels".into(), done - encoded, 0));
        laps.push(lap);
        frames.push(done - began);
        peaks.push(fma_peak(threads));
    }
    let report = summarise(resolution, threads, &laps[1..], &frames[1..], greatest(&peaks) / 1e9);
    if args.json { report::print_json(&report) } else { report::print(&table(&report)) }
}

fn summarise(
    resolution: Resolution,
    threads: usize,
    laps: &[Vec<(String, Duration, u64)>],
    frames: &[Duration],
    peak_gflop_per_s: f64,
) -> Report {
    let stages: Vec<Stage> = laps[0]
        .iter()
        .enumerate()
        .map(|(index, (name, _, flop))| {
            let median_ms = median(laps.iter().map(|lap| lap[index].1.as_secs_f64() * 1e3));
            let gflop = *flop as f64 / 1e9;
            let share_of_peak = (*flop > 0).then(|| gflop / (median_ms / 1e3) / peak_gflop_per_s);
            Stage { name: name.clone(), median_ms, gflop, share_of_peak }
        })
        .collect();
    let layers = || stages.iter().filter(|stage| stage.gflop > 0.0);
    let network_gflop: f64 = layers().map(|stage| stage.gflop).sum();
    let layers_s: f64 = layers().map(|stage| stage.median_ms / 1e3).sum();
    Report {
        resolution: resolution.to_string(),
        threads,
        peak_gflop_per_s,
        frame_ms: median(frames.iter().map(|frame| frame.as_secs_f64() * 1e3)),
        network_gflop,
        network_share_of_peak: network_gflop / layers_s / peak_gflop_per_s,
        stages,
    }
}

/// The peak is what the cores can do: the best lap, since whatever else runs only takes from it.
fn greatest(peaks: &[f64]) -> f64 {
    peaks.iter().copied().fold(0.0, f64::max)
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut sorted: Vec<f64> = values.collect();
    sorted.sort_by(f64::total_cmp);
    sorted[sorted.len() / 2]
}

fn table(report: &Report) -> String {
    let mut text = format!(
        "{} on {} threads; fused multiply-add peak of these threads, same run: {:.0} GFLOP/s\n\n{:<24}{:>12}{:>12}{:>12}\n",
        report.resolution, report.threads, report.peak_gflop_per_s, "stage", "median ms", "GFLOP", "of peak"
    );
    for stage in &report.stages {
        let share = stage.share_of_peak.map_or(String::new(), |share| format!("{:.0} %", share * 100.0));
        let gflop = if stage.gflop > 0.0 { format!("{:.3}", stage.gflop) } else { String::new() };
        text.push_str(&format!("{:<24}{:>12.2}{gflop:>12}{share:>12}\n", stage.name, stage.median_ms));
    }
    text.push_str(&format!(
        "{:<24}{:>12.2}{:>12.3}{:>12}",
        "whole frame",
        report.frame_ms,
        report.network_gflop,
        format!("{:.0} %", report.network_share_of_peak * 100.0)
    ));
    text
}

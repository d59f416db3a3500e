//! `holod bench`: medians per stage, beside the arithmetic peak of the machine's cores measured in the same run.

use std::sync::Arc;
use std::time::{Duration, Instant};

use holod_calibration::{PupilDiameter, Resolution};
use holod_model::engine::{StageTiming, fma_peak};
use holod_slm_output::LevelsFrame;
use serde::Serialize;

use crate::cli::BenchArgs;
use crate::failure::{Exit, Failure};
use crate::{renderer, report, setup};

#[derive(Serialize)]
struct Report {
    resolution: String,
    renderer: String,
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
    /// Of operations as the definition has them.
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
    let encoder = renderer::panel_encoder(&rig, resolution)?;
    let mut renderer = renderer::open(args.backend, &weights, &encoder)?;
    let frame = Arc::new(setup::sample_frame(resolution));
    let mut levels = LevelsFrame::new(encoder.layout());
    let threads = std::thread::available_parallelism().map_or(1, usize::from);

    let pupil = PupilDiameter::from_mm(3.0);
    let mut laps: Vec<Vec<StageTiming>> = Vec::new();
    let (mut frames, mut peaks) = (Vec::new(), Vec::new());
    // The first lap warms caches and is thrown away.
    for _ in 0..=args.repeat {
        peaks.push(fma_peak(threads));
        let began = Instant::now();
        renderer.render(&frame, pupil, &mut levels).map_err(Failure::because(Exit::Software))?;
        frames.push(began.elapsed());
        laps.push(renderer.timings().to_vec());
        peaks.push(fma_peak(threads));
    }
    let report =
        summarise(resolution, renderer.description(), threads, &laps[1..], &frames[1..], greatest(&peaks) / 1e9);
    if args.json { report::print_json(&report) } else { report::print(&table(&report)) }
}

fn summarise(
    resolution: Resolution,
    renderer: &str,
    threads: usize,
    laps: &[Vec<StageTiming>],
    frames: &[Duration],
    peak_gflop_per_s: f64,
) -> Report {
    let stages: Vec<Stage> = laps[0]
        .iter()
        .enumerate()
        .map(|(index, StageTiming { name, flop, .. })| {
            let median_ms = median(laps.iter().map(|lap| lap[index].duration.as_secs_f64() * 1e3));
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
        renderer: renderer.to_owned(),
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
        "{} by {}; fused multiply-add peak of {} threads, same run: {:.0} GFLOP/s\n\n{:<24}{:>12}{:>12}{:>12}\n",
        report.resolution,
        report.renderer,
        report.threads,
        report.peak_gflop_per_s,
        "stage",
        "median ms",
        "GFLOP",
        "direct/peak"
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
    text.push_str(
        "\n\ndirect/peak: operations as the definition has them over time, beside the peak; a plain layer does a quarter of \
         them (Winograd), so it may exceed 100 %",
    );
    text
}

//! `holod bench`: how long each stage and the frame take, beside the machine's ceilings measured in the same run, and
//! how long the loop takes from tracker sample to photons.

use std::fmt::Write;
use std::sync::Arc;
use std::time::{Duration, Instant};

use holod_calibration::rig::{LaserDriver, Lasers, Model, Rig};
use holod_calibration::{Metres, PupilDiameter, Resolution, Sorted};
use holod_model::engine::{StageTiming, fma_peak, stream_bandwidth};
use holod_model::{RgbdFrame, Weights};
use holod_pupil_input::{Scenario, TrackerSpec};
use holod_slm_output::present::ReportFaults;
use holod_slm_output::{LevelsFrame, OutputSpec};
use serde::Serialize;

use crate::cli::{BenchArgs, SceneArgs};
use crate::failure::{Exit, Failure};
use crate::session::{self, Observer, SessionPlan, Summary};
use crate::snapshot::Figures;
use crate::source::feed::cost::{self, FeedCost};
use crate::source::{Pictures, scene};
use crate::spread::Spread;
use crate::{progress, renderer, results, run_text, setup};

/// How often the memory's bandwidth is measured before the frames, and again after them: between them, it would empty
/// the caches.
const STREAMS: usize = 3;

#[derive(Serialize)]
struct Report {
    resolution: String,
    weights: String,
    renderer: String,
    frames: u32,
    /// Where the processor computes.
    ceilings: Option<Ceilings>,
    stages: Vec<Measured>,
    /// The stages together that are of matrix-like work, where there are any.
    layers: Option<Measured>,
    frame: Measured,
    /// Where the loop was run.
    closed_loop: Option<ClosedLoop>,
}

/// What the machine can do at most, on as many threads as compute frames.
#[derive(Clone, Copy, Serialize)]
struct Ceilings {
    threads: usize,
    /// Fused multiply-adds, 10⁹ operations a second.
    gflop_per_s: f64,
    /// Read and written memory beyond the caches, 10⁹ bytes a second.
    gb_per_s: f64,
}

/// A part of the frame, or all of it.
#[derive(Serialize)]
struct Measured {
    name: String,
    #[serde(flatten)]
    time: Quartiles,
    /// Of operations and bytes as the definition has them; nothing where they are not known.
    gflop: Option<f64>,
    mb: Option<f64>,
    share_of_arithmetic_peak: Option<f64>,
    share_of_bandwidth: Option<f64>,
}

#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
struct Quartiles {
    lower_quartile_ms: f64,
    median_ms: f64,
    upper_quartile_ms: f64,
}

/// A run of the loop with a simulated eye and a virtual panel.
#[derive(Serialize)]
struct ClosedLoop {
    duration_s: f64,
    frames_shown: u64,
    frames_shown_hz: f64,
    panel_frames_hz: f64,
    /// From waking to the submitted levels.
    frame_time: Option<Spread>,
    /// From the newest believed tracker sample behind a frame to the middle of its first light.
    sample_to_photon: Option<Spread>,
}

struct Laps {
    renderer: String,
    ceilings: Option<Ceilings>,
    frames: Vec<Lap>,
}

struct Lap {
    frame: Duration,
    stages: Vec<StageTiming>,
}

/// What a picture of the live feed costs.
#[derive(Serialize)]
struct FeedReport {
    resolution: String,
    picture_mb: f64,
    pictures: usize,
    /// Programs that ran or waited to run, mean over the minute before; to be compared with `cores`.
    load: Option<f64>,
    cores: usize,
    memcpy: Quartiles,
    take: Quartiles,
    make: Quartiles,
    /// The ratio of the two medians.
    take_of_memcpy: f64,
    make_of_memcpy: f64,
}

pub(super) fn bench(args: &BenchArgs) -> Result<(), Failure> {
    if let Some(resolution) = args.feed {
        let load = load();
        let measure = || cost::measure(resolution, args.repeat).map_err(Failure::because(Exit::Unavailable));
        let report = FeedReport::new(resolution, &progress::during("timing pictures", measure)?, load);
        return if args.json { results::print_json(&report) } else { results::print(&report.text()) };
    }
    let rig = setup::rig_with_network(&args.rig, &args.network)?;
    let weights = setup::weights(&rig)?;
    let named = SceneArgs { resolution: args.resolution, ..SceneArgs::default() };
    let frames = scene::frames(&named, &rig.geometry)?;
    let laps = progress::during("timing frames", || Laps::run(args, &rig, &weights, &frames.frames[0]))?;
    let mut report = laps.report(frames.resolution().to_string(), setup::weights_name(&rig.model.weights));
    if !args.duration.is_zero() {
        report.closed_loop = Some(closed_loop(args, rig, weights, frames)?);
    }
    if args.json { results::print_json(&report) } else { results::print(&table(&report)) }
}

/// The load of the last minute, where the kernel tells it.
fn load() -> Option<f64> {
    std::fs::read_to_string("/proc/loadavg").ok()?.split_whitespace().next()?.parse().ok()
}

impl FeedReport {
    fn new(resolution: Resolution, cost: &FeedCost, load: Option<f64>) -> Self {
        let quartiles = |times: &[Duration]| Quartiles::of(times.iter().map(|time| time.as_secs_f64() * 1e3));
        let [memcpy, take, make] = [&cost.memcpy, &cost.take, &cost.make].map(|times| quartiles(times));
        Self {
            resolution: resolution.to_string(),
            picture_mb: cost.picture_bytes as f64 / 1e6,
            pictures: cost.take.len(),
            load,
            cores: std::thread::available_parallelism().map_or(1, usize::from),
            memcpy,
            take,
            make,
            take_of_memcpy: take.median_ms / memcpy.median_ms,
            make_of_memcpy: make.median_ms / memcpy.median_ms,
        }
    }

    fn text(&self) -> String {
        let Self { resolution, picture_mb, pictures, cores, .. } = self;
        let mut text = format!(
            "{resolution}, RGBA8 and 16-bit millimetres, {picture_mb:.1} MB; {pictures} pictures, on one of {cores} cores\n\n\
             {:<44}{:>10}{:>22}{:>11}\n",
            "", "median ms", "quartiles", "of memcpy"
        );
        for (name, time, ratio) in [
            ("memcpy: its bytes from memory to memory", self.memcpy, 1.0),
            ("take: copied, while its client waits", self.take, self.take_of_memcpy),
            ("make: a frame of it, after that", self.make, self.make_of_memcpy),
        ] {
            let Quartiles { lower_quartile_ms, median_ms, upper_quartile_ms } = time;
            let quartiles = format!("{lower_quartile_ms:.2} to {upper_quartile_ms:.2}");
            writeln!(text, "{name:<44}{median_ms:>10.2}{quartiles:>22}{ratio:>11.2}").expect(GROWS);
        }
        match self.load {
            Some(load) if load >= 1.0 => write!(
                text,
                "\nother programs were running (load {load:.1} in the minute before): the figures may be too high, and their \
                 ratios wrong"
            ),
            Some(load) => write!(text, "\nload in the minute before: {load:.1}"),
            None => write!(text, "\nthe load in the minute before is not known"),
        }
        .expect(GROWS);
        text
    }
}

impl Laps {
    fn run(args: &BenchArgs, rig: &Rig, weights: &Weights, frame: &Arc<RgbdFrame>) -> Result<Self, Failure> {
        let encoder = renderer::panel_encoder(rig, frame.resolution)?;
        let mut renderer = renderer::open(args.backend, weights, rig, &encoder, &renderer::Use::Command)?;
        let threads = renderer.cpu_threads();
        let mut levels = LevelsFrame::new(encoder.layout());
        let pupil = PupilDiameter::from_mm(3.0);

        let (mut peaks, mut bandwidths, mut frames) = (Vec::new(), Vec::new(), Vec::new());
        let mut stream = || bandwidths.extend(threads.map(stream_bandwidth));
        (0..STREAMS).for_each(|_| stream());
        // The first lap warms caches and is thrown away.
        for _ in 0..=args.repeat {
            peaks.extend(threads.map(fma_peak));
            let began = Instant::now();
            let rendered = renderer.render(frame, pupil, &mut levels).map_err(Failure::because(Exit::Unavailable))?;
            frames.push(Lap { frame: began.elapsed(), stages: renderer.timings().to_vec() });
            if rendered.engine_changed {
                return Err(renderer::failed_while_timed(&*renderer));
            }
            peaks.extend(threads.map(fma_peak));
        }
        (0..STREAMS).for_each(|_| stream());
        frames.remove(0);
        let ceilings = threads.map(|threads| Ceilings {
            threads,
            gflop_per_s: greatest(&peaks) / 1e9,
            gb_per_s: greatest(&bandwidths) / 1e9,
        });
        Ok(Self { renderer: renderer.description().to_owned(), ceilings, frames })
    }

    fn report(self, resolution: String, weights: String) -> Report {
        let Self { renderer, ceilings, frames } = self;
        // A part's time in each lap, and what it does there.
        let measured = |name: &str, of: &dyn Fn(&Lap) -> Duration, is_part: &dyn Fn(&StageTiming) -> bool| {
            let parts = || frames[0].stages.iter().filter(|stage| is_part(stage));
            let (flop, bytes) = (parts().map(|stage| stage.flop).sum(), parts().map(|stage| stage.bytes).sum());
            let time = Quartiles::of(frames.iter().map(|lap| of(lap).as_secs_f64() * 1e3));
            Measured::new(name, time, flop, bytes, ceilings)
        };
        let stage = |(index, stage): (usize, &StageTiming)| {
            measured(&stage.name, &|lap| lap.stages[index].duration, &|other| other.name == stage.name)
        };
        let is_layer = |stage: &StageTiming| stage.flop > 0;
        let in_layers = |lap: &Lap| lap.stages.iter().filter(|stage| is_layer(stage)).map(|stage| stage.duration).sum();
        Report {
            resolution,
            weights,
            renderer,
            frames: frames.len() as u32,
            ceilings,
            stages: frames[0].stages.iter().enumerate().map(stage).collect(),
            layers: frames[0].stages.iter().any(is_layer).then(|| measured("all layers", &in_layers, &is_layer)),
            frame: measured("whole frame", &|lap| lap.frame, &|_| true),
            closed_loop: None,
        }
    }
}

impl Measured {
    fn new(name: &str, time: Quartiles, flop: u64, bytes: u64, ceilings: Option<Ceilings>) -> Self {
        let known = |count: u64| (count > 0).then_some(count as f64);
        let (gflop, mb) = (known(flop).map(|flop| flop / 1e9), known(bytes).map(|bytes| bytes / 1e6));
        let seconds = time.median_ms / 1e3;
        let share = |done: Option<f64>, per_s: Option<f64>| Some(done? / seconds / per_s?);
        Self {
            name: name.to_owned(),
            time,
            gflop,
            mb,
            share_of_arithmetic_peak: share(gflop, ceilings.map(|ceilings| ceilings.gflop_per_s)),
            share_of_bandwidth: share(mb, ceilings.map(|ceilings| ceilings.gb_per_s * 1e3)),
        }
    }
}

impl Quartiles {
    /// Of at least one value.
    fn of(values_ms: impl Iterator<Item = f64>) -> Self {
        let sorted = Sorted::new(values_ms).expect("at least one value");
        let [lower_quartile_ms, median_ms, upper_quartile_ms] = [0.25, 0.5, 0.75].map(|share| sorted.quantile(share));
        Self { lower_quartile_ms, median_ms, upper_quartile_ms }
    }
}

/// A ceiling is what the machine can do: the best of several looks, since whatever else runs only takes from it.
fn greatest(looks: &[f64]) -> f64 {
    looks.iter().copied().fold(0.0, f64::max)
}

/// Runs the loop as `demo` does. Whatever the rig has is left alone: no laser is lit.
fn closed_loop(args: &BenchArgs, rig: Rig, weights: Weights, frames: scene::Frames) -> Result<ClosedLoop, Failure> {
    struct Nobody;
    impl Observer for Nobody {}

    // Each frame is to be computed.
    let model = Model { pupil_step: Some(Metres(0.0)), ..rig.model };
    let plan = SessionPlan {
        rig: Rig { lasers: Lasers { driver: LaserDriver::Simulated, ..rig.lasers }, model, ..rig },
        rig_again: None,
        hangups: None,
        weights,
        backend: args.backend,
        pictures: Pictures::Scene(Arc::new(frames)),
        output: OutputSpec::Headless(ReportFaults::NONE),
        tracker: TrackerSpec::Mock(Scenario::Sweep),
        ports_of_others: Vec::new(),
        pupil: None,
        record_tracker: None,
        record: None,
        frame_limit: None,
        duration: Some(args.duration),
        keep_levels: false,
        hash_levels: false,
    };
    let Summary { duration_s, frames_shown_hz, figures, .. } = session::run(plan, &mut Nobody)?.summary;
    let Figures { frames_shown, panel_frames_hz, frame_time, sample_to_photon, .. } = figures;
    Ok(ClosedLoop { duration_s, frames_shown, frames_shown_hz, panel_frames_hz, frame_time, sample_to_photon })
}

fn table(report: &Report) -> String {
    let Report { resolution, weights, renderer, frames, ceilings, stages, layers, frame, closed_loop } = report;
    let mut text = format!("{resolution}, {weights}, by {renderer}; {frames} frames\n");
    if let Some(Ceilings { threads, gflop_per_s, gb_per_s }) = ceilings {
        writeln!(
            text,
            "ceilings of {threads} threads, same run: {gflop_per_s:.0} GFLOP/s of fused multiply-adds, {gb_per_s:.1} GB/s \
             read and written"
        )
        .expect(GROWS);
    }
    let mut row = |cells: [&str; 7]| {
        let [name, median, quartiles, gflop, of_peak, mb, of_bandwidth] = cells;
        let line = format!("{name:<30}{median:>10}{quartiles:>22}{gflop:>10}{of_peak:>9}{mb:>9}{of_bandwidth:>9}");
        writeln!(text, "{}", line.trim_end()).expect(GROWS);
    };
    row([""; 7]);
    row(match ceilings {
        Some(_) => ["stage", "median ms", "quartiles", "GFLOP", "of peak", "MB", "of GB/s"],
        None => ["stage", "median ms", "quartiles", "GFLOP", "", "MB", ""],
    });
    for Measured { name, time, gflop, mb, share_of_arithmetic_peak, share_of_bandwidth } in
        stages.iter().chain(layers).chain([frame])
    {
        let figure = |value: &Option<f64>, digits| value.map_or(String::new(), |value| format!("{value:.digits$}"));
        let percent = |share: &Option<f64>| share.map_or(String::new(), |share| format!("{:.0} %", share * 100.0));
        row([
            name,
            &format!("{:.2}", time.median_ms),
            &format!("{:.2} to {:.2}", time.lower_quartile_ms, time.upper_quartile_ms),
            &figure(gflop, 3),
            &percent(share_of_arithmetic_peak),
            &figure(mb, 1),
            &percent(share_of_bandwidth),
        ]);
    }
    if ceilings.is_some() {
        text.push_str(
            "\nof peak: operations as the definition has them over time, beside the peak; a plain layer does a quarter of \
             them (Winograd) and half precision two at once, so it may exceed 100 %\n\
             of GB/s: the bytes that come in and go out, once each, over time, beside the bandwidth; what stays in caches \
             may exceed 100 %\n",
        );
    }
    if let Some(ClosedLoop {
        duration_s,
        frames_shown,
        frames_shown_hz,
        panel_frames_hz,
        frame_time,
        sample_to_photon,
    }) = closed_loop
    {
        write!(
            text,
            "\nclosed loop, a simulated eye and a virtual panel, {duration_s:.1} s: {frames_shown} frames shown, \
             {frames_shown_hz:.1} a second of the panel's {panel_frames_hz:.1}\n\
             time per frame {}; tracker sample to photons {}\n",
            run_text::spread_text(*frame_time),
            run_text::spread_text(*sample_to_photon)
        )
        .expect(GROWS);
    }
    text.truncate(text.trim_end().len());
    text
}

const GROWS: &str = "text grows";

#[cfg(test)]
mod tests {
    use super::*;

    fn laps(ceilings: Option<Ceilings>) -> Laps {
        let lap = |[net, other, frame]: [u64; 3]| Lap {
            frame: Duration::from_millis(frame),
            stages: vec![
                StageTiming {
                    name: "layer 0".into(),
                    duration: Duration::from_millis(net),
                    flop: 3_000_000,
                    bytes: 500_000,
                },
                StageTiming { name: "field".into(), duration: Duration::from_millis(other), flop: 0, bytes: 1_000_000 },
            ],
        };
        let frames = [[9, 40, 50], [1, 20, 30], [5, 30, 20], [3, 10, 10], [2, 50, 40]].map(lap).into();
        Laps { renderer: "cpu, avx2, 2 threads".into(), ceilings, frames }
    }

    fn report(ceilings: Option<Ceilings>) -> Report {
        laps(ceilings).report("64x48".into(), "small".into())
    }

    const CEILINGS: Ceilings = Ceilings { threads: 2, gflop_per_s: 2.0, gb_per_s: 0.5 };

    #[test]
    fn ratios_of_the_feed_are_of_medians_and_a_busy_machine_is_told() {
        let times = |ms: [u64; 3]| ms.map(Duration::from_millis).to_vec();
        let cost = FeedCost {
            picture_bytes: 12_441_600,
            memcpy: times([2, 4, 90]),
            take: times([5, 1, 6]),
            make: times([30, 20, 10]),
        };
        let resolution = Resolution { width: 1920, height: 1080 };
        let [calm, busy, unknown] =
            [Some(0.3), Some(1.0), None].map(|load| FeedReport::new(resolution, &cost, load).text());
        assert!(calm.starts_with("1920x1080, RGBA8 and 16-bit millimetres, 12.4 MB; 3 pictures"), "{calm}");
        for (row, figures) in [
            ("memcpy:", ["4.00", "3.00 to 47.00", "1.00"]),
            ("take:", ["5.00", "3.00 to 5.50", "1.25"]),
            ("make:", ["20.00", "15.00 to 25.00", "5.00"]),
        ] {
            let line = calm.lines().find(|line| line.starts_with(row)).unwrap();
            assert!(figures.iter().all(|figure| line.contains(figure)), "{line}");
        }
        assert!(calm.ends_with("load in the minute before: 0.3"), "{calm}");
        assert!(busy.contains("other programs were running (load 1.0") && unknown.contains("not known"));
    }

    #[test]
    fn shares_are_of_medians_and_ceilings() {
        let Report { stages, layers, frame, .. } = report(Some(CEILINGS));
        let figures = |part: &Measured| {
            [part.gflop, part.mb, part.share_of_arithmetic_peak, part.share_of_bandwidth]
                .map(|figure| figure.map(|figure| (figure * 1e9).round() / 1e9))
        };
        // 3 MFLOP in 3 ms of 2 GFLOP/s; 0.5 MB in 3 ms of 0.5 GB/s.
        assert_eq!((&*stages[0].name, stages[0].time.median_ms), ("layer 0", 3.0));
        assert_eq!(figures(&stages[0]), [Some(0.003), Some(0.5), Some(0.5), Some(0.333_333_333)]);
        assert_eq!(stages[1].time, Quartiles { lower_quartile_ms: 20.0, median_ms: 30.0, upper_quartile_ms: 40.0 });
        assert_eq!(figures(&stages[1]), [None, Some(1.0), None, Some(0.066_666_667)]);
        assert_eq!(figures(&layers.unwrap()), figures(&stages[0]));
        assert_eq!(figures(&frame), [Some(0.003), Some(1.5), Some(0.05), Some(0.1)]);
    }

    #[test]
    fn a_gpu_is_not_held_against_the_processors_ceilings() {
        let [cpu, gpu] = [Some(CEILINGS), None].map(|ceilings| table(&report(ceilings)));
        assert!(
            cpu.contains("2 threads, same run: 2 GFLOP/s") && cpu.contains("of peak") && cpu.contains("50 %"),
            "{cpu}"
        );
        assert!(!gpu.contains("ceilings") && !gpu.contains("of peak") && !gpu.contains('%'), "{gpu}");
        for table in [cpu, gpu] {
            for line in ["layer 0", "field", "all layers", "whole frame"] {
                assert!(table.contains(&format!("\n{line} ")), "{table}");
            }
            assert!(table.contains("20.00 to 40.00"), "{table}");
        }
    }
}

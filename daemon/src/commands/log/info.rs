//! `holod log info`: what a log holds, and what the gate makes of it.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use holod_calibration::TimeNs;
use holod_calibration::rig::Rig;
use holod_pupil_input::{
    CounterSnapshot, Decision, Estimator, EstimatorSettings, Figures, LogInfo, Recording, RefusalChange, RefusalWatch,
    SizeUnit, Verdict,
};
use ratatui::style::Color;
use serde::Serialize;

use super::{odd_scale, read};
use crate::cli::LogInfoArgs;
use crate::destination::Destination;
use crate::failure::Failure;
use crate::pictures::{PupilPlot, PupilSampleMark};
use crate::results;
use crate::terminal::{Axes, LiveText, Series, TextSize, plot};

/// What was found, with the gate's word.
#[derive(Serialize)]
struct Report<'a> {
    #[serde(flatten)]
    info: &'a LogInfo,
    gate: Option<&'a GateCounts>,
}

/// What the gate made of the samples, with both eyes driving.
#[derive(Serialize)]
struct GateCounts {
    believed: u64,
    rejected: BTreeMap<&'static str, u64>,
    /// Why nothing is believed, and the likely cure.
    #[serde(skip_serializing_if = "Option::is_none")]
    advice: Option<String>,
}

/// What a plot can show of the samples with their verdicts, and the estimate of their times.
struct Judged {
    counts: GateCounts,
    marks: Vec<PupilSampleMark>,
    estimate: Vec<(f64, f64)>,
}

pub(super) fn info(args: &LogInfoArgs) -> Result<(), Failure> {
    let plot = args.plot.as_deref().map(|path| Destination::new(path, "--plot", args.force)).transpose()?;
    if let Some(plot) = &plot {
        plot.refuse_json("--plot", args.json)?;
        plot.refuse_inputs("--plot", [args.log.clone()])?;
    }
    let recording = read(&args.log)?;
    if let Some(warning) = odd_scale(&args.log, &recording, args.scale) {
        tracing::warn!("{warning}");
    }
    let scale = args.scale.or(recording.recorded_scale());
    let info = LogInfo::of(&recording, scale);
    let in_mm = recording.unit() == SizeUnit::Millimetres || scale.is_some();
    let judged = in_mm.then(|| judge(&recording, args.scale));
    if let Some(plot) = &plot {
        let raw = raw_marks(&recording);
        // The gate judges millimetres only.
        let (unit, samples, estimate) = match &judged {
            Some(judged) => (None, &judged.marks, &judged.estimate[..]),
            None => (Some(recording.unit().name()), &raw, &[][..]),
        };
        let drawn = PupilPlot { unit, of_log: true, samples, estimate, truth: &[] };
        plot.write(|path| drawn.save(path))?;
    }
    if plot.is_some_and(|plot| plot.is_stdout()) {
        return Ok(());
    }
    if args.json {
        let gate = judged.as_ref().map(|judged| &judged.counts);
        return results::print_json(&Report { info: &info, gate });
    }
    let scaled = scale.map(|scale| (recording.unit(), scale)).filter(|(_, scale)| *scale != 1.0);
    let mut text = format!("{}\n{}", args.log.display(), text_of(&info, scaled));
    match &judged {
        Some(judged) => text.push_str(&gate_text(judged)),
        None => text.push_str(
            "gate     not asked: it judges millimetres; give --scale MM_PER_UNIT, measured with an artificial pupil\n",
        ),
    }
    text.push_str(&drawn(&recording, scale, info.duration_s));
    results::print(text.trim_end())
}

/// Lets the gate and the filter see the whole log.
fn judge(recording: &Recording, given_scale: Option<f64>) -> Judged {
    let mut settings = Rig::default().tracker;
    settings.scale = given_scale;
    let figures = Figures { recorded_scale: recording.recorded_scale(), ..recording.unit().into() };
    let mut estimator = Estimator::new(EstimatorSettings::from(&figures.scaled(&settings)));
    let begins = recording.begins();
    let seconds = |t: TimeNs| (t - begins).seconds();
    let mut counts = GateCounts { believed: 0, rejected: BTreeMap::new(), advice: None };
    let mut watch = RefusalWatch::new(&settings, figures, begins);
    let mut decisions = CounterSnapshot::zero();
    let every = step(recording);
    let mut marks = Vec::with_capacity(PLOTTED);
    let mut decided = 0_usize;
    let mut note = |decision: Decision| {
        let accepted = decision.verdict == Verdict::Accepted;
        match decision.verdict {
            Verdict::Accepted => counts.believed += 1,
            Verdict::Rejected(reason) => *counts.rejected.entry(reason.name()).or_default() += 1,
        }
        decisions.add(decision.verdict);
        watch.note(&decision);
        decided += 1;
        let shown = decided.is_multiple_of(every) && decision.sample.valid;
        if shown && decision.sample.diameter_mm.is_finite() {
            let (t_s, raw_mm) = (seconds(decision.sample.t_sample), f64::from(decision.sample.diameter_mm));
            marks.push(PupilSampleMark { t_s, raw_mm, accepted });
        }
    };
    let mut estimate = Vec::with_capacity(PLOTTED);
    for (index, sample) in recording.samples().enumerate() {
        let t = sample.t_sample;
        estimator.push(sample, &mut note);
        if index.is_multiple_of(every) {
            estimate.push((seconds(t), f64::from(estimator.pupil_at(t).pupil.mm())));
        }
    }
    estimator.finish(&mut note);
    if let Some(RefusalChange::Refused(refusal)) = watch.judge(begins, &decisions, true) {
        counts.advice = Some(refusal.advice).filter(|_| !OF_TIMES.contains(&&refusal.reason[..]));
    }
    Judged { counts, marks, estimate }
}

/// What a plot can show of the samples as the log has them.
fn raw_marks(recording: &Recording) -> Vec<PupilSampleMark> {
    let begins = recording.begins();
    recording
        .samples()
        .step_by(step(recording))
        .filter(|sample| sample.valid && sample.diameter_mm.is_finite())
        .map(|sample| PupilSampleMark {
            t_s: (sample.t_sample - begins).seconds(),
            raw_mm: f64::from(sample.diameter_mm),
            accepted: true,
        })
        .collect()
}

/// Reasons of which the log's own notes say more than what is said of a tracker's clock.
const OF_TIMES: [&str; 2] = ["rejected_repeated", "rejected_backwards"];

/// More points than this say no more in a plot.
const PLOTTED: usize = 20_000;

/// Of how many samples one is plotted: an odd number, so that of two eyes that take turns both are seen.
fn step(recording: &Recording) -> usize {
    recording.len().div_ceil(PLOTTED) | 1
}

fn gate_text(judged: &Judged) -> String {
    let GateCounts { believed, rejected, advice } = &judged.counts;
    let reasons: Vec<_> = rejected.iter().map(|(name, count)| format!("{name} {count}")).collect();
    let reasons = if reasons.is_empty() { "none rejected".to_owned() } else { reasons.join(", ") };
    let share = 100.0 * *believed as f64 / (believed + rejected.values().sum::<u64>()).max(1) as f64;
    let advice = advice.as_ref().map_or(String::new(), |advice| format!("         {advice}\n"));
    format!("gate     {believed} samples believed ({share:.1} %); {reasons}\n{advice}")
}

/// The figures; `scaled` tells the log's own unit and by what it was multiplied.
fn text_of(info: &LogInfo, scaled: Option<(SizeUnit, f64)>) -> String {
    let mut text = String::new();
    let mut put = |name: &str, says: String| writeln!(text, "{name:8} {says}").expect("a String takes all");
    let own = scaled.map_or(String::new(), |(unit, scale)| format!(", the log's {} times {scale}", unit.name()));
    put("format", format!("{}, diameters in {}{own}", info.format, info.unit));
    put("length", format!("{:.3} s, {} samples, first at {} ns", info.duration_s, info.samples, info.begins_ns));
    if let Some(rate_hz) = info.stated_rate_hz {
        put("states", format!("{rate_hz} Hz"));
    }
    for eye in &info.eyes {
        let rate = eye.rate_hz.map_or("unknown rate".to_owned(), |rate| format!("{rate:.2} Hz"));
        let interval = eye.interval_ms.map_or(String::new(), |[p1, p50, p99]| {
            format!(", interval p1/median/p99 {p1:.2} / {p50:.2} / {p99:.2} ms")
        });
        put(eye.eye, format!("{} samples at {rate}{interval}", eye.samples));
        put(
            "",
            format!(
                "{} lost in {} runs (longest {:.2} s), {} unsure; {} gaps ({:.2} s in all, longest {:.2} s), {} samples missing",
                eye.lost,
                eye.lost_runs,
                eye.longest_lost_s,
                eye.unsure,
                eye.gaps,
                eye.gaps_s,
                eye.longest_gap_s,
                eye.missing
            ),
        );
        if let Some(range) = &eye.diameter {
            put(
                "",
                format!(
                    "diameter p1/median/p99 {:.2} / {:.2} / {:.2}, from {:.2} to {:.2} {}",
                    range.p1, range.median, range.p99, range.least, range.greatest, info.unit
                ),
            );
        }
        let found = eye.blinks_found.map_or("not judged".to_owned(), |found| format!("{found} found"));
        put(
            "",
            format!(
                "blinks: {} told by the log, {found}; {} longer losses",
                eye.blinks_told,
                eye.long_losses.unwrap_or(0)
            ),
        );
    }
    let blinks = &info.blinks;
    put(
        "blinks",
        format!("{} told, {} found, {} more in one eye only", blinks.told, blinks.found, blinks.found_in_one_eye),
    );
    let faults: Vec<_> = info.faults.iter().map(|fault| format!("{} {}", fault.name, fault.count)).collect();
    put("faults", if faults.is_empty() { "none".to_owned() } else { faults.join(", ") });
    for note in &info.notes {
        put("note", note.clone());
    }
    text
}

/// The whole log as a plot for the terminal.
fn drawn(recording: &Recording, scale: Option<f64>, duration_s: f64) -> String {
    let every = step(recording);
    let begins = recording.begins();
    let points: Vec<_> = recording
        .samples()
        .step_by(every)
        .filter(|sample| sample.valid && sample.diameter_mm.is_finite())
        .map(|sample| ((sample.t_sample - begins).seconds(), f64::from(sample.diameter_mm) * scale.unwrap_or(1.0)))
        .collect();
    let most = points.iter().map(|(_, diameter)| *diameter).fold(0.0, f64::max);
    let in_mm = scale.is_some() || recording.unit() == SizeUnit::Millimetres;
    let axes = Axes {
        x_name: "s",
        x: [0.0, duration_s.max(1e-3)],
        y_name: if in_mm { "pupil / mm" } else { recording.unit().name() },
        y: [0.0, if in_mm { 9.0 } else { (1.1 * most).max(1e-3) }],
    };
    plot(
        &[Series { name: "raw", colour: Color::Green, points: &points }],
        &axes,
        TextSize::of_plot(),
        LiveText::visible(),
    )
}

//! `holod tracker try`: reads a tracker for a while and shows what it sends.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::time::Duration;

use holod_calibration::TimeNs;
use holod_calibration::rig::Rig;
use holod_pupil_input::{
    ClockWatch, Counter, RecordFiles, Refusal, RefusalWatch, Tracker, TrackerHandle, TrackerOptions, TrackerSpec,
    Verdict, host_now,
};
use ratatui::style::Color;
use serde::Serialize;

use super::observed::{EyeFigures, Observed, Quantiles};
use crate::bug_report;
use crate::cli::TryArgs;
use crate::failure::{Exit, Failure};
use crate::record::RecordFolder;
use crate::session::Signals;
use crate::terminal::{Axes, LiveText, Series, TextSize, plot};
use crate::{results, setup};

/// What came of it.
#[derive(Serialize)]
struct Report {
    tracker: String,
    ended_by: String,
    duration_s: f64,
    link: &'static str,
    eyes: BTreeMap<String, EyeFigures>,
    /// The estimate of the present moment, at the end.
    pupil_mm: f32,
    pupil_state: &'static str,
    /// How much slower the tracker's clock runs than the host's, parts per million.
    clock_drift_ppm: Option<f64>,
    /// 19 of 20 samples arrive within this after the quickest ones of their time.
    delay_spread_ms: Option<f64>,
    counts: BTreeMap<String, u64>,
    /// Pieces of the link's bytes and decisions that the recording lost.
    records_lost: u64,
    /// Why a link that was lost did not come back.
    trouble: Option<String>,
    warnings: Vec<String>,
}

const TICK: Duration = Duration::from_millis(20);
/// How often the live picture changes.
const REDRAW: TimeNs = TimeNs(200_000_000);
/// The live plot's length.
const PLOTTED_S: f64 = 10.0;

/// A tracker that is tried, and what has come of it so far.
struct Trial {
    spec: TrackerSpec,
    began: TimeNs,
    tracker: TrackerHandle,
    folder: Option<RecordFolder>,
    observed: Observed,
    refusals: RefusalWatch,
}

pub(super) fn try_out(args: &TryArgs) -> Result<(), Failure> {
    let mut rig = setup::rig(&args.rig)?;
    let spec = spec_of(args, &rig)?;
    if let Some(scale) = args.scale {
        rig.tracker.scale = Some(scale);
    }
    let signals = Signals::install(None)?;
    let mut trial = Trial::start(args, &rig, spec)?;
    let mut live = LiveText::default();
    let ended_by = trial.watch(args, &signals, &mut live)?;
    trial.keep_what_came()?;
    let now = host_now();
    let last = trial.report(&ended_by, now);
    trial.tracker.control.stop();
    trial.take_decisions();
    // Counts and figures are of all samples; link and pupil as they were before the tracker was stopped.
    let Report { link, pupil_mm, pupil_state, trouble, .. } = last;
    let report = Report { link, pupil_mm, pupil_state, trouble, ..trial.report(&ended_by, now) };
    if args.json {
        results::print_json(&report)?;
    } else {
        live.show("");
        results::print(&trial.picture(&report, now))?;
    }
    trial.refusals.judge(now, &trial.tracker.control.counters(), true);
    trial.judge(report.trouble)
}

impl Trial {
    fn start(args: &TryArgs, rig: &Rig, spec: TrackerSpec) -> Result<Self, Failure> {
        let folder = args.record.as_deref().map(|path| RecordFolder::claim(path, args.force)).transpose()?;
        let began = host_now();
        let options = TrackerOptions {
            origin: began,
            record: folder.as_ref().map(|folder| RecordFiles::in_folder(folder.path())),
            forbidden: setup::ports_of_others(rig),
            ..TrackerOptions::default()
        };
        let tracker = Tracker::start(&spec, &rig.tracker, options).map_err(setup::tracker_failure)?;
        if !args.json {
            for warning in tracker.control.warnings() {
                tracing::warn!("{warning}");
            }
            for remark in tracker.control.remarks() {
                tracing::info!("{remark}");
            }
        }
        let refusals = RefusalWatch::new(&rig.tracker, tracker.control.figures(), began);
        Ok(Self { spec, began, tracker, folder, observed: Observed::default(), refusals })
    }

    /// Shows what comes until there is a reason to end, which it returns.
    fn watch(&mut self, args: &TryArgs, signals: &Signals, live: &mut LiveText) -> Result<String, Failure> {
        let mut clock = ClockWatch::default();
        let mut redrawn = self.began;
        loop {
            std::thread::sleep(TICK);
            let now = host_now();
            self.keep_what_came()?;
            // There is not room for many, and the last one tells that the link is back.
            self.tracker.control.trouble();
            self.take_decisions();
            let control = &mut self.tracker.control;
            if let Some(wrong) = clock.judge(now, control.clock(), &control.counters()) {
                tracing::warn!("{wrong}");
            }
            if let Some(signal) = signals.caught() {
                return Ok(signal.to_owned());
            }
            if (now - self.began).seconds() >= args.duration.as_secs_f64() {
                return Ok("the asked duration".to_owned());
            }
            if control.finished() {
                return Ok("the end of the pupil log".to_owned());
            }
            if !args.json && now - redrawn >= REDRAW {
                redrawn = now;
                let report = self.report("", now);
                live.show(&self.picture(&report, now));
            }
        }
    }

    fn take_decisions(&mut self) {
        while let Some(decision) = self.tracker.decisions.pop() {
            self.observed.take(&decision);
            self.refusals.note(&decision);
        }
    }

    /// A recording of silence is not worth keeping, and takes no earlier one's place.
    fn keep_what_came(&mut self) -> Result<(), Failure> {
        let counters = self.tracker.control.counters();
        let came = counters.of(Counter::Bytes) > 0 || counters.of(Counter::Samples) > 0;
        self.folder.as_mut().filter(|_| came).map_or(Ok(()), RecordFolder::keep)
    }

    fn report(&mut self, ended_by: &str, now: TimeNs) -> Report {
        let tracker = &mut self.tracker;
        let estimate = tracker.estimate.pupil_at(now);
        Report {
            tracker: self.spec.to_string(),
            ended_by: ended_by.to_owned(),
            duration_s: (now - self.began).seconds(),
            link: tracker.control.link().name(),
            eyes: self.observed.figures(),
            pupil_mm: estimate.pupil.mm(),
            pupil_state: estimate.state.name(),
            clock_drift_ppm: tracker.control.clock().map(|clock| clock.drift_ppm),
            delay_spread_ms: tracker.control.clock().map(|clock| clock.delay_spread.seconds() * 1e3),
            counts: tracker.control.counters().entries().collect(),
            records_lost: tracker.control.recording().map_or(0, |status| status.chunks_lost + status.decisions_lost),
            trouble: tracker.control.trouble().map(str::to_owned),
            warnings: tracker.control.warnings().to_vec(),
        }
    }

    /// The plots above the report's text, as large as a terminal lets them be, and of a fixed height without one.
    fn picture(&self, report: &Report, now: TimeNs) -> String {
        let text = text_of(report);
        format!("{}\n{text}", traces(&self.observed, now, LiveText::visible(), text.lines().count()))
    }

    /// Whether samples were believed, and their recording is whole.
    ///
    /// # Errors
    /// Why not, and what to do about it; `trouble` is why a link that was lost did not come back.
    fn judge(&self, trouble: Option<String>) -> Result<(), Failure> {
        let Self { spec, tracker, observed, refusals, .. } = self;
        if let Some(failure) = tracker.control.recording().and_then(|recording| recording.failure) {
            return Err(Failure::new(Exit::CannotCreate, format!("the recording is not whole: {failure}")));
        }
        if observed.accepted() > 0 {
            return Ok(());
        }
        let counters = tracker.control.counters();
        // Logs and simulated eyes have no bytes.
        let [bytes, samples] = [Counter::Bytes, Counter::Samples].map(|counter| counters.of(counter));
        let came = |refusal: &&Refusal| refusal.refused > 0 || bytes > 0 && trouble.is_none();
        let heard = match refusals.current().filter(came) {
            Some(refusal) => refusal.to_string(),
            None if samples > 0 => {
                format!("{samples} samples came, and none was believed yet: give it a longer --duration")
            }
            None => trouble.unwrap_or_else(|| {
                "nothing was heard; is it switched on, and does it send without being asked?".to_owned()
            }),
        };
        Err(Failure::new(Exit::Unavailable, format!("tracker {spec}: {heard}")))
    }
}

fn spec_of(args: &TryArgs, rig: &Rig) -> Result<TrackerSpec, Failure> {
    // The rig's was judged with the rig.
    let text = args.spec.as_ref().or(rig.tracker.spec.as_ref()).ok_or_else(|| {
        Failure::new(Exit::Usage, "which tracker? name its spec, or a rig file with tracker.spec by --config")
    })?;
    let spec = text.parse().map_err(Failure::because(Exit::Usage))?;
    if let TrackerSpec::Path(path) | TrackerSpec::Replay { path, .. } = &spec {
        bug_report::refuse_archive(path)?;
    }
    Ok(spec)
}

/// The last seconds of all eyes, above `rows_below` rows of text: rejected and believed.
fn traces(observed: &Observed, now: TimeNs, colours: bool, rows_below: usize) -> String {
    let since_s = |t: TimeNs| (t - now).seconds();
    let points = |wanted: fn(&Verdict) -> bool| -> Vec<(f64, f64)> {
        observed
            .eyes()
            .flat_map(|(_, eye)| &eye.marks)
            .filter(|mark| wanted(&mark.verdict) && mark.valid)
            .map(|mark| (since_s(mark.t_sample), f64::from(mark.raw_mm)))
            .collect()
    };
    let believed = points(|verdict| *verdict == Verdict::Accepted);
    let rejected = points(|verdict| *verdict != Verdict::Accepted);
    let series = [
        Series { name: "rejected", colour: Color::Red, points: &rejected },
        Series { name: "believed", colour: Color::Green, points: &believed },
    ];
    let axes = Axes { x_name: "s", x: [-PLOTTED_S, 0.0], y_name: "pupil / mm", y: [0.0, 9.0] };
    if colours {
        return plot(&series, &axes, TextSize::of_plot_above(rows_below), true);
    }
    // Without colours the two are told apart by standing in two plots.
    let size = TextSize { height: 12, ..TextSize::of_plot() };
    let [rejected, believed] = series.map(|series| plot(&[series], &axes, size, false));
    believed + &rejected
}

fn text_of(report: &Report) -> String {
    let count = |name: &str| report.counts.get(name).copied().unwrap_or(0);
    let mut text = format!(
        "{}: link {}, {:.1} s, {} bytes, {} samples; pupil {:.2} mm, {}\n",
        report.tracker,
        report.link,
        report.duration_s,
        count("bytes"),
        count("samples"),
        report.pupil_mm,
        report.pupil_state,
    );
    let put = |text: &mut String, line: String| writeln!(text, "{line}").expect("a String takes all");
    let three = |quantiles: Option<Quantiles>, unit: &str, decimals: usize| {
        quantiles.map_or("-".to_owned(), |q| {
            format!("{:.decimals$} / {:.decimals$} / {:.decimals$} {unit}", q.p1, q.median, q.p99)
        })
    };
    for (name, eye) in &report.eyes {
        let share = 100.0 * eye.accepted as f64 / eye.samples.max(1) as f64;
        let rate = eye.rate_hz.map_or("rate unknown".to_owned(), |rate| format!("{rate:.1} Hz"));
        let raw = three(eye.raw_mm, "mm", 2);
        let [taken, arrived] = [eye.interval_ms, eye.arrival_interval_ms].map(|interval| three(interval, "ms", 2));
        put(&mut text, format!("{name:6} {rate}, {share:.1} % believed; raw {raw}"));
        put(&mut text, format!("       interval {taken}, as they arrive {arrived}"));
        put(&mut text, format!("       delay over the least {}", three(eye.delay_ms, "ms", 2)));
    }
    if !report.eyes.is_empty() {
        put(&mut text, "       (1st / 50th / 99th percentile)".to_owned());
    }
    if let Some((drift_ppm, spread_ms)) = report.clock_drift_ppm.zip(report.delay_spread_ms) {
        put(
            &mut text,
            format!(
                "clock: {drift_ppm:+.0} ppm against this machine's; 19 of 20 samples within {spread_ms:.2} ms of the quickest"
            ),
        );
    }
    if report.records_lost > 0 {
        put(&mut text, format!("the recording lost {} pieces: the disk is too slow for it", report.records_lost));
    }
    if let Some(trouble) = &report.trouble {
        put(&mut text, format!("lost, and not found again: {trouble}"));
    }
    let shown: Vec<_> = report
        .counts
        .iter()
        .filter(|(name, count)| **count > 0 && !["bytes", "samples"].contains(&name.as_str()))
        .map(|(name, count)| format!("{name} {count}"))
        .collect();
    put(&mut text, format!("counts: {}", if shown.is_empty() { "none".to_owned() } else { shown.join(", ") }));
    text
}

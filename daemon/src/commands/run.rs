//! `holod run`: the daemon, and a report that is shown again.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use holod_calibration::rig::{LaserDriver, Lasers, Rig, WeightsChoice};
use holod_calibration::{Colour, Resolution};
use holod_pupil_input::{RecordFiles, ReplaySpeed, Tracker, TrackerSpec};
use holod_slm_output::OutputSpec;
use serde::Serialize;

use super::service_facts::files_of;
use crate::aside;
use crate::bug_report::{self, Outcome, Played};
use crate::cli::{FitArg, LasersInstead, RunArgs};
use crate::control::RigReader;
use crate::failure::{Exit, Failure};
use crate::page::{self, Page};
use crate::pictures::levels_picture;
use crate::progress;
use crate::record::{self, RecordFolder, RecordHealth, Recorder};
use crate::service_lasers::ServiceLasers;
use crate::session::{self, Hangups, SessionPlan, SessionReport, ShownLevels, Summary, not_dark};
use crate::{results, run_text, setup, source};

/// Scenario of the built-in tracker.
const SAMPLE_TRACKER: &str = "mock";
/// How long the end of a run waits for its summary and its levels to be written.
const SAVING: Duration = Duration::from_secs(30);

pub(super) fn run(args: &RunArgs) -> Result<(), Failure> {
    ServiceLasers::of_this_process().inspect(ServiceLasers::begin);
    let output: OutputSpec = args.output.parse().map_err(Failure::because(Exit::Usage))?;
    if let Some(spec) = &args.tracker
        && let Some(report) = report_of(spec)?
    {
        return replay(args, output, &report);
    }
    refuse_lasers(args)?;
    // From the first reading on, another may be asked for.
    let hangups = if args.rig.config.is_some() { Hangups::take_over()? } else { None };
    let rig = setup::rig_with_network(&args.rig, &args.network)?;
    // Those of lasers in whose place there are simulated ones, too.
    let ports_of_others = setup::ports_of_others(&rig);
    let rig = with_options(rig, args);
    let spec = rig.tracker.spec.clone().unwrap_or_else(|| SAMPLE_TRACKER.to_owned());
    // The rig's own was judged with the rig.
    let tracker: TrackerSpec = spec.parse().map_err(Failure::because(Exit::Usage))?;
    if let TrackerSpec::Path(path) | TrackerSpec::Replay { path, .. } = &tracker {
        bug_report::refuse_archive(path)?;
    }
    tracing::info!("{}: tracker {tracker}, panel {output} of {}", rig.name, rig.resolution());
    if let Some(folder) = args.record.as_ref().filter(|_| args.force) {
        RecordFolder::refuse_as_inputs(folder, inputs(args, &rig, &tracker))?;
    }
    for warning in rig.warnings() {
        tracing::warn!("{warning}");
    }
    let weights = progress::during("loading the network", || setup::weights(&rig))?;
    let pictures =
        progress::during("loading the scene", || source::named(&args.scene, args.feed_dark_after, &rig.geometry))?;
    let page = Page::open(&args.page)?;
    let recorder = recorder(args, &rig, &tracker, pictures.resolution())?;
    let network = weights.config();
    tracing::info!(
        "{} of {}{} by network {} {}",
        pictures.resolution(),
        pictures.name(),
        pictures.extent(),
        network.architecture,
        network.version
    );
    let again = args.clone();
    let plan = SessionPlan {
        rig,
        rig_again: args.rig.config.is_some().then(|| Arc::new(move || rig_again(&again)) as RigReader),
        hangups,
        weights,
        backend: args.backend,
        pictures,
        output,
        tracker,
        ports_of_others,
        pupil: args.pupil,
        record_tracker: recorder.as_ref().map(|recorder| RecordFiles::in_folder(&recorder.folder())),
        record: recorder.as_ref().map(Recorder::health),
        frame_limit: args.frames,
        duration: args.duration,
        keep_levels: recorder.is_some(),
        hash_levels: recorder.is_some(),
    };
    run_to_the_end(plan, args, recorder, page)
}

/// What writes the run's record, where one is asked for.
fn recorder(
    args: &RunArgs,
    rig: &Rig,
    tracker: &TrackerSpec,
    hologram: Resolution,
) -> Result<Option<Recorder>, Failure> {
    let folder = match (&args.record, &args.record_in) {
        (Some(path), _) => RecordFolder::claim(path, args.force)?,
        (None, Some(parent)) => RecordFolder::claim_new(parent, SystemTime::now())?,
        (None, None) => return Ok(None),
    };
    Ok(Some(Recorder::create(folder, args, rig, hologram)?.with_tracker(tracker.to_string())))
}

/// Runs, finishes the record and says what came of both.
fn run_to_the_end(
    plan: SessionPlan,
    args: &RunArgs,
    recorder: Option<Recorder>,
    page: Option<Page>,
) -> Result<(), Failure> {
    let mut observers = (recorder, page);
    let session = match session::run(plan, &mut observers) {
        Ok(session) => session,
        Err(failure) => {
            return Err(match observers.0 {
                Some(recorder) => recorder.fail(&failure),
                None => failure,
            });
        }
    };
    let (Some(mut recorder), _) = observers else { return tell(args, &session.summary, None) };
    let has_record = recorder.finish();
    let health = recorder.health();
    let session = Arc::new(session);
    if has_record && !health.is_lost() {
        finish_record(&session, &recorder.folder(), &health)?;
    }
    let mut summary = session.summary.clone();
    summary.figures.record = (has_record || health.is_lost()).then(|| health.state());
    let told = tell(args, &summary, None);
    if let (Err(_), Err(lost)) = (&told, health.judge()) {
        tracing::error!("{lost}");
    }
    told.and_then(|()| health.judge())
}

/// The files and folders that a run reads, with the option that names each.
fn inputs(args: &RunArgs, rig: &Rig, tracker: &TrackerSpec) -> Vec<(&'static str, PathBuf)> {
    let config = args.rig.config.iter().map(|path| ("--config", path.clone()));
    let weights = match &rig.model.weights {
        WeightsChoice::File(path) => Some(("--weights", path.clone())),
        _ => None,
    };
    let mut of_rig = rig.clone();
    // What the run has in its place is among the tracker's files.
    of_rig.tracker.spec = None;
    let of_rig = files_of(&of_rig).into_iter().map(|path| ("the rig", path));
    let scene = args.scene.scene.iter().flat_map(|scene| scene.split(',')).map(|path| ("--scene", path.into()));
    let tracker = tracker.files().into_iter().map(|path| ("--tracker", path));
    config.chain(weights).chain(of_rig).chain(scene).chain(tracker).collect()
}

/// Refuses what `run` would by its options and its rig alone. Devices are not opened; files that are not there may be
/// when it is run.
pub(super) fn judge(args: &RunArgs, rig: &Rig) -> Result<(), Failure> {
    if let Some(spec) = &args.tracker
        && let Some(report) = report_of(spec)?
    {
        refuse_options(args, &report)?;
    }
    refuse_lasers(args)?;
    page::judge(&args.page)?;
    source::judge(&args.scene, args.feed_dark_after, &rig.geometry)?;
    let meant = with_options(rig.clone(), args);
    let spec = meant.tracker.spec.as_deref().unwrap_or(SAMPLE_TRACKER);
    let spec: TrackerSpec = spec.parse().map_err(Failure::because(Exit::Usage))?;
    setup::refuse_port_of_others(&spec, rig)?;
    if spec.files().iter().all(|file| file.exists()) {
        Tracker::examine(&spec, &meant.tracker).map_err(setup::tracker_failure)?;
    }
    Ok(())
}

/// The report that a tracker's spec names.
fn report_of(spec: &str) -> Result<Option<TrackerSpec>, Failure> {
    let spec: TrackerSpec = spec.parse().map_err(Failure::because(Exit::Usage))?;
    let (TrackerSpec::Path(path) | TrackerSpec::Replay { path, .. }) = &spec else { return Ok(None) };
    Ok(bug_report::is_archive(path).then_some(spec))
}

/// Shows the frames of a report again.
fn replay(args: &RunArgs, output: OutputSpec, tracker: &TrackerSpec) -> Result<(), Failure> {
    refuse_options(args, tracker)?;
    let (TrackerSpec::Path(path) | TrackerSpec::Replay { path, .. }) = tracker else { return Ok(()) };
    let unpacked = progress::during("unpacking the report", || bug_report::unpack(path))?;
    let Played { rig, pictures, backend, playback, comparison } =
        progress::during("reading what its frames are made of", || bug_report::prepare(&unpacked, args.backend))?;
    let weights = progress::during("loading the network", || setup::weights(&rig))?;
    let page = Page::open(&args.page)?;
    let frames = playback.frames();
    tracing::info!("{frames} frames of {} are made again, with simulated lasers", path.display());
    let plan = SessionPlan {
        rig,
        rig_again: None,
        hangups: None,
        weights,
        backend,
        pictures,
        output,
        tracker: tracker.clone(),
        ports_of_others: Vec::new(),
        pupil: None,
        record_tracker: None,
        record: None,
        frame_limit: Some(args.frames.map_or(frames, |asked| asked.min(frames))),
        duration: args.duration,
        keep_levels: false,
        hash_levels: true,
    };
    let mut observers = (page, comparison);
    let session = session::play(plan, playback, &mut observers)?;
    let outcome = observers.1.finish(&session.summary.figures.engine);
    tell(args, &session.summary, Some(&outcome))?;
    if outcome.differs() {
        let (frames, fields) = (outcome.frames_different, outcome.fields_different);
        let differs = format!("{frames} frames have other levels than the report's, {fields} other colour fields");
        return Err(Failure::new(Exit::Different, differs));
    }
    Ok(())
}

/// Refuses simulated lasers beside a panel that is one: nobody would see what the rig's own do.
fn refuse_lasers(args: &RunArgs) -> Result<(), Failure> {
    let output: OutputSpec = args.output.parse().map_err(Failure::because(Exit::Usage))?;
    if args.lasers.is_none() || matches!(output, OutputSpec::Headless(_)) {
        return Ok(());
    }
    let what = format!(
        "--lasers simulated: found --output {}, expected headless: leave --lasers out where there is a panel",
        args.output
    );
    Err(Failure::new(Exit::Usage, what))
}

/// Refuses what a report brings itself.
fn refuse_options(args: &RunArgs, tracker: &TrackerSpec) -> Result<(), Failure> {
    if args.record.is_some() || args.record_in.is_some() {
        let what = "--record: a report holds its record already; `tar xzf FILE` takes it out";
        return Err(Failure::new(Exit::Usage, what));
    }
    let own_pace =
        matches!(tracker, TrackerSpec::Replay { speed, repeat, .. } if *repeat || *speed != ReplaySpeed::Times(1.0));
    let given = [
        ("speed= and loop", own_pace),
        ("--config", args.rig.config.is_some()),
        ("--weights", args.network.weights.is_some()),
        ("--scene", args.scene.scene.is_some()),
        ("--depth-encoding", args.scene.depth_encoding.is_some()),
        ("--fit", args.scene.fit != FitArg::Native),
        ("--resolution", args.scene.resolution.is_some()),
        ("--feed-dark-after", args.feed_dark_after.is_some()),
        ("--pupil", args.pupil.is_some()),
        ("--eye", args.eye.is_some()),
        ("--lasers", args.lasers.is_some()),
        ("--scale", args.scale.is_some()),
    ];
    match given.into_iter().find(|(_, is_given)| *is_given) {
        None => Ok(()),
        Some((option, _)) => Err(Failure::new(
            Exit::Usage,
            format!(
                "{option}: a report brings its own rig, weights, scene and pupils, and is shown at the panel's pace; leave \
                 the option out"
            ),
        )),
    }
}

/// A run that is over, and how a report came out.
#[derive(Serialize)]
struct RunResult<'a> {
    #[serde(flatten)]
    summary: &'a Summary,
    #[serde(skip_serializing_if = "Option::is_none")]
    report: Option<&'a Outcome>,
}

/// Says what the run came to.
///
/// # Errors
/// The lasers did not go dark, which matters most, or standard output takes no more.
fn tell(args: &RunArgs, summary: &Summary, outcome: Option<&Outcome>) -> Result<(), Failure> {
    let text = if args.json {
        results::to_json(&RunResult { summary, report: outcome })?
    } else {
        let outcome = outcome.map_or(String::new(), |outcome| format!("\n{}", outcome.text()));
        format!("{}{outcome}", run_text::summary_text(summary))
    };
    let printed = results::print_once(&text);
    match &summary.lasers_not_dark {
        None => printed,
        Some(why) => Err(Failure::new(Exit::Unavailable, not_dark(why))),
    }
}

/// The rig with what the command line says in its place.
fn rig_again(args: &RunArgs) -> Result<Rig, Failure> {
    setup::rig_with_network(&args.rig, &args.network).map(|rig| with_options(rig, args))
}

fn with_options(mut rig: Rig, args: &RunArgs) -> Rig {
    let tracker = &mut rig.tracker;
    tracker.spec = args.tracker.clone().or(tracker.spec.take());
    tracker.eye = args.eye.unwrap_or(tracker.eye);
    tracker.scale = args.scale.or(tracker.scale);
    match args.lasers {
        None => {}
        Some(LasersInstead::Simulated) => simulate_lasers(&mut rig.lasers),
    }
    rig
}

/// Takes the simulated lasers in place of the rig's own, of the same colours.
fn simulate_lasers(lasers: &mut Lasers) {
    for colour in Colour::ALL.into_iter().filter(|&colour| !lasers.driver.has(colour)) {
        lasers.power_mw[colour] = 0.0;
    }
    lasers.driver = LaserDriver::Simulated;
}

/// Writes the levels that the panel showed and `summary.json` into the record, which is lost where they cannot be
/// written.
///
/// # Errors
/// The system gives no thread for it.
fn finish_record(session: &Arc<SessionReport>, folder: &Path, health: &Arc<RecordHealth>) -> Result<(), Failure> {
    let (of_session, into, of_health) = (Arc::clone(session), folder.to_owned(), Arc::clone(health));
    let save = move || save(&of_session, &into, &of_health);
    let saved = progress::during("finishing the record", || aside::within(SAVING, save));
    match saved.map_err(Failure::because(Exit::Unavailable))? {
        Some(()) => {}
        None => health.give_up(&format!("the disk of {} does not take its end within {SAVING:?}", folder.display())),
    }
    Ok(())
}

/// `summary.json` of a record.
#[derive(Serialize)]
struct RecordSummary<'a> {
    #[serde(flatten)]
    summary: &'a Summary,
    shown_levels: Vec<KeptLevels>,
}

/// A picture of levels in a record, and what turns it into what an eye saw.
#[derive(Serialize)]
struct KeptLevels {
    file: String,
    frame: u64,
    pupil_mm: f32,
    /// The amplitude that double phase took as 1.
    amplitude_constant: f32,
    /// Size of the hologram in the middle of the panel.
    hologram: [usize; 2],
}

/// Saves the levels first: the summary says whether they are there.
fn save(session: &SessionReport, folder: &Path, health: &RecordHealth) {
    let cannot = |failure: Failure| health.give_up(&format!("cannot finish it: {failure}"));
    health.look_for_folder();
    record::judge_parts(folder).unwrap_or_else(cannot);
    let shown_levels = save_shown(session, folder).unwrap_or_else(|failure| {
        cannot(failure);
        Vec::new()
    });
    let mut summary = session.summary.clone();
    summary.figures.record = Some(health.state());
    let summary = RecordSummary { summary: &summary, shown_levels };
    results::save_json(&summary, &folder.join("summary.json")).unwrap_or_else(cannot);
}

fn save_shown(session: &SessionReport, folder: &Path) -> Result<Vec<KeptLevels>, Failure> {
    let Resolution { width, height } = session.encoder.pattern_resolution();
    let save = |shown: &ShownLevels| {
        let (frame, pupil_mm) = (shown.levels.tag().frame_id, shown.pupil.mm());
        let file = record::shown_name(pupil_mm, frame);
        results::save_png(levels_picture(&shown.levels), &folder.join(&file))?;
        let amplitude_constant = shown.amplitude_constant;
        Ok(KeptLevels { file, frame, pupil_mm, amplitude_constant, hologram: [width, height] })
    };
    session.shown.iter().map(save).collect()
}

#[cfg(test)]
mod tests {
    use clap::Parser;
    use holod_calibration::PerColour;
    use holod_calibration::rig::TextLaserProfile;

    use super::*;
    use crate::cli::Cli;

    #[test]
    fn what_a_run_would_refuse_is_refused_before_there_is_one() {
        let mut rig = Rig::default();
        rig.lasers.driver = LaserDriver::Serial { path: "/dev/null".into(), sync_wire: false };
        rig.tracker.spec = Some("serial:/dev/null".into());
        let judged = |more: &[&str]| {
            let cli = Cli::try_parse_from([&["holod"], more].concat()).unwrap();
            judge(&cli.run, &rig).map_err(|failure| failure.to_string())
        };
        assert!(judged(&[]).unwrap_err().contains("/dev/null that the rig names for its lasers"));
        assert_eq!(judged(&["--tracker", "mock:steady"]), Ok(()));
        assert!(judged(&["--lasers", "simulated"]).unwrap_err().contains("that the rig names for its lasers"));
        assert_eq!(judged(&["--lasers", "simulated", "--tracker", "mock:steady"]), Ok(()));
        let on_panel = judged(&["--lasers", "simulated", "--output", "drm:DP-1"]).unwrap_err();
        assert!(on_panel.contains("found --output drm:DP-1, expected headless"), "{on_panel}");
    }

    #[test]
    fn simulated_lasers_have_the_colours_of_the_rigs_own() {
        let mut lasers = Rig::default().lasers;
        let profile = TextLaserProfile::named("cobolt").unwrap().clone();
        lasers.driver = LaserDriver::Text {
            profile: Box::new(profile),
            paths: PerColour([None, Some("/dev/null".into()), None]),
            transmission_ppb: PerColour([1_000_000_000; 3]),
        };
        let green_mw = lasers.power_mw[Colour::Green];
        simulate_lasers(&mut lasers);
        assert_eq!((lasers.driver, lasers.power_mw), (LaserDriver::Simulated, PerColour([0.0, green_mw, 0.0])));
    }
}

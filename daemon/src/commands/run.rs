//! `holod run`: the daemon.

use std::path::Path;
use std::sync::Arc;

use holod_calibration::TimeNs;
use holod_calibration::rig::Rig;
use holod_pupil_input::{RecordFiles, TrackerSpec};
use holod_slm_output::{FieldEvent, OutputSpec};

use crate::cli::RunArgs;
use crate::control::{Request, RigReader};
use crate::failure::{Exit, Failure};
use crate::page::Page;
use crate::pictures::levels_picture;
use crate::progress;
use crate::record::{self, FieldRecord, FrameLog, FrameRecord};
use crate::report;
use crate::session::{self, Observer, SessionPlan, SessionReport, not_dark};
use crate::{setup, source};

/// Scenario of the built-in tracker.
const SAMPLE_TRACKER: &str = "mock";

pub(super) fn run(args: &RunArgs) -> Result<(), Failure> {
    let output: OutputSpec = args.output.parse().map_err(Failure::because(Exit::Usage))?;
    let rig = rig_of(args)?;
    let spec = rig.tracker.spec.clone().unwrap_or_else(|| SAMPLE_TRACKER.to_owned());
    let tracker: TrackerSpec = spec.parse().map_err(Failure::because(Exit::Usage))?;
    tracing::info!("{}: tracker {tracker}, panel {output} of {}", rig.name, rig.resolution());
    let weights = progress::during("loading the network", || setup::weights(&rig))?;
    let pictures = progress::during("loading the scene", || source::named(&args.scene, &rig.geometry))?;
    if let Some(folder) = args.record.as_deref().filter(|_| args.force) {
        record::remove_earlier(folder)?;
    }
    let page = Page::open(&args.page)?;
    let log = args.record.as_deref().map(FrameLog::create).transpose()?;
    let mut observers = (log.map(Recorder), page);
    let network = weights.config();
    tracing::info!(
        "{} of {} by network {} {}",
        pictures.resolution(),
        pictures.name(),
        network.architecture,
        network.version
    );
    let again = args.clone();
    let plan = SessionPlan {
        rig,
        rig_again: args.rig.config.is_some().then(|| Arc::new(move || rig_of(&again)) as RigReader),
        weights,
        backend: args.backend,
        pictures,
        output,
        tracker,
        pupil: args.pupil,
        record_tracker: args.record.as_deref().map(RecordFiles::in_folder),
        frame_limit: args.frames,
        duration: args.duration,
        keep_levels: args.record.is_some(),
    };
    let session = match session::run(plan, &mut observers) {
        Ok(session) => session,
        Err(failure) => {
            if let (Some(Recorder(log)), _) = observers {
                log.discard_if_empty();
            }
            return Err(failure);
        }
    };
    if let ((Some(Recorder(log)), _), Some(folder)) = (&mut observers, &args.record) {
        log.flush()?;
        save(&session, folder)?;
    }
    if args.json {
        report::print_json(&session.summary)?;
    } else {
        report::print(&report::summary_text(&session.summary))?;
    }
    match &session.summary.lasers_not_dark {
        None => Ok(()),
        Some(why) => Err(Failure::new(Exit::Unavailable, not_dark(why))),
    }
}

/// The rig with what the command line says in its place.
fn rig_of(args: &RunArgs) -> Result<Rig, Failure> {
    let mut rig = setup::rig_with_network(&args.rig, &args.network)?;
    let tracker = &mut rig.tracker;
    tracker.spec = args.tracker.clone().or(tracker.spec.take());
    tracker.eye = args.eye.unwrap_or(tracker.eye);
    tracker.scale = args.scale.or(tracker.scale);
    Ok(rig)
}

/// Writes `summary.json` and the levels that the panel showed.
fn save(session: &SessionReport, folder: &Path) -> Result<(), Failure> {
    report::save_json(&session.summary, &folder.join("summary.json"))?;
    for (pupil, levels) in &session.shown {
        let name = format!("shown_pupil_{:.2}mm_frame_{:06}.png", pupil.mm(), levels.tag().frame_id);
        report::save_png(&levels_picture(levels), &folder.join(name))?;
    }
    Ok(())
}

struct Recorder(FrameLog);

impl Observer for Recorder {
    fn frame(&mut self, record: &FrameRecord) -> Result<(), Failure> {
        self.0.frame(*record);
        Ok(())
    }

    fn field(&mut self, event: &FieldEvent) -> Result<(), Failure> {
        self.0.field(&FieldRecord::of(event))
    }

    fn order(&mut self, t: TimeNs, request: &Request) -> Result<(), Failure> {
        self.0.order(t, request)
    }

    fn tick(&mut self) -> Result<(), Failure> {
        self.0.flush()
    }
}

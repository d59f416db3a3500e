//! `holod run`: the daemon.

use std::path::Path;

use holod_pupil_input::{RecordFiles, TrackerSpec};
use holod_slm_output::FieldEvent;

use crate::cli::RunArgs;
use crate::failure::{Exit, Failure};
use crate::pictures::levels_picture;
use crate::record::{FieldRecord, FrameLog, FrameRecord};
use crate::report;
use crate::session::{self, Observer, SessionPlan, SessionReport};
use crate::setup;

/// Scenario of the built-in tracker.
const SAMPLE_TRACKER: &str = "mock";

pub(super) fn run(args: &RunArgs) -> Result<(), Failure> {
    check_output(&args.output)?;
    let rig = setup::rig_with_network(&args.rig, &args.network)?;
    let spec = args.tracker.clone().or_else(|| rig.tracker.spec.clone()).unwrap_or_else(|| SAMPLE_TRACKER.to_owned());
    let tracker: TrackerSpec = spec.parse().map_err(Failure::because(Exit::Usage))?;
    let weights = setup::weights(&rig)?;
    let frames = setup::frames(&args.scene, &rig.geometry)?;
    let mut recorder = Recorder { log: args.record.as_deref().map(FrameLog::create).transpose()? };
    tracing::info!("{}: {} of {} on a panel of {}", rig.name, frames.resolution(), frames.name, rig.resolution());
    let plan = SessionPlan {
        rig,
        weights,
        backend: args.backend,
        frames,
        tracker,
        record_tracker: args.record.as_deref().map(RecordFiles::in_folder),
        frame_limit: args.frames,
        duration: args.duration,
        keep_levels: args.record.is_some(),
    };
    let session = match session::run(plan, &mut recorder) {
        Ok(session) => session,
        Err(failure) => {
            if let Some(log) = recorder.log {
                log.discard_if_empty();
            }
            return Err(failure);
        }
    };
    if let (Some(log), Some(folder)) = (&mut recorder.log, &args.record) {
        log.flush()?;
        save(&session, folder)?;
    }
    if args.json {
        report::print_json(&session.summary)
    } else {
        report::print(&report::summary_text(&session.summary))
    }
}

fn check_output(spec: &str) -> Result<(), Failure> {
    let kind = spec.split(':').next().unwrap_or_default();
    match kind {
        "headless" if spec == "headless" => Ok(()),
        "window" | "drm" => Err(Failure::new(
            Exit::Unavailable,
            format!("--output {spec}: this version shows patterns on a virtual panel only; use --output headless"),
        )),
        _ => Err(Failure::new(Exit::Usage, format!("--output: found '{spec}', expected headless"))),
    }
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

struct Recorder {
    log: Option<FrameLog>,
}

impl Observer for Recorder {
    fn frame(&mut self, record: &FrameRecord) -> Result<(), Failure> {
        if let Some(log) = &mut self.log {
            log.frame(*record);
        }
        Ok(())
    }

    fn field(&mut self, event: &FieldEvent) -> Result<(), Failure> {
        match &mut self.log {
            Some(log) => log.field(&FieldRecord::of(event)),
            None => Ok(()),
        }
    }

    fn tick(&mut self) -> Result<(), Failure> {
        self.log.as_mut().map_or(Ok(()), FrameLog::flush)
    }
}

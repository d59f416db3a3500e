//! One run of the whole loop: starts the threads, watches them, takes them down in the right order.

mod build;
mod desk;
mod feed_watch;
mod frame_loop;
mod inputs;
mod keep;
mod laser_watch;
mod ledger;
mod observer;
mod output_watch;
mod rate_watch;
pub(crate) mod scheduling;
mod service;
mod stats;
mod summary;
mod take_down;
mod tally;
mod tracker_watch;
mod watch;

use std::sync::Arc;
use std::time::Duration;

use holod_calibration::PupilDiameter;
use holod_calibration::rig::Rig;
use holod_model::Weights;
use holod_pupil_input::{RecordFiles, ReplayError, SourceError, TrackerError, TrackerSpec};
use holod_slm_output::OutputSpec;

use crate::cli::Backend;
use crate::control::RigReader;
use crate::failure::{Exit, Failure};
use crate::record::RecordHealth;
use crate::source::Pictures;

#[cfg(feature = "fault-injection")]
use crate::fault::host_now;
#[cfg(not(feature = "fault-injection"))]
use holod_pupil_input::host_now;

pub(crate) use self::inputs::{Cue, Playback, pupil_state_named, pupil_states};
pub use self::ledger::LaserSummary;
pub use self::observer::{Began, FirstLight, Observer};
pub use self::service::Hangups;
pub(crate) use self::service::Signals;
pub use self::stats::Spread;
pub use self::summary::{SessionReport, Summary};
pub use self::take_down::not_dark;

/// What to run.
pub struct SessionPlan {
    /// The bench.
    pub rig: Rig,
    /// Reads it again, where there is a file to read it from.
    pub rig_again: Option<RigReader>,
    /// What asks for that; where there is nothing, SIGHUP ends the run.
    pub hangups: Option<Hangups>,
    /// The network.
    pub weights: Weights,
    /// Which engine runs it.
    pub backend: Backend,
    /// What to show.
    pub pictures: Pictures,
    /// Where to show it.
    pub output: OutputSpec,
    /// The pupil that holograms are made for, where it is not the tracker's.
    pub pupil: Option<PupilDiameter>,
    /// Where samples come from; nothing is opened where a record is played.
    pub tracker: TrackerSpec,
    /// Where the tracker's bytes and samples are written down.
    pub record_tracker: Option<RecordFiles>,
    /// Whether the run's record goes on.
    pub record: Option<Arc<RecordHealth>>,
    /// Stop after so many frames.
    pub frame_limit: Option<u64>,
    /// Stop after so long.
    pub duration: Option<Duration>,
    /// Keep the levels that the panel showed, the newest for each half millimetre of pupil.
    pub keep_levels: bool,
    /// Tell the levels of each frame by their hash.
    pub hash_levels: bool,
}

/// Frame records on their way to the control thread.
const RECORDS: usize = 1024;

/// Runs until a limit, a signal or a failure ends it; lasers are dark when it returns.
///
/// # Errors
/// What could not be started, or the observer's failure; in both cases everything has been taken down.
pub fn run(plan: SessionPlan, observer: &mut dyn Observer) -> Result<SessionReport, Failure> {
    run_with(plan, None, observer)
}

/// Runs the same loop with the frames of a record, in place of what tracker and pictures would bring.
///
/// # Errors
/// As [`run`].
pub(crate) fn play(
    plan: SessionPlan,
    playback: Playback,
    observer: &mut dyn Observer,
) -> Result<SessionReport, Failure> {
    run_with(plan, Some(playback), observer)
}

fn run_with(
    plan: SessionPlan,
    playback: Option<Playback>,
    observer: &mut dyn Observer,
) -> Result<SessionReport, Failure> {
    let signals = Signals::install(plan.hangups.as_ref())?;
    #[cfg(feature = "fault-injection")]
    crate::fault::install()?;
    let mut session = build::build(plan, playback, signals, observer)?;
    let ended = session.watch.until_the_end(&session.limits, &session.output, &session.frame_thread);
    take_down::take_down(session, ended)
}

/// The exit code of a tracker that cannot be started.
pub(crate) fn tracker_failure(error: TrackerError) -> Failure {
    let exit = match &error {
        TrackerError::Source(SourceError::Serial(_)) => Exit::NoInput,
        TrackerError::Source(_) => Exit::Unavailable,
        TrackerError::Profile(_) | TrackerError::WrongLink { .. } => Exit::Usage,
        TrackerError::Replay(ReplayError::Io { .. }) => Exit::NoInput,
        TrackerError::Replay(_) => Exit::Data,
        TrackerError::Script(_) => Exit::Data,
        TrackerError::Record(_) => Exit::CannotCreate,
        TrackerError::NoScale { .. } => Exit::Config,
        TrackerError::Thread(_) => Exit::Unavailable,
    };
    Failure::because(exit)(error)
}

//! One run of the whole loop: starts the threads, watches them, takes them down in the right order.

mod build;
mod clock;
mod desk;
mod feed_watch;
mod frame_loop;
mod held_pupil;
mod inputs;
mod laser_watch;
mod ledger;
mod obey;
mod output_watch;
mod plan;
mod rate_watch;
mod recorded_levels;
mod service;
mod sleep;
mod state;
mod stats;
mod summary;
mod take_down;
mod tally;
mod tracker_watch;
mod watch;

use crate::failure::Failure;

pub(crate) use self::inputs::{Cue, Playback};
pub use self::laser_watch::BoxLost;
pub(crate) use self::laser_watch::LaserBoxWatch;
pub use self::ledger::LaserSummary;
pub use self::plan::SessionPlan;
pub use self::service::Hangups;
pub(crate) use self::service::Signals;
pub(crate) use self::sleep::SleepWatch;
pub use self::summary::{SessionReport, ShownLevels, Summary};
pub use self::take_down::{NO_ACKNOWLEDGEMENT, PANEL_HANGS, not_dark};
pub use crate::observer::{Began, FirstLight, Observer};

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

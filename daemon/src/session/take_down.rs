//! The end of a run: lasers dark, flat pattern, threads joined, and what it all came to.

use std::sync::atomic::Ordering;
use std::time::Duration;

use super::build::Session;
use super::clock::host_now;
use super::ledger::LaserSummary;
use super::summary::{SessionReport, ShownLevels, Summary};
use crate::aside::ends_within;
use crate::failure::{Exit, Failure};
use crate::snapshot::Figures;

/// Longer than any frame takes, of the largest size on a slow processor.
const LONGEST_FRAME: Duration = Duration::from_secs(60);

/// Why lasers are not known to be dark where nobody says more.
pub const NO_ACKNOWLEDGEMENT: &str = "the laser box did not acknowledge in time";
/// What is said where the panel's thread was left to itself.
pub const PANEL_HANGS: &str = "the panel's thread has not ended: does the display server or the graphics driver hang?";

/// Ends every part in order, whatever `ended` says, and then says what the run came to.
///
/// # Errors
/// What ended the run early, or went wrong at its end.
pub(super) fn take_down(session: Session<'_>, ended: Result<String, Failure>) -> Result<SessionReport, Failure> {
    let Session { mut watch, output, frame_thread, stop, records_lost, limits, encoder } = session;
    watch.service.stopping();
    tracing::info!("stopping: {}", ended.as_deref().unwrap_or("a failure"));
    watch.signals.lasers_go_out();
    stop.store(true, Ordering::Release);
    let down = output.shutdown();
    watch.signals.lasers_are_out();
    watch.signals.tell_of_suspension();
    let frame_loop = ends_within(&frame_thread, LONGEST_FRAME).then(|| frame_thread.join());
    let tracker_link = watch.tracker.link().name().to_owned();
    watch.tracker.stop();
    let observed = watch.drain();
    let t_end = host_now();
    watch.laser_box.drain(false, t_end);
    let box_lost = watch.laser_box.box_lost(t_end);
    let lasers_not_dark =
        (!down.lasers_dark).then(|| watch.laser_box.trouble().unwrap_or(NO_ACKNOWLEDGEMENT).to_owned());
    watch.tracker_watch.judge(&watch.tracker, host_now());
    watch.judge_recording();
    let figures = Figures { tracker_link, ..watch.figures(&down.counts, host_now()) };
    watch.feed = None;
    let recorded = watch.tracker.recording();
    if !down.panel_ended {
        tracing::error!("{PANEL_HANGS}");
    }
    if let Some(why) = &lasers_not_dark
        && (ended.is_err() || observed.is_err() || !matches!(frame_loop, Some(Ok(Ok(())))))
    {
        tracing::error!("{}", not_dark(why));
    }
    let ended_by = ended?;
    observed?;
    match frame_loop {
        None => {
            let hangs = "the frame loop has not ended: does the GPU hang? The kernel's log may tell; --backend cpu does without";
            return Err(Failure::new(Exit::Unavailable, hangs));
        }
        Some(Err(_panic)) => {
            return Err(Failure::new(Exit::Software, "the frame loop failed (its message stands above)"));
        }
        Some(Ok(rendered)) => rendered.map_err(Failure::because(Exit::Unavailable))?,
    }
    if down.lasers_dark {
        watch.desk.dark_note.take_away_unless_of_service();
    }

    let tally = watch.tally;
    if tally.frames_shown == 0 {
        tracing::warn!("no frame was shown: the run ended before the first one was ready; give it longer");
    }
    let kept = down.kept.into_iter().flatten();
    let mut shown: Vec<ShownLevels> = kept.filter_map(|levels| tally.shown_levels(levels)).collect();
    shown.sort_by(|a, b| a.pupil.mm().total_cmp(&b.pupil.mm()));
    let duration_s = (host_now() - limits.t_origin).seconds();
    let counters = watch.tracker.counters();
    let summary = Summary {
        ended_by,
        duration_s,
        figures,
        fields_shown: tally.fields_shown,
        fields_repeated: tally.fields_repeated,
        frames_shown_hz: tally.frames_shown as f64 / duration_s,
        frames_by_pupil_state: tally.by_state.iter().map(|(state, frames)| (state.name(), *frames)).collect(),
        pupil_range_mm: tally.pupil_range_mm,
        frames_beyond_trained_pupils: tally.beyond_trained,
        samples_rejected: counters.refused_in_all(),
        tracker_clock_drift_ppm: watch.tracker.clock().map(|clock| clock.drift_ppm),
        tracker_records_lost: recorded.as_ref().map_or(0, |status| status.chunks_lost + status.decisions_lost),
        clipped_share_max: tally.clipped_share_max,
        unreachable_share_max: tally.unreachable_share_max,
        lasers: LaserSummary { lit_in_part: down.counts.lit_in_part, box_lost, ..tally.lasers.finish() },
        lasers_dark_at_end: down.lasers_dark,
        lasers_not_dark,
        flat_at_end: down.flat_presented,
        records_lost: down.counts.lost + records_lost.load(Ordering::Relaxed),
    };
    Ok(SessionReport { summary, t_origin: limits.t_origin, shown, encoder })
}

/// What a person must do where a laser box did not acknowledge darkness, for the reason `why`.
pub fn not_dark(why: &str) -> String {
    format!("the lasers did not acknowledge darkness at the end: {why}; look at them, and switch them off by hand")
}

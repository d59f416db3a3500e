//! `holod status`: what the running daemon says of itself.

use crate::cli::StatusArgs;
use crate::failure::Failure;
use crate::report;
use crate::session::Spread;
use crate::status::{self, Status};

pub(super) fn status(args: &StatusArgs) -> Result<(), Failure> {
    let (status, stale) = status::of_running()?;
    if let Some(age) = stale {
        tracing::warn!(
            "process {} wrote its status {:.0} s ago: its loop does not turn",
            status.pid,
            age.as_secs_f64()
        );
    }
    if args.json { report::print_json(&status) } else { report::print(&text_of(&status)) }
}

fn text_of(status: &Status) -> String {
    let spread = |spread: Option<Spread>| {
        spread.map_or("not measured".to_owned(), |s| format!("median {:.1} ms, p99 {:.1} ms", s.median_ms, s.p99_ms))
    };
    let counts: Vec<_> = status
        .tracker_counts
        .iter()
        .filter(|(_, count)| **count > 0)
        .map(|(name, count)| format!("{name} {count}"))
        .collect();
    format!(
        "{} for {:.0} s, process {}, {}\n\
         pupil    {}, {}\n\
         tracker  {}: link {}{}\n\
         \x20        {}\n\
         frames   {} made, {} shown, {} late\n\
         time     per frame {}; tracker sample to photons {}",
        status.state,
        status.uptime_s,
        status.pid,
        status.rig,
        status.pupil_mm.map_or("none yet".to_owned(), |mm| format!("{mm:.2} mm")),
        status.pupil_state,
        status.tracker,
        status.tracker_link,
        status.tracker_trouble.as_ref().map_or(String::new(), |trouble| format!("; {trouble}")),
        counts.join(", "),
        status.frames_made,
        status.frames_shown,
        status.deadline_misses,
        spread(status.frame_time),
        spread(status.sample_to_photon),
    )
}

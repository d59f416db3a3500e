//! `holod status`: what the running daemon says of itself.

use crate::cli::StatusArgs;
use crate::failure::{Exit, Failure};
use crate::report;
use crate::session::Spread;
use crate::status::{self, Found, Status};

pub(super) fn status(args: &StatusArgs) -> Result<(), Failure> {
    let mut running = status::of_running()?;
    if let Some(pid) = args.pid {
        running.retain(|found| found.status.pid == pid);
    }
    for Found { status, stale } in &running {
        if let Some(age) = stale {
            let (pid, age_s) = (status.pid, age.as_secs_f64());
            tracing::warn!("process {pid} wrote its status {age_s:.0} s ago: its loop does not turn");
        }
    }
    match (&running[..], args.json) {
        ([], _) => Err(Failure::new(Exit::Unavailable, "no holod of that process number is running")),
        ([one], true) => report::print_json(&one.status),
        (several, true) => {
            let pids: Vec<_> = several.iter().map(|found| found.status.pid.to_string()).collect();
            Err(Failure::new(
                Exit::Usage,
                format!("{} holods are running, {}: name one with --pid", pids.len(), pids.join(" and ")),
            ))
        }
        (several, false) => {
            let texts: Vec<_> = several.iter().map(|found| text_of(&found.status)).collect();
            report::print(&texts.join("\n\n"))
        }
    }
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
         panel    {}: {:.2} refreshes a second{}\n\
         lasers   {}{}\n\
         engine   {}\n\
         frames   {:.1} a second of the panel's {:.1}{}; {} made, {} shown, {} late\n\
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
        status.panel,
        status.panel_refresh_hz,
        status.panel_trouble.as_ref().map_or(String::new(), |trouble| format!("; lost: {trouble}")),
        status.lasers,
        status.lasers_trouble.as_ref().map_or(String::new(), |trouble| format!("; {trouble}")),
        status.engine,
        status.frames_shown_hz,
        status.panel_frames_hz,
        status.speed_advice.as_ref().map_or(String::new(), |advice| format!(" ({advice})")),
        status.frames_made,
        status.frames_shown,
        status.deadline_misses,
        spread(status.frame_time),
        spread(status.sample_to_photon),
    )
}

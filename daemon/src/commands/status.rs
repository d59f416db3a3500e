//! `holod status`: what the running daemon says of itself.

use crate::cli::StatusArgs;
use crate::failure::{Exit, Failure};
use crate::snapshot::{Snapshot, SnapshotNow};
use crate::status::{self, Found};
use crate::{results, run_text};

pub(super) fn status(args: &StatusArgs) -> Result<(), Failure> {
    let running = status::of_running_as(args.pid)?;
    if args.json {
        let Found { status, stale, .. } = status::only(&running)?;
        if let Some(status) = status {
            results::print_json(&SnapshotNow { snapshot: status, stale_s: stale.map(|age| age.as_secs_f64()) })?;
        }
    } else {
        let texts: Vec<_> = running.iter().filter_map(|found| found.status.as_ref()).map(text_of).collect();
        if !texts.is_empty() {
            results::print(&texts.join("\n\n"))?;
        }
    }
    let troubles: Vec<_> = running.iter().filter_map(trouble_of).collect();
    if troubles.is_empty() { Ok(()) } else { Err(Failure::new(Exit::Unavailable, troubles.join("\n"))) }
}

/// Why a status does not say how the run is now.
fn trouble_of(Found { pid, status, stale, .. }: &Found) -> Option<String> {
    match (status, stale) {
        (None, _) => Some(format!(
            "process {pid} runs, but its status cannot be understood: is it of another version? `holod ctl --pid {pid}` \
             may reach it"
        )),
        (Some(_), Some(age)) => Some(format!(
            "process {pid} wrote its status {:.0} s ago: its loop does not turn; the lasers may be lit: `holod dark \
             --config RIG` puts them out beside it",
            age.as_secs_f64()
        )),
        (Some(_), None) => None,
    }
}

fn text_of(status: &Snapshot) -> String {
    let figures = &status.figures;
    let counts: Vec<_> = figures
        .tracker_counts
        .iter()
        .filter(|(_, count)| **count > 0)
        .map(|(name, count)| format!("{name} {count}"))
        .collect();
    let feed = figures.feed.as_ref().map_or(String::new(), |feed| {
        let shown = match &feed.shown {
            Some(name) => format!("`{name}` is shown, of {}", feed.clients.len()),
            None => format!("nobody is shown, {} connected", feed.clients.len()),
        };
        let view = feed.view.text().map_or(String::new(), |view| format!("; {view}"));
        let age = feed.newest_age_s.map_or(String::new(), |age_s| format!("; newest {age_s:.1} s ago"));
        format!(
            "\nfeed     {}: {shown}{age}{view}\n\
             \x20        {}; picture to photons {}",
            feed.socket.display(),
            run_text::feed_text(feed),
            run_text::spread_text(figures.picture_to_photon)
        )
    });
    let record = figures.record.as_ref().map_or(String::new(), |record| format!("\nrecord   {}", record.text()));
    format!(
        "{}, up for {:.0} s, process {}, {}{}\n\
         pupil    {}, {}; eye: {}\n\
         tracker  {}: link {}{}\n\
         \x20        {}\n\
         panel    {}: {:.2} refreshes a second{}\n\
         lasers   {}{}{}\n\
         engine   {}; weights {}\n\
         frames   {} a second of the panel's {:.1}{}; {} made, {} of them computed, {} shown, {} late\n\
         time     per frame {}; tracker sample to photons {}{feed}{record}",
        status.state,
        status.uptime_s,
        status.pid,
        figures.rig,
        match &status.pattern {
            Some(name) => format!("; in place of holograms a pattern is shown: {name}"),
            None if status.paused => "; the picture stands still".to_owned(),
            None => String::new(),
        },
        status.pupil_mm.map_or("none yet".to_owned(), |mm| format!("{mm:.2} mm")),
        status.pupil_state,
        status.eye,
        figures.tracker,
        figures.tracker_link,
        figures.tracker_trouble.as_ref().map_or(String::new(), |trouble| format!("; {trouble}")),
        counts.join(", "),
        status.panel,
        figures.panel_refresh_hz,
        status.panel_trouble.as_ref().map_or(String::new(), |trouble| format!("; lost: {trouble}")),
        status.lasers,
        match &status.feed_trouble {
            _ if status.lasers_kept_dark => ", kept dark by `holod ctl lasers dark`",
            Some(_) => ", kept dark as the live feed gives no pictures",
            None => "",
        },
        status
            .lasers_trouble
            .as_ref()
            .or(status.unlit.as_ref())
            .map_or(String::new(), |trouble| format!("; {trouble}")),
        figures.engine,
        figures.weights,
        status.frames_shown_hz.map_or("not known yet how many".to_owned(), |hz| format!("{hz:.1}")),
        figures.panel_frames_hz,
        figures.speed_advice.as_ref().map_or(String::new(), |advice| format!(" ({advice})")),
        figures.frames_made,
        figures.frames_computed,
        figures.frames_shown,
        figures.deadline_misses,
        run_text::spread_text(figures.frame_time),
        run_text::spread_text(figures.sample_to_photon),
    )
}

//! What a command says: text or JSON on standard output, and files that are written beside and renamed.

use std::io::{self, Write};
use std::path::Path;

use image::RgbImage;
use serde::Serialize;

use holod_calibration::write_atomically;

use crate::failure::{Exit, Failure};
use crate::logging;
use crate::session::{Spread, Summary};
use crate::source::feed::FeedStatus;

/// Prints lines on standard output, after what was said on standard error before. A reader that has gone away is no failure.
///
/// # Errors
/// Standard output cannot be written.
pub fn print(text: &str) -> Result<(), Failure> {
    match write_stdout(text) {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => Err(stdout_failure(&error)),
        _ => Ok(()),
    }
}

/// The same, of what nobody can ask for a second time: a reader that has gone away is a failure, too.
///
/// # Errors
/// Standard output cannot be written.
pub fn print_for_good(text: &str) -> Result<(), Failure> {
    write_stdout(text).map_err(|error| stdout_failure(&error))
}

fn write_stdout(text: &str) -> io::Result<()> {
    logging::flush();
    let mut stdout = io::stdout().lock();
    writeln!(stdout, "{text}").and_then(|()| stdout.flush())
}

/// Standard output takes no more.
pub fn stdout_failure(error: &io::Error) -> Failure {
    Failure::new(Exit::Output, format!("cannot write to standard output: {error}"))
}

/// Prints a value as JSON.
pub fn print_json(value: &impl Serialize) -> Result<(), Failure> {
    print(&to_json(value)?)
}

/// Saves a value as JSON.
pub fn save_json(value: &impl Serialize, path: &Path) -> Result<(), Failure> {
    let text = to_json(value)? + "\n";
    save(text.as_bytes(), path)
}

/// Saves a picture as PNG.
pub fn save_png(picture: &RgbImage, path: &Path) -> Result<(), Failure> {
    let mut bytes = io::Cursor::new(Vec::new());
    picture
        .write_to(&mut bytes, image::ImageFormat::Png)
        .map_err(|error| Failure::new(Exit::Software, format!("{}: {error}", path.display())))?;
    save(bytes.get_ref(), path)
}

fn save(bytes: &[u8], path: &Path) -> Result<(), Failure> {
    let cannot = |error| Failure::new(Exit::CannotCreate, format!("{}: {error}", path.display()));
    write_atomically(path, |out| out.write_all(bytes)).map_err(cannot)
}

/// A value as JSON.
///
/// # Errors
/// It has no such form.
pub fn to_json(value: &impl Serialize) -> Result<String, Failure> {
    serde_json::to_string_pretty(value).map_err(Failure::because(Exit::Software))
}

/// Median and tail in words.
pub fn spread_text(spread: Option<Spread>) -> String {
    spread.map_or("not measured".to_owned(), |s| format!("median {:.1} ms, p99 {:.1} ms", s.median_ms, s.p99_ms))
}

/// What became of a feed's pictures.
pub fn feed_text(feed: &FeedStatus) -> String {
    let bad_depths = match feed.pictures_with_bad_depths {
        0 => String::new(),
        pictures => format!("; bad depths in {pictures} of them: {} pixels", feed.bad_depths_in_all.text()),
    };
    let refusal = feed.last_refusal.as_ref().map_or(String::new(), |why| format!("; refused last: {why}"));
    format!(
        "{} pictures taken, {} overtaken, {} refused, {} of clients not shown, {} left out by clients; {} \
         connections refused{bad_depths}{refusal}",
        feed.taken, feed.overtaken, feed.refused, feed.not_shown, feed.left_out, feed.connections_refused,
    )
}

/// A run in a few lines.
pub fn summary_text(summary: &Summary) -> String {
    let states: Vec<String> =
        summary.frames_by_pupil_state.iter().map(|(state, count)| format!("{count} {state}")).collect();
    let pupils = summary.pupil_range_mm.map_or("none".to_owned(), |[a, b]| format!("{a:.2} to {b:.2} mm"));
    let (figures, lasers) = (&summary.figures, &summary.lasers);
    let slow = figures.speed_advice.as_ref().map_or(String::new(), |advice| format!("\n          {advice}"));
    let mut trouble =
        figures.tracker_trouble.as_ref().map_or(String::new(), |trouble| format!("\n          {trouble}"));
    if summary.tracker_records_lost > 0 {
        let lost = summary.tracker_records_lost;
        trouble.push_str(&format!("\n          the recording lost {lost} pieces: the disk is too slow for it"));
    }
    let feed = figures.feed.as_ref().map_or(String::new(), |feed| {
        format!("\nfeed      {}; picture to photons {}", feed_text(feed), spread_text(figures.picture_to_photon))
    });
    let record = figures.record.as_ref().map_or(String::new(), |record| format!("\nrecord    {}", record.text()));
    format!(
        "ended by {} after {:.1} s\n\
         frames    {} made, {} shown ({} late), {:.1} a second of the panel's {:.1}; {} colour fields shown, {} of them \
         repetitions{slow}\n\
         pupil     {pupils}; frames: {}\n\
         tracker   {}: link {}, {} samples, {} rejected{trouble}{feed}\n\
         time      per frame {}; tracker sample to photons {}\n\
         lasers    {} fields judged: {} lit by their own colour, {} kept dark, {} faults of which {} unsafe\n\
         shutdown  lasers dark: {}; flat pattern on the panel: {}{record}",
        summary.ended_by,
        summary.duration_s,
        figures.frames_made,
        figures.frames_shown,
        figures.deadline_misses,
        summary.frames_shown_hz,
        figures.panel_frames_hz,
        summary.fields_shown,
        summary.fields_repeated,
        states.join(", "),
        figures.tracker,
        figures.tracker_link,
        figures.tracker_counts.get("samples").copied().unwrap_or(0),
        summary.samples_rejected,
        spread_text(figures.frame_time),
        spread_text(figures.sample_to_photon),
        lasers.fields,
        lasers.lit,
        lasers.dark,
        lasers.findings_in_all,
        lasers.unsafe_findings,
        summary.lasers_not_dark.as_ref().map_or("true".to_owned(), |why| format!("false ({why})")),
        summary.flat_at_end,
    )
}

//! A run in words.

use crate::session::Summary;
use crate::source::feed::FeedStatus;
use crate::spread::Spread;

/// Median and tail in words, and of how many frames: where little is computed they may be those of a run's start.
pub(crate) fn spread_text(spread: Option<Spread>) -> String {
    let Some(Spread { median_ms, p99_ms, max_ms, values }) = spread else { return "not measured".to_owned() };
    let frames = match values {
        1 => "one frame".to_owned(),
        _ if values > Spread::NEWEST as u64 => {
            format!("the newest {} frames, longest ever {max_ms:.1} ms", Spread::NEWEST)
        }
        _ => format!("{values} frames"),
    };
    format!("median {median_ms:.1} ms, p99 {p99_ms:.1} ms of {frames}")
}

/// What became of a feed's pictures.
pub(crate) fn feed_text(feed: &FeedStatus) -> String {
    let bad_depths = match feed.pictures_with_bad_depths {
        0 => String::new(),
        pictures => format!("; bad depths in {pictures} pictures: {} pixels", feed.bad_depths_in_all.text()),
    };
    let clipped = match feed.pictures_with_clipped_colours {
        0 => String::new(),
        pictures => {
            format!("; colours clipped in {pictures} pictures, in pixels: {}", feed.clipped_colours_in_all.text())
        }
    };
    let refusal = feed.last_refusal.as_ref().map_or(String::new(), |why| format!("; refused last: {why}"));
    format!(
        "{} pictures taken, {} overtaken, {} refused, {} of clients not shown, {} left out by clients; {} \
         connections refused{bad_depths}{clipped}{refusal}",
        feed.taken, feed.overtaken, feed.refused, feed.not_shown, feed.left_out, feed.connections_refused,
    )
}

/// A run in a few lines.
pub(crate) fn summary_text(summary: &Summary) -> String {
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
    let not_told = match lasers.not_told {
        0 => String::new(),
        fields => format!("; of {fields} more the lasers tell nothing, they are simply on"),
    };
    let box_lost = lasers.box_lost.map_or(String::new(), |lost| format!("; {}", lost.text()));
    format!(
        "ended by {} after {:.1} s\n\
         frames    {} made, {} of them computed, {} shown ({} late), {:.1} a second of the panel's {:.1}; {} colour fields shown, {} of them \
         repetitions{slow}\n\
         pupil     {pupils}; frames: {}\n\
         tracker   {}: link {}, {} samples, {} rejected{trouble}{feed}\n\
         time      per frame {}; tracker sample to photons {}\n\
         lasers    {} fields judged: {} lit by their own colour, {} kept dark, {} faults of which {} unsafe{not_told}{box_lost}\n\
         shutdown  lasers dark: {}; flat pattern on the panel: {}{record}",
        summary.ended_by,
        summary.duration_s,
        figures.frames_made,
        figures.frames_computed,
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_say_of_how_many_frames_they_are() {
        let text = |values| spread_text(Some(Spread { median_ms: 0.5, p99_ms: 3.25, max_ms: 75.5, values }));
        assert_eq!(text(1), "median 0.5 ms, p99 3.2 ms of one frame");
        assert_eq!(text(16_384), "median 0.5 ms, p99 3.2 ms of 16384 frames");
        assert_eq!(text(16_385), "median 0.5 ms, p99 3.2 ms of the newest 16384 frames, longest ever 75.5 ms");
        assert_eq!(spread_text(None), "not measured");
    }
}

//! Whether the time that a compositor tells is reported for the picture that was scanned out then: lasers are lit by it.

use holod_calibration::rig::PanelMode;
use holod_calibration::{Colour, TimeNs, host_now};
use holod_slm_output::present::window::{DisplayServer, Road};
use holod_slm_output::present::{PresentedRefresh, TimestampSource, WindowSpec};

use super::bench::{Bench, SIZE, levels};
use super::stamping_compositor::{Flip, Manner, PANEL, StampingCompositor, Times};

/// The panel's field order.
const ORDER: [Colour; 3] = [Colour::Green, Colour::Red, Colour::Blue];

fn open(compositor: &StampingCompositor, mode: PanelMode) -> Bench {
    let spec = WindowSpec { monitor: Some(PANEL.to_owned()), allow_primary: true };
    Bench::open(DisplayServer::Wayland(compositor.socket()), Road::Copies, &spec, mode).unwrap()
}

/// What is reported of twenty frames, each of which is shown for about six refreshes.
fn reports(bench: &mut Bench) -> Vec<PresentedRefresh> {
    let mut reports = Vec::new();
    for _ in 0..20 {
        bench.submit();
        let mut left = 6;
        let reported = bench.run(|refresh| {
            assert!(refresh.t_present <= host_now(), "what is still to come is reported then");
            left -= 1;
            left == 0
        });
        reports.extend(reported.unwrap());
    }
    reports
}

/// The first row of pixels that `report` says is on the monitor: blue, green and red of each.
fn row(report: &PresentedRefresh, mode: PanelMode) -> Option<Vec<[u8; 3]>> {
    let frame = report.frame?.frame_id;
    // Red, green and blue.
    let channels = match mode {
        PanelMode::FieldSequential => [ORDER[report.field]; 3],
        _ => ORDER,
    };
    let [red, green, blue] = channels.map(|colour| levels(frame, colour));
    let pixels = (0..SIZE.width).map(|pixel| [blue[pixel] as u8, green[pixel] as u8, red[pixel] as u8]);
    Some(pixels.collect())
}

/// Reports of frames over another picture than was scanned out at their time, and how many there are.
fn wrong(reports: &[PresentedRefresh], flips: &[Flip], mode: PanelMode) -> [usize; 2] {
    let of_frames: Vec<_> = reports.iter().filter_map(|report| Some((report, row(report, mode)?))).collect();
    let is_wrong = |(report, row): &&(&PresentedRefresh, Vec<[u8; 3]>)| {
        let flip = flips.iter().find(|flip| flip.t_present == report.t_present);
        flip.is_none_or(|flip| flip.row != *row)
    };
    [of_frames.iter().filter(is_wrong).count(), of_frames.len()]
}

/// Of refreshes that are told late and early.
const TOLD_AFTER: [TimeNs; 2] = [TimeNs(300_000), TimeNs(-700_000)];

#[test]
fn a_time_is_reported_for_the_picture_that_was_scanned_out_then() {
    for (told_after, mode) in TOLD_AFTER.into_iter().zip([PanelMode::FieldSequential, PanelMode::ChannelPacked]) {
        let compositor = StampingCompositor::start(Manner { told_after, ..Manner::default() });
        let mut bench = open(&compositor, mode);
        let reports = reports(&mut bench);
        assert!(reports.iter().all(|report| report.timestamp_source == TimestampSource::Driver), "{reports:?}");
        let mut flips = compositor.flips();
        let [found, judged] = wrong(&reports, &flips, mode);
        assert!(found == 0 && judged >= 100, "{mode:?}: {found} of {judged} are wrong");
        // Canary: the pictures of the refreshes before.
        for later in (1..flips.len()).rev() {
            flips[later].row = flips[later - 1].row.clone();
        }
        let [found, _] = wrong(&reports, &flips, mode);
        assert!(found >= 20, "{mode:?}: only {found} of {judged} are seen to be wrong");
    }
}

#[test]
fn a_picture_that_was_left_out_is_presented_again_before_the_next() {
    for mode in [PanelMode::FieldSequential, PanelMode::ChannelPacked] {
        let manner = Manner { told_after: TOLD_AFTER[0], leaves_out: Some(5), ..Manner::default() };
        let compositor = StampingCompositor::start(manner);
        let mut bench = open(&compositor, mode);
        let reports = reports(&mut bench);
        let [found, judged] = wrong(&reports, &compositor.flips(), mode);
        assert!(found == 0 && judged >= 100, "{mode:?}: {found} of {judged} are wrong");
        let fields = if mode == PanelMode::FieldSequential { 3 } else { 1 };
        for pair in reports.windows(2) {
            assert_eq!(pair[1].field, (pair[0].field + 1) % fields, "{mode:?}: {pair:?}");
            // Only what was there is there again.
            let is_new = pair[1].field == 0 && pair[1].frame != pair[0].frame;
            assert!(!(is_new && pair[1].repeated), "{mode:?}: {pair:?}");
        }
    }
}

#[test]
fn of_a_compositor_that_tells_no_times_pictures_are_shown_in_its_rhythm_and_none_is_stamped() {
    for times in [Times::Denied, Times::Unanswered] {
        let compositor = StampingCompositor::start(Manner { times, ..Manner::default() });
        let mut bench = open(&compositor, PanelMode::ChannelPacked);
        let reports = reports(&mut bench);
        assert!(reports.iter().all(|report| report.timestamp_source == TimestampSource::Software), "{times:?}");
        let mut apart: Vec<_> = reports.windows(2).map(|pair| pair[1].t_present - pair[0].t_present).collect();
        let mean_ms = apart.iter().map(|apart| apart.0).sum::<i64>() as f64 / 1e6 / apart.len() as f64;
        apart.sort();
        let median_ms = apart[apart.len() / 2].0 as f64 / 1e6;
        // A busy machine misses refreshes, and shows none sooner.
        assert!(
            mean_ms >= 16.0 && median_ms < 20.0,
            "{times:?}: {mean_ms} ms between pictures in the mean, {median_ms} ms in the middle"
        );
    }
}

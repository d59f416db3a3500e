//! The run's figures for Prometheus, as OpenMetrics text: base units, counters that only grow, histograms of latency.

mod process;

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use holod_calibration::host_now;
use prometheus_client::collector::Collector;
use prometheus_client::encoding::{DescriptorEncoder, EncodeLabelSet, EncodeMetric, text};
use prometheus_client::metrics::counter::ConstCounter;
use prometheus_client::metrics::gauge::ConstGauge;
use prometheus_client::metrics::info::Info;
use prometheus_client::registry::{Registry, Unit};

use self::process::OfProcess;
use super::latencies::Latencies;
use super::live::Live;
use crate::frame_state::FrameState;
use crate::logging;
use crate::snapshot::RecordCondition;
use crate::snapshot::Snapshot;
use crate::source::feed::FeedStatus;

/// What scrapers of OpenMetrics expect.
pub(super) const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// What is told of the run that `live` follows.
pub(super) fn registry(live: &Arc<Live>) -> Registry {
    let mut all = Registry::default();
    all.register_collector(Box::new(OfProcess));
    let registry = all.sub_registry_with_prefix("holod");
    let seconds = || Unit::Seconds;
    let Latencies { frame, sample_to_photon, picture_to_photon } = &live.latencies;
    registry.register_with_unit("frame", "From waking to the submitted levels", seconds(), frame.clone());
    registry.register_with_unit(
        "sample_to_photon",
        "From the newest believed tracker sample behind a frame to the middle of its first light",
        seconds(),
        sample_to_photon.clone(),
    );
    registry.register_with_unit(
        "picture_to_photon",
        "From when a feed's client took a picture to the middle of its first light",
        seconds(),
        picture_to_photon.clone(),
    );
    registry.register_collector(Box::new(OfSnapshot(Arc::clone(live))));
    all
}

/// All of them as text.
pub(super) fn text(registry: &Registry) -> String {
    let mut page = String::new();
    text::encode(&mut page, registry).expect("a string takes everything");
    page
}

/// Figures that are read off the newest snapshot when they are asked for.
struct OfSnapshot(Arc<Live>);

impl fmt::Debug for OfSnapshot {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("OfSnapshot")
    }
}

impl Collector for OfSnapshot {
    fn encode(&self, encoder: DescriptorEncoder) -> fmt::Result {
        let mut told = Teller(encoder);
        let live = &self.0;
        let viewers = live.viewers.load(Ordering::Relaxed) as f64;
        told.gauge("page_viewers", "Browsers that watch the status page", None, viewers)?;
        told.counters("page_refused", "Requests that the status page refused", "reason", live.refused.each())?;
        told.counter("log_lines_lost", "Lines that standard error did not take", logging::lines_lost())?;
        match &*live.snapshot.load() {
            Some(published) => {
                let age_s = (host_now() - published.t).seconds();
                told.gauge("snapshot_age", "How old the figures of the run are", Some(Unit::Seconds), age_s)?;
                of_run(&mut told, &published.snapshot)
            }
            None => Ok(()),
        }
    }
}

fn of_run(told: &mut Teller<'_>, snapshot: &Snapshot) -> fmt::Result {
    let figures = &snapshot.figures;
    told.info(
        "build",
        "What runs",
        &[
            ("version", env!("CARGO_PKG_VERSION")),
            ("rig", &figures.rig),
            ("scene", &figures.scene),
            ("weights", &figures.weights),
            ("engine", &figures.engine),
            ("hologram", &figures.hologram),
            ("panel", &snapshot.panel),
            ("tracker", &figures.tracker),
        ],
    )?;
    of_states(told, snapshot)?;
    told.gauge("uptime", "How long it has run", Some(Unit::Seconds), snapshot.uptime_s)?;
    if let Some(pupil_mm) = snapshot.pupil_mm {
        let metres = f64::from(pupil_mm) / 1e3;
        told.gauge("pupil_diameter", "The pupil that the newest frame was made for", Some(Unit::Meters), metres)?;
    }
    let hertz = || Some(Unit::Other("hertz".into()));
    told.gauge("panel_refresh", "What the panel reports", hertz(), figures.panel_refresh_hz)?;
    told.gauge("panel_frame", "Frames of all colours that the panel could show", hertz(), figures.panel_frames_hz)?;
    told.counter("frames_made", "Frames that were made", figures.frames_made)?;
    told.counter("frames_computed", "Of those, frames whose levels were computed", figures.frames_computed)?;
    told.counter("frames_shown", "Frames that came on the panel", figures.frames_shown)?;
    told.counter("deadline_misses", "Frames that came later than planned", figures.deadline_misses)?;
    of_tracker(told, &figures.tracker_counts)?;
    told.counters(
        "control_refused",
        "Orders on the control socket that were not carried out",
        "reason",
        named(&snapshot.orders_refused),
    )?;
    if let Some(record) = &figures.record {
        let lost = f64::from(u8::from(record.state == RecordCondition::Lost));
        told.gauge("record_lost", "Whether the record was given up", None, lost)?;
        told.counter("record_rows_lost", "Rows of the record that a slow disk left out", record.rows_lost)?;
    }
    figures.feed.as_ref().map_or(Ok(()), |feed| of_feed(told, feed))
}

/// How the run and its parts are: one of several states, or whether something is so.
fn of_states(told: &mut Teller<'_>, snapshot: &Snapshot) -> fmt::Result {
    told.states("state", "How the run is", &["dark", "running", "degraded"], &snapshot.state)?;
    told.states(
        "tracker_link",
        "How the tracker's link is",
        &["up", "silent", "down", "finished"],
        &snapshot.figures.tracker_link,
    )?;
    let pupil_states = FrameState::OF_A_RUN.map(FrameState::name);
    told.states("pupil_state", "What the pupil rests on", &pupil_states, &snapshot.pupil_state)?;
    for (name, help, is_so) in [
        ("lasers_armed", "Whether lasers may be lit", snapshot.lasers == "armed"),
        ("lasers_kept_dark", "Whether a person keeps the lasers dark", snapshot.lasers_kept_dark),
        (
            "feed_keeps_dark",
            "Whether lasers are dark as the live feed gives no pictures",
            snapshot.feed_trouble.is_some(),
        ),
        ("laser_box_lost", "Whether something is wrong with the laser box", snapshot.lasers_trouble.is_some()),
        ("panel_lost", "Whether the panel is lost", snapshot.panel_trouble.is_some()),
        ("paused", "Whether the picture stands still", snapshot.paused),
    ] {
        told.gauge(name, help, None, f64::from(u8::from(is_so)))?;
    }
    Ok(())
}

fn of_feed(told: &mut Teller<'_>, feed: &FeedStatus) -> fmt::Result {
    told.gauge("feed_clients", "Clients of the live feed", None, feed.clients.len() as f64)?;
    let pictures = [
        ("taken", feed.taken),
        ("overtaken", feed.overtaken),
        ("refused", feed.refused),
        ("not_shown", feed.not_shown),
        ("left_out", feed.left_out),
    ];
    told.counters("feed_pictures", "Pictures of the live feed, by what became of them", "fate", pictures)?;
    let bad = feed.bad_depths_in_all.entries();
    told.counters("feed_bad_depth_pixels", "Depths that cannot be shown as they are, by what they are", "kind", bad)?;
    told.counter("feed_bad_depth_pictures", "Pictures that have some", feed.pictures_with_bad_depths)?;
    let clipped = feed.clipped_colours_in_all.entries();
    told.counters("feed_clipped_colour_pixels", "Pixels with colours that were clipped, by how", "kind", clipped)?;
    told.counter("feed_clipped_colour_pictures", "Pictures that have some", feed.pictures_with_clipped_colours)?;
    told.counters(
        "feed_connections_refused",
        "Connections that were refused or broken off",
        "reason",
        named(&feed.connections_refused_by),
    )
}

/// What came of the tracker, what was not believed of it and why, and what else happened. What can be added up is one
/// figure with a label, all else has a name of its own.
fn of_tracker(told: &mut Teller<'_>, counts: &BTreeMap<String, u64>) -> fmt::Result {
    let (mut rejected, mut faulty, mut events) = (Vec::new(), Vec::new(), Vec::new());
    for (name, count) in named(counts) {
        match (name, name.strip_prefix("rejected_")) {
            ("bytes", _) => {
                let received = ConstCounter::new(count);
                told.tell("tracker_received", "What the tracker sent", Some(Unit::Bytes), &received)?;
            }
            ("samples", _) => told.counter("tracker_samples", "Samples of the tracker", count)?,
            ("accepted", _) => told.counter("tracker_accepted_samples", "Samples that were believed", count)?,
            // It falls where a gap is filled.
            ("sequence_gaps", _) => {
                let help = "Gaps in the running numbers that have not been filled";
                told.gauge("tracker_sequence_gaps", help, None, count as f64)?;
            }
            ("sequence_missing", _) => {
                let overtaken = counts.get("sequence_overtaken").copied().unwrap_or(0);
                events.push(("sequence_skipped", count + overtaken));
            }
            (_, Some(reason)) => rejected.push((reason, count)),
            (fault, None) if fault.starts_with("wire_") || fault.starts_with("log_") => faulty.push((fault, count)),
            (event, None) => events.push((event, count)),
        }
    }
    told.counters("tracker_rejected_samples", "Samples that were not believed", "reason", rejected)?;
    told.counters("tracker_faulty_messages", "Messages that held no sample", "reason", faulty)?;
    told.counters("tracker_events", "What else happened at the tracker's link", "event", events)
}

fn named(counts: &BTreeMap<String, u64>) -> impl Iterator<Item = (&str, u64)> {
    counts.iter().map(|(name, count)| (name.as_str(), *count))
}

struct Teller<'a>(DescriptorEncoder<'a>);

impl Teller<'_> {
    fn gauge(&mut self, name: &str, help: &str, unit: Option<Unit>, value: f64) -> fmt::Result {
        self.tell(name, help, unit, &ConstGauge::new(value))
    }

    fn counter(&mut self, name: &str, help: &str, value: u64) -> fmt::Result {
        self.tell(name, help, None, &ConstCounter::new(value))
    }

    fn info(&mut self, name: &str, help: &str, labels: &[(&str, &str)]) -> fmt::Result {
        let labels: Vec<(String, String)> = labels.iter().map(|&(key, value)| (key.into(), value.into())).collect();
        self.tell(name, help, None, &Info::new(labels))
    }

    fn tell(&mut self, name: &str, help: &str, unit: Option<Unit>, metric: &impl EncodeMetric) -> fmt::Result {
        metric.encode(self.0.encode_descriptor(name, help, unit.as_ref(), metric.metric_type())?)
    }

    fn counters<'c>(
        &mut self,
        name: &str,
        help: &str,
        label: &str,
        counts: impl IntoIterator<Item = (&'c str, u64)>,
    ) -> fmt::Result {
        let each = counts.into_iter().map(|(which, count)| ([(label, which)], ConstCounter::new(count)));
        self.family(name, help, each)
    }

    /// 1 for the state that holds.
    fn states(&mut self, name: &str, help: &str, states: &[&str], holds: &str) -> fmt::Result {
        let each = states.iter().map(|state| ([("is", *state)], ConstGauge::new(i64::from(*state == holds))));
        self.family(name, help, each)
    }

    fn family<L: EncodeLabelSet, M: EncodeMetric>(
        &mut self,
        name: &str,
        help: &str,
        each: impl Iterator<Item = (L, M)>,
    ) -> fmt::Result {
        let mut each = each.peekable();
        let Some((_, first)) = each.peek() else { return Ok(()) };
        let mut family = self.0.encode_descriptor(name, help, None, first.metric_type())?;
        for (labels, metric) in each {
            metric.encode(family.encode_family(&labels)?)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use holod_pupil_input::Rejection;

    use super::super::live::Refused;
    use super::*;
    use crate::snapshot::RecordState;
    use crate::source::feed::ClippedPixels;

    #[test]
    fn counters_do_not_fall_where_a_late_sample_fills_a_gap() {
        let told = |missing: u64, overtaken: u64, gaps: u64| {
            let live = Arc::new(Live::default());
            let counts = [("sequence_missing", missing), ("sequence_overtaken", overtaken), ("sequence_gaps", gaps)];
            let mut snapshot = Snapshot::default();
            snapshot.figures.tracker_counts = counts.map(|(name, count)| (name.to_owned(), count)).into();
            live.publish(&snapshot, host_now());
            text(&registry(&live))
        };
        let before = told(3, 0, 2);
        let after = told(2, 1, 1);
        for line in ["# TYPE holod_tracker_sequence_gaps gauge", "holod_tracker_sequence_gaps 2.0"] {
            assert!(before.contains(line), "{line} is not in:\n{before}");
        }
        let counters = |told: &str| -> BTreeMap<String, f64> {
            let samples = told.lines().filter_map(|line| line.rsplit_once(' '));
            let counters = samples.filter(|(name, _)| name.starts_with("holod_tracker_events_total"));
            counters.map(|(name, count)| (name.to_owned(), count.parse().expect("a figure"))).collect()
        };
        let (before, after) = (counters(&before), counters(&after));
        assert_eq!(before["holod_tracker_events_total{event=\"sequence_skipped\"}"], 3.0);
        assert_eq!(after["holod_tracker_events_total{event=\"sequence_overtaken\"}"], 1.0);
        assert!(before.iter().all(|(name, count)| after[name] >= *count), "{before:?} {after:?}");
    }

    #[test]
    fn every_figure_stands_in_the_table_of_the_page_about_it() {
        let live = Arc::new(Live::default());
        let mut snapshot = Snapshot { pupil_mm: Some(3.0), ..Snapshot::default() };
        snapshot.orders_refused = [("busy".to_owned(), 5)].into();
        let counts =
            ["bytes", "samples", "accepted", "sequence_gaps", "silences", "wire_bad_checksum", "rejected_blink"];
        snapshot.figures.tracker_counts = counts.map(|name| (name.to_owned(), 1)).into();
        snapshot.figures.record = Some(RecordState::default());
        let mut feed = FeedStatus::default();
        feed.connections_refused_by = [("full".to_owned(), 3)].into();
        snapshot.figures.feed = Some(feed);
        live.publish(&snapshot, host_now());
        let told = text(&registry(&live));
        let figures = told.lines().filter_map(|line| line.strip_prefix("# TYPE ")?.split_once(' '));
        let figures: BTreeSet<_> = figures
            .map(|(name, kind)| match kind {
                "counter" => format!("{name}_total"),
                "info" => format!("{name}_info"),
                _ => name.to_owned(),
            })
            .collect();
        let page = include_str!("../../doc/page.md");
        let rows = page.lines().filter(|line| line.starts_with("| `holod_") || line.starts_with("| `process_"));
        let first_cells = rows.filter_map(|row| row.split('|').nth(1));
        let named = first_cells.flat_map(|cell| cell.split('`').skip(1).step_by(2));
        let named: BTreeSet<_> = named.map(|name| name.split('{').next().unwrap_or_default().to_owned()).collect();
        assert_eq!(named, figures);
    }

    #[test]
    fn rejections_and_refusals_are_told_by_their_reasons() {
        let live = Arc::new(Live::default());
        live.refused.count(Refused::Token);
        let counts = [("bytes", 900), ("samples", 30), ("accepted", 21), ("silences", 2), ("wire_bad_checksum", 4)];
        let mut tracker_counts: BTreeMap<String, u64> = counts.map(|(name, count)| (name.to_owned(), count)).into();
        for (count, reason) in Rejection::ALL.into_iter().enumerate() {
            tracker_counts.insert(format!("rejected_{}", reason.name()), count as u64);
        }
        let mut feed = FeedStatus::default();
        feed.connections_refused_by.insert("full".to_owned(), 3);
        feed.clipped_colours_in_all = ClippedPixels { above_white: 70, below_black: 8 };
        feed.pictures_with_clipped_colours = 2;
        let mut snapshot = Snapshot { orders_refused: [("busy".to_owned(), 5)].into(), ..Snapshot::default() };
        snapshot.figures.tracker_counts = tracker_counts;
        snapshot.figures.feed = Some(feed);
        live.publish(&snapshot, host_now());
        let told = text(&registry(&live));
        let has = |line: &str| told.lines().any(|told| told == line);
        for (count, reason) in Rejection::ALL.into_iter().enumerate() {
            let line = format!("holod_tracker_rejected_samples_total{{reason=\"{}\"}} {count}", reason.name());
            assert!(has(&line), "{line} is not in:\n{told}");
        }
        for line in [
            "holod_tracker_received_bytes_total 900",
            "holod_tracker_samples_total 30",
            "holod_tracker_accepted_samples_total 21",
            "holod_tracker_events_total{event=\"silences\"} 2",
            "holod_tracker_faulty_messages_total{reason=\"wire_bad_checksum\"} 4",
            "holod_page_refused_total{reason=\"token\"} 1",
            "holod_page_refused_total{reason=\"viewers\"} 0",
            "holod_control_refused_total{reason=\"busy\"} 5",
            "holod_feed_connections_refused_total{reason=\"full\"} 3",
            "holod_feed_clipped_colour_pixels_total{kind=\"above_white\"} 70",
            "holod_feed_clipped_colour_pixels_total{kind=\"below_black\"} 8",
            "holod_feed_clipped_colour_pictures_total 2",
        ] {
            assert!(has(line), "{line} is not in:\n{told}");
        }
        assert!(!has("holod_tracker_events_total{event=\"samples\"} 30"), "it cannot be added to other events");
        // The names that Prometheus's own libraries give a process are without a prefix.
        assert!(told.contains("\nprocess_open_fds ") && !told.contains("holod_process"), "{told}");
    }
}

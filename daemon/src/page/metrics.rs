//! The run's figures for Prometheus, as OpenMetrics text: base units, counters that only grow, histograms of latency.

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use holod_calibration::TimeNs;
use prometheus_client::collector::Collector;
use prometheus_client::encoding::{DescriptorEncoder, EncodeLabelSet, EncodeMetric, text};
use prometheus_client::metrics::counter::ConstCounter;
use prometheus_client::metrics::gauge::ConstGauge;
use prometheus_client::metrics::histogram::Histogram;
use prometheus_client::metrics::info::Info;
use prometheus_client::registry::{Registry, Unit};

use super::live::Live;
use crate::session::FirstLight;
use crate::snapshot::Snapshot;

/// What scrapers of OpenMetrics expect.
pub(super) const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// Bounds of the histograms: from a frame of a fast panel to a slide show.
const BOUNDS_S: [f64; 14] = [0.002, 0.004, 0.006, 0.008, 0.012, 0.016, 0.024, 0.032, 0.048, 0.064, 0.1, 0.2, 0.5, 2.0];

/// How long things take.
pub(super) struct Latencies {
    frame: Histogram,
    sample_to_photon: Histogram,
    picture_to_photon: Histogram,
}

impl Default for Latencies {
    fn default() -> Self {
        let histogram = || Histogram::new(BOUNDS_S);
        Self { frame: histogram(), sample_to_photon: histogram(), picture_to_photon: histogram() }
    }
}

impl Latencies {
    pub(super) fn frame(&self, time: TimeNs) {
        self.frame.observe(time.seconds());
    }

    pub(super) fn light(&self, light: &FirstLight) {
        for (histogram, time) in
            [(&self.sample_to_photon, light.sample_to_photon), (&self.picture_to_photon, light.picture_to_photon)]
        {
            if let Some(time) = time {
                histogram.observe(time.seconds());
            }
        }
    }
}

/// What is told of the run that `live` follows.
pub(super) fn registry(live: &Arc<Live>) -> Registry {
    let mut registry = Registry::with_prefix("holod");
    let seconds = || Unit::Seconds;
    let Latencies { frame, sample_to_photon, picture_to_photon } = &live.latencies;
    registry.register_with_unit("frame", "From waking to the submitted levels", seconds(), frame.clone());
    registry.register_with_unit(
        "sample_to_photon",
        "From the newest tracker sample behind a frame to the middle of its first light",
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
    registry
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
        let refused = live.refused.load(Ordering::Relaxed);
        told.counter("page_refused", "Requests that the status page refused", refused)?;
        own_process(&mut told)?;
        match &*live.snapshot.load() {
            Some(snapshot) => of_run(&mut told, snapshot),
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
    told.states("state", "How the run is", &["dark", "running", "degraded"], &snapshot.state)?;
    told.states(
        "tracker_link",
        "How the tracker's link is",
        &["up", "silent", "down", "finished"],
        &figures.tracker_link,
    )?;
    told.states("pupil_state", "What the pupil rests on", &PUPIL_STATES, &snapshot.pupil_state)?;
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
    told.gauge("uptime", "How long it has run", Some(Unit::Seconds), snapshot.uptime_s)?;
    if let Some(pupil_mm) = snapshot.pupil_mm {
        let metres = f64::from(pupil_mm) / 1e3;
        told.gauge("pupil_diameter", "The pupil that the newest frame was made for", Some(Unit::Meters), metres)?;
    }
    let hertz = || Some(Unit::Other("hertz".into()));
    told.gauge("panel_refresh", "What the panel reports", hertz(), figures.panel_refresh_hz)?;
    told.gauge("panel_frame", "Frames of all colours that the panel could show", hertz(), figures.panel_frames_hz)?;
    told.counter("frames_made", "Frames that were made", figures.frames_made)?;
    told.counter("frames_shown", "Frames that came on the panel", figures.frames_shown)?;
    told.counter("deadline_misses", "Frames that came later than planned", figures.deadline_misses)?;
    let counts = figures.tracker_counts.iter().map(|(name, count)| (name.as_str(), *count));
    told.counters("tracker_events", "Samples, connections and rejections by their reason", "event", counts)?;
    let Some(feed) = &figures.feed else { return Ok(()) };
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
    told.counter("feed_connections_refused", "Connections that were refused or broken off", feed.connections_refused)
}

const PUPIL_STATES: [&str; 4] = ["tracking", "holding", "fallback", "fixed"];

/// Memory, descriptors and threads of this process, where the kernel tells them.
fn own_process(told: &mut Teller<'_>) -> fmt::Result {
    let entries = |path| std::fs::read_dir(path).map(|entries| entries.count() as f64);
    let pages = std::fs::read_to_string("/proc/self/statm").ok();
    let resident = pages.and_then(|text| text.split_whitespace().nth(1)?.parse::<f64>().ok());
    if let Some(pages) = resident {
        let bytes = pages * rustix::param::page_size() as f64;
        told.gauge("process_resident_memory", "Memory in use", Some(Unit::Bytes), bytes)?;
    }
    if let Ok(descriptors) = entries("/proc/self/fd") {
        told.gauge("process_open_fds", "Open file descriptors", None, descriptors)?;
    }
    if let Ok(threads) = entries("/proc/self/task") {
        told.gauge("process_threads", "Threads", None, threads)?;
    }
    Ok(())
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

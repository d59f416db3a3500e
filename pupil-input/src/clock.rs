//! The tracker's clock mapped onto the host's.
//!
//! A sample cannot arrive before it was taken, and what delays it (USB frames, FTDI's latency timer, bursts, a network,
//! the scheduler) only ever adds. So over the device's time the offset host − device is a line (a crystal is some parts
//! per million off, a log that a script feeds with sleeps some per cent), and all of `arrival − device` lies on it or
//! above. Of the last 16 s the least of each quarter second is kept. The line's slope is that of the line below all of
//! these points that is closest to them in sum, which is the edge of their lower convex hull below their mean time
//! (Moon, Skelly and Towsley 1999: late points do not move it at all). Its height is the least of the last second along
//! that slope, so that a link whose delay changes is followed soon.
//!
//! What does not fit is not taken into the line at once: a sample that lies far below it (a clock set forward, or one
//! wrong time) or far above (set back, stopped for a while, or one late sample) is a stray. Strays that agree with each
//! other, or that go on for too long without a fitting sample between them, are a reset, and the line begins anew with
//! them.
//!
//! Where the device's clock can be read by itself, such readings hold the line down, and samples lie above it by the
//! delay that all of them have: as long as a camera takes, and a computer for its images. What is far above is judged
//! by the line of the samples alone, which without readings is the same.

use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};

use holod_calibration::TimeNs;

const BUCKETS: usize = 64;
const BUCKET: TimeNs = TimeNs(250_000_000);
/// The least of this many buckets, the newest, decides the height: a second.
const RECENT: usize = 4;
/// Less time than this tells nothing of the slope.
const SLOPE_SPAN_NS: f64 = 0.5e9;
/// A device clock is followed up to this share slower or faster than the host's.
const GREATEST_SLOPE: f64 = 0.3;

/// So far below the line a sample is a stray.
const STRAY_BELOW: TimeNs = TimeNs(50_000_000);
/// So far above the line of the samples a sample is a stray.
const STRAY_ABOVE: TimeNs = TimeNs(150_000_000);
/// A sample before its predecessor in the device's time is one that was overtaken, unless it lies by this or more above
/// the line: then it may be that the clock was set back.
const STRAY_BACKWARDS: TimeNs = TimeNs(30_000_000);
/// A clock that falls by this much has restarted or wrapped: no link keeps a sample for so long.
pub(crate) const RESTART: TimeNs = TimeNs(1_000_000_000);
/// No delay that all samples have is longer.
const LONGEST_DELAY: TimeNs = RESTART;
/// Strays agree when their offsets differ by less.
const AGREEMENT: TimeNs = TimeNs(50_000_000);
/// This many strays that agree are a step forward or a restart.
const AGREEING: u32 = 3;
/// For so long there must have been agreeing strays only, to tell a clock set back from overtaken samples.
const SET_BACK_LASTS: TimeNs = TimeNs(100_000_000);
/// For so long there must have been strays only, of any kind, to give the line up.
const STRAYS_LAST: TimeNs = TimeNs(300_000_000);
/// A line of fewer samples than this that is given up was the beginning of a stream and no reset.
const ESTABLISHED: u64 = 10;
/// No sample is older than this when it arrives.
const OLDEST: TimeNs = TimeNs(60_000_000_000);

/// Maps device times to host times; constant memory. Device times may be any.
#[derive(Clone, Debug)]
pub struct ClockModel {
    /// Of samples and readings.
    line: Line,
    /// Of the samples alone, without readings.
    samples: Line,
    strays: Option<Strays>,
    /// The latest device time that fitted, and what it was mapped to.
    newest: Option<Mapped>,
    /// Delay over the line that 19 of 20 samples stay below.
    spread_ns: f64,
    resets: u64,
    leaps: u64,
}

/// What a [`ClockModel`] has found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClockReport {
    /// Host time less device time, without delay, at the newest sample.
    pub offset: TimeNs,
    /// How much slower the device's clock runs than the host's, parts per million; negative where it runs faster.
    pub drift_ppm: f64,
    /// 19 of 20 samples arrive within this after the quickest ones of their time.
    pub delay_spread: TimeNs,
}

/// The newest [`ClockReport`], for other threads. Its figures may be of neighbouring samples.
#[derive(Debug)]
pub(crate) struct ClockGauge {
    known: AtomicBool,
    offset_ns: AtomicI64,
    drift_ppb: AtomicI64,
    spread_ns: AtomicI64,
}

impl ClockGauge {
    pub(crate) const fn new() -> Self {
        Self {
            known: AtomicBool::new(false),
            offset_ns: AtomicI64::new(0),
            drift_ppb: AtomicI64::new(0),
            spread_ns: AtomicI64::new(0),
        }
    }

    pub(crate) fn set(&self, report: Option<ClockReport>) {
        if let Some(ClockReport { offset, drift_ppm, delay_spread }) = report {
            self.offset_ns.store(offset.0, Ordering::Relaxed);
            self.drift_ppb.store((drift_ppm * 1e3) as i64, Ordering::Relaxed);
            self.spread_ns.store(delay_spread.0, Ordering::Relaxed);
        }
        self.known.store(report.is_some(), Ordering::Release);
    }

    pub(crate) fn get(&self) -> Option<ClockReport> {
        self.known.load(Ordering::Acquire).then(|| ClockReport {
            offset: TimeNs(self.offset_ns.load(Ordering::Relaxed)),
            drift_ppm: self.drift_ppb.load(Ordering::Relaxed) as f64 * 1e-3,
            delay_spread: TimeNs(self.spread_ns.load(Ordering::Relaxed)),
        })
    }
}

#[derive(Clone, Copy, Debug)]
struct Mapped {
    device: TimeNs,
    host: TimeNs,
    arrival: TimeNs,
}

#[derive(Clone, Copy, Debug)]
struct Strays {
    since: TimeNs,
    /// Offset of the newest one.
    offset_ns: i64,
    agreeing: u32,
    agreeing_since: TimeNs,
}

impl Default for ClockModel {
    fn default() -> Self {
        Self::new()
    }
}

impl ClockModel {
    /// A model that knows nothing yet: the first sample is taken to have arrived at once.
    pub const fn new() -> Self {
        let (line, samples) = (Line::new(), Line::new());
        Self { line, samples, strays: None, newest: None, spread_ns: 1e6, resets: 0, leaps: 0 }
    }

    /// Host time at which a sample of device time `device` was taken, given that it arrived at `arrival`; never later
    /// than `arrival`. Samples that come in the order of their device times are mapped in that order, and one that
    /// comes late is not put behind those that it is before.
    pub fn map(&mut self, device: TimeNs, arrival: TimeNs) -> TimeNs {
        // Device times are untrusted and may lie anywhere in i64.
        let offset_ns = arrival.0.saturating_sub(device.0);
        if self.is_stray(device, offset_ns) {
            if !self.is_reset(device, offset_ns, arrival) {
                return self.map_stray(device, offset_ns, arrival);
            }
            *(if self.samples.noted >= ESTABLISHED { &mut self.resets } else { &mut self.leaps }) += 1;
            (self.line, self.samples) = (Line::new(), Line::new());
            self.newest = None;
        }
        self.strays = None;
        self.line.note(device, offset_ns, arrival);
        self.samples.note(device, offset_ns, arrival);
        let excess_ns = self.samples.above(device, offset_ns).max(0) as f64;
        // A sign-following quantile.
        let step_ns = (self.spread_ns / 20.0).max(10_000.0);
        self.spread_ns += if excess_ns > self.spread_ns { 0.95 * step_ns } else { -0.05 * step_ns };

        let mut host = self.by_line(device, arrival);
        match self.newest {
            Some(newest) if device == newest.device => host = newest.host,
            Some(newest) if device < newest.device => return host.min(newest.host),
            // A better offset must not put a later sample before an earlier one.
            Some(newest) => host = host.max(TimeNs(newest.host.0 + 1)).min(arrival),
            None => {}
        }
        self.newest = Some(Mapped { device, host, arrival });
        host
    }

    /// Takes a reading of the device's clock that came by itself, as the answer to a question. It delays no sample and
    /// is mapped to nothing, but the line cannot lie above it: where samples take long to be made, as those of a camera
    /// do, it lies below theirs by as much, so that they are mapped to when they were taken.
    pub fn observe(&mut self, device: TimeNs, arrival: TimeNs) {
        let offset_ns = arrival.0.saturating_sub(device.0);
        // One far above is late, or the clock was set back; one far below is wrong, or the clock was set forward. The
        // samples will tell.
        let above_ns = if self.line.noted > 0 { self.line.above(device, offset_ns) } else { 0 };
        let late = above_ns > STRAY_ABOVE.0;
        let early = self.samples.noted > 0 && self.samples.above(device, offset_ns) < -LONGEST_DELAY.0;
        if late || early {
            return;
        }
        self.line.note(device, offset_ns, arrival);
        // The clock goes on as it did where a reading says so that lies on the line itself: samples far above theirs have
        // a longer delay than those before them.
        let goes_on = above_ns.abs() < AGREEMENT.0;
        if goes_on && self.strays.is_some_and(|strays| self.samples.above(device, strays.offset_ns) > 0) {
            self.strays = None;
            self.samples = Line::new();
        }
    }

    /// How often the device's clock was found to have been reset or stepped.
    pub const fn resets(&self) -> u64 {
        self.resets
    }

    /// How often a line was given up before it was established: at the beginning of a stream once or twice, and again and
    /// again where the device's clock is no clock, or runs many times too fast.
    pub const fn leaps(&self) -> u64 {
        self.leaps
    }

    /// What has been found; nothing before the first sample.
    pub fn report(&self) -> Option<ClockReport> {
        self.newest.map(|newest| ClockReport {
            offset: TimeNs(self.line.offset_at(newest.device)),
            drift_ppm: self.line.slope * 1e6,
            delay_spread: TimeNs(self.spread_ns as i64),
        })
    }

    fn by_line(&self, device: TimeNs, arrival: TimeNs) -> TimeNs {
        let host = device.0.saturating_add(self.line.offset_at(device));
        TimeNs(host.max(arrival.0.saturating_sub(OLDEST.0)).min(arrival.0))
    }

    fn is_stray(&self, device: TimeNs, offset_ns: i64) -> bool {
        let Some(newest) = self.newest else { return false };
        let backwards = device < newest.device;
        let most = if backwards { STRAY_BACKWARDS } else { STRAY_ABOVE };
        let above_ns = self.line.above(device, offset_ns);
        !(-STRAY_BELOW.0..=LONGEST_DELAY.0 + most.0).contains(&above_ns)
            || self.samples.noted > 0 && self.samples.above(device, offset_ns) > most.0
    }

    fn is_reset(&mut self, device: TimeNs, offset_ns: i64, arrival: TimeNs) -> bool {
        let first = Strays { since: arrival, offset_ns, agreeing: 0, agreeing_since: arrival };
        let strays = self.strays.get_or_insert(first);
        if offset_ns.saturating_sub(strays.offset_ns).unsigned_abs() < AGREEMENT.0.unsigned_abs() {
            strays.agreeing += 1;
        } else {
            *strays = Strays { since: strays.since, agreeing: 1, ..first };
        }
        strays.offset_ns = offset_ns;
        let Some(newest) = self.newest else { return true };
        let below = self.line.above(device, offset_ns) < 0;
        let fell_ns = newest.device.0.saturating_sub(device.0);
        let lasted = |since: TimeNs| arrival - since;
        let agree = strays.agreeing >= AGREEING;
        agree && (below || fell_ns >= RESTART.0)
            || agree && fell_ns > 0 && lasted(strays.agreeing_since) >= SET_BACK_LASTS
            || lasted(strays.since) >= STRAYS_LAST
    }

    /// The best that can be said of one that may be wrong: what lies far below the line took as long as its
    /// predecessor, what lies above it is late.
    fn map_stray(&self, device: TimeNs, offset_ns: i64, arrival: TimeNs) -> TimeNs {
        match self.newest {
            Some(newest) if self.line.above(device, offset_ns) < 0 => {
                let since = (arrival - newest.arrival).0.max(1);
                TimeNs(newest.host.0.saturating_add(since)).min(arrival)
            }
            _ => self.by_line(device, arrival),
        }
    }
}

/// The line of the offset over the device's time, and the points that it rests on.
#[derive(Clone, Debug)]
struct Line {
    /// The least of each bucket of host time.
    least: [Option<Point>; BUCKETS],
    newest: usize,
    bucket_began: TimeNs,
    /// Rise of the offset in a second of the device's time.
    slope: f64,
    noted: u64,
}

#[derive(Clone, Copy, Debug)]
struct Point {
    device: TimeNs,
    offset_ns: i64,
}

impl Point {
    /// Device time and offset from those of `origin`, ns.
    fn from(self, origin: Self) -> (f64, f64) {
        let device_ns = self.device.0.saturating_sub(origin.device.0) as f64;
        (device_ns, self.offset_ns.saturating_sub(origin.offset_ns) as f64)
    }
}

impl Line {
    const fn new() -> Self {
        Self { least: [None; BUCKETS], newest: 0, bucket_began: TimeNs(0), slope: 0.0, noted: 0 }
    }

    /// The offset without delay at `device`.
    fn offset_at(&self, device: TimeNs) -> i64 {
        let at = |point: Point| {
            let since_ns = device.0.saturating_sub(point.device.0) as f64;
            point.offset_ns.saturating_add((self.slope * since_ns) as i64)
        };
        // After a silence the newest points are old ones.
        self.backwards().take(RECENT).map(at).min().unwrap_or(0)
    }

    /// By how much `offset_ns` lies above the line at `device`, ns.
    fn above(&self, device: TimeNs, offset_ns: i64) -> i64 {
        offset_ns.saturating_sub(self.offset_at(device))
    }

    /// The points, the newest first.
    fn backwards(&self) -> impl Iterator<Item = Point> {
        (0..BUCKETS).filter_map(|back| self.least[(self.newest + BUCKETS - back) % BUCKETS])
    }

    fn note(&mut self, device: TimeNs, offset_ns: i64, arrival: TimeNs) {
        if self.noted == 0 {
            self.bucket_began = arrival;
        }
        self.noted += 1;
        let passed = ((arrival - self.bucket_began).0 / BUCKET.0).max(0);
        if passed > 0 {
            self.slope = self.find_slope();
            // A silence longer than the window keeps the newest bucket: it still knows best.
            for _ in 0..passed.min(BUCKETS as i64 - 1) {
                self.newest = (self.newest + 1) % BUCKETS;
                self.least[self.newest] = None;
            }
            self.bucket_began = self.bucket_began + TimeNs(passed * BUCKET.0);
        }
        let point = Point { device, offset_ns };
        let slot = &mut self.least[self.newest];
        let lower = |known: Point| {
            let (since_ns, above_ns) = point.from(known);
            above_ns < self.slope * since_ns
        };
        if slot.is_none_or(lower) {
            *slot = Some(point);
        }
    }

    /// The slope of the hull's edge below the mean time of the points.
    fn find_slope(&self) -> f64 {
        let Some(origin) = self.backwards().last() else { return 0.0 };
        let mut hull = [(0.0, 0.0); BUCKETS];
        let mut corners = 0;
        let (mut sum_ns, mut points, mut last_ns) = (0.0, 0.0, f64::NEG_INFINITY);
        for back in (0..BUCKETS).rev() {
            let Some(point) = self.least[(self.newest + BUCKETS - back) % BUCKETS] else { continue };
            let (x, y) = point.from(origin);
            if x <= last_ns {
                continue;
            }
            (sum_ns, points, last_ns) = (sum_ns + x, points + 1.0, x);
            while corners >= 2 {
                let ((ax, ay), (bx, by)) = (hull[corners - 2], hull[corners - 1]);
                if (by - ay) * (x - ax) < (y - ay) * (bx - ax) {
                    break;
                }
                corners -= 1;
            }
            hull[corners] = (x, y);
            corners += 1;
        }
        if last_ns < SLOPE_SPAN_NS {
            return 0.0;
        }
        let mean_ns = sum_ns / points;
        let edge = hull[..corners].windows(2).find(|edge| edge[1].0 >= mean_ns);
        let slope = edge.map_or(0.0, |edge| (edge[1].1 - edge[0].1) / (edge[1].0 - edge[0].0));
        slope.clamp(-GREATEST_SLOPE, GREATEST_SLOPE)
    }
}

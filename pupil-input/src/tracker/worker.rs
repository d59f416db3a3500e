//! The thread of a tracker: reads, decodes, gates, filters, publishes.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread;
use std::time::Duration;

use holod_calibration::{TimeNs, host_now};

use super::job::{Job, Play};
use super::{Link, Shared};
use crate::PupilSample;
use crate::clock::ClockModel;
use crate::counters::Counter;
use crate::estimator::{Decision, EstimateSnapshot, Estimator, EstimatorSettings, StreamClock};
use crate::gate::Verdict;
use crate::import::leaps::span_in_words;
use crate::import::raw::RawLog;
use crate::import::{LogFault, Recording};
use crate::profile::Profile;
use crate::record::{Kind, ROOM, Taps};
use crate::sequence::{SequenceEvent, SequenceTracker};
use crate::simulate::{MockSource, Script};
use crate::source::{ByteSource, Feed, LONGEST_READ, ReadEvent};
use crate::spec::ReplaySpeed;
use crate::stamp::Stamper;
use crate::wire::{Decoder, WireEvent};

/// A link that has brought bytes is silent after this long without any.
const SILENCE: TimeNs = TimeNs(500_000_000);
/// A link that was just opened is, after this long: a board that was reset by that starts in two seconds.
const FIRST_SILENCE: TimeNs = TimeNs(2_500_000_000);
const FIRST_BACK_OFF: Duration = Duration::from_millis(100);
const LONGEST_BACK_OFF: Duration = Duration::from_secs(2);
/// A log that brings nothing for longer is said to.
const LONG_WAIT: TimeNs = TimeNs(10_000_000_000);
/// Whoever reads decisions, and has taken none for this long, reads none.
const UNREAD: TimeNs = TimeNs(1_000_000_000);

/// The thread's own state. While a link lasts nothing is allocated after its first sample.
pub(super) struct Worker {
    pub(super) estimator: Estimator,
    /// From the stream's time to the host's.
    pub(super) clock: StreamClock,
    pub(super) published: triple_buffer::Input<EstimateSnapshot>,
    pub(super) tap: rtrb::Producer<Decision>,
    pub(super) troubles: rtrb::Producer<String>,
    pub(super) changes: rtrb::Consumer<EstimatorSettings>,
    pub(super) record: Option<Taps>,
    /// Times of arrival are the stream's too.
    pub(super) arrivals_of_stream: bool,
    /// Somebody takes decisions out of the tap.
    pub(super) tap_is_read: bool,
    pub(super) shared: Arc<Shared>,
}

impl Worker {
    pub(super) fn run(mut self, job: Job) {
        let _finished = FinishedAtEnd(Arc::clone(&self.shared));
        match job {
            Job::Live { open, feed, profile, .. } => self.run_live(open, feed, &profile),
            Job::Replay { recording, play } => self.run_replay(&recording, play),
            Job::Rerun { raw, play } => {
                self.arrivals_of_stream = true;
                self.run_again(&raw, play);
            }
            Job::Mock { script, origin } => self.run_mock(*script, origin),
        }
        self.finish();
    }

    fn run_live(&mut self, open: Box<dyn ByteSource>, mut feed: Box<dyn Feed>, profile: &Profile) {
        let mut link = Some(open);
        let datagrams = feed.datagrams();
        let mut stream = LiveStream::new(profile, datagrams);
        let mut buffer = vec![0; LONGEST_READ];
        let mut back_off = FIRST_BACK_OFF;
        // What the feed said last.
        let mut is_troubled = false;
        let mut silent_from = host_now() + FIRST_SILENCE;
        let opened = host_now();
        self.connected(opened);
        self.estimator.begin(opened);
        while self.goes_on() {
            let Some(open) = &mut link else {
                if !self.wait_until(host_now() + TimeNs(back_off.as_nanos() as i64)) {
                    return;
                }
                self.count(Counter::ReconnectAttempts, 1);
                back_off = (back_off * 2).min(LONGEST_BACK_OFF);
                link = match feed.open() {
                    Ok(link) => {
                        let trouble = feed.trouble();
                        is_troubled = trouble.is_some();
                        self.trouble(trouble.unwrap_or_default());
                        Some(link)
                    }
                    Err(error) => {
                        self.trouble(error.to_string());
                        None
                    }
                };
                if link.is_some() {
                    stream.rejoin(profile);
                    silent_from = host_now() + FIRST_SILENCE;
                    self.connected(host_now());
                }
                continue;
            };
            match open.read(&mut buffer) {
                ReadEvent::Bytes(count) => {
                    let arrival = host_now();
                    silent_from = arrival + SILENCE;
                    back_off = FIRST_BACK_OFF;
                    self.set_link(Link::Up);
                    let bytes = &buffer[..count];
                    if let Some(taps) = &mut self.record {
                        taps.bytes(arrival, bytes);
                    }
                    if stream.push(bytes, arrival, self) {
                        open.is_followed();
                    }
                    self.publish();
                    if is_troubled && feed.trouble().is_none() {
                        is_troubled = false;
                        self.trouble(String::new());
                    }
                }
                event @ (ReadEvent::Silence | ReadEvent::Stranger) => {
                    if event == ReadEvent::Stranger {
                        self.count(Counter::Strangers, 1);
                    }
                    if host_now() > silent_from && self.link() == Link::Up {
                        self.count(Counter::Silences, 1);
                        self.set_link(Link::Silent);
                    }
                }
                ReadEvent::Gone => {
                    link = None;
                    self.disconnected(host_now());
                }
            }
        }
    }

    /// Tells why the link does not come back; an empty text that it has. What finds no room is told again soon.
    fn trouble(&mut self, text: String) {
        let _ = self.troubles.push(text);
    }

    fn connected(&mut self, t: TimeNs) {
        self.count(Counter::Connects, 1);
        self.set_link(Link::Up);
        if let Some(taps) = &mut self.record {
            taps.connected(t);
        }
    }

    fn disconnected(&mut self, t: TimeNs) {
        self.count(Counter::Disconnects, 1);
        self.set_link(Link::Down);
        if let Some(taps) = &mut self.record {
            taps.disconnected(t);
        }
    }

    /// Plays a recording of a link: the same bytes at the same times of arrival, so the same samples.
    fn run_again(&mut self, raw: &RawLog, play: Play) {
        let Play { speed, repeat, origin } = play;
        if let ReplaySpeed::Times(rate) = speed {
            self.clock = StreamClock { host: origin, stream: raw.begins(), rate };
        }
        let (mut later, mut begun) = (TimeNs(0), false);
        loop {
            let mut stream = LiveStream::new(raw.profile(), raw.datagrams());
            // It was read to its end when the tracker was started. What cannot be read any more is its end now.
            let Ok(mut records) = raw.records() else { return };
            while let Ok(Some((head, payload))) = records.next() {
                let arrival = head.t + later;
                match speed {
                    ReplaySpeed::Times(_) => {
                        if !self.wait_for_log(self.clock.to_host(arrival)) {
                            return;
                        }
                    }
                    // The newest bytes always come now.
                    ReplaySpeed::Fastest => {
                        if !self.wait_for_room() {
                            return;
                        }
                        self.clock = StreamClock { host: host_now(), stream: arrival, rate: 1.0 };
                    }
                }
                match head.kind {
                    Kind::Connected => {
                        stream.rejoin(raw.profile());
                        self.connected(arrival);
                        // As live, where the link was opened for the first time.
                        if !std::mem::replace(&mut begun, true) {
                            self.estimator.begin(arrival);
                        }
                    }
                    Kind::Bytes => {
                        stream.push(payload, arrival, self);
                        self.publish();
                    }
                    Kind::Disconnected => self.disconnected(arrival),
                    Kind::Lost | Kind::End => {}
                }
            }
            if !repeat {
                return;
            }
            later = later + raw.period();
            self.count(Counter::Loops, 1);
        }
    }

    fn run_replay(&mut self, recording: &Recording, play: Play) {
        let Play { speed, repeat, origin } = play;
        self.shared.counters.add_faults(recording.faults().entries());
        let begins = recording.begins();
        if let ReplaySpeed::Times(rate) = speed {
            self.clock = StreamClock { host: origin, stream: begins, rate };
        }
        let mut later = TimeNs(0);
        loop {
            for index in 0..recording.len() {
                let mut sample = recording.sample(index);
                sample.t_sample = sample.t_sample + later;
                match speed {
                    ReplaySpeed::Times(_) => {
                        if !self.wait_for_log(self.clock.to_host(sample.t_sample)) {
                            return;
                        }
                    }
                    // The newest sample is always now.
                    ReplaySpeed::Fastest => {
                        if !self.wait_for_room() {
                            return;
                        }
                        self.clock = StreamClock { host: host_now(), stream: sample.t_sample, rate: 1.0 };
                    }
                }
                sample.t_arrival = host_now();
                self.take(sample, sample.t_sample);
                self.publish();
            }
            if !repeat {
                return;
            }
            later = later + recording.period();
            self.count(Counter::Loops, 1);
        }
    }

    fn run_mock(&mut self, script: Script, origin: TimeNs) {
        self.clock = StreamClock { host: origin, stream: TimeNs(0), rate: 1.0 };
        let ends = script.ends().map_or(TimeNs(i64::MAX), |ends| self.clock.to_host(ends));
        // A script's clock and link are learnt as a real tracker's; without them every sample has its own time.
        let mut clock = script.has_link().then(ClockModel::new);
        for mock in MockSource::of(script) {
            let mut sample = mock.sample;
            if !self.wait_until(self.clock.to_host(sample.t_arrival)) {
                return;
            }
            sample.t_arrival = host_now();
            let mut known = sample.t_sample;
            if let Some(clock) = &mut clock {
                known = self.clock.to_stream(sample.t_arrival);
                let (resets, leaps) = (clock.resets(), clock.leaps());
                sample.t_sample = clock.map(sample.t_device, known);
                self.count(Counter::ClockResets, clock.resets() - resets);
                self.count(Counter::ClockLeaps, clock.leaps() - leaps);
                self.shared.clock.set(clock.report());
            }
            self.take(sample, known);
            self.publish();
        }
        // One that falls silent for good has not ended.
        self.wait_until(ends);
    }

    /// Takes a sample that is known from `t_known` on, on the stream's clock.
    fn take(&mut self, sample: PupilSample, t_known: TimeNs) {
        self.count(Counter::Samples, 1);
        self.note_decisions(|estimator, tap| estimator.push_at(t_known, sample, |decision| tap.note(decision)));
    }

    fn finish(&mut self) {
        self.note_decisions(|estimator, tap| estimator.finish(|decision| tap.note(decision)));
        self.publish();
        self.set_link(Link::Finished);
    }

    fn note_decisions(&mut self, decide: impl FnOnce(&mut Estimator, &mut Tap<'_>)) {
        let Self { estimator, tap, shared, clock, record, arrivals_of_stream, .. } = self;
        let mut tap = Tap { tap, record, clock: *clock, arrivals_of_stream: *arrivals_of_stream, shared };
        decide(estimator, &mut tap);
    }

    fn publish(&mut self) {
        let mut snapshot = self.estimator.snapshot();
        snapshot.set_clock(self.clock);
        self.published.write(snapshot);
    }

    /// Waits until host time `t`; false if the tracker is to stop.
    fn wait_until(&mut self, t: TimeNs) -> bool {
        loop {
            if !self.goes_on() {
                return false;
            }
            let left = t - host_now();
            if left.0 <= 0 {
                return true;
            }
            thread::park_timeout(Duration::from_nanos(left.0.unsigned_abs()));
        }
    }

    /// Waits until host time `t` for what comes next of a log, and tells where that takes long; false if the tracker is
    /// to stop.
    fn wait_for_log(&mut self, t: TimeNs) -> bool {
        let left = t - host_now();
        if left <= LONG_WAIT {
            return self.wait_until(t);
        }
        self.trouble(format!("what comes next in the log is {} away", span_in_words(left.0)));
        let goes_on = self.wait_until(t);
        self.trouble(String::new());
        goes_on
    }

    /// Waits until recording and tap have room for what one piece of a log brings, since a log can be read faster than
    /// a disk is written; false if the tracker is to stop. A tap that nobody reads is not waited for.
    fn wait_for_room(&mut self) -> bool {
        let mut waiting_since = None;
        loop {
            if !self.goes_on() {
                return false;
            }
            let recorded = self.record.as_ref().is_none_or(Taps::has_room);
            let read = !self.tap_is_read || self.tap.slots() >= ROOM.min(self.tap.buffer().capacity());
            if recorded && read {
                return true;
            }
            let now = host_now();
            if recorded && now - *waiting_since.get_or_insert(now) > UNREAD {
                self.tap_is_read = false;
            }
            thread::park_timeout(Duration::from_millis(1));
        }
    }

    /// Takes a change of settings; false if the tracker is to stop.
    fn goes_on(&mut self) -> bool {
        while let Ok(&settings) = self.changes.peek() {
            let t = self.clock.to_stream(host_now());
            self.note_decisions(|estimator, tap| estimator.change(settings, t, |decision| tap.note(decision)));
            // Only now, so that whoever finds it taken counts no decision by the settings before it.
            let _ = self.changes.pop();
            self.publish();
        }
        !self.shared.stop.load(Ordering::Acquire)
    }

    fn count(&self, counter: Counter, count: u64) {
        self.shared.counters.add(counter, count);
    }

    fn link(&self) -> Link {
        Link::ALL[usize::from(self.shared.link.load(Ordering::Relaxed))]
    }

    fn set_link(&self, link: Link) {
        self.shared.link.store(link as u8, Ordering::Release);
    }
}

/// However the thread ends, by a panic too, the link is finished then.
struct FinishedAtEnd(Arc<Shared>);

impl Drop for FinishedAtEnd {
    fn drop(&mut self) {
        self.0.link.store(Link::Finished as u8, Ordering::Release);
    }
}

/// Where decisions go: to whoever looks at them, and into the recording.
struct Tap<'a> {
    tap: &'a mut rtrb::Producer<Decision>,
    record: &'a mut Option<Taps>,
    clock: StreamClock,
    arrivals_of_stream: bool,
    shared: &'a Shared,
}

impl Tap<'_> {
    /// Counts a decision and hands it to the recording, as the stream has it, and to the tap, on the host's clock.
    fn note(&mut self, mut decision: Decision) {
        match decision.verdict {
            Verdict::Accepted => self.shared.counters.add(Counter::Accepted, 1),
            Verdict::Rejected(reason) => self.shared.counters.add_rejected(reason),
        }
        if let Some(record) = self.record {
            record.decision(decision);
        }
        let sample = &mut decision.sample;
        sample.t_sample = self.clock.to_host(sample.t_sample);
        if self.arrivals_of_stream {
            sample.t_arrival = self.clock.to_host(sample.t_arrival);
        }
        if self.tap.push(decision).is_err() {
            self.shared.counters.add(Counter::DecisionsDropped, 1);
        }
    }
}

/// What one connection has brought: decoder, running numbers, clock.
struct LiveStream {
    decoder: Box<dyn Decoder>,
    sequence: SequenceTracker,
    stamper: Stamper,
    datagrams: bool,
}

impl LiveStream {
    fn new(profile: &Profile, datagrams: bool) -> Self {
        Self { decoder: profile.decoder(), sequence: SequenceTracker::new(), stamper: Stamper::new(), datagrams }
    }

    /// Goes on with a link that was opened anew.
    fn rejoin(&mut self, profile: &Profile) {
        if !self.decoder.rejoin() {
            self.decoder = profile.decoder();
        }
        (self.sequence, self.stamper) = (SequenceTracker::new(), Stamper::new());
    }

    /// Takes what was read; tells whether a sample was in it.
    fn push(&mut self, bytes: &[u8], arrival: TimeNs, worker: &mut Worker) -> bool {
        worker.count(Counter::Bytes, bytes.len() as u64);
        let Self { decoder, sequence, stamper, datagrams } = self;
        let (resets, leaps) = (stamper.resets(), stamper.leaps());
        let mut has_sample = false;
        let mut take = |event| match event {
            WireEvent::Sample(sample) => {
                has_sample = true;
                if let Some(number) = sample.sequence {
                    worker.count_sequence(sequence.next(number, sample.eye));
                }
                if let Some(sample) = stamper.take(sample, arrival) {
                    worker.take(sample, arrival);
                }
            }
            WireEvent::Note => worker.count(Counter::Notes, 1),
            WireEvent::Partial => worker.count(Counter::Partials, 1),
            WireEvent::Clock(t_device) => {
                stamper.observe(t_device, arrival);
                worker.count(Counter::Notes, 1);
            }
            WireEvent::Rejected(fault) => worker.shared.counters.add_fault(LogFault::Wire(fault), 1),
        };
        decoder.push(bytes, &mut take);
        if *datagrams {
            decoder.finish(&mut take);
        }
        stamper.rest(arrival, |sample| worker.take(sample, arrival));
        worker.count(Counter::ClockResets, stamper.resets() - resets);
        worker.count(Counter::ClockLeaps, stamper.leaps() - leaps);
        worker.shared.clock.set(stamper.report());
        has_sample
    }
}

impl Worker {
    fn count_sequence(&self, event: SequenceEvent) {
        match event {
            SequenceEvent::InOrder => {}
            SequenceEvent::Gap(missing) => {
                self.count(Counter::SequenceGaps, 1);
                self.count(Counter::SequenceMissing, missing);
            }
            SequenceEvent::Overtaken { gaps } => {
                self.count(Counter::SequenceOvertaken, 1);
                match gaps {
                    1 => self.count(Counter::SequenceGaps, 1),
                    -1 => self.shared.counters.fill_gap(),
                    _ => {}
                }
            }
            SequenceEvent::Repeat => self.count(Counter::SequenceRepeats, 1),
            SequenceEvent::Restart => self.count(Counter::SequenceRestarts, 1),
        }
    }
}

//! A day of samples in simulated time: clock model, gate and filter of a tracker that drifts, blinks, drops out, stands
//! still and has its clock set; judged by the true times and the true pupil at every frame of a display.

use crate::support::settings;
use holod_calibration::{TimeNs, rig};
use holod_pupil_input::{ClockModel, Estimator, GateSettings, PupilEstimate, PupilSample, PupilState, SampleEye};
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

const MS: i64 = 1_000_000;
const S: i64 = 1_000 * MS;
const MINUTE: i64 = 60 * S;
const BEGINS: i64 = 1000 * S;
/// Of the tracker.
const SAMPLE_PERIOD: i64 = S / 120;
const FRAME_PERIOD: i64 = S / 60;
/// A frame asks for the pupil so far ahead.
const AHEAD: i64 = 20 * MS;
/// One minute of this many is a bad one.
const BAD_EVERY: i64 = 4;
/// So long after the last trouble all is as if there had been none: the clock model's line forgets in 16 s.
const SETTLES: i64 = 20 * S;

/// The true pupil: between 2.4 and 5.6 mm, no faster than 0.7 mm/s.
fn truth_mm(t: i64) -> f64 {
    let t_s = (t - BEGINS) as f64 * 1e-9;
    4.0 + 1.2 * (t_s * std::f64::consts::TAU / 37.0).sin() + 0.4 * (t_s * std::f64::consts::TAU / 5.3).sin()
}

/// What a viewer and a clock must not see.
struct Judge {
    last: Option<(i64, PupilEstimate)>,
    last_mapped: Option<TimeNs>,
    fastest_mm: f32,
    worst_tracking_mm: f32,
    worst_clock_ns: i64,
    faults: Vec<String>,
}

impl Judge {
    /// The greatest change from one frame to the next: the fastest that the filter follows an eye (7 mm/s) while a
    /// difference is worked off (4 mm/s), 0.19 mm in a frame; and what working it off comes too late by where a frame
    /// has looked ahead, 0.08 mm, where a velocity was run on for as long, 0.14 mm; and the noise of one sample.
    const MOST_A_FRAME_MM: f32 = 0.45;
    /// The greatest distance from the true pupil while samples are followed and nothing has gone wrong of late: the
    /// stated lag, and noise, and how far a lid takes the first samples of a blink before it is known for one.
    const MOST_TRACKING_MM: f32 = 0.6;
    /// The greatest error of a time when nothing has gone wrong of late: the link's least delay, 2 ms, which cannot be
    /// known, half of its jitter, and what a drift that changes makes of it.
    const MOST_CLOCK: i64 = 6 * MS;

    const fn new() -> Self {
        Self {
            last: None,
            last_mapped: None,
            fastest_mm: 0.0,
            worst_tracking_mm: 0.0,
            worst_clock_ns: 0,
            faults: Vec::new(),
        }
    }

    fn object(&mut self, fault: String) {
        if self.faults.len() < 10 {
            self.faults.push(fault);
        }
    }

    /// A sample that was taken at `taken` and came at `arrival` is said to have been taken at `mapped`.
    fn mapped(&mut self, taken: i64, arrival: i64, mapped: TimeNs, settled: bool) {
        if mapped.0 > arrival || arrival - mapped.0 > 60 * S {
            self.object(format!("a sample of {arrival} is mapped to {mapped:?}"));
        }
        let before = self.last_mapped.replace(mapped);
        if !settled {
            return;
        }
        let error_ns = mapped.0 - taken;
        self.worst_clock_ns = self.worst_clock_ns.max(error_ns.abs());
        if error_ns.abs() > Self::MOST_CLOCK {
            self.object(format!("the clock is wrong by {error_ns} ns at {taken}"));
        }
        if before.is_some_and(|before| mapped <= before) {
            self.object(format!("times do not go on: {mapped:?} after {before:?}"));
        }
    }

    /// The frame of host time `now` is made for `estimate`.
    fn frame(&mut self, now: i64, estimate: PupilEstimate, settled: bool) {
        let mm = estimate.pupil.mm();
        if !(1.0..=9.0).contains(&mm) {
            self.object(format!("{mm} mm at {now}"));
        }
        if estimate.t_heard.is_some_and(|t_heard| t_heard.0 > now) {
            self.object(format!("a sample of the future at {now}: {estimate:?}"));
        }
        if estimate.t_sample.is_some_and(|t_sample| TimeNs(now) - t_sample < GateSettings::default().lead) {
            self.object(format!("a sample that cannot be believed yet at {now}: {estimate:?}"));
        }
        if let Some((before, last)) = self.last.replace((now, estimate)) {
            let step_mm = (mm - last.pupil.mm()).abs();
            self.fastest_mm = self.fastest_mm.max(step_mm);
            // The first diameter is shown at once.
            if step_mm > Self::MOST_A_FRAME_MM && now > BEGINS + S / 2 {
                self.object(format!("{step_mm} mm from {before} to {now}: {last:?}, {estimate:?}"));
            }
            // The fallback rests on none.
            if estimate.t_sample.zip(last.t_sample).is_some_and(|(this, before)| this < before) {
                self.object(format!("an older sample: {last:?}, {estimate:?}"));
            }
        }
        if settled && estimate.state == PupilState::Tracking {
            let off_mm = (f64::from(mm) - truth_mm(now + AHEAD)).abs() as f32;
            self.worst_tracking_mm = self.worst_tracking_mm.max(off_mm);
            if off_mm > Self::MOST_TRACKING_MM {
                self.object(format!("{off_mm} mm off at {now}: {estimate:?}"));
            }
        }
    }
}

struct Day {
    random: Pcg64Mcg,
    clock: ClockModel,
    estimator: Estimator,
    judge: Judge,
    now: i64,
    t_frame: i64,
    t_arrival: i64,
    device: f64,
    drift_ppm: f64,
    t_blink: i64,
    blink_lasts: i64,
    /// No sample comes until then.
    t_silent: i64,
    /// The device's clock stands until then.
    t_stands: i64,
    /// Bytes are kept back until then.
    t_kept: i64,
    t_trouble: i64,
    resets: u64,
    tracked: u64,
    frames: u64,
}

impl Day {
    fn new(seed: u64) -> Self {
        Self {
            random: Pcg64Mcg::seed_from_u64(seed),
            clock: ClockModel::new(),
            estimator: Estimator::new(settings(rig::Eye::Left)),
            judge: Judge::new(),
            now: BEGINS,
            t_frame: BEGINS,
            t_arrival: BEGINS,
            device: 5e9,
            drift_ppm: 30.0,
            t_blink: BEGINS + 2 * S,
            blink_lasts: 200 * MS,
            t_silent: 0,
            t_stands: 0,
            t_kept: 0,
            t_trouble: BEGINS,
            resets: 0,
            tracked: 0,
            frames: 0,
        }
    }

    fn begin_trouble(&mut self) {
        self.t_trouble = self.now;
        let mut lasts = |most_ms: i64| self.random.random_range(5 * MS..most_ms * MS);
        let (short, long, kind) = (lasts(400), lasts(5_000), lasts(1_000) % 8);
        match kind {
            0 => self.t_silent = self.now + short,
            1 => self.t_silent = self.now + long,
            2 => self.device += short as f64,
            3 => self.device -= short as f64,
            4 => self.device += if short % 2 == 0 { long as f64 } else { -(long as f64) },
            5 => self.t_stands = self.now + short,
            6 => self.device = 0.0,
            _ => self.t_kept = self.now + short,
        }
        self.t_trouble = self.t_trouble.max(self.t_silent).max(self.t_stands).max(self.t_kept);
    }

    fn frames_until(&mut self, t: i64) {
        while self.t_frame < t {
            let now = self.t_frame;
            let estimate = self.estimator.pupil_at(TimeNs(now + AHEAD));
            self.judge.frame(now, estimate, now - self.t_trouble > SETTLES);
            self.tracked += u64::from(estimate.state == PupilState::Tracking);
            self.frames += 1;
            self.t_frame += FRAME_PERIOD;
        }
    }

    fn sample(&mut self) {
        self.now += SAMPLE_PERIOD;
        let now = self.now;
        // A crystal that warms and cools.
        self.drift_ppm = (self.drift_ppm + self.random.random_range(-0.01..0.01)).clamp(-80.0, 80.0);
        if now > self.t_stands {
            self.device += SAMPLE_PERIOD as f64 * (1.0 + self.drift_ppm * 1e-6);
        }
        if now > self.t_blink + self.blink_lasts {
            self.t_blink = now + self.random.random_range(S..7 * S);
            self.blink_lasts = self.random.random_range(120 * MS..350 * MS);
        }
        if now < self.t_silent {
            return;
        }
        let noise_mm = 0.08 * (self.random.random::<f64>() + self.random.random::<f64>() - 1.0);
        let blinks = now >= self.t_blink;
        let lid_mm = if blinks { truth_mm(now) * 0.5 + 5.0 * noise_mm } else { truth_mm(now) + noise_mm };
        let delay = self.random.random_range(2 * MS..5 * MS);
        self.t_arrival = (now + delay).max(self.t_arrival).max(self.t_kept);
        let arrival = self.t_arrival;
        self.frames_until(arrival);
        let device = TimeNs(self.device as i64);
        let t_sample = self.clock.map(device, TimeNs(arrival));
        let settled = now - self.t_trouble > SETTLES;
        self.judge.mapped(now, arrival, t_sample, settled);
        let sample = PupilSample {
            t_device: device,
            t_sample,
            t_arrival: TimeNs(arrival),
            eye: SampleEye::Left,
            diameter_mm: lid_mm as f32,
            confidence: if blinks { 0.3 } else { 0.95 },
            aperture_mm: None,
            sequence: None,
            valid: true,
        };
        self.estimator.push_at(TimeNs(arrival), sample, |_| {});
    }

    fn run(&mut self, t_end: i64, bad: bool) {
        while self.now < t_end {
            if bad && self.random.random_bool(0.004) {
                self.begin_trouble();
            }
            self.sample();
        }
    }
}

fn run_minutes(seed: u64, minutes: i64) -> Day {
    let mut day = Day::new(seed);
    for minute in 0..minutes {
        let bad = minute % BAD_EVERY == BAD_EVERY - 1;
        let resets = day.clock.resets();
        day.run(BEGINS + (minute + 1) * MINUTE, bad);
        // A trouble that begins at the end of a bad minute may end in the next one.
        if minute % BAD_EVERY > 0 && !bad {
            assert_eq!(day.clock.resets(), resets, "minute {minute}: nobody set the clock");
        }
        day.resets = day.clock.resets();
        assert!(day.judge.faults.is_empty(), "seed {seed}, minute {minute}: {:#?}", day.judge.faults);
    }
    day
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 1, max_shrink_iters: 0, ..ProptestConfig::default() })]

    #[test]
    fn a_day_of_samples_is_followed_without_a_jump(seed in any::<u64>()) {
        let day = run_minutes(seed, 24 * 60);
        // It did see troubles, and it did follow.
        prop_assert!(day.resets > 1000, "{}", day.resets);
        let tracked = day.tracked as f64 / day.frames as f64;
        prop_assert!(tracked > 0.7, "{tracked}");
        prop_assert!(day.judge.worst_tracking_mm > 0.0 && day.judge.fastest_mm > 0.0 && day.judge.worst_clock_ns > 0);
    }
}

#[test]
fn canary_the_judge_objects_to_one_jump_and_to_one_wrong_time() {
    let day = run_minutes(1, 1);
    let now = day.t_arrival;
    let estimate = day.estimator.pupil_at(TimeNs(now + AHEAD));
    let moved = |by_mm: f32| PupilEstimate {
        pupil: holod_calibration::PupilDiameter::from_mm(estimate.pupil.mm() + by_mm),
        ..estimate
    };
    let frames = |estimates: &[PupilEstimate]| {
        let mut judge = Judge::new();
        for (&estimate, now) in estimates.iter().zip((now..).step_by(FRAME_PERIOD as usize)) {
            judge.frame(now, estimate, false);
        }
        judge.faults.len()
    };
    assert_eq!(frames(&[estimate, moved(0.2), estimate]), 0);
    assert_eq!(frames(&[estimate, moved(0.5)]), 1);
    let older = PupilEstimate { t_sample: estimate.t_sample.map(|t| t - TimeNs(1)), ..estimate };
    assert_eq!(frames(&[estimate, older]), 1);
    let newest = PupilEstimate { t_sample: Some(TimeNs(now - 20 * MS)), ..estimate };
    assert_eq!(frames(&[newest]), 1);
    let unborn = PupilEstimate { t_heard: Some(TimeNs(now + 1)), ..estimate };
    assert_eq!(frames(&[unborn]), 1);
    let mut judge = Judge::new();
    judge.frame(now, moved(0.0), true);
    let followed = judge.faults.len();
    judge.frame(now + 1, moved(3.0), true);
    assert!(judge.faults.len() >= followed + 2, "off, and a jump: {:?}", judge.faults);
    let times = |times: &[(i64, i64)]| {
        let mut judge = Judge::new();
        times.iter().for_each(|&(taken, mapped)| judge.mapped(taken, taken + 3 * MS, TimeNs(mapped), true));
        judge.faults.len()
    };
    assert_eq!(times(&[(S, S), (2 * S, 2 * S + MS)]), 0);
    assert_eq!(times(&[(S, S), (2 * S, 2 * S + 4 * MS)]), 1, "after its arrival");
    assert_eq!(times(&[(S, S), (2 * S, 2 * S - 7 * MS)]), 1, "wrong");
    assert_eq!(times(&[(S, S + MS), (S + MS / 2, S + MS)]), 1, "twice the same");
}

//! The clock model against simulated clocks and links, of which the true times are known.

use holod_calibration::TimeNs;
use holod_pupil_input::ClockModel;
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

const MS: i64 = 1_000_000;
const S: i64 = 1_000 * MS;
/// Host time at which a simulation begins.
const BEGINS: i64 = 1000 * S;

/// A sample on its way: when it was taken and when it arrived on the host's clock, and what the device's clock said.
#[derive(Clone, Copy, Debug)]
struct Sent {
    taken: i64,
    device: i64,
    arrival: i64,
}

/// What adds to a sample's way.
#[derive(Clone, Copy, Debug)]
enum Link {
    /// Uniform from least to greatest, ns.
    Uniform(i64, i64),
    /// FTDI's latency timer: bytes leave every 16 ms; and 0.3 ms of USB.
    Ftdi,
    /// Reports leave in bursts every 25 ms, 2 ms on the way.
    Bursts,
    /// A network: 1 ms, an exponential of mean 3 ms, and one in fifty is 20 to 120 ms late. Order is not kept.
    Network,
}

impl Link {
    fn arrival(self, taken: i64, random: &mut Pcg64Mcg) -> i64 {
        let leaves = |period: i64| (taken.div_euclid(period) + 1) * period;
        match self {
            Self::Uniform(least, greatest) => taken + random.random_range(least..=greatest),
            Self::Ftdi => leaves(16 * MS) + 3 * MS / 10,
            Self::Bursts => leaves(25 * MS) + 2 * MS,
            Self::Network => {
                let queue = (-(1.0 - random.random::<f64>()).ln() * 3.0 * MS as f64) as i64;
                let late = if random.random_range(0..50) == 0 { random.random_range(20 * MS..120 * MS) } else { 0 };
                taken + MS + queue + late
            }
        }
    }

    /// Within what the least delay of a quarter second lies at 200 Hz, after the least possible one.
    fn envelope(self) -> i64 {
        match self {
            Self::Uniform(least, greatest) => (greatest - least) / 3,
            Self::Ftdi | Self::Bursts => 5 * MS,
            Self::Network => 2 * MS,
        }
    }

    fn least(self) -> i64 {
        match self {
            Self::Uniform(least, _) => least,
            Self::Ftdi => 3 * MS / 10,
            Self::Bursts => 2 * MS,
            Self::Network => MS,
        }
    }
}

/// Samples of `rate_hz` for `seconds`, in order of arrival. `device` gives what the device's clock says at a true time,
/// counted from the beginning.
fn send(rate_hz: i64, seconds: i64, link: Link, seed: u64, device: impl Fn(i64) -> i64) -> Vec<Sent> {
    let mut random = Pcg64Mcg::seed_from_u64(seed);
    let mut sent: Vec<_> = (0..rate_hz * seconds)
        .map(|k| {
            let since = k * S / rate_hz;
            let taken = BEGINS + since;
            Sent { taken, device: device(since), arrival: link.arrival(taken, &mut random) }
        })
        .collect();
    sent.sort_by_key(|sample| sample.arrival);
    sent
}

/// Mapped less true time, in order of arrival.
fn errors(model: &mut ClockModel, sent: &[Sent]) -> Vec<i64> {
    let map = |sample: &Sent| {
        let mapped = model.map(TimeNs(sample.device), TimeNs(sample.arrival)).0;
        assert!(mapped <= sample.arrival, "the future");
        mapped - sample.taken
    };
    sent.iter().map(map).collect()
}

/// A device clock that began long ago and is `ppm` slower than the host's.
fn drifting(ppm: i64) -> impl Fn(i64) -> i64 {
    move |since| 77 * S + since - since / 1_000_000 * ppm
}

const LINKS: [Link; 5] =
    [Link::Uniform(MS, 2 * MS), Link::Uniform(MS, 17 * MS), Link::Ftdi, Link::Bursts, Link::Network];

#[test]
fn a_crystal_is_followed_through_every_link() {
    for link in LINKS {
        for ppm in [-500, -50, 0, 50, 500] {
            let mut model = ClockModel::new();
            let errors = errors(&mut model, &send(200, 60, link, 1, drifting(ppm)));
            let settled = &errors[600..];
            let (least, greatest) = (settled.iter().min().expect("some"), settled.iter().max().expect("some"));
            let allowed = link.least() - MS..=link.least() + link.envelope();
            assert!(allowed.contains(least) && allowed.contains(greatest), "{link:?} {ppm} ppm: {least}..{greatest}");
            assert_eq!(model.resets(), 0);
            let report = model.report().expect("has samples");
            let tolerance_ppm = link.envelope() as f64 / 8e9 * 1e6 + 20.0;
            assert!((report.drift_ppm - ppm as f64).abs() < tolerance_ppm, "{link:?} {ppm} ppm: {report:?}");
        }
    }
}

#[test]
fn the_report_tells_offset_and_spread() {
    let mut model = ClockModel::new();
    assert_eq!(model.report(), None);
    errors(&mut model, &send(200, 30, Link::Uniform(2 * MS, 12 * MS), 2, |since| since));
    let report = model.report().expect("has samples");
    assert!((report.offset.0 - BEGINS - 2 * MS).abs() < MS / 2, "{report:?}");
    assert!((8 * MS..11 * MS).contains(&report.delay_spread.0), "{report:?}");
}

#[test]
fn slow_and_fast_feeds_are_followed() {
    for per_cent in [-10, -3, 2, 5, 10] {
        let mut model = ClockModel::new();
        let errors = errors(&mut model, &send(200, 30, Link::Uniform(MS, 4 * MS), 3, drifting(per_cent * 10_000)));
        let greatest = errors[400..].iter().map(|error| error.abs()).max().expect("some");
        assert!(greatest < 5 * MS, "{per_cent} %: {greatest}");
        assert_eq!(model.resets(), 0);
    }
}

#[test]
fn a_clock_that_runs_many_times_too_fast_leaps() {
    let leaps = |times: i64| {
        let mut model = ClockModel::new();
        for sample in send(200, 10, Link::Uniform(MS, 2 * MS), 13, |since| since * times) {
            model.map(TimeNs(sample.device), TimeNs(sample.arrival));
        }
        model.leaps()
    };
    // The canary: as a clock runs.
    assert_eq!(leaps(1), 0);
    for times in [100, 1000, 1_000_000] {
        assert!((20..200).contains(&leaps(times)), "{times} times: {}", leaps(times));
    }
}

#[test]
fn every_rate_is_followed() {
    for rate_hz in [6, 30, 60, 123, 500, 1000, 2000] {
        let mut model = ClockModel::new();
        let errors = errors(&mut model, &send(rate_hz, 30, Link::Uniform(MS, 9 * MS), 4, drifting(80)));
        let settled = &errors[(3 * rate_hz) as usize..];
        assert!(settled.iter().all(|error| (0..8 * MS).contains(error)), "{rate_hz} Hz");
        assert_eq!(model.resets(), 0);
    }
}

/// How long the mapped times were wrong by more than 10 ms, from a step of the device's clock after 5 s.
fn wrong_after(device: impl Fn(i64) -> i64) -> (i64, u64) {
    let mut model = ClockModel::new();
    let sent = send(200, 20, Link::Uniform(MS, 3 * MS), 5, device);
    let errors = errors(&mut model, &sent);
    let wrong = |(sample, error): (&Sent, &i64)| (error.abs() > 10 * MS).then_some(sample.taken - BEGINS - 5 * S);
    let wrong: Vec<_> = sent.iter().zip(&errors).filter_map(wrong).collect();
    assert!(wrong.iter().all(|since| *since >= 0));
    (wrong.last().map_or(0, |last| last + 5 * MS), model.resets())
}

#[test]
fn steps_and_resets_are_found_within_a_bounded_time() {
    let stepped = |by: i64| move |since: i64| if since < 5 * S { since } else { since + by };
    // Restarts and steps forward are found with the third sample, at 200 Hz.
    for by in [-5000 * S, -2 * S, 60 * MS, 200 * MS, 2 * S, 90 * S, i64::MAX - 20 * S] {
        let (wrong, resets) = wrong_after(stepped(by));
        assert!(wrong <= 15 * MS && resets == 1, "{by}: {wrong} ns, {resets} resets");
    }
    // A clock that is set back by less looks like late samples at first.
    for by in [-900 * MS, -400 * MS, -160 * MS] {
        let (wrong, resets) = wrong_after(stepped(by));
        assert!(wrong <= 120 * MS && resets == 1, "{by}: {wrong} ns, {resets} resets");
    }
    // One of less than the strays' bound is no reset: the height follows.
    for by in [-60 * MS, 40 * MS] {
        let (wrong, _) = wrong_after(stepped(by));
        assert!(wrong <= 1500 * MS, "{by}: {wrong} ns");
    }
    // A clock that counts on from 0 after a wrap.
    let (wrong, resets) = wrong_after(|since| (since + (1_i64 << 32) * 1000 - 5 * S) % ((1_i64 << 32) * 1000));
    assert!(wrong <= 15 * MS && resets == 1);
}

#[test]
fn a_clock_that_stood_still_in_a_pause_is_found() {
    // The tracker pauses for 3 s and its clock with it.
    let mut sent =
        send(200, 20, Link::Uniform(MS, 3 * MS), 6, |since| if since < 8 * S { since } else { since - 3 * S });
    sent.retain(|sample| !(5 * S..8 * S).contains(&(sample.taken - BEGINS)));
    let mut model = ClockModel::new();
    let errors = errors(&mut model, &sent);
    let wrong = errors.iter().filter(|error| error.abs() > 10 * MS).count();
    assert!(wrong <= 70, "{wrong} samples");
    assert_eq!(model.resets(), 1);
}

#[test]
fn a_gap_changes_nothing() {
    for gap_s in [1, 10, 100] {
        let mut sent = send(200, 20 + gap_s, Link::Uniform(MS, 3 * MS), 7, drifting(100));
        sent.retain(|sample| !(10 * S..(10 + gap_s) * S).contains(&(sample.taken - BEGINS)));
        let mut model = ClockModel::new();
        let errors = errors(&mut model, &sent);
        assert!(errors[400..].iter().all(|error| (-10 * MS..6 * MS).contains(error)), "{gap_s} s");
        assert_eq!(model.resets(), 0);
    }
}

#[test]
fn a_stalled_link_that_delivers_all_at_once_is_no_reset() {
    let mut sent = send(200, 20, Link::Uniform(MS, 3 * MS), 8, |since| since);
    for sample in &mut sent {
        if (10 * S..12 * S).contains(&(sample.taken - BEGINS)) {
            sample.arrival = BEGINS + 12 * S;
        }
    }
    let mut model = ClockModel::new();
    let errors = errors(&mut model, &sent);
    assert!(errors[400..].iter().all(|error| (-MS..4 * MS).contains(error)));
    assert_eq!(model.resets(), 0);
}

#[test]
fn what_a_port_had_kept_before_it_was_opened_does_no_harm() {
    // 1.5 s of samples come at once, then, what was between being lost, those of 4 s on as they are taken.
    let mut sent = send(200, 10, Link::Uniform(MS, 3 * MS), 9, |since| since);
    sent.retain(|sample| !(1500 * MS..4 * S).contains(&(sample.taken - BEGINS)));
    sent[..300].iter_mut().for_each(|sample| sample.arrival = BEGINS + 4 * S - MS);
    let mut model = ClockModel::new();
    let errors = errors(&mut model, &sent);
    assert!(errors[310..].iter().all(|error| (0..5 * MS).contains(error)), "{:?}", &errors[300..310]);
}

#[test]
fn single_wrong_times_cost_nothing_else() {
    let wrong = [i64::MIN, i64::MAX, -1, 0, BEGINS * 5, 76 * S];
    let sent = send(200, 30, Link::Uniform(MS, 3 * MS), 10, drifting(0));
    let (mut model, mut random) = (ClockModel::new(), Pcg64Mcg::seed_from_u64(11));
    for (k, sample) in sent.iter().enumerate() {
        let hostile = k > 100 && k % 3 > 0 && random.random_range(0..2) == 0;
        let device = if hostile { wrong[random.random_range(0..wrong.len())] } else { sample.device };
        let mapped = model.map(TimeNs(device), TimeNs(sample.arrival)).0;
        assert!(mapped <= sample.arrival);
        if k > 100 && !hostile {
            assert!((0..4 * MS).contains(&(mapped - sample.taken)), "sample {k}: {} ns", mapped - sample.taken);
        }
    }
    assert_eq!(model.resets(), 0);
}

#[test]
fn overtaken_samples_keep_their_place() {
    let sent = send(1000, 20, Link::Network, 12, |since| since);
    let overtaken = sent.windows(2).filter(|pair| pair[1].device < pair[0].device).count();
    assert!(overtaken > 1000, "{overtaken}");
    let mut model = ClockModel::new();
    let errors = errors(&mut model, &sent);
    assert!(errors[2000..].iter().all(|error| (0..3 * MS).contains(error)));
    assert_eq!(model.resets(), 0);
}

#[test]
fn a_device_time_that_is_repeated_is_mapped_to_the_same() {
    let mut model = ClockModel::new();
    let first = model.map(TimeNs(5), TimeNs(BEGINS));
    assert_eq!(model.map(TimeNs(5), TimeNs(BEGINS + MS)), first);
    assert_eq!(ClockModel::new().map(TimeNs(5), TimeNs(BEGINS + MS)).0, BEGINS + MS);
}

proptest! {
    #![proptest_config(proptest::test_runner::Config { failure_persistence: None, ..Default::default() })]

    #[test]
    fn any_clock_and_link_are_within_the_envelope(
        seed in any::<u64>(),
        rate_hz in 60..1000_i64,
        ppm in -500..500_i64,
        least_ms in 0..50_i64,
        spread_ms in 1..16_i64,
        begins in any::<i64>(),
    ) {
        let link = Link::Uniform(least_ms * MS, (least_ms + spread_ms) * MS);
        let device = |since: i64| begins.saturating_sub(40 * S) + since - since / 1_000_000 * ppm;
        let mut model = ClockModel::new();
        let errors = errors(&mut model, &send(rate_hz, 15, link, seed, device));
        // The least of a quarter second lies within half of the spread, all but surely even at 60 Hz.
        let allowed = (least_ms - 1) * MS - spread_ms * MS / 2..=least_ms * MS + spread_ms * MS / 2 + MS;
        for error in &errors[(3 * rate_hz) as usize..] {
            prop_assert!(allowed.contains(error), "{} ns, allowed {:?}", error, allowed);
        }
        prop_assert_eq!(model.resets(), 0);
    }

    #[test]
    fn never_later_than_arrival_nor_a_minute_before_and_never_a_panic(
        times in prop::collection::vec((any::<i64>(), 0..50_000_000_i64), 1..400),
        likely in prop::collection::vec(any::<bool>(), 400),
    ) {
        let mut model = ClockModel::new();
        let mut arrival = BEGINS;
        for ((device, later), likely) in times.into_iter().zip(likely) {
            arrival += later;
            let device = if likely { arrival - 3 * MS } else { device };
            let mapped = model.map(TimeNs(device), TimeNs(arrival)).0;
            prop_assert!((arrival - 60 * S..=arrival).contains(&mapped));
        }
        // Whatever it was, two seconds of good samples set it right.
        for k in 0..400 {
            arrival += 5 * MS;
            let mapped = model.map(TimeNs(arrival - 77 * S), TimeNs(arrival)).0;
            if k > 70 {
                prop_assert!((arrival - MS..=arrival).contains(&mapped), "sample {}: {} ns", k, mapped - arrival);
            }
        }
    }

    #[test]
    fn later_samples_map_to_later_times(
        steps in prop::collection::vec((1_000..20_000_000_i64, 0..16_000_000_i64), 1..300),
    ) {
        let mut model = ClockModel::new();
        let mut last = TimeNs(i64::MIN);
        let (mut taken, mut arrival) = (0, 0);
        for (step, delay) in steps {
            taken += step;
            // A port keeps the order.
            arrival = (taken + delay).max(arrival + 1);
            let mapped = model.map(TimeNs(taken), TimeNs(arrival));
            prop_assert!(mapped > last);
            last = mapped;
        }
    }
}

#[test]
fn readings_of_the_clock_tell_a_delay_that_all_samples_have() {
    let errors_ms = |with_readings: bool| {
        let mut model = ClockModel::new();
        let mut errors_ms = Vec::new();
        for k in 0..2000 {
            let now = BEGINS + k * 5 * MS;
            if with_readings && k % 50 == 0 {
                model.observe(TimeNs(k * 5 * MS - MS), TimeNs(now));
            }
            // Published 40 ms after its image, or up to 3 ms later.
            let taken = now - 40 * MS - (k * 7919 % 4) * MS;
            errors_ms.push((model.map(TimeNs(taken - BEGINS), TimeNs(now)).0 - taken) / MS);
        }
        assert_eq!(model.resets(), 0);
        errors_ms.split_off(200)
    };
    assert!(errors_ms(true).iter().all(|error_ms| (0..=2).contains(error_ms)));
    assert!(errors_ms(false).iter().all(|error_ms| *error_ms >= 38));
}

/// Samples of a camera at 120 Hz, each `delay_ms` of its image's time and up to 5 ms more after it, and how far from
/// the truth they are mapped, with the clock read four times a second; `device` as in [`send`].
struct Camera {
    sent: Vec<Sent>,
    errors: Vec<i64>,
    in_order: bool,
    model: ClockModel,
}

impl Camera {
    fn new(delay_ms: impl Fn(i64) -> i64, device: impl Fn(i64) -> i64) -> Self {
        let mut sent = send(120, 40, Link::Uniform(0, 5 * MS), 14, &device);
        sent.iter_mut().for_each(|sample| sample.arrival += delay_ms(sample.taken - BEGINS) * MS);
        sent.sort_by_key(|sample| sample.arrival);
        let mut readings = (1..200).map(|k| k * 250 * MS).peekable();
        let mut model = ClockModel::new();
        let (mut errors, mut in_order, mut newest) = (Vec::new(), true, TimeNs(i64::MIN));
        for sample in &sent {
            while let Some(since) = readings.next_if(|since| BEGINS + since + MS <= sample.arrival) {
                model.observe(TimeNs(device(since)), TimeNs(BEGINS + since + MS));
            }
            let mapped = model.map(TimeNs(sample.device), TimeNs(sample.arrival));
            assert!(mapped.0 <= sample.arrival, "the future");
            in_order &= mapped > newest;
            newest = mapped;
            errors.push(mapped.0 - sample.taken);
        }
        Self { sent, errors, in_order, model }
    }

    /// The greatest error from `after_s` on, ms.
    fn worst_ms(&self, after_s: i64) -> i64 {
        self.worst_ms_from(after_s * S)
    }

    fn worst_ms_from(&self, since: i64) -> i64 {
        let later = self.sent.iter().zip(&self.errors).filter(|(sample, _)| sample.taken - BEGINS >= since);
        later.map(|(_, error)| error.abs()).max().expect("some") / MS
    }
}

#[test]
fn readings_tell_a_delay_that_is_longer_than_a_stray_may_lie_above_the_line() {
    for delay_ms in [0, 40, 140, 155, 200, 300, 900] {
        let camera = Camera::new(|_| delay_ms, drifting(50));
        assert_eq!((camera.model.resets(), camera.model.leaps()), (0, 0), "{delay_ms} ms");
        assert!(camera.in_order && camera.worst_ms(2) <= 3, "{delay_ms} ms: {} ms", camera.worst_ms(2));
        let spread = camera.model.report().expect("has samples").delay_spread;
        assert!((3 * MS..6 * MS).contains(&spread.0), "{delay_ms} ms: {spread:?}");
    }
    // Longer than any delay is believed to be: the readings are left alone.
    let camera = Camera::new(|_| 1500, drifting(50));
    assert_eq!(camera.model.resets(), 0);
    assert!(camera.in_order && (1499..=1506).contains(&camera.worst_ms(2)), "{} ms", camera.worst_ms(2));
}

#[test]
fn a_delay_that_changes_is_no_reset_where_readings_tell_that_the_clock_goes_on() {
    for (before_ms, after_ms) in [(40, 300), (300, 40), (100, 700), (700, 100), (10, 160)] {
        let camera = Camera::new(|since| if since < 10 * S { before_ms } else { after_ms }, drifting(50));
        assert_eq!(camera.model.resets(), 0, "{before_ms} to {after_ms} ms");
        assert!(camera.worst_ms(2) <= 5, "{before_ms} to {after_ms} ms: {} ms", camera.worst_ms(2));
    }
}

#[test]
fn a_clock_that_is_set_is_found_beside_its_readings() {
    for by in [-5000 * S, -2 * S, -900 * MS, -400 * MS, 2 * S, 90 * S] {
        for delay_ms in [5, 200] {
            let camera = Camera::new(|_| delay_ms, |since| if since < 10 * S { since } else { since + by });
            assert_eq!(camera.model.resets(), 1, "{by} with {delay_ms} ms");
            assert!(camera.worst_ms(12) <= 3, "{by} with {delay_ms} ms: {} ms", camera.worst_ms(12));
        }
    }
}

/// Whenever readings fall between the samples that tell it: one that is off the line itself is no proof that the clock
/// goes on.
#[test]
fn a_clock_that_is_set_back_a_little_is_found_at_once_beside_its_readings() {
    for by_ms in [-125, -140] {
        for phase_ms in (0..250).step_by(10) {
            let set = 10 * S + phase_ms * MS;
            let camera = Camera::new(|_| 100, |since| if since < set { since } else { since + by_ms * MS });
            assert_eq!(camera.model.resets(), 1, "{by_ms} ms at {phase_ms} ms");
            // After the next two readings.
            let late_ms = camera.worst_ms_from(set + 500 * MS);
            assert!(late_ms <= 5, "{by_ms} ms at {phase_ms} ms: {late_ms} ms");
        }
    }
}

#[test]
fn wrong_readings_do_no_lasting_harm() {
    let mut model = ClockModel::new();
    let mut errors = Vec::new();
    for k in 0..2000 {
        let now = BEGINS + k * 5 * MS;
        match k {
            400 => model.observe(TimeNs(i64::MAX), TimeNs(now)),
            600 => model.observe(TimeNs(i64::MIN), TimeNs(now)),
            800 => model.observe(TimeNs(k * 5 * MS + 10 * S), TimeNs(now)),
            _ => {}
        }
        errors.push(model.map(TimeNs(k * 5 * MS), TimeNs(now)).0 - now);
    }
    assert!(errors[590..800].iter().all(|error| error.abs() < MS));
    assert!(errors[1000..].iter().all(|error| error.abs() < MS));
}

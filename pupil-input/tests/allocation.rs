//! After its start the way from bytes to an estimate allocates nothing.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use holod_calibration::{TimeNs, rig};
use holod_pupil_input::wire::line::{LineDecoder, LineSample, encode_line};
use holod_pupil_input::wire::{Decoder, WireEvent};
use holod_pupil_input::{ClockModel, Estimator, EstimatorSettings, MockSource, PupilSample, Scenario};

/// The system's allocator, counting for each thread.
struct Counting;

thread_local! {
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

// SAFETY: every call is passed on to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.set(ALLOCATIONS.get() + 1);
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller's promises are passed on.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

fn allocations_of(work: impl FnOnce()) -> u64 {
    let before = ALLOCATIONS.get();
    work();
    ALLOCATIONS.get() - before
}

#[test]
fn the_simulated_eye_its_clock_and_the_choice_of_an_eye_allocate_nothing() {
    let text = "free-running\njitter 20ms\nahead 9s\ndrift 90ppm\n3s every 5s blink 200ms\n4s every 7s steps -600ms";
    let mut source = MockSource::of(holod_pupil_input::Script::parse("test", text).expect("a script"));
    let mut clock = ClockModel::new();
    let mut estimator =
        Estimator::new(EstimatorSettings::from(&rig::Tracker { eye: rig::Eye::Better, ..rig::Rig::default().tracker }));
    let allocations = allocations_of(|| {
        for mock in source.by_ref().take(20_000) {
            let t_sample = clock.map(mock.sample.t_device, mock.sample.t_arrival);
            estimator.push(PupilSample { t_sample, ..mock.sample }, |_| {});
        }
    });
    assert_eq!(allocations, 0);
    assert!(clock.resets() > 3);
}

#[test]
fn the_count_sees_an_allocation() {
    assert_eq!(allocations_of(|| drop(std::hint::black_box(Box::new(1)))), 1);
}

#[test]
fn bytes_become_estimates_without_allocation() {
    let mut bytes = String::new();
    for mock in MockSource::new(Scenario::Blinks, 3).take(4000) {
        let PupilSample { t_device, eye, diameter_mm, confidence, sequence, .. } = mock.sample;
        let sequence = sequence.expect("the mock counts");
        encode_line(&LineSample { sequence, device_us: t_device.0 / 1000, eye, diameter_mm, confidence }, &mut bytes);
        bytes.push_str("rubbish\n");
    }
    let mut decoder = LineDecoder::new();
    let mut clock = ClockModel::new();
    let mut estimator = Estimator::new(EstimatorSettings::from(&rig::Rig::default().tracker));
    let mut sum_mm = 0.0;
    let allocations = allocations_of(|| {
        for chunk in bytes.as_bytes().chunks(61) {
            decoder.push(chunk, &mut |event| {
                let WireEvent::Sample(line) = event else { return };
                let t_device = line.t_device.expect("a line has a time");
                let t_arrival = t_device + TimeNs(7_000_000_000);
                let sample = PupilSample {
                    t_device,
                    t_sample: clock.map(t_device, t_arrival),
                    t_arrival,
                    eye: line.eye,
                    diameter_mm: line.diameter_mm,
                    confidence: line.confidence,
                    aperture_mm: None,
                    sequence: line.sequence,
                    valid: true,
                };
                estimator.push(sample, |_| {});
                sum_mm += estimator.snapshot().pupil_at(t_arrival).pupil.mm();
            });
        }
    });
    assert_eq!(allocations, 0);
    assert!((3.5..4.5).contains(&(sum_mm / 4000.0)), "{}", sum_mm / 4000.0);
}

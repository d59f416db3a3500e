//! After its start the way from bytes to an estimate allocates nothing.

mod counting;

use holod_calibration::{TimeNs, rig};
use holod_pupil_input::wire::line::{LineDecoder, LineSample, encode_line};
use holod_pupil_input::wire::{Decoder, WireEvent};
use holod_pupil_input::{ClockModel, Estimator, EstimatorSettings, MockSource, PupilSample, Scenario};

fn allocations_of(work: impl FnOnce()) -> u64 {
    let before = counting::here();
    work();
    counting::here() - before
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

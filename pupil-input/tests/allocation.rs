//! After its start the way from bytes to an estimate allocates nothing.

use holod_calibration::{TimeNs, rig};
use holod_pupil_input::wire::line::{LineDecoder, LineSample, encode_line};
use holod_pupil_input::wire::{Decoder, WireEvent};
use holod_pupil_input::{
    ClockModel, Estimator, EstimatorSettings, MockSource, Profile, PupilSample, SampleEye, Scenario,
};
use holod_tests::counting::{self, Counting};

#[global_allocator]
static COUNTING: Counting = Counting;

fn allocations_of(work: impl FnOnce()) -> u64 {
    let before = counting::here();
    work();
    counting::here() - before
}

#[test]
fn the_simulated_eye_its_clock_and_the_choice_of_an_eye_allocate_nothing() {
    let text = "free-running\njitter 20ms\nahead 9s\ndrift 90ppm\n3s every 5s blink 200ms\n4s every 7s steps -600ms";
    let mut source = MockSource::of(holod_pupil_input::Script::parse("test", text).expect("a script"));
    let mut clock = ClockModel::new();
    let mut estimator =
        Estimator::new(EstimatorSettings::from(&rig::Tracker { eye: rig::Eye::Better, ..rig::Rig::default().tracker }));
    let other = EstimatorSettings::from(&rig::Rig::default().tracker);
    let allocations = allocations_of(|| {
        for mock in source.by_ref().take(20_000) {
            let t_sample = clock.map(mock.sample.t_device, mock.sample.t_arrival);
            estimator.push(PupilSample { t_sample, ..mock.sample }, |_| {});
        }
        estimator.change(other, TimeNs(0), |_| {});
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

#[test]
fn no_decoder_of_a_shipped_profile_allocates_for_its_bytes() {
    let mut line = String::new();
    let sample = LineSample { sequence: 7, device_us: 8, eye: SampleEye::Left, diameter_mm: 3.5, confidence: 0.9 };
    encode_line(&sample, &mut line);
    let packet = [0xAA, 0x55, 9, 0, 0x40, 0x42, 0x0F, 0, 0xB2, 0x0C, 0xB2, 0x0C, 255, 51, 0, 0];
    let frame = [0xFA, 0, 0, 0, 1, 2, 0x10, 0, 0, 0, 0, 0];
    let messages = [
        line.as_bytes(),
        b"millis,left_mm,right_mm\r\n1000,3.25,4.125\r\nx,,\n# comment\n",
        &packet,
        &frame,
        &[1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15],
        b"\x44\x44\x01\x02 rubbish \r\n",
    ];
    // Whatever comes, and however it is cut: lines and packets of the right kind, of others, and halves of them.
    let bytes = [messages.concat(), messages[..3].concat(), vec![b'7'; 9000], messages.concat()].concat();
    for profile in Profile::shipped() {
        let mut decoder = profile.decoder();
        let mut events = 0;
        let allocations = allocations_of(|| {
            for round in 0..20 {
                for chunk in bytes.chunks(7 + 31 * round) {
                    decoder.push(chunk, &mut |_| events += 1);
                }
            }
        });
        assert_eq!(allocations, 0, "{}", profile.name);
        assert!(events > 0, "{}", profile.name);
    }
}

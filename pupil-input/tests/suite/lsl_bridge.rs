//! The bridge of `doc/lab-streaming-layer.md`: what it sent of a real stream's left and right eye is read as such.

use holod_pupil_input::SampleEye;
use holod_pupil_input::wire::WireSample;
use holod_pupil_input::wire::line::{LineSample, parse_line};

#[test]
fn lines_of_the_bridge_are_read() {
    let sample = |sequence, device_us, eye, diameter_mm, confidence| {
        Ok(LineSample { sequence, device_us, eye, diameter_mm, confidence })
    };
    assert_eq!(
        parse_line(b"P1,6,16731209120,R,3.5000,1.000*D8"),
        sample(6, 16_731_209_120, SampleEye::Right, 3.5, 1.0)
    );
    // A pupil that was NaN is lost.
    let lost = parse_line(b"P1,7,16731214296,L,0.0000,0.000*26");
    assert_eq!(lost, sample(7, 16_731_214_296, SampleEye::Left, 0.0, 0.0));
    assert!(lost.is_ok_and(|line| !WireSample::from(line).valid));
    assert!(parse_line(b"P1,7,16731214296,L,0.0000,0.000*27").is_err());
}

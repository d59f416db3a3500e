//! The samples of a run with what the gate said of each, as a table.

use std::io::{self, Write};

use crate::estimator::Decision;
use crate::gate::Verdict;

/// Its first line. Times are ns: `t_device` on the tracker's own clock, the others on the host's monotonic clock (of a
/// log that is played: `t_sample` on the log's; of a recording that is played both, on the clock of the run that
/// recorded it). Diameters are scaled to millimetres; empty cells are what the tracker does not tell.
pub(crate) const SAMPLES_HEADER: &str =
    "t_device_ns,t_sample_ns,t_arrival_ns,eye,diameter_mm,confidence,aperture_mm,sequence,valid,verdict";

/// Writes one row; numbers are written so that they read back as the same bits.
pub(crate) fn write_sample(decision: &Decision, out: &mut impl Write) -> io::Result<()> {
    let sample = &decision.sample;
    let (t_device, t_sample, t_arrival) = (sample.t_device.0, sample.t_sample.0, sample.t_arrival.0);
    write!(out, "{t_device},{t_sample},{t_arrival},{},{},{},", sample.eye, sample.diameter_mm, sample.confidence)?;
    if let Some(aperture_mm) = sample.aperture_mm {
        write!(out, "{aperture_mm}")?;
    }
    out.write_all(b",")?;
    if let Some(sequence) = sample.sequence {
        write!(out, "{sequence}")?;
    }
    let verdict = match decision.verdict {
        Verdict::Accepted => "accepted",
        Verdict::Rejected(reason) => reason.name(),
    };
    writeln!(out, ",{},{verdict}", u8::from(sample.valid))
}

#[cfg(test)]
mod tests {
    use holod_calibration::TimeNs;

    use super::*;
    use crate::gate::Rejection;
    use crate::{PupilSample, SampleEye};

    #[test]
    fn a_row_holds_every_field() {
        let sample = PupilSample {
            t_device: TimeNs(-1),
            t_sample: TimeNs(2),
            t_arrival: TimeNs(3),
            eye: SampleEye::Right,
            diameter_mm: 0.3,
            confidence: 1.0,
            aperture_mm: None,
            sequence: Some(u64::MAX),
            valid: true,
        };
        let row = |decision| {
            let mut out = Vec::new();
            write_sample(&decision, &mut out).expect("memory takes all");
            String::from_utf8(out).expect("text")
        };
        let accepted = row(Decision { sample, verdict: Verdict::Accepted });
        assert_eq!(accepted, "-1,2,3,right,0.3,1,,18446744073709551615,1,accepted\n");
        let lost = PupilSample { valid: false, sequence: None, aperture_mm: Some(7.5), ..sample };
        let rejected = row(Decision { sample: lost, verdict: Verdict::Rejected(Rejection::Guard) });
        assert_eq!(rejected, "-1,2,3,right,0.3,1,7.5,,0,guard\n");
        assert_eq!(accepted.split(',').count(), SAMPLES_HEADER.split(',').count());
        let read: f32 = accepted.split(',').nth(4).expect("a diameter").parse().expect("a number");
        assert_eq!(read.to_bits(), sample.diameter_mm.to_bits());
    }
}

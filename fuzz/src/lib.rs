//! What every decoder and every importer must hold on any bytes.

use std::path::{Path, PathBuf};

use holod_calibration::{TimeNs, rig};
use holod_pupil_input::wire::{Decoder, WireEvent};
use holod_pupil_input::{Estimator, EstimatorSettings, LogInfo, Recording};
pub use holod_tests::counting;
use holod_tests::counting::Counting;

#[global_allocator]
static COUNTING: Counting = Counting;

/// More than any decoder makes of `bytes`, so that what it does can be written down without an allocation.
const fn most_events(bytes: usize) -> usize {
    4 * bytes + 16
}

/// Pushes a stream at once and in pieces that the stream itself decides, and holds the decoder to: the same events, no
/// more of them than there is reason for, samples that can be used, and nothing allocated, so that no state grows.
pub fn check_stream(decoder: impl Fn() -> Box<dyn Decoder>, bytes: &[u8]) {
    let whole = events_of(&mut *decoder(), bytes.len(), [bytes]);
    let mut rest = bytes;
    let pieces = std::iter::from_fn(|| {
        let first = rest.first()?;
        let (now, later) = rest.split_at((1 + usize::from(first % 64)).min(rest.len()));
        rest = later;
        Some(now)
    });
    assert_eq!(events_of(&mut *decoder(), bytes.len(), pieces), whole, "the split of the bytes matters");
    assert_eq!(events_of(&mut *decoder(), bytes.len(), bytes.chunks(1)), whole, "bytes one by one give other events");
}

/// Pushes messages (a byte for the length, then as many) to a decoder of whole messages.
pub fn check_messages(mut decoder: Box<dyn Decoder>, bytes: &[u8]) {
    let mut rest = bytes;
    let messages = std::iter::from_fn(|| {
        let (length, behind) = rest.split_first()?;
        let (message, later) = behind.split_at(usize::from(*length).min(behind.len()));
        rest = later;
        Some(message)
    });
    events_of(&mut *decoder, bytes.len(), messages);
}

/// Pushes one message to a decoder of whole messages.
pub fn check_message(mut decoder: Box<dyn Decoder>, message: &[u8]) {
    events_of(&mut *decoder, message.len(), [message]);
}

/// The events of `bytes` bytes in pieces.
fn events_of<'a>(
    decoder: &mut dyn Decoder,
    bytes: usize,
    pieces: impl IntoIterator<Item = &'a [u8]>,
) -> Vec<WireEvent> {
    let mut events = Vec::with_capacity(most_events(bytes));
    let allocations = counting::here();
    for piece in pieces {
        decoder.push(piece, &mut |event| events.push(event));
    }
    decoder.finish(&mut |event| events.push(event));
    assert_eq!(counting::here(), allocations, "the decoder, or too many events, allocated");
    assert!(events.len() <= most_events(bytes), "{} events of {bytes} bytes", events.len());
    for event in &mut events {
        if let WireEvent::Sample(sample) = event {
            assert!(!sample.valid || (sample.diameter_mm.is_finite() && sample.diameter_mm >= 0.0), "{sample:?}");
            assert!((0.0..=1.0).contains(&sample.confidence), "{sample:?}");
            assert!(sample.aperture_mm.is_none_or(f32::is_finite), "{sample:?}");
            if !sample.valid {
                // Means nothing, and a NaN is not itself.
                sample.diameter_mm = 0.0;
            }
        }
    }
    events
}

/// A folder of this process for log files.
pub fn folder() -> PathBuf {
    let folder = std::env::temp_dir().join(format!("holod-fuzz-{}", std::process::id()));
    std::fs::create_dir_all(&folder).expect("the folder can be made");
    folder
}

/// Reads a log and holds what it gives to: times in order, diameters that can be used, a summary, and estimates of a
/// pupil that an eye can have.
pub fn check_log(path: &Path) {
    let recording = match Recording::read(path) {
        Ok(recording) => recording,
        Err(error) => return drop(std::hint::black_box(error.to_string())),
    };
    let mut last = recording.begins();
    for sample in recording.samples() {
        assert!(sample.t_sample >= last, "{sample:?} behind {last:?}");
        assert!(!sample.valid || (sample.diameter_mm.is_finite() && sample.diameter_mm >= 0.0), "{sample:?}");
        last = sample.t_sample;
    }
    assert_eq!(recording.samples().count(), recording.len());
    assert!(last <= recording.ends());
    assert!(recording.blinks().iter().all(|blink| blink.begins <= blink.ends), "a blink that ends before it begins");
    let info = LogInfo::of(&recording, Some(0.01));
    assert_eq!(info.samples, recording.len() as u64);
    assert_eq!(info.eyes.iter().map(|eye| eye.samples).sum::<u64>(), info.samples, "samples of no eye");
    for eye in [rig::Eye::Both, rig::Eye::Better] {
        check_estimates(&recording, EstimatorSettings::from(&rig::Tracker { eye, ..rig::Rig::default().tracker }));
    }
}

fn check_estimates(recording: &Recording, settings: EstimatorSettings) {
    let pupils_mm = settings.gate.least_mm..=settings.gate.greatest_mm;
    let mut estimator = Estimator::new(settings);
    let mut decided = 0;
    for sample in recording.samples() {
        estimator.push(sample, |_| decided += 1);
        let estimate = estimator.pupil_at(sample.t_sample + TimeNs(20_000_000));
        assert!(pupils_mm.contains(&estimate.pupil.mm()), "{estimate:?} after {sample:?}");
        assert!(estimate.velocity_mm_per_s.is_finite(), "{estimate:?} after {sample:?}");
    }
    estimator.finish(|_| decided += 1);
    assert_eq!(decided, recording.len(), "each sample is judged once");
}

/// The first part of an input that is cut by zero bytes, and what follows it.
pub fn cut_at_zero(bytes: &[u8]) -> (&[u8], &[u8]) {
    let at = bytes.iter().position(|&byte| byte == 0).unwrap_or(bytes.len());
    (&bytes[..at], bytes.get(at + 1..).unwrap_or_default())
}

/// The first part of an input, whose length its first two bytes tell, and what follows it.
pub fn cut_by_length(bytes: &[u8]) -> (&[u8], &[u8]) {
    let Some((length, rest)) = bytes.split_first_chunk() else { return (&[], bytes) };
    rest.split_at(usize::from(u16::from_le_bytes(*length)).min(rest.len()))
}

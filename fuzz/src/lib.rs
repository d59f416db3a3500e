//! What every decoder must hold on any bytes.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use holod_pupil_input::wire::{Decoder, WireEvent};

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

/// More than any decoder makes of `bytes`, so that what it does can be written down without an allocation.
const fn most_events(bytes: usize) -> usize {
    4 * bytes + 16
}

/// Pushes a stream at once and in pieces that the stream itself decides, and holds the decoder to: the same events, no
/// more of them than there is reason for, samples that can be used, and nothing allocated, so that no state grows.
pub fn check_stream(decoder: impl Fn() -> Box<dyn Decoder>, bytes: &[u8]) {
    let whole = events_of(&mut *decoder(), [bytes]);
    let mut rest = bytes;
    let pieces = std::iter::from_fn(|| {
        let first = rest.first()?;
        let (now, later) = rest.split_at((1 + usize::from(first % 64)).min(rest.len()));
        rest = later;
        Some(now)
    });
    assert_eq!(events_of(&mut *decoder(), pieces), whole, "the split of the bytes matters");
    assert_eq!(events_of(&mut *decoder(), bytes.chunks(1)), whole, "bytes one by one give other events");
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
    events_of(&mut *decoder, messages);
}

/// Pushes one message to a decoder of whole messages.
pub fn check_message(mut decoder: Box<dyn Decoder>, message: &[u8]) {
    events_of(&mut *decoder, [message]);
}

fn events_of<'a>(decoder: &mut dyn Decoder, pieces: impl IntoIterator<Item = &'a [u8]>) -> Vec<WireEvent> {
    let mut events = Vec::with_capacity(1 << 16);
    let mut bytes = 0;
    let allocations = ALLOCATIONS.get();
    for piece in pieces {
        bytes += piece.len();
        decoder.push(piece, &mut |event| events.push(event));
    }
    decoder.finish(&mut |event| events.push(event));
    assert_eq!(ALLOCATIONS.get(), allocations, "the decoder, or too many events, allocated");
    assert!(events.len() <= most_events(bytes), "{} events of {bytes} bytes", events.len());
    for event in &events {
        if let WireEvent::Sample(sample) = event {
            assert!(!sample.valid || (sample.diameter_mm.is_finite() && sample.diameter_mm >= 0.0), "{sample:?}");
            assert!((0.0..=1.0).contains(&sample.confidence), "{sample:?}");
            assert!(sample.aperture_mm.is_none_or(f32::is_finite), "{sample:?}");
        }
    }
    events
}

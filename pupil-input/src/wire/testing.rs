//! What the decoders' tests share.

use super::{Decoder, WireEvent};

/// What all of `bytes` at once, and the end behind them, give.
pub(crate) fn events_of(decoder: &mut dyn Decoder, bytes: &[u8]) -> Vec<WireEvent> {
    split_events(decoder, bytes, &[bytes.len().max(1)])
}

/// What `bytes` give when they come in pieces of these lengths, again and again.
pub(crate) fn split_events(decoder: &mut dyn Decoder, bytes: &[u8], cuts: &[usize]) -> Vec<WireEvent> {
    let mut events = Vec::new();
    let mut rest = bytes;
    for &cut in cuts.iter().cycle() {
        if rest.is_empty() {
            break;
        }
        let (now, later) = rest.split_at(cut.min(rest.len()));
        decoder.push(now, &mut |event| events.push(event));
        rest = later;
    }
    decoder.finish(&mut |event| events.push(event));
    events
}

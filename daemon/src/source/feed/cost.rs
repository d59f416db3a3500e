//! What a picture of the feed costs, beside a copy of its bytes in memory in the same run.

use std::hint::black_box;
use std::time::{Duration, Instant};

use holod_calibration::{DisplayGeometry, Resolution, TimeNs};
use holod_model::RgbdFrame;
use holod_model::scene::{Fit, LiveColour, LiveDepth, LiveFormat};
use rustix::io::pwrite;

use super::client::{Copied, Stream, Target};
use super::message::VERSION;
use super::slots::Picture;

/// What was measured, once for each round.
pub struct FeedCost {
    /// Bytes of a picture: colour and depth.
    pub picture_bytes: usize,
    /// A copy of these bytes from memory to memory.
    pub memcpy: Vec<Duration>,
    /// What is done while the client waits for its slot: the picture's bytes are copied out of the shared memory, and
    /// it is found out whether it can be shown.
    pub take: Vec<Duration>,
    /// What is done once the slot has been given back: a frame is made of the copy.
    pub make: Vec<Duration>,
}

/// Measures with pictures of RGBA8 and 16-bit millimetres of the hologram's size, in turn, on this thread.
///
/// # Errors
/// There is no memory for the pictures.
pub fn measure(resolution: Resolution, rounds: u32) -> std::io::Result<FeedCost> {
    let format = LiveFormat { resolution, colour: LiveColour::Rgba8, depth: LiveDepth::MillimetresU16 };
    let target = Target { geometry: DisplayGeometry::DEFAULT, resolution, fit: Fit::Native };
    let mut stream = Stream::open(VERSION, format, &target).map_err(std::io::Error::other)?;
    let colour: Vec<u8> = (0..format.colour_bytes()).map(|at| (at * 7) as u8).collect();
    let depth: Vec<u8> = (0..resolution.pixels()).flat_map(|at| (400 + (at % 3000) as u16).to_ne_bytes()).collect();
    let (mut colour_copy, mut depth_copy) = (vec![0; colour.len()], vec![0; depth.len()]);
    let picture = Picture { slot: 0, sequence: 0, t_taken: TimeNs(0), t_heard: TimeNs(0) };
    let (mut copied, mut frame) = (Copied::default(), RgbdFrame::black(resolution));

    let mut cost =
        FeedCost { picture_bytes: colour.len() + depth.len(), memcpy: Vec::new(), take: Vec::new(), make: Vec::new() };
    // The first round warms memory and caches and is thrown away.
    for round in 0..=rounds {
        // The client writes it anew each time.
        for (bytes, at) in [&colour, &depth].into_iter().zip(stream.offsets(&picture)) {
            write_whole(&stream, bytes, at)?;
        }
        let memcpy = timed(|| {
            colour_copy.copy_from_slice(black_box(&colour));
            depth_copy.copy_from_slice(black_box(&depth));
        });
        black_box((&colour_copy, &depth_copy));
        let mut taken = Ok(());
        let take = timed(|| taken = stream.copy_out(&picture, &mut copied));
        taken.map_err(std::io::Error::other)?;
        let mut made = None;
        let make = timed(|| made = Some(stream.make(&copied, &mut frame)));
        black_box((&frame, made));
        if round > 0 {
            cost.memcpy.push(memcpy);
            cost.take.push(take);
            cost.make.push(make);
        }
    }
    Ok(cost)
}

fn write_whole(stream: &Stream, mut bytes: &[u8], mut at: usize) -> std::io::Result<()> {
    while !bytes.is_empty() {
        let written = pwrite(stream.memory(), bytes, at as u64)?;
        bytes = &bytes[written..];
        at += written;
    }
    Ok(())
}

fn timed(work: impl FnOnce()) -> Duration {
    let began = Instant::now();
    work();
    began.elapsed()
}

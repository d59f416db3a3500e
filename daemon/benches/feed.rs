//! What it costs a client to hand a 1920x1080 picture over through the live feed, beside a copy of its bytes in the
//! same run: `cargo bench -p holod --bench feed`. What holod itself does with it is measured by `holod bench --feed`.

#![allow(clippy::print_stdout, reason = "it prints what it measured")]

use std::hint::black_box;
use std::sync::Arc;
use std::time::{Duration, Instant};

use holod_calibration::{DisplayGeometry, Resolution, TimeNs};
use holod_daemon::source::feed::FeedPlan;
use holod_daemon::source::{self, OpenPictures, Pictures};
use holod_model::scene::{Fit, LiveColour, LiveDepth, LiveFormat};
use holod_tests::feed::{Answer, FeedClient, hello};

const SIZE: Resolution = Resolution { width: 1920, height: 1080 };
const ROUNDS: usize = 31;

fn main() {
    let format = LiveFormat { resolution: SIZE, colour: LiveColour::Rgba8, depth: LiveDepth::MillimetresU16 };
    let colour: Vec<u8> = (0..format.colour_bytes()).map(|at| (at * 7) as u8).collect();
    let depth: Vec<u8> = (0..SIZE.pixels()).flat_map(|at| (400 + (at % 3000) as u16).to_ne_bytes()).collect();
    let (mut colour_copy, mut depth_copy) = (colour.clone(), depth.clone());

    let folder = tempfile::tempdir().expect("a folder for the socket");
    let socket = folder.path().join("feed");
    let plan = Arc::new(FeedPlan::new(socket.clone(), SIZE, Fit::Native));
    let pictures = Pictures::Feed(plan);
    let OpenPictures { mut source, feed: _feed, .. } =
        source::open(&pictures, &DisplayGeometry::DEFAULT, TimeNs(0)).expect("a feed");
    let mut client = FeedClient::connect(&socket).expect("a connection");
    client.say(&hello(SIZE.width as u32, SIZE.height as u32, None, "bench")).expect("the feed listens");
    assert_eq!(client.answer(), Answer::Ring);

    let mut times = [const { Vec::new() }; 3];
    for round in 0..ROUNDS {
        times[0].push(timed(|| {
            colour_copy.copy_from_slice(black_box(&colour));
            depth_copy.copy_from_slice(black_box(&depth));
        }));
        times[1].push(timed(|| client.write(0, &colour, &depth)));
        times[2].push(timed(|| {
            client.hand_over(0, 1 + round as u64, 0).expect("the feed listens");
            assert!(matches!(client.answer(), Answer::Free { outcome: 0, .. }));
        }));
        black_box((&colour_copy, &depth_copy, source.at(TimeNs(0)).1));
    }
    let [copied, others @ ..] = times.map(median_ms);
    let bytes = format.colour_bytes() + format.depth_bytes();
    println!("{SIZE}, RGBA8 and 16-bit millimetres: {:.1} MB", bytes as f64 / 1e6);
    println!("a copy of the bytes in memory          {copied:6.2} ms");
    let names = ["written into the shared memory", "handed over, until the slot is free"];
    for (name, ms) in names.into_iter().zip(others) {
        println!("{name:36}   {ms:6.2} ms, {:5.2} of a copy", ms / copied);
    }
}

fn timed(work: impl FnOnce()) -> Duration {
    let began = Instant::now();
    work();
    began.elapsed()
}

fn median_ms(mut times: Vec<Duration>) -> f64 {
    times.sort();
    times[times.len() / 2].as_secs_f64() * 1e3
}

//! The live feed as other programs meet it: what they hand over is what the panel shows.

use std::fs;
use std::path::Path;
use std::time::Duration;

use holod_tests::daemon::{Daemon, run, wait_until};
use holod_tests::feed::{Answer, FeedClient, hello};
use holod_tests::{frames, small_rig};
use rustix::process::Signal;
use serde_json::Value;

use crate::HOLOD;

const PATIENCE: Duration = Duration::from_secs(60);
const SIDE: u32 = 64;

/// A folder with a rig and a log of an eye whose pupil never changes.
fn bench() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("rig.toml"), small_rig(64, 64, "driver = \"simulated\"")).unwrap();
    let rows = (0..24_000_u64).map(|row| format!("{},left,3.0,1.0,,1\n", row * 5_000_000));
    let log = "t_ns,eye,diameter_mm,confidence,aperture_mm,valid\n".to_owned() + &rows.collect::<String>();
    fs::write(folder.path().join("steady.csv"), log).unwrap();
    folder
}

fn holod_with_feed(folder: &Path, more: &[&str]) -> Daemon {
    let args = ["--config", "rig.toml", "--tracker", "steady.csv", "--scene", "feed:pictures"];
    let daemon = Daemon::start_with(HOLOD, &[&args, more].concat(), folder, &[("XDG_RUNTIME_DIR", folder)]);
    assert!(wait_until(PATIENCE, || folder.join("pictures").exists()), "the feed listens");
    daemon
}

/// RGBA and millimetres of a slanted plane with a bright square on it.
fn picture(shift: u32) -> (Vec<u8>, Vec<u8>) {
    let pixels = || (0..SIDE).flat_map(|y| (0..SIDE).map(move |x| (x, y)));
    let square = |x: u32, y: u32| (x + shift) % SIDE < 20 && (10..40).contains(&y);
    let colour = pixels().flat_map(|(x, y)| if square(x, y) { [255, 200, 60, 255] } else { [30, 60, x as u8, 255] });
    let depth = pixels().flat_map(|(x, y)| if square(x, y) { 450_u16 } else { 1500 + 20 * y as u16 }.to_ne_bytes());
    (colour.collect(), depth.collect())
}

fn connect(folder: &Path) -> FeedClient {
    let mut client = FeedClient::connect(&folder.join("pictures")).unwrap();
    client.say(&hello(SIDE, SIDE, None, "test camera")).unwrap();
    assert_eq!(client.answer(), Answer::Ring);
    client
}

fn send(client: &mut FeedClient, sequence: u64, (colour, depth): &(Vec<u8>, Vec<u8>)) {
    client.write(0, colour, depth);
    client.hand_over(0, sequence, 0).unwrap();
    assert!(matches!(client.answer(), Answer::Free { outcome: 0, .. }));
}

/// What `holod status` says of one, with `more` options.
fn said_of(daemon: &Daemon, folder: &Path, more: &[&str]) -> String {
    let pid = daemon.pid().to_string();
    let args = [&["status", "--pid", &pid], more].concat();
    Daemon::start_with(HOLOD, &args, folder, &[("XDG_RUNTIME_DIR", folder)]).wait(PATIENCE).stdout
}

fn status(daemon: &Daemon, folder: &Path) -> Value {
    serde_json::from_str(&said_of(daemon, folder, &["--json"])).unwrap_or_default()
}

/// The one picture of the panel's levels in a record.
fn levels(record: &Path) -> Vec<u8> {
    let is_levels = |name: &str| name.starts_with("shown_pupil_3.00mm") && name.ends_with(".png");
    let mut found = fs::read_dir(record).unwrap().map(|entry| entry.unwrap().path());
    let path = found.find(|path| is_levels(&path.file_name().unwrap().to_string_lossy())).expect("levels at 3 mm");
    fs::read(path).unwrap()
}

#[test]
fn a_picture_that_is_handed_over_becomes_the_levels_of_the_same_picture_in_files() {
    let folder = bench();
    let (colour, depth) = picture(0);
    let save = |name: &str, picture: image::DynamicImage| picture.save(folder.path().join(name)).unwrap();
    save("colour.png", image::RgbaImage::from_raw(SIDE, SIDE, colour.clone()).unwrap().into());
    let millimetres = depth.as_chunks::<2>().0.iter().map(|&bytes| u16::from_ne_bytes(bytes)).collect();
    save(
        "depth.png",
        image::ImageBuffer::<image::Luma<u16>, Vec<u16>>::from_raw(SIDE, SIDE, millimetres).unwrap().into(),
    );
    let scene = ["--scene", "colour.png,depth.png", "--depth-encoding", "millimetres", "--duration", "3s"];
    let common = ["--config", "rig.toml", "--tracker", "steady.csv", "--record", "of-files"];
    let ended = run(HOLOD, &[&common[..], &scene].concat(), folder.path());
    assert!(ended.status.success(), "{}", ended.stderr);

    let daemon = holod_with_feed(folder.path(), &["--record", "of-feed", "--json"]);
    let mut client = connect(folder.path());
    // What is not shown any more must leave no trace in what is.
    send(&mut client, 1, &picture(30));
    send(&mut client, 2, &(colour, depth));
    let shown = || fs::read_to_string(folder.path().join("of-feed/frames.csv")).unwrap_or_default();
    assert!(wait_until(PATIENCE, || shown().lines().filter(|row| row.contains(",tracking,")).count() > 60));
    daemon.signal(Signal::TERM);
    let ended = daemon.wait(PATIENCE);
    assert!(ended.status.success(), "{}", ended.stderr);
    assert!(levels(&folder.path().join("of-feed")) == levels(&folder.path().join("of-files")), "other levels");
    let summary: Value = serde_json::from_str(&ended.stdout).unwrap();
    assert_eq!((&summary["feed"]["taken"], &summary["feed"]["refused"]), (&2.into(), &0.into()));
    assert!(summary["picture_to_photon"]["median_ms"].as_f64().unwrap() > 0.0, "{summary:#}");
    let rows = frames::read(&folder.path().join("of-feed/frames.csv")).unwrap();
    let pictures: Vec<_> = rows.iter().map(|row| row.picture).collect();
    assert!(pictures.is_sorted() && pictures.last() == Some(&2), "{pictures:?}");
    assert!(!folder.path().join("pictures").exists(), "the socket goes with holod");
}

#[test]
fn a_client_that_dies_leaves_its_picture_and_the_loop_goes_on() {
    let folder = bench();
    let daemon = holod_with_feed(folder.path(), &["--json"]);
    let mut client = connect(folder.path());
    send(&mut client, 1, &picture(0));
    assert!(wait_until(PATIENCE, || status(&daemon, folder.path())["feed"]["shown"] == "test camera"));
    client.write(1, &[7; 400], &[]);
    drop(client);
    let mut frames_shown = None;
    let nobody_is_shown = || {
        let status = status(&daemon, folder.path());
        frames_shown = status["frames_shown"].as_u64();
        status["feed"].is_object() && status["feed"]["shown"].is_null()
    };
    assert!(wait_until(PATIENCE, nobody_is_shown));
    assert!(wait_until(PATIENCE, || status(&daemon, folder.path())["frames_shown"].as_u64() > frames_shown));
    let mut next = connect(folder.path());
    send(&mut next, 1, &picture(5));
    assert!(wait_until(PATIENCE, || status(&daemon, folder.path())["feed"]["taken"] == 2));
    let text = said_of(&daemon, folder.path(), &[]);
    assert!(text.contains("`test camera` is shown, of 1") && text.contains("2 pictures taken"), "{text}");
    daemon.signal(Signal::TERM);
    let ended = daemon.wait(PATIENCE);
    assert!(ended.status.success(), "{}", ended.stderr);
    assert!(ended.stderr.contains("the last picture of `test camera` stays"), "{}", ended.stderr);
    let summary: Value = serde_json::from_str(&ended.stdout).unwrap();
    assert_eq!(summary["lasers"]["unsafe_findings"], 0);
}

#[test]
fn what_cannot_be_a_feed_is_said() {
    let folder = bench();
    let refused = |args: &[&str], exit: i32, expected: &str| {
        let ended = run(HOLOD, args, folder.path());
        assert_eq!(ended.status.code(), Some(exit), "{}", ended.stderr);
        assert!(ended.stderr.contains(expected), "{}", ended.stderr);
    };
    let feed = ["--config", "rig.toml", "--scene", "feed:pictures", "--duration", "1s"];
    refused(&[&feed[..], &["--depth-encoding", "metres"]].concat(), 64, "a feed's clients say what their depths are");
    refused(&[&feed[..], &["--resolution", "128x64"]].concat(), 64, "larger than the panel of 64x64");
    refused(&["render", "--scene", "feed", "--pupil", "3", "--out", "x"], 64, "for `holod run` alone");
    let daemon = holod_with_feed(folder.path(), &[]);
    refused(&feed, 69, "another holod listens there; name another socket with --scene feed:PATH");
    drop(daemon);
    assert!(folder.path().join("pictures").exists(), "holod was killed");
    let ended = run(HOLOD, &feed, folder.path());
    assert!(ended.status.success(), "the socket of a killed holod is replaced: {}", ended.stderr);
}

//! The live feed as other programs meet it: what they hand over is what the panel shows.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use holod_pupil_input::host_now;
use holod_tests::daemon::{Daemon, run, wait_until};
use holod_tests::feed::{Answer, FeedClient, hello};
use holod_tests::{frames, small_rig};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

use crate::HOLOD;

const PATIENCE: Duration = Duration::from_secs(60);
const SIDE: u32 = 64;

/// A folder with a rig and a log of an eye whose pupil never changes.
fn bench() -> tempfile::TempDir {
    let folder = holod_tests::new_folder();
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
    let mut hello = hello(SIDE, SIDE, None, "test camera");
    hello[4..8].copy_from_slice(&2_u32.to_ne_bytes());
    client.say(&hello).unwrap();
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
    client.write(0, &colour, &depth);
    client.hand_over_with(0, 2, 0, 3, [1.25, 60.0, 45.5]).unwrap();
    assert!(matches!(client.answer(), Answer::Free { outcome: 0, .. }));
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
    let view = |row: &frames::FieldRow| (row.picture_focus_dpt, row.picture_fov_x_deg, row.picture_fov_y_deg);
    let taken = (Some(1.25), Some(60.0), Some(45.5));
    assert!(rows.iter().all(|row| view(row) == if row.picture == 2 { taken } else { (None, None, None) }));
    assert!(
        ended.stderr.contains("pictures taken with 60.0 x 45.5 degrees are shown in 0.7 x 0.7"),
        "{}",
        ended.stderr
    );
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
fn a_client_of_another_clock_is_told_and_one_that_comes_and_goes_does_not_fill_the_log() {
    let folder = bench();
    let daemon = holod_with_feed(folder.path(), &["--json"]);
    let mut client = connect(folder.path());
    client.write(0, &picture(0).0, &picture(0).1);
    for t_taken_ns in [1, 2] {
        client.hand_over(0, t_taken_ns as u64, t_taken_ns).unwrap();
        assert!(matches!(client.answer(), Answer::Free { outcome: 0, .. }), "it is shown all the same");
    }
    let feed = |key: &str| status(&daemon, folder.path())["feed"][key].clone();
    assert!(wait_until(PATIENCE, || feed("shown") == "test camera"));
    std::thread::sleep(Duration::from_secs(1));
    drop(client);
    for sequence in 0..150 {
        let mut client = connect(folder.path());
        client.write(0, &picture(0).0, &picture(0).1);
        client.hand_over(0, sequence, 0).unwrap();
        // The one before may still be shown.
        assert!(matches!(client.answer(), Answer::Free { .. }));
    }
    assert!(wait_until(PATIENCE, || feed("clients").as_array().is_some_and(Vec::is_empty)));
    std::thread::sleep(Duration::from_secs(3));
    daemon.signal(Signal::TERM);
    let ended = daemon.wait(PATIENCE);
    assert!(ended.status.success(), "{}", ended.stderr);
    let lines = |about: &str| ended.stderr.lines().filter(|line| line.contains(about)).count();
    assert_eq!(lines("s before it came was found, expected nanoseconds of CLOCK_MONOTONIC"), 1, "{}", ended.stderr);
    let of_clients = lines("the feed's client ") + lines("the last picture of ");
    assert!((10..100).contains(&of_clients), "{of_clients} of 450: {}", ended.stderr);
    assert!(lines("lines about the feed's clients were left out") > 0, "{}", ended.stderr);
    let summary: Value = serde_json::from_str(&ended.stdout).unwrap();
    let longest_ms = summary["picture_to_photon"]["max_ms"].as_f64();
    assert!(longest_ms.is_none_or(|ms| ms < 10_000.0), "{longest_ms:?}");
}

/// The client in C with its moving cards, as a process of its own; killed when it is dropped.
struct TwoCards(Child);

impl TwoCards {
    fn start(folder: &Path) -> Self {
        let sources = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/clients/c"));
        let program = folder.join("two-cards");
        let mut compiler = Command::new("cc");
        compiler.arg("-o").arg(&program).args(["example.c", "holod_feed.c"].map(|name| sources.join(name)));
        assert!(compiler.status().unwrap().success(), "the C compiler that Rust links with");
        let mut client = Command::new(program);
        client.arg(folder.join("pictures")).args(["64x64", "600", "30"]).stdout(Stdio::null());
        Self(client.spawn().unwrap())
    }

    fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.0), signal).unwrap();
    }
}

impl Drop for TwoCards {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
fn a_client_that_stands_still_makes_the_lasers_dark_until_it_goes_on() {
    const DARK_AFTER_NS: i64 = 500_000_000;

    let folder = bench();
    let daemon = holod_with_feed(folder.path(), &["--feed-dark-after", "0.5", "--record", "record", "--json"]);
    let seen = |what: &str, is_so: &dyn Fn(&Value) -> bool| {
        let mut last = Value::Null;
        let came = wait_until(PATIENCE, || {
            last = status(&daemon, folder.path());
            is_so(&last)
        });
        assert!(came, "{what}: {last:#}");
    };
    let is_dark = |status: &Value| status["lasers"] == "dark" && status["feed_trouble"].is_string();
    let is_lit = |status: &Value| status["lasers"] == "armed" && status["feed_trouble"].is_null();
    seen("no picture has ever come", &is_dark);
    let client = TwoCards::start(folder.path());
    seen("pictures come", &is_lit);
    std::thread::sleep(Duration::from_millis(500));
    let t_stop_ns = host_now().0;
    client.signal(Signal::STOP);
    seen("the client stands still", &is_dark);
    let t_dark_ns = host_now().0;
    let text = said_of(&daemon, folder.path(), &[]);
    assert!(text.contains("lasers   dark, kept dark as the live feed gives no pictures"), "{text}");
    let frames_shown = status(&daemon, folder.path())["frames_shown"].as_u64();
    seen("patterns go on in the dark", &|status| status["frames_shown"].as_u64() > frames_shown);
    std::thread::sleep(Duration::from_secs(1));
    let t_cont_ns = host_now().0;
    client.signal(Signal::CONT);
    seen("the client goes on", &is_lit);
    std::thread::sleep(Duration::from_millis(500));
    daemon.signal(Signal::TERM);
    let ended = daemon.wait(PATIENCE);
    assert!(ended.status.success(), "{}", ended.stderr);
    for said in [
        "lasers dark: the feed's client `two cards (C example)` has given no new picture for 0.5 s",
        "the live feed gives pictures again: lasers are lit by the rules",
    ] {
        assert!(ended.stderr.contains(said), "{}", ended.stderr);
    }
    let summary: Value = serde_json::from_str(&ended.stdout).unwrap();
    assert_eq!(summary["lasers"]["unsafe_findings"], 0);
    assert!(summary["lasers"]["went_dark"].to_string().contains("no-picture at "), "{summary:#}");

    let rows = frames::read(&folder.path().join("record/frames.csv")).unwrap();
    assert!(frames::lit_windows(&rows, t_stop_ns - DARK_AFTER_NS, t_stop_ns) > 10, "lit before");
    assert_eq!(frames::lit_windows(&rows, t_dark_ns, t_cont_ns), 0, "dark while it stands still");
    assert!(rows.iter().filter(|row| (t_dark_ns..t_cont_ns).contains(&row.t_present_ns)).count() > 10);
    let stale = rows.iter().filter(|row| row.t_present_ns < t_cont_ns).map(|row| row.picture).max().unwrap();
    let again = rows.iter().find(|row| row.laser_on_ns.is_some_and(|on_ns| on_ns > t_cont_ns)).expect("light again");
    assert!(again.picture > stale, "a new picture is lit first: {} after {stale}", again.picture);
}

#[test]
fn a_picture_that_the_feed_gave_up_is_not_lit_again_after_a_pattern_or_a_pause() {
    let folder = bench();
    let daemon = holod_with_feed(folder.path(), &["--feed-dark-after", "0.5", "--record", "record"]);
    let until = |what: &str, is_so: &dyn Fn(&Value) -> bool| {
        assert!(wait_until(PATIENCE, || is_so(&status(&daemon, folder.path()))), "{what}");
    };
    let order = |order: &[&str]| {
        let pid = daemon.pid().to_string();
        let args = [&["ctl", "--pid", &pid], order].concat();
        let ended = Daemon::start_with(HOLOD, &args, folder.path(), &[("XDG_RUNTIME_DIR", folder.path())]);
        assert!(ended.wait(PATIENCE).status.success(), "{order:?}");
    };
    let is_dark = |status: &Value| status["lasers"] == "dark" && status["feed_trouble"].is_string();
    let is_lit = |status: &Value| status["lasers"] == "armed" && status["feed_trouble"].is_null();
    let frames_go_on = || {
        let then = status(&daemon, folder.path())["frames_shown"].as_u64();
        until("frames go on", &|status| status["frames_shown"].as_u64() > then.map(|then| then + 20));
    };
    let mut client = connect(folder.path());
    send(&mut client, 1, &picture(0));
    until("it gives no more", &|status| is_dark(status) && status["feed"]["taken"] == 1);
    let t_given_up_ns = host_now().0;
    order(&["flat"]);
    until("the pattern is lit", &is_lit);
    order(&["hologram"]);
    until("the old picture is dark", &is_dark);
    frames_go_on();
    order(&["pause"]);
    order(&["flat"]);
    until("the pattern is lit", &is_lit);
    order(&["hologram"]);
    until("what stands still is dark", &is_dark);
    frames_go_on();
    order(&["resume"]);
    frames_go_on();
    let lit = |pictures: std::ops::RangeInclusive<u64>| {
        let rows = frames::read(&folder.path().join("record/frames.csv")).unwrap_or_default();
        let lit = rows.into_iter().filter(move |row| pictures.contains(&row.picture));
        lit.filter_map(|row| row.laser_on_ns).collect::<Vec<_>>()
    };
    let mut number = 1;
    let new_picture_is_lit = || {
        number += 1;
        send(&mut client, number, &picture(9));
        !lit(2..=number).is_empty()
    };
    assert!(wait_until(PATIENCE, new_picture_is_lit));
    daemon.signal(Signal::TERM);
    let ended = daemon.wait(PATIENCE);
    assert!(ended.status.success(), "{}", ended.stderr);
    let of_old = lit(1..=1);
    assert!(!of_old.is_empty() && of_old.iter().all(|on_ns| *on_ns < t_given_up_ns), "{t_given_up_ns}: {of_old:?}");
}

#[test]
fn a_picture_that_is_too_bright_and_too_near_is_told_though_it_is_enlarged() {
    let folder = bench();
    let daemon = holod_with_feed(folder.path(), &["--fit", "contain"]);
    let white = 0x3c00_u16;
    // Each picture with so many pixels that are brighter than white.
    for (name, depth_mm, pictures) in [
        ("near", 2_u16, &[(1, 1024)][..]),
        ("flat", 1000, &[(2, 1024)]),
        ("late", 1000, &[(3, 0), (4, 10), (5, 11), (6, 12)]),
    ] {
        let mut client = FeedClient::connect(&folder.path().join("pictures")).unwrap();
        let mut hello = hello(32, 32, None, name);
        hello[16..20].copy_from_slice(&2_u32.to_ne_bytes());
        client.say(&hello).unwrap();
        assert_eq!(client.answer(), Answer::Ring);
        for &(number, bright) in pictures {
            let pixel = |red: u16| [red, 0, 0, white].map(u16::to_ne_bytes).concat();
            let colour = [pixel(0x7bff).repeat(bright), pixel(white).repeat(32 * 32 - bright)].concat();
            send(&mut client, number, &(colour, depth_mm.to_ne_bytes().repeat(32 * 32)));
            assert!(wait_until(PATIENCE, || status(&daemon, folder.path())["feed"]["taken"] == number));
        }
    }
    let feed = &status(&daemon, folder.path())["feed"];
    assert_eq!(
        (&feed["clipped_colours"]["above_white"], &feed["pictures_with_clipped_colours"]),
        (&12.into(), &5.into())
    );
    let text = said_of(&daemon, folder.path(), &[]);
    assert!(text.contains("colours clipped in 5 pictures, in pixels: 2081 above white"), "{text}");
    daemon.signal(Signal::TERM);
    let ended = daemon.wait(PATIENCE);
    assert!(ended.status.success(), "{}", ended.stderr);
    for said in [
        "`near`: of 1024 depths, these cannot be shown as they are: 1024 nearer than the display",
        "`near`: 1024 of 1024 pixels are brighter than white and were clipped",
        "`flat`: 1024 of 1024 pixels are brighter than white and were clipped",
        "`late`: 11 of 1024 pixels are brighter than white and were clipped",
        "`flat`: all depths lie within 0.000 dpt: is the depth encoding right?",
    ] {
        assert!(ended.stderr.contains(said), "`{said}` is not in: {}", ended.stderr);
    }
    assert_eq!(ended.stderr.matches("brighter than white").count(), 3, "once of each client: {}", ended.stderr);
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
    refused(&["--feed-dark-after", "2"], 64, "name it with --scene feed");
    refused(&[&feed[..], &["--feed-dark-after", "2h"]].concat(), 64, "expected seconds without a picture, 0.1 to 3600");
    refused(&["render", "--scene", "feed", "--pupil", "3", "--out", "x"], 64, "for `holod run` alone");
    let daemon = holod_with_feed(folder.path(), &[]);
    refused(&feed, 69, "another holod listens there; name another socket with --scene feed:PATH");
    drop(daemon);
    assert!(folder.path().join("pictures").exists(), "holod was killed");
    let ended = run(HOLOD, &feed, folder.path());
    assert!(ended.status.success(), "the socket of a killed holod is replaced: {}", ended.stderr);
}

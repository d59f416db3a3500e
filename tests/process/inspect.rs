//! What holod says of trackers and logs, as a user asks it: `tracker try`, `log`, `status`.

use std::fs;
use std::path::Path;
use std::time::{Duration, Instant};

use holod_pupil_input::wire::line::{LineSample, encode_line};
use holod_pupil_input::{MockSource, Scenario, host_now};
use holod_slm_output::laser::simulator::{Faults, SimulatedBox, SimulatedTerminal};
use holod_tests::daemon::{Daemon, Ended, run, wait_until};
use holod_tests::tracker::{PtyTracker, TimedLine};
use holod_tests::{diverged_weights, small_rig};
use rustix::process::Signal;
use serde_json::Value;

use crate::HOLOD;

/// Room for a machine that does something else, too.
const PATIENCE: Duration = Duration::from_secs(60);

fn json(ended: &Ended) -> Value {
    serde_json::from_str(&ended.stdout).unwrap_or_else(|error| panic!("{error}: {ended:?}"))
}

/// The first `count` samples of the scenario `blinks`, as protocol lines.
fn lines(count: usize) -> Vec<TimedLine> {
    MockSource::new(Scenario::Blinks, 3)
        .take(count)
        .map(|mock| {
            let sample = mock.sample;
            let line = LineSample {
                sequence: sample.sequence.unwrap(),
                device_us: sample.t_device.0 / 1000,
                eye: sample.eye,
                diameter_mm: sample.diameter_mm,
                confidence: sample.confidence,
            };
            let mut text = String::new();
            encode_line(&line, &mut text);
            TimedLine { due: Duration::from_nanos(sample.t_device.0 as u64), bytes: text.into_bytes() }
        })
        .collect()
}

fn samples(folder: &Path) -> String {
    fs::read_to_string(folder.join("samples.csv")).unwrap()
}

#[test]
fn a_tracker_that_is_tried_is_counted_recorded_and_played_again() {
    let folder = holod_tests::new_folder();
    let link = folder.path().join("ttyTracker");
    let mut tracker = PtyTracker::plug_in(&link).unwrap();
    let args = ["tracker", "try", "ttyTracker", "--duration", "6s", "--record", "live", "--json"];
    let tried = Daemon::start(HOLOD, &args, folder.path());
    assert!(wait_until(PATIENCE, || folder.path().join("live/samples.csv").exists()));
    let lines = lines(800);
    tracker.send(b"# hello\nP1,broken\n").unwrap();
    tracker.feed(&lines, Instant::now()).unwrap();
    let ended = tried.wait(PATIENCE);
    assert!(ended.status.success(), "{ended:?}");
    let report = json(&ended);
    let count = |name: &str| report["counts"][name].as_u64().unwrap();
    assert_eq!((count("samples"), count("sequence_gaps"), count("notes")), (800, 0, 1));
    assert_eq!(count("wire_bad_checksum"), 1);
    assert!(["up", "silent"].contains(&report["link"].as_str().unwrap()), "{report}");
    for eye in ["left", "right"] {
        let rate_hz = report["eyes"][eye]["rate_hz"].as_f64().unwrap();
        assert!((rate_hz - 200.0).abs() < 10.0, "{eye}: {rate_hz}");
        let judged = report["eyes"][eye]["samples"].as_u64().unwrap();
        assert_eq!(judged, 400, "{eye}");
        assert!(report["eyes"][eye]["rejected"]["low_confidence"].as_u64().unwrap() > 10);
    }

    let again = ["tracker", "try", "replay:live/tracker.holodraw,speed=max", "--record", "again", "--json"];
    let ended = run(HOLOD, &again, folder.path());
    assert!(ended.status.success(), "{ended:?}");
    assert_eq!(samples(&folder.path().join("again")), samples(&folder.path().join("live")));
    let replayed = json(&ended);
    for name in ["samples", "accepted", "wire_bad_checksum", "rejected_low_confidence"] {
        assert_eq!(replayed["counts"][name], report["counts"][name], "{name}");
    }
}

#[test]
fn a_tracker_that_says_nothing_or_nonsense_is_told_from_one_that_works() {
    let folder = holod_tests::new_folder();
    let link = folder.path().join("ttyTracker");
    let mut tracker = PtyTracker::plug_in(&link).unwrap();
    let args = ["tracker", "try", "ttyTracker", "--duration", "1s"];
    let ended = run(HOLOD, &args, folder.path());
    assert_eq!(ended.status.code(), Some(69));
    assert!(ended.stderr.contains("nothing was heard"), "{ended:?}");

    let tried = Daemon::start(HOLOD, &["tracker", "try", "ttyTracker", "--duration", "4s"], folder.path());
    for _ in 0..20 {
        tracker.send(b"7f 03 ff rubbish\n").unwrap();
        std::thread::sleep(Duration::from_millis(100));
    }
    let ended = tried.wait(PATIENCE);
    assert_eq!(ended.status.code(), Some(69));
    assert!(ended.stderr.contains("wire_malformed") && ended.stderr.contains("profile and baud rate"), "{ended:?}");
    assert!(ended.stdout.contains("wire_malformed"), "{ended:?}");
}

#[test]
fn a_tracker_is_never_looked_for_at_the_laser_boxs_port() {
    let folder = holod_tests::new_folder();
    let box_link = folder.path().join("ttyLasers");
    let _laser_box = PtyTracker::plug_in(&box_link).unwrap();
    let lasers = format!("driver = \"serial\"\ndevice = \"{}\"", box_link.display());
    fs::write(folder.path().join("rig.toml"), small_rig(64, 64, &lasers)).unwrap();
    std::os::unix::fs::symlink(&box_link, folder.path().join("ttyOther")).unwrap();
    let ended = run(HOLOD, &["tracker", "try", "ttyOther", "--config", "rig.toml", "--duration", "1s"], folder.path());
    assert!(!ended.status.success());
    assert!(ended.stderr.contains("ttyOther") && ended.stderr.contains("laser"), "{ended:?}");
}

#[test]
fn check_estimates_the_frames_a_second_and_takes_a_tracker() {
    let folder = holod_tests::new_folder();
    fs::write(folder.path().join("rig.toml"), small_rig(64, 64, "driver = \"simulated\"")).unwrap();
    let ended = run(HOLOD, &["check", "--config", "rig.toml", "--tracker", "mock", "--json"], folder.path());
    let check = |ended: &Ended, name: &str| {
        let checks = json(ended)["checks"].as_array().unwrap().clone();
        checks.into_iter().find(|check| check["name"] == name).unwrap()["says"].as_str().unwrap().to_owned()
    };
    let speed = check(&ended, "speed");
    assert!(
        speed.contains("estimated from frames of up to 64x64") && speed.contains("frames a second of 64x64"),
        "{speed}"
    );
    assert!(speed.contains("the panel could show 60.0"), "{speed}");
    assert!(check(&ended, "tracker").contains("a simulated eye"));
    // A panel of many pixels is slow on any processor, and what helps is said.
    let ended = run(HOLOD, &["check", "--resolution", "1920x1080", "--json"], folder.path());
    let speed = check(&ended, "speed");
    assert!(speed.contains("--weights small") && speed.contains("--resolution"), "{speed}");
}

#[test]
fn check_says_where_a_bench_lies_in_what_the_network_was_trained_for() {
    let folder = holod_tests::new_folder();
    let rig = small_rig(64, 64, "driver = \"simulated\"");
    let fine = rig.replace("pixel_pitch_um = 8.0", "pixel_pitch_um = 1.0");
    fs::write(folder.path().join("default.toml"), rig).unwrap();
    fs::write(folder.path().join("fine.toml"), fine).unwrap();
    let check = |name: &str| run(HOLOD, &["check", "--config", name], folder.path());
    let says = |ended: &Ended, parts: &[&str]| {
        for part in parts {
            assert!(ended.stdout.contains(part), "`{part}` is not in: {}", ended.stdout);
        }
    };
    let known = check("default.toml");
    assert!(known.status.success(), "{known:?}");
    says(&known, &["42.9 px over the depth range at a pupil of 3 mm", "red 45.57, green 37.14, blue 32.14 px²"]);
    says(&known, &["half band", "green 1.30, blue 1.1", "at most red 22.79, green 18.57, blue 16.07 px"]);
    // 64 times the diffraction: more than any network was trained for.
    let unknown = check("fine.toml");
    assert_eq!(unknown.status.code(), Some(69));
    says(&unknown, &["FAIL spread", "2916.57 px² in red", "would bring it inside", "not estimated without weights"]);
    let refused = run(HOLOD, &["render", "--config", "fine.toml", "--pupil", "1", "--out", "out"], folder.path());
    assert_eq!(refused.status.code(), Some(78), "{refused:?}");
    assert!(refused.stderr.contains("2916.57 px² in red") && refused.stderr.contains("model/training/README.md"));
}

#[test]
fn a_profile_that_is_not_there_is_a_fault_of_the_rig() {
    let folder = holod_tests::new_folder();
    let rig = |profile: &str| {
        let rig = small_rig(64, 64, "driver = \"simulated\"");
        rig.replace("[tracker]\n", &format!("[tracker]\nspec = \"tcp:127.0.0.1:4242,profile={profile}\"\n"))
    };
    fs::write(folder.path().join("good.toml"), rig("open-gaze")).unwrap();
    fs::write(folder.path().join("bad.toml"), rig("open-gase")).unwrap();
    assert!(run(HOLOD, &["check", "--config", "good.toml"], folder.path()).status.success());
    let line = 1 + rig("").lines().position(|line| line.starts_with("spec = ")).unwrap();
    for command in [&["check"][..], &["tracker", "try"], &[]] {
        let ended = run(HOLOD, &[command, &["--config", "bad.toml"]].concat(), folder.path());
        assert_eq!(ended.status.code(), Some(78), "{command:?}: {ended:?}");
        for told in ["rig file bad.toml", &format!("line {line}, tracker.spec: "), "did you mean `open-gaze`?"] {
            assert!(ended.stderr.contains(told), "{command:?}: {told} is not in {}", ended.stderr);
        }
    }
    // It keeps no laser from being put out.
    let ended = run(HOLOD, &["dark", "--config", "bad.toml"], folder.path());
    assert!(ended.status.success() && ended.stdout.contains("no laser box"), "{ended:?}");
    // On the command line it is a fault of the command line.
    let ended = run(HOLOD, &["--tracker", "tcp:127.0.0.1:4242,profile=open-gase"], folder.path());
    assert_eq!(ended.status.code(), Some(64), "{ended:?}");
}

#[test]
fn logs_are_looked_into_and_converted_without_loss() {
    let folder = holod_tests::new_folder();
    let text: Vec<u8> = lines(4000).into_iter().flat_map(|line| line.bytes).collect();
    fs::write(folder.path().join("log"), text).unwrap();
    let info = |name: &str| json(&run(HOLOD, &["log", "info", name, "--json"], folder.path()));
    let first = info("log");
    assert_eq!((&first["format"], &first["samples"]), (&"holod line protocol".into(), &4000.into()));
    assert!((first["eyes"][0]["rate_hz"].as_f64().unwrap() - 200.0).abs() < 1.0, "{first}");
    // In ten seconds of the scenario the lids shut at 1, 2.5, 4, 5.5, 7 and 8.5 s.
    assert_eq!(first["blinks"]["found"], 6, "{first}");
    assert!(first["gate"]["believed"].as_u64().unwrap() > 3000);

    for (from, to, out) in [("log", "csv", "a.csv"), ("a.csv", "lines", "b.lines")] {
        let ended = run(HOLOD, &["log", "convert", from, "--to", to, "--out", out], folder.path());
        assert!(ended.status.success(), "{ended:?}");
        let mut again = info(out);
        again["format"] = first["format"].clone();
        assert_eq!(again, first, "{out}");
    }
    let ended = run(HOLOD, &["log", "convert", "log", "--to", "csv", "--out", "a.csv"], folder.path());
    assert_eq!(ended.status.code(), Some(73));
    assert!(ended.stderr.contains("a.csv exists already"), "{ended:?}");

    let ended = run(HOLOD, &["log", "info", "log", "--plot", "log.svg"], folder.path());
    assert!(ended.stdout.contains("blinks") && ended.stdout.contains("pupil / mm"), "{ended:?}");
    assert!(fs::read_to_string(folder.path().join("log.svg")).unwrap().contains("raw sample, rejected"));
}

#[test]
fn a_log_in_arbitrary_units_needs_a_scale_and_says_so() {
    let folder = holod_tests::new_folder();
    let mut text = String::from("SAMPLES\tGAZE\tLEFT\tRATE\t1000.00\nPUPIL\tAREA\nSTART\t1000 \tLEFT\tSAMPLES\n");
    for t_ms in 1000..3000 {
        text.push_str(&format!("{t_ms}\t  964.3\t  541.5\t  1256.0\t...\n"));
    }
    fs::write(folder.path().join("log.asc"), text).unwrap();
    fs::write(folder.path().join("rig.toml"), small_rig(64, 64, "driver = \"simulated\"")).unwrap();
    let tried = |more: &[&str]| {
        let mut args = vec!["tracker", "try", "replay:log.asc,speed=max", "--config", "rig.toml", "--json"];
        args.extend_from_slice(more);
        run(HOLOD, &args, folder.path())
    };
    let ended = tried(&[]);
    assert_eq!(ended.status.code(), Some(78), "{ended:?}");
    assert!(ended.stderr.contains("arbitrary units") && ended.stderr.contains("scale_mm_per_unit"), "{ended:?}");
    let ended = tried(&["--scale", "100"]);
    assert_eq!(ended.status.code(), Some(69), "{ended:?}");
    assert!(
        ended.stderr.contains("scale_mm_per_unit = 100") && !ended.stderr.contains("nothing was heard"),
        "{ended:?}"
    );
    let report = json(&tried(&["--scale", "0.1"]));
    // A disc of area 1256 is 40 units wide.
    let median_mm = report["eyes"]["left"]["believed_mm"]["median"].as_f64().unwrap();
    assert!((median_mm - 4.0).abs() < 0.01, "{report}");
}

#[test]
fn a_running_holod_says_how_it_is_and_a_stopped_one_is_not_found() {
    let folder = holod_tests::new_folder();
    fs::write(folder.path().join("rig.toml"), small_rig(64, 64, "driver = \"simulated\"")).unwrap();
    let runtime = folder.path().join("runtime");
    // None of the other places in which a holod of another test may write its status.
    let elsewhere = folder.path();
    let environment = [("RUNTIME_DIRECTORY", runtime.as_path()), ("XDG_RUNTIME_DIR", elsewhere), ("TMPDIR", elsewhere)];
    let args = ["--config", "rig.toml", "--tracker", "mock:blinks", "--resolution", "64x64"];
    let daemon = Daemon::start_with(HOLOD, &args, folder.path(), &environment);
    let ask = || Daemon::start_with(HOLOD, &["status", "--json"], folder.path(), &environment).wait(PATIENCE);
    let shown = |ended: &Ended| ended.status.success() && json(ended)["frames_shown"].as_u64() > Some(10);
    assert!(wait_until(PATIENCE, || shown(&ask())));
    let status = json(&ask());
    assert_eq!((&status["state"], &status["tracker"]), (&"running".into(), &"mock:blinks".into()));
    assert!(status["tracker_counts"]["rejected_low_confidence"].as_u64().is_some());
    assert!(status["pupil_mm"].as_f64().is_some());
    daemon.signal(Signal::TERM);
    assert!(daemon.wait(PATIENCE).status.success());
    let ended = ask();
    assert_eq!(ended.status.code(), Some(69));
    assert!(ended.stderr.contains("no holod is running"), "{ended:?}");
}

#[test]
fn two_holods_are_told_apart_and_found_without_a_runtime_folder() {
    let folder = holod_tests::new_folder();
    fs::write(folder.path().join("rig.toml"), small_rig(64, 64, "driver = \"simulated\"")).unwrap();
    let environment = [("XDG_RUNTIME_DIR", Path::new("")), ("TMPDIR", folder.path())];
    let start = |tracker| {
        let args = ["--config", "rig.toml", "--tracker", tracker, "--resolution", "64x64"];
        Daemon::start_with(HOLOD, &args, folder.path(), &environment)
    };
    let (first, second) = (start("mock:blinks"), start("mock:steady"));
    let pid = |daemon: &Daemon| daemon.pid().to_string();
    let ask = |args: &[&str]| {
        Daemon::start_with(HOLOD, &[&["status"], args].concat(), folder.path(), &environment).wait(PATIENCE)
    };
    let of = |pid: &str| ask(&["--json", "--pid", pid]);
    for daemon in [&first, &second] {
        assert!(wait_until(PATIENCE, || of(&pid(daemon)).status.success()));
    }
    assert_eq!(json(&of(&pid(&first)))["tracker"], "mock:blinks");
    assert_eq!(json(&of(&pid(&second)))["tracker"], "mock:steady");
    let both = ask(&[]);
    assert!(both.stdout.contains("mock:blinks") && both.stdout.contains("mock:steady"), "{both:?}");
    let unclear = ask(&["--json"]);
    assert_eq!(unclear.status.code(), Some(64), "{unclear:?}");
    assert!(unclear.stderr.contains(&pid(&first)) && unclear.stderr.contains("--pid"), "{unclear:?}");
    let ended_pid = pid(&second);
    second.signal(Signal::TERM);
    assert!(second.wait(PATIENCE).status.success());
    assert!(!of(&ended_pid).status.success());
    let status = json(&of(&pid(&first)));
    assert_eq!(status["tracker"], "mock:blinks", "the end of one is none of the other's");
    assert!((status["panel_frames_hz"].as_f64().unwrap() - 60.0).abs() < 1e-6, "{status}");
}

#[test]
fn a_replay_that_ends_ends_the_run() {
    let folder = holod_tests::new_folder();
    fs::write(folder.path().join("rig.toml"), small_rig(64, 64, "driver = \"simulated\"")).unwrap();
    let text: Vec<u8> = lines(800).into_iter().flat_map(|line| line.bytes).collect();
    fs::write(folder.path().join("log"), text).unwrap();
    let with = |more: &[&'static str]| [&["--config", "rig.toml", "--resolution", "64x64"], more].concat();
    let ended = run(HOLOD, &with(&["--tracker", "log", "--duration", "100s", "--json"]), folder.path());
    let summary = json(&ended);
    assert_eq!(summary["ended_by"], "the end of the pupil log", "{summary}");
    assert!(summary["frames_by_pupil_state"]["fallback"].as_u64().unwrap_or(0) < 200, "{summary}");
}

#[test]
fn a_log_that_is_not_in_millimetres_is_plotted_in_its_own_unit_and_replayed_with_a_scale() {
    let folder = holod_tests::new_folder();
    let mut text = String::from("SAMPLES\tGAZE\tLEFT\tRATE\t1000.00\nPUPIL\tDIAMETER\nSTART\t1000 \tLEFT\tSAMPLES\n");
    for t_ms in 1000..3000 {
        text.push_str(&format!("{t_ms}\t  964.3\t  541.5\t  320.0\t...\n"));
    }
    fs::write(folder.path().join("log.asc"), text).unwrap();
    let ended = run(HOLOD, &["log", "info", "log.asc", "--plot", "raw.svg"], folder.path());
    assert!(ended.status.success(), "{ended:?}");
    let svg = fs::read_to_string(folder.path().join("raw.svg")).unwrap();
    assert!(svg.contains("pupil diameter / arbitrary units") && !svg.contains("rejected"));

    // A rig file that has a tracker alone is of the built-in bench; the log is beside it.
    fs::create_dir(folder.path().join("bench")).unwrap();
    fs::rename(folder.path().join("log.asc"), folder.path().join("bench/log.asc")).unwrap();
    fs::write(folder.path().join("bench/rig.toml"), "[tracker]\nspec = \"log.asc\"\nscale_mm_per_unit = 1.0\n")
        .unwrap();
    let run_with = |more: &[&str]| {
        let args = [&["--config", "bench/rig.toml", "--resolution", "64x64", "--json"], more].concat();
        run(HOLOD, &args, folder.path())
    };
    let summary = json(&run_with(&["--scale", "0.0125"]));
    let [_, widest] = [0, 1].map(|end| summary["pupil_range_mm"][end].as_f64().unwrap());
    assert!((widest - 4.0).abs() < 0.3, "{summary}");
    assert!(summary["tracker_trouble"].is_null(), "{summary}");
    let wrong = run_with(&[]);
    assert!(wrong.stderr.contains("rejected_out_of_range"), "{wrong:?}");
    assert!(json(&wrong)["tracker_trouble"].as_str().unwrap().contains("320"), "{wrong:?}");
}

#[test]
fn check_says_what_would_keep_a_tracker_from_being_started() {
    let folder = holod_tests::new_folder();
    let asc = "SAMPLES\tGAZE\tLEFT\tRATE\t1000.00\nPUPIL\tDIAMETER\nSTART\t1000 \tLEFT\tSAMPLES\n\
               1000\t  964.3\t  541.5\t  320.0\t...\n1001\t  964.3\t  541.5\t  320.0\t...\n";
    fs::write(folder.path().join("log.asc"), asc).unwrap();
    fs::write(folder.path().join("notes.txt"), "eye three, day two\n").unwrap();
    let tracker_check = |spec: &str, scale: &str| {
        fs::write(folder.path().join("rig.toml"), format!("[tracker]\nspec = \"{spec}\"\n{scale}")).unwrap();
        let found =
            json(&run(HOLOD, &["check", "--config", "rig.toml", "--resolution", "64x64", "--json"], folder.path()));
        let checks = found["checks"].as_array().unwrap();
        checks.iter().find(|check| check["name"] == "tracker").unwrap().clone()
    };
    for (spec, says) in [
        ("log.asc", "millimetres"),
        ("replay:notes.txt", "notes.txt"),
        ("serial:notes.txt", "no serial port"),
        ("serial:/dev/null,profile=livetrack", "millimetres"),
    ] {
        let check = tracker_check(spec, "");
        assert!(check["passed"] == false && check["says"].as_str().unwrap().contains(says), "{spec}: {check}");
    }
    let check = tracker_check("log.asc", "scale_mm_per_unit = 0.0125");
    assert!(check["passed"] == true, "{check}");
    // Without a rig file, too.
    let args = ["check", "--tracker", "log.asc", "--resolution", "64x64", "--json"];
    let without = json(&run(HOLOD, &args, folder.path()));
    assert!(without["checks"].to_string().contains("of an area A that is 2·√(A/π)"), "{without}");
    let scaled = json(&run(HOLOD, &[&args[..], &["--scale", "0.0125"]].concat(), folder.path()));
    assert_eq!(scaled["meaning"]["tracker"]["scale_mm_per_unit"], 0.0125);
    assert!(!scaled["checks"].to_string().contains("artificial pupil"), "{scaled}");
}

#[test]
fn a_run_warns_at_its_start_of_phases_that_the_panel_cannot_show_in_the_words_of_check() {
    let folder = holod_tests::new_folder();
    let rig = small_rig(64, 64, "driver = \"simulated\"");
    let told = |rig: &str| {
        fs::write(folder.path().join("rig.toml"), rig).unwrap();
        let checked = run(HOLOD, &["check", "--config", "rig.toml", "--resolution", "64x64", "--json"], folder.path());
        let notes = json(&checked)["meaning"]["notes"].clone();
        let args = ["--config", "rig.toml", "--tracker", "mock", "--resolution", "64x64", "--frames", "1"];
        let ran = run(HOLOD, &args, folder.path());
        let warned =
            ran.stderr.lines().find_map(|line| line.split_once(" WARN ").filter(|(_, says)| says.contains("stroke")));
        (notes, warned.map(|(_, says)| says.to_owned()))
    };
    let (notes, warned) = told(&rig.replacen("blue = 1.9921875", "blue = 1.5", 1));
    let warned = warned.expect("a warning");
    assert!(warned.starts_with("blue: the panel's stroke is 1.500 π; "), "{warned}");
    assert!(notes.as_array().unwrap().iter().any(|note| *note == *warned), "{notes}");
    assert_eq!(told(&rig).1, None);
}

#[test]
fn check_refuses_what_a_laser_box_would_refuse_at_the_start_of_a_run_in_the_same_words() {
    let folder = holod_tests::new_folder();
    let terminal = SimulatedTerminal::open().unwrap();
    let device = terminal.path().to_owned();
    let mut simulated = SimulatedBox::new(host_now());
    (simulated.limits.power_uw, simulated.limits.timeout_us) = ([1000; 3], 250_000);
    let log = fs::File::create(folder.path().join("box.csv")).unwrap();
    std::thread::spawn(move || terminal.serve(simulated, log, &Faults::default(), host_now));
    let rig = small_rig(64, 64, &format!("driver = \"serial\"\ndevice = {device:?}"));
    let lasers = |(from, to): (&str, &str)| {
        fs::write(folder.path().join("rig.toml"), rig.replacen(from, to, 1)).unwrap();
        let args = ["check", "--config", "rig.toml", "--resolution", "64x64", "--json"];
        let checks = json(&run(HOLOD, &args, folder.path()))["checks"].clone();
        let check = checks.as_array().unwrap().iter().find(|check| check["name"] == "lasers").unwrap().clone();
        (check["passed"] == true, check["says"].as_str().unwrap().to_owned())
    };
    for (change, refused) in [
        (("red = 1.0", "red = 1.2"), "the laser box takes 1 mW of red power at most; the rig asks for 1.2"),
        (
            ("timeout_ms = 100.0", "timeout_ms = 300.0"),
            "the laser box takes 250 ms of heartbeat timeout at most; the rig asks for 300",
        ),
    ] {
        let (passed, says) = lasers(change);
        assert!(!passed && says.contains(refused), "{says}");
        let args = ["--config", "rig.toml", "--tracker", "mock", "--resolution", "64x64", "--frames", "1"];
        let ended = run(HOLOD, &args, folder.path());
        assert!(!ended.status.success() && ended.stderr.contains(refused), "{ended:?}");
    }
    let (passed, says) = lasers(("red = 1.0", "red = 1.0"));
    assert!(passed && says.contains("dark, interlock closed"), "{says}");
    // Whatever else is wrong with the rig, its lasers are put out.
    let dark = |rig: String| {
        fs::write(folder.path().join("rig.toml"), rig).unwrap();
        run(HOLOD, &["dark", "--config", "rig.toml"], folder.path())
    };
    for (from, to) in
        [("bit_depth = 8", "bit_depth = 8\nlut = \"gone.csv\""), ("power_mw", "power_mW"), ("[optics]", "[optic]")]
    {
        let ended = dark(rig.replacen(from, to, 1));
        assert!(ended.status.success() && ended.stdout.contains("acknowledged that they are dark"), "{to}: {ended:?}");
        assert!(ended.stderr.contains("its lasers are put out nevertheless"), "{to}: {ended:?}");
    }
    assert_eq!(dark(rig.replacen("device", "devise", 1)).status.code(), Some(78));
}

#[test]
fn amplitudes_that_double_phase_clips_are_told_once() {
    let folder = holod_tests::new_folder();
    fs::write(folder.path().join("rig.toml"), small_rig(64, 64, "driver = \"simulated\"")).unwrap();
    let built_in = fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("../model/weights/fast.safetensors")).unwrap();
    let key = br#"amplitude_constant\": "#;
    let at = built_in.windows(key.len()).position(|window| window == key).expect("the key") + key.len();
    let mut dim = built_in;
    assert_eq!(&dim[at..at + 4], b"1.25");
    dim[at..at + 4].copy_from_slice(b"0.01");
    fs::write(folder.path().join("dim.safetensors"), dim).unwrap();
    let told = |command: &str, weights: &str| {
        let frame = ["--config", "rig.toml", "--resolution", "64x64", "--weights", weights];
        let args = match command {
            "run" => vec!["run", "--tracker", "mock", "--frames", "3"],
            _ => vec!["render", "--pupil", "3", "--out", "out", "--force"],
        };
        let ran = run(HOLOD, &[&args[..], &frame].concat(), folder.path());
        assert!(ran.status.success(), "{}", ran.stderr);
        ran.stderr.lines().filter(|line| line.contains("amplitudes are above the amplitude_constant")).count()
    };
    for command in ["run", "render"] {
        assert_eq!((told(command, "dim.safetensors"), told(command, "fast")), (1, 0), "{command}");
    }
}

#[test]
fn weights_that_give_no_numbers_are_taken_by_nothing() {
    let folder = holod_tests::new_folder();
    fs::write(folder.path().join("rig.toml"), small_rig(64, 64, "driver = \"simulated\"")).unwrap();
    fs::write(folder.path().join("diverged.safetensors"), diverged_weights()).unwrap();
    let ended = |command: &[&str], weights: &str| {
        run(HOLOD, &[command, &["--config", "rig.toml", "--weights", weights]].concat(), folder.path())
    };
    let check = ["check", "--resolution", "64x64"];
    let live = ["run", "--tracker", "mock", "--resolution", "64x64", "--frames", "3"];
    let render = ["render", "--pupil", "3", "--resolution", "64x64", "--out", "out"];
    for command in [&check[..], &live, &render] {
        let refused = ended(command, "diverged.safetensors");
        let said = format!("{}{}", refused.stdout, refused.stderr);
        assert!(!refused.status.success() && said.contains("values are no finite numbers"), "{command:?}: {said}");
    }
    let taken = ended(&live, "fast");
    assert!(taken.status.success(), "{}", taken.stderr);
}

#[test]
fn the_log_says_more_when_asked_and_a_typo_silences_nothing() {
    let folder = holod_tests::new_folder();
    fs::write(folder.path().join("rig.toml"), small_rig(64, 64, "driver = \"simulated\"")).unwrap();
    let logged = |level: &str| {
        let args = ["--config", "rig.toml", "--tracker", "mock", "--resolution", "64x64", "--duration", "1s"];
        Daemon::start_with(HOLOD, &args, folder.path(), &[("HOLOD_LOG", Path::new(level))]).wait(PATIENCE).stderr
    };
    let count = |text: &str, level: &str| text.lines().filter(|line| line.contains(level)).count();
    let info = logged("info");
    assert!(info.contains("frames a second of the panel's 60.0"), "{info}");
    assert_eq!((count(&info, "DEBUG"), count(&info, "TRACE")), (0, 0));
    let debug = logged("debug");
    assert!(count(&debug, "DEBUG") > 4 && count(&debug, "TRACE") == 0, "{debug}");
    assert!(count(&logged("trace"), "TRACE") > 100);
    let typo = logged("debgu");
    assert!(typo.contains("HOLOD_LOG: found `debgu`") && typo.contains("stopping"), "{typo}");
}

#[test]
fn a_silent_run_still_has_a_log_in_its_record() {
    let folder = holod_tests::new_folder();
    fs::write(folder.path().join("rig.toml"), small_rig(64, 64, "driver = \"simulated\"")).unwrap();
    let run = ["--config", "rig.toml", "--tracker", "mock", "--resolution", "64x64", "--frames", "3"];
    let args = [&run[..], &["--record", "record"]].concat();
    let ended = Daemon::start_with(HOLOD, &args, folder.path(), &[("HOLOD_LOG", Path::new("off"))]).wait(PATIENCE);
    assert!(ended.status.success() && ended.stderr.is_empty(), "{ended:?}");
    let log = fs::read_to_string(folder.path().join("record/log.txt")).unwrap();
    assert!(log.contains(" INFO ") && log.contains("holograms are computed by"), "{log}");
}

#[test]
fn profiles_are_listed_with_what_they_are() {
    let folder = holod_tests::new_folder();
    let ended = run(HOLOD, &["tracker", "list", "--json"], folder.path());
    let list = json(&ended);
    assert!(list["serial_ports"].is_array() && list["hid_devices"].is_array(), "{list}");
    let of = |name: &str| list["profiles"].as_array().unwrap().iter().find(|profile| profile["name"] == name).cloned();
    assert_eq!(of("iscan-etl").unwrap()["unit"], "arbitrary units");
    assert_eq!(of("holod-hid").unwrap()["wire"], "report");
    assert!(of("nobody").is_none());
}

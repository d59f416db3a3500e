//! A running holod is changed by `holod ctl` and by lines of JSON.

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::Duration;

use holod_tests::daemon::{Daemon, Ended, wait_until};
use holod_tests::frames::FieldRow;
use holod_tests::{diverged_weights, frames, small_rig};
use rustix::process::Signal;
use serde_json::{Value, json};

use crate::HOLOD;

const PATIENCE: Duration = Duration::from_secs(60);

/// What a run is started with here.
const ARGS: [&str; 11] = [
    "--config",
    "rig.toml",
    "--tracker",
    "mock:sweep",
    "--resolution",
    "64x64",
    "--record",
    "record",
    "--backend",
    "cpu",
    "--json",
];

fn folder_with_rig() -> tempfile::TempDir {
    let folder = holod_tests::new_folder();
    fs::write(folder.path().join("rig.toml"), small_rig(64, 64, "driver = \"simulated\"")).unwrap();
    folder
}

struct Bench {
    folder: tempfile::TempDir,
    daemon: Option<Daemon>,
}

impl Bench {
    fn start(more: &[&str]) -> Self {
        let folder = folder_with_rig();
        // As a service has it: without a terminal whose end would be the run's.
        let args = [&[HOLOD][..], &ARGS, more].concat();
        let environment = [("XDG_RUNTIME_DIR", folder.path())];
        let daemon = Daemon::start_with("setsid", &args, folder.path(), &environment);
        let bench = Self { folder, daemon: Some(daemon) };
        assert!(wait_until(PATIENCE, || bench.status()["frames_shown"].as_u64() > Some(20)), "{}", bench.status());
        bench
    }

    fn path(&self) -> &Path {
        self.folder.path()
    }

    fn holod(&self, args: &[&str]) -> Ended {
        Daemon::start_with(HOLOD, args, self.path(), &[("XDG_RUNTIME_DIR", self.path())]).wait(PATIENCE)
    }

    /// Orders for this one: other tests have holods, too.
    fn asked(&self, args: &[&str]) -> Ended {
        let pid = self.daemon.as_ref().expect("it runs").pid().to_string();
        self.holod(&[&["ctl"], args, &["--pid", &pid]].concat())
    }

    fn ctl(&self, args: &[&str]) -> String {
        let ended = self.asked(args);
        assert!(ended.status.success(), "{args:?}: {}", ended.stderr);
        ended.stdout
    }

    fn refused(&self, args: &[&str]) -> String {
        let names_one = args.iter().any(|arg| ["--pid", "--socket"].contains(arg));
        let ended = if names_one { self.holod(&[&["ctl"], args].concat()) } else { self.asked(args) };
        assert!(!ended.status.success(), "{args:?}: {}", ended.stdout);
        ended.stderr
    }

    fn status(&self) -> Value {
        serde_json::from_str(&self.asked(&["status"]).stdout).unwrap_or_default()
    }

    fn until(&self, what: &str, done: impl Fn(&Value) -> bool) {
        assert!(wait_until(PATIENCE, || done(&self.status())), "{what}: {}", self.status());
    }

    /// Waits until so many more frames have been shown.
    fn frames_go_on(&self, frames: u64) {
        let then = self.status()["frames_shown"].as_u64().unwrap() + frames;
        self.until("frames go on", |status| status["frames_shown"].as_u64() > Some(then));
    }

    fn socket(&self) -> PathBuf {
        self.status()["control"].as_str().unwrap().into()
    }

    /// Ends it by `holod ctl stop`; its summary.
    fn stop(mut self) -> (Value, tempfile::TempDir) {
        assert!(self.ctl(&["stop"]).contains("ends"));
        let ended = self.daemon.take().unwrap().wait(PATIENCE);
        assert!(ended.status.success(), "{}", ended.stderr);
        (serde_json::from_str(&ended.stdout).unwrap(), self.folder)
    }
}

#[test]
fn pupil_weights_and_lasers_are_changed_while_frames_go_on() {
    let bench = Bench::start(&["--weights", "fast"]);
    assert_eq!(bench.status()["weights"], "fast");
    bench.ctl(&["pupil", "4.25"]);
    bench.until("the pupil is fixed", |status| status["pupil_state"] == "fixed" && status["pupil_mm"] == 4.25);
    bench.ctl(&["weights", "small"]);
    let before = bench.status()["frames_shown"].as_u64();
    bench.until("frames go on", |status| status["weights"] == "small" && status["frames_shown"].as_u64() > before);
    assert!(bench.ctl(&["lasers", "dark"]).contains("the lasers are dark"));
    let status = bench.status();
    assert_eq!((&status["lasers"], &status["lasers_kept_dark"]), (&json!("dark"), &json!(true)));
    let pid = bench.daemon.as_ref().unwrap().pid().to_string();
    assert!(bench.holod(&["status", "--pid", &pid]).stdout.contains("holod ctl lasers dark"));
    let dark_since = status["frames_shown"].as_u64().unwrap();
    bench.until("frames go on in the dark", |status| {
        assert_eq!(status["lasers"], "dark");
        status["frames_shown"].as_u64() > Some(dark_since + 30)
    });
    bench.ctl(&["lasers", "arm"]);
    bench.until("the lasers are lit again", |status| status["lasers"] == "armed");
    bench.ctl(&["pupil", "follow"]);
    bench.until("the tracker is followed", |status| status["pupil_state"] == "tracking");

    let (summary, folder) = bench.stop();
    assert_eq!(summary["ended_by"], "holod ctl stop");
    assert_eq!(summary["lasers"]["unsafe_findings"], 0, "{summary:#}");
    let rows = frames::read(&folder.path().join("record/frames.csv")).unwrap();
    assert!(rows.iter().any(|row| row.pupil_state == "fixed" && (row.pupil_mm - 4.25).abs() < 1e-6));
    let orders = fs::read_to_string(folder.path().join("record/orders.jsonl")).unwrap();
    let orders: Vec<Value> = orders.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let t_of = |what: &str| {
        let order = orders.iter().find(|order| order["request"]["do"] == what);
        order.and_then(|order| order["t_ns"].as_i64()).unwrap_or_else(|| panic!("no {what}"))
    };
    // A field that was lit when the order came may have been shown just before.
    let kept_dark = t_of("lasers-dark") + 50_000_000..t_of("lasers-arm");
    let mut in_between = rows.iter().filter(|row| kept_dark.contains(&row.t_present_ns)).peekable();
    assert!(in_between.peek().is_some() && in_between.all(|row| row.laser_on_ns.is_none()), "light in between");
    let done: Vec<_> = orders.iter().map(|order| order["request"]["do"].as_str().unwrap()).collect();
    assert_eq!(done, ["pupil", "weights", "lasers-dark", "lasers-arm", "pupil", "stop"]);
    assert!(orders.is_sorted_by_key(|order| order["t_ns"].as_i64()));
}

#[test]
fn scenes_come_and_go_and_stand_still() {
    let bench = Bench::start(&["--scene", "feed:pictures"]);
    assert_eq!(bench.status()["scene"], "the live feed");
    let folder = bench.path().join("sequence");
    fs::create_dir(&folder).unwrap();
    for frame in 0..4_u8 {
        let colour = image::RgbImage::from_pixel(64, 64, image::Rgb([60 * frame; 3]));
        colour.save(folder.join(format!("colour{frame}.png"))).unwrap();
        let depth = image::ImageBuffer::from_fn(64, 64, |x, _| image::Luma([500_u16 + 10 * x as u16]));
        depth.save(folder.join(format!("depth{frame}.png"))).unwrap();
    }
    let description =
        "colour = \"colour{}.png\"\ndepth = \"depth{}.png\"\ndepth_encoding = \"millimetres\"\nfps = 20.0\n";
    fs::write(folder.join("scene.toml"), description).unwrap();
    // Its name is understood where it is given, not where holod was started.
    bench.ctl(&["scene", "sequence"]);
    bench.until("the scene is shown", |status| status["scene"].as_str().unwrap_or_default().ends_with("/sequence"));
    bench.ctl(&["pause"]);
    let paused = bench.status();
    assert_eq!(paused["paused"], true);
    let first = paused["frames_made"].as_u64().unwrap() + 3;
    bench.until("some frames", |status| status["frames_made"].as_u64() > Some(first + 30));
    bench.ctl(&["resume"]);
    let last = bench.status()["frames_made"].as_u64().unwrap();
    bench.until("some frames", |status| status["frames_made"].as_u64() > Some(last + 60));
    bench.ctl(&["scene", "feed"]);
    assert_eq!(bench.status()["scene"], "the live feed");

    let (_, folder) = bench.stop();
    let rows = frames::read(&folder.path().join("record/frames.csv")).unwrap();
    let pictures = |frames: std::ops::Range<u64>| {
        let mut seen: Vec<_> = rows.iter().filter(|row| frames.contains(&row.frame)).map(|row| row.picture).collect();
        seen.sort_unstable();
        seen.dedup();
        seen
    };
    assert_eq!(pictures(first..first + 25).len(), 1, "it stood still");
    assert_eq!(pictures(last + 3..last + 60), [0, 1, 2, 3], "it goes round");
}

#[test]
fn patterns_take_the_place_of_holograms_and_make_way_again() {
    let bench = Bench::start(&["--weights", "fast"]);
    for (order, name) in
        [(&["pattern", "dots", "--spacing", "20", "--dot", "6"][..], "dots of 6 px, 20 px apart"), (&["flat"], "flat")]
    {
        let said = bench.ctl(order);
        assert!(said.contains(&format!("shown until `holod ctl hologram`: {name}")), "{said}");
        assert_eq!(bench.status()["pattern"], name);
        bench.frames_go_on(40);
    }
    let pid = bench.daemon.as_ref().unwrap().pid().to_string();
    bench.until("the status says so", |_| {
        bench.holod(&["status", "--pid", &pid]).stdout.contains("in place of holograms a pattern is shown: flat")
    });
    bench.ctl(&["hologram"]);
    assert_eq!(bench.status()["pattern"], Value::Null);
    bench.frames_go_on(20);

    let (summary, folder) = bench.stop();
    assert_eq!(summary["lasers"]["unsafe_findings"], 0, "{summary:#}");
    let rows = frames::read(&folder.path().join("record/frames.csv")).unwrap();
    let orders = fs::read_to_string(folder.path().join("record/orders.jsonl")).unwrap();
    let orders: Vec<Value> = orders.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let done: Vec<_> = orders.iter().map(|order| order["request"]["do"].as_str().unwrap()).collect();
    assert_eq!(done, ["pattern", "flat", "hologram", "stop"]);
    let [began, ended] = [0, 2].map(|order: usize| orders[order]["t_ns"].as_i64().unwrap());
    let rests_on_a_sample = |t: std::ops::Range<i64>| {
        let rows = rows.iter().filter(|row| t.contains(&row.t_wake_ns));
        rows.map(|row| row.t_sample_ns.is_some()).collect::<Vec<_>>()
    };
    // The order's time is taken before the change is handed over, so that a few more holograms come.
    let during: Vec<_> = rests_on_a_sample(began..ended).into_iter().skip_while(|rests| *rests).collect();
    assert!(during.len() > 40 && during.iter().all(|rests| !rests), "a pattern rests on no sample");
    // The run's first frames are for the fallback: a sample is believed after 30 ms.
    let before: Vec<_> = rests_on_a_sample(0..began).into_iter().skip_while(|rests| !rests).collect();
    assert!(!before.is_empty() && before.iter().all(|rests| *rests));
}

#[test]
fn the_rig_file_is_read_again_and_taken_whole_or_not_at_all() {
    let bench = Bench::start(&["--scale", "1"]);
    let path = bench.path().join("rig.toml");
    let rig = fs::read_to_string(&path).unwrap();
    let write = |rig: &str, changes: &[(&str, &str)]| {
        let changed = changes.iter().fold(rig.to_owned(), |rig, (from, to)| {
            assert!(rig.contains(from), "{from}");
            rig.replacen(from, to, 1)
        });
        fs::write(&path, &changed).unwrap();
        changed
    };
    assert!(bench.ctl(&["reload"]).contains("rig.toml is read again: nothing that is in force has changed"));
    assert_eq!(bench.status()["eye"], "left");
    assert!(bench.ctl(&["eye", "right"]).contains("the right eye"));
    assert_eq!(bench.status()["eye"], "right");
    bench.until("the right eye is followed", |status| status["pupil_state"] == "tracking");

    // Weights and eye could be taken, the lit window could not.
    let hold = "hold_ms = 400.0\n[model]\nnetwork = \"fast\"\npupil_step_mm = 0";
    let good = write(
        &rig,
        &[("\"left\"", "\"both\""), ("fallback_mm = 3.0", "fallback_mm = 4.2"), ("hold_ms = 1000.0", hold)],
    );
    write(&good, &[("lit_ms = 3.0", "lit_ms = 2.5"), ("width_px = 64", "width_px = 66")]);
    let refused = bench.refused(&["reload"]);
    assert!(refused.contains("panel.width_px, lasers.lit_ms than this run was started with"), "{refused}");
    assert!(refused.contains("restart") && refused.contains("Nothing has changed"), "{refused}");
    write(&good, &[("hold_ms", "hold")]);
    let refused = bench.refused(&["reload"]);
    assert!(refused.contains("hold: found an unknown key") && refused.contains("nothing has changed"), "{refused}");
    let status = bench.status();
    assert_eq!((&status["eye"], &status["weights"]), (&json!("right"), &json!("standard")));

    write(&good, &[]);
    bench.daemon.as_ref().unwrap().signal(Signal::HUP);
    bench.until("SIGHUP is obeyed", |status| status["eye"] == "both" && status["weights"] == "fast");
    std::thread::sleep(Duration::from_secs(1));

    let (summary, folder) = bench.stop();
    assert_eq!(summary["ended_by"], "holod ctl stop");
    let orders = fs::read_to_string(folder.path().join("record/orders.jsonl")).unwrap();
    let orders: Vec<Value> = orders.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let requests: Vec<_> = orders.iter().map(|order| &order["request"]).collect();
    let changed = json!({
        "tracker.eye": "both", "tracker.fallback_mm": 4.2, "tracker.hold_ms": 400.0, "model.network": "fast",
        "model.pupil_step_mm": 0.0,
    });
    assert_eq!(requests[..2], [&json!({"do": "reload"}), &json!({"do": "eye", "eye": "right"})]);
    assert_eq!(requests[2..], [&json!({"do": "reload", "changed": changed}), &json!({"do": "stop"})]);

    let rows = frames::read(&folder.path().join("record/frames.csv")).unwrap();
    let is_held = |row: &&FieldRow| row.pupil_estimate_mm.is_some_and(|estimate_mm| estimate_mm != row.pupil_mm);
    // The order's time is taken before the change is handed over.
    let t_reload_ns = orders[2]["t_ns"].as_i64().unwrap() + 500_000_000;
    let (before, after): (Vec<_>, Vec<_>) = rows.iter().partition(|row| row.t_wake_ns < t_reload_ns);
    assert!(before.into_iter().filter(is_held).count() > 0, "a step is in force at first");
    assert!(!after.is_empty() && after.into_iter().filter(is_held).count() == 0, "and none later");
}

#[test]
fn a_terminal_that_goes_away_ends_the_run_in_order() {
    let folder = folder_with_rig();
    let command = format!("exec {HOLOD} {}", ARGS.join(" "));
    let environment = [("XDG_RUNTIME_DIR", folder.path())];
    // Whoever runs the tests may ignore the signal, which programs inherit.
    let args = ["--default-signal=HUP", "script", "-qec", &command, "/dev/null"];
    let terminal = Daemon::start_with("env", &args, folder.path(), &environment);
    let frames = folder.path().join("record/frames.csv");
    let lit = || frames::read(&frames).is_ok_and(|rows| rows.iter().any(|row| row.laser_on_ns.is_some()));
    assert!(wait_until(PATIENCE, lit), "no light");
    terminal.signal(Signal::KILL);
    let summary = folder.path().join("record/summary.json");
    assert!(wait_until(PATIENCE, || summary.exists()), "the run goes on without its terminal");
    let summary: Value = serde_json::from_str(&fs::read_to_string(summary).unwrap()).unwrap();
    assert_eq!((&summary["ended_by"], &summary["lasers_dark_at_end"]), (&json!("SIGHUP"), &json!(true)));
}

#[test]
fn a_run_that_is_to_outlive_its_terminal_does() {
    let folder = holod_tests::new_folder();
    // Without a rig file the signal has nothing else to say than that the terminal is gone.
    let options = ["--resolution", "64x64", "--backend", "cpu", "--weights", "fast", "--record", "record", "--json"];
    let environment = [("XDG_RUNTIME_DIR", folder.path())];
    let frames = || frames::read(&folder.path().join("record/frames.csv")).map_or(0, |rows| rows.len());
    for (program, outlives) in [("nohup", true), ("--default-signal=HUP", false)] {
        let args = [&[program, HOLOD][..], &options].concat();
        let mut daemon = Daemon::start_with("env", &args, folder.path(), &environment);
        assert!(wait_until(PATIENCE, || frames() > 100), "no frames");
        daemon.signal(Signal::HUP);
        if outlives {
            let before = frames();
            assert!(wait_until(PATIENCE, || frames() > before + 100), "no frames after the signal");
            assert!(daemon.runs());
            daemon.signal(Signal::TERM);
        }
        let ended = daemon.wait(PATIENCE);
        assert!(ended.status.success(), "{}", ended.stderr);
        let summary: Value = serde_json::from_str(&ended.stdout).unwrap();
        assert_eq!(summary["ended_by"], if outlives { "SIGTERM" } else { "SIGHUP" });
        fs::remove_dir_all(folder.path().join("record")).unwrap();
    }
}

#[test]
fn orders_that_come_within_one_frame_are_all_obeyed() {
    let bench = Bench::start(&["--weights", "fast"]);
    let stream = UnixStream::connect(bench.socket()).unwrap();
    let mut answers = BufReader::new(stream.try_clone().unwrap()).lines();
    for _ in 0..5 {
        for order in ["flat", "hologram", "flat", "hologram"] {
            writeln!(&stream, "{}", json!({ "do": order })).unwrap();
            let answer: Value = serde_json::from_str(&answers.next().unwrap().unwrap()).unwrap();
            assert!(answer["ok"].is_string(), "{order}: {answer}");
        }
        bench.frames_go_on(5);
    }
    assert_eq!(bench.status()["pattern"], Value::Null);
    bench.stop();
}

#[test]
fn levels_are_kept_of_holograms_and_of_no_pattern() {
    let bench = Bench::start(&["--weights", "fast"]);
    let pupil = |mm: f64| {
        bench.ctl(&["pupil", &mm.to_string()]);
        bench.until("the pupil is fixed", |status| status["pupil_mm"] == mm);
    };
    pupil(3.25);
    bench.frames_go_on(40);
    bench.ctl(&["pattern", "level", "200"]);
    bench.frames_go_on(40);
    pupil(5.25);
    bench.frames_go_on(40);
    bench.ctl(&["hologram"]);
    bench.frames_go_on(40);
    let drawn = bench.holod(&["pattern", "level", "200", "--config", "rig.toml", "--out", "level.png"]);
    assert!(drawn.status.success(), "{}", drawn.stderr);

    let (_, folder) = bench.stop();
    let is_pattern = |path: &Path| image::open(path).unwrap().to_rgb8().pixels().all(|pixel| pixel.0 == [200; 3]);
    assert!(is_pattern(&folder.path().join("level.png")), "the judge knows a pattern");
    let mut kept_mm = Vec::new();
    for entry in fs::read_dir(folder.path().join("record")).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_str().unwrap().to_owned();
        let Some(rest) = name.strip_prefix("shown_pupil_") else { continue };
        assert!(!is_pattern(&path), "{name}");
        kept_mm.push(rest.split("mm").next().unwrap().parse::<f64>().unwrap());
    }
    for mm in [3.25, 5.25] {
        assert!(kept_mm.iter().any(|kept| (kept - mm).abs() < 0.01), "{mm}: {kept_mm:?}");
    }
}

#[test]
fn what_cannot_be_done_is_said_and_changes_nothing() {
    let bench = Bench::start(&[]);
    let before = bench.status();
    let scene = "colour = \"colour.png\"\ndepth = \"depth.png\"\ndepth_encoding = \"metres\"\n";
    fs::write(bench.path().join("scene.toml"), scene).unwrap();
    fs::write(bench.path().join("diverged.safetensors"), diverged_weights()).unwrap();
    for (args, said) in [
        (&["scene", "absent"][..], "absent"),
        (&["scene", ".", "--depth-encoding", "dioptres"], "scene.toml, line 3: `depth_encoding`: found metres here"),
        (&["scene", "feed"], "start it with --scene feed"),
        (&["weights", "./absent.safetensors"], "absent.safetensors"),
        (&["pupil", "12"], "expected a human pupil of 0.5 to 9 mm"),
        (&["weights", "./diverged.safetensors"], "values are no finite numbers"),
        (&["weights", "smal"], "did you mean `small`?"),
        (&["eye", "third"], "expected left, right, both or better"),
        (&["pattern", "level", "256"], "expected 0 to 255, the panel's levels"),
        (&["pattern", "checkerboard", "--period", "0"], "period"),
        (&["status", "--pid", "1"], "no holod of that process number"),
        (&["status", "--socket", "nowhere"], "nowhere: holod does not answer there"),
    ] {
        let refused = bench.refused(args);
        assert!(refused.contains(said), "{args:?}: {refused}");
    }
    for key in ["scene", "weights", "pupil_state", "lasers_kept_dark", "paused", "pattern"] {
        let now = bench.status();
        assert!(now[key] == before[key] || key == "pupil_state" && now[key] != "fixed", "{key}");
    }
    let (_, folder) = bench.stop();
    let orders = fs::read_to_string(folder.path().join("record/orders.jsonl")).unwrap();
    assert_eq!(orders.lines().count(), 1, "only the stop: {orders}");
}

#[test]
fn strangers_on_the_socket_are_answered_and_the_loop_goes_on() {
    let bench = Bench::start(&[]);
    let socket = bench.socket();
    let answer = |bytes: &[u8]| {
        let mut stream = UnixStream::connect(&socket).unwrap();
        stream.write_all(bytes).unwrap();
        stream.shutdown(std::net::Shutdown::Write).unwrap();
        let mut answer = String::new();
        BufReader::new(stream).read_line(&mut answer).unwrap();
        serde_json::from_str::<Value>(&answer).unwrap()["error"].as_str().unwrap().to_owned()
    };
    assert!(answer(b"GET / HTTP/1.1\r\n\r\n").contains("the request is not understood"));
    assert!(answer(b"{\"do\":\"dance\"}\n").contains("unknown variant `dance`"));
    assert!(answer(b"{\"do\":\"pupil\",\"cm\":0.3}\n").contains("cm"));
    assert!(answer(b"{\"do\":\"pupil\",\"mm\":300}\n").contains("expected a human pupil"));
    assert!(answer(b"{\"do\":\"scene\",\"scene\":\"colour.png\"}\n").contains("expected an absolute path"));
    assert!(answer(b"{\"do\":\"scene\",\"scene\":\"/a.png,b.png\"}\n").contains("expected an absolute path"));
    assert!(answer(b"\xff\xfe\n").contains("not understood"));
    assert!(answer(&[b'x'; 70_000]).contains("at most 65536 bytes"));
    // As many as may be connected, and more, say nothing.
    let _silent: Vec<_> = (0..40).map(|_| UnixStream::connect(&socket).unwrap()).collect();
    let mut one = UnixStream::connect(&socket).unwrap();
    let mut several = BufReader::new(one.try_clone().unwrap()).lines();
    for mm in [3.0, 4.0] {
        writeln!(one, "{}", json!({ "do": "pupil", "mm": mm })).unwrap();
        let answer: Value = serde_json::from_str(&several.next().unwrap().unwrap()).unwrap();
        assert!(answer["ok"].as_str().unwrap().contains("until further notice"), "{answer}");
    }
    bench.until("the last one holds", |status| status["pupil_mm"] == 4.0);
    bench.stop();
    assert!(!socket.exists());
}

#[test]
fn lasers_whose_darkness_was_asked_for_last_stay_dark_though_holod_stood_still_meanwhile() {
    let bench = Bench::start(&["--weights", "fast"]);
    let socket = bench.socket();
    let daemon = bench.daemon.as_ref().unwrap();
    let ask = |order: &str| {
        let mut stream = UnixStream::connect(&socket).unwrap();
        stream.write_all(format!("{}\n", json!({ "do": order })).as_bytes()).unwrap();
        stream
    };
    let answer = |stream: UnixStream| {
        let mut answer = String::new();
        BufReader::new(stream).read_line(&mut answer).unwrap();
        serde_json::from_str::<Value>(&answer).unwrap()
    };
    for gives_up in [true, false, true, false, true, false] {
        daemon.signal(Signal::STOP);
        std::thread::sleep(Duration::from_millis(200));
        let arm = ask("lasers-arm");
        let arm = if gives_up { None } else { Some(arm) };
        let dark = ask("lasers-dark");
        daemon.signal(Signal::CONT);
        let dark = answer(dark);
        assert!(dark["ok"].as_str().unwrap_or_default().contains("the lasers are dark"), "{dark}");
        arm.map(answer);
        // Whatever was to follow has followed.
        bench.frames_go_on(20);
        let status = bench.status();
        assert_eq!((&status["lasers"], &status["lasers_kept_dark"]), (&json!("dark"), &json!(true)), "{status}");
        bench.ctl(&["lasers", "arm"]);
        bench.until("the lasers are lit again", |status| status["lasers"] == "armed");
    }
    let (_, folder) = bench.stop();
    let orders = fs::read_to_string(folder.path().join("record/orders.jsonl")).unwrap();
    let orders: Vec<Value> = orders.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert!(orders.iter().filter(|order| order["request"]["do"] == "lasers-dark").count() == 6, "{orders:?}");
}

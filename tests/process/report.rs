//! A run that is recorded, packed, sent elsewhere and shown again: the same levels to the byte.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use holod_tests::daemon::{Daemon, Ended, run, wait_until};
use holod_tests::feed::{Answer, FeedClient, hello};
use holod_tests::small_rig;
use image::{ImageBuffer, Luma, Rgb, RgbImage};
use rustix::process::Signal;
use serde_json::Value;

use crate::HOLOD;

const PATIENCE: Duration = Duration::from_secs(60);
const SMALL: [&str; 4] = ["--weights", "fast", "--backend", "cpu"];

/// A bench whose rig names a file, a scene of four pictures, and a pupil that goes up and down.
struct Bench(tempfile::TempDir);

impl Bench {
    fn new() -> Self {
        let bench = Self(holod_tests::new_folder());
        let lut: String = (0..256).map(|level| format!("{level},{}\n", f64::from(level) * 0.0246)).collect();
        fs::write(bench.path("lut.csv"), lut).unwrap();
        let rig = small_rig(64, 64, "driver = \"simulated\"");
        let lut = format!("lut_file = {{ green = \"{}\" }}\nsettle_ms", bench.path("lut.csv").display());
        // A place that looks like somebody's.
        let named = rig.replace("test bench", "bench of /home/somebody/lab").replace("settle_ms", &lut);
        let named = named.replace("green = 1.9921875, ", "");
        fs::write(bench.path("rig.toml"), named).unwrap();
        fs::create_dir(bench.path("scene")).unwrap();
        for index in 0..4_u8 {
            let colour = RgbImage::from_fn(64, 64, |x, y| Rgb([4 * x as u8, 60 * index, 4 * y as u8]));
            colour.save(bench.path(&format!("scene/colour{index}.png"))).unwrap();
            let depth = |x, y| Luma([500 + 20 * x as u16 + 7 * y as u16]);
            let depth = ImageBuffer::<Luma<u16>, Vec<u16>>::from_fn(64, 64, depth);
            depth.save(bench.path(&format!("scene/depth{index}.png"))).unwrap();
        }
        let description =
            "colour = \"colour{}.png\"\ndepth = \"depth{}.png\"\ndepth_encoding = \"millimetres\"\nfps = 15.0\n";
        fs::write(bench.path("scene/scene.toml"), description).unwrap();
        let pupil = |row: u64| 3.5 + f64::from((row % 400) as u32).mul_add(0.008, -1.6).abs();
        let rows = (0..12_000_u64).map(|row| format!("{},left,{:.4},1.0,,1\n", row * 5_000_000, pupil(row)));
        let log = "t_ns,eye,diameter_mm,confidence,aperture_mm,valid\n".to_owned() + &rows.collect::<String>();
        fs::write(bench.path("log.csv"), log).unwrap();
        bench
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn holod(&self, args: &[&str]) -> Ended {
        run(HOLOD, args, self.0.path())
    }

    fn record(&self, more: &[&str]) {
        let args = ["--config", "rig.toml", "--tracker", "log.csv", "--scene", "scene", "--record", "record"];
        let ended = self.holod(&[&args[..], &SMALL, more].concat());
        assert!(ended.status.success(), "{}", ended.stderr);
    }

    fn pack(&self, more: &[&str]) -> Ended {
        let ended = self.holod(&[&["report", "record", "--out", "report.tar.gz"], more].concat());
        assert!(ended.status.success(), "{}", ended.stderr);
        ended
    }

    /// Only the report stays, under another name and in another folder.
    fn send(self) -> Sent {
        let sent = Sent(holod_tests::new_folder());
        fs::copy(self.path("report.tar.gz"), sent.path()).unwrap();
        sent
    }
}

struct Sent(tempfile::TempDir);

impl Sent {
    fn path(&self) -> PathBuf {
        self.0.path().join("from a user")
    }

    fn show(&self, more: &[&str]) -> Ended {
        let spec = format!("replay:{}", self.path().display());
        let temporary = self.0.path().join("temporary");
        fs::create_dir_all(&temporary).unwrap();
        let args = [&["--tracker", &spec, "--json"], more].concat();
        let ended = Daemon::start_with(HOLOD, &args, self.0.path(), &[("TMPDIR", &temporary)]).wait(PATIENCE);
        let left: Vec<_> = fs::read_dir(temporary).unwrap().map(|entry| entry.unwrap().file_name()).collect();
        assert!(left.iter().all(|name| !name.to_string_lossy().starts_with("holod-report")), "left behind: {left:?}");
        ended
    }

    /// Unpacks it, lets `change` change its folder, and packs it again with a list that knows the changes.
    fn changed(&self, change: impl FnOnce(&Path)) {
        let folder = self.0.path().join("unpacked");
        fs::create_dir(&folder).unwrap();
        tar(&["xzf", self.path().to_str().unwrap(), "-C", folder.to_str().unwrap()]);
        let report = folder.join("holod-report");
        change(&report);
        let list = report.join("report.json");
        let mut manifest: Value = serde_json::from_str(&fs::read_to_string(&list).unwrap()).unwrap();
        // What is not in the list is not compared with it.
        manifest["files"] = Value::Array(Vec::new());
        fs::write(&list, manifest.to_string()).unwrap();
        tar(&["czf", self.path().to_str().unwrap(), "-C", folder.to_str().unwrap(), "holod-report"]);
        fs::remove_dir_all(folder).unwrap();
    }
}

fn tar(args: &[&str]) {
    assert!(Command::new("tar").args(args).status().unwrap().success());
}

fn outcome(ended: &Ended) -> Value {
    let summary: Value = serde_json::from_str(&ended.stdout).unwrap_or_else(|_| panic!("{}", ended.stderr));
    summary["report"].clone()
}

fn assert_all_the_same(ended: &Ended) -> u64 {
    assert!(ended.status.success(), "{}", ended.stderr);
    let outcome = outcome(ended);
    let frames = outcome["frames_recorded"].as_u64().unwrap();
    assert!(frames > 20, "{outcome:#}");
    assert_eq!(outcome["frames_same"], frames, "{outcome:#}");
    assert_eq!(outcome["frames_different"], 0);
    assert_eq!(outcome["fields_different"], 0);
    assert!(outcome["fields_same"].as_u64().unwrap() > 20, "{outcome:#}");
    frames
}

#[test]
fn a_run_that_is_packed_and_sent_is_shown_again_to_the_byte() {
    let bench = Bench::new();
    bench.record(&["--frames", "90"]);
    let said = bench.pack(&[]).stdout;
    for expected in ["frames.csv", "scene/", "in 9 files", "bench/", "log.txt", "report.tar.gz is written", "kernel"] {
        assert!(said.contains(expected), "{expected}: {said}");
    }
    let again = bench.holod(&["report", "record", "--out", "report.tar.gz"]);
    assert_eq!(again.status.code(), Some(73), "{}", again.stderr);
    assert!(again.stderr.contains("--force"), "{}", again.stderr);
    let over_itself = bench.holod(&["report", "record", "--out", "record/bench/rig.toml", "--force"]);
    assert_eq!(over_itself.status.code(), Some(64), "{}", over_itself.stderr);
    assert!(over_itself.stderr.contains("this command reads"), "{}", over_itself.stderr);
    bench.pack(&["--force"]);

    let home = bench.0.path().display().to_string();
    let sent = bench.send();
    let ended = sent.show(&[]);
    let frames = assert_all_the_same(&ended);
    let summary: Value = serde_json::from_str(&ended.stdout).unwrap();
    assert_eq!(summary["ended_by"], "the end of the report");
    assert_eq!(summary["frames_made"], frames);
    assert_eq!(summary["lasers"]["unsafe_findings"], 0);

    // Without gzip, and by its path alone.
    let plain = sent.0.path().join("plain");
    let unzipped = Command::new("gzip").args(["-dc"]).stdin(fs::File::open(sent.path()).unwrap()).output().unwrap();
    fs::write(&plain, unzipped.stdout).unwrap();
    assert_all_the_same(&run(HOLOD, &["run", "--tracker", "plain", "--json"], sent.0.path()));
    let checked = run(HOLOD, &["check", "--tracker", "plain", "--weights", "fast", "--json"], sent.0.path());
    let found: Value = serde_json::from_str(&checked.stdout).unwrap();
    let tracker = found["checks"].as_array().unwrap().iter().find(|check| check["name"] == "tracker").unwrap();
    assert_eq!(tracker["passed"], true, "{tracker}");
    assert!(tracker["says"].as_str().unwrap().contains("plain: a report, which brings its own rig"), "{tracker}");
    let recorded = run(HOLOD, &["--tracker", "plain", "--record", "again"], sent.0.path());
    assert_eq!(recorded.status.code(), Some(64), "{}", recorded.stderr);
    assert!(recorded.stderr.contains("--record: a report holds its record already"), "{}", recorded.stderr);
    assert!(!sent.0.path().join("again").exists());
    tar(&["xzf", sent.path().to_str().unwrap(), "-C", sent.0.path().to_str().unwrap()]);

    // Whoever reads it learns nothing of where it was made.
    for name in ["run.json", "log.txt", "bench/rig.toml", "report.json", "summary.json"] {
        let text = fs::read_to_string(sent.0.path().join("holod-report").join(name)).unwrap();
        assert!(!text.contains("/home/"), "{name}: {text}");
        assert!(name == "run.json" || !text.contains(&home), "{name}: {text}");
    }
    let rig = fs::read_to_string(sent.0.path().join("holod-report/bench/rig.toml")).unwrap();
    assert!(rig.contains("bench of ~/lab") && rig.contains("lut-green.csv"), "{rig}");
}

#[test]
fn one_changed_byte_and_one_changed_pupil_are_found() {
    let bench = Bench::new();
    bench.record(&["--frames", "120"]);
    bench.pack(&[]);
    let sent = bench.send();
    let mut changed = Vec::new();
    sent.changed(|report| {
        let path = report.join("frames.csv");
        let text = fs::read_to_string(&path).unwrap();
        let mut rows: Vec<Vec<String>> = text.lines().map(|row| row.split(',').map(str::to_owned).collect()).collect();
        let mut frames: Vec<String> = rows.iter().skip(1).map(|row| row[0].clone()).collect();
        frames.dedup();
        // Behind the first ten, before the last one, which may be shown in part.
        let [hashed, pupil, coloured] = [12, 14, 16].map(|index| frames[index].clone());
        assert!(frames.len() > 18);
        for row in &mut rows {
            if row[0] == hashed {
                let last = if row[18].ends_with('0') { "1" } else { "0" };
                row[18].replace_range(15.., last);
            }
            if row[0] == pupil {
                row[5] = "5.875".into();
            }
            if row[0] == coloured && row[2] == "red" {
                row[2] = "blue".into();
            }
        }
        changed = vec![hashed, pupil, coloured];
        let rows: Vec<String> = rows.iter().map(|row| row.join(",")).collect();
        fs::write(path, rows.join("\n") + "\n").unwrap();
    });
    let ended = sent.show(&[]);
    assert_eq!(ended.status.code(), Some(1), "{}", ended.stderr);
    let outcome = outcome(&ended);
    let numbers: Vec<u64> = changed.iter().map(|frame| frame.parse().unwrap()).collect();
    assert_eq!(outcome["first_different"], serde_json::json!(numbers[..2]), "{outcome:#}");
    assert_eq!(outcome["frames_different"], 2);
    assert_eq!(outcome["first_fields_different"], serde_json::json!(numbers[2..]), "{outcome:#}");
    assert!(ended.stderr.contains("2 frames have other levels than the report's, 1 other colour fields"));
    let text = run(HOLOD, &["--tracker", sent.path().to_str().unwrap(), "--frames", "10"], sent.0.path());
    assert!(text.status.success(), "none of the first ten was changed: {}", text.stderr);
    assert!(text.stdout.contains(": 10 the same to the byte, 0 different, 0 not shown again"), "{}", text.stdout);
}

#[test]
fn what_orders_changed_is_changed_at_the_same_frame() {
    let bench = Bench::new();
    let rig = fs::read_to_string(bench.path("rig.toml")).unwrap();
    let with_network = |name: &str| fs::write(bench.path("rig.toml"), format!("{rig}[model]\nnetwork = \"{name}\"\n"));
    with_network("fast").unwrap();
    let args = ["--config", "rig.toml", "--tracker", "mock:sweep", "--record", "record", "--resolution", "64x64"];
    let environment = [("XDG_RUNTIME_DIR", bench.0.path())];
    let args = [&args[..], &["--backend", "cpu"]].concat();
    let daemon = Daemon::start_with(HOLOD, &args, bench.0.path(), &environment);
    let pid = daemon.pid().to_string();
    let asked = |order: &[&str]| {
        let args = [&["ctl", "--pid", &pid], order].concat();
        Daemon::start_with(HOLOD, &args, bench.0.path(), &environment).wait(PATIENCE)
    };
    let shown = || {
        let status: Value = serde_json::from_str(&asked(&["status"]).stdout).unwrap_or_default();
        status["frames_shown"].as_u64()
    };
    assert!(wait_until(PATIENCE, || shown() > Some(10)));
    for order in [
        &["scene", "scene"][..],
        &["pause"],
        &["scene", "scene/colour1.png,scene/depth1.png", "--depth-encoding", "millimetres"],
        &["weights", "small"],
        &["resume"],
        &["pattern", "dots", "--spacing", "20", "--dot", "6"],
        &["weights", "fast"],
        &["flat"],
        &["hologram"],
        &["eye", "both"],
        &["reload"],
        &["pupil", "4.25"],
    ] {
        with_network(if order[0] == "reload" { "small" } else { "fast" }).unwrap();
        let ended = asked(order);
        assert!(ended.status.success(), "{order:?}: {}", ended.stderr);
        let then = shown();
        assert!(wait_until(PATIENCE, || shown() > then.map(|frames| frames + 8)), "{order:?}");
    }
    assert!(asked(&["stop"]).status.success());
    assert!(daemon.wait(PATIENCE).status.success());
    bench.pack(&[]);

    let sent = bench.send();
    assert_all_the_same(&sent.show(&[]));
    // An order that this holod does not know may have changed anything.
    sent.changed(|report| {
        let orders = report.join("orders.jsonl");
        let text = fs::read_to_string(&orders).unwrap();
        fs::write(orders, text.replace("\"do\":\"flat\"", "\"do\":\"dance\"")).unwrap();
    });
    let ended = sent.show(&[]);
    assert!(ended.status.success(), "{}", ended.stderr);
    let outcome = outcome(&ended);
    let why = outcome["frames_not_shown_again"].as_object().unwrap();
    assert_eq!(why.keys().collect::<Vec<_>>(), ["order 8, `dance`, is not carried out again"]);
    let [all, same, not_again] = [
        outcome["frames_recorded"].as_u64().unwrap(),
        outcome["frames_same"].as_u64().unwrap(),
        why.values().next().unwrap().as_u64().unwrap(),
    ];
    assert!(same + not_again == all && same > 20 && not_again > 16, "{outcome:#}");
}

#[test]
fn pictures_of_a_live_feed_are_not_recorded_and_what_was_shown_before_them_is_shown_again() {
    let bench = Bench::new();
    let args = ["--config", "rig.toml", "--tracker", "mock:steady", "--record", "record", "--scene", "feed:pictures"];
    let environment = [("XDG_RUNTIME_DIR", bench.0.path())];
    let daemon = Daemon::start_with(HOLOD, &[&args[..], &SMALL].concat(), bench.0.path(), &environment);
    let rows = |live: bool| {
        let text = fs::read_to_string(bench.path("record/frames.csv")).unwrap_or_default();
        let is_live = |row: &&str| row.split(',').nth(17).is_some_and(|t_picture| !t_picture.is_empty()) == live;
        text.lines().skip(1).filter(is_live).count()
    };
    assert!(wait_until(PATIENCE, || rows(false) > 60));
    let mut client = FeedClient::connect(&bench.path("pictures")).unwrap();
    client.say(&hello(64, 64, Some(1.0), "test camera")).unwrap();
    assert_eq!(client.answer(), Answer::Ring);
    client.write(0, &[99; 4 * 64 * 64], &[]);
    client.hand_over(0, 1, 0).unwrap();
    assert!(wait_until(PATIENCE, || rows(true) > 60));
    daemon.signal(Signal::TERM);
    assert!(daemon.wait(PATIENCE).status.success());
    assert!(bench.pack(&[]).stdout.contains("pictures of the live feed, which are not recorded"));
    let ended = bench.send().show(&[]);
    assert!(ended.status.success(), "{}", ended.stderr);
    let outcome = outcome(&ended);
    let not_again = outcome["frames_not_shown_again"]["pictures of a live feed are not recorded"].as_u64().unwrap();
    let same = outcome["frames_same"].as_u64().unwrap();
    assert!(not_again > 0 && same > 0, "{outcome:#}");
    assert_eq!(outcome["frames_recorded"], same + not_again, "{outcome:#}");
}

#[test]
fn a_report_without_its_pictures_says_so_and_compares_nothing() {
    let bench = Bench::new();
    bench.record(&["--frames", "30"]);
    let said = bench.pack(&["--without-scene"]).stdout;
    assert!(said.contains("left out:") && said.contains("scene/: 8 files") && !said.contains("shown_pupil_"), "{said}");
    let sent = bench.send();
    let ended = sent.show(&[]);
    assert_eq!(ended.status.code(), Some(65), "{}", ended.stderr);
    assert!(ended.stderr.contains("the scene is not in the report"), "{}", ended.stderr);
}

#[test]
fn a_picture_that_has_changed_since_the_run_is_left_out() {
    let bench = Bench::new();
    bench.record(&["--frames", "60"]);
    let changed = RgbImage::from_pixel(64, 64, Rgb([1, 2, 3]));
    changed.save(bench.path("scene/colour2.png")).unwrap();
    let said = bench.pack(&[]).stdout;
    assert!(said.contains("scene/colour-000002.png: it has changed since the run"), "{said}");
    // What the bench's folder held is of the run, whatever becomes of the bench.
    fs::write(bench.path("lut.csv"), "").unwrap();
    fs::write(bench.path("rig.toml"), "").unwrap();
    bench.pack(&["--force"]);
    assert!(bench.send().show(&[]).stderr.contains("the scene is not in the report"));
}

#[test]
fn a_record_takes_the_place_of_no_file_that_is_there() {
    let bench = Bench::new();
    let args = ["--config", "rig.toml", "--tracker", "log.csv", "--frames", "20", "--resolution", "64x64"];
    let args = [&args[..], &SMALL, &["--record", "record"]].concat();
    for name in ["log.txt", "run.json", "bench/mine.txt"] {
        let path = bench.path("record").join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(&path, "precious").unwrap();
        let ended = bench.holod(&args);
        assert_eq!(ended.status.code(), Some(73), "{name}: {}", ended.stderr);
        assert_eq!(fs::read_to_string(&path).unwrap(), "precious");
        assert!(!bench.path("record/frames.csv").exists());
        fs::remove_dir_all(bench.path("record")).unwrap();
    }
    for force in [&[][..], &["--force"]] {
        let ended = bench.holod(&[&args[..], force].concat());
        assert!(ended.status.success(), "{}", ended.stderr);
    }
    bench.pack(&[]);
    assert!(bench.send().show(&[]).status.success());
}

#[test]
fn a_report_names_no_file_outside_of_it() {
    let bench = Bench::new();
    bench.record(&["--frames", "30"]);
    bench.pack(&[]);
    let sent = bench.send();
    let outside = sent.0.path().join("outside");
    fs::create_dir(&outside).unwrap();
    let kept = outside.join("kept");
    fs::copy(sent.path(), &kept).unwrap();
    let refused = |says: &str| {
        let ended = sent.show(&[]);
        assert_eq!(ended.status.code(), Some(65), "{}", ended.stderr);
        assert!(ended.stderr.contains(says), "{}", ended.stderr);
    };
    let rewrite = |path: PathBuf, from: &str, to: &str| {
        let text = fs::read_to_string(&path).unwrap();
        assert!(text.contains(from), "{text}");
        fs::write(path, text.replace(from, to)).unwrap();
    };
    let elsewhere = |name: &str| outside.join(name).display().to_string();
    sent.changed(|report| {
        for index in 0..4 {
            let name = format!("colour-00000{index}.png");
            fs::copy(report.join("scene").join(&name), outside.join(name)).unwrap();
        }
        rewrite(report.join("scene/scene.toml"), "colour-{:06}.png", &elsewhere("colour-{:06}.png"));
    });
    refused("names pictures that are not in the report");
    sent.changed(|report| {
        fs::copy(report.join("bench/lut-green.csv"), outside.join("lut.csv")).unwrap();
        rewrite(report.join("bench/rig.toml"), "lut-green.csv", &elsewhere("lut.csv"));
    });
    refused("lut.csv`, which is not in the report");

    let whole = |change: &dyn Fn(&Path)| {
        fs::copy(&kept, sent.path()).unwrap();
        sent.changed(change);
    };
    // Neither is read, which would never end, nor told of.
    whole(&|report| rewrite(report.join("run.json"), "\"colour-000000.png\"", "\"/dev/zero\""));
    refused("the scene is not in the report");
    whole(&|report| rewrite(report.join("bench/rig.toml"), "[lasers]", "[lasers]\nprofile_file = \"/etc/passwd\""));
    refused("lasers.profile_file names `/etc/passwd`, which is not in the report");
    // Only what is asked of a pattern is carried out for a pattern.
    whole(&|report| {
        let order = format!("{{\"t_ns\":1,\"request\":{{\"do\":\"scene\",\"scene\":\"{}\"}}}}\n", outside.display());
        fs::write(report.join("orders.jsonl"), order).unwrap();
        rewrite(report.join("frames.csv"), ",0,0,0,,,,", ",0,0,1,,,,");
    });
    refused("order 1: it brought no pattern");
}

#[test]
fn what_is_no_report_is_said() {
    let bench = Bench::new();
    bench.record(&["--frames", "30"]);
    bench.pack(&[]);
    let whole = fs::read(bench.path("report.tar.gz")).unwrap();
    let mut damaged = whole.clone();
    let middle = damaged.len() / 2;
    damaged[middle] ^= 0x10;
    for (name, bytes) in [("cut", &whole[..whole.len() / 2]), ("damaged", &damaged), ("short", &whole[..30])] {
        fs::write(bench.path(name), bytes).unwrap();
    }
    tar(&["czf", bench.path("other").to_str().unwrap(), "-C", bench.0.path().to_str().unwrap(), "scene"]);
    fs::create_dir(bench.path("empty")).unwrap();
    let facts = bench.holod(&["report", "--out", "facts"]);
    assert!(facts.status.success(), "{}", facts.stderr);
    assert!(facts.stdout.contains("frames: no record was named"), "{}", facts.stdout);
    let before = fs::read_dir(bench.0.path()).unwrap().count();
    for (args, exit, says) in [
        (&["--tracker", "replay:cut"][..], 65, "was it sent whole?"),
        (&["--tracker", "damaged"], 65, "damaged"),
        (&["--tracker", "short"], 66, "short: incomplete"),
        (&["--tracker", "other"], 65, "is no report of holod"),
        (&["--tracker", "facts"], 65, "the report holds no run"),
        (&["--tracker", "replay:report.tar.gz,speed=2"], 64, "at the panel's pace"),
        (&["--tracker", "report.tar.gz", "--weights", "small"], 64, "--weights: a report brings its own"),
        (&["--tracker", "report.tar.gz", "--config", "rig.toml"], 64, "--config"),
        (&["--tracker", "report.tar.gz", "--pupil", "3"], 64, "--pupil"),
        (&["log", "info", "report.tar.gz"], 65, "found a tar archive, expected a log"),
        (&["tracker", "try", "replay:report.tar.gz"], 65, "holod --tracker replay:report.tar.gz"),
        (&["report", "empty"], 66, "found no frames.csv"),
        (&["report", "record", "--out", "empty"], 73, "directory"),
        (&["report", "--without-scene"], 64, "DIR"),
    ] {
        let ended = bench.holod(args);
        assert_eq!(ended.status.code(), Some(exit), "{args:?}: {}", ended.stderr);
        assert!(ended.stderr.contains(says), "{args:?}: {}", ended.stderr);
    }
    assert_eq!(fs::read_dir(bench.0.path()).unwrap().count(), before, "nothing is left behind");
}

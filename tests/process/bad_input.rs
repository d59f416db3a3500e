//! What bad input gets: one clear error, the right exit code, and nothing half written.

use std::ffi::OsStr;
use std::fs;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::FileTypeExt;
use std::path::Path;
use std::time::Duration;

use holod_tests::daemon::{Daemon, run, wait_until};
use holod_tests::small_rig;
use image::{ImageBuffer, Luma, Rgb, RgbImage};
use rustix::fs::Mode;
use rustix::process::Signal;

use crate::HOLOD;

struct Case<'a> {
    args: &'a [&'a str],
    exit: i32,
    says: &'a [&'a str],
}

fn colour(path: &Path, width: u32, height: u32) {
    RgbImage::from_pixel(width, height, Rgb([90, 120, 150])).save(path).unwrap();
}

fn depth(path: &Path, width: u32, height: u32) {
    ImageBuffer::<Luma<u16>, _>::from_pixel(width, height, Luma([1500u16])).save(path).unwrap();
}

#[test]
fn each_bad_input_gets_a_clear_error_and_leaves_nothing_behind() {
    let folder = holod_tests::new_folder();
    let at = |name: &str| folder.path().join(name);
    colour(&at("colour.png"), 64, 48);
    depth(&at("depth.png"), 64, 48);
    depth(&at("small.png"), 32, 24);
    fs::write(at("cut.exr"), [0x76, 0x2f, 0x31, 0x01, 2, 0, 0, 0, b'c', b'h']).unwrap();
    fs::write(at("text.png"), "this is no picture").unwrap();
    fs::create_dir(at("directory")).unwrap();
    fs::create_dir(at("scene")).unwrap();
    let scene = "colour = \"../colour.png\"\ndepth = \"../depth.png\"\ndepth_encoding = \"millimetres\"\n";
    fs::write(at("scene/scene.toml"), scene).unwrap();
    fs::write(at("log.csv"), "when,how wide\n1,3.5\n2,3.6\n").unwrap();
    fs::write(at("empty.csv"), "").unwrap();
    let rig = small_rig(64, 64, "driver = \"simulated\"");
    let three = rig
        .replace("pixel_pitch_um = 8.0", "pixel_pitch_um = -8.0")
        .replace("refresh_hz = 60.0", "refesh_hz = 60.0")
        .replace("fallback_mm = 3.0", "fallback_mm = \"wide\"");
    fs::write(at("three.toml"), three).unwrap();
    fs::write(at("other_optics.toml"), rig.replace("pixel_pitch_um = 8.0", "pixel_pitch_um = 2.0")).unwrap();
    fs::write(at("junk.toml"), [0xff, 0xfe, 0x00]).unwrap();
    fs::write(at("weights.safetensors"), "no weights").unwrap();
    fs::write(at("bad_weights.toml"), format!("{rig}[model]\nweights_file = \"weights.safetensors\"\n")).unwrap();
    for (name, tracker) in [
        ("bad_tracker.toml", "spec = \"hid:1234\"\neye = \"third\"\n"),
        ("wrong_link.toml", "spec = \"serial:/dev/null,profile=holod-hid\"\n"),
        ("unknown_hid.toml", "spec = \"hid:046d:c31c\"\n"),
    ] {
        fs::write(at(name), format!("[tracker]\n{tracker}")).unwrap();
    }
    let before = listing(folder.path());

    const METRES: [&str; 2] = ["--depth-encoding", "millimetres"];
    let scene = |pair: &'static str| ["render", "--scene", pair, METRES[0], METRES[1], "--pupil", "3", "--out", "out"];
    let cases = [
        Case { args: &scene("nowhere.png,depth.png"), exit: 66, says: &["nowhere.png"] },
        Case { args: &scene("colour.png,nowhere.png"), exit: 66, says: &["nowhere.png"] },
        Case { args: &scene("colour.png,small.png"), exit: 65, says: &["small.png", "32x24", "64x48"] },
        Case { args: &scene("text.png,depth.png"), exit: 65, says: &["text.png"] },
        Case { args: &scene("cut.exr"), exit: 65, says: &["cut.exr"] },
        Case {
            args: &["render", "--scene", "colour.png,depth.png", "--pupil", "3", "--out", "out"],
            exit: 64,
            says: &["--depth-encoding", "metres", "millimetres", "dioptres", "normalised_dioptres"],
        },
        Case {
            args: &[
                "render",
                "--scene",
                "colour.png,depth.png",
                "--depth-encoding",
                "feet",
                "--pupil",
                "3",
                "--out",
                "out",
            ],
            exit: 64,
            says: &["feet", "metres"],
        },
        Case {
            args: &["--scene", "scene", "--depth-encoding", "dioptres"],
            exit: 64,
            says: &["scene/scene.toml, line 3: `depth_encoding`", "millimetres here and dioptres", "in this file"],
        },
        Case { args: &["render", "--pupil", "wide", "--out", "out"], exit: 64, says: &["wide", "--pupil"] },
        Case { args: &["render", "--pupil", "12", "--out", "out"], exit: 64, says: &["12"] },
        Case { args: &["render", "--pupil", "8.5", "--out", "out"], exit: 64, says: &["8.5", "trained"] },
        Case { args: &["render", "--pupil", "3", "--out", "colour.png"], exit: 73, says: &["colour.png", "file"] },
        Case {
            args: &["view", "--hologram", "directory", "--focus", "1", "--out", "v.png"],
            exit: 66,
            says: &["directory", "field.safetensors", "holod render"],
        },
        Case {
            args: &["view", "--hologram", "directory", "--resolution", "64x48", "--focus", "-1", "--out", "v.png"],
            exit: 64,
            says: &["--hologram", "--resolution"],
        },
        Case {
            args: &["view", "--hologram", "directory", "--backend", "cpu", "--focus", "1", "--out", "v.png"],
            exit: 64,
            says: &["--hologram", "--backend"],
        },
        Case { args: &["--weights", "nowhere.safetensors"], exit: 66, says: &["nowhere.safetensors"] },
        Case { args: &["view", "--focus", "1", "--out", "v.png"], exit: 64, says: &["--hologram", "--pupil"] },
        Case { args: &["check", "--config", "nowhere.toml"], exit: 66, says: &["nowhere.toml"] },
        Case { args: &["check", "--config", "junk.toml"], exit: 78, says: &["junk.toml"] },
        Case {
            args: &["check", "--config", "three.toml"],
            exit: 78,
            says: &[
                "panel.pixel_pitch_um",
                "-8",
                "refesh_hz",
                "refresh_hz",
                "tracker.fallback_mm",
                "wide",
                "line 5",
                "line 6",
            ],
        },
        Case {
            args: &["--config", "other_optics.toml"],
            exit: 78,
            says: &["729.14 px² in red", "8.00 to 240.00", "model/training/README.md"],
        },
        Case { args: &["--config", "bad_weights.toml"], exit: 65, says: &["weights.safetensors"] },
        Case {
            args: &["--config", "bad_tracker.toml"],
            exit: 78,
            says: &["bad_tracker.toml", "2 faults", "line 2, tracker.spec", "hid:1234", "line 3, tracker.eye"],
        },
        Case { args: &["--config", "wrong_link.toml"], exit: 78, says: &["line 2, tracker.spec", "hid:VID:PID"] },
        Case {
            args: &["--config", "unknown_hid.toml"],
            exit: 78,
            says: &["line 2, tracker.spec", "no shipped profile"],
        },
        Case { args: &["--tracker", "/dev/nothing-here"], exit: 66, says: &["/dev/nothing-here", "does not exist"] },
        Case { args: &["--tracker", "directory"], exit: 66, says: &["directory"] },
        Case { args: &["--tracker", "log.csv"], exit: 65, says: &["log.csv", "when,how wide"] },
        Case { args: &["--tracker", "log.csv", "--record", "record"], exit: 65, says: &["log.csv"] },
        Case {
            args: &["view", "--pupil", "3", "--focus", "1", "--out", "directory"],
            exit: 73,
            says: &["directory", "name of a file"],
        },
        Case { args: &["--tracker", "empty.csv"], exit: 65, says: &["empty.csv"] },
        Case { args: &["--tracker", "mock:nosuch"], exit: 64, says: &["nosuch", "light-steps"] },
        Case { args: &["--tracker", "hid:1234"], exit: 64, says: &["hid:1234", "VID:PID"] },
        Case { args: &["--tracker", "hid:1234:5678"], exit: 69, says: &["1234:5678", "profile="] },
        Case { args: &["--tracker", "tcp:127.0.0.1:1,profile=open-gaze"], exit: 69, says: &["127.0.0.1:1"] },
        Case { args: &["--tracker", "serial:/dev/null,profile=neon"], exit: 64, says: &["neon:HOST"] },
        Case { args: &["--tracker", "serial:/dev/null,profile=nosuch"], exit: 64, says: &["nosuch", "holod-hid"] },
        Case { args: &["--weights", "smal"], exit: 64, says: &["smal", "did you mean `small`?"] },
        Case { args: &["--weights", "./smal"], exit: 66, says: &["smal"] },
        Case { args: &["check", "--tracker", "/dev/nothing-here"], exit: 69, says: &["/dev/nothing-here"] },
        Case { args: &["--tracker", "/dev/null,profile=nosuch"], exit: 64, says: &["nosuch", "holod-hid"] },
        Case { args: &["--force"], exit: 64, says: &["--record"] },
        Case { args: &["--output", "screen"], exit: 64, says: &["screen", "headless"] },
        Case { args: &["--frames", "many"], exit: 64, says: &["many"] },
        Case { args: &["--no-such-option"], exit: 64, says: &["--no-such-option"] },
    ];
    for case in &cases {
        // Before a tracker is opened a first frame is made.
        let small: &[&str] = if case.args[0] == "--tracker" { &["--resolution", "64x64"] } else { &[] };
        let ended = run(HOLOD, &[case.args, small].concat(), folder.path());
        let what = format!("holod {}\n{}", case.args.join(" "), ended.stderr);
        assert_eq!(ended.status.code(), Some(case.exit), "{what}");
        for words in case.says {
            assert!(ended.stderr.contains(words), "no '{words}' in: {what}");
        }
        assert!(!ended.stderr.contains("panicked"), "{what}");
        assert_eq!(listing(folder.path()), before, "something was left behind by {what}");
    }
}

fn listing(folder: &Path) -> Vec<(String, u64)> {
    let mut names: Vec<(String, u64)> = fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap())
        .map(|entry| (entry.file_name().to_string_lossy().into_owned(), entry.metadata().unwrap().len()))
        .collect();
    names.sort();
    names
}

#[test]
fn results_are_overwritten_by_force_only_and_by_the_same_rule_everywhere() {
    let folder = holod_tests::new_folder();
    let at = |name: &str| folder.path().join(name);
    let rig = small_rig(64, 64, "driver = \"simulated\"");
    fs::write(at("rig.toml"), rig).unwrap();
    let lines: String = (0..20).map(|k| format!("{},left,3.5,1,,1\n", k * 5_000_000)).collect();
    fs::write(at("log.csv"), format!("t_ns,eye,diameter_mm,confidence,aperture_mm,valid\n{lines}")).unwrap();
    let small = ["--config", "rig.toml", "--resolution", "64x64"];
    let with = |args: &[&'static str]| [args, &small[..]].concat();
    let cases = [
        (with(&["render", "--pupil", "3", "--out", "out"]), "out/report.json"),
        (with(&["view", "--pupil", "3", "--focus", "1", "--out", "v.png"]), "v.png"),
        (vec!["log", "convert", "log.csv", "--to", "lines", "--out", "out.lines"], "out.lines"),
        (vec!["log", "info", "log.csv", "--plot", "plot.svg"], "plot.svg"),
        (vec!["pattern", "level", "37", "--config", "rig.toml", "--out", "level.png"], "level.png"),
        (with(&["run", "--tracker", "mock", "--frames", "2", "--record", "record"]), "record/frames.csv"),
        (
            vec!["demo", "--duration", "2s", "--resolution", "128x128", "--weights", "small", "--out", "demo"],
            "demo/eye.png",
        ),
    ];
    for (args, result) in cases {
        fs::create_dir_all(at(result).parent().unwrap()).unwrap();
        fs::write(at(result), "precious").unwrap();
        let ended = run(HOLOD, &args, folder.path());
        assert_eq!(ended.status.code(), Some(73), "{args:?}: {}", ended.stderr);
        assert!(ended.stderr.contains("--force"), "{args:?}: {}", ended.stderr);
        assert_eq!(fs::read_to_string(at(result)).unwrap(), "precious", "{args:?}");
        let ended = run(HOLOD, &[&args[..], &["--force"]].concat(), folder.path());
        assert!(ended.status.success(), "{args:?}: {}", ended.stderr);
        assert_ne!(fs::read(at(result)).unwrap(), b"precious", "{args:?}");
    }
    // The demo finds a folder of its own each time.
    for (name, duration) in [("holod-demo", "8s"), ("holod-demo-2", "2s")] {
        let args = ["demo", "--duration", duration, "--resolution", "128x128", "--weights", "small"];
        let ended = run(HOLOD, &args, folder.path());
        assert!(ended.status.success() && at(name).join("eye.png").is_file(), "{}", ended.stderr);
        assert!(ended.stdout.contains(name), "{}", ended.stdout);
    }
    // Its phase patterns are those of the pupil that it names.
    let summary = fs::read_to_string(at("holod-demo/summary.txt")).unwrap();
    let pupils: Vec<_> = summary.lines().filter_map(|line| line.strip_prefix("  pupil ")?.split(' ').next()).collect();
    let named = summary.split("the widest pupil kept, ").nth(1).unwrap().split(' ').next().unwrap();
    // On a machine that shows no more than one frame there is no other to tell it from.
    if let Some(other) = pupils.iter().find(|pupil| **pupil != named) {
        let apart = |pupil: &str| {
            let args = ["render", "--resolution", "128x128", "--weights", "small", "--force", "--pupil", pupil];
            let ended = run(HOLOD, &[&args[..], &["--out", "rendered"]].concat(), folder.path());
            assert!(ended.status.success(), "{}", ended.stderr);
            phases_apart(&at("holod-demo/phase_green.png"), &at("rendered/phase_green.png"))
        };
        let (of_named, of_other) = (apart(named), apart(other));
        assert!(of_named < of_other, "{named} mm: {of_named} levels apart; {other} mm: {of_other}");
    }
}

/// How far two pictures of phases lie apart in the mean, in 256ths of a turn.
fn phases_apart(a: &Path, b: &Path) -> f64 {
    let [a, b] = [a, b].map(|path| image::open(path).unwrap().to_luma8());
    assert_eq!(a.dimensions(), b.dimensions());
    let apart = a.iter().zip(b.iter()).map(|(a, b)| f64::from(a.wrapping_sub(*b).cast_signed().unsigned_abs()));
    apart.sum::<f64>() / a.len() as f64
}

#[test]
fn a_dash_writes_to_standard_output() {
    let folder = holod_tests::new_folder();
    fs::write(folder.path().join("rig.toml"), small_rig(64, 64, "driver = \"simulated\"")).unwrap();
    let to_stdout = |args: &[&str]| {
        let output = std::process::Command::new(HOLOD).args(args).current_dir(folder.path()).output().unwrap();
        assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
        output.stdout
    };
    let picture =
        ["view", "--config", "rig.toml", "--resolution", "64x64", "--pupil", "3", "--focus", "1", "--out", "-"];
    let png = to_stdout(&picture);
    assert_eq!(image::load_from_memory(&png).unwrap().width(), 64);
    fs::write(folder.path().join("log.csv"), "t_ns,eye,diameter_mm,confidence,aperture_mm,valid\n0,left,3.5,1,,1\n")
        .unwrap();
    let lines = String::from_utf8(to_stdout(&["log", "convert", "log.csv", "--to", "lines", "--out", "-"])).unwrap();
    assert!(lines.lines().all(|line| line.starts_with("# ") || line.starts_with("P1,")), "{lines}");
    assert!(lines.contains("P1,0,0,L,3.5"), "{lines}");
    let svg = String::from_utf8(to_stdout(&["log", "info", "log.csv", "--plot", "-"])).unwrap();
    assert!(svg.starts_with("<svg") && svg.trim_end().ends_with("</svg>"), "{svg}");
    for command in [&picture[..], &["report", "--out", "-"], &["lut", "log.csv", "--out", "-"]] {
        let both = run(HOLOD, &[command, &["--json"]].concat(), folder.path());
        assert_eq!(both.status.code(), Some(64), "{command:?}");
        assert!(both.stderr.contains("would both write to standard output"), "{command:?}: {}", both.stderr);
    }
    assert_eq!(listing(folder.path()).len(), 2, "nothing is left behind");
}

#[test]
fn a_signal_takes_what_is_half_done_away() {
    let folder = holod_tests::new_folder();
    let args = ["render", "--pupil", "3", "--resolution", "1920x1080", "--out", "out"];
    let daemon = Daemon::start(HOLOD, &args, folder.path());
    assert!(wait_until(Duration::from_secs(60), || !listing(folder.path()).is_empty()));
    daemon.signal(Signal::INT);
    let ended = daemon.wait(Duration::from_secs(60));
    assert_eq!(ended.status.code(), Some(130), "{ended:?}");
    assert_eq!(listing(folder.path()), []);
}

#[test]
fn a_signal_takes_away_what_waits_for_a_slow_reader() {
    let folder = holod_tests::new_folder();
    let temporary = folder.path().join("temporary");
    fs::create_dir(&temporary).unwrap();
    // More than a pipe holds.
    let rows: String = (0..10_000).map(|row| format!("{},left,3.5,1,,1\n", row * 5_000_000_u64)).collect();
    fs::write(folder.path().join("log.csv"), format!("t_ns,eye,diameter_mm,confidence,aperture_mm,valid\n{rows}"))
        .unwrap();
    let mut holod = std::process::Command::new(HOLOD)
        .args(["log", "convert", "log.csv", "--to", "csv", "--out", "-"])
        .current_dir(folder.path())
        .env("TMPDIR", &temporary)
        .stdout(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    assert!(wait_until(Duration::from_secs(60), || !listing(&temporary).is_empty()));
    let holods_number = rustix::process::Pid::from_child(&holod);
    rustix::process::kill_process(holods_number, Signal::INT).unwrap();
    assert_eq!(holod.wait().unwrap().code(), Some(130));
    assert_eq!(listing(&temporary), []);
}

#[test]
fn no_command_overwrites_what_it_reads() {
    let folder = holod_tests::new_folder();
    let at = |name: &str| folder.path().join(name);
    fs::write(at("log.csv"), "time_s,diameter_mm\n0,3\n0.01,3\n").unwrap();
    fs::write(at("powers.csv"), "level,power\n0,1\n").unwrap();
    image::RgbImage::new(64, 64).save(at("colour.png")).unwrap();
    image::ImageBuffer::<image::Luma<u16>, _>::from_pixel(64, 64, image::Luma([500])).save(at("depth.png")).unwrap();
    fs::write(at("rig.toml"), small_rig(64, 64, "driver = \"simulated\"")).unwrap();
    let view = ["view", "--scene", "colour.png,depth.png", "--depth-encoding", "millimetres", "--config", "rig.toml"];
    let view = [&view[..], &["--pupil", "3", "--focus", "1", "--out", "./colour.png"]].concat();
    for (args, kept) in [
        (&["log", "info", "log.csv", "--plot", "log.csv"][..], "log.csv"),
        (&["log", "convert", "log.csv", "--to", "lines", "--out", "./log.csv"], "log.csv"),
        (&["lut", "powers.csv", "--out", "powers.csv"], "powers.csv"),
        (&view, "colour.png"),
    ] {
        let before = fs::read(at(kept)).unwrap();
        let ended = run(HOLOD, &[args, &["--force"]].concat(), folder.path());
        assert_eq!(ended.status.code(), Some(64), "{args:?}: {}", ended.stderr);
        assert!(
            ended.stderr.contains("this command reads") && ended.stderr.contains("another file"),
            "{}",
            ended.stderr
        );
        assert_eq!(fs::read(at(kept)).unwrap(), before, "{args:?}");
    }
}

#[test]
fn a_pipe_is_never_replaced_by_a_file() {
    let folder = holod_tests::new_folder();
    let pipe = folder.path().join("pipe");
    rustix::fs::mkfifoat(rustix::fs::CWD, &pipe, Mode::RUSR | Mode::WUSR).unwrap();
    fs::write(folder.path().join("log.csv"), "time_s,diameter_mm\n0,3\n0.01,3\n").unwrap();
    let view = ["view", "--pupil", "3", "--focus", "1", "--resolution", "64x64", "--out", "pipe"];
    let convert = ["log", "convert", "log.csv", "--to", "csv", "--out", "pipe"];
    for args in [&view[..], &convert, &["report", "--out", "pipe"], &["pattern", "level", "7", "--out", "pipe"]] {
        for force in [&[][..], &["--force"]] {
            let ended = run(HOLOD, &[args, force].concat(), folder.path());
            assert_eq!(ended.status.code(), Some(73), "{args:?}: {}", ended.stderr);
            assert!(ended.stderr.contains("a pipe"), "{args:?}: {}", ended.stderr);
            assert!(fs::metadata(&pipe).unwrap().file_type().is_fifo(), "{args:?}");
        }
    }
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 2, "nothing stays beside it");
}

#[test]
fn a_pipe_is_no_log() {
    let folder = holod_tests::new_folder();
    rustix::fs::mkfifoat(rustix::fs::CWD, folder.path().join("pipe"), Mode::RUSR | Mode::WUSR).unwrap();
    for args in [&["--tracker", "replay:pipe", "--resolution", "64x64"][..], &["log", "info", "pipe"]] {
        let ended = run(HOLOD, args, folder.path());
        assert!(ended.stderr.contains("a device or pipe"), "{args:?}: {ended:?}");
        assert!(!ended.status.success(), "{args:?}");
    }
}

#[test]
fn a_record_is_never_overwritten() {
    let folder = holod_tests::new_folder();
    fs::create_dir(folder.path().join("record")).unwrap();
    fs::write(folder.path().join("record/frames.csv"), "precious").unwrap();
    let ended = run(HOLOD, &["--record", "record", "--resolution", "64x64"], folder.path());
    assert_eq!(ended.status.code(), Some(73), "{}", ended.stderr);
    assert_eq!(fs::read_to_string(folder.path().join("record/frames.csv")).unwrap(), "precious");
}

#[test]
fn a_name_that_a_unit_cannot_have_is_refused() {
    let name = OsStr::from_bytes(b"/etc/rig-\xff.toml");
    let output = std::process::Command::new(HOLOD).args(["unit", "--config"]).arg(name).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(64), "{said}");
    assert!(said.contains("rig-\u{fffd}.toml, expected words in UTF-8"), "{said}");
}

//! What bad input gets: one clear error, the right exit code, and nothing half written.

use std::fs;
use std::path::Path;

use holod_tests::daemon::run;
use holod_tests::small_rig;
use image::{ImageBuffer, Luma, Rgb, RgbImage};

const HOLOD: &str = env!("CARGO_BIN_EXE_holod");

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
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    colour(&at("colour.png"), 64, 48);
    depth(&at("depth.png"), 64, 48);
    depth(&at("small.png"), 32, 24);
    fs::write(at("cut.exr"), [0x76, 0x2f, 0x31, 0x01, 2, 0, 0, 0, b'c', b'h']).unwrap();
    fs::write(at("text.png"), "this is no picture").unwrap();
    fs::create_dir(at("directory")).unwrap();
    fs::write(at("log.csv"), "when,how wide\n1,3.5\n2,3.6\n").unwrap();
    fs::write(at("empty.csv"), "").unwrap();
    let rig = small_rig(64, 64, "driver = \"simulated\"");
    let three = rig
        .replace("pixel_pitch_um = 8.0", "pixel_pitch_um = -8.0")
        .replace("refresh_hz = 60.0", "refesh_hz = 60.0")
        .replace("fallback_mm = 3.0", "fallback_mm = \"wide\"");
    fs::write(at("three.toml"), three).unwrap();
    fs::write(at("other_optics.toml"), rig.replace("pixel_pitch_um = 8.0", "pixel_pitch_um = 6.4")).unwrap();
    fs::write(at("junk.toml"), [0xff, 0xfe, 0x00]).unwrap();
    fs::write(at("weights.safetensors"), "no weights").unwrap();
    fs::write(at("bad_weights.toml"), format!("{rig}[model]\nweights_file = \"weights.safetensors\"\n")).unwrap();
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
        Case { args: &["render", "--pupil", "wide", "--out", "out"], exit: 64, says: &["wide", "--pupil"] },
        Case { args: &["render", "--pupil", "12", "--out", "out"], exit: 64, says: &["12"] },
        Case { args: &["render", "--pupil", "7", "--out", "out"], exit: 64, says: &["7", "trained"] },
        Case { args: &["render", "--pupil", "3", "--out", "colour.png"], exit: 73, says: &["colour.png", "file"] },
        Case {
            args: &["view", "--hologram", "directory", "--focus", "1", "--out", "v.png"],
            exit: 66,
            says: &["directory", "field.safetensors", "holod render"],
        },
        Case { args: &["view", "--focus", "1", "--out", "v.png"], exit: 64, says: &["--hologram", "--pupil"] },
        Case { args: &["check", "--config", "nowhere.toml"], exit: 78, says: &["nowhere.toml"] },
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
        Case { args: &["--config", "other_optics.toml"], exit: 78, says: &["pitch", "6.4", "8"] },
        Case { args: &["--config", "bad_weights.toml"], exit: 65, says: &["weights.safetensors"] },
        Case { args: &["--tracker", "/dev/nothing-here"], exit: 66, says: &["/dev/nothing-here", "does not exist"] },
        Case { args: &["--tracker", "directory"], exit: 66, says: &["directory"] },
        Case { args: &["--tracker", "log.csv"], exit: 65, says: &["log.csv", "when,how wide"] },
        Case { args: &["--tracker", "log.csv", "--record", "record"], exit: 65, says: &["log.csv"] },
        Case {
            args: &["view", "--pupil", "3", "--focus", "1", "--out", "directory"],
            exit: 73,
            says: &["directory", "PNG"],
        },
        Case { args: &["--tracker", "empty.csv"], exit: 65, says: &["empty.csv"] },
        Case { args: &["--tracker", "mock:nosuch"], exit: 64, says: &["nosuch", "light-steps"] },
        Case { args: &["--tracker", "hid:1234"], exit: 64, says: &["hid:1234", "VID:PID"] },
        Case { args: &["--tracker", "hid:1234:5678"], exit: 69, says: &["1234:5678", "profile="] },
        Case { args: &["--tracker", "tcp:127.0.0.1:1,profile=open-gaze"], exit: 69, says: &["127.0.0.1:1"] },
        Case { args: &["--tracker", "serial:/dev/null,profile=neon"], exit: 64, says: &["neon:HOST"] },
        Case { args: &["--tracker", "serial:/dev/null,profile=nosuch"], exit: 64, says: &["nosuch", "holod-hid"] },
        Case { args: &["--output", "window"], exit: 69, says: &["window", "headless"] },
        Case { args: &["--backend", "gpu"], exit: 69, says: &["gpu", "cpu"] },
        Case { args: &["--frames", "many"], exit: 64, says: &["many"] },
        Case { args: &["--no-such-option"], exit: 64, says: &["--no-such-option"] },
    ];
    for case in &cases {
        let ended = run(HOLOD, case.args, folder.path());
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
fn a_record_is_never_overwritten() {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir(folder.path().join("record")).unwrap();
    fs::write(folder.path().join("record/frames.csv"), "precious").unwrap();
    let ended = run(HOLOD, &["--record", "record", "--frames", "1"], folder.path());
    assert_eq!(ended.status.code(), Some(73), "{}", ended.stderr);
    assert_eq!(fs::read_to_string(folder.path().join("record/frames.csv")).unwrap(), "precious");
}

//! What `holod render` says of its scene, and where what it made can be looked at.

use std::ffi::OsStr;
use std::fs;
use std::os::unix::ffi::OsStrExt;
use std::path::Path;
use std::process::Command;

use holod_calibration::{Dioptres, PupilDiameter, Resolution};
use holod_model::LinearImage;
use holod_model::files::{BenchOptics, StoredHologram};
use holod_model::scene::FocalStack;
use holod_tests::daemon::run;
use holod_tests::small_rig;
use serde_json::Value;

use crate::HOLOD;

const SIZE: Resolution = Resolution { width: 40, height: 32 };

/// Writes `light.exr`, all 0.5 but for some pixels of 2 and some of -1, and `depth.png` of 500 mm to 1 m.
fn write_scene(folder: &Path, above_white_px: usize, below_black_px: usize) {
    let mut pixels = vec![0.5; 3 * SIZE.pixels()];
    pixels[..above_white_px].fill(2.0);
    pixels[above_white_px..][..below_black_px].fill(-1.0);
    let image = LinearImage { resolution: SIZE, pixels };
    let pupil = PupilDiameter::from_mm(3.0);
    FocalStack::save(&folder.join("stack"), &[image], &[Dioptres(1.0)], pupil).unwrap();
    fs::rename(folder.join("stack/focus-00.exr"), folder.join("light.exr")).unwrap();
    let (width, height) = (SIZE.width as u32, SIZE.height as u32);
    let depth_mm = |_, y| image::Luma([if y < height / 2 { 500_u16 } else { 1000 }]);
    image::ImageBuffer::from_fn(width, height, depth_mm).save(folder.join("depth.png")).unwrap();
}

#[test]
fn what_was_clipped_and_how_deep_the_scene_is_are_told_without_the_padding() {
    let folder = holod_tests::new_folder();
    write_scene(folder.path(), 9, 3);
    let args = ["render", "--scene", "light.exr,depth.png", "--depth-encoding", "millimetres", "--pupil", "3"];
    let args =
        [&args[..], &["--resolution", "48x48", "--weights", "fast", "--backend", "cpu", "--out", "out"]].concat();
    let ended = run(HOLOD, &args, folder.path());
    assert!(ended.status.success(), "{ended:?}");
    for said in ["depth 1.00 to 2.00 dpt;", "with colours clipped 12, padded 1024\n"] {
        assert!(ended.stdout.contains(said), "`{said}` is not in: {}", ended.stdout);
    }
    assert!(!ended.stderr.contains("brighter than white"), "12 of 1280 pixels are few: {}", ended.stderr);
    let report: Value = serde_json::from_slice(&fs::read(folder.path().join("out/report.json")).unwrap()).unwrap();
    assert_eq!((&report["colour_clipped_px"], &report["colour_above_white_px"]), (&12.into(), &9.into()));
    let range_dpt = ["depth_least_dpt", "depth_greatest_dpt"].map(|key| report[key].as_f64().unwrap());
    assert!((range_dpt[0] - 1.0).abs() < 1e-4 && (range_dpt[1] - 2.0).abs() < 1e-4, "{range_dpt:?}");

    let built_in = ["render", "--pupil", "3", "--resolution", "48x48", "--weights", "fast", "--backend", "cpu"];
    let ended = run(HOLOD, &[&built_in[..], &["--out", "built-in"]].concat(), folder.path());
    assert!(ended.stdout.contains("\ndepth 0.") && !ended.stdout.contains("depth 0.00 to 0.00"), "{}", ended.stdout);
    assert!(ended.stdout.contains(" dpt; its cards stand at 2.50 and 0.25 dpt; pixels filled"), "{}", ended.stdout);
    let report: Value = serde_json::from_slice(&fs::read(folder.path().join("built-in/report.json")).unwrap()).unwrap();
    assert_eq!((&report["weights"], &report["rig"]), (&"fast".into(), &"built-in bench".into()));
    assert_eq!((&report["rig_hash"], &report["phase_png_2pi"]), (&Value::Null, &65536.into()));

    fs::remove_dir_all(folder.path().join("stack")).unwrap();
    write_scene(folder.path(), 13, 14);
    let ended = run(HOLOD, &[&args[..], &["--force"]].concat(), folder.path());
    for said in ["13 of 1280 pixels are brighter than white", "14 of 1280 pixels have a colour below 0"] {
        assert!(ended.stderr.contains(said), "`{said}` is not in: {}", ended.stderr);
    }
}

#[test]
fn a_hologram_of_another_rig_is_looked_at_with_that_rig_only() {
    let folder = holod_tests::new_folder();
    for (name, width) in [("small.toml", 64), ("wide.toml", 96)] {
        fs::write(folder.path().join(name), small_rig(width, 64, "driver = \"simulated\"")).unwrap();
    }
    let render = ["render", "--config", "wide.toml", "--resolution", "96x48", "--pupil", "3", "--weights", "fast"];
    let ended = run(HOLOD, &[&render[..], &["--backend", "cpu", "--out", "wide"]].concat(), folder.path());
    assert!(ended.status.success(), "{ended:?}");
    let view = |rig| {
        let args = ["view", "--hologram", "wide", "--config", rig, "--focus", "1", "--out", "seen.png"];
        run(HOLOD, &args, folder.path())
    };
    let refused = view("small.toml");
    assert_eq!(refused.status.code(), Some(64));
    for said in ["--hologram wide: found a hologram of 96x48", "panel of 64x64", "by --config FILE"] {
        assert!(refused.stderr.contains(said), "`{said}` is not in: {}", refused.stderr);
    }
    let seen = view("wide.toml");
    assert!(seen.status.success(), "{seen:?}");

    // One that fits, but of other optics, says which.
    let other = fs::read_to_string(folder.path().join("wide.toml")).unwrap();
    assert!(other.contains("eyepiece_focal_length_mm = 40.0"), "{other}");
    let other = other.replace("eyepiece_focal_length_mm = 40.0", "eyepiece_focal_length_mm = 20.0");
    fs::write(folder.path().join("other.toml"), other).unwrap();
    let args = ["render", "--config", "other.toml", "--resolution", "48x48", "--pupil", "3", "--weights", "fast"];
    let ended = run(HOLOD, &[&args[..], &["--backend", "cpu", "--out", "other"]].concat(), folder.path());
    assert!(ended.status.success(), "{ended:?}");
    let view = |rig: &[&str]| {
        let args = ["view", "--hologram", "other", "--focus", "1", "--out", "seen.png", "--force"];
        run(HOLOD, &[&args[..], rig].concat(), folder.path())
    };
    let refused = view(&["--config", "wide.toml"]);
    assert_eq!(refused.status.code(), Some(64));
    for said in ["--hologram other: found a hologram for 8 µm, f = 20 mm, ", "this rig's 8 µm, f = 40 mm, ", "--config"]
    {
        assert!(refused.stderr.contains(said), "`{said}` is not in: {}", refused.stderr);
    }
    let seen = view(&["--config", "other.toml"]);
    assert!(seen.status.success() && !seen.stderr.contains("its own optics"), "{seen:?}");
    let warned = view(&[]);
    assert!(warned.status.success(), "{warned:?}");
    assert!(warned.stderr.contains("its own optics, 8 µm, f = 20 mm, "), "{}", warned.stderr);
}

#[test]
fn a_hologram_of_another_rig_of_the_same_optics_is_looked_at_with_a_warning() {
    let folder = holod_tests::new_folder();
    let rig = small_rig(64, 64, "driver = \"simulated\"");
    let turned = rig.replace("phase_sign = \"positive\"", "phase_sign = \"negative\"");
    assert_ne!(turned, rig);
    fs::write(folder.path().join("other.toml"), rig).unwrap();
    fs::write(folder.path().join("turned.toml"), turned).unwrap();
    let render = |out, rig: &[&str]| {
        let args = ["render", "--resolution", "48x48", "--pupil", "3", "--weights", "fast", "--backend", "cpu"];
        let ended = run(HOLOD, &[&args[..], &["--out", out], rig].concat(), folder.path());
        assert!(ended.status.success(), "{ended:?}");
    };
    let turned = ["--config", "turned.toml"];
    render("turned", &turned);
    render("built-in", &[]);
    let view = |hologram, rig: &[&str]| {
        let args = ["view", "--hologram", hologram, "--focus", "1", "--out", "seen.png", "--force"];
        let ended = run(HOLOD, &[&args[..], rig].concat(), folder.path());
        assert!(ended.status.success(), "{ended:?}");
        ended.stderr
    };
    let report: Value = serde_json::from_slice(&fs::read(folder.path().join("turned/report.json")).unwrap()).unwrap();
    let hash = report["rig_hash"].as_str().unwrap();
    for (hologram, rig, says) in [
        ("turned", &turned[..], None),
        ("built-in", &[], None),
        ("turned", &[], Some(["panel and lasers of the built-in rig", "by --config FILE"])),
        ("turned", &["--config", "other.toml"], Some(["panel and lasers of the rig file of hash", "by --config FILE"])),
        ("built-in", &turned, Some(["made with the built-in rig", "leave --config out"])),
    ] {
        let said = view(hologram, rig);
        match says {
            None => assert!(!said.contains("it was made with"), "{said}"),
            Some(says) => assert!(says.iter().all(|words| said.contains(words)), "{says:?} in {said}"),
        }
        let names_the_hash = said.contains(&format!("made with the rig file of hash {hash}"));
        assert_eq!(names_the_hash, hologram == "turned" && says.is_some(), "{said}");
    }
}

#[test]
fn a_hologram_for_what_no_bench_has_is_refused() {
    let folder = holod_tests::new_folder();
    let args = ["render", "--resolution", "48x48", "--pupil", "3", "--weights", "fast", "--backend", "cpu"];
    let ended = run(HOLOD, &[&args[..], &["--out", "made"]].concat(), folder.path());
    assert!(ended.status.success(), "{ended:?}");
    let path = folder.path().join("made/field.safetensors");
    let whole = StoredHologram::load(&path).unwrap();
    let view = |stored: StoredHologram| {
        stored.save(&path).unwrap();
        let args = ["view", "--hologram", "made", "--focus", "20", "--out", "seen.png", "--force"];
        run(HOLOD, &args, folder.path())
    };
    let optics = BenchOptics { eyepiece_focal_length_mm: -40.0, ..whole.optics.clone() };
    let refused = view(StoredHologram { optics, ..whole.clone() });
    assert_eq!(refused.status.code(), Some(65), "{refused:?}");
    for said in ["field.safetensors: -40 in `eyepiece_focal_length_mm`", "expected a number from 5 to 500 mm"] {
        assert!(refused.stderr.contains(said), "`{said}` is not in: {}", refused.stderr);
    }
    let refused = view(StoredHologram { amplitude_constant: 1e-42, ..whole.clone() });
    assert_eq!(refused.status.code(), Some(65), "{refused:?}");
    assert!(refused.stderr.contains("`amplitude_constant`") && !refused.stderr.contains("panicked"), "{refused:?}");
    assert!(view(whole).status.success());
}

#[test]
fn colours_that_a_monochrome_panel_never_shows_are_black() {
    let folder = holod_tests::new_folder();
    let rig = small_rig(64, 64, "driver = \"simulated\"");
    let mode = rig.lines().find(|line| line.starts_with("mode = ")).expect("the rig has a mode").to_owned();
    fs::write(folder.path().join("rig.toml"), rig.replace(&mode, "mode = \"monochrome\"\ncolour = \"green\"")).unwrap();
    let args = ["view", "--config", "rig.toml", "--pupil", "3", "--resolution", "48x48", "--weights", "fast"];
    let args = [&args[..], &["--backend", "cpu", "--focus", "1", "--out", "seen.png"]].concat();
    let ended = run(HOLOD, &args, folder.path());
    assert!(ended.status.success(), "{ended:?}");
    let seen = image::open(folder.path().join("seen.png")).unwrap().into_rgb8();
    let brightest = seen.pixels().fold([0; 3], |most, pixel| std::array::from_fn(|c| pixel.0[c].max(most[c])));
    assert!(brightest[0] == 0 && brightest[1] > 100 && brightest[2] == 0, "{brightest:?}");
}

#[test]
fn a_pupil_that_is_refused_is_not_said_to_be_shown_worse() {
    let folder = holod_tests::new_folder();
    // On this bench the weights know pupils of up to 3.76 mm.
    let bench = concat!(env!("CARGO_MANIFEST_DIR"), "/../model/training/benches/gaea-40.toml");
    let shared = ["--config", bench, "--weights", "fast", "--backend", "cpu", "--resolution", "48x48"];
    let named = run(HOLOD, &[&["render", "--pupil", "4", "--out", "out"], &shared[..]].concat(), folder.path());
    assert_eq!(named.status.code(), Some(64), "{named:?}");
    assert!(named.stderr.contains("--pupil: found 4 mm"), "{}", named.stderr);
    let any = ["run", "--tracker", "mock:steady", "--output", "headless", "--frames", "2"];
    let any = run(HOLOD, &[&any[..], &shared].concat(), folder.path());
    assert!(any.status.success(), "{any:?}");
    let worse = |stderr: &str| stderr.contains("the picture is worse");
    assert!(!worse(&named.stderr) && worse(&any.stderr), "{} {}", named.stderr, any.stderr);
}

#[test]
fn what_a_colour_without_light_loses_is_not_told() {
    let folder = holod_tests::new_folder();
    let rig = small_rig(96, 64, "driver = \"simulated\"").replace("red = 1.9921875", "red = 0.8");
    let only_green = rig.replace("mode = \"channel-packed\"", "mode = \"monochrome\"\ncolour = \"green\"");
    let args = ["render", "--config", "rig.toml", "--pupil", "3", "--weights", "fast", "--backend", "cpu"];
    let args = [&args[..], &["--out", "out", "--force", "--json"]].concat();
    let loop_args = ["run", "--config", "rig.toml", "--pupil", "3", "--weights", "fast", "--backend", "cpu"];
    let loop_args = [&loop_args[..], &["--output", "headless", "--frames", "2", "--json"]].concat();
    for (text, is_told) in [(&rig, true), (&only_green, false)] {
        fs::write(folder.path().join("rig.toml"), text).unwrap();
        let ended = run(HOLOD, &args, folder.path());
        assert!(ended.status.success(), "{ended:?}");
        let report: Value = serde_json::from_str(&ended.stdout).unwrap();
        assert_eq!(report["unreachable_share"].as_f64().unwrap() > 0.01, is_told, "{report}");
        assert_eq!(ended.stderr.contains("red: the panel's stroke is 0.800 π"), is_told, "{}", ended.stderr);
        let ended = run(HOLOD, &loop_args, folder.path());
        assert!(ended.status.success(), "{ended:?}");
        let summary: Value = serde_json::from_str(&ended.stdout).unwrap();
        assert_eq!(summary["unreachable_share_max"].as_f64().unwrap() > 0.01, is_told, "{summary}");
        assert_eq!(ended.stderr.contains("red: the panel's stroke is 0.800 π"), is_told, "{}", ended.stderr);
    }
}

#[test]
fn view_says_what_it_cannot_show_or_take() {
    let folder = holod_tests::new_folder();
    let dark = small_rig(96, 64, "driver = \"simulated\"").replace("= 1.0", "= 0.0");
    fs::write(folder.path().join("dark.toml"), dark).unwrap();
    let view = ["view", "--pupil", "3", "--focus", "1", "--weights", "fast", "--backend", "cpu", "--out", "seen.png"];
    let ended = run(HOLOD, &[&view[..], &["--config", "dark.toml"]].concat(), folder.path());
    assert!(ended.status.success() && ended.stderr.contains("the picture is black: the rig lights no"), "{ended:?}");

    fs::create_dir(folder.path().join("r1")).unwrap();
    fs::write(folder.path().join("r1/field.safetensors"), "").unwrap();
    let args = ["view", "--hologram", "r1/field.safetensors", "--focus", "1", "--out", "other.png"];
    let refused = run(HOLOD, &args, folder.path());
    assert_eq!(refused.status.code(), Some(66));
    assert!(refused.stderr.contains("found a file, expected the folder"), "{}", refused.stderr);
    assert!(refused.stderr.contains("name the folder, such as r1"), "{}", refused.stderr);
}

#[test]
fn view_prints_json_of_a_name_that_is_no_text() {
    let folder = holod_tests::new_folder();
    let args = ["view", "--pupil", "3", "--focus", "1", "--weights", "fast", "--backend", "cpu"];
    let ended = Command::new(HOLOD)
        .args([&args[..], &["--resolution", "48x48", "--json", "--out"]].concat())
        .arg(OsStr::from_bytes(b"m\xfcller.png"))
        .current_dir(folder.path())
        .output()
        .unwrap();
    assert!(ended.status.success(), "{ended:?}");
    let report: Value = serde_json::from_slice(&ended.stdout).unwrap();
    assert_eq!(report["out"], "m\u{fffd}ller.png");
}

//! `holod render --focal-stack`: the hologram of a folder of images, and what is said of others.

use std::fs;
use std::path::{Path, PathBuf};

use holod_calibration::{DisplayGeometry, PupilDiameter, Resolution};
use holod_model::engine::{FocalStackEngine, Precision};
use holod_model::files::StoredHologram;
use holod_model::scene::{Fit, FocalStack, FocalStackFiles};
use holod_model::{ComplexHologram, LinearImage, Weights};
use holod_scenes::sample_scene;
use holod_tests::daemon::run;
use holod_tests::worst;
use serde_json::Value;

use crate::HOLOD;

const SIZE: Resolution = Resolution { width: 48, height: 32 };
const BENCH: DisplayGeometry = DisplayGeometry::DEFAULT;
const PLANES: usize = 3;

/// Random weights for stacks of three images.
fn weights() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../model/golden/focal-stack-narrow.weights.safetensors")
}

/// What a pupil of 2.5 mm sees of the built-in scene at `count` focuses, in a new folder `name`.
fn write_stack(folder: &Path, name: &str, count: usize) {
    let focuses: Vec<_> = (0..count).map(|plane| BENCH.depth_at(plane as f64 / (count - 1) as f64)).collect();
    let pupil = PupilDiameter::from_mm(2.5);
    let pixels = sample_scene(SIZE).focal_stack(pupil, &focuses, 8);
    let images = pixels.chunks_exact(3 * SIZE.pixels());
    let images: Vec<_> = images.map(|pixels| LinearImage { resolution: SIZE, pixels: pixels.to_vec() }).collect();
    FocalStack::save(&folder.join(name), &images, &focuses, pupil).unwrap();
}

#[test]
fn a_folder_of_images_becomes_the_hologram_that_the_engine_makes_of_it() {
    let folder = holod_tests::new_folder();
    write_stack(folder.path(), "stack", PLANES);
    let weights = weights();
    let weights_path = weights.to_str().unwrap();
    let args = ["render", "--focal-stack", "stack", "--weights", weights_path, "--backend", "cpu", "--out", "hologram"];
    let ended = run(HOLOD, &[&args[..], &["--json"]].concat(), folder.path());
    assert!(ended.status.success(), "{ended:?}");
    let report: Value = serde_json::from_str(&ended.stdout).unwrap();
    assert_eq!((&report["width_px"], &report["height_px"], &report["pupil_mm"]), (&48.into(), &32.into(), &2.5.into()));
    assert_eq!(report["focus_dpt"].as_array().unwrap().len(), PLANES);
    let written = fs::read(folder.path().join("hologram/report.json")).unwrap();
    assert_eq!(serde_json::from_slice::<Value>(&written).unwrap()["focal_stack"], "stack");

    let (stack, _) = FocalStackFiles::open(&folder.path().join("stack")).unwrap().load(None, Fit::Native).unwrap();
    let mut expected = ComplexHologram::dark(SIZE);
    FocalStackEngine::new(&Weights::load(&weights).unwrap(), &BENCH, SIZE, Precision::Single)
        .unwrap()
        .render(&stack, &mut expected)
        .unwrap();
    let stored = StoredHologram::load(&folder.path().join("hologram/field.safetensors")).unwrap();
    assert_eq!((stored.pupil.mm(), stored.hologram.field.len()), (2.5, expected.field.len()));
    let apart = |expected: &ComplexHologram| {
        worst(stored.hologram.field.iter().zip(&expected.field).map(|(a, b)| (a - b).norm()))
    };
    assert!(apart(&expected) < 1e-5, "{}", apart(&expected));
    expected.field.swap(100, 700);
    assert!(apart(&expected) > 1e-3, "the comparison is blind");

    assert!(!ended.stderr.contains("were clipped"), "{}", ended.stderr);
    // The same weights with a constant above which most amplitudes are.
    let mut bytes = fs::read(&weights).unwrap();
    let key = br#"amplitude_constant\": "#;
    let at = bytes.windows(key.len()).position(|window| window == key).unwrap() + key.len();
    bytes[at..][..3].copy_from_slice(b"0.1");
    let loud = folder.path().join("loud.safetensors");
    fs::write(&loud, bytes).unwrap();
    let args = ["render", "--focal-stack", "stack", "--weights", "loud.safetensors", "--out", "loud"];
    let ended = run(HOLOD, &args, folder.path());
    assert!(ended.status.success(), "{ended:?}");
    assert!(ended.stderr.contains("amplitude_constant of the weights, and were clipped"), "{}", ended.stderr);

    let seen = run(HOLOD, &["view", "--hologram", "hologram", "--focus", "2.5", "--out", "seen"], folder.path());
    assert!(seen.status.success(), "{seen:?}");
    let told = run(HOLOD, &[&args[..], &["--force", "--resolution", "64x40"]].concat(), folder.path());
    assert!(told.status.success(), "{told:?}");
    for words in ["hologram of 64x40 from 3 images for a pupil of 2.5 mm", "0.00 to 2.86 dpt", "padded 1024"] {
        assert!(told.stdout.contains(words), "no '{words}' in {}", told.stdout);
    }
}

#[test]
fn other_stacks_weights_and_options_are_refused_in_words_and_nothing_is_left() {
    let folder = holod_tests::new_folder();
    let at = |name: &str| folder.path().join(name);
    write_stack(folder.path(), "stack", PLANES);
    write_stack(folder.path(), "two", 2);
    write_stack(folder.path(), "wide", PLANES);
    write_stack(folder.path(), "cut", PLANES);
    fs::create_dir(at("empty")).unwrap();
    let text = fs::read_to_string(at("wide/stack.toml")).unwrap();
    fs::write(at("wide/stack.toml"), text.replace("pupil_mm = 2.5", "pupil_mm = 12")).unwrap();
    let image = fs::read(at("cut/focus-01.exr")).unwrap();
    fs::write(at("cut/focus-01.exr"), &image[..image.len() / 2]).unwrap();
    let weights = weights();
    let cases: [(&[&str], i32, &[&str]); 12] = [
        (&["--focal-stack", "two"], 65, &["two/stack.toml", "found 2 images", "takes 3 images", "1.429"]),
        (&["--focal-stack", "empty"], 66, &["empty/stack.toml", "names images and focuses"]),
        (&["--focal-stack", "cut"], 65, &["cut/focus-01.exr"]),
        (&["--focal-stack", "wide"], 65, &["wide/stack.toml: `pupil_mm`: found 12 mm", "trained"]),
        (&["--focal-stack", "stack", "--weights", "fast"], 78, &["`expected-stack` network", "not a focal stack"]),
        (&["--focal-stack", "stack", "--backend", "gpu"], 64, &["--backend", "processor alone", "`cpu`"]),
        (&["--focal-stack", "stack", "--pupil", "3"], 64, &["--focal-stack", "--pupil"]),
        (&["--focal-stack", "stack", "--scene", "stack"], 64, &["--focal-stack", "--scene"]),
        (&["--focal-stack", "stack", "--resolution", "40x32"], 64, &["48x32", "a fit to 40x32", "crop"]),
        (&["--focal-stack", "stack", "--resolution", "4000x32"], 64, &["4000x32", "larger than the panel"]),
        (&["--pupil", "3"], 78, &["`focal-stack` network", "--focal-stack"]),
        (&["--pupil", "3", "--backend", "cpu"], 78, &["`focal-stack` network", "--focal-stack"]),
    ];
    let names = || {
        let mut names: Vec<_> = fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
        names.sort();
        names
    };
    let before = names();
    for (args, exit, says) in cases {
        let focal: &[&str] = if args.contains(&"--weights") { &[] } else { &["--weights", weights.to_str().unwrap()] };
        let ended = run(HOLOD, &[&["render", "--out", "out"], args, focal].concat(), folder.path());
        let what = format!("holod render {}\n{}", args.join(" "), ended.stderr);
        assert_eq!(ended.status.code(), Some(exit), "{what}");
        for words in says {
            assert!(ended.stderr.contains(words), "no '{words}' in: {what}");
        }
        assert!(!ended.stderr.contains("panicked") && ended.stdout.is_empty(), "{what}");
        assert_eq!(names(), before, "something was left behind by {what}");
    }
    let checked = run(HOLOD, &["check", "--weights", weights.to_str().unwrap()], folder.path());
    assert!(!checked.status.success() && checked.stdout.contains("it takes focal stacks"), "{checked:?}");
}

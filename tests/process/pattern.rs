//! `holod pattern` as a process: the bytes that would travel to the panel, what is to be seen, and the pattern on a
//! panel with its lasers.

use std::fs;
use std::path::Path;

use holod_tests::daemon::{Ended, run};
use holod_tests::small_rig;
use image::RgbImage;

use crate::HOLOD;

fn pattern(folder: &Path, rig: &str, args: &str) -> Ended {
    fs::write(folder.join("rig.toml"), rig).unwrap();
    let args: Vec<&str> = ["pattern"].into_iter().chain(args.split_whitespace()).collect();
    run(HOLOD, &[&args[..], &["--config", "rig.toml"]].concat(), folder)
}

fn rig() -> String {
    small_rig(96, 64, "driver = \"simulated\"")
}

fn picture(path: &Path) -> RgbImage {
    image::open(path).unwrap().into_rgb8()
}

#[test]
fn a_picture_holds_the_bytes_that_travel_to_the_panel() {
    let folder = holod_tests::new_folder();
    let ended = pattern(folder.path(), &rig(), "level 37 --colour green --out level.png");
    assert!(ended.status.success(), "{}", ended.stderr);
    let level = picture(&folder.path().join("level.png"));
    assert_eq!(level.dimensions(), (96, 64));
    // Green is the first field, which the red channel carries.
    assert!(level.pixels().all(|pixel| pixel.0 == [37, 0, 0]));

    let sequential = rig().replace("channel-packed", "field-sequential").replace("bit_depth = 8", "bit_depth = 10");
    let sequential = sequential.replace("phase_sign", "packing = \"red8-blue2\"\nphase_sign");
    let ended = pattern(folder.path(), &sequential, "level 1021 --colour red,blue --out field.png --json");
    assert!(ended.status.success(), "{}", ended.stderr);
    let said: serde_json::Value = serde_json::from_str(&ended.stdout).unwrap();
    assert_eq!(said["files"], serde_json::json!(["field-1-green.png", "field-2-red.png", "field-3-blue.png"]));
    for (file, expected) in [("1-green", [0, 0, 0]), ("2-red", [255, 0, 1]), ("3-blue", [255, 0, 1])] {
        let field = picture(&folder.path().join(format!("field-{file}.png")));
        assert!(field.pixels().all(|pixel| pixel.0 == expected), "{file}");
    }

    let monochrome = rig().replace("\"channel-packed\"", "\"monochrome\"\ncolour = \"blue\"");
    let ended = pattern(folder.path(), &monochrome, "grating --period 8 --out lines.png");
    assert!(ended.status.success(), "{}", ended.stderr);
    let lines = picture(&folder.path().join("lines.png"));
    for (x, _, pixel) in lines.enumerate_pixels() {
        // A line begins in the panel's middle, between two pixels: a pixel is 32 levels.
        let expected = x as usize % 8 * 32 + 16;
        assert!(pixel.0.iter().all(|&channel| usize::from(channel).abs_diff(expected) <= 1), "{x}: {pixel:?}");
    }
    assert!(ended.stdout.contains("blue") && !ended.stdout.contains("\n  red "), "{}", ended.stdout);
}

#[test]
fn a_picture_has_what_the_video_has_around_the_panel() {
    let folder = holod_tests::new_folder();
    let wide = rig().replace("phase_sign", "video_width_px = 104\nvideo_left_px = 3\nvideo_height_px = 66\nphase_sign");
    let ended = pattern(folder.path(), &wide, "level 37 --out level.png");
    assert!(ended.status.success(), "{}", ended.stderr);
    let level = picture(&folder.path().join("level.png"));
    assert_eq!(level.dimensions(), (104, 66));
    for (x, y, pixel) in level.enumerate_pixels() {
        let is_panel = (3..99).contains(&x) && y < 64;
        assert_eq!(pixel.0, [if is_panel { 37 } else { 0 }; 3], "{x},{y}");
    }
}

#[test]
fn a_short_stroke_is_warned_of_and_counts_in_the_shares() {
    let folder = holod_tests::new_folder();
    let first = |rig: &str| {
        let ended = pattern(folder.path(), rig, "grating --period 8 --colour red --json");
        assert!(ended.status.success(), "{}", ended.stderr);
        assert_eq!(ended.stderr.contains("stroke"), rig.contains("1.4,"), "{}", ended.stderr);
        let said: serde_json::Value = serde_json::from_str(&ended.stdout).unwrap();
        said["spots"][0]["share"].as_f64().unwrap()
    };
    let whole = first(&rig());
    let short = first(&rig().replace("1.9921875", "1.4"));
    // sinc²(1/8), of which the gap of 0.6 π leaves 0.924.
    assert!((whole - 0.9496).abs() < 1e-3 && (short - 0.924 * 0.9496).abs() < 4e-3, "{whole} {short}");
}

#[test]
fn a_colour_that_the_panel_never_shows_is_refused() {
    let folder = holod_tests::new_folder();
    let monochrome = rig().replace("\"channel-packed\"", "\"monochrome\"\ncolour = \"green\"");
    let ended = pattern(folder.path(), &monochrome, "level 200 --colour red --out x.png");
    assert_eq!(ended.status.code(), Some(64), "{}", ended.stderr);
    assert!(ended.stderr.contains("the panel shows green alone"), "{}", ended.stderr);
    assert!(!folder.path().join("x.png").exists());
}

#[test]
fn a_pattern_on_a_panel_is_lit_by_each_fields_own_laser_or_stays_dark() {
    let folder = holod_tests::new_folder();
    let lit = pattern(folder.path(), &rig(), "field-identity --output headless --duration 1500ms");
    assert!(lit.status.success(), "{}", lit.stderr);
    for colour in ["red", "green", "blue"] {
        let line = lit.stdout.lines().find(|line| line.starts_with(&format!("{colour}: ")) && line.contains("fields"));
        let count: Vec<u64> =
            line.unwrap().split(|c: char| !c.is_ascii_digit()).filter_map(|n| n.parse().ok()).collect();
        assert!(count[1] > 20 && count[1] <= count[0], "{line:?}");
    }
    assert!(lit.stdout.contains("lasers dark at the end: true; flat pattern on the panel: true"), "{}", lit.stdout);

    let green = pattern(folder.path(), &rig(), "level 40 --colour green --output headless --duration 1s");
    assert!(green.status.success(), "{}", green.stderr);
    assert!(green.stdout.contains("- --output shows it with no light of red and blue"), "{}", green.stdout);
    assert_eq!(green.stdout.matches(" fields, its laser without power").count(), 2, "{}", green.stdout);
    assert_eq!(green.stdout.matches(" of them lit").count(), 1, "{}", green.stdout);

    let json = pattern(folder.path(), &rig(), "field-identity --output headless --duration 500ms --json");
    let said: serde_json::Value = serde_json::from_str(&json.stdout).unwrap_or_else(|why| panic!("{why}: {json:?}"));
    assert!(said["pattern"].is_string() && said["shown"]["lasers_dark"] == true, "{said}");
    assert!(said["shown"]["lit"]["green"].as_u64().is_some_and(|lit| lit > 0), "{said}");
    let dark = pattern(folder.path(), &rig(), "field-identity --output headless --duration 500ms --dark");
    assert!(dark.status.success(), "{}", dark.stderr);
    assert_eq!(dark.stdout.matches(" fields, 0 of them lit").count(), 3, "{}", dark.stdout);
    assert!(dark.stdout.contains("not lit, last: asked"), "{}", dark.stdout);
}

#[test]
fn what_cannot_be_drawn_or_written_is_said_and_nothing_is_left_behind() {
    let folder = holod_tests::new_folder();
    fs::create_dir(folder.path().join("folder.png")).unwrap();
    for (args, exit, says) in [
        ("level 256 --out x.png", 64, "0 to 255"),
        ("lens --focal-length 0.1 --out x.png", 64, "mm at least in red"),
        ("grating --period 97 --out x.png", 64, "2 to 96 px"),
        ("field-identity --radius 0.6 --out x.png", 64, "0.563 mm"),
        ("dots --out folder.png", 73, "expected the name of a PNG file"),
        ("dots --spacing 30 --dot 12 --out nowhere/x.png", 73, "nowhere"),
        ("dots --spacing 30 --dot 12 --output screen --out x.png", 64, "screen"),
    ] {
        let ended = pattern(folder.path(), &rig(), args);
        assert_eq!(ended.status.code(), Some(exit), "{args}: {}", ended.stderr);
        assert!(ended.stderr.contains(says), "{args}: {}", ended.stderr);
    }
    let mut left: Vec<_> = fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    left.sort();
    assert_eq!(left, ["folder.png", "rig.toml"]);
}

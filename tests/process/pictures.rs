//! The closed loop judged by what an eye sees of the levels that the panel really showed.

use std::fs;
use std::path::Path;

use holod_calibration::rig::Rig;
use holod_calibration::{Colour, Dioptres, PupilDiameter, Resolution};
use holod_model::optics::{Eye, PhasePattern, SimulatedEye};
use holod_model::{LinearImage, Weights};
use holod_pupil_input::SampleEye;
use holod_pupil_input::wire::line::{LineSample, encode_line};
use holod_slm_output::PanelEncoder;
use holod_tests::daemon::run;
use holod_tests::{frames, small_rig};

use crate::HOLOD;

const SIZE: Resolution = Resolution { width: 256, height: 256 };
const NEAR: Dioptres = Dioptres(2.5);
const FAR: Dioptres = Dioptres(0.25);

/// A log of a pupil that stays for a while at each diameter and moves between them as fast as a pupil can.
fn staircase_log(steps_mm: &[f32]) -> String {
    let mut text = String::from("# a staircase\n");
    let mut diameter_mm = steps_mm[0];
    let mut sequence = 0;
    for &step_mm in steps_mm {
        for _ in 0..500 {
            diameter_mm += (step_mm - diameter_mm).clamp(-0.02, 0.02);
            let line = LineSample {
                sequence,
                device_us: sequence as i64 * 5_000,
                eye: SampleEye::Left,
                diameter_mm,
                confidence: 1.0,
            };
            encode_line(&line, &mut text);
            sequence += 1;
        }
    }
    text
}

#[test]
fn what_the_buffers_have_already_is_not_computed_again() {
    let folder = holod_tests::new_folder();
    let rig = format!("{}[model]\nnetwork = \"fast\"\n", small_rig(64, 64, "driver = \"simulated\""));
    fs::write(folder.path().join("rig.toml"), rig).unwrap();
    let record = |name: &str, more: &[&str]| {
        let args = ["--config", "rig.toml", "--resolution", "64x64", "--frames", "60", "--json", "--record", name];
        let ended = run(HOLOD, &[&args[..], more].concat(), folder.path());
        assert!(ended.status.success(), "{}", ended.stderr);
        let summary: serde_json::Value = serde_json::from_str(&ended.stdout).unwrap();
        let rows = frames::read(&folder.path().join(name).join("frames.csv")).unwrap();
        let mut levels: Vec<_> = rows.iter().map(|row| row.levels_xxh3.clone()).collect();
        levels.sort();
        levels.dedup();
        assert!(!levels.contains(&String::new()));
        let mut computed: Vec<_> = rows.iter().filter(|row| row.computed).map(|row| row.frame).collect();
        computed.dedup();
        let shown_of = (1..=summary["frames_computed"].as_u64().unwrap()).contains(&(computed.len() as u64));
        assert!(shown_of, "{computed:?}: {summary:#}");
        assert_eq!((&summary["frames_made"], &summary["lasers"]["unsafe_findings"]), (&60.into(), &0.into()));
        (summary, levels)
    };
    let (still, levels) = record("still", &["--pupil", "3"]);
    assert_eq!(levels.len(), 1);
    // Three buffers go round, and one that the panel has.
    assert!((1..=4).contains(&still["frames_computed"].as_u64().unwrap()), "{still:#}");
    assert_eq!(still["frame_time"]["values"], still["frames_computed"]);
    assert_eq!(still["frames_by_pupil_state"]["fixed"], 60);
    assert!(still["frames_shown"].as_u64().unwrap() > 30, "{still:#}");

    // A report of it is shown again with the same levels.
    let packed = run(HOLOD, &["report", "still", "--out", "report.tar.gz"], folder.path());
    assert!(packed.status.success(), "{}", packed.stderr);
    let again = run(HOLOD, &["--tracker", "replay:report.tar.gz", "--json"], folder.path());
    assert!(again.status.success(), "{}", again.stderr);
    let again: serde_json::Value = serde_json::from_str(&again.stdout).unwrap();
    assert_eq!((&again["report"]["frames_different"], &again["report"]["fields_different"]), (&0.into(), &0.into()));
    assert_eq!(again["report"]["frames_same"], again["report"]["frames_recorded"]);

    // Of a sequence and of a pupil that moves there is something new each time.
    fs::create_dir(folder.path().join("sequence")).unwrap();
    for frame in 0..4_u8 {
        let colour = image::RgbImage::from_pixel(64, 64, image::Rgb([60 * frame; 3]));
        colour.save(folder.path().join(format!("sequence/colour{frame}.png"))).unwrap();
    }
    let depth = image::ImageBuffer::from_fn(64, 64, |x, _| image::Luma([500_u16 + 10 * x as u16]));
    depth.save(folder.path().join("sequence/depth.png")).unwrap();
    // At half the panel's rate, too, all four come.
    let scene = "colour = \"colour{}.png\"\ndepth = \"depth.png\"\ndepth_encoding = \"millimetres\"\nfps = 50.0\n\
                 count = 4\n";
    fs::write(folder.path().join("sequence/scene.toml"), scene).unwrap();
    let (sequence, levels) = record("moving", &["--pupil", "3", "--scene", "sequence"]);
    assert_eq!(levels.len(), 4);
    assert!(sequence["frames_computed"].as_u64().unwrap() > 40, "{sequence:#}");
}

/// Brightness of the two cards' halves, 8 bits.
const LIGHT: u8 = 220;
const DARK: u8 = 60;

/// Writes a scene as files: a near card on the left and a far card on the right, each with an upright edge between a
/// dark and a light half in its middle.
fn write_cards(folder: &Path, rig: &Rig) {
    let (width, height) = (SIZE.width as u32, SIZE.height as u32);
    let is_near = |x: u32| x < width / 2;
    let colour = image::RgbImage::from_fn(width, height, |x, _| {
        let light = (x / (width / 4)) % 2 == 1;
        image::Rgb([if light { LIGHT } else { DARK }; 3])
    });
    colour.save(folder.join("cards.png")).unwrap();
    let stored = |depth: Dioptres| (rig.geometry.normalised_depth(depth) * 65535.0).round() as u16;
    let depth = image::ImageBuffer::<image::Luma<u16>, _>::from_fn(width, height, |x, _| {
        image::Luma([stored(if is_near(x) { NEAR } else { FAR })])
    });
    depth.save(folder.join("depth.png")).unwrap();
}

/// How blurred the upright edge at column `edge` is, in pixels: the area between the mean row profile and an ideal
/// step, over the step's height. A uniform blur of diameter c gives about c/4.
fn edge_blur_px(picture: &LinearImage, edge: usize) -> f64 {
    let linear = |encoded: u8| ((f64::from(encoded) / 255.0 + 0.055) / 1.055).powf(2.4);
    let (dark, light) = (linear(DARK), linear(LIGHT));
    let rows = 32..SIZE.height - 32;
    let plane = picture.plane(Colour::Green);
    let mean = |x: usize| rows.clone().map(|y| f64::from(plane[y * SIZE.width + x])).sum::<f64>() / rows.len() as f64;
    let reach = 24;
    let area = |x: usize| (mean(x) - if x < edge { dark } else { light }).abs();
    (edge - reach..edge + reach).map(area).sum::<f64>() / (light - dark)
}

#[test]
fn the_recorded_panel_levels_blur_with_the_pupil_and_keep_what_is_in_focus() {
    let folder = holod_tests::new_folder();
    let at = |name: &str| folder.path().join(name);
    let rig_text = small_rig(SIZE.width, SIZE.height, "driver = \"simulated\"");
    let rig = Rig::parse(&rig_text, Path::new("rig.toml")).unwrap();
    write_cards(folder.path(), &rig);
    fs::write(at("rig.toml"), &rig_text).unwrap();
    fs::write(at("pupil.log"), staircase_log(&[2.2, 3.2, 4.2])).unwrap();
    let args = [
        "--config",
        "rig.toml",
        "--tracker",
        "pupil.log",
        "--record",
        "record",
        "--scene",
        "cards.png,depth.png",
        "--depth-encoding",
        "normalised_dioptres:0,2.857142857142857",
    ];
    let ended = run(HOLOD, &args, folder.path());
    assert!(ended.status.success(), "{}", ended.stderr);

    let encoder = PanelEncoder::new(&rig.panel, SIZE, SIZE).unwrap();
    let constant = Weights::builtin().config().amplitude_constant;
    let mut eye = SimulatedEye::new(&rig.geometry, SIZE);
    let (near_edge, far_edge) = (SIZE.width / 4, 3 * SIZE.width / 4);
    let mut seen = Vec::new();
    for (pupil, pattern) in shown(&at("record"), &encoder) {
        let mut blur_px =
            |focus: Dioptres, edge| edge_blur_px(&eye.view(&pattern, constant, Eye { pupil, focus }), edge);
        seen.push(Seen {
            pupil,
            near: Blur { focused_px: blur_px(NEAR, near_edge), defocused_px: blur_px(FAR, near_edge) },
            far: Blur { focused_px: blur_px(FAR, far_edge), defocused_px: blur_px(NEAR, far_edge) },
        });
    }
    assert!(seen.len() >= 3 && seen[seen.len() - 1].pupil.mm() - seen[0].pupil.mm() > 1.5, "{seen:#?}");
    assert_eq!(faults(&seen), Vec::<String>::new(), "{seen:#?}");

    let mut reversed = seen.clone();
    for one in &mut reversed {
        std::mem::swap(&mut one.near.focused_px, &mut one.near.defocused_px);
    }
    assert!(!faults(&reversed).is_empty(), "the judge objects to a near edge in reverse");
    let mut lost = seen.clone();
    let last = lost.len() - 1;
    lost[last].far.focused_px = 0.76 * lost[last].far.defocused_px;
    assert!(!faults(&lost).is_empty(), "the judge objects to a far edge that is lost in focus");
    let same: Vec<Seen> = seen.iter().map(|one| Seen { pupil: one.pupil, ..seen[0] }).collect();
    assert!(!faults(&same).is_empty(), "the judge objects to a display that ignores the pupil");
}

/// What an eye sees of both edges.
#[derive(Clone, Copy, Debug)]
struct Seen {
    pupil: PupilDiameter,
    near: Blur,
    far: Blur,
}

/// The blur of one edge, in focus and out of it.
#[derive(Clone, Copy, Debug)]
struct Blur {
    focused_px: f64,
    defocused_px: f64,
}

/// An edge in focus may gain at most this share of the blur that it would have out of focus, from the narrowest to the
/// widest pupil. A network that showed one blurred picture at every depth would gain all of it.
const FOCUSED_GAIN_SHARE: f64 = 0.4;

/// Frames whose pupils differ by less are not compared.
const SAME_PUPIL_MM: f32 = 0.15;

/// What is wrong with a series of ever wider pupils.
fn faults(series: &[Seen]) -> Vec<String> {
    let mut found = Vec::new();
    for (name, edge) in [("near", (|seen| seen.near) as fn(&Seen) -> Blur), ("far", |seen| seen.far)] {
        for seen in series {
            let Blur { focused_px, defocused_px } = edge(seen);
            if defocused_px < 1.3 * focused_px {
                let mm = seen.pupil.mm();
                found.push(format!(
                    "{mm} mm: the {name} edge is blurred by {focused_px} px in focus, {defocused_px} out"
                ));
            }
        }
        for pair in series.windows(2) {
            if pair[1].pupil.mm() - pair[0].pupil.mm() < SAME_PUPIL_MM {
                continue;
            }
            let (before_px, after_px) = (edge(&pair[0]).defocused_px, edge(&pair[1]).defocused_px);
            if after_px <= before_px {
                let mm = pair.iter().map(|seen| seen.pupil.mm()).collect::<Vec<_>>();
                found.push(format!(
                    "{mm:?} mm: the {name} edge out of focus gets no blurrier: {before_px} {after_px} px"
                ));
            }
        }
        let (first, last) = (edge(&series[0]), edge(&series[series.len() - 1]));
        if last.focused_px > first.focused_px + FOCUSED_GAIN_SHARE * last.defocused_px {
            found.push(format!("the {name} edge in focus loses its sharpness: {first:?} {last:?}"));
        }
    }
    found
}

/// The patterns that the record keeps, with the pupils in their names.
fn shown(record: &Path, encoder: &PanelEncoder) -> Vec<(PupilDiameter, PhasePattern)> {
    let mut patterns = Vec::new();
    for entry in fs::read_dir(record).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_str().unwrap().to_owned();
        let Some(rest) = name.strip_prefix("shown_pupil_") else { continue };
        let pupil = PupilDiameter::from_mm(rest.split("mm").next().unwrap().parse().unwrap());
        let levels = image::open(&path).unwrap().to_rgb8();
        let mut pattern = PhasePattern::flat(SIZE);
        for colour in Colour::ALL {
            let channel: Vec<u16> = levels.pixels().map(|pixel| u16::from(pixel.0[colour.index()])).collect();
            pattern.plane_mut(colour).copy_from_slice(&encoder.decode_pattern(colour, &channel));
        }
        patterns.push((pupil, pattern));
    }
    patterns.sort_by(|(a, _), (b, _)| a.mm().total_cmp(&b.mm()));
    patterns
}

//! The closed loop judged by what an eye sees of the levels that the panel really showed.

use std::fs;
use std::path::Path;

use holod_calibration::rig::Rig;
use holod_calibration::{Colour, Dioptres, PupilDiameter, Resolution};
use holod_daemon::pictures::Area;
use holod_model::optics::{Eye, PhasePattern, SimulatedEye};
use holod_model::{LinearImage, Weights, metrics, scene_renderer};
use holod_pupil_input::SampleEye;
use holod_pupil_input::wire::line::{LineSample, encode_line};
use holod_slm_output::PanelEncoder;
use holod_tests::daemon::run;
use holod_tests::small_rig;

const HOLOD: &str = env!("CARGO_BIN_EXE_holod");
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

/// Writes the refocus cards as files of a scene: an 8-bit picture and depth in dioptres.
fn write_cards(folder: &Path) -> Vec<f32> {
    let picture = scene_renderer::Scene::cards(true, SIZE).picture();
    let pixels = SIZE.pixels();
    let image = LinearImage { resolution: SIZE, pixels: picture.image };
    let colour = image::RgbImage::from_raw(SIZE.width as u32, SIZE.height as u32, image.to_srgb8()).unwrap();
    colour.save(folder.join("cards.png")).unwrap();
    let depth: Vec<u16> = picture.depth.iter().map(|depth| (depth * 65535.0).round() as u16).collect();
    let depth =
        image::ImageBuffer::<image::Luma<u16>, _>::from_raw(SIZE.width as u32, SIZE.height as u32, depth).unwrap();
    depth.save(folder.join("depth.png")).unwrap();
    assert_eq!(picture.depth.len(), pixels);
    picture.depth
}

#[test]
fn the_recorded_panel_levels_blur_with_the_pupil_and_keep_what_is_in_focus() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let depth = write_cards(folder.path());
    let rig_text = small_rig(SIZE.width, SIZE.height, "driver = \"simulated\"");
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

    let rig = Rig::parse(&rig_text, Path::new("rig.toml")).unwrap();
    let encoder = PanelEncoder::new(&rig.panel, SIZE, SIZE).unwrap();
    let constant = Weights::builtin().config().amplitude_constant;
    let mut eye = SimulatedEye::new(&rig.geometry, SIZE);
    let card = |at| Area::at_depth(&depth, SIZE, &rig.geometry, at, 16).expect("the cards are in the picture");
    let (near_card, far_card) = (card(NEAR), card(FAR));
    let mut seen = Vec::new();
    for (pupil, pattern) in shown(&at("record"), &encoder) {
        let mut energy = |focus: Dioptres, card: &Area| {
            let picture = eye.view(&pattern, constant, Eye { pupil, focus });
            metrics::gradient_energy(&picture, card.columns.clone(), card.rows.clone())
        };
        seen.push(Seen {
            pupil,
            near_sharp: energy(NEAR, &near_card),
            near_blurred: energy(FAR, &near_card),
            far_sharp: energy(FAR, &far_card),
            far_blurred: energy(NEAR, &far_card),
        });
    }
    for wanted_mm in [2.2, 3.2, 4.2] {
        assert!(seen.iter().any(|s| (s.pupil.mm() - wanted_mm).abs() < 0.1), "no frame for {wanted_mm} mm: {seen:?}");
    }
    let at_steps: Vec<&Seen> =
        [2.2, 3.2, 4.2].iter().map(|mm| seen.iter().find(|s| (s.pupil.mm() - mm).abs() < 0.1).unwrap()).collect();
    assert_eq!(faults(&at_steps), Vec::<String>::new(), "{seen:#?}");

    let swapped: Vec<Seen> = at_steps
        .iter()
        .map(|s| Seen { near_sharp: s.near_blurred, near_blurred: s.near_sharp, ..(*s).clone() })
        .collect();
    assert!(!faults(&swapped.iter().collect::<Vec<_>>()).is_empty(), "the judge objects to a near card in reverse");
    let same: Vec<&Seen> = vec![at_steps[0]; 3];
    assert!(!faults(&same).is_empty(), "the judge objects to a display that ignores the pupil");
}

#[derive(Clone, Debug)]
struct Seen {
    pupil: PupilDiameter,
    near_sharp: f64,
    near_blurred: f64,
    far_sharp: f64,
    far_blurred: f64,
}

/// What is wrong with a series of ever wider pupils.
fn faults(series: &[&Seen]) -> Vec<String> {
    let mut found = Vec::new();
    for seen in series {
        let mm = seen.pupil.mm();
        for (name, sharp, blurred) in
            [("near", seen.near_sharp, seen.near_blurred), ("far", seen.far_sharp, seen.far_blurred)]
        {
            if sharp < 1.3 * blurred {
                found.push(format!("{mm} mm: the {name} card is only {:.2} times sharper in focus", sharp / blurred));
            }
        }
    }
    for pair in series.windows(2) {
        let (narrow, wide) = (pair[0], pair[1]);
        for (name, before, after) in
            [("near", narrow.near_blurred, wide.near_blurred), ("far", narrow.far_blurred, wide.far_blurred)]
        {
            if after >= before {
                found.push(format!(
                    "from {} to {} mm the {name} card out of focus gets no blurrier: {before:.6} {after:.6}",
                    narrow.pupil.mm(),
                    wide.pupil.mm()
                ));
            }
        }
    }
    let (first, last) = (series[0], series[series.len() - 1]);
    for (name, before, after) in [("near", first.near_sharp, last.near_sharp), ("far", first.far_sharp, last.far_sharp)]
    {
        if after < 0.5 * before {
            found.push(format!("the {name} card in focus loses its sharpness: {before:.6} {after:.6}"));
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

//! `holod evaluate` against what the trainer's evaluation finds on the same scene, and what it says and writes.

use std::fs;
use std::path::{Path, PathBuf};

use holod_calibration::{Dioptres, DisplayGeometry, PupilDiameter, Resolution};
use holod_model::scene_renderer::SceneKind;
use holod_model::scene_renderer::shard::{PlanePlan, PupilPlan, ShardPlan, file_name};
use holod_tests::daemon::run;
use serde_json::Value;

use crate::HOLOD;

const SIZE: Resolution = Resolution { width: 64, height: 48 };

/// How far the two evaluations may be apart.
const TOLERANCES: [(&str, f64); 9] = [
    ("psnr_db", 0.05),
    ("psnr_in_focus_db", 0.05),
    ("psnr_out_of_focus_db", 0.05),
    ("flat_oracle_psnr_db", 0.05),
    ("slope", 0.005),
    ("correlation", 0.005),
    ("ssim", 0.005),
    ("foam", 0.000_02),
    ("clipped_share", 0.0002),
];
/// Largest relative difference of a refocus ratio.
const REFOCUS_TOLERANCE: f64 = 0.02;

fn model() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../model")
}

/// A safetensors file's header, and where its tensors begin.
fn header(bytes: &[u8]) -> (Value, usize) {
    let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    (serde_json::from_slice(&bytes[8..8 + length]).unwrap(), 8 + length)
}

/// A JSON value in the metadata of a shard.
fn entry(bytes: &[u8], key: &str) -> Value {
    serde_json::from_str(header(bytes).0["__metadata__"][key].as_str().unwrap()).unwrap()
}

/// Evaluates the golden scene whose file is `bytes`, as scene and as cards, with the weights and border that it names.
fn evaluated(bytes: &[u8]) -> Value {
    let folder = holod_tests::new_folder();
    fs::write(folder.path().join(file_name(0)), bytes).unwrap();
    let weights = model().join("weights").join(entry(bytes, "weights").as_str().unwrap());
    let border_px = entry(bytes, "border_px").to_string();
    let args = ["evaluate", "--scenes", ".", "--cards", ".", "--border-px", &border_px, "--json", "--backend", "cpu"];
    let args = [&args[..], &["--weights", weights.to_str().unwrap()]].concat();
    let ended = run(HOLOD, &args, folder.path());
    assert!(ended.status.success(), "{ended:?}");
    serde_json::from_str(&ended.stdout).unwrap()
}

/// Every figure in which `evaluated` is not what the trainer `found`.
fn disagreements(evaluated: &Value, found: &Value) -> Vec<String> {
    let mut wrong = Vec::new();
    let mut compare = |what: String, ours: &Value, theirs: &Value, tolerance: f64| {
        let (ours, theirs) = (ours.as_f64().unwrap_or(f64::NAN), theirs.as_f64().unwrap());
        let difference = (ours - theirs).abs();
        if difference.is_nan() || difference > tolerance {
            wrong.push(format!("{what}: {ours} for {theirs}"));
        }
    };
    let rows = found["rows"].as_array().unwrap();
    for (number, theirs) in rows.iter().enumerate() {
        let pupil = &theirs["pupil_mm"];
        let (ours, refocus) = (&evaluated["rows"][number], &evaluated["refocus"][number]);
        compare(format!("pupil of row {number}"), &ours["pupil_mm"], pupil, 0.0);
        for (figure, tolerance) in TOLERANCES {
            compare(format!("{figure} at {pupil} mm"), &ours[figure]["mean"], &theirs[figure], tolerance);
        }
        for card in ["near_card", "far_card"] {
            let tolerance = REFOCUS_TOLERANCE * theirs[card].as_f64().unwrap();
            compare(format!("{card} at {pupil} mm"), &refocus[card], &theirs[card], tolerance);
        }
        for column in 0..rows.len() {
            let (ours, theirs) = (&evaluated["matrix"]["psnr_db"], &found["matrix_psnr_db"]);
            let what = format!("matrix [{number}][{column}]");
            compare(what, &ours[number][column], &theirs[number][column], 0.05);
        }
    }
    wrong
}

#[test]
fn the_trainers_evaluation_finds_the_same() {
    let golden = fs::read(model().join("golden/evaluation.safetensors")).unwrap();
    let found = entry(&golden, "found");
    let ours = evaluated(&golden);
    assert_eq!(disagreements(&ours, &found), Vec::<String>::new());
    assert_eq!(ours["refocus"][0]["contrast"], "dark on bright");

    // Every figure counts: one that is 0.06 dB, 0.006 or 2.5 % off is seen, and it alone.
    for row in 0..2 {
        for (figure, tolerance) in TOLERANCES.into_iter().chain([("near_card", 0.0), ("far_card", 0.0)]) {
            let mut spoiled = found.clone();
            let value = spoiled["rows"][row][figure].as_f64().unwrap();
            spoiled["rows"][row][figure] =
                (value * 1.025f64.powf(f64::from(tolerance == 0.0)) + 1.2 * tolerance).into();
            let wrong = disagreements(&ours, &spoiled);
            assert!(matches!(wrong.as_slice(), [one] if one.starts_with(figure)), "{figure}: {wrong:?}");
        }
    }

    // A scene whose red and blue are swapped is another scene.
    let (header, start) = header(&golden);
    let offset = |end: usize| start + header["image"]["data_offsets"][end].as_u64().unwrap() as usize;
    let mut swapped = golden;
    let image = &mut swapped[offset(0)..offset(1)];
    let plane = image.len() / 3;
    let (red, rest) = image.split_at_mut(plane);
    red.swap_with_slice(&mut rest[plane..]);
    let wrong = disagreements(&evaluated(&swapped), &found);
    assert!(wrong.iter().any(|what| what.starts_with("psnr_db at 2")), "{wrong:?}");
}

/// Renders `count` scenes of `kind` into `folder`.
fn render(folder: &Path, kind: SceneKind, resolution: Resolution, count: u64) {
    render_for(DisplayGeometry::DEFAULT, folder, kind, resolution, count);
}

/// The same for a bench.
fn render_for(bench: DisplayGeometry, folder: &Path, kind: SceneKind, resolution: Resolution, count: u64) {
    let plan = ShardPlan {
        kind,
        seed: 11,
        resolution,
        bench,
        pupils: PupilPlan::Fixed([2.0, 4.0].map(PupilDiameter::from_mm).to_vec()),
        planes: PlanePlan::Uniform(2),
        rays: 8,
    };
    for index in 0..count {
        plan.write(folder, index, &holod_model::scene_renderer::Tracer::cpu()).unwrap();
    }
}

fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> =
        fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    names
}

#[test]
fn scenes_of_the_renderer_are_judged_told_and_written() {
    let folder = holod_tests::new_folder();
    render(&folder.path().join("scenes"), SceneKind::Test, SIZE, 2);
    let common = ["evaluate", "--scenes", "scenes", "--border-px", "8"];
    let with = |more: &[&str]| {
        let ended = run(HOLOD, &[&common[..], more].concat(), folder.path());
        assert!(ended.status.success(), "{ended:?}");
        ended.stdout
    };

    let printed: Value = serde_json::from_str(&with(&["--json", "--out", "judged"])).unwrap();
    assert_eq!(names(folder.path()), ["judged", "scenes"]);
    assert_eq!(names(&folder.path().join("judged")), ["evaluation.json", "sheet.png"]);
    let written = fs::read(folder.path().join("judged/evaluation.json")).unwrap();
    assert_eq!(serde_json::from_slice::<Value>(&written).unwrap(), printed);
    let sheet = image::open(folder.path().join("judged/sheet.png")).unwrap();
    assert!(sheet.width() as usize > 4 * SIZE.width && sheet.height() as usize > 4 * SIZE.height);

    assert_eq!((&printed["scenes"], &printed["width_px"], &printed["height_px"]), (&2.into(), &64.into(), &48.into()));
    assert_eq!((&printed["panel_bit_depth"], &printed["border_px"]), (&8.into(), &8.into()));
    let rows = printed["rows"].as_array().unwrap();
    assert_eq!(rows.iter().map(|row| row["pupil_mm"].as_f64().unwrap()).collect::<Vec<_>>(), [2.0, 4.0]);
    for (number, row) in rows.iter().enumerate() {
        let mean = |figure: &str| row[figure]["mean"].as_f64().unwrap_or_else(|| panic!("{figure}: {row}"));
        assert!(
            (15.0..50.0).contains(&mean("psnr_db")) && (15.0..60.0).contains(&mean("flat_oracle_psnr_db")),
            "{row}"
        );
        assert!(row["psnr_db"]["ci95_half_width"].as_f64().unwrap() > 0.0, "{row}");
        assert!(mean("ssim") > 0.2 && mean("slope").is_finite() && mean("correlation").abs() <= 1.0, "{row}");
        let own = printed["matrix"]["psnr_db"][number][number].as_f64().unwrap();
        assert!((own - mean("psnr_db")).abs() < 1e-9, "the matrix' diagonal is the row's own PSNR");
    }
    assert_eq!(printed["refocus"], Value::Array(Vec::new()));

    let one: Value = serde_json::from_str(&with(&["--json", "--limit", "1", "--pupil", "4", "--pupil", "4"])).unwrap();
    assert_eq!((one["rows"].as_array().unwrap().len(), &one["rows"][0]["pupil_mm"]), (1, &4.0.into()));
    assert_eq!((&one["scenes"], &one["rows"][0]["psnr_db"]["ci95_half_width"]), (&1.into(), &Value::Null));

    let told = with(&["--limit", "1"]);
    for words in ["1 scenes of 64x48", "8-bit levels", "in focus", "foam", "flat oracle", "seen by another"] {
        assert!(told.contains(words), "no '{words}' in {told}");
    }
}

/// What the trainer finds with the weights `fast` on the scenes of [`render`], 256x256 pixels: all light over what was
/// put in, and mean light of what is black. To have it again: `holod-scenes generate --kind marks --seed 11 --count 3
/// --size 256 --pupils 2,4 --planes 2 --rays 8`, then `python -m holod_training evaluate --marks` on these.
const LIGHT_OF_MARKS: [(&str, f64, f64, f64); 6] = [
    ("dots", 2.0, 0.9988, 0.000_002_129),
    ("dots", 4.0, 0.9227, 0.000_002_882),
    ("lines", 2.0, 1.0192, 0.000_009_382),
    ("lines", 4.0, 0.9599, 0.000_005_525),
    ("stars", 2.0, 0.9727, 0.000_001_125),
    ("stars", 4.0, 0.9374, 0.000_002_453),
];

/// How far the light on black may be off, of white's: phases of which some fall on the next level.
const DARK_OFF: f64 = 2e-7;

/// Every figure of `rows` that is more than 1 % off what was `found`, or of something else; on black it may be off by
/// [`DARK_OFF`].
fn wrong_light(rows: &Value, found: &[(&str, f64, f64, f64)]) -> Vec<String> {
    let rows = rows.as_array().unwrap();
    assert_eq!(rows.len(), found.len());
    let mut wrong = Vec::new();
    for (row, (marks, pupil_mm, light_ratio, dark_mean)) in rows.iter().zip(found) {
        if row["marks"] != *marks || row["pupil_mm"] != *pupil_mm || row["scenes"] != 1 {
            wrong.push(format!("{row} for {marks} at {pupil_mm} mm"));
        }
        for (figure, found, off) in [("light_ratio", light_ratio, 0.0), ("dark_mean", dark_mean, DARK_OFF)] {
            let ours = row[figure].as_f64().unwrap();
            let is_near = (ours - found).abs() < (0.01 * found).max(off);
            if !is_near {
                wrong.push(format!("{figure} of {marks} at {pupil_mm} mm: {ours} for {found}"));
            }
        }
    }
    wrong
}

#[test]
fn the_trainer_finds_as_much_light_of_bright_marks_on_black() {
    let folder = holod_tests::new_folder();
    render(&folder.path().join("scenes"), SceneKind::Test, SIZE, 1);
    render(&folder.path().join("marks"), SceneKind::Marks, Resolution { width: 256, height: 256 }, 3);
    let evaluate = |more: &[&str]| {
        let args = [
            "evaluate",
            "--scenes",
            "scenes",
            "--marks",
            "marks",
            "--border-px",
            "8",
            "--weights",
            "fast",
            "--backend",
            "cpu",
        ];
        let ended = run(HOLOD, &[&args[..], more].concat(), folder.path());
        assert!(ended.status.success(), "{ended:?}");
        ended.stdout
    };
    let printed: Value = serde_json::from_str(&evaluate(&["--json", "--out", "judged"])).unwrap();
    let rows = &printed["marks"];
    assert_eq!(wrong_light(rows, &LIGHT_OF_MARKS), Vec::<String>::new());
    for row in 0..LIGHT_OF_MARKS.len() {
        let mut spoilt = LIGHT_OF_MARKS;
        spoilt[row].2 *= 1.02;
        assert_eq!(wrong_light(rows, &spoilt).len(), 1);
        (spoilt[row].2, spoilt[row].3) = (LIGHT_OF_MARKS[row].2, LIGHT_OF_MARKS[row].3 - 2.0 * DARK_OFF);
        assert_eq!(wrong_light(rows, &spoilt).len(), 1);
    }
    let sheet = image::open(folder.path().join("judged/sheet.png")).unwrap();
    assert!(sheet.height() > 3 * 2 * 256, "each kind of marks is on the sheet, for both pupils");
    let told = evaluate(&["--pupil", "4"]);
    for words in ["bright marks on exact black", "dots", "lines", "stars"] {
        assert!(told.contains(words), "no '{words}' in {told}");
    }
}

/// Cards stand at the same place of every bench's depth range: here at 1.81 and 0.63 dpt.
#[test]
fn cards_are_judged_on_a_bench_with_another_depth_range() {
    const CARDS: Resolution = Resolution { width: 128, height: 128 };
    let folder = holod_tests::new_folder();
    let bench = DisplayGeometry { depth_far: Dioptres(0.5), depth_near: Dioptres(2.0), ..DisplayGeometry::DEFAULT };
    render_for(bench, &folder.path().join("scenes"), SceneKind::Test, CARDS, 1);
    render_for(bench, &folder.path().join("cards"), SceneKind::Cards, CARDS, 2);
    let rig = holod_tests::small_rig(CARDS.width, CARDS.height, "driver = \"simulated\"")
        .replace("depth_far_m = inf", "depth_far_m = 2.0")
        .replace("depth_near_m = 0.35", "depth_near_m = 0.5");
    fs::write(folder.path().join("rig.toml"), rig).unwrap();
    let args = ["evaluate", "--config", "rig.toml", "--scenes", "scenes", "--cards", "cards", "--weights", "fast"];
    let ended = run(HOLOD, &[&args[..], &["--border-px", "8", "--backend", "cpu", "--json"]].concat(), folder.path());
    assert!(ended.status.success(), "{ended:?}");
    let judged: Value = serde_json::from_str(&ended.stdout).unwrap();
    let rows = judged["refocus"].as_array().unwrap();
    assert_eq!(rows.len(), 4, "two cards and two pupils");
    for card in ["near_card", "far_card"] {
        assert!(rows.iter().all(|row| row[card].as_f64().unwrap() > 1.1), "{rows:?}");
    }
}

#[test]
fn each_bad_folder_gets_a_clear_error_and_leaves_nothing_behind() {
    let folder = holod_tests::new_folder();
    let at = |name: &str| folder.path().join(name);
    render(&at("scenes"), SceneKind::Test, SIZE, 1);
    render(&at("small"), SceneKind::Marks, SIZE, 1);
    render(&at("learned"), SceneKind::Train, SIZE, 1);
    fs::create_dir(at("empty")).unwrap();
    fs::create_dir(at("cut")).unwrap();
    let whole = fs::read(at("scenes").join(file_name(0))).unwrap();
    fs::write(at("cut").join(file_name(3)), &whole[..whole.len() / 2]).unwrap();
    fs::write(at("file"), "").unwrap();
    let cases: [(&[&str], i32, &[&str]); 14] = [
        (&["--scenes", "nowhere"], 66, &["nowhere", "holod-scenes"]),
        (&["--scenes", "empty"], 66, &["empty", "scene_*.safetensors", "holod-scenes generate"]),
        (&["--scenes", "cut"], 65, &["cut/scene_000003.safetensors", "bytes", "holod-scenes generate"]),
        (&["--scenes", "scenes", "--pupil", "3"], 65, &["scene_000000", "[2.0, 4.0] mm", "3 mm", "--pupil"]),
        (&["--scenes", "scenes", "--border-px", "30"], 64, &["--border-px", "30", "at most 18", "64x48"]),
        (
            &["--scenes", "scenes", "--border-px", "8", "--cards", "scenes"],
            65,
            &["scene_000000", "card", "--kind cards"],
        ),
        (
            &["--scenes", "scenes", "--border-px", "8", "--marks", "scenes"],
            65,
            &["scene_000000", "kind `test`", "--kind marks"],
        ),
        (
            &["--scenes", "scenes", "--border-px", "8", "--marks", "small"],
            65,
            &["scene_000000", "no mark in 64x48", "96x120", "--kind marks"],
        ),
        (&["--scenes", "learned"], 65, &["scene_000000", "`kind` is `train`", "held-out", "--kind test"]),
        (&["--scenes", "scenes", "--cards", "learned"], 65, &["scene_000000", "`kind` is `train`", "held-out"]),
        (&["--scenes", "small"], 65, &["scene_000000", "`kind` is `marks`", "--kind test", "with --marks"]),
        (&["--scenes", "scenes", "--limit", "0"], 64, &["--limit", "0"]),
        (&["--scenes", "scenes", "--weights", "file"], 65, &["file"]),
        (&["--border-px", "8"], 64, &["--scenes"]),
    ];
    let before = names(folder.path());
    for (args, exit, says) in cases {
        let ended = run(HOLOD, &[&["evaluate"], args, &["--out", "out"]].concat(), folder.path());
        let what = format!("holod evaluate {}\n{}", args.join(" "), ended.stderr);
        assert_eq!(ended.status.code(), Some(exit), "{what}");
        for words in says {
            assert!(ended.stderr.contains(words), "no '{words}' in: {what}");
        }
        assert!(!ended.stderr.contains("panicked") && ended.stdout.is_empty(), "{what}");
        assert_eq!(names(folder.path()), before, "something was left behind by {what}");
    }
}

//! `holod evaluate` against what the trainer's evaluation finds on the same scene, and what it says and writes.

use std::fs;
use std::path::{Path, PathBuf};

use holod_calibration::rig::Rig;
use holod_calibration::{Dioptres, DisplayGeometry, PupilDiameter, Resolution};
use holod_model::scene_shard::SceneKind;
use holod_scenes::shard::{PlanePlan, PupilPlan, ShardPlan, file_name};
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

/// The shard `bytes` with other entries in its metadata.
fn with_entries(bytes: &[u8], entries: &[(&str, &str)]) -> Vec<u8> {
    let (mut changed, start) = header(bytes);
    for (key, value) in entries {
        changed["__metadata__"][key] = (*value).into();
    }
    let mut text = serde_json::to_vec(&changed).unwrap();
    text.resize(text.len().next_multiple_of(8), b' ');
    [&(text.len() as u64).to_le_bytes()[..], &text, &bytes[start..]].concat()
}

/// Writes a shard as the only one of a new folder.
fn write_alone(folder: PathBuf, bytes: &[u8]) {
    fs::create_dir(&folder).unwrap();
    fs::write(folder.join(file_name(0)), bytes).unwrap();
}

/// Evaluates the golden scene whose file is `bytes`, as scene and as cards, with the weights and border that it names,
/// on the built-in rig or on that of `more`.
fn evaluated_with(bytes: &[u8], more: &[&str]) -> Value {
    let folder = holod_tests::new_folder();
    write_alone(folder.path().join("scenes"), bytes);
    write_alone(folder.path().join("cards"), &with_entries(bytes, &[("kind", "cards")]));
    let weights = model().join("weights").join(entry(bytes, "weights").as_str().unwrap());
    let border_px = entry(bytes, "border_px").to_string();
    let args = ["evaluate", "--scenes", "scenes", "--cards", "cards", "--border-px", &border_px, "--backend", "cpu"];
    let args = [&args[..], &["--json", "--weights", weights.to_str().unwrap()], more].concat();
    let ended = run(HOLOD, &args, folder.path());
    assert!(ended.status.success(), "{ended:?}");
    serde_json::from_str(&ended.stdout).unwrap()
}

fn evaluated(bytes: &[u8]) -> Value {
    evaluated_with(bytes, &[])
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

/// The built-in rig with each colour's laser at so many milliwatts.
fn rig_with_powers(powers_mw: [f64; 3]) -> String {
    let rig = Rig::BUILT_IN_TOML;
    let line = rig.lines().find(|line| line.starts_with("power_mw")).expect("the rig has powers");
    let [red, green, blue] = powers_mw;
    rig.replace(line, &format!("power_mw = {{ red = {red:?}, green = {green:?}, blue = {blue:?} }}"))
}

#[test]
fn colours_without_light_are_not_judged() {
    let golden = fs::read(model().join("golden/evaluation.safetensors")).unwrap();
    let folder = holod_tests::new_folder();
    let rig = folder.path().join("rig.toml");
    let on_rig = |powers_mw, bytes: &[u8]| {
        fs::write(&rig, rig_with_powers(powers_mw)).unwrap();
        evaluated_with(bytes, &["--config", rig.to_str().unwrap()])
    };
    let all = evaluated(&golden);
    assert_eq!(all["colours"], serde_json::json!(["red", "green", "blue"]));
    let figures = |of: &Value| -> Vec<f64> {
        let row = &of["rows"][0];
        ["psnr_db", "ssim", "foam", "flat_oracle_psnr_db", "clipped_share"]
            .map(|figure| row[figure]["mean"].as_f64().unwrap())
            .to_vec()
    };
    let alone = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(|powers_mw| on_rig(powers_mw, &golden));
    for (judged, name) in alone.iter().zip(["red", "green", "blue"]) {
        assert_eq!(judged["colours"], serde_json::json!([name]));
        // What is black would cost more than 10 dB.
        let psnr_db = figures(judged)[0];
        assert!((psnr_db - figures(&all)[0]).abs() < 5.0, "{name}: {psnr_db} dB");
        for (row, of_all) in judged["refocus"].as_array().unwrap().iter().zip(all["refocus"].as_array().unwrap()) {
            let [near, of_all] = [row, of_all].map(|row| row["near_card"].as_f64().unwrap());
            assert!(near > 1.0 && (near / of_all).ln().abs() < 1.0, "{name}: {near} beside {of_all}");
        }
    }
    // Over all colours each of these figures is the mean of the three, PSNR that of the squared errors.
    let mean = |of: &dyn Fn(&Value) -> f64| alone.iter().map(of).sum::<f64>() / 3.0;
    for (number, figure) in figures(&all).into_iter().enumerate() {
        let is_db = [0, 3].contains(&number);
        let of_three = match is_db {
            true => -10.0 * mean(&|judged| 10f64.powf(-0.1 * figures(judged)[number])).log10(),
            false => mean(&|judged| figures(judged)[number]),
        };
        assert!((of_three - figure).abs() < 1e-4 * figure.abs().max(1e-3), "figure {number}: {of_three} for {figure}");
    }
    let dark = folder.path().join("scenes");
    write_alone(dark, &golden);
    fs::write(&rig, rig_with_powers([0.0; 3])).unwrap();
    let ended = run(HOLOD, &["evaluate", "--config", "rig.toml", "--scenes", "scenes"], folder.path());
    assert_eq!(ended.status.code(), Some(78), "{ended:?}");
    for words in ["no colour that the panel shows and the lasers light", "lasers.power_mw"] {
        assert!(ended.stderr.contains(words), "no '{words}' in {}", ended.stderr);
    }
}

#[test]
fn an_evaluation_says_what_computed_it_and_of_which_scenes() {
    let golden = fs::read(model().join("golden/evaluation.safetensors")).unwrap();
    let folder = holod_tests::new_folder();
    let rig = folder.path().join("rig.toml");
    fs::write(&rig, rig_with_powers([1.0; 3])).unwrap();
    let file = evaluated_with(&golden, &["--config", rig.to_str().unwrap()]);
    assert!(file["engine"].as_str().unwrap().starts_with("cpu, "), "{}", file["engine"]);
    assert_eq!(file["weights"], entry(&golden, "weights"));
    let hashes = ["weights_xxh3", "rig_hash"].map(|key| file[key].as_str().unwrap().to_owned());
    assert!(hashes.iter().all(|hash| hash.len() == 16), "{hashes:?}");
    let checked = run(HOLOD, &["check", "--config", "rig.toml"], folder.path());
    assert!(checked.stdout.contains(&hashes[1]), "{} is not in {}", hashes[1], checked.stdout);
    assert_eq!(file["rig_tables_xxh3"], serde_json::json!({}));
    let set = |kind: &str| serde_json::json!([{ "kind": kind, "seed": entry(&golden, "seed"), "indices": [0] }]);
    assert_eq!([&file["scene_sets"], &file["card_sets"]], [&set("test"), &set("cards")]);
    assert_eq!(file["mark_sets"], serde_json::json!([]));
}

/// Renders `count` scenes of `kind` into `folder`.
pub(crate) fn render(folder: &Path, kind: SceneKind, resolution: Resolution, count: u64) {
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
        plan.write(folder, index, &holod_scenes::Tracer::cpu()).unwrap();
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
    assert_eq!((&printed["weights"], &printed["weights_xxh3"]), (&"standard".into(), &Value::Null));
    assert_eq!((&printed["rig"], &printed["rig_hash"]), (&"built-in bench".into(), &Value::Null));
    assert_eq!(printed["scene_sets"], serde_json::json!([{ "kind": "test", "seed": 11, "indices": [0, 1] }]));
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
    for words in [
        "1 scenes of 64x48",
        "judged in red, green, blue",
        "computed by ",
        "8-bit levels",
        "in focus",
        "foam",
        "flat oracle",
        "seen by another",
    ] {
        assert!(told.contains(words), "no '{words}' in {told}");
    }
}

/// What the trainer finds with the weights `fast` on the scenes of [`render`], 256x256 pixels: all light over what was
/// put in, and mean light of what is black. To have it again: `holod-scenes generate --kind marks --seed 11 --count 3
/// --size 256 --pupils 2,4 --planes 2 --rays 8`, then `python -m holod_training evaluate --marks` on these.
const LIGHT_OF_MARKS: [(&str, f64, f64, f64); 6] = [
    ("dots", 2.0, 0.9967, 0.000_003_278),
    ("dots", 4.0, 0.9415, 0.000_003_338),
    ("lines", 2.0, 1.0146, 0.000_012_234),
    ("lines", 4.0, 0.9712, 0.000_006_772),
    ("stars", 2.0, 0.9999, 0.000_002_502),
    ("stars", 4.0, 0.9216, 0.000_002_582),
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

/// Scenes of other indices or seeds are others, whatever their files are called.
#[test]
fn scenes_of_two_seeds_are_judged_together() {
    let folder = holod_tests::new_folder();
    let scenes = folder.path().join("scenes");
    render(&scenes, SceneKind::Test, SIZE, 1);
    let first = fs::read(scenes.join(file_name(0))).unwrap();
    fs::write(scenes.join(file_name(1)), with_entries(&first, &[("seed", "12")])).unwrap();
    fs::write(scenes.join(file_name(2)), with_entries(&first, &[("index", "5")])).unwrap();
    let args = ["evaluate", "--scenes", "scenes", "--border-px", "8", "--weights", "fast", "--json"];
    let ended = run(HOLOD, &args, folder.path());
    assert!(ended.status.success(), "{ended:?}");
    let judged: Value = serde_json::from_str(&ended.stdout).unwrap();
    let set = |seed: u64, indices: &[u64]| serde_json::json!({ "kind": "test", "seed": seed, "indices": indices });
    assert_eq!(judged["scene_sets"], serde_json::json!([set(11, &[0, 5]), set(12, &[0])]));
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
    fs::create_dir(at("twice")).unwrap();
    fs::write(at("twice").join(file_name(0)), &whole).unwrap();
    std::os::unix::fs::symlink("scene_000000.safetensors", at("twice").join(file_name(7))).unwrap();
    let cases: [(&[&str], i32, &[&str]); 15] = [
        (&["--scenes", "nowhere"], 66, &["nowhere", "holod-scenes"]),
        (&["--scenes", "empty"], 66, &["empty", "scene_*.safetensors", "holod-scenes generate"]),
        (&["--scenes", "cut"], 65, &["cut/scene_000003.safetensors", "bytes", "holod-scenes generate"]),
        (&["--scenes", "scenes", "--pupil", "3"], 65, &["scene_000000", "[2.0, 4.0] mm", "3 mm", "--pupil"]),
        (&["--scenes", "scenes", "--border-px", "30"], 64, &["--border-px", "30", "at most 18", "64x48"]),
        (
            &["--scenes", "scenes", "--border-px", "8", "--cards", "scenes"],
            65,
            &["scene_000000", "kind `test`", "--kind cards"],
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
        (
            &["--scenes", "twice", "--border-px", "8"],
            65,
            &["twice/scene_000007", "number 0 of seed 11, as in twice/scene_000000", "each scene once"],
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

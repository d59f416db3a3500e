//! Holograms on a GPU: Mesa's software device plays one, and where there is none that is said.

use std::path::Path;
use std::time::Duration;

use holod_calibration::Resolution;
use holod_model::scene_shard::SceneKind;
use holod_tests::daemon::{Daemon, Ended, run};
use serde_json::Value;

use crate::HOLOD;
use crate::evaluate::render;

const RENDER: [&str; 8] = ["render", "--weights", "small", "--resolution", "48x32", "--pupil", "3", "--force"];

fn rendered(folder: &Path, backend: &str, out: &str) -> Ended {
    run(HOLOD, &[&RENDER[..], &["--backend", backend, "--out", out]].concat(), folder)
}

/// Where Vulkan has no driver.
fn run_without_vulkan(args: &[&str], folder: &Path) -> Ended {
    let nowhere = Path::new("/nowhere.json");
    let environment = [("VK_DRIVER_FILES", nowhere), ("VK_ICD_FILENAMES", nowhere)];
    Daemon::start_with(HOLOD, args, folder, &environment).wait(Duration::from_secs(60))
}

fn rendered_without_vulkan(folder: &Path, backend: &str) -> Ended {
    run_without_vulkan(&[&RENDER[..], &["--backend", backend, "--out", "without"]].concat(), folder)
}

fn engine(folder: &Path, out: &str) -> String {
    let report = std::fs::read(folder.join(out).join("report.json")).unwrap();
    serde_json::from_slice::<Value>(&report).unwrap()["engine"].as_str().unwrap().to_owned()
}

/// Share of two patterns' pixels that are more than one of 256 levels apart on the circle.
fn share_apart(folder: &Path, one: &str, other: &str) -> f64 {
    let load = |out: &str| image::open(folder.join(out).join("phase_green.png")).unwrap().into_luma16().into_raw();
    let (one, other) = (load(one), load(other));
    assert_eq!(one.len(), other.len());
    let apart = |(one, other): (&u16, &u16)| (2 * 257..u16::MAX - 2 * 257).contains(&one.wrapping_sub(*other));
    one.iter().zip(&other).filter(|&pair| apart(pair)).count() as f64 / one.len() as f64
}

#[test]
fn a_gpu_gives_the_processors_hologram_and_is_named() {
    let folder = holod_tests::new_folder();
    let named = [
        ("gpu", "gpu, ", "single precision"),
        ("gpu-half", "gpu, ", "half precision"),
        ("cpu", "cpu, ", "threads"),
        // Half precision where the processor has it.
        ("cpu-half", "cpu, ", "threads"),
    ];
    for (backend, begins, precision) in named {
        let ended = rendered(folder.path(), backend, backend);
        assert!(ended.status.success(), "{ended:?}");
        let engine = engine(folder.path(), backend);
        assert!(engine.starts_with(begins) && engine.contains(precision), "{engine}");
        assert!(ended.stderr.contains(&engine), "{engine}: {ended:?}");
    }
    assert!(share_apart(folder.path(), "gpu", "cpu") < 1e-2);
    assert!(share_apart(folder.path(), "gpu-half", "gpu") < 1e-2);
    assert!(share_apart(folder.path(), "cpu-half", "cpu") < 2e-2);
    assert!(!engine(folder.path(), "cpu").contains("half precision"));
    let [half, single] = ["gpu-half", "gpu"].map(|out| std::fs::read(folder.path().join(out).join("phase_green.png")));
    assert!(half.unwrap() != single.unwrap(), "computed in single precision");
    let wider = [&RENDER[..5], &["5", "--force", "--backend", "cpu", "--out", "wider"]].concat();
    let wider: Vec<&str> = wider.iter().map(|&arg| if arg == "5" { "--pupil=5" } else { arg }).collect();
    assert!(run(HOLOD, &wider, folder.path()).status.success());
    assert!(share_apart(folder.path(), "gpu", "wider") > 1e-2, "the comparison is blind");
}

/// Figures of quality in which two evaluations are more than 0.05 dB apart.
fn figures_apart(one: &Value, other: &Value) -> Vec<String> {
    let [ours, theirs] = [one, other].map(|evaluation| evaluation["rows"].as_array().unwrap());
    assert_eq!((ours.len(), theirs.len()), (2, 2), "a row for each pupil");
    let mut apart = Vec::new();
    for (ours, theirs) in ours.iter().zip(theirs) {
        assert_eq!(ours["pupil_mm"], theirs["pupil_mm"]);
        for figure in ["psnr_db", "psnr_in_focus_db", "psnr_out_of_focus_db", "flat_oracle_psnr_db"] {
            let [ours_db, theirs_db] = [ours, theirs].map(|row| row[figure]["mean"].as_f64().unwrap());
            if (ours_db - theirs_db).abs() > 0.05 {
                apart.push(format!("{figure} at {} mm: {ours_db} for {theirs_db}", ours["pupil_mm"]));
            }
        }
    }
    apart
}

#[test]
fn weights_are_judged_alike_by_a_gpu_and_the_processor() {
    let folder = holod_tests::new_folder();
    render(&folder.path().join("scenes"), SceneKind::Test, Resolution { width: 64, height: 64 }, 1);
    let evaluated = |weights: &str, backend: &str| -> Value {
        let args = ["evaluate", "--scenes", "scenes", "--border-px", "8", "--json", "--weights", weights];
        let ended = run(HOLOD, &[&args[..], &["--backend", backend]].concat(), folder.path());
        assert!(ended.status.success(), "{ended:?}");
        serde_json::from_str(&ended.stdout).unwrap()
    };
    let [gpu, cpu, other] = [("fast", "gpu"), ("fast", "cpu"), ("small", "cpu")].map(|(w, b)| evaluated(w, b));
    let engines = [&gpu, &cpu].map(|evaluation| evaluation["engine"].as_str().unwrap());
    assert!(engines[0].starts_with("gpu, ") && engines[1].starts_with("cpu, "), "{engines:?}");
    assert_eq!(figures_apart(&gpu, &cpu), Vec::<String>::new());
    let apart = figures_apart(&gpu, &other);
    assert!(apart.iter().any(|figure| figure.starts_with("psnr_db")), "the comparison is blind: {apart:?}");
}

#[test]
fn without_a_gpu_the_processor_computes_and_one_that_is_asked_for_is_refused() {
    let folder = holod_tests::new_folder();
    let ended = rendered_without_vulkan(folder.path(), "auto");
    assert!(ended.status.success(), "{ended:?}");
    let engine = engine(folder.path(), "without");
    assert!(engine.starts_with("cpu, ") && engine.contains("Vulkan shows nothing and no GPU"), "{engine}");

    let ended = rendered_without_vulkan(folder.path(), "gpu");
    assert_eq!(ended.status.code(), Some(69), "{ended:?}");
    for part in ["--backend gpu", "Vulkan shows nothing", "mesa-vulkan-drivers", "--backend cpu"] {
        assert!(ended.stderr.contains(part), "{part}: {ended:?}");
    }
}

#[test]
fn the_gpu_that_a_rig_names_is_taken_or_none() {
    let folder = holod_tests::new_folder();
    let rendered = |named: &str, backend: &str| {
        std::fs::write(folder.path().join("rig.toml"), format!("[model]\ngpu = \"{named}\"\n")).unwrap();
        let args = [&RENDER[..], &["--config", "rig.toml", "--backend", backend, "--out", "named"]].concat();
        run(HOLOD, &args, folder.path())
    };
    let ended = rendered("LLVMpipe", "gpu");
    assert!(ended.status.success(), "{ended:?}");
    let engine = engine(folder.path(), "named");
    assert!(engine.starts_with("gpu, llvmpipe"), "{engine}");
    // The processor does not take the place of a GPU that was named.
    for backend in ["auto", "gpu"] {
        let ended = rendered("rtx 4090", backend);
        assert_eq!(ended.status.code(), Some(69), "{ended:?}");
        for part in ["Vulkan shows llvmpipe", "of which none that is a GPU has `rtx 4090`", "model.gpu"] {
            assert!(ended.stderr.contains(part), "{part}: {ended:?}");
        }
    }
    assert!(rendered("rtx 4090", "cpu").status.success(), "it takes no GPU");
}

#[test]
fn a_bench_is_not_ready_without_the_gpu_that_is_asked_for() {
    let folder = holod_tests::new_folder();
    let checked = |backend| {
        let args = ["check", "--weights", "fast", "--resolution", "64x48", "--backend", backend];
        run_without_vulkan(&args, folder.path())
    };
    for backend in ["gpu", "gpu-half"] {
        let ended = checked(backend);
        assert_eq!(ended.status.code(), Some(69), "{ended:?}");
        let says = format!("FAIL speed      --backend {backend}: Vulkan shows nothing");
        assert!(ended.stdout.contains(&says), "{ended:?}");
    }
    let ended = checked("auto");
    assert!(ended.stdout.contains("ok   speed      cpu, "), "{ended:?}");
}

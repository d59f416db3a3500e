//! `holod bench`: what it measures and prints, at a size that is measured in no time. No speed is asserted.

use holod_pupil_input::GateSettings;
use holod_tests::daemon::run;
use serde_json::Value;

use crate::HOLOD;

#[test]
fn bench_measures_stages_the_frame_both_ceilings_and_the_loop() {
    let folder = holod_tests::new_folder();
    let args = [
        "bench",
        "--backend",
        "cpu",
        "--weights",
        "small",
        "--resolution",
        "64x48",
        "--repeat",
        "3",
        "--duration",
        "2s",
    ];
    let ended = run(HOLOD, &[&args[..], &["--json"]].concat(), folder.path());
    assert!(ended.status.success(), "{ended:?}");
    let report: Value = serde_json::from_str(&ended.stdout).unwrap_or_else(|error| panic!("{error}: {ended:?}"));
    let above_zero = |value: &Value| value.as_f64().is_some_and(|figure| figure.is_finite() && figure > 0.0);
    assert!(!above_zero(&report["absent"]) && !above_zero(&Value::from(0.0)));

    assert_eq!(
        (&report["resolution"], &report["weights"], &report["frames"]),
        (&"64x48".into(), &"small".into(), &3.into())
    );
    assert!(report["renderer"].as_str().unwrap().starts_with("cpu, "), "{report}");
    for ceiling in ["threads", "gflop_per_s", "gb_per_s"] {
        assert!(above_zero(&report["ceilings"][ceiling]), "{ceiling}: {report}");
    }
    let stages = report["stages"].as_array().unwrap();
    assert_eq!(stages.last().unwrap()["name"], "panel levels");
    for part in stages.iter().chain([&report["layers"], &report["frame"]]) {
        let quartiles =
            ["lower_quartile_ms", "median_ms", "upper_quartile_ms"].map(|name| part[name].as_f64().unwrap());
        assert!(quartiles.is_sorted() && quartiles[1] > 0.0, "{part}");
        assert!(above_zero(&part["mb"]) && above_zero(&part["share_of_bandwidth"]), "{part}");
        let parts = ["lighting layer", "correction layer", "all layers", "whole frame"];
        let computes = parts.iter().any(|name| part["name"].as_str().unwrap().starts_with(name));
        assert_eq!(above_zero(&part["gflop"]), computes, "{part}");
        assert_eq!(above_zero(&part["share_of_arithmetic_peak"]), computes, "{part}");
    }
    let in_loop = &report["closed_loop"];
    assert!(above_zero(&in_loop["frames_shown"]), "{report}");
    for time in ["frame_time", "sample_to_photon"] {
        assert!(above_zero(&in_loop[time]["median_ms"]), "{time}: {report}");
    }
    let lead_ms = GateSettings::default().lead.seconds() * 1e3;
    let latency_ms = in_loop["sample_to_photon"]["median_ms"].as_f64().unwrap();
    assert!(latency_ms > lead_ms, "no younger sample is believed: {report}");
}

#[test]
fn bench_measures_what_a_picture_of_the_feed_costs_beside_a_copy() {
    let folder = holod_tests::new_folder();
    let args = ["bench", "--feed", "64x48", "--repeat", "3", "--json"];
    let ended = run(HOLOD, &args, folder.path());
    assert!(ended.status.success(), "{ended:?}");
    let report: Value = serde_json::from_str(&ended.stdout).unwrap_or_else(|error| panic!("{error}: {ended:?}"));
    let median = |part: &str| report[part]["median_ms"].as_f64().unwrap();
    for part in ["take", "make"] {
        let ratio = report[format!("{part}_of_memcpy")].as_f64().unwrap();
        assert!((ratio / (median(part) / median("memcpy")) - 1.0).abs() < 1e-9, "{part}: {report}");
    }
    assert_eq!((&report["resolution"], &report["pictures"]), (&"64x48".into(), &3.into()));
    assert!(run(HOLOD, &["bench", "--feed", "--repeat", "1"], folder.path()).stdout.starts_with("1920x1080, "));
}

#[test]
fn bench_leaves_the_loop_out_and_refuses_what_is_larger_than_the_panel() {
    let folder = holod_tests::new_folder();
    let args = ["bench", "--backend", "cpu", "--weights", "small", "--repeat", "1", "--duration", "0s", "--resolution"];
    let ended = run(HOLOD, &[&args[..], &["64x48"]].concat(), folder.path());
    assert!(ended.status.success(), "{ended:?}");
    for part in ["same run: ", "expected stack", "panel levels", "all layers", "whole frame"] {
        assert!(ended.stdout.contains(part), "{part}: {ended:?}");
    }
    assert!(!ended.stdout.contains("closed loop"), "{ended:?}");
    let ended = run(HOLOD, &[&args[..], &["4000x48"]].concat(), folder.path());
    assert_eq!(ended.status.code(), Some(64));
    assert!(ended.stderr.contains("found 4000x48"), "{ended:?}");
}

#[test]
fn bench_takes_a_small_panels_own_size() {
    let folder = holod_tests::new_folder();
    std::fs::write(folder.path().join("rig.toml"), holod_tests::small_rig(96, 64, "driver = \"simulated\"")).unwrap();
    let args = ["bench", "--config", "rig.toml", "--backend", "cpu", "--weights", "fast", "--repeat", "1"];
    let ended = run(HOLOD, &[&args[..], &["--duration", "0s", "--json"]].concat(), folder.path());
    assert!(ended.status.success(), "{ended:?}");
    let report: Value = serde_json::from_str(&ended.stdout).unwrap();
    assert_eq!(report["resolution"], "96x64");
}

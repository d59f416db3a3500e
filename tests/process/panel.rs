//! The daemon over a virtual panel that misbehaves.

use std::fs;

use holod_tests::daemon::{Ended, run};
use holod_tests::small_rig;

use crate::{HOLOD, beside_each_other};

/// Runs for `duration` over `output`, with one field for each refresh where `sequential`; the end, and its summary.
fn run_over(output: &str, sequential: bool, duration: &str) -> (Ended, serde_json::Value) {
    let folder = holod_tests::new_folder();
    let packed = small_rig(64, 64, "driver = \"simulated\"");
    let rig = match sequential {
        true => packed.replace("channel-packed", "field-sequential").replace("refresh_hz = 60.0", "refresh_hz = 180.0"),
        false => packed,
    };
    fs::write(folder.path().join("rig.toml"), rig).unwrap();
    let fixed = ["--config", "rig.toml", "--tracker", "mock:steady", "--resolution", "64x64", "--json"];
    let args = [&fixed[..], &["--output", output, "--duration", duration]].concat();
    let ended = run(HOLOD, &args, folder.path());
    assert!(ended.status.success(), "{}", ended.stderr);
    let summary: serde_json::Value = serde_json::from_str(&ended.stdout).unwrap();
    assert_eq!(summary["lasers"]["unsafe_findings"], 0, "{summary:#}");
    assert_eq!(summary["lasers_dark_at_end"], true);
    (ended, summary)
}

fn count(summary: &serde_json::Value, name: &str) -> u64 {
    summary["lasers"][name].as_u64().unwrap()
}

#[test]
fn an_unplugged_panel_is_named_dark_and_taken_back() {
    beside_each_other([false, true], |sequential| {
        let (ended, summary) = run_over("headless:unplug=1s+1s", sequential, "4s");
        assert!(ended.stderr.contains("the panel is lost, lasers dark: the panel was unplugged"), "{}", ended.stderr);
        assert!(ended.stderr.contains("the panel is back"), "{}", ended.stderr);
        let reasons = summary["lasers"]["went_dark"].to_string();
        assert!(reasons.contains("panel-lost") && reasons.contains("shutdown"), "dark twice: {reasons}");
        assert_eq!(summary["flat_at_end"], true);
    });
}

#[test]
fn a_panel_of_another_rate_stays_dark_and_both_rates_are_said() {
    beside_each_other([(false, "57", "60"), (true, "150", "180")], |(sequential, rate, nominal)| {
        let (ended, summary) = run_over(&format!("headless:refresh={rate}"), sequential, "3s");
        let said = format!("the panel refreshes at {rate}.00 Hz, the rig says {nominal} Hz");
        assert!(ended.stderr.contains(&said), "{}", ended.stderr);
        assert_eq!(ended.stderr.matches("the panel refreshes at").count(), 1, "{}", ended.stderr);
        assert_eq!(count(&summary, "lit"), 0);
        let measured_hz = summary["panel_refresh_hz"].as_f64().unwrap();
        assert!((measured_hz - rate.parse::<f64>().unwrap()).abs() < 0.01, "{measured_hz}");
    });
}

#[test]
fn a_panel_a_little_off_its_rate_is_lit_and_one_whose_reports_scatter_is_not_which_is_said() {
    beside_each_other(["headless:refresh=59.92", "headless:refresh=60.2"], |output| {
        let (ended, summary) = run_over(output, false, "3s");
        assert!(count(&summary, "lit") > 100, "{output}: {summary:#}");
        assert!(!ended.stderr.contains("is believed"), "{}", ended.stderr);
    });
    beside_each_other([false, true], |sequential| {
        let (ended, summary) = run_over("headless:jitter=0.3ms,seed=5", sequential, "6s");
        assert_eq!(count(&summary, "lit"), 0, "{summary:#}");
        let told = ended.stderr.matches("no report of the panel's refreshes is believed").count();
        assert_eq!(told, 1, "{}", ended.stderr);
    });
}

/// As those of a compositor may be: each field's report comes when it has gone by.
#[test]
fn a_panel_whose_reports_all_come_too_late_stays_dark_which_is_said_and_counted() {
    let (ended, summary) = run_over("headless:late=1", true, "8s");
    assert_eq!(count(&summary, "lit"), 0, "{summary:#}");
    assert_eq!(ended.stderr.matches("no field is lit: late (").count(), 1, "{}", ended.stderr);
    assert!(ended.stderr.contains("dark: tracker up"), "it is not said to be running: {}", ended.stderr);
    assert!(summary["lasers"]["dark_by_reason"]["late"].as_u64() > Some(300), "{summary:#}");
}

#[test]
fn lying_reports_cost_light_and_nothing_else() {
    let lies = "headless:jitter=20us,early=0.01,doubled=0.01,dropped=0.01,late=0.01,seed=3";
    let (_, summary) = run_over(lies, true, "4s");
    assert!(count(&summary, "lit") > 100, "{summary:#}");
    assert!(count(&summary, "dark") > 10, "{summary:#}");
}

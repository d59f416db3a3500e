//! `holod lut`: from powers on the bench to a table that the rig takes.

use std::f64::consts::PI;
use std::fs;

use holod_tests::daemon::run;
use holod_tests::{small_rig, worst};

use crate::HOLOD;

fn phase_rad(level: u16) -> f64 {
    1.95 * PI * (f64::from(level) / 255.0).powf(1.1)
}

fn sweep(every: usize) -> String {
    let power = |level: u16| 0.02 + 0.7 * (0.5 * phase_rad(level)).sin().powi(2);
    let row = |level| format!("{level},{:.6}\n", power(level));
    let levels = (0..255).step_by(every).chain([255]);
    format!("# green, 520 nm\nlevel,power_mw\n{}", levels.map(row).collect::<String>())
}

fn most_off(table: &str, sign: f64) -> f64 {
    let rows: Vec<&str> = table.lines().skip(2).collect();
    assert_eq!(rows.len(), 256, "{table}");
    let off = |(level, row): (usize, &&str)| {
        let (named, found) = row.split_once(',').unwrap();
        assert_eq!(named.parse::<usize>().unwrap(), level);
        (found.parse::<f64>().unwrap() - sign * phase_rad(level as u16)).abs()
    };
    worst(rows.iter().enumerate().map(off))
}

#[test]
fn measured_powers_become_a_table_that_the_rig_takes() {
    let folder = holod_tests::new_folder();
    let at = |name: &str| folder.path().join(name);
    fs::write(at("green.csv"), sweep(3)).unwrap();
    let rig = small_rig(64, 64, "driver = \"simulated\"");
    fs::write(at("rig.toml"), &rig).unwrap();
    let made = run(HOLOD, &["lut", "green.csv", "--out", "lut.csv", "--config", "rig.toml"], folder.path());
    assert!(made.status.success(), "{}", made.stderr);
    assert!(made.stdout.contains("the phase of 256 levels, up to 1.9"), "{}", made.stdout);
    let table = fs::read_to_string(at("lut.csv")).unwrap();
    assert!(most_off(&table, 1.0) < 0.02, "{table}");
    assert!(most_off(&table.replace("\n100,", "\n100,9"), 1.0) > 0.02, "another table is told");

    let with =
        rig.replace("[optics]", "lut_file = { green = \"lut.csv\" }\n[optics]").replace(" green = 1.9921875,", "");
    fs::write(at("with.toml"), with).unwrap();
    let taken = run(HOLOD, &["pattern", "checkerboard", "--config", "with.toml"], folder.path());
    assert!(taken.status.success(), "{}", taken.stderr);

    fs::write(at("falls.toml"), rig.replace("phase_sign = \"positive\"", "phase_sign = \"negative\"")).unwrap();
    let falls = run(HOLOD, &["lut", "green.csv", "--out", "-", "--config", "falls.toml"], folder.path());
    assert!(falls.status.success(), "{}", falls.stderr);
    assert!(most_off(&falls.stdout, -1.0) < 0.02, "{}", falls.stdout);
}

#[test]
fn a_sweep_that_gives_no_table_says_what_is_missing() {
    let folder = holod_tests::new_folder();
    let at = |name: &str| folder.path().join(name);
    let middle: String =
        (0..=255).map(|level| format!("{level},{}\n", (0.5 * phase_rad(level)).cos().powi(2))).collect();
    for (name, text, exit, says) in [
        ("row.csv", sweep(1).replace("\n40,", "\n40;"), 65, "row.csv: line 43: found `40;"),
        ("short.csv", sweep(1).lines().take(200).collect::<Vec<_>>().join("\n"), 65, "expected all of 0 to 255"),
        ("middle.csv", middle, 65, "expected the least power at level 0"),
        ("none.csv", String::new(), 65, "found 0 rows"),
    ] {
        fs::write(at(name), text).unwrap();
        let ended = run(HOLOD, &["lut", name, "--out", "lut.csv"], folder.path());
        assert_eq!(ended.status.code(), Some(exit), "{name}: {}", ended.stderr);
        assert!(ended.stderr.contains(says) && ended.stderr.contains(name), "{name}: {}", ended.stderr);
        assert!(!at("lut.csv").exists(), "{name}");
    }
    let missing = run(HOLOD, &["lut", "no.csv", "--out", "lut.csv"], folder.path());
    assert_eq!(missing.status.code(), Some(66), "{}", missing.stderr);
    fs::write(at("lut.csv"), "precious").unwrap();
    fs::write(at("sound.csv"), sweep(1)).unwrap();
    let kept = run(HOLOD, &["lut", "sound.csv", "--out", "lut.csv"], folder.path());
    assert_eq!(kept.status.code(), Some(73), "{}", kept.stderr);
    assert_eq!(fs::read_to_string(at("lut.csv")).unwrap(), "precious");
}

//! `holod check`: what the rig file means, and whether this bench is ready.

use std::path::Path;

use holod_calibration::rig::{LaserDriver, Meaning, Rig};
use holod_pupil_input::{Profile, TrackerSpec, serial_port_warnings};
use serde::Serialize;

use crate::cli::CheckArgs;
use crate::failure::{Exit, Failure};
use crate::{report, setup};

#[derive(Serialize)]
struct Findings {
    ready: bool,
    checks: Vec<Check>,
    meaning: Meaning,
}

#[derive(Serialize)]
struct Check {
    name: &'static str,
    passed: bool,
    says: String,
}

pub(super) fn check(args: &CheckArgs) -> Result<(), Failure> {
    let rig = setup::rig(&args.rig)?;
    let checks = vec![weights(&rig), tracker(&rig), lasers(&rig), panel(&rig)];
    let findings = Findings { ready: checks.iter().all(|check| check.passed), checks, meaning: rig.meaning() };
    if args.json {
        report::print_json(&findings)?;
    } else {
        let mut text = findings.meaning.to_string();
        text.push_str("\n\nChecks\n");
        for check in &findings.checks {
            text.push_str(&format!(
                "  {} {:8} {}\n",
                if check.passed { "ok  " } else { "FAIL" },
                check.name,
                check.says
            ));
        }
        report::print(text.trim_end())?;
    }
    let failed: Vec<&str> = findings.checks.iter().filter(|c| !c.passed).map(|c| c.says.as_str()).collect();
    if failed.is_empty() {
        Ok(())
    } else {
        Err(Failure::new(Exit::Unavailable, format!("this bench is not ready: {}", failed.join("; "))))
    }
}

fn weights(rig: &Rig) -> Check {
    let (passed, says) = match setup::weights(rig) {
        Ok(weights) => {
            let config = weights.config();
            let [narrowest, widest] = config.pupil_range_mm;
            (
                true,
                format!(
                    "{} {} with {} layers, trained for these optics and pupils of {narrowest} to {widest} mm",
                    config.architecture,
                    config.version,
                    config.layer_count()
                ),
            )
        }
        Err(failure) => (false, failure.to_string()),
    };
    Check { name: "weights", passed, says }
}

fn tracker(rig: &Rig) -> Check {
    let name = "tracker";
    let Some(spec) = &rig.tracker.spec else {
        return Check { name, passed: true, says: "the rig names none: give one with --tracker".into() };
    };
    let (passed, says) = match spec.parse::<TrackerSpec>() {
        Err(error) => (false, error.to_string()),
        Ok(spec) => match profile_of(&spec).map(Profile::find) {
            Some(Err(error)) => (false, error.to_string()),
            _ => reachable(&spec),
        },
    };
    Check { name, passed, says }
}

fn profile_of(spec: &TrackerSpec) -> Option<&str> {
    match spec {
        TrackerSpec::Serial { profile, .. } | TrackerSpec::Hid { profile, .. } => profile.as_deref(),
        TrackerSpec::Tcp { profile, .. } | TrackerSpec::Udp { profile, .. } => Some(profile),
        _ => None,
    }
}

/// Whether the tracker is there, as far as that can be told without opening it.
fn reachable(spec: &TrackerSpec) -> (bool, String) {
    match spec {
        TrackerSpec::Mock(_) => (true, format!("{spec}: a simulated eye")),
        TrackerSpec::Path(path)
        | TrackerSpec::Serial { path, .. }
        | TrackerSpec::Replay { path, .. }
        | TrackerSpec::MockFile(path) => {
            let (passed, says) = present(path, "plug the tracker in or correct tracker.spec");
            let warnings = serial_port_warnings(path);
            (passed, std::iter::once(says).chain(warnings).collect::<Vec<_>>().join("; "))
        }
        TrackerSpec::Hid { .. }
        | TrackerSpec::Tcp { .. }
        | TrackerSpec::Udp { .. }
        | TrackerSpec::Core(_)
        | TrackerSpec::Neon(_) => (true, format!("{spec}: not tried; `holod tracker try {spec}` does")),
    }
}

fn lasers(rig: &Rig) -> Check {
    let (passed, says) = match &rig.lasers.driver {
        LaserDriver::Simulated => (true, "simulated: no light leaves this bench".to_owned()),
        LaserDriver::Serial { path } => {
            let (passed, says) = present(path, "plug the laser box in or correct lasers.device");
            (passed, format!("{says}; this version's panel is virtual, over which a real laser is never lit"))
        }
    };
    Check { name: "lasers", passed, says }
}

fn panel(rig: &Rig) -> Check {
    let says = format!(
        "{} at {} Hz; this version shows patterns on a virtual panel only",
        rig.resolution(),
        rig.panel.refresh_hz
    );
    Check { name: "panel", passed: true, says }
}

fn present(path: &Path, otherwise: &str) -> (bool, String) {
    match path.try_exists() {
        Ok(true) => (true, format!("{} is there", path.display())),
        Ok(false) => (false, format!("{} does not exist: {otherwise}", path.display())),
        Err(error) => (false, format!("{}: {error}: {otherwise}", path.display())),
    }
}

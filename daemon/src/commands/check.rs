//! `holod check`: what the rig file means, and whether this bench is ready.

mod output;

use std::path::Path;

use holod_calibration::Resolution;
use holod_calibration::rig::{Meaning, Rig};
use holod_pupil_input::{Profile, TrackerSpec, serial_port_warnings};
use serde::Serialize;

use crate::cli::CheckArgs;
use crate::failure::{Exit, Failure};
use crate::speed::{self, Estimate};
use crate::{progress, report, setup};

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
    let mut rig = setup::rig_with_network(&args.rig, &args.network)?;
    if let Some(spec) = &args.tracker {
        rig.tracker.spec = Some(spec.clone());
    }
    let output = args.output.as_deref().map(str::parse).transpose().map_err(Failure::because(Exit::Usage))?;
    let mut checks = vec![weights(&rig), frames_hz(&rig, args.resolution), tracker(&rig)];
    checks.extend(output::lasers(&rig));
    checks.extend(output::panel(&rig, output.as_ref()));
    let findings = Findings { ready: checks.iter().all(|check| check.passed), checks, meaning: rig.meaning() };
    if args.json {
        report::print_json(&findings)?;
    } else {
        let mut text = findings.meaning.to_string();
        text.push_str("\n\nChecks\n");
        for check in &findings.checks {
            text.push_str(&format!(
                "  {} {:10} {}\n",
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

/// Frames a second, estimated from a small frame: slow is no fault of the bench.
fn frames_hz(rig: &Rig, resolution: Option<Resolution>) -> Check {
    let name = "speed";
    let panel = rig.resolution();
    let sizes = match resolution {
        Some(size) => vec![size],
        None => vec![setup::SAMPLE_RESOLUTION, panel],
    };
    let fits = |size: &Resolution| size.width <= panel.width && size.height <= panel.height;
    let sizes: Vec<Resolution> = sizes.into_iter().filter(fits).collect();
    let estimated = setup::weights(rig)
        .and_then(|weights| progress::during("estimating the frames a second", || Estimate::of(rig, &weights)));
    let (passed, says) = match (estimated, &sizes[..]) {
        // Why is said above, of the weights.
        (Err(_), _) => (true, "not estimated without weights".into()),
        (Ok(_), []) => (false, format!("--resolution is larger than the panel of {panel}")),
        (Ok(estimate), [first, ..]) => {
            let rates = sizes.iter().map(|&size| format!("{:.2} frames a second of {size}", estimate.frames_hz(size)));
            let rates: Vec<String> = rates.collect();
            let advice = speed::advice(estimate.frames_hz(*first), rig, *first);
            let says = format!(
                "{}; estimated from frames of up to {}: {}; the panel could show {:.1}{}",
                estimate.engine,
                estimate.timed[1],
                rates.join(", "),
                speed::panel_frames_hz(&rig.panel),
                advice.map_or(String::new(), |advice| format!("; {advice}"))
            );
            (true, says)
        }
    };
    Check { name, passed, says }
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

fn present(path: &Path, otherwise: &str) -> (bool, String) {
    match path.try_exists() {
        Ok(true) => (true, format!("{} is there", path.display())),
        Ok(false) => (false, format!("{} does not exist: {otherwise}", path.display())),
        Err(error) => (false, format!("{}: {error}: {otherwise}", path.display())),
    }
}

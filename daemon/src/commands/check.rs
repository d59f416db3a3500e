//! `holod check`: what the rig file means, and whether this bench is ready.

pub(super) mod access;
mod machine;
mod output;
mod service;

use std::os::unix::fs::FileTypeExt;
use std::path::Path;

use holod_calibration::rig::{Meaning, Rig};
use holod_calibration::{PupilDiameter, Resolution};
use holod_model::Weights;
use holod_model::conditions::BenchFit;
use holod_model::weights::{Architecture, JudgedBench};
use holod_pupil_input::{Tracker, TrackerSpec, serial_port_warnings};
use serde::Serialize;

use crate::bug_report;
use crate::cli::{Backend, CheckArgs};
use crate::failure::{Exit, Failure};
use crate::source::scene;
use crate::speed::{self, Estimate};
use crate::{progress, results, setup};

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
    rig.tracker.scale = args.scale.or(rig.tracker.scale);
    let output = args.output.as_deref().map(str::parse).transpose().map_err(Failure::because(Exit::Usage))?;
    let network = setup::load_weights(&rig);
    let mut checks = weights_checks(&rig, &network);
    let runs = checks.iter().all(|check| check.passed);
    checks.extend(speed(&rig, network.as_ref().ok().filter(|_| runs), (args.backend, args.resolution)));
    checks.push(tracker(&rig));
    let root = Path::new("/");
    checks.extend(access::access(&rig, args.service, root));
    if args.service {
        checks.extend(service::service(&rig, args, root));
    }
    checks.extend(machine::machine(&rig, args.service, root));
    checks.extend(output::lasers(&rig));
    checks.extend(output::panel(&rig, output.as_ref()));
    let findings = Findings { ready: checks.iter().all(|check| check.passed), checks, meaning: rig.meaning() };
    if args.json {
        results::print_json(&findings)?;
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
        results::print(text.trim_end())?;
    }
    let failed: Vec<&str> = findings.checks.iter().filter(|c| !c.passed).map(|c| c.says.as_str()).collect();
    if failed.is_empty() {
        Ok(())
    } else {
        Err(Failure::new(Exit::Unavailable, format!("this bench is not ready: {}", failed.join("; "))))
    }
}

/// The network, and where this bench lies in what it was trained for.
fn weights_checks(rig: &Rig, weights: &Result<Weights, Failure>) -> Vec<Check> {
    let check = |name, passed, says| Check { name, passed, says };
    let weights = match weights {
        Ok(weights) => weights,
        Err(failure) => return vec![check("weights", false, failure.to_string())],
    };
    let (config, bench) = (weights.config(), &rig.geometry);
    let mut network = format!("{} {} with {} layers", config.architecture, config.version, config.layer_count());
    let shows_pictures = config.architecture != Architecture::FocalStack;
    if !shows_pictures {
        network
            .push_str(": it takes focal stacks, which are for `holod render --focal-stack` alone; name other weights");
    }
    let [least_px, most_px] = config.trained.volume_blur_px;
    let [narrowest, widest] = weights.trained_pupils(bench).map(PupilDiameter::mm);
    let mut blur = format!(
        "{:.1} px over the depth range at a pupil of 3 mm; the network was trained for {least_px:.1} to {most_px:.1} px, on \
         this bench pupils of {narrowest:.2} to {widest:.2} mm",
        bench.largest_coc_px(PupilDiameter::from_mm(3.0))
    );
    if setup::few_pupils(weights, bench).is_some() {
        blur.push_str("; warning: of other pupils it is told the nearest of these, and the picture is worse");
    }
    let figures: Vec<_> = bench.volume_fresnel_px2().iter().map(|(colour, px2)| format!("{colour} {px2:.2}")).collect();
    let [least_px2, most_px2] = config.trained.volume_fresnel_px2;
    let diffraction = format!(
        "{} px² over the depth range; the network was trained for {least_px2:.2} to {most_px2:.2} px²",
        figures.join(", ")
    );
    let (fits, diffraction) = match weights.fit(bench) {
        BenchFit::Inside => (true, diffraction),
        BenchFit::Near(outside) => {
            (true, format!("{diffraction}; warning: {}", outside.behind_relay(rig.relay_magnification)))
        }
        BenchFit::Far(outside) => (false, outside.behind_relay(rig.relay_magnification).to_string()),
    };
    let mut checks =
        vec![check("weights", shows_pictures, network), check("blur", true, blur), check("spread", fits, diffraction)];
    if let Some(JudgedBench { name, judged }) = weights.judged_on_the_like_of(bench, PupilDiameter::from_mm(3.0)) {
        let quality = format!(
            "{:.1} dB over all ({:+.1} to smooth phase), {:.1} dB in focus and a focus slope of {:.2} on the bench most \
             alike that the network was judged on, {name}, at {:.0} px of blur",
            judged.psnr_db, judged.over_smooth_phase_db, judged.psnr_in_focus_db, judged.slope, judged.volume_blur_px
        );
        checks.push(check("quality", true, quality));
    }
    checks
}

/// Frames a second, estimated from a small frame: slow is no fault of the bench. An engine that is not to be had is
/// one, and so is a GPU that computes wrongly.
fn speed(rig: &Rig, weights: Option<&Weights>, (backend, resolution): (Backend, Option<Resolution>)) -> Vec<Check> {
    let panel = rig.resolution();
    let fits = |size: &Resolution| size.width <= panel.width && size.height <= panel.height;
    let mut sizes = match resolution {
        Some(size) => vec![size],
        None => vec![scene::sample_resolution_on(panel), panel],
    };
    sizes.retain(fits);
    sizes.dedup();
    let estimate = |weights| progress::during("estimating the frames a second", || Estimate::of(rig, weights, backend));
    let estimated = weights.map(estimate);
    let compared: Vec<Check> = match (&estimated, weights) {
        (Some(Ok(Estimate { engine, .. })), Some(weights)) if speed::is_gpu(engine) => {
            let compare = |&size: &Resolution| {
                let compare = || speed::compare(rig, weights, backend, size).transpose();
                let what = format!("comparing the GPU with the processor at {size}");
                progress::during(&what, compare).map(|apart| gpu(engine, size, apart))
            };
            sizes.iter().filter_map(compare).collect()
        }
        _ => Vec::new(),
    };
    let (passed, says) = match (estimated, &sizes[..]) {
        // Why is said above, of the weights.
        (None, _) => (true, "not estimated without weights that fit".into()),
        // As `run` would be.
        (Some(Err(failure)), _) => (false, failure.to_string()),
        (Some(Ok(_)), []) => (false, format!("--resolution is larger than the panel of {panel}")),
        (Some(Ok(estimate)), [first, ..]) => {
            let engine_at = |size| {
                let weights = weights.expect("the estimate's");
                progress::during(&format!("opening the engine for {size}"), || {
                    speed::engine_at(rig, weights, backend, size)
                })
            };
            let frames_hz = |size| speed::shown_hz(estimate.frame_time(size), &rig.panel);
            let (passed, rates) = rates(&estimate, &sizes, frames_hz, engine_at);
            let advice = speed::advice(frames_hz(*first), &estimate.engine, rig, *first);
            let more = [estimate.faster_processor(), advice].into_iter().flatten();
            let says = format!(
                "{}; estimated from frames of up to {}: {}; the panel could show {:.1}{}",
                estimate.engine,
                estimate.timed[1],
                rates,
                speed::panel_frames_hz(&rig.panel),
                more.map(|said| format!("; {said}")).collect::<String>()
            );
            (passed, says)
        }
    };
    [Check { name: "speed", passed, says }].into_iter().chain(compared).collect()
}

/// The frames a second of each of `sizes`, which `frames_hz` says, in words; and whether there is an engine for the first, that of a run. Small
/// frames fit on a GPU where those of a panel do not: there `engine_at` says what computes them.
fn rates(
    estimate: &Estimate,
    sizes: &[Resolution],
    frames_hz: impl Fn(Resolution) -> f64,
    engine_at: impl Fn(Resolution) -> Result<String, Failure>,
) -> (bool, String) {
    let mut passed = true;
    let mut rate = |(index, &size): (usize, &Resolution)| {
        let estimated = || format!("{:.2} frames a second of {size}", frames_hz(size));
        if !speed::is_gpu(&estimate.engine) || size == estimate.timed[1] {
            return estimated();
        }
        match engine_at(size) {
            Ok(engine) if speed::is_gpu(&engine) => estimated(),
            Ok(other) => format!("frames of {size} are computed by {other}"),
            Err(failure) => {
                passed &= index > 0;
                format!("no frames of {size}: {failure}")
            }
        }
    };
    let rates: Vec<String> = sizes.iter().enumerate().map(&mut rate).collect();
    (passed, rates.join(", "))
}

/// Whether a GPU computes what the processor does for frames of `size`; of a share `apart` of the pixels it does not.
fn gpu(engine: &str, size: Resolution, apart: Result<f64, Failure>) -> Check {
    let name = "gpu";
    let apart = match apart {
        Ok(apart) => apart,
        Err(failure) => return Check { name, passed: false, says: format!("not compared: {failure}") },
    };
    let most = speed::most_apart(engine);
    let [wide, high] = speed::strips(size);
    let found = format!(
        "{:.2} % of the phases or levels of strips of {wide} and {high} are more than 1/256 of a turn or a level from \
         the processor's",
        1e2 * apart
    );
    let says = if apart <= most {
        found
    } else {
        let other = if engine.contains("half precision") { "--backend gpu, or cpu" } else { "--backend cpu" };
        let most_percent = 1e2 * most;
        format!(
            "it computes wrongly: {found}; expected {most_percent:.1} % at most; take {other}, or \
             another version of its driver"
        )
    };
    Check { name, passed: apart <= most, says }
}

fn tracker(rig: &Rig) -> Check {
    let name = "tracker";
    let Some(spec) = &rig.tracker.spec else {
        return Check { name, passed: true, says: "the rig names none: give one with --tracker".into() };
    };
    let (passed, says) = match spec.parse::<TrackerSpec>() {
        Err(error) => (false, error.to_string()),
        Ok(spec) => examine(&spec, rig),
    };
    Check { name, passed, says }
}

fn examine(spec: &TrackerSpec, rig: &Rig) -> (bool, String) {
    if let Err(failure) = setup::refuse_port_of_others(spec, rig) {
        return (false, failure.to_string());
    }
    if let TrackerSpec::Path(path) | TrackerSpec::Replay { path, .. } = spec
        && bug_report::is_archive(path)
    {
        return match progress::during("unpacking the report", || bug_report::unpack(path)) {
            Ok(_) => (true, format!("{}: a report, which brings its own rig, weights and scene", path.display())),
            Err(failure) => (false, failure.to_string()),
        };
    }
    match reachable(spec) {
        (true, says) => match Tracker::examine(spec, &rig.tracker) {
            Ok(()) => (true, says),
            Err(error) => (false, error.to_string()),
        },
        not_there => not_there,
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
            let is_ports = matches!(spec, TrackerSpec::Serial { .. }) || path.starts_with("/dev");
            let otherwise = if is_ports {
                "plug the tracker in or correct tracker.spec"
            } else {
                "correct the file's path in the spec"
            };
            let (passed, says) = present(path, otherwise);
            let is_port = path.metadata().is_ok_and(|metadata| metadata.file_type().is_char_device());
            let may_be_file = !matches!(spec, TrackerSpec::Serial { .. });
            if passed && !is_port && !(may_be_file && path.is_file()) {
                return (false, format!("{} is no serial port: correct tracker.spec", path.display()));
            }
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

#[cfg(test)]
mod tests {
    use holod_calibration::rig::LaserDriver;

    use super::*;

    #[test]
    fn what_is_not_there_is_to_be_plugged_in_or_named_otherwise() {
        for (spec, cure) in [
            ("/dev/none", "plug the tracker in"),
            ("serial:none", "plug the tracker in"),
            ("none.csv", "correct the file's path"),
            ("replay:none.csv", "correct the file's path"),
            ("mock:none.txt", "correct the file's path"),
        ] {
            let (passed, says) = reachable(&spec.parse().unwrap());
            assert!(!passed && says.contains("none") && says.contains(cure), "{spec}: {says}");
        }
    }

    #[test]
    fn a_tracker_at_the_lasers_port_is_a_fault_of_the_bench() {
        let mut rig = Rig::default();
        rig.tracker.spec = Some("serial:/dev/null".into());
        assert!(tracker(&rig).passed, "{}", tracker(&rig).says);
        rig.lasers.driver = LaserDriver::Serial { path: "/dev/null".into(), sync_wire: false };
        let Check { passed, says, .. } = tracker(&rig);
        assert!(!passed && says.contains("/dev/null that the rig names for its lasers"), "{says}");
    }

    #[test]
    fn a_size_that_does_not_fit_on_the_gpu_is_not_promised() {
        let square = |side| Resolution { width: side, height: side };
        let [small, large] = [square(512), square(4096)];
        let estimate = |engine: &str| Estimate::taking(engine, [square(256), small], [0.1, 0.2]);
        let on_gpu = estimate("gpu, X, single precision");
        let rates =
            |estimate: &Estimate, sizes: &[Resolution], engine_at: &dyn Fn(Resolution) -> Result<String, Failure>| {
                rates(estimate, sizes, |size| 1.0 / estimate.frame_time(size).seconds(), engine_at)
            };
        let (passed, says) = rates(&on_gpu, &[small, large], &|_| Ok("gpu, X, single precision".into()));
        assert!(
            passed && says.contains("5.00 frames a second of 512x512, ") && says.ends_with("a second of 4096x4096")
        );
        let full: &dyn Fn(_) -> _ = &|_| Err(Failure::new(Exit::Unavailable, "no room for the sky"));
        let (passed, says) = rates(&on_gpu, &[small, large], full);
        assert!(passed && says.ends_with("512x512, no frames of 4096x4096: no room for the sky"), "{says}");
        assert!(!rates(&on_gpu, &[large], full).0);
        let (passed, says) = rates(&on_gpu, &[large], &|_| Ok("cpu, 8 threads, as X is full".into()));
        assert!(passed && says == "frames of 4096x4096 are computed by cpu, 8 threads, as X is full", "{says}");
        assert!(rates(&estimate("cpu, 8 threads"), &[large], full).1.contains("frames a second of 4096x4096"));
    }

    #[test]
    fn a_gpu_that_computes_wrongly_is_told_with_what_to_take() {
        let [single, half] = ["gpu, X, single precision", "gpu, X, matrix units, half precision"];
        let size = Resolution { width: 1920, height: 1080 };
        let gpu = |engine, apart| gpu(engine, size, Ok(apart));
        assert!(gpu(single, 0.0005).passed && gpu(half, 0.005).passed);
        for (engine, cure) in [(single, "--backend cpu"), (half, "--backend gpu, or cpu")] {
            let Check { passed, says, .. } = gpu(engine, 0.02);
            assert!(
                !passed
                    && says.contains("2.00 % of the phases or levels of strips of 1920x64 and 64x1080")
                    && says.contains(cure),
                "{says}"
            );
        }
    }
}

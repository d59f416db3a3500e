//! From names on the command line to the parts of a run: rig and weights.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use holod_calibration::rig::{Rig, RigError, WeightsChoice};
use holod_calibration::{DisplayGeometry, PupilDiameter};
use holod_model::Weights;
use holod_model::conditions::BenchFit;
use holod_model::weights::WeightsError;
use holod_pupil_input::{ReplayError, SourceError, TrackerError, TrackerSpec};
use holod_slm_output::present::Presenter;
use holod_slm_output::present::drm::Verdict;

use crate::cli::{NetworkArgs, RigArgs};
use crate::failure::{Exit, Failure};

/// What eyes' pupils mostly are.
const MOST_EYES_MM: [f32; 2] = [2.0, 6.0];

/// The rig that was named, or the built-in one.
pub fn rig(args: &RigArgs) -> Result<Rig, Failure> {
    load(args, |path| {
        Rig::load_with(path, &|text, folder| TrackerSpec::of_rig(text, folder).map(|spec| spec.to_string()))
    })
}

/// The same, whatever its tracker is: what is wrong there keeps no laser from being put out.
pub fn rig_of_lasers(args: &RigArgs) -> Result<Rig, Failure> {
    load(args, Rig::load)
}

fn load(args: &RigArgs, load: impl Fn(&Path) -> Result<Rig, RigError>) -> Result<Rig, Failure> {
    args.config.as_deref().map_or(Ok(Rig::default()), |path| {
        let exit = if path.exists() { Exit::Config } else { Exit::NoInput };
        load(path).map_err(Failure::because(exit))
    })
}

/// The same with the network that was named in place of the rig's own.
pub fn rig_with_network(args: &RigArgs, network: &NetworkArgs) -> Result<Rig, Failure> {
    let mut rig = rig(args)?;
    if let Some(weights) = &network.weights {
        rig.model.weights.clone_from(weights);
    }
    Ok(rig)
}

/// The same for what is shown on its panel, with a warning of what that cannot show.
pub fn rig_to_show(args: &RigArgs, network: &NetworkArgs) -> Result<Rig, Failure> {
    let rig = rig_with_network(args, network)?;
    warn_of_panel(&rig);
    Ok(rig)
}

/// Warns of what the rig's panel cannot show.
pub fn warn_of_panel(rig: &Rig) {
    for warning in rig.panel_warnings() {
        tracing::warn!("{warning}");
    }
}

/// Warns of what most likely changes levels on their way to the opened panel.
pub fn warn_of_link(panel: &dyn Presenter) {
    for check in panel.checks().iter().filter(|check| check.verdict == Verdict::Doubtful) {
        tracing::warn!("{check}");
    }
}

/// The rig's weights, for whatever bench they were trained.
pub fn load_weights(rig: &Rig) -> Result<Weights, Failure> {
    match &rig.model.weights {
        WeightsChoice::Standard => Ok(Weights::builtin()),
        WeightsChoice::Small => Ok(Weights::builtin_small()),
        WeightsChoice::Fast => Ok(Weights::builtin_fast()),
        WeightsChoice::File(path) => Weights::load(path).map_err(|error| {
            let is_missing =
                matches!(&error, WeightsError::Read { source, .. } if source.kind() == ErrorKind::NotFound);
            Failure::because(if is_missing { Exit::NoInput } else { Exit::Data })(error)
        }),
    }
}

/// The rig's weights, which must have been trained for benches such as this; what they know less well is warned of, and
/// pupils of most eyes that they do not know.
pub fn weights(rig: &Rig) -> Result<Weights, Failure> {
    let weights = weights_for_one_pupil(rig)?;
    if let Some(few) = few_pupils(&weights, &rig.geometry) {
        tracing::warn!("{few}");
    }
    Ok(weights)
}

/// The same for one pupil that is named: `check_pupil` refuses those outside the range.
pub fn weights_for_one_pupil(rig: &Rig) -> Result<Weights, Failure> {
    let weights = load_weights(rig)?;
    match weights.fit(&rig.geometry) {
        BenchFit::Inside => {}
        BenchFit::Near(outside) => tracing::warn!("{}", outside.behind_relay(rig.relay_magnification)),
        BenchFit::Far(outside) => {
            return Err(Failure::because(Exit::Config)(outside.behind_relay(rig.relay_magnification)));
        }
    }
    Ok(weights)
}

/// Why the pupils that `weights` were trained for are too few on `bench`, where they are.
pub fn few_pupils(weights: &Weights, bench: &DisplayGeometry) -> Option<String> {
    let [narrowest, widest] = weights.trained_pupils(bench).map(PupilDiameter::mm);
    let [least, most] = MOST_EYES_MM;
    // A range that ends there but for rounding is whole.
    (narrowest > least * 1.0001 || widest < most * 0.9999).then(|| {
        format!(
            "on this bench the network was trained for pupils of {narrowest:.2} to {widest:.2} mm, and eyes' are mostly \
             {least} to {most} mm: of others it is told the nearest of these, and the picture is worse"
        )
    })
}

/// Says why a pupil cannot be had, where the weights were not trained for it.
pub(crate) fn check_pupil(weights: &Weights, bench: &DisplayGeometry, pupil: PupilDiameter) -> Result<(), String> {
    let [narrowest, widest] = weights.trained_pupils(bench);
    if (narrowest..=widest).contains(&pupil) {
        return Ok(());
    }
    Err(format!(
        "found {} mm, expected {:.2} to {:.2} mm, the pupils that these weights were trained for on this bench",
        pupil.mm(),
        narrowest.mm(),
        widest.mm()
    ))
}

/// What weights are called in reports.
pub fn weights_name(weights: &WeightsChoice) -> String {
    match weights {
        WeightsChoice::File(path) => path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned(),
        built_in => built_in.built_in_name().unwrap_or_default().into(),
    }
}

/// Ports that belong to something else than the tracker: the laser box's.
pub fn ports_of_others(rig: &Rig) -> Vec<PathBuf> {
    rig.lasers.driver.paths().into_iter().map(Path::to_path_buf).collect()
}

/// Refuses a tracker at a port of [`ports_of_others`], which a run would not open.
///
/// # Errors
/// It is one.
pub(crate) fn refuse_port_of_others(spec: &TrackerSpec, rig: &Rig) -> Result<(), Failure> {
    let (TrackerSpec::Path(path) | TrackerSpec::Serial { path, .. }) = spec else { return Ok(()) };
    let resolved = |path: &Path| path.canonicalize().unwrap_or_else(|_| path.to_owned());
    let port = resolved(path);
    match ports_of_others(rig).into_iter().find(|owner| resolved(owner) == port) {
        None => Ok(()),
        Some(owner) => Err(Failure::new(
            Exit::NoInput,
            format!(
                "tracker port {} is the port {} that the rig names for its lasers; name the tracker's own port, which `holod \
                 tracker list` shows",
                path.display(),
                owner.display()
            ),
        )),
    }
}

/// The exit code of a tracker that cannot be started.
pub(crate) fn tracker_failure(error: TrackerError) -> Failure {
    let exit = match &error {
        TrackerError::Source(SourceError::Serial(_)) => Exit::NoInput,
        TrackerError::Source(_) => Exit::Unavailable,
        TrackerError::Profile(_) | TrackerError::WrongLink { .. } => Exit::Usage,
        TrackerError::Replay(ReplayError::Io { .. }) => Exit::NoInput,
        TrackerError::Replay(_) => Exit::Data,
        TrackerError::Script(_) => Exit::Data,
        TrackerError::Record(_) => Exit::CannotCreate,
        TrackerError::NoScale { .. } => Exit::Config,
        TrackerError::Thread(_) => Exit::Unavailable,
    };
    Failure::because(exit)(error)
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use holod_calibration::rig::LaserDriver;

    use super::*;

    #[test]
    fn the_port_of_the_lasers_is_no_trackers() {
        let folder = tempfile::tempdir().unwrap();
        let link = folder.path().join("holod-lasers");
        symlink("/dev/null", &link).unwrap();
        let mut rig = Rig::default();
        let refused = |rig: &Rig, spec: &str| refuse_port_of_others(&spec.parse().unwrap(), rig).is_err();
        assert!(!refused(&rig, "/dev/null"));
        for lasers in [link, "/dev/null".into()] {
            rig.lasers.driver = LaserDriver::Serial { path: lasers, sync_wire: false };
            assert!(refused(&rig, "/dev/null") && refused(&rig, "serial:/dev/null,profile=holod"));
            assert!(!refused(&rig, "/dev/zero") && !refused(&rig, "mock"));
        }
        // Elsewhere, where neither is plugged in.
        rig.lasers.driver = LaserDriver::Serial { path: "/dev/holod-none".into(), sync_wire: false };
        assert!(refused(&rig, "serial:/dev/holod-none"));
    }
}

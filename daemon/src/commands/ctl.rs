//! `holod ctl`: changes what the running daemon does.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use holod_calibration::rig::WeightsChoice;

use crate::cli::{CtlArgs, CtlOrder, LasersArg, PupilOrder};
use crate::control::{Request, ask};
use crate::failure::{Exit, Failure};
use crate::results;
use crate::setup;
use crate::status;

pub(super) fn ctl(args: &CtlArgs) -> Result<(), Failure> {
    let socket = match &args.socket {
        Some(socket) => socket.clone(),
        None => socket_of_running(args.pid)?,
    };
    let answer = ask(&socket, &request(&args.order)?)?;
    match answer {
        serde_json::Value::String(said) => results::print(&said),
        other => results::print_json(&other),
    }
}

fn socket_of_running(pid: Option<u32>) -> Result<PathBuf, Failure> {
    let running = status::of_running_as(pid)?;
    let running = status::only(&running)?;
    running.control.clone().ok_or_else(|| {
        Failure::new(Exit::Unavailable, format!("process {} has no control socket: its log says why", running.pid))
    })
}

/// The request that is meant; names of files become absolute, as the daemon is elsewhere.
fn request(order: &CtlOrder) -> Result<Request, Failure> {
    Ok(match order {
        CtlOrder::Status => Request::Status {},
        CtlOrder::Scene { scene, depth_encoding, fit } => Request::Scene {
            scene: if scene == "feed" { scene.clone() } else { absolute_scene(scene)? },
            depth_encoding: depth_encoding.clone(),
            fit: (*fit).into(),
        },
        CtlOrder::Weights { weights: WeightsChoice::File(path) } => Request::Weights { weights: absolute(path)? },
        CtlOrder::Weights { weights } => Request::Weights { weights: setup::weights_name(weights) },
        CtlOrder::Pause => Request::Pause {},
        CtlOrder::Resume => Request::Resume {},
        CtlOrder::Pupil { pupil: PupilOrder::Follow } => Request::Pupil { mm: None },
        CtlOrder::Pupil { pupil: PupilOrder::Fixed(pupil) } => Request::Pupil { mm: Some(pupil.mm()) },
        CtlOrder::Pattern(kind) => Request::Pattern {
            pattern: kind.into(),
            axis_px: kind.target().axis,
            colours: kind.target().colour.clone(),
        },
        CtlOrder::Eye { eye } => Request::Eye { eye: *eye },
        CtlOrder::Reload => Request::Reload { changed: BTreeMap::new() },
        CtlOrder::Flat => Request::Flat {},
        CtlOrder::Hologram => Request::Hologram {},
        CtlOrder::Lasers { lasers: LasersArg::Dark } => Request::LasersDark {},
        CtlOrder::Lasers { lasers: LasersArg::Arm } => Request::LasersArm {},
        CtlOrder::Stop => Request::Stop {},
    })
}

/// A folder or file, or two files with a comma between them.
fn absolute_scene(scene: &str) -> Result<String, Failure> {
    if Path::new(scene).exists() {
        return absolute(Path::new(scene));
    }
    let parts: Result<Vec<_>, _> = scene.split(',').map(|part| absolute(Path::new(part))).collect();
    Ok(parts?.join(","))
}

fn absolute(path: &Path) -> Result<String, Failure> {
    let path = std::path::absolute(path).map_err(Failure::because(Exit::NoInput))?;
    path.into_os_string()
        .into_string()
        .map_err(|path| Failure::new(Exit::Usage, format!("{}: expected a name in UTF-8", path.display())))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_files_become_absolute_and_nothing_else_does() {
        let here = std::env::current_dir().unwrap();
        let path = |name: &str| here.join(name).display().to_string();
        assert_eq!(absolute_scene("a.png,b.png").unwrap(), format!("{},{}", path("a.png"), path("b.png")));
        assert_eq!(absolute_scene("/x/scene").unwrap(), "/x/scene");
        let weights = |weights| request(&CtlOrder::Weights { weights }).unwrap();
        assert_eq!(weights(WeightsChoice::Small), Request::Weights { weights: "small".into() });
        let file = weights(WeightsChoice::File("./w.safetensors".into()));
        assert_eq!(file, Request::Weights { weights: path("w.safetensors") });
    }
}

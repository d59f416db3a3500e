//! Opens the panel that a spec names.

use holod_calibration::TimeNs;

#[cfg(feature = "window")]
use super::window;
use super::{HeadlessPanel, OutputSpec, PanelSetup, Presenter, SpecError, drm};

/// Why a panel could not be opened.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// The figures of a virtual panel.
    #[error(transparent)]
    Spec(#[from] SpecError),
    /// A connector of a graphics card.
    #[error(transparent)]
    Drm(#[from] drm::DrmError),
    /// A window that fills the panel's monitor.
    #[cfg(feature = "window")]
    #[error("--output window: {0}")]
    Window(#[from] window::WindowError),
    /// The program holds no code for it.
    #[error("this program was built without --output {kind}; build it with `--features {kind}`")]
    NotBuilt {
        /// The presenter, which is also the feature's name.
        kind: &'static str,
    },
}

/// Opens the panel that `spec` names.
///
/// # Errors
/// [`OpenError`]: there is no such panel, it is not the one that the rig describes, or it may not be opened.
pub fn open_panel(spec: &OutputSpec, setup: &PanelSetup, now: TimeNs) -> Result<Box<dyn Presenter>, OpenError> {
    Ok(match spec {
        OutputSpec::Headless(faults) => Box::new(HeadlessPanel::new(setup, now, *faults)),
        OutputSpec::Drm(target) => Box::new(drm::DrmPanel::open(target, setup)?),
        #[cfg(feature = "window")]
        OutputSpec::Window(spec) => {
            let server = window::DisplayServer::from_environment()?;
            Box::new(window::WindowPanel::open(server, window::Road::best(), spec, setup)?)
        }
        #[cfg(not(feature = "window"))]
        OutputSpec::Window(_) => return Err(OpenError::NotBuilt { kind: "window" }),
    })
}

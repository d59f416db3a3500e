//! The files of a hologram, and what they say it was made with.

use holod_calibration::Colour;
use holod_calibration::rig::Rig;
use holod_model::files::{self, StoredHologram};
use holod_model::optics::PhasePattern;
use serde::Serialize;

use crate::failure::{Exit, Failure};
use crate::staging::Staging;
use crate::{progress, setup};

/// The hologram, its phases and the report.
pub(super) const FILES: [&str; 5] =
    ["field.safetensors", "phase_red.png", "phase_green.png", "phase_blue.png", "report.json"];

/// What a hologram was made with.
#[derive(Serialize)]
pub(super) struct MadeWith {
    /// The network's weights by name, or their file's name.
    weights: String,
    /// The rig's name.
    rig: String,
    /// Of the rig file's text, as `holod check` states it; none of the built-in rig.
    rig_hash: Option<String>,
    /// What 2π would be in the PNGs of phases.
    phase_png_2pi: u32,
}

impl MadeWith {
    pub(super) fn of(rig: &Rig) -> Self {
        Self {
            weights: setup::weights_name(&rig.model.weights),
            rig: rig.name.clone(),
            rig_hash: rig.provenance.text_hash.map(|hash| format!("{hash:016x}")),
            phase_png_2pi: files::PHASE_LEVELS,
        }
    }
}

/// Writes all files but the report.
pub(super) fn save(hologram: &StoredHologram, pattern: &PhasePattern, staging: &Staging) -> Result<(), Failure> {
    progress::during("writing the hologram", || {
        let cannot = Failure::because(Exit::CannotCreate);
        hologram.save(&staging.path(FILES[0])).map_err(&cannot)?;
        for (colour, name) in Colour::ALL.into_iter().zip(&FILES[1..4]) {
            files::save_phase(pattern, colour, &staging.path(name)).map_err(&cannot)?;
        }
        Ok(())
    })
}

//! The files of a hologram.

use holod_calibration::Colour;
use holod_model::files::{self, StoredHologram};
use holod_model::optics::PhasePattern;

use crate::failure::{Exit, Failure};
use crate::progress;
use crate::staging::Staging;

/// The hologram, its phases and the report.
pub(super) const FILES: [&str; 5] =
    ["field.safetensors", "phase_red.png", "phase_green.png", "phase_blue.png", "report.json"];

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

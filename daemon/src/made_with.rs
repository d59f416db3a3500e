//! What holograms are made with, as reports say it.

use holod_calibration::rig::Rig;
use serde::Serialize;

use crate::failure::Failure;
use crate::record::weights_file;
use crate::setup;

/// The rig and its weights.
#[derive(Serialize)]
pub struct MadeWith {
    /// The network's weights by name, or their file's name.
    pub weights: String,
    /// XXH3 of 64 bits of the weights' file, hexadecimal; none of built-in ones.
    pub weights_xxh3: Option<String>,
    /// The rig's name.
    pub rig: String,
    /// Of the rig file's text, as `holod check` states it; none of the built-in rig.
    pub rig_hash: Option<String>,
}

impl MadeWith {
    /// What `rig` makes holograms with.
    ///
    /// # Errors
    /// The weights' file cannot be read.
    pub fn of(rig: &Rig) -> Result<Self, Failure> {
        Ok(Self {
            weights: setup::weights_name(&rig.model.weights),
            weights_xxh3: weights_file(&rig.model.weights)?.map(|file| file.xxh3),
            rig: rig.name.clone(),
            rig_hash: rig.provenance.hash_text(),
        })
    }
}

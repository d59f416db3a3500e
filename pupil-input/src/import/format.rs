//! The kinds of log.

use std::fmt;

/// The kinds of log that are known.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LogFormat {
    /// Lines of holod's own protocol for microcontrollers.
    Lines,
    /// Pupil Labs Neon, 3D eye states of its cloud.
    NeonEyeStates,
    /// holod's recording of the bytes of a link.
    Raw,
    /// holod's own CSV, as `holod log convert` writes it.
    Csv,
    /// Tobii Pro Lab or Studio.
    Tobii,
    /// Gazepoint Analysis or Control.
    Gazepoint,
    /// The CSV that PupilEXT records.
    PupilExt,
    /// Lab Streaming Layer recordings.
    Xdf,
    /// Eye tracking in the Brain Imaging Data Structure: tables with a JSON sidecar.
    Bids,
    /// Pupil Labs Neon, eye states as its phone writes them.
    NeonNative,
    /// Pupil Labs Core, `pupil_positions.csv` of its player.
    Core,
    /// SR Research EyeLink, `.asc` as `edf2asc` writes it.
    EyeLink,
    /// SMI, of BeGaze or the IDF converter.
    Smi,
}

impl LogFormat {
    /// Its name for people.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Lines => "holod line protocol",
            Self::NeonEyeStates => "Pupil Labs Neon 3d_eye_states.csv",
            Self::Raw => "holod recording of a link",
            Self::Csv => "holod CSV",
            Self::Tobii => "Tobii Pro Lab or Studio TSV",
            Self::Gazepoint => "Gazepoint CSV",
            Self::PupilExt => "PupilEXT CSV",
            Self::Xdf => "XDF (Lab Streaming Layer)",
            Self::Bids => "BIDS eye tracking _physio.tsv.gz",
            Self::NeonNative => "Pupil Labs Neon eye_state raw",
            Self::Core => "Pupil Labs Core pupil_positions.csv",
            Self::EyeLink => "EyeLink .asc",
            Self::Smi => "SMI BeGaze text",
        }
    }
}

impl fmt::Display for LogFormat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

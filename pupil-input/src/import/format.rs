//! The kinds of log.

use std::fmt;

/// The kinds of log that are known.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LogFormat {
    /// holod's line protocol.
    Lines,
    /// Pupil Labs Neon, 3D eye states of its cloud.
    NeonEyeStates,
    /// holod's recording of the bytes of a link.
    Raw,
    /// holod's own CSV.
    Csv,
    /// Tobii Pro Lab or Studio.
    Tobii,
    /// Gazepoint Analysis or Control.
    Gazepoint,
    /// PupilEXT.
    PupilExt,
    /// Lab Streaming Layer recordings.
    Xdf,
    /// BIDS eye tracking.
    Bids,
    /// Pupil Labs Neon, eye states as its phone writes them.
    NeonNative,
    /// Pupil Labs Core.
    Core,
    /// SR Research EyeLink.
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

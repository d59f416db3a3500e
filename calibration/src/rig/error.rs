//! What is wrong with a rig file, all of it at once.

use std::fmt;

/// One thing that is wrong with a rig file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Fault {
    /// The key's full path, for example `panel.pixel_pitch_um`; empty where the file as a whole is at fault.
    pub key: String,
    /// The line of the rig file, from 1: of the key, or of its table where the key is missing.
    pub line: Option<usize>,
    /// What the file says.
    pub found: String,
    /// What it may say.
    pub expected: String,
    /// What to do about it.
    pub advice: String,
}

/// A rig file that cannot be used, with every fault that was found in it, in the order of its lines.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub struct RigError {
    /// The rig file, as it was named.
    pub origin: String,
    /// At least one fault.
    pub faults: Vec<Fault>,
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self.line, self.key.as_str()) {
            (Some(line), "") => write!(f, "line {line}: ")?,
            (Some(line), key) => write!(f, "line {line}, {key}: ")?,
            (None, "") => {}
            (None, key) => write!(f, "{key}: ")?,
        }
        write!(f, "found {}; expected {}; {}", self.found, self.expected, self.advice)
    }
}

impl fmt::Display for RigError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let count = self.faults.len();
        write!(f, "rig file {}: {count} fault{}", self.origin, if count == 1 { "" } else { "s" })?;
        self.faults.iter().try_for_each(|fault| write!(f, "\n  {fault}"))
    }
}

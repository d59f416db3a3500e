//! What is wrong with a rig file, all of it at once.

use std::fmt;

use crate::toml_reader::Fault;

/// A rig file that cannot be used, with every fault that was found in it, in the order of its lines.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub struct RigError {
    /// The rig file, as it was named.
    pub origin: String,
    /// At least one fault.
    pub faults: Vec<Fault>,
}

impl fmt::Display for RigError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let count = self.faults.len();
        write!(f, "rig file {}: {count} fault{}", self.origin, if count == 1 { "" } else { "s" })?;
        self.faults.iter().try_for_each(|fault| write!(f, "\n  {fault}"))
    }
}

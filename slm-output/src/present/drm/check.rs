//! What was looked at on the way to the panel, and whether it is as it must be.

use std::fmt;

/// One thing that was looked at on the way to the panel.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DisplayCheck {
    /// What was looked at.
    pub name: String,
    /// What it is.
    pub found: String,
    /// What it must be.
    pub wanted: String,
    /// What follows.
    pub verdict: Verdict,
}

/// Whether a thing is as it must be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// It was read back, and it is.
    Right,
    /// It was read back, and it is not.
    Wrong,
    /// The driver does not tell.
    Unverified,
    /// Lasers stay dark by it, but those of a box that times itself by the panel's sync output.
    Dark,
}

impl fmt::Display for DisplayCheck {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let verdict = match self.verdict {
            Verdict::Right => "right",
            Verdict::Wrong => "WRONG",
            Verdict::Unverified => "not verified",
            Verdict::Dark => "lasers stay dark but those of a box with a sync wire in channel-packed mode",
        };
        write!(f, "{}: {}, wanted {} ({verdict})", self.name, self.found, self.wanted)
    }
}

impl DisplayCheck {
    /// A check whose found and wanted are texts that must be equal.
    pub(crate) fn equal(name: &str, found: impl ToString, wanted: impl ToString) -> Self {
        let (found, wanted) = (found.to_string(), wanted.to_string());
        let verdict = if found == wanted { Verdict::Right } else { Verdict::Wrong };
        Self { name: name.to_owned(), found, wanted, verdict }
    }

    /// A check that could not be made.
    pub(crate) fn unverified(name: &str, found: &str, wanted: impl ToString) -> Self {
        Self {
            name: name.to_owned(),
            found: found.to_owned(),
            wanted: wanted.to_string(),
            verdict: Verdict::Unverified,
        }
    }
}

//! What was looked at on the way to the panel, and whether it is as it must be.

use std::fmt;

/// What carries the levels to the panel; other models than RGB have fewer of them.
pub(crate) const COLOUR_MODEL: &str = "colour model of the link";

/// One thing that was looked at on the way to the panel.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DisplayCheck {
    /// What was looked at.
    pub name: String,
    /// What was read back, or that nothing was.
    pub found: String,
    /// What it must be.
    pub wanted: String,
    /// What follows for lasers and levels.
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
    /// The driver does not tell, but is known to do otherwise.
    Doubtful,
    /// Lasers stay dark by it, but those of a box that times itself by the panel's sync output.
    Dark,
}

impl fmt::Display for DisplayCheck {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let verdict = match self.verdict {
            Verdict::Right => "right",
            Verdict::Wrong => "WRONG",
            Verdict::Unverified => "not verified",
            Verdict::Doubtful => "most likely WRONG",
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
        let (name, found, wanted) = (name.to_owned(), found.to_owned(), wanted.to_string());
        Self { name, found, wanted, verdict: Verdict::Unverified }
    }

    /// What is to be said of a connector that [sends it](super::SeenConnector::sends_ycbcr_444).
    pub(crate) fn ycbcr_444() -> Self {
        let found = "YCbCr 4:4:4, which amdgpu sends to HDMI monitors that offer it, as this one does: about 220 of 256 \
                     levels are left; use DisplayPort, or take the offer from the EDID (slm-output/doc/drm.md, \
                     \"YCbCr\")";
        Self { verdict: Verdict::Doubtful, ..Self::unverified(COLOUR_MODEL, found, "RGB") }
    }
}

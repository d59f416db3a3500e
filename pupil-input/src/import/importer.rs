//! What reads the logs of one format.

use super::fault::ReplayError;
use super::format::LogFormat;
use super::input::LogInput;
use super::recording::LogBuilder;

/// What goes into reading one log, apart from the log itself.
pub(crate) struct Importer {
    pub(crate) format: LogFormat,
    /// Whether the log is of this format; looks at content.
    pub(crate) recognises: fn(&LogInput<'_>) -> bool,
    /// Reads all of it into the builder. Single bad lines are counted there; an error is for a log that is wrong as a
    /// whole.
    pub(crate) read: fn(&LogInput<'_>, &mut LogBuilder) -> Result<(), ReplayError>,
}

//! Which connector is meant.

use std::path::{Path, PathBuf};

use super::error::DrmError;
use super::find::{NotFound, SYS_CLASS_DRM, SeenConnector, choose, seen_connectors};

/// A connector by name or monitor.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DrmTarget {
    /// A connector's name such as `DP-1`, or the name or serial number of the monitor at it.
    pub connector: String,
    /// The card, such as `/dev/dri/card1`, where the connector's name is not enough.
    pub card: Option<PathBuf>,
}

impl DrmTarget {
    /// The connector that is meant, of those that the kernel lists below `class`, usually `/sys/class/drm`.
    ///
    /// # Errors
    /// [`DrmError`]: there is none, or more than one.
    pub fn find(&self, class: &Path) -> Result<SeenConnector, DrmError> {
        let asked = &self.connector;
        choose(seen_connectors(class), asked, self.card.as_deref()).map_err(|found| match found {
            NotFound::NoCard => DrmError::NoCard { class: SYS_CLASS_DRM },
            NotFound::None(there) => DrmError::NoSuchConnector { asked: asked.clone(), there },
            NotFound::Several(there) => DrmError::Ambiguous { asked: asked.clone(), there },
        })
    }
}

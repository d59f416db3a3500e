//! The properties of a card's objects, by name.

use std::io;

use drm::control::{Device, ResourceHandle, connector, crtc, plane, property};

/// The properties of one object, by name.
pub(crate) struct Properties(Vec<(property::Info, u64)>);

impl Properties {
    pub(crate) fn of<H: ResourceHandle>(card: &impl Device, object: H) -> io::Result<Self> {
        let values = card.get_properties(object)?;
        let read = |(&handle, &value)| card.get_property(handle).map(|info| (info, value));
        values.iter().map(read).collect::<io::Result<_>>().map(Self)
    }

    pub(crate) fn find(&self, name: &str) -> Option<&(property::Info, u64)> {
        self.0.iter().find(|(info, _)| info.name().to_bytes() == name.as_bytes())
    }

    pub(crate) fn handle(&self, name: &str) -> Option<property::Handle> {
        self.find(name).map(|(info, _)| info.handle())
    }

    pub(crate) fn value(&self, name: &str) -> Option<u64> {
        self.find(name).map(|&(_, value)| value)
    }
}

/// The properties of the three objects on the way to the panel.
pub(crate) struct PipeProperties {
    pub(crate) connector: Properties,
    pub(crate) crtc: Properties,
    pub(crate) plane: Properties,
}

impl PipeProperties {
    pub(crate) fn of(
        card: &impl Device,
        connector: connector::Handle,
        crtc: crtc::Handle,
        plane: plane::Handle,
    ) -> io::Result<Self> {
        Ok(Self {
            connector: Properties::of(card, connector)?,
            crtc: Properties::of(card, crtc)?,
            plane: Properties::of(card, plane)?,
        })
    }
}

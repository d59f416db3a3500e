//! What the figures of trackers and logs are.

use holod_calibration::rig;

/// What a tracker's figures are, before the rig's scale.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum SizeUnit {
    /// Diameters in millimetres, as the pupil itself has them.
    #[default]
    Millimetres,
    /// Diameters in pixels of the eye camera.
    Pixels,
    /// Diameters in units of the tracker's own; an area A is given as the diameter 2·√(A/π) of its disc.
    Arbitrary,
}

impl SizeUnit {
    /// Its name for people.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Millimetres => "mm",
            Self::Pixels => "camera pixels",
            Self::Arbitrary => "arbitrary units",
        }
    }
}

/// What a tracker's figures are, and what its profile makes of them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Figures {
    /// What they are when the profile has converted them.
    pub unit: SizeUnit,
    /// What the profile multiplies them by; 1 where it knows no conversion.
    pub mm_per_unit: f64,
    /// Millimetres for one of them in the run that recorded them, where that had a scale.
    pub recorded_scale: Option<f64>,
}

impl Figures {
    /// The scale that they get: the settings' own goes before that of the recording.
    pub fn scale(&self, settings: &rig::Tracker) -> Option<f64> {
        settings.scale.or(self.recorded_scale)
    }

    /// The settings with the scale that they get.
    pub fn scaled(&self, settings: &rig::Tracker) -> rig::Tracker {
        rig::Tracker { scale: self.scale(settings), ..settings.clone() }
    }
}

impl From<SizeUnit> for Figures {
    /// Figures that are as they came.
    fn from(unit: SizeUnit) -> Self {
        Self { unit, mm_per_unit: 1.0, recorded_scale: None }
    }
}

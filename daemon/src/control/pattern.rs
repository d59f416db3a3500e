//! Test patterns as they are asked for: the figures of [`Pattern`] with their units in their names.

use std::f64::consts::PI;

use holod_calibration::{Colour, Metres, PerColour};
use holod_slm_output::patterns::{Pattern, Placement, Profile};
use serde::{Deserialize, Serialize};

use crate::cli::{ColourArg, PatternKind, ProfileArg};

/// A test pattern.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
#[expect(missing_docs, reason = "they are those of holod_slm_output::patterns::Pattern")]
pub enum PatternRequest {
    Level {
        level: u16,
    },
    Checkerboard {
        period_px: usize,
        depth_rad: f64,
    },
    Grating {
        period_px: f64,
        #[serde(default)]
        angle_deg: f64,
        profile: ProfileArg,
        #[serde(default, skip_serializing_if = "Option::is_none")]
        depth_rad: Option<f64>,
    },
    Lens {
        focal_length_mm: f64,
        #[serde(default, skip_serializing_if = "Option::is_none")]
        diameter_mm: Option<f64>,
    },
    Dots {
        spacing_px: usize,
        diameter_px: usize,
    },
    CrossHair {
        line_px: usize,
    },
    FieldIdentity {
        #[serde(default, skip_serializing_if = "Option::is_none")]
        radius_mm: Option<f64>,
    },
}

impl PatternRequest {
    /// What the command line asks for.
    pub(crate) fn of_arguments<To: clap::Args>(kind: &PatternKind<To>) -> Self {
        match *kind {
            PatternKind::Level { level, .. } => Self::Level { level },
            PatternKind::Checkerboard { period, depth, .. } => {
                Self::Checkerboard { period_px: period, depth_rad: depth * PI }
            }
            PatternKind::Grating { period, angle, profile, depth, .. } => {
                Self::Grating { period_px: period, angle_deg: angle, profile, depth_rad: depth.map(|depth| depth * PI) }
            }
            PatternKind::Lens { focal_length, diameter, .. } => {
                Self::Lens { focal_length_mm: focal_length, diameter_mm: diameter }
            }
            PatternKind::Dots { spacing, dot, .. } => Self::Dots { spacing_px: spacing, diameter_px: dot },
            PatternKind::CrossHair { line, .. } => Self::CrossHair { line_px: line },
            PatternKind::FieldIdentity { radius, .. } => Self::FieldIdentity { radius_mm: radius },
        }
    }

    /// What it is called.
    pub(crate) fn name(&self) -> &'static str {
        match self {
            Self::Level { .. } => "level",
            Self::Checkerboard { .. } => "checkerboard",
            Self::Grating { .. } => "grating",
            Self::Lens { .. } => "lens",
            Self::Dots { .. } => "dots",
            Self::CrossHair { .. } => "cross-hair",
            Self::FieldIdentity { .. } => "field-identity",
        }
    }
}

impl From<PatternRequest> for Pattern {
    fn from(request: PatternRequest) -> Self {
        let metres = |mm: f64| Metres(mm / 1e3);
        match request {
            PatternRequest::Level { level } => Self::Level { level },
            PatternRequest::Checkerboard { period_px, depth_rad } => Self::Checkerboard { period_px, depth_rad },
            PatternRequest::Grating { period_px, angle_deg, profile, depth_rad } => Self::Grating {
                period_px,
                angle_deg,
                profile: match profile {
                    ProfileArg::Binary => Profile::Binary,
                    ProfileArg::Blazed => Profile::Blazed,
                    ProfileArg::Sinusoidal => Profile::Sinusoidal,
                },
                depth_rad,
            },
            PatternRequest::Lens { focal_length_mm, diameter_mm } => {
                Self::Lens { focal_length: metres(focal_length_mm), diameter: diameter_mm.map(metres) }
            }
            PatternRequest::Dots { spacing_px, diameter_px } => Self::Dots { spacing_px, diameter_px },
            PatternRequest::CrossHair { line_px } => Self::CrossHair { line_px },
            PatternRequest::FieldIdentity { radius_mm } => Self::FieldIdentity { radius: radius_mm.map(metres) },
        }
    }
}

/// Where it is drawn, and in which colours: in all of them where none is named.
pub(crate) fn placement(axis_px: [f64; 2], colours: &[ColourArg]) -> Placement {
    let named = |colour| colours.is_empty() || colours.iter().any(|&named| Colour::from(named) == colour);
    Placement { axis_px, colours: PerColour(Colour::ALL.map(named)) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_carry_their_units() {
        let lens: PatternRequest = serde_json::from_str(r#"{"kind":"lens","focal_length_mm":-250.0}"#).unwrap();
        assert_eq!(Pattern::from(lens), Pattern::Lens { focal_length: Metres(-0.25), diameter: None });
        let grating = r#"{"kind":"grating","period_px":6.5,"angle_deg":90.0,"profile":"binary"}"#;
        let read: PatternRequest = serde_json::from_str(grating).unwrap();
        assert_eq!(serde_json::to_string(&read).unwrap(), grating);
        for wrong in
            [r#"{"kind":"lens","focal_length":300}"#, r#"{"kind":"stripes"}"#, r#"{"kind":"level","level":-1}"#, "{}"]
        {
            assert!(serde_json::from_str::<PatternRequest>(wrong).is_err(), "{wrong}");
        }
    }
}

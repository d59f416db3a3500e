//! The display seen as a thin lens: how depths, blurs and angles map to the panel.

use crate::{Dioptres, Metres, PerColour, PupilDiameter, Resolution};

/// The optical numbers of a display on which a hologram depends.
///
/// The panel sits in the front focal plane of an eyepiece of focal length f, so an image plane at distance u from the
/// panel appears to the eye at vergence e_d = u/f² (Newton's form of the lens equation) and one panel pixel subtends
/// pitch/f.
///
/// Behind a relay of magnification M the panel's image has pixels of M·pitch, and its image planes lie M²·u from it. The
/// eye sees what it would see of the panel itself through an eyepiece of f/M, so that is the focal length here.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DisplayGeometry {
    /// Columns and rows of panel pixels, without the margins of the video frame.
    pub resolution: Resolution,
    /// Distance between the centres of neighbouring pixels.
    pub pixel_pitch: Metres,
    /// Wavelength of each colour's laser.
    pub wavelengths: PerColour<Metres>,
    /// Focal length of the eyepiece, over the magnification of the relay before it.
    pub eyepiece_focal_length: Metres,
    /// Vergence of the farthest depth that the display shows, 0 for infinity.
    pub depth_far: Dioptres,
    /// Vergence of the nearest depth that the display shows.
    pub depth_near: Dioptres,
}

impl DisplayGeometry {
    /// The default bench: 1920x1080 at 8 µm; 638, 520 and 450 nm; f = 40 mm; infinity to 35 cm.
    pub const DEFAULT: Self = Self {
        resolution: Resolution { width: 1920, height: 1080 },
        pixel_pitch: Metres(8e-6),
        wavelengths: PerColour([Metres(638e-9), Metres(520e-9), Metres(450e-9)]),
        eyepiece_focal_length: Metres(40e-3),
        depth_far: Dioptres(0.0),
        depth_near: Dioptres(1.0 / 0.35),
    };

    /// Distance u = f²·D from the panel to the image plane of depth `depth`.
    pub fn image_distance(&self, depth: Dioptres) -> Metres {
        let f_m = self.eyepiece_focal_length.0;
        Metres(f_m * f_m * depth.0)
    }

    /// The depth at normalised position `depth_normalised`: 0 the far end, 1 the near end, uniform in dioptres.
    pub fn depth_at(&self, depth_normalised: f64) -> Dioptres {
        Dioptres(self.depth_far.0 + depth_normalised * (self.depth_near.0 - self.depth_far.0))
    }

    /// The normalised position of `depth`; outside 0..=1 where the display cannot show it.
    pub fn normalised_depth(&self, depth: Dioptres) -> f64 {
        (depth.0 - self.depth_far.0) / (self.depth_near.0 - self.depth_far.0)
    }

    /// The angle that one pixel subtends at the eye, in radians.
    pub fn pixel_angle_rad(&self) -> f64 {
        self.pixel_pitch.0 / self.eyepiece_focal_length.0
    }

    /// Diameter in panel pixels of the circle of confusion of a point at `depth` for an eye focused at `focus`:
    /// c = s·|1/d − 1/d_f| as an angle, over the angle of a pixel.
    pub fn coc_px(&self, pupil: PupilDiameter, depth: Dioptres, focus: Dioptres) -> f64 {
        pupil.metres().0 * (depth.0 - focus.0).abs() / self.pixel_angle_rad()
    }

    /// The largest circle of confusion s·(f/p)·V, between the two ends of the depth range V, in panel pixels: what a
    /// weights file calls `volume_blur_px`.
    pub fn largest_coc_px(&self, pupil: PupilDiameter) -> f64 {
        self.coc_px(pupil, self.depth_far, self.depth_near)
    }

    /// The pupil for which [`Self::largest_coc_px`] is `blur_px`.
    pub fn pupil_of_largest_coc(&self, blur_px: f64) -> PupilDiameter {
        PupilDiameter::from_mm((blur_px * self.pixel_angle_rad() / self.volume().0 * 1e3) as f32)
    }

    /// By how much a pupil must change for the largest circle of confusion to change by an angle: φ/V.
    pub fn pupil_step_of_blur(&self, angle_rad: f64) -> Metres {
        Metres(angle_rad / self.volume().0)
    }

    /// The depth range V, from its far end to its near end.
    pub fn volume(&self) -> Dioptres {
        self.depth_near - self.depth_far
    }

    /// λ·(f/p)²·V of each colour, in squared panel pixels: the distance f²·V that the depth range's images span, times
    /// the wavelength. Its root is how far light spreads by diffraction from one end of the range to the other.
    pub fn volume_fresnel_px2(&self) -> PerColour<f64> {
        self.wavelengths.map(|wavelength| wavelength.0 * self.volume().0 / self.pixel_angle_rad().powi(2))
    }

    /// Width of the eyebox λf/p of each colour: the separation of the panel's diffraction orders at the eye.
    pub fn eyebox(&self) -> PerColour<Metres> {
        self.wavelengths.map(|wavelength| Metres(wavelength.0 * self.eyepiece_focal_length.0 / self.pixel_pitch.0))
    }

    /// Width λf/2p of the part of the eyebox that the 4f stop's half band fills. Light with a smooth phase goes no
    /// farther than that, so it is blurred over the depth range as by a pupil of this width at most:
    /// λ·(f/p)²·V/2, half of [`Self::volume_fresnel_px2`], whatever the width of the eye's own.
    pub fn half_band_eyebox(&self) -> PerColour<Metres> {
        self.eyebox().map(|width| Metres(width.0 / 2.0))
    }

    /// Half-angle s/2f that light must leave the panel with to fill the pupil, in radians: the band that a physically
    /// exact blur needs.
    pub fn blur_half_angle_rad(&self, pupil: PupilDiameter) -> f64 {
        pupil.metres().0 / (2.0 * self.eyepiece_focal_length.0)
    }

    /// Half-angle λ/2p to which the panel's pixels can send light in each colour, in radians: the band there is.
    pub fn panel_half_angle_rad(&self) -> PerColour<f64> {
        self.wavelengths.map(|wavelength| wavelength.0 / (2.0 * self.pixel_pitch.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BENCH: DisplayGeometry = DisplayGeometry::DEFAULT;

    fn close(actual: f64, expected: f64, tolerance: f64) -> bool {
        (actual - expected).abs() <= tolerance
    }

    #[test]
    fn default_bench_matches_the_design_figures() {
        assert!(close(BENCH.image_distance(BENCH.depth_near).0, 4.571e-3, 1e-6));
        assert!(close(BENCH.pixel_angle_rad(), 0.2e-3, 1e-12));
        for (pupil_mm, largest_px) in [(2.0, 28.57), (3.0, 42.86), (4.0, 57.14)] {
            assert!(close(BENCH.largest_coc_px(PupilDiameter::from_mm(pupil_mm)), largest_px, 0.01));
        }
        for (eyebox, expected_mm) in BENCH.eyebox().0.into_iter().zip([3.19, 2.60, 2.25]) {
            assert!(close(eyebox.0 * 1e3, expected_mm, 1e-9));
        }
    }

    #[test]
    fn a_pupil_as_wide_as_the_eyebox_needs_exactly_the_panel_band() {
        let green_eyebox_mm = (BENCH.eyebox().0[1].0 * 1e3) as f32;
        let needed = BENCH.blur_half_angle_rad(PupilDiameter::from_mm(green_eyebox_mm));
        // A pupil is an f32, so seven digits.
        assert!(close(needed, BENCH.panel_half_angle_rad().0[1], 1e-8));
    }

    #[test]
    fn blur_and_diffraction_over_the_volume_are_those_of_the_definitions() {
        // 638 nm · (40 mm / 8 µm)² / 0.35 m.
        for (found, expected_px2) in BENCH.volume_fresnel_px2().0.into_iter().zip([45.571_429, 37.142_857, 32.142_857])
        {
            assert!(close(found, expected_px2, 1e-6));
        }
        let bench = DisplayGeometry { depth_far: Dioptres(0.5), depth_near: Dioptres(2.5), ..BENCH };
        let pupil = PupilDiameter::from_mm(3.0);
        assert!(close(bench.volume().0, 2.0, 1e-12));
        assert!(close(bench.largest_coc_px(pupil), 30.0, 1e-5));
        assert!(close(bench.volume_fresnel_px2().0[1], 26.0, 1e-9));
        assert!(close(f64::from(bench.pupil_of_largest_coc(30.0).mm()), 3.0, 1e-6));
        // Both are in pixels: a panel that is finer, behind an eyepiece that is shorter, is the same bench to them.
        let same = DisplayGeometry { pixel_pitch: Metres(6.4e-6), eyepiece_focal_length: Metres(32e-3), ..bench };
        assert!(close(same.largest_coc_px(pupil), bench.largest_coc_px(pupil), 1e-9));
        assert!(close(same.volume_fresnel_px2().0[0], bench.volume_fresnel_px2().0[0], 1e-9));
    }

    #[test]
    fn a_pupil_as_wide_as_the_half_band_fills_is_blurred_by_half_the_diffraction() {
        let widths = BENCH.half_band_eyebox();
        for ((_, width), fresnel_px2) in widths.iter().zip(BENCH.volume_fresnel_px2().0) {
            let pupil = PupilDiameter::from_mm((width.0 * 1e3) as f32);
            assert!(close(BENCH.largest_coc_px(pupil), fresnel_px2 / 2.0, 1e-5));
        }
    }

    #[test]
    fn depth_normalisation_inverts() {
        for position in [0.0, 0.25, 0.5, 1.0] {
            assert!(close(BENCH.normalised_depth(BENCH.depth_at(position)), position, 1e-12));
        }
    }
}

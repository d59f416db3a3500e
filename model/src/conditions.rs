//! What networks are told of a bench and a pupil, and where a bench lies in what a network was trained for.
//!
//! All of it is in panel pixels, in which benches of any wavelength λ, pixel pitch p, focal length f and depth range V
//! compare. For an eye with the pupil s:
//!
//! ```text
//! blur over the depth range         b = s·(f/p)·V      px    DisplayGeometry::largest_coc_px
//! diffraction over the depth range  F = λ·(f/p)²·V     px²   DisplayGeometry::volume_fresnel_px2
//! ```
//!
//! Two benches that have the same b and F need the same hologram, as far as light goes in small angles.

use std::fmt;

use holod_calibration::{Colour, DisplayGeometry, PupilDiameter};
use serde::{Deserialize, Serialize};

/// The widest pupil that engines take. No eye's is half as wide; but scenes of wider ones on one bench stand for those
/// of eyes on another, whose pixels are finer.
pub const WIDEST_PUPIL: PupilDiameter = PupilDiameter::from_mm(20.0);
/// Focuses no farther apart are one.
pub(crate) const SAME_FOCUS_DPT: f64 = 1e-3;

const REFERENCE_BLUR_PX: f64 = 40.0;
const REFERENCE_FRESNEL_PX2: f64 = 40.0;
/// By which factor a bench's diffraction may lie outside what was trained before it is no longer run.
const FARTHEST_OUTSIDE: f64 = 1.5;
/// Relative difference below which two figures are the same.
const SAME: f64 = 1e-4;
/// The steps of the figures that would bring a bench inside, which are written with as many digits.
const FOCAL_LENGTH_STEP_MM: f64 = 0.1;
const PIXEL_PITCH_STEP_UM: f64 = 0.01;
const DEPTH_RANGE_STEP_DPT: f64 = 0.01;

/// The least and the most, of all benches and pupils that a network was trained for.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainedRange {
    /// Of the blur b.
    pub volume_blur_px: [f64; 2],
    /// Of the diffraction F, which each colour of a bench has its own of.
    pub volume_fresnel_px2: [f64; 2],
}

impl TrainedRange {
    /// The narrowest and the widest pupil for which the blur on `bench` is one that was trained.
    pub fn pupils(&self, bench: &DisplayGeometry) -> [PupilDiameter; 2] {
        self.volume_blur_px.map(|blur_px| bench.pupil_of_largest_coc(blur_px))
    }

    /// Where the diffraction of `bench` lies in what was trained.
    pub fn fit(&self, bench: &DisplayGeometry) -> BenchFit {
        let [least_px2, most_px2] = self.volume_fresnel_px2;
        let factor = |px2: f64| (px2 / most_px2).max(least_px2 / px2);
        let found_px2 = bench.volume_fresnel_px2();
        let outside: Vec<_> =
            found_px2.iter().map(|(colour, &px2)| (colour, px2)).filter(|&(_, px2)| factor(px2) > 1.0 + SAME).collect();
        let worst = outside.iter().map(|&(_, px2)| factor(px2)).fold(1.0, f64::max);
        if outside.is_empty() {
            return BenchFit::Inside;
        }
        let [shrunk, grown] = [f64::max, f64::min].map(|pick| found_px2.0.into_iter().reduce(pick).unwrap_or(f64::NAN));
        // By what all three would have to be multiplied, where one factor serves them all.
        let (at_least, at_most) = (least_px2 / grown, most_px2 / shrunk);
        let nearest = if at_most < 1.0 { at_most } else { at_least };
        // Towards the inside, so that what is said of the figures holds as they are written.
        let [smaller, larger] = if at_most < 1.0 { [f64::floor, f64::ceil] } else { [f64::ceil, f64::floor] };
        let rounded = |figure: f64, step: f64, round: fn(f64) -> f64| round(figure / step) * step;
        let outside = OutsideTraining {
            found_px2: outside,
            trained_px2: self.volume_fresnel_px2,
            inside_at: (at_least <= at_most * (1.0 + SAME)).then(|| InsideAt {
                eyepiece_focal_length_mm: rounded(
                    bench.eyepiece_focal_length.0 * 1e3 * nearest.sqrt(),
                    FOCAL_LENGTH_STEP_MM,
                    smaller,
                ),
                pixel_pitch_um: rounded(bench.pixel_pitch.0 * 1e6 / nearest.sqrt(), PIXEL_PITCH_STEP_UM, larger),
                depth_range_dpt: rounded(bench.volume().0 * nearest, DEPTH_RANGE_STEP_DPT, smaller),
            }),
        };
        if worst <= FARTHEST_OUTSIDE * (1.0 + SAME) { BenchFit::Near(outside) } else { BenchFit::Far(outside) }
    }
}

/// Where a bench lies in what a network was trained for.
#[derive(Clone, Debug, PartialEq)]
pub enum BenchFit {
    /// Every colour is inside.
    Inside,
    /// A colour is outside, by a factor of 1.5 at most.
    Near(OutsideTraining),
    /// A colour is farther outside.
    Far(OutsideTraining),
}

/// Colours whose diffraction over the depth range lies outside what a network was trained for.
#[derive(Clone, Debug, PartialEq)]
pub struct OutsideTraining {
    /// These colours, one at least, each with its diffraction F, px².
    pub found_px2: Vec<(Colour, f64)>,
    /// The least and the most that were trained.
    pub trained_px2: [f64; 2],
    /// What would bring all three colours inside; nothing where they are too far from one another.
    pub inside_at: Option<InsideAt>,
}

/// A figure of the bench any one of which, in place of its own, would bring it inside what was trained; rounded towards
/// the inside.
#[derive(Clone, Copy, Debug, PartialEq)]
#[expect(missing_docs, reason = "the names say it")]
pub struct InsideAt {
    pub eyepiece_focal_length_mm: f64,
    pub pixel_pitch_um: f64,
    pub depth_range_dpt: f64,
}

impl OutsideTraining {
    /// The same where the focal length of the bench is that of the eyepiece over `relay_magnification`
    /// ([`DisplayGeometry`]): what is said of the focal length is said of the eyepiece itself.
    #[must_use]
    pub fn behind_relay(mut self, relay_magnification: f64) -> Self {
        let too_large = self.found_px2.iter().any(|&(_, px2)| px2 > self.trained_px2[1]);
        if let Some(InsideAt { eyepiece_focal_length_mm, .. }) = &mut self.inside_at
            && relay_magnification != 1.0
        {
            let steps = *eyepiece_focal_length_mm * relay_magnification / FOCAL_LENGTH_STEP_MM;
            *eyepiece_focal_length_mm = FOCAL_LENGTH_STEP_MM * if too_large { steps.floor() } else { steps.ceil() };
        }
        self
    }
}

impl fmt::Display for OutsideTraining {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let found: Vec<_> = self.found_px2.iter().map(|(colour, px2)| format!("{px2:.2} px² in {colour}")).collect();
        let [least_px2, most_px2] = self.trained_px2;
        write!(
            f,
            "diffraction over this bench's depth range, λ·(f/p)²·V, is {}; the network was trained for {least_px2:.2} to \
             {most_px2:.2} px²; ",
            found.join(" and ")
        )?;
        match self.inside_at {
            Some(InsideAt { eyepiece_focal_length_mm, pixel_pitch_um, depth_range_dpt }) => write!(
                f,
                "a focal length of {eyepiece_focal_length_mm:.1} mm, a pixel pitch of {pixel_pitch_um:.2} µm or a depth \
                 range of {depth_range_dpt:.2} dioptres would bring it inside"
            ),
            None => f.write_str("the three colours are too far from one another for any one network of that range"),
        }?;
        f.write_str("; or train a network for this bench: model/training/README.md")
    }
}

impl std::error::Error for OutsideTraining {}

/// What networks are told of a bench and a pupil: log2(b / 40 px), and log2(F / 40 px²) of the mean of three colours,
/// both within what was trained. What networks compute with is the bench and the pupil themselves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Conditions {
    pub(crate) blur: f64,
    pub(crate) fresnel: f64,
}

impl Conditions {
    pub(crate) fn of(trained: &TrainedRange, bench: &DisplayGeometry, pupil: PupilDiameter) -> Self {
        let told = |found: f64, [least, most]: [f64; 2], reference: f64| (found.clamp(least, most) / reference).log2();
        let fresnel_px2 = bench.volume_fresnel_px2().0.iter().sum::<f64>() / 3.0;
        Self {
            blur: told(bench.largest_coc_px(pupil), trained.volume_blur_px, REFERENCE_BLUR_PX),
            fresnel: told(fresnel_px2, trained.volume_fresnel_px2, REFERENCE_FRESNEL_PX2),
        }
    }

    /// What normalised depth less a half is multiplied by in one of the maps that networks read.
    pub(crate) fn blur_scale(self) -> f64 {
        3.0 + 2.0 * self.blur
    }

    /// Blur and diffraction, in the order in which networks have them as maps and as inputs.
    pub(crate) fn told(self) -> [f64; 2] {
        [self.blur, self.fresnel]
    }
}

#[cfg(test)]
mod tests {
    use holod_calibration::{Dioptres, Metres, PerColour};

    use super::*;
    use crate::worst::worst;

    const BENCH: DisplayGeometry = DisplayGeometry::DEFAULT;
    const TRAINED: TrainedRange = TrainedRange { volume_blur_px: [10.0, 80.0], volume_fresnel_px2: [30.0, 50.0] };

    /// The default bench with another depth range, so that red's diffraction is `red_px2` and blue's 0.7 of it.
    fn bench(red_px2: f64) -> DisplayGeometry {
        let share = red_px2 / BENCH.volume_fresnel_px2()[Colour::Red];
        DisplayGeometry { depth_near: BENCH.depth_at(share), ..BENCH }
    }

    #[test]
    fn networks_are_told_logarithms_within_what_was_trained() {
        let told = |pupil_mm| Conditions::of(&TRAINED, &BENCH, PupilDiameter::from_mm(pupil_mm));
        // 14.2857 px to a millimetre, and (45.5714 + 37.1429 + 32.1429) / 3 px².
        let at_3_mm = Conditions { blur: (42.857_143f64 / 40.0).log2(), fresnel: (38.285_714f64 / 40.0).log2() };
        let apart = |a: Conditions, b: Conditions| worst([a.blur - b.blur, a.fresnel - b.fresnel].map(f64::abs));
        assert!(apart(told(3.0), at_3_mm) < 1e-6, "{:?}", told(3.0));
        assert!(apart(told(3.01), at_3_mm) > 1e-3, "the comparison is blind");
        assert_eq!((told(0.6).blur, told(0.1).blur), (-2.0, -2.0));
        assert_eq!((told(6.0).blur, told(19.0).blur), (1.0, 1.0));
        assert_eq!(told(6.0).blur_scale(), 5.0);
        let far = Conditions::of(&TRAINED, &bench(500.0), PupilDiameter::from_mm(3.0));
        assert!((far.fresnel - (50.0f64 / 40.0).log2()).abs() < 1e-12);
        let near = Conditions::of(&TRAINED, &bench(5.0), PupilDiameter::from_mm(3.0));
        assert!((near.fresnel - (30.0f64 / 40.0).log2()).abs() < 1e-12);
    }

    #[test]
    fn pupils_are_those_whose_blur_was_trained() {
        let [narrowest, widest] = TRAINED.pupils(&BENCH);
        assert!((narrowest.mm() - 0.7).abs() < 1e-6 && (widest.mm() - 5.6).abs() < 1e-6);
        let finer = DisplayGeometry { pixel_pitch: Metres(4e-6), ..BENCH };
        assert!((TRAINED.pupils(&finer)[1].mm() - 2.8).abs() < 1e-6);
    }

    #[test]
    fn a_bench_is_inside_what_was_trained_or_near_it_or_far() {
        let wide = TrainedRange { volume_fresnel_px2: [20.0, 50.0], ..TRAINED };
        assert_eq!(wide.fit(&bench(50.0)), BenchFit::Inside);
        assert_eq!(wide.fit(&bench(20.0 * 638.0 / 450.0)), BenchFit::Inside);
        // Two figures that are the same but for rounding.
        assert_eq!(wide.fit(&bench(50.0 * (1.0 + 1e-9))), BenchFit::Inside);
        for near_px2 in [50.1, 74.9, 75.0] {
            assert!(matches!(wide.fit(&bench(near_px2)), BenchFit::Near(_)), "{near_px2}");
        }
        for far_px2 in [75.1, 500.0] {
            assert!(matches!(wide.fit(&bench(far_px2)), BenchFit::Far(_)), "{far_px2}");
        }
        // Below, blue is the first to be outside: at 20 px² and, 1.5 times farther, at 13.3 px².
        let blue = |px2: f64| bench(px2 * 638.0 / 450.0);
        for (px2, is_far) in [(19.9, false), (13.4, false), (13.3, true), (1.0, true)] {
            assert_eq!(matches!(wide.fit(&blue(px2)), BenchFit::Far(_)), is_far, "{px2}");
            assert!(!matches!(wide.fit(&blue(px2)), BenchFit::Inside), "{px2}");
        }
    }

    #[test]
    fn what_is_outside_is_told_with_what_would_be_inside() {
        let BenchFit::Far(outside) = TRAINED.fit(&DisplayGeometry { pixel_pitch: Metres(4e-6), ..BENCH }) else {
            panic!("four times the diffraction")
        };
        // Red's 182.29 px² over 50 px² is 3.646.
        let said = outside.to_string();
        for part in [
            "182.29 px² in red",
            "148.57 px² in green",
            "30.00 to 50.00 px²",
            "focal length of 20.9 mm",
            "7.64 µm",
            "0.78 dioptres",
            "model/training/README.md",
        ] {
            assert!(said.contains(part), "`{part}` is not in: {said}");
        }
        let inside = outside.inside_at.unwrap();
        for bench in [
            DisplayGeometry { pixel_pitch: Metres(inside.pixel_pitch_um * 1e-6), ..BENCH },
            DisplayGeometry {
                pixel_pitch: Metres(4e-6),
                eyepiece_focal_length: Metres(inside.eyepiece_focal_length_mm * 1e-3),
                ..BENCH
            },
        ] {
            assert_eq!(TRAINED.fit(&bench), BenchFit::Inside);
        }
        // Each figure as it is written, on benches that are above and below what was trained.
        for focal_length_mm in (200..1200).step_by(7).map(|tenths| 0.1 * f64::from(tenths)) {
            let bench = DisplayGeometry { eyepiece_focal_length: Metres(1e-3 * focal_length_mm), ..BENCH };
            let (BenchFit::Near(outside) | BenchFit::Far(outside)) = TRAINED.fit(&bench) else { continue };
            let inside = outside.inside_at.unwrap();
            let written = |figure: f64, digits: usize| format!("{figure:.digits$}").parse::<f64>().unwrap();
            let depth_far = Dioptres(bench.depth_near.0 - written(inside.depth_range_dpt, 2));
            for bench in [
                DisplayGeometry {
                    eyepiece_focal_length: Metres(written(inside.eyepiece_focal_length_mm, 1) * 1e-3),
                    ..bench
                },
                DisplayGeometry { pixel_pitch: Metres(written(inside.pixel_pitch_um, 2) * 1e-6), ..bench },
                DisplayGeometry { depth_far, ..bench },
            ] {
                assert_eq!(TRAINED.fit(&bench), BenchFit::Inside, "{focal_length_mm} mm: {outside}");
            }
        }
        // Behind relays: what is said is to be written into the rig file.
        for (focal_length_mm, magnification) in [(30.0, 0.5), (60.0, 1.7), (28.0, 1.3)] {
            let behind = |focal_length_mm: f64| DisplayGeometry {
                eyepiece_focal_length: Metres(1e-3 * focal_length_mm / magnification),
                ..BENCH
            };
            let fit = TRAINED.fit(&behind(focal_length_mm));
            let (BenchFit::Near(outside) | BenchFit::Far(outside)) = fit else {
                panic!("{focal_length_mm} mm is inside")
            };
            let said = outside.behind_relay(magnification).to_string();
            let written = said.split("a focal length of ").nth(1).unwrap().split(" mm").next().unwrap();
            let inside = TRAINED.fit(&behind(written.parse().unwrap()));
            assert_eq!(inside, BenchFit::Inside, "{focal_length_mm} mm, {magnification}: {said}");
        }
        let BenchFit::Near(low) = TRAINED.fit(&bench(40.0)) else { panic!("blue has 28 px²") };
        assert_eq!(low.found_px2.len(), 1);
        assert!(low.to_string().contains("28.21 px² in blue") && low.inside_at.unwrap().depth_range_dpt > 2.6, "{low}");
        let apart = DisplayGeometry { wavelengths: PerColour([780e-9, 520e-9, 380e-9].map(Metres)), ..BENCH };
        let BenchFit::Near(apart) = TRAINED.fit(&apart) else { panic!("both ends are outside") };
        assert_eq!((apart.found_px2.len(), apart.inside_at), (2, None));
        assert!(apart.to_string().contains("too far from one another"), "{apart}");
    }
}

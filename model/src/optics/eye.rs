//! The simulated eye: what is seen of the phases that a panel really showed.

use holod_calibration::{Colour, Dioptres, DisplayGeometry, Metres, PerColour, PupilDiameter, Resolution};
use num_complex::Complex32;

use super::propagation::Propagator;
use super::{ComplexHologram, PhasePattern};
use crate::LinearImage;

/// An eye that looks into the display.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Eye {
    /// Diameter of its pupil, which lies centred in the eyebox.
    pub pupil: PupilDiameter,
    /// What it is focused at.
    pub focus: Dioptres,
}

/// The bench's optics from the panel to a retina.
///
/// Light leaves the panel, passes the 4f stop (|fx|, |fy| < 1/4p) and the pupil (a disc of radius (s/2)/(λf) in the
/// panel's spectrum), and is focused at u = f²·D. Both stops are hard. The panel is surrounded by darkness, unless it
/// is [`repeating`](Self::repeating).
///
/// The 4f stop is one of its own for each colour. A bench has one for all, as wide as red's: it passes |fx|, |fy| up to
/// λ_red/λ of that. Pictures differ little by it (40 to 46 dB in green and blue), but black beside bright marks is 2
/// times as bright there in green and 5 in blue, and 10 in blue around dots of 3 px.
pub struct SimulatedEye {
    geometry: DisplayGeometry,
    propagator: Propagator,
}

impl SimulatedEye {
    /// For patterns of `resolution` on the bench `geometry`, whose own resolution does not matter.
    pub fn new(geometry: &DisplayGeometry, resolution: Resolution) -> Self {
        Self { geometry: *geometry, propagator: Propagator::new(geometry, resolution) }
    }

    /// The same where the pattern goes on beyond its edges as if it were repeated: for a picture that is cut out of a
    /// larger one, where darkness would put light that rings round edges that are not there.
    pub fn repeating(geometry: &DisplayGeometry, resolution: Resolution) -> Self {
        Self { geometry: *geometry, propagator: Propagator::repeating(geometry, resolution) }
    }

    /// What `eye` sees of a phase pattern that was encoded with `amplitude_constant`, white = 1.
    pub fn view(&mut self, pattern: &PhasePattern, amplitude_constant: f32, eye: Eye) -> LinearImage {
        self.view_weighted(pattern, amplitude_constant, eye, PerColour([1.0; 3]))
    }

    /// The same with each colour's light multiplied by `light`: laser power times lit time, relative to those at which
    /// white is white.
    pub fn view_weighted(
        &mut self,
        pattern: &PhasePattern,
        amplitude_constant: f32,
        eye: Eye,
        light: PerColour<f32>,
    ) -> LinearImage {
        let mut image = LinearImage::black(pattern.resolution);
        for colour in Colour::ALL {
            let gain = amplitude_constant * amplitude_constant * light[colour];
            self.view_colour(colour, pattern.plane(colour), eye, gain, image.plane_mut(colour));
        }
        image
    }

    /// What `eye` sees of one colour's phases [height, width] in radians, intensities times `gain`, into `intensity`.
    pub fn view_colour(&mut self, colour: Colour, phase_rad: &[f32], eye: Eye, gain: f32, intensity: &mut [f32]) {
        assert_eq!(phase_rad.len(), self.propagator.resolution().pixels(), "phases have the eye's resolution");
        self.propagator.pad(|index| Complex32::cis(phase_rad[index]));
        self.see(colour, eye, gain, intensity);
    }

    /// What `eye` would see of a complex hologram if a panel could show it.
    pub fn view_field(&mut self, hologram: &ComplexHologram, eye: Eye) -> LinearImage {
        assert_eq!(hologram.resolution, self.propagator.resolution(), "the hologram has the eye's resolution");
        let mut image = LinearImage::black(hologram.resolution);
        for colour in Colour::ALL {
            let plane = hologram.plane(colour);
            self.propagator.pad(|index| plane[index]);
            self.see(colour, eye, 1.0, image.plane_mut(colour));
        }
        image
    }

    fn see(&mut self, colour: Colour, eye: Eye, gain: f32, intensity: &mut [f32]) {
        let Metres(wavelength_m) = self.geometry.wavelengths[colour];
        let pupil_radius = 0.5 * eye.pupil.metres().0 / (wavelength_m * self.geometry.eyepiece_focal_length.0);
        let u = self.geometry.image_distance(eye.focus);
        self.propagator.filter(colour, u, |[x, y]| {
            let in_pupil = x.per_m * x.per_m + y.per_m * y.per_m <= pupil_radius * pupil_radius;
            x.in_half_band && y.in_half_band && in_pupil
        });
        let width = self.propagator.resolution().width;
        for (y, row) in intensity.chunks_exact_mut(width).enumerate() {
            for (pixel, value) in row.iter_mut().zip(self.propagator.row(y)) {
                *pixel = value.norm_sqr() * gain;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::optics::DoublePhase;

    const BENCH: DisplayGeometry = DisplayGeometry::DEFAULT;
    const SIZE: Resolution = Resolution { width: 96, height: 72 };

    fn eye(pupil_mm: f32, focus_dpt: f64) -> Eye {
        Eye { pupil: PupilDiameter::from_mm(pupil_mm), focus: Dioptres(focus_dpt) }
    }

    /// A soft spot of amplitude 0.8 and 1/e radius `radius_px` that converges at `focus_dpt`.
    fn spot(focus_dpt: f64, radius_px: f32) -> ComplexHologram {
        let mut hologram = ComplexHologram::dark(SIZE);
        let mut propagator = Propagator::new(&BENCH, SIZE);
        for colour in Colour::ALL {
            let plane = hologram.plane_mut(colour);
            for (index, value) in plane.iter_mut().enumerate() {
                let (x, y) = ((index % SIZE.width) as f32 - 48.0, (index / SIZE.width) as f32 - 36.0);
                *value = Complex32::new(0.8 * (-(x * x + y * y) / (radius_px * radius_px)).exp(), 0.0);
            }
            propagator.propagate(plane, colour, Metres(-BENCH.image_distance(Dioptres(focus_dpt)).0));
        }
        hologram
    }

    #[test]
    fn a_phase_pattern_shows_the_field_that_it_encodes() {
        let hologram = spot(1.5, 14.0);
        let mut pattern = PhasePattern::flat(SIZE);
        DoublePhase::new(SIZE, 1.4).encode(&hologram, &mut pattern);
        let mut simulated = SimulatedEye::new(&BENCH, SIZE);
        let (field, phases) =
            (simulated.view_field(&hologram, eye(4.0, 1.5)), simulated.view(&pattern, 1.4, eye(4.0, 1.5)));
        for colour in Colour::ALL {
            let centre = 36 * SIZE.width + 48;
            let (expected, actual) = (field.plane(colour)[centre], phases.plane(colour)[centre]);
            assert!((expected - 0.64).abs() < 0.01, "{colour}: {expected}");
            assert!((actual - expected).abs() < 0.05, "{colour}: {actual} for {expected}");
        }
    }

    #[test]
    fn a_spot_is_sharpest_where_it_is_focused_and_a_narrow_pupil_sees_it_wider() {
        let hologram = spot(2.0, 4.0);
        let mut simulated = SimulatedEye::new(&BENCH, SIZE);
        let centre = 36 * SIZE.width + 48;
        let mut peak = |pupil_mm, focus_dpt| {
            simulated.view_field(&hologram, eye(pupil_mm, focus_dpt)).plane(Colour::Green)[centre]
        };
        assert!(peak(4.0, 2.0) > 1.2 * peak(4.0, 0.0));
        assert!(peak(4.0, 2.0) > 1.2 * peak(0.5, 2.0));
    }

    #[test]
    fn stop_and_pupil_cut_where_their_figures_say() {
        // The pupil's edge (s/2)/(λf) for s = 1 mm, in cycles a pixel: red 0.157, green 0.192, blue 0.222.
        let edges = [0.1567, 0.1923, 0.2222];
        let centre = 36 * SIZE.width + 48;
        let mut simulated = SimulatedEye::new(&BENCH, SIZE);
        let mut seen = |pupil_mm, fx: f32, fy: f32, colour| {
            let mut hologram = ComplexHologram::dark(SIZE);
            for (index, value) in hologram.plane_mut(colour).iter_mut().enumerate() {
                let (x, y) = ((index % SIZE.width) as f32, (index / SIZE.width) as f32);
                *value = Complex32::cis(std::f32::consts::TAU * (fx * x + fy * y));
            }
            simulated.view_field(&hologram, eye(pupil_mm, 0.0)).plane(colour)[centre]
        };
        for (colour, edge) in Colour::ALL.into_iter().zip(edges) {
            for (fx, fy) in [(1.0, 0.0), (0.0, -1.0), (0.6, 0.8)] {
                let (inside, outside) = (edge - 0.025, edge + 0.025);
                assert!(seen(1.0, inside * fx, inside * fy, colour) > 0.7, "{colour} {fx} {fy}");
                assert!(seen(1.0, outside * fx, outside * fy, colour) < 0.1, "{colour} {fx} {fy}");
            }
            // A wide pupil leaves the square 4f stop, corners included.
            assert!(seen(9.0, 0.225, 0.225, colour) > 0.7 && seen(9.0, -0.225, 0.0, colour) > 0.7, "{colour}");
            assert!(seen(9.0, 0.275, 0.0, colour) < 0.1 && seen(9.0, 0.0, 0.275, colour) < 0.1, "{colour}");
        }
    }

    #[test]
    fn the_stop_takes_light_on_its_edge_whatever_pitch_and_size_are() {
        for pitch_um in [3.6, 3.74, 6.4, 8.0, 9.2, 12.5] {
            let bench = DisplayGeometry { pixel_pitch: Metres(pitch_um / 1e6), ..BENCH };
            for width in 48..57 {
                for (size, fx, fy) in
                    [(Resolution { width, height: 8 }, 0.25, 0.0), (Resolution { width: 8, height: width }, 0.0, 0.25)]
                {
                    let mut simulated = SimulatedEye::repeating(&bench, size);
                    let mut seen = |scale: f32| {
                        let mut hologram = ComplexHologram::dark(size);
                        for (index, value) in hologram.plane_mut(Colour::Green).iter_mut().enumerate() {
                            let (x, y) = ((index % size.width) as f32, (index / size.width) as f32);
                            *value = Complex32::cis(std::f32::consts::TAU * scale * (fx * x + fy * y));
                        }
                        simulated.view_field(&hologram, eye(9.0, 0.0)).plane(Colour::Green)[0]
                    };
                    assert!(seen(0.0) > 0.99, "{pitch_um} µm, {size}");
                    if width % 4 == 0 {
                        assert!(seen(1.0) < 1e-6, "{pitch_um} µm, {size}");
                    }
                }
            }
        }
    }

    #[test]
    fn light_is_weighted_by_colour() {
        let mut pattern = PhasePattern::flat(SIZE);
        DoublePhase::new(SIZE, 1.0).encode(&spot(0.0, 14.0), &mut pattern);
        let mut simulated = SimulatedEye::new(&BENCH, SIZE);
        let plain = simulated.view(&pattern, 1.0, eye(3.0, 0.0));
        let weighted = simulated.view_weighted(&pattern, 1.0, eye(3.0, 0.0), PerColour([0.5, 1.0, 0.0]));
        let centre = 36 * SIZE.width + 48;
        assert!((weighted.plane(Colour::Red)[centre] - 0.5 * plain.plane(Colour::Red)[centre]).abs() < 1e-6);
        assert_eq!(weighted.plane(Colour::Green)[centre], plain.plane(Colour::Green)[centre]);
        assert!(weighted.plane(Colour::Blue).iter().all(|&value| value == 0.0));
    }
}

//! The whole rig, simulated: from the patterns that were on the panel and the lasers' edges to the picture that an eye
//! integrates.
//!
//! **Light and pattern.** While a laser is lit, the eye receives the light that the pattern on the panel makes of *its*
//! wavelength, whatever colour the pattern was meant for, and sees it in the laser's own colour. A level is a path
//! difference of the liquid crystal: the phase that the level has at its own field's wavelength, times that wavelength
//! over the laser's. The crystal's dispersion is left out.
//!
//! **While the panel settles,** each pixel's path goes from the old pattern's to the new one's as 1 − exp(−4 t/T), with
//! T the rig's settle time, at which it has arrived. It passes through everything in between, whole turns too: that is
//! how a liquid crystal gets from one level to another.
//!
//! **The eye** adds up intensities over time. White is what a laser that is lit for the rig's lit time on a settled
//! pattern of its own makes of amplitude 1: the white of [`SimulatedEye::view`].

use std::f64::consts::TAU;

use holod_calibration::rig::Rig;
use holod_calibration::{Colour, TimeNs};
use holod_model::LinearImage;
use holod_model::optics::{Eye, SimulatedEye};
use holod_slm_output::PanelEncoder;
use holod_slm_output::laser::{LaserEdge, LitWindow};

/// Parts into which the settle time is divided.
const SETTLE_STEPS: i64 = 16;
/// Settle times over the time constant of the panel's response.
const SETTLE_CONSTANTS: f64 = 4.0;

/// A pattern while it is on the panel.
#[derive(Clone, Copy, Debug)]
pub struct PatternOnPanel<'a> {
    /// The colour whose table its levels are of.
    pub colour: Colour,
    /// Levels `[panel height, panel width]`, row-major.
    pub levels: &'a [u16],
    /// When it came on the panel.
    pub t_present: TimeNs,
    /// When the next one did.
    pub t_end: TimeNs,
}

/// What happened on a rig.
pub struct Exposure<'a> {
    /// The rig whose panel and lasers these were.
    pub rig: &'a Rig,
    /// The encoder that made the levels.
    pub encoder: &'a PanelEncoder,
    /// The double phase's amplitude constant.
    pub amplitude_constant: f32,
    /// What was on the panel, in order and without overlap. The first one is taken as settled.
    pub patterns: &'a [PatternOnPanel<'a>],
    /// What the lasers did, in order.
    pub edges: &'a [LaserEdge],
}

/// What an eye saw.
#[derive(Clone, Debug, PartialEq)]
pub struct Seen {
    /// The picture, white = 1.
    pub picture: LinearImage,
    /// Laser light at times of which no pattern is known, which is not in the picture.
    pub unexplained: TimeNs,
}

impl Exposure<'_> {
    /// What `eye` behind `optics` integrates from `from` to `to`.
    ///
    /// # Panics
    /// Where `optics` have another size than the encoder's patterns, and where levels have another than its panel.
    pub fn seen(&self, optics: &mut SimulatedEye, eye: Eye, from: TimeNs, to: TimeNs) -> Seen {
        let resolution = self.encoder.pattern_resolution();
        let mut seen = Seen { picture: LinearImage::black(resolution), unexplained: TimeNs(0) };
        let mut intensity = vec![0.0; resolution.pixels()];
        let lit = lit_windows(self.edges, from, to);
        for window in &lit {
            let explained: i64 = self.patterns.iter().map(|pattern| overlap(pattern, window).map_or(0, length)).sum();
            seen.unexplained = seen.unexplained + TimeNs((window.t_off - window.t_on).0 - explained);
        }
        let mut before: Option<Vec<f32>> = None;
        for pattern in self.patterns {
            let after_m = self.paths_m(pattern);
            for window in &lit {
                let Some(lit) = overlap(pattern, window) else { continue };
                for (arrived, part) in self.steps(pattern.t_present, lit, before.is_some()) {
                    let phases_rad = self.phases_rad(before.as_deref(), &after_m, arrived, window.colour);
                    let share = length(part) as f64 / self.rig.lasers.width.0 as f64;
                    let gain = self.amplitude_constant * self.amplitude_constant * share as f32;
                    optics.view_colour(window.colour, &phases_rad, eye, gain, &mut intensity);
                    for (sum, light) in seen.picture.plane_mut(window.colour).iter_mut().zip(&intensity) {
                        *sum += light;
                    }
                }
            }
            before = Some(after_m);
        }
        seen
    }

    /// The path difference of each pixel of the pattern, metres.
    fn paths_m(&self, pattern: &PatternOnPanel<'_>) -> Vec<f32> {
        let m_per_rad = (self.rig.geometry.wavelengths[pattern.colour].0 / TAU) as f32;
        let mut paths_m = self.encoder.decode_unwrapped(pattern.colour, pattern.levels);
        paths_m.iter_mut().for_each(|path| *path *= m_per_rad);
        paths_m
    }

    /// Phases for `laser` when the panel has gone the share `arrived` of the way from `before_m` to `after_m`.
    fn phases_rad(&self, before_m: Option<&[f32]>, after_m: &[f32], arrived: f64, laser: Colour) -> Vec<f32> {
        let rad_per_m = (TAU / self.rig.geometry.wavelengths[laser].0) as f32;
        match before_m {
            Some(before_m) if arrived < 1.0 => {
                let arrived = arrived as f32;
                let between = before_m.iter().zip(after_m).map(|(before, after)| before + (after - before) * arrived);
                between.map(|path_m| path_m * rad_per_m).collect()
            }
            _ => after_m.iter().map(|path_m| path_m * rad_per_m).collect(),
        }
    }

    /// Cuts the time `lit` where the panel still moves; each part with how far it has come in its middle.
    fn steps(&self, t_present: TimeNs, lit: (TimeNs, TimeNs), moves: bool) -> Vec<(f64, (TimeNs, TimeNs))> {
        let settle = if moves { self.rig.panel.settle } else { TimeNs(0) };
        let cut = |step: i64| t_present + TimeNs(settle.0 * step / SETTLE_STEPS);
        let mut parts = Vec::new();
        for step in 0..SETTLE_STEPS {
            let part = (cut(step).max(lit.0), cut(step + 1).min(lit.1));
            if length(part) > 0 {
                let middle = 0.5 * ((part.0 - t_present).seconds() + (part.1 - t_present).seconds());
                parts.push((arrived(middle / settle.seconds()), part));
            }
        }
        let still = (cut(SETTLE_STEPS).max(lit.0), lit.1);
        if length(still) > 0 {
            parts.push((1.0, still));
        }
        parts
    }
}

/// How far the panel has come after this share of its settle time.
fn arrived(settle_share: f64) -> f64 {
    let approach = |share: f64| 1.0 - (-SETTLE_CONSTANTS * share).exp();
    if settle_share >= 1.0 { 1.0 } else { approach(settle_share) / approach(1.0) }
}

/// Each laser's lit times between `from` and `to`. A laser that goes off first was lit before, one that never goes off
/// is lit to the end.
fn lit_windows(edges: &[LaserEdge], from: TimeNs, to: TimeNs) -> Vec<LitWindow> {
    let mut windows = Vec::new();
    for colour in Colour::ALL {
        let mut t_on = None;
        let mut seen_any = false;
        for edge in edges.iter().filter(|edge| edge.colour == colour) {
            match (edge.on, t_on) {
                (true, None) => t_on = Some(edge.t),
                (false, Some(on)) => windows.push(LitWindow { colour, t_on: on, t_off: edge.t }),
                (false, None) if !seen_any => windows.push(LitWindow { colour, t_on: from, t_off: edge.t }),
                _ => {}
            }
            seen_any = true;
            t_on = t_on.filter(|_| edge.on);
        }
        windows.extend(t_on.map(|t_on| LitWindow { colour, t_on, t_off: to }));
    }
    let within = |window: LitWindow| LitWindow { t_on: window.t_on.max(from), t_off: window.t_off.min(to), ..window };
    windows.into_iter().map(within).filter(|window| window.t_off > window.t_on).collect()
}

fn overlap(pattern: &PatternOnPanel<'_>, window: &LitWindow) -> Option<(TimeNs, TimeNs)> {
    let both = (pattern.t_present.max(window.t_on), pattern.t_end.min(window.t_off));
    (length(both) > 0).then_some(both)
}

fn length((from, to): (TimeNs, TimeNs)) -> i64 {
    to.0 - from.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use holod_calibration::{Dioptres, PerColour, PupilDiameter, Resolution};
    use holod_model::optics::{ComplexHologram, DoublePhase, PhasePattern};
    use holod_slm_output::{FrameLayout, LevelsFrame};

    use crate::pictures::shown_pattern;

    const SIZE: Resolution = Resolution { width: 48, height: 32 };
    const EYE: Eye = Eye { pupil: PupilDiameter::from_mm(6.0), focus: Dioptres(0.0) };
    const CENTRE: usize = 16 * 48 + 24;
    const CONSTANT: f32 = 1.2;

    struct Bench {
        rig: Rig,
        encoder: PanelEncoder,
        frames: Vec<LevelsFrame>,
    }

    /// A rig and frames of levels that show the amplitudes, by pixel and colour, of each picture.
    fn bench(pictures: &[&dyn Fn(usize, Colour) -> f32]) -> Bench {
        let rig = Rig::default();
        let encoder = PanelEncoder::new(&rig.panel, SIZE, SIZE).unwrap();
        let mut double_phase = DoublePhase::new(SIZE, CONSTANT);
        let frames = pictures.iter().map(|amplitude| {
            let mut hologram = ComplexHologram::dark(SIZE);
            for colour in Colour::ALL {
                for (pixel, value) in hologram.plane_mut(colour).iter_mut().enumerate() {
                    value.re = CONSTANT * amplitude(pixel, colour);
                }
            }
            let mut pattern = PhasePattern::flat(SIZE);
            double_phase.encode(&hologram, &mut pattern);
            let mut frame = LevelsFrame::new(FrameLayout::new(&rig.panel, SIZE));
            encoder.encode(PerColour(Colour::ALL.map(|colour| pattern.plane(colour))), &mut frame);
            frame
        });
        Bench { frames: frames.collect(), rig, encoder }
    }

    impl Bench {
        fn field(&self) -> i64 {
            self.rig.panel.field_period().0
        }

        /// What the eye sees of the last frame when each laser is late by `late` nanoseconds. Frames follow each other
        /// on the panel; the last one comes again after itself, and nothing is known of what follows.
        fn seen(&self, late: i64) -> Seen {
            let shown: Vec<_> = self.frames.iter().chain(self.frames.last()).collect();
            let mut levels = Vec::new();
            for frame in &shown {
                levels.extend(self.rig.panel.field_order.map(|colour| (colour, frame.unpack_colour(colour).levels)));
            }
            let begin = |index: usize| TimeNs(index as i64 * self.field());
            let patterns: Vec<_> = levels
                .iter()
                .enumerate()
                .map(|(index, (colour, levels))| PatternOnPanel {
                    colour: *colour,
                    levels,
                    t_present: begin(index),
                    t_end: begin(index + 1),
                })
                .collect();
            let first = 3 * (self.frames.len() - 1);
            let on_after = self.rig.panel.settle + self.rig.lasers.on_delay + TimeNs(late);
            let edges: Vec<_> = (first..first + 3)
                .flat_map(|index| {
                    let (colour, t_on) = (patterns[index].colour, begin(index) + on_after);
                    let t_off = t_on + self.rig.lasers.width;
                    [LaserEdge { t: t_on, colour, on: true }, LaserEdge { t: t_off, colour, on: false }]
                })
                .collect();
            let exposure = Exposure {
                rig: &self.rig,
                encoder: &self.encoder,
                amplitude_constant: CONSTANT,
                patterns: &patterns,
                edges: &edges,
            };
            let mut optics = SimulatedEye::repeating(&self.rig.geometry, SIZE);
            exposure.seen(&mut optics, EYE, begin(0), begin(patterns.len() + 3))
        }
    }

    fn farthest_apart(a: &LinearImage, b: &LinearImage) -> f32 {
        let planes = Colour::ALL.into_iter().flat_map(|colour| a.plane(colour).iter().zip(b.plane(colour)));
        // By the total order a value that is no number is the largest.
        planes.map(|(a, b)| (a - b).abs()).max_by(f32::total_cmp).unwrap_or(f32::NAN)
    }

    /// The least and the greatest light at 8 px or more from a bright pattern that is smaller than its panel, white 1.
    fn light_around(frame: impl FnOnce(&PanelEncoder, &mut LevelsFrame)) -> (f32, f32) {
        const AWAY: usize = 8;
        let panel = Resolution { width: 95, height: 70 };
        let rig = Rig::default();
        let encoder = PanelEncoder::new(&rig.panel, panel, SIZE).unwrap();
        let mut levels = LevelsFrame::new(FrameLayout::new(&rig.panel, panel));
        frame(&encoder, &mut levels);
        let phases_rad = encoder.decode(Colour::Green, &levels.unpack_colour(Colour::Green).levels);
        let mut light = vec![0.0; panel.pixels()];
        SimulatedEye::new(&rig.geometry, panel).view_colour(
            Colour::Green,
            &phases_rad,
            EYE,
            CONSTANT * CONSTANT,
            &mut light,
        );
        let (left, top) = ((panel.width - SIZE.width) / 2, (panel.height - SIZE.height) / 2);
        let is_away = |pixel: usize| {
            let (x, y) = (pixel % panel.width, pixel / panel.width);
            let from_edges = [x, panel.width - 1 - x, y, panel.height - 1 - y];
            let is_near =
                x + AWAY >= left && x < left + SIZE.width + AWAY && y + AWAY >= top && y < top + SIZE.height + AWAY;
            !is_near && from_edges.into_iter().all(|distance| distance >= AWAY)
        };
        let around = light.iter().enumerate().filter(|(pixel, _)| is_away(*pixel)).map(|(_, light)| *light);
        around.fold((f32::INFINITY, f32::NEG_INFINITY), |(least, most), light| (least.min(light), most.max(light)))
    }

    #[test]
    fn what_surrounds_a_small_pattern_is_dark_to_an_eye_that_sees_the_whole_panel() {
        let bright = bench(&[&|_, _| 1.0]);
        let phases_rad = bright.encoder.decode(Colour::Green, &bright.frames[0].unpack_colour(Colour::Green).levels);
        let (_, most) = light_around(|encoder, frame| {
            encoder.encode(PerColour([&phases_rad[..]; 3]), frame);
        });
        assert!(most < 5e-3, "{most}");
        // Phase 0 in its place would be brighter than white.
        let (least, _) = light_around(|encoder, frame| encoder.encode_flat(frame));
        assert!(least > 1.2, "{least}");
    }

    #[test]
    fn in_step_the_eye_sees_what_view_shows() {
        let ramps = |pixel: usize, colour: Colour| match colour {
            Colour::Red => (pixel % 48) as f32 / 48.0,
            Colour::Green => (pixel / 48) as f32 / 32.0,
            Colour::Blue => 0.5,
        };
        let bench = bench(&[&ramps]);
        let seen = bench.seen(0);
        assert_eq!(seen.unexplained, TimeNs(0));
        let pattern = shown_pattern(&bench.encoder, &bench.frames[0]);
        let mut optics = SimulatedEye::repeating(&bench.rig.geometry, SIZE);
        let mut viewed = optics.view(&pattern, CONSTANT, EYE);
        assert!(farthest_apart(&seen.picture, &viewed) < 2e-5, "{}", farthest_apart(&seen.picture, &viewed));
        // Canary: one wrong value is found.
        viewed.plane_mut(Colour::Blue)[7] += 1e-3;
        assert!(farthest_apart(&seen.picture, &viewed) > 2e-5);
    }

    /// The brightness of an even field of amplitude `amplitude`, made for `field` and lit by `laser`: pixels alternate
    /// between the paths of ±acos a, of which the negative one is a wave longer.
    fn lit_by_hand(bench: &Bench, amplitude: f64, field: Colour, laser: Colour) -> f64 {
        let waves = bench.rig.geometry.wavelengths[field].0 / bench.rig.geometry.wavelengths[laser].0;
        let level = |phase_rad: f64| (phase_rad.rem_euclid(TAU) * 256.0 / TAU).round() * TAU / 256.0;
        let [up, down] = [level(amplitude.acos()), level(-amplitude.acos())];
        f64::from(CONSTANT).powi(2) * (0.5 * (up - down) * waves).cos().powi(2)
    }

    #[test]
    fn one_field_late_each_laser_lights_the_next_colours_pattern() {
        let amplitudes = PerColour([0.9f32, 0.4, 0.05]);
        let bench = bench(&[&|_, colour| amplitudes[colour]]);
        let (right, wrong) = (bench.seen(0).picture, bench.seen(bench.field()).picture);
        for (laser, next) in [(Colour::Red, Colour::Green), (Colour::Green, Colour::Blue), (Colour::Blue, Colour::Red)]
        {
            let close = |found: f32, expected: f64| (f64::from(found) - expected).abs() < 1e-4;
            let (own, others) = (right.plane(laser)[CENTRE], wrong.plane(laser)[CENTRE]);
            assert!(close(own, lit_by_hand(&bench, amplitudes[laser].into(), laser, laser)), "{laser}: {own}");
            let expected = lit_by_hand(&bench, amplitudes[next].into(), next, laser);
            assert!(close(others, expected), "{laser} on {next}'s pattern: {others} for {expected}");
            assert!((own - others).abs() > 0.05, "{laser}: the two differ");
        }
    }

    #[test]
    fn a_laser_that_is_early_sees_the_panel_move() {
        // Black, then white. Red comes on with the white pattern, before it has settled: the pixels are then on their
        // way from a quarter and three quarters of a wave of blue, the field before red, to the same path.
        let mut bench = bench(&[&|_, _| 0.0, &|_, _| 1.0]);
        let early = -(bench.rig.panel.settle + bench.rig.lasers.on_delay).0;
        bench.rig.lasers.width = bench.rig.panel.settle;
        let seen = bench.seen(early).picture.plane(Colour::Red)[CENTRE];
        let waves = bench.rig.geometry.wavelengths[Colour::Blue].0 / bench.rig.geometry.wavelengths[Colour::Red].0;
        let samples = 10_000;
        let by_hand = (0..samples).map(|sample| {
            let left = 1.0 - arrived((f64::from(sample) + 0.5) / f64::from(samples));
            // Half of the difference between three quarters and a quarter of a wave.
            (0.25 * TAU * waves * left).cos().powi(2)
        });
        let expected = by_hand.sum::<f64>() / f64::from(samples) * f64::from(CONSTANT).powi(2);
        assert!((f64::from(seen) - expected).abs() < 0.005, "{seen} for {expected}");
        assert!(expected < 0.95 * f64::from(CONSTANT).powi(2), "it is not what a settled panel shows");
        let settled = bench.seen(0).picture.plane(Colour::Red)[CENTRE];
        assert!((settled - CONSTANT * CONSTANT).abs() < 1e-3, "{settled}");
    }

    #[test]
    fn light_over_an_unknown_pattern_is_counted_and_not_shown() {
        let bench = bench(&[&|_, _| 1.0]);
        // Red meets the last pattern, blue's; green and blue come when it is over.
        let seen = bench.seen(5 * bench.field());
        assert_eq!(seen.unexplained, TimeNs(2 * bench.rig.lasers.width.0));
        let [red, green, blue] = Colour::ALL.map(|colour| seen.picture.plane(colour)[CENTRE]);
        assert!(red > 1.0 && green == 0.0 && blue == 0.0, "{red} {green} {blue}");
    }

    #[test]
    fn edges_become_lit_times() {
        let edge = |t, colour, on| LaserEdge { t: TimeNs(t), colour, on };
        let (red, blue) = (Colour::Red, Colour::Blue);
        let edges = [edge(5, red, false), edge(20, blue, true), edge(30, red, true), edge(40, red, false)];
        let windows = lit_windows(&edges, TimeNs(0), TimeNs(100));
        let window = |colour, t_on, t_off| LitWindow { colour, t_on: TimeNs(t_on), t_off: TimeNs(t_off) };
        assert_eq!(windows, [window(red, 0, 5), window(red, 30, 40), window(blue, 20, 100)]);
        assert_eq!(lit_windows(&edges, TimeNs(35), TimeNs(36)), [window(red, 35, 36), window(blue, 35, 36)]);
    }
}

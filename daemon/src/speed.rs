//! How many frames a second there are, how many the panel could show, and what would bring more; and whether a GPU
//! computes what the processor does.

use std::f32::consts::TAU;
use std::sync::Arc;
use std::time::Instant;

use holod_calibration::rig::{Panel, Rig, WeightsChoice};
use holod_calibration::{Colour, PerColour, PupilDiameter, Resolution, TimeNs};
use holod_model::{RgbdFrame, Weights};
use holod_slm_output::LevelsFrame;
use holod_slm_output::pacing::refreshes_for;
use holod_slm_output::present::PanelTiming;

use crate::cli::Backend;
use crate::failure::{Exit, Failure};
use crate::renderer::{self, Renderer, Use};
use crate::source::scene;

/// A display that shows less than this share of the panel's frames is called slow.
const ENOUGH: f64 = 0.9;
/// The sides of the frames that are timed.
const TIMED_PX: [usize; 2] = [256, 512];
/// A side that is advised is a multiple of this, and not less than [`LEAST_SIDE_PX`].
const SIDE_STEP_PX: usize = 16;
const LEAST_SIDE_PX: usize = 64;

/// Rows or columns of what a GPU is compared at.
const STRIP_PX: usize = 64;
/// Phases of two engines are the same up to this, the step of a panel of 256 levels.
const SAME_PHASE_RAD: f32 = TAU / 256.0;
/// The frames are for this pupil, or the nearest that was trained: one at which every stage has something to do.
const PUPIL_MM: f32 = 3.0;

/// A GPU whose phases or levels are farther from the processor's at more than this share of the pixels computes
/// wrongly. Where the field is dark, little changes its phase; of `standard` and `fast` not one pixel was so in half
/// precision.
pub(crate) fn most_apart(engine: &str) -> f64 {
    if engine.contains("half precision") { 1e-2 } else { 1e-3 }
}

/// Whether an engine of this description computes on a GPU, or on what plays one.
pub(crate) fn is_gpu(engine: &str) -> bool {
    engine.starts_with("gpu, ")
}

/// Which engine a run would have for frames of `size` on the rig's panel, by its description.
///
/// # Errors
/// The backend is not to be had at this size, or the rig contradicts itself.
pub(crate) fn engine_at(rig: &Rig, weights: &Weights, backend: Backend, size: Resolution) -> Result<String, Failure> {
    let encoder = renderer::panel_encoder(rig, size)?;
    Ok(renderer::open(backend, weights, rig, &encoder, &Use::Command)?.description().to_owned())
}

/// Frames of all colours that the panel can show in a second.
pub(crate) fn panel_frames_hz(panel: &Panel) -> f64 {
    panel.refresh_hz * panel.mode.fields_per_refresh() / panel.fields() as f64
}

/// Frames a second that the panel shows where each takes so long to make: one for every n-th of its own, as they are
/// paced.
pub(crate) fn shown_hz(frame_time: TimeNs, panel: &Panel) -> f64 {
    let timing = PanelTiming::new(panel);
    let taken = refreshes_for(frame_time + timing.submit_margin(), timing.frame_period.0 as f64);
    panel_frames_hz(panel) / taken
}

/// What would bring `frames_hz` frames of `size`, by an engine of the description `engine`, nearer to the panel's;
/// nothing where there are enough.
pub(crate) fn advice(frames_hz: f64, engine: &str, rig: &Rig, size: Resolution) -> Option<String> {
    let panel_hz = panel_frames_hz(&rig.panel);
    if frames_hz >= ENOUGH * panel_hz {
        return None;
    }
    let mut cures = Vec::new();
    let smaller = match (&rig.model.weights, is_gpu(engine)) {
        (WeightsChoice::Standard, false) => "--weights small takes about 0.7 of the time, --weights fast 0.5",
        (WeightsChoice::Standard, true) => "--weights small takes about 0.5 of the time, --weights fast 0.3",
        (WeightsChoice::Small, false) => "--weights fast takes about 0.7 of the time",
        (WeightsChoice::Small, true) => "--weights fast takes about 0.6 of the time",
        (WeightsChoice::Fast | WeightsChoice::File(_), _) => "",
    };
    if !smaller.is_empty() {
        cures.push(smaller.to_owned());
    }
    // Time goes with the number of pixels.
    let shrunk = |side: usize| {
        let side = side as f64 * (frames_hz / panel_hz).sqrt();
        (side as usize / SIDE_STEP_PX * SIDE_STEP_PX).max(LEAST_SIDE_PX)
    };
    let small = Resolution { width: shrunk(size.width), height: shrunk(size.height) };
    if small.width < size.width && small.height < size.height {
        cures.push(format!("--resolution {small} (with --fit contain where a scene is named) is about what keeps up"));
    }
    let other = match is_gpu(engine) {
        true if engine.contains(renderer::PLAYS_A_GPU) => "--backend cpu helps, and a GPU",
        true => "a faster GPU helps",
        false => "a GPU helps, or more or faster cores",
    };
    cures.push(other.to_owned());
    Some(cures.join("; "))
}

/// The times of two small frames, from which those of others are estimated.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Estimate {
    /// How the frames were computed.
    pub engine: String,
    /// Their sizes, the smaller first.
    pub timed: [Resolution; 2],
    seconds: [f64; 2],
    /// Seconds that the processor takes for the smaller one, where a GPU computed it.
    processor_s: Option<f64>,
}

impl Estimate {
    /// Times small frames on the rig's panel, each after one that warms up.
    ///
    /// # Errors
    /// The backend is not to be had, its device fails, or the rig contradicts itself.
    pub(crate) fn of(rig: &Rig, weights: &Weights, backend: Backend) -> Result<Self, Failure> {
        let panel = rig.resolution();
        let timed = TIMED_PX.map(|side| Resolution { width: side.min(panel.width), height: side.min(panel.height) });
        let time = |backend, size| Timed::new(rig, weights, backend, size);
        let [smaller, larger] = [time(backend, timed[0])?, time(backend, timed[1])?];
        let engine = larger.renderer.description().to_owned();
        let processor_s = match is_gpu(&engine) {
            true => Some(time(Backend::Cpu, timed[0])?.seconds),
            false => None,
        };
        Ok(Self { engine, timed, seconds: [smaller.seconds, larger.seconds], processor_s })
    }

    /// As if they had taken `seconds` by `engine`.
    #[cfg(test)]
    pub(crate) fn taking(engine: &str, timed: [Resolution; 2], seconds: [f64; 2]) -> Self {
        Self { engine: engine.to_owned(), timed, seconds, processor_s: None }
    }

    /// What the processor would take, where it is faster than the GPU that computes.
    pub(crate) fn faster_processor(&self) -> Option<String> {
        let ([gpu_s, _], [size, _]) = (self.seconds, self.timed);
        let processor_s = self.processor_s.filter(|&processor_s| processor_s < gpu_s)?;
        let [gpu_ms, processor_ms] = [gpu_s, processor_s].map(|seconds| seconds * 1e3);
        Some(format!("for {size} the processor takes {processor_ms:.0} ms (--backend cpu), this GPU {gpu_ms:.0} ms"))
    }

    /// The time of a frame of `size`: some of it goes with frames, as what a GPU takes to begin, the rest with the
    /// pixels.
    pub(crate) fn frame_time(&self, size: Resolution) -> TimeNs {
        let ([smaller, larger], [smaller_s, larger_s]) = (self.timed.map(|size| size.pixels() as f64), self.seconds);
        // Not less for a frame that took longer, nor more for each pixel than all of them took.
        let by_pixel = if larger > smaller { (larger_s - smaller_s) / (larger - smaller) } else { f64::INFINITY };
        let by_pixel = by_pixel.clamp(0.0, larger_s / larger);
        TimeNs::from_seconds(larger_s + by_pixel * (size.pixels() as f64 - larger))
    }
}

/// A renderer that has made the sample frame of a size, and the seconds that it takes.
struct Timed {
    renderer: Box<dyn Renderer>,
    seconds: f64,
}

impl Timed {
    fn new(rig: &Rig, weights: &Weights, backend: Backend, size: Resolution) -> Result<Self, Failure> {
        let encoder = renderer::panel_encoder(rig, size)?;
        let renderer = renderer::open(backend, weights, rig, &encoder, &Use::Command)?;
        let (frame, levels) = (Arc::new(scene::sample_frame(size)), LevelsFrame::new(encoder.layout()));
        Self::by(renderer, &frame, usual_pupil(weights, rig), levels)
    }

    fn by(
        mut renderer: Box<dyn Renderer>,
        frame: &Arc<RgbdFrame>,
        pupil: PupilDiameter,
        mut levels: LevelsFrame,
    ) -> Result<Self, Failure> {
        let mut seconds = f64::MAX;
        for _ in 0..2 {
            let began = Instant::now();
            let rendered = renderer.render(frame, pupil, &mut levels).map_err(Failure::because(Exit::Unavailable))?;
            if rendered.engine_changed {
                return Err(renderer::failed_while_timed(&*renderer));
            }
            seconds = seconds.min(began.elapsed().as_secs_f64());
        }
        renderer::check_last_hologram(&mut *renderer)?;
        Ok(Self { renderer, seconds })
    }
}

fn usual_pupil(weights: &Weights, rig: &Rig) -> PupilDiameter {
    let [narrowest, widest] = weights.trained_pupils(&rig.geometry).map(PupilDiameter::mm);
    PupilDiameter::from_mm(PUPIL_MM.clamp(narrowest, widest))
}

/// What a GPU is compared at for frames of `size`: its shaders are written for the lengths of lines, so a frame's width
/// and a frame's height, by few rows and columns.
pub(crate) fn strips(size: Resolution) -> [Resolution; 2] {
    let Resolution { width, height } = size;
    [Resolution { width, height: height.min(STRIP_PX) }, Resolution { width: width.min(STRIP_PX), height }]
}

/// The share of pixels, of all colours, at which a GPU does not compute what the processor does: the phases of strips
/// of a frame of `size`, for two pupils, or the levels that it makes of its phases for the rig's panel, whichever are
/// more. Nothing where the processor computes them.
///
/// # Errors
/// The backend is not to be had, its device fails, or the rig contradicts itself.
pub(crate) fn compare(
    rig: &Rig,
    weights: &Weights,
    backend: Backend,
    size: Resolution,
) -> Result<Option<f64>, Failure> {
    let failed = Failure::because(Exit::Unavailable);
    let [narrowest, _] = weights.trained_pupils(&rig.geometry);
    let mut apart = 0.0_f64;
    for strip in strips(size) {
        let encoder = renderer::panel_encoder(rig, strip)?;
        let open = |backend| renderer::open(backend, weights, rig, &encoder, &Use::Command);
        let mut gpu = open(backend)?;
        if gpu.cpu_threads().is_some() {
            return Ok(None);
        }
        let mut processor = open(Backend::Cpu)?;
        let frame = Arc::new(scene::sample_frame(strip));
        let [mut found, mut expected] = [(); 2].map(|()| LevelsFrame::new(encoder.layout()));
        for pupil in [usual_pupil(weights, rig), narrowest] {
            processor.render(&frame, pupil, &mut expected).map_err(&failed)?;
            if gpu.render(&frame, pupil, &mut found).map_err(&failed)?.engine_changed {
                return Err(renderer::failed_while_timed(&*gpu));
            }
            let [of_gpu, of_processor] = [gpu.pattern().map_err(&failed)?, processor.pattern().map_err(&failed)?];
            let phases_apart = share_apart(&of_gpu.phase_rad, &of_processor.phase_rad);
            encoder.encode(PerColour(Colour::ALL.map(|colour| of_gpu.plane(colour))), &mut expected);
            let levels_apart = levels_apart(found.samples(), expected.samples());
            let levels_apart = levels_apart as f64 / of_gpu.phase_rad.len() as f64;
            apart = apart.max(phases_apart).max(levels_apart);
        }
    }
    Ok(Some(apart))
}

/// How many levels are more than one from those that are expected: a phase may lie where two engines round it apart.
fn levels_apart(found: &[u16], expected: &[u16]) -> usize {
    assert_eq!(found.len(), expected.len());
    found.iter().zip(expected).filter(|(found, expected)| found.abs_diff(**expected) > 1).count()
}

/// The share of phases that are not the same, round the circle; those that are no numbers are not.
fn share_apart(found: &[f32], expected: &[f32]) -> f64 {
    assert_eq!(found.len(), expected.len());
    let same = |(found, expected): &(&f32, &f32)| {
        let apart_rad = (*found - *expected).rem_euclid(TAU);
        apart_rad.min(TAU - apart_rad) <= SAME_PHASE_RAD && apart_rad.is_finite()
    };
    1.0 - found.iter().zip(expected).filter(same).count() as f64 / found.len() as f64
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::renderer::failing::Failing;
    use holod_calibration::rig::PanelMode;

    const SIZE: Resolution = Resolution { width: 1920, height: 1080 };

    #[test]
    fn a_slow_display_is_told_what_helps_and_a_fast_one_nothing() {
        let mut rig = Rig::default();
        let advice = |frames_hz, rig: &Rig, size| advice(frames_hz, "cpu, 8 threads", rig, size);
        assert_eq!(advice(60.0, &rig, SIZE), None);
        assert_eq!(advice(54.1, &rig, SIZE), None);
        let said = advice(0.6, &rig, SIZE).unwrap();
        // A tenth of each side.
        assert!(
            said.contains("--weights small") && said.contains("--resolution 192x96") && said.contains("GPU"),
            "{said}"
        );
        rig.model.weights = WeightsChoice::Small;
        assert!(advice(0.6, &rig, SIZE).unwrap().contains("--weights fast"));
        rig.model.weights = WeightsChoice::Fast;
        assert!(!advice(0.6, &rig, SIZE).unwrap().contains("--weights"));
        let least = Resolution { width: 64, height: 64 };
        assert!(!advice(0.6, &rig, least).unwrap().contains("--resolution"));
    }

    #[test]
    fn a_slow_gpu_is_told_what_helps_there() {
        let mut rig = Rig::default();
        let card = "gpu, X, single precision";
        let of = |rig: &Rig, engine: &str| advice(0.6, engine, rig, SIZE).unwrap();
        let said = of(&rig, card);
        assert!(said.contains("small takes about 0.5 of the time, --weights fast 0.3"), "{said}");
        assert!(said.ends_with("; a faster GPU helps"), "{said}");
        assert!(of(&rig, &format!("{card}, {}", renderer::PLAYS_A_GPU)).ends_with("--backend cpu helps, and a GPU"));
        rig.model.weights = WeightsChoice::Small;
        assert!(of(&rig, card).contains("--weights fast takes about 0.6"));
        assert!(of(&rig, "cpu, 8 threads").contains("--weights fast takes about 0.7"));
    }

    #[test]
    fn a_panel_shows_as_many_frames_as_it_has_fields_for() {
        let mut panel = Rig::default().panel;
        assert!((panel_frames_hz(&panel) - 60.0).abs() < 1e-6);
        panel.mode = PanelMode::FieldSequential;
        assert!((panel_frames_hz(&panel) - 20.0).abs() < 1e-6);
        panel.frames_per_colour = 2;
        assert!((panel_frames_hz(&panel) - 10.0).abs() < 1e-6);
    }

    /// As the pacer plans it: half of a panel's frames as soon as one takes longer than there is.
    #[test]
    fn slow_frames_are_shown_at_whole_parts_of_the_panels_rate() {
        let mut panel = Rig::default().panel;
        let near = |found: f64, expected: f64| assert!((found / expected - 1.0).abs() < 1e-6, "{found} for {expected}");
        let ms = |ms: f64| TimeNs::from_seconds(ms / 1e3);
        // A sixteenth of a refresh is left for handing it over.
        for (frame_ms, expected_hz) in [(3.0, 60.0), (15.6, 60.0), (15.7, 30.0), (18.0, 30.0), (280.0, 60.0 / 17.0)] {
            near(shown_hz(ms(frame_ms), &panel), expected_hz);
        }
        panel.mode = PanelMode::FieldSequential;
        for (frame_ms, expected_hz) in [(48.0, 20.0), (49.5, 10.0)] {
            near(shown_hz(ms(frame_ms), &panel), expected_hz);
        }
    }

    #[test]
    fn the_estimate_goes_with_the_pixels_and_leaves_out_what_each_frame_takes() {
        let square = |side| Resolution { width: side, height: side };
        let estimate = |seconds| Estimate::taking("cpu", [square(256), square(512)], seconds);
        let frames_hz = |seconds, side| 1.0 / estimate(seconds).frame_time(square(side)).seconds();
        let near = |found: f64, expected: f64| assert!((found / expected - 1.0).abs() < 1e-6, "{found} for {expected}");
        near(frames_hz([0.25, 1.0], 256), 4.0);
        near(frames_hz([0.25, 1.0], 1024), 0.25);
        // 2 ms, and 1 ms for each 256x256.
        near(frames_hz([0.003, 0.006], 1024), 1.0 / 0.018);
        // A lap that something disturbed.
        near(frames_hz([0.5, 0.4], 1024), 1.0 / 0.4);
        near(frames_hz([0.0, 0.4], 1024), 1.0 / 1.6);
        let same = Estimate::taking("cpu", [square(64); 2], [0.1, 0.1]);
        near(1.0 / same.frame_time(square(128)).seconds(), 2.5);
    }

    #[test]
    fn a_processor_that_is_faster_than_the_gpu_is_told() {
        let square = |side| Resolution { width: side, height: side };
        let of = |processor_s| {
            let estimate = Estimate::taking("gpu, X", [square(256), square(512)], [0.05, 0.2]);
            Estimate { processor_s, ..estimate }.faster_processor()
        };
        let said = of(Some(0.02)).expect("it is faster");
        assert_eq!(said, "for 256x256 the processor takes 20 ms (--backend cpu), this GPU 50 ms");
        assert_eq!([of(Some(0.06)), of(None)], [None, None]);
    }

    #[test]
    fn phases_are_compared_round_the_circle_and_what_is_no_number_is_wrong() {
        let expected = [0.0, 0.01, 3.0, 6.279, 1.0, 2.0, 4.0, 5.0];
        assert_eq!(share_apart(&[6.279, 0.02, 3.02, 0.0, 1.0, 2.0, 4.0, 5.0], &expected), 0.0);
        assert_eq!(share_apart(&[0.0, 0.01, 3.03, 6.279, 1.0, 2.0, f32::NAN, 5.0], &expected), 0.25);
    }

    #[test]
    fn an_engine_that_fails_is_not_timed_as_another_one() {
        let timed = |frames: &[(Duration, bool)]| {
            let renderer = Box::new(Failing::new(frames));
            let size = Resolution { width: 8, height: 8 };
            let encoder = renderer::panel_encoder(&Rig::default(), size).unwrap();
            let frame = Arc::new(scene::sample_frame(size));
            Timed::by(renderer, &frame, PupilDiameter::from_mm(3.0), LevelsFrame::new(encoder.layout()))
        };
        let [good, fails] = [(Duration::ZERO, false), (Duration::ZERO, true)];
        assert!(timed(&[good]).is_ok());
        for frames in [[fails, good], [good, fails]] {
            let failure = timed(&frames).err().expect("a failure").to_string();
            assert!(failure.contains("failed while it was timed") && failure.contains("another engine"), "{failure}");
        }
    }

    #[cfg(feature = "gpu")]
    #[test]
    fn a_size_that_the_gpu_cannot_hold_has_no_engine() {
        let mut rig = Rig::default();
        // Of its half no workgroup's memory holds a line.
        rig.geometry.resolution = Resolution { width: 40_000, height: 48 };
        let engine_at =
            |width| engine_at(&rig, &Weights::builtin_fast(), Backend::Gpu, Resolution { width, height: 48 });
        assert!(is_gpu(&engine_at(64).unwrap()));
        let refused = engine_at(40_000).unwrap_err().to_string();
        assert!(refused.contains("--backend gpu: a line of 20000 samples"), "{refused}");
    }

    #[test]
    fn levels_are_compared_up_to_one() {
        let expected = [7, 0, 255, 12];
        assert_eq!(levels_apart(&[8, 1, 254, 12], &expected), 0);
        assert_eq!(levels_apart(&[9, 0, 253, 12], &expected), 2);
        // As of an engine that writes each pixel to its neighbour's place.
        assert_eq!(levels_apart(&[0, 255, 12, 7], &expected), 4);
    }

    #[test]
    fn strips_are_as_long_as_a_frames_lines_and_no_larger_than_it() {
        let of =
            |width, height| strips(Resolution { width, height }).map(|Resolution { width, height }| (width, height));
        assert_eq!(of(1920, 1080), [(1920, 64), (64, 1080)]);
        assert_eq!(of(40, 30), [(40, 30); 2]);
    }

    /// On Mesa's software device, which `Auto` does not take; on a panel with mirrors, and larger than the frame.
    #[cfg(feature = "gpu")]
    #[test]
    fn a_gpu_is_compared_with_the_processor() {
        let mut rig = Rig::default();
        rig.panel.orientation = holod_calibration::rig::Orientation::MirrorX;
        let size = Resolution { width: 240, height: 150 };
        let compare = |backend| compare(&rig, &Weights::builtin_fast(), backend, size).expect("an engine");
        assert!(compare(Backend::Gpu).expect("compared") < most_apart("gpu, X, single precision"));
        assert_eq!(compare(Backend::Cpu), None);
    }
}

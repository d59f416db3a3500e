//! From names on the command line to the parts of a run: rig, weights, scene.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use holod_calibration::rig::{Rig, WeightsChoice};
use holod_calibration::{DisplayGeometry, PupilDiameter, Resolution};
use holod_model::conditions::BenchFit;
use holod_model::scene::{DepthEncoding, Fit, FrameReport, Scene, SceneError};
use holod_model::{RgbdFrame, Weights, scene_renderer};

use crate::cli::{FitArg, NetworkArgs, RigArgs, SceneArgs};
use crate::failure::{Exit, Failure};

/// Size of a hologram of the built-in scene on a processor.
pub const SAMPLE_RESOLUTION: Resolution = Resolution { width: 512, height: 512 };

/// What eyes' pupils mostly are.
const MOST_EYES_MM: [f32; 2] = [2.0, 6.0];

/// Frames of a sequence that are kept in memory, in bytes.
const SEQUENCE_BYTES_MAX: usize = 4 << 30;

/// The rig that was named, or the built-in one.
pub fn rig(args: &RigArgs) -> Result<Rig, Failure> {
    match &args.config {
        None => Ok(Rig::default()),
        Some(path) => {
            let exit = if path.exists() { Exit::Config } else { Exit::NoInput };
            Rig::load(path).map_err(Failure::because(exit))
        }
    }
}

/// The same with the network that was named in place of the rig's own.
pub fn rig_with_network(args: &RigArgs, network: &NetworkArgs) -> Result<Rig, Failure> {
    let mut rig = rig(args)?;
    if let Some(weights) = &network.weights {
        rig.model.weights.clone_from(weights);
    }
    Ok(rig)
}

/// The rig's weights, for whatever bench they were trained.
pub fn load_weights(rig: &Rig) -> Result<Weights, Failure> {
    match &rig.model.weights {
        WeightsChoice::Standard => Ok(Weights::builtin()),
        WeightsChoice::Small => Ok(Weights::builtin_small()),
        WeightsChoice::Fast => Ok(Weights::builtin_fast()),
        WeightsChoice::File(path) => Weights::load(path).map_err(Failure::because(Exit::Data)),
    }
}

/// The rig's weights, which must have been trained for benches such as this; what they know less well is warned of.
pub fn weights(rig: &Rig) -> Result<Weights, Failure> {
    let weights = load_weights(rig)?;
    match weights.fit(&rig.geometry) {
        BenchFit::Inside => {}
        BenchFit::Near(outside) => tracing::warn!("{outside}"),
        BenchFit::Far(outside) => return Err(Failure::because(Exit::Config)(outside)),
    }
    if let Some(few) = few_pupils(&weights, &rig.geometry) {
        tracing::warn!("{few}");
    }
    Ok(weights)
}

/// Why the pupils that `weights` were trained for are too few on `bench`, where they are.
pub fn few_pupils(weights: &Weights, bench: &DisplayGeometry) -> Option<String> {
    let [narrowest, widest] = weights.trained_pupils(bench).map(PupilDiameter::mm);
    let [least, most] = MOST_EYES_MM;
    // A range that ends there but for rounding is whole.
    (narrowest > least * 1.0001 || widest < most * 0.9999).then(|| {
        format!(
            "on this bench the network was trained for pupils of {narrowest:.2} to {widest:.2} mm, and eyes' are mostly \
             {least} to {most} mm: of others it is told the nearest of these, and the picture is worse"
        )
    })
}

/// What weights are called in reports.
pub fn weights_name(weights: &WeightsChoice) -> String {
    match weights {
        WeightsChoice::Standard => "standard".into(),
        WeightsChoice::Small => "small".into(),
        WeightsChoice::Fast => "fast".into(),
        WeightsChoice::File(path) => path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned(),
    }
}

/// The frames to show, all of one size.
pub struct Frames {
    /// At least one.
    pub frames: Vec<Arc<RgbdFrame>>,
    /// Frames a second of a sequence, which is shown over and over.
    pub fps: Option<f64>,
    /// What was done to each frame when it was read.
    pub reports: Vec<FrameReport>,
    /// The scene's name for reports.
    pub name: String,
}

impl Frames {
    /// Size of every frame.
    pub fn resolution(&self) -> Resolution {
        self.frames[0].resolution
    }

    /// Which frame is shown `seconds` after the start.
    pub fn index_at(&self, seconds: f64) -> usize {
        match self.fps {
            Some(fps) if self.frames.len() > 1 => (seconds.max(0.0) * fps) as usize % self.frames.len(),
            _ => 0,
        }
    }
}

/// Loads every frame of the scene that was named, or renders the built-in one.
pub fn frames(args: &SceneArgs, geometry: &DisplayGeometry) -> Result<Frames, Failure> {
    let Some(spec) = &args.scene else { return sample_frames(args, geometry) };
    let encoding = args
        .depth_encoding
        .as_deref()
        .map(|text| DepthEncoding::parse(text, geometry))
        .transpose()
        .map_err(Failure::because(Exit::Usage))?;
    let scene = Scene::open(spec, encoding).map_err(scene_failure)?;
    let mut loaded = Frames { frames: Vec::new(), fps: scene.fps(), reports: Vec::new(), name: spec.clone() };
    for index in 0..scene.frames() {
        let (frame, report) = scene.load(index, geometry, args.resolution, fit(args.fit)).map_err(scene_failure)?;
        check_fits(frame.resolution, geometry, spec)?;
        if let Some(first) = loaded.frames.first()
            && first.resolution != frame.resolution
        {
            return Err(Failure::new(
                Exit::Data,
                format!(
                    "{spec}: frame {index} is {}, the first one {}; give every frame one size with --resolution and --fit",
                    frame.resolution, first.resolution
                ),
            ));
        }
        let bytes = scene.frames() * frame.resolution.pixels() * 4 * size_of::<f32>();
        if bytes > SEQUENCE_BYTES_MAX {
            return Err(Failure::new(
                Exit::Data,
                format!(
                    "{spec}: {} frames of {} need {} GiB of memory, more than 4; name fewer frames or a smaller \
                     --resolution",
                    scene.frames(),
                    frame.resolution,
                    bytes >> 30
                ),
            ));
        }
        warn_of_odd_depth(spec, &frame, &report, geometry);
        warn_of_clipped_colours(spec, &frame, &report);
        loaded.frames.push(Arc::new(frame));
        loaded.reports.push(report);
    }
    Ok(loaded)
}

/// Depth that is nearly all clamped, or all one, is most often a wrong encoding.
fn warn_of_odd_depth(name: &str, frame: &RgbdFrame, report: &FrameReport, geometry: &DisplayGeometry) {
    let pixels = frame.resolution.pixels();
    let clamped = report.depth_clamped_far_px + report.depth_clamped_near_px;
    let ends = frame.depth_normalised.iter().fold((f32::MAX, f32::MIN), |(a, b), &d| (a.min(d), b.max(d)));
    let spread_dpt = geometry.depth_at(f64::from(ends.1)).0 - geometry.depth_at(f64::from(ends.0)).0;
    if 2 * clamped > pixels {
        tracing::warn!(
            "{name}: {clamped} of {pixels} pixels lie outside the display's depth range: is the depth encoding right?"
        );
    } else if spread_dpt < 0.05 && pixels > 1 {
        tracing::warn!("{name}: all depths lie within {spread_dpt:.3} dpt: is the depth encoding right?");
    }
}

/// Colours that are nearly all brighter than white are most often scene-linear light that was never exposed.
fn warn_of_clipped_colours(name: &str, frame: &RgbdFrame, report: &FrameReport) {
    let pixels = frame.resolution.pixels();
    if 2 * report.colour_clipped_px > pixels {
        tracing::warn!(
            "{name}: {} of {pixels} pixels are brighter than white and were clipped: scale the picture's light so that \
             white is 1",
            report.colour_clipped_px
        );
    }
}

fn sample_frames(args: &SceneArgs, geometry: &DisplayGeometry) -> Result<Frames, Failure> {
    if args.depth_encoding.is_some() {
        return Err(Failure::new(Exit::Usage, "--depth-encoding says how to read a depth file: name one with --scene"));
    }
    let resolution = args.resolution.unwrap_or(SAMPLE_RESOLUTION);
    check_fits(resolution, geometry, "--resolution")?;
    let frame = sample_frame(resolution);
    Ok(Frames {
        frames: vec![Arc::new(frame)],
        fps: None,
        reports: vec![FrameReport::default()],
        name: "the built-in scene".into(),
    })
}

/// Ports that belong to something else than the tracker: the laser box's.
pub fn ports_of_others(rig: &Rig) -> Vec<PathBuf> {
    rig.lasers.driver.paths().into_iter().map(Path::to_path_buf).collect()
}

/// The built-in scene as the network reads it.
pub fn sample_frame(resolution: Resolution) -> RgbdFrame {
    let picture = scene_renderer::sample_scene(resolution).picture();
    let amplitude = picture.image.into_iter().map(f32::sqrt).collect();
    RgbdFrame { resolution, amplitude, depth_normalised: picture.depth }
}

fn check_fits(resolution: Resolution, geometry: &DisplayGeometry, name: &str) -> Result<(), Failure> {
    let panel = geometry.resolution;
    if resolution.width <= panel.width && resolution.height <= panel.height {
        return Ok(());
    }
    Err(Failure::new(
        Exit::Usage,
        format!(
            "{name}: found {resolution}, larger than the panel of {panel}; bring it to the panel's size with \
             --resolution {panel} --fit contain (or cover, or crop)"
        ),
    ))
}

fn fit(arg: FitArg) -> Fit {
    match arg {
        FitArg::Native => Fit::Native,
        FitArg::Contain => Fit::Contain,
        FitArg::Cover => Fit::Cover,
        FitArg::Crop => Fit::Crop,
    }
}

fn scene_failure(error: SceneError) -> Failure {
    let exit = match &error {
        SceneError::Read { .. } | SceneError::Kind { .. } => Exit::NoInput,
        SceneError::DepthEncoding { .. } => Exit::Usage,
        _ => Exit::Data,
    };
    Failure::because(exit)(error)
}

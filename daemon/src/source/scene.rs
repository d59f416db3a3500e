//! Scenes from files, read whole before they are shown.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use holod_calibration::{DisplayGeometry, Resolution};
use holod_model::RgbdFrame;
use holod_model::scene::{ClippedColours, DepthEncoding, FrameReport, Scene, SceneError};
use serde::{Deserialize, Serialize};

use crate::cli::SceneArgs;
use crate::failure::{Exit, Failure};

/// Size of a hologram of the built-in scene on a processor.
pub const SAMPLE_RESOLUTION: Resolution = Resolution { width: 512, height: 512 };

/// In this share of a picture's pixels colours may be clipped, as in highlights, without a word.
const CLIPPED_SHARE_MAX: f64 = 0.01;

/// What is said of a file whose colours are of other primaries.
const FOREIGN_PRIMARIES: &str = "it names other primaries than those of sRGB (Rec. 709), or a high dynamic range, but its \
                                 colours are shown as sRGB's: convert the picture to sRGB, an OpenEXR file to linear \
                                 light with the primaries and the white of sRGB";

/// Frames of a sequence that are kept in memory, in bytes.
const SEQUENCE_BYTES_MAX: u64 = 4 << 30;

/// The frames to show, all of one size.
pub struct Frames {
    /// In the order of the sequence; at least one.
    pub frames: Vec<Arc<RgbdFrame>>,
    /// Frames a second of a sequence, which is shown over and over.
    pub fps: Option<f64>,
    /// What was done to each frame when it was read.
    pub reports: Vec<FrameReport>,
    /// The scene's name for reports.
    pub name: String,
}

/// A scene from files in figures.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SceneFigures {
    /// Frames of its sequence; 1 for a still.
    pub frames: u64,
    /// Depths of all their files.
    pub depth_px: u64,
    /// Those that were missing and were filled from their surroundings.
    pub depth_missing_px: u64,
    /// Pixels farther than the display shows, set to its far end.
    pub depth_clamped_far_px: u64,
    /// Pixels nearer than the display shows, set to its near end.
    pub depth_clamped_near_px: u64,
}

impl Frames {
    /// What can be said of them in figures.
    pub fn figures(&self) -> SceneFigures {
        let all = |of: fn(&FrameReport) -> usize| self.reports.iter().map(|report| of(report) as u64).sum();
        SceneFigures {
            frames: self.frames.len() as u64,
            depth_px: all(|report| report.depth_px),
            depth_missing_px: all(|report| report.depth_missing_px),
            depth_clamped_far_px: all(|report| report.depth_clamped_far_px),
            depth_clamped_near_px: all(|report| report.depth_clamped_near_px),
        }
    }

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

/// Loads every frame of the scene that was named, to be played, or renders the built-in one.
pub fn frames(args: &SceneArgs, geometry: &DisplayGeometry) -> Result<Frames, Failure> {
    let Some((spec, scene)) = open(args, geometry)? else { return sample_frames(args, geometry) };
    let fps = scene.playback_fps().map_err(failure)?;
    load(spec, &scene, scene.frames(), fps, args, geometry)
}

/// Refuses options that fit no scene, or not the one that was named. What cannot be read may be there later.
pub(super) fn judge(args: &SceneArgs, geometry: &DisplayGeometry) -> Result<(), Failure> {
    match (open(args, geometry), args.scene.as_deref().zip(args.resolution)) {
        (Err(failure), _) if failure.exit == Exit::Usage => Err(failure),
        (_, Some((spec, resolution))) => check_fits(resolution, geometry, spec),
        (Ok(None), None) => sample_resolution(args, geometry).map(drop),
        (_, None) => Ok(()),
    }
}

/// Loads the first frame of the scene that was named, or renders the built-in one.
pub fn first_frame(args: &SceneArgs, geometry: &DisplayGeometry) -> Result<Frames, Failure> {
    let Some((spec, scene)) = open(args, geometry)? else { return sample_frames(args, geometry) };
    load(spec, &scene, 1, None, args, geometry)
}

/// The files of the scene that was named, as far as it can be opened.
pub(crate) fn files(args: &SceneArgs, geometry: &DisplayGeometry) -> Vec<PathBuf> {
    let Ok(Some((_, scene))) = open(args, geometry) else { return Vec::new() };
    let pictures = (0..scene.frames()).flat_map(|index| scene.pictures(index));
    pictures.chain(scene.file().map(Path::to_owned)).collect()
}

/// The scene that was named, with its name.
fn open<'a>(args: &'a SceneArgs, geometry: &DisplayGeometry) -> Result<Option<(&'a str, Scene)>, Failure> {
    let Some(spec) = args.scene.as_deref() else { return Ok(None) };
    if super::feed_socket(spec).is_some() {
        let only = "--scene feed is for `holod run` alone; for a folder of that name write ./feed";
        return Err(Failure::new(Exit::Usage, only));
    }
    let encoding = args
        .depth_encoding
        .as_deref()
        .map(|text| DepthEncoding::parse(text, geometry))
        .transpose()
        .map_err(Failure::because(Exit::Usage))?;
    Ok(Some((spec, Scene::open(spec, encoding).map_err(failure)?)))
}

/// Loads the first `count` frames of a scene.
fn load(
    spec: &str,
    scene: &Scene,
    count: usize,
    fps: Option<f64>,
    args: &SceneArgs,
    geometry: &DisplayGeometry,
) -> Result<Frames, Failure> {
    let mut loaded = Frames { frames: Vec::new(), fps, reports: Vec::new(), name: spec.to_owned() };
    for index in 0..count {
        let (frame, report) = scene.load(index, geometry, args.resolution, args.fit.into()).map_err(failure)?;
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
        if index == 0 && count > 1 {
            sequence_fits(count as u64, frame.resolution, available_bytes())
                .map_err(|why| Failure::new(Exit::Data, format!("{spec}: {why}")))?;
        }
        loaded.frames.push(Arc::new(frame));
        loaded.reports.push(report);
    }
    let name_of = |index: usize| if count > 1 { format!("{spec}, frame {index}") } else { spec.to_owned() };
    let odd = |oddity: &dyn Fn(&FrameReport) -> Option<String>| {
        let mut odd = loaded.reports.iter().map(oddity).enumerate().filter_map(|(index, odd)| Some((index, odd?)));
        if let Some((index, first)) = odd.next() {
            let alike = match odd.count() {
                0 => String::new(),
                others => format!(" (and {others} more of its {count} frames)"),
            };
            tracing::warn!("{}{alike}: {first}", name_of(index));
        }
    };
    odd(&|report| depth_oddity(report, geometry, false));
    odd(&|report| report.turned_apart.map(odd_turns));
    odd(&|report| report.has_foreign_primaries.then(|| FOREIGN_PRIMARIES.to_owned()));
    if let Some((index, source, clipped)) = most_clipped(&loaded.reports) {
        warn_of_clipped_colours(&name_of(index), clipped, source.pixels());
    }
    Ok(loaded)
}

/// The picture of which most was clipped: all of a sequence are told by it.
fn most_clipped(reports: &[FrameReport]) -> Option<(usize, Resolution, ClippedColours)> {
    let each = reports.iter().enumerate();
    let clipped = each.filter_map(|(index, report)| Some((index, report.source?, report.colour_clipped)));
    clipped.rev().max_by_key(|(.., clipped)| clipped.in_all())
}

/// Memory that could be had, where the kernel tells it.
fn available_bytes() -> Option<u64> {
    let facts = std::fs::read_to_string("/proc/meminfo").ok()?;
    let line = facts.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?;
    line.split_whitespace().next()?.parse::<u64>().ok()?.checked_mul(1024)
}

/// Says why a sequence of this length cannot be kept in memory, where it cannot.
fn sequence_fits(frames: u64, resolution: Resolution, available_bytes: Option<u64>) -> Result<(), String> {
    let frame_bytes = (resolution.pixels() * 4 * size_of::<f32>()) as u64;
    let needed = frames.saturating_mul(frame_bytes);
    let gib = |bytes: u64| bytes as f64 / f64::from(1 << 30);
    let most = match available_bytes {
        _ if needed > SEQUENCE_BYTES_MAX => format!("the {:.0} GiB that a sequence may have", gib(SEQUENCE_BYTES_MAX)),
        Some(available) if needed > available => format!("the {:.1} GiB that are free", gib(available)),
        _ => return Ok(()),
    };
    Err(format!(
        "{frames} frames of {resolution} need {:.1} GiB of memory, more than {most}; name fewer frames or a smaller \
         --resolution, or hand them over one by one (--scene feed)",
        gib(needed)
    ))
}

/// Warns of what is most often a mistake in a picture called `name`.
/// `is_plane`: one depth for all of it is meant.
pub fn warn_of_oddities(name: &str, report: &FrameReport, geometry: &DisplayGeometry, is_plane: bool) {
    let Some(source) = report.source else { return };
    if let Some(oddity) = depth_oddity(report, geometry, is_plane) {
        tracing::warn!("{name}: {oddity}");
    }
    if let Some(orientations) = report.turned_apart {
        tracing::warn!("{name}: {}", odd_turns(orientations));
    }
    if report.has_foreign_primaries {
        warn_of_foreign_primaries(name);
    }
    warn_of_clipped_colours(name, report.colour_clipped, source.pixels());
}

/// Warns of the colours of files called `name`, which say that they are of other primaries.
pub(crate) fn warn_of_foreign_primaries(name: &str) {
    tracing::warn!("{name}: {FOREIGN_PRIMARIES}");
}

/// Says of colour and depth that their files are turned by these EXIF orientations.
fn odd_turns([of_colour, of_depth]: [u8; 2]) -> String {
    format!(
        "colours are turned by their EXIF orientation {of_colour} and depths by {of_depth}, where 1 is as stored: does \
         the depth lie on the picture? Export both with one orientation"
    )
}

/// What is odd about the depth of a picture, in words.
pub(super) fn depth_oddity(report: &FrameReport, geometry: &DisplayGeometry, is_plane: bool) -> Option<String> {
    report.source.and_then(|source| odd_depth(source, report, geometry, is_plane))
}

/// Warns of a picture called `name` of which more than some highlights was clipped. All counts are of the picture as it
/// came, before it was fitted.
pub fn warn_of_clipped_colours(name: &str, clipped: ClippedColours, source_px: usize) {
    for oddity in odd_colours(clipped, source_px) {
        tracing::warn!("{name}: {oddity}");
    }
}

/// Colours of which many are above white are most often scene-linear light that was never exposed; below 0 they are
/// those of a wider gamut.
pub(super) fn odd_colours(clipped: ClippedColours, source_px: usize) -> Vec<String> {
    let ClippedColours { above_white_px, below_black_px } = clipped;
    let are_many = |clipped_px: usize| clipped_px as f64 > CLIPPED_SHARE_MAX * source_px as f64;
    let above = are_many(above_white_px).then(|| {
        format!(
            "{above_white_px} of {source_px} pixels are brighter than white and were clipped: scale the picture's \
             light so that white is 1"
        )
    });
    let below = are_many(below_black_px).then(|| {
        format!(
            "{below_black_px} of {source_px} pixels have a colour below 0 or that is no number, which became 0: bring \
             the picture to the primaries of sRGB, whose colours are 0 to 1"
        )
    });
    above.into_iter().chain(below).collect()
}

/// Depth of which most is missing or clamped, or that is all one, is most often a wrong encoding.
fn odd_depth(source: Resolution, report: &FrameReport, geometry: &DisplayGeometry, is_plane: bool) -> Option<String> {
    let FrameReport { depth_px, depth_missing_px, .. } = *report;
    if 2 * depth_missing_px > depth_px {
        let share_percent = 100.0 * depth_missing_px as f64 / depth_px as f64;
        return Some(format!(
            "{depth_missing_px} of {depth_px} depths ({share_percent:.1} %) are missing and were filled from their \
             surroundings: are the depth encoding and the number that means none right?"
        ));
    }
    let pixels = source.pixels();
    let clamped = report.depth_clamped_far_px + report.depth_clamped_near_px;
    if 2 * clamped > pixels {
        return Some(format!(
            "{clamped} of {pixels} pixels lie outside the display's depth range: is the depth encoding right?"
        ));
    }
    let [far_dpt, near_dpt] = report.depth_range.map(|depth| geometry.depth_at(f64::from(depth)).0);
    let spread_dpt = near_dpt - far_dpt;
    (spread_dpt < 0.05 && pixels > 1 && !is_plane)
        .then(|| format!("all depths lie within {spread_dpt:.3} dpt: is the depth encoding right?"))
}

/// Size of the built-in scene on `panel` where none is asked for.
pub fn sample_resolution_on(panel: Resolution) -> Resolution {
    let Resolution { width, height } = SAMPLE_RESOLUTION;
    Resolution { width: width.min(panel.width), height: height.min(panel.height) }
}

/// Size of the built-in scene.
fn sample_resolution(args: &SceneArgs, geometry: &DisplayGeometry) -> Result<Resolution, Failure> {
    if args.depth_encoding.is_some() {
        return Err(Failure::new(Exit::Usage, "--depth-encoding says how to read a depth file: name one with --scene"));
    }
    let resolution = args.resolution.unwrap_or_else(|| sample_resolution_on(geometry.resolution));
    check_fits(resolution, geometry, "--resolution")?;
    Ok(resolution)
}

fn sample_frames(args: &SceneArgs, geometry: &DisplayGeometry) -> Result<Frames, Failure> {
    let frame = sample_frame(sample_resolution(args, geometry)?);
    let least_and_greatest = |[least, greatest]: [f32; 2], &depth: &f32| [least.min(depth), greatest.max(depth)];
    let depth_range = frame.depth_normalised.iter().fold([f32::MAX, f32::MIN], least_and_greatest);
    Ok(Frames {
        frames: vec![Arc::new(frame)],
        fps: None,
        reports: vec![FrameReport { depth_range, ..FrameReport::default() }],
        name: "the built-in scene".into(),
    })
}

/// The built-in scene as the network reads it.
pub fn sample_frame(resolution: Resolution) -> RgbdFrame {
    let picture = holod_scenes::sample_scene(resolution).picture();
    let amplitude = picture.image.into_iter().map(f32::sqrt).collect();
    RgbdFrame { resolution, amplitude, depth_normalised: picture.depth }
}

/// Refuses what is larger than the panel.
pub fn check_fits(resolution: Resolution, geometry: &DisplayGeometry, name: &str) -> Result<(), Failure> {
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

/// A scene or a focal stack that cannot be loaded, with its exit code.
pub fn failure(error: SceneError) -> Failure {
    let exit = match &error {
        SceneError::Read { .. } | SceneError::Kind { .. } => Exit::NoInput,
        SceneError::DepthEncoding { .. } | SceneError::EncodingsDiffer { .. } | SceneError::BlurScaled { .. } => {
            Exit::Usage
        }
        _ => Exit::Data,
    };
    Failure::because(exit)(error)
}

#[cfg(test)]
mod tests {
    use holod_model::scene::Fit;

    use super::*;

    /// What is odd about the depth of a picture of 64x48 whose pixels number `index` have `depth_mm`, at each size.
    fn odd_at_every_size(depth_mm: impl Fn(u32) -> u16) -> Vec<Option<String>> {
        const SIZE: Resolution = Resolution { width: 64, height: 48 };
        const BENCH: DisplayGeometry = DisplayGeometry::DEFAULT;
        let folder = tempfile::tempdir().unwrap();
        let [colour, depth] = ["colour.png", "depth.png"].map(|name| folder.path().join(name));
        image::RgbImage::new(64, 48).save(&colour).unwrap();
        let at = |x, y| image::Luma([depth_mm(y * 64 + x)]);
        image::ImageBuffer::from_fn(64, 48, at).save(&depth).unwrap();
        let spec = format!("{},{}", colour.display(), depth.display());
        let scene = Scene::open(&spec, Some(DepthEncoding::Millimetres)).unwrap();
        let sizes = [(SIZE, Fit::Native), (SIZE, Fit::Contain)].into_iter().chain(
            [(96, 72), (19, 14), (96, 48), (20, 60)]
                .into_iter()
                .flat_map(|(width, height)| [Fit::Contain, Fit::Cover, Fit::Crop].map(|fit| (width, height, fit)))
                .map(|(width, height, fit)| (Resolution { width, height }, fit)),
        );
        sizes
            .map(|(size, fit)| scene.load(0, &BENCH, Some(size), fit).unwrap().1)
            .map(|report| odd_depth(report.source.unwrap(), &report, &BENCH, false))
            .collect()
    }

    #[test]
    fn the_built_in_scene_fits_on_every_panel_unless_a_size_is_asked_for() {
        let size = |width, height| Resolution { width, height };
        let on = |panel, resolution| {
            let geometry = DisplayGeometry { resolution: panel, ..DisplayGeometry::DEFAULT };
            sample_resolution(&SceneArgs { resolution, ..SceneArgs::default() }, &geometry)
        };
        for (panel, expected) in
            [(size(300, 280), size(300, 280)), (size(1920, 480), size(512, 480)), (size(1920, 1080), SAMPLE_RESOLUTION)]
        {
            assert_eq!(on(panel, None).unwrap(), expected);
        }
        let refused = on(size(300, 280), Some(SAMPLE_RESOLUTION)).unwrap_err();
        assert!(refused.to_string().starts_with("--resolution: found 512x512, larger than the panel of 300x280"));
    }

    #[test]
    fn a_wrong_encoding_is_told_whatever_the_picture_is_fitted_to() {
        let too_near = odd_at_every_size(|_| 2);
        let told = "3072 of 3072 pixels lie outside the display's depth range: is the depth encoding right?";
        assert_eq!(too_near, vec![Some(told.to_owned()); 14]);
        let told = "1920 of 3072 pixels lie outside the display's depth range: is the depth encoding right?";
        let most_too_near = odd_at_every_size(|index| if index < 1920 { 2 } else { 1000 });
        assert_eq!(most_too_near, vec![Some(told.to_owned()); 14]);
        let one_depth = odd_at_every_size(|_| 1000);
        let told = "all depths lie within 0.000 dpt: is the depth encoding right?";
        assert_eq!(one_depth, vec![Some(told.to_owned()); 14]);
    }

    #[test]
    fn depth_of_which_most_is_missing_is_told_with_its_share() {
        let holes =
            |every: u32| odd_at_every_size(move |index| if index % every == 0 { 600 + index as u16 } else { 0 });
        assert_eq!(holes(2), vec![None; 14], "a half");
        let told = "2976 of 3072 depths (96.9 %) are missing and were filled from their surroundings: are the depth \
                    encoding and the number that means none right?";
        assert_eq!(holes(32), vec![Some(told.to_owned()); 14]);
    }

    #[test]
    fn a_scenes_figures_are_those_of_all_its_frames() {
        let report = FrameReport {
            depth_px: 9,
            depth_missing_px: 5,
            depth_clamped_far_px: 2,
            depth_clamped_near_px: 1,
            ..FrameReport::default()
        };
        let frame = || Arc::new(RgbdFrame::black(SAMPLE_RESOLUTION));
        let frames = vec![frame(), frame()];
        let scene = Frames { frames, fps: None, reports: vec![report.clone(), report], name: String::new() };
        let figures = SceneFigures {
            frames: 2,
            depth_px: 18,
            depth_missing_px: 10,
            depth_clamped_far_px: 4,
            depth_clamped_near_px: 2,
        };
        assert_eq!(scene.figures(), figures);
    }

    #[test]
    fn what_was_clipped_is_called_what_it_is() {
        let odd = |above_white_px, below_black_px| odd_colours(ClippedColours { above_white_px, below_black_px }, 1000);
        assert_eq!(odd(10, 10), Vec::<String>::new());
        let [above, below] = [odd(11, 0), odd(0, 11)];
        assert!(above.len() == 1 && above[0].starts_with("11 of 1000 pixels are brighter than white"), "{above:?}");
        assert!(below.len() == 1 && below[0].starts_with("11 of 1000 pixels have a colour below 0"), "{below:?}");
    }

    #[test]
    fn a_sequence_is_told_by_the_picture_that_is_clipped_most() {
        let report = |above_white_px| FrameReport {
            source: Some(SAMPLE_RESOLUTION),
            colour_clipped: ClippedColours { above_white_px, below_black_px: 1 },
            ..FrameReport::default()
        };
        let worst = most_clipped(&[report(0), report(7), report(7), report(3)]).unwrap();
        assert_eq!(worst, (1, SAMPLE_RESOLUTION, ClippedColours { above_white_px: 7, below_black_px: 1 }));
        assert_eq!(most_clipped(&[FrameReport::default()]), None, "the built-in scene");
    }

    #[test]
    fn a_picture_with_a_few_depths_that_are_too_near_is_not_doubted() {
        let some_too_near = odd_at_every_size(|index| if index % 25 < 3 { 2 } else { 1000 + index as u16 });
        assert_eq!(some_too_near, vec![None; 14]);
    }

    #[test]
    fn a_sequence_is_played_by_its_fps_and_its_first_picture_is_had_without() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        for index in 0..3_u16 {
            image::RgbImage::new(8, 8).save(at(&format!("c{index}.png"))).unwrap();
            let depth = |x, _| image::Luma([500 + 100 * x as u16]);
            image::ImageBuffer::from_fn(8, 8, depth).save(at(&format!("d{index}.png"))).unwrap();
        }
        let args = SceneArgs { scene: folder.path().to_str().map(str::to_owned), ..SceneArgs::default() };
        let describe = |text: &str| {
            std::fs::write(
                at("scene.toml"),
                format!("depth_encoding = \"millimetres\"\ndepth = \"d{{}}.png\"\n{text}"),
            )
            .unwrap();
        };
        let played = || frames(&args, &DisplayGeometry::DEFAULT);
        let first = || first_frame(&args, &DisplayGeometry::DEFAULT).unwrap();

        describe("colour = \"c{}.png\"\nfps = 20.0");
        assert_eq!((played().unwrap().frames.len(), played().unwrap().index_at(0.12)), (3, 2));
        assert_eq!((first().frames.len(), first().reports.len(), first().index_at(0.12)), (1, 1, 0));
        for (text, line) in
            [("colour = \"c{}.png\"", 3), ("colour = \"c0.png\"", 2), ("colour = \"c{}.png\"\ncount = 3", 3)]
        {
            describe(text);
            let refused = played().err().unwrap();
            assert_eq!(refused.exit, Exit::Data);
            let why = refused.to_string();
            let place = format!("scene.toml, line {line}: `fps`: found none for this sequence of 3 frames");
            assert!(why.contains(&place) && why.contains("fps = 30.0"), "{why}");
            assert_eq!(first().frames.len(), 1);
        }
        describe("colour = \"c{}.png\"\ncount = 1");
        assert_eq!(played().unwrap().frames.len(), 1);
    }

    #[test]
    fn a_sequence_that_memory_has_no_room_for_is_refused_in_figures() {
        // 4 MiB each.
        let fits = |frames, available| sequence_fits(frames, SAMPLE_RESOLUTION, available);
        assert_eq!([fits(1024, None), fits(1024, Some(4 << 30)), fits(2, Some(8 << 20))], [const { Ok(()) }; 3]);
        let why = fits(1025, Some(64 << 30)).unwrap_err();
        assert!(why.starts_with("1025 frames of 512x512 need 4.0 GiB of memory, more than the 4 GiB that a"), "{why}");
        let why = fits(512, Some(1 << 30)).unwrap_err();
        assert!(why.contains("need 2.0 GiB of memory, more than the 1.0 GiB that are free; name fewer"), "{why}");
        assert!(fits(u64::MAX, None).is_err());
        assert!(available_bytes().is_some_and(|bytes| bytes > 1 << 20), "the kernel tells it");
    }
}

//! Focal stacks: what an eye with one pupil sees of a scene, focused at several depths.
//!
//! A focal stack is a directory with a `stack.toml`:
//!
//! ```toml
//! pupil_mm = 3.0             # diameter of that eye's pupil
//!
//! [[image]]                  # for each depth, in any order
//! file = "focus-0.png"       # a picture as in a scene: 8- or 16-bit PNG, JPEG or OpenEXR
//! focus_dpt = 0.0            # where the eye is focused
//! ```
//!
//! Images are cut or padded to another size and never scaled, which would scale the blur in them, too.

use std::path::{Path, PathBuf};

use holod_calibration::{Colour, Dioptres, PupilDiameter, Resolution};
use serde::Deserialize;
use toml::Spanned;

use super::description::{line_error, read_text};
use super::fit::Placement;
use super::{ClippedColours, Fit, SceneError, raster};
use crate::LinearImage;
use crate::conditions::{SAME_FOCUS_DPT, WIDEST_PUPIL};
use crate::weights::MOST_DEPTH_LAYERS;

const FILE: &str = "stack.toml";
/// Vergence of a hundredth of a metre: what is nearer is not meant.
const NEAREST_DPT: f64 = 100.0;

/// What an eye with one pupil sees of a scene, focused at several depths.
#[derive(Clone, Debug, PartialEq)]
pub struct FocalStack {
    /// Width and height of each image.
    pub resolution: Resolution,
    /// Square root of linear light, 0..=1, [images, 3, height, width].
    pub amplitude: Vec<f32>,
    /// Where each image is focused, far to near.
    pub focuses: Vec<Dioptres>,
    /// The pupil that all images are seen through.
    pub pupil: PupilDiameter,
}

/// What happened to the images between their files and the network.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FocalStackReport {
    /// Pixels of all images in their files.
    pub source_px: usize,
    /// Those of which some colour was clipped.
    pub colour_clipped: ClippedColours,
    /// Pixels of each image that the picture does not reach: black.
    pub padded_px: usize,
    /// Whether a file says that its colours are of other primaries than those that they are taken for.
    pub has_foreign_primaries: bool,
}

/// The keys of a `stack.toml`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct StackFile {
    pupil_mm: Spanned<f64>,
    image: Spanned<Vec<ImageEntry>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ImageEntry {
    file: Spanned<String>,
    focus_dpt: Spanned<f64>,
}

/// A focal stack whose `stack.toml` was read, and whose images are as yet in their files.
#[derive(Debug)]
pub struct FocalStackFiles {
    files: Vec<PathBuf>,
    focuses: Vec<Dioptres>,
    pupil: PupilDiameter,
}

impl FocalStackFiles {
    /// Reads the `stack.toml` in `directory`.
    ///
    /// # Errors
    /// There is none, or a line of it cannot be used.
    pub fn open(directory: &Path) -> Result<Self, SceneError> {
        let path = directory.join(FILE);
        let text = read_text(&path, "a directory with a stack.toml, of at most 1 MiB, which names images and focuses")?;
        let (pupil, images) = parse(&path, &text)?;
        let focuses = images.iter().map(|image| Dioptres(*image.focus_dpt.get_ref())).collect();
        let files = images.into_iter().map(|image| directory.join(image.file.into_inner())).collect();
        Ok(Self { files, focuses, pupil })
    }

    /// Where the images are focused, far to near.
    pub fn focuses(&self) -> &[Dioptres] {
        &self.focuses
    }

    /// The pupil that they were made for.
    pub fn pupil(&self) -> PupilDiameter {
        self.pupil
    }

    /// Loads the images, at `resolution` or, without one, at their own. They are never scaled: what is blurred in them
    /// is as large as their pupil makes it.
    ///
    /// # Errors
    /// One cannot be read, has another size than the first, or would have to be scaled for `fit`.
    pub fn load(self, resolution: Option<Resolution>, fit: Fit) -> Result<(FocalStack, FocalStackReport), SceneError> {
        let Self { files, focuses, pupil } = self;
        let mut report = FocalStackReport::default();
        let mut sizes: Option<(Resolution, Resolution)> = None;
        let mut amplitude = Vec::new();
        for file in files {
            let colour = raster::read_colour(&file)?;
            let (first, wanted) = *sizes.get_or_insert((colour.size, resolution.unwrap_or(colour.size)));
            if colour.size != first {
                let (found, expected) = (format!("an image of {}", colour.size), format!("{first}, as the others"));
                return Err(SceneError::Picture { path: file, found, expected });
            }
            let placement = Placement::new(first, wanted, fit)
                .filter(Placement::is_unscaled)
                .ok_or(SceneError::BlurScaled { path: file, found: first, wanted })?;
            report.source_px += first.pixels();
            report.colour_clipped += colour.clipped;
            report.has_foreign_primaries |= colour.has_foreign_primaries;
            report.padded_px = placement.padded_px();
            if amplitude.is_empty() {
                amplitude.reserve_exact(3 * focuses.len() * wanted.pixels());
            }
            for plane in colour.linear.chunks_exact(first.pixels()) {
                amplitude.extend(placement.light(plane).into_iter().map(f32::sqrt));
            }
        }
        let (_, resolution) = sizes.expect("a stack has images");
        Ok((FocalStack { resolution, amplitude, focuses, pupil }, report))
    }
}

impl FocalStack {
    /// Writes `images`, of one size, as OpenEXR files of single precision, with a `stack.toml` that says where each is
    /// focused, to the new folder `directory`, which appears once all is written.
    ///
    /// # Errors
    /// The folder is there already, or it or a file cannot be written.
    ///
    /// # Panics
    /// Where there are not as many images as focuses.
    pub fn save(
        directory: &Path,
        images: &[LinearImage],
        focuses: &[Dioptres],
        pupil: PupilDiameter,
    ) -> std::io::Result<()> {
        assert_eq!(images.len(), focuses.len(), "one image a focus");
        if directory.exists() {
            return Err(std::io::ErrorKind::AlreadyExists.into());
        }
        let mut part = directory.file_name().ok_or(std::io::ErrorKind::InvalidInput)?.to_owned();
        part.push(".part");
        let part = directory.with_file_name(part);
        std::fs::create_dir_all(&part)?;
        let written = Self::write(&part, images, focuses, pupil).and_then(|()| std::fs::rename(&part, directory));
        if written.is_err() {
            // Why it failed is what is told.
            let _ = std::fs::remove_dir_all(&part);
        }
        written
    }

    fn write(
        directory: &Path,
        images: &[LinearImage],
        focuses: &[Dioptres],
        pupil: PupilDiameter,
    ) -> std::io::Result<()> {
        let mut text = format!("pupil_mm = {}\n", pupil.mm());
        for (number, (image, Dioptres(focus_dpt))) in images.iter().zip(focuses).enumerate() {
            let file = format!("focus-{number:02}.exr");
            let [red, green, blue] = Colour::ALL.map(|colour| image.plane(colour));
            let Resolution { width, height } = image.resolution;
            exr::prelude::write_rgb_file(directory.join(&file), width, height, |x, y| {
                let index = y * width + x;
                (red[index], green[index], blue[index])
            })
            .map_err(std::io::Error::other)?;
            text.push_str(&format!("\n[[image]]\nfile = \"{file}\"\nfocus_dpt = {focus_dpt}\n"));
        }
        std::fs::write(directory.join(FILE), text)
    }
}

/// The pupil, and at least two images from far to near.
fn parse(path: &Path, text: &str) -> Result<(PupilDiameter, Vec<ImageEntry>), SceneError> {
    let error_at = |span: std::ops::Range<usize>, key: &str, found: String, expected: &str| {
        line_error(path, text, span.start, key, found, expected)
    };
    let StackFile { pupil_mm, image } = toml::from_str(text).map_err(|error| {
        let expected = "TOML with pupil_mm, and for each image [[image]] with file and focus_dpt";
        let span = error.span().unwrap_or_default();
        let key = text.get(span.clone()).filter(|key| !key.is_empty() && key.len() < 60 && !key.contains('\n'));
        error_at(span, key.unwrap_or("stack"), error.message().to_owned(), expected)
    })?;
    let pupil = PupilDiameter::from_mm(*pupil_mm.get_ref() as f32);
    if !(pupil.mm() > 0.0 && pupil <= WIDEST_PUPIL) {
        let expected = format!("millimetres, above 0 and up to {}", WIDEST_PUPIL.mm());
        return Err(error_at(pupil_mm.span(), "pupil_mm", pupil_mm.get_ref().to_string(), &expected));
    }
    let (span, mut images) = (image.span(), image.into_inner());
    if !(2..=MOST_DEPTH_LAYERS).contains(&images.len()) {
        let expected = format!("2 to {MOST_DEPTH_LAYERS}, each focused at another depth");
        return Err(error_at(span, "image", format!("{} images", images.len()), &expected));
    }
    for image in &images {
        let focus_dpt = *image.focus_dpt.get_ref();
        if !(0.0..=NEAREST_DPT).contains(&focus_dpt) {
            let expected = format!("dioptres, from 0, which is infinity, to {NEAREST_DPT}");
            return Err(error_at(image.focus_dpt.span(), "focus_dpt", focus_dpt.to_string(), &expected));
        }
    }
    images.sort_by(|a, b| a.focus_dpt.get_ref().total_cmp(b.focus_dpt.get_ref()));
    for pair in images.windows(2) {
        let [far, near] = [&pair[0], &pair[1]].map(|image| *image.focus_dpt.get_ref());
        if near - far <= SAME_FOCUS_DPT {
            let [far_file, near_file] = [&pair[0], &pair[1]].map(|image| image.file.get_ref());
            let found = format!("{near} of \"{near_file}\" beside {far} of \"{far_file}\"");
            return Err(error_at(pair[1].focus_dpt.span(), "focus_dpt", found, "each image at a depth of its own"));
        }
    }
    for (index, image) in images.iter().enumerate() {
        if let Some(other) = images[..index].iter().find(|other| other.file.get_ref() == image.file.get_ref()) {
            let (far, near) = (other.focus_dpt.get_ref(), image.focus_dpt.get_ref());
            let found = format!("\"{}\" for {far} and {near} dpt", image.file.get_ref());
            return Err(error_at(image.file.span(), "file", found, "an image of its own for each depth"));
        }
    }
    Ok((pupil, images))
}

#[cfg(test)]
mod tests {
    use image::{ImageBuffer, Rgb};

    use super::*;

    const SIZE: Resolution = Resolution { width: 5, height: 3 };

    /// A folder with images whose red is their number times 50, and what `text` says of them.
    fn folder(text: &str) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for number in 0..3u8 {
            let (width, height) = if number < 2 { (SIZE.width, SIZE.height) } else { (4, 4) };
            let image = ImageBuffer::from_pixel(width as u32, height as u32, Rgb([50 * number, 128, 255]));
            image.save(folder.path().join(format!("{number}.png"))).unwrap();
        }
        std::fs::write(folder.path().join(FILE), text).unwrap();
        folder
    }

    fn load(directory: &Path, resolution: Option<Resolution>) -> Result<(FocalStack, FocalStackReport), SceneError> {
        FocalStackFiles::open(directory)?.load(resolution, Fit::Native)
    }

    fn entry(file: &str, focus_dpt: &str) -> String {
        format!("[[image]]\nfile = \"{file}\"\nfocus_dpt = {focus_dpt}\n")
    }

    fn two() -> String {
        format!("pupil_mm = 2.5\n{}{}", entry("1.png", "2.5"), entry("0.png", "0"))
    }

    #[test]
    fn images_are_sorted_from_far_to_near_and_become_amplitudes() {
        let folder = folder(&two());
        let (stack, report) = load(folder.path(), None).unwrap();
        assert_eq!((stack.resolution, &stack.focuses), (SIZE, &[0.0, 2.5].map(Dioptres).to_vec()));
        assert_eq!((stack.pupil.mm(), report), (2.5, FocalStackReport { source_px: 30, ..Default::default() }));
        assert_eq!(stack.amplitude.len(), 2 * 3 * SIZE.pixels());
        let red_of = |image: usize| stack.amplitude[image * 3 * SIZE.pixels()];
        // sRGB 50 is 0.0319 of white.
        assert!(red_of(0) == 0.0 && (red_of(1) - 0.0319f32.sqrt()).abs() < 1e-3, "{}", red_of(1));
        assert_eq!(stack.amplitude[2 * SIZE.pixels()], 1.0);

        let larger = Some(Resolution { width: 9, height: 4 });
        let (padded, report) = load(folder.path(), larger).unwrap();
        assert_eq!((padded.resolution.pixels(), report.padded_px), (36, 36 - 15));
        assert_eq!(padded.amplitude.len(), 2 * 3 * 36);
    }

    #[test]
    fn images_are_cut_and_padded_and_never_scaled_as_their_blur_is_that_of_their_pupil() {
        let folder = folder(&two());
        let load = |width, height, fit| {
            FocalStackFiles::open(folder.path()).unwrap().load(Some(Resolution { width, height }), fit)
        };
        for (width, height, fit) in
            [(10, 6, Fit::Contain), (4, 2, Fit::Contain), (10, 6, Fit::Cover), (5, 4, Fit::Cover), (4, 3, Fit::Native)]
        {
            let error = load(width, height, fit).unwrap_err().to_string();
            let says = format!("0.png is 5x3; expected a fit to {width}x{height} that cuts or pads it, as crop does");
            assert!(error.contains(&says) && error.contains("the blur of another pupil"), "{fit:?}: {error}");
        }
        for (width, height, fit) in
            [(5, 3, Fit::Contain), (5, 4, Fit::Contain), (4, 3, Fit::Cover), (2, 2, Fit::Crop), (9, 2, Fit::Crop)]
        {
            let (stack, _) = load(width, height, fit).unwrap();
            assert_eq!((stack.resolution, stack.pupil.mm()), (Resolution { width, height }, 2.5), "{fit:?}");
        }
    }

    #[test]
    fn what_is_saved_is_loaded() {
        let folder = tempfile::tempdir().unwrap();
        // With a slash behind it, as shells complete it.
        let directory = folder.path().join("stack/");
        let image = |number: usize| LinearImage {
            resolution: SIZE,
            pixels: (0..3 * SIZE.pixels()).map(|index| (index + number) as f32 / 64.0).collect(),
        };
        let focuses = [0.0, 1.25, 2.857].map(Dioptres);
        FocalStack::save(&directory, &[0, 1, 2].map(image), &focuses, PupilDiameter::from_mm(3.25)).unwrap();
        let (stack, report) = load(&directory, None).unwrap();
        assert_eq!((stack.focuses, stack.pupil.mm(), report.source_px), (focuses.to_vec(), 3.25, 45));
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "nothing is left beside it");
        let written = [0, 1, 2].map(image).into_iter().flat_map(|image| image.pixels);
        assert_eq!(stack.amplitude, written.map(f32::sqrt).collect::<Vec<_>>());
        let again = FocalStack::save(&directory, &[image(0)], &focuses[..1], PupilDiameter::from_mm(3.0));
        assert_eq!(again.unwrap_err().kind(), std::io::ErrorKind::AlreadyExists);
    }

    #[test]
    fn what_cannot_be_used_is_told_with_its_line() {
        let cases: [(&str, &[&str]); 12] = [
            (&two().replace("2.5\n[", "0\n["), &["line 1: `pupil_mm`", "found 0", "millimetres", "up to 20"]),
            (&two().replace("2.5\n[", "300\n["), &["line 1: `pupil_mm`", "found 300"]),
            (&two().replace("pupil_mm", "pupil"), &["line 1", "unknown field `pupil`", "pupil_mm", "focus_dpt"]),
            (&entry("0.png", "0"), &["missing field `pupil_mm`"]),
            (&format!("pupil_mm = 3\n{}", entry("0.png", "0")), &["line 2: `image`", "1 images", "2 to 64"]),
            (&two().replace("focus_dpt = 0\n", "focus_dpt = -0.5\n"), &["line 7: `focus_dpt`", "-0.5", "infinity"]),
            (&two().replace("focus_dpt = 0\n", "focus_dpt = nan\n"), &["line 7: `focus_dpt`", "NaN"]),
            (
                &two().replace("focus_dpt = 0\n", "focus_dpt = 2.5003\n"),
                &["line 7: `focus_dpt`", "2.5003 of \"0.png\" beside 2.5 of \"1.png\"", "of its own"],
            ),
            (&two().replace("1.png", "0.png"), &["line 3: `file`", "\"0.png\" for 0 and 2.5 dpt", "of its own"]),
            (&two().replace("\"0.png\"", "\"none.png\""), &["none.png", "PNG"]),
            (&two().replace("\"1.png\"", "\"2.png\""), &["2.png: an image of 4x4", "5x3, as the others"]),
            (&two().replace("file = \"0.png\"\n", ""), &["line 5", "missing field `file`"]),
        ];
        for (text, says) in cases {
            let folder = folder(text);
            let error = load(folder.path(), None).unwrap_err().to_string();
            for words in says {
                assert!(error.contains(words), "no '{words}' in: {error}\nof {text}");
            }
        }
        let absent = load(Path::new("nowhere"), None).unwrap_err().to_string();
        assert!(absent.contains("nowhere/stack.toml") && absent.contains("a directory with a stack.toml"), "{absent}");
    }
}

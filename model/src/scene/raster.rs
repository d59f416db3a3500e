//! Colour and depth pictures from files, as linear light and raw depth numbers.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use holod_calibration::{Resolution, png_grey_bits};
use image::metadata::Orientation;
use image::{DynamicImage, ImageDecoder, ImageError, ImageFormat, ImageReader};

use super::decoded::{ColourRaster, DepthRaster, FORMATS, check_size};
use super::depth::DepthNumbers;
use super::{ClippedColours, SceneError, jpeg, openexr, primaries};
use crate::picture::srgb_to_linear;

/// What kind of file a path holds, by its first bytes.
enum Format {
    OpenExr,
    Other,
}

/// Reads the colours of a picture.
pub(super) fn read_colour(path: &Path) -> Result<ColourRaster, SceneError> {
    match format_of(path)? {
        Format::OpenExr => openexr::read_colour(path),
        Format::Other => {
            let (picture, turned, icc_profile) = decode(path)?;
            let size = Resolution { width: picture.width() as usize, height: picture.height() as usize };
            let are_foreign = |file| primaries::are_foreign(BufReader::new(file), icc_profile.as_deref());
            let has_foreign_primaries = picture.color().has_color()
                && File::open(path).and_then(are_foreign).map_err(|source| read_error(path, source))?;
            Ok(ColourRaster {
                size,
                turned,
                linear: linear_planes(&picture),
                clipped: ClippedColours::default(),
                is_luminance: false,
                has_foreign_primaries,
            })
        }
    }
}

/// Reads the depth numbers of a picture. `is_alone`: its file is not that of the colours.
pub(super) fn read_depth(path: &Path, is_alone: bool) -> Result<DepthRaster, SceneError> {
    match format_of(path)? {
        Format::OpenExr => openexr::read_depth(path, is_alone),
        Format::Other => {
            let (picture, turned, _) = decode(path)?;
            let size = Resolution { width: picture.width() as usize, height: picture.height() as usize };
            let bits = File::open(path).and_then(png_grey_bits).map_err(|source| read_error(path, source))?;
            let mut numbers = depth_numbers(path, picture)?;
            if let Some(bits @ ..8) = bits {
                numbers.shrink_to(bits);
            }
            Ok(DepthRaster { size, turned, numbers, is_luminance: false })
        }
    }
}

fn read_error(path: &Path, source: std::io::Error) -> SceneError {
    SceneError::Read { path: path.to_owned(), source, expected: FORMATS }
}

/// Whether a file is OpenEXR, by its first bytes.
pub(super) fn is_openexr(path: &Path) -> Result<bool, SceneError> {
    Ok(matches!(format_of(path)?, Format::OpenExr))
}

fn format_of(path: &Path) -> Result<Format, SceneError> {
    use std::io::Read;
    let read_error = |source| read_error(path, source);
    let metadata = std::fs::metadata(path).map_err(read_error)?;
    if !metadata.is_file() {
        let found = if metadata.is_dir() { "a directory" } else { "no regular file" };
        return Err(SceneError::Kind { path: path.to_owned(), found: found.into(), expected: FORMATS });
    }
    let mut magic = Vec::new();
    File::open(path).and_then(|file| file.take(4).read_to_end(&mut magic)).map_err(read_error)?;
    Ok(if magic == [0x76, 0x2f, 0x31, 0x01] { Format::OpenExr } else { Format::Other })
}

/// The picture as viewers show it, how its file says that it is turned for that, and its ICC profile.
fn decode(path: &Path) -> Result<(DynamicImage, Orientation, Option<Vec<u8>>), SceneError> {
    let damaged = |found: String| SceneError::Picture {
        path: path.to_owned(),
        found,
        expected: format!("{FORMATS}; the file may be damaged or cut short: export or copy it again"),
    };
    let read_error = |source| read_error(path, source);
    let open = || -> Result<_, SceneError> {
        let reader = BufReader::new(File::open(path).map_err(read_error)?);
        ImageReader::new(reader).with_guessed_format().map_err(read_error)
    };
    if open()?.format() == Some(ImageFormat::Jpeg) {
        let bytes = std::fs::read(path).map_err(read_error)?;
        if !jpeg::is_whole(&bytes) {
            return Err(damaged("the JPEG data end before the end-of-image marker".into()));
        }
    }
    let damaged = |error: ImageError| match error {
        ImageError::Unsupported(_) => SceneError::Picture {
            path: path.to_owned(),
            found: error.to_string(),
            expected: format!("{FORMATS}: export it as one of them"),
        },
        _ => damaged(error.to_string()),
    };
    let mut decoder = open()?.into_decoder().map_err(damaged)?;
    let (width, height) = decoder.dimensions();
    check_size(path, width as usize, height as usize)?;
    let turned = decoder.orientation().map_err(damaged)?;
    // One that cannot be read keeps no picture from being shown.
    let icc_profile = decoder.icc_profile().unwrap_or_default();
    let mut picture = DynamicImage::from_decoder(decoder).map_err(damaged)?;
    picture.apply_orientation(turned);
    Ok((picture, turned, icc_profile))
}

/// Linear light of each colour; transparent pixels over black.
fn linear_planes(picture: &DynamicImage) -> Vec<f32> {
    let pixels = picture.width() as usize * picture.height() as usize;
    let mut planes = vec![0.0; 3 * pixels];
    let mut write = |index: usize, colours: [f32; 3], alpha: f32| {
        for (colour, value) in colours.into_iter().enumerate() {
            planes[colour * pixels + index] = value * alpha;
        }
    };
    let wide = matches!(
        picture,
        DynamicImage::ImageLuma16(_)
            | DynamicImage::ImageLumaA16(_)
            | DynamicImage::ImageRgb16(_)
            | DynamicImage::ImageRgba16(_)
    );
    if wide {
        for (index, pixel) in picture.to_rgba16().pixels().enumerate() {
            let [red, green, blue, alpha] = pixel.0.map(|value| f32::from(value) / 65535.0);
            write(index, [red, green, blue].map(srgb_to_linear), alpha);
        }
    } else {
        let table: [f32; 256] = std::array::from_fn(|value| srgb_to_linear(value as f32 / 255.0));
        for (index, pixel) in picture.to_rgba8().pixels().enumerate() {
            let [red, green, blue, alpha] = pixel.0;
            write(index, [red, green, blue].map(|value| table[usize::from(value)]), f32::from(alpha) / 255.0);
        }
    }
    planes
}

/// The numbers of a grey picture, or of a coloured one whose colours are equal everywhere. Where nothing is drawn, as
/// alpha is 0, there is none.
fn depth_numbers(path: &Path, picture: DynamicImage) -> Result<DepthNumbers, SceneError> {
    let coloured = || SceneError::Picture {
        path: path.to_owned(),
        found: "a picture whose red, green and blue differ".into(),
        expected: "depth as one grey channel; a colour-mapped depth picture cannot be read: export the numbers".into(),
    };
    let (values, full_scale) = match picture {
        DynamicImage::ImageLuma8(picture) => (numbers(picture.pixels().map(|pixel| pixel.0)), 255.0),
        DynamicImage::ImageLumaA8(picture) => (numbers(picture.pixels().map(|pixel| pixel.0)), 255.0),
        DynamicImage::ImageRgb8(picture) => (numbers(picture.pixels().map(|pixel| pixel.0)), 255.0),
        DynamicImage::ImageRgba8(picture) => (numbers(picture.pixels().map(|pixel| pixel.0)), 255.0),
        DynamicImage::ImageLuma16(picture) => (numbers(picture.pixels().map(|pixel| pixel.0)), 65535.0),
        DynamicImage::ImageLumaA16(picture) => (numbers(picture.pixels().map(|pixel| pixel.0)), 65535.0),
        DynamicImage::ImageRgb16(picture) => (numbers(picture.pixels().map(|pixel| pixel.0)), 65535.0),
        DynamicImage::ImageRgba16(picture) => (numbers(picture.pixels().map(|pixel| pixel.0)), 65535.0),
        _ => return Err(coloured()),
    };
    Ok(DepthNumbers { values: values.ok_or_else(coloured)?, full_scale: Some(full_scale) })
}

/// The number of each pixel of one grey or three colours, and an alpha where their count is even; NaN where that is 0.
/// `None` where colours differ.
fn numbers<T: Copy + Default + PartialEq + Into<f32>, const CHANNELS: usize>(
    pixels: impl Iterator<Item = [T; CHANNELS]>,
) -> Option<Vec<f32>> {
    let number = |pixel: [T; CHANNELS]| {
        let (colours, alpha) = pixel.split_at((CHANNELS - 1) | 1);
        if alpha.first() == Some(&T::default()) {
            return Some(f32::NAN);
        }
        colours.iter().all(|colour| *colour == colours[0]).then(|| colours[0].into())
    };
    pixels.map(number).collect()
}

//! A picture of the phase that flattens a panel.

use std::f64::consts::TAU;
use std::io::Cursor;
use std::path::Path;

use image::{DynamicImage, ImageFormat, ImageReader};

use super::files::FileFault;
use crate::{Resolution, png_grey_bits};

/// What the grays of a picture mean.
#[derive(Clone, Copy)]
pub(super) struct GrayScale {
    /// The gray that means 2π, where it is not one more than the picture's highest.
    pub(super) gray_of_2pi: Option<f64>,
    /// Whether the picture shows what is to be taken off instead of what is to be added.
    pub(super) subtracted: bool,
}

/// The phase in radians to add at each panel pixel, row-major, by the `picture` that the file at `path` holds.
///
/// It is a PNG or BMP of the panel's size, recognised by its content: gray of 8 or 16 bits, or with a palette
/// or colours that are all grays. Gray g is 2π·g/n; n is 256 or 65536, or the gray of 2π that `scale` states.
///
/// # Errors
/// [`FileFault`] where it is neither format or damaged, has colours, transparency, grays of fewer
/// bits or another size than the panel, or fewer grays than `scale` says.
pub(super) fn read(path: &Path, picture: &[u8], panel: Resolution, scale: GrayScale) -> Result<Vec<f32>, FileFault> {
    let fault = |found: String, advice: &str| FileFault {
        found: format!("{}: {found}", path.display()),
        expected: format!("a gray PNG of 8 or 16 bits, or a BMP, {panel} pixels"),
        advice: advice.into(),
    };
    let damaged = |why: image::ImageError| fault(why.to_string(), "save it as a gray PNG or BMP again");
    let (width, height) = open(path, picture, &fault)?.into_dimensions().map_err(damaged)?;
    let size = Resolution { width: width as usize, height: height as usize };
    if size != panel {
        return Err(fault(
            format!("{size} pixels"),
            "make it at the panel's own size, or correct panel.width_px and height_px",
        ));
    }
    let bits = png_grey_bits(picture).map_err(|why| FileFault::unreadable(path, &why))?;
    if let Some(bits) = bits.filter(|bits| *bits < 8) {
        return Err(fault(format!("grays of {bits} bits"), "save it with 8 or 16 bits, as its grays were measured"));
    }
    let picture = open(path, picture, &fault)?.decode().map_err(damaged)?;
    let (grays, full_range) = match picture {
        DynamicImage::ImageLuma8(gray) => (gray.into_raw().into_iter().map(f64::from).collect(), 256.0),
        DynamicImage::ImageLuma16(gray) => (gray.into_raw().into_iter().map(f64::from).collect(), 65536.0),
        // How palettes are decoded.
        DynamicImage::ImageRgb8(colours) => {
            let mut grays: Vec<f64> = Vec::with_capacity(panel.pixels());
            for (x, y, pixel) in colours.enumerate_pixels() {
                let [red, green, blue] = pixel.0;
                if red != green || green != blue {
                    let found = format!("the colour {red}, {green}, {blue} at column {x} of row {y}");
                    return Err(fault(found, "save it with one gray channel"));
                }
                grays.push(red.into());
            }
            (grays, 256.0)
        }
        other => {
            return Err(fault(format!("{:?} pixels", other.color()), "save it with one gray channel, without alpha"));
        }
    };
    let gray_of_2pi = scale.gray_of_2pi.unwrap_or(full_range);
    if gray_of_2pi > full_range {
        let found = format!("a picture of {full_range} grays, of which {gray_of_2pi} should be 2π");
        return Err(fault(found, "correct panel.flatness_2pi_gray, or save the picture with 16 bits"));
    }
    let sign = if scale.subtracted { -1.0 } else { 1.0 };
    Ok(grays.into_iter().map(|gray: f64| (sign * TAU * gray / gray_of_2pi) as f32).collect())
}

/// The file as a picture of one of the two formats.
fn open<'a>(
    path: &Path,
    picture: &'a [u8],
    fault: &impl Fn(String, &str) -> FileFault,
) -> Result<ImageReader<Cursor<&'a [u8]>>, FileFault> {
    let reader = ImageReader::new(Cursor::new(picture)).with_guessed_format();
    let reader = reader.map_err(|why| FileFault::unreadable(path, &why))?;
    match reader.format() {
        Some(ImageFormat::Png | ImageFormat::Bmp) => Ok(reader),
        _ => Err(fault("neither PNG nor BMP".into(), "save it as a gray PNG or BMP")),
    }
}

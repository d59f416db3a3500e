//! A picture of the phase that flattens a panel.

use std::f32::consts::TAU;
use std::path::Path;

use image::{DynamicImage, ImageFormat, ImageReader};

use super::files::{FileFault, plain_file};
use crate::Resolution;

/// Reads the phase in radians to add at each panel pixel, row-major.
///
/// The picture is a gray PNG of the panel's size; its full range is 2π: level g of n (256 or 65536) is 2π·g/n.
///
/// # Errors
/// [`FileFault`] where the file cannot be read, is no gray PNG, or has another size than the panel.
pub(super) fn read(path: &Path, panel: Resolution) -> Result<Vec<f32>, FileFault> {
    plain_file(path)?;
    let fault = |found: String, advice: &str| FileFault {
        found: format!("{}: {found}", path.display()),
        expected: format!("a gray PNG of 8 or 16 bits, {panel} pixels, full range 2π"),
        advice: advice.into(),
    };
    let open = || -> Result<ImageReader<_>, FileFault> {
        let mut reader = ImageReader::open(path).map_err(|why| FileFault::unreadable(path, &why))?;
        reader.set_format(ImageFormat::Png);
        Ok(reader)
    };
    let damaged = |why: image::ImageError| fault(why.to_string(), "save it as a gray PNG again");
    let (width, height) = open()?.into_dimensions().map_err(damaged)?;
    let size = Resolution { width: width as usize, height: height as usize };
    if size != panel {
        return Err(fault(
            format!("{size} pixels"),
            "make it at the panel's own size, or correct panel.width_px and height_px",
        ));
    }
    match open()?.decode().map_err(damaged)? {
        DynamicImage::ImageLuma8(gray) => Ok(gray.as_raw().iter().map(|&g| f32::from(g) * (TAU / 256.0)).collect()),
        DynamicImage::ImageLuma16(gray) => Ok(gray.as_raw().iter().map(|&g| f32::from(g) * (TAU / 65536.0)).collect()),
        other => Err(fault(format!("{:?} pixels", other.color()), "save it with one gray channel, without alpha")),
    }
}

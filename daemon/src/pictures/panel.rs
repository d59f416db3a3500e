//! From the panel's levels back to pictures and phases.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use holod_calibration::rig::{Panel, PanelMode};
use holod_calibration::{Colour, PerColour, Resolution};
use holod_model::LinearImage;
use holod_model::optics::PhasePattern;
use holod_slm_output::packing::{PIXEL_BYTES, PixelFormat, write_frame};
use holod_slm_output::{LevelsFrame, PanelEncoder};
use image::{DynamicImage, ImageBuffer, ImageFormat, Pixel, Primitive, Rgb, RgbImage};

use crate::failure::{Exit, Failure};

/// The phases that the panel shows for `levels`, where it carries the pattern.
pub fn shown_pattern(encoder: &PanelEncoder, levels: &LevelsFrame) -> PhasePattern {
    let mut pattern = PhasePattern::flat(encoder.pattern_resolution());
    for colour in Colour::ALL {
        let shown = encoder.decode_pattern(colour, &levels.unpack_colour(colour).levels);
        pattern.plane_mut(colour).copy_from_slice(&shown);
    }
    pattern
}

/// The levels of the whole panel as a picture: each colour's in its own channel, as they are. A panel of more than 8
/// bits has a picture of 16.
pub fn levels_picture(levels: &LevelsFrame) -> DynamicImage {
    let fields = Colour::ALL.map(|colour| levels.unpack_colour(colour).levels);
    let layout = levels.layout();
    if layout.packing.bit_depth() > 8 {
        from_planes(layout.resolution, |colour, pixel| fields[colour][pixel]).into()
    } else {
        from_planes(layout.resolution, |colour, pixel| fields[colour][pixel] as u8).into()
    }
}

/// The levels that [`levels_picture`] wrote to the file at `path` for `panel` of `resolution`: red, green, blue.
///
/// # Errors
/// The file cannot be read, or is no picture of such a panel.
pub fn read_levels(path: &Path, panel: &Panel, resolution: Resolution) -> Result<PerColour<Vec<u16>>, Failure> {
    let data = |what: String| Failure::new(Exit::Data, format!("{}: {what}", path.display()));
    let file = File::open(path).map_err(|error| Failure::new(Exit::NoInput, format!("{}: {error}", path.display())))?;
    let picture = image::load(BufReader::new(file), ImageFormat::Png).map_err(|error| data(error.to_string()))?;
    let bits = if panel.packing.bit_depth() > 8 { 16 } else { 8 };
    let found = Resolution { width: picture.width() as usize, height: picture.height() as usize };
    let found_bits = picture.color().bytes_per_pixel() * 8 / picture.color().channel_count();
    if found != resolution || picture.color().channel_count() != 3 || u16::from(found_bits) != bits {
        let channels = picture.color().channel_count();
        return Err(data(format!(
            "found a picture of {found} with {channels} channels of {found_bits} bits, expected one of {resolution} with 3 \
             of {bits}, as a run of this rig records it; name the rig of that run (bench/rig.toml in the record)"
        )));
    }
    let samples: Vec<u16> = match picture {
        DynamicImage::ImageRgb8(picture) => picture.into_raw().into_iter().map(u16::from).collect(),
        other => other.into_rgb16().into_raw(),
    };
    Ok(PerColour([0, 1, 2].map(|colour| samples.iter().copied().skip(colour).step_by(3).collect())))
}

/// What travels to the panel for `levels`, bit for bit and with what the video has around the panel: each different
/// video frame of the colour frame, with the colour whose field it carries where it carries one. Ten bits of a channel
/// are the high ones of sixteen, and below them the highest again, so that white is white.
pub fn video_pictures(levels: &LevelsFrame) -> Vec<(Option<Colour>, DynamicImage)> {
    let layout = levels.layout();
    let Resolution { width, height } = layout.video_resolution();
    let is_deep = layout.packing.channel_bits() > 8;
    let format = if is_deep { PixelFormat::Xrgb10 } else { PixelFormat::Rgbx8 };
    let picture = |first_field: usize| -> DynamicImage {
        let mut pixels = vec![0; width * height * PIXEL_BYTES];
        write_frame(levels, first_field, format, width * PIXEL_BYTES, &mut pixels);
        let pixels = pixels.as_chunks::<PIXEL_BYTES>().0.iter();
        let (width, height) = (width as u32, height as u32);
        if is_deep {
            let words = pixels.flat_map(|&pixel| {
                let word = u32::from_le_bytes(pixel);
                [20, 10, 0].map(|up| (word >> up & 0x3ff) as u16).map(|channel| channel << 6 | channel >> 4)
            });
            let words = words.collect();
            ImageBuffer::<Rgb<u16>, _>::from_raw(width, height, words).expect("three words for each pixel").into()
        } else {
            let bytes = pixels.flat_map(|&[red, green, blue, _]| [red, green, blue]).collect();
            RgbImage::from_raw(width, height, bytes).expect("three bytes for each pixel").into()
        }
    };
    if layout.mode == PanelMode::ChannelPacked {
        return vec![(None, picture(0))];
    }
    let mut pictures: Vec<(Option<Colour>, DynamicImage)> = Vec::new();
    for field in 0..layout.fields() {
        let colour = Some(layout.colour_of_field(field));
        if pictures.last().is_none_or(|(last, _)| *last != colour) {
            pictures.push((colour, picture(field)));
        }
    }
    pictures
}

/// A phase pattern as a picture: 0 black, 2π white.
pub fn phase_picture(pattern: &PhasePattern, colour: Colour) -> RgbImage {
    let phases = pattern.plane(colour);
    let grey = |phase_rad: f32| (phase_rad.rem_euclid(std::f32::consts::TAU) / std::f32::consts::TAU * 256.0) as u8;
    from_planes(pattern.resolution, |_, pixel| grey(phases[pixel]))
}

/// A picture as a screen shows it.
pub fn screen_picture(picture: &LinearImage) -> RgbImage {
    let Resolution { width, height } = picture.resolution;
    RgbImage::from_raw(width as u32, height as u32, picture.to_srgb8()).expect("three bytes for each pixel")
}

fn from_planes<T>(resolution: Resolution, value: impl Fn(usize, usize) -> T) -> ImageBuffer<Rgb<T>, Vec<T>>
where
    Rgb<T>: Pixel<Subpixel = T>,
    T: Primitive,
{
    ImageBuffer::from_fn(resolution.width as u32, resolution.height as u32, |x, y| {
        let pixel = y as usize * resolution.width + x as usize;
        Rgb([0, 1, 2].map(|colour| value(colour, pixel)))
    })
}

#[cfg(test)]
mod tests {
    use holod_calibration::rig::{Packing, Rig, VideoMargins};
    use holod_slm_output::FrameLayout;

    use super::*;

    #[test]
    fn a_picture_of_levels_has_all_of_their_bits_and_is_read_again() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("levels.png");
        let resolution = Resolution { width: 4, height: 2 };
        let mut panel = Rig::default().panel;
        for (packing, top) in [(Packing::Gray, 255), (Packing::Gray10, 1023), (Packing::Red8Green8, 65535)] {
            (panel.packing, panel.bit_depth) = (packing, packing.bit_depth());
            let mut levels = LevelsFrame::new(FrameLayout::new(&panel, resolution));
            for (index, sample) in levels.samples_mut().iter_mut().enumerate() {
                *sample = top - index as u16;
            }
            crate::results::save_png(levels_picture(&levels), &path).unwrap();
            let read = read_levels(&path, &panel, resolution).unwrap();
            for colour in Colour::ALL {
                assert_eq!(read[colour], levels.unpack_colour(colour).levels, "{packing:?} {colour}");
            }
        }
        for (packing, resolution) in
            [(Packing::Gray, resolution), (Packing::Gray10, Resolution { height: 4, ..resolution })]
        {
            panel.packing = packing;
            let refused = read_levels(&path, &panel, resolution).unwrap_err();
            assert!(refused.to_string().contains("4x2 with 3 channels of 16 bits"), "{refused}");
        }
    }

    #[test]
    fn a_video_picture_has_what_the_video_has_around_the_panel() {
        let mut panel = Rig::default().panel;
        panel.video_margins = VideoMargins { left: 2, right: 1, top: 1, bottom: 3 };
        for (packing, white) in [(Packing::Gray, 200 * 257), (Packing::Gray10, 200 << 6 | 200 >> 4)] {
            panel.packing = packing;
            let mut levels = LevelsFrame::new(FrameLayout::new(&panel, Resolution { width: 4, height: 2 }));
            levels.samples_mut().fill(200);
            let pictures = video_pictures(&levels);
            assert_eq!(pictures.len(), 1);
            let picture = pictures[0].1.to_rgb16();
            assert_eq!(picture.dimensions(), (7, 6));
            for (x, y, pixel) in picture.enumerate_pixels() {
                let is_panel = (2..6).contains(&x) && (1..3).contains(&y);
                assert_eq!(pixel.0, [if is_panel { white } else { 0 }; 3], "{packing:?} at {x},{y}");
            }
        }
    }
}

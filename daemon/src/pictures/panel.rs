//! From the panel's levels back to pictures and phases.

use holod_calibration::rig::PanelMode;
use holod_calibration::{Colour, Resolution};
use holod_model::LinearImage;
use holod_model::optics::PhasePattern;
use holod_slm_output::packing::{PIXEL_BYTES, PixelFormat, write_frame};
use holod_slm_output::{LevelsFrame, PanelEncoder};
use image::{DynamicImage, ImageBuffer, Rgb, RgbImage};

/// The phases that the panel shows for `levels`, where it carries the pattern.
pub fn shown_pattern(encoder: &PanelEncoder, levels: &LevelsFrame) -> PhasePattern {
    let mut pattern = PhasePattern::flat(encoder.pattern_resolution());
    for colour in Colour::ALL {
        let shown = encoder.decode_pattern(colour, &levels.unpack_colour(colour).levels);
        pattern.plane_mut(colour).copy_from_slice(&shown);
    }
    pattern
}

/// The levels of the whole panel as a picture: each colour's low 8 bits in its own channel.
pub fn levels_picture(levels: &LevelsFrame) -> RgbImage {
    let fields = Colour::ALL.map(|colour| levels.unpack_colour(colour).levels);
    from_planes(levels.layout().resolution, |colour, pixel| fields[colour][pixel] as u8)
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

fn from_planes(resolution: Resolution, value: impl Fn(usize, usize) -> u8) -> RgbImage {
    RgbImage::from_fn(resolution.width as u32, resolution.height as u32, |x, y| {
        let pixel = y as usize * resolution.width + x as usize;
        image::Rgb([0, 1, 2].map(|colour| value(colour, pixel)))
    })
}

#[cfg(test)]
mod tests {
    use holod_calibration::rig::{Packing, Rig, VideoMargins};
    use holod_slm_output::FrameLayout;

    use super::*;

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

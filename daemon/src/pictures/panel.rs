//! From the panel's levels back to pictures and phases.

use holod_calibration::rig::PanelMode;
use holod_calibration::{Colour, Resolution};
use holod_model::LinearImage;
use holod_model::optics::PhasePattern;
use holod_slm_output::packing::channels;
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

/// What travels to the panel for `levels`, bit for bit: each different video frame of the colour frame, with the colour
/// whose field it carries where it carries one. Ten bits of a channel are the high ones of sixteen, and below them the
/// highest again, so that white is white.
pub fn video_pictures(levels: &LevelsFrame) -> Vec<(Option<Colour>, DynamicImage)> {
    let layout = levels.layout();
    let Resolution { width, height } = layout.resolution;
    let picture = |first_field: usize| -> DynamicImage {
        let rows = (0..height).map(|row| levels.video_row(first_field, row));
        let channels: Vec<u16> = match layout.mode {
            PanelMode::ChannelPacked => {
                let pixels = rows.flat_map(|row| row.as_chunks().0);
                pixels.flat_map(|&shown| layout.channels_of(shown)).collect()
            }
            _ => rows.flatten().flat_map(|&level| channels(layout.packing, level)).collect(),
        };
        let (width, height) = (width as u32, height as u32);
        if layout.packing.channel_bits() == 8 {
            let bytes = channels.into_iter().map(|channel| channel as u8).collect();
            RgbImage::from_raw(width, height, bytes).expect("three bytes for each pixel").into()
        } else {
            let words = channels.into_iter().map(|channel| channel << 6 | channel >> 4).collect();
            ImageBuffer::<Rgb<u16>, _>::from_raw(width, height, words).expect("three words for each pixel").into()
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

//! Levels on the video link: which bits of which channel carry them.
//!
//! What travels is exact: no gamma, no dithering, full range. [`channels`] says what one level becomes; [`write_frame`]
//! and [`pack_row`] do the same for whole pictures as fast as memory allows.

use holod_calibration::Colour;
use holod_calibration::rig::{Packing, PanelMode, VideoMargins};

use crate::fields::{FIELDS, FrameLayout, LevelsFrame};

/// Bytes of a video pixel in memory.
pub const PIXEL_BYTES: usize = 4;

/// How a video pixel stands in memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PixelFormat {
    /// Bytes red, green, blue and 255: wgpu's `Rgba8Unorm`, DRM's `XB24`.
    Rgbx8,
    /// Bytes blue, green, red and 255: wgpu's `Bgra8Unorm`, DRM's `XR24` (`XRGB8888`).
    Bgrx8,
    /// A little-endian word of ten bits each, red in the highest but two: DRM's `XR30` (`XRGB2101010`).
    Xrgb10,
}

impl PixelFormat {
    /// Bits of a channel.
    pub const fn channel_bits(self) -> u8 {
        match self {
            Self::Rgbx8 | Self::Bgrx8 => 8,
            Self::Xrgb10 => 10,
        }
    }
}

/// Red, green and blue of a video pixel that carries `level`, which is below 2^bits of `packing`.
pub const fn channels(packing: Packing, level: u16) -> [u16; 3] {
    match packing {
        Packing::Gray | Packing::Gray10 => [level; 3],
        Packing::Red8Blue2 => [level >> 2, 0, level & 0b11],
        Packing::Red3Green3Blue4 => {
            let (red, green, blue) = (level >> 7 & 0b111, level >> 4 & 0b111, level & 0b1111);
            [red << 5 | red << 1, green << 5 | green << 1, blue << 4 | blue]
        }
        Packing::Red8Green8 => [level >> 8, level & 0xff, 0],
    }
}

/// Writes the video frame that begins with the `first_field`-th field of the colour frame `levels` to `pixels`, whose
/// rows are `pitch` bytes apart; around the panel's pixels level 0. What lies behind the end of a row stays as it is.
/// Neither allocates nor locks.
///
/// Each byte is written once and in order, and none is read, as memory wants it that the processor does not cache.
///
/// # Panics
/// Where `pixels` are too few, the frame has no such field, or `format` has another number of bits in a channel than
/// the frame's packing needs.
pub fn write_frame(levels: &LevelsFrame, first_field: usize, format: PixelFormat, pitch: usize, pixels: &mut [u8]) {
    let layout = levels.layout();
    let (video, VideoMargins { left, top, .. }) = (layout.video_resolution(), layout.video_margins);
    let panel_rows = top..top + layout.resolution.height;
    let panel_bytes = PIXEL_BYTES * left..PIXEL_BYTES * (left + layout.resolution.width);
    let rows = pixels.chunks_mut(pitch).take(video.height);
    assert_eq!(rows.len(), video.height, "a video frame has {} rows", video.height);
    for (row, pixels) in rows.enumerate() {
        let pixels = &mut pixels[..PIXEL_BYTES * video.width];
        if panel_rows.contains(&row) {
            fill_black(format, &mut pixels[..panel_bytes.start]);
            let samples = levels.video_row(first_field, row - top);
            pack_row(&layout, samples, format, &mut pixels[panel_bytes.clone()]);
            fill_black(format, &mut pixels[panel_bytes.end..]);
        } else {
            fill_black(format, pixels);
        }
    }
}

/// Writes pixels of level 0, which is black in every packing.
fn fill_black(format: PixelFormat, pixels: &mut [u8]) {
    let black = u32::MAX << (3 * format.channel_bits());
    pixels.as_chunks_mut::<PIXEL_BYTES>().0.fill(black.to_le_bytes());
}

/// Writes one row of a video frame: `samples` as [`LevelsFrame::video_row`] gives them, `pixels` of [`PIXEL_BYTES`]
/// each.
///
/// # Panics
/// Where `pixels` has room for another number of pixels than `samples` are; as [`write_frame`].
pub fn pack_row(layout: &FrameLayout, samples: &[u16], format: PixelFormat, pixels: &mut [u8]) {
    let bits = layout.packing.channel_bits();
    assert_eq!(format.channel_bits(), bits, "levels packed as {} need {bits} bits a channel", layout.packing.name());
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2.
        return unsafe { pack_avx2(layout, samples, format, pixels) };
    }
    pack(layout, samples, format, pixels);
}

/// [`pack`], for which the compiler may use wider vectors.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn pack_avx2(layout: &FrameLayout, samples: &[u16], format: PixelFormat, pixels: &mut [u8]) {
    pack(layout, samples, format, pixels);
}

#[inline(always)]
fn pack(layout: &FrameLayout, samples: &[u16], format: PixelFormat, pixels: &mut [u8]) {
    match format {
        PixelFormat::Rgbx8 => pack_as::<0, 8, 16, 8>(layout, samples, pixels),
        PixelFormat::Bgrx8 => pack_as::<16, 8, 0, 8>(layout, samples, pixels),
        PixelFormat::Xrgb10 => pack_as::<20, 10, 0, 10>(layout, samples, pixels),
    }
}

/// Where red, green and blue begin in a little-endian word, in bits from the lowest, and how many bits each has; the
/// bits above are 1.
#[inline(always)]
fn pack_as<const RED: u32, const GREEN: u32, const BLUE: u32, const BITS: u32>(
    layout: &FrameLayout,
    samples: &[u16],
    pixels: &mut [u8],
) {
    let full = u32::MAX << (3 * BITS);
    let mask = (1 << BITS) - 1;
    let (pixels, rest) = pixels.as_chunks_mut::<PIXEL_BYTES>();
    assert!(rest.is_empty(), "pixels have {PIXEL_BYTES} bytes");
    if layout.mode == PanelMode::ChannelPacked {
        let (fields, rest) = samples.as_chunks::<FIELDS>();
        assert!(rest.is_empty() && fields.len() == pixels.len(), "a row has {FIELDS} samples for each pixel");
        let shifts = layout.channel_order.map(|channel| match channel {
            Colour::Red => RED,
            Colour::Green => GREEN,
            Colour::Blue => BLUE,
        });
        for (pixel, &fields) in pixels.iter_mut().zip(fields) {
            let [first, second, third] = fields.map(|level| u32::from(level) & mask);
            *pixel = (first << shifts[0] | second << shifts[1] | third << shifts[2] | full).to_le_bytes();
        }
        return;
    }
    assert_eq!(samples.len(), pixels.len(), "a row has one sample for each pixel");
    let rgb = |[red, green, blue]: [u32; 3]| red << RED | green << GREEN | blue << BLUE | full;
    match layout.packing {
        Packing::Gray | Packing::Gray10 => each(samples, pixels, |level| rgb([level & mask; 3])),
        Packing::Red8Blue2 => each(samples, pixels, |level| rgb([level >> 2 & mask, 0, level & 0b11])),
        Packing::Red3Green3Blue4 => each(samples, pixels, |level| {
            let (red, green, blue) = (level >> 7 & 0b111, level >> 4 & 0b111, level & 0b1111);
            rgb([red * 0b10_0010, green * 0b10_0010, blue * 0b1_0001])
        }),
        Packing::Red8Green8 => each(samples, pixels, |level| rgb([level >> 8, level & 0xff, 0])),
    }
}

#[inline(always)]
fn each(samples: &[u16], pixels: &mut [[u8; PIXEL_BYTES]], pixel_of: impl Fn(u32) -> u32) {
    for (pixel, &level) in pixels.iter_mut().zip(samples) {
        *pixel = pixel_of(u32::from(level)).to_le_bytes();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use holod_calibration::Resolution;
    use proptest::prelude::*;

    fn layout(mode: PanelMode, packing: Packing) -> FrameLayout {
        let resolution = Resolution { width: 7, height: 1 };
        FrameLayout {
            resolution,
            mode,
            field_order: Colour::ALL,
            channel_order: Colour::ALL,
            frames_per_colour: 1,
            packing,
            video_margins: VideoMargins::default(),
        }
    }

    /// What a panel reads out of a video pixel, written bit by bit from the makers' descriptions.
    fn level_read(packing: Packing, [red, green, blue]: [u16; 3]) -> u16 {
        let bits =
            |places: &[(u16, u32)]| places.iter().fold(0u16, |level, &(byte, place)| level << 1 | byte >> place & 1);
        match packing {
            Packing::Gray | Packing::Gray10 => {
                assert!(red == green && green == blue);
                red
            }
            Packing::Red8Blue2 => bits(&[
                (red, 7),
                (red, 6),
                (red, 5),
                (red, 4),
                (red, 3),
                (red, 2),
                (red, 1),
                (red, 0),
                (blue, 1),
                (blue, 0),
            ]),
            Packing::Red3Green3Blue4 => bits(&[
                (red, 7),
                (red, 6),
                (red, 5),
                (green, 7),
                (green, 6),
                (green, 5),
                (blue, 7),
                (blue, 6),
                (blue, 5),
                (blue, 4),
            ]),
            Packing::Red8Green8 => red << 8 | green,
        }
    }

    /// The second half of the refresh of a 120 Hz panel with ten bits.
    fn second_level_read([red, green, blue]: [u16; 3]) -> u16 {
        (red >> 1 & 7) << 7 | (green >> 1 & 7) << 4 | blue & 15
    }

    #[test]
    fn a_panel_reads_the_level_that_was_meant() {
        for packing in Packing::ALL {
            for level in 0..=((1u32 << packing.bit_depth()) - 1) as u16 {
                let sent = channels(packing, level);
                assert!(sent.iter().all(|&channel| u32::from(channel) < 1 << packing.channel_bits()), "{packing:?}");
                assert_eq!(level_read(packing, sent), level, "{packing:?}");
            }
        }
        for level in 0..1024 {
            assert_eq!(second_level_read(channels(Packing::Red3Green3Blue4, level)), level);
        }
    }

    #[test]
    fn known_levels_become_known_bytes() {
        assert_eq!(channels(Packing::Gray, 0xa5), [0xa5, 0xa5, 0xa5]);
        assert_eq!(channels(Packing::Red8Blue2, 0x326), [0b1100_1001, 0, 0b10]);
        assert_eq!(channels(Packing::Red3Green3Blue4, 0x327), [0b1100_1100, 0b0100_0100, 0b0111_0111]);
        assert_eq!(channels(Packing::Red8Green8, 0x12ab), [0x12, 0xab, 0]);
    }

    /// A pixel by the formats' definitions, byte for byte.
    fn bytes_of(format: PixelFormat, [red, green, blue]: [u16; 3]) -> [u8; PIXEL_BYTES] {
        match format {
            PixelFormat::Rgbx8 => [red as u8, green as u8, blue as u8, 255],
            PixelFormat::Bgrx8 => [blue as u8, green as u8, red as u8, 255],
            PixelFormat::Xrgb10 => {
                (0b11 << 30 | u32::from(red) << 20 | u32::from(green) << 10 | u32::from(blue)).to_le_bytes()
            }
        }
    }

    fn formats(packing: Packing) -> impl Iterator<Item = PixelFormat> {
        let all = [PixelFormat::Rgbx8, PixelFormat::Bgrx8, PixelFormat::Xrgb10];
        all.into_iter().filter(move |format| format.channel_bits() == packing.channel_bits())
    }

    proptest! {
        #[test]
        fn a_row_is_its_pixels(
            levels in prop::collection::vec(any::<u16>(), 0..400), packing in prop::sample::select(&Packing::ALL[..]),
        ) {
            let top = ((1u32 << packing.bit_depth()) - 1) as u16;
            let levels: Vec<u16> = levels.into_iter().map(|level| level & top).collect();
            let layout = layout(PanelMode::FieldSequential, packing);
            for format in formats(packing) {
                let mut pixels = vec![7; PIXEL_BYTES * levels.len()];
                let mut plain = pixels.clone();
                pack_row(&layout, &levels, format, &mut pixels);
                pack(&layout, &levels, format, &mut plain);
                prop_assert_eq!(&pixels, &plain, "with and without wider vectors");
                for (bytes, &level) in pixels.chunks_exact(PIXEL_BYTES).zip(&levels) {
                    prop_assert_eq!(bytes, bytes_of(format, channels(packing, level)));
                }
            }
        }

        #[test]
        fn a_channel_packed_row_has_a_field_in_each_channel(
            fields in prop::collection::vec(any::<[u16; 3]>(), 0..400), ten_bits in prop::bool::ANY,
            channel_order in prop::sample::select(vec![Colour::ALL, [Colour::Green, Colour::Blue, Colour::Red]]),
        ) {
            let packing = if ten_bits { Packing::Gray10 } else { Packing::Gray };
            let top = (1u16 << packing.bit_depth()) - 1;
            let samples: Vec<u16> = fields.iter().flatten().map(|&level| level & top).collect();
            let layout = FrameLayout { channel_order, ..layout(PanelMode::ChannelPacked, packing) };
            for format in formats(packing) {
                let mut pixels = vec![7; PIXEL_BYTES * fields.len()];
                pack_row(&layout, &samples, format, &mut pixels);
                for (bytes, &shown) in pixels.chunks_exact(PIXEL_BYTES).zip(samples.as_chunks::<3>().0) {
                    let [first, second, third] = shown;
                    // Blue is shown second there, red third.
                    let channels = if channel_order == Colour::ALL { shown } else { [third, first, second] };
                    prop_assert_eq!(bytes, bytes_of(format, channels));
                }
            }
        }
    }

    proptest! {
        #[test]
        fn around_the_panel_a_video_frame_is_black_and_inside_it_is_the_panels(
            [left, right, top, bottom] in prop::array::uniform4(0usize..4), packed in any::<bool>(),
            packing in prop::sample::select(&Packing::ALL[..]), extra in 0usize..9, seed in any::<u16>(),
        ) {
            let packed = packed && matches!(packing, Packing::Gray | Packing::Gray10);
            let mode = if packed { PanelMode::ChannelPacked } else { PanelMode::FieldSequential };
            let resolution = Resolution { width: 5, height: 3 };
            let plain = FrameLayout { resolution, ..layout(mode, packing) };
            let framed = FrameLayout { video_margins: VideoMargins { left, right, top, bottom }, ..plain };
            let levels_mask = ((1u32 << packing.bit_depth()) - 1) as u16;
            let frames = [plain, framed].map(|layout| {
                let mut frame = LevelsFrame::new(layout);
                for (index, sample) in frame.samples_mut().iter_mut().enumerate() {
                    *sample = (index as u16 + 1).wrapping_mul(seed | 1) & levels_mask;
                }
                frame
            });
            for format in formats(packing) {
                let [panel, video] = frames.each_ref().map(|frame| {
                    let video = frame.layout().video_resolution();
                    let pitch = PIXEL_BYTES * video.width + extra;
                    let mut pixels = vec![0xee; pitch * video.height];
                    write_frame(frame, 0, format, pitch, &mut pixels);
                    pixels.chunks(pitch).map(<[u8]>::to_vec).collect::<Vec<_>>()
                });
                let black = bytes_of(format, channels(packing, 0));
                for (y, row) in video.iter().enumerate() {
                    for (x, pixel) in row.as_chunks::<PIXEL_BYTES>().0[..left + 5 + right].iter().enumerate() {
                        let inside = (left..left + 5).contains(&x) && (top..top + 3).contains(&y);
                        let expected = if inside {
                            &panel[y - top][PIXEL_BYTES * (x - left)..][..PIXEL_BYTES]
                        } else {
                            &black
                        };
                        prop_assert_eq!(&pixel[..], expected, "column {}, row {}", x, y);
                    }
                    prop_assert!(row[row.len() - extra..].iter().all(|&byte| byte == 0xee), "behind the row");
                }
            }
        }
    }

    #[test]
    fn a_frame_is_its_rows_and_the_pitch_is_left_alone() {
        let resolution = Resolution { width: 3, height: 2 };
        let layout = FrameLayout { resolution, ..layout(PanelMode::FieldSequential, Packing::Red8Blue2) };
        let mut frame = LevelsFrame::new(layout);
        frame.field_mut(Colour::Green).write(&[0, 1, 2, 1021, 1022, 1023]);
        let mut pixels = [0xee; 2 * 16];
        write_frame(&frame, 1, PixelFormat::Bgrx8, 16, &mut pixels);
        let rest = [0xee; 4];
        let rows = [
            [[0, 0, 0, 255], [1, 0, 0, 255], [2, 0, 0, 255], rest],
            [[1, 0, 255, 255], [2, 0, 255, 255], [3, 0, 255, 255], rest],
        ];
        assert_eq!(pixels.as_slice(), rows.as_flattened().as_flattened());
        // Canary: one level that differs is seen.
        frame.field_mut(Colour::Green).write(&[0, 1, 2, 1021, 1020, 1023]);
        let mut others = [0xee; 2 * 16];
        write_frame(&frame, 1, PixelFormat::Bgrx8, 16, &mut others);
        assert_ne!(others, pixels);
    }

    #[test]
    #[should_panic(expected = "levels packed as gray10 need 10 bits a channel")]
    fn a_format_of_too_few_bits_is_refused() {
        pack_row(&layout(PanelMode::FieldSequential, Packing::Gray10), &[0; 3], PixelFormat::Bgrx8, &mut [0; 12]);
    }

    #[test]
    #[should_panic(expected = "one sample for each pixel")]
    fn a_row_of_another_length_is_refused() {
        pack_row(&layout(PanelMode::FieldSequential, Packing::Gray), &[0; 3], PixelFormat::Rgbx8, &mut [0; 16]);
    }
}

//! Pictures that another program hands over, in the formats of the live feed.

use std::io;

use half::f16;
use holod_calibration::{Dioptres, DisplayGeometry, Resolution};

use super::fit::Placement;
use super::{Fit, FrameReport, ROUNDING, RgbdFrame, depth};
use crate::picture::srgb_to_linear;

/// How a picture's colours are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LiveColour {
    /// Red, green, blue and one more value that is ignored, 8 bits each, sRGB.
    Rgba8,
    /// The same as half floats of linear light.
    Rgba16F,
    /// Three planes of floats, linear light.
    PlanarF32,
}

/// How a picture's depths are stored.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum LiveDepth {
    /// There are none: the picture is a plane.
    Plane(Dioptres),
    /// Unsigned 16-bit millimetres; 0 is no depth.
    MillimetresU16,
    /// Half floats, metres.
    MetresF16,
    /// Half floats, dioptres.
    DioptresF16,
    /// Floats, metres.
    MetresF32,
    /// Floats, dioptres.
    DioptresF32,
}

/// What all pictures of one program are like. Rows are without padding, the top one first, in the machine's byte order.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LiveFormat {
    /// Size of colour and depth.
    pub resolution: Resolution,
    /// How colours are stored.
    pub colour: LiveColour,
    /// How depths are stored.
    pub depth: LiveDepth,
}

/// Why a picture cannot be shown.
#[derive(Debug, thiserror::Error)]
pub enum LiveError {
    /// It does not fit.
    #[error(
        "found pictures of {found}, larger than the hologram of {wanted}; start holod with --fit contain (or cover, or crop), \
         or send smaller ones"
    )]
    TooLarge {
        /// Size of the pictures.
        found: Resolution,
        /// Size of the hologram.
        wanted: Resolution,
    },
    /// No pixel has a depth.
    #[error("found no pixel with a valid depth, expected {expected}")]
    NoDepth {
        /// What a depth is in this format.
        expected: &'static str,
    },
    /// Its bytes cannot be read.
    #[error("the picture cannot be read: {0}")]
    Read(#[from] io::Error),
}

impl LiveColour {
    /// Bytes of a pixel.
    pub const fn pixel_bytes(self) -> usize {
        match self {
            Self::Rgba8 => 4,
            Self::Rgba16F => 8,
            Self::PlanarF32 => 12,
        }
    }
}

impl LiveDepth {
    /// Bytes of a pixel.
    pub const fn pixel_bytes(self) -> usize {
        match self {
            Self::Plane(_) => 0,
            Self::MillimetresU16 | Self::MetresF16 | Self::DioptresF16 => 2,
            Self::MetresF32 | Self::DioptresF32 => 4,
        }
    }

    const fn expected(self) -> &'static str {
        match self {
            Self::Plane(_) => "a distance in dioptres",
            Self::MillimetresU16 => "millimetres above 0",
            Self::MetresF16 | Self::MetresF32 => "metres above 0",
            Self::DioptresF16 | Self::DioptresF32 => "dioptres of 0 or more",
        }
    }

    /// Vergence in dioptres of a number as it is stored; NaN where it is none.
    fn dioptres(self, number: f32) -> f32 {
        let reciprocal = |length: f32| if length > 0.0 { 1.0 / length } else { f32::NAN };
        match self {
            Self::Plane(plane) => plane.0 as f32,
            Self::MillimetresU16 => 1e3 * reciprocal(number),
            Self::MetresF16 | Self::MetresF32 => reciprocal(number),
            Self::DioptresF16 | Self::DioptresF32 => {
                if number >= 0.0 && number.is_finite() {
                    number
                } else {
                    f32::NAN
                }
            }
        }
    }
}

impl LiveFormat {
    /// Bytes of a picture's colours.
    pub const fn colour_bytes(&self) -> usize {
        self.resolution.pixels() * self.colour.pixel_bytes()
    }

    /// Bytes of a picture's depths.
    pub const fn depth_bytes(&self) -> usize {
        self.resolution.pixels() * self.depth.pixel_bytes()
    }
}

/// Turns the pictures of one program into frames of one size. Values of 8 and 16 bits go through tables.
pub struct LiveReader {
    format: LiveFormat,
    geometry: DisplayGeometry,
    placement: Placement,
    padded_px: usize,
    colours: ColourTable,
    /// Normalised depth of each 16-bit number; empty for other formats.
    depths: Vec<f32>,
    /// Bytes on their way.
    rows: Vec<u8>,
    /// Amplitude, or linear light where the picture is scaled, and normalised depth, at the picture's size; empty where
    /// that is the frame's.
    picture: RgbdFrame,
}

/// What each stored colour value becomes.
enum ColourTable {
    Eight(Box<[f32; 256]>),
    Sixteen(Vec<f32>),
    Float,
}

/// A colour value after clipping, and whether it was clipped.
fn clip(light: f32) -> (f32, bool) {
    // NaN becomes black.
    let clipped = if light > 0.0 { light.min(1.0) } else { 0.0 };
    (clipped, clipped != light)
}

impl LiveReader {
    /// A reader of pictures of `format` into frames of `resolution` for the depth range of `geometry`.
    ///
    /// # Errors
    /// [`LiveError::TooLarge`] where `fit` does not bring the picture to that size.
    pub fn new(
        format: LiveFormat,
        geometry: &DisplayGeometry,
        resolution: Resolution,
        fit: Fit,
    ) -> Result<Self, LiveError> {
        let placement = Placement::new(format.resolution, resolution, fit)
            .ok_or(LiveError::TooLarge { found: format.resolution, wanted: resolution })?;
        // Values that are not mixed may become amplitudes at once.
        let transfer = |light: f32| if placement.is_unscaled() { light.sqrt() } else { light };
        let colours = match format.colour {
            LiveColour::Rgba8 => ColourTable::Eight(Box::new(std::array::from_fn(|value| {
                transfer(srgb_to_linear(value as f32 / 255.0))
            }))),
            LiveColour::Rgba16F => ColourTable::Sixteen(
                (0..=u16::MAX).map(|bits| transfer(clip(f16::from_bits(bits).to_f32()).0)).collect(),
            ),
            LiveColour::PlanarF32 => ColourTable::Float,
        };
        let normalised = |number| normalised(format.depth, geometry, number);
        let depths = match format.depth {
            LiveDepth::MillimetresU16 => (0..=u16::MAX).map(|mm| normalised(f32::from(mm))).collect(),
            LiveDepth::MetresF16 | LiveDepth::DioptresF16 => {
                (0..=u16::MAX).map(|bits| normalised(f16::from_bits(bits).to_f32())).collect()
            }
            LiveDepth::Plane(_) | LiveDepth::MetresF32 | LiveDepth::DioptresF32 => Vec::new(),
        };
        let pixels = if placement.is_identity() { 0 } else { format.resolution.pixels() };
        Ok(Self {
            format,
            geometry: *geometry,
            padded_px: placement.padded_px(),
            placement,
            colours,
            depths,
            rows: Vec::new(),
            picture: RgbdFrame {
                resolution: format.resolution,
                amplitude: vec![0.0; 3 * pixels],
                depth_normalised: vec![0.0; pixels],
            },
        })
    }

    /// Reads one picture. `read_at` fills a buffer from an offset in the picture's bytes: of its colours, or of its depths.
    /// `frame` has the reader's size. Where this fails it holds nothing of worth.
    ///
    /// # Errors
    /// No pixel has a depth, or the bytes cannot be read.
    pub fn read(
        &mut self,
        mut read_at: impl FnMut(LivePart, &mut [u8], usize) -> io::Result<()>,
        frame: &mut RgbdFrame,
    ) -> Result<FrameReport, LiveError> {
        let mut picture = std::mem::replace(&mut self.picture, RgbdFrame::empty());
        let is_identity = self.placement.is_identity();
        let report = self.read_picture(&mut read_at, if is_identity { frame } else { &mut picture });
        if report.is_ok() && !is_identity {
            self.place(&picture, frame);
        }
        self.picture = picture;
        report
    }

    /// Reads a picture at its own size.
    fn read_picture(
        &mut self,
        read_at: &mut impl FnMut(LivePart, &mut [u8], usize) -> io::Result<()>,
        picture: &mut RgbdFrame,
    ) -> Result<FrameReport, LiveError> {
        let mut report = FrameReport {
            source: Some(self.format.resolution),
            padded_px: self.padded_px,
            colour_clipped_px: self.read_colours(read_at, &mut picture.amplitude)?,
            ..FrameReport::default()
        };
        self.read_depths(read_at, &mut picture.depth_normalised)?;
        report.depth_missing_px = depth::fill_missing(&mut picture.depth_normalised, self.format.resolution)
            .ok_or(LiveError::NoDepth { expected: self.format.depth.expected() })?;
        for depth in &mut picture.depth_normalised {
            report.depth_clamped_far_px += usize::from(*depth < -ROUNDING);
            report.depth_clamped_near_px += usize::from(*depth > 1.0 + ROUNDING);
            *depth = depth.clamp(0.0, 1.0);
        }
        Ok(report)
    }

    /// Brings a picture to the frame's size.
    fn place(&self, picture: &RgbdFrame, frame: &mut RgbdFrame) {
        let planes = picture.amplitude.chunks_exact(picture.resolution.pixels());
        for (plane, amplitude) in planes.zip(frame.amplitude.chunks_exact_mut(frame.resolution.pixels())) {
            if self.placement.is_unscaled() {
                amplitude.copy_from_slice(&self.placement.nearest(plane, 0.0));
            } else {
                let light = self.placement.light(plane);
                amplitude.iter_mut().zip(light).for_each(|(amplitude, light)| *amplitude = light.sqrt());
            }
        }
        frame.depth_normalised.copy_from_slice(&self.placement.nearest(&picture.depth_normalised, 0.0));
    }

    /// Writes the colours to `planes`, [3, height, width], and counts the pixels that were clipped.
    fn read_colours(
        &mut self,
        read_at: &mut impl FnMut(LivePart, &mut [u8], usize) -> io::Result<()>,
        planes: &mut [f32],
    ) -> io::Result<usize> {
        let pixels = self.format.resolution.pixels();
        let mut read_at = |bytes: &mut [u8], at| read_at(LivePart::Colour, bytes, at);
        match &self.colours {
            ColourTable::Eight(table) => {
                let [red, green, blue] = split(planes);
                in_pieces(&mut self.rows, 4, 4 * pixels, &mut read_at, |bytes, first| {
                    for (pixel, rgba) in (first..).zip(bytes.as_chunks::<4>().0) {
                        red[pixel] = table[usize::from(rgba[0])];
                        green[pixel] = table[usize::from(rgba[1])];
                        blue[pixel] = table[usize::from(rgba[2])];
                    }
                })?;
                Ok(0)
            }
            ColourTable::Sixteen(table) => {
                let [red, green, blue] = split(planes);
                let mut clipped_px = 0;
                let white = f16::ONE.to_bits();
                in_pieces(&mut self.rows, 8, 8 * pixels, &mut read_at, |bytes, first| {
                    for (pixel, rgba) in (first..).zip(bytes.as_chunks::<8>().0) {
                        let [r, g, b] = [0, 2, 4].map(|at| u16::from_ne_bytes([rgba[at], rgba[at + 1]]));
                        red[pixel] = table[usize::from(r)];
                        green[pixel] = table[usize::from(g)];
                        blue[pixel] = table[usize::from(b)];
                        // Above white, not finite, or below 0, which -0 is not.
                        let is_clipped = |bits: u16| bits > white && bits != 0x8000;
                        clipped_px += usize::from(is_clipped(r) || is_clipped(g) || is_clipped(b));
                    }
                })?;
                Ok(clipped_px)
            }
            ColourTable::Float => {
                // Of each plane: which of them are the same pixels is not worth a mask.
                let mut clipped_px = [0; 3];
                let unscaled = self.placement.is_unscaled();
                in_pieces(&mut self.rows, 4, 12 * pixels, &mut read_at, |bytes, first| {
                    for (value, &bytes) in (first..).zip(bytes.as_chunks::<4>().0) {
                        let (light, is_clipped) = clip(f32::from_ne_bytes(bytes));
                        planes[value] = if unscaled { light.sqrt() } else { light };
                        clipped_px[value / pixels] += usize::from(is_clipped);
                    }
                })?;
                Ok(clipped_px.into_iter().max().unwrap_or(0))
            }
        }
    }

    /// Writes normalised depths, not clamped, NaN where there is none.
    fn read_depths(
        &mut self,
        read_at: &mut impl FnMut(LivePart, &mut [u8], usize) -> io::Result<()>,
        depths: &mut [f32],
    ) -> io::Result<()> {
        let Self { format, geometry, depths: table, rows, .. } = self;
        let mut read_at = |bytes: &mut [u8], at| read_at(LivePart::Depth, bytes, at);
        match format.depth {
            LiveDepth::Plane(plane) => {
                depths.fill(normalised(format.depth, geometry, plane.0 as f32));
                Ok(())
            }
            LiveDepth::MillimetresU16 | LiveDepth::MetresF16 | LiveDepth::DioptresF16 => {
                in_pieces(rows, 2, 2 * depths.len(), &mut read_at, |bytes, first| {
                    for (depth, &bits) in depths[first..].iter_mut().zip(bytes.as_chunks::<2>().0) {
                        *depth = table[usize::from(u16::from_ne_bytes(bits))];
                    }
                })
            }
            LiveDepth::MetresF32 | LiveDepth::DioptresF32 => {
                in_pieces(rows, 4, 4 * depths.len(), &mut read_at, |bytes, first| {
                    for (depth, &bytes) in depths[first..].iter_mut().zip(bytes.as_chunks::<4>().0) {
                        *depth = normalised(format.depth, geometry, f32::from_ne_bytes(bytes));
                    }
                })
            }
        }
    }
}

/// The three planes of [3, height, width].
fn split(planes: &mut [f32]) -> [&mut [f32]; 3] {
    let (red, others) = planes.split_at_mut(planes.len() / 3);
    let (green, blue) = others.split_at_mut(others.len() / 2);
    [red, green, blue]
}

/// Which of a picture's bytes are meant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LivePart {
    /// The colours.
    Colour,
    /// The depths.
    Depth,
}

/// Normalised depth of a stored number, not clamped; NaN where it is none.
fn normalised(depth: LiveDepth, geometry: &DisplayGeometry, number: f32) -> f32 {
    // A denormal length has an infinite vergence, which is as near as can be.
    let dioptres = depth.dioptres(number).clamp(f32::MIN, f32::MAX);
    geometry.normalised_depth(Dioptres(dioptres.into())) as f32
}

/// Bytes that are read at once: they stay in the processor's cache until they are converted.
const PIECE_BYTES: usize = 1 << 16;

/// Reads `total` bytes of elements of `element` bytes piece by piece, and hands each to `convert` with the number of its
/// first element.
fn in_pieces(
    rows: &mut Vec<u8>,
    element: usize,
    total: usize,
    mut read_at: impl FnMut(&mut [u8], usize) -> io::Result<()>,
    mut convert: impl FnMut(&[u8], usize),
) -> io::Result<()> {
    rows.resize(PIECE_BYTES, 0);
    for at in (0..total).step_by(PIECE_BYTES) {
        let piece = &mut rows[..PIECE_BYTES.min(total - at)];
        read_at(piece, at)?;
        convert(piece, at / element);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::super::Scene;
    use super::*;

    const SIZE: Resolution = Resolution { width: 6, height: 4 };
    const BENCH: DisplayGeometry = DisplayGeometry::DEFAULT;

    /// A picture's bytes, colours and depths.
    struct Picture {
        format: LiveFormat,
        colour: Vec<u8>,
        depth: Vec<u8>,
    }

    impl Picture {
        fn read_with(&self, reader: &mut LiveReader, frame: &mut RgbdFrame) -> Result<FrameReport, LiveError> {
            let read_at = |part, bytes: &mut [u8], at: usize| {
                let all = if part == LivePart::Colour { &self.colour } else { &self.depth };
                bytes.copy_from_slice(&all[at..at + bytes.len()]);
                Ok(())
            };
            reader.read(read_at, frame)
        }

        fn read(&self, resolution: Resolution, fit: Fit) -> Result<(RgbdFrame, FrameReport), LiveError> {
            let mut frame = RgbdFrame::black(resolution);
            let report = self.read_with(&mut LiveReader::new(self.format, &BENCH, resolution, fit)?, &mut frame)?;
            Ok((frame, report))
        }
    }

    /// 8-bit sRGB of a pixel and colour.
    fn encoded(pixel: usize, colour: usize) -> u8 {
        (pixel * 37 + colour * 91) as u8
    }

    fn linear(pixel: usize, colour: usize) -> f32 {
        srgb_to_linear(f32::from(encoded(pixel, colour)) / 255.0)
    }

    fn millimetres(pixel: usize) -> u16 {
        if pixel == 9 { 0 } else { 300 + 150 * pixel as u16 }
    }

    fn picture(colour: LiveColour, depth: LiveDepth) -> Picture {
        let pixels = 0..SIZE.pixels();
        let half = |value: f32| f16::from_f32(value).to_ne_bytes();
        let metres = |pixel| if pixel == 9 { f32::NAN } else { f32::from(millimetres(pixel)) * 1e-3 };
        Picture {
            format: LiveFormat { resolution: SIZE, colour, depth },
            colour: match colour {
                LiveColour::Rgba8 => pixels.clone().flat_map(|px| [0, 1, 2, 3].map(|c| encoded(px, c))).collect(),
                LiveColour::Rgba16F => {
                    pixels.clone().flat_map(|px| [0, 1, 2, 3].map(|c| half(linear(px, c)))).flatten().collect()
                }
                LiveColour::PlanarF32 => {
                    (0..3).flat_map(|c| pixels.clone().flat_map(move |px| linear(px, c).to_ne_bytes())).collect()
                }
            },
            depth: match depth {
                LiveDepth::Plane(_) => Vec::new(),
                LiveDepth::MillimetresU16 => pixels.flat_map(|px| millimetres(px).to_ne_bytes()).collect(),
                LiveDepth::MetresF16 => pixels.flat_map(|px| half(metres(px))).collect(),
                LiveDepth::DioptresF16 => pixels.flat_map(|px| half(1.0 / metres(px))).collect(),
                LiveDepth::MetresF32 => pixels.flat_map(|px| metres(px).to_ne_bytes()).collect(),
                LiveDepth::DioptresF32 => pixels.flat_map(|px| (1.0 / metres(px)).to_ne_bytes()).collect(),
            },
        }
    }

    /// The same picture through files.
    fn from_files(resolution: Resolution, fit: Fit) -> (RgbdFrame, FrameReport) {
        let folder = tempfile::tempdir().unwrap();
        let [colour, depth] = ["colour.png", "depth.png"].map(|name| folder.path().join(name));
        let (width, height) = (SIZE.width as u32, SIZE.height as u32);
        let pixel = |x: u32, y: u32| (y * width + x) as usize;
        image::RgbImage::from_fn(width, height, |x, y| image::Rgb([0, 1, 2].map(|c| encoded(pixel(x, y), c))))
            .save(&colour)
            .unwrap();
        image::ImageBuffer::from_fn(width, height, |x, y| image::Luma([millimetres(pixel(x, y))]))
            .save(&depth)
            .unwrap();
        let spec = format!("{},{}", colour.display(), depth.display());
        let scene = Scene::open(&spec, Some(super::super::DepthEncoding::Millimetres)).unwrap();
        scene.load(0, &BENCH, Some(resolution), fit).unwrap()
    }

    /// The largest difference of two frames.
    fn difference(a: &RgbdFrame, b: &RgbdFrame) -> f32 {
        assert_eq!(a.resolution, b.resolution);
        let pairs = a.amplitude.iter().zip(&b.amplitude).chain(a.depth_normalised.iter().zip(&b.depth_normalised));
        // A NaN is the largest of all.
        pairs.map(|(a, b)| (a - b).abs()).max_by(f32::total_cmp).unwrap_or(0.0)
    }

    #[test]
    fn what_is_handed_over_is_what_a_file_would_be_for_every_fit() {
        let [wide, small] = [(9, 7), (3, 3)].map(|(width, height)| Resolution { width, height });
        let live = picture(LiveColour::Rgba8, LiveDepth::MillimetresU16);
        for (resolution, fit) in [
            (SIZE, Fit::Native),
            (wide, Fit::Native),
            (wide, Fit::Contain),
            (wide, Fit::Cover),
            (small, Fit::Crop),
            (small, Fit::Contain),
        ] {
            let (frame, report) = live.read(resolution, fit).unwrap();
            let (of_files, report_of_files) = from_files(resolution, fit);
            assert!(difference(&frame, &of_files) < 1e-6, "{resolution} {fit:?}: {}", difference(&frame, &of_files));
            assert_eq!(report, report_of_files);
        }
    }

    #[test]
    fn one_wrong_pixel_is_seen() {
        let (right, _) = picture(LiveColour::Rgba8, LiveDepth::MillimetresU16).read(SIZE, Fit::Native).unwrap();
        for wrong in [f32::NAN, 1e-4] {
            let mut frame = right.clone();
            frame.depth_normalised[5] += wrong;
            assert!(difference(&frame, &right).total_cmp(&1e-6).is_gt());
        }
    }

    #[test]
    fn every_format_says_the_same() {
        let (right, _) = picture(LiveColour::Rgba8, LiveDepth::MillimetresU16).read(SIZE, Fit::Native).unwrap();
        let depths = [
            (LiveDepth::MetresF16, 2e-3),
            (LiveDepth::DioptresF16, 2e-3),
            (LiveDepth::MetresF32, 1e-6),
            (LiveDepth::DioptresF32, 1e-6),
        ];
        for (depth, tolerance) in depths {
            for (colour, colour_tolerance) in
                [(LiveColour::Rgba8, 1e-6_f32), (LiveColour::Rgba16F, 1e-3), (LiveColour::PlanarF32, 1e-6)]
            {
                let (frame, report) = picture(colour, depth).read(SIZE, Fit::Native).unwrap();
                let off = difference(&frame, &right);
                assert!(off < colour_tolerance.max(tolerance), "{colour:?} {depth:?}: {off}");
                assert_eq!((report.depth_missing_px, report.colour_clipped_px), (1, 0));
            }
        }
    }

    #[test]
    fn a_picture_without_depth_is_a_plane() {
        let (frame, report) =
            picture(LiveColour::Rgba8, LiveDepth::Plane(Dioptres(1.25))).read(SIZE, Fit::Native).unwrap();
        let expected = BENCH.normalised_depth(Dioptres(1.25)) as f32;
        assert_eq!(frame.depth_normalised, [expected; SIZE.pixels()]);
        assert_eq!(report.depth_missing_px, 0);
    }

    #[test]
    fn light_above_white_below_black_or_not_finite_is_clipped_and_counted() {
        let mut wrong = picture(LiveColour::PlanarF32, LiveDepth::Plane(Dioptres(1.0)));
        let mut half = picture(LiveColour::Rgba16F, LiveDepth::Plane(Dioptres(1.0)));
        let values = [(0, 2.0, 1.0), (1, -0.5, 0.0), (2, f32::NAN, 0.0), (3, f32::INFINITY, 1.0), (4, -0.0, 0.0)];
        for (pixel, value, _) in values {
            wrong.colour[4 * pixel..][..4].copy_from_slice(&value.to_ne_bytes());
            half.colour[8 * pixel..][..2].copy_from_slice(&f16::from_f32(value).to_ne_bytes());
        }
        for picture in [wrong, half] {
            let (frame, report) = picture.read(SIZE, Fit::Native).unwrap();
            assert_eq!(report.colour_clipped_px, 4, "{:?}", picture.format);
            for (pixel, value, amplitude) in values {
                assert_eq!(frame.amplitude[pixel], amplitude, "{value}");
            }
        }
    }

    #[test]
    fn depths_outside_the_display_are_counted_for_a_wrong_unit_to_be_seen() {
        // Metres that are sent as millimetres.
        let mut wrong = picture(LiveColour::Rgba8, LiveDepth::MillimetresU16);
        wrong.depth = (0..SIZE.pixels()).flat_map(|_| 2_u16.to_ne_bytes()).collect();
        let (frame, report) = wrong.read(SIZE, Fit::Native).unwrap();
        assert_eq!(report.depth_clamped_near_px, SIZE.pixels());
        assert_eq!(frame.depth_normalised, [1.0; SIZE.pixels()]);
    }

    #[test]
    fn a_picture_that_is_refused_leaves_the_reader_usable() {
        let small = Resolution { width: 3, height: 3 };
        let right = picture(LiveColour::Rgba8, LiveDepth::MillimetresU16);
        let mut wrong = picture(LiveColour::Rgba8, LiveDepth::MillimetresU16);
        wrong.depth.fill(0);
        let mut reader = LiveReader::new(right.format, &BENCH, small, Fit::Contain).unwrap();
        let mut frame = RgbdFrame::black(small);
        let refused = wrong.read_with(&mut reader, &mut frame).unwrap_err();
        assert_eq!(refused.to_string(), "found no pixel with a valid depth, expected millimetres above 0");
        right.read_with(&mut reader, &mut frame).unwrap();
        assert_eq!(frame, right.read(small, Fit::Contain).unwrap().0);
        let too_large = LiveReader::new(right.format, &BENCH, small, Fit::Native).err().unwrap();
        assert!(too_large.to_string().contains("--fit contain"), "{too_large}");
    }
}

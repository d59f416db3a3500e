//! Pictures that another program hands over, in the formats of the live feed.

use half::f16;
use holod_calibration::{Dioptres, DisplayGeometry, Resolution};

use super::clipped::{self, any, is_above_white, is_below_black};
use super::fit::Placement;
use super::{ClippedColours, Fit, FrameReport, ROUNDING, RgbdFrame, clamp, depth};
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
    /// Metres as IEEE 754 numbers of 16 bits.
    MetresF16,
    /// Dioptres as IEEE 754 numbers of 16 bits.
    DioptresF16,
    /// Metres as IEEE 754 numbers of 32 bits.
    MetresF32,
    /// Dioptres as IEEE 754 numbers of 32 bits.
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
        /// What was found in its place.
        missing: MissingDepths,
    },
}

/// What was done to a picture when a frame was made of it.
#[derive(Clone, Debug, PartialEq)]
pub struct LiveReport {
    /// As of a picture from files.
    pub frame: FrameReport,
    /// What stood in place of the depths that were missing.
    pub missing: MissingDepths,
}

/// Numbers that are no depths, by what they are.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MissingDepths {
    /// Pixels whose depth is not a number.
    pub nan: usize,
    /// Pixels with 0, where that is no depth.
    pub zero: usize,
    /// Pixels with a number below 0.
    pub negative: usize,
    /// Pixels with an infinite number, where that is no depth.
    pub infinite: usize,
}

impl MissingDepths {
    /// Of a picture's depths as they are stored.
    fn of(depth: LiveDepth, bytes: &[u8]) -> Self {
        let halves = bytes.as_chunks::<2>().0.iter().map(|&bits| f16::from_ne_bytes(bits).to_f32());
        let floats = bytes.as_chunks::<4>().0.iter().map(|&bits| f32::from_ne_bytes(bits));
        match depth {
            LiveDepth::Plane(_) => Self::default(),
            LiveDepth::MillimetresU16 => Self {
                zero: bytes.as_chunks::<2>().0.iter().filter(|bits| **bits == [0; 2]).count(),
                ..Self::default()
            },
            LiveDepth::MetresF16 => Self::of_lengths(halves),
            LiveDepth::DioptresF16 => Self::of_dioptres(halves),
            LiveDepth::MetresF32 => Self::of_lengths(floats),
            LiveDepth::DioptresF32 => Self::of_dioptres(floats),
        }
    }

    fn of_lengths(lengths: impl Iterator<Item = f32>) -> Self {
        lengths.fold(Self::default(), |mut counts, length| {
            counts.nan += usize::from(length.is_nan());
            counts.zero += usize::from(length == 0.0);
            counts.negative += usize::from(length < 0.0);
            counts
        })
    }

    fn of_dioptres(dioptres: impl Iterator<Item = f32>) -> Self {
        dioptres.fold(Self::default(), |mut counts, dioptres| {
            counts.nan += usize::from(dioptres.is_nan());
            counts.negative += usize::from(dioptres < 0.0);
            counts.infinite += usize::from(dioptres == f32::INFINITY);
            counts
        })
    }
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

    /// Vergence in dioptres of a number as it is stored, rounded as that of a file's number is; NaN where it is none.
    fn dioptres(self, number: f32) -> f32 {
        let reciprocal = |length: f32| if length > 0.0 { 1.0 / f64::from(length) } else { f64::NAN };
        match self {
            Self::Plane(plane) => plane.0 as f32,
            Self::MillimetresU16 => (1e3 * reciprocal(number)) as f32,
            Self::MetresF16 | Self::MetresF32 => reciprocal(number) as f32,
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

/// [`is_above_white`] of a half float.
fn is_half_above_white(bits: u16) -> bool {
    bits > f16::ONE.to_bits() && bits <= f16::INFINITY.to_bits()
}

/// [`is_below_black`] of a half float. Behind infinity come NaNs, numbers from -0 down, and NaNs again.
fn is_half_below_black(bits: u16) -> bool {
    /// What is rounding, in steps of 2^-24, as the bits of the smallest numbers count.
    const ROUNDED: u16 = (ROUNDING * 16_777_216.0) as u16;
    bits > f16::INFINITY.to_bits() && bits.wrapping_sub(f16::NEG_ZERO.to_bits()) > ROUNDED
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
                (0..=u16::MAX).map(|bits| transfer(clipped::shown(f16::from_bits(bits).to_f32()))).collect(),
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
            picture: RgbdFrame {
                resolution: format.resolution,
                amplitude: vec![0.0; 3 * pixels],
                depth_normalised: vec![0.0; pixels],
            },
        })
    }

    /// Frame pixels to a picture's pixel.
    pub const fn scale(&self) -> f64 {
        self.placement.scale()
    }

    /// Whether a picture with these depths can be shown. Of most pictures it looks at a few pixels only.
    ///
    /// # Errors
    /// [`LiveError::NoDepth`] where no pixel has one.
    pub fn check(&self, depth: &[u8]) -> Result<(), LiveError> {
        let is_depth = |bits: u16| !self.depths[usize::from(bits)].is_nan();
        let is_there = match self.format.depth {
            LiveDepth::Plane(_) => true,
            LiveDepth::MillimetresU16 | LiveDepth::MetresF16 | LiveDepth::DioptresF16 => {
                depth.as_chunks::<2>().0.iter().any(|&bytes| is_depth(u16::from_ne_bytes(bytes)))
            }
            LiveDepth::MetresF32 | LiveDepth::DioptresF32 => {
                let dioptres = |&bytes: &[u8; 4]| self.format.depth.dioptres(f32::from_ne_bytes(bytes));
                depth.as_chunks::<4>().0.iter().any(|bytes| !dioptres(bytes).is_nan())
            }
        };
        if is_there { Ok(()) } else { Err(self.no_depth(depth)) }
    }

    fn no_depth(&self, depth: &[u8]) -> LiveError {
        LiveError::NoDepth {
            expected: self.format.depth.expected(),
            missing: MissingDepths::of(self.format.depth, depth),
        }
    }

    /// Makes `frame`, which has the reader's size, of one picture's colours and depths as they are stored. Where this
    /// fails it holds nothing of worth.
    ///
    /// # Errors
    /// No pixel has a depth.
    ///
    /// # Panics
    /// Where there are fewer or more bytes than the format says.
    pub fn make(&mut self, colour: &[u8], depth: &[u8], frame: &mut RgbdFrame) -> Result<LiveReport, LiveError> {
        assert_eq!(
            (colour.len(), depth.len()),
            (self.format.colour_bytes(), self.format.depth_bytes()),
            "bytes of colour and depth"
        );
        let mut picture = std::mem::replace(&mut self.picture, RgbdFrame::empty());
        let is_identity = self.placement.is_identity();
        let report = self.read_picture(colour, depth, if is_identity { frame } else { &mut picture });
        if report.is_ok() && !is_identity {
            self.place(&picture, frame);
        }
        self.picture = picture;
        report
    }

    /// Reads a picture at its own size.
    fn read_picture(&self, colour: &[u8], depth: &[u8], picture: &mut RgbdFrame) -> Result<LiveReport, LiveError> {
        let mut report = FrameReport {
            source: Some(self.format.resolution),
            depth_px: self.format.resolution.pixels(),
            padded_px: self.padded_px,
            colour_clipped: self.read_colours(colour, &mut picture.amplitude),
            ..FrameReport::default()
        };
        self.read_depths(depth, &mut picture.depth_normalised);
        report.depth_missing_px = depth::fill_missing(&mut picture.depth_normalised, self.format.resolution)
            .ok_or_else(|| self.no_depth(depth))?;
        clamp(&mut picture.depth_normalised, &mut report);
        let missing = match report.depth_missing_px {
            0 => MissingDepths::default(),
            _ => MissingDepths::of(self.format.depth, depth),
        };
        Ok(LiveReport { frame: report, missing })
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
    fn read_colours(&self, colour: &[u8], planes: &mut [f32]) -> ClippedColours {
        let mut clipped = ClippedColours::default();
        let [red, green, blue] = split(planes);
        match &self.colours {
            ColourTable::Eight(table) => {
                for (pixel, rgba) in colour.as_chunks::<4>().0.iter().enumerate() {
                    red[pixel] = table[usize::from(rgba[0])];
                    green[pixel] = table[usize::from(rgba[1])];
                    blue[pixel] = table[usize::from(rgba[2])];
                }
            }
            ColourTable::Sixteen(table) => {
                for (pixel, rgba) in colour.as_chunks::<8>().0.iter().enumerate() {
                    let rgb = [0, 2, 4].map(|at| u16::from_ne_bytes([rgba[at], rgba[at + 1]]));
                    [red[pixel], green[pixel], blue[pixel]] = rgb.map(|bits| table[usize::from(bits)]);
                    clipped.count(any(rgb.map(is_half_above_white)), any(rgb.map(is_half_below_black)));
                }
            }
            ColourTable::Float => {
                let unscaled = self.placement.is_unscaled();
                let transfer = |light: f32| if unscaled { light.sqrt() } else { light };
                let mut stored = colour.as_chunks::<4>().0.chunks_exact(red.len());
                let [reds, greens, blues] = std::array::from_fn(|_| stored.next().expect("three planes"));
                for (pixel, ((r, g), b)) in reds.iter().zip(greens).zip(blues).enumerate() {
                    let rgb = [r, g, b].map(|bytes| f32::from_ne_bytes(*bytes));
                    [red[pixel], green[pixel], blue[pixel]] = rgb.map(|light| transfer(clipped::shown(light)));
                    clipped.count(any(rgb.map(is_above_white)), any(rgb.map(is_below_black)));
                }
            }
        }
        clipped
    }

    /// Writes normalised depths, not clamped, NaN where there is none.
    fn read_depths(&self, bytes: &[u8], depths: &mut [f32]) {
        let Self { format, geometry, depths: table, .. } = self;
        match format.depth {
            LiveDepth::Plane(plane) => depths.fill(normalised(format.depth, geometry, plane.0 as f32)),
            LiveDepth::MillimetresU16 | LiveDepth::MetresF16 | LiveDepth::DioptresF16 => {
                for (depth, &bits) in depths.iter_mut().zip(bytes.as_chunks::<2>().0) {
                    *depth = table[usize::from(u16::from_ne_bytes(bits))];
                }
            }
            LiveDepth::MetresF32 | LiveDepth::DioptresF32 => {
                for (depth, &bytes) in depths.iter_mut().zip(bytes.as_chunks::<4>().0) {
                    *depth = normalised(format.depth, geometry, f32::from_ne_bytes(bytes));
                }
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

/// Normalised depth of a stored number, not clamped; NaN where it is none.
fn normalised(depth: LiveDepth, geometry: &DisplayGeometry, number: f32) -> f32 {
    // A denormal length has an infinite vergence, which is as near as can be.
    let dioptres = depth.dioptres(number).clamp(f32::MIN, f32::MAX);
    geometry.normalised_depth(Dioptres(dioptres.into())) as f32
}

#[cfg(test)]
mod tests {
    use super::super::depth::DepthReading;
    use super::super::{DepthEncoding, Scene};
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
            reader.make(&self.colour, &self.depth, frame).map(|report| report.frame)
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
        let scene = Scene::open(&spec, Some(DepthEncoding::Millimetres)).unwrap();
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

    /// Else the same picture would give other levels at pixels where rounding decides.
    #[test]
    fn a_length_is_the_vergence_of_a_file_s_to_the_bit() {
        let reading = |encoding| DepthReading { encoding, scale: None, missing: None }.converter(None);
        let (millimetres, metres) = (reading(DepthEncoding::Millimetres), reading(DepthEncoding::Metres));
        for number in (1..=u16::MAX).map(f32::from) {
            assert_eq!(LiveDepth::MillimetresU16.dioptres(number), millimetres(number), "{number} mm");
            assert_eq!(LiveDepth::MetresF32.dioptres(number / 997.0), metres(number / 997.0), "{} m", number / 997.0);
        }
        assert_ne!(LiveDepth::MillimetresU16.dioptres(450.0), millimetres(450.01), "the comparison sees a little");
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
                assert_eq!((report.depth_missing_px, report.colour_clipped), (1, ClippedColours::default()));
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
            let expected = ClippedColours { above_white_px: 2, below_black_px: 2 };
            assert_eq!(report.colour_clipped, expected, "{:?}", picture.format);
            for (pixel, value, amplitude) in values {
                assert_eq!(frame.amplitude[pixel], amplitude, "{value}");
            }
        }
    }

    #[test]
    fn each_pixel_with_clipped_light_is_counted_once_whatever_its_colours() {
        // Red above white, green below black, blue of both and of neither, and what rounding leaves.
        let values: [(usize, [f32; 3], [usize; 2]); 6] = [
            (0, [2.0, 0.5, 0.5], [1, 0]),
            (1, [0.5, -0.5, 0.5], [0, 1]),
            (2, [0.5, 0.5, f32::NEG_INFINITY], [0, 1]),
            (3, [3.0, f32::NAN, -1.0], [1, 0]),
            (4, [0.5, -0.5, f32::INFINITY], [1, 0]),
            (5, [0.5, -9e-6, 1.0], [0, 0]),
        ];
        let plane = LiveDepth::Plane(Dioptres(1.0));
        let (mut planar, mut half) = (picture(LiveColour::PlanarF32, plane), picture(LiveColour::Rgba16F, plane));
        for (pixel, rgb, _) in values {
            for (colour, light) in rgb.into_iter().enumerate() {
                let at = 4 * (colour * SIZE.pixels() + pixel);
                planar.colour[at..][..4].copy_from_slice(&light.to_ne_bytes());
                half.colour[8 * pixel + 2 * colour..][..2].copy_from_slice(&f16::from_f32(light).to_ne_bytes());
            }
        }
        let [above_white_px, below_black_px] = [0, 1].map(|kind| values.iter().map(|(.., counts)| counts[kind]).sum());
        for picture in [planar, half] {
            let (_, report) = picture.read(SIZE, Fit::Native).unwrap();
            assert_eq!(
                report.colour_clipped,
                ClippedColours { above_white_px, below_black_px },
                "{:?}",
                picture.format
            );
        }
    }

    #[test]
    fn half_floats_are_judged_as_the_numbers_that_they_are() {
        for bits in 0..=u16::MAX {
            let light = f16::from_bits(bits).to_f32();
            assert_eq!(is_half_above_white(bits), is_above_white(light), "{light}");
            assert_eq!(is_half_below_black(bits), is_below_black(light), "{light}");
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
    fn what_is_no_depth_is_counted_by_what_it_is() {
        let numbers = [f32::NAN, f32::NAN, 0.0, -0.0, 0.0, -1.0, f32::INFINITY, f32::NEG_INFINITY, 1.0, 65504.0];
        let lengths = MissingDepths { nan: 2, zero: 3, negative: 2, infinite: 0 };
        let dioptres = MissingDepths { nan: 2, zero: 0, negative: 2, infinite: 1 };
        for (depth, expected) in [
            (LiveDepth::MetresF16, lengths),
            (LiveDepth::MetresF32, lengths),
            (LiveDepth::DioptresF16, dioptres),
            (LiveDepth::DioptresF32, dioptres),
            (LiveDepth::MillimetresU16, MissingDepths { zero: 4, ..MissingDepths::default() }),
        ] {
            let bytes = |pixel: usize| match depth {
                LiveDepth::MetresF16 | LiveDepth::DioptresF16 => {
                    f16::from_f32(numbers.get(pixel).copied().unwrap_or(1.0)).to_ne_bytes().to_vec()
                }
                LiveDepth::MillimetresU16 => u16::from(pixel > 3).to_ne_bytes().to_vec(),
                _ => numbers.get(pixel).copied().unwrap_or(1.0).to_ne_bytes().to_vec(),
            };
            let mut picture = picture(LiveColour::Rgba8, depth);
            picture.depth = (0..SIZE.pixels()).flat_map(bytes).collect();
            let mut reader = LiveReader::new(picture.format, &BENCH, SIZE, Fit::Native).unwrap();
            let report = reader.make(&picture.colour, &picture.depth, &mut RgbdFrame::black(SIZE)).unwrap();
            assert_eq!(report.missing, expected, "{depth:?}");
            let MissingDepths { nan, zero, negative, infinite } = report.missing;
            assert_eq!(
                report.frame.depth_missing_px,
                nan + zero + negative + infinite,
                "all that are filled are counted"
            );
            reader.check(&picture.depth).unwrap();
        }
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
        assert_eq!(reader.check(&wrong.depth).unwrap_err().to_string(), refused.to_string());
        reader.check(&right.depth).unwrap();
        assert_eq!(refused.to_string(), "found no pixel with a valid depth, expected millimetres above 0");
        right.read_with(&mut reader, &mut frame).unwrap();
        assert_eq!(frame, right.read(small, Fit::Contain).unwrap().0);
        let too_large = LiveReader::new(right.format, &BENCH, small, Fit::Native).err().unwrap();
        assert!(too_large.to_string().contains("--fit contain"), "{too_large}");
    }
}

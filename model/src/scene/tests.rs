//! Scenes in files that these tests write, and in the shared real ones.

use std::path::{Path, PathBuf};

use crc::{CRC_32_ISO_HDLC, Crc};
use exr::image::{AnyChannel, AnyChannels, FlatSamples, Image, Layer};
use exr::math::Vec2;
use exr::meta::attribute::{Chromaticities, IntegerBounds, Text};
use exr::meta::header::{ImageAttributes, LayerAttributes};
use exr::prelude::{Encoding, WritableImage};
use holod_tests::shared_data;
use image::{ImageBuffer, Luma, LumaA, Rgb, Rgba};

use super::*;

const BENCH: DisplayGeometry = DisplayGeometry::DEFAULT;

fn size(width: usize, height: usize) -> Resolution {
    Resolution { width, height }
}

/// A folder with files of one scene.
struct Files(tempfile::TempDir);

impl Files {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn spec(&self) -> String {
        self.0.path().to_str().unwrap().into()
    }

    fn colour8(&self, name: &str, width: u32, height: u32, value: impl Fn(u32, u32) -> [u8; 3]) {
        ImageBuffer::from_fn(width, height, |x, y| Rgb(value(x, y))).save(self.path(name)).unwrap();
    }

    fn depth16(&self, name: &str, width: u32, height: u32, value: impl Fn(u32, u32) -> u16) {
        ImageBuffer::from_fn(width, height, |x, y| Luma([value(x, y)])).save(self.path(name)).unwrap();
    }

    fn describe(&self, text: &str) {
        std::fs::write(self.path("scene.toml"), text).unwrap();
    }

    fn open(&self) -> Scene {
        Scene::open(&self.spec(), None).unwrap()
    }

    /// An OpenEXR file with half colours and float depth whose data window begins at `origin` of the display window.
    fn exr(
        &self,
        name: &str,
        display: Resolution,
        origin: [i32; 2],
        data: Resolution,
        value: impl Fn(&str, usize) -> f32,
    ) {
        let channel = |name: &str, half: bool| {
            let samples = (0..data.pixels()).map(|index| value(name, index));
            let samples = if half {
                FlatSamples::F16(samples.map(half::f16::from_f32).collect())
            } else {
                FlatSamples::F32(samples.collect())
            };
            AnyChannel::new(name, samples)
        };
        let channels = ["B", "G", "R"].map(|name| channel(name, true)).into_iter().chain([channel("Z", false)]);
        let mut attributes = LayerAttributes::named(Text::from("main"));
        attributes.layer_position = Vec2(origin[0] - 3, origin[1] - 5);
        let layer = Layer::new(
            Vec2(data.width, data.height),
            attributes,
            Encoding::SMALL_FAST_LOSSLESS,
            AnyChannels::sort(channels.collect()),
        );
        let window = IntegerBounds { position: Vec2(-3, -5), size: Vec2(display.width, display.height) };
        let image = Image::empty(ImageAttributes::new(window)).with_layer(layer);
        image.write().to_file(self.path(name)).unwrap();
    }
}

/// An OpenEXR file of two pixels, each part of which has its channels with one value each.
fn write_parts(path: &Path, parts: &[(&str, &[(&str, f32)])]) {
    let layers = parts.iter().map(|(part, channels)| {
        let channel = |&(name, value): &(&str, f32)| AnyChannel::new(name, FlatSamples::F32(vec![value; 2]));
        Layer::new(
            Vec2(2, 1),
            LayerAttributes::named(Text::from(*part)),
            Encoding::UNCOMPRESSED,
            AnyChannels::sort(channels.iter().map(channel).collect()),
        )
    });
    let window = IntegerBounds { position: Vec2(0, 0), size: Vec2(2, 1) };
    let image = Image::from_layers(ImageAttributes::new(window), layers.collect::<Vec<_>>());
    image.write().to_file(path).unwrap();
}

const MILLIMETRES: &str = "colour = \"c.png\"\ndepth = \"d.png\"\ndepth_encoding = \"millimetres\"\n";

#[test]
fn a_pair_of_pngs_becomes_amplitude_and_normalised_depth() {
    let files = Files::new();
    files.colour8("c.png", 3, 1, |x, _| [[255, 128, 0], [0, 0, 0], [255, 255, 255]][x as usize]);
    files.depth16("d.png", 3, 1, |x, _| [350, 0, 700][x as usize]);
    files.describe(MILLIMETRES);
    let (frame, report) = files.open().load(0, &BENCH, None, Fit::Native).unwrap();
    assert_eq!(frame.resolution, size(3, 1));
    let expected = [1.0, 0.0, 1.0, 0.215_861f32.sqrt(), 0.0, 1.0, 0.0, 0.0, 1.0];
    for (actual, expected) in frame.amplitude.iter().zip(expected) {
        assert!((actual - expected).abs() < 1e-5, "{actual} for {expected}");
    }
    // The hole takes the farther of its neighbours.
    for (actual, expected) in frame.depth_normalised.iter().zip([1.0, 0.5, 0.5]) {
        assert!((actual - expected).abs() < 1e-5, "{actual} for {expected}");
    }
    let expected = FrameReport {
        source: Some(size(3, 1)),
        depth_px: 3,
        depth_missing_px: 1,
        depth_range: [frame.depth_normalised[1], frame.depth_normalised[0]],
        ..FrameReport::default()
    };
    assert_eq!(report, expected);

    let pair = format!("{},{}", files.path("c.png").display(), files.path("d.png").display());
    let scene = Scene::open(&pair, Some(DepthEncoding::Millimetres)).unwrap();
    assert_eq!(scene.load(0, &BENCH, None, Fit::Native).unwrap().0, frame);
}

#[test]
fn sixteen_bit_colour_and_eight_bit_depth_are_read() {
    let files = Files::new();
    ImageBuffer::from_pixel(1, 1, Rgb([32768u16, 65535, 0])).save(files.path("c.png")).unwrap();
    ImageBuffer::from_pixel(1, 1, Luma([51u8])).save(files.path("d.png")).unwrap();
    files.describe(
        "colour = \"c.png\"\ndepth = \"d.png\"\ndepth_encoding = \"normalised_dioptres\"\nnear_dpt = 2.5\nfar_dpt = 0.0",
    );
    let (frame, _) = files.open().load(0, &BENCH, None, Fit::Native).unwrap();
    assert!((frame.amplitude[0] - 0.214_06f32.sqrt()).abs() < 1e-4 && frame.amplitude[1] == 1.0);
    assert!((frame.depth_normalised[0] - 0.5 * 0.35).abs() < 1e-5);
}

/// A grey PNG of one row of 8 pixels of fewer than 8 bits, which are in `row`.
fn few_bits(path: &Path, bits: u8, row: &[u8]) {
    let chunk = |name: &[u8], data: &[u8]| {
        let named = [name, data].concat();
        let checksum = Crc::<u32>::new(&CRC_32_ISO_HDLC).checksum(&named);
        [&(data.len() as u32).to_be_bytes()[..], &named, &checksum.to_be_bytes()].concat()
    };
    let header = [&[0, 0, 0, 8, 0, 0, 0, 1, bits][..], &[0; 4]].concat();
    // The row, unfiltered, as a block that is not compressed, and its Adler-32.
    let line = [&[0], row].concat();
    let (low, high) =
        line.iter().fold((1_u32, 0), |(low, high), &byte| (low + u32::from(byte), high + low + u32::from(byte)));
    let length = line.len() as u16;
    let block = [&[0x78, 1, 1][..], &length.to_le_bytes(), &(!length).to_le_bytes(), &line].concat();
    let data = [block, (((high % 65521) << 16) | (low % 65521)).to_be_bytes().to_vec()].concat();
    let chunks = [chunk(b"IHDR", &header), chunk(b"IDAT", &data), chunk(b"IEND", &[])].concat();
    std::fs::write(path, [&b"\x89PNG\r\n\x1a\n"[..], &chunks].concat()).unwrap();
}

#[test]
fn depths_of_few_bits_are_the_numbers_of_the_file() {
    let files = Files::new();
    let path = files.path("d.png");
    for (bits, row, numbers) in [
        (1, &[0b0110_0101][..], [0.0, 1.0, 1.0, 0.0, 0.0, 1.0, 0.0, 1.0]),
        (2, &[0b0001_1011, 0b1110_0100], [0.0, 1.0, 2.0, 3.0, 3.0, 2.0, 1.0, 0.0]),
        (4, &[0x01, 0x23, 0x4e, 0xf1], [0.0, 1.0, 2.0, 3.0, 4.0, 14.0, 15.0, 1.0]),
    ] {
        few_bits(&path, bits, row);
        let read = raster::read_depth(&path, false).unwrap().numbers;
        assert_eq!(
            (&read.values[..], read.full_scale),
            (&numbers[..], Some(f32::from((1_u8 << bits) - 1))),
            "{bits} bits"
        );
        let light = raster::read_colour(&path).unwrap().linear;
        assert_eq!(light[numbers.iter().position(|number| Some(*number) == read.full_scale).unwrap()], 1.0);
    }
}

#[test]
fn a_depth_that_is_wholly_transparent_is_none() {
    let files = Files::new();
    let path = files.path("d.png");
    let depths = || {
        let numbers = raster::read_depth(&path, false).unwrap().numbers.values;
        numbers.iter().map(|number| (!number.is_nan()).then_some(*number as u32)).collect::<Vec<_>>()
    };
    let [there, faint, gone] = [65535_u16, 1, 0];
    let alpha = |x: u32| [there, faint, gone, gone][x as usize];
    let seen = [Some(500), Some(501), None, None];
    ImageBuffer::from_fn(4, 1, |x, _| LumaA([500 + x as u16, alpha(x)])).save(&path).unwrap();
    assert_eq!(depths(), seen);
    // What colour a pixel has that is not drawn says nothing.
    let colours = |x: u32| [500 + x as u16, 500 + x as u16, if x == 3 { 9 } else { 500 + x as u16 }, alpha(x)];
    ImageBuffer::from_fn(4, 1, |x, _| Rgba(colours(x))).save(&path).unwrap();
    assert_eq!(depths(), seen);
    ImageBuffer::from_fn(4, 1, |x, _| LumaA([50 + x as u8, alpha(x).min(255) as u8])).save(&path).unwrap();
    assert_eq!(depths(), [Some(50), Some(51), None, None]);

    files.colour8("c.png", 4, 1, |_, _| [9; 3]);
    ImageBuffer::from_fn(4, 1, |x, _| LumaA([500 + x as u16, alpha(x)])).save(&path).unwrap();
    files.describe(MILLIMETRES);
    assert_eq!(files.open().load(0, &BENCH, None, Fit::Native).unwrap().1.depth_missing_px, 2);
}

#[test]
fn depths_beyond_the_display_are_clamped_and_counted() {
    let files = Files::new();
    files.colour8("c.png", 3, 1, |_, _| [9; 3]);
    files.depth16("d.png", 3, 1, |x, _| [100, 350, 5000][x as usize]);
    files.describe(MILLIMETRES);
    let geometry = DisplayGeometry { depth_far: holod_calibration::Dioptres(0.5), ..BENCH };
    let (frame, report) = files.open().load(0, &geometry, None, Fit::Native).unwrap();
    assert_eq!((report.depth_clamped_near_px, report.depth_clamped_far_px), (1, 1));
    assert_eq!((frame.depth_normalised[0], frame.depth_normalised[2]), (1.0, 0.0));
}

#[test]
fn a_picture_that_is_not_clamped_to_a_display_ends_at_infinity() {
    let files = Files::new();
    let normalised = [-1e-3, 0.0, 0.5, 1.25];
    files.exr("both.exr", size(4, 1), [0, 0], size(4, 1), |channel, index| match channel {
        "Z" => normalised[index],
        _ => 0.5,
    });
    let encoding = DepthEncoding::NormalisedDioptres { far_dpt: 0.0, near_dpt: 4.0 };
    let scene = Scene::open(&files.path("both.exr").display().to_string(), Some(encoding)).unwrap();
    assert_eq!(scene.picture(0, &BENCH, None, Fit::Native).unwrap().depth_dpt, [0.0, 0.0, 2.0, 5.0]);
}

#[test]
fn sizes_are_fitted_only_as_asked() {
    let files = Files::new();
    files.colour8("c.png", 8, 4, |_, _| [255; 3]);
    files.depth16("d.png", 8, 4, |_, _| 350);
    files.describe(MILLIMETRES);
    let scene = files.open();
    let load = |width, height, fit| scene.load(0, &BENCH, Some(size(width, height)), fit);
    let (padded, report) = load(10, 5, Fit::Native).unwrap();
    assert_eq!((padded.resolution, report.padded_px), (size(10, 5), 50 - 32));
    assert_eq!((padded.amplitude[0], padded.depth_normalised[0]), (0.0, 0.0));
    assert_eq!((padded.amplitude[1], padded.depth_normalised[1]), (1.0, 1.0));
    let error = load(6, 6, Fit::Native).unwrap_err().to_string();
    assert!(error.contains("8x4") && error.contains("6x6") && error.contains("contain"), "{error}");
    assert_eq!(load(4, 4, Fit::Contain).unwrap().1.padded_px, 8);
    assert_eq!(load(5, 5, Fit::Cover).unwrap().1.padded_px, 0);
    assert_eq!(load(6, 6, Fit::Crop).unwrap().1.padded_px, 12);
}

#[test]
fn a_depth_map_of_another_size_is_refused_unless_a_fit_is_asked() {
    let files = Files::new();
    files.colour8("c.png", 8, 4, |_, _| [255; 3]);
    files.depth16("d.png", 4, 2, |x, _| if x < 2 { 350 } else { 3500 });
    files.describe(MILLIMETRES);
    let error = files.open().load(0, &BENCH, None, Fit::Native).unwrap_err().to_string();
    assert!(["c.png", "d.png", "8x4", "4x2"].iter().all(|part| error.contains(part)), "{error}");
    let (frame, _) = files.open().load(0, &BENCH, None, Fit::Cover).unwrap();
    for (actual, expected) in frame.depth_normalised[..8].iter().zip([1.0, 1.0, 1.0, 1.0, 0.1, 0.1, 0.1, 0.1]) {
        assert!((actual - expected).abs() < 1e-5, "{actual}");
    }
    files.depth16("d.png", 4, 4, |_, _| 350);
    assert!(matches!(files.open().load(0, &BENCH, None, Fit::Cover), Err(SceneError::SizesDiffer { .. })));
}

#[test]
fn an_exr_with_a_small_data_window_fills_the_display_window() {
    let files = Files::new();
    files.exr("both.exr", size(5, 4), [1, 1], size(2, 2), |channel, index| match (channel, index) {
        ("Z", 0) => f32::INFINITY,
        ("Z", 1) => f32::NAN,
        ("Z", _) => 0.7,
        ("R", _) => 0.25,
        ("G", 3) => 4.0,
        ("B", 0) => -0.25,
        ("B", 1) => f32::NAN,
        _ => 0.0,
    });
    let path = files.path("both.exr");
    let scene = Scene::open(path.to_str().unwrap(), Some(DepthEncoding::Metres)).unwrap();
    let (frame, report) = scene.load(0, &BENCH, None, Fit::Native).unwrap();
    assert_eq!(frame.resolution, size(5, 4));
    let red: Vec<_> = frame.amplitude[..20].iter().enumerate().filter(|(_, value)| **value > 0.0).collect();
    assert_eq!(red, [(6, &0.5), (7, &0.5), (11, &0.5), (12, &0.5)]);
    assert_eq!(report.colour_clipped, ClippedColours { above_white_px: 1, below_black_px: 2 });
    assert_eq!(report.depth_missing_px, 17);
    assert!((frame.depth_normalised[12] - 0.5).abs() < 1e-5 && frame.depth_normalised[6] == 0.0);
    assert!(frame.depth_normalised.iter().all(|value| (0.0..=1.0).contains(value)));

    files.describe("colour = \"both.exr\"\ndepth_encoding = \"metres\"");
    assert_eq!(files.open().load(0, &BENCH, None, Fit::Native).unwrap().0, frame);
}

#[test]
fn an_exrs_colours_are_those_of_one_layer_and_its_depth_is_no_vector() {
    let files = Files::new();
    let path = files.path("layers.exr");
    let colours = || raster::read_colour(&path).map(|colour| [0, 2, 4].map(|plane| colour.linear[plane]));
    let depth = || raster::read_depth(&path, false).map(|depth| depth.numbers.values[0]);
    let rgb = |layer: &str, red: f32| {
        [("R", red), ("G", red + 0.01), ("B", red + 0.02)].map(|(name, value)| (format!("{layer}{name}"), value))
    };
    let xyz = |layer: &str| ["X", "Y", "Z"].map(|name| (format!("{layer}{name}"), 9.0));
    let one = |name: &str, value: f32| [(name.to_owned(), value)];
    let write = |parts: &[(&str, Vec<(String, f32)>)]| {
        let borrowed: Vec<(&str, Vec<(&str, f32)>)> = parts
            .iter()
            .map(|(part, channels)| (*part, channels.iter().map(|(name, value)| (name.as_str(), *value)).collect()))
            .collect();
        write_parts(&path, &borrowed.iter().map(|(part, channels)| (*part, &channels[..])).collect::<Vec<_>>());
    };
    let shown = [0.5, 0.51, 0.52];
    let blender = [
        &rgb("ViewLayer.AO.", 0.1)[..],
        &rgb("ViewLayer.Combined.", 0.5),
        &xyz("ViewLayer.Denoising Normal."),
        &one("ViewLayer.Depth.Z", 3.0),
        &one("ViewLayer.Mist.Z", 0.7),
    ]
    .concat();
    for (what, parts) in [
        ("Blender's passes", vec![("", blender.clone())]),
        (
            "no layer before layers",
            vec![("main", [&rgb("", 0.5)[..], &one("Z", 3.0), &rgb("Combined.", 0.1), &one("Depth.Z", 1.0)].concat())],
        ),
        ("small letters", vec![("", [&rgb("beauty.", 0.5)[..], &one("depth.z", 3.0), &xyz("n.")].concat())]),
        ("a depth layer's only channel", vec![("", [&rgb("", 0.5)[..], &one("a.Depth.V", 3.0), &xyz("N.")].concat())]),
        ("a channel called depth", vec![("", [&rgb("", 0.5)[..], &one("depth", 3.0), &xyz("P.")].concat())]),
        ("parts", vec![("rgba", rgb("", 0.5).to_vec()), ("normals", xyz("").to_vec()), ("z", one("Z", 3.0).to_vec())]),
        (
            "parts with a layer each",
            vec![
                ("a", [&rgb("AO.", 0.1)[..], &rgb("Combined.", 0.5)].concat()),
                ("b", [&one("Depth.Z", 3.0)[..], &one("Mist.Z", 1.0)].concat()),
            ],
        ),
    ] {
        write(&parts);
        assert_eq!((colours().unwrap(), depth().unwrap()), (shown, 3.0), "{what}");
    }
    write(&[("", [&one("Y", 0.5)[..], &xyz("normal.")].concat())]);
    assert_eq!((colours().unwrap(), depth().unwrap()), ([0.5; 3], 0.5), "luminance alone");
    let loaded = |names: String| {
        let scene = Scene::open(&names, Some(DepthEncoding::Metres)).unwrap();
        scene.load(0, &BENCH, None, Fit::Native).map_err(|error| error.to_string())
    };
    let both = loaded(path.display().to_string()).unwrap_err();
    assert!(both.contains("layers.exr") && both.contains("COLOUR,DEPTH"), "{both}");
    let other = files.path("other.exr");
    std::fs::copy(&path, &other).unwrap();
    loaded(format!("{},{}", path.display(), other.display())).unwrap();

    let two = [
        &rgb("left.Combined.", 0.5)[..],
        &rgb("right.Combined.", 0.5),
        &one("left.Depth.Z", 3.0),
        &one("right.Depth.Z", 3.0),
    ]
    .concat();
    let others = [&rgb("AO.", 0.5)[..], &rgb("Emit.", 0.5), &xyz("Normal."), &one("Mist.Z", 0.5)].concat();
    let parts = |part| (part, [&rgb("", 0.5)[..], &one("Z", 3.0)].concat());
    let apart = vec![("", [&one("a.R", 0.5)[..], &one("b.G", 0.5), &one("c.B", 0.5)].concat())];
    for (parts, of_colours, of_depth) in [
        (
            vec![("", two)],
            &["colours more than once: left.Combined, right.Combined;", "export only one"][..],
            &["depth more than once: left.Depth.Z, right.Depth.Z;", "export only one"][..],
        ),
        (
            vec![("", others)],
            &["more than once: AO, Emit;", "Combined"],
            &["the channels AO.B, AO.G, AO.R, Emit.B,", "Mist.Z, Normal.X", "called Depth"],
        ),
        (vec![parts("l"), parts("r")], &["more than once: l, r;"], &["more than once: l.Z, r.Z;"]),
        (apart, &["the channels a.R, b.G, c.B;", "R, G and B"], &["the channels a.R, b.G, c.B;", "Z"]),
    ] {
        write(&parts);
        for (error, says) in [(colours().unwrap_err(), of_colours), (depth().unwrap_err(), of_depth)] {
            let error = error.to_string();
            assert!(says.iter().all(|part| error.contains(part)) && error.contains("layers.exr"), "{error}");
        }
    }
}

#[test]
fn no_picture_but_an_openexr_one_is_its_own_depth_map() {
    let files = Files::new();
    files.depth16("grey.png", 4, 2, |x, _| 400 + x as u16);
    image::open(files.path("grey.png")).unwrap().to_luma8().save(files.path("grey.jpg")).unwrap();
    let pair = format!("{0},{0}", files.path("grey.png").display());
    let of_pair = Scene::open(&pair, Some(DepthEncoding::Millimetres)).unwrap();
    let named = ["colour = \"grey.png\"", "colour = \"grey.jpg\"", "colour = \"grey.png\"\ndepth = \"./grey.png\""];
    let of_files = named.map(|names| {
        files.describe(&format!("{names}\ndepth_encoding = \"millimetres\""));
        files.open()
    });
    for scene in of_files.iter().chain([&of_pair]) {
        let error = scene.load(0, &BENCH, None, Fit::Native).unwrap_err().to_string();
        let said = ["grey.", "not OpenEXR", "`depth` in a scene.toml", "COLOUR,DEPTH"];
        assert!(said.iter().all(|part| error.contains(part)), "{error}");
    }
    std::fs::copy(files.path("grey.png"), files.path("other.png")).unwrap();
    files.describe("colour = \"grey.png\"\ndepth = \"other.png\"\ndepth_encoding = \"millimetres\"");
    files.open().load(0, &BENCH, None, Fit::Native).unwrap();
}

#[test]
fn a_sequence_has_as_many_frames_as_files() {
    let files = Files::new();
    for index in 2..5 {
        files.colour8(&format!("c{index:03}.png"), 2, 2, |_, _| [index as u8 * 50; 3]);
        files.depth16(&format!("d{index:03}.png"), 2, 2, |_, _| 500);
    }
    files.describe(
        "colour = \"c{:03}.png\"\ndepth = \"d{:03}.png\"\ndepth_encoding = \"millimetres\"\nfirst = 2\nfps = 25.0",
    );
    let scene = files.open();
    assert_eq!((scene.frames(), scene.fps()), (3, Some(25.0)));
    let brightness = |index| scene.load(index, &BENCH, None, Fit::Native).unwrap().0.amplitude[0];
    assert!(brightness(0) < brightness(1) && brightness(1) < brightness(2));
    assert!(matches!(
        scene.load(3, &BENCH, None, Fit::Native),
        Err(SceneError::NoSuchFrame { index: 3, frames: 3, .. })
    ));
}

#[test]
fn a_sequence_with_a_gap_is_refused_with_the_first_file_that_is_missing() {
    let files = Files::new();
    let colour = |index: u32| files.colour8(&format!("c{index}.png"), 2, 2, |_, _| [50; 3]);
    let depth = |index: u32| {
        std::fs::create_dir_all(files.path(&format!("{index:03}"))).unwrap();
        files.depth16(&format!("{index:03}/d.png"), 2, 2, |_, _| 500);
    };
    let opened = |rest: &str| {
        let names = "colour = \"c{}.png\"\ndepth = \"{:03}/d.png\"\n";
        files.describe(&format!("{names}depth_encoding = \"millimetres\"\nfps = 25.0\n{rest}"));
        Scene::open(&files.spec(), None).map(|scene| scene.frames()).map_err(|error| error.to_string())
    };
    (0..4).chain(6..10).for_each(|index| {
        colour(index);
        depth(index);
    });
    colour(5);
    let refused = |rest: &str, says: &[&str]| {
        let why = opened(rest).unwrap_err();
        assert!(says.iter().all(|part| why.contains(part)), "{why}");
    };
    refused("", &["scene.toml, line 1: `count`", "c4.png is missing", "number 9", "supply it", "`count = 4`"]);
    assert_eq!(opened("count = 4"), Ok(4));
    refused("first = 5", &["005/d.png is missing", "number 9", "`first`"]);
    assert_eq!((opened("first = 6"), opened("first = 8")), (Ok(4), Ok(2)));
    assert_eq!(opened("first = 1\nstep = 10"), Ok(1), "what is between the steps is none of it");
    // The last of one kind has none of the other.
    colour(10);
    refused("first = 6", &["010/d.png is missing", "number 10", "`count = 4`"]);
    std::fs::remove_file(files.path("c10.png")).unwrap();
    std::fs::write(files.path("c11.txt"), "x").unwrap();
    std::fs::write(files.path("c0012.png"), "x").unwrap();
    assert_eq!(opened("first = 6"), Ok(4), "other names are no frames");
}

#[test]
fn orientations_that_differ_are_reported_where_sizes_cannot_tell() {
    let files = Files::new();
    let pair = format!("{},{}", files.path("c.jpg").display(), files.path("d.jpg").display());
    let report = |of_colour, of_depth| {
        jpeg_turned(&files.path("c.jpg"), of_colour);
        jpeg_turned(&files.path("d.jpg"), of_depth);
        let scene =
            Scene::open(&pair, Some(DepthEncoding::NormalisedDioptres { far_dpt: 0.0, near_dpt: 2.0 })).unwrap();
        scene.load(0, &BENCH, None, Fit::Native).unwrap().1.turned_apart
    };
    assert_eq!([report(1, 1), report(3, 3), report(6, 6)], [None; 3]);
    assert_eq!([report(3, 1), report(1, 2), report(6, 8)], [Some([3, 1]), Some([1, 2]), Some([6, 8])]);
    // An upright depth picture of the size that the photo has once it is turned.
    files.depth16("d.png", 8, 16, |x, _| 500 + x as u16);
    let upright = Scene::open(&pair.replace("d.jpg", "d.png"), Some(DepthEncoding::Millimetres)).unwrap();
    assert_eq!(upright.load(0, &BENCH, None, Fit::Native).unwrap().1.turned_apart, None);
}

#[test]
fn primaries_that_are_not_rec_709s_are_reported() {
    let files = Files::new();
    let path = files.path("c.exr");
    let with = |chromaticities| {
        let channels = ["B", "G", "R"].map(|name| AnyChannel::new(name, FlatSamples::F32(vec![0.5; 2])));
        let channels = AnyChannels::sort(channels.into_iter().collect());
        let layer = Layer::new(Vec2(2, 1), LayerAttributes::default(), Encoding::UNCOMPRESSED, channels);
        let window = IntegerBounds { position: Vec2(0, 0), size: Vec2(2, 1) };
        let attributes = ImageAttributes { chromaticities, ..ImageAttributes::new(window) };
        Image::empty(attributes).with_layer(layer).write().to_file(&path).unwrap();
        raster::read_colour(&path).unwrap().has_foreign_primaries
    };
    let of = |red: (f32, f32), green: (f32, f32), blue: (f32, f32), white: (f32, f32)| {
        let [red, green, blue, white] = [red, green, blue, white].map(|(x, y)| Vec2(x, y));
        Some(Chromaticities { red, green, blue, white })
    };
    assert!(!with(None));
    assert!(!with(of((0.64, 0.33), (0.3, 0.6), (0.15, 0.06), (0.3127, 0.329))));
    assert!(!with(of((0.6405, 0.33), (0.3, 0.6), (0.15, 0.06), (0.3128, 0.3291))), "rounded");
    assert!(with(of((0.64, 0.33), (0.3, 0.6), (0.15, 0.06), (0.3217, 0.3377))), "another white");
    assert!(with(of((0.7347, 0.2653), (0.0, 1.0), (0.0001, -0.077), (0.32168, 0.33767))), "ACES AP0");
}

#[test]
fn other_colours_than_srgbs_of_png_and_jpeg_are_reported() {
    use image::ImageEncoder;
    use image::codecs::jpeg::JpegEncoder;
    use image::codecs::png::PngEncoder;
    let files = Files::new();
    let profile = |colours: [[f32; 3]; 3]| {
        let mut bytes = vec![0; 128];
        bytes.extend(3_u32.to_be_bytes());
        for (index, name) in [b"rXYZ", b"gXYZ", b"bXYZ"].into_iter().enumerate() {
            bytes.extend(
                name.iter().copied().chain((168 + 20 * index as u32).to_be_bytes()).chain(20_u32.to_be_bytes()),
            );
        }
        for colour in colours {
            bytes.extend(b"XYZ \0\0\0\0");
            bytes.extend(colour.iter().flat_map(|part| ((part * 65536.0) as i32).to_be_bytes()));
        }
        bytes
    };
    let srgb = profile([[0.43607, 0.22249, 0.01392], [0.38515, 0.71687, 0.09708], [0.14307, 0.06061, 0.7141]]);
    let p3 = profile([[0.51512, 0.2412, -0.00105], [0.29198, 0.69225, 0.04189], [0.1571, 0.06657, 0.78407]]);
    let with_profile = |profile: &[u8], is_png: bool| {
        let mut bytes = Vec::new();
        let (pixels, kind) = ([90; 12], image::ExtendedColorType::Rgb8);
        if is_png {
            let mut encoder = PngEncoder::new(&mut bytes);
            encoder.set_icc_profile(profile.to_vec()).unwrap();
            encoder.write_image(&pixels, 2, 2, kind).unwrap();
        } else {
            let mut encoder = JpegEncoder::new(&mut bytes);
            encoder.set_icc_profile(profile.to_vec()).unwrap();
            encoder.write_image(&pixels, 2, 2, kind).unwrap();
        }
        bytes
    };
    let is_told = |bytes: &[u8]| {
        std::fs::write(files.path("c.png"), bytes).unwrap();
        raster::read_colour(&files.path("c.png")).unwrap().has_foreign_primaries
    };
    for is_png in [false, true] {
        assert!(!is_told(&with_profile(&srgb, is_png)));
        assert!(is_told(&with_profile(&p3, is_png)));
        assert!(!is_told(&with_profile(&p3[..140], is_png)), "a profile that is cut says nothing");
    }

    files.colour8("plain.png", 2, 2, |_, _| [90, 60, 30]);
    let plain = std::fs::read(files.path("plain.png")).unwrap();
    let with_chunks = |chunks: &[(&[u8; 4], Vec<u8>)]| {
        let mut bytes = plain[..33].to_vec();
        for (name, content) in chunks {
            let named = [&name[..], content].concat();
            let sum = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC).checksum(&named);
            bytes.extend((content.len() as u32).to_be_bytes().into_iter().chain(named).chain(sum.to_be_bytes()));
        }
        bytes.extend(&plain[33..]);
        is_told(&bytes)
    };
    let points = |points: [u32; 8]| (b"cHRM", points.into_iter().flat_map(u32::to_be_bytes).collect::<Vec<u8>>());
    let rec709 = || points([31270, 32900, 64000, 33000, 30000, 60000, 15000, 6000]);
    let rec2020 = || points([31270, 32900, 70800, 29200, 17000, 79700, 13100, 4600]);
    let codes = |primaries, transfer| (b"cICP", vec![primaries, transfer, 0, 1]);
    assert!(!with_chunks(&[]) && !with_chunks(&[rec709()]) && !with_chunks(&[codes(1, 13)]));
    assert!(with_chunks(&[rec2020()]) && with_chunks(&[codes(9, 13)]));
    assert!(with_chunks(&[codes(1, 16)]) && with_chunks(&[codes(1, 18)]), "PQ and HLG");
    assert!(!with_chunks(&[(b"sRGB", vec![0]), rec2020()]), "sRGB stands above cHRM");
    assert!(with_chunks(&[codes(12, 13), rec709()]), "cICP stands above it, too");
}

#[test]
fn a_depth_file_of_its_own_may_be_grey_or_have_one_channel_of_any_name() {
    let files = Files::new();
    let path = files.path("d.exr");
    let depth = |is_alone| {
        let read = raster::read_depth(&path, is_alone);
        read.map(|depth| depth.numbers.values[0]).map_err(|error| error.to_string())
    };
    for channels in [
        &[("V", 3.0)][..],
        &[("scene.V", 3.0)],
        &[("B", 3.0), ("G", 3.0), ("R", 3.0)],
        &[("A", 1.0), ("B", 3.0), ("G", 3.0), ("R", 3.0)],
        &[("B", f32::INFINITY), ("G", f32::INFINITY), ("R", f32::INFINITY)],
    ] {
        write_parts(&path, &[("", channels)]);
        assert_eq!(depth(true), Ok(channels.last().unwrap().1), "{channels:?}");
        assert!(depth(false).unwrap_err().contains("expected one depth channel: Z"), "colours are no depth");
    }
    for channels in [&[("B", 3.0), ("G", 3.0), ("R", 3.5)][..], &[("U", 3.0), ("V", 3.0)]] {
        write_parts(&path, &[("", channels)]);
        assert!(depth(true).unwrap_err().contains("R, G and B that are equal everywhere"), "{channels:?}");
    }
    let both =
        [("Depth.B", 3.0), ("Depth.G", 3.0), ("Depth.R", 3.0), ("view.B", 0.5), ("view.G", 0.5), ("view.R", 0.5)];
    write_parts(&path, &[("", &both)]);
    assert_eq!((depth(false), depth(true)), (Ok(3.0), Ok(3.0)));
    assert_eq!(raster::read_colour(&path).unwrap().linear[0], 0.5, "the only other layer");
}

#[test]
fn a_format_that_is_not_read_is_not_called_damaged() {
    let files = Files::new();
    let path = files.path("m.tiff");
    std::fs::write(&path, b"II*\0\x08\0\0\0\0\0\0\0\0\0").unwrap();
    let error = raster::read_colour(&path).err().unwrap().to_string();
    assert!(error.contains("m.tiff") && error.contains("export it as one of them"), "{error}");
    assert!(!error.contains("damaged"), "{error}");
}

#[test]
fn damaged_files_are_refused_and_never_half_read() {
    let files = Files::new();
    files.colour8("c.png", 40, 40, |x, y| [(x * y) as u8, x as u8, y as u8]);
    files.depth16("d.png", 40, 40, |x, y| (400 + x * y) as u16);
    files.exr("e.exr", size(40, 40), [0, 0], size(40, 40), |_, index| 0.1 + index as f32 * 1e-3);
    for (name, spec) in [("c.png", "c.png,d.png"), ("d.png", "c.png,d.png"), ("e.exr", "e.exr")] {
        let whole = std::fs::read(files.path(name)).unwrap();
        let spec: Vec<_> = spec.split(',').map(|file| files.path(file).display().to_string()).collect();
        let load =
            || Scene::open(&spec.join(","), Some(DepthEncoding::Metres)).unwrap().load(0, &BENCH, None, Fit::Native);
        load().unwrap();
        for length in [0, 3, 20, whole.len() / 3, whole.len() / 2, whole.len() - 30] {
            std::fs::write(files.path(name), &whole[..length]).unwrap();
            let error = load().unwrap_err().to_string();
            assert!(error.contains(name), "{length} bytes of {name}: {error}");
        }
        // Whatever the damage, there is an answer and no panic.
        for place in (0..whole.len()).step_by(whole.len() / 100 + 1) {
            let mut damaged = whole.clone();
            damaged[place] ^= 0x55;
            std::fs::write(files.path(name), damaged).unwrap();
            let _ = load();
        }
        std::fs::write(files.path(name), whole).unwrap();
    }
}

#[test]
fn a_jpeg_that_was_cut_short_is_refused() {
    let files = Files::new();
    files.colour8("c.png", 64, 64, |x, y| [(x * 3) as u8, (y * 3) as u8, (x * y) as u8]);
    let path = files.path("c.jpg");
    image::open(files.path("c.png")).unwrap().to_rgb8().save(&path).unwrap();
    let whole = std::fs::read(&path).unwrap();
    raster::read_colour(&path).unwrap();
    for length in [whole.len() / 2, whole.len() - 40, whole.len() - 1] {
        std::fs::write(&path, &whole[..length]).unwrap();
        let error = raster::read_colour(&path).err().unwrap().to_string();
        assert!(error.contains("c.jpg") && error.contains("end-of-image"), "{length}: {error}");
    }
}

/// A JPEG with an EXIF orientation, 16x8, bright in its upper left quarter.
fn jpeg_turned(path: &Path, orientation: u8) {
    let mut jpeg = Vec::new();
    let bright = |x, y| Rgb([if x < 8 && y < 4 { 255_u8 } else { 0 }; 3]);
    let encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut jpeg, 100);
    ImageBuffer::from_fn(16, 8, bright).write_with_encoder(encoder).unwrap();
    // One entry of a directory of TIFF: a short that is the orientation.
    let entry = [0x01, 0x12, 0, 3, 0, 0, 0, 1, 0, orientation, 0, 0];
    let exif = [&b"Exif\0\0MM\0\x2a\0\0\0\x08\0\x01"[..], &entry, &[0; 4]].concat();
    let segment = [&[0xff, 0xe1, 0, exif.len() as u8 + 2][..], &exif].concat();
    std::fs::write(path, [&jpeg[..2], &segment, &jpeg[2..]].concat()).unwrap();
}

#[test]
fn a_picture_is_turned_by_its_own_orientation() {
    let files = Files::new();
    files.describe("colour = \"c.jpg\"\ndepth = \"d.png\"\ndepth_encoding = \"millimetres\"\n");
    for (orientation, shown, bright) in [(1, size(16, 8), [0, 0]), (3, size(16, 8), [1, 1]), (6, size(8, 16), [1, 0])] {
        jpeg_turned(&files.path("c.jpg"), orientation);
        files.depth16("d.png", shown.width as u32, shown.height as u32, |x, _| 500 + x as u16);
        let (frame, report) = files.open().load(0, &BENCH, None, Fit::Native).unwrap();
        assert_eq!((frame.resolution, report.source), (shown, Some(shown)));
        for y in 0..shown.height {
            for x in 0..shown.width {
                let is_bright = [2 * x / shown.width, 2 * y / shown.height] == bright;
                let light = frame.amplitude[y * shown.width + x];
                assert_eq!(light > 0.5, is_bright, "orientation {orientation}: {light} at {x}, {y}");
            }
        }
        assert!(frame.depth_normalised.chunks_exact(shown.width).all(|row| row.is_sorted_by(|a, b| a > b)));
    }
    files.depth16("d.png", 16, 8, |x, _| 500 + x as u16);
    for fit in [Fit::Native, Fit::Cover] {
        let error = files.open().load(0, &BENCH, None, fit).unwrap_err().to_string();
        let said = ["d.png is 16x8 and ", "c.jpg is 8x16 (turned by its EXIF orientation 6);"];
        assert!(said.iter().all(|part| error.contains(part)), "{error}");
    }
    jpeg_turned(&files.path("d.jpg"), 8);
    let turned = raster::read_depth(&files.path("d.jpg"), true).unwrap();
    assert_eq!((turned.size, turned.turned.to_exif()), (size(8, 16), 8), "depth is turned by its own");
}

#[test]
fn a_jpeg_with_a_film_behind_it_is_read() {
    let files = Files::new();
    let path = files.path("motion.jpg");
    let whole = include_bytes!("progressive.jpg");
    std::fs::write(&path, whole).unwrap();
    let picture = raster::read_colour(&path).unwrap();
    assert_eq!(picture.size, size(24, 16));
    std::fs::write(&path, [&whole[..], b"\0\0\0\x18ftypmp42\xff\xda\0\x08mdat"].concat()).unwrap();
    assert!(raster::read_colour(&path).unwrap().linear == picture.linear);
}

#[test]
fn a_file_that_claims_a_huge_picture_is_refused_before_it_is_decoded() {
    let files = Files::new();
    files.colour8("c.png", 2, 2, |_, _| [0; 3]);
    let mut bytes = std::fs::read(files.path("c.png")).unwrap();
    bytes[16..24].copy_from_slice(&[0, 1, 0, 0, 0, 1, 0, 0]);
    let checksum = Crc::<u32>::new(&CRC_32_ISO_HDLC).checksum(&bytes[12..29]);
    bytes[29..33].copy_from_slice(&checksum.to_be_bytes());
    std::fs::write(files.path("c.png"), bytes).unwrap();
    let error = raster::read_colour(&files.path("c.png")).err().unwrap().to_string();
    assert!(error.contains("65536x65536"), "{error}");
}

#[test]
fn what_is_no_picture_says_so() {
    let files = Files::new();
    files.colour8("c.png", 2, 2, |_, _| [0; 3]);
    files.depth16("d.png", 2, 2, |_, _| 0);
    files.describe(MILLIMETRES);
    let error = files.open().load(0, &BENCH, None, Fit::Native).unwrap_err().to_string();
    assert!(error.contains("d.png") && error.contains("encoding"), "{error}");
    files.describe("colour = \"absent.png\"\ndepth = \"d.png\"\ndepth_encoding = \"metres\"");
    assert!(matches!(files.open().load(0, &BENCH, None, Fit::Native), Err(SceneError::Read { .. })));
    files.describe("colour = \"c.png\"\ndepth = \".\"\ndepth_encoding = \"metres\"");
    assert!(matches!(files.open().load(0, &BENCH, None, Fit::Native), Err(SceneError::Kind { .. })));
    files.colour8("d.png", 2, 2, |x, _| [10, 20, x as u8]);
    files.describe(MILLIMETRES);
    let error = files.open().load(0, &BENCH, None, Fit::Native).unwrap_err().to_string();
    assert!(error.contains("d.png") && error.contains("grey"), "{error}");
}

#[test]
fn encodings_are_read_from_a_command_line() {
    let parse = |text: &str| DepthEncoding::parse(text, &BENCH);
    let normalised = |far_dpt, near_dpt| DepthEncoding::NormalisedDioptres { far_dpt, near_dpt };
    assert_eq!(parse("metres").unwrap(), DepthEncoding::Metres);
    assert_eq!(parse("normalised_dioptres:0.25,2.5").unwrap(), normalised(0.25, 2.5));
    assert_eq!(parse("normalised_dioptres").unwrap(), normalised(BENCH.depth_far.0, BENCH.depth_near.0));
    for unknown in ["inches", "", "normalised_dioptres:", "normalised_dioptres:2,1", "normalised_dioptres:0,x"] {
        let error = parse(unknown).unwrap_err().to_string();
        assert!(error.contains("metres, millimetres, dioptres") && error.contains(unknown), "{error}");
    }
    for (ends, told) in [("2.5,0", true), ("1,1", true), ("-1,2", false), ("0,inf", false), ("inf,inf", false)] {
        let error = parse(&format!("normalised_dioptres:{ends}")).unwrap_err().to_string();
        assert_eq!(error.contains("the near one, has no more dioptres than the first"), told, "{error}");
        assert!(error.contains("NEAR more than FAR; the rig's depth range where they are left out"), "{error}");
    }
}

#[test]
#[ignore = "needs shared data"]
fn shared_data_living_room_sequence_loads() {
    let files = Files::new();
    let room = shared_data().join("rgbd/livingroom");
    files.describe(&format!(
        "colour = \"{0}/rgb/{{:05}}.jpg\"\ndepth = \"{0}/depth/{{:05}}.png\"\ndepth_encoding = \"millimetres\"\nstep = 30",
        room.canonicalize().unwrap().display()
    ));
    let scene = files.open();
    assert_eq!(scene.frames(), 8);
    for index in 0..8 {
        let (frame, report) = scene.load(index, &BENCH, Some(size(512, 512)), Fit::Cover).unwrap();
        assert_eq!((frame.resolution, report.source), (size(512, 512), Some(size(640, 480))));
        assert!(report.depth_missing_px < 640 * 480 / 4, "{report:?}");
        let mean = frame.depth_normalised.iter().sum::<f32>() / (512.0 * 512.0);
        assert!((0.02..0.9).contains(&mean), "{mean}");
    }
}

#[test]
#[ignore = "needs shared data"]
fn shared_data_beach_ball_loads_at_its_display_window() {
    let path = shared_data().join("rgbd/beachball/singlepart.0001.exr");
    let scene = Scene::open(path.to_str().unwrap(), Some(DepthEncoding::Metres)).unwrap();
    let (frame, report) = scene.load(0, &BENCH, None, Fit::Native).unwrap();
    assert_eq!(frame.resolution, size(2048, 1556));
    assert!(report.depth_missing_px >= 2048 * 1556 - 911 * 876, "{report:?}");
    let inside = 600 * 2048 + 1100;
    assert!(frame.amplitude[inside] > 0.0 && frame.amplitude[0] == 0.0);
    assert!(scene.load(0, &BENCH, Some(size(1920, 1080)), Fit::Native).is_err());
    scene.load(0, &BENCH, Some(size(640, 360)), Fit::Contain).unwrap();
}

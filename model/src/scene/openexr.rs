//! OpenEXR pictures: linear light already, and depth in a channel of its own.
//!
//! The frame is the display window. Pixels outside the data window are black and have no depth.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use exr::image::{AnyChannel, FlatSamples};
use exr::meta::MetaData;
use exr::meta::attribute::Chromaticities;
use exr::prelude::{ReadChannels, ReadLayers};
use holod_calibration::Resolution;
use image::metadata::Orientation;

use super::decoded::{ColourRaster, DepthRaster, FORMATS, MOST_PIXELS, check_size};
use super::depth::DepthNumbers;
use super::{ClippedColours, SceneError, clipped, primaries};

/// An OpenEXR file's channels, as they were decoded.
struct Picture {
    size: Resolution,
    /// Position of the display window's first pixel.
    origin: [i64; 2],
    /// What primaries and white its colours are of, where it says so.
    chromaticities: Option<Chromaticities>,
    channels: Vec<Channel>,
}

/// One channel with the part of the plane that it covers.
struct Channel {
    /// `R`, or with its layer `ViewLayer.Combined.R`; of a file with several parts it begins with the part's name.
    name: String,
    /// Whether it is in no layer of its part.
    is_bare: bool,
    origin: [i64; 2],
    size: Resolution,
    samples: FlatSamples,
}

/// Channels whose names are alike but for the last part.
struct Layer<'a> {
    /// `ViewLayer.Combined`; empty for channels that are in none.
    name: &'a str,
    channels: Vec<&'a Channel>,
}

pub(super) fn read_colour(path: &Path) -> Result<ColourRaster, SceneError> {
    let picture = read(path)?;
    let channels = picture.colours(path)?;
    let is_luminance = std::ptr::eq(channels[0], channels[1]);
    let pixels = picture.size.pixels();
    let mut linear = vec![0.0; 3 * pixels];
    let mut is_outside = vec![[false; 2]; pixels];
    for (plane, channel) in linear.chunks_exact_mut(pixels).zip(channels) {
        picture.place(channel, |index, light| {
            plane[index] = clipped::shown(light);
            let [above_white, below_black] = &mut is_outside[index];
            *above_white |= clipped::is_above_white(light);
            *below_black |= clipped::is_below_black(light);
        });
    }
    let mut clipped = ClippedColours::default();
    is_outside.into_iter().for_each(|[above_white, below_black]| clipped.count(above_white, below_black));
    let has_foreign_primaries = !is_luminance && picture.chromaticities.is_some_and(|of| !are_rec709(of));
    let (size, turned) = (picture.size, Orientation::NoTransforms);
    Ok(ColourRaster { size, turned, linear, clipped, is_luminance, has_foreign_primaries })
}

/// Whether colours are of the primaries and the white of sRGB.
fn are_rec709(Chromaticities { red, green, blue, white }: Chromaticities) -> bool {
    primaries::are_rec709([red, green, blue, white].map(|point| [point.x(), point.y()]))
}

pub(super) fn read_depth(path: &Path, is_alone: bool) -> Result<DepthRaster, SceneError> {
    let picture = read(path)?;
    let channel = picture.depth(path, is_alone)?;
    let mut values = vec![f32::NAN; picture.size.pixels()];
    picture.place(channel, |index, value| values[index] = value);
    let numbers = DepthNumbers { values, full_scale: None };
    let is_luminance = channel.component().eq_ignore_ascii_case("Y");
    Ok(DepthRaster { size: picture.size, turned: Orientation::NoTransforms, numbers, is_luminance })
}

impl Picture {
    /// Red, green and blue of one layer: of none, of one called Combined, or else of the only one. A picture without
    /// them may have luminance.
    fn colours(&self, path: &Path) -> Result<[&Channel; 3], SceneError> {
        let mut candidates = Vec::new();
        for layer in self.layers().into_iter().filter(|layer| !layer.is_called("Depth")) {
            if let [Some(red), Some(green), Some(blue)] = ["R", "G", "B"].map(|name| layer.channel(name)) {
                let rules = [layer.name.is_empty(), layer.is_called("Combined"), red.is_bare, true];
                let rank = rules.iter().take_while(|keeps| !**keeps).count();
                candidates.push((rank, layer.name, [red, green, blue]));
            } else if let Some((rank, luminance)) = layer.luminance() {
                candidates.push((4 + rank, luminance.name.as_str(), [luminance; 3]));
            }
        }
        let expected = "channels R, G and B in no layer, in one called Combined or in only one, or else Y";
        self.best(path, candidates, "colours", expected)
    }

    /// Z in no layer or in one called Depth. A file of depth alone often calls it luminance, or anything, or has it as
    /// grey.
    fn depth(&self, path: &Path, is_alone: bool) -> Result<&Channel, SceneError> {
        let mut candidates = Vec::new();
        for layer in self.layers() {
            let z = layer.channel("Z").filter(|_| !layer.is_vector());
            let named = match &layer.channels[..] {
                _ if !layer.is_called("Depth") => layer.channel("Depth"),
                [only] => Some(*only),
                _ => z.or_else(|| layer.grey()),
            };
            let found = match (named, z) {
                (_, Some(z)) if layer.name.is_empty() => Some((0, z)),
                (Some(named), _) => Some((1, named)),
                (None, Some(z)) if z.is_bare => Some((2, z)),
                _ => layer.luminance().map(|(rank, luminance)| (3 + rank, luminance)),
            };
            candidates.extend(found.map(|(rank, channel)| (rank, channel.name.as_str(), channel)));
        }
        if !is_alone {
            let expected = "one depth channel: Z in no layer or in one called Depth, without X and Y, or else Y";
            return self.best(path, candidates, "depth", expected);
        }
        if candidates.is_empty() {
            let all = self.layers();
            let grey = all.iter().filter_map(Layer::grey);
            let only = self.channels.first().filter(|_| self.channels.len() == 1);
            candidates.extend(only.into_iter().chain(grey).map(|channel| (0, channel.name.as_str(), channel)));
        }
        let expected = "one depth channel: Z in no layer or in one called Depth, without X and Y, or else Y, the only \
                        channel, or R, G and B that are equal everywhere";
        self.best(path, candidates, "depth", expected)
    }

    /// The one of the lowest rank; each has the name that says which it is.
    fn best<T>(
        &self,
        path: &Path,
        candidates: Vec<(usize, &str, T)>,
        what: &str,
        expected: &str,
    ) -> Result<T, SceneError> {
        let Some(rank) = candidates.iter().map(|(rank, ..)| *rank).min() else {
            return Err(self.lacks(path, expected));
        };
        let mut best: Vec<_> = candidates.into_iter().filter(|(of, ..)| *of == rank).collect();
        if best.len() > 1 {
            let names: Vec<_> = best.iter().map(|(_, name, _)| *name).collect();
            return Err(SceneError::Picture {
                path: path.to_owned(),
                found: format!("{what} more than once: {}", names.join(", ")),
                expected: format!("{expected}: export only one of them"),
            });
        }
        Ok(best.remove(0).2)
    }

    /// Layers in the order of the file.
    fn layers(&self) -> Vec<Layer<'_>> {
        let mut layers: Vec<Layer<'_>> = Vec::new();
        for channel in &self.channels {
            let name = channel.layer();
            match layers.iter_mut().find(|layer| layer.name == name) {
                Some(layer) => layer.channels.push(channel),
                None => layers.push(Layer { name, channels: vec![channel] }),
            }
        }
        layers
    }

    fn lacks(&self, path: &Path, expected: &str) -> SceneError {
        let names: Vec<_> = self.channels.iter().map(|channel| channel.name.as_str()).collect();
        SceneError::Picture {
            path: path.to_owned(),
            found: format!("the channels {}", names.join(", ")),
            expected: expected.into(),
        }
    }

    /// Calls `write` with the index in the display window of each sample of `channel` inside it.
    fn place(&self, channel: &Channel, mut write: impl FnMut(usize, f32)) {
        let inside = |position: i64, size: usize| (0..size as i64).contains(&position).then_some(position as usize);
        for row in 0..channel.size.height {
            let Some(y) = inside(channel.origin[1] - self.origin[1] + row as i64, self.size.height) else { continue };
            for column in 0..channel.size.width {
                if let Some(x) = inside(channel.origin[0] - self.origin[0] + column as i64, self.size.width) {
                    let value = channel.samples.value_by_flat_index(row * channel.size.width + column).to_f32();
                    write(y * self.size.width + x, value);
                }
            }
        }
    }
}

impl Channel {
    /// The name's last part.
    fn component(&self) -> &str {
        self.name.rsplit('.').next().unwrap_or_default()
    }

    /// The name without its last part.
    fn layer(&self) -> &str {
        self.name.rsplit_once('.').map_or("", |(layer, _)| layer)
    }
}

impl<'a> Layer<'a> {
    fn channel(&self, component: &str) -> Option<&'a Channel> {
        self.channels.iter().copied().find(|channel| channel.component().eq_ignore_ascii_case(component))
    }

    /// Red, where green and blue are the same everywhere.
    fn grey(&self) -> Option<&'a Channel> {
        let [red, green, blue] = ["R", "G", "B"].map(|name| self.channel(name));
        let red = red?;
        let is_alike = |other: &Channel| {
            let pairs = red.samples.values_as_f32().zip(other.samples.values_as_f32());
            red.samples.len() == other.samples.len()
                && pairs.into_iter().all(|(a, b)| a == b || a.is_nan() && b.is_nan())
        };
        (is_alike(green?) && is_alike(blue?)).then_some(red)
    }

    /// Whether that is the last part of its name.
    fn is_called(&self, name: &str) -> bool {
        self.name.rsplit('.').next().is_some_and(|last| last.eq_ignore_ascii_case(name))
    }

    /// Whether Z is not alone: a normal or a motion.
    fn is_vector(&self) -> bool {
        self.channel("X").is_some() && self.channel("Y").is_some()
    }

    /// Luminance, with 0 where it is in no layer and 1 where it is in one.
    fn luminance(&self) -> Option<(usize, &'a Channel)> {
        let luminance = self.channel("Y").filter(|_| self.channel("X").is_none())?;
        Some((usize::from(!self.name.is_empty()), luminance))
    }
}

fn read(path: &Path) -> Result<Picture, SceneError> {
    let damaged = |error: exr::error::Error| SceneError::Picture {
        path: path.to_owned(),
        found: format!("an OpenEXR file that cannot be read ({error})"),
        expected: "a whole OpenEXR file without deep data; it may be damaged or cut short: export or copy it again"
            .into(),
    };
    let open = || -> Result<_, SceneError> {
        let file = File::open(path);
        Ok(BufReader::new(file.map_err(|source| SceneError::Read {
            path: path.to_owned(),
            source,
            expected: FORMATS,
        })?))
    };
    // The header alone first: its sizes decide how much memory decoding takes.
    let metadata = MetaData::read_from_buffered(open()?, false).map_err(damaged)?;
    let mut samples = 0usize;
    for header in &metadata.headers {
        let size = check_size(path, header.layer_size.width(), header.layer_size.height())?;
        samples = samples.saturating_add(size.pixels().saturating_mul(header.channels.list.len()));
        if let Some(channel) = header.channels.list.iter().find(|channel| channel.sampling != exr::math::Vec2(1, 1)) {
            return Err(SceneError::Picture {
                path: path.to_owned(),
                found: format!("the subsampled channel {}", channel.name),
                expected: "channels of full resolution: export without chroma subsampling".into(),
            });
        }
    }
    if samples > 8 * MOST_PIXELS {
        return Err(SceneError::Picture {
            path: path.to_owned(),
            found: format!("{samples} samples in all its channels"),
            expected: format!("at most {}: export only colour and depth", 8 * MOST_PIXELS),
        });
    }

    let image = exr::image::read::read()
        .no_deep_data()
        .largest_resolution_level()
        .all_channels()
        .all_layers()
        .all_attributes()
        .from_buffered(open()?)
        .map_err(damaged)?;
    let window = image.attributes.display_window;
    let size = check_size(path, window.size.width(), window.size.height())?;
    let has_parts = image.layer_data.len() > 1;
    let channels = image
        .layer_data
        .into_iter()
        .flat_map(|layer| {
            let position = layer.attributes.layer_position;
            let size = Resolution { width: layer.size.width(), height: layer.size.height() };
            let part = layer.attributes.layer_name.filter(|_| has_parts);
            let prefix = part.map(|name| format!("{name}.")).unwrap_or_default();
            layer.channel_data.list.into_iter().map(move |AnyChannel { name, sample_data, .. }| Channel {
                name: format!("{prefix}{name}"),
                is_bare: !name.to_string().contains('.'),
                origin: [i64::from(position.x()), i64::from(position.y())],
                size,
                samples: sample_data,
            })
        })
        .collect();
    let origin = [i64::from(window.position.x()), i64::from(window.position.y())];
    Ok(Picture { size, origin, chromaticities: image.attributes.chromaticities, channels })
}

//! OpenEXR pictures: linear light already, and depth in a channel of its own.
//!
//! The frame is the display window. Pixels outside the data window are black and have no depth.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use exr::image::{AnyChannel, FlatSamples};
use exr::meta::MetaData;
use exr::prelude::{ReadChannels, ReadLayers};
use holod_calibration::Resolution;

use super::SceneError;
use super::decoded::{ColourRaster, DepthRaster, FORMATS, MOST_PIXELS, check_size};
use super::depth::DepthNumbers;

/// A decoded file.
struct Picture {
    size: Resolution,
    /// Position of the display window's first pixel.
    origin: [i64; 2],
    channels: Vec<Channel>,
}

/// One channel with the part of the plane that it covers.
struct Channel {
    /// `R`, or with its layer `ViewLayer.Combined.R`.
    name: String,
    origin: [i64; 2],
    size: Resolution,
    samples: FlatSamples,
}

pub(super) fn read_colour(path: &Path) -> Result<ColourRaster, SceneError> {
    let picture = read(path)?;
    let names = ["r", "g", "b"].map(|name| picture.find(|channel| channel.component() == name));
    let channels = match names {
        [Some(red), Some(green), Some(blue)] => [red, green, blue],
        _ => match picture.find(|channel| channel.component() == "y") {
            Some(luminance) => [luminance; 3],
            None => return Err(picture.lacks(path, "channels R, G and B, or Y")),
        },
    };
    let pixels = picture.size.pixels();
    let mut linear = vec![0.0; 3 * pixels];
    let mut clipped = vec![false; pixels];
    for (plane, channel) in linear.chunks_exact_mut(pixels).zip(channels) {
        picture.place(channel, |index, value| {
            plane[index] = if value.is_nan() { 0.0 } else { value.clamp(0.0, 1.0) };
            clipped[index] |= plane[index] != value;
        });
    }
    let clipped_px = clipped.into_iter().filter(|&clipped| clipped).count();
    Ok(ColourRaster { size: picture.size, linear, clipped_px })
}

pub(super) fn read_depth(path: &Path) -> Result<DepthRaster, SceneError> {
    let picture = read(path)?;
    let channel = picture
        .find(|channel| channel.component() == "z")
        .or_else(|| picture.find(|channel| channel.component() == "depth" || channel.layer() == "depth"))
        // A file of depth alone often calls it luminance.
        .or_else(|| picture.find(|channel| channel.component() == "y"));
    let Some(channel) = channel else { return Err(picture.lacks(path, "a depth channel Z, `*.Z`, `Depth` or Y")) };
    let mut values = vec![f32::NAN; picture.size.pixels()];
    picture.place(channel, |index, value| values[index] = value);
    Ok(DepthRaster { size: picture.size, numbers: DepthNumbers { values, full_scale: None } })
}

impl Picture {
    fn find(&self, wanted: impl Fn(&Channel) -> bool) -> Option<&Channel> {
        self.channels.iter().find(|channel| wanted(channel))
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
    /// The name's last part in lower case.
    fn component(&self) -> String {
        self.name.rsplit('.').next().unwrap_or_default().to_ascii_lowercase()
    }

    /// The part before the last in lower case.
    fn layer(&self) -> String {
        self.name.rsplit('.').nth(1).unwrap_or_default().to_ascii_lowercase()
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
    let channels = image
        .layer_data
        .into_iter()
        .flat_map(|layer| {
            let position = layer.attributes.layer_position;
            let size = Resolution { width: layer.size.width(), height: layer.size.height() };
            let prefix = layer.attributes.layer_name.map(|name| format!("{name}.")).unwrap_or_default();
            layer.channel_data.list.into_iter().map(move |AnyChannel { name, sample_data, .. }| Channel {
                name: format!("{prefix}{name}"),
                origin: [i64::from(position.x()), i64::from(position.y())],
                size,
                samples: sample_data,
            })
        })
        .collect();
    Ok(Picture { size, origin: [i64::from(window.position.x()), i64::from(window.position.y())], channels })
}

//! The steps of a frame, and the buffers through which they pass on what they make.

use std::ops::{Index, IndexMut};

use holod_calibration::Resolution;

use super::conv::Scratch;
use super::feature_map::FeatureMap;
use crate::ComplexHologram;
use crate::conditions::Conditions;
use crate::simd::{InstructionSet, Products};

/// What to render; it and the hologram have the network's resolution.
pub(super) struct Job<'a, I> {
    pub(super) input: &'a I,
    pub(super) pupil_mm: f32,
    pub(super) conditions: Conditions,
    pub(super) hologram: &'a mut ComplexHologram,
}

/// What the stages of a family share besides maps.
pub(super) trait Shared: Send + Sync {
    /// What the family makes holograms of.
    type Input;
}

/// One step of a frame, with its parameters and what it alone needs to run.
pub(super) trait Stage<F: Shared>: Send + Sync {
    /// The stage's name, as in [`StageTiming`](crate::engine::StageTiming).
    fn name(&self) -> &str;

    /// Floating-point operations of a frame, as in [`StageTiming`](crate::engine::StageTiming).
    fn flop(&self) -> u64 {
        0
    }

    /// Bytes that a frame moves at least, as in [`StageTiming`](crate::engine::StageTiming).
    fn bytes(&self) -> u64;

    /// Does the step; allocates nothing.
    fn run(&mut self, buffers: &mut Buffers<F>, job: &mut Job<'_, F::Input>);

    /// What the step has just written, for tests that look inside.
    #[cfg(test)]
    fn seen<'a>(&'a self, buffers: &'a Buffers<F>, job: &'a Job<'_, F::Input>) -> Seen<'a>;
}

/// Bytes of `count` planes of real numbers of `size`; a field has [`OUTPUT_CHANNELS`](crate::weights::OUTPUT_CHANNELS).
pub(super) const fn plane_bytes(count: usize, size: Resolution) -> u64 {
    (count * size.width * size.height * size_of::<f32>()) as u64
}

/// Bytes of a picture and its depth.
pub(super) const fn frame_bytes(resolution: Resolution) -> u64 {
    plane_bytes(3 + 1, resolution)
}

#[cfg(test)]
pub(super) enum Seen<'a> {
    /// A layer's map, and the offsets of an adjustable one.
    Map(&'a FeatureMap, Option<FeatureMap>),
    /// What a net reads, and the channel of each of its inputs.
    Inputs(&'a FeatureMap, Vec<usize>),
    /// A field, [3, height, width].
    Light(std::borrow::Cow<'a, [num_complex::Complex32]>),
}

/// What stages write for later ones.
pub(super) struct Buffers<F> {
    pub(super) maps: Maps,
    pub(super) family: F,
}

/// The maps of a network, all of one size, and the scratch of the layers between them.
pub(super) struct Maps {
    /// Width and height of each map.
    pub(super) size: Resolution,
    pub(super) products: Products,
    pub(super) scratch: Scratch,
    maps: Vec<FeatureMap>,
    /// What the layers of nets hand on, with its channels.
    handed_on: Vec<(usize, [MapId; 2])>,
}

/// The place of one of the [`Maps`].
#[derive(Clone, Copy)]
pub(super) struct MapId(usize);

impl Maps {
    pub(super) fn new(size: Resolution, products: Products) -> Self {
        Self { size, products, scratch: Scratch::new(), maps: Vec::new(), handed_on: Vec::new() }
    }

    /// The vectors of everything that is no product.
    pub(super) fn set(&self) -> InstructionSet {
        self.products.set()
    }

    /// Makes a further map, of zeros.
    pub(super) fn add(&mut self, channels: usize) -> MapId {
        self.maps.push(FeatureMap::new(self.size.width, self.size.height, channels, self.set()));
        MapId(self.maps.len() - 1)
    }

    /// Two maps that the layers of a net hand on by turns. All nets of one number of channels share them: each has made
    /// its output when the next one begins.
    pub(super) fn handed_on(&mut self, channels: usize) -> [MapId; 2] {
        if let Some((_, maps)) = self.handed_on.iter().find(|(of, _)| *of == channels) {
            return *maps;
        }
        let maps = [self.add(channels), self.add(channels)];
        self.handed_on.push((channels, maps));
        maps
    }

    /// What a layer needs that reads one map and writes another.
    pub(super) fn for_layer(&mut self, input: MapId, output: MapId) -> (&FeatureMap, &mut FeatureMap, &mut Scratch) {
        let [input, output] =
            self.maps.get_disjoint_mut([input.0, output.0]).expect("a layer reads another map than it writes");
        (input, output, &mut self.scratch)
    }
}

impl Index<MapId> for Maps {
    type Output = FeatureMap;

    fn index(&self, id: MapId) -> &FeatureMap {
        &self.maps[id.0]
    }
}

impl IndexMut<MapId> for Maps {
    fn index_mut(&mut self, id: MapId) -> &mut FeatureMap {
        &mut self.maps[id.0]
    }
}

//! Reproducible random numbers: one PCG stream for each purpose, and a hash for textures.

use holod_model::scene_shard::SceneKind;
use rand::Rng;
use rand_pcg::Pcg32;

/// A stream of random numbers that depends on nothing but its key.
pub(super) struct Random(Pcg32);

impl Random {
    pub(super) fn new(seed: u64, stream: u64) -> Self {
        Self(Pcg32::new(mix(seed), mix(stream ^ 0x9e37_79b9)))
    }

    /// Uniform from 0 to below 1.
    pub(super) fn unit(&mut self) -> f32 {
        (self.0.next_u32() >> 8) as f32 / 16_777_216.0
    }

    pub(super) fn between(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * self.unit()
    }

    /// Uniform in the logarithm.
    pub(super) fn log_between(&mut self, low: f32, high: f32) -> f32 {
        low * (high / low).powf(self.unit())
    }

    /// Uniform from 0 to below `count`.
    pub(super) fn below(&mut self, count: u32) -> u32 {
        ((u64::from(self.0.next_u32()) * u64::from(count)) >> 32) as u32
    }

    pub(super) fn chance(&mut self, probability: f32) -> bool {
        self.unit() < probability
    }

    pub(super) fn seed(&mut self) -> u32 {
        self.0.next_u32()
    }
}

/// Scenes of one kind are drawn from a seed space of their own.
pub(super) fn stream(kind: SceneKind) -> u64 {
    match kind {
        SceneKind::Train => 0x7472_6169_6e00,
        SceneKind::Test => 0x7465_7374_0000,
        SceneKind::Cards => 0x6361_7264_7300,
        SceneKind::Marks => 0x6d61_726b_7300,
    }
}

/// The SplitMix64 finaliser: neighbouring keys give unrelated values.
pub(super) fn mix(key: u64) -> u64 {
    let mut z = key.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// A 32-bit hash of a lattice point.
pub(super) fn hash(x: i32, y: i32, seed: u32) -> u32 {
    let mut h =
        (x as u32).wrapping_mul(0x85eb_ca6b) ^ (y as u32).wrapping_mul(0xc2b2_ae35) ^ seed.wrapping_mul(0x27d4_eb2f);
    h = (h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d);
    h = (h ^ (h >> 12)).wrapping_mul(0x297a_2d39);
    h ^ (h >> 15)
}

/// The hash as a number in 0..1.
pub(super) fn hash_unit(x: i32, y: i32, seed: u32) -> f32 {
    (hash(x, y, seed) >> 8) as f32 / 16_777_216.0
}

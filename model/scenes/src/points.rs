//! Which rays are traced: aperture points, and for each a fraction of a pixel by which its view's grid is moved.

use super::random::Random;

/// Frequencies, in cycles a pixel along x and y, at which the places that rays reach in their pixels are kept even.
const HIGHEST_FREQUENCY: i32 = 4;
/// Offsets tried for each view.
const CANDIDATES: usize = 32;
/// Focus planes at which the places are kept even; of more planes, this many are looked at.
const PLANES_LOOKED_AT: usize = 8;

/// One view's aperture point, in pixels per dioptre, and its grid's offset in a pixel.
pub(super) struct ViewPoint {
    pub(super) ax: f32,
    pub(super) ay: f32,
    pub(super) dx: f32,
    pub(super) dy: f32,
}

/// `count` points spread evenly over the ring between two radii, in pixels per dioptre. `lifts` are the distances in
/// dioptres from the grids' depth to the focus planes.
///
/// The aperture points are a Kronecker sequence of the plastic number. The offsets are chosen one after another: of a
/// few candidates the one that makes the rays' places within the pixels of all focus planes together most even, which
/// is to say that makes the power of their low frequencies least.
pub(super) fn view_points(inner: f32, outer: f32, count: usize, lifts: &[f32], key: u64) -> Vec<ViewPoint> {
    // The root of g³ = g + 1.
    const G: f64 = 1.324_717_957_244_746;
    let mut random = Random::new(key, 0);
    let mut sequence = || {
        let start = [random.unit(), random.unit()].map(f64::from);
        (0u32..).map(move |n| {
            [(start[0] + f64::from(n) / G).fract(), (start[1] + f64::from(n) / (G * G)).fract()].map(|part| part as f32)
        })
    };
    let ring = inner * inner..outer * outer;
    let aperture = sequence()
        .map(|part| part.map(|p| outer * (2.0 * p - 1.0)))
        .filter(|[ax, ay]| ring.contains(&(ax * ax + ay * ay)))
        .take(count);
    let mut offsets = sequence();
    let mut evenness = Evenness::new(lifts);
    aperture
        .map(|[ax, ay]| {
            let wanted = evenness.wanted(ax, ay);
            let candidates = offsets.by_ref().take(CANDIDATES).map(|offset| (evenness.cost(&wanted, offset), offset));
            let (_, [dx, dy]) = candidates.min_by(|a, b| a.0.total_cmp(&b.0)).expect("there are candidates");
            evenness.add(ax, ay, dx, dy);
            ViewPoint { ax, ay, dx, dy }
        })
        .collect()
}

/// Sums of e^(2πi h·x) over the places x that rays reach in their pixels, for each plane and frequency h.
struct Evenness {
    lifts: Vec<f32>,
    frequencies: Vec<[f32; 2]>,
    sums: Vec<[f32; 2]>,
}

impl Evenness {
    fn new(lifts: &[f32]) -> Self {
        let looked_at = lifts.len().min(PLANES_LOOKED_AT);
        let last = (lifts.len() - 1) as f32 / (looked_at.max(2) - 1) as f32;
        let lifts: Vec<f32> = (0..looked_at).map(|k| lifts[(k as f32 * last).round() as usize]).collect();
        // The other half of the frequencies are their conjugates.
        let frequencies: Vec<[f32; 2]> = (0..=HIGHEST_FREQUENCY)
            .flat_map(|y| (-HIGHEST_FREQUENCY..=HIGHEST_FREQUENCY).map(move |x| [x as f32, y as f32]))
            .filter(|[x, y]| *y > 0.0 || *x > 0.0)
            .collect();
        let sums = vec![[0.0; 2]; lifts.len() * frequencies.len()];
        Self { lifts, frequencies, sums }
    }

    /// For each frequency, what a ray through an aperture point should add to all planes' sums but for its offset.
    fn wanted(&self, ax: f32, ay: f32) -> Vec<[f32; 2]> {
        let mut wanted = vec![[0.0; 2]; self.frequencies.len()];
        for (&lift, sums) in self.lifts.iter().zip(self.sums.chunks_exact(self.frequencies.len())) {
            for ((wanted, [x, y]), sum) in wanted.iter_mut().zip(&self.frequencies).zip(sums) {
                // The conjugate of the sum times the ray's own wave, weighted as pictures' spectra fall.
                let (sin, cos) = (std::f32::consts::TAU * lift * (x * ax + y * ay)).sin_cos();
                let weight = 1.0 / (x * x + y * y);
                wanted[0] += weight * (sum[0] * cos + sum[1] * sin);
                wanted[1] += weight * (sum[0] * sin - sum[1] * cos);
            }
        }
        wanted
    }

    /// How much power an offset adds to the sums, but for a constant.
    fn cost(&self, wanted: &[[f32; 2]], [dx, dy]: [f32; 2]) -> f32 {
        wanted
            .iter()
            .zip(&self.frequencies)
            .map(|(wanted, [x, y])| {
                let (sin, cos) = (std::f32::consts::TAU * (x * dx + y * dy)).sin_cos();
                wanted[0] * cos - wanted[1] * sin
            })
            .sum()
    }

    fn add(&mut self, ax: f32, ay: f32, dx: f32, dy: f32) {
        for (&lift, sums) in self.lifts.iter().zip(self.sums.chunks_exact_mut(self.frequencies.len())) {
            for (sum, [x, y]) in sums.iter_mut().zip(&self.frequencies) {
                let turns = x * (dx + ax * lift) + y * (dy + ay * lift);
                let (sin, cos) = (std::f32::consts::TAU * turns).sin_cos();
                *sum = [sum[0] + cos, sum[1] + sin];
            }
        }
    }
}

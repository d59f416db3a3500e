//! Circular transforms of lines of samples, as many lines at once as a vector has lanes.
//!
//! Samples are cells: the real parts of all lines, then their imaginary parts. A pass of Stockham's (1966) self-sorting
//! transform reads all cells of one buffer and writes all of another, so that no pass only sorts.

use std::f64::consts::TAU;
use std::sync::Arc;

use holod_fft::{Fft, FftDirection, Real};
use num_complex::Complex32;

use crate::simd::{Simd, Task};

/// Radices of passes. Those of more samples than registers hold would be no faster.
const RADICES: [usize; 9] = [2, 3, 4, 5, 6, 7, 8, 11, 13];
const MOST_RADIX: usize = RADICES[RADICES.len() - 1];

/// Which way a transform goes; neither is normalised.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Direction {
    Forward,
    Inverse,
}

/// Cells that lie beside one another in squares, of as many cells as a vector has lanes each.
#[derive(Clone, Copy)]
pub(super) struct Squares<'a> {
    /// From the first one on.
    pub(super) values: &'a [f32],
    /// From one to the next.
    pub(super) pitch: usize,
}

impl Squares<'_> {
    /// Where cell number `cell` begins.
    #[inline(always)]
    fn place<S: Simd>(self, cell: usize) -> usize {
        cell / S::LANES * self.pitch + cell % S::LANES * 2 * S::LANES
    }
}

/// A complex number in each lane.
type Cell<S> = [<S as Simd>::Vector; 2];
/// [cos, sin] of minus a part of a turn.
type Turn = [f32; 2];

/// A transform of lines of one length.
pub(super) struct LineFft {
    length: usize,
    passes: Vec<Pass>,
    /// Where the length has a prime factor that no radix has: the transform of one line.
    single: Option<Arc<dyn Fft<f32>>>,
}

/// What transforms of one worker need meanwhile.
pub(super) struct FftScratch {
    cells: [Vec<f32>; 2],
    line: Vec<Complex32>,
    single: Vec<Complex32>,
}

struct Pass {
    radix: usize,
    /// Butterflies between which the turns differ, and how many there are of each.
    groups: usize,
    stride: usize,
    /// Turns of a group's butterflies but for its first sample, [group, sample].
    turns: Vec<Turn>,
    /// A turn in as many parts as the radix has samples.
    circle: [Turn; MOST_RADIX],
}

fn turn(parts: usize, of: usize) -> Turn {
    let (sine, cosine) = (-TAU * (parts % of) as f64 / of as f64).sin_cos();
    [cosine as f32, sine as f32]
}

impl LineFft {
    /// For lines of `length`, which is not 0.
    pub(super) fn new(length: usize) -> Self {
        assert!(length > 0, "a line has samples");
        let Some(radices) = radices(length) else {
            return Self { length, passes: Vec::new(), single: Some(f32::plan(length, FftDirection::Forward)) };
        };
        let mut stride = 1;
        let passes = radices.into_iter().map(|radix| {
            let rest = length / stride;
            let groups = rest / radix;
            let turns = (0..groups).flat_map(|group| (1..radix).map(move |sample| turn(group * sample, rest)));
            let circle = std::array::from_fn(|part| turn(part, radix));
            let pass = Pass { radix, groups, stride, turns: turns.collect(), circle };
            stride *= radix;
            pass
        });
        Self { length, passes: passes.collect(), single: None }
    }

    /// Room for transforms of this length on vectors of `lanes`.
    pub(super) fn scratch(&self, lanes: usize) -> FftScratch {
        let buffers = self.passes.len().saturating_sub(1);
        let cells = std::array::from_fn(|buffer| vec![0.0; if buffer < buffers { self.length * 2 * lanes } else { 0 }]);
        let (line, single) = match &self.single {
            Some(fft) => (self.length, fft.get_inplace_scratch_len()),
            None => (0, 0),
        };
        FftScratch { cells, line: vec![Complex32::ZERO; line], single: vec![Complex32::ZERO; single] }
    }

    /// Transforms the cells `from` to `to`, which have this length.
    #[inline(always)]
    pub(super) fn transform<S: Simd>(
        &self,
        simd: S,
        direction: Direction,
        from: &[f32],
        to: &mut [f32],
        scratch: &mut FftScratch,
    ) {
        assert!(from.len() == self.length * 2 * S::LANES);
        self.transform_squares(simd, direction, Squares { values: from, pitch: 2 * S::LANES * S::LANES }, to, scratch);
    }

    /// Whether it is passes that transform lines of this length.
    pub(super) fn has_passes(&self) -> bool {
        !self.passes.is_empty()
    }

    /// The same of cells in squares, which lie apart from one another only where it [has passes](Self::has_passes).
    #[inline(always)]
    pub(super) fn transform_squares<S: Simd>(
        &self,
        simd: S,
        direction: Direction,
        from: Squares<'_>,
        to: &mut [f32],
        scratch: &mut FftScratch,
    ) {
        assert!(to.len() == self.length * 2 * S::LANES);
        // Every caller with a copy of its own would take minutes to compile.
        simd.vectorise(Transform { fft: self, direction, from, to, scratch });
    }
}

struct Transform<'a> {
    fft: &'a LineFft,
    direction: Direction,
    from: Squares<'a>,
    to: &'a mut [f32],
    scratch: &'a mut FftScratch,
}

impl Task for Transform<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { fft, direction, from, to, scratch } = self;
        let beside = 2 * S::LANES * S::LANES;
        if let Some(single) = &fft.single {
            assert!(from.pitch == beside, "only passes take squares apart");
            return transform_each::<S>(&**single, direction, &from.values[..to.len()], to, scratch);
        }
        let [even, odd] = &mut scratch.cells;
        for (number, pass) in fft.passes.iter().enumerate() {
            let (before, after) = if number.is_multiple_of(2) { (&*odd, &mut *even) } else { (&*even, &mut *odd) };
            let source = if number == 0 { from } else { Squares { values: before, pitch: beside } };
            let target = if number + 1 == fft.passes.len() { &mut *to } else { after };
            pass.run(simd, direction, source, target);
        }
        if fft.passes.is_empty() {
            to.copy_from_slice(&from.values[..to.len()]);
        }
    }
}

/// Radices of as few passes as there can be, and as small as they can be; none where a prime factor is too large.
fn radices(length: usize) -> Option<Vec<usize>> {
    let mut best: Option<Vec<usize>> = None;
    let mut begun = vec![(length, Vec::new())];
    while let Some((rest, radices)) = begun.pop() {
        if rest == 1 {
            let cost = |radices: &Vec<usize>| (radices.len(), radices.iter().sum::<usize>());
            if best.as_ref().is_none_or(|best| cost(&radices) < cost(best)) {
                best = Some(radices);
            }
            continue;
        }
        let most = radices.last().copied().unwrap_or(MOST_RADIX);
        for radix in RADICES.into_iter().filter(|&radix| radix <= most && rest.is_multiple_of(radix)) {
            begun.push((rest / radix, [&radices[..], &[radix]].concat()));
        }
    }
    best
}

/// One lane after another.
fn transform_each<S: Simd>(
    fft: &dyn Fft<f32>,
    direction: Direction,
    from: &[f32],
    to: &mut [f32],
    scratch: &mut FftScratch,
) {
    let [re, im] = parts::<S>(direction);
    let FftScratch { line, single, .. } = scratch;
    for lane in 0..S::LANES {
        for (value, cell) in line.iter_mut().zip(from.chunks_exact(2 * S::LANES)) {
            *value = Complex32::new(cell[re + lane], cell[im + lane]);
        }
        fft.process_with_scratch(line, single);
        for (value, cell) in line.iter().zip(to.chunks_exact_mut(2 * S::LANES)) {
            (cell[re + lane], cell[im + lane]) = (value.re, value.im);
        }
    }
}

/// Where in a cell a transform finds real and imaginary parts: with both exchanged before and after it, the forward
/// transform is the inverse one.
#[inline(always)]
const fn parts<S: Simd>(direction: Direction) -> [usize; 2] {
    match direction {
        Direction::Forward => [0, S::LANES],
        Direction::Inverse => [S::LANES, 0],
    }
}

impl Pass {
    #[inline(always)]
    fn run<S: Simd>(&self, simd: S, direction: Direction, from: Squares<'_>, to: &mut [f32]) {
        match self.radix {
            2 => self.butterflies::<S, 2>(simd, direction, from, to),
            3 => self.butterflies::<S, 3>(simd, direction, from, to),
            4 => self.butterflies::<S, 4>(simd, direction, from, to),
            5 => self.butterflies::<S, 5>(simd, direction, from, to),
            6 => self.butterflies::<S, 6>(simd, direction, from, to),
            7 => self.butterflies::<S, 7>(simd, direction, from, to),
            8 => self.butterflies::<S, 8>(simd, direction, from, to),
            11 => self.butterflies::<S, 11>(simd, direction, from, to),
            13 => self.butterflies::<S, 13>(simd, direction, from, to),
            radix => unreachable!("no pass has radix {radix}"),
        }
    }

    #[inline(always)]
    fn butterflies<S: Simd, const R: usize>(&self, simd: S, direction: Direction, from: Squares<'_>, to: &mut [f32]) {
        let Self { groups, stride, turns, circle, .. } = self;
        let (groups, stride, cell) = (*groups, *stride, 2 * S::LANES);
        let [re, im] = parts::<S>(direction);
        let beside = S::LANES * cell;
        assert!(
            from.pitch == beside || (stride == 1 && from.pitch > beside),
            "only the first pass takes squares apart"
        );
        assert!(from.values.len() >= from.place::<S>(R * groups * stride - 1) + cell);
        assert!(to.len() == R * groups * stride * cell);
        assert!(turns.len() == groups * (R - 1));
        for group in 0..groups {
            let turns = &turns[group * (R - 1)..][..R - 1];
            let mut places = [0; R];
            for (index, place) in places.iter_mut().enumerate() {
                *place = from.place::<S>((index * groups + group) * stride);
            }
            for sample in 0..stride {
                // SAFETY: `from` has the cells below R·groups·stride, which are read, and `to` the same, which are
                // written: both as asserted above. Those of one index lie beside one another.
                unsafe {
                    let from = from.values.as_ptr().add(sample * cell);
                    let mut values = [[simd.splat(0.0); 2]; R];
                    for (value, place) in values.iter_mut().zip(places) {
                        let from = from.add(place);
                        *value = [simd.load(from.add(re)), simd.load(from.add(im))];
                    }
                    let values = dft::<S, R>(simd, values, circle, 1);
                    let to = to.as_mut_ptr().add((group * R * stride + sample) * cell);
                    for (index, value) in values.into_iter().enumerate() {
                        let value =
                            if group == 0 || index == 0 { value } else { turned(simd, value, turns[index - 1]) };
                        let to = to.add(index * stride * cell);
                        simd.store(to.add(re), value[0]);
                        simd.store(to.add(im), value[1]);
                    }
                }
            }
        }
    }
}

/// The forward transform of N cells; `circle` has N·`step` parts of a turn.
#[inline(always)]
fn dft<S: Simd, const N: usize>(simd: S, x: [Cell<S>; N], circle: &[Turn; MOST_RADIX], step: usize) -> [Cell<S>; N] {
    match N {
        2 => {
            let mut to = x;
            to[0] = sum(simd, x[0], x[1]);
            to[1] = difference(simd, x[0], x[1]);
            to
        }
        4 => {
            let (even, odd) = (sum(simd, x[0], x[2]), sum(simd, x[1], x[3]));
            let (even_apart, [re, im]) = (difference(simd, x[0], x[2]), difference(simd, x[1], x[3]));
            let mut to = x;
            to[0] = sum(simd, even, odd);
            to[1] = [simd.add(even_apart[0], im), simd.sub(even_apart[1], re)];
            to[2] = difference(simd, even, odd);
            to[3] = [simd.sub(even_apart[0], im), simd.add(even_apart[1], re)];
            to
        }
        6 => composite::<S, N, 3, 2>(simd, x, circle, step),
        8 => composite::<S, N, 2, 4>(simd, x, circle, step),
        _ => odd(simd, x, circle, step),
    }
}

/// Cooley and Tukey's (1965): B transforms of A cells, turns, and A transforms of B cells.
#[inline(always)]
fn composite<S: Simd, const N: usize, const A: usize, const B: usize>(
    simd: S,
    x: [Cell<S>; N],
    circle: &[Turn; MOST_RADIX],
    step: usize,
) -> [Cell<S>; N] {
    let zero = [simd.splat(0.0); 2];
    let mut columns = [[zero; B]; A];
    for b in 0..B {
        let mut column = [zero; A];
        for (a, value) in column.iter_mut().enumerate() {
            *value = x[B * a + b];
        }
        for (c, value) in dft::<S, A>(simd, column, circle, step * B).into_iter().enumerate() {
            columns[c][b] = if b * c == 0 { value } else { turned(simd, value, circle[b * c * step]) };
        }
    }
    let mut to = [zero; N];
    for (c, column) in columns.into_iter().enumerate() {
        for (d, value) in dft::<S, B>(simd, column, circle, step * A).into_iter().enumerate() {
            to[c + A * d] = value;
        }
    }
    to
}

/// An odd number of cells: those as far from the first one on both sides share their products.
#[inline(always)]
fn odd<S: Simd, const N: usize>(simd: S, x: [Cell<S>; N], circle: &[Turn; MOST_RADIX], step: usize) -> [Cell<S>; N] {
    let half = N / 2;
    let (mut sums, mut differences) = (x, x);
    let mut to = x;
    for k in 1..=half {
        sums[k] = sum(simd, x[k], x[N - k]);
        differences[k] = difference(simd, x[k], x[N - k]);
        to[0] = sum(simd, to[0], sums[k]);
    }
    for j in 1..=half {
        let (mut even, mut odd) = (x[0], [simd.splat(0.0); 2]);
        for k in 1..=half {
            let [cosine, sine] = circle[j * k % N * step];
            let (cosine, sine) = (simd.splat(cosine), simd.splat(sine));
            even = [simd.mul_add(sums[k][0], cosine, even[0]), simd.mul_add(sums[k][1], cosine, even[1])];
            odd = [simd.mul_add(differences[k][0], sine, odd[0]), simd.mul_add(differences[k][1], sine, odd[1])];
        }
        to[j] = [simd.sub(even[0], odd[1]), simd.add(even[1], odd[0])];
        to[N - j] = [simd.add(even[0], odd[1]), simd.sub(even[1], odd[0])];
    }
    to
}

#[inline(always)]
fn sum<S: Simd>(simd: S, a: Cell<S>, b: Cell<S>) -> Cell<S> {
    [simd.add(a[0], b[0]), simd.add(a[1], b[1])]
}

#[inline(always)]
fn difference<S: Simd>(simd: S, a: Cell<S>, b: Cell<S>) -> Cell<S> {
    [simd.sub(a[0], b[0]), simd.sub(a[1], b[1])]
}

#[inline(always)]
fn turned<S: Simd>(simd: S, [re, im]: Cell<S>, turn: Turn) -> Cell<S> {
    let (cosine, sine) = (simd.splat(turn[0]), simd.splat(turn[1]));
    [simd.neg_mul_add(im, sine, simd.mul(re, cosine)), simd.mul_add(im, cosine, simd.mul(re, sine))]
}

#[cfg(test)]
mod tests {
    use num_complex::Complex64;

    use super::*;
    use crate::simd::InstructionSet;
    use crate::worst::worst;

    /// One sample of one lane's line.
    fn sample(sample: usize, lane: usize) -> Complex64 {
        Complex64::cis(((16 * sample + lane) as f64 + 0.37).powf(1.7)) * (1.0 + (sample % 5) as f64)
    }

    /// The definition of the transform, term by term.
    fn direct_dft(length: usize, lane: usize) -> Vec<Complex64> {
        let turn = |part: usize| Complex64::cis(-TAU * (part % length) as f64 / length as f64);
        let bin = |bin| (0..length).map(|place| sample(place, lane) * turn(bin * place)).sum();
        (0..length).map(bin).collect()
    }

    #[test]
    fn every_lane_is_the_dft_of_its_line_and_comes_back() {
        const TOLERANCE: f64 = 2e-6;
        // Every radix alone and with others, and primes that none has.
        for length in (1..=64).chain([97, 106, 256, 540, 960, 2 * 11 * 13]) {
            for set in InstructionSet::available() {
                let (fft, lanes) = (LineFft::new(length), set.lanes());
                let mut scratch = fft.scratch(lanes);
                let mut from = vec![0.0; length * 2 * lanes];
                for (place, cell) in from.chunks_exact_mut(2 * lanes).enumerate() {
                    for lane in 0..lanes {
                        let value = sample(place, lane);
                        (cell[lane], cell[lanes + lane]) = (value.re as f32, value.im as f32);
                    }
                }
                let mut transformed = |direction, from: &[f32]| {
                    let mut to = vec![f32::NAN; from.len()];
                    let from = Squares { values: from, pitch: 2 * lanes * lanes };
                    set.run(Transform { fft: &fft, direction, from, to: &mut to, scratch: &mut scratch });
                    to
                };
                let mut spectrum = transformed(Direction::Forward, &from);
                let back = transformed(Direction::Inverse, &spectrum);

                let lane = length % lanes;
                let expected = direct_dft(length, lane);
                let at = |cells: &[f32], place: usize, lane: usize| {
                    let cell = &cells[place * 2 * lanes..];
                    Complex64::new(cell[lane].into(), cell[lanes + lane].into())
                };
                let scale = (length as f64).sqrt() * 3.3;
                let error = |cells: &[f32]| {
                    let differences = expected.iter().enumerate().map(|(bin, value)| at(cells, bin, lane) - value);
                    worst(differences.map(|difference| difference.norm() / scale))
                };
                let context = format!("{length} on {}", set.name());
                assert!(error(&spectrum) < TOLERANCE, "{context}: {}", error(&spectrum));
                let returned = worst((0..length * lanes).map(|index| {
                    let (place, lane) = (index / lanes, index % lanes);
                    (at(&back, place, lane) / length as f64 - sample(place, lane)).norm()
                }));
                assert!(returned < 1e-5, "{context}: {returned}");
                spectrum[length / 2 * 2 * lanes + lane] += (2.0 * TOLERANCE * scale) as f32;
                assert!(error(&spectrum) > TOLERANCE, "{context}: the comparison is blind");
            }
        }
    }
}

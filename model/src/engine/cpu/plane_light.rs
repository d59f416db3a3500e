//! Light on planes of the depth volume, and how it goes between them and the SLM plane.

use holod_calibration::{Colour, DisplayGeometry, Metres, Resolution};

use super::column_blocks::{ColumnBlocks, load, store};
use super::input_features::sample_pitch;
use super::plane_fft::{Columns, PlaneFft, Rows};
use super::pupil_stop::PupilStop;
use crate::optics::transfer_table;
use crate::simd::{InstructionSet, Simd, Task};

/// Planes equally far apart, which is equal in dioptres, too.
#[derive(Clone, Copy)]
pub(super) struct PlanePositions {
    pub(super) count: usize,
    /// Where the farthest is imaged, from the SLM plane.
    pub(super) farthest: Metres,
    /// From one to the next nearer one.
    pub(super) step: Metres,
}

impl PlanePositions {
    /// The middles of `count` layers into which the depth volume of `bench` is divided.
    pub(super) fn of_layers(count: usize, bench: &DisplayGeometry) -> Self {
        let far_m = bench.image_distance(bench.depth_far).0;
        let step_m = (bench.image_distance(bench.depth_near).0 - far_m) / count as f64;
        Self { count, farthest: Metres(far_m + step_m / 2.0), step: Metres(step_m) }
    }

    /// `count` planes, of which the first and the last are the ends of the depth volume of `bench`.
    pub(super) fn from_end_to_end(count: usize, bench: &DisplayGeometry) -> Self {
        let farthest = bench.image_distance(bench.depth_far);
        let step_m = (bench.image_distance(bench.depth_near).0 - farthest.0) / (count - 1) as f64;
        Self { count, farthest, step: Metres(step_m) }
    }
}

/// Light of planes far to near, carried by ASM on the half-band grid. Nothing is allocated after `new`.
///
/// Spectra and transfer functions lie as [`PlaneFft::room_for_spectra`] has them, a plane for each colour.
pub(super) struct PlaneLight {
    pub(super) count: usize,
    pub(super) set: InstructionSet,
    pub(super) fft: PlaneFft,
    /// What is between the halves of its transforms.
    pub(super) between: Vec<f32>,
    /// From one plane to the next nearer one.
    step: Vec<f32>,
    /// From the nearest plane to the SLM plane, over the number of samples.
    back: Vec<f32>,
    /// The light of the planes so far.
    sum: Vec<f32>,
    /// Three colours: what arrives at the SLM plane.
    pub(super) carried: ColumnBlocks,
}

impl PlaneLight {
    pub(super) fn new(
        positions: PlanePositions,
        bench: &DisplayGeometry,
        size: Resolution,
        set: InstructionSet,
    ) -> Self {
        let PlanePositions { count, farthest, step } = positions;
        let nearest_m = farthest.0 + (count - 1) as f64 * step.0;
        let mut step = transfer(bench, size, step, set);
        step.iter_mut().for_each(|value| *value *= size.pixels() as f32);
        let fft = PlaneFft::new(Colour::ALL.len(), size, set);
        Self {
            count,
            set,
            step,
            back: transfer(bench, size, Metres(-nearest_m), set),
            sum: fft.room_for_spectra(),
            between: vec![0.0; fft.room_between()],
            fft,
            carried: ColumnBlocks::of_cells(Colour::ALL.len(), size, set),
        }
    }

    /// Adds the light that plane `number` has sent to that of farther ones: Horner's rule, far to near.
    pub(super) fn add(&mut self, number: usize) {
        let Self { set, fft, between, step, sum, .. } = self;
        let blocks = sum.chunks_exact_mut(fft.spectra_len()).zip(step.chunks_exact(fft.spectra_len()));
        fft.for_rows(between, blocks, |rows, (sum, step)| set.run(Add { rows, sum, step, is_first: number == 0 }));
    }

    /// Sends what arrives at the SLM plane of the light of all planes, through a pupil or past it.
    pub(super) fn bring_back(&mut self, pupil: Option<&PupilStop>) {
        let Self { set, fft, between, sum, back, .. } = self;
        let blocks = sum.chunks_exact(fft.spectra_len()).zip(back.chunks_exact(fft.spectra_len())).enumerate();
        fft.for_rows(between, blocks, |rows, (block, (sum, back))| {
            set.run(BringBack { rows, sum, back, pupil, block })
        });
    }

    /// Sends light that has left the SLM plane to the farthest plane through a pupil: `transfer` is the transfer
    /// function to there, and `reaching` becomes what reaches the next nearer plane.
    pub(super) fn send_to_farthest(&mut self, transfer: &[f32], pupil: &PupilStop, reaching: &mut [f32]) {
        let Self { set, fft, between, step, .. } = self;
        let len = fft.spectra_len();
        let tables = transfer.chunks_exact(len).zip(step.chunks_exact(len));
        let blocks = reaching.chunks_exact_mut(len).zip(tables).enumerate();
        fft.for_rows(between, blocks, |rows, (block, (reaching, (transfer, step)))| {
            set.run(SendToFarthest { rows, transfer, pupil, block, reaching, step });
        });
    }

    /// Sends `reaching` to a plane, and makes of it what reaches the next nearer one.
    pub(super) fn send_to_next(&mut self, reaching: &mut [f32]) {
        let Self { set, fft, between, step, .. } = self;
        let blocks = reaching.chunks_exact_mut(fft.spectra_len()).zip(step.chunks_exact(fft.spectra_len()));
        fft.for_rows(between, blocks, |rows, (reaching, step)| set.run(SendToNext { rows, reaching, step }));
    }

    /// Takes what has arrived at the SLM plane as the field.
    pub(super) fn keep(&mut self) {
        let Self { set, fft, between, carried, .. } = self;
        fft.for_columns(between, carried.blocks_mut(), |columns, carried| set.run(Keep { columns, carried }));
    }
}

/// The transfer functions of all colours over the distance `u`, over the number of samples.
pub(super) fn transfer(bench: &DisplayGeometry, size: Resolution, u: Metres, set: InstructionSet) -> Vec<f32> {
    let Resolution { width, height } = size;
    let lanes = set.lanes();
    let tables = Colour::ALL.map(|colour| transfer_table(bench.wavelengths[colour], sample_pitch(bench), size, u));
    let mut spectra = vec![0.0; height.div_ceil(lanes) * tables.len() * width * 2 * lanes];
    for (number, cell) in spectra.chunks_exact_mut(2 * lanes).enumerate() {
        let (first, table, column) =
            (number / (tables.len() * width) * lanes, &tables[number / width % tables.len()], number % width);
        for (lane, value) in table[column * height..][..height].iter().skip(first).take(lanes).enumerate() {
            (cell[lane], cell[lanes + lane]) = (value.re, value.im);
        }
    }
    spectra
}

#[inline(always)]
fn product<S: Simd>(simd: S, [a_re, a_im]: [S::Vector; 2], [b_re, b_im]: [S::Vector; 2]) -> [S::Vector; 2] {
    [simd.neg_mul_add(a_im, b_im, simd.mul(a_re, b_re)), simd.mul_add(a_im, b_re, simd.mul(a_re, b_im))]
}

struct Add<'a> {
    rows: Rows<'a>,
    sum: &'a mut [f32],
    step: &'a [f32],
    is_first: bool,
}

impl Task for Add<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { mut rows, sum, step, is_first } = self;
        for colour in Colour::ALL {
            let arriving = rows.arrive(simd, colour.index());
            let plane = colour.index() * arriving.len()..(colour.index() + 1) * arriving.len();
            let (sum, step) = (&mut sum[plane.clone()], &step[plane]);
            if is_first {
                sum.copy_from_slice(arriving);
                continue;
            }
            let cells = sum.chunks_exact_mut(2 * S::LANES).zip(step.chunks_exact(2 * S::LANES));
            for ((sum, step), arriving) in cells.zip(arriving.chunks_exact(2 * S::LANES)) {
                let ([sum_re, sum_im], [step_re, step_im]) = (load(simd, sum), load(simd, step));
                let [re, im] = load(simd, arriving);
                let re = simd.neg_mul_add(sum_im, step_im, simd.mul_add(sum_re, step_re, re));
                let im = simd.mul_add(sum_im, step_re, simd.mul_add(sum_re, step_im, im));
                store(simd, sum, [re, im]);
            }
        }
    }
}

struct BringBack<'a> {
    rows: Rows<'a>,
    sum: &'a [f32],
    back: &'a [f32],
    pupil: Option<&'a PupilStop>,
    block: usize,
}

impl Task for BringBack<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { mut rows, sum, back, pupil, block } = self;
        for colour in Colour::ALL {
            let cells = rows.cells(colour.index());
            let plane = colour.index() * cells.len()..(colour.index() + 1) * cells.len();
            multiply(simd, &sum[plane.clone()], &back[plane], cells);
            if let Some(pupil) = pupil {
                pupil.stop::<S>(colour, block, cells);
            }
            rows.send(simd, colour.index());
        }
    }
}

struct SendToFarthest<'a> {
    rows: Rows<'a>,
    transfer: &'a [f32],
    pupil: &'a PupilStop,
    block: usize,
    reaching: &'a mut [f32],
    step: &'a [f32],
}

impl Task for SendToFarthest<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { mut rows, transfer, pupil, block, reaching, step } = self;
        for colour in Colour::ALL {
            let cells = rows.arrive(simd, colour.index());
            let plane = colour.index() * cells.len()..(colour.index() + 1) * cells.len();
            let reaching = &mut reaching[plane.clone()];
            multiply(simd, cells, &transfer[plane.clone()], reaching);
            pupil.stop::<S>(colour, block, reaching);
            cells.copy_from_slice(reaching);
            multiply(simd, cells, &step[plane], reaching);
            rows.send(simd, colour.index());
        }
    }
}

struct SendToNext<'a> {
    rows: Rows<'a>,
    reaching: &'a mut [f32],
    step: &'a [f32],
}

impl Task for SendToNext<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { mut rows, reaching, step } = self;
        for colour in Colour::ALL {
            let cells = rows.cells(colour.index());
            let plane = colour.index() * cells.len()..(colour.index() + 1) * cells.len();
            let reaching = &mut reaching[plane.clone()];
            cells.copy_from_slice(reaching);
            multiply(simd, cells, &step[plane], reaching);
            rows.send(simd, colour.index());
        }
    }
}

/// Writes the products of the cells of `a` and `b` to `to`.
#[inline(always)]
fn multiply<S: Simd>(simd: S, a: &[f32], b: &[f32], to: &mut [f32]) {
    let factors = a.chunks_exact(2 * S::LANES).zip(b.chunks_exact(2 * S::LANES));
    for ((a, b), to) in factors.zip(to.chunks_exact_mut(2 * S::LANES)) {
        store(simd, to, product(simd, load(simd, a), load(simd, b)));
    }
}

struct Keep<'a> {
    columns: Columns<'a>,
    carried: &'a mut [f32],
}

impl Task for Keep<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { mut columns, carried } = self;
        let plane_len = carried.len() / Colour::ALL.len();
        for (colour, carried) in carried.chunks_exact_mut(plane_len).enumerate() {
            carried.copy_from_slice(columns.arrive(simd, colour));
        }
    }
}

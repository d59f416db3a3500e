//! What an eye lacks when it focuses on each plane, fed back to the field at the SLM plane.

use holod_calibration::{Colour, DisplayGeometry, Resolution};

use super::column_blocks::{ColumnBlocks, load, store};
use super::plane_fft::Columns;
use super::plane_light::{PlaneLight, PlanePositions, transfer};
use super::pupil_stop::PupilStop;
use super::view::View;
use crate::engine::constants::FEEDBACK_DARK_POWER;
use crate::simd::{InstructionSet, Simd, Task};
use crate::weights::Feedback;

/// One step of Gerchberg and Saxton (1972) at all planes at once: the field goes through the pupil to every plane,
/// takes the wanted amplitude there with the phase that it has, and the mean of these changes comes back, each with its
/// weight. The planes change one another too; the second net mends that. Nothing is allocated after `new`.
pub(super) struct PlaneFeedback {
    feedback: Feedback,
    pupil: PupilStop,
    /// From the SLM plane to the farthest plane, as spectra of [`PlaneLight`] lie.
    to_farthest: Vec<f32>,
    /// The spectrum of what reaches the next plane.
    reaching: Vec<f32>,
    /// Three colours: the change of the field that would give what is lacking.
    pub(super) change: ColumnBlocks,
}

impl PlaneFeedback {
    pub(super) fn new(
        feedback: Feedback,
        positions: PlanePositions,
        bench: &DisplayGeometry,
        size: Resolution,
        set: InstructionSet,
    ) -> Self {
        let to_farthest = transfer(bench, size, positions.farthest, set);
        Self {
            feedback,
            pupil: PupilStop::new(bench, size, set),
            reaching: vec![0.0; to_farthest.len()],
            to_farthest,
            change: ColumnBlocks::of_cells(Colour::ALL.len(), size, set),
        }
    }

    /// Changes the field that `light` carried by what it lacks of the amplitudes `stack`, three colours of each plane,
    /// which become that lack.
    pub(super) fn run(&mut self, light: &mut PlaneLight, stack: &mut ColumnBlocks, view: &impl View, pupil_mm: f32) {
        let Self { feedback: Feedback { share, sharpness }, pupil, to_farthest, reaching, change } = self;
        let (set, share, sharpness) = (light.set, *share, *sharpness);
        pupil.set_mm(pupil_mm);
        let fields = light.carried.blocks();
        light.fft.for_columns(&mut light.between, fields, |columns, field| set.run(Leave { columns, field }));
        for plane in 0..light.count {
            if plane == 0 {
                light.send_to_farthest(to_farthest, pupil, reaching);
            } else {
                light.send_to_next(reaching);
            }
            light.fft.for_columns(&mut light.between, stack.blocks_mut().enumerate(), |columns, (block, stack)| {
                set.run(Compare { columns, stack, plane, block, view, sharpness });
            });
            light.add(plane);
        }
        light.bring_back(Some(pupil));
        let per_plane = 1.0 / light.count as f32;
        let blocks = light.carried.blocks_mut().zip(change.blocks_mut());
        light.fft.for_columns(&mut light.between, blocks, |columns, (field, change)| {
            set.run(Change { columns, field, change, per_plane, share });
        });
    }
}

/// Light leaves the SLM plane.
struct Leave<'a> {
    columns: Columns<'a>,
    field: &'a [f32],
}

impl Task for Leave<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { mut columns, field } = self;
        for (colour, field) in field.chunks_exact(field.len() / Colour::ALL.len()).enumerate() {
            columns.cells(colour).copy_from_slice(field);
            columns.send(simd, colour);
        }
    }
}

/// What arrives at a plane becomes the change that it should have there, which is sent back.
struct Compare<'a, V> {
    columns: Columns<'a>,
    /// Three colours of each plane.
    stack: &'a mut [f32],
    plane: usize,
    block: usize,
    view: &'a V,
    sharpness: f32,
}

impl<V: View> Task for Compare<'_, V> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { mut columns, stack, plane, block, view, sharpness } = self;
        for colour in Colour::ALL {
            columns.arrive(simd, colour.index());
        }
        let cells = columns.all_cells();
        let len = cells.len() / Colour::ALL.len();
        let lacks = &mut stack[plane * cells.len() / 2..][..cells.len() / 2];
        for y in 0..len / (2 * S::LANES) {
            let share = view.share_in_focus(simd, plane, block, y);
            let weight = simd.mul_add(simd.splat(sharpness), share, simd.splat(1.0));
            for colour in 0..Colour::ALL.len() {
                let cell = &mut cells[colour * len + y * 2 * S::LANES..];
                let wanted = &mut lacks[(colour * len / 2) + y * S::LANES..];
                let [re, im] = load(simd, cell);
                let power = simd.mul_add(re, re, simd.mul_add(im, im, simd.splat(FEEDBACK_DARK_POWER)));
                let amplitude = simd.sqrt(power);
                let lack = simd.sub(simd.read(wanted), amplitude);
                simd.write(wanted, lack);
                let change = simd.div(simd.mul(weight, lack), amplitude);
                store(simd, cell, [simd.mul(re, change), simd.mul(im, change)]);
            }
        }
        for colour in Colour::ALL {
            columns.send(simd, colour.index());
        }
    }
}

/// The field takes its share of the mean change.
struct Change<'a> {
    columns: Columns<'a>,
    field: &'a mut [f32],
    change: &'a mut [f32],
    /// One over the number of planes.
    per_plane: f32,
    share: f32,
}

impl Task for Change<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { mut columns, field, change, per_plane, share } = self;
        let len = field.len() / Colour::ALL.len();
        for (colour, (field, change)) in field.chunks_exact_mut(len).zip(change.chunks_exact_mut(len)).enumerate() {
            let sums = columns.arrive(simd, colour);
            for ((field, change), sum) in field.iter_mut().zip(change).zip(sums) {
                *change = *sum * per_plane;
                *field += *change * share;
            }
        }
    }
}

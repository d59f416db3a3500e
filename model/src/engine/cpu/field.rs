//! The last stage: the field on the panel's pixels.

use holod_calibration::{Colour, Resolution};
use num_complex::Complex32;

use super::blocks::{grid_size, scale_of};
use super::feature_map::FeatureMap;
use super::stage::{Buffers, Job, MapId, Shared, Stage, plane_bytes};
use crate::optics::FourierUpsampler;
use crate::weights::{Grid, OUTPUT_CHANNELS};

/// The field on the network's grid that the last net corrects.
pub(super) trait UncorrectedField: Shared {
    /// Planes of real numbers that it is kept in.
    const PLANES: usize;

    /// Writes one colour of it with the last net's output `residual` to `field` [height, width].
    fn write_corrected(&self, residual: &FeatureMap, colour: Colour, field: &mut [Complex32]);
}

/// Corrects the field, and upsamples it on the half-band grid.
pub(super) struct Field {
    residual: MapId,
    size: Resolution,
    /// The panel's size, and that rounded up to what the grid needs.
    resolution: Resolution,
    padded: Resolution,
    upsampler: Option<FourierUpsampler>,
    /// One colour at `padded`, where that differs from `resolution`.
    uncropped: Vec<Complex32>,
}

impl Field {
    pub(super) fn new(grid: Grid, resolution: Resolution, residual: MapId) -> Self {
        let (scale, size) = (scale_of(grid), grid_size(grid, resolution));
        let padded = Resolution { width: scale * size.width, height: scale * size.height };
        Self {
            residual,
            size,
            resolution,
            padded,
            upsampler: (grid == Grid::HalfBand).then(|| FourierUpsampler::new(padded)),
            uncropped: if padded == resolution { Vec::new() } else { vec![Complex32::ZERO; padded.pixels()] },
        }
    }
}

impl<F: UncorrectedField> Stage<F> for Field {
    fn name(&self) -> &str {
        "field"
    }

    fn bytes(&self) -> u64 {
        let Self { size, resolution, .. } = self;
        plane_bytes(F::PLANES + OUTPUT_CHANNELS, *size) + plane_bytes(OUTPUT_CHANNELS, *resolution)
    }

    fn run(&mut self, Buffers { maps, family }: &mut Buffers<F>, job: &mut Job<'_, F::Input>) {
        let Self { residual, resolution, padded, upsampler, uncropped, .. } = self;
        let residual = &maps[*residual];
        for colour in Colour::ALL {
            let plane = job.hologram.plane_mut(colour);
            let Some(upsampler) = upsampler else {
                family.write_corrected(residual, colour, plane);
                continue;
            };
            family.write_corrected(residual, colour, upsampler.input());
            if padded == resolution {
                upsampler.upsample(plane);
                continue;
            }
            upsampler.upsample(uncropped);
            let cropped_rows = uncropped.chunks_exact(padded.width);
            for (row, from) in plane.chunks_exact_mut(resolution.width).zip(cropped_rows) {
                row.copy_from_slice(&from[..resolution.width]);
            }
        }
    }

    #[cfg(test)]
    fn seen<'a>(&'a self, _: &'a Buffers<F>, job: &'a Job<'_, F::Input>) -> super::stage::Seen<'a> {
        super::stage::Seen::Light(job.hologram.field[..].into())
    }
}

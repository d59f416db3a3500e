//! The network on the CPU: channels-last maps, rayon over rows, SIMD chosen at run time.

mod blocks;
mod conv;
mod defocus;
mod deformable;
mod depth_layers;
mod direct;
mod expected_stack;
mod feature_map;
mod feedback;
mod layered;
mod maps;
mod network;
mod peak;
mod product;
#[cfg(test)]
mod tests;
mod trunk;

use holod_calibration::{PupilDiameter, Resolution};

use self::network::Network;
use crate::engine::{EngineError, StageTimings};
use crate::resident::Resident;
use crate::simd::InstructionSet;
use crate::{ComplexHologram, RgbdFrame, Weights};

pub use peak::fma_peak;

/// The network on the CPU, for frames of one size, with a thread pool of its own.
pub struct CpuEngine {
    resident: Resident<Job>,
    resolution: Resolution,
    set: InstructionSet,
    timings: StageTimings,
}

struct Job {
    frame: RgbdFrame,
    pupil: PupilDiameter,
    hologram: ComplexHologram,
    network: Network,
}

impl CpuEngine {
    /// An engine for frames of `resolution`, which may be odd, with `threads` threads, 0 for as many as there are cores.
    pub fn new(weights: &Weights, resolution: Resolution, threads: usize) -> Result<Self, EngineError> {
        Self::with_instructions(weights, resolution, threads, InstructionSet::best())
    }

    fn with_instructions(
        weights: &Weights,
        resolution: Resolution,
        threads: usize,
        set: InstructionSet,
    ) -> Result<Self, EngineError> {
        if resolution.pixels() == 0 {
            return Err(EngineError::Empty { resolution });
        }
        let network = Network::new(weights, resolution, set);
        let timings = network.timings.clone();
        let job = Job {
            frame: RgbdFrame {
                resolution,
                amplitude: vec![0.0; 3 * resolution.pixels()],
                depth_normalised: vec![0.0; resolution.pixels()],
            },
            pupil: PupilDiameter::from_mm(weights.config().pupil_range_mm[0]),
            hologram: ComplexHologram::dark(resolution),
            network,
        };
        let resident = Resident::new("holod-cpu", threads, job, |Job { frame, pupil, hologram, network }| {
            network.render(frame, *pupil, hologram);
        })
        .map_err(|error| EngineError::Threads { threads, detail: error.to_string() })?;
        Ok(Self { resident, resolution, set, timings })
    }

    /// Writes the hologram of `frame` for an eye with `pupil` to `hologram`. Does not allocate.
    ///
    /// A pupil outside the range that the weights were trained for is taken as the nearest one inside.
    pub fn render(
        &mut self,
        frame: &RgbdFrame,
        pupil: PupilDiameter,
        hologram: &mut ComplexHologram,
    ) -> Result<(), EngineError> {
        for (what, found) in [("the frame", frame.resolution), ("the hologram", hologram.resolution)] {
            if found != self.resolution {
                return Err(EngineError::Resolution { what, found, expected: self.resolution });
            }
        }
        if !(pupil.mm() > 0.0 && pupil.mm().is_finite()) {
            return Err(EngineError::Pupil { pupil_mm: pupil.mm() });
        }
        let timings = &mut self.timings;
        self.resident.run(
            |job| {
                job.frame.amplitude.copy_from_slice(&frame.amplitude);
                job.frame.depth_normalised.copy_from_slice(&frame.depth_normalised);
                job.pupil = pupil;
            },
            |job| {
                // The old content, swapped in, is overwritten by the next frame.
                std::mem::swap(&mut hologram.field, &mut job.hologram.field);
                for (ours, theirs) in timings.stages.iter_mut().zip(&job.network.timings.stages) {
                    ours.duration = theirs.duration;
                }
            },
        );
        Ok(())
    }

    /// Where the time of the last frame went.
    pub fn last_timings(&self) -> &StageTimings {
        &self.timings
    }

    /// Threads that work on a frame.
    pub fn threads(&self) -> usize {
        self.resident.threads()
    }

    /// Which instruction set the kernels use: `avx512`, `avx2` or `portable`.
    pub fn instruction_set(&self) -> &'static str {
        self.set.name()
    }
}

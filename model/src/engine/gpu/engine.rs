//! A plan on a device, frame after frame.

use std::sync::Arc;
use std::time::Duration;

use half::f16;
use holod_calibration::{DisplayGeometry, LevelTables, PupilDiameter};
use num_complex::Complex32;
use wgpu::{BufferUsages, QuerySet};

use super::conv::Method;
use super::fft::WorkgroupLimits;
use super::loaded_plan::LoadedPlan;
use super::map::Format;
use super::network::NetworkPlan;
use super::plan::{Plan, Stage};
use super::shared::pupil_values;
use super::trunk::Features;
use crate::engine::{EngineError, Precision, StageTiming, StageTimings, check_pupil};
use crate::gpu::{Gpu, GpuChoice, GpuError, MatrixUnits, first_that_opens};
use crate::{ComplexHologram, PhasePattern, RgbdFrame, Weights};

/// Network, double phase and levels on the GPU, for frames of one size and one panel.
pub struct GpuEngine {
    gpu: Gpu,
    network: NetworkPlan,
    loaded: LoadedPlan,
    format: Format,
    /// Why it multiplies no matrices though that was tried.
    refused_matrices: Option<GpuError>,
    timestamps: Option<Timestamps>,
    timings: StageTimings,
    readback: Readback,
    /// The frame that the device has.
    uploaded: Option<Arc<RgbdFrame>>,
    /// The pupil that it has, and that its weights are modulated for.
    pupil: Option<PupilDiameter>,
}

/// What was lost between hologram and levels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct EncodedCounts {
    /// Of each colour, samples of the hologram whose amplitude exceeded the double phase's constant.
    pub clipped: [u32; 3],
    /// Of each colour, pixels whose phase the panel cannot reach.
    pub unreachable: [u32; 3],
}

/// When each stage began and ended, on the device.
struct Timestamps {
    queries: QuerySet,
    resolved: wgpu::Buffer,
    tick_ns: f32,
}

/// What comes back to the host with each frame: timestamps, counts and samples, one after the other.
struct Readback {
    staging: wgpu::Buffer,
    timestamps_bytes: u64,
    samples_bytes: u64,
}

/// Bytes of the counts.
const COUNTS_BYTES: u64 = 24;
const TIMESTAMP_BYTES: u64 = 8;

impl GpuEngine {
    /// An engine for frames of the pattern's size of `tables`, which may be odd, on the optics of `bench`, whose own
    /// resolution does not matter; on the best device of `choice` that has room for it. Features are in
    /// `precision` where the device has it; where that is left to the device, in half precision if it multiplies
    /// matrices so, since it sums up in single, and else in single precision.
    ///
    /// # Errors
    /// There is no device, all lack what the network needs at this size, or the size is nothing; of several devices it
    /// is why the best one will not do.
    pub fn open(
        weights: &Weights,
        bench: &DisplayGeometry,
        tables: &LevelTables,
        choice: GpuChoice<'_>,
        precision: Option<Precision>,
    ) -> Result<Self, EngineError> {
        first_that_opens(&Gpu::candidates(choice)?, |adapter| {
            let open = |wanted: &dyn Fn(MatrixUnits) -> bool| {
                Self::on(Gpu::on(adapter, wanted)?, weights, bench, tables, precision)
            };
            let channels = weights.config().channels;
            match precision {
                Some(Precision::Single) => open(&|_| false),
                Some(Precision::Half) => open(&|units| units.suit(channels)),
                None => {
                    let known = |units: MatrixUnits| units.have_run() && units.suit(channels);
                    let (engine, refused_matrices) =
                        without_matrices_if_need_be(|matrices| open(&|units| matrices && known(units)))?;
                    Ok(Self { refused_matrices, ..engine })
                }
            }
        })
    }

    pub(super) fn on(
        gpu: Gpu,
        weights: &Weights,
        bench: &DisplayGeometry,
        tables: &LevelTables,
        precision: Option<Precision>,
    ) -> Result<Self, EngineError> {
        let precision = match precision {
            Some(precision) if gpu.half_precision => precision,
            None if gpu.matrix_units.is_some() => Precision::Half,
            _ => Precision::Single,
        };
        let limits = WorkgroupLimits { bytes: gpu.workgroup_bytes, threads: gpu.workgroup_threads };
        let format = Format::of(precision, gpu.matrix_units);
        let features = Features { format, method: Method::of_vendor(gpu.vendor) };
        let mut network = NetworkPlan::new(weights, bench, tables, features, limits)?;
        let plan = &network.plan;
        let loaded = LoadedPlan::new(&gpu, plan)?;
        let timestamps = match gpu.timestamp_ns {
            Some(tick_ns) => Some(Timestamps::new(&gpu, plan.stages.len(), tick_ns)?),
            None => None,
        };
        let samples_bytes = loaded.buffer(network.samples).size();
        let timestamps_bytes = timestamps.as_ref().map_or(0, |timestamps| timestamps.resolved.size());
        let staging = gpu.buffer(
            "what comes back",
            timestamps_bytes + COUNTS_BYTES + samples_bytes,
            BufferUsages::MAP_READ | BufferUsages::COPY_DST,
        )?;
        let timing = |stage: &Stage| StageTiming {
            name: stage.name.clone(),
            duration: Duration::ZERO,
            flop: stage.flop,
            bytes: 0,
        };
        let timings = StageTimings { stages: plan.stages.iter().map(timing).collect() };
        // What the tables hold is on the device now.
        network.plan = Plan::default();
        Ok(Self {
            timings,
            readback: Readback { staging, timestamps_bytes, samples_bytes },
            gpu,
            network,
            loaded,
            format,
            refused_matrices: None,
            timestamps,
            uploaded: None,
            pupil: None,
        })
    }

    /// The device's name, as its driver has it.
    pub fn device(&self) -> &str {
        self.gpu.name()
    }

    /// From now on the device counts as hung ([`GpuError::Hung`]) where a frame, or what is read back, takes longer
    /// than `patience`; at first that is two minutes.
    pub fn hangs_after(&mut self, patience: Duration) {
        self.gpu.patience = patience;
    }

    /// What its features are.
    pub fn precision(&self) -> Precision {
        self.format.precision()
    }

    /// Whether layers multiply on units of the device that multiply matrices.
    pub fn uses_matrix_units(&self) -> bool {
        matches!(self.format, Format::HalfTiles(_))
    }

    /// Why it does without such units, where the device failed with them.
    pub fn refused_matrices(&self) -> Option<&GpuError> {
        self.refused_matrices.as_ref()
    }

    /// Writes the samples of the hologram of `frame` for an eye with `pupil` to `samples`, as the panel takes them.
    ///
    /// Of a pupil beyond those that the weights were trained for, the network is told the nearest; blur and stop are
    /// its own. The frame is sent to the device once, however often it is rendered.
    ///
    /// # Errors
    /// [`EngineError`] for a frame of another size than the engine's, a pupil that is none, and a device
    /// that fails; that engine will not render again.
    ///
    /// # Panics
    /// Where `samples` is not of the panel's size.
    pub fn render(
        &mut self,
        frame: &Arc<RgbdFrame>,
        pupil: PupilDiameter,
        samples: &mut [u16],
    ) -> Result<EncodedCounts, EngineError> {
        let expected = self.network.shared.resolution;
        if frame.resolution != expected {
            return Err(EngineError::Resolution { what: "the frame", found: frame.resolution, expected });
        }
        check_pupil(pupil)?;
        self.send(frame, pupil);
        let submission = self.submit();
        Ok(self.receive(submission, samples)?)
    }

    /// Sends what has changed since the last frame.
    fn send(&mut self, frame: &Arc<RgbdFrame>, pupil: PupilDiameter) {
        let Self { gpu, network, loaded, uploaded, .. } = self;
        if uploaded.as_ref().is_none_or(|uploaded| !Arc::ptr_eq(uploaded, frame)) {
            let on_device = loaded.buffer(network.shared.frame);
            let amplitude: &[u8] = bytemuck::cast_slice(&frame.amplitude);
            gpu.queue.write_buffer(on_device, 0, amplitude);
            gpu.queue.write_buffer(on_device, amplitude.len() as u64, bytemuck::cast_slice(&frame.depth_normalised));
            *uploaded = Some(Arc::clone(frame));
        }
        if self.pupil != Some(pupil) {
            let conditions = network.conditions(pupil);
            let values = pupil_values(pupil, conditions);
            gpu.queue.write_buffer(loaded.buffer(network.shared.pupil), 0, bytemuck::bytes_of(&values));
            for modulated in &mut network.modulated {
                let buffer = loaded.buffer(modulated.buffer);
                if let Some(parameters) = modulated.change_to(conditions) {
                    gpu.queue.write_buffer(buffer, 0, parameters);
                }
            }
            self.pupil = Some(pupil);
        }
    }

    /// Hands one frame's work to the device.
    fn submit(&mut self) -> wgpu::SubmissionIndex {
        let Self { gpu, network, loaded, timestamps, timings, readback, .. } = self;
        let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        let [clipped, unreachable] = [network.clipped, network.unreachable].map(|id| loaded.buffer(id));
        encoder.clear_buffer(clipped, 0, None);
        encoder.clear_buffer(unreachable, 0, None);
        loaded.encode(&mut encoder, |stage| timestamps.as_ref().map(|timestamps| timestamps.of_stage(stage)));
        let Readback { staging, timestamps_bytes, samples_bytes } = readback;
        if let Some(Timestamps { queries, resolved, .. }) = timestamps {
            encoder.resolve_query_set(queries, 0..2 * timings.stages.len() as u32, resolved, 0);
            encoder.copy_buffer_to_buffer(resolved, 0, staging, 0, *timestamps_bytes);
        }
        encoder.copy_buffer_to_buffer(clipped, 0, staging, *timestamps_bytes, 12);
        encoder.copy_buffer_to_buffer(unreachable, 0, staging, *timestamps_bytes + 12, 12);
        let place = *timestamps_bytes + COUNTS_BYTES;
        encoder.copy_buffer_to_buffer(loaded.buffer(network.samples), 0, staging, place, *samples_bytes);
        gpu.queue.submit([encoder.finish()])
    }

    /// Waits for a frame, and takes what it has written.
    fn receive(&mut self, submission: wgpu::SubmissionIndex, samples: &mut [u16]) -> Result<EncodedCounts, GpuError> {
        let Self { gpu, timestamps, timings, readback: Readback { staging, timestamps_bytes, .. }, .. } = self;
        // Whether it can be read is asked below.
        staging.map_async(wgpu::MapMode::Read, .., |_| ());
        gpu.wait(submission)?;
        let view = staging.get_mapped_range(..).map_err(|error| gpu.failed(error))?;
        let (ticks, rest) = view.split_at(*timestamps_bytes as usize);
        let (counts, written) = rest.split_at(COUNTS_BYTES as usize);
        // Of an odd number of samples the last word holds one only.
        let written: &[u16] = bytemuck::cast_slice(written);
        assert_eq!(samples.len().next_multiple_of(2), written.len(), "the samples of one panel");
        samples.copy_from_slice(&written[..samples.len()]);
        let counts: [[u32; 3]; 2] = bytemuck::pod_read_unaligned(counts);
        let counts = EncodedCounts { clipped: counts[0], unreachable: counts[1] };
        if let Some(Timestamps { tick_ns, .. }) = timestamps {
            let ticks: &[u64] = bytemuck::cast_slice(ticks);
            for (timing, ticks) in timings.stages.iter_mut().zip(ticks.chunks_exact(2)) {
                let elapsed = ticks[1].saturating_sub(ticks[0]) as f64 * f64::from(*tick_ns);
                timing.duration = Duration::from_nanos(elapsed as u64);
            }
        }
        drop(view);
        staging.unmap();
        Ok(counts)
    }

    /// Where the device's time for the last frame went; zeros where it has no timestamps.
    pub fn last_timings(&self) -> &StageTimings {
        &self.timings
    }

    /// Copies the last frame's hologram, before double phase, to the host.
    ///
    /// # Errors
    /// The device fails.
    ///
    /// # Panics
    /// Where `hologram` has another size.
    pub fn read_hologram(&self, hologram: &mut ComplexHologram) -> Result<(), GpuError> {
        assert_eq!(hologram.resolution, self.network.shared.resolution, "a hologram of the engine's size");
        let field = self.loaded.buffer(self.network.shared.field);
        match self.network.shared.stored {
            Precision::Single => {
                let mut pairs = vec![[0.0f32; 2]; hologram.field.len()];
                self.gpu.read(field, &mut pairs)?;
                hologram.field.iter_mut().zip(pairs).for_each(|(value, [re, im])| *value = Complex32::new(re, im));
            }
            Precision::Half => {
                let mut pairs = vec![[0u16; 2]; hologram.field.len()];
                self.gpu.read(field, &mut pairs)?;
                for (value, pair) in hologram.field.iter_mut().zip(pairs) {
                    let [re, im] = pair.map(|bits| f16::from_bits(bits).to_f32());
                    *value = Complex32::new(re, im);
                }
            }
        }
        Ok(())
    }

    /// Copies the last frame's phases, after double phase, to the host.
    ///
    /// # Errors
    /// The device fails.
    ///
    /// # Panics
    /// Where `pattern` has another size.
    pub fn read_pattern(&self, pattern: &mut PhasePattern) -> Result<(), GpuError> {
        assert_eq!(pattern.resolution, self.network.shared.resolution, "a pattern of the engine's size");
        self.gpu.read(self.loaded.buffer(self.network.phases), &mut pattern.phase_rad)
    }

    /// As if the driver had lost the device: what a test of recovery asks for.
    #[doc(hidden)]
    pub fn lose_device(&self) {
        self.gpu.device.destroy();
    }
}

/// What `open` gives where it may use matrix units, or where the driver refuses that, without; and why. A driver may
/// offer such units and refuse their shaders.
fn without_matrices_if_need_be<T>(
    open: impl Fn(bool) -> Result<T, EngineError>,
) -> Result<(T, Option<GpuError>), EngineError> {
    match open(true) {
        Err(EngineError::Gpu(cause @ (GpuError::Refused { .. } | GpuError::Failed { .. }))) => {
            open(false).map(|opened| (opened, Some(cause)))
        }
        opened => opened.map(|opened| (opened, None)),
    }
}

impl Timestamps {
    fn new(gpu: &Gpu, stages: usize, tick_ns: f32) -> Result<Self, GpuError> {
        let count = 2 * stages as u32;
        let queries = gpu.device.create_query_set(&wgpu::QuerySetDescriptor {
            label: Some("stages"),
            ty: wgpu::QueryType::Timestamp,
            count,
        });
        let bytes = u64::from(count) * TIMESTAMP_BYTES;
        let resolved = gpu.buffer("timestamps", bytes, BufferUsages::QUERY_RESOLVE | BufferUsages::COPY_SRC)?;
        Ok(Self { queries, resolved, tick_ns })
    }

    fn of_stage(&self, index: usize) -> wgpu::ComputePassTimestampWrites<'_> {
        let first = 2 * index as u32;
        wgpu::ComputePassTimestampWrites {
            query_set: &self.queries,
            beginning_of_pass_write_index: Some(first),
            end_of_pass_write_index: Some(first + 1),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_device_that_fails_with_matrices_is_tried_without() {
        let fault = |reason: &str| GpuError::Failed { name: "X".into(), reason: reason.into() };
        let tried = |with: Result<&'static str, GpuError>, without: Result<&'static str, GpuError>| {
            without_matrices_if_need_be(|matrices| {
                if matrices { with.clone() } else { without.clone() }.map_err(Into::into)
            })
        };
        assert_eq!(tried(Ok("with"), Ok("without")).ok(), Some(("with", None)));
        assert_eq!(tried(Err(fault("a shader")), Ok("without")).ok(), Some(("without", Some(fault("a shader")))));
        let both = tried(Err(fault("a shader")), Err(fault("all"))).err();
        assert!(matches!(both, Some(EngineError::Gpu(error)) if error == fault("all")));
        let too_large = GpuError::TooLarge { what: "a map", bytes: 2, name: "X".into(), limit: 1 };
        assert!(tried(Err(too_large), Ok("without")).is_err());
    }
}

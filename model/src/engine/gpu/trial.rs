//! Runs a plan on the device that tests run on.

use half::f16;
use num_complex::Complex64;

use super::map::{GROUP, Map};
use super::plan::{BufferId, Dispatch, Plan};
use crate::engine::Precision;
use crate::gpu::{Gpu, test_gpu};
use crate::worst::worst;

/// Numbers behind each buffer, not finite, which no shader may read or write.
const GUARD: usize = 1 << 12;

/// A plan with its buffers and pipelines on the device.
pub(super) struct Trial {
    gpu: Gpu,
    /// Each with a guard behind it.
    buffers: Vec<wgpu::Buffer>,
    stages: Vec<(String, Vec<Work>)>,
}

type Work = (wgpu::ComputePipeline, wgpu::BindGroup, [u32; 3]);

impl Trial {
    pub(super) fn new(plan: &Plan) -> Self {
        let gpu = test_gpu();
        let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::COPY_SRC;
        let guard = vec![f32::NAN; GUARD];
        let buffers: Vec<_> = plan
            .buffers
            .iter()
            .map(|buffer| {
                let device_buffer = gpu.buffer(buffer.what, buffer.bytes + 4 * GUARD as u64, usage).expect("a buffer");
                gpu.queue.write_buffer(&device_buffer, 0, &buffer.contents);
                gpu.queue.write_buffer(&device_buffer, buffer.bytes, bytemuck::cast_slice(&guard));
                device_buffer
            })
            .collect();
        let work = |Dispatch { shader, bindings, workgroups, .. }: &Dispatch| {
            let pipeline = gpu.trusted_pipeline(&shader.label, &shader.source, shader.entry).expect("a shader");
            let bound: Vec<_> = bindings.iter().map(|&(binding, id)| (binding, &buffers[id.0])).collect();
            let group = gpu.bind_at(&pipeline, &bound);
            gpu.check().expect("buffers that the shader takes");
            (pipeline, group, *workgroups)
        };
        let stages = plan.stages.iter();
        let stages = stages.map(|stage| (stage.name.clone(), stage.dispatches.iter().map(work).collect())).collect();
        Self { gpu, buffers, stages }
    }

    pub(super) fn write(&self, buffer: BufferId, values: &[f32]) {
        let buffer = &self.buffers[buffer.0];
        assert!(4 * (values.len() + GUARD) as u64 <= buffer.size());
        self.gpu.queue.write_buffer(buffer, 0, bytemuck::cast_slice(values));
    }

    /// Runs all stages and waits for them.
    pub(super) fn run(&self) {
        self.run_stages(|_| true);
    }

    /// Runs one stage and waits for it.
    pub(super) fn run_stage(&self, name: &str) {
        assert!(self.stages.iter().any(|(stage, _)| stage == name), "no stage {name}");
        self.run_stages(|stage| stage == name);
    }

    fn run_stages(&self, chosen: impl Fn(&str) -> bool) {
        let mut encoder = self.gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        {
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
            let stages = self.stages.iter().filter(|(name, _)| chosen(name));
            for (pipeline, group, [x, y, z]) in stages.flat_map(|(_, work)| work) {
                pass.set_pipeline(pipeline);
                pass.set_bind_group(0, group, &[]);
                pass.dispatch_workgroups(*x, *y, *z);
            }
        }
        self.gpu.wait(self.gpu.queue.submit([encoder.finish()])).expect("work that ends");
        self.gpu.check().expect("a device without faults");
        self.check_guards();
    }

    /// The guards behind all buffers are as they were.
    fn check_guards(&self) {
        let bytes = 4 * GUARD as u64;
        let usage = wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::COPY_SRC;
        let guards = self.gpu.buffer("guards", bytes * self.buffers.len() as u64, usage).expect("a buffer");
        let mut encoder = self.gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        for (place, buffer) in (0..).step_by(4 * GUARD).zip(&self.buffers) {
            encoder.copy_buffer_to_buffer(buffer, buffer.size() - bytes, &guards, place, bytes);
        }
        self.gpu.queue.submit([encoder.finish()]);
        let mut values = vec![0.0_f32; GUARD * self.buffers.len()];
        self.gpu.read(&guards, &mut values).expect("the guards' values");
        let touched = values.iter().position(|value| !value.is_nan());
        assert_eq!(touched.map(|value| value / GUARD), None, "a shader wrote behind the buffer of this number");
    }

    /// What a buffer holds; the guard behind it is as it was.
    pub(super) fn read(&self, buffer: BufferId) -> Vec<f32> {
        let buffer = &self.buffers[buffer.0];
        let mut values = vec![0.0f32; (buffer.size() / 4) as usize];
        self.gpu.read(buffer, &mut values).expect("the buffer's values");
        let guard = values.split_off(values.len() - GUARD);
        assert!(guard.iter().all(|value| value.is_nan()), "a shader wrote behind a buffer");
        values
    }
}

impl Map {
    fn place(&self, channel: usize, y: usize, x: usize) -> usize {
        let block = GROUP * self.format.block_groups();
        let first = channel / block * block / GROUP;
        ((y + 1) * self.groups + first) * self.pitch() * GROUP + (x + 1) * block + channel % block
    }

    /// What the map's buffer holds, as 32-bit words, where channel c of pixel (x, y) is `value(c, y, x)`.
    pub(super) fn values(&self, value: impl Fn(usize, usize, usize) -> f32) -> Vec<f32> {
        let mut values = vec![0.0; self.rows() * self.groups * self.pitch() * GROUP];
        self.for_each(|channel, y, x| values[self.place(channel, y, x)] = value(channel, y, x));
        match self.format.precision() {
            Precision::Single => values,
            Precision::Half => {
                let half: Vec<_> = values.iter().map(|&value| f16::from_f32(value).to_bits()).collect();
                bytemuck::cast_slice(&half).to_vec()
            }
        }
    }

    fn for_each(&self, mut visit: impl FnMut(usize, usize, usize)) {
        for (channel, y) in (0..self.groups * GROUP).flat_map(|channel| (0..self.height).map(move |y| (channel, y))) {
            (0..self.width).for_each(|x| visit(channel, y, x));
        }
    }

    /// [channels, height, width] of the first `channels` of `values`; the border and the rows below are zero.
    pub(super) fn planes(&self, values: &[f32], channels: usize) -> Vec<f32> {
        let mut rest = match self.format.precision() {
            Precision::Single => values.to_vec(),
            Precision::Half => {
                let half: &[u16] = bytemuck::cast_slice(values);
                half.iter().map(|&bits| f16::from_bits(bits).to_f32()).collect()
            }
        };
        let mut planes = Vec::new();
        self.for_each(|channel, y, x| {
            let value = std::mem::take(&mut rest[self.place(channel, y, x)]);
            if channel < channels {
                planes.push(value);
            }
        });
        assert!(rest.iter().all(|&value| value == 0.0), "a shader wrote to a map's border");
        planes
    }
}

/// What a buffer of complex numbers holds.
pub(super) fn complex(stored: Precision, values: &[f32]) -> Vec<Complex64> {
    let halves: Vec<f32>;
    let values = match stored {
        Precision::Single => values,
        Precision::Half => {
            let bits: &[u16] = bytemuck::cast_slice(values);
            halves = bits.iter().map(|&bits| f16::from_bits(bits).to_f32()).collect();
            &halves
        }
    };
    values.chunks_exact(2).map(|parts| Complex64::new(parts[0].into(), parts[1].into())).collect()
}

/// The largest difference relative to the largest value expected; infinite where anything is no number.
pub(super) fn largest_difference(found: &[Complex64], expected: &[Complex64]) -> f64 {
    assert_eq!(found.len(), expected.len());
    let difference = worst(found.iter().zip(expected).map(|(found, expected)| (found - expected).norm()));
    difference / worst(expected.iter().map(|value| value.norm())).max(1e-6)
}

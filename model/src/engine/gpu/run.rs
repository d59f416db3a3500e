//! Runs a plan on the software device, for tests of its stages.

use std::collections::HashMap;
use std::sync::Arc;

use num_complex::Complex64;

use super::plan::{BufferId, Plan, Shader};
use crate::gpu::Gpu;

/// What lies behind each buffer: no number, so that what is read there shows, and what is written there too.
const GUARD: [u32; 64] = [0x7FC0_1234; 64];

/// A plan on a device.
pub(super) struct Runner<'a> {
    gpu: &'a Gpu,
    plan: Plan,
    /// The plan's buffers, each with a guard behind it.
    buffers: Vec<wgpu::Buffer>,
    pipelines: HashMap<Arc<Shader>, wgpu::ComputePipeline>,
}

impl<'a> Runner<'a> {
    pub(super) fn new(gpu: &'a Gpu, plan: Plan) -> Self {
        let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::COPY_SRC;
        let buffers = plan.buffers.iter().map(|described| {
            let bytes = described.bytes.next_multiple_of(4);
            let buffer = gpu.buffer(described.what, bytes + size_of_val(&GUARD) as u64, usage).expect("memory");
            gpu.queue.write_buffer(&buffer, 0, &described.contents);
            gpu.queue.write_buffer(&buffer, bytes, bytemuck::cast_slice(&GUARD));
            buffer
        });
        let buffers = buffers.collect();
        Self { gpu, plan, buffers, pipelines: HashMap::new() }
    }

    pub(super) fn write(&mut self, buffer: BufferId, values: &[f32]) {
        assert_eq!(size_of_val(values) as u64, self.plan.buffers[buffer.0].bytes);
        self.gpu.queue.write_buffer(&self.buffers[buffer.0], 0, bytemuck::cast_slice(values));
    }

    pub(super) fn read(&self, buffer: BufferId) -> Vec<f32> {
        let count = self.plan.buffers[buffer.0].bytes as usize / 4;
        let mut values = vec![0.0; count + GUARD.len()];
        self.gpu.read(&self.buffers[buffer.0], &mut values).expect("what a buffer holds");
        let guard: Vec<_> = values[count..].iter().map(|value| value.to_bits()).collect();
        assert_eq!(guard, GUARD, "something was written behind {}", self.plan.buffers[buffer.0].what);
        values.truncate(count);
        values
    }

    /// Runs the stage `name`, and sees that nothing was written behind the buffers.
    pub(super) fn run(&mut self, name: &str) {
        let Self { gpu, plan, buffers, pipelines } = self;
        let stage = plan.stages.iter().find(|stage| stage.name == name).expect("a stage of that name");
        let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
        for dispatch in &stage.dispatches {
            let pipeline = pipelines.entry(dispatch.shader.clone()).or_insert_with(|| pipeline(gpu, &dispatch.shader));
            let entries: Vec<_> = dispatch
                .bindings
                .iter()
                .map(|&(binding, buffer)| wgpu::BindGroupEntry {
                    binding,
                    resource: buffers[buffer.0].as_entire_binding(),
                })
                .collect();
            let layout = &pipeline.get_bind_group_layout(0);
            let descriptor = wgpu::BindGroupDescriptor { label: None, layout, entries: &entries };
            pass.set_pipeline(pipeline);
            pass.set_bind_group(0, &gpu.device.create_bind_group(&descriptor), &[]);
            let [x, y, z] = dispatch.workgroups;
            assert!(dispatch.workgroups.iter().all(|&count| (1..=65535).contains(&count)));
            pass.dispatch_workgroups(x, y, z);
        }
        drop(pass);
        gpu.queue.submit([encoder.finish()]);
        gpu.check().expect("a device without faults");
        (0..self.buffers.len()).for_each(|buffer| drop(self.read(BufferId(buffer))));
    }
}

fn pipeline(gpu: &Gpu, shader: &Shader) -> wgpu::ComputePipeline {
    let source = wgpu::ShaderSource::Wgsl(shader.source.as_str().into());
    let module =
        gpu.device.create_shader_module(wgpu::ShaderModuleDescriptor { label: Some(&shader.label), source });
    gpu.check().expect("a shader that is one");
    let pipeline = gpu.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
        label: Some(&shader.label),
        layout: None,
        module: &module,
        entry_point: Some(shader.entry),
        compilation_options: wgpu::PipelineCompilationOptions::default(),
        cache: None,
    });
    gpu.check().expect("a shader that the device takes");
    pipeline
}

/// What a buffer of complex numbers holds.
pub(super) fn complex(values: &[f32]) -> Vec<Complex64> {
    values.chunks_exact(2).map(|parts| Complex64::new(parts[0].into(), parts[1].into())).collect()
}

/// The largest difference relative to the largest value expected; infinite where anything is no number.
pub(super) fn largest_difference(found: &[Complex64], expected: &[Complex64]) -> f64 {
    assert_eq!(found.len(), expected.len());
    let largest = |values: &mut dyn Iterator<Item = f64>| {
        values.fold(0.0, |worst: f64, value| if value.is_nan() { f64::INFINITY } else { worst.max(value) })
    };
    let difference = largest(&mut found.iter().zip(expected).map(|(found, expected)| (found - expected).norm()));
    difference / largest(&mut expected.iter().map(|value| value.norm())).max(1e-6)
}

//! Runs a plan on Mesa's software device, for tests.

use half::f16;

use super::map::{GROUP, Map, Precision};
use super::plan::{BufferId, Plan};
use crate::gpu::{Adapters, Gpu};

/// Numbers behind each buffer, not finite, which no shader may read or write.
const GUARD: usize = 1 << 12;

/// A plan with its buffers and pipelines on the device.
pub(super) struct Trial {
    gpu: Gpu,
    /// Each with a guard behind it.
    buffers: Vec<wgpu::Buffer>,
    work: Vec<(wgpu::ComputePipeline, wgpu::BindGroup, [u32; 3])>,
}

impl Trial {
    pub(super) fn new(plan: &Plan) -> Self {
        let gpu = Gpu::open(Adapters::Software).expect("Mesa's software device; install mesa-vulkan-drivers");
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
        let dispatches = plan.stages.iter().flat_map(|stage| &stage.dispatches);
        let work = dispatches.map(|dispatch| {
            let pipeline = gpu.pipeline(&dispatch.shader.label, &dispatch.shader.source).expect("a shader");
            let entries: Vec<_> = dispatch
                .bindings
                .iter()
                .map(|&(binding, id)| wgpu::BindGroupEntry { binding, resource: buffers[id.0].as_entire_binding() })
                .collect();
            let layout = pipeline.get_bind_group_layout(0);
            let descriptor = wgpu::BindGroupDescriptor { label: None, layout: &layout, entries: &entries };
            let group = gpu.device.create_bind_group(&descriptor);
            (pipeline, group, dispatch.workgroups)
        });
        let work = work.collect();
        Self { gpu, buffers, work }
    }

    pub(super) fn write(&self, buffer: BufferId, values: &[f32]) {
        let buffer = &self.buffers[buffer.0];
        assert!(4 * (values.len() + GUARD) as u64 <= buffer.size());
        self.gpu.queue.write_buffer(buffer, 0, bytemuck::cast_slice(values));
    }

    /// Runs all dispatches and waits for them.
    pub(super) fn run(&self) {
        let mut encoder = self.gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        {
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
            for (pipeline, group, [x, y, z]) in &self.work {
                pass.set_pipeline(pipeline);
                pass.set_bind_group(0, group, &[]);
                pass.dispatch_workgroups(*x, *y, *z);
            }
        }
        self.gpu.wait(self.gpu.queue.submit([encoder.finish()])).expect("work that ends");
    }

    /// What a buffer holds; the guard behind it is as it was.
    pub(super) fn read(&self, buffer: BufferId) -> Vec<f32> {
        let buffer = &self.buffers[buffer.0];
        let mut values = vec![0.0_f32; (buffer.size() / 4) as usize];
        self.gpu.read(buffer, &mut values).expect("the buffer's values");
        let guard = values.split_off(values.len() - GUARD);
        assert!(guard.iter().all(|value| value.is_nan()), "a shader wrote behind a buffer");
        values
    }
}

impl Map {
    fn place(&self, channel: usize, y: usize, x: usize) -> usize {
        (((y + 1) * self.groups + channel / GROUP) * self.pitch() + x + 1) * GROUP + channel % GROUP
    }

    /// What the map's buffer holds, as 32-bit words, where channel c of pixel (x, y) is `value(c, y, x)`.
    pub(super) fn values(&self, value: impl Fn(usize, usize, usize) -> f32) -> Vec<f32> {
        let rows = self.height.next_multiple_of(super::map::ROWS) + 2;
        let mut values = vec![0.0; rows * self.groups * self.pitch() * GROUP];
        self.for_each(|channel, y, x| values[self.place(channel, y, x)] = value(channel, y, x));
        match self.precision {
            Precision::F32 => values,
            Precision::F16 => {
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
        let mut rest = match self.precision {
            Precision::F32 => values.to_vec(),
            Precision::F16 => {
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

//! A plan on a device: its buffers made, its shaders compiled.

use std::collections::HashMap;
use std::collections::hash_map::Entry;

use wgpu::BufferUsages;

use super::plan::{Buffer, BufferId, Dispatch, Plan};
use crate::gpu::{Gpu, GpuError};

/// Buffers and dispatches that are ready to run.
pub(super) struct LoadedPlan {
    buffers: Vec<wgpu::Buffer>,
    stages: Vec<Vec<LoadedDispatch>>,
}

struct LoadedDispatch {
    pipeline: wgpu::ComputePipeline,
    bindings: wgpu::BindGroup,
    workgroups: [u32; 3],
}

impl LoadedPlan {
    /// Makes the buffers with what they hold at first, and compiles each shader once.
    ///
    /// # Errors
    /// A buffer does not fit, or the driver refuses a shader.
    pub(super) fn new(gpu: &Gpu, plan: &Plan) -> Result<Self, GpuError> {
        let buffers = buffers(gpu, plan)?;
        Ok(Self { stages: stages(gpu, plan, &buffers)?, buffers })
    }

    pub(super) fn buffer(&self, id: BufferId) -> &wgpu::Buffer {
        &self.buffers[id.0]
    }

    /// Adds each stage to `encoder` as a pass of its own, with the timestamps that `timestamps` gives for its number.
    pub(super) fn encode<'a>(
        &self,
        encoder: &mut wgpu::CommandEncoder,
        timestamps: impl Fn(usize) -> Option<wgpu::ComputePassTimestampWrites<'a>>,
    ) {
        for (index, stage) in self.stages.iter().enumerate() {
            let descriptor = wgpu::ComputePassDescriptor { label: None, timestamp_writes: timestamps(index) };
            let mut pass = encoder.begin_compute_pass(&descriptor);
            for LoadedDispatch { pipeline, bindings, workgroups: [x, y, z] } in stage {
                pass.set_pipeline(pipeline);
                pass.set_bind_group(0, bindings, &[]);
                pass.dispatch_workgroups(*x, *y, *z);
            }
        }
    }
}

fn buffers(gpu: &Gpu, plan: &Plan) -> Result<Vec<wgpu::Buffer>, GpuError> {
    let usage = BufferUsages::STORAGE | BufferUsages::COPY_DST | BufferUsages::COPY_SRC;
    let make = |buffer: &Buffer| {
        let made = gpu.buffer(buffer.what, buffer.bytes, usage)?;
        if !buffer.contents.is_empty() {
            gpu.queue.write_buffer(&made, 0, &buffer.contents);
        }
        Ok(made)
    };
    plan.buffers.iter().map(make).collect()
}

fn stages(gpu: &Gpu, plan: &Plan, buffers: &[wgpu::Buffer]) -> Result<Vec<Vec<LoadedDispatch>>, GpuError> {
    let mut pipelines = HashMap::new();
    let mut ready = Vec::new();
    for stage in &plan.stages {
        let mut dispatches = Vec::new();
        for Dispatch { shader, bindings, workgroups, .. } in &stage.dispatches {
            let pipeline = match pipelines.entry((&shader.source, shader.entry)) {
                Entry::Occupied(compiled) => compiled.into_mut(),
                Entry::Vacant(place) => {
                    place.insert(gpu.trusted_pipeline(&shader.label, &shader.source, shader.entry)?)
                }
            };
            let bound: Vec<_> = bindings.iter().map(|&(binding, id)| (binding, &buffers[id.0])).collect();
            let bindings = gpu.bind_at(pipeline, &bound);
            gpu.check()?;
            dispatches.push(LoadedDispatch { pipeline: pipeline.clone(), bindings, workgroups: *workgroups });
        }
        ready.push(dispatches);
    }
    Ok(ready)
}

//! One device with its queue. Faults that the driver tells late, between calls, are kept and given by the next call
//! that can fail, so that none is missed.

use std::ops::Deref;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use super::{Adapters, GpuChoice, GpuError, MatrixUnits, caught};

/// A device and its queue.
pub struct Gpu {
    /// What makes encoders; buffers, shaders and bindings are made by [`Gpu`] itself, which finds their faults.
    pub device: wgpu::Device,
    /// Where work is submitted.
    pub queue: GivenBack<wgpu::Queue>,
    name: String,
    fault: Arc<OnceLock<String>>,
    /// The maker's number at PCI.
    pub(crate) vendor: u32,
    /// The longest that any piece of work may take before the device counts as hung.
    pub(crate) patience: Duration,
    /// The most bytes that a shader can see as one buffer.
    pub largest_buffer: u64,
    /// The memory that the threads of a workgroup share, bytes.
    pub(crate) workgroup_bytes: u32,
    /// The most threads of a workgroup, all along x.
    pub(crate) workgroup_threads: u32,
    /// Whether its shaders compute in half precision.
    pub(crate) half_precision: bool,
    pub(crate) matrix_units: Option<MatrixUnits>,
    /// Nanoseconds to a tick of the timestamps, where the device has them.
    pub(crate) timestamp_ns: Option<f32>,
}

/// Bytes that are read back at a time.
const READ_BYTES: u64 = 64 << 20;
/// That, unless another one is set.
const PATIENCE: Duration = Duration::from_secs(if cfg!(test) { 900 } else { 120 });

impl Gpu {
    /// Opens the best device that opens, without its matrix units.
    ///
    /// # Errors
    /// There is none, or the driver of the best one refuses, and those of all others.
    pub fn open(choice: GpuChoice<'_>) -> Result<Self, GpuError> {
        first_that_opens(&Self::candidates(choice)?, |adapter| Self::on(adapter, |_| false))
    }

    /// The devices that will do, of which there is one at least, the best first: cards of their own before those that
    /// are a part of the processor.
    ///
    /// # Errors
    /// There is none, or none that is called so.
    pub(crate) fn candidates(choice: GpuChoice<'_>) -> Result<Vec<wgpu::Adapter>, GpuError> {
        let GpuChoice { adapters, named } = choice;
        let instance = wgpu::Instance::new(wgpu::InstanceDescriptor {
            backends: wgpu::Backends::VULKAN,
            ..wgpu::InstanceDescriptor::new_without_display_handle()
        });
        let rank = |adapter: &wgpu::Adapter| match adapter.get_info().device_type {
            wgpu::DeviceType::DiscreteGpu => 0,
            wgpu::DeviceType::IntegratedGpu => 1,
            wgpu::DeviceType::VirtualGpu | wgpu::DeviceType::Other => 2,
            wgpu::DeviceType::Cpu => 3,
        };
        let mut found = pollster::block_on(instance.enumerate_adapters(wgpu::Backends::VULKAN));
        found.sort_by_key(rank);
        let is_usable = |adapter: &wgpu::Adapter| (adapters == Adapters::Software) == (rank(adapter) == 3);
        if let Some(named) = named {
            let there = found.iter().map(|adapter| name_and_place(&adapter.get_info())).collect();
            found.retain(|adapter| is_usable(adapter) && is_called(&adapter.get_info(), named));
            return if found.is_empty() {
                Err(GpuError::NotNamed { named: named.to_owned(), there })
            } else {
                Ok(found)
            };
        }
        let (usable, others): (Vec<_>, Vec<_>) = found.into_iter().partition(is_usable);
        if usable.is_empty() {
            let wanted = match adapters {
                Adapters::Hardware => "GPU; install its driver",
                Adapters::Software => "software device; install mesa-vulkan-drivers",
            };
            let passed_over = others.iter().map(|adapter| adapter.get_info().name).collect();
            return Err(GpuError::None { wanted, passed_over });
        }
        Ok(usable)
    }

    /// Opens a device. Its matrix units can be used if they are `wanted`.
    ///
    /// # Errors
    /// Its driver refuses.
    pub(crate) fn on(adapter: &wgpu::Adapter, wanted: impl Fn(MatrixUnits) -> bool) -> Result<Self, GpuError> {
        let wgpu::AdapterInfo { name, vendor, .. } = adapter.get_info();
        let timestamps = adapter.features() & wgpu::Features::TIMESTAMP_QUERY;
        let half_precision = adapter.features() & wgpu::Features::SHADER_F16;
        let matrix_units = matrix_units(adapter).filter(|&units| wanted(units));
        let (matrices, experimental_features) = match matrix_units {
            // SAFETY: no other experimental feature is asked for, and this one is used by this crate's own shaders
            // alone, whose results are compared with the reference's on cards that have it: NVIDIA's, so far.
            Some(units) => (matrix_features(units), unsafe { wgpu::ExperimentalFeatures::enabled() }),
            None => (wgpu::Features::empty(), wgpu::ExperimentalFeatures::disabled()),
        };
        let descriptor = wgpu::DeviceDescriptor {
            label: Some("holod"),
            required_features: timestamps | half_precision | matrices,
            required_limits: adapter.limits(),
            experimental_features,
            memory_hints: wgpu::MemoryHints::Performance,
            ..wgpu::DeviceDescriptor::default()
        };
        let (device, queue) = pollster::block_on(adapter.request_device(&descriptor))
            .map_err(|error| GpuError::Refused { name: name.clone(), reason: error.to_string() })?;
        let fault = Arc::new(OnceLock::new());
        let kept = fault.clone();
        // Only the first is kept: the others follow from it.
        device.on_uncaptured_error(Arc::new(move |error| drop(kept.set(error.to_string()))));
        let kept = fault.clone();
        device.set_device_lost_callback(move |reason, text| {
            if reason != wgpu::DeviceLostReason::Destroyed {
                drop(kept.set(format!("it was lost ({text})")));
            }
        });
        let limits = device.limits();
        let largest_buffer = limits.max_storage_buffer_binding_size.min(limits.max_buffer_size);
        let workgroup_bytes = limits.max_compute_workgroup_storage_size;
        let workgroup_threads = limits.max_compute_invocations_per_workgroup.min(limits.max_compute_workgroup_size_x);
        let half_precision = !half_precision.is_empty();
        let timestamp_ns = (!timestamps.is_empty()).then(|| queue.get_timestamp_period());
        Ok(Self {
            device,
            queue: GivenBack(Some(queue)),
            name,
            fault,
            vendor,
            patience: PATIENCE,
            largest_buffer,
            workgroup_bytes,
            workgroup_threads,
            half_precision,
            matrix_units,
            timestamp_ns,
        })
    }

    /// The device's name, as its driver has it.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The first fault that there was, if there was one.
    pub(crate) fn check(&self) -> Result<(), GpuError> {
        self.fault.get().map_or(Ok(()), |reason| Err(self.failed(reason)))
    }

    pub(crate) fn failed(&self, reason: impl ToString) -> GpuError {
        GpuError::Failed { name: self.name.clone(), reason: reason.to_string() }
    }

    /// A buffer of zeros.
    ///
    /// # Errors
    /// It is too large, or the device failed.
    pub fn buffer(&self, what: &'static str, bytes: u64, usage: wgpu::BufferUsages) -> Result<wgpu::Buffer, GpuError> {
        let limit = self.largest_buffer;
        if bytes > limit {
            return Err(GpuError::TooLarge { what, bytes, name: self.name.clone(), limit });
        }
        let descriptor = wgpu::BufferDescriptor { label: Some(what), size: bytes, usage, mapped_at_creation: false };
        let buffer = self.device.create_buffer(&descriptor);
        self.check()?;
        Ok(buffer)
    }

    /// A buffer for a shader that holds `values`, or one zero where there are none: an empty one cannot be bound.
    ///
    /// # Errors
    /// As [`buffer`](Self::buffer).
    pub fn upload<T: bytemuck::NoUninit>(&self, what: &'static str, values: &[T]) -> Result<wgpu::Buffer, GpuError> {
        let bytes: &[u8] = bytemuck::cast_slice(values);
        let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST;
        let buffer = self.buffer(what, bytes.len().max(size_of::<T>()) as u64, usage)?;
        if !bytes.is_empty() {
            self.queue.write_buffer(&buffer, 0, bytes);
        }
        Ok(buffer)
    }

    /// A shader's only entry point, with the bindings that it names.
    ///
    /// # Errors
    /// The shader is none, or the device failed.
    pub fn pipeline(&self, label: &str, wgsl: &str) -> Result<wgpu::ComputePipeline, GpuError> {
        let source = wgpu::ShaderSource::Wgsl(wgsl.into());
        let module = self.device.create_shader_module(wgpu::ShaderModuleDescriptor { label: Some(label), source });
        self.pipeline_of(label, &module, None)
    }

    /// An entry point of a shader of this crate, whose accesses and loops are checked in debug builds only: the checks
    /// cost up to a hundred times the work (gfx-rs/wgpu#7698).
    pub(crate) fn trusted_pipeline(
        &self,
        label: &str,
        wgsl: &str,
        entry: &str,
    ) -> Result<wgpu::ComputePipeline, GpuError> {
        let source = wgpu::ShaderSource::Wgsl(wgsl.into());
        let descriptor = wgpu::ShaderModuleDescriptor { label: Some(label), source };
        let checks = match cfg!(debug_assertions) {
            true => wgpu::ShaderRuntimeChecks::checked(),
            false => wgpu::ShaderRuntimeChecks::unchecked(),
        };
        // SAFETY: the crate's shaders end their loops and stay inside their buffers, whose sizes are made from the same
        // constants; the tests run them with the checks and compare what they write.
        let module = unsafe { self.device.create_shader_module_trusted(descriptor, checks) };
        self.pipeline_of(label, &module, Some(entry))
    }

    fn pipeline_of(
        &self,
        label: &str,
        module: &wgpu::ShaderModule,
        entry_point: Option<&str>,
    ) -> Result<wgpu::ComputePipeline, GpuError> {
        // A shader that is none already has a fault, and none of it would be found by a layout.
        self.check()?;
        let pipeline = self.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(label),
            layout: None,
            module,
            entry_point,
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            cache: None,
        });
        self.check()?;
        Ok(pipeline)
    }

    /// The buffers as a pipeline's bindings 0, 1, …
    pub fn bind(&self, pipeline: &wgpu::ComputePipeline, buffers: &[&wgpu::Buffer]) -> wgpu::BindGroup {
        self.bind_at(pipeline, &(0..).zip(buffers.iter().copied()).collect::<Vec<_>>())
    }

    /// Each buffer as the binding of a pipeline that is named with it.
    pub(crate) fn bind_at(
        &self,
        pipeline: &wgpu::ComputePipeline,
        buffers: &[(u32, &wgpu::Buffer)],
    ) -> wgpu::BindGroup {
        let entries: Vec<_> = buffers
            .iter()
            .map(|&(binding, buffer)| wgpu::BindGroupEntry { binding, resource: buffer.as_entire_binding() })
            .collect();
        let layout = pipeline.get_bind_group_layout(0);
        self.device.create_bind_group(&wgpu::BindGroupDescriptor { label: None, layout: &layout, entries: &entries })
    }

    /// Waits until the work of `submission`, and all before it, is done.
    ///
    /// # Errors
    /// The device failed, or does not end its work.
    pub fn wait(&self, submission: wgpu::SubmissionIndex) -> Result<(), GpuError> {
        let until = wgpu::PollType::Wait { submission_index: Some(submission), timeout: Some(self.patience) };
        match self.guarded(|| has_ended(self.device.poll(until)))? {
            true => Ok(()),
            false => Err(GpuError::Hung { name: self.name.clone(), waited: self.patience }),
        }
    }

    /// What was told late comes first: it is the cause. wgpu panics where a device is lost in `poll`, after it has told
    /// the callback.
    fn guarded<T, E: ToString>(&self, poll: impl FnOnce() -> Result<T, E>) -> Result<T, GpuError> {
        let polled = caught(poll);
        self.check()?;
        polled.map_err(|_| self.failed("it was lost"))?.map_err(|error| self.failed(error))
    }

    /// Copies a buffer that was made with `COPY_SRC` to `values`, once all work before is done.
    ///
    /// # Errors
    /// As [`wait`](Self::wait).
    pub fn read<T: bytemuck::Pod>(&self, buffer: &wgpu::Buffer, values: &mut [T]) -> Result<(), GpuError> {
        let usage = wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST;
        let staging = self.buffer("reading back", READ_BYTES.min(size_of_val(values) as u64), usage)?;
        let mut offset = 0;
        for part in values.chunks_mut(staging.size() as usize / size_of::<T>()) {
            let bytes = size_of_val(part) as u64;
            let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
            encoder.copy_buffer_to_buffer(buffer, offset, &staging, 0, bytes);
            let submission = self.queue.submit([encoder.finish()]);
            // Whether it can be read is asked below.
            staging.map_async(wgpu::MapMode::Read, ..bytes, |_| ());
            self.wait(submission)?;
            let view = staging.get_mapped_range(..bytes).map_err(|error| self.failed(error))?;
            part.copy_from_slice(bytemuck::cast_slice(&view));
            drop(view);
            staging.unmap();
            offset += bytes;
        }
        Ok(())
    }
}

/// What `open` makes of the first candidate with which it can; where there is none, why not with the first.
pub(crate) fn first_that_opens<A, T, E>(candidates: &[A], open: impl Fn(&A) -> Result<T, E>) -> Result<T, E> {
    let (first, others) = candidates.split_first().expect("one candidate at least");
    open(first).or_else(|why| others.iter().find_map(|other| open(other).ok()).ok_or(why))
}

fn name_and_place(wgpu::AdapterInfo { name, device_pci_bus_id, .. }: &wgpu::AdapterInfo) -> String {
    if device_pci_bus_id.is_empty() { name.clone() } else { format!("{name} ({device_pci_bus_id})") }
}

/// Whether somebody who says `named` means this device: by a part of its name, or by its place on the PCI bus.
fn is_called(info: &wgpu::AdapterInfo, named: &str) -> bool {
    info.name.to_lowercase().contains(&named.to_lowercase()) || info.device_pci_bus_id.eq_ignore_ascii_case(named)
}

/// Something whose end is no panic: that of a queue waits for its device, and wgpu panics where the driver then says
/// anything but that the device is lost.
pub struct GivenBack<T>(Option<T>);

impl<T> Deref for GivenBack<T> {
    type Target = T;

    fn deref(&self) -> &T {
        self.0.as_ref().expect("it is there until it is dropped")
    }
}

impl<T> Drop for GivenBack<T> {
    fn drop(&mut self) {
        // Nothing is left to be done with a device that fails now.
        let _given_back = caught(|| drop(self.0.take()));
    }
}

/// How the adapter multiplies matrices, if it does so as [`MatrixUnits`] does.
fn matrix_units(adapter: &wgpu::Adapter) -> Option<MatrixUnits> {
    use wgpu::CooperativeScalarType::{F16, F32};
    let info = adapter.get_info();
    let units = units_of_subgroups(info.subgroup_min_size, info.subgroup_max_size)?;
    let features = wgpu::Features::SHADER_F16 | matrix_features(units);
    let of_16 = |offered: &wgpu::CooperativeMatrixProperties| {
        let &wgpu::CooperativeMatrixProperties { m_size, n_size, k_size, ab_type, cr_type, .. } = offered;
        (m_size, n_size, k_size, ab_type, cr_type) == (16, 16, 16, F16, F32)
    };
    let has_them = adapter.features().contains(features) && adapter.cooperative_matrix_properties().iter().any(of_16);
    has_them.then_some(units)
}

/// Those of a device whose subgroups have from `least` to `most` threads; where that may vary, a workgroup of 32 could be
/// half of one.
fn units_of_subgroups(least: u32, most: u32) -> Option<MatrixUnits> {
    match (least, most) {
        (32, 32) => Some(MatrixUnits::Device),
        (32, 64) | (64, 64) => Some(MatrixUnits::DeviceOfAnySubgroups),
        _ => None,
    }
}

/// What shaders for these units need of a device besides half precision.
fn matrix_features(units: MatrixUnits) -> wgpu::Features {
    let matrices = wgpu::Features::EXPERIMENTAL_COOPERATIVE_MATRIX;
    match units {
        MatrixUnits::DeviceOfAnySubgroups => matrices | wgpu::Features::SUBGROUP,
        _ => matrices,
    }
}

/// Whether work has ended within the time that it was waited for.
fn has_ended(polled: Result<wgpu::PollStatus, wgpu::PollError>) -> Result<bool, wgpu::PollError> {
    match polled {
        Err(wgpu::PollError::Timeout) => Ok(false),
        polled => polled.map(|_| true),
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::gpu::panic_is_caught;

    pub(crate) fn test_adapters() -> Adapters {
        if holod_tests::on_a_graphics_card() { Adapters::Hardware } else { Adapters::Software }
    }

    pub(crate) fn test_gpu() -> Gpu {
        let adapters = test_adapters();
        let candidates = Gpu::candidates(adapters.into());
        candidates
            .and_then(|candidates| first_that_opens(&candidates, |adapter| Gpu::on(adapter, |_| true)))
            .unwrap_or_else(|error| panic!("{adapters:?} for tests: {error}"))
    }

    #[test]
    fn a_device_is_named_by_a_part_of_its_name_or_its_place() {
        let info = wgpu::AdapterInfo {
            name: "NVIDIA GeForce RTX 4090".into(),
            device_pci_bus_id: "0000:0a:00.0".into(),
            ..Gpu::candidates(test_adapters().into()).expect("a device")[0].get_info()
        };
        assert!(["rtx 4090", "NVIDIA", "0000:0A:00.0"].iter().all(|named| is_called(&info, named)));
        assert!(["rtx 2080", "0000:0b:00.0", "0a:00"].iter().all(|named| !is_called(&info, named)));

        let test_gpu = test_gpu();
        let choice = |named| GpuChoice { adapters: test_adapters(), named: Some(named) };
        let found = Gpu::open(choice(test_gpu.name())).expect("by its name");
        assert_eq!(found.name(), test_gpu.name());
        let refused = Gpu::candidates(choice("no such card")).expect_err("no such card");
        let text = refused.to_string();
        assert!(["no such card", "model.gpu", test_gpu.name()].iter().all(|part| text.contains(part)), "{text}");
    }

    #[test]
    fn units_are_used_by_the_sizes_that_subgroups_may_have() {
        assert_eq!(units_of_subgroups(32, 32), Some(MatrixUnits::Device));
        assert_eq!(units_of_subgroups(32, 64), Some(MatrixUnits::DeviceOfAnySubgroups));
        assert_eq!(units_of_subgroups(64, 64), Some(MatrixUnits::DeviceOfAnySubgroups));
        assert_eq!([(8, 32), (16, 16), (4, 128)].map(|(least, most)| units_of_subgroups(least, most)), [None; 3]);
        assert!(matrix_features(MatrixUnits::DeviceOfAnySubgroups).contains(wgpu::Features::SUBGROUP));
    }

    #[test]
    fn units_that_have_run_on_no_card_are_taken_where_asked_for_and_by_wide_networks_alone() {
        let of_any_size = MatrixUnits::DeviceOfAnySubgroups;
        assert_eq!([MatrixUnits::Device, of_any_size].map(MatrixUnits::have_run), [true, false]);
        assert_eq!([16, 24, 32].map(|channels| MatrixUnits::Device.suit(channels)), [true; 3]);
        assert_eq!([16, 24, 32].map(|channels| of_any_size.suit(channels)), [false, false, true]);
    }

    #[test]
    fn what_is_uploaded_is_read_back() {
        let gpu = test_gpu();
        let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::COPY_SRC;
        let buffer = gpu.buffer("numbers", 12, usage).expect("a buffer");
        gpu.queue.write_buffer(&buffer, 0, bytemuck::cast_slice(&[1.5f32, -2.0, 1e-30]));
        let mut values = [0.0_f32; 3];
        gpu.read(&buffer, &mut values).expect("the numbers");
        assert_eq!(values, [1.5, -2.0, 1e-30]);
    }

    #[test]
    fn what_does_not_fit_is_told_with_both_sizes() {
        let gpu = test_gpu();
        let bytes = gpu.largest_buffer + 4;
        let error = gpu.buffer("the sky", bytes, wgpu::BufferUsages::STORAGE).expect_err("too large");
        let text = error.to_string();
        assert!(
            ["the sky", &bytes.to_string(), gpu.name(), "--backend cpu"].iter().all(|part| text.contains(part)),
            "{text}"
        );
    }

    #[test]
    fn a_shader_that_is_none_is_an_error_now_and_ever_after() {
        let gpu = test_gpu();
        let error = gpu.pipeline("broken", "@compute @workgroup_size(1) fn f() { nonsense(); }").expect_err("nonsense");
        assert!(matches!(&error, GpuError::Failed { reason, .. } if reason.contains("nonsense")), "{error}");
        assert_eq!(gpu.check(), Err(error));
    }

    #[test]
    fn a_lost_device_is_an_error() {
        let gpu = test_gpu();
        let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC;
        let buffer = gpu.buffer("numbers", 12, usage).expect("a buffer");
        let panicked = gpu.guarded::<(), String>(|| {
            assert!(panic_is_caught());
            panic!("as wgpu does")
        });
        assert!(!panic_is_caught());
        let panicked = panicked.expect_err("a panic");
        assert!(panicked.to_string().contains("it was lost"), "{panicked}");
        gpu.device.destroy();
        assert!(matches!(gpu.read(&buffer, &mut [0.0_f32; 3]), Err(GpuError::Failed { .. })));
    }

    #[test]
    fn where_the_best_device_will_not_do_the_next_one_is_tried() {
        let tried = |candidates: &[i32]| first_that_opens(candidates, |&n| if n > 10 { Ok(n) } else { Err(n) });
        assert_eq!(tried(&[11, 12]), Ok(11));
        assert_eq!(tried(&[1, 2, 12, 13]), Ok(12));
        assert_eq!(tried(&[2, 1]), Err(2), "the best one's reason");
    }

    #[test]
    fn what_panics_at_its_end_is_given_back_all_the_same() {
        struct Panics;
        impl Drop for Panics {
            fn drop(&mut self) {
                assert!(panic_is_caught());
                panic!("as wgpu's queue does")
            }
        }
        assert!(std::panic::catch_unwind(|| drop(Panics)).is_err(), "the test is blind");
        drop(GivenBack(Some(Panics)));
        assert!(!panic_is_caught());
        assert_eq!(*GivenBack(Some(9)), 9);
    }

    #[test]
    fn work_that_does_not_end_in_time_is_told_from_work_that_fails() {
        assert_eq!(has_ended(Ok(wgpu::PollStatus::QueueEmpty)).ok(), Some(true));
        assert_eq!(has_ended(Err(wgpu::PollError::Timeout)).ok(), Some(false));
        assert!(has_ended(Err(wgpu::PollError::WrongSubmissionIndex(2, 1))).is_err());
    }

    #[test]
    fn much_is_read_back_in_parts() {
        let gpu = test_gpu();
        let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::COPY_SRC;
        let count = (READ_BYTES / 4) as usize + 3;
        let buffer = gpu.buffer("numbers", 4 * count as u64, usage).expect("a buffer");
        let numbers: Vec<f32> = (0..count).map(|n| n as f32).collect();
        gpu.queue.write_buffer(&buffer, 0, bytemuck::cast_slice(&numbers));
        let mut values = vec![-1.0; count];
        gpu.read(&buffer, &mut values).expect("the numbers");
        assert!(values == numbers);
    }
}

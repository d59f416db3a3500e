//! WGSL to SPIR-V, as wgpu does it for a trusted shader in a release build.

use naga::back::spv;
use naga::proc::{BoundsCheckPolicies, BoundsCheckPolicy};
use naga::valid::{Capabilities, GlobalUse, SubgroupOperationSet, ValidationFlags, Validator};

use super::CostError;
use crate::engine::gpu::plan::Shader;

/// A shader as SPIR-V, and what its entry point says of itself.
pub(super) struct Module {
    pub(super) words: Vec<u32>,
    /// Threads of a workgroup.
    pub(super) threads: u32,
    /// Each binding of group 0 that the entry point uses.
    pub(super) bindings: Vec<Binding>,
}

/// How an entry point uses a buffer.
pub(super) struct Binding {
    pub(super) number: u32,
    pub(super) read: bool,
    pub(super) written: bool,
}

impl Module {
    /// # Errors
    /// The shader is no valid WGSL.
    pub(super) fn new(shader: &Shader) -> Result<Self, CostError> {
        let refused = |reason| CostError::Shader { label: shader.label.clone(), reason };
        let module = naga::front::wgsl::parse_str(&shader.source)
            .map_err(|error| refused(error.emit_to_string(&shader.source)))?;
        let info = Validator::new(ValidationFlags::all(), Capabilities::all())
            .subgroup_stages(naga::valid::ShaderStages::all())
            .subgroup_operations(SubgroupOperationSet::all())
            .validate(&module)
            .map_err(|error| refused(error.emit_to_string(&shader.source)))?;
        let entry = (naga::ShaderStage::Compute, shader.entry);
        let (module, info) = naga::back::pipeline_constants::process_overrides(
            &module,
            &info,
            Some(entry),
            &naga::back::PipelineConstants::default(),
        )
        .map_err(|error| refused(error.to_string()))?;
        let place = module.entry_points.iter().position(|point| (point.stage, point.name.as_str()) == entry);
        let place = place.ok_or_else(|| refused(format!("it has no compute entry point {}", shader.entry)))?;
        let uses = info.get_entry_point(place);
        let bindings = module.global_variables.iter().filter_map(|(handle, variable)| {
            let number = variable.binding.as_ref().filter(|binding| binding.group == 0)?.binding;
            let usage = uses[handle];
            let read = usage.intersects(GlobalUse::READ | GlobalUse::ATOMIC);
            let written = usage.intersects(GlobalUse::WRITE | GlobalUse::ATOMIC);
            (read || written).then_some(Binding { number, read, written })
        });
        let bindings = bindings.collect();
        let pipeline = spv::PipelineOptions { shader_stage: entry.0, entry_point: entry.1.to_owned() };
        let words =
            spv::write_vec(&module, &info, &options(), Some(&pipeline)).map_err(|error| refused(error.to_string()))?;
        Ok(Self { words, threads: module.entry_points[place].workgroup_size.iter().product(), bindings })
    }
}

/// What wgpu-hal 30 sets for a device with Vulkan 1.3, where `ShaderRuntimeChecks::unchecked()` asks for no checks.
fn options() -> spv::Options<'static> {
    spv::Options {
        lang_version: (1, 6),
        flags: spv::WriterFlags::LABEL_VARYINGS | spv::WriterFlags::FORCE_POINT_SIZE,
        capabilities: None,
        bounds_check_policies: BoundsCheckPolicies {
            index: BoundsCheckPolicy::Unchecked,
            buffer: BoundsCheckPolicy::Unchecked,
            image_load: BoundsCheckPolicy::Unchecked,
            binding_array: BoundsCheckPolicy::Unchecked,
        },
        zero_initialize_workgroup_memory: spv::ZeroInitializeWorkgroupMemoryMode::Native,
        force_loop_bounding: false,
        ray_query_initialization_tracking: false,
        task_dispatch_limits: None,
        mesh_shader_primitive_indices_clamp: false,
        emit_int_div_checks: false,
        ..spv::Options::default()
    }
}

//! Mesa's RADV with its null device: the real driver's compiler for a card that is not there. Nothing can be run on it.
//!
//! The driver takes the card from the environment and ends the process where it does not know the card, so it runs in a
//! process of its own, which is told by lines of JSON what to compile.

use std::ffi::{CStr, CString};
use std::io::{self, BufRead, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use ash::vk;
use serde::{Deserialize, Serialize};

use super::{Card, CostError};

/// Where loaders look for drivers.
const DRIVER_FOLDERS: [&str; 3] = ["/usr/share/vulkan/icd.d", "/usr/local/share/vulkan/icd.d", "/etc/vulkan/icd.d"];

/// What is to be compiled.
#[derive(Serialize, Deserialize)]
pub(super) struct Request {
    pub(super) spirv: Vec<u32>,
    pub(super) entry: String,
    /// Of group 0, all of them storage buffers.
    pub(super) bindings: Vec<u32>,
}

/// What the driver made of it.
#[derive(Serialize, Deserialize)]
pub(super) struct Binary {
    /// Name and value, as the driver has them.
    pub(super) statistics: Vec<(String, u64)>,
    /// Threads of a wave.
    pub(super) wave_threads: u32,
    pub(super) assembly: String,
}

impl Binary {
    pub(super) fn statistic(&self, name: &str) -> Option<u64> {
        self.statistics.iter().find(|(found, _)| found == name).map(|(_, value)| *value)
    }
}

/// A process that compiles for one card.
pub(super) struct NullDevice {
    process: Child,
    requests: ChildStdin,
    answers: io::BufReader<ChildStdout>,
    pub(super) opened: Opened,
}

/// What the process says of the device first.
#[derive(Serialize, Deserialize)]
pub(super) struct Opened {
    /// As the driver has it.
    pub(super) name: String,
    /// The driver and its version.
    pub(super) driver: String,
    /// Whether it multiplies matrices as the shaders for matrix units do.
    pub(super) has_matrices: bool,
}

impl NullDevice {
    /// Starts `program`, which calls [`serve`], for `card`.
    ///
    /// # Errors
    /// The driver is not installed, or has no null device for the card.
    pub(super) fn open(program: &Path, card: &Card) -> Result<Self, CostError> {
        let driver = driver().ok_or(CostError::NoDriver)?;
        let mut said = String::new();
        for family in card.families {
            let mut process = Command::new(program)
                .arg(super::SERVE)
                .env("RADV_FORCE_FAMILY", family)
                // The second is what older loaders read.
                .env("VK_DRIVER_FILES", &driver)
                .env("VK_ICD_FILENAMES", &driver)
                .env("MESA_SHADER_CACHE_DISABLE", "true")
                .stdin(Stdio::piped())
                .stdout(Stdio::piped())
                .stderr(Stdio::piped())
                .spawn()
                .map_err(|source| CostError::Process { program: program.to_owned(), source })?;
            let requests = process.stdin.take().expect("it is piped");
            let mut answers = io::BufReader::new(process.stdout.take().expect("it is piped"));
            let mut line = String::new();
            if answers.read_line(&mut line).is_ok()
                && let Ok(Ok(opened)) = serde_json::from_str::<Result<Opened, String>>(&line)
            {
                return Ok(Self { process, requests, answers, opened });
            }
            drop(requests);
            let output = process.wait_with_output().map(|output| output.stderr).unwrap_or_default();
            said = format!("{} {}", line.trim(), String::from_utf8_lossy(&output).trim());
        }
        Err(CostError::NoNullDevice { card: card.name, driver, said })
    }

    /// # Errors
    /// What the driver says.
    pub(super) fn compile(&mut self, request: &Request) -> Result<Binary, String> {
        let died = |error: io::Error| format!("Mesa's compiler ended: {error}");
        let request = serde_json::to_string(request).expect("a request is plain data");
        writeln!(self.requests, "{request}").and_then(|()| self.requests.flush()).map_err(died)?;
        let mut answer = String::new();
        self.answers.read_line(&mut answer).map_err(died)?;
        serde_json::from_str::<Result<Binary, String>>(&answer)
            .unwrap_or_else(|_| Err("Mesa's compiler ended without an answer".to_owned()))
    }
}

impl Drop for NullDevice {
    fn drop(&mut self) {
        // It holds nothing that would have to be saved.
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// The file by which RADV is found: the one that the environment names, or else the installed one.
fn driver() -> Option<PathBuf> {
    if let Some(named) = std::env::var_os("VK_DRIVER_FILES") {
        return Some(named.into());
    }
    let files = DRIVER_FOLDERS.iter().filter_map(|folder| std::fs::read_dir(folder).ok()).flatten();
    let mut files: Vec<_> = files.filter_map(|entry| Some(entry.ok()?.path())).collect();
    files.retain(|path| {
        let name = path.file_name().map(|name| name.to_string_lossy()).unwrap_or_default();
        // A system with drivers for other processors too has theirs besides.
        name.starts_with("radeon_icd") && name.ends_with(".json") && !name.contains("i686")
    });
    files.into_iter().min()
}

/// Tells what device there is, then answers one request after another with what the driver made of it.
///
/// # Errors
/// Standard input or output fail.
pub fn serve() -> io::Result<()> {
    let mut out = io::stdout().lock();
    let mut say = |answer: String| writeln!(out, "{answer}").and_then(|()| out.flush());
    let compiler = Compiler::open();
    let opened = compiler.as_ref().map(|compiler| &compiler.opened);
    say(serde_json::to_string(&opened).expect("it is plain data"))?;
    let Ok(compiler) = compiler else { return Ok(()) };
    for line in io::stdin().lines() {
        let answer = serde_json::from_str(&line?)
            .map_err(|error| error.to_string())
            .and_then(|request| compiler.compile(&request).map_err(|result| format!("Vulkan says {result}")));
        say(serde_json::to_string(&answer).expect("an answer is plain data"))?;
    }
    Ok(())
}

/// The driver's device.
struct Compiler {
    opened: Opened,
    device: ash::Device,
    executables: ash::khr::pipeline_executable_properties::Device,
    instance: ash::Instance,
    _entry: ash::Entry,
}

impl Compiler {
    fn open() -> Result<Self, String> {
        let says = |result: vk::Result| format!("Vulkan says {result}");
        // SAFETY: the loader is a system library; the handles are used by this object alone, which destroys each of
        // them after all that was made from it.
        unsafe {
            let entry = ash::Entry::load().map_err(|error| format!("no Vulkan loader: {error}"))?;
            let application = vk::ApplicationInfo::default().api_version(vk::API_VERSION_1_3);
            let info = vk::InstanceCreateInfo::default().application_info(&application);
            let instance = entry.create_instance(&info, None).map_err(says)?;
            let found = instance
                .enumerate_physical_devices()
                .map_err(says)
                .and_then(|devices| devices.first().copied().ok_or_else(|| "there is no device".to_owned()));
            let opened = found.and_then(|physical| {
                let mut drivers = vk::PhysicalDeviceDriverProperties::default();
                let mut properties = vk::PhysicalDeviceProperties2::default().push_next(&mut drivers);
                instance.get_physical_device_properties2(physical, &mut properties);
                let name = text(&properties.properties.device_name);
                let has_matrices = has_matrices(&entry, &instance, physical).map_err(says)?;
                let opened = Opened { name, driver: text(&drivers.driver_info), has_matrices };
                Ok((opened, device(&instance, physical).map_err(says)?))
            });
            match opened {
                Ok((opened, device)) => {
                    let executables = ash::khr::pipeline_executable_properties::Device::new(&instance, &device);
                    Ok(Self { opened, device, executables, instance, _entry: entry })
                }
                Err(reason) => {
                    instance.destroy_instance(None);
                    Err(reason)
                }
            }
        }
    }

    fn compile(&self, request: &Request) -> Result<Binary, vk::Result> {
        let Self { device, executables, .. } = self;
        let bindings: Vec<_> = request
            .bindings
            .iter()
            .map(|&number| {
                vk::DescriptorSetLayoutBinding::default()
                    .binding(number)
                    .descriptor_type(vk::DescriptorType::STORAGE_BUFFER)
                    .descriptor_count(1)
                    .stage_flags(vk::ShaderStageFlags::COMPUTE)
            })
            .collect();
        let entry = CString::new(request.entry.as_str()).map_err(|_| vk::Result::ERROR_UNKNOWN)?;
        // SAFETY: naga made the module for this entry point and these bindings; what is made here is destroyed in turn
        // where all went well, and where it did not, the process ends soon.
        unsafe {
            let info = vk::DescriptorSetLayoutCreateInfo::default().bindings(&bindings);
            let sets = [device.create_descriptor_set_layout(&info, None)?];
            let layout =
                device.create_pipeline_layout(&vk::PipelineLayoutCreateInfo::default().set_layouts(&sets), None)?;
            let module =
                device.create_shader_module(&vk::ShaderModuleCreateInfo::default().code(&request.spirv), None)?;
            let stage = vk::PipelineShaderStageCreateInfo::default()
                .stage(vk::ShaderStageFlags::COMPUTE)
                .module(module)
                .name(&entry);
            let capture = vk::PipelineCreateFlags::CAPTURE_STATISTICS_KHR
                | vk::PipelineCreateFlags::CAPTURE_INTERNAL_REPRESENTATIONS_KHR;
            let info = vk::ComputePipelineCreateInfo::default().flags(capture).stage(stage).layout(layout);
            let pipelines = device.create_compute_pipelines(vk::PipelineCache::null(), &[info], None);
            let pipeline = pipelines.map_err(|(_, result)| result)?[0];
            let properties =
                executables.get_pipeline_executable_properties(&vk::PipelineInfoKHR::default().pipeline(pipeline))?;
            let which = vk::PipelineExecutableInfoKHR::default().pipeline(pipeline);
            let statistics = executables.get_pipeline_executable_statistics(&which)?;
            let statistics = statistics.iter().filter_map(|statistic| {
                let whole = statistic.format == vk::PipelineExecutableStatisticFormatKHR::UINT64;
                whole.then(|| (text(&statistic.name), statistic.value.u64))
            });
            let binary = Binary {
                statistics: statistics.collect(),
                wave_threads: properties.first().map_or(0, |properties| properties.subgroup_size),
                assembly: self.assembly(&which)?,
            };
            device.destroy_pipeline(pipeline, None);
            device.destroy_shader_module(module, None);
            device.destroy_pipeline_layout(layout, None);
            device.destroy_descriptor_set_layout(sets[0], None);
            Ok(binary)
        }
    }

    /// The executable's last text, in which the driver has its instructions.
    ///
    /// # Safety
    /// `which` names a pipeline of this device that was made with its texts.
    unsafe fn assembly(&self, which: &vk::PipelineExecutableInfoKHR) -> Result<String, vk::Result> {
        let executables = &self.executables;
        // SAFETY: the caller's promise; every text has the room that the driver has asked for.
        unsafe {
            let mut texts = executables.get_pipeline_executable_internal_representations(which)?;
            let mut rooms: Vec<_> = texts.iter().map(|text| vec![0_u8; text.data_size]).collect();
            for (text, room) in texts.iter_mut().zip(&mut rooms) {
                text.p_data = room.as_mut_ptr().cast();
            }
            let mut count = texts.len() as u32;
            let get = executables.fp().get_pipeline_executable_internal_representations_khr;
            get(executables.device(), which, &mut count, texts.as_mut_ptr()).result()?;
            let assembly = texts.iter().zip(rooms).find(|(found, _)| text(&found.name).contains("ssembly"));
            let (_, room) = assembly.ok_or(vk::Result::ERROR_FEATURE_NOT_PRESENT)?;
            Ok(CStr::from_bytes_until_nul(&room).unwrap_or_default().to_string_lossy().into_owned())
        }
    }
}

impl Drop for Compiler {
    fn drop(&mut self) {
        // SAFETY: nothing that was made from them is left.
        unsafe {
            self.device.destroy_device(None);
            self.instance.destroy_instance(None);
        }
    }
}

/// Whether the device has matrices of 16 by 16 numbers of half precision that a subgroup multiplies, and sums up in
/// single precision.
///
/// # Safety
/// `physical` is a device of `instance`.
unsafe fn has_matrices(
    entry: &ash::Entry,
    instance: &ash::Instance,
    physical: vk::PhysicalDevice,
) -> Result<bool, vk::Result> {
    // SAFETY: the caller's promise.
    let offered = unsafe { instance.enumerate_device_extension_properties(physical)? };
    let name = ash::khr::cooperative_matrix::NAME;
    if !offered.iter().any(|found| found.extension_name_as_c_str() == Ok(name)) {
        return Ok(false);
    }
    let matrices = ash::khr::cooperative_matrix::Instance::new(entry, instance);
    // SAFETY: the caller's promise, and the driver has the extension.
    let kinds = unsafe { matrices.get_physical_device_cooperative_matrix_properties(physical)? };
    let (half, single) = (vk::ComponentTypeKHR::FLOAT16, vk::ComponentTypeKHR::FLOAT32);
    Ok(kinds.iter().any(|kind| {
        (kind.m_size, kind.n_size, kind.k_size) == (16, 16, 16)
            && (kind.a_type, kind.b_type, kind.c_type, kind.result_type) == (half, half, single, single)
            && kind.scope == vk::ScopeKHR::SUBGROUP
    }))
}

/// A device with every feature that the driver offers, among them those by which wgpu has accesses checked.
///
/// # Safety
/// `physical` is a device of `instance`.
unsafe fn device(instance: &ash::Instance, physical: vk::PhysicalDevice) -> Result<ash::Device, vk::Result> {
    // SAFETY: the caller's promise.
    unsafe {
        let offered = instance.enumerate_device_extension_properties(physical)?;
        let offers = |name: &CStr| offered.iter().any(|found| found.extension_name_as_c_str() == Ok(name));
        let mut extensions = vec![ash::khr::pipeline_executable_properties::NAME.as_ptr()];
        let mut features11 = vk::PhysicalDeviceVulkan11Features::default();
        let mut features12 = vk::PhysicalDeviceVulkan12Features::default();
        let mut features13 = vk::PhysicalDeviceVulkan13Features::default();
        let mut robustness2 = vk::PhysicalDeviceRobustness2FeaturesEXT::default();
        let mut executables = vk::PhysicalDevicePipelineExecutablePropertiesFeaturesKHR::default();
        let mut matrices = vk::PhysicalDeviceCooperativeMatrixFeaturesKHR::default();
        let mut features = vk::PhysicalDeviceFeatures2::default()
            .push_next(&mut features11)
            .push_next(&mut features12)
            .push_next(&mut features13)
            .push_next(&mut executables);
        if offers(ash::ext::robustness2::NAME) {
            extensions.push(ash::ext::robustness2::NAME.as_ptr());
            features = features.push_next(&mut robustness2);
        }
        if offers(ash::khr::cooperative_matrix::NAME) {
            extensions.push(ash::khr::cooperative_matrix::NAME.as_ptr());
            features = features.push_next(&mut matrices);
        }
        instance.get_physical_device_features2(physical, &mut features);
        let queues = [vk::DeviceQueueCreateInfo::default().queue_priorities(&[1.0])];
        let info = vk::DeviceCreateInfo::default()
            .queue_create_infos(&queues)
            .enabled_extension_names(&extensions)
            .push_next(&mut features);
        instance.create_device(physical, &info, None)
    }
}

fn text(name: &[std::ffi::c_char]) -> String {
    let bytes: Vec<_> = name.iter().map(|&byte| byte as u8).take_while(|&byte| byte != 0).collect();
    String::from_utf8_lossy(&bytes).into_owned()
}

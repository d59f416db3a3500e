//! From levels to the window's pixels: one to one, by copies only, paced by the display.
//!
//! There is no shader that could scale, blend or convert: a picture's bytes are written to a texture and copied to the
//! surface's, both `Bgra8Unorm`. wgpu and the driver allocate and lock within their calls.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use holod_calibration::Resolution;

use super::WindowError;
use crate::packing::PIXEL_BYTES;
use crate::present::PanelFault;

/// The only format: an 8-bit level is stored as it is.
const FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Bgra8Unorm;

/// Whether there is a graphics processor, rather than a processor that plays one.
pub(super) fn has_hardware() -> bool {
    let instance = instance();
    let found = pollster::block_on(instance.enumerate_adapters(wgpu::Backends::VULKAN));
    found.iter().any(|adapter| adapter.get_info().device_type != wgpu::DeviceType::Cpu)
}

fn instance() -> wgpu::Instance {
    wgpu::Instance::new(wgpu::InstanceDescriptor {
        backends: wgpu::Backends::VULKAN,
        ..wgpu::InstanceDescriptor::new_without_display_handle()
    })
}

/// A window's surface and the pictures that can be shown on it.
#[derive(Debug)]
pub(super) struct Scanout {
    // The surface goes before the device, and its owner drops the window after all of this.
    surface: wgpu::Surface<'static>,
    configuration: wgpu::SurfaceConfiguration,
    pictures: Vec<wgpu::Texture>,
    queue: wgpu::Queue,
    device: wgpu::Device,
    lost: Arc<AtomicBool>,
    size: wgpu::Extent3d,
}

impl Scanout {
    /// Opens a device that can show pictures on `target`, and makes room for `pictures` of them.
    ///
    /// # Safety
    /// What `target` points to outlives the result.
    ///
    /// # Errors
    /// [`WindowError`]: there is no such device, or the surface cannot be had as it must be.
    pub(super) unsafe fn open(
        target: wgpu::SurfaceTargetUnsafe,
        resolution: Resolution,
        pictures: usize,
    ) -> Result<Self, WindowError> {
        let instance = instance();
        let vulkan = |reason: String| WindowError::Vulkan { reason };
        // SAFETY: the caller promises what is asked for here.
        let surface = unsafe { instance.create_surface_unsafe(target) }.map_err(|why| vulkan(why.to_string()))?;
        let wanted = wgpu::RequestAdapterOptions {
            power_preference: wgpu::PowerPreference::HighPerformance,
            compatible_surface: Some(&surface),
            ..wgpu::RequestAdapterOptions::default()
        };
        let adapter = pollster::block_on(instance.request_adapter(&wanted)).map_err(|why| vulkan(why.to_string()))?;
        let name = adapter.get_info().name;
        let offers = surface.get_capabilities(&adapter);
        let lacks = |what: &'static str| Err(WindowError::Surface { device: name.clone(), what });
        if !offers.formats.contains(&FORMAT) {
            return lacks("8-bit levels that are not sRGB (Bgra8Unorm)");
        }
        if !offers.present_modes.contains(&wgpu::PresentMode::Fifo) {
            return lacks("pictures in step with the refresh (Fifo)");
        }
        if !offers.alpha_modes.contains(&wgpu::CompositeAlphaMode::Opaque) {
            return lacks("opaque pictures");
        }
        if !offers.usages.contains(wgpu::TextureUsages::COPY_DST) {
            return lacks("pictures that are copied to it");
        }
        let descriptor = wgpu::DeviceDescriptor {
            label: Some("holod-panel"),
            required_limits: wgpu::Limits::downlevel_defaults().using_resolution(adapter.limits()),
            ..wgpu::DeviceDescriptor::default()
        };
        let (device, queue) =
            pollster::block_on(adapter.request_device(&descriptor)).map_err(|why| vulkan(why.to_string()))?;
        let lost = Arc::new(AtomicBool::new(false));
        let flag = lost.clone();
        // Without these two, wgpu panics where a driver fails.
        device.on_uncaptured_error(Arc::new(move |_| flag.store(true, Ordering::Release)));
        let flag = lost.clone();
        device.set_device_lost_callback(move |_, _| flag.store(true, Ordering::Release));

        let (width, height) = (resolution.width as u32, resolution.height as u32);
        let size = wgpu::Extent3d { width, height, depth_or_array_layers: 1 };
        let limit = device.limits().max_texture_dimension_2d;
        if width.max(height) > limit {
            return lacks("pictures as large as the panel");
        }
        let configuration = wgpu::SurfaceConfiguration {
            usage: wgpu::TextureUsages::COPY_DST,
            format: FORMAT,
            color_space: wgpu::SurfaceColorSpace::Auto,
            width,
            height,
            present_mode: wgpu::PresentMode::Fifo,
            desired_maximum_frame_latency: 1,
            alpha_mode: wgpu::CompositeAlphaMode::Opaque,
            view_formats: Vec::new(),
        };
        surface.configure(&device, &configuration);
        let picture = wgpu::TextureDescriptor {
            label: Some("levels"),
            size,
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format: FORMAT,
            usage: wgpu::TextureUsages::COPY_DST | wgpu::TextureUsages::COPY_SRC,
            view_formats: &[],
        };
        let pictures = (0..pictures).map(|_| device.create_texture(&picture)).collect();
        if lost.load(Ordering::Acquire) {
            return Err(vulkan(format!("{name} did not take the surface's size or format")));
        }
        Ok(Self { surface, configuration, pictures, queue, device, lost, size })
    }

    /// Writes a picture: `pixels` has [`PIXEL_BYTES`] for each pixel, row-major: blue, green, red and one that is
    /// unused.
    pub(super) fn write(&self, picture: usize, pixels: &[u8]) {
        let layout = wgpu::TexelCopyBufferLayout {
            offset: 0,
            bytes_per_row: Some(self.size.width * PIXEL_BYTES as u32),
            rows_per_image: None,
        };
        self.queue.write_texture(self.pictures[picture].as_image_copy(), pixels, layout, self.size);
    }

    /// Queues a picture for the next refresh. Waits for the display where it holds all images.
    ///
    /// # Errors
    /// [`PanelFault::DeviceLost`], and [`PanelFault::WindowLost`] where the surface is not to be had as it was, or the
    /// display holds its images for a second.
    pub(super) fn present(&self, picture: usize) -> Result<(), PanelFault> {
        let image = self.image()?;
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        let from = self.pictures[picture].as_image_copy();
        encoder.copy_texture_to_texture(from, image.texture.as_image_copy(), self.size);
        self.queue.submit([encoder.finish()]);
        self.queue.present(image);
        self.check()
    }

    fn image(&self) -> Result<wgpu::SurfaceTexture, PanelFault> {
        use wgpu::CurrentSurfaceTexture as Image;
        let mut acquired = self.surface.get_current_texture();
        if matches!(acquired, Image::Outdated) {
            self.surface.configure(&self.device, &self.configuration);
            acquired = self.surface.get_current_texture();
        }
        self.check()?;
        match acquired {
            // Suboptimal: the server copies, or another window's size would let it flip; the pixels are right.
            Image::Success(image) | Image::Suboptimal(image) => Ok(image),
            Image::Timeout | Image::Occluded | Image::Outdated | Image::Lost | Image::Validation => {
                Err(PanelFault::WindowLost)
            }
        }
    }

    fn check(&self) -> Result<(), PanelFault> {
        if self.lost.load(Ordering::Acquire) { Err(PanelFault::DeviceLost) } else { Ok(()) }
    }
}

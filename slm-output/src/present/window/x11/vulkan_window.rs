//! The window as Vulkan's surface needs it: on a connection of the C library, which Vulkan uses with threads of its
//! own.

use std::ffi::CString;
use std::num::NonZeroU32;
use std::ptr::NonNull;

use holod_calibration::Resolution;
use x11rb::xcb_ffi::XCBConnection;

use super::{X11Error, create_window};
use crate::present::PanelFault;
use crate::present::window::monitors::Monitor;
use crate::present::window::vulkan::Scanout;
use crate::present::window::{Draw, WindowError};

/// The window and its connection.
pub(super) struct VulkanWindow {
    connection: XCBConnection,
    screen: usize,
    window: u32,
}

impl VulkanWindow {
    pub(super) fn create(display: &str, monitor: &Monitor) -> Result<Self, X11Error> {
        let name = CString::new(display).map_err(|_| X11Error::Lacks("name without a zero byte"))?;
        let (connection, screen) = XCBConnection::connect(Some(&name))?;
        let window = create_window(&connection, screen, monitor)?;
        Ok(Self { connection, screen, window })
    }

    pub(super) fn window(&self) -> u32 {
        self.window
    }

    /// Opens the device that draws to it.
    pub(super) fn draw(self, size: Resolution, pictures: usize) -> Result<VulkanDraw, WindowError> {
        let connection = NonNull::new(self.connection.get_raw_xcb_connection());
        let display = wgpu::rwh::XcbDisplayHandle::new(connection, self.screen as i32);
        let no_window = || WindowError::Vulkan { reason: "the X server gave the window no number".to_owned() };
        let window = wgpu::rwh::XcbWindowHandle::new(NonZeroU32::new(self.window).ok_or_else(no_window)?);
        let target = wgpu::SurfaceTargetUnsafe::RawHandle {
            raw_display_handle: Some(display.into()),
            raw_window_handle: window.into(),
        };
        // SAFETY: `self` holds the connection, which the window lives as long as, and is dropped after the scan-out: it
        // was made before it here, and stands below it in `VulkanDraw`.
        let scanout = unsafe { Scanout::open(target, size, pictures) }?;
        Ok(VulkanDraw { scanout, _window: self })
    }
}

/// Draws to the window. The scan-out goes before the window.
pub(super) struct VulkanDraw {
    scanout: Scanout,
    _window: VulkanWindow,
}

impl Draw for VulkanDraw {
    fn write(&mut self, picture: usize, pixels: &[u8]) -> Result<(), PanelFault> {
        self.scanout.write(picture, pixels);
        Ok(())
    }

    fn present(&mut self, picture: usize) -> Result<(), PanelFault> {
        self.scanout.present(picture)
    }
}

//! Pictures that the X server copies to the window at a refresh, by its Present extension.
//!
//! They go through the connection's socket and live in the server's memory. Every X server can do that, and none can
//! scan them out directly.

use holod_calibration::Resolution;
use x11rb::connection::{Connection, RequestConnection};
use x11rb::protocol::present::{self, ConnectionExt as _};
use x11rb::protocol::xproto::{ConnectionExt as _, CreateGCAux, ImageFormat};
use x11rb::rust_connection::RustConnection;
use x11rb::wrapper::ConnectionExt as _;

use super::super::Draw;
use super::{X11Error, create_window};
use crate::packing::PIXEL_BYTES;
use crate::present::PanelFault;
use crate::present::window::monitors::Monitor;

/// The window, and pictures in the server's memory.
pub(super) struct Copies {
    connection: RustConnection,
    window: u32,
    context: u32,
    depth: u8,
    size: Resolution,
    pictures: Vec<u32>,
    /// Rows that fit in one request.
    rows: usize,
    serial: u32,
}

/// Bytes of an image's request before its pixels.
const HEADER_BYTES: usize = 28;

impl Copies {
    pub(super) fn create(display: &str, monitor: &Monitor, pictures: usize) -> Result<Self, X11Error> {
        let (connection, screen) = x11rb::connect(Some(display))?;
        if connection.extension_information(present::X11_EXTENSION_NAME)?.is_none() {
            return Err(X11Error::Lacks("Present extension"));
        }
        connection.present_query_version(1, 0)?.reply()?;
        let window = create_window(&connection, screen, monitor)?;
        let depth = connection.setup().roots[screen].root_depth;
        let context = connection.generate_id()?;
        connection.create_gc(context, window, &CreateGCAux::new())?;
        let size = monitor.mode;
        let picture = || -> Result<u32, X11Error> {
            let picture = connection.generate_id()?;
            connection.create_pixmap(depth, picture, window, size.width as u16, size.height as u16)?.check()?;
            Ok(picture)
        };
        let pictures = (0..pictures).map(|_| picture()).collect::<Result<Vec<_>, _>>()?;
        let rows = (connection.maximum_request_bytes() - HEADER_BYTES) / (PIXEL_BYTES * size.width);
        if rows == 0 {
            return Err(X11Error::Lacks("requests as long as a row of the panel"));
        }
        connection.sync()?;
        Ok(Self { connection, window, context, depth, size, pictures, rows, serial: 0 })
    }

    pub(super) fn window(&self) -> u32 {
        self.window
    }

    fn put(&self, picture: u32, pixels: &[u8]) -> Result<(), X11Error> {
        let row_bytes = PIXEL_BYTES * self.size.width;
        for (index, rows) in pixels.chunks(self.rows * row_bytes).enumerate() {
            let (top, height) = ((index * self.rows) as i16, (rows.len() / row_bytes) as u16);
            let (format, width) = (ImageFormat::Z_PIXMAP, self.size.width as u16);
            self.connection.put_image(format, picture, self.context, width, height, 0, top, 0, self.depth, rows)?;
        }
        Ok(())
    }

    fn show(&self, picture: u32) -> Result<(), X11Error> {
        let next_refresh = 0;
        let (all, anywhere, any_monitor, no_fence) = (0u32, 0, 0u32, 0u32);
        let request = self.connection.present_pixmap(
            self.window,
            picture,
            self.serial,
            all,
            all,
            anywhere,
            anywhere,
            any_monitor,
            no_fence,
            no_fence,
            // Never scanned out as it is: it is written again.
            present::Option::COPY.into(),
            next_refresh,
            0,
            0,
            &[],
        )?;
        request.ignore_error();
        self.connection.flush()?;
        Ok(())
    }
}

impl Draw for Copies {
    fn write(&mut self, picture: usize, pixels: &[u8]) -> Result<(), PanelFault> {
        self.put(self.pictures[picture], pixels).map_err(|_| PanelFault::WindowLost)
    }

    fn present(&mut self, picture: usize) -> Result<(), PanelFault> {
        self.serial = self.serial.wrapping_add(1);
        self.show(self.pictures[picture]).map_err(|_| PanelFault::WindowLost)
    }
}

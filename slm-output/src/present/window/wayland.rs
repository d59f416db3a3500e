//! The panel's window on a Wayland compositor: pictures in shared memory, and the compositor's own word for when each
//! came on the monitor (presentation-time).
//!
//! What a compositor does not tell is not watched: its gamma ramps, power-saving, and notifications over a fullscreen
//! window.

use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use holod_calibration::{Resolution, TimeNs, host_now};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{MemfdFlags, ftruncate, memfd_create};
use wayland_client::backend::{ObjectId, ReadEventsGuard, WaylandError};
use wayland_client::protocol::{
    wl_buffer, wl_callback, wl_compositor, wl_output, wl_pointer, wl_registry, wl_seat, wl_shm, wl_shm_pool, wl_surface,
};
use wayland_client::{Connection, Dispatch, EventQueue, Proxy, QueueHandle, WEnum, delegate_noop};
use wayland_protocols::wp::idle_inhibit::zv1::client::{zwp_idle_inhibit_manager_v1, zwp_idle_inhibitor_v1};
use wayland_protocols::wp::presentation_time::client::wp_presentation;
use wayland_protocols::wp::presentation_time::client::wp_presentation_feedback::{self, Kind};
use wayland_protocols::xdg::shell::client::{xdg_surface, xdg_toplevel, xdg_wm_base};
use wayland_protocols::xdg::xdg_output::zv1::client::{zxdg_output_manager_v1, zxdg_output_v1};

use super::monitors::{Alteration, Monitor, choose, fault_of};
use super::watch::{Completion, Shown, Watched, Watcher};
use super::{Draw, Opened, Wanted, WindowError};
use crate::packing::PIXEL_BYTES;
use crate::present::PanelFault;
use crate::present::drm::{Edid, SYS_CLASS_DRM, seen_connectors};

/// How long the compositor may take to answer.
const PATIENCE: Duration = Duration::from_secs(2);
/// A picture is written to one while the compositor may still read the other.
const COPIES: usize = 2;
/// How long after drawing a picture a compositor tells when it came on the monitor, if it ever does: at 24 Hz some 80 ms.
const TIME_WAIT: TimeNs = TimeNs(200_000_000);
/// How often the watcher looks round where nothing happens.
const LOOK_EVERY: TimeNs = TimeNs(1_000_000_000);

/// Opens the panel's window on the compositor at `socket`, with room for `pictures`. It is on its monitor once the
/// first picture is: see [`Watched::is_placed`].
pub(super) fn open(socket: &Path, wanted: &Wanted, pictures: usize) -> Result<Opened, WindowError> {
    let failed = |reason: String| WindowError::Server { server: format!("compositor {}", socket.display()), reason };
    let stream = UnixStream::connect(socket).map_err(|why| failed(why.to_string()))?;
    let connection = Connection::from_socket(stream).map_err(|why| failed(why.to_string()))?;
    let mut queue = connection.new_event_queue();
    let handle = queue.handle();
    connection.display().get_registry(&handle, ());
    let mut view = View::default();
    // The first brings the compositor's objects, the second what they say of themselves, the third their logical sizes.
    for _ in 0..3 {
        queue.roundtrip(&mut view).map_err(|why| failed(why.to_string()))?;
        view.ask_for_logical_sizes(&handle);
    }
    let monitor = choose(&view.monitors(), &wanted.spec, &wanted.panel)?.clone();
    let lacks = |what: &str| failed(format!("it has no {what}, which holod needs"));
    let compositor = view.compositor.clone().ok_or_else(|| lacks("wl_compositor of version 4"))?;
    let shell = view.shell.clone().ok_or_else(|| lacks("xdg_wm_base"))?;
    let memory = view.memory.clone().ok_or_else(|| lacks("wl_shm"))?;
    let output =
        view.outputs.iter().find(|output| output.connector == monitor.connector).map(|output| output.proxy.clone());

    let surface = compositor.create_surface(&handle, ());
    let window = shell.get_xdg_surface(&surface, &handle, ());
    let toplevel = window.get_toplevel(&handle, ());
    toplevel.set_title("holod panel".to_owned());
    toplevel.set_app_id("holod".to_owned());
    toplevel.set_fullscreen(output.as_ref());
    if let Some(inhibitors) = &view.inhibitors {
        // For as long as the surface lasts.
        inhibitors.create_inhibitor(&surface, &handle, ());
    }
    surface.commit();
    let t_end = Instant::now() + PATIENCE;
    while !view.configured {
        if Instant::now() >= t_end {
            return Err(WindowError::NotShown { monitor: Box::new(monitor), fault: PanelFault::WindowLost });
        }
        queue.roundtrip(&mut view).map_err(|why| failed(why.to_string()))?;
    }
    let pictures =
        Pictures::new(&memory, monitor.mode, pictures, &handle).map_err(|why| WindowError::System(why.into()))?;
    let draw = WaylandDraw {
        connection: connection.clone(),
        handle,
        surface: surface.clone(),
        presentation: view.presentation.clone(),
        pictures,
        serial: 0,
    };
    let (shown, wanted) = (monitor.clone(), wanted.clone());
    let watched = Watched::start(monitor, true, None, move |watcher| {
        let fault = watch(queue, view, &shown, &wanted, watcher).unwrap_or(PanelFault::WindowLost);
        // No monitor may show the pattern until the panel is back.
        surface.attach(None, 0, 0);
        surface.commit();
        let _gone_anyway = connection.flush();
        fault
    })?;
    Ok(Opened { draw: Box::new(draw), watched })
}

/// Watches until something is wrong or the panel is closed; `None` where the connection is broken.
fn watch(
    mut queue: EventQueue<View>,
    mut view: View,
    monitor: &Monitor,
    wanted: &Wanted,
    watcher: &mut Watcher,
) -> Option<PanelFault> {
    let handle = queue.handle();
    loop {
        queue.dispatch_pending(&mut view).ok()?;
        view.ask_for_logical_sizes(&handle);
        view.completed.extend(view.answers.waited(host_now()));
        for completion in view.completed.drain(..) {
            watcher.completed(completion);
        }
        if let Some(fault) = view.fault(monitor, wanted) {
            return Some(fault);
        }
        if view.placed {
            watcher.placed();
        }
        queue.flush().ok()?;
        let Some(guard) = queue.prepare_read() else { continue };
        let now = host_now();
        let patience =
            view.answers.t_waited().map_or(LOOK_EVERY, |t_waited| (t_waited - now).clamp(TimeNs(0), LOOK_EVERY));
        let timeout = Timespec { tv_sec: patience.0 / 1_000_000_000, tv_nsec: patience.0 % 1_000_000_000 };
        let mut fds = [
            PollFd::from_borrowed_fd(guard.connection_fd(), PollFlags::IN),
            PollFd::from_borrowed_fd(watcher.order().as_fd(), PollFlags::IN),
        ];
        match poll(&mut fds, Some(&timeout)) {
            Ok(_) | Err(rustix::io::Errno::INTR) => {}
            Err(_) => return None,
        }
        let [readable, ordered] = fds.map(|fd| !fd.revents().is_empty());
        if ordered {
            return Some(PanelFault::WindowLost);
        }
        if readable {
            take_in(guard).ok()?;
        }
    }
}

/// Reads what the compositor has sent. What has come may be half a message, or one to the library alone, which then
/// says that nothing came.
fn take_in(guard: ReadEventsGuard) -> Result<(), WaylandError> {
    match guard.read() {
        Err(WaylandError::Io(why)) if why.kind() == io::ErrorKind::WouldBlock => Ok(()),
        read => read.map(drop),
    }
}

/// What the compositor has said.
#[derive(Default)]
struct View {
    compositor: Option<wl_compositor::WlCompositor>,
    memory: Option<wl_shm::WlShm>,
    shell: Option<xdg_wm_base::XdgWmBase>,
    presentation: Option<wp_presentation::WpPresentation>,
    inhibitors: Option<zwp_idle_inhibit_manager_v1::ZwpIdleInhibitManagerV1>,
    logical_sizes: Option<zxdg_output_manager_v1::ZxdgOutputManagerV1>,
    outputs: Vec<Output>,
    /// Presentation times are of the monotonic clock.
    times_are_monotonic: bool,
    /// The window's size and states as they were last configured.
    size: (i32, i32),
    states: Vec<u32>,
    /// Pictures may be shown.
    configured: bool,
    closed: bool,
    /// The outputs that show a part of the window.
    entered: Vec<ObjectId>,
    /// The window has been all of its monitor's picture.
    placed: bool,
    answers: Answers,
    completed: Vec<Completion>,
}

/// Makes one completion for each picture of what a compositor says: that it has drawn it, and, where it can, when it
/// came on the monitor, or that it never did. The first may be said long before the picture is seen, so it is taken
/// only of a compositor that tells no times. No clock is read here.
#[derive(Debug, Default)]
struct Answers {
    complete_by: CompleteBy,
    /// Number of the last picture that is complete.
    completed: u32,
}

/// What completes a picture.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
enum CompleteBy {
    /// It is not known yet, and nothing was drawn.
    #[default]
    Unknown,
    /// It is not known yet, and the time of this picture is waited for.
    Awaiting {
        serial: u32,
        t_waited: TimeNs,
    },
    Drawing,
    Time,
}

impl Answers {
    /// Picture `serial` was drawn at `now`.
    fn drawn(&mut self, serial: u32, now: TimeNs) -> Option<Completion> {
        match self.complete_by {
            CompleteBy::Unknown | CompleteBy::Awaiting { .. } => {
                self.complete_by = CompleteBy::Awaiting { serial, t_waited: now + TIME_WAIT };
                None
            }
            CompleteBy::Drawing => self.once(without_time(serial, Shown::Copied)),
            CompleteBy::Time => None,
        }
    }

    /// A picture came on the monitor.
    fn presented(&mut self, completion: Completion) -> Option<Completion> {
        self.complete_by = CompleteBy::Time;
        self.once(completion)
    }

    /// No time is told of picture `serial`: it was never seen, or the compositor tells none of any.
    fn discarded(&mut self, serial: u32) -> Option<Completion> {
        match self.complete_by {
            CompleteBy::Time => self.once(without_time(serial, Shown::Skipped)),
            CompleteBy::Awaiting { .. } => self.give_times_up(),
            CompleteBy::Unknown => {
                self.complete_by = CompleteBy::Drawing;
                None
            }
            CompleteBy::Drawing => None,
        }
    }

    /// Until when a time is waited for.
    fn t_waited(&self) -> Option<TimeNs> {
        match self.complete_by {
            CompleteBy::Awaiting { t_waited, .. } => Some(t_waited),
            _ => None,
        }
    }

    /// Gives up waiting for a time where `now` is too late for it.
    fn waited(&mut self, now: TimeNs) -> Option<Completion> {
        self.t_waited().filter(|t_waited| now >= *t_waited).and_then(|_| self.give_times_up())
    }

    fn give_times_up(&mut self) -> Option<Completion> {
        let drawn = std::mem::replace(&mut self.complete_by, CompleteBy::Drawing);
        let CompleteBy::Awaiting { serial, .. } = drawn else { return None };
        self.once(without_time(serial, Shown::Copied))
    }

    fn once(&mut self, completion: Completion) -> Option<Completion> {
        let further = completion.serial.wrapping_sub(self.completed);
        if further == 0 || further > u32::MAX / 2 {
            return None;
        }
        self.completed = completion.serial;
        Some(completion)
    }
}

fn without_time(serial: u32, shown: Shown) -> Completion {
    Completion { serial, t_present: TimeNs(0), refresh_count: 0, shown }
}

/// A monitor, as far as the compositor has described it.
struct Output {
    global: u32,
    proxy: wl_output::WlOutput,
    logical: Option<zxdg_output_v1::ZxdgOutputV1>,
    described: bool,
    connector: String,
    make: String,
    model: String,
    upright: bool,
    scale: i32,
    mode: (i32, i32),
    refresh_mhz: i32,
    position: (i32, i32),
    logical_size: Option<(i32, i32)>,
}

impl Output {
    fn new(global: u32, proxy: wl_output::WlOutput) -> Self {
        Self {
            global,
            proxy,
            logical: None,
            described: false,
            connector: String::new(),
            make: String::new(),
            model: String::new(),
            upright: true,
            scale: 1,
            mode: (0, 0),
            refresh_mhz: 0,
            position: (0, 0),
            logical_size: None,
        }
    }

    fn monitor(&self) -> Monitor {
        let mut alterations = Vec::new();
        if !self.upright {
            alterations.push(Alteration::Transformed);
        } else if self.scale != 1 || self.logical_size.is_some_and(|size| size != self.mode) {
            alterations.push(Alteration::Scaled);
        }
        let by_name = |name: &String| (!name.is_empty()).then(|| name.clone());
        let told = || Edid {
            maker: self.make.clone(),
            product: 0,
            serial_number: 0,
            name: by_name(&self.model),
            serial: None,
            native: None,
            takes_ycbcr_444: false,
        };
        Monitor {
            connector: self.connector.clone(),
            edid: edid_of(&self.connector).or_else(|| (!self.make.is_empty()).then(told)),
            primary: false,
            left_px: self.position.0,
            top_px: self.position.1,
            mode: Resolution { width: self.mode.0.max(0) as usize, height: self.mode.1.max(0) as usize },
            refresh_hz: (self.refresh_mhz > 0).then(|| f64::from(self.refresh_mhz) / 1000.0),
            alterations,
        }
    }

    fn meets(&self, other: &Self) -> bool {
        let size = |output: &Self| output.logical_size.unwrap_or(output.mode);
        let overlap = |a: i32, length_a: i32, b: i32, length_b: i32| a < b + length_b && b < a + length_a;
        overlap(self.position.0, size(self).0, other.position.0, size(other).0)
            && overlap(self.position.1, size(self).1, other.position.1, size(other).1)
    }
}

/// The EDID of a connector, whose name compositors take from the kernel.
fn edid_of(connector: &str) -> Option<Edid> {
    seen_connectors(Path::new(SYS_CLASS_DRM)).0.into_iter().find(|seen| seen.name == connector)?.edid
}

impl View {
    fn ask_for_logical_sizes(&mut self, handle: &QueueHandle<Self>) {
        let Some(manager) = &self.logical_sizes else { return };
        for output in self.outputs.iter_mut().filter(|output| output.logical.is_none()) {
            output.logical = Some(manager.get_xdg_output(&output.proxy, handle, output.global));
        }
    }

    fn output(&mut self, global: u32) -> Option<&mut Output> {
        self.outputs.iter_mut().find(|output| output.global == global)
    }

    fn monitors(&self) -> Vec<Monitor> {
        let described = || self.outputs.iter().filter(|output| output.described);
        let with_mirror = |output: &Output| {
            let mut monitor = output.monitor();
            let mirror = described().find(|other| other.global != output.global && other.meets(output));
            monitor.alterations.extend(mirror.map(|other| Alteration::Mirrored(other.connector.clone())));
            monitor
        };
        described().map(with_mirror).collect()
    }

    fn is_fullscreen(&self, monitor: &Monitor) -> bool {
        let (width, height) = self.size;
        let covers =
            usize::try_from(width) == Ok(monitor.mode.width) && usize::try_from(height) == Ok(monitor.mode.height);
        let is = |state: xdg_toplevel::State| self.states.contains(&u32::from(state));
        covers && is(xdg_toplevel::State::Fullscreen) && !is(xdg_toplevel::State::Suspended)
    }

    /// Whether the window is on `monitor` and on no other one.
    fn is_on(&self, monitor: &Monitor) -> bool {
        let shows = |output: &&Output| self.entered.contains(&output.proxy.id());
        self.outputs.iter().filter(shows).map(|output| &output.connector).eq([&monitor.connector])
    }

    /// What keeps the window from being all of `monitor`'s picture, if anything does.
    fn fault(&mut self, monitor: &Monitor, wanted: &Wanted) -> Option<PanelFault> {
        let fault = fault_of(monitor, &self.monitors(), &wanted.spec, &wanted.panel);
        if fault.is_some() {
            return fault;
        }
        let is_there = self.is_on(monitor) && self.is_fullscreen(monitor);
        // It gets there with its first picture.
        let strayed = self.placed && !is_there;
        self.placed |= is_there;
        (self.closed || strayed).then_some(PanelFault::WindowLost)
    }
}

/// The memory that the compositor reads pictures from.
struct Pictures {
    file: OwnedFd,
    buffers: Vec<Buffer>,
}

struct Buffer {
    proxy: wl_buffer::WlBuffer,
    /// Where it begins in the memory.
    offset: u64,
    /// The compositor may still read it.
    busy: Arc<AtomicBool>,
}

impl Pictures {
    fn new(
        memory: &wl_shm::WlShm,
        size: Resolution,
        pictures: usize,
        handle: &QueueHandle<View>,
    ) -> rustix::io::Result<Self> {
        let bytes = PIXEL_BYTES * size.pixels();
        let file = memfd_create("holod-panel", MemfdFlags::CLOEXEC)?;
        let count = pictures * COPIES;
        let whole = i32::try_from(bytes * count).map_err(|_| rustix::io::Errno::FBIG)?;
        ftruncate(&file, whole as u64)?;
        let pool = memory.create_pool(file.as_fd(), whole, handle, ());
        let (width, height) = (size.width as i32, size.height as i32);
        let buffer = |index: usize| {
            let busy = Arc::new(AtomicBool::new(false));
            let (offset, stride, format) =
                ((index * bytes) as i32, width * PIXEL_BYTES as i32, wl_shm::Format::Xrgb8888);
            let proxy = pool.create_buffer(offset, width, height, stride, format, handle, busy.clone());
            Buffer { proxy, offset: (index * bytes) as u64, busy }
        };
        let buffers = (0..count).map(buffer).collect();
        pool.destroy();
        Ok(Self { file, buffers })
    }
}

/// Draws to the window, from the panel thread.
struct WaylandDraw {
    connection: Connection,
    handle: QueueHandle<View>,
    surface: wl_surface::WlSurface,
    presentation: Option<wp_presentation::WpPresentation>,
    pictures: Pictures,
    serial: u32,
}

impl Draw for WaylandDraw {
    fn write(&mut self, picture: usize, mut pixels: &[u8]) -> Result<(), PanelFault> {
        // A picture is shown from the first of its copies; the one that is free is brought there.
        let copies = &mut self.pictures.buffers[COPIES * picture..][..COPIES];
        let is_free = |buffer: &Buffer| !buffer.busy.load(Ordering::Acquire);
        let free = copies.iter().position(is_free).ok_or(PanelFault::WindowLost)?;
        copies.swap(0, free);
        let mut offset = copies[0].offset;
        while !pixels.is_empty() {
            let written = rustix::io::pwrite(&self.pictures.file, pixels, offset).map_err(PanelFault::System)?;
            pixels = &pixels[written..];
            offset += written as u64;
        }
        Ok(())
    }

    fn present(&mut self, picture: usize) -> Result<(), PanelFault> {
        let buffer = &self.pictures.buffers[COPIES * picture];
        buffer.busy.store(true, Ordering::Release);
        self.serial = self.serial.wrapping_add(1);
        self.surface.attach(Some(&buffer.proxy), 0, 0);
        self.surface.damage_buffer(0, 0, i32::MAX, i32::MAX);
        if let Some(presentation) = &self.presentation {
            presentation.feedback(&self.surface, &self.handle, self.serial);
        }
        self.surface.frame(&self.handle, self.serial);
        self.surface.commit();
        self.connection.flush().map_err(|_| PanelFault::WindowLost)
    }
}

impl Dispatch<wl_registry::WlRegistry, ()> for View {
    fn event(
        view: &mut Self,
        registry: &wl_registry::WlRegistry,
        event: wl_registry::Event,
        _: &(),
        _: &Connection,
        handle: &QueueHandle<Self>,
    ) {
        match event {
            wl_registry::Event::Global { name, interface, version } => match interface.as_str() {
                "wl_compositor" if version >= 4 => view.compositor = Some(registry.bind(name, 4, handle, ())),
                "wl_shm" => view.memory = Some(registry.bind(name, 1, handle, ())),
                "wl_seat" => drop(registry.bind::<wl_seat::WlSeat, _, _>(name, 1, handle, ())),
                // Version 6 tells when a window is not shown.
                "xdg_wm_base" => view.shell = Some(registry.bind(name, version.min(6), handle, ())),
                "wp_presentation" => view.presentation = Some(registry.bind(name, 1, handle, ())),
                "zwp_idle_inhibit_manager_v1" => view.inhibitors = Some(registry.bind(name, 1, handle, ())),
                "zxdg_output_manager_v1" => view.logical_sizes = Some(registry.bind(name, version.min(3), handle, ())),
                // Version 2 tells when it has said all, version 4 the connector's name.
                "wl_output" if version >= 2 => {
                    view.outputs.push(Output::new(name, registry.bind(name, version.min(4), handle, name)));
                }
                _ => {}
            },
            wl_registry::Event::GlobalRemove { name } => view.outputs.retain(|output| output.global != name),
            _ => {}
        }
    }
}

impl Dispatch<wl_output::WlOutput, u32> for View {
    fn event(
        view: &mut Self,
        _: &wl_output::WlOutput,
        event: wl_output::Event,
        &global: &u32,
        _: &Connection,
        _: &QueueHandle<Self>,
    ) {
        let Some(output) = view.output(global) else { return };
        match event {
            wl_output::Event::Geometry { x, y, make, model, transform, .. } => {
                output.upright = transform == WEnum::Value(wl_output::Transform::Normal);
                output.make = make;
                output.model = model;
                if output.logical_size.is_none() {
                    output.position = (x, y);
                }
            }
            wl_output::Event::Mode { flags: WEnum::Value(flags), width, height, refresh }
                if flags.contains(wl_output::Mode::Current) =>
            {
                output.mode = (width, height);
                output.refresh_mhz = refresh;
            }
            wl_output::Event::Scale { factor } => output.scale = factor,
            wl_output::Event::Name { name } => output.connector = name,
            wl_output::Event::Done => output.described = true,
            _ => {}
        }
    }
}

impl Dispatch<zxdg_output_v1::ZxdgOutputV1, u32> for View {
    fn event(
        view: &mut Self,
        _: &zxdg_output_v1::ZxdgOutputV1,
        event: zxdg_output_v1::Event,
        &global: &u32,
        _: &Connection,
        _: &QueueHandle<Self>,
    ) {
        let Some(output) = view.output(global) else { return };
        match event {
            zxdg_output_v1::Event::Name { name } => output.connector = name,
            zxdg_output_v1::Event::LogicalPosition { x, y } => output.position = (x, y),
            zxdg_output_v1::Event::LogicalSize { width, height } => output.logical_size = Some((width, height)),
            _ => {}
        }
    }
}

impl Dispatch<xdg_wm_base::XdgWmBase, ()> for View {
    fn event(
        _: &mut Self,
        shell: &xdg_wm_base::XdgWmBase,
        event: xdg_wm_base::Event,
        _: &(),
        _: &Connection,
        _: &QueueHandle<Self>,
    ) {
        if let xdg_wm_base::Event::Ping { serial } = event {
            shell.pong(serial);
        }
    }
}

impl Dispatch<xdg_surface::XdgSurface, ()> for View {
    fn event(
        view: &mut Self,
        window: &xdg_surface::XdgSurface,
        event: xdg_surface::Event,
        _: &(),
        _: &Connection,
        _: &QueueHandle<Self>,
    ) {
        if let xdg_surface::Event::Configure { serial } = event {
            window.ack_configure(serial);
            view.configured = true;
        }
    }
}

impl Dispatch<xdg_toplevel::XdgToplevel, ()> for View {
    fn event(
        view: &mut Self,
        _: &xdg_toplevel::XdgToplevel,
        event: xdg_toplevel::Event,
        _: &(),
        _: &Connection,
        _: &QueueHandle<Self>,
    ) {
        match event {
            xdg_toplevel::Event::Configure { width, height, states } => {
                view.size = (width, height);
                let number = |bytes: &[u8]| bytes.try_into().map_or(0, u32::from_ne_bytes);
                view.states = states.chunks_exact(4).map(number).collect();
            }
            xdg_toplevel::Event::Close => view.closed = true,
            _ => {}
        }
    }
}

impl Dispatch<wl_surface::WlSurface, ()> for View {
    fn event(
        view: &mut Self,
        _: &wl_surface::WlSurface,
        event: wl_surface::Event,
        _: &(),
        _: &Connection,
        _: &QueueHandle<Self>,
    ) {
        match event {
            wl_surface::Event::Enter { output } => view.entered.push(output.id()),
            wl_surface::Event::Leave { output } => view.entered.retain(|entered| *entered != output.id()),
            _ => {}
        }
    }
}

impl Dispatch<wp_presentation::WpPresentation, ()> for View {
    fn event(
        view: &mut Self,
        _: &wp_presentation::WpPresentation,
        event: wp_presentation::Event,
        _: &(),
        _: &Connection,
        _: &QueueHandle<Self>,
    ) {
        if let wp_presentation::Event::ClockId { clk_id } = event {
            view.times_are_monotonic = clk_id == rustix::time::ClockId::Monotonic as u32;
        }
    }
}

/// What the compositor says of a picture that came on the monitor at `time`, in seconds and nanoseconds of the
/// monotonic clock.
fn presented(serial: u32, time: Option<(u64, u32)>, refresh_count: u64, flags: WEnum<Kind>) -> Completion {
    let t_present = time.map_or(0, |(seconds, nanoseconds)| {
        i64::try_from(seconds).unwrap_or(0).saturating_mul(1_000_000_000).saturating_add(nanoseconds.into())
    });
    // Only then the time is that of the display controller, and the refresh the one that showed it.
    let stamped = Kind::Vsync | Kind::HwClock | Kind::HwCompletion;
    let is_stamped = time.is_some() && matches!(flags, WEnum::Value(flags) if flags.contains(stamped));
    let shown = if is_stamped { Shown::Flipped } else { Shown::Copied };
    Completion { serial, t_present: TimeNs(t_present), refresh_count, shown }
}

/// A number that the protocol carries in two halves.
fn joined(high: u32, low: u32) -> u64 {
    u64::from(high) << 32 | u64::from(low)
}

impl Dispatch<wp_presentation_feedback::WpPresentationFeedback, u32> for View {
    fn event(
        view: &mut Self,
        _: &wp_presentation_feedback::WpPresentationFeedback,
        event: wp_presentation_feedback::Event,
        &serial: &u32,
        _: &Connection,
        _: &QueueHandle<Self>,
    ) {
        use wp_presentation_feedback::Event;
        let completion = match event {
            Event::Presented { tv_sec_hi, tv_sec_lo, tv_nsec, seq_hi, seq_lo, flags, .. } => {
                let time = Some((joined(tv_sec_hi, tv_sec_lo), tv_nsec)).filter(|_| view.times_are_monotonic);
                view.answers.presented(presented(serial, time, joined(seq_hi, seq_lo), flags))
            }
            Event::Discarded => view.answers.discarded(serial),
            _ => None,
        };
        view.completed.extend(completion);
    }
}

/// A compositor asks for the next picture once it has drawn one.
impl Dispatch<wl_callback::WlCallback, u32> for View {
    fn event(
        view: &mut Self,
        _: &wl_callback::WlCallback,
        event: wl_callback::Event,
        &serial: &u32,
        _: &Connection,
        _: &QueueHandle<Self>,
    ) {
        if let wl_callback::Event::Done { .. } = event {
            view.completed.extend(view.answers.drawn(serial, host_now()));
        }
    }
}

impl Dispatch<wl_buffer::WlBuffer, Arc<AtomicBool>> for View {
    fn event(
        _: &mut Self,
        _: &wl_buffer::WlBuffer,
        event: wl_buffer::Event,
        busy: &Arc<AtomicBool>,
        _: &Connection,
        _: &QueueHandle<Self>,
    ) {
        if let wl_buffer::Event::Release = event {
            busy.store(false, Ordering::Release);
        }
    }
}

impl Dispatch<wl_seat::WlSeat, ()> for View {
    fn event(
        _: &mut Self,
        seat: &wl_seat::WlSeat,
        event: wl_seat::Event,
        _: &(),
        _: &Connection,
        handle: &QueueHandle<Self>,
    ) {
        if let wl_seat::Event::Capabilities { capabilities: WEnum::Value(capabilities) } = event
            && capabilities.contains(wl_seat::Capability::Pointer)
        {
            seat.get_pointer(handle, ());
        }
    }
}

impl Dispatch<wl_pointer::WlPointer, ()> for View {
    fn event(
        _: &mut Self,
        pointer: &wl_pointer::WlPointer,
        event: wl_pointer::Event,
        _: &(),
        _: &Connection,
        _: &QueueHandle<Self>,
    ) {
        // Over the panel there is no cursor.
        if let wl_pointer::Event::Enter { serial, .. } = event {
            pointer.set_cursor(serial, None, 0, 0);
        }
    }
}

delegate_noop!(View: ignore wl_compositor::WlCompositor);
delegate_noop!(View: ignore wl_shm::WlShm);
delegate_noop!(View: ignore wl_shm_pool::WlShmPool);
delegate_noop!(View: ignore zwp_idle_inhibit_manager_v1::ZwpIdleInhibitManagerV1);
delegate_noop!(View: ignore zwp_idle_inhibitor_v1::ZwpIdleInhibitorV1);
delegate_noop!(View: ignore zxdg_output_manager_v1::ZxdgOutputManagerV1);

#[cfg(test)]
mod tests {
    use std::io::Write as _;

    use super::*;

    const MS: i64 = 1_000_000;

    fn flipped(serial: u32) -> Completion {
        Completion { serial, t_present: TimeNs(16 * MS), refresh_count: 1, shown: Shown::Flipped }
    }

    #[test]
    fn of_a_compositor_that_tells_times_a_picture_is_complete_once_by_its_own_time() {
        let mut answers = Answers::default();
        assert_eq!(answers.drawn(1, TimeNs(0)), None);
        assert_eq!(answers.waited(TimeNs(199 * MS)), None);
        assert_eq!(answers.presented(flipped(1)), Some(flipped(1)));
        assert_eq!(answers.t_waited(), None);
        assert_eq!([answers.drawn(2, TimeNs(0)), answers.presented(flipped(1))], [None, None]);
        assert_eq!(answers.presented(flipped(2)), Some(flipped(2)));
        assert_eq!(answers.discarded(3), Some(without_time(3, Shown::Skipped)));
        assert_eq!(answers.presented(flipped(3)), None);
    }

    #[test]
    fn of_one_that_tells_none_a_picture_is_complete_once_it_is_drawn() {
        let copied = |serial| Some(without_time(serial, Shown::Copied));
        // It says nothing of the first, says that there is no time of it before it is drawn, or after.
        let mut silent = Answers::default();
        assert_eq!(silent.drawn(1, TimeNs(0)), None);
        assert_eq!([silent.waited(TimeNs(199 * MS)), silent.waited(TimeNs(200 * MS))], [None, copied(1)]);
        let mut before = Answers::default();
        assert_eq!([before.discarded(1), before.drawn(1, TimeNs(0))], [None, copied(1)]);
        let mut after = Answers::default();
        assert_eq!([after.drawn(1, TimeNs(0)), after.discarded(1)], [None, copied(1)]);
        for mut answers in [silent, before, after] {
            assert_eq!([answers.drawn(2, TimeNs(0)), answers.discarded(2)], [copied(2), None]);
            // One that was only slow: its times are taken from then on, and of no picture twice.
            assert_eq!(answers.presented(flipped(2)), None);
            assert_eq!([answers.drawn(3, TimeNs(0)), answers.presented(flipped(3))], [None, Some(flipped(3))]);
        }
    }

    #[test]
    fn numbers_of_pictures_may_begin_again() {
        let mut answers = Answers { complete_by: CompleteBy::Time, completed: u32::MAX };
        assert_eq!(answers.presented(flipped(u32::MAX - 1)), None);
        assert_eq!(answers.presented(flipped(0)), Some(flipped(0)));
    }

    #[test]
    fn half_a_message_and_one_to_the_library_alone_are_no_broken_connection() {
        let (client, mut compositor) = UnixStream::pair().unwrap();
        let connection = Connection::from_socket(client).unwrap();
        let mut read = |bytes: &[u8]| {
            compositor.write_all(bytes).unwrap();
            take_in(connection.prepare_read().expect("nothing is left to be dispatched"))
        };
        // wl_display.delete_id of an object that was never there, first whole, then its first half.
        let message = [1u32, 12 << 16 | 1, 77].map(u32::to_ne_bytes).concat();
        assert!(read(&message).is_ok());
        assert!(read(&message[..6]).is_ok());
        drop(compositor);
        assert!(take_in(connection.prepare_read().unwrap()).is_err(), "a compositor that has gone");
    }

    #[test]
    fn only_the_display_controllers_own_time_is_taken_for_a_flip() {
        let all = Kind::Vsync | Kind::HwClock | Kind::HwCompletion;
        let told = |time, flags: Kind| presented(7, time, joined(1, 2), WEnum::Value(flags));
        let stamped = Completion {
            serial: 7,
            t_present: TimeNs(12_000_000_345),
            refresh_count: 0x1_0000_0002,
            shown: Shown::Flipped,
        };
        assert_eq!(told(Some((12, 345)), all), stamped);
        assert_eq!(told(Some((12, 345)), all | Kind::ZeroCopy), stamped);
        for missing in [Kind::Vsync, Kind::HwClock, Kind::HwCompletion] {
            assert_eq!(told(Some((12, 345)), all - missing), Completion { shown: Shown::Copied, ..stamped });
        }
        // Of another clock than the monotonic one no time is taken.
        let unknown = Completion { shown: Shown::Copied, t_present: TimeNs(0), ..stamped };
        assert_eq!(told(None, all), unknown);
        assert_eq!(presented(7, Some((12, 345)), 1, WEnum::Unknown(255)).shown, Shown::Copied);
    }
}

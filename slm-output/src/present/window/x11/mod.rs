//! The panel's window on an X server.
//!
//! Two connections: on one the window lives and is drawn to ([`copies`], `vulkan_window`); the other, which only this
//! file reads, watches both the window and the monitors. The window is one that window managers leave alone
//! (override-redirect): none moves, decorates or focuses it, and none is needed.

mod copies;
#[cfg(feature = "vulkan")]
mod vulkan_window;

use std::os::fd::{AsFd, OwnedFd};
use std::time::{Duration, Instant};

use holod_calibration::{Resolution, TimeNs};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use x11rb::connection::{Connection, RequestConnection};
use x11rb::errors::{ConnectError, ConnectionError, ReplyError, ReplyOrIdError};
use x11rb::protocol::Event;
use x11rb::protocol::dpms::{self, ConnectionExt as _, DPMSMode};
use x11rb::protocol::present::{self, CompleteKind, CompleteMode, ConnectionExt as _};
use x11rb::protocol::randr::{self, ConnectionExt as _, ModeFlag, NotifyMask, Rotation};
use x11rb::protocol::render::Transform;
use x11rb::protocol::screensaver::{self, ConnectionExt as _};
use x11rb::protocol::xproto::{
    AtomEnum, ChangeWindowAttributesAux, ConnectionExt as _, CreateGCAux, CreateWindowAux, EventMask, MapState,
    PropMode, Rectangle, Screen, Visibility, WindowClass,
};
use x11rb::rust_connection::RustConnection;
use x11rb::wrapper::ConnectionExt as _;

use super::monitors::{Alteration, Monitor, choose, fault_of};
use super::watch::{Completion, Shown, Watched, Watcher};
use super::{Draw, Opened, Road, Wanted, WindowError};
use crate::present::PanelFault;
use crate::present::drm::Edid;

/// How long a window may take to come up.
const PATIENCE: Duration = Duration::from_secs(2);
/// How often the things are looked at of which no event tells: the gamma ramp and power-saving.
const LOOK_EVERY: Duration = Duration::from_millis(500);

/// Opens the panel's window on the X server `display`, with room for `pictures`, and waits until it covers its monitor.
pub(super) fn open(display: &str, wanted: &Wanted, road: Road, pictures: usize) -> Result<Opened, WindowError> {
    let failed = |why: X11Error| why.at(display);
    let mut view = View::connect(display).map_err(failed)?;
    if view.is_xwayland().map_err(failed)? {
        return Err(WindowError::Xwayland { display: display.to_owned() });
    }
    let monitor = choose(&view.monitors().map_err(failed)?, &wanted.spec, &wanted.panel)?.clone();
    let mut up = |window: u32| bring_up(&mut view, window, display, &monitor, wanted);
    let draw: Box<dyn Draw> = match road {
        #[cfg(feature = "vulkan")]
        Road::Vulkan => {
            let window = vulkan_window::VulkanWindow::create(display, &monitor).map_err(failed)?;
            up(window.window())?;
            Box::new(window.draw(monitor.mode, pictures)?)
        }
        Road::Copies => {
            let copies = copies::Copies::create(display, &monitor, pictures).map_err(failed)?;
            up(copies.window())?;
            Box::new(copies)
        }
    };
    let (shown, wanted) = (monitor.clone(), wanted.clone());
    let completions = view.completions;
    let socket = view.connection.stream().as_fd().try_clone_to_owned().map_err(WindowError::System)?;
    let watch = move |watcher: &mut Watcher| watch(view, &shown, &wanted, watcher);
    let watched = Watched::start(monitor, completions, Some(socket), watch)?;
    Ok(Opened { draw, watched })
}

/// Shows the window and waits until it covers its monitor.
fn bring_up(
    view: &mut View,
    window: u32,
    display: &str,
    monitor: &Monitor,
    wanted: &Wanted,
) -> Result<(), WindowError> {
    let failed = |why: X11Error| why.at(display);
    view.watch(window).map_err(failed)?;
    let t_end = Instant::now() + PATIENCE;
    while let Some(fault) = view.fault(monitor, wanted).map_err(failed)? {
        if Instant::now() >= t_end {
            return Err(WindowError::NotShown { monitor: Box::new(monitor.clone()), fault });
        }
        view.wait(Duration::from_millis(20), None).map_err(failed)?;
        view.drain(&mut |_| ()).map_err(failed)?;
    }
    Ok(())
}

/// Why the X server did not do what it was asked.
#[derive(Debug, thiserror::Error)]
enum X11Error {
    #[error(transparent)]
    Connect(#[from] ConnectError),
    #[error(transparent)]
    Connection(#[from] ConnectionError),
    #[error(transparent)]
    Reply(#[from] ReplyError),
    #[error(transparent)]
    ReplyOrId(#[from] ReplyOrIdError),
    #[error("it has no {0}, which holod needs")]
    Lacks(&'static str),
    #[error(
        "{connector} is the panel of another holod, process {process}; end that one, or name another monitor",
        process = pid.map_or("unknown".to_owned(), |pid| pid.to_string())
    )]
    Taken { connector: String, pid: Option<u32> },
    #[error(transparent)]
    System(#[from] rustix::io::Errno),
}

impl X11Error {
    fn at(self, display: &str) -> WindowError {
        WindowError::Server { server: format!("X server {display}"), reason: self.to_string() }
    }
}

/// Makes the window, which is not shown yet.
fn create_window(connection: &impl Connection, screen: usize, monitor: &Monitor) -> Result<u32, X11Error> {
    let root = &connection.setup().roots[screen];
    let true_colour = root.allowed_depths.iter().flat_map(|depth| &depth.visuals).any(|visual| {
        visual.visual_id == root.root_visual && [visual.red_mask, visual.green_mask, visual.blue_mask] == COLOUR_MASKS
    });
    if !true_colour {
        return Err(X11Error::Lacks("picture of 8 bits for each colour (screen depth 24)"));
    }
    // A cursor of one pixel, which its mask takes away.
    let (cursor, blank, clear) = (connection.generate_id()?, connection.generate_id()?, connection.generate_id()?);
    connection.create_pixmap(1, blank, root.root, 1, 1)?;
    connection.create_gc(clear, blank, &CreateGCAux::new().foreground(0))?;
    connection.poly_fill_rectangle(blank, clear, &[Rectangle { x: 0, y: 0, width: 1, height: 1 }])?;
    connection.create_cursor(cursor, blank, blank, 0, 0, 0, 0, 0, 0, 0, 0)?;
    connection.free_gc(clear)?;
    connection.free_pixmap(blank)?;

    let window = connection.generate_id()?;
    let attributes = CreateWindowAux::new().override_redirect(1).background_pixel(root.black_pixel).cursor(cursor);
    let Resolution { width, height } = monitor.mode;
    let (left, top) = (monitor.left_px as i16, monitor.top_px as i16);
    let (parent, class) = (root.root, WindowClass::INPUT_OUTPUT);
    connection
        .create_window(0, window, parent, left, top, width as u16, height as u16, 0, class, 0, &attributes)?
        .check()?;
    connection.change_property8(PropMode::REPLACE, window, AtomEnum::WM_NAME, AtomEnum::STRING, b"holod panel")?;
    connection.change_property8(PropMode::REPLACE, window, AtomEnum::WM_CLASS, AtomEnum::STRING, b"holod\0holod\0")?;
    let bypass = connection.intern_atom(false, b"_NET_WM_BYPASS_COMPOSITOR")?.reply()?.atom;
    connection.change_property32(PropMode::REPLACE, window, bypass, AtomEnum::CARDINAL, &[1])?;
    claim(connection, window, monitor)?;
    connection.sync()?;
    Ok(window)
}

/// Makes the monitor this process's panel, where it is no other holod's: a selection of the X server says whose, which
/// its window owns for as long as it is there.
fn claim(connection: &impl Connection, window: u32, monitor: &Monitor) -> Result<(), X11Error> {
    let name = format!("_HOLOD_PANEL_{}", monitor.connector);
    let selection = connection.intern_atom(false, name.as_bytes())?.reply()?.atom;
    let pid_atom = connection.intern_atom(false, b"_NET_WM_PID")?.reply()?.atom;
    let own_pid = std::process::id();
    connection.change_property32(PropMode::REPLACE, window, pid_atom, AtomEnum::CARDINAL, &[own_pid])?;
    // Between the look and the claim nobody else may come.
    connection.grab_server()?;
    let owner = connection.get_selection_owner(selection)?.reply()?.owner;
    let pid = match owner {
        x11rb::NONE => Some(own_pid),
        owner => {
            let property = connection.get_property(false, owner, pid_atom, AtomEnum::CARDINAL, 0, 1)?.reply();
            property.ok().and_then(|property| property.value32()?.next())
        }
    };
    // The server may not have taken away yet this process's last window.
    let is_free = pid == Some(own_pid);
    if is_free {
        connection.set_selection_owner(window, selection, x11rb::CURRENT_TIME)?;
    }
    connection.ungrab_server()?.check()?;
    if is_free { Ok(()) } else { Err(X11Error::Taken { connector: monitor.connector.clone(), pid }) }
}

/// Red, green and blue as bits of a pixel: the layout of `Bgra8Unorm`.
const COLOUR_MASKS: [u32; 3] = [0xFF_0000, 0x00_FF00, 0x00_00FF];

/// The connection that watches.
struct View {
    connection: RustConnection,
    screen: Screen,
    window: u32,
    edid_atom: u32,
    /// The X server has what the name says.
    has_dpms: bool,
    completions: bool,
    /// No part of the window is under another one, as far as the X server knows: a compositor hides that.
    uncovered: bool,
    destroyed: bool,
    /// Something has happened since the last look.
    stale: bool,
}

impl View {
    fn connect(display: &str) -> Result<Self, X11Error> {
        let (connection, screen) = x11rb::connect(Some(display))?;
        let screen = connection.setup().roots[screen].clone();
        if connection.extension_information(randr::X11_EXTENSION_NAME)?.is_none() {
            return Err(X11Error::Lacks("RandR extension"));
        }
        connection.randr_query_version(1, 3)?.reply()?;
        let interesting = NotifyMask::SCREEN_CHANGE
            | NotifyMask::CRTC_CHANGE
            | NotifyMask::OUTPUT_CHANGE
            | NotifyMask::OUTPUT_PROPERTY;
        connection.randr_select_input(screen.root, interesting)?;
        let edid_atom = connection.intern_atom(false, b"EDID")?.reply()?.atom;
        let has_dpms = connection.extension_information(dpms::X11_EXTENSION_NAME)?.is_some()
            && connection.dpms_capable()?.reply()?.capable;
        let completions = connection.extension_information(present::X11_EXTENSION_NAME)?.is_some();
        if completions {
            connection.present_query_version(1, 0)?.reply()?;
        }
        if connection.extension_information(screensaver::X11_EXTENSION_NAME)?.is_some() {
            connection.screensaver_query_version(1, 1)?.reply()?;
            // For as long as this connection lasts.
            connection.screensaver_suspend(1)?;
        }
        Ok(Self {
            connection,
            screen,
            window: 0,
            edid_atom,
            has_dpms,
            completions,
            uncovered: false,
            destroyed: false,
            stale: true,
        })
    }

    fn is_xwayland(&self) -> Result<bool, X11Error> {
        Ok(self.connection.extension_information("XWAYLAND")?.is_some()
            || self.monitors()?.iter().any(|monitor| monitor.connector.starts_with("XWAYLAND")))
    }

    /// Asks for the events of `window`, and shows it.
    fn watch(&mut self, window: u32) -> Result<(), X11Error> {
        self.window = window;
        let events = EventMask::STRUCTURE_NOTIFY | EventMask::VISIBILITY_CHANGE;
        let attributes = ChangeWindowAttributesAux::new().event_mask(events);
        self.connection.change_window_attributes(window, &attributes)?.check()?;
        if self.completions {
            let id = self.connection.generate_id()?;
            self.connection.present_select_input(id, window, present::EventMask::COMPLETE_NOTIFY)?.check()?;
        }
        self.connection.map_window(window)?.check()?;
        Ok(())
    }

    /// All monitors that are lit.
    fn monitors(&self) -> Result<Vec<Monitor>, X11Error> {
        let x = &self.connection;
        let resources = x.randr_get_screen_resources_current(self.screen.root)?.reply()?;
        let primary = x.randr_get_output_primary(self.screen.root)?.reply()?.output;
        let asleep = self.has_dpms && {
            let dpms = x.dpms_info()?.reply()?;
            dpms.state && dpms.power_level != DPMSMode::ON
        };
        let mut lit = Vec::new();
        for &output in &resources.outputs {
            let info = x.randr_get_output_info(output, resources.config_timestamp)?.reply()?;
            if info.crtc == 0 || info.connection == randr::Connection::DISCONNECTED {
                continue;
            }
            let crtc = x.randr_get_crtc_info(info.crtc, resources.config_timestamp)?.reply()?;
            let Some(mode) = resources.modes.iter().find(|mode| mode.id == crtc.mode) else { continue };
            let transform = x.randr_get_crtc_transform(info.crtc)?.reply()?.current_transform;
            let gamma = x.randr_get_crtc_gamma(info.crtc)?.reply()?;
            let mut alterations = alterations(mode, &crtc, &transform, &gamma);
            if asleep {
                alterations.push(Alteration::Asleep);
            }
            let edid =
                x.randr_get_output_property(output, self.edid_atom, AtomEnum::ANY, 0, 256, false, false)?.reply()?;
            let monitor = Monitor {
                connector: String::from_utf8_lossy(&info.name).into_owned(),
                edid: Edid::parse(&edid.data),
                primary: output == primary,
                left_px: crtc.x.into(),
                top_px: crtc.y.into(),
                mode: Resolution { width: mode.width.into(), height: mode.height.into() },
                refresh_hz: refresh_hz(mode),
                alterations,
            };
            lit.push((monitor, Area::of(&crtc)));
        }
        // A server whose desktop has no main monitor still has panels and icons: they begin at its corner.
        if primary == 0 {
            for (monitor, area) in &mut lit {
                monitor.primary = (area.left, area.top) == (0, 0);
            }
        }
        let mirrored = |index: usize| {
            let (_, area) = &lit[index];
            let other = lit.iter().enumerate().find(|(other, (_, theirs))| *other != index && area.meets(theirs));
            other.map(|(_, (other, _))| Alteration::Mirrored(other.connector.clone()))
        };
        let mirrors: Vec<_> = (0..lit.len()).map(mirrored).collect();
        let with_mirror = |((mut monitor, _), mirror): ((Monitor, Area), Option<Alteration>)| {
            monitor.alterations.extend(mirror);
            monitor
        };
        Ok(lit.into_iter().zip(mirrors).map(with_mirror).collect())
    }

    /// What keeps the window from being all of `monitor`'s picture, if anything does.
    fn fault(&mut self, monitor: &Monitor, wanted: &Wanted) -> Result<Option<PanelFault>, X11Error> {
        self.stale = false;
        let fault = fault_of(monitor, &self.monitors()?, &wanted.spec, &wanted.panel);
        if fault.is_some() {
            return Ok(fault);
        }
        if self.destroyed {
            return Ok(Some(PanelFault::WindowLost));
        }
        let geometry = self.connection.get_geometry(self.window)?;
        let attributes = self.connection.get_window_attributes(self.window)?;
        let origin = self.connection.translate_coordinates(self.window, self.screen.root, 0, 0)?;
        let (Ok(geometry), Ok(attributes), Ok(origin)) = (geometry.reply(), attributes.reply(), origin.reply()) else {
            return Ok(Some(PanelFault::WindowLost));
        };
        let place = (i32::from(origin.dst_x), i32::from(origin.dst_y));
        let size = Resolution { width: geometry.width.into(), height: geometry.height.into() };
        let covers = place == (monitor.left_px, monitor.top_px) && size == monitor.mode;
        let visible = attributes.map_state == MapState::VIEWABLE && self.uncovered;
        Ok((!covers || !visible).then_some(PanelFault::WindowLost))
    }

    /// Takes in what the X server has to say.
    fn drain(&mut self, completed: &mut dyn FnMut(Completion)) -> Result<(), X11Error> {
        while let Some(event) = self.connection.poll_for_event()? {
            match event {
                Event::PresentCompleteNotify(event) if event.kind == CompleteKind::PIXMAP => {
                    completed(Completion {
                        serial: event.serial,
                        t_present: TimeNs(i64::try_from(event.ust.saturating_mul(1000)).unwrap_or(0)),
                        refresh_count: event.msc,
                        shown: match event.mode {
                            CompleteMode::FLIP => Shown::Flipped,
                            CompleteMode::SKIP => Shown::Skipped,
                            _ => Shown::Copied,
                        },
                    });
                }
                Event::PresentCompleteNotify(_) => {}
                Event::VisibilityNotify(event) => {
                    self.uncovered = event.state == Visibility::UNOBSCURED;
                    self.stale = true;
                }
                Event::DestroyNotify(event) if event.window == self.window => {
                    self.destroyed = true;
                    self.stale = true;
                }
                _ => self.stale = true,
            }
        }
        Ok(())
    }

    /// Waits for the X server, `order` or the end of `patience`; whether it was `order`.
    fn wait(&self, patience: Duration, order: Option<&OwnedFd>) -> Result<bool, X11Error> {
        let timeout = Timespec { tv_sec: patience.as_secs() as i64, tv_nsec: patience.subsec_nanos().into() };
        let mut fds = vec![PollFd::new(self.connection.stream(), PollFlags::IN)];
        if let Some(order) = order {
            fds.push(PollFd::from_borrowed_fd(order.as_fd(), PollFlags::IN));
        }
        match poll(&mut fds, Some(&timeout)) {
            Ok(_) | Err(rustix::io::Errno::INTR) => Ok(fds.get(1).is_some_and(|order| !order.revents().is_empty())),
            Err(why) => Err(why.into()),
        }
    }
}

/// Watches until something is wrong or the panel is closed.
fn watch(mut view: View, monitor: &Monitor, wanted: &Wanted, watcher: &mut Watcher) -> PanelFault {
    watcher.placed();
    let mut look = || -> Result<Option<PanelFault>, X11Error> {
        let mut t_look = Instant::now();
        loop {
            view.drain(&mut |completion| watcher.completed(completion))?;
            if view.stale || t_look.elapsed() >= LOOK_EVERY {
                t_look = Instant::now();
                if let Some(fault) = view.fault(monitor, wanted)? {
                    return Ok(Some(fault));
                }
                // The answers may have brought events along.
                continue;
            }
            if view.wait(LOOK_EVERY, Some(watcher.order()))? {
                return Ok(None);
            }
        }
    };
    match look() {
        Ok(None) => PanelFault::WindowLost,
        Ok(Some(fault)) => {
            // No other monitor may show the pattern until the panel is back.
            let _gone_anyway = view.connection.unmap_window(view.window).and_then(|_| view.connection.flush());
            fault
        }
        Err(_) => PanelFault::WindowLost,
    }
}

/// In 16.16 fixed point.
const IDENTITY: [[i32; 3]; 3] = [[1 << 16, 0, 0], [0, 1 << 16, 0], [0, 0, 1 << 16]];

/// What the server does to the pixels of a monitor.
fn alterations(
    mode: &randr::ModeInfo,
    crtc: &randr::GetCrtcInfoReply,
    transform: &Transform,
    gamma: &randr::GetCrtcGammaReply,
) -> Vec<Alteration> {
    let Transform { matrix11, matrix12, matrix13, matrix21, matrix22, matrix23, matrix31, matrix32, matrix33 } =
        *transform;
    let matrix = [[matrix11, matrix12, matrix13], [matrix21, matrix22, matrix23], [matrix31, matrix32, matrix33]];
    let turned = crtc.rotation != Rotation::ROTATE0;
    let is = [
        (!turned && (matrix != IDENTITY || (crtc.width, crtc.height) != (mode.width, mode.height)), Alteration::Scaled),
        (turned, Alteration::Transformed),
        (mode.mode_flags.intersects(ModeFlag::INTERLACE | ModeFlag::DOUBLE_SCAN), Alteration::Interlaced),
        (![&gamma.red, &gamma.green, &gamma.blue].iter().all(|ramp| is_straight(ramp)), Alteration::GammaRamp),
    ];
    is.into_iter().filter_map(|(is, alteration)| is.then_some(alteration)).collect()
}

/// Refreshes a second of a mode, from its pixel clock. `None` where the server does not know that.
fn refresh_hz(mode: &randr::ModeInfo) -> Option<f64> {
    let mut lines = f64::from(mode.vtotal);
    if mode.mode_flags.contains(ModeFlag::DOUBLE_SCAN) {
        lines *= 2.0;
    }
    if mode.mode_flags.contains(ModeFlag::INTERLACE) {
        lines /= 2.0;
    }
    let hz = f64::from(mode.dot_clock) / (f64::from(mode.htotal) * lines);
    (hz.is_finite() && hz > 0.0).then_some(hz)
}

/// Whether a gamma ramp leaves 8-bit levels as they are. Servers begin with ramps that end at 65535 or a level short of
/// it; those that have no ramps give zeros.
fn is_straight(ramp: &[u16]) -> bool {
    if ramp.iter().all(|&value| value == 0) {
        return true;
    }
    let last = ramp.len().saturating_sub(1).max(1) as f64;
    let strays = |(index, &value): (usize, &u16)| (f64::from(value) - index as f64 / last * 65_535.0).abs() >= 256.0;
    !ramp.iter().enumerate().any(strays)
}

/// A part of the desktop.
struct Area {
    left: i32,
    top: i32,
    right: i32,
    bottom: i32,
}

impl Area {
    fn of(crtc: &randr::GetCrtcInfoReply) -> Self {
        let (left, top) = (i32::from(crtc.x), i32::from(crtc.y));
        Self { left, top, right: left + i32::from(crtc.width), bottom: top + i32::from(crtc.height) }
    }

    fn meets(&self, other: &Self) -> bool {
        self.left < other.right && other.left < self.right && self.top < other.bottom && other.top < self.bottom
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 1920x1080 at 60 Hz, as it is sold.
    fn full_hd() -> randr::ModeInfo {
        let (width, height, htotal, vtotal) = (1920, 1080, 2200, 1125);
        randr::ModeInfo { width, height, htotal, vtotal, dot_clock: 148_500_000, ..randr::ModeInfo::default() }
    }

    fn upright(mode: &randr::ModeInfo) -> randr::GetCrtcInfoReply {
        let (width, height) = (mode.width, mode.height);
        randr::GetCrtcInfoReply { width, height, rotation: Rotation::ROTATE0, ..randr::GetCrtcInfoReply::default() }
    }

    fn identity() -> Transform {
        Transform { matrix11: 1 << 16, matrix22: 1 << 16, matrix33: 1 << 16, ..Transform::default() }
    }

    fn gamma(blue: Vec<u16>) -> randr::GetCrtcGammaReply {
        let straight: Vec<u16> = (0..256).map(|level| level * 257).collect();
        randr::GetCrtcGammaReply { red: straight.clone(), green: straight, blue, ..randr::GetCrtcGammaReply::default() }
    }

    fn straight() -> randr::GetCrtcGammaReply {
        gamma((0..256).map(|level| level * 257).collect())
    }

    #[test]
    fn refreshes_are_counted_from_the_pixel_clock() {
        assert_eq!(refresh_hz(&full_hd()), Some(60.0));
        let half = randr::ModeInfo { mode_flags: ModeFlag::DOUBLE_SCAN, ..full_hd() };
        assert_eq!(refresh_hz(&half), Some(30.0));
        let fields = randr::ModeInfo { mode_flags: ModeFlag::INTERLACE, ..full_hd() };
        assert_eq!(refresh_hz(&fields), Some(120.0));
        assert_eq!(refresh_hz(&randr::ModeInfo::default()), None);
    }

    #[test]
    fn every_way_to_change_pixels_is_seen() {
        let mode = full_hd();
        let plain = upright(&mode);
        assert_eq!(alterations(&mode, &plain, &identity(), &straight()), []);
        let scaled = Transform { matrix11: 1 << 15, ..identity() };
        assert_eq!(alterations(&mode, &plain, &scaled, &straight()), [Alteration::Scaled]);
        let smaller = randr::GetCrtcInfoReply { width: 1280, height: 720, ..plain.clone() };
        assert_eq!(alterations(&mode, &smaller, &identity(), &straight()), [Alteration::Scaled]);
        for rotation in [Rotation::ROTATE90, Rotation::ROTATE180, Rotation::ROTATE0 | Rotation::REFLECT_X] {
            let turned = randr::GetCrtcInfoReply { rotation, ..plain.clone() };
            assert_eq!(alterations(&mode, &turned, &identity(), &straight()), [Alteration::Transformed]);
        }
        let interlaced = randr::ModeInfo { mode_flags: ModeFlag::INTERLACE, ..full_hd() };
        assert_eq!(alterations(&interlaced, &plain, &identity(), &straight()), [Alteration::Interlaced]);
    }

    #[test]
    fn a_ramp_is_straight_where_no_level_becomes_another() {
        let ramp = |of: &dyn Fn(u16) -> u16| (0..256).map(of).collect::<Vec<_>>();
        // Servers begin with either.
        assert!(is_straight(&ramp(&|level| level * 257)) && is_straight(&ramp(&|level| level << 8)));
        assert!(is_straight(&(0..1024u32).map(|level| (level * 65_535 / 1023) as u16).collect::<Vec<_>>()));
        assert!(is_straight(&[]) && is_straight(&[0; 256]));
        assert!(!is_straight(&ramp(&|level| level * 254)));
        assert!(!is_straight(&ramp(&|level| 65_535 - level * 257)));
        assert!(!is_straight(&ramp(&|level| level * 257 + if level == 100 { 300 } else { 0 })));
        let (mode, bent) = (full_hd(), gamma(ramp(&|level| level * 200)));
        assert_eq!(alterations(&mode, &upright(&mode), &identity(), &bent), [Alteration::GammaRamp]);
    }
}

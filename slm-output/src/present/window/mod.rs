//! The panel as a window that covers one monitor, pixel for pixel, under X11 and Wayland.
//!
//! What can go wrong on a desktop is wrong for a hologram: another monitor, a scaled or bent picture, a window over it.
//! So the monitor is chosen by name ([`monitors`]), all of that is looked at before the first picture and watched
//! afterwards, and whatever changes is a [`PanelFault`]: the window is taken away at once, and [`Presenter::recover`]
//! opens everything anew, from the connection to the display server on, by the same rules. That is also how a new
//! monitor mode, a replugged monitor, a lost device and a restarted display server are survived.
//!
//! Threads: `holod-window` watches and answers the display server; the panel thread, which calls the [`Presenter`],
//! hands pictures over. This file's own code does not allocate after its start. The libraries of X11, Wayland and wgpu
//! do within their calls, and lock: that is the price of a window, and one reason why `drm` is the road for a bench.
//!
//! holod speaks X11 and Wayland itself rather than through a windowing library: those allow one connection for a
//! process, end it when the X server does, and do not hand on when a picture came on the monitor.

pub mod monitors;
mod timeline;
#[cfg(feature = "vulkan")]
mod vulkan;
mod watch;
mod wayland;
mod x11;

use std::os::fd::BorrowedFd;
use std::path::{Path, PathBuf};
use std::sync::mpsc;
use std::time::Duration;
use std::{fmt, io};

use holod_calibration::rig::{Packing, PanelMode};
use holod_calibration::{Resolution, TimeNs, host_now};
use rustix::event::{PollFd, PollFlags, Timespec, poll};

use self::monitors::{Monitor, MonitorError, PanelMonitor};
use self::timeline::{Lead, Outcome, Presented, Timeline};
use self::watch::Watched;
use crate::fields::{FIELDS, FrameTag, LevelsFrame};
use crate::packing::{PIXEL_BYTES, PixelFormat, write_frame};
use crate::present::drm::{DisplayCheck, SYS_CLASS_DRM, Verdict, seen_connectors};
use crate::present::{
    FrameSource, PanelFault, PanelSetup, PanelTiming, PresentedRefresh, Presenter, TimestampSource, WindowSpec,
};

/// The display server that windows are opened on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum DisplayServer {
    /// A Wayland compositor, by its socket.
    Wayland(PathBuf),
    /// An X server, as `DISPLAY` names it.
    X11(String),
}

impl DisplayServer {
    /// The one that the environment names: a compositor, where it names both.
    ///
    /// # Errors
    /// It names none, or a compositor in a folder that it does not name.
    pub fn from_environment() -> Result<Self, WindowError> {
        let named = |variable| std::env::var(variable).ok().filter(|name| !name.is_empty());
        if let Some(socket) = named("WAYLAND_DISPLAY").map(PathBuf::from) {
            return match named("XDG_RUNTIME_DIR") {
                _ if socket.is_absolute() => Ok(Self::Wayland(socket)),
                Some(folder) => Ok(Self::Wayland(Path::new(&folder).join(socket))),
                None => Err(WindowError::NoSocketFolder { socket }),
            };
        }
        named("DISPLAY").map(Self::X11).ok_or(WindowError::NoServer)
    }
}

impl fmt::Display for DisplayServer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Wayland(socket) => write!(f, "compositor {}", socket.display()),
            Self::X11(display) => write!(f, "X server {display}"),
        }
    }
}

/// Why the panel's window could not be opened.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "the messages say what the fields are")]
pub enum WindowError {
    /// There is no display server to ask.
    #[error(
        "a window needs a display server, and neither WAYLAND_DISPLAY nor DISPLAY is set; start holod within the desktop's session, or use --output drm:CONNECTOR without one"
    )]
    NoServer,
    /// The compositor's socket is in no folder.
    #[error(
        "WAYLAND_DISPLAY is `{}`, in the folder of XDG_RUNTIME_DIR, which is not set: start holod within the desktop's session, or set it, such as to /run/user/1000",
        socket.display()
    )]
    NoSocketFolder {
        /// As the environment names it.
        socket: PathBuf,
    },
    /// The display server ended the connection, or refused what a window needs.
    #[error("{server}: {reason}")]
    Server { server: String, reason: String },
    /// The display server answers nothing.
    #[error("{server} has not answered for {waited_s} s: does it hang?")]
    Silent {
        server: String,
        /// How long it was waited for, seconds.
        waited_s: u64,
    },
    /// It is one that draws to another.
    #[error(
        "X server {display} is Xwayland, which hides how its pixels are scaled; set WAYLAND_DISPLAY, so that holod speaks to the compositor itself"
    )]
    Xwayland { display: String },
    /// No monitor can be the panel.
    #[error(transparent)]
    Monitor(#[from] MonitorError),
    /// The window does not come up as it must.
    #[error(
        "the window on {monitor} did not come up: {fault}; is another window above it, or does a tool move windows?"
    )]
    NotShown {
        /// Where it should be.
        monitor: Box<Monitor>,
        fault: PanelFault,
    },
    /// Nothing can draw to it.
    #[error(
        "Vulkan cannot draw to the window: {reason}; install the graphics driver's Vulkan part (mesa-vulkan-drivers)"
    )]
    Vulkan { reason: String },
    /// The device cannot show levels as they are.
    #[cfg(feature = "vulkan")]
    #[error("{device} does not give the window {what}")]
    Surface { device: String, what: &'static str },
    /// Nothing came on the monitor.
    #[error("the flat pattern did not come on {monitor}: {fault}")]
    NothingShown {
        /// Where it should be.
        monitor: Box<Monitor>,
        fault: PanelFault,
    },
    /// The levels need more bits than a window's channels have.
    #[error(
        "a window has {} bits a channel, and panel.packing = \"{}\" needs {}: use --output drm:CONNECTOR, or another packing",
        FORMAT.channel_bits(),
        .0.name(),
        .0.channel_bits()
    )]
    Packing(Packing),
    /// The system refused something.
    #[error("cannot watch the window: {0}; check the limits on threads and open files")]
    System(io::Error),
}

impl WindowError {
    /// What it is for a panel that was open.
    fn as_fault(&self) -> PanelFault {
        match self {
            Self::Monitor(why) => why.as_fault(),
            Self::NotShown { fault, .. } | Self::NothingShown { fault, .. } => *fault,
            #[cfg(feature = "vulkan")]
            Self::Vulkan { .. } | Self::Surface { .. } => PanelFault::DeviceLost,
            _ => PanelFault::WindowLost,
        }
    }
}

/// How pictures get to a window of an X server. On a Wayland compositor they go through memory that both share.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Road {
    /// By Vulkan. A window that fills all of an X screen, which then has but one monitor, is scanned out directly, and
    /// the driver stamps the refreshes.
    #[cfg(feature = "vulkan")]
    Vulkan,
    /// The server copies them at a refresh. Nothing says when the copy is done, so no laser is lit by it.
    Copies,
}

impl Road {
    /// By Vulkan where a graphics processor is; else by copies.
    pub fn best() -> Self {
        #[cfg(feature = "vulkan")]
        if vulkan::has_hardware() {
            return Self::Vulkan;
        }
        Self::Copies
    }
}

/// Puts pictures on a window: 8 bits each of blue, green, red and nothing for each pixel, row-major, as they are.
trait Draw: Send {
    /// Writes a picture, which may be on the monitor.
    fn write(&mut self, picture: usize, pixels: &[u8]) -> Result<(), PanelFault>;

    /// Queues a picture for the next refresh.
    fn present(&mut self, picture: usize) -> Result<(), PanelFault>;
}

/// How a picture's pixels stand in memory, under every display server.
const FORMAT: PixelFormat = PixelFormat::Bgrx8;

/// A window that is there, the drawing end first: it goes first.
struct Opened {
    draw: Box<dyn Draw>,
    watched: Watched,
}

/// What is asked of the display server.
#[derive(Clone, Debug)]
struct Wanted {
    spec: WindowSpec,
    panel: PanelMonitor,
}

/// How long a display server may take to bring a window up, its graphics driver included.
const OPEN_WAIT: Duration = Duration::from_secs(10);
/// How long the first pictures may take to come on the monitor, all of them flat.
const FIRST_PICTURES_WAIT: TimeNs = TimeNs(1_000_000_000);
/// So many: some servers copy the first ones and flip later ones.
const FIRST_PICTURES: u32 = 6;
/// A picture that has been on its way for this long is stuck.
const STUCK: TimeNs = TimeNs(500_000_000);
/// A panel on a monitor of the desktop.
#[derive(Debug)]
pub struct WindowPanel {
    server: DisplayServer,
    road: Road,
    wanted: Wanted,
    timing: PanelTiming,
    /// Different video frames in a colour frame.
    planes: usize,
    /// Refreshes in a row that show one of them.
    refreshes_per_plane: usize,
    fields_per_refresh: usize,
    /// `None` while the panel is lost.
    open: Option<Open>,
    checks: Vec<DisplayCheck>,
    flat: LevelsFrame,
    flat_wanted: bool,
    /// The frame that was reported last, and its levels.
    reported: Option<FrameTag>,
    shown: LevelsFrame,
    /// The frame whose refreshes are being presented, and its levels until they are reported.
    frame: Option<FrameTag>,
    coming: LevelsFrame,
    repeated: bool,
    /// Position of the next refresh in its colour frame.
    next_refresh: usize,
    /// Its picture is written: it was presented before, and never came on the monitor.
    skipped: bool,
    on_its_way: Option<OnItsWay>,
    t_next: TimeNs,
    pixels: Vec<u8>,
}

/// A panel that is there.
struct Open {
    draw: Box<dyn Draw>,
    watched: Watched,
    /// `None` where the display server does not say when pictures come on the monitor.
    timeline: Option<Timeline>,
    lead: Lead,
    /// When the picture that is on the monitor came.
    t_refresh: TimeNs,
}

impl std::fmt::Debug for Open {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Open").field("monitor", self.watched.monitor()).finish_non_exhaustive()
    }
}

/// A picture that has been handed over.
#[derive(Clone, Copy, Debug)]
struct OnItsWay {
    frame: Option<FrameTag>,
    /// Position of the refresh in its colour frame.
    refresh: usize,
    repeated: bool,
    since: TimeNs,
    /// What is known of its coming; where that time is still to come, it is reported then.
    came: Option<Presented>,
}

impl WindowPanel {
    /// Opens the window on `server` and shows the flat pattern. A server that hangs is waited for some seconds; the
    /// thread that opens the window is then left to itself.
    ///
    /// # Errors
    /// [`WindowError`].
    pub fn open(server: DisplayServer, road: Road, spec: &WindowSpec, setup: &PanelSetup) -> Result<Self, WindowError> {
        let (done, opened) = mpsc::channel();
        let silent = WindowError::Silent { server: server.to_string(), waited_s: OPEN_WAIT.as_secs() };
        let (spec, setup) = (spec.clone(), setup.clone());
        let open = move || {
            // Whoever asked may have gone.
            let _late = done.send(Self::open_waiting(server, road, &spec, &setup));
        };
        std::thread::Builder::new().name("holod-window-up".into()).spawn(open).map_err(WindowError::System)?;
        match opened.recv_timeout(OPEN_WAIT) {
            Ok(opened) => opened,
            Err(_) => Err(silent),
        }
    }

    fn open_waiting(
        server: DisplayServer,
        road: Road,
        spec: &WindowSpec,
        setup: &PanelSetup,
    ) -> Result<Self, WindowError> {
        let PanelSetup { panel, flat } = setup;
        let layout = flat.layout();
        if layout.packing.channel_bits() != FORMAT.channel_bits() {
            return Err(WindowError::Packing(layout.packing));
        }
        let planes = if layout.mode == PanelMode::FieldSequential { FIELDS } else { 1 };
        let mut window = Self {
            server,
            road,
            wanted: Wanted { spec: spec.clone(), panel: PanelMonitor::new(panel, layout.video_resolution()) },
            timing: PanelTiming::new(panel),
            planes,
            refreshes_per_plane: layout.refreshes() / planes,
            fields_per_refresh: layout.fields_per_refresh(),
            open: None,
            checks: Vec::new(),
            flat: flat.clone(),
            flat_wanted: false,
            reported: None,
            shown: flat.clone(),
            frame: None,
            coming: flat.clone(),
            repeated: false,
            next_refresh: 0,
            skipped: false,
            on_its_way: None,
            t_next: TimeNs(0),
            pixels: vec![0; PIXEL_BYTES * layout.video_resolution().pixels()],
        };
        window.open_anew()?;
        Ok(window)
    }

    /// Opens everything from the connection on, and shows the flat pattern.
    fn open_anew(&mut self) -> Result<(), WindowError> {
        self.close();
        let planes = self.planes;
        let Opened { draw, watched } = match &self.server {
            DisplayServer::X11(display) => x11::open(display, &self.wanted, self.road, 2 * planes)?,
            DisplayServer::Wayland(socket) => wayland::open(socket, &self.wanted, 2 * planes)?,
        };
        let monitor = Box::new(watched.monitor().clone());
        let (lead, t_refresh) = (Lead::new(self.timing.refresh_period), host_now());
        let mut open = Open { draw, watched, timeline: None, lead, t_refresh };
        let last = self.show_first(&mut open);
        let last = last.map_err(|fault| WindowError::NothingShown { monitor: monitor.clone(), fault })?;
        self.checks = checks(&monitor, &self.wanted.panel, last);
        open.timeline = last.map(Timeline::starting_with);
        self.t_next = host_now();
        self.open = Some(open);
        Ok(())
    }

    /// Writes the flat pattern and waits until it is on the monitor, with what the display server says of the last time
    /// that it was presented. `None` where the server says nothing.
    fn show_first(&mut self, open: &mut Open) -> Result<Option<watch::Completion>, PanelFault> {
        for plane in 0..self.planes {
            write_pixels(&self.flat, plane * self.refreshes_per_plane, &mut self.pixels);
            open.draw.write(self.planes + plane, &self.pixels)?;
        }
        open.draw.present(self.planes)?;
        let t_end = host_now() + FIRST_PICTURES_WAIT;
        let (mut last, mut shown) = (None, 0);
        loop {
            open.watched.check()?;
            if let Some(completion) = open.watched.completion() {
                (last, shown) = (Some(completion), shown + 1);
                if shown < FIRST_PICTURES {
                    open.draw.present(self.planes)?;
                }
            }
            let is_shown = shown == FIRST_PICTURES || !open.watched.reports_completions();
            if open.watched.is_placed() && is_shown {
                return Ok(last);
            }
            let rest = t_end - host_now();
            if rest <= TimeNs(0) {
                // One that is still on its way would be taken for the next.
                let all_came = shown == 0 || shown == FIRST_PICTURES;
                return if open.watched.is_placed() && all_came { Ok(last) } else { Err(PanelFault::WindowLost) };
            }
            let timeout = Timespec { tv_sec: 0, tv_nsec: rest.0.min(999_999_999) };
            let bell = PollFd::from_borrowed_fd(open.watched.bell(), PollFlags::IN);
            let _woken_or_not = poll(&mut [bell], Some(&timeout));
        }
    }

    fn close(&mut self) {
        self.open = None;
        self.on_its_way = None;
        self.frame = None;
        self.reported = None;
        self.repeated = false;
        self.next_refresh = 0;
        self.skipped = false;
    }

    /// At a colour frame's start, takes what is newest.
    fn latch(&mut self, frames: &mut FrameSource) {
        if self.flat_wanted {
            self.frame = None;
            self.repeated = false;
            return;
        }
        self.repeated = self.frame.is_some() && self.reported == self.frame;
        if frames.update() {
            std::mem::swap(&mut self.coming, frames.current_mut());
            self.frame = Some(self.coming.tag());
            self.repeated = false;
            self.skipped = false;
        }
    }

    /// Hands the next refresh's picture over.
    fn present(&mut self, now: TimeNs, frames: &mut FrameSource) -> Result<(), PanelFault> {
        if self.next_refresh == 0 {
            self.latch(frames);
        }
        let Some(open) = &mut self.open else { return Err(PanelFault::WindowLost) };
        let plane = self.next_refresh / self.refreshes_per_plane;
        let picture = match self.frame {
            Some(_) => plane,
            None => self.planes + plane,
        };
        let is_new =
            self.frame.is_some() && !self.repeated && self.next_refresh.is_multiple_of(self.refreshes_per_plane);
        if is_new && !self.skipped {
            // Once it is reported, the levels are where reported ones are.
            let levels = if self.reported == self.frame { &self.shown } else { &self.coming };
            write_pixels(levels, plane * self.refreshes_per_plane, &mut self.pixels);
            open.draw.write(picture, &self.pixels)?;
        }
        open.draw.present(picture)?;
        if let Some(timeline) = &mut open.timeline {
            timeline.present();
        }
        let (frame, refresh, repeated) = (self.frame, self.next_refresh, self.repeated);
        self.on_its_way = Some(OnItsWay { frame, refresh, repeated, since: now, came: None });
        self.skipped = false;
        self.next_refresh = (self.next_refresh + 1) % (self.planes * self.refreshes_per_plane);
        Ok(())
    }

    /// The picture that was on its way has come on the monitor.
    fn report(&mut self, picture: OnItsWay, came: Presented, presented: &mut dyn FnMut(PresentedRefresh)) {
        if picture.frame.is_some() && self.reported != picture.frame {
            std::mem::swap(&mut self.shown, &mut self.coming);
        }
        self.reported = picture.frame;
        presented(PresentedRefresh {
            frame: picture.frame,
            field: picture.refresh * self.fields_per_refresh,
            repeated: picture.repeated,
            t_present: came.t_present,
            timestamp_source: came.timestamp_source,
            refresh_count: came.refresh_count,
        });
    }

    /// Takes in what the display server says has come on the monitor.
    fn collect(&mut self) -> Result<(), PanelFault> {
        loop {
            let Some(open) = &mut self.open else { return Err(PanelFault::WindowLost) };
            open.watched.check()?;
            let Some(timeline) = &mut open.timeline else { return Ok(()) };
            let Some(completion) = open.watched.completion() else { return Ok(()) };
            let Some(picture) = &mut self.on_its_way else { continue };
            match timeline.complete(completion, host_now()) {
                Outcome::NotThis => {}
                Outcome::Skipped => {
                    self.t_next = host_now();
                    self.next_refresh = picture.refresh;
                    self.skipped = true;
                    self.on_its_way = None;
                }
                Outcome::Shown(came) => {
                    open.lead.learn(open.t_refresh, came.t_present);
                    open.t_refresh = came.t_present;
                    picture.came = Some(came);
                }
            }
        }
    }

    /// Reports the picture that has come on the monitor by `now`, if one has.
    fn report_due(&mut self, now: TimeNs, presented: &mut dyn FnMut(PresentedRefresh)) {
        let is_due = |picture: &mut OnItsWay| picture.came.is_some_and(|came| came.t_present <= now);
        if let Some(picture) = self.on_its_way.take_if(is_due)
            && let (Some(came), Some(open)) = (picture.came, &self.open)
        {
            self.t_next = open.lead.t_choose(came.t_present);
            self.report(picture, came, presented);
        }
    }
}

impl Presenter for WindowPanel {
    fn is_virtual(&self) -> bool {
        false
    }

    fn wake_fd(&self) -> Option<BorrowedFd<'_>> {
        self.open.as_ref().map(|open| open.watched.bell())
    }

    fn t_next(&self) -> TimeNs {
        self.t_next
    }

    fn tick(
        &mut self,
        now: TimeNs,
        frames: &mut FrameSource,
        presented: &mut dyn FnMut(PresentedRefresh),
    ) -> Result<(), PanelFault> {
        // A panel that is lost is closed when it is opened again: that takes time, and the lasers must go out now.
        self.collect()?;
        // What came arrived after `now`, perhaps.
        self.report_due(host_now(), presented);
        if let Some(picture) = self.on_its_way {
            if now - picture.since > STUCK {
                return Err(PanelFault::WindowLost);
            }
            self.t_next = picture.came.map_or(picture.since + STUCK, |came| came.t_present);
            return Ok(());
        }
        if now < self.t_next {
            return Ok(());
        }
        self.present(now, frames)?;
        self.t_next = now + STUCK;
        if self.open.as_ref().is_some_and(|open| open.timeline.is_none())
            && let Some(picture) = self.on_its_way.take()
        {
            let t_present = host_now();
            self.t_next = (now + self.timing.refresh_period).max(t_present);
            let came = Presented { t_present, timestamp_source: TimestampSource::Software, refresh_count: None };
            self.report(picture, came, presented);
        }
        Ok(())
    }

    fn show_flat(&mut self) {
        self.flat_wanted = true;
    }

    fn recover(&mut self, _now: TimeNs) -> Result<(), PanelFault> {
        self.open_anew().map_err(|why| why.as_fault())
    }

    fn checks(&self) -> &[DisplayCheck] {
        &self.checks
    }

    fn shown(&self) -> Option<&LevelsFrame> {
        self.reported.map(|_| &self.shown)
    }
}

/// What is to be said of a window that has come up on `monitor`, and whose last picture came as `last` says.
fn checks(monitor: &Monitor, panel: &PanelMonitor, last: Option<watch::Completion>) -> Vec<DisplayCheck> {
    let is_stamped = last.is_some_and(|last| last.shown == watch::Shown::Flipped);
    let found = if is_stamped { "the display driver's" } else { "software's" };
    let check = |name: &str, found: String, wanted: String, verdict| DisplayCheck {
        name: name.to_owned(),
        found,
        wanted,
        verdict,
    };
    let times = if is_stamped { Verdict::Right } else { Verdict::Dark };
    let mut checks = vec![
        check("monitor", monitor.to_string(), panel.to_string(), Verdict::Right),
        check("times of refreshes", found.to_owned(), "the display driver's".to_owned(), times),
    ];
    if let Some(native) = monitor.edid.as_ref().and_then(|edid| edid.native) {
        let size = |size: Resolution| format!("{}x{}", size.width, size.height);
        let verdict = if native == panel.resolution { Verdict::Right } else { Verdict::Unverified };
        checks.push(check("the monitor's own size by its EDID", size(native), size(panel.resolution), verdict));
    }
    let there = seen_connectors(Path::new(SYS_CLASS_DRM));
    checks.extend(monitor.gets_ycbcr_444(&there).then(DisplayCheck::ycbcr_444));
    let unseen = "the display server is not asked; set them in the graphics driver's settings, or use drm:CONNECTOR";
    checks.push(DisplayCheck::unverified("full range, no underscan, no dithering", unseen, "all three"));
    checks
}

/// Writes the pixels of the video frame that begins with the `first_field`-th field of `frame`.
fn write_pixels(frame: &LevelsFrame, first_field: usize, pixels: &mut [u8]) {
    let pitch = PIXEL_BYTES * frame.layout().video_resolution().width;
    write_frame(frame, first_field, FORMAT, pitch, pixels);
}

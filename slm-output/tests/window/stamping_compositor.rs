//! A Wayland compositor that scans pictures out at 60 Hz and tells the time of each, as one on a graphics processor
//! does; none that runs without one tells any.
//!
//! A picture is drawn as soon as none waits for its refresh, comes on the monitor at the next one, and can be read from
//! then on: [`StampingCompositor::flips`].

use std::collections::VecDeque;
use std::os::fd::{AsFd, OwnedFd};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;

use holod_calibration::{TimeNs, host_now};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use wayland_protocols::wp::presentation_time::server::wp_presentation::{self, WpPresentation};
use wayland_protocols::wp::presentation_time::server::wp_presentation_feedback::{Kind, WpPresentationFeedback};
use wayland_protocols::xdg::shell::server::xdg_surface::{self, XdgSurface};
use wayland_protocols::xdg::shell::server::xdg_toplevel::{State, XdgToplevel};
use wayland_protocols::xdg::shell::server::xdg_wm_base::{self, XdgWmBase};
use wayland_server::backend::ClientData;
use wayland_server::protocol::wl_buffer::WlBuffer;
use wayland_server::protocol::wl_callback::WlCallback;
use wayland_server::protocol::wl_compositor::{self, WlCompositor};
use wayland_server::protocol::wl_output::{Mode, Subpixel, Transform, WlOutput};
use wayland_server::protocol::wl_shm::{self, Format, WlShm};
use wayland_server::protocol::wl_shm_pool::{self, WlShmPool};
use wayland_server::protocol::wl_surface::{self, WlSurface};
use wayland_server::{
    Client, DataInit, Dispatch, Display, DisplayHandle, GlobalDispatch, ListeningSocket, New, Resource,
};

use super::bench::SIZE;

/// Its only monitor.
pub(crate) const PANEL: &str = "DP-7";
const PERIOD: TimeNs = TimeNs(16_666_667);

/// What is scanned out from a refresh on.
#[derive(Clone)]
pub(crate) struct Flip {
    pub(crate) t_present: TimeNs,
    /// The first row of pixels: blue, green and red of each.
    pub(crate) row: Vec<[u8; 3]>,
}

/// What a compositor says of its pictures.
#[derive(Clone, Copy, Default)]
pub(crate) struct Manner {
    /// How long after a refresh its time is told; before it, where negative.
    pub(crate) told_after: TimeNs,
    /// Every n-th picture never comes on the monitor, which is told.
    pub(crate) leaves_out: Option<u32>,
    pub(crate) times: Times,
}

/// Whether times are told.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) enum Times {
    #[default]
    Told,
    /// Asked for one, it says that there is none.
    Denied,
    /// Asked for one, it says nothing.
    Unanswered,
}

/// A running compositor; ended when it is dropped.
pub(crate) struct StampingCompositor {
    folder: tempfile::TempDir,
    flips: Arc<Mutex<Vec<Flip>>>,
    ended: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl StampingCompositor {
    pub(crate) fn start(manner: Manner) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let (flips, ended) = (Arc::<Mutex<Vec<Flip>>>::default(), Arc::<AtomicBool>::default());
        let mut display = Display::new().expect("a display");
        let socket = ListeningSocket::bind_absolute(socket_in(folder.path())).expect("a socket");
        let handle = display.handle();
        handle.create_global::<Scanout, WlCompositor, ()>(4, ());
        handle.create_global::<Scanout, WlShm, ()>(1, ());
        handle.create_global::<Scanout, XdgWmBase, ()>(6, ());
        handle.create_global::<Scanout, WpPresentation, ()>(1, ());
        handle.create_global::<Scanout, WlOutput, ()>(4, ());
        let mut scanout = Scanout { manner, flips: flips.clone(), ..Scanout::default() };
        let is_ended = ended.clone();
        let thread = std::thread::spawn(move || {
            let (mut t_refresh, mut refresh_count) = (host_now() + PERIOD, 1);
            while !is_ended.load(Ordering::Acquire) {
                while let Some(stream) = socket.accept().expect("a connection") {
                    display.handle().insert_client(stream, Arc::new(Guest)).expect("a client");
                }
                display.dispatch_clients(&mut scanout).expect("requests");
                if host_now() >= t_refresh + manner.told_after {
                    scanout.refresh(t_refresh, refresh_count);
                    (t_refresh, refresh_count) = (t_refresh + PERIOD, refresh_count + 1);
                }
                // A client that has gone is not told anything.
                let _gone = display.flush_clients();
                let rest = (t_refresh + manner.told_after - host_now()).max(TimeNs(0));
                let timeout = Timespec { tv_sec: 0, tv_nsec: rest.0 };
                let fds = [display.as_fd(), socket.as_fd()];
                let _woken_or_not =
                    poll(&mut fds.map(|fd| PollFd::from_borrowed_fd(fd, PollFlags::IN)), Some(&timeout));
            }
        });
        Self { folder, flips, ended, thread: Some(thread) }
    }

    /// Where it is reached.
    pub(crate) fn socket(&self) -> PathBuf {
        socket_in(self.folder.path())
    }

    /// What has been scanned out until now.
    pub(crate) fn flips(&self) -> Vec<Flip> {
        self.flips.lock().expect("no thread panics with it").clone()
    }
}

impl Drop for StampingCompositor {
    fn drop(&mut self) {
        self.ended.store(true, Ordering::Release);
        let ended = self.thread.take().map(JoinHandle::join);
        assert!(std::thread::panicking() || matches!(ended, Some(Ok(()))), "the compositor panicked");
    }
}

fn socket_in(folder: &Path) -> PathBuf {
    folder.join("wayland-1")
}

struct Guest;

impl ClientData for Guest {}

/// Where a buffer lies.
struct Memory {
    pool: Arc<OwnedFd>,
    offset: u64,
}

/// A surface's picture, and who is to be told of it.
#[derive(Default)]
struct Picture {
    buffer: Option<WlBuffer>,
    drawn: Vec<WlCallback>,
    presented: Vec<WpPresentationFeedback>,
}

#[derive(Default)]
struct Scanout {
    manner: Manner,
    output: Option<WlOutput>,
    window: Option<(XdgSurface, XdgToplevel)>,
    configured: bool,
    entered: bool,
    /// What the client has not committed yet.
    pending: Picture,
    /// Committed, oldest first: the first waits for its refresh, the others to be drawn.
    committed: VecDeque<Picture>,
    count: u32,
    shown: Option<WlBuffer>,
    flips: Arc<Mutex<Vec<Flip>>>,
}

impl Scanout {
    fn commit(&mut self, surface: &WlSurface) {
        if !self.configured {
            let (window, toplevel) = self.window.as_ref().expect("a surface is a window first");
            let states = [State::Fullscreen, State::Activated].map(|state| (state as u32).to_ne_bytes());
            toplevel.configure(SIZE.width as i32, SIZE.height as i32, states.concat());
            window.configure(1);
            self.configured = true;
            return;
        }
        let picture = std::mem::take(&mut self.pending);
        if picture.buffer.is_none() {
            return;
        }
        if !self.entered {
            self.entered = true;
            surface.enter(self.output.as_ref().expect("a client knows its output"));
        }
        self.count += 1;
        if self.manner.leaves_out.is_some_and(|every| self.count.is_multiple_of(every)) {
            picture.presented.iter().for_each(WpPresentationFeedback::discarded);
            picture.buffer.iter().for_each(WlBuffer::release);
            return;
        }
        self.committed.push_back(picture);
        self.draw();
    }

    fn draw(&mut self) {
        for drawn in self.committed.front_mut().map(|first| std::mem::take(&mut first.drawn)).into_iter().flatten() {
            drawn.done(0);
        }
    }

    fn refresh(&mut self, t_present: TimeNs, refresh_count: u32) {
        let Some(picture) = self.committed.pop_front() else { return };
        let buffer = picture.buffer.expect("only such are committed");
        let Memory { pool, offset } = buffer.data().expect("a buffer of this compositor");
        let mut bytes = vec![0; 4 * SIZE.width];
        rustix::io::pread(pool, &mut bytes, *offset).expect("memory that both share");
        let row = bytes.chunks_exact(4).map(|pixel| [pixel[0], pixel[1], pixel[2]]).collect();
        self.flips.lock().expect("no thread panics with it").push(Flip { t_present, row });
        for feedback in picture.presented {
            let (seconds, nanoseconds) = (t_present.0 / 1_000_000_000, t_present.0 % 1_000_000_000);
            match self.manner.times {
                Times::Told => {
                    let stamped = Kind::Vsync | Kind::HwClock | Kind::HwCompletion;
                    let (seconds, nanoseconds) = (seconds as u32, nanoseconds as u32);
                    feedback.presented(0, seconds, nanoseconds, PERIOD.0 as u32, 0, refresh_count, stamped);
                }
                Times::Denied => feedback.discarded(),
                Times::Unanswered => {}
            }
        }
        if let Some(before) = self.shown.replace(buffer.clone()).filter(|before| *before != buffer) {
            before.release();
        }
        self.draw();
    }
}

impl GlobalDispatch<WlCompositor, ()> for Scanout {
    fn bind(
        _: &mut Self,
        _: &DisplayHandle,
        _: &Client,
        new: New<WlCompositor>,
        &(): &(),
        init: &mut DataInit<'_, Self>,
    ) {
        init.init(new, ());
    }
}

impl GlobalDispatch<WlShm, ()> for Scanout {
    fn bind(_: &mut Self, _: &DisplayHandle, _: &Client, new: New<WlShm>, &(): &(), init: &mut DataInit<'_, Self>) {
        init.init(new, ()).format(Format::Xrgb8888);
    }
}

impl GlobalDispatch<XdgWmBase, ()> for Scanout {
    fn bind(_: &mut Self, _: &DisplayHandle, _: &Client, new: New<XdgWmBase>, &(): &(), init: &mut DataInit<'_, Self>) {
        init.init(new, ());
    }
}

impl GlobalDispatch<WpPresentation, ()> for Scanout {
    fn bind(
        _: &mut Self,
        _: &DisplayHandle,
        _: &Client,
        new: New<WpPresentation>,
        &(): &(),
        init: &mut DataInit<'_, Self>,
    ) {
        init.init(new, ()).clock_id(rustix::time::ClockId::Monotonic as u32);
    }
}

impl GlobalDispatch<WlOutput, ()> for Scanout {
    fn bind(
        scanout: &mut Self,
        _: &DisplayHandle,
        _: &Client,
        new: New<WlOutput>,
        &(): &(),
        init: &mut DataInit<'_, Self>,
    ) {
        let output = init.init(new, ());
        let (maker, model) = ("HOL".to_owned(), "Scanned out".to_owned());
        output.geometry(0, 0, 100, 100, Subpixel::Unknown, maker, model, Transform::Normal);
        output.mode(Mode::Current | Mode::Preferred, SIZE.width as i32, SIZE.height as i32, 60_000);
        output.scale(1);
        output.name(PANEL.to_owned());
        output.done();
        scanout.output = Some(output);
    }
}

impl Dispatch<WlCompositor, ()> for Scanout {
    fn request(
        _: &mut Self,
        _: &Client,
        _: &WlCompositor,
        request: wl_compositor::Request,
        &(): &(),
        _: &DisplayHandle,
        init: &mut DataInit<'_, Self>,
    ) {
        let wl_compositor::Request::CreateSurface { id } = request else { unreachable!("{request:?}") };
        init.init(id, ());
    }
}

impl Dispatch<WlShm, ()> for Scanout {
    fn request(
        _: &mut Self,
        _: &Client,
        _: &WlShm,
        request: wl_shm::Request,
        &(): &(),
        _: &DisplayHandle,
        init: &mut DataInit<'_, Self>,
    ) {
        let wl_shm::Request::CreatePool { id, fd, .. } = request else { unreachable!("{request:?}") };
        init.init(id, Arc::new(fd));
    }
}

impl Dispatch<WlShmPool, Arc<OwnedFd>> for Scanout {
    fn request(
        _: &mut Self,
        _: &Client,
        _: &WlShmPool,
        request: wl_shm_pool::Request,
        pool: &Arc<OwnedFd>,
        _: &DisplayHandle,
        init: &mut DataInit<'_, Self>,
    ) {
        if let wl_shm_pool::Request::CreateBuffer { id, offset, .. } = request {
            init.init(id, Memory { pool: pool.clone(), offset: offset as u64 });
        }
    }
}

impl Dispatch<WlSurface, ()> for Scanout {
    fn request(
        scanout: &mut Self,
        _: &Client,
        surface: &WlSurface,
        request: wl_surface::Request,
        &(): &(),
        _: &DisplayHandle,
        init: &mut DataInit<'_, Self>,
    ) {
        match request {
            wl_surface::Request::Attach { buffer, .. } => scanout.pending.buffer = buffer,
            wl_surface::Request::Frame { callback } => scanout.pending.drawn.push(init.init(callback, ())),
            wl_surface::Request::Commit => scanout.commit(surface),
            _ => {}
        }
    }
}

impl Dispatch<XdgWmBase, ()> for Scanout {
    fn request(
        _: &mut Self,
        _: &Client,
        _: &XdgWmBase,
        request: xdg_wm_base::Request,
        &(): &(),
        _: &DisplayHandle,
        init: &mut DataInit<'_, Self>,
    ) {
        if let xdg_wm_base::Request::GetXdgSurface { id, .. } = request {
            init.init(id, ());
        }
    }
}

impl Dispatch<XdgSurface, ()> for Scanout {
    fn request(
        scanout: &mut Self,
        _: &Client,
        window: &XdgSurface,
        request: xdg_surface::Request,
        &(): &(),
        _: &DisplayHandle,
        init: &mut DataInit<'_, Self>,
    ) {
        if let xdg_surface::Request::GetToplevel { id } = request {
            scanout.window = Some((window.clone(), init.init(id, ())));
        }
    }
}

impl Dispatch<WpPresentation, ()> for Scanout {
    fn request(
        scanout: &mut Self,
        _: &Client,
        _: &WpPresentation,
        request: wp_presentation::Request,
        &(): &(),
        _: &DisplayHandle,
        init: &mut DataInit<'_, Self>,
    ) {
        if let wp_presentation::Request::Feedback { callback, .. } = request {
            scanout.pending.presented.push(init.init(callback, ()));
        }
    }
}

/// Objects whose requests change nothing here.
macro_rules! asks_for_nothing {
    ($($object:ty, $data:ty;)*) => {$(
        impl Dispatch<$object, $data> for Scanout {
            fn request(
                _: &mut Self,
                _: &Client,
                _: &$object,
                _: <$object as Resource>::Request,
                _: &$data,
                _: &DisplayHandle,
                _: &mut DataInit<'_, Self>,
            ) {
            }
        }
    )*};
}

asks_for_nothing! {
    WlBuffer, Memory;
    WlCallback, ();
    WlOutput, ();
    WpPresentationFeedback, ();
    XdgToplevel, ();
}

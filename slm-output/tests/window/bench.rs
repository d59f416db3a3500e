//! A panel's window, the frames that it is given, and a judge of what its monitor shows.

use std::os::fd::BorrowedFd;
use std::time::{Duration, Instant};

use holod_calibration::rig::{Panel, PanelMode, Rig};
use holod_calibration::{Colour, Resolution, TimeNs, host_now};
use holod_slm_output::fields::FrameTag;
use holod_slm_output::present::window::{DisplayServer, Road, WindowError, WindowPanel};
use holod_slm_output::present::{
    FrameSink, FrameSource, PanelFault, PanelSetup, PresentedRefresh, Presenter, WindowSpec, frame_channel,
};
use holod_slm_output::{FrameLayout, LevelsFrame};
use rustix::event::{PollFd, PollFlags, Timespec, poll};

/// The panel's pixels.
pub(crate) const SIZE: Resolution = Resolution { width: 640, height: 480 };
/// The flat pattern's level.
pub(crate) const FLAT: u16 = 128;

/// The rig's panel.
pub(crate) fn panel(mode: PanelMode) -> Panel {
    let [red, green, blue] = Colour::ALL;
    Panel { mode, field_order: [green, red, blue], refresh_hz: 60.0, ..Rig::default().panel }
}

pub(crate) fn named(monitor: &str) -> WindowSpec {
    WindowSpec { monitor: Some(monitor.to_owned()), allow_primary: false }
}

/// A panel with frames to show.
pub(crate) struct Bench {
    pub(crate) panel: WindowPanel,
    sink: FrameSink,
    pub(crate) source: FrameSource,
    /// Number of the frame that was submitted last.
    pub(crate) submitted: u64,
}

impl Bench {
    /// Opens the panel's window on a display server.
    pub(crate) fn open(
        server: DisplayServer,
        road: Road,
        spec: &WindowSpec,
        mode: PanelMode,
    ) -> Result<Self, WindowError> {
        Self::open_panel(server, road, spec, panel(mode), SIZE)
    }

    /// The same for `panel` of `resolution`.
    pub(crate) fn open_panel(
        server: DisplayServer,
        road: Road,
        spec: &WindowSpec,
        panel: Panel,
        resolution: Resolution,
    ) -> Result<Self, WindowError> {
        let mut flat = LevelsFrame::new(FrameLayout::new(&panel, resolution));
        for colour in Colour::ALL {
            flat.field_mut(colour).write(&vec![FLAT; resolution.pixels()]);
        }
        let (sink, source) = frame_channel(&flat);
        let panel = WindowPanel::open(server, road, spec, &PanelSetup { panel, flat })?;
        Ok(Self { panel, sink, source, submitted: 0 })
    }

    /// Submits a frame in which every pixel of every colour has a level of its own kind.
    pub(crate) fn submit(&mut self) -> u64 {
        self.submitted += 1;
        for colour in Colour::ALL {
            self.sink.acquire().field_mut(colour).write(&levels(self.submitted, colour));
        }
        let now = host_now();
        let tag = FrameTag { frame_id: self.submitted, t_submit: now, t_desired_present: now, keep: None };
        self.sink.submit(tag);
        self.submitted
    }

    /// Runs the panel until `done` says so of a refresh or the panel is lost, at most ten seconds.
    pub(crate) fn run(
        &mut self,
        mut done: impl FnMut(&PresentedRefresh) -> bool,
    ) -> Result<Vec<PresentedRefresh>, PanelFault> {
        let t_end = host_now() + TimeNs(10_000_000_000);
        let (mut refreshes, mut is_done) = (Vec::new(), false);
        while !is_done {
            let now = host_now();
            assert!(now < t_end, "still not done after {} refreshes: {:?}", refreshes.len(), refreshes.last());
            self.panel.tick(now, &mut self.source, &mut |refresh| {
                is_done |= done(&refresh);
                refreshes.push(refresh);
            })?;
            let rest_ns = (self.panel.t_next() - host_now()).0.clamp(0, 20_000_000);
            wait(self.panel.wake_fd(), rest_ns);
        }
        Ok(refreshes)
    }

    pub(crate) fn run_for(&mut self, refreshes: usize) -> Result<Vec<PresentedRefresh>, PanelFault> {
        let mut left = refreshes;
        self.run(|_| {
            left -= 1;
            left == 0
        })
    }

    /// Runs until frame `frame_id` is shown a second time, so that what a copy leaves behind is there to be seen.
    pub(crate) fn show(&mut self, frame_id: u64) {
        let shown = self.run(|refresh| refresh.repeated && refresh.frame.is_some_and(|tag| tag.frame_id == frame_id));
        shown.expect("the panel is there");
    }

    /// The fault that the panel finds while it runs.
    pub(crate) fn fault(&mut self) -> PanelFault {
        self.run(|_| false).expect_err("a fault")
    }

    pub(crate) fn recover(&mut self) {
        let recovered = wait_until(|| self.panel.recover(host_now()).is_ok());
        assert!(recovered, "{:?}", self.panel.recover(host_now()));
    }
}

fn wait(bell: Option<BorrowedFd<'_>>, rest_ns: i64) {
    let timeout = Timespec { tv_sec: 0, tv_nsec: rest_ns };
    let mut fds: Vec<_> = bell.into_iter().map(|bell| PollFd::from_borrowed_fd(bell, PollFlags::IN)).collect();
    poll(&mut fds, Some(&timeout)).expect("a descriptor can be waited for");
}

/// Levels that no scaling, dithering, shift or exchange of channels leaves as they are.
pub(crate) fn levels(frame: u64, colour: Colour) -> Vec<u16> {
    let salt = frame as usize * 41 + colour.index() * 89;
    (0..SIZE.pixels())
        .map(|pixel| {
            let (x, y) = (pixel % SIZE.width, pixel / SIZE.width);
            ((x * 7 + y * 13 + x * y / 3 + salt) % 256) as u16
        })
        .collect()
}

/// What the panel's monitor must show: blue, green and red of each pixel, for the colours in the video's channels.
pub(crate) fn expected(channels: [Vec<u16>; 3]) -> Vec<[u8; 3]> {
    let [red, green, blue] = channels;
    (0..SIZE.pixels()).map(|pixel| [blue[pixel] as u8, green[pixel] as u8, red[pixel] as u8]).collect()
}

/// Positions at which a picture is not what it must be.
pub(crate) fn differences(picture: &[u8], expected: &[[u8; 3]]) -> Vec<usize> {
    assert_eq!(picture.len(), 4 * expected.len());
    let pixels = picture.chunks_exact(4).zip(expected).enumerate();
    pixels.filter(|(_, (found, wanted))| found[..3] != wanted[..]).map(|(position, _)| position).collect()
}

pub(crate) fn packed(frame: u64) -> Vec<[u8; 3]> {
    // The panel's field order.
    expected([levels(frame, Colour::Green), levels(frame, Colour::Red), levels(frame, Colour::Blue)])
}

/// Waits until `done`, at most ten seconds; false where it never came.
pub(crate) fn wait_until(mut done: impl FnMut() -> bool) -> bool {
    let began = Instant::now();
    while began.elapsed() < Duration::from_secs(10) {
        if done() {
            return true;
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    false
}

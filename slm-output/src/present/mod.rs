//! Putting frames on a panel and saying when each was really shown.
//!
//! A [`Presenter`] knows one way to a panel. It reports refreshes, each a video frame that has come on the panel; what
//! that means for colours and lasers is worked out in [`crate::schedule`], alike for all of them.

pub mod drm;
mod headless;
mod look;
mod open;
mod recorder;
mod spec;
#[cfg(feature = "window")]
pub mod window;

pub use headless::{HeadlessPanel, ReportFaults};
pub use look::PanelLook;
pub(crate) use look::look;
pub use open::{OpenError, open_panel};
pub use recorder::Recorder;
pub use spec::{OutputSpec, SpecError, WindowSpec};

use std::os::fd::BorrowedFd;

use holod_calibration::TimeNs;
use holod_calibration::rig::{Panel, PanelMode};
use rustix::io::Errno;

use self::drm::DisplayCheck;
use crate::fields::{FrameTag, LevelsFrame};
use crate::levels::PanelEncoder;

/// Where the time of a presentation comes from, and so how far it can be trusted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum TimestampSource {
    /// The display controller stamped it.
    Hardware,
    /// The display server or driver reported it, from the controller's stamp as far as it says so.
    Driver,
    /// A sync input on the display's way to the panel.
    External,
    /// Software took the time, near the event but not from it. Of a virtual panel it is exact.
    Software,
    /// Nobody saw it; it was computed from earlier ones.
    Estimated,
}

impl TimestampSource {
    /// The lower-case name, as in files and logs.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Hardware => "hardware",
            Self::Driver => "driver",
            Self::External => "external",
            Self::Software => "software",
            Self::Estimated => "estimated",
        }
    }
}

/// The panel's nominal periods.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PanelTiming {
    /// How long one colour field is on the panel.
    pub field_period: TimeNs,
    /// From one video frame to the next: three fields in channel-packed mode, one field in the other modes.
    pub refresh_period: TimeNs,
    /// From one colour frame's first field to the next one's.
    pub frame_period: TimeNs,
    /// Fields in a colour frame.
    pub fields: usize,
    /// From a refresh that the display reports to the panel's update with its video.
    pub latency: TimeNs,
}

impl PanelTiming {
    /// The nominal timing of `panel`, whole nanoseconds: within 1 ns a field of the refresh rate.
    pub fn new(panel: &Panel) -> Self {
        let (field_period, fields) = (panel.field_period(), panel.fields());
        let frame_period = TimeNs(field_period.0 * fields as i64);
        let refresh_period = if panel.mode == PanelMode::ChannelPacked { frame_period } else { field_period };
        Self { field_period, refresh_period, frame_period, fields, latency: panel.latency }
    }

    /// How long before a refresh the frame that is for it must be submitted, as far as nothing else is known.
    pub fn submit_margin(self) -> TimeNs {
        TimeNs(self.refresh_period.0 / 16)
    }
}

/// A video frame that has come on the panel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PresentedRefresh {
    /// The frame whose pattern is shown; `None` for the flat pattern.
    pub frame: Option<FrameTag>,
    /// The first field of the colour frame that this refresh carries: 0 in channel-packed mode.
    pub field: usize,
    /// Whether the colour frame had been shown before, because no newer one was there in time.
    pub repeated: bool,
    /// When the pattern came on the panel; a [`Presenter`] tells when the display took it, which is sooner by the
    /// panel's latency.
    pub t_present: TimeNs,
    /// Where `t_present` comes from.
    pub timestamp_source: TimestampSource,
    /// The display controller's own count of refreshes, where it has one.
    pub refresh_count: Option<u64>,
}

impl PresentedRefresh {
    /// The same as a panel of that latency shows it. A time that is none stays so.
    pub(crate) fn shown_after(self, latency: TimeNs) -> Self {
        match self.t_present {
            TimeNs(..=0) => self,
            TimeNs(t) => Self { t_present: TimeNs(t.saturating_add(latency.0)), ..self },
        }
    }
}

/// What goes wrong at a panel that was open. Lasers are dark until the panel is back.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PanelFault {
    /// The connector has no panel any more.
    #[error("the panel was unplugged: plug it in again, holod takes it back")]
    Unplugged,
    /// Another program drives the display.
    #[error("another program took the display over: switch back to holod's terminal or end that program")]
    MastershipLost,
    /// The seat that the display belongs to shows another session.
    #[error("the display was switched to another session: switch back to holod's terminal")]
    SwitchedAway,
    /// The link to the panel fell below what its mode needs, and the mode must be set once more.
    #[error("the link to the panel failed: check the cable; holod sets the panel's mode once more")]
    LinkBad,
    /// The graphics device is gone or was reset.
    #[error("the graphics device was lost")]
    DeviceLost,
    /// The window was closed, hidden or moved off its monitor.
    #[error("the window is not on its monitor any more")]
    WindowLost,
    /// The panel no longer takes its own mode.
    #[error("the display refused the panel's own size or rate: check the cable and the monitor settings")]
    ModeRefused,
    /// The panel's monitor does not show its pixels as they are any more.
    #[error("the display does not show the panel's pixels as they are: {0}")]
    Altered(AlterationKind),
    /// The panel's monitor has become the one where the desktop is.
    #[error("the panel's monitor is the desktop's main one now: make another one that, or add ,allow_primary")]
    Primary,
    /// More than one monitor could be the panel.
    #[error("more than one monitor could be the panel now: name it by its connector or serial number")]
    Ambiguous,
    /// The system refused something else.
    #[error("the display failed: {0}")]
    System(Errno),
}

/// What changes pixels on their way to a monitor.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum AlterationKind {
    /// The server draws in another size, and scales.
    #[error("it is scaled; set its scale to 1")]
    Scaled,
    /// It rotates, reflects or warps.
    #[error("it is rotated, reflected or warped; set it upright")]
    Transformed,
    /// It shows one half of the lines at a time, or each twice.
    #[error("its mode is interlaced or doubles lines; set a progressive one")]
    Interlaced,
    /// It bends the levels by a gamma ramp, as night-light and calibration tools set one.
    #[error("a gamma ramp bends its levels; switch off night light and colour profiles for it")]
    GammaRamp,
    /// Another monitor shows the same part of the desktop.
    #[error("another monitor shows the same part of the desktop; move one of them")]
    Mirrored,
    /// It is in power-saving.
    #[error("it is in power-saving; wake it, and switch power-saving off")]
    Asleep,
}

impl PanelFault {
    /// Whether [`Presenter::recover`] can mend it.
    pub const fn is_recoverable(self) -> bool {
        !matches!(self, Self::System(_))
    }
}

/// A panel, real or virtual, driven from one thread.
pub trait Presenter: Send {
    /// Whether there is no panel but this program, so that its software times are the truth.
    fn is_virtual(&self) -> bool;

    /// A descriptor that becomes readable when [`Self::tick`] has something to do; without one only time wakes it.
    fn wake_fd(&self) -> Option<BorrowedFd<'_>> {
        None
    }

    /// The next time at which [`Self::tick`] has something to do, whatever [`Self::wake_fd`] says.
    fn t_next(&self) -> TimeNs;

    /// Brings the panel to `now`: takes the newest frame when the next video frame is chosen, and calls `presented` for
    /// each refresh that has come on the panel since the last call, in order; also for one that shows what was shown
    /// before. Neither allocates, locks nor logs, and waits for nothing but the panel.
    ///
    /// # Errors
    /// [`PanelFault`]; nothing more is presented until [`Self::recover`] has succeeded.
    fn tick(
        &mut self,
        now: TimeNs,
        frames: &mut FrameSource,
        presented: &mut dyn FnMut(PresentedRefresh),
    ) -> Result<(), PanelFault>;

    /// From the next colour frame on, shows the flat pattern and takes no more frames.
    fn show_flat(&mut self);

    /// Takes the panel back after a fault; called some times a second while it is lost. May allocate and may wait for
    /// the system, since lasers are dark.
    ///
    /// # Errors
    /// [`PanelFault`] while the panel is not to be had.
    fn recover(&mut self, now: TimeNs) -> Result<(), PanelFault>;

    /// What was looked at on the way to the panel when it was opened or last taken back, where it says.
    fn checks(&self) -> &[DisplayCheck] {
        &[]
    }

    /// The levels of the frame that was reported last; `None` for the flat pattern.
    fn shown(&self) -> Option<&LevelsFrame>;
}

/// What a presenter must know of the panel.
#[derive(Clone, Debug)]
pub struct PanelSetup {
    /// The panel, as the rig describes it.
    pub panel: Panel,
    /// The flat pattern; its layout is that of every frame.
    pub flat: LevelsFrame,
}

impl PanelSetup {
    /// The setup for `panel`, whose frames `encoder` makes.
    pub fn new(panel: &Panel, encoder: &PanelEncoder) -> Self {
        let mut flat = LevelsFrame::new(encoder.layout());
        encoder.encode_flat(&mut flat);
        Self { panel: panel.clone(), flat }
    }
}

/// The way of frames to the panel: three buffers, of which the newest complete one is shown; wait-free at both ends.
/// `blank` gives the layout; its copies are all the memory that is ever taken.
pub fn frame_channel(blank: &LevelsFrame) -> (FrameSink, FrameSource) {
    let (input, output) = triple_buffer::triple_buffer(blank);
    (FrameSink(input), FrameSource(output))
}

/// Where frames are made.
#[derive(Debug)]
pub struct FrameSink(triple_buffer::Input<LevelsFrame>);

impl FrameSink {
    /// The buffer of the next frame, with the levels of some older one in it.
    pub fn acquire(&mut self) -> &mut LevelsFrame {
        self.0.input_buffer_mut()
    }

    /// Hands the acquired frame over.
    pub fn submit(&mut self, tag: FrameTag) {
        self.acquire().tag = tag;
        self.0.publish();
    }
}

/// What a presenter takes frames from: the newest one that has been submitted.
#[derive(Debug)]
pub struct FrameSource(triple_buffer::Output<LevelsFrame>);

impl FrameSource {
    /// Makes the newest submitted frame current; whether there was one since the last call.
    pub fn update(&mut self) -> bool {
        self.0.update()
    }

    /// The current frame. A presenter that keeps it swaps a buffer of the same layout into its place.
    pub fn current_mut(&mut self) -> &mut LevelsFrame {
        self.0.output_buffer_mut()
    }
}

//! Putting frames on a panel and saying when each field was really shown.

mod headless;

pub use headless::HeadlessPanel;

use holod_calibration::rig::Panel;
use holod_calibration::{Colour, TimeNs};

use crate::fields::{FIELDS, FrameTag, LevelsFrame};

/// Where the time of a presentation comes from, and so how far it can be trusted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Provenance {
    /// The display controller stamped it.
    Hardware,
    /// A sync input that sees the panel itself.
    External,
    /// Software took the time, near the event but not from it. Of a virtual panel it is exact.
    Software,
    /// Nobody saw it; it was computed from earlier ones.
    Estimated,
}

impl Provenance {
    /// The lower-case name, as in files and logs.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Hardware => "hardware",
            Self::External => "external",
            Self::Software => "software",
            Self::Estimated => "estimated",
        }
    }
}

/// The panel's clockwork.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PanelTiming {
    /// How long one field is on the panel.
    pub field_period: TimeNs,
    /// From one colour frame's first field to the next one's: three fields.
    pub frame_period: TimeNs,
}

impl PanelTiming {
    /// The nominal timing of `panel`, whole nanoseconds: within 1 ns a field of the refresh rate.
    pub fn new(panel: &Panel) -> Self {
        let field_period = panel.field_period();
        Self { field_period, frame_period: TimeNs(field_period.0 * FIELDS as i64) }
    }
}

/// One colour field that has come on the panel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PresentedField {
    /// The frame whose pattern is shown; `None` for the flat pattern before the first and after the last frame.
    pub frame: Option<FrameTag>,
    /// Position in the field order.
    pub field: usize,
    /// The colour whose pattern is shown.
    pub colour: Colour,
    /// When the pattern came on the panel.
    pub t_present: TimeNs,
    /// Where `t_present` comes from.
    pub provenance: Provenance,
    /// Whether the frame had been shown before, because no newer one was there in time.
    pub repeated: bool,
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

/// A panel, real or virtual, driven from one thread.
pub trait Presenter: Send {
    /// The panel's clockwork.
    fn timing(&self) -> PanelTiming;

    /// Whether there is no panel but this program, so that its software times are the truth.
    fn is_virtual(&self) -> bool;

    /// The next time at which [`Self::tick`] has something to do.
    fn t_next(&self) -> TimeNs;

    /// Brings the panel to `now`: takes the newest frame at each colour frame's start and calls `presented` for each
    /// field that has come on the panel since the last call, in order. Neither allocates, locks nor logs.
    fn tick(&mut self, now: TimeNs, frames: &mut FrameSource, presented: &mut dyn FnMut(PresentedField));

    /// From the next colour frame on, shows the flat pattern and takes no more frames.
    fn show_flat(&mut self);

    /// The last frame whose levels were shown; `None` before the first one, and where it cannot say.
    fn last_frame(&self) -> Option<&LevelsFrame>;

    /// Takes the levels that were shown and kept, by slot (see [`FrameTag::keep`]).
    fn take_kept(&mut self) -> Vec<Option<LevelsFrame>>;
}

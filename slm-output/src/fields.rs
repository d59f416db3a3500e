//! The levels of a colour frame as the panel is sent them, and back again.

use std::sync::atomic::{AtomicU64, Ordering};

use holod_calibration::rig::{Packing, Panel, PanelMode, VideoMargins};
use holod_calibration::{Colour, Resolution};
use rayon::prelude::*;

/// Patterns in a colour frame: one for each laser.
pub const FIELDS: usize = 3;

/// How a panel wants the levels of a colour frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FrameLayout {
    /// Pixels of one field: those of the panel.
    pub resolution: Resolution,
    /// How the fields are carried.
    pub mode: PanelMode,
    /// The order in which the colours are shown; it is that of the patterns in a frame's samples.
    pub field_order: [Colour; FIELDS],
    /// The order in which the panel shows the video's channels, in channel-packed mode.
    pub channel_order: [Colour; FIELDS],
    /// Video frames in a row that show one colour's pattern in field-sequential mode; 1 in the other modes.
    pub frames_per_colour: u8,
    /// Where the bits of a level travel on the video link.
    pub packing: Packing,
    /// What the video frame has around the panel's pixels.
    pub video_margins: VideoMargins,
}

impl FrameLayout {
    /// The layout for `panel` with `resolution` pixels.
    pub fn new(panel: &Panel, resolution: Resolution) -> Self {
        let Panel { mode, field_order, channel_order, frames_per_colour, packing, video_margins, .. } = *panel;
        Self { resolution, mode, field_order, channel_order, frames_per_colour, packing, video_margins }
    }

    /// Pixels of the video frame: the panel's, and those around them.
    pub fn video_resolution(&self) -> Resolution {
        self.video_margins.around(self.resolution)
    }

    /// Colour fields from the start of one colour frame to the start of the next.
    pub fn fields(&self) -> usize {
        match self.mode {
            PanelMode::ChannelPacked => FIELDS,
            PanelMode::FieldSequential => FIELDS * usize::from(self.frames_per_colour),
            PanelMode::Monochrome(_) => 1,
        }
    }

    /// Video frames from the start of one colour frame to the start of the next.
    pub fn refreshes(&self) -> usize {
        self.fields() / self.fields_per_refresh()
    }

    /// Colour fields that the panel shows in one video frame.
    pub fn fields_per_refresh(&self) -> usize {
        if self.mode == PanelMode::ChannelPacked { FIELDS } else { 1 }
    }

    /// The colour whose pattern is shown as the `field`-th field of a colour frame.
    ///
    /// # Panics
    /// Where `field` is not below [`Self::fields`].
    pub fn colour_of_field(&self, field: usize) -> Colour {
        assert!(field < self.fields(), "a colour frame has {} fields", self.fields());
        match self.mode {
            PanelMode::ChannelPacked => self.field_order[field],
            PanelMode::FieldSequential => self.field_order[field / usize::from(self.frames_per_colour)],
            PanelMode::Monochrome(colour) => colour,
        }
    }

    /// The position of `colour` in the field order.
    ///
    /// # Panics
    /// Where the order lacks the colour, which the rig file's validation excludes.
    fn position_of(&self, colour: Colour) -> usize {
        self.field_order.iter().position(|&shown| shown == colour).expect("a field order holds each colour once")
    }

    /// Distance in samples between neighbouring pixels of one field.
    const fn stride(&self) -> usize {
        match self.mode {
            PanelMode::ChannelPacked => FIELDS,
            PanelMode::FieldSequential | PanelMode::Monochrome(_) => 1,
        }
    }

    /// Index of the first sample of the pattern at `position` in the field order.
    const fn offset(&self, position: usize) -> usize {
        match self.mode {
            PanelMode::ChannelPacked => position,
            PanelMode::FieldSequential | PanelMode::Monochrome(_) => position * self.resolution.pixels(),
        }
    }
}

/// One colour frame of levels, laid out as the panel takes it.
///
/// - Channel-packed: one video frame `[height, width, 3]`, row-major, the fields in the order in which they are *shown*,
///   whatever their colours are; the video's channels carry them as [`FrameLayout::channel_order`] says.
/// - Field-sequential and monochrome: three gray video frames `[3 (shown order), height, width]`; whoever sends one to
///   a colour video link repeats each level in R, G and B. In monochrome mode the panel shows one of them only.
#[derive(Clone, Debug)]
pub struct LevelsFrame {
    pub(crate) tag: FrameTag,
    layout: FrameLayout,
    samples: Vec<u16>,
    /// Which encoder's surround lies around its pattern; none since anything else wrote here.
    pub(crate) surround: Option<SurroundId>,
    /// What its maker calls its samples; nothing since anything else wrote here.
    content: Option<u64>,
}

/// Numbers what an encoder writes around its patterns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct SurroundId(u64);

impl SurroundId {
    /// A number not given before.
    pub(crate) fn new() -> Self {
        static NEXT: AtomicU64 = AtomicU64::new(0);
        Self(NEXT.fetch_add(1, Ordering::Relaxed))
    }
}

impl Eq for LevelsFrame {}

impl PartialEq for LevelsFrame {
    /// Who wrote the samples makes no difference.
    fn eq(&self, other: &Self) -> bool {
        let Self { tag, layout, samples, surround: _, content: _ } = self;
        (tag, layout, samples) == (&other.tag, &other.layout, &other.samples)
    }
}

/// What travels with a frame's levels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameTag {
    /// The frame's number, as the pacer gave it.
    pub frame_id: u64,
    /// When the frame was handed to the panel.
    pub t_submit: holod_calibration::TimeNs,
    /// When it was to come on the panel.
    pub t_desired_present: holod_calibration::TimeNs,
    /// The memory slot in which the panel shall keep the levels that it has really shown, if any.
    pub keep: Option<usize>,
}

impl LevelsFrame {
    /// A frame whose every sample is level 0.
    pub fn new(layout: FrameLayout) -> Self {
        Self {
            tag: FrameTag::default(),
            layout,
            samples: vec![0; FIELDS * layout.resolution.pixels()],
            surround: None,
            content: None,
        }
    }

    /// The frame's number and times.
    pub fn tag(&self) -> FrameTag {
        self.tag
    }

    /// How the samples are laid out.
    pub fn layout(&self) -> FrameLayout {
        self.layout
    }

    /// All samples, as the panel takes them.
    pub fn samples(&self) -> &[u16] {
        &self.samples
    }

    /// All samples, to be written as a whole by whoever has made them as the panel takes them.
    pub fn samples_mut(&mut self) -> &mut [u16] {
        (self.surround, self.content) = (None, None);
        &mut self.samples
    }

    /// The samples of one colour's pattern, `[height, width]` row-major.
    ///
    /// # Panics
    /// In channel-packed mode, where the samples of the colours alternate.
    pub fn plane(&self, colour: Colour) -> &[u16] {
        assert_eq!(self.layout.stride(), 1, "the samples of a channel-packed frame alternate");
        &self.samples[self.layout.offset(self.layout.position_of(colour))..][..self.layout.resolution.pixels()]
    }

    /// The samples of one row of the video frame that begins with the `first_field`-th field of a colour frame, for
    /// [`crate::packing::pack_row`].
    ///
    /// # Panics
    /// Where there is no such field or row.
    pub fn video_row(&self, first_field: usize, row: usize) -> &[u16] {
        let Resolution { width, height } = self.layout.resolution;
        assert!(row < height, "a frame has {height} rows");
        let stride = self.layout.stride();
        let first = match self.layout.mode {
            PanelMode::ChannelPacked => 0,
            _ => self.layout.offset(self.layout.position_of(self.layout.colour_of_field(first_field))),
        };
        &self.samples[first + row * width * stride..][..width * stride]
    }

    /// The levels of `colour`, to be written.
    pub fn field_mut(&mut self, colour: Colour) -> FieldMut<'_> {
        let (stride, offset) = (self.layout.stride(), self.layout.offset(self.layout.position_of(colour)));
        (self.surround, self.content) = (None, None);
        FieldMut { samples: &mut self.samples[offset..], stride, resolution: self.layout.resolution }
    }

    /// All rows of samples, to be written by the threads of the pool that this is called in.
    pub(crate) fn par_rows_mut(&mut self) -> impl IndexedParallelIterator<Item = RowMut<'_>> {
        let Self { layout, samples, surround, content, .. } = self;
        (*surround, *content) = (None, None);
        let FrameLayout { resolution: Resolution { width, height }, field_order, .. } = *layout;
        let stride = layout.stride();
        samples.par_chunks_exact_mut((width * stride).max(1)).enumerate().map(move |(index, samples)| {
            let (mut colours, count) = (field_order, stride);
            if count == 1 {
                colours[0] = field_order[index / height];
            }
            RowMut { row: index % height, colours, count, samples }
        })
    }

    /// Writes one sample without a trace of it.
    #[cfg(test)]
    pub(crate) fn write_unseen(&mut self, index: usize, sample: u16) {
        self.samples[index] = sample;
    }

    /// Takes the levels of `colour` out of the frame.
    pub fn unpack_colour(&self, colour: Colour) -> ColourField {
        let samples = self.samples[self.layout.offset(self.layout.position_of(colour))..].iter();
        ColourField {
            frame_id: self.tag.frame_id,
            colour,
            resolution: self.layout.resolution,
            levels: samples.step_by(self.layout.stride()).take(self.layout.resolution.pixels()).copied().collect(),
        }
    }

    /// Overwrites samples and tag with those of `other`, without allocating.
    ///
    /// # Panics
    /// Where `other` has another layout.
    pub fn copy_from(&mut self, other: &Self) {
        assert_eq!(self.layout, other.layout, "frames of one output have one layout");
        self.tag = other.tag;
        self.samples.copy_from_slice(&other.samples);
        (self.surround, self.content) = (other.surround, other.content);
    }

    /// Calls the samples by a number, until any are written. It goes where they go: whoever gets the buffer again need
    /// not write the same once more.
    pub fn call_content(&mut self, content: u64) {
        self.content = Some(content);
    }

    /// What the samples were called last, where none were written since.
    pub fn content(&self) -> Option<u64> {
        self.content
    }
}

/// One colour's pattern while its laser is lit.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ColourField {
    /// The frame it belongs to.
    pub frame_id: u64,
    /// The laser that belongs to it.
    pub colour: Colour,
    /// Width and height of `levels`: the panel's pixels.
    pub resolution: Resolution,
    /// Levels `[height, width]`, row-major.
    pub levels: Vec<u16>,
}

/// One row of the panel's samples: of all colours in turn, or of one.
#[derive(Debug)]
pub(crate) struct RowMut<'a> {
    /// The row, from the top.
    pub(crate) row: usize,
    colours: [Colour; FIELDS],
    count: usize,
    samples: &'a mut [u16],
}

impl RowMut<'_> {
    /// Each colour of the row with its samples from its first one on, as many apart as there are colours in the row.
    pub(crate) fn for_each(&mut self, mut write: impl FnMut(Colour, Strided<'_>)) {
        for (offset, &colour) in self.colours[..self.count].iter().enumerate() {
            write(colour, Strided { samples: &mut self.samples[offset..], stride: self.count });
        }
    }
}

/// Samples of one colour, some apart.
#[derive(Debug)]
pub(crate) struct Strided<'a> {
    pub(crate) samples: &'a mut [u16],
    pub(crate) stride: usize,
}

impl Strided<'_> {
    /// Those from the `first`-th pixel on.
    pub(crate) fn from(&mut self, first: usize) -> Strided<'_> {
        let begin = (first * self.stride).min(self.samples.len());
        Strided { samples: &mut self.samples[begin..], stride: self.stride }
    }
}

/// The samples of one field inside a frame.
#[derive(Debug)]
pub struct FieldMut<'a> {
    samples: &'a mut [u16],
    stride: usize,
    resolution: Resolution,
}

impl FieldMut<'_> {
    /// Width and height of the field: the panel's pixels.
    pub fn resolution(&self) -> Resolution {
        self.resolution
    }

    /// Copies `levels` `[height, width]`, row-major, into the field.
    ///
    /// # Panics
    /// Where `levels` has another number of pixels than the panel.
    pub fn write(&mut self, levels: &[u16]) {
        assert_eq!(levels.len(), self.resolution.pixels(), "a field has one level for each panel pixel");
        for (sample, &level) in self.samples.iter_mut().step_by(self.stride).zip(levels) {
            *sample = level;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const SMALL: Resolution = Resolution { width: 5, height: 3 };
    const TWO: Resolution = Resolution { width: 2, height: 1 };

    fn layout(resolution: Resolution, mode: PanelMode, field_order: [Colour; FIELDS]) -> FrameLayout {
        FrameLayout {
            resolution,
            mode,
            field_order,
            channel_order: Colour::ALL,
            frames_per_colour: 1,
            packing: Packing::Gray,
            video_margins: VideoMargins::default(),
        }
    }

    #[test]
    fn what_samples_are_called_goes_with_them_and_ends_when_any_are_written() {
        let blank = LevelsFrame::new(layout(SMALL, PanelMode::FieldSequential, Colour::ALL));
        let writes: [fn(&mut LevelsFrame); 3] = [
            |frame| frame.samples_mut()[0] = 0,
            |frame| _ = frame.field_mut(Colour::Red),
            |frame| _ = frame.par_rows_mut(),
        ];
        for write in writes {
            let mut frame = blank.clone();
            assert_eq!(frame.content(), None);
            frame.call_content(7);
            assert_eq!((frame.content(), frame.clone() == blank), (Some(7), true), "a name changes no levels");
            let mut copy = blank.clone();
            copy.copy_from(&frame);
            assert_eq!(copy.content(), Some(7));
            write(&mut frame);
            assert_eq!((frame.content(), copy.content()), (None, Some(7)));
            copy.copy_from(&frame);
            assert_eq!(copy.content(), None);
        }
    }

    fn orders() -> impl Strategy<Value = [Colour; FIELDS]> {
        Just(Colour::ALL).prop_shuffle()
    }

    fn modes() -> impl Strategy<Value = PanelMode> {
        let monochrome = PanelMode::Monochrome(Colour::Green);
        prop_oneof![Just(PanelMode::ChannelPacked), Just(PanelMode::FieldSequential), Just(monochrome)]
    }

    fn levels() -> impl Strategy<Value = Vec<u16>> {
        prop::collection::vec(0u16..1024, SMALL.pixels())
    }

    proptest! {
        #[test]
        fn unpacking_gives_back_each_colour_in_its_place(
            field_order in orders(), mode in modes(), red in levels(), green in levels(), blue in levels(),
        ) {
            let layout = layout(SMALL, mode, field_order);
            let mut frame = LevelsFrame::new(layout);
            let given = [red, green, blue];
            for colour in Colour::ALL {
                frame.field_mut(colour).write(&given[colour.index()]);
            }
            for colour in Colour::ALL {
                let field = frame.unpack_colour(colour);
                prop_assert_eq!(field.colour, colour);
                prop_assert_eq!(&field.levels, &given[colour.index()]);
                if mode != PanelMode::ChannelPacked {
                    prop_assert_eq!(frame.plane(colour), &given[colour.index()][..]);
                }
            }
        }
    }

    #[test]
    fn channel_packed_puts_the_first_shown_field_in_the_first_channel() {
        let field_order = [Colour::Green, Colour::Red, Colour::Blue];
        let layout = layout(TWO, PanelMode::ChannelPacked, field_order);
        let mut frame = LevelsFrame::new(layout);
        frame.field_mut(Colour::Red).write(&[10, 11]);
        frame.field_mut(Colour::Green).write(&[20, 21]);
        frame.field_mut(Colour::Blue).write(&[30, 31]);
        assert_eq!(frame.samples(), [20, 10, 30, 21, 11, 31]);
        assert_eq!(frame.video_row(0, 0), frame.samples());
    }

    #[test]
    fn field_sequential_puts_the_first_shown_field_first() {
        let field_order = [Colour::Blue, Colour::Red, Colour::Green];
        let layout = FrameLayout { frames_per_colour: 2, ..layout(TWO, PanelMode::FieldSequential, field_order) };
        let [blue, red, green] = field_order;
        let shown: Vec<_> = (0..layout.fields()).map(|field| layout.colour_of_field(field)).collect();
        assert_eq!(shown, [blue, blue, red, red, green, green]);
        let mut frame = LevelsFrame::new(layout);
        frame.field_mut(Colour::Red).write(&[10, 11]);
        frame.field_mut(Colour::Green).write(&[20, 21]);
        frame.field_mut(Colour::Blue).write(&[30, 31]);
        assert_eq!(frame.samples(), [30, 31, 10, 11, 20, 21]);
        let rows: Vec<_> = (0..layout.fields()).map(|field| frame.video_row(field, 0)).collect();
        assert_eq!(rows, [[30, 31], [30, 31], [10, 11], [10, 11], [20, 21], [20, 21]]);
    }
}

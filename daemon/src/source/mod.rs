//! Pictures for the frame thread: a scene from files, or what a live feed has handed over last.
//!
//! The newest picture wins. Whoever has one puts it into the [`PictureSink`]; the frame thread takes it out of the
//! [`PictureSource`], wait-free, and never gives memory back: that is left to the sink.

pub mod feed;
pub mod scene;

use std::sync::{Arc, Mutex};
use std::time::Duration;

use holod_calibration::{DisplayGeometry, Resolution, TimeNs};
use holod_model::RgbdFrame;
use serde::{Deserialize, Serialize};

use crate::cli::SceneArgs;
use crate::failure::{Exit, Failure};

use self::feed::{Feed, FeedError, FeedPlan};
use self::scene::{Frames, SceneFigures};

/// What a run is to show.
#[derive(Clone)]
pub enum Pictures {
    /// A scene from files, or the built-in one.
    Scene(Arc<Frames>),
    /// What clients of a live feed hand over.
    Feed(Arc<FeedPlan>),
}

impl Pictures {
    /// Size of every frame.
    pub fn resolution(&self) -> Resolution {
        match self {
            Self::Scene(frames) => frames.resolution(),
            Self::Feed(plan) => plan.resolution,
        }
    }

    /// The name for reports.
    pub fn name(&self) -> &str {
        match self {
            Self::Scene(frames) => &frames.name,
            Self::Feed(_) => "the live feed",
        }
    }

    /// A scene in figures.
    pub fn figures(&self) -> Option<SceneFigures> {
        match self {
            Self::Scene(frames) => Some(frames.figures()),
            Self::Feed(_) => None,
        }
    }

    /// How long a sequence is, for reports; nothing of stills.
    pub fn extent(&self) -> String {
        match self {
            Self::Scene(frames) if frames.frames.len() > 1 => {
                let rate = frames.fps.map(|fps| format!(" at {fps} a second")).unwrap_or_default();
                format!(", {} frames{rate},", frames.frames.len())
            }
            _ => String::new(),
        }
    }

    /// What is shown first: of a feed, until a client has handed something over, black.
    pub fn first_frame(&self) -> Arc<RgbdFrame> {
        match self {
            Self::Scene(frames) => Arc::clone(&frames.frames[0]),
            Self::Feed(plan) => Arc::clone(&plan.black),
        }
    }
}

/// The socket that `--scene feed` or `--scene feed:PATH` means; of the former, none.
pub(crate) fn feed_socket(spec: &str) -> Option<Option<&str>> {
    if spec == "feed" { Some(None) } else { spec.strip_prefix("feed:").map(Some) }
}

/// Whether a live feed is named.
pub(crate) fn is_feed(spec: &str) -> bool {
    feed_socket(spec).is_some()
}

/// The scene or the feed that was named; of the latter, lasers are dark when it gives no picture for `dark_after`.
///
/// # Errors
/// The scene cannot be read, or what was named does not fit on the panel.
pub fn named(args: &SceneArgs, dark_after: Option<Duration>, geometry: &DisplayGeometry) -> Result<Pictures, Failure> {
    let Some((socket, resolution)) = feed_of(args, dark_after, geometry)? else {
        return scene::frames(args, geometry).map(|frames| Pictures::Scene(Arc::new(frames)));
    };
    let socket = match socket {
        Some(path) => path.into(),
        None => feed::default_socket().map_err(Failure::because(Exit::Unavailable))?,
    };
    let dark_after = dark_after.map(|time| TimeNs(i64::try_from(time.as_nanos()).unwrap_or(i64::MAX)));
    let plan = FeedPlan { dark_after, ..FeedPlan::new(socket, resolution, args.fit.into()) };
    Ok(Pictures::Feed(Arc::new(plan)))
}

/// Refuses what [`named`] would by its options alone. A scene that cannot be read may be there later.
///
/// # Errors
/// The options do not go together, or what they name does not fit on the panel.
pub fn judge(args: &SceneArgs, dark_after: Option<Duration>, geometry: &DisplayGeometry) -> Result<(), Failure> {
    match feed_of(args, dark_after, geometry)? {
        Some(_) => Ok(()),
        None => scene::judge(args, geometry),
    }
}

/// The socket of the feed that was named, and the size of its frames; nothing where a scene was.
fn feed_of<'a>(
    args: &'a SceneArgs,
    dark_after: Option<Duration>,
    geometry: &DisplayGeometry,
) -> Result<Option<(Option<&'a str>, Resolution)>, Failure> {
    let Some(socket) = args.scene.as_deref().and_then(feed_socket) else {
        if dark_after.is_some() {
            let only = "--feed-dark-after is for a live feed: name it with --scene feed";
            return Err(Failure::new(Exit::Usage, only));
        }
        return Ok(None);
    };
    if args.depth_encoding.is_some() {
        let own = "--depth-encoding is for files: a feed's clients say what their depths are";
        return Err(Failure::new(Exit::Usage, own));
    }
    let resolution = args.resolution.unwrap_or(geometry.resolution);
    scene::check_fits(resolution, geometry, "--resolution")?;
    Ok(Some((socket, resolution)))
}

/// Pictures on their way, by the threads that hold their parts.
pub struct OpenPictures {
    /// Where other scenes are put in.
    pub sink: Arc<Mutex<PictureSink>>,
    /// For the frame thread.
    pub source: PictureSource,
    /// The feed, where there is one.
    pub feed: Option<Feed>,
}

/// Both ends of `pictures`, which begin at host time `t_start`.
///
/// # Errors
/// The feed cannot listen.
pub fn open(pictures: &Pictures, geometry: &DisplayGeometry, t_start: TimeNs) -> Result<OpenPictures, FeedError> {
    let (sink, source) = newest_picture(pictures, t_start);
    let sink = Arc::new(Mutex::new(sink));
    let feed = match pictures {
        Pictures::Scene(_) => None,
        Pictures::Feed(plan) => Some(Feed::listen(plan, geometry, Arc::clone(&sink))?),
    };
    Ok(OpenPictures { sink, source, feed })
}

/// Something to show until there is something newer.
#[derive(Clone)]
enum Shown {
    /// A scene, from the time at which it begins.
    Scene { frames: Arc<Frames>, t_start: TimeNs, order: u32 },
    /// One picture of a live feed.
    Live { frame: Arc<RgbdFrame>, tag: PictureTag },
}

/// How a camera took a picture, where a feed's client says so. It is recorded and told, and changes nothing that is
/// shown.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PictureView {
    /// The distance at which it was focused, in dioptres.
    pub focus_dpt: Option<f32>,
    /// Its field of view across and up, in degrees.
    pub field_of_view_deg: Option<[f32; 2]>,
}

impl PictureView {
    /// In words, where something is known.
    pub fn text(&self) -> Option<String> {
        let focus = self.focus_dpt.map(|dpt| format!("focused at {dpt:.2} dpt"));
        let field = self.field_of_view_deg.map(|[across, up]| format!("{across:.1} x {up:.1} degrees"));
        let parts: Vec<_> = focus.into_iter().chain(field).collect();
        (!parts.is_empty()).then(|| parts.join(", "))
    }
}

/// Which picture a hologram was made of.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PictureTag {
    /// Its number in a scene, from 0, or the sequence that a feed's client gave it.
    pub number: u64,
    /// When a feed's client took it, or else when it came.
    pub t_taken: Option<TimeNs>,
    /// When it was taken over from a feed's client.
    pub t_came: Option<TimeNs>,
    /// How it was taken.
    pub view: PictureView,
    /// The line in `orders.jsonl` of the order that brought its scene, from 1; 0 for what the run began with.
    pub order: u32,
}

/// Of a picture that is older when it comes no time from picture to photons is had: it was not taken to be shown live,
/// or by another clock.
pub const LIVE_WITHIN: TimeNs = TimeNs(10_000_000_000);

impl PictureTag {
    /// How old it was when it came.
    pub fn age(&self) -> Option<TimeNs> {
        self.t_came.zip(self.t_taken).map(|(came, taken)| came - taken)
    }

    /// Whether it came soon after it was taken, as far as is known.
    pub fn is_live(&self) -> bool {
        self.age().is_none_or(|age| age <= LIVE_WITHIN)
    }
}

/// The two ends, with what is to be shown first.
pub fn newest_picture(pictures: &Pictures, t_start: TimeNs) -> (PictureSink, PictureSource) {
    let (first, scenes) = match pictures {
        Pictures::Scene(frames) => {
            (Shown::Scene { frames: Arc::clone(frames), t_start, order: 0 }, vec![Arc::clone(frames)])
        }
        Pictures::Feed(_) => (Shown::Live { frame: pictures.first_frame(), tag: PictureTag::default() }, Vec::new()),
    };
    let (input, output) = triple_buffer::triple_buffer(&first);
    let is_live = matches!(pictures, Pictures::Feed(_));
    let sink = PictureSink { input, size: pictures.resolution(), scenes, t_start, order: 0, is_live };
    (sink, PictureSource { output, t: t_start })
}

/// Where pictures are put in; for ordinary threads.
pub struct PictureSink {
    input: triple_buffer::Input<Shown>,
    size: Resolution,
    /// Scenes of which the other side may still hold a frame, the newest last: the last of it is dropped here.
    scenes: Vec<Arc<Frames>>,
    /// When the newest of them begins.
    t_start: TimeNs,
    /// The order that brought it.
    order: u32,
    is_live: bool,
}

impl PictureSink {
    /// Shows a scene from the next frame on, which begins at host time `t_start`, and no live picture any more. `order`
    /// brought it.
    ///
    /// # Panics
    /// Where it is of another size than what was shown before: a renderer is made for one.
    pub fn show_scene(&mut self, frames: Arc<Frames>, t_start: TimeNs, order: u32) {
        assert_eq!(frames.resolution(), self.size, "every picture has the hologram's size");
        (self.is_live, self.t_start, self.order) = (false, t_start, order);
        self.input.write(Shown::Scene { frames: Arc::clone(&frames), t_start, order });
        self.drop_old_scenes();
        self.scenes.push(frames);
    }

    /// Shows a live picture from the next frame on, where those are shown, and says whether they are. Whoever has it
    /// keeps its frame alive.
    ///
    /// # Panics
    /// As [`Self::show_scene`].
    pub fn show_live(&mut self, frame: Arc<RgbdFrame>, tag: PictureTag) -> bool {
        assert_eq!(frame.resolution, self.size, "every picture has the hologram's size");
        if self.is_live {
            self.input.write(Shown::Live { frame, tag });
            self.drop_old_scenes();
        }
        self.is_live
    }

    /// Gives back the memory of scenes that are over, from time to time: the way to the frame thread keeps some.
    pub fn tidy(&mut self) {
        if !self.is_live
            && self.input.consumed()
            && let [_, .., newest] = &self.scenes[..]
        {
            self.input.write(Shown::Scene { frames: Arc::clone(newest), t_start: self.t_start, order: self.order });
        }
        self.drop_old_scenes();
    }

    fn drop_old_scenes(&mut self) {
        let is_in_use = |scene: &Arc<Frames>| {
            Arc::strong_count(scene) > 1 || scene.frames.iter().any(|frame| Arc::strong_count(frame) > 1)
        };
        self.scenes.retain(is_in_use);
    }

    /// Whether live pictures are shown, and no scene.
    pub fn is_live(&self) -> bool {
        self.is_live
    }

    /// Shows live pictures again, from the next one on.
    pub fn go_live(&mut self) {
        self.is_live = true;
    }
}

/// Where the frame thread takes pictures out.
pub struct PictureSource {
    output: triple_buffer::Output<Shown>,
    /// The time for which a picture was taken out last.
    t: TimeNs,
}

impl PictureSource {
    /// The picture to be shown at host time `t`, and which it is: wait-free, no allocation.
    pub fn at(&mut self, t: TimeNs) -> (&Arc<RgbdFrame>, PictureTag) {
        self.output.update();
        self.t = t;
        self.same_again()
    }

    /// The picture that was taken out last.
    pub fn same_again(&self) -> (&Arc<RgbdFrame>, PictureTag) {
        match self.output.output_buffer() {
            Shown::Scene { frames, t_start, order } => {
                let index = frames.index_at((self.t - *t_start).seconds());
                (&frames.frames[index], PictureTag { number: index as u64, order: *order, ..PictureTag::default() })
            }
            Shown::Live { frame, tag } => (frame, *tag),
        }
    }
}

#[cfg(test)]
mod tests {
    use holod_model::scene::Fit;

    use super::*;

    const SIZE: Resolution = Resolution { width: 4, height: 2 };

    fn feed() -> Pictures {
        Pictures::Feed(Arc::new(FeedPlan::new("feed".into(), SIZE, Fit::Native)))
    }

    fn show(sink: &mut PictureSink, number: u64) {
        let tag = PictureTag { number, t_taken: Some(TimeNs(number as i64)), ..PictureTag::default() };
        sink.show_live(Arc::new(RgbdFrame::black(SIZE)), tag);
    }

    fn sequence(count: usize) -> Arc<Frames> {
        let frames = (0..count).map(|_| Arc::new(RgbdFrame::black(SIZE))).collect();
        Arc::new(Frames { frames, fps: Some(10.0), reports: Vec::new(), name: String::new() })
    }

    #[test]
    fn a_sequence_is_told_with_its_length() {
        let extent = |count| Pictures::Scene(sequence(count)).extent();
        assert_eq!((extent(3).as_str(), extent(1).as_str()), (", 3 frames at 10 a second,", ""));
        assert_eq!((feed().extent().as_str(), feed().figures()), ("", None));
    }

    #[test]
    fn the_newest_wins_and_stays() {
        let (mut sink, mut source) = newest_picture(&feed(), TimeNs(0));
        assert_eq!(source.at(TimeNs(0)).1, PictureTag::default());
        show(&mut sink, 2);
        show(&mut sink, 3);
        assert_eq!(source.same_again().1.number, 0, "a loop that is paused sees nothing new");
        assert_eq!([source.at(TimeNs(0)).1.number, source.at(TimeNs(9)).1.number], [3, 3]);
    }

    #[test]
    fn a_scene_begins_when_it_is_shown_goes_round_and_stands_still() {
        let (_sink, mut source) = newest_picture(&Pictures::Scene(sequence(3)), TimeNs(1_000_000_000));
        let numbers = [900, 1_000, 1_150, 1_299, 1_300].map(|ms| source.at(TimeNs(ms * 1_000_000)).1.number);
        assert_eq!(numbers, [0, 0, 1, 2, 0]);
        source.at(TimeNs(1_150_000_000));
        assert_eq!(source.same_again().1.number, 1);
    }

    #[test]
    fn a_scene_takes_the_place_of_live_pictures_until_they_are_wanted_again() {
        let (mut sink, mut source) = newest_picture(&feed(), TimeNs(0));
        show(&mut sink, 7);
        sink.show_scene(sequence(2), TimeNs(0), 5);
        show(&mut sink, 8);
        assert_eq!(source.at(TimeNs(0)).1, PictureTag { order: 5, ..PictureTag::default() });
        sink.go_live();
        assert_eq!(source.at(TimeNs(0)).1.t_taken, None, "until there is a picture");
        show(&mut sink, 9);
        assert_eq!(source.at(TimeNs(0)).1.number, 9);
    }

    #[test]
    fn a_scene_is_given_back_by_the_sink_and_never_by_the_frame_thread() {
        let (mut sink, mut source) = newest_picture(&Pictures::Scene(sequence(1)), TimeNs(0));
        let held = Arc::clone(source.at(TimeNs(0)).0);
        for _ in 0..100 {
            sink.show_scene(sequence(1), TimeNs(0), 1);
            source.at(TimeNs(0));
            assert!(Arc::strong_count(&held) > 1, "the renderer's is never the last");
        }
        assert!(sink.scenes.len() <= 5, "{}", sink.scenes.len());
        drop(held);
        for _ in 0..4 {
            sink.tidy();
            source.at(TimeNs(0));
        }
        assert_eq!(sink.scenes.len(), 1, "only the one that is shown");
        sink.go_live();
        for number in 0..4 {
            show(&mut sink, number);
            source.at(TimeNs(0));
        }
        assert!(sink.scenes.is_empty(), "live pictures need none");
    }

    #[test]
    #[should_panic(expected = "the hologram's size")]
    fn a_picture_of_another_size_is_no_picture() {
        let (mut sink, _source) = newest_picture(&feed(), TimeNs(0));
        let size = Resolution { width: 2, height: 2 };
        sink.show_live(Arc::new(RgbdFrame::black(size)), PictureTag::default());
    }
}

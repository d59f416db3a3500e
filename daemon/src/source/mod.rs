//! Pictures for the frame thread: a scene from files, or what a live feed has handed over last.
//!
//! The newest picture wins. Whoever has one puts it in with [`PictureSink::show`]; the frame thread takes it out with
//! [`PictureSource::at`], wait-free, and never gives memory back: that is left to the sink.

pub mod feed;
pub mod scene;

use std::sync::Arc;

use holod_calibration::{DisplayGeometry, Resolution, TimeNs};
use holod_model::RgbdFrame;

use crate::cli::SceneArgs;
use crate::failure::{Exit, Failure};

use self::feed::{Feed, FeedError, FeedPlan};
use self::scene::Frames;

/// What a run is to show.
#[derive(Clone)]
pub enum Pictures {
    /// A scene from files, or the built-in one.
    Scene(Arc<Frames>),
    /// What clients of a live feed hand over.
    Feed(FeedPlan),
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

    /// What is shown first: of a feed, until a client has handed something over, black.
    pub fn first_frame(&self) -> Arc<RgbdFrame> {
        match self {
            Self::Scene(frames) => Arc::clone(&frames.frames[0]),
            Self::Feed(plan) => Arc::new(RgbdFrame::black(plan.resolution)),
        }
    }
}

/// The socket that `--scene feed` or `--scene feed:PATH` means; of the former, none.
fn feed_socket(spec: &str) -> Option<Option<&str>> {
    if spec == "feed" { Some(None) } else { spec.strip_prefix("feed:").map(Some) }
}

/// The scene or the feed that was named.
///
/// # Errors
/// The scene cannot be read, or what was named does not fit on the panel.
pub fn named(args: &SceneArgs, geometry: &DisplayGeometry) -> Result<Pictures, Failure> {
    let Some(socket) = args.scene.as_deref().and_then(feed_socket) else {
        return scene::frames(args, geometry).map(|frames| Pictures::Scene(Arc::new(frames)));
    };
    if args.depth_encoding.is_some() {
        let own = "--depth-encoding is for files: a feed's clients say what their depths are";
        return Err(Failure::new(Exit::Usage, own));
    }
    let resolution = args.resolution.unwrap_or(geometry.resolution);
    scene::check_fits(resolution, geometry, "--resolution")?;
    let socket = match socket {
        Some(path) => path.into(),
        None => feed::default_socket().map_err(Failure::because(Exit::Unavailable))?,
    };
    Ok(Pictures::Feed(FeedPlan { socket, resolution, fit: scene::fit(args.fit) }))
}

/// The frame thread's end of `pictures`, which begin at host time `t_start`, and the feed where there is one.
///
/// # Errors
/// The feed cannot listen.
pub fn open(
    pictures: &Pictures,
    geometry: &DisplayGeometry,
    t_start: TimeNs,
) -> Result<(PictureSource, Option<Feed>), FeedError> {
    match pictures {
        Pictures::Scene(frames) => {
            let (_, source) = newest_picture(Shown::Scene { frames: Arc::clone(frames), t_start });
            Ok((source, None))
        }
        Pictures::Feed(plan) => {
            let black = Shown::Live { frame: pictures.first_frame(), tag: PictureTag::default() };
            let (sink, source) = newest_picture(black);
            Ok((source, Some(Feed::listen(plan.clone(), geometry, sink)?)))
        }
    }
}

/// Something to show until there is something newer.
#[derive(Clone)]
pub enum Shown {
    /// A scene, from the time at which it begins.
    Scene {
        /// Its frames.
        frames: Arc<Frames>,
        /// When the first one is shown.
        t_start: TimeNs,
    },
    /// One picture of a live feed.
    Live {
        /// It.
        frame: Arc<RgbdFrame>,
        /// Which it is.
        tag: PictureTag,
    },
}

/// Which picture a hologram was made of.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PictureTag {
    /// Its number in a scene, from 0, or the sequence that a feed's client gave it.
    pub number: u64,
    /// When a feed's client took it, or else when it came.
    pub t_taken: Option<TimeNs>,
}

impl Shown {
    fn frame(&self) -> &Arc<RgbdFrame> {
        match self {
            Self::Scene { frames, .. } => &frames.frames[0],
            Self::Live { frame, .. } => frame,
        }
    }
}

/// The two ends, with what is to be shown first.
pub fn newest_picture(first: Shown) -> (PictureSink, PictureSource) {
    let (input, output) = triple_buffer::triple_buffer(&first);
    let mut sink = PictureSink { input, size: first.frame().resolution, scenes: Vec::new() };
    sink.remember(first);
    (sink, PictureSource { output })
}

/// Where pictures are put in; for ordinary threads.
pub struct PictureSink {
    input: triple_buffer::Input<Shown>,
    size: Resolution,
    /// Scenes of which the other side may still hold a frame: the last of it is dropped here.
    scenes: Vec<Arc<Frames>>,
}

impl PictureSink {
    /// Shows `newer` from the next frame on. Whoever shows a live picture keeps its frame alive.
    ///
    /// # Panics
    /// Where it is of another size than what was shown before: a renderer is made for one.
    pub fn show(&mut self, newer: Shown) {
        assert_eq!(newer.frame().resolution, self.size, "every picture has the hologram's size");
        self.input.write(newer.clone());
        self.remember(newer);
    }

    fn remember(&mut self, newer: Shown) {
        let is_in_use = |scene: &Arc<Frames>| {
            Arc::strong_count(scene) > 1 || scene.frames.iter().any(|frame| Arc::strong_count(frame) > 1)
        };
        self.scenes.retain(is_in_use);
        if let Shown::Scene { frames, .. } = newer {
            self.scenes.push(frames);
        }
    }
}

/// Where the frame thread takes pictures out.
pub struct PictureSource {
    output: triple_buffer::Output<Shown>,
}

impl PictureSource {
    /// The picture to be shown at host time `t`, and which it is: wait-free, no allocation.
    pub fn at(&mut self, t: TimeNs) -> (&Arc<RgbdFrame>, PictureTag) {
        match self.output.read() {
            Shown::Scene { frames, t_start } => {
                let index = frames.index_at((t - *t_start).seconds());
                (&frames.frames[index], PictureTag { number: index as u64, t_taken: None })
            }
            Shown::Live { frame, tag } => (frame, *tag),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: Resolution = Resolution { width: 4, height: 2 };

    fn live(number: u64) -> Shown {
        let tag = PictureTag { number, t_taken: Some(TimeNs(number as i64)) };
        Shown::Live { frame: Arc::new(RgbdFrame::black(SIZE)), tag }
    }

    fn sequence(count: usize) -> Shown {
        let frames = (0..count).map(|_| Arc::new(RgbdFrame::black(SIZE))).collect();
        let frames = Frames { frames, fps: Some(10.0), reports: Vec::new(), name: String::new() };
        Shown::Scene { frames: Arc::new(frames), t_start: TimeNs(1_000_000_000) }
    }

    #[test]
    fn the_newest_wins_and_stays() {
        let (mut sink, mut source) = newest_picture(live(1));
        assert_eq!(source.at(TimeNs(0)).1.number, 1);
        sink.show(live(2));
        sink.show(live(3));
        assert_eq!([source.at(TimeNs(0)).1.number, source.at(TimeNs(9)).1.number], [3, 3]);
    }

    #[test]
    fn a_scene_begins_when_it_is_shown_and_goes_round() {
        let (_sink, mut source) = newest_picture(sequence(3));
        let numbers = [900, 1_000, 1_150, 1_299, 1_300].map(|ms| source.at(TimeNs(ms * 1_000_000)).1.number);
        assert_eq!(numbers, [0, 0, 1, 2, 0]);
    }

    #[test]
    fn a_scene_is_given_back_by_the_sink_and_never_by_the_frame_thread() {
        let (mut sink, mut source) = newest_picture(sequence(1));
        let held = Arc::clone(source.at(TimeNs(0)).0);
        for _ in 0..100 {
            sink.show(sequence(1));
            source.at(TimeNs(0));
            assert!(Arc::strong_count(&held) > 1, "the renderer's is never the last");
        }
        assert!(sink.scenes.len() <= 5, "{}", sink.scenes.len());
        drop(held);
        sink.show(sequence(1));
        assert!(sink.scenes.len() <= 4, "{}", sink.scenes.len());
    }

    #[test]
    #[should_panic(expected = "the hologram's size")]
    fn a_picture_of_another_size_is_no_picture() {
        let (mut sink, _source) = newest_picture(live(0));
        let size = Resolution { width: 2, height: 2 };
        sink.show(Shown::Live { frame: Arc::new(RgbdFrame::black(size)), tag: PictureTag::default() });
    }
}

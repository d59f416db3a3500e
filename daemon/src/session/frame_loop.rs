//! The frame thread: wake, ask for the pupil, render the panel's levels, submit them.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use holod_calibration::{PerColour, PupilDiameter, TimeNs};
use holod_model::engine::EngineError;
use holod_slm_output::{FramePlan, FramePort, LevelsFrame, Pacer};

use super::clock::host_now;
use super::inputs::{FrameContent, Inputs, TrainedPupils};
use super::recorded_levels::keep_slot;
use crate::frame_record::{FrameOrders, FrameRecord, levels_xxh3};
use crate::renderer::{Rendered, Renderer};
use crate::source::PictureTag;

/// An order to stop is seen within this time.
const LONGEST_SLEEP: Duration = Duration::from_millis(20);

/// How often the panel is asked whether it has shown a frame, and after which time it is not waited for any more.
const PANEL_POLL: Duration = Duration::from_micros(500);
const LONGEST_WAIT: TimeNs = TimeNs(1_000_000_000);

/// Everything that a frame needs, allocated before the first one.
pub(super) struct FrameLoop {
    /// Where pupils and pictures come from.
    pub inputs: Inputs,
    /// Frame and pupil to levels.
    pub renderer: Box<dyn Renderer>,
    /// Levels to the panel.
    pub port: FramePort,
    /// Which refresh each frame is for.
    pub pacer: Pacer,
    /// The light of each colour: of those without any it matters to nobody what was lost.
    pub light: PerColour<f32>,
    /// The pupils that the network knows.
    pub trained: TrainedPupils,
    /// Levels that take the place of what would be computed.
    pub pattern: Option<Box<LevelsFrame>>,
    /// The orders that brought engine and pattern.
    pub orders: FrameOrders,
    /// What takes another's place, with the order that brings it.
    pub changes: rtrb::Consumer<(u32, Change)>,
    /// Whose place was taken: giving back what it has is nothing for this thread.
    pub retired: rtrb::Producer<Change>,
    pub records: rtrb::Producer<LoopRecord>,
    /// Records that found no room.
    pub records_lost: Arc<AtomicU64>,
    /// Whether presented levels are kept by pupil.
    pub keep_levels: bool,
    /// Whether all levels are told by their hash.
    pub hash_levels: bool,
    /// The newest frame that the panel was handed, and the newest that it has shown.
    pub submitted: u64,
    pub shown: u64,
    /// What was made last.
    pub made: Option<Made>,
    /// Engines that took another's place because that failed.
    pub engines_failed: u32,
    /// Frames to make; without end where absent.
    pub limit: Option<u64>,
    /// How holograms are computed, for the status.
    pub engine: Arc<Mutex<String>>,
    /// Set by the control thread.
    pub stop: Arc<AtomicBool>,
}

/// What levels are made of. Where all of it is the same, they are.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Content {
    /// The orders and the failures stand for the engine.
    Hologram { picture: PictureTag, pupil: PupilDiameter, weights_order: u32, engines_failed: u32 },
    /// The order stands for it.
    Pattern(u32),
}

/// Levels that were made.
#[derive(Clone, Copy, Debug)]
pub(super) struct Made {
    content: Content,
    /// What the buffers call them that have them.
    number: u64,
    rendered: Rendered,
    levels_xxh3: Option<u64>,
}

/// The buffer that is submitted next, and what is in it.
struct Filled {
    is_hologram: bool,
    /// The picture in hand, also where a pattern is in its place.
    picture: PictureTag,
    content: Content,
    rendered: Rendered,
    /// What was made last, where it has the same content.
    again: Option<Made>,
    /// The same where the buffer held it already.
    there: Option<Made>,
}

/// What takes another's place in the loop, and what has made way for it.
pub(super) enum Change {
    /// An engine, with the pupils that it knows.
    Engine(Box<dyn Renderer>, TrainedPupils),
    /// A pattern in place of holograms, or holograms again.
    Pattern(Option<Box<LevelsFrame>>),
}

/// Frame records on their way to the control thread.
pub(super) const RECORDS: usize = 1024;

/// What the loop says of one frame.
#[derive(Clone, Copy, Debug)]
pub(super) struct LoopRecord {
    pub frame: FrameRecord,
    /// When the feed's picture was taken over that the loop had in hand, also where a pattern took its place.
    pub t_picture_in_hand: Option<TimeNs>,
    /// Whether the pupil is one that the network was not trained for.
    pub beyond_trained: bool,
    /// Share of amplitudes above the double phase's constant.
    pub clipped_share: f32,
    /// Share of phases that the panel cannot reach.
    pub unreachable_share: f32,
}

impl FrameLoop {
    /// Makes frames until told to stop or the limit is reached.
    ///
    /// # Errors
    /// The engine failed and nothing could take its place.
    pub(super) fn run(mut self) -> Result<(), EngineError> {
        let mut made = 0;
        while !self.stop.load(Ordering::Acquire) && self.limit.is_none_or(|limit| made < limit) {
            if let Inputs::Recorded(playback) = &self.inputs {
                self.pacer.number_next(playback.frame());
            }
            let plan = self.pacer.predict(host_now());
            if !self.sleep_until(plan.t_wake) {
                break;
            }
            if let Err(failed) = self.frame(plan) {
                // An engine that fails is not replaced any more where the run ends: that is no failure of the run.
                return if self.stop.load(Ordering::Acquire) { Ok(()) } else { Err(failed) };
            }
            made += 1;
            if let Inputs::Recorded(playback) = &mut self.inputs {
                playback.advance();
            }
        }
        Ok(())
    }

    /// One frame, top to bottom.
    fn frame(&mut self, plan: FramePlan) -> Result<(), EngineError> {
        // A change that comes after this may be left to the next frame, none that came before.
        let t_wake = host_now();
        self.make_changes();
        let mut pupil = self.inputs.pupil(t_wake, plan.t_predicted_photon);

        let t_render_begin = host_now();
        let filled = self.fill(plan.t_predicted_photon, pupil.pupil)?;
        let t_render_end = host_now();

        let made = self.number(&filled);
        self.made = Some(made);
        if !filled.is_hologram {
            // A pattern rests on no sample.
            (pupil.t_sample, pupil.raw_mm, pupil.estimate) = (None, None, None);
        }
        let is_kept = self.keep_levels && filled.is_hologram && pupil.is_meant();
        let keep = if is_kept { keep_slot(pupil.pupil) } else { None };
        if matches!(self.inputs, Inputs::Recorded(_)) {
            self.wait_for_the_panel();
        }
        let t_submit = host_now();
        let frame = FrameRecord {
            frame: plan.frame_id,
            t_sample: pupil.t_sample,
            pupil_raw_mm: pupil.raw_mm,
            pupil: pupil.pupil,
            pupil_estimate: pupil.estimate,
            pupil_state: pupil.state,
            t_wake,
            t_render_begin,
            t_render_end,
            t_submit,
            t_desired_present: plan.t_desired_present,
            picture: if filled.is_hologram { filled.picture } else { PictureTag::default() },
            keep,
            amplitude_constant: self.renderer.amplitude_constant(),
            orders: self.orders,
            levels_xxh3: made.levels_xxh3,
            is_computed: filled.there.is_none(),
        };
        self.report(frame, &filled);
        self.port.submit(&plan, keep, t_submit);
        match filled.there {
            None => self.pacer.submitted(plan.frame_id, t_submit),
            Some(_) => self.pacer.submitted_at_once(plan.frame_id, t_submit),
        }
        self.submitted = plan.frame_id;
        self.hear_the_panel();
        Ok(())
    }

    /// Fills the next buffer with the levels of what is to be seen at host time `t_photon`, for an eye with `pupil`;
    /// what is in it already is not made again.
    fn fill(&mut self, t_photon: TimeNs, pupil: PupilDiameter) -> Result<Filled, EngineError> {
        let FrameContent { picture, tag, pattern } = self.inputs.content(t_photon);
        let pattern = pattern.or(self.pattern.as_deref());
        let is_hologram = pattern.is_none();
        self.orders.scene = tag.order;
        let FrameOrders { weights: weights_order, pattern: pattern_order, .. } = self.orders;
        let content = |engines_failed| match is_hologram {
            true => Content::Hologram { picture: tag, pupil, weights_order, engines_failed },
            false => Content::Pattern(pattern_order),
        };
        let again = self.made.filter(|made| made.content == content(self.engines_failed));
        let buffer = self.port.acquire();
        // Each of the buffers that go round has to be filled once.
        let there = again.filter(|made| buffer.content() == Some(made.number));
        let rendered = match (there, pattern) {
            (Some(made), _) => made.rendered,
            (None, None) => self.renderer.render(picture, pupil, buffer)?,
            (None, Some(pattern)) => {
                buffer.copy_from(pattern);
                Rendered::default()
            }
        };
        let engine_changed = there.is_none() && rendered.engine_changed;
        if engine_changed {
            self.engines_failed += 1;
            // It happens when a device is lost, which took longer than any lock.
            self.renderer.description().clone_into(&mut self.engine.lock().unwrap_or_else(PoisonError::into_inner));
        }
        let again = again.filter(|_| !engine_changed);
        Ok(Filled { is_hologram, picture: tag, content: content(self.engines_failed), rendered, again, there })
    }

    /// What the buffer holds, which is given its number where it was filled.
    fn number(&mut self, filled: &Filled) -> Made {
        if let Some(there) = filled.there {
            return there;
        }
        let next = self.made.map_or(1, |made| made.number + 1);
        let number = filled.again.map_or(next, |made| made.number);
        let buffer = self.port.acquire();
        buffer.call_content(number);
        let levels_xxh3 = self.hash_levels.then(|| levels_xxh3(buffer));
        Made { content: filled.content, number, rendered: filled.rendered, levels_xxh3 }
    }

    /// Hands what is to be said of a frame to the control thread.
    fn report(&mut self, frame: FrameRecord, filled: &Filled) {
        let record = LoopRecord {
            frame,
            t_picture_in_hand: filled.picture.t_came,
            beyond_trained: !self.trained.contain(frame.pupil),
            clipped_share: filled.rendered.clipped_where_lit(self.light),
            unreachable_share: filled.rendered.unreachable_where_lit(self.light),
        };
        // A full ring means that nobody records; the frame is shown all the same.
        if self.records.push(record).is_err() {
            self.records_lost.fetch_add(1, Ordering::Relaxed);
        }
    }

    fn hear_the_panel(&mut self) {
        let shown = &mut self.shown;
        self.port.feed(&mut self.pacer, |report| *shown = (*shown).max(report.frame_id));
    }

    /// Lets the panel show the last frame before another one takes its place: of a record all are to be seen.
    fn wait_for_the_panel(&mut self) {
        let t_give_up = host_now() + LONGEST_WAIT;
        while self.shown < self.submitted && host_now() < t_give_up && !self.stop.load(Ordering::Acquire) {
            std::thread::sleep(PANEL_POLL);
            self.hear_the_panel();
        }
    }

    fn make_changes(&mut self) {
        if let Inputs::Recorded(playback) = &mut self.inputs {
            playback.change_engine(&mut self.renderer, &mut self.trained);
            self.orders = playback.orders();
        }
        while let Ok((order, change)) = self.changes.pop() {
            let retired = match change {
                Change::Engine(renderer, trained) => {
                    self.orders.weights = order;
                    Change::Engine(
                        std::mem::replace(&mut self.renderer, renderer),
                        std::mem::replace(&mut self.trained, trained),
                    )
                }
                Change::Pattern(pattern) => {
                    self.orders.pattern = order;
                    Change::Pattern(std::mem::replace(&mut self.pattern, pattern))
                }
            };
            assert!(self.retired.push(retired).is_ok(), "there is room for as many as are sent");
        }
    }

    /// Sleeps in short steps, so that an order to stop is seen; false where it came.
    fn sleep_until(&self, t: TimeNs) -> bool {
        loop {
            if self.stop.load(Ordering::Acquire) {
                return false;
            }
            let left_ns = (t - host_now()).0;
            if left_ns <= 0 {
                return true;
            }
            std::thread::sleep(Duration::from_nanos(left_ns as u64).min(LONGEST_SLEEP));
        }
    }
}

//! Where the pupil and the picture of each frame come from: followed as they come, or as a record has them.

use std::sync::Arc;

use holod_calibration::{PupilDiameter, TimeNs};
use holod_model::RgbdFrame;
use holod_pupil_input::{EstimateReader, PupilState};
use holod_slm_output::LevelsFrame;

use super::held_pupil::HeldPupil;
use crate::control::{NewEngine, Steering};
use crate::frame_record::FrameOrders;
use crate::frame_state::FrameState;
use crate::renderer::Renderer;
use crate::source::{PictureSource, PictureTag};

/// A pupil is not predicted farther ahead than this; slower frames use the prediction for this time.
const FARTHEST_PREDICTION: TimeNs = TimeNs(200_000_000);

/// Where pupils and pictures come from.
pub(super) enum Inputs {
    /// The tracker, and whatever is to be shown.
    Followed(Followed),
    /// The frames of a record, made again.
    Recorded(Playback),
}

/// What frames are made of: the pupil and the pictures, as a person steers them.
pub(super) struct Followed {
    /// The tracker's newest estimate.
    pub(super) pupil: EstimateReader,
    /// The pupil that the last hologram was made for.
    pub(super) held: HeldPupil,
    pub(super) pictures: PictureSource,
    /// What a person changes.
    pub(super) steering: Arc<Steering>,
}

/// The pupil that a frame is made for.
pub(super) struct FramePupil {
    pub(super) pupil: PupilDiameter,
    /// What the tracker's samples make it, where they are followed.
    pub(super) estimate: Option<PupilDiameter>,
    pub(super) t_sample: Option<TimeNs>,
    pub(super) raw_mm: Option<f32>,
    pub(super) state: FrameState,
}

impl FramePupil {
    /// Whether it is anything but the fallback.
    pub(super) fn is_meant(&self) -> bool {
        !self.state.is_fallback()
    }
}

/// What a frame shows.
pub(super) struct FrameContent<'a> {
    pub(super) picture: &'a Arc<RgbdFrame>,
    pub(super) tag: PictureTag,
    /// In place of a hologram of the picture.
    pub(super) pattern: Option<&'a LevelsFrame>,
}

impl Inputs {
    /// The pupil of a frame that is begun at host time `t_wake` and whose light arrives at `t_photon`.
    pub(super) fn pupil(&mut self, t_wake: TimeNs, t_photon: TimeNs) -> FramePupil {
        match self {
            Self::Followed(followed) => {
                let state = followed.pupil.pupil_at(t_wake).state;
                let estimate = followed.pupil.pupil_at(t_photon.min(t_wake + FARTHEST_PREDICTION));
                if let Some(fixed) = followed.steering.fixed_pupil() {
                    let pupil = followed.held.take(fixed);
                    return FramePupil {
                        pupil,
                        estimate: None,
                        t_sample: None,
                        raw_mm: None,
                        state: FrameState::Fixed,
                    };
                }
                // No noise is in the fallback, and what it ends at is the rig's.
                let pupil = match state {
                    PupilState::Fallback => followed.held.take(estimate.pupil),
                    _ => followed.held.follow(estimate.pupil, followed.steering.pupil_step_mm()),
                };
                FramePupil {
                    pupil,
                    estimate: Some(estimate.pupil),
                    t_sample: estimate.t_sample,
                    raw_mm: estimate.raw_mm,
                    state: FrameState::Estimated(state),
                }
            }
            Self::Recorded(playback) => {
                let cue = playback.cue();
                FramePupil { pupil: cue.pupil, estimate: None, t_sample: None, raw_mm: None, state: cue.pupil_state }
            }
        }
    }

    /// What a frame shows whose light arrives at host time `t_photon`.
    pub(super) fn content(&mut self, t_photon: TimeNs) -> FrameContent<'_> {
        match self {
            Self::Followed(followed) => {
                let (picture, tag) = if followed.steering.is_paused() {
                    followed.pictures.same_again()
                } else {
                    followed.pictures.at(t_photon)
                };
                FrameContent { picture, tag, pattern: None }
            }
            Self::Recorded(playback) => playback.content(),
        }
    }
}

/// A frame to be made again.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Cue {
    /// Its number in the record.
    pub(crate) frame: u64,
    /// The pupil that it was made for.
    pub(crate) pupil: PupilDiameter,
    pub(crate) pupil_state: FrameState,
    /// The place of its picture in [`Playback::pictures`].
    pub(crate) picture: usize,
    /// The picture's number in its scene.
    pub(crate) number: u64,
    /// The place of its engine: 0 is the run's first one, others follow in [`Playback::engines`].
    pub(crate) engine: usize,
    /// The place of the pattern in [`Playback::patterns`] that it shows in place of a hologram.
    pub(crate) pattern: Option<usize>,
    /// The orders that brought all this.
    pub(crate) orders: FrameOrders,
}

/// The frames of a record, to be made again, with all that they are made of.
pub(crate) struct Playback {
    /// At least one, by rising number.
    pub(crate) cues: Vec<Cue>,
    /// The pictures that they show.
    pub(crate) pictures: Vec<Arc<RgbdFrame>>,
    /// Engines beside the first.
    pub(crate) engines: Vec<NewEngine>,
    /// The patterns that they show.
    pub(crate) patterns: Vec<LevelsFrame>,
    /// The cue that is due.
    pub(crate) at: usize,
    /// The engine that is at work.
    pub(crate) engine: usize,
}

impl Playback {
    /// How many frames there are.
    pub(crate) fn frames(&self) -> u64 {
        self.cues.len() as u64
    }

    fn cue(&self) -> &Cue {
        &self.cues[self.at]
    }

    /// The number of the frame that is due.
    pub(super) fn frame(&self) -> u64 {
        self.cue().frame
    }

    /// The orders that brought what it shows.
    pub(super) fn orders(&self) -> FrameOrders {
        self.cue().orders
    }

    /// Brings its engine to work; the one that worked takes its place here.
    pub(super) fn change_engine(&mut self, renderer: &mut Box<dyn Renderer>, trained: &mut TrainedPupils) {
        let wanted = self.cue().engine;
        if wanted == self.engine {
            return;
        }
        // Where the first one works, the others are in their places. Where another works, the first has its place.
        for place in [self.engine, wanted].into_iter().filter(|place| *place > 0) {
            let other = &mut self.engines[place - 1];
            std::mem::swap(renderer, &mut other.renderer);
            let theirs = std::mem::replace(&mut other.trained, trained.ends());
            *trained = TrainedPupils::of(theirs);
        }
        self.engine = wanted;
    }

    fn content(&self) -> FrameContent<'_> {
        let cue = self.cue();
        FrameContent {
            picture: &self.pictures[cue.picture],
            tag: PictureTag { number: cue.number, order: cue.orders.scene, ..PictureTag::default() },
            pattern: cue.pattern.map(|pattern| &self.patterns[pattern]),
        }
    }

    /// Goes on to the next one, where there is one.
    pub(super) fn advance(&mut self) {
        self.at = (self.at + 1).min(self.cues.len() - 1);
    }
}

/// The pupils that a network was trained for, on one bench.
#[derive(Clone, Copy, Debug)]
pub(super) struct TrainedPupils {
    narrowest: PupilDiameter,
    widest: PupilDiameter,
}

impl TrainedPupils {
    pub(super) fn of([narrowest, widest]: [PupilDiameter; 2]) -> Self {
        Self { narrowest, widest }
    }

    pub(super) fn ends(self) -> [PupilDiameter; 2] {
        [self.narrowest, self.widest]
    }

    pub(super) fn contain(self, pupil: PupilDiameter) -> bool {
        (self.narrowest..=self.widest).contains(&pupil)
    }
}

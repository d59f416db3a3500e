//! What the frame loop says of each frame: for records, the page and the numbers of a run.

use holod_calibration::{PupilDiameter, TimeNs};
use holod_slm_output::LevelsFrame;
use twox_hash::XxHash3_64;

use crate::frame_state::FrameState;
use crate::source::PictureTag;

/// What the frame loop did for one frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FrameRecord {
    /// Number of the frame.
    pub frame: u64,
    /// Host time of the newest tracker sample that the estimate rests on, a believed one, where there is one.
    pub t_sample: Option<TimeNs>,
    /// That sample's diameter as measured, scaled to millimetres.
    pub pupil_raw_mm: Option<f32>,
    /// The pupil that the hologram was computed for.
    pub pupil: PupilDiameter,
    /// The tracker's estimate for the time at which the frame's light arrives, where that is followed.
    pub pupil_estimate: Option<PupilDiameter>,
    /// What `pupil` rests on.
    pub pupil_state: FrameState,
    /// The loop woke for this frame.
    pub t_wake: TimeNs,
    pub t_render_begin: TimeNs,
    /// The levels were ready.
    pub t_render_end: TimeNs,
    /// The levels were handed to the presenter.
    pub t_submit: TimeNs,
    /// When it was to come on the panel.
    pub t_desired_present: TimeNs,
    /// The picture that was shown.
    pub picture: PictureTag,
    /// The memory slot for its levels, where they are kept.
    pub keep: Option<usize>,
    /// The amplitude that double phase took as 1.
    pub amplitude_constant: f32,
    /// The orders that brought what it shows.
    pub orders: FrameOrders,
    /// [`levels_xxh3`] of its levels, where that is wanted.
    pub levels_xxh3: Option<u64>,
    /// They were made for it: the buffer did not have them already.
    pub is_computed: bool,
}

#[cfg(test)]
impl FrameRecord {
    /// A frame for `pupil` of which nothing else is known, made at time 0.
    pub(crate) fn of_pupil(frame: u64, pupil: PupilDiameter) -> Self {
        let t = TimeNs(0);
        Self {
            frame,
            t_sample: None,
            pupil_raw_mm: None,
            pupil,
            pupil_estimate: Some(pupil),
            pupil_state: FrameState::Estimated(holod_pupil_input::PupilState::Tracking),
            t_wake: t,
            t_render_begin: t,
            t_render_end: t,
            t_submit: t,
            t_desired_present: t,
            picture: PictureTag::default(),
            keep: None,
            amplitude_constant: 1.0,
            orders: FrameOrders::default(),
            levels_xxh3: None,
            is_computed: true,
        }
    }
}

/// The orders that brought what a frame shows: their lines in `orders.jsonl`, from 1; 0 for what the run began with.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameOrders {
    pub scene: u32,
    pub weights: u32,
    /// The pattern, or holograms again.
    pub pattern: u32,
}

/// XXH3 of 64 bits of a frame's levels: of its samples as [`LevelsFrame`] has them, each as two bytes, the low one first.
pub(crate) fn levels_xxh3(levels: &LevelsFrame) -> u64 {
    XxHash3_64::oneshot(bytemuck::cast_slice(levels.samples()))
}

//! How a run is, as the service manager, the log and the page show it.

use holod_pupil_input::{Link, PupilState};

use crate::frame_state::FrameState;

/// The daemon's state, as `systemctl status` shows it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum State {
    /// Lasers are not lit over frames.
    #[default]
    Dark,
    /// They are, for pupils that follow the eye or are set by a person, and the record is written.
    Running,
    /// They are, with the fallback for a pupil, or with a record that is lost.
    Degraded,
}

impl State {
    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::Dark => "dark",
            Self::Running => "running",
            Self::Degraded => "degraded",
        }
    }
}

/// What the state of a run follows from.
#[derive(Clone, Copy, Debug)]
pub(super) struct Condition {
    /// Lasers are armed, over frames that have come on the panel.
    pub(super) is_lit: bool,
    /// Frames of a record are made again: no tracker is followed.
    pub(super) plays: bool,
    pub(super) link: Link,
    /// Of the newest frame, where there is one.
    pub(super) pupil: Option<FrameState>,
    pub(super) record_lost: bool,
}

impl Condition {
    pub(super) fn state(self) -> State {
        let follows = match self.pupil {
            Some(FrameState::Fixed) => true,
            Some(FrameState::Estimated(PupilState::Fallback)) => self.plays,
            Some(FrameState::Estimated(_) | FrameState::Recorded) | None => self.plays || self.link == Link::Up,
        };
        match (self.is_lit, follows && !self.record_lost) {
            (false, _) => State::Dark,
            (true, false) => State::Degraded,
            (true, true) => State::Running,
        }
    }

    /// In words. A blink is no news; what the pupil falls back to is.
    pub(super) fn text(self) -> String {
        let pupil = match self.pupil {
            None => "not known yet",
            Some(state @ (FrameState::Fixed | FrameState::Estimated(PupilState::Fallback))) => state.name(),
            Some(_) => "followed",
        };
        let record = if self.record_lost { ", record lost" } else { "" };
        format!("{}: tracker {}, pupil {pupil}{record}", self.state().name(), self.link.name())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Lit frames that follow a tracker.
    const RUNNING: Condition = Condition {
        is_lit: true,
        plays: false,
        link: Link::Up,
        pupil: Some(FrameState::Estimated(PupilState::Tracking)),
        record_lost: false,
    };
    const FALLBACK: Option<FrameState> = Some(FrameState::Estimated(PupilState::Fallback));

    #[test]
    fn a_run_is_degraded_where_nothing_is_followed_or_its_record_is_lost_and_dark_without_light() {
        for (condition, state, text) in [
            (RUNNING, State::Running, "running: tracker up, pupil followed"),
            (Condition { pupil: FALLBACK, ..RUNNING }, State::Degraded, "degraded: tracker up, pupil fallback"),
            (Condition { link: Link::Silent, ..RUNNING }, State::Degraded, "degraded: tracker silent, pupil followed"),
            (
                Condition { link: Link::Down, pupil: FALLBACK, ..RUNNING },
                State::Degraded,
                "degraded: tracker down, pupil fallback",
            ),
            (
                Condition { record_lost: true, ..RUNNING },
                State::Degraded,
                "degraded: tracker up, pupil followed, record lost",
            ),
            (Condition { is_lit: false, ..RUNNING }, State::Dark, "dark: tracker up, pupil followed"),
            (
                Condition { is_lit: false, record_lost: true, ..RUNNING },
                State::Dark,
                "dark: tracker up, pupil followed, record lost",
            ),
            (Condition { is_lit: false, pupil: None, ..RUNNING }, State::Dark, "dark: tracker up, pupil not known yet"),
        ] {
            assert_eq!((condition.state(), condition.text().as_str()), (state, text), "{condition:?}");
        }
    }

    #[test]
    fn a_blink_leaves_a_run_as_it_is() {
        for state in [PupilState::Acquiring, PupilState::Holding] {
            let blink = Condition { pupil: Some(FrameState::Estimated(state)), ..RUNNING };
            assert_eq!((blink.state(), blink.text()), (RUNNING.state(), RUNNING.text()), "{state:?}");
        }
    }

    #[test]
    fn a_fixed_pupil_and_a_record_that_is_played_need_no_tracker() {
        for link in [Link::Up, Link::Silent, Link::Down, Link::Finished] {
            let fixed = Condition { link, pupil: Some(FrameState::Fixed), ..RUNNING };
            assert_eq!(fixed.state(), State::Running, "{link:?}");
            assert!(fixed.text().ends_with("pupil fixed"), "{}", fixed.text());
            for pupil in FrameState::OF_A_RUN.into_iter().chain([FrameState::Recorded]) {
                let played = Condition { link, plays: true, pupil: Some(pupil), ..RUNNING };
                assert_eq!(played.state(), State::Running, "{link:?} {pupil:?}");
            }
        }
        let fixed = Condition { pupil: Some(FrameState::Fixed), record_lost: true, ..RUNNING };
        assert_eq!(fixed.state(), State::Degraded);
    }
}

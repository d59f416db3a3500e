//! What the pupil of a frame rests on, in the frame loop and in records.

use holod_pupil_input::PupilState;

/// What the pupil of a frame rests on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum FrameState {
    /// The tracker's estimate, as it stood when the frame was begun.
    Estimated(PupilState),
    /// A diameter that a person has set in place of the tracker's.
    Fixed,
    /// A frame of a record that has a state of which this holod does not know.
    Recorded,
}

impl FrameState {
    /// Those that frames of a tracker and of a fixed pupil have.
    pub(crate) const OF_A_RUN: [Self; 5] = {
        let [acquiring, tracking, holding, fallback] = PupilState::ALL;
        [
            Self::Estimated(acquiring),
            Self::Estimated(tracking),
            Self::Estimated(holding),
            Self::Estimated(fallback),
            Self::Fixed,
        ]
    };

    /// The name used in records, in the status and on the page.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Estimated(state) => state.name(),
            Self::Fixed => "fixed",
            Self::Recorded => "recorded",
        }
    }

    /// What a record calls by that name.
    pub(crate) fn named(name: &str) -> Self {
        Self::OF_A_RUN.into_iter().find(|state| state.name() == name).unwrap_or(Self::Recorded)
    }

    /// Whether the pupil is the rig's fallback, or on its way there.
    pub(crate) const fn is_fallback(self) -> bool {
        matches!(self, Self::Estimated(PupilState::Fallback))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_state_is_found_by_its_name_and_one_of_another_holod_is_recorded() {
        for state in FrameState::OF_A_RUN {
            assert_eq!(FrameState::named(state.name()), state);
        }
        let names = FrameState::OF_A_RUN.map(FrameState::name);
        assert_eq!(names, ["acquiring", "tracking", "holding", "fallback", "fixed"]);
        assert_eq!(FrameState::named("guessing"), FrameState::Recorded);
        assert_eq!(FrameState::Recorded.name(), "recorded");
    }
}

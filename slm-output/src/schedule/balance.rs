//! Equal light for all colours.

use holod_calibration::rig::PanelMode;
use holod_calibration::{Colour, PerColour, TimeNs};

use crate::fields::FrameLayout;

/// Keeps any colour from being lit longer than the others, so that a picture of which some fields stay dark gets darker
/// and not coloured.
///
/// A colour may be ahead of the one that was lit least by the windows of one colour frame and no more. Whoever is
/// ahead waits. So the colours differ by one colour frame's light at most over any time.
#[derive(Clone, Debug)]
pub(super) struct Balance {
    lit: PerColour<TimeNs>,
    /// By how much a colour may be ahead before its next window.
    ahead_max: Option<TimeNs>,
}

impl Balance {
    /// Nothing has been lit yet. `width` is the length of a whole window.
    pub(super) fn new(layout: &FrameLayout, width: TimeNs) -> Self {
        let ahead_max = match layout.mode {
            // There is only one colour.
            PanelMode::Monochrome(_) => None,
            _ => Some(TimeNs((i64::from(layout.frames_per_colour) - 1) * width.0)),
        };
        Self { lit: PerColour([TimeNs(0); 3]), ahead_max }
    }

    /// Whether `colour` may be lit for `time` now; it is then taken as lit.
    pub(super) fn take(&mut self, colour: Colour, time: TimeNs) -> bool {
        let least = self.lit.0.into_iter().min().unwrap_or_default();
        if self.ahead_max.is_some_and(|ahead_max| self.lit[colour] - least > ahead_max) {
            return false;
        }
        self.lit[colour] = self.lit[colour] + time;
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use holod_calibration::Resolution;
    use holod_calibration::rig::{Panel, Rig};
    use proptest::prelude::*;

    const WIDTH: TimeNs = TimeNs(3_000_000);

    fn layout(mode: PanelMode, frames_per_colour: u8) -> FrameLayout {
        let panel = Panel { mode, frames_per_colour, ..Rig::default().panel };
        FrameLayout::new(&panel, Resolution { width: 2, height: 2 })
    }

    #[test]
    fn a_colour_waits_for_one_that_was_missed() {
        let mut balance = Balance::new(&layout(PanelMode::FieldSequential, 1), WIDTH);
        let [red, green, blue] = Colour::ALL;
        assert!(balance.take(red, WIDTH) && balance.take(blue, WIDTH), "green was missed");
        assert!(!balance.take(red, WIDTH), "red is ahead of green");
        assert!(balance.take(green, WIDTH) && balance.take(red, WIDTH));
    }

    #[test]
    fn one_colour_alone_has_nobody_to_wait_for() {
        let mut balance = Balance::new(&layout(PanelMode::Monochrome(Colour::Green), 1), WIDTH);
        assert!((0..1000).all(|_| balance.take(Colour::Green, WIDTH)));
    }

    proptest! {
        #[test]
        fn whatever_is_missed_the_colours_differ_by_one_colour_frame(
            frames_per_colour in 1u8..4,
            fields in prop::collection::vec((prop::bool::weighted(0.8), 1i64..=WIDTH.0), 1..600),
        ) {
            let layout = layout(PanelMode::FieldSequential, frames_per_colour);
            let mut balance = Balance::new(&layout, WIDTH);
            for (index, (there, time_ns)) in fields.into_iter().enumerate() {
                if there {
                    balance.take(layout.colour_of_field(index % layout.fields()), TimeNs(time_ns));
                }
                let most = balance.lit.0.into_iter().max().unwrap();
                let least = balance.lit.0.into_iter().min().unwrap();
                prop_assert!((most - least).0 <= i64::from(frames_per_colour) * WIDTH.0);
            }
        }
    }
}

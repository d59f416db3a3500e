//! Equal light for all colours.

use holod_calibration::rig::PanelMode;
use holod_calibration::{Colour, PerColour, TimeNs};

use crate::fields::FrameLayout;

/// A window shorter than this is not worth its rounding to the box's microseconds: its field stays dark.
pub(super) const LIGHT_MIN: TimeNs = TimeNs(20_000);

/// Keeps any colour from being lit longer than the others, so that a picture of which some fields stay dark gets darker
/// and not coloured.
///
/// Before each field it compares what the colours have been lit for in excess of the windows that they have already had
/// in this colour frame. The field's colour may be lit until it has as much as the least of them and its own whole
/// window, so that it waits for a colour that was missed, and is cut as short as one whose window was cut short. So the
/// colours differ by one colour frame's light at most over any time, and what one was lit less than the others is made
/// good within the colour frame that follows.
#[derive(Clone, Debug)]
pub(super) struct Balance {
    lit: PerColour<TimeNs>,
    /// What was taken last, for it to be given back.
    last: Option<(Colour, TimeNs)>,
    layout: FrameLayout,
    width: TimeNs,
}

impl Balance {
    /// Nothing has been lit yet. `width` is the length of a whole window.
    pub(super) fn new(layout: &FrameLayout, width: TimeNs) -> Self {
        Self { lit: PerColour([TimeNs(0); 3]), last: None, layout: *layout, width }
    }

    /// For how much of `time` the colour of `field`, a position in the colour frame, may be lit now; it is then taken
    /// as lit. 0 where it must wait.
    pub(super) fn take(&mut self, field: usize, time: TimeNs) -> TimeNs {
        let colour = self.layout.colour_of_field(field);
        // There is only one colour.
        if matches!(self.layout.mode, PanelMode::Monochrome(_)) {
            return time;
        }
        let excess = |colour: Colour| {
            let had = (0..field).filter(|&before| self.layout.colour_of_field(before) == colour).count();
            self.lit[colour].0 - had as i64 * self.width.0
        };
        let least = Colour::ALL.into_iter().map(excess).min().unwrap_or_default();
        let room = TimeNs(self.width.0 + least - excess(colour));
        let taken = time.min(room);
        let taken = if taken < LIGHT_MIN { TimeNs(0) } else { taken };
        self.lit[colour] = self.lit[colour] + taken;
        self.last = Some((colour, taken));
        taken
    }

    /// What was taken last stayed dark.
    pub(super) fn give_back(&mut self) {
        if let Some((colour, taken)) = self.last.take() {
            self.lit[colour] = self.lit[colour] - taken;
        }
    }

    /// Of what `colour` took before, `time` stayed dark.
    pub(super) fn give_back_of(&mut self, colour: Colour, time: TimeNs) {
        if !matches!(self.layout.mode, PanelMode::Monochrome(_)) {
            self.lit[colour] = self.lit[colour] - time;
        }
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

    fn spread_ns(balance: &Balance) -> i64 {
        let lit = balance.lit.0;
        (lit.into_iter().max().unwrap() - lit.into_iter().min().unwrap()).0
    }

    /// Three colours of one field each, whose light is all there.
    fn whole_frame(balance: &mut Balance) -> [TimeNs; 3] {
        [0, 1, 2].map(|field| balance.take(field, WIDTH))
    }

    #[test]
    fn a_colour_waits_for_one_that_was_missed() {
        let mut balance = Balance::new(&layout(PanelMode::FieldSequential, 1), WIDTH);
        assert_eq!(balance.take(0, WIDTH), WIDTH);
        assert_eq!(balance.take(2, WIDTH), TimeNs(0), "the second was missed, so the third waits for it");
        assert_eq!(whole_frame(&mut balance), [TimeNs(0), WIDTH, WIDTH], "the first is ahead");
        assert_eq!(spread_ns(&balance), 0);
        assert_eq!(whole_frame(&mut balance), [WIDTH; 3]);
    }

    #[test]
    fn a_window_that_was_cut_short_costs_the_other_colours_as_much() {
        let short = TimeNs(1_000_000);
        for cut in 0..3 {
            let mut balance = Balance::new(&layout(PanelMode::FieldSequential, 1), WIDTH);
            whole_frame(&mut balance);
            for field in 0..3 {
                balance.take(field, if field == cut { short } else { WIDTH });
            }
            whole_frame(&mut balance);
            assert_eq!(spread_ns(&balance), 0, "field {cut}: {balance:?}");
            assert_eq!(whole_frame(&mut balance), [WIDTH; 3]);
        }
    }

    #[test]
    fn what_stayed_dark_is_not_counted() {
        let mut balance = Balance::new(&layout(PanelMode::FieldSequential, 1), WIDTH);
        whole_frame(&mut balance);
        assert_eq!(balance.take(0, WIDTH), WIDTH);
        balance.give_back();
        balance.give_back();
        assert_eq!([1, 2].map(|field| balance.take(field, WIDTH)), [TimeNs(0); 2]);
        assert_eq!(whole_frame(&mut balance), [WIDTH; 3]);
    }

    /// Each colour frame's windows are heard of too late in part, which is known when the next ones have been taken.
    #[test]
    fn light_that_is_missed_is_made_good_by_the_other_colours_once_it_is_known() {
        let mut balance = Balance::new(&layout(PanelMode::FieldSequential, 1), WIDTH);
        whole_frame(&mut balance);
        whole_frame(&mut balance);
        balance.give_back_of(Colour::Red, WIDTH);
        balance.give_back_of(Colour::Blue, TimeNs(1_000_000));
        whole_frame(&mut balance);
        whole_frame(&mut balance);
        assert_eq!(spread_ns(&balance), 0, "{balance:?}");
        assert_eq!(whole_frame(&mut balance), [WIDTH; 3]);
    }

    #[test]
    fn one_colour_alone_has_nobody_to_wait_for() {
        let mut balance = Balance::new(&layout(PanelMode::Monochrome(Colour::Green), 1), WIDTH);
        assert!((0..1000).all(|_| balance.take(0, WIDTH) == WIDTH));
    }

    proptest! {
        /// Also where the colour frame begins again before it is over.
        #[test]
        fn whatever_is_missed_the_colours_differ_by_one_colour_frame_and_are_soon_equal(
            frames_per_colour in 1u8..4,
            fields in prop::collection::vec((prop::bool::weighted(0.8), 1i64..=WIDTH.0, prop::bool::weighted(0.02)), 1..600),
        ) {
            let layout = layout(PanelMode::FieldSequential, frames_per_colour);
            let mut balance = Balance::new(&layout, WIDTH);
            let mut field = 0;
            for (there, time_ns, begins_again) in fields {
                field = if begins_again { 0 } else { (field + 1) % layout.fields() };
                if there {
                    balance.take(field, TimeNs(time_ns));
                }
                prop_assert!(spread_ns(&balance) <= i64::from(frames_per_colour) * WIDTH.0);
            }
            // Two whole colour frames: the one that is under way may have been cut, and the next one makes it good.
            for field in (0..layout.fields()).chain(0..layout.fields()) {
                balance.take(field, WIDTH);
            }
            prop_assert!(spread_ns(&balance) < LIGHT_MIN.0, "{balance:?}");
        }
    }
}

//! Whether the live feed still gives pictures. Where a run asks for that, lasers are dark once it does not.

use holod_calibration::TimeNs;

/// What is shown now, as far as the feed is concerned.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum FeedPart {
    /// Its pictures, as they come.
    Pictures,
    /// The last of them, which stands still because a person wants it to.
    Still,
    /// Something else: a scene, a pattern.
    Nothing,
}

/// What the judgement rests on.
#[derive(Clone, Copy, Debug)]
pub(super) struct FeedSeen {
    pub(super) part: FeedPart,
    /// When the newest picture was taken over.
    pub(super) t_newest: Option<TimeNs>,
    /// When the picture was taken over that the panel shows.
    pub(super) t_shown: Option<TimeNs>,
}

/// Says when lasers are to go dark for want of pictures, and when no longer.
#[derive(Debug)]
pub(super) struct FeedWatch {
    dark_after: Option<TimeNs>,
    /// Before this no picture was to be expected.
    t_since: TimeNs,
    /// While lasers are kept dark: when the newest picture before that was taken over.
    dark: Option<Option<TimeNs>>,
}

impl FeedWatch {
    /// Judges from host time `began` on. Without `dark_after` the last picture stays lit.
    pub(super) const fn new(dark_after: Option<TimeNs>, began: TimeNs) -> Self {
        Self { dark_after, t_since: began, dark: None }
    }

    /// How long the feed may give no picture.
    pub(super) const fn dark_after(&self) -> Option<TimeNs> {
        self.dark_after
    }

    /// Whether lasers are to be dark.
    pub(super) const fn keeps_dark(&self) -> bool {
        self.dark.is_some()
    }

    /// Judges what is seen at host time `now`; whether that has changed anything.
    pub(super) fn judge(&mut self, seen: FeedSeen, now: TimeNs) -> bool {
        let Some(dark_after) = self.dark_after else { return false };
        if seen.part != FeedPart::Pictures {
            self.t_since = now;
        }
        let t_last = seen.t_newest.map_or(self.t_since, |t_newest| t_newest.max(self.t_since));
        let is_silent = now - t_last > dark_after;
        let before = self.dark;
        self.dark = match (seen.part, before) {
            (FeedPart::Nothing, _) => None,
            (FeedPart::Still, before) => before,
            (FeedPart::Pictures, None) => is_silent.then_some(seen.t_newest),
            // What is lit first is a new picture, not the old one that is still on the panel.
            (FeedPart::Pictures, Some(newest_before)) => {
                (is_silent || seen.t_shown <= newest_before).then_some(newest_before)
            }
        };
        self.dark.is_some() != before.is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn ms(ms: i64) -> TimeNs {
        TimeNs(ms * 1_000_000)
    }

    fn watch() -> FeedWatch {
        FeedWatch::new(Some(ms(500)), ms(0))
    }

    fn seen(part: FeedPart, newest_ms: Option<i64>, shown_ms: Option<i64>) -> FeedSeen {
        FeedSeen { part, t_newest: newest_ms.map(ms), t_shown: shown_ms.map(ms) }
    }

    #[test]
    fn lasers_are_dark_while_no_picture_comes_and_until_a_new_one_is_on_the_panel() {
        let mut watch = watch();
        let pictures = |newest, shown| seen(FeedPart::Pictures, newest, shown);
        let looks = [
            (0, pictures(None, None), false),
            (500, pictures(None, None), false),
            (501, pictures(None, None), true),
            (600, pictures(Some(600), None), true),
            (650, pictures(Some(640), Some(600)), false),
            (1_140, pictures(Some(640), Some(640)), false),
            (1_141, pictures(Some(640), Some(640)), true),
            (9_000, pictures(Some(640), Some(640)), true),
            (9_010, pictures(Some(9_005), Some(640)), true),
            (9_020, pictures(Some(9_005), Some(9_005)), false),
        ];
        for (now_ms, seen, dark) in looks {
            let before = watch.keeps_dark();
            assert_eq!(watch.judge(seen, ms(now_ms)), before != dark, "{now_ms} ms");
            assert_eq!(watch.keeps_dark(), dark, "{now_ms} ms");
        }
    }

    #[test]
    fn a_picture_that_came_and_went_in_the_dark_lights_nothing() {
        let mut watch = watch();
        watch.judge(seen(FeedPart::Pictures, Some(0), Some(0)), ms(600));
        watch.judge(seen(FeedPart::Pictures, Some(610), Some(610)), ms(1_200));
        assert!(watch.keeps_dark(), "silent again before it was seen");
        watch.judge(seen(FeedPart::Pictures, Some(1_210), Some(1_210)), ms(1_220));
        assert!(!watch.keeps_dark());
    }

    #[test]
    fn a_scene_or_a_pattern_is_lit_and_the_feed_counts_anew_after_it() {
        let mut watch = watch();
        watch.judge(seen(FeedPart::Pictures, None, None), ms(600));
        assert!(watch.keeps_dark());
        watch.judge(seen(FeedPart::Nothing, None, None), ms(610));
        assert!(!watch.keeps_dark());
        watch.judge(seen(FeedPart::Nothing, None, None), ms(5_000));
        watch.judge(seen(FeedPart::Pictures, None, None), ms(5_500));
        assert!(!watch.keeps_dark());
        watch.judge(seen(FeedPart::Pictures, None, None), ms(5_501));
        assert!(watch.keeps_dark());
    }

    #[test]
    fn a_picture_that_stands_still_is_neither_put_out_nor_lit() {
        let mut watch = watch();
        let newest = Some(0);
        watch.judge(seen(FeedPart::Still, newest, newest), ms(5_000));
        assert!(!watch.keeps_dark(), "a person wants it to stand");
        watch.judge(seen(FeedPart::Pictures, newest, newest), ms(5_501));
        assert!(watch.keeps_dark());
        watch.judge(seen(FeedPart::Still, Some(5_600), newest), ms(5_610));
        assert!(watch.keeps_dark(), "the old picture is on the panel");
    }

    #[test]
    fn without_a_time_the_last_picture_stays_lit() {
        let mut watch = FeedWatch::new(None, ms(0));
        assert!(!watch.judge(seen(FeedPart::Pictures, None, None), ms(1_000_000)));
        assert!(!watch.keeps_dark());
    }
}

//! Whether the live feed still gives pictures. Where a run asks for that, lasers are dark once it does not.

use holod_calibration::TimeNs;

/// What the judgement rests on.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct FeedSeen {
    /// The feed is to be shown, and no scene.
    pub(super) is_live: bool,
    /// The picture is to stand still, because a person wants it to.
    pub(super) is_paused: bool,
    /// A pattern is to be shown in place of pictures.
    pub(super) has_pattern: bool,
    /// When the newest picture was taken over.
    pub(super) t_newest: Option<TimeNs>,
    /// When the picture was taken over that the frame loop had in hand for what the panel shows; none is where it has a
    /// scene.
    pub(super) t_in_hand: Option<TimeNs>,
    /// When what the panel shows was begun.
    pub(super) t_begun: Option<TimeNs>,
}

/// Says when lasers are to go dark for want of pictures, and when no longer.
///
/// A feed is given up when no picture has come for too long, and remains so, whatever a person has shown in its place,
/// until the frame loop has a newer picture in hand or, with a scene, none that could come back. Lasers are dark while
/// a feed that was given up is to be shown, and after that until something else is on the panel.
#[derive(Debug)]
pub(super) struct FeedWatch {
    dark_after: Option<TimeNs>,
    /// Before this no picture was to be expected.
    t_since: TimeNs,
    /// Where the feed has been given up: when the newest picture before that was taken over.
    given_up: Option<Option<TimeNs>>,
    is_to_be_shown: bool,
    /// When that was another matter last.
    t_changed: TimeNs,
    keeps_dark: bool,
}

impl FeedWatch {
    /// Judges from host time `began` on. Without `dark_after` the last picture stays lit.
    pub(super) const fn new(dark_after: Option<TimeNs>, began: TimeNs) -> Self {
        Self { dark_after, t_since: began, given_up: None, is_to_be_shown: true, t_changed: began, keeps_dark: false }
    }

    /// How long the feed may give no picture.
    pub(super) const fn dark_after(&self) -> Option<TimeNs> {
        self.dark_after
    }

    /// Whether lasers are to be dark.
    pub(super) const fn keeps_dark(&self) -> bool {
        self.keeps_dark
    }

    /// Judges what is seen at host time `now`, by which the frame loop has been handed what is to be shown; whether
    /// that has changed anything.
    pub(super) fn judge(&mut self, seen: FeedSeen, now: TimeNs) -> bool {
        let Some(dark_after) = self.dark_after else { return false };
        if !seen.is_live {
            self.t_since = now;
        }
        let is_to_be_shown = !seen.has_pattern && (seen.is_live || seen.is_paused);
        if std::mem::replace(&mut self.is_to_be_shown, is_to_be_shown) != is_to_be_shown {
            self.t_changed = now;
        }
        // What the panel shows was begun before that: a picture may be on its way there.
        let may_be_older = seen.t_begun <= Some(self.t_changed);
        let t_last = seen.t_newest.map_or(self.t_since, |t_newest| t_newest.max(self.t_since));
        self.given_up = match (seen.is_paused, seen.is_live) {
            // What was in hand when it began stays in hand.
            (true, _) => self.given_up,
            (false, true) if now - t_last > dark_after => Some(seen.t_newest),
            (false, true) => self.given_up.filter(|&t_before| seen.t_in_hand <= t_before),
            (false, false) => self.given_up.filter(|_| seen.t_in_hand.is_some() || may_be_older),
        };
        let keeps_dark = self.given_up.is_some() && (is_to_be_shown || may_be_older);
        std::mem::replace(&mut self.keeps_dark, keeps_dark) != keeps_dark
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn ms(ms: i64) -> TimeNs {
        TimeNs(ms * 1_000_000)
    }

    /// The feed in front of the watch, by milliseconds: what is asked for, and what the panel shows.
    struct Bench {
        watch: FeedWatch,
        seen: FeedSeen,
    }

    impl Bench {
        /// Whose lasers go dark after half a second.
        fn new() -> Self {
            let seen = FeedSeen { is_live: true, ..FeedSeen::default() };
            Self { watch: FeedWatch::new(Some(ms(500)), ms(0)), seen }
        }

        fn comes(&mut self, t_ms: i64) {
            self.seen.t_newest = Some(ms(t_ms));
        }

        /// The panel shows what was begun then, with a picture or a scene in hand.
        fn shows(&mut self, begun_ms: i64, picture_ms: Option<i64>) {
            (self.seen.t_begun, self.seen.t_in_hand) = (Some(ms(begun_ms)), picture_ms.map(ms));
        }

        fn is_dark_at(&mut self, now_ms: i64) -> bool {
            let before = self.watch.keeps_dark();
            let changes = self.watch.judge(self.seen, ms(now_ms));
            assert_eq!(changes, before != self.watch.keeps_dark(), "{now_ms} ms");
            self.watch.keeps_dark()
        }

        /// A picture of 0 ms is on the panel, and the feed is given up.
        fn given_up() -> Self {
            let mut bench = Self::new();
            bench.comes(0);
            bench.shows(0, Some(0));
            assert!(bench.is_dark_at(600));
            bench
        }
    }

    #[test]
    fn lasers_are_dark_while_no_picture_comes_and_until_a_new_one_is_on_the_panel() {
        let mut bench = Bench::new();
        assert!(!bench.is_dark_at(0) && !bench.is_dark_at(500));
        assert!(bench.is_dark_at(501));
        bench.comes(600);
        assert!(bench.is_dark_at(600));
        bench.comes(640);
        bench.shows(610, Some(600));
        assert!(!bench.is_dark_at(650));
        bench.shows(650, Some(640));
        assert!(!bench.is_dark_at(1_140));
        assert!(bench.is_dark_at(1_141) && bench.is_dark_at(9_000));
        bench.comes(9_005);
        assert!(bench.is_dark_at(9_010), "the old picture is on the panel");
        bench.shows(9_010, Some(9_005));
        assert!(!bench.is_dark_at(9_020));
    }

    #[test]
    fn a_picture_that_came_and_went_in_the_dark_lights_nothing() {
        let mut bench = Bench::given_up();
        bench.comes(610);
        bench.shows(620, Some(610));
        assert!(bench.is_dark_at(1_200), "silent again before it was seen");
        bench.comes(1_210);
        assert!(bench.is_dark_at(1_215), "the one of 610 is on the panel, which is too old by now");
        bench.shows(1_215, Some(1_210));
        assert!(!bench.is_dark_at(1_220));
    }

    #[test]
    fn a_pattern_is_lit_once_it_is_on_the_panel_and_the_old_picture_is_dark_after_it() {
        let mut bench = Bench::given_up();
        bench.seen.has_pattern = true;
        assert!(bench.is_dark_at(610), "the old picture is on the panel");
        bench.shows(611, Some(0));
        assert!(!bench.is_dark_at(620) && !bench.is_dark_at(9_000));
        bench.seen.has_pattern = false;
        assert!(bench.is_dark_at(9_010));
        bench.seen.has_pattern = true;
        assert!(bench.is_dark_at(9_020), "the old picture may be on its way to the panel");
        bench.shows(9_019, Some(0));
        assert!(bench.is_dark_at(9_030));
        bench.shows(9_021, Some(0));
        assert!(!bench.is_dark_at(9_040));
        bench.seen.has_pattern = false;
        bench.comes(9_045);
        assert!(bench.is_dark_at(9_050));
        bench.shows(9_051, Some(9_045));
        assert!(!bench.is_dark_at(9_060));
    }

    #[test]
    fn a_feed_that_falls_silent_behind_a_pattern_is_dark_after_it_and_one_that_goes_on_is_lit() {
        let mut bench = Bench::new();
        bench.comes(0);
        bench.shows(0, Some(0));
        assert!(!bench.is_dark_at(10));
        bench.seen.has_pattern = true;
        assert!(!bench.is_dark_at(20));
        bench.shows(21, Some(0));
        assert!(!bench.is_dark_at(5_000), "a pattern is lit");
        bench.comes(5_010);
        bench.seen.has_pattern = false;
        assert!(bench.is_dark_at(5_020), "the frame loop may have the old picture in hand");
        bench.seen.has_pattern = true;
        bench.shows(5_021, Some(5_010));
        assert!(!bench.is_dark_at(5_030));
        bench.seen.has_pattern = false;
        assert!(!bench.is_dark_at(5_040));
    }

    #[test]
    fn a_scene_is_lit_once_it_is_on_the_panel_and_the_feed_counts_anew_after_it() {
        let mut bench = Bench::given_up();
        bench.seen.is_live = false;
        assert!(bench.is_dark_at(610), "the old picture is on the panel");
        bench.shows(611, None);
        assert!(!bench.is_dark_at(620) && !bench.is_dark_at(5_000));
        bench.seen.is_live = true;
        assert!(!bench.is_dark_at(5_500), "no picture was to be expected before 5 s");
        assert!(bench.is_dark_at(5_501));
        bench.comes(5_510);
        bench.shows(5_511, Some(5_510));
        assert!(!bench.is_dark_at(5_520));
    }

    #[test]
    fn a_picture_that_is_on_its_way_to_the_panel_when_a_scene_is_asked_for_stays_dark() {
        let mut bench = Bench::new();
        bench.comes(0);
        assert!(bench.is_dark_at(501), "it has not been shown yet");
        bench.seen.is_live = false;
        assert!(bench.is_dark_at(510));
        bench.shows(400, Some(0));
        assert!(bench.is_dark_at(520), "the old picture has come on the panel");
        bench.shows(511, None);
        assert!(!bench.is_dark_at(530));
    }

    #[test]
    fn a_feed_without_pictures_is_dark_again_after_a_pattern() {
        let mut bench = Bench::new();
        assert!(bench.is_dark_at(600));
        bench.seen.has_pattern = true;
        assert!(bench.is_dark_at(610));
        bench.shows(611, None);
        assert!(!bench.is_dark_at(620));
        bench.seen.has_pattern = false;
        assert!(bench.is_dark_at(630));
    }

    #[test]
    fn a_picture_that_stands_still_is_neither_put_out_nor_lit() {
        let mut bench = Bench::new();
        bench.comes(0);
        bench.shows(0, Some(0));
        bench.seen.is_paused = true;
        assert!(!bench.is_dark_at(5_000), "a person wants it to stand");
        bench.seen.is_paused = false;
        assert!(bench.is_dark_at(5_001), "nothing has come all the while");
        bench.seen.is_paused = true;
        bench.comes(5_600);
        assert!(bench.is_dark_at(5_610), "the old picture is on the panel");
        bench.seen.is_paused = false;
        bench.shows(5_611, Some(5_600));
        assert!(!bench.is_dark_at(5_620));
        bench.seen.is_paused = true;
        bench.comes(8_900);
        assert!(!bench.is_dark_at(9_000));
        bench.seen.is_paused = false;
        assert!(!bench.is_dark_at(9_010), "pictures have come all the while");
    }

    #[test]
    fn an_old_picture_that_stands_still_stays_dark_behind_scenes_and_patterns() {
        let mut bench = Bench::given_up();
        (bench.seen.is_paused, bench.seen.is_live) = (true, false);
        assert!(bench.is_dark_at(610), "a scene is shown once the picture goes on");
        bench.seen.has_pattern = true;
        assert!(bench.is_dark_at(620));
        bench.shows(621, Some(0));
        assert!(!bench.is_dark_at(630));
        bench.seen.has_pattern = false;
        assert!(bench.is_dark_at(640), "what stands still comes back");
        bench.shows(641, Some(0));
        bench.seen.is_paused = false;
        assert!(bench.is_dark_at(650));
        bench.shows(651, None);
        assert!(!bench.is_dark_at(660));
    }

    #[test]
    fn without_a_time_the_last_picture_stays_lit() {
        let mut bench = Bench { watch: FeedWatch::new(None, ms(0)), ..Bench::new() };
        assert!(!bench.is_dark_at(1_000_000));
    }
}

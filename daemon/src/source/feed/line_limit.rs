//! How much of the log clients may fill.

use holod_calibration::TimeNs;

/// Lines that may come at once.
const AT_ONCE: i64 = 16;
/// After these one line in this time.
const EVERY: TimeNs = TimeNs(1_000_000_000);

/// Lets some lines into the log at once and then one a second, so that a client that connects again and again does not
/// fill it.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct LineLimit {
    /// Host time at which there is room for all lines again.
    t_empty: TimeNs,
    left_out: u64,
}

impl LineLimit {
    /// Whether there is room for a line at host time `now`; where there is none it is counted.
    pub(super) fn has_room(&mut self, now: TimeNs) -> bool {
        let has_room = self.take_room(now);
        self.left_out += u64::from(!has_room);
        has_room
    }

    /// How many lines were left out, where there are some, and room to say so.
    pub(super) fn left_out(&mut self, now: TimeNs) -> Option<u64> {
        (self.left_out > 0 && self.take_room(now)).then(|| std::mem::take(&mut self.left_out))
    }

    fn take_room(&mut self, now: TimeNs) -> bool {
        let t_empty = self.t_empty.max(now) + EVERY;
        let has_room = t_empty - now <= TimeNs(AT_ONCE * EVERY.0);
        if has_room {
            self.t_empty = t_empty;
        }
        has_room
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn some_lines_come_at_once_then_one_a_second_and_the_rest_is_counted() {
        let mut limit = LineLimit::default();
        let at = |ms: i64| TimeNs(1_000_000_000_000 + ms * 1_000_000);
        let said = |limit: &mut LineLimit, from_ms: i64| (0..1000).filter(|k| limit.has_room(at(from_ms + k))).count();
        assert_eq!((said(&mut limit, 0), said(&mut limit, 1000), said(&mut limit, 2000)), (16, 1, 1));
        assert_eq!((limit.left_out(at(3000)), limit.left_out(at(3001))), (Some(3000 - 18), None));
        assert_eq!(said(&mut limit, 3001), 1, "at its end: what was left out took the room before");
        assert_eq!(limit.left_out(at(5000)), Some(999));
        assert_eq!(said(&mut limit, 60_000), 16, "all is forgotten after a while");
    }

    #[test]
    fn a_client_that_comes_and_goes_now_and_then_is_told_in_full() {
        let mut limit = LineLimit::default();
        let lines = (0..1000_i64).flat_map(|k| [TimeNs(k * 3_000_000_000); 3]);
        assert!(lines.into_iter().all(|now| limit.has_room(now)));
        assert_eq!(limit.left_out(TimeNs(i64::MAX / 2)), None);
    }
}

//! Was the rule kept? Judged from what was on the panel and from the box's own log of edges, and from nothing else.
//!
//! When a field was on the panel is what the panel reported: a report that is wrong, by no more than
//! [`FieldGate::time_tolerance`](crate::schedule::FieldGate::time_tolerance), is not found here.

use std::fmt;

use holod_calibration::{Colour, TimeNs};

use super::{DarkReason, LaserEdge};

/// One colour field that was on the panel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FieldSpan {
    /// Number of the frame whose pattern it shows.
    pub frame_id: u64,
    /// Position in the field order.
    pub field: usize,
    /// The laser that belongs to it.
    pub colour: Colour,
    /// When it came on the panel.
    pub t_present: TimeNs,
    /// When it may first be lit.
    pub t_settled: TimeNs,
    /// When it made way for the next one.
    pub t_end: TimeNs,
    /// Why it was meant to be dark, if it was.
    pub dark: Option<DarkReason>,
}

/// Light that does not go with the fields that were on the panel, or that is missing. Times are the host's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs, reason = "the variants say what their fields are")]
pub enum Finding {
    /// A laser was lit while no field was on the panel.
    WindowWithoutField { colour: Colour, t_on: TimeNs },
    /// A laser was lit over a field of another colour.
    WrongColour { colour: Colour, t_on: TimeNs, field_colour: Colour, frame_id: u64 },
    /// A laser was lit over its own field but also before it had settled or after its end.
    OutsideField { colour: Colour, t_on: TimeNs, t_off: TimeNs, frame_id: u64 },
    /// Two lasers were lit at once.
    TwoLit { colours: [Colour; 2], t: TimeNs },
    /// A laser was lit twice in one field.
    SecondWindow { colour: Colour, t_on: TimeNs, frame_id: u64 },
    /// A laser was lit over a field that must stay dark.
    ForbiddenField { colour: Colour, frame_id: u64, reason: DarkReason },
    /// A field that should have been lit was not.
    FieldWithoutWindow {
        colour: Colour,
        frame_id: u64,
        /// When it came on the panel.
        t_present: TimeNs,
    },
    /// A laser went on that was on, or off that was off.
    BrokenLog { colour: Colour, t: TimeNs },
    /// A laser was never switched off.
    StillLit { colour: Colour, t_on: TimeNs },
}

impl Finding {
    /// Whether light went where it must not; otherwise some was only missing.
    fn is_unsafe(&self) -> bool {
        !matches!(self, Self::FieldWithoutWindow { .. })
    }
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::WindowWithoutField { colour, t_on } => {
                write!(f, "{colour} lit at {} ns with no field on the panel", t_on.0)
            }
            Self::WrongColour { colour, t_on, field_colour, frame_id } => {
                write!(f, "{colour} lit at {} ns over the {field_colour} field of frame {frame_id}", t_on.0)
            }
            Self::OutsideField { colour, t_on, t_off, frame_id } => {
                write!(
                    f,
                    "{colour} lit from {} to {} ns, outside its settled field of frame {frame_id}",
                    t_on.0, t_off.0
                )
            }
            Self::TwoLit { colours: [a, b], t } => write!(f, "{a} and {b} both lit at {} ns", t.0),
            Self::SecondWindow { colour, t_on, frame_id } => {
                write!(f, "{colour} lit again at {} ns in one field of frame {frame_id}", t_on.0)
            }
            Self::ForbiddenField { colour, frame_id, reason } => {
                write!(f, "{colour} lit over the field of frame {frame_id}, which must stay dark: {reason}")
            }
            Self::FieldWithoutWindow { colour, frame_id, t_present } => {
                write!(f, "the {colour} field of frame {frame_id} at {} ns was not lit", t_present.0)
            }
            Self::BrokenLog { colour, t } => write!(f, "{colour} switched at {} ns to what it was already", t.0),
            Self::StillLit { colour, t_on } => write!(f, "{colour} lit at {} ns and never switched off", t_on.0),
        }
    }
}

/// How the lasers' edges go with the fields that were on the panel.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct EdgeReport {
    /// Fields that were judged: all that were given.
    pub fields: usize,
    /// Of those, fields lit by exactly one window of their own laser, inside their settled time.
    pub lit: usize,
    /// Of those, fields that were meant to stay dark and did.
    pub dark: usize,
    /// Every fault, in the order in which edges and fields were gone through.
    pub findings: Vec<Finding>,
}

impl EdgeReport {
    /// Findings of light where it must not be.
    pub fn unsafe_findings(&self) -> impl Iterator<Item = &Finding> {
        self.findings.iter().filter(|finding| finding.is_unsafe())
    }
}

/// Judges `edges` against `fields`. Both are given in order of time; fields do not overlap.
///
/// A window that touches no field, a field of another colour, or its own field's unsettled part, is a finding; so are
/// two lasers lit at once, two windows in one field and a field without a window that has no reason to be dark.
pub fn verify_edges(fields: &[FieldSpan], edges: &[LaserEdge]) -> EdgeReport {
    let mut report = EdgeReport { fields: fields.len(), ..EdgeReport::default() };
    let windows = windows(edges, &mut report.findings);
    let mut longest: Option<(Colour, TimeNs)> = None;
    for &(colour, t_on, t_off) in &windows {
        match longest {
            Some((other, t_until)) if t_on < t_until => {
                report.findings.push(Finding::TwoLit { colours: [other, colour], t: t_on });
                if t_off > t_until {
                    longest = Some((colour, t_off));
                }
            }
            _ => longest = Some((colour, t_off)),
        }
    }

    let mut lit = vec![0u32; fields.len()];
    let mut tainted = vec![false; fields.len()];
    for &(colour, t_on, t_off) in &windows {
        let first = fields.partition_point(|field| field.t_end <= t_on);
        let touched = fields[first..].iter().take_while(|field| field.t_present < t_off).count();
        let touched = first..first + touched;
        let Some(own) = touched.clone().find(|&index| fields[index].colour == colour) else {
            report.findings.push(match fields.get(first).filter(|_| !touched.is_empty()) {
                Some(field) => {
                    let (field_colour, frame_id) = (field.colour, field.frame_id);
                    Finding::WrongColour { colour, t_on, field_colour, frame_id }
                }
                None => Finding::WindowWithoutField { colour, t_on },
            });
            continue;
        };
        let (field, frame_id) = (&fields[own], fields[own].frame_id);
        lit[own] += 1;
        if t_on < field.t_settled || t_off > field.t_end {
            tainted[own] = true;
            report.findings.push(Finding::OutsideField { colour, t_on, t_off, frame_id });
        }
        if lit[own] > 1 {
            tainted[own] = true;
            report.findings.push(Finding::SecondWindow { colour, t_on, frame_id });
        }
    }
    for ((field, lit), tainted) in fields.iter().zip(lit).zip(tainted) {
        match (lit, field.dark) {
            (0, Some(_)) => report.dark += 1,
            (0, None) => {
                let (colour, frame_id, t_present) = (field.colour, field.frame_id, field.t_present);
                report.findings.push(Finding::FieldWithoutWindow { colour, frame_id, t_present });
            }
            (_, Some(reason)) if reason.forbids_light() => {
                let (colour, frame_id) = (field.colour, field.frame_id);
                report.findings.push(Finding::ForbiddenField { colour, frame_id, reason });
            }
            _ => report.lit += usize::from(!tainted),
        }
    }
    report
}

/// The lit windows (laser, on, off) in order of their on edges.
fn windows(edges: &[LaserEdge], findings: &mut Vec<Finding>) -> Vec<(Colour, TimeNs, TimeNs)> {
    let mut windows = Vec::with_capacity(edges.len() / 2);
    let mut on_since: [Option<TimeNs>; 3] = [None; 3];
    for edge in edges {
        let since = &mut on_since[edge.colour.index()];
        match (edge.on, *since) {
            (true, None) => *since = Some(edge.t),
            (false, Some(t_on)) => {
                *since = None;
                windows.push((edge.colour, t_on, edge.t));
            }
            _ => findings.push(Finding::BrokenLog { colour: edge.colour, t: edge.t }),
        }
    }
    for (colour, since) in Colour::ALL.into_iter().zip(on_since) {
        if let Some(t_on) = since {
            findings.push(Finding::StillLit { colour, t_on });
            windows.push((colour, t_on, edges.last().map_or(t_on, |last| last.t)));
        }
    }
    windows.sort_by_key(|&(_, t_on, _)| t_on);
    windows
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Three frames of three fields of 100 ns that settle for 20 ns.
    fn fields() -> Vec<FieldSpan> {
        (0..9)
            .map(|index: i64| FieldSpan {
                frame_id: 1 + index as u64 / 3,
                field: index as usize % 3,
                colour: Colour::ALL[index as usize % 3],
                t_present: TimeNs(1000 + 100 * index),
                t_settled: TimeNs(1020 + 100 * index),
                t_end: TimeNs(1100 + 100 * index),
                dark: None,
            })
            .collect()
    }

    /// A window of each field, from 30 to 80 ns after its start.
    fn windows() -> Vec<(Colour, i64, i64)> {
        fields().iter().map(|field| (field.colour, field.t_present.0 + 30, field.t_present.0 + 80)).collect()
    }

    fn edges(windows: &[(Colour, i64, i64)]) -> Vec<LaserEdge> {
        let mut edges: Vec<_> = windows
            .iter()
            .flat_map(|&(colour, on, off)| {
                [LaserEdge { t: TimeNs(on), colour, on: true }, LaserEdge { t: TimeNs(off), colour, on: false }]
            })
            .collect();
        edges.sort_by_key(|edge| edge.t);
        edges
    }

    fn findings(windows: &[(Colour, i64, i64)]) -> Vec<Finding> {
        verify_edges(&fields(), &edges(windows)).findings
    }

    #[test]
    fn each_field_with_its_own_window_is_right() {
        let report = verify_edges(&fields(), &edges(&windows()));
        assert_eq!(report, EdgeReport { fields: 9, lit: 9, dark: 0, findings: vec![] });
    }

    #[test]
    fn a_window_may_fill_all_of_the_settled_field() {
        let mut full = windows();
        full[4] = (Colour::Green, 1420, 1500);
        assert_eq!(findings(&full), []);
    }

    #[test]
    fn canary_a_window_without_field() {
        let mut extra = windows();
        extra.push((Colour::Red, 1950, 1960));
        assert_eq!(findings(&extra), [Finding::WindowWithoutField { colour: Colour::Red, t_on: TimeNs(1950) }]);
        extra.pop();
        extra.insert(0, (Colour::Red, 930, 980));
        assert_eq!(findings(&extra), [Finding::WindowWithoutField { colour: Colour::Red, t_on: TimeNs(930) }]);
    }

    #[test]
    fn canary_a_field_without_window() {
        let mut missing = windows();
        missing.remove(4);
        let (colour, t_present) = (Colour::Green, TimeNs(1400));
        let found = findings(&missing);
        assert_eq!(found, [Finding::FieldWithoutWindow { colour, frame_id: 2, t_present }]);
        assert!(!found[0].is_unsafe());
    }

    #[test]
    fn a_field_that_was_meant_to_be_dark_may_be() {
        let mut missing = windows();
        missing.remove(4);
        let mut fields = fields();
        fields[4].dark = Some(DarkReason::Shutdown);
        assert_eq!(
            verify_edges(&fields, &edges(&missing)),
            EdgeReport { fields: 9, lit: 8, dark: 1, findings: vec![] }
        );
    }

    #[test]
    fn canary_light_over_a_field_that_is_not_known_to_be_shown() {
        let mut fields = fields();
        fields[4].dark = Some(DarkReason::Untrusted);
        let reason = DarkReason::Untrusted;
        let expected = [Finding::ForbiddenField { colour: Colour::Green, frame_id: 2, reason }];
        assert_eq!(verify_edges(&fields, &edges(&windows())).findings, expected);
    }

    #[test]
    fn canary_the_wrong_colour() {
        let mut wrong = windows();
        wrong[4].0 = Colour::Blue;
        let (colour, t_on, t_present) = (Colour::Blue, TimeNs(1430), TimeNs(1400));
        let expected = [
            Finding::WrongColour { colour, t_on, field_colour: Colour::Green, frame_id: 2 },
            Finding::FieldWithoutWindow { colour: Colour::Green, frame_id: 2, t_present },
        ];
        assert_eq!(findings(&wrong), expected);
    }

    #[test]
    fn canary_two_lit_at_once() {
        let mut two = windows();
        // Blue stays lit over the whole next field, so that its overlap is not with its neighbour only.
        two[2].2 = 1335;
        let found = findings(&two);
        let two_lit = Finding::TwoLit { colours: [Colour::Blue, Colour::Red], t: TimeNs(1330) };
        assert!(found.contains(&two_lit), "{found:?}");
        two[2].2 = 1435;
        let found = findings(&two);
        assert!(
            found.contains(&Finding::TwoLit { colours: [Colour::Blue, Colour::Green], t: TimeNs(1430) }),
            "{found:?}"
        );
    }

    #[test]
    fn canary_lit_outside_the_field() {
        for (t_on, t_off) in [(1419, 1480), (1430, 1501)] {
            let mut outside = windows();
            outside[4] = (Colour::Green, t_on, t_off);
            let (t_on, t_off) = (TimeNs(t_on), TimeNs(t_off));
            let expected = [Finding::OutsideField { colour: Colour::Green, t_on, t_off, frame_id: 2 }];
            assert_eq!(findings(&outside), expected);
        }
    }

    #[test]
    fn canary_a_second_window_in_one_field() {
        let mut twice = windows();
        twice.push((Colour::Green, 1485, 1490));
        let expected = [Finding::SecondWindow { colour: Colour::Green, t_on: TimeNs(1485), frame_id: 2 }];
        assert_eq!(findings(&twice), expected);
    }

    #[test]
    fn canary_a_broken_log() {
        let mut edges = edges(&windows());
        let last = edges.pop().unwrap();
        let still = Finding::StillLit { colour: Colour::Blue, t_on: TimeNs(1830) };
        assert!(verify_edges(&fields(), &edges).findings.contains(&still));
        edges.push(LaserEdge { on: true, ..last });
        let broken = Finding::BrokenLog { colour: Colour::Blue, t: last.t };
        assert!(verify_edges(&fields(), &edges).findings.contains(&broken));
    }
}

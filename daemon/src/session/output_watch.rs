//! What is said of the panel and the lasers while the loop runs.

use holod_calibration::TimeNs;
use holod_calibration::rig::{PanelMode, RATE_TOLERANCE, Rig};
use holod_slm_output::PanelEvent;
use holod_slm_output::laser::DarkReason;
use holod_slm_output::output::FieldEvent;
use holod_slm_output::present::{PanelFault, TimestampSource};

/// How long the panel's rate is watched before it is judged.
const RATE_WATCHED: TimeNs = TimeNs(1_000_000_000);
/// Fields are judged together that came within so long.
const JUDGED: TimeNs = TimeNs(3_000_000_000);
/// At most one line in this time says that lasers went dark: lasers that flicker must not flood the log.
const DARK_EVERY: TimeNs = TimeNs(1_000_000_000);

/// Follows panel and lasers, and says in the log what changes.
pub(super) struct OutputWatch {
    events: rtrb::Consumer<PanelEvent>,
    /// Refreshes a second that the rig names.
    nominal_hz: f64,
    mode: PanelMode,
    /// Lasers are lit for single fields, at the times that the rig's window says.
    gates_fields: bool,
    lost: Option<PanelFault>,
    /// Whether software's times are good enough to light lasers by.
    takes_software_times: bool,
    /// Whether the times of the last field were such that lasers are lit by them, which others' rate says nothing of.
    are_times_good: bool,
    /// Since when the rate has been off.
    off_rate: Option<TimeNs>,
    has_said_rate: bool,
    fields: FieldsSeen,
    /// Why most fields were dark that were judged last, where they were, and whether all of them.
    trouble: Option<(DarkReason, bool)>,
    /// Of what that has been said.
    said: Vec<DarkReason>,
    t_next_dark_line: TimeNs,
}

impl OutputWatch {
    pub(super) fn new(events: rtrb::Consumer<PanelEvent>, rig: &Rig, takes_software_times: bool) -> Self {
        Self {
            events,
            nominal_hz: rig.panel.refresh_hz,
            mode: rig.panel.mode,
            gates_fields: rig.lasers.driver.gates_fields(),
            lost: None,
            takes_software_times,
            are_times_good: false,
            off_rate: None,
            has_said_rate: false,
            fields: FieldsSeen::default(),
            trouble: None,
            said: Vec::new(),
            t_next_dark_line: TimeNs(i64::MIN),
        }
    }

    /// Why the panel is lost now, if it is.
    pub(super) fn lost(&self) -> Option<PanelFault> {
        self.lost
    }

    /// Takes note of everything that the panel's thread has said.
    pub(super) fn drain(&mut self) {
        while let Ok(event) = self.events.pop() {
            match event {
                PanelEvent::Lost { fault, .. } => {
                    tracing::error!("the panel is lost, lasers dark: {fault}");
                    (self.fields, self.trouble) = (FieldsSeen::default(), None);
                    self.lost = Some(fault);
                }
                PanelEvent::Back { .. } => {
                    tracing::info!("the panel is back");
                    self.lost = None;
                    (self.off_rate, self.has_said_rate) = (None, false);
                    self.said.clear();
                }
            }
        }
    }

    /// What to say, once until the panel is lost and back, where its rate is not the rig's.
    pub(super) fn judge_rate(&mut self, refresh_hz: f64, now: TimeNs) -> Option<String> {
        let off = refresh_hz > 0.0 && (refresh_hz / self.nominal_hz - 1.0).abs() > RATE_TOLERANCE;
        if !off || !self.are_times_good || self.lost.is_some() {
            self.off_rate = None;
            return None;
        }
        let since = *self.off_rate.get_or_insert(now);
        if self.has_said_rate || now - since < RATE_WATCHED {
            return None;
        }
        self.has_said_rate = true;
        Some(format!(
            "the panel refreshes at {refresh_hz:.2} Hz, the rig says {} Hz: its fields are not as long as the lasers' \
             windows suppose, so lasers stay dark; set the panel's mode to the rig's rate, or correct panel.refresh_hz",
            self.nominal_hz
        ))
    }

    /// Takes note of a field that is over. What to say, once until the panel is lost and back, where most fields stay
    /// dark for a reason that nobody asked for.
    pub(super) fn judge_field(&mut self, field: &FieldEvent) -> Option<String> {
        self.are_times_good = match field.timestamp_source {
            TimestampSource::Hardware | TimestampSource::Driver | TimestampSource::External => true,
            TimestampSource::Software => self.takes_software_times,
            TimestampSource::Estimated => false,
        };
        let since = *self.fields.since.get_or_insert(field.t_present);
        self.fields.note(field);
        if field.t_present - since < JUDGED {
            return None;
        }
        let seen = std::mem::take(&mut self.fields);
        self.trouble = seen.trouble();
        let (reason, is_all) = self.trouble?;
        // What is said of the rate explains that.
        if reason == DarkReason::Untrusted && self.off_rate.is_some() || self.said.contains(&reason) {
            return None;
        }
        self.said.push(reason);
        Some(match reason {
            DarkReason::Untrusted if is_all => {
                let why = self.why_unbelieved(field.timestamp_source);
                format!("no report of the panel's refreshes is believed, so lasers stay dark: {why}")
            }
            DarkReason::Untrusted => {
                let why = self.why_unbelieved(field.timestamp_source);
                format!("few reports of the panel's refreshes are believed, so lasers flicker: {why}")
            }
            reason => {
                let fields = if is_all { "no field is lit" } else { "few fields are lit" };
                format!("{fields}: {reason} ({}){}", reason.meaning(), cure(reason))
            }
        })
    }

    fn why_unbelieved(&self, timestamp_source: TimestampSource) -> String {
        match timestamp_source {
            // No window of the rig's switches these lasers, so that none of its figures leaves more room.
            TimestampSource::Hardware | TimestampSource::Driver | TimestampSource::External if !self.gates_fields => {
                "their times scatter by more than 1/16 of a refresh; `holod check` says what an output is good for".into()
            }
            TimestampSource::Hardware | TimestampSource::Driver | TimestampSource::External => {
                let wire = match self.mode {
                    PanelMode::ChannelPacked => {
                        ", and a wire from the panel's sync output to the laser box (lasers.sync_wire) needs none"
                    }
                    PanelMode::FieldSequential | PanelMode::Monochrome(_) => "",
                };
                format!(
                    "their times scatter by more than the rig leaves room for; a longer lasers.on_delay_ms and a shorter \
                     lit_ms leave more{wire}"
                )
            }
            TimestampSource::Software | TimestampSource::Estimated => {
                "their times are software's, not the display's, or scatter; `holod check` says what an output is good for"
                    .into()
            }
        }
    }

    /// Why no field is lit though lasers may be, where that is so.
    pub(super) fn unlit(&self) -> Option<String> {
        let (reason, _) = self.trouble.filter(|(_, is_all)| *is_all)?;
        Some(format!("no field is lit: {reason} ({})", reason.meaning()))
    }

    /// The laser box went dark.
    pub(super) fn went_dark(&mut self, t: TimeNs, reason: DarkReason) {
        if t >= self.t_next_dark_line {
            tracing::info!("lasers dark: {reason} ({})", reason.meaning());
            self.t_next_dark_line = t + DARK_EVERY;
        }
    }
}

/// What became of the fields of some seconds.
#[derive(Default)]
struct FieldsSeen {
    since: Option<TimeNs>,
    fields: usize,
    lit: usize,
    dark: [usize; DarkReason::ALL.len()],
}

impl FieldsSeen {
    fn note(&mut self, field: &FieldEvent) {
        self.fields += 1;
        match field.dark.filter(|_| field.laser_on.is_none()) {
            Some(reason) => self.dark[reason as usize] += 1,
            // Lasers that tell no edges among them.
            None => self.lit += 1,
        }
    }

    /// The commonest of the reasons for which more than half of the fields were dark; whether all fields were dark.
    fn trouble(&self) -> Option<(DarkReason, bool)> {
        // The other reasons are what somebody asked for, or are told elsewhere.
        const TROUBLE: [DarkReason; 8] = [
            DarkReason::Untrusted,
            DarkReason::Late,
            DarkReason::ClockUnsure,
            DarkReason::MissingReport,
            DarkReason::WrongColour,
            DarkReason::Heartbeat,
            DarkReason::SyncLost,
            DarkReason::SyncRate,
        ];
        let of = |reason: DarkReason| self.dark[reason as usize];
        // A colour waits for the others only where those are dark.
        let dark: usize = TROUBLE.into_iter().chain([DarkReason::Balance]).map(of).sum();
        let commonest = TROUBLE.into_iter().max_by_key(|reason| of(*reason)).filter(|reason| of(*reason) > 0)?;
        (2 * dark > self.fields).then_some((commonest, self.lit == 0))
    }
}

/// What helps against it, as the end of a sentence.
const fn cure(reason: DarkReason) -> &'static str {
    match reason {
        DarkReason::ClockUnsure => {
            "; the line to the laser box takes too long there and back, which `holod check` measures: USB CDC, or an \
             adapter whose latency_timer is 1 (deploy/udev/60-holod-latency.rules), or in channel-packed mode a wire \
             from the panel's sync output to the box (lasers.sync_wire)"
        }
        DarkReason::Late => {
            "; `holod check` measures the line; a compositor may report its refreshes one later (--output \
             drm:CONNECTOR does not), and a longer lit_ms leaves more time"
        }
        _ => "",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use holod_calibration::Colour;

    fn watch() -> OutputWatch {
        OutputWatch::new(rtrb::RingBuffer::new(1).1, &Rig::default(), false)
    }

    /// The field of this number, of 180 a second.
    fn field(index: i64, timestamp_source: TimestampSource, dark: Option<DarkReason>) -> FieldEvent {
        let t_present = TimeNs(index * 5_555_556);
        FieldEvent {
            frame_id: index as u64 / 3,
            field: index as usize % 3,
            colour: Colour::ALL[index as usize % 3],
            t_submit: TimeNs(0),
            t_desired_present: TimeNs(0),
            t_present,
            t_settled: t_present,
            t_end: t_present,
            timestamp_source,
            laser_on: dark.is_none().then_some(t_present),
            laser_off: dark.is_none().then_some(t_present),
            dark,
            repeated: false,
            deadline_missed: false,
        }
    }

    /// What is said of the fields of a minute, each dark as `dark` says of its number.
    fn said(watch: &mut OutputWatch, minute: i64, dark: impl Fn(i64) -> Option<DarkReason>) -> Vec<String> {
        let fields = 60 * 180 * minute..60 * 180 * (minute + 1);
        fields.filter_map(|index| watch.judge_field(&field(index, TimestampSource::Hardware, dark(index)))).collect()
    }

    #[test]
    fn another_rate_is_told_once_and_only_of_times_by_which_lasers_are_lit() {
        for (timestamp_source, takes_software_times, told) in [
            (TimestampSource::Driver, false, 1),
            (TimestampSource::Software, false, 0),
            (TimestampSource::Software, true, 1),
        ] {
            let mut watch = OutputWatch { takes_software_times, ..watch() };
            watch.judge_field(&field(0, timestamp_source, Some(DarkReason::Untrusted)));
            // A rate that crosses the tolerance again and again, as measured.
            let rates = (0..60).map(|second| if second % 6 == 5 { 60.0 } else { 58.3 + 0.1 * f64::from(second % 3) });
            let said = rates.zip(0..).filter_map(|(hz, second)| watch.judge_rate(hz, TimeNs(second * 1_000_000_000)));
            let said: Vec<_> = said.collect();
            assert_eq!(said.len(), told, "{said:?}");
            assert!(said.iter().all(|words| words.contains("the rig says 60 Hz")), "{said:?}");
        }
    }

    #[test]
    fn fields_that_stay_dark_are_told_once_by_the_commonest_reason() {
        for (reason, words) in [
            (DarkReason::ClockUnsure, "no field is lit: clock-unsure (how the box's clock"),
            (DarkReason::Late, "no field is lit: late (the report of a field, or the order"),
            (DarkReason::Untrusted, "no report of the panel's refreshes is believed, so lasers stay dark: their times"),
        ] {
            let mut watch = watch();
            let told = said(&mut watch, 0, |index| Some(if index % 3 == 0 { DarkReason::Balance } else { reason }));
            assert!(matches!(&told[..], [told] if told.starts_with(words)), "{told:?}");
            assert!(watch.unlit().unwrap().starts_with(&format!("no field is lit: {reason} (")));
            assert_eq!(said(&mut watch, 1, |_| None), [""; 0]);
            assert_eq!(watch.unlit(), None);
        }
    }

    #[test]
    fn a_sync_wire_and_a_window_are_named_only_where_they_do_something() {
        for (mode, named) in [(PanelMode::ChannelPacked, true), (PanelMode::FieldSequential, false)] {
            let mut watch = OutputWatch { mode, ..watch() };
            let [told] = said(&mut watch, 0, |_| Some(DarkReason::Untrusted)).try_into().unwrap();
            assert_eq!(told.contains("sync_wire"), named, "{told}");
            assert!(told.contains("on_delay_ms") && told.contains("lit_ms"), "{told}");
        }
        let mut watch = OutputWatch { gates_fields: false, ..watch() };
        let [told] = said(&mut watch, 0, |_| Some(DarkReason::Untrusted)).try_into().unwrap();
        assert!(!told.contains("_ms") && !told.contains("sync_wire"), "no key of a window: {told}");
    }

    #[test]
    fn lasers_that_flicker_are_told_and_some_dark_fields_are_not() {
        // As of reports that scatter just at the tolerance: one field in five is lit, at times.
        let flickers = |index: i64| (index % 50 >= 10).then_some(DarkReason::Untrusted);
        let mut watch = watch();
        let told = said(&mut watch, 0, flickers);
        assert!(matches!(&told[..], [told] if told.starts_with("few reports of the panel's refreshes")), "{told:?}");
        assert_eq!(watch.unlit(), None);
        assert_eq!(said(&mut watch, 1, |index| (index % 50 >= 30).then_some(DarkReason::Late)), [""; 0]);
    }

    #[test]
    fn darkness_that_was_asked_for_is_no_trouble() {
        for reason in
            [DarkReason::Asked, DarkReason::NoPicture, DarkReason::Sleep, DarkReason::ByHand, DarkReason::Stall]
        {
            let mut watch = watch();
            assert_eq!(said(&mut watch, 0, |_| Some(reason)), [""; 0]);
            assert_eq!(watch.unlit(), None);
        }
    }
}

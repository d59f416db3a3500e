//! A test pattern on the panel.

use std::fmt;
use std::time::Duration;

use holod_calibration::rig::{LaserDriver, Rig};
use holod_calibration::{Colour, PerColour, TimeNs};
use holod_pupil_input::host_now;
use holod_slm_output::laser::{BoxEvent, DarkReason, open_laser};
use holod_slm_output::output::{OutputError, pacing_config};
use holod_slm_output::patterns::Placement;
use holod_slm_output::present::{PanelSetup, open_panel};
use holod_slm_output::{
    FieldEvent, FramePlan, FramePort, LevelsFrame, Output, OutputControl, OutputOptions, OutputSpec, Pacer,
    PanelEncoder, PanelEvent,
};
use rtrb::Consumer;
use serde::{Serialize, Serializer};

use crate::cli::PatternTarget;
use crate::dark_note::DarkNote;
use crate::failure::{Exit, Failure};
use crate::session::{LaserBoxWatch, NO_ACKNOWLEDGEMENT, PANEL_HANGS, Signals, SleepWatch, not_dark};
use crate::setup;

/// Time that a frame may take before it has been measured.
const FIRST_COPY: TimeNs = TimeNs(5_000_000);
/// Signals and the end of the asked time are seen within this.
const LONGEST_SLEEP: TimeNs = TimeNs(20_000_000);

/// What came of showing a pattern.
#[derive(Default, Serialize)]
pub(super) struct Shown {
    ended_by: String,
    duration_s: f64,
    refresh_hz: f64,
    #[serde(serialize_with = "by_colour")]
    fields: PerColour<u64>,
    #[serde(serialize_with = "by_colour")]
    lit: PerColour<u64>,
    /// Fields of lasers that are simply on while their box is armed.
    #[serde(serialize_with = "by_colour")]
    not_told: PerColour<u64>,
    #[serde(skip)]
    has_power: PerColour<bool>,
    /// Why the last field that was not lit was not.
    #[serde(serialize_with = "in_words")]
    dark: Option<DarkReason>,
    /// Windows that the laser box heard of after their beginning.
    lit_in_part: u64,
    pub(super) lasers_dark: bool,
    flat_presented: bool,
}

/// The rig without the light of the colours that `placement` leaves flat: theirs would all be in the middle, on top of
/// what is to be looked at.
pub(super) fn rig_with_lasers_of(mut rig: Rig, placement: &Placement) -> Rig {
    for colour in Colour::ALL.into_iter().filter(|&colour| !placement.colours[colour]) {
        rig.lasers.power_mw[colour] = 0.0;
    }
    rig
}

fn by_colour<S: Serializer>(counts: &PerColour<u64>, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_map(counts.iter().map(|(colour, count)| (colour.name(), count)))
}

fn in_words<S: Serializer>(reason: &Option<DarkReason>, serializer: S) -> Result<S::Ok, S::Error> {
    reason.map(|reason| reason.to_string()).serialize(serializer)
}

/// Shows `levels` on the panel that `spec` names until the asked time is over or a signal comes; lasers are dark when
/// it returns. Each colour frame is submitted anew, so that lasers go dark where this program stalls.
pub(super) fn show(
    spec: &OutputSpec,
    rig: &Rig,
    encoder: &PanelEncoder,
    levels: &LevelsFrame,
    to: &PatternTarget,
) -> Result<Shown, Failure> {
    let mut signals = Signals::install(None)?;
    let pacing = pacing_config(rig, FIRST_COPY).map_err(Failure::because(Exit::Config))?;
    let output = open(spec, rig, encoder).map_err(Failure::because(Exit::Unavailable))?;
    signals.end_after_lasers(&rig.lasers.driver);
    let laser_box = LaserBoxWatch::new(output.laser_faults, output.laser_watch);
    let switch = output.control.dark_switch();
    switch.install_panic_hook(host_now, || false);
    let if_noted = "where they may be lit, start holod and `holod ctl lasers arm`, or take that file away";
    let noted = DarkNote::on(&rig.lasers.driver).look().why_dark(if_noted, "");
    if let Some(why) = noted.as_ref().filter(|_| !to.dark) {
        tracing::warn!("{why}");
    }
    let is_dark = to.dark || noted.is_some();
    if is_dark {
        switch.dark(DarkReason::Asked);
    } else if rig.lasers.driver != LaserDriver::Simulated && !matches!(spec, OutputSpec::Headless(_)) {
        tracing::warn!(
            "lasers will be lit: an eye in the display may get all of their light in one spot; use a camera"
        );
    }
    let sleep = SleepWatch::begin(&rig.lasers.driver);
    sleep.may_be_lit(!is_dark);
    let planes = Colour::ALL.map(|colour| levels.unpack_colour(colour).levels);
    let t_begin = host_now();
    let mut pacer = Pacer::new(pacing, t_begin);
    let mut bench = Bench {
        frames: output.frames,
        fields: output.events,
        box_events: output.box_events,
        panel_events: output.panel_events,
        control: output.control,
        laser_box,
        signals,
        sleep,
        is_dark,
        t_begin,
        duration: to.duration.map(|duration| TimeNs(i64::try_from(duration.as_nanos()).unwrap_or(i64::MAX))),
    };
    let has_power = rig.lasers.power_mw.map(|power_mw| power_mw > 0.0);
    let mut shown = Shown { has_power, ..Shown::default() };
    let ended = loop {
        let plan = pacer.predict(host_now());
        if let Some(ended) = bench.wait_until(plan.t_wake) {
            break ended;
        }
        bench.submit(&plan, &planes, &mut pacer);
        if let Err(failed) = bench.drain(&mut shown) {
            break Err(failed);
        }
    };
    bench.end(shown, ended)
}

/// Panel and lasers while a pattern is shown, and what may end that.
struct Bench {
    frames: FramePort,
    fields: Consumer<FieldEvent>,
    box_events: Consumer<BoxEvent>,
    panel_events: Consumer<PanelEvent>,
    control: OutputControl,
    laser_box: LaserBoxWatch,
    signals: Signals,
    sleep: SleepWatch,
    /// A person wants no light.
    is_dark: bool,
    t_begin: TimeNs,
    /// The asked time, from `t_begin` on.
    duration: Option<TimeNs>,
}

impl Bench {
    /// Waits until host time `t_wake`. Where something ends it all before: what.
    fn wait_until(&mut self, t_wake: TimeNs) -> Option<Result<String, Failure>> {
        let switch = self.control.dark_switch();
        loop {
            let now = host_now();
            self.signals.tell_of_suspension();
            if self.sleep.look() {
                let wish = self.is_dark.then_some(DarkReason::Asked).or(self.sleep.keeps_dark());
                self.sleep.told(wish, self.control.keep_dark(wish));
            }
            if let Some(signal) = self.signals.caught() {
                return Some(Ok(signal.to_owned()));
            }
            if switch.reason() == Some(DarkReason::Panic) {
                switch.wait_for_panic_message(host_now);
                return Some(Err(Failure::new(Exit::Software, "a thread failed (its message stands above)")));
            }
            if self.duration.is_some_and(|duration| now - self.t_begin >= duration) {
                return Some(Ok("the asked duration".to_owned()));
            }
            if now >= t_wake {
                return None;
            }
            let sleep = (t_wake - now).min(LONGEST_SLEEP);
            std::thread::sleep(Duration::from_nanos(sleep.0 as u64));
        }
    }

    fn submit(&mut self, plan: &FramePlan, planes: &[Vec<u16>], pacer: &mut Pacer) {
        let frame = self.frames.acquire();
        for colour in Colour::ALL {
            frame.field_mut(colour).write(&planes[colour.index()]);
        }
        let now = host_now();
        self.frames.submit(plan, None, now);
        pacer.submitted(plan.frame_id, now);
        self.frames.feed(pacer, |_| ());
    }

    /// Takes note of what panel and lasers did; a panel that is lost for good ends it all.
    fn drain(&mut self, shown: &mut Shown) -> Result<(), Failure> {
        while let Ok(field) = self.fields.pop() {
            shown.fields[field.colour] += 1;
            shown.lit[field.colour] += u64::from(field.laser_on.is_some());
            shown.not_told[field.colour] += u64::from(field.laser_on.is_none() && field.dark.is_none());
            shown.dark = field.dark.or(shown.dark);
        }
        while self.box_events.pop().is_ok() {}
        self.laser_box.drain(self.control.counts().armed, host_now());
        while let Ok(event) = self.panel_events.pop() {
            match event {
                PanelEvent::Lost { fault, .. } if fault.is_recoverable() => {
                    tracing::error!("the panel is lost, lasers dark: {fault}");
                }
                PanelEvent::Lost { fault, .. } => {
                    return Err(Failure::new(Exit::Unavailable, format!("the panel: {fault}")));
                }
                PanelEvent::Back { .. } => tracing::info!("the panel is back"),
            }
        }
        Ok(())
    }

    /// Puts the lasers out and ends the output.
    fn end(mut self, mut shown: Shown, ended: Result<String, Failure>) -> Result<Shown, Failure> {
        shown.duration_s = (host_now() - self.t_begin).seconds();
        let counts = self.control.counts();
        (shown.refresh_hz, shown.lit_in_part) = (counts.refresh_hz, counts.lit_in_part);
        self.signals.lasers_go_out();
        let down = self.control.shutdown();
        self.signals.lasers_are_out();
        self.laser_box.drain(false, host_now());
        if !down.panel_ended {
            tracing::error!("{PANEL_HANGS}");
        }
        if ended.is_err() && !down.lasers_dark {
            tracing::error!("{}", not_dark(self.laser_box.trouble().unwrap_or(NO_ACKNOWLEDGEMENT)));
        }
        shown.ended_by = ended?;
        (shown.lasers_dark, shown.flat_presented) = (down.lasers_dark, down.flat_presented);
        Ok(shown)
    }
}

fn open(spec: &OutputSpec, rig: &Rig, encoder: &PanelEncoder) -> Result<Output, OutputError> {
    let panel = open_panel(spec, &PanelSetup::new(&rig.panel, encoder), host_now())?;
    setup::warn_of_link(&*panel);
    let laser = open_laser(&rig.lasers, host_now)?;
    let options = OutputOptions::default();
    let stall_timeout = rig.lasers.stall_timeout.unwrap_or(options.stall_timeout);
    Output::start(rig, encoder, panel, laser, OutputOptions { stall_timeout, ..options }, host_now)
}

impl fmt::Display for Shown {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "shown for {:.1} s at {:.3} video frames a second, ended by {}",
            self.duration_s, self.refresh_hz, self.ended_by
        )?;
        for (colour, fields) in self.fields.iter().filter(|(_, fields)| **fields > 0) {
            match self.not_told[colour] {
                _ if !self.has_power[colour] => writeln!(f, "{colour}: {fields} fields, its laser without power")?,
                0 => writeln!(f, "{colour}: {fields} fields, {} of them lit", self.lit[colour])?,
                on => writeln!(f, "{colour}: {fields} fields, its laser on in {on} of them as far as it was told")?,
            }
        }
        if self.lit_in_part > 0 {
            writeln!(
                f,
                "lit in part: {} windows, of which the laser box heard after their beginning",
                self.lit_in_part
            )?;
        }
        if let Some(reason) = self.dark {
            writeln!(f, "not lit, last: {reason}")?;
        }
        write!(f, "lasers dark at the end: {}; flat pattern on the panel: {}", self.lasers_dark, self.flat_presented)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lasers_of_colours_that_are_not_named_have_no_power() {
        let rig = Rig::default();
        let lit = |colours: &[Colour]| {
            rig_with_lasers_of(rig.clone(), &Placement::new([0.0; 2], colours)).lasers.power_mw.map(|mw| mw > 0.0)
        };
        assert_eq!(lit(&[Colour::Green]), PerColour([false, true, false]));
        assert_eq!(lit(&[]), PerColour([true; 3]));
    }
}

//! What a decision over a field costs, and how evenly heartbeats go to the laser box:
//! `cargo run --release -p holod-slm-output --example schedule_speed`
//!
//! The second figure is that of the real threads on a virtual panel at 180 fields a second, at normal priority. A
//! heartbeat follows each field; its jitter is how far the time from one to the next is off the field's period.

use std::io::Write;
use std::sync::mpsc::{Sender, channel};
use std::time::{Duration, Instant};

use holod_calibration::rig::{PanelMode, Rig};
use holod_calibration::{Resolution, TimeNs, host_now};
use holod_slm_output::fields::FrameTag;
use holod_slm_output::laser::{BoxEvent, Capability, DarkReason, LaserBox, LaserError, LaserProgram, LitWindow};
use holod_slm_output::output::{Output, OutputOptions, pacing_config};
use holod_slm_output::present::{PanelSetup, PresentedRefresh, open_panel};
use holod_slm_output::schedule::{Evidence, FieldScheduler, WindowClock};
use holod_slm_output::{FrameLayout, Pacer, PanelEncoder, TimestampSource};

const SIZE: Resolution = Resolution { width: 8, height: 8 };
const REFRESHES: i64 = 1_000_000;

fn main() -> std::io::Result<()> {
    let mut out = std::io::stdout().lock();
    for mode in [PanelMode::ChannelPacked, PanelMode::FieldSequential] {
        let mut rig = Rig::default();
        rig.panel.mode = mode;
        rig.panel.refresh_hz = if mode == PanelMode::ChannelPacked { 60.0 } else { 180.0 };
        let (lit, each_ns) = decisions(&rig);
        writeln!(out, "{}: {each_ns:.0} ns a field ({lit} of {REFRESHES} refreshes armed)", mode.name())?;
    }
    let mut intervals_us = heartbeat_jitter();
    intervals_us.sort_by(f64::total_cmp);
    let at = |share: f64| intervals_us[((intervals_us.len() - 1) as f64 * share) as usize];
    writeln!(
        out,
        "heartbeat jitter over {} fields: median {:.0} µs, p99 {:.0} µs, max {:.0} µs",
        intervals_us.len(),
        at(0.5),
        at(0.99),
        at(1.0)
    )
}

/// Refreshes at which lasers were armed, and the time of one field's decision.
fn decisions(rig: &Rig) -> (i64, f64) {
    let layout = FrameLayout::new(&rig.panel, SIZE);
    let stall_timeout = TimeNs(2_000_000_000);
    let (evidence, clock) = (Evidence::Stamped, WindowClock::Reports);
    let mut scheduler =
        FieldScheduler::new(&rig.panel, layout, &rig.lasers, evidence, clock, stall_timeout).expect("the rig is sound");
    let period_ns = scheduler.gate().timing().refresh_period.0;
    let mut armed = 0;
    let mut fields = 0;
    let began = Instant::now();
    for index in 0..REFRESHES {
        let t_present = TimeNs((1 + index) * period_ns);
        let refresh = PresentedRefresh {
            frame: Some(FrameTag { frame_id: 1 + index as u64, ..FrameTag::default() }),
            field: index as usize % layout.refreshes() * layout.fields_per_refresh(),
            repeated: false,
            t_present,
            timestamp_source: TimestampSource::Hardware,
            refresh_count: Some(index as u64),
        };
        scheduler.on_refresh(&refresh);
        while let Some(decision) = std::hint::black_box(scheduler.next_field(t_present + TimeNs(period_ns - 1))) {
            fields += 1;
            let _orders = std::hint::black_box(decision);
        }
        armed += i64::from(scheduler.is_armed());
    }
    (armed, began.elapsed().as_nanos() as f64 / f64::from(fields))
}

/// A box without lasers that notes when it hears a heartbeat.
struct Listener(Sender<TimeNs>);

impl LaserBox for Listener {
    fn capability(&self) -> Capability {
        Capability { simulated: true, gates_fields: true, has_heartbeat: true, sync_wire: false }
    }
    fn program(&mut self, _: &LaserProgram, _: TimeNs) -> Result<(), LaserError> {
        Ok(())
    }
    fn arm(&mut self, _: TimeNs) -> Result<(), LaserError> {
        Ok(())
    }
    fn sync(&mut self, _: TimeNs, _: TimeNs) -> Result<Option<DarkReason>, LaserError> {
        Ok(None)
    }
    fn light(&mut self, _: LitWindow, _: TimeNs) -> Result<Option<DarkReason>, LaserError> {
        Ok(None)
    }
    fn heartbeat(&mut self, _: TimeNs) -> Result<(), LaserError> {
        let _nobody_listens = self.0.send(host_now());
        Ok(())
    }
    fn dark(&mut self, _: DarkReason, _: TimeNs) -> Result<(), LaserError> {
        Ok(())
    }
    fn poll(&mut self, _: TimeNs, _: &mut dyn FnMut(BoxEvent)) -> Result<(), LaserError> {
        Ok(())
    }
}

/// How far each interval between heartbeats is off the field's period, microseconds.
fn heartbeat_jitter() -> Vec<f64> {
    let mut rig = Rig::default();
    rig.panel.mode = PanelMode::FieldSequential;
    rig.panel.refresh_hz = 180.0;
    let encoder = PanelEncoder::new(&rig.panel, SIZE, SIZE).expect("the rig is sound");
    let setup = PanelSetup::new(&rig.panel, &encoder);
    let panel = open_panel(&"headless".parse().expect("a spec"), &setup, host_now()).expect("a virtual panel");
    let (heard, heartbeats) = channel();
    let options = OutputOptions::default();
    let output = Output::start(&rig, &encoder, panel, Box::new(Listener(heard)), options, host_now);
    let mut output = output.expect("threads start");
    let mut pacer = Pacer::new(pacing_config(&rig, TimeNs(1_000_000)).expect("a rig"), host_now());
    let began = Instant::now();
    while began.elapsed() < Duration::from_secs(10) {
        output.frames.feed(&mut pacer, |_| ());
        let plan = pacer.predict(host_now());
        std::thread::sleep(Duration::from_nanos((plan.t_wake - host_now()).0.max(0) as u64));
        output.frames.submit(&plan, None, host_now());
        while output.events.pop().is_ok() {}
    }
    output.control.shutdown();
    let times: Vec<TimeNs> = heartbeats.iter().collect();
    let period_us = rig.panel.field_period().0 as f64 / 1e3;
    times.windows(2).map(|pair| ((pair[1] - pair[0]).0 as f64 / 1e3 - period_us).abs()).collect()
}

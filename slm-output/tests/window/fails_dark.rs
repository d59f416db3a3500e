//! Whatever happens to the window, the lasers go dark: the real threads, and a laser box on a terminal with a log of
//! its own.
//!
//! No display server here scans a window out directly, so none stamps a time that a laser may be lit by. A decorator
//! passes the times of copies off as stamped ones; all else is what a bench runs.

use std::fs::{self, File};
use std::os::fd::BorrowedFd;
use std::sync::mpsc;
use std::time::Duration;

use holod_calibration::rig::{LaserDriver, PanelMode, Rig};
use holod_calibration::{PerColour, TimeNs, host_now};
use holod_slm_output::laser::edge_log::read_log;
use holod_slm_output::laser::simulator::{SimulatedBox, SimulatedTerminal};
use holod_slm_output::laser::{BoxEvent, open_laser};
use holod_slm_output::output::{Output, OutputOptions, pacing_config};
use holod_slm_output::pacing::Pacer;
use holod_slm_output::present::window::{DisplayServer, Road, WindowPanel};
use holod_slm_output::present::{FrameSource, PanelFault, PanelSetup, PresentedRefresh, Presenter, TimestampSource};
use holod_slm_output::{LevelsFrame, PanelEncoder};

use super::bench::{SIZE, named, panel};
use super::x11::cover;
use super::x11_server::{Desktop, PANEL};

/// Longest time from a fault to darkness: the box's own timeout, and what a machine under load adds to it.
const DARK_WITHIN: TimeNs = TimeNs(130_000_000);

/// So long after the fault nothing may light again.
const WATCHED: TimeNs = TimeNs(1_000_000_000);

/// A panel whose times pass for the driver's.
struct Stamped(WindowPanel);

impl Presenter for Stamped {
    fn is_virtual(&self) -> bool {
        self.0.is_virtual()
    }

    fn wake_fd(&self) -> Option<BorrowedFd<'_>> {
        self.0.wake_fd()
    }

    fn t_next(&self) -> TimeNs {
        self.0.t_next()
    }

    fn tick(
        &mut self,
        now: TimeNs,
        frames: &mut FrameSource,
        presented: &mut dyn FnMut(PresentedRefresh),
    ) -> Result<(), PanelFault> {
        self.0.tick(now, frames, &mut |refresh| {
            presented(PresentedRefresh { timestamp_source: TimestampSource::Driver, ..refresh });
        })
    }

    fn show_flat(&mut self) {
        self.0.show_flat();
    }

    fn recover(&mut self, now: TimeNs) -> Result<(), PanelFault> {
        self.0.recover(now)
    }

    fn shown(&self) -> Option<&LevelsFrame> {
        self.0.shown()
    }
}

/// Lights lasers over a window on an X server, lets `strike` happen, and reads how long after it the box was dark; what
/// `lasts` must not be lit again, what does not is taken back by the rules.
fn dark_after(server: DisplayServer, lasts: bool, strike: impl FnOnce()) -> TimeNs {
    let folder = tempfile::tempdir().unwrap();
    let terminal = SimulatedTerminal::open().unwrap();
    let mut rig = Rig { panel: panel(PanelMode::ChannelPacked), ..Rig::default() };
    // Copies come up to a millisecond off the rhythm; the windows leave room for that.
    (rig.panel.settle, rig.lasers.on_delay, rig.lasers.width) = (TimeNs(500_000), TimeNs(2_000_000), TimeNs(1_000_000));
    rig.lasers.driver = LaserDriver::Serial { path: terminal.path().to_owned(), sync_wire: false };
    let log = File::create(folder.path().join("box.csv")).unwrap();
    std::thread::spawn(move || {
        terminal.serve(SimulatedBox::new(host_now()), log, &std::sync::Arc::default(), host_now)
    });
    let events = || read_log(&fs::read_to_string(folder.path().join("box.csv")).unwrap()).unwrap();

    let encoder = PanelEncoder::new(&rig.panel, SIZE, SIZE).unwrap();
    let setup = PanelSetup::new(&rig.panel, &encoder);
    let window = WindowPanel::open(server, Road::Copies, &named(PANEL), &setup).unwrap();
    let laser = open_laser(&rig.lasers, host_now).unwrap();
    let options = OutputOptions::default();
    let mut output = Output::start(&rig, &encoder, Box::new(Stamped(window)), laser, options, host_now).unwrap();
    let mut pacer = Pacer::new(pacing_config(&rig, TimeNs(1_000_000)).unwrap(), host_now());
    let pattern = vec![1.0; SIZE.pixels()];
    let mut frame = || {
        output.frames.feed(&mut pacer, |_| ());
        let plan = pacer.predict(host_now());
        encoder.encode(PerColour([&pattern; 3]), output.frames.acquire());
        output.frames.submit(&plan, None, host_now());
        std::thread::sleep(Duration::from_millis(10));
    };
    let is_lit = |event: &&BoxEvent| matches!(event, BoxEvent::Edge(edge) if edge.on);
    let t_end = host_now() + TimeNs(30_000_000_000);
    while events().iter().filter(is_lit).count() < 60 {
        assert!(host_now() < t_end, "never lit: {:?} {:?}", output.control.counts(), events().last());
        frame();
    }
    let t_strike = host_now();
    strike();
    while host_now() < t_strike + WATCHED {
        frame();
    }
    let events = events();
    let state = |event: &&BoxEvent| matches!(event, BoxEvent::Armed { .. } | BoxEvent::Dark { .. });
    let before = events.iter().take_while(|event| time_of(event) <= t_strike).filter(state).last();
    let dark = events.iter().find_map(|event| match event {
        BoxEvent::Dark { t, .. } if *t > t_strike => Some(*t - t_strike),
        _ => None,
    });
    if lasts {
        let last = events.iter().rev().find(state);
        assert!(matches!(last, Some(BoxEvent::Dark { .. })), "not dark at the end: {:?}", events.last());
        let lit_last = events.iter().rev().find(|event| matches!(event, BoxEvent::Edge(_))).map(time_of).unwrap();
        return (lit_last - t_strike).max(TimeNs(0));
    }
    match before {
        // On a busy machine it may have been dark when the fault struck.
        Some(BoxEvent::Dark { .. }) => TimeNs(0),
        _ => dark.unwrap_or_else(|| panic!("not dark at all: {:?}", events.last())),
    }
}

fn time_of(event: &BoxEvent) -> TimeNs {
    match event {
        BoxEvent::Armed { t } | BoxEvent::Dark { t, .. } => *t,
        BoxEvent::Edge(edge) => edge.t,
    }
}

fn assert_dark_in_time(what: &str, dark_after: TimeNs) {
    eprintln!("{what}: dark after {:.1} ms", dark_after.seconds() * 1e3);
    assert!(dark_after < DARK_WITHIN, "{what}: dark after {} ms", dark_after.seconds() * 1e3);
}

#[test]
#[should_panic(expected = "not dark at the end")]
fn canary_a_window_that_nothing_happens_to_stays_lit() {
    // On a busy machine it may be dark just when it is looked at; three times in a row is no accident.
    for _ in 0..3 {
        let desktop = Desktop::with_two_monitors();
        dark_after(DisplayServer::X11(desktop.name.clone()), true, || ());
    }
}

#[test]
fn the_death_of_the_x_server_is_darkness() {
    let mut desktop = Desktop::with_two_monitors();
    let server = DisplayServer::X11(desktop.name.clone());
    assert_dark_in_time("X server killed", dark_after(server, true, || desktop.kill()));
}

#[test]
fn a_monitor_that_goes_and_a_window_that_is_covered_are_darkness() {
    let after = |lasts: bool, strike: fn(&Desktop)| {
        let desktop = Desktop::with_two_monitors();
        dark_after(DisplayServer::X11(desktop.name.clone()), lasts, || strike(&desktop))
    };
    assert_dark_in_time("monitor switched off", after(true, |desktop| desktop.switch_off(PANEL)));
    // The window is opened anew, above what covers it.
    assert_dark_in_time("window covered", after(false, |desktop| cover(desktop, false)));
}

/// What `work` comes to on a thread of its own, which is left to itself after `patience`.
fn within<T: Send + 'static>(patience: Duration, work: impl FnOnce() -> T + Send + 'static) -> Option<T> {
    let (done, result) = mpsc::channel();
    std::thread::spawn(move || done.send(work()));
    result.recv_timeout(patience).ok()
}

#[test]
fn an_x_server_that_hangs_keeps_no_output_from_its_end_and_opens_no_window() {
    let desktop = Desktop::with_two_monitors();
    let server = DisplayServer::X11(desktop.name.clone());
    let rig = Rig { panel: panel(PanelMode::ChannelPacked), ..Rig::default() };
    let encoder = PanelEncoder::new(&rig.panel, SIZE, SIZE).unwrap();
    let setup = PanelSetup::new(&rig.panel, &encoder);
    let start = || {
        let window = WindowPanel::open(server.clone(), Road::Copies, &named(PANEL), &setup).unwrap();
        let laser = open_laser(&rig.lasers, host_now).unwrap();
        Output::start(&rig, &encoder, Box::new(window), laser, OutputOptions::default(), host_now).unwrap()
    };
    let well = within(Duration::from_secs(30), {
        let output = start();
        move || output.control.shutdown()
    });
    let well = well.expect("it ends");
    assert!(well.panel_ended && well.flat_presented && well.lasers_dark);

    let output = start();
    desktop.suspend();
    // Its watcher has asked the server something by then, and the panel's thread has missed its refreshes.
    std::thread::sleep(Duration::from_secs(2));
    let down = within(Duration::from_secs(8), move || output.control.shutdown());
    let down = down.expect("the output ends beside a server that hangs");
    assert!(down.lasers_dark && !down.flat_presented);

    let opened = within(Duration::from_secs(20), {
        let setup = setup.clone();
        move || WindowPanel::open(server, Road::Copies, &named(PANEL), &setup).map(|_| ())
    });
    let refused = opened.expect("nobody waits for the server for ever").expect_err("no window").to_string();
    assert!(refused.contains("has not answered"), "{refused}");
}

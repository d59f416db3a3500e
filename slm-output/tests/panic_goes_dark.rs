//! A panic anywhere in the program makes the lasers dark. Alone in its process, since a panic hook is global.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use holod_calibration::rig::Rig;
use holod_calibration::{PerColour, Resolution, TimeNs, host_now};
use holod_slm_output::PanelEncoder;
use holod_slm_output::laser::{BoxEvent, DarkReason, open_laser};
use holod_slm_output::output::{Output, OutputOptions, pacing_config};
use holod_slm_output::pacing::Pacer;
use holod_slm_output::present::{PanelSetup, open_panel};

/// Whether a panic is one that is caught.
static IS_CAUGHT: AtomicBool = AtomicBool::new(false);
/// Whether a panic's message has been written.
static IS_TOLD: AtomicBool = AtomicBool::new(false);

#[test]
fn a_panic_in_any_thread_goes_dark_for_good() {
    let rig = Rig::default();
    let size = Resolution { width: 4, height: 2 };
    let encoder = PanelEncoder::new(&rig.panel, size, size).unwrap();
    let panel = open_panel(&"headless".parse().unwrap(), &PanelSetup::new(&rig.panel, &encoder), host_now());
    let laser = open_laser(&rig.lasers, host_now).unwrap();
    let mut output = Output::start(&rig, &encoder, panel.unwrap(), laser, OutputOptions::default(), host_now).unwrap();
    let switch = output.control.dark_switch();
    // A terminal that takes its time.
    std::panic::set_hook(Box::new(|_| {
        std::thread::sleep(Duration::from_millis(200));
        IS_TOLD.store(true, Ordering::Release);
    }));
    switch.install_panic_hook(host_now, || IS_CAUGHT.load(Ordering::Acquire));
    let mut pacer = Pacer::new(pacing_config(&rig, TimeNs(1_000_000)).unwrap(), host_now());
    let mut show = |frames: &mut holod_slm_output::FramePort| {
        encoder.encode(PerColour([&[1.0; 8]; 3]), frames.acquire());
        frames.submit(&pacer.predict(host_now()), None, host_now());
        std::thread::sleep(Duration::from_millis(20));
    };
    let t_end = host_now() + TimeNs(30_000_000_000);
    while !output.control.counts().armed {
        assert!(host_now() < t_end, "never armed");
        show(&mut output.frames);
    }
    assert!(!switch.is_dark());
    IS_CAUGHT.store(true, Ordering::Release);
    assert!(std::thread::spawn(|| panic!("caught")).join().is_err());
    IS_CAUGHT.store(false, Ordering::Release);
    show(&mut output.frames);
    assert!(!switch.is_dark() && switch.reason().is_none(), "a panic that is caught changes nothing");
    let panicked = std::thread::spawn(|| panic!("meant"));
    while switch.reason().is_none() {
        assert!(host_now() < t_end, "nobody is told");
        std::thread::sleep(Duration::from_millis(1));
    }
    switch.wait_for_panic_message(host_now);
    assert!(IS_TOLD.load(Ordering::Acquire), "whoever knows of a panic finds its message above");
    assert!(panicked.join().is_err());
    while !switch.is_dark() {
        assert!(host_now() < t_end, "never dark");
        std::thread::sleep(Duration::from_millis(1));
    }
    for _ in 0..5 {
        show(&mut output.frames);
    }
    assert!(!output.control.counts().armed);
    output.control.shutdown();
    let last = std::iter::from_fn(|| output.box_events.pop().ok()).last();
    assert!(matches!(last, Some(BoxEvent::Dark { reason: DarkReason::Panic, .. })), "{last:?}");
}

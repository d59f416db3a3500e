//! Under a real Wayland compositor.

use holod_calibration::rig::PanelMode;
use holod_calibration::{Colour, host_now};
use holod_slm_output::present::window::{DisplayServer, Road, WindowError};
use holod_slm_output::present::{AlterationKind, PanelFault, Presenter, WindowSpec};

use super::bench::{Bench, FLAT, SIZE, differences, expected, levels, named, packed};
use super::compositor::{Compositor, OTHER, PANEL};

fn open(compositor: &Compositor, spec: &WindowSpec, mode: PanelMode) -> Result<Bench, WindowError> {
    Bench::open(DisplayServer::Wayland(compositor.socket()), Road::Copies, spec, mode)
}

#[test]
fn the_pattern_is_on_the_panels_monitor_pixel_for_pixel_and_nowhere_else() {
    let compositor = Compositor::start();
    let before = compositor.picture(OTHER);
    let mut bench = open(&compositor, &named(PANEL), PanelMode::ChannelPacked).unwrap();
    let flat = vec![[FLAT as u8; 3]; SIZE.pixels()];
    assert_eq!(differences(&compositor.picture(PANEL), &flat), [], "the first picture is the flat pattern");
    for _ in 0..3 {
        let frame = bench.submit();
        bench.show(frame);
        let mut picture = compositor.picture(PANEL);
        assert_eq!(differences(&picture, &packed(frame)), []);
        assert_eq!(bench.panel.shown().map(|shown| shown.tag().frame_id), Some(frame));
        // Canary: one level that is off by one.
        picture[4 * 123_456 + 1] ^= 1;
        assert_eq!(differences(&picture, &packed(frame)), [123_456]);
    }
    assert!(compositor.picture(OTHER) == before, "nothing came on the other monitor");
}

#[test]
fn field_sequential_pictures_come_in_turn_each_in_all_channels() {
    let compositor = Compositor::start();
    let mut bench = open(&compositor, &named(PANEL), PanelMode::FieldSequential).unwrap();
    let frame = bench.submit();
    bench.show(frame);
    for _ in 0..6 {
        let shown = bench.run_for(1).unwrap()[0];
        let gray = levels(frame, [Colour::Green, Colour::Red, Colour::Blue][shown.field]);
        let picture = compositor.picture(PANEL);
        assert_eq!(differences(&picture, &expected([gray.clone(), gray.clone(), gray])), [], "field {}", shown.field);
    }
}

#[test]
fn a_compositor_knows_no_primary_monitor_so_that_the_panel_must_be_named() {
    let compositor = Compositor::start();
    let refused = |spec: &WindowSpec| open(&compositor, spec, PanelMode::ChannelPacked).err().unwrap().to_string();
    let unnamed = refused(&WindowSpec::default());
    assert!(unnamed.contains("name it") && unnamed.contains(PANEL), "{unnamed}");
    let other_size = refused(&named(OTHER));
    assert!(other_size.contains("800x600") && other_size.contains("640x480"), "{other_size}");
    let alone = Compositor::with_monitors(1);
    let only = open(&alone, &named(OTHER), PanelMode::ChannelPacked).err().unwrap().to_string();
    assert!(only.contains("is the only monitor"), "{only}");
}

const SCALED: PanelFault = PanelFault::Altered(AlterationKind::Scaled);

/// What somebody does to the desktop, in the compositor's words, the fault that it is, and what mends it, where opening
/// the window again does not.
const ATTACKS: &[(&str, PanelFault, Option<&str>)] = &[
    ("[app_id=holod] move container to output HEADLESS-1", PanelFault::WindowLost, None),
    ("[app_id=holod] fullscreen disable", PanelFault::WindowLost, None),
    ("[app_id=holod] kill", PanelFault::WindowLost, None),
    ("workspace 9 output HEADLESS-2, workspace 9", PanelFault::WindowLost, None),
    ("output HEADLESS-2 pos 900 0", PanelFault::WindowLost, None),
    (
        "output HEADLESS-2 mode --custom 800x600@60Hz",
        PanelFault::ModeRefused,
        Some("output HEADLESS-2 mode --custom 640x480@60Hz"),
    ),
    (
        "output HEADLESS-2 mode --custom 640x480@75Hz",
        PanelFault::ModeRefused,
        Some("output HEADLESS-2 mode --custom 640x480@60Hz"),
    ),
    ("output HEADLESS-2 scale 2", SCALED, Some("output HEADLESS-2 scale 1")),
    ("output HEADLESS-2 scale 1.25", SCALED, Some("output HEADLESS-2 scale 1")),
    (
        "output HEADLESS-2 transform 180",
        PanelFault::Altered(AlterationKind::Transformed),
        Some("output HEADLESS-2 transform normal"),
    ),
    ("output HEADLESS-2 pos 100 0", PanelFault::Altered(AlterationKind::Mirrored), Some("output HEADLESS-2 pos 800 0")),
];

#[test]
fn whatever_takes_the_window_off_its_monitor_is_a_fault_that_recovers() {
    let compositor = Compositor::start();
    let mut bench = open(&compositor, &named(PANEL), PanelMode::ChannelPacked).unwrap();
    for &(attack, fault, mend) in ATTACKS {
        eprintln!("{attack}");
        let frame = bench.submit();
        bench.show(frame);
        assert_eq!(differences(&compositor.picture(PANEL), &packed(frame)), [], "before: {attack}");
        compositor.ask(attack);
        let first = bench.fault();
        assert!(first == fault || first == PanelFault::WindowLost, "{attack}: {first}");
        if let Some(mend) = mend {
            assert_eq!(bench.panel.recover(host_now()), Err(fault), "{attack}: it is not mended yet");
            compositor.ask(mend);
        }
        bench.recover();
    }
    let frame = bench.submit();
    bench.show(frame);
    assert_eq!(differences(&compositor.picture(PANEL), &packed(frame)), []);
}

#[test]
fn a_compositor_that_dies_is_a_fault_and_its_successor_gets_the_window() {
    let mut compositor = Compositor::start();
    let mut bench = open(&compositor, &named(PANEL), PanelMode::ChannelPacked).unwrap();
    let frame = bench.submit();
    bench.show(frame);
    compositor.kill();
    assert_eq!(bench.fault(), PanelFault::WindowLost);
    assert!(bench.panel.recover(host_now()).is_err());
    compositor.restart();
    bench.recover();
    let frame = bench.submit();
    bench.show(frame);
    assert_eq!(differences(&compositor.picture(PANEL), &packed(frame)), []);
}

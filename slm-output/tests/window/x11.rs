//! Under a real X server: what the monitors show, pixel for pixel, and what happens when somebody moves the window, the
//! monitors or the server.

use holod_calibration::rig::{Panel, PanelMode, VideoMargins};
use holod_calibration::{Colour, Resolution, host_now};
use holod_slm_output::present::drm::Verdict;
use holod_slm_output::present::window::{DisplayServer, Road, WindowError};
use holod_slm_output::present::{AlterationKind, PanelFault, Presenter, TimestampSource, WindowSpec};

use super::bench::{Bench, FLAT, SIZE, differences, expected, levels, named, packed, panel, wait_until};
use super::x11_server::{Desktop, MAIN, MAIN_PLACE, PANEL, PANEL_PLACE, PANEL_SIZE};

fn open_by(road: Road, desktop: &Desktop, spec: &WindowSpec, mode: PanelMode) -> Result<Bench, WindowError> {
    Bench::open(DisplayServer::X11(desktop.name.clone()), road, spec, mode)
}

fn open(desktop: &Desktop, spec: &WindowSpec, mode: PanelMode) -> Result<Bench, WindowError> {
    open_by(Road::Copies, desktop, spec, mode)
}

/// Every way by which pictures get to the window.
const ROADS: &[Road] = &[
    Road::Copies,
    #[cfg(feature = "vulkan")]
    Road::Vulkan,
];

#[test]
fn the_pattern_is_on_the_panels_monitor_pixel_for_pixel_and_nowhere_else() {
    ROADS.iter().for_each(|&road| the_pattern_is_on_the_panels_monitor(road));
}

fn the_pattern_is_on_the_panels_monitor(road: Road) {
    let desktop = Desktop::with_two_monitors();
    let before = desktop.picture(MAIN_PLACE);
    let mut bench = open_by(road, &desktop, &named(PANEL), PanelMode::ChannelPacked).unwrap();
    let flat = vec![[FLAT as u8; 3]; SIZE.pixels()];
    assert_eq!(differences(&desktop.picture(PANEL_PLACE), &flat), [], "the first picture is the flat pattern");
    for _ in 0..3 {
        let frame = bench.submit();
        bench.show(frame);
        let mut picture = desktop.picture(PANEL_PLACE);
        assert_eq!(differences(&picture, &packed(frame)), []);
        assert_eq!(bench.panel.shown().map(|shown| shown.tag().frame_id), Some(frame));
        // Canary: one level that is off by one.
        picture[4 * 123_456 + 1] ^= 1;
        assert_eq!(differences(&picture, &packed(frame)), [123_456]);
    }
    assert!(desktop.picture(MAIN_PLACE) == before, "nothing came on the main monitor");
    bench.panel.show_flat();
    bench.run(|refresh| refresh.frame.is_none()).unwrap();
    bench.run_for(2).unwrap();
    assert_eq!(differences(&desktop.picture(PANEL_PLACE), &flat), []);
}

#[test]
fn a_panel_that_shows_a_part_of_its_video_frame_has_black_around_it() {
    let desktop = Desktop::with_two_monitors();
    let video_margins = VideoMargins { left: 8, right: 32, top: 3, bottom: 7 };
    let resolution = Resolution { width: SIZE.width - 40, height: SIZE.height - 10 };
    for &road in ROADS {
        let server = DisplayServer::X11(desktop.name.clone());
        let panel = Panel { video_margins, ..panel(PanelMode::ChannelPacked) };
        let bench = Bench::open_panel(server, road, &named(PANEL), panel, resolution).unwrap();
        let mut expected = vec![[0; 3]; SIZE.pixels()];
        for row in expected.chunks_mut(SIZE.width).skip(3).take(resolution.height) {
            row[8..8 + resolution.width].fill([FLAT as u8; 3]);
        }
        assert_eq!(differences(&desktop.picture(PANEL_PLACE), &expected), []);
        // Canary: a column further.
        expected.rotate_right(1);
        assert_ne!(differences(&desktop.picture(PANEL_PLACE), &expected), []);
        drop(bench);
    }
}

#[test]
fn refreshes_have_the_servers_times_which_a_copy_does_not_make_the_drivers() {
    let desktop = Desktop::with_two_monitors();
    let mut bench = open(&desktop, &named(PANEL), PanelMode::ChannelPacked).unwrap();
    bench.submit();
    let refreshes = bench.run_for(61).unwrap();
    assert!(refreshes.iter().all(|refresh| refresh.timestamp_source == TimestampSource::Software));
    let counts: Vec<_> = refreshes.iter().filter_map(|refresh| refresh.refresh_count).collect();
    assert_eq!(counts.len(), refreshes.len());
    assert!(counts.is_sorted_by(|a, b| a < b), "{counts:?}");
    let t_present = |index: usize| refreshes[index].t_present.0 as f64;
    let period_ns = (t_present(60) - t_present(0)) / (counts[60] - counts[0]) as f64;
    assert!((period_ns - 1e9 / 60.0).abs() < 0.05e9 / 60.0, "{period_ns}");
}

#[test]
fn field_sequential_pictures_come_in_turn_each_in_all_channels() {
    let desktop = Desktop::with_two_monitors();
    let mut bench = open(&desktop, &named(PANEL), PanelMode::FieldSequential).unwrap();
    let frame = bench.submit();
    bench.show(frame);
    let order = [Colour::Green, Colour::Red, Colour::Blue];
    for _ in 0..6 {
        let shown = bench.run_for(1).unwrap()[0];
        assert_eq!(shown.frame.map(|tag| tag.frame_id), Some(frame));
        let gray = levels(frame, order[shown.field]);
        let picture = desktop.picture(PANEL_PLACE);
        assert_eq!(differences(&picture, &expected([gray.clone(), gray.clone(), gray])), [], "field {}", shown.field);
    }
}

#[test]
fn monochrome_shows_the_one_colours_pattern() {
    let desktop = Desktop::with_two_monitors();
    let mut bench = open(&desktop, &named(PANEL), PanelMode::Monochrome(Colour::Blue)).unwrap();
    let frame = bench.submit();
    bench.show(frame);
    let gray = levels(frame, Colour::Blue);
    assert_eq!(differences(&desktop.picture(PANEL_PLACE), &expected([gray.clone(), gray.clone(), gray])), []);
}

#[test]
fn the_cursor_is_not_in_the_picture() {
    use x11rb::protocol::xfixes::ConnectionExt as _;
    use x11rb::protocol::xproto::ConnectionExt as _;
    let desktop = Desktop::with_two_monitors();
    let x = &desktop.x;
    x.xfixes_query_version(5, 0).unwrap().reply().unwrap();
    // An empty X server has no cursor until a window asks for one.
    let arrow = x11rb::connection::Connection::generate_id(x).unwrap();
    let font = x11rb::connection::Connection::generate_id(x).unwrap();
    x.open_font(font, b"cursor").unwrap();
    x.create_glyph_cursor(arrow, font, font, 68, 69, 0, 0, 0, !0, !0, !0).unwrap();
    let with_arrow = x11rb::protocol::xproto::ChangeWindowAttributesAux::new().cursor(arrow);
    x.change_window_attributes(desktop.root, &with_arrow).unwrap().check().unwrap();
    let opaque = |left: i16| {
        x.warp_pointer(0u32, desktop.root, 0, 0, 0, 0, left, 100).unwrap().check().unwrap();
        let cursor = x.xfixes_get_cursor_image().unwrap().reply().unwrap().cursor_image;
        cursor.iter().filter(|pixel| **pixel >> 24 != 0).count()
    };
    let bench = open(&desktop, &named(PANEL), PanelMode::ChannelPacked).unwrap();
    assert_eq!(opaque(PANEL_PLACE.0 + 100), 0);
    // Canary: it is there on the main monitor.
    assert!(opaque(100) > 10);
    drop(bench);
}

#[test]
fn the_primary_and_the_only_monitor_are_taken_only_when_allowed() {
    let desktop = Desktop::with_two_monitors();
    desktop.place(MAIN, (0, 0, PANEL_SIZE.0, PANEL_SIZE.1), 60.0);
    let refused = |spec: &WindowSpec| open(&desktop, spec, PanelMode::ChannelPacked).err().map(|why| why.to_string());
    let because_primary = refused(&named(MAIN)).unwrap();
    assert!(because_primary.contains("is the primary monitor") && because_primary.contains(PANEL), "{because_primary}");
    // Without a name it is the other one.
    let unnamed = open(&desktop, &WindowSpec::default(), PanelMode::ChannelPacked).unwrap();
    let flat = vec![[FLAT as u8; 3]; SIZE.pixels()];
    assert_eq!(differences(&desktop.picture(PANEL_PLACE), &flat), []);
    drop(unnamed);
    desktop.switch_off(PANEL);
    let because_only = refused(&WindowSpec::default()).unwrap();
    assert!(because_only.contains("is the only monitor"), "{because_only}");
    let allowed = WindowSpec { monitor: None, allow_primary: true };
    assert_eq!(refused(&allowed), None);
}

#[test]
fn monitors_are_known_by_model_and_serial_number() {
    let desktop = Desktop::with_two_monitors();
    desktop.set_edid(MAIN, "OFFICE", "11");
    desktop.set_edid(PANEL, "PLUTO-2", "SN 0042");
    for name in ["pluto-2", "SN 0042", "PLUTO-2 SN 0042", PANEL] {
        let bench = open(&desktop, &named(name), PanelMode::ChannelPacked);
        assert!(bench.is_ok(), "{name}: {:?}", bench.err());
    }
    let unknown = open(&desktop, &named("LETO"), PanelMode::ChannelPacked).err().unwrap().to_string();
    assert!(unknown.contains("no monitor is called \"LETO\"") && unknown.contains("SN 0042"), "{unknown}");
}

/// What somebody does to the desktop, the fault that it is, and what mends it, where opening the window again does not.
struct Attack {
    name: &'static str,
    strike: fn(&Desktop),
    fault: PanelFault,
    mend: Option<fn(&Desktop)>,
}

fn window_of(desktop: &Desktop) -> u32 {
    desktop.panel_window().expect("the panel has a window")
}

fn reconfigure(desktop: &Desktop, change: x11rb::protocol::xproto::ConfigureWindowAux) {
    use x11rb::protocol::xproto::ConnectionExt as _;
    desktop.x.configure_window(window_of(desktop), &change).unwrap().check().unwrap();
}

/// A window of another program over a part of the panel; one that a window manager takes care of, or not.
pub(crate) fn cover(desktop: &Desktop, managed: bool) {
    use x11rb::connection::Connection as _;
    use x11rb::protocol::xproto::{ConnectionExt as _, CreateWindowAux, WindowClass};
    let window = desktop.x.generate_id().unwrap();
    let attributes = CreateWindowAux::new().override_redirect(u32::from(!managed)).background_pixel(0xFF_FFFF);
    let (parent, class) = (desktop.root, WindowClass::INPUT_OUTPUT);
    let left = PANEL_PLACE.0 + 100;
    desktop.x.create_window(0, window, parent, left, 50, 200, 100, 0, class, 0, &attributes).unwrap().check().unwrap();
    desktop.x.map_window(window).unwrap().check().unwrap();
}

fn attacks() -> Vec<Attack> {
    use x11rb::protocol::xproto::{ConfigureWindowAux, ConnectionExt as _};
    let back: Option<fn(&Desktop)> = Some(|desktop| desktop.place(PANEL, PANEL_PLACE, 60.0));
    vec![
        Attack {
            name: "the window is moved to the main monitor",
            strike: |desktop| reconfigure(desktop, ConfigureWindowAux::new().x(0).y(0)),
            fault: PanelFault::WindowLost,
            mend: None,
        },
        Attack {
            name: "it is moved by one pixel",
            strike: |desktop| reconfigure(desktop, ConfigureWindowAux::new().x(i32::from(PANEL_PLACE.0) + 1)),
            fault: PanelFault::WindowLost,
            mend: None,
        },
        Attack {
            name: "it is resized",
            strike: |desktop| reconfigure(desktop, ConfigureWindowAux::new().width(639)),
            fault: PanelFault::WindowLost,
            mend: None,
        },
        Attack {
            name: "it is hidden",
            strike: |desktop| desktop.x.unmap_window(window_of(desktop)).unwrap().check().unwrap(),
            fault: PanelFault::WindowLost,
            mend: None,
        },
        Attack {
            name: "it is destroyed",
            strike: |desktop| desktop.x.destroy_window(window_of(desktop)).unwrap().check().unwrap(),
            fault: PanelFault::WindowLost,
            mend: None,
        },
        Attack {
            name: "a window covers a part of it",
            strike: |desktop| cover(desktop, false),
            fault: PanelFault::WindowLost,
            mend: None,
        },
        Attack {
            name: "its program is cut off from the X server",
            strike: |desktop| desktop.x.kill_client(window_of(desktop)).unwrap().check().unwrap(),
            fault: PanelFault::WindowLost,
            mend: None,
        },
        Attack {
            name: "the monitor goes",
            strike: |desktop| desktop.switch_off(PANEL),
            fault: PanelFault::Unplugged,
            mend: back,
        },
        Attack {
            name: "the panel becomes the primary monitor",
            strike: |desktop| desktop.set_primary(Some(PANEL)),
            fault: PanelFault::Primary,
            mend: Some(|desktop| desktop.set_primary(Some(MAIN))),
        },
        Attack {
            name: "the main monitor shows the panel's part of the desktop, too",
            strike: |desktop| desktop.place(MAIN, (PANEL_PLACE.0 - 400, 0, MAIN_PLACE.2, MAIN_PLACE.3), 60.0),
            fault: PanelFault::Altered(AlterationKind::Mirrored),
            mend: Some(|desktop| desktop.place(MAIN, MAIN_PLACE, 60.0)),
        },
        Attack {
            name: "another resolution",
            strike: |desktop| desktop.place(PANEL, (PANEL_PLACE.0, 0, 800, 600), 60.0),
            fault: PanelFault::ModeRefused,
            mend: back,
        },
        Attack {
            name: "another refresh rate",
            strike: |desktop| desktop.place(PANEL, PANEL_PLACE, 75.0),
            fault: PanelFault::ModeRefused,
            mend: back,
        },
        Attack {
            name: "night light",
            strike: |desktop| desktop.dim(PANEL, 0.9),
            fault: PanelFault::Altered(AlterationKind::GammaRamp),
            mend: Some(|desktop| desktop.dim(PANEL, 1.0)),
        },
        Attack {
            name: "the monitors change places",
            strike: |desktop| {
                // As one step: between them the monitors would show the same part of the desktop.
                desktop.x.grab_server().unwrap().check().unwrap();
                desktop.place(MAIN, (PANEL_SIZE.0 as i16, 0, MAIN_PLACE.2, MAIN_PLACE.3), 60.0);
                desktop.place(PANEL, (0, 0, PANEL_SIZE.0, PANEL_SIZE.1), 60.0);
                desktop.x.ungrab_server().unwrap().check().unwrap();
            },
            fault: PanelFault::WindowLost,
            mend: None,
        },
    ]
}

/// Every attack is a fault, after which nothing is presented and no monitor shows the pattern in the wrong place; once
/// it is mended the panel comes back by itself and shows what it must.
#[test]
fn whatever_takes_the_window_off_its_monitor_is_a_fault_that_recovers() {
    ROADS.iter().for_each(|&road| whatever_takes_the_window_off_its_monitor(road));
}

fn whatever_takes_the_window_off_its_monitor(road: Road) {
    let desktop = Desktop::with_two_monitors();
    let mut bench = open_by(road, &desktop, &named(PANEL), PanelMode::ChannelPacked).unwrap();
    for Attack { name, strike, fault, mend } in attacks() {
        eprintln!("{road:?}: {name}");
        let frame = bench.submit();
        bench.show(frame);
        assert_eq!(differences(&desktop.picture(PANEL_PLACE), &packed(frame)), [], "before: {name}");
        strike(&desktop);
        // While monitors change, windows come and go: that may be what is seen first.
        let first = bench.fault();
        assert!(first == fault || first == PanelFault::WindowLost, "{name}: {first}");
        let now = host_now();
        let again = bench.panel.tick(now, &mut bench.source, &mut |refresh| panic!("{name}: {refresh:?}"));
        assert_eq!(again, Err(first), "{name}");
        if let Some(mend) = mend {
            assert_eq!(bench.panel.recover(host_now()), Err(fault), "{name}: it is not mended yet");
            assert_eq!(desktop.panel_window(), None, "{name}: a panel that is lost has no window");
            mend(&desktop);
        }
        bench.recover();
        assert_eq!(bench.panel.shown(), None, "{name}: the panel begins with the flat pattern");
    }
    let frame = bench.submit();
    bench.show(frame);
    let place = (0, 0, PANEL_SIZE.0, PANEL_SIZE.1);
    assert_eq!(differences(&desktop.picture(place), &packed(frame)), [], "where the panel is at last");
}

#[test]
fn a_window_manager_neither_moves_nor_hides_the_window() {
    let desktop = Desktop::with_two_monitors();
    let mut manager = desktop.window_manager();
    let mut bench = open(&desktop, &named(PANEL), PanelMode::ChannelPacked).unwrap();
    let frame = bench.submit();
    bench.show(frame);
    // Without a manager the window stays as it is, and a new manager leaves it alone.
    manager.kill().unwrap();
    manager.wait().unwrap();
    bench.run_for(10).unwrap();
    let mut manager = desktop.window_manager();
    // What a taskbar or `wmctrl` asks of the manager.
    desktop.ask_manager(window_of(&desktop), "_NET_MOVERESIZE_WINDOW", [0b11 << 8, 10, 10, 0, 0]);
    desktop.ask_manager(window_of(&desktop), "_NET_WM_STATE", [1, desktop.atom("_NET_WM_STATE_HIDDEN"), 0, 1, 0]);
    bench.run_for(30).unwrap();
    assert_eq!(differences(&desktop.picture(PANEL_PLACE), &packed(frame)), []);
    // A program that asks for the panel's monitor: its window stays below the panel's, or there is a fault.
    cover(&desktop, true);
    if bench.run_for(90).is_err() {
        bench.recover();
        let frame = bench.submit();
        bench.show(frame);
    }
    assert_eq!(differences(&desktop.picture(PANEL_PLACE), &packed(bench.submitted)), []);
    manager.kill().unwrap();
    manager.wait().unwrap();
}

#[test]
fn a_server_that_dies_is_a_fault_and_its_successor_gets_the_window() {
    ROADS.iter().for_each(|&road| a_server_that_dies_is_a_fault(road));
}

fn a_server_that_dies_is_a_fault(road: Road) {
    let mut desktop = Desktop::with_two_monitors();
    let mut bench = open_by(road, &desktop, &named(PANEL), PanelMode::ChannelPacked).unwrap();
    let frame = bench.submit();
    bench.show(frame);
    desktop.kill();
    assert_eq!(bench.fault(), PanelFault::WindowLost);
    assert!(bench.panel.recover(host_now()).is_err());
    desktop.restart();
    bench.recover();
    let frame = bench.submit();
    bench.show(frame);
    assert_eq!(differences(&desktop.picture(PANEL_PLACE), &packed(frame)), []);
}

#[test]
fn the_screen_saver_waits_while_the_panel_is_open() {
    use x11rb::protocol::screensaver::{ConnectionExt as _, State};
    use x11rb::protocol::xproto::{Blanking, ConnectionExt as _, Exposures};
    let desktop = Desktop::with_two_monitors();
    let saving = || {
        let info = desktop.x.screensaver_query_info(desktop.root).unwrap().reply().unwrap();
        info.state == u8::from(State::ON)
    };
    let mut bench = open(&desktop, &named(PANEL), PanelMode::ChannelPacked).unwrap();
    desktop.x.set_screen_saver(1, 0, Blanking::PREFERRED, Exposures::ALLOWED).unwrap().check().unwrap();
    bench.run_for(150).unwrap();
    assert!(!saving());
    drop(bench);
    // Canary: it was only waiting.
    assert!(wait_until(saving));
}

#[test]
fn a_server_without_window_manager_or_rates_shows_the_pattern_where_its_only_monitor_is_allowed() {
    let desktop = Desktop::xvfb();
    let spec = WindowSpec { monitor: None, allow_primary: true };
    let mut bench = open(&desktop, &spec, PanelMode::ChannelPacked).unwrap();
    let frame = bench.submit();
    bench.show(frame);
    let all = (0, 0, PANEL_SIZE.0, PANEL_SIZE.1);
    assert_eq!(differences(&desktop.picture(all), &packed(frame)), []);
    drop(bench);
    let refused = open(&desktop, &WindowSpec::default(), PanelMode::ChannelPacked).err().unwrap();
    assert!(refused.to_string().contains("is the only monitor"), "{refused}");
}

#[test]
fn a_panel_that_another_holod_shows_patterns_on_is_left_to_it() {
    use x11rb::protocol::xproto::{AtomEnum, PropMode};
    use x11rb::wrapper::ConnectionExt as _;
    let desktop = Desktop::with_two_monitors();
    let mut first = open(&desktop, &named(PANEL), PanelMode::ChannelPacked).unwrap();
    // As if it were another process's.
    let (window, pid) = (window_of(&desktop), desktop.atom("_NET_WM_PID"));
    desktop.x.change_property32(PropMode::REPLACE, window, pid, AtomEnum::CARDINAL, &[4711]).unwrap().check().unwrap();
    let refused = open(&desktop, &named(PANEL), PanelMode::ChannelPacked).err().unwrap().to_string();
    assert!(refused.contains("DUMMY1 is the panel of another holod, process 4711"), "{refused}");
    first.submit();
    first.run_for(30).expect("the first one is not disturbed");
    drop(first);
    assert!(wait_until(|| open(&desktop, &named(PANEL), PanelMode::ChannelPacked).is_ok()), "the monitor is free");
}

#[test]
fn what_a_panel_is_good_for_is_said_when_it_is_opened() {
    let desktop = Desktop::with_two_monitors();
    desktop.set_edid(PANEL, "PLUTO-2", "SN 0042");
    let bench = open(&desktop, &named(PANEL), PanelMode::ChannelPacked).unwrap();
    let said: Vec<_> = bench.panel.checks().iter().map(|check| (check.verdict, check.to_string())).collect();
    let [(Verdict::Right, monitor), (Verdict::Dark, times), (Verdict::Unverified, unseen)] = &said[..] else {
        panic!("{said:?}")
    };
    assert!(monitor.contains("DUMMY1") && monitor.contains("PLUTO-2") && monitor.contains("60.00 Hz"), "{monitor}");
    assert!(times.contains("software's") && times.contains("lasers stay dark"), "{times}");
    assert!(unseen.contains("full range"), "{unseen}");
}

#[test]
fn a_monitor_of_another_size_or_rate_is_refused_with_both() {
    let desktop = Desktop::with_two_monitors();
    desktop.place(PANEL, (PANEL_PLACE.0, 0, 800, 600), 60.0);
    let refused = open(&desktop, &named(PANEL), PanelMode::ChannelPacked).err().unwrap().to_string();
    assert!(refused.contains("800x600 at 60.32 Hz") && refused.contains("640x480 at 60.00 Hz"), "{refused}");
    desktop.place(PANEL, PANEL_PLACE, 75.0);
    let refused = open(&desktop, &named(PANEL), PanelMode::ChannelPacked).err().unwrap().to_string();
    assert!(refused.contains("640x480 at 75.00 Hz"), "{refused}");
    assert_eq!(desktop.panel_window(), None);
}

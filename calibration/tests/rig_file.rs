//! Rig files: what they mean, and what is said of faulty ones.

use std::f64::consts::{PI, TAU};
use std::fs;
use std::path::{Path, PathBuf};

use holod_calibration::rig::{
    Eye, LaserDriver, LevelPhase, Meaning, Orientation, OutOfStroke, Packing, PanelMode, PanelProfile, PhaseSign,
    Provenance, Rig, RigError, TextLaserProfile, VideoMargins, WeightsChoice,
};
use holod_calibration::toml_reader::Fault;
use holod_calibration::{Colour, Dioptres, DisplayGeometry, Metres, PerColour, Resolution, TimeNs};
use image::{GrayImage, ImageBuffer, ImageFormat, Luma, Rgb, RgbImage, RgbaImage};
use proptest::prelude::*;
use serde_json::json;

const EXAMPLE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/rigs/example.toml");

/// The built-in rig's text with each `from` replaced by its `to`; every `from` must be there.
fn changed(changes: &[(&str, &str)]) -> String {
    changes.iter().fold(Rig::BUILT_IN_TOML.to_owned(), |text, (from, to)| {
        assert!(text.contains(from), "{from} is not in the built-in rig");
        text.replacen(from, to, 1)
    })
}

fn faults_of(text: &str) -> Vec<Fault> {
    Rig::parse(text, Path::new("rig.toml")).expect_err("a fault").faults
}

/// The one fault of the built-in rig with one change.
fn fault_of(from: &str, to: &str) -> Fault {
    let mut faults = faults_of(&changed(&[(from, to)]));
    assert_eq!(faults.len(), 1, "{faults:#?}");
    faults.remove(0)
}

/// The line of the built-in rig that begins with `start`.
fn line_of(start: &str) -> Option<usize> {
    let line = Rig::BUILT_IN_TOML.lines().position(|line| line.starts_with(start));
    Some(1 + line.unwrap_or_else(|| panic!("no line begins with {start}")))
}

#[track_caller]
fn assert_fault(fault: &Fault, key: &str, line: Option<usize>, found: &str, expected: &str, advice: &str) {
    assert_eq!((fault.key.as_str(), fault.line), (key, line), "{fault}");
    assert!(fault.found.contains(found), "found: {fault}");
    assert!(fault.expected.contains(expected), "expected: {fault}");
    assert!(fault.advice.contains(advice), "advice: {fault}");
}

/// Checks the one fault that `from` → `to` makes, in the line that begins with `from`'s first line.
#[track_caller]
fn check(from: &str, to: &str, key: &str, found: &str, expected: &str, advice: &str) {
    assert_fault(&fault_of(from, to), key, line_of(from), found, expected, advice);
}

#[test]
fn the_built_in_file_is_the_built_in_rig() {
    let rig = Rig::parse(Rig::BUILT_IN_TOML, Path::new("built-in.toml")).unwrap();
    assert_eq!(rig.provenance.origin, "built-in.toml");
    assert_eq!(Rig { provenance: Provenance::default(), ..rig }, Rig::default());
}

#[test]
fn the_example_rig_says_what_its_comments_say() {
    let rig = Rig::load(Path::new(EXAMPLE)).unwrap();
    assert_eq!(rig.name, "lab bench 1");
    assert_eq!(rig.resolution(), Resolution { width: 1920, height: 1080 });
    assert!((rig.pixel_pitch().0 - 8e-6).abs() < 1e-15);
    assert_eq!(rig.provenance.panel_profile, Some("holoeye-pluto"));
    assert_eq!((rig.panel.mode, rig.panel.phase_sign), (PanelMode::ChannelPacked, PhaseSign::Positive));
    assert_eq!(rig.panel.stroke_rad, PerColour([TAU * 255.0 / 256.0; 3]));
    assert_eq!((rig.panel.settle, rig.panel.field_period()), (TimeNs(2_000_000), TimeNs(5_555_556)));
    assert_eq!(rig.geometry.depth_near, DisplayGeometry::DEFAULT.depth_near);
    assert_eq!(rig.lasers.driver, LaserDriver::Serial { path: "/dev/holod-lasers".into(), sync_wire: false });
    assert_eq!(rig.lasers.power_mw, PerColour([1.2, 0.8, 1.0]));
    assert_eq!(rig.lasers.power_limit_mw, PerColour([Some(2.0); 3]));
    assert_eq!(rig.tracker.spec.as_deref(), Some("serial:/dev/holod-tracker"));
    assert_eq!(rig.model.weights, WeightsChoice::Standard);

    let meaning = rig.meaning();
    assert!((meaning.pixel_angle_mrad - 0.2).abs() < 1e-12);
    assert!((meaning.u_near_mm - 4.571).abs() < 1e-3 && meaning.u_far_mm == 0.0 && meaning.depth_far_m.is_none());
    assert!((meaning.eyebox_mm.blue - 2.25).abs() < 1e-9);
    assert!((meaning.blurs[0].largest_blur_px - 2.0 / 0.35 / 0.2).abs() < 1e-3);
    let [on_ms, off_ms] = [meaning.field.laser_on_ms, meaning.field.laser_off_ms].map(Option::unwrap);
    assert!((on_ms - 2.1).abs() < 1e-9 && (off_ms - 5.1).abs() < 1e-9);
    assert!(meaning.files.is_empty());
}

#[test]
fn the_example_comments_name_every_profile_and_its_own_figures() {
    let text = fs::read_to_string(EXAMPLE).unwrap();
    for profile in PanelProfile::all() {
        assert!(text.contains(profile.name), "{} is not in the example's comments", profile.name);
    }
    for name in TextLaserProfile::names() {
        assert!(text.contains(name), "{name} is not in the example's comments");
    }
    let spelled_out = ["width_px", "height_px", "pixel_pitch_um", "refresh_hz", "bit_depth", "packing"]
        .iter()
        .fold(text.clone(), |text, key| text.replace(&format!("# {key} = "), &format!("{key} = ")))
        .replace("profile = \"holoeye-pluto\"", "");
    let explicit = Rig::parse(&spelled_out, Path::new(EXAMPLE)).unwrap();
    let by_profile = Rig::load(Path::new(EXAMPLE)).unwrap();
    assert_eq!(Rig { provenance: by_profile.provenance.clone(), ..explicit }, by_profile);
}

#[test]
fn three_faults_are_one_report_of_three_keys_and_lines() {
    let text = changed(&[
        ("pixel_pitch_um = 8.0", "pixel_pitch_um = 8e-6"),
        ("green = 520.0", "green = 0.52"),
        ("fallback_mm = 3.0", "fallback_mm = 12"),
    ]);
    let error = Rig::parse(&text, Path::new("bench.toml")).unwrap_err();
    let keys: Vec<_> = error.faults.iter().map(|fault| (fault.key.as_str(), fault.line)).collect();
    let expected = [
        ("panel.pixel_pitch_um", line_of("pixel_pitch_um")),
        ("optics.wavelengths_nm.green", line_of("wavelengths_nm")),
        ("tracker.fallback_mm", line_of("fallback_mm")),
    ];
    assert_eq!(keys, expected);
    let shown = error.to_string();
    assert!(
        shown.starts_with("rig file bench.toml: 3 faults\n  line 7, panel.pixel_pitch_um: found 0.000008;"),
        "{shown}"
    );
    assert!(shown.contains("0.52 looks like micrometres: write 520"), "{shown}");
}

#[test]
fn figures_in_another_unit_are_recognised() {
    for (from, to, key, advice) in [
        (
            "pixel_pitch_um = 8.0",
            "pixel_pitch_um = 8e-6",
            "panel.pixel_pitch_um",
            "looks like metres: write 8 for 8 µm",
        ),
        ("pixel_pitch_um = 8.0", "pixel_pitch_um = 0.008", "panel.pixel_pitch_um", "looks like millimetres: write 8 "),
        ("refresh_hz = 60.0", "refresh_hz = 60000", "panel.refresh_hz", "looks like millihertz: write 60 "),
        ("settle_ms = 2.0", "settle_ms = 2000", "panel.settle_ms", "looks like microseconds: write 2 "),
        (
            "eyepiece_focal_length_mm = 40.0",
            "eyepiece_focal_length_mm = 0.04",
            "optics.eyepiece_focal_length_mm",
            "write 40 ",
        ),
        ("lit_ms = 3.0", "lit_ms = 3000", "lasers.lit_ms", "looks like microseconds: write 3 "),
        (
            "power_mw = { red = 1.0",
            "power_mw = { red = 1200",
            "lasers.power_mw.red",
            "microwatts: write 1.2 for 1.2 mW",
        ),
        (
            "heartbeat_timeout_ms = 100.0",
            "heartbeat_timeout_ms = 0.1",
            "lasers.heartbeat_timeout_ms",
            "seconds: write 100 ",
        ),
        ("fallback_mm = 3.0", "fallback_mm = 0.003", "tracker.fallback_mm", "looks like metres: write 3 "),
        ("depth_far_m = inf", "depth_far_m = 2000", "optics.depth_far_m", "looks like millimetres: write 2 "),
        ("depth_near_m = 0.35", "depth_near_m = 350", "optics.depth_near_m", "looks like millimetres: write 0.35 "),
        ("hold_ms = 1000.0", "hold_ms = 1", "tracker.hold_ms", "looks like seconds: write 1000 "),
        ("network = \"standard\"", "pupil_step_mm = 50", "model.pupil_step_mm", "looks like micrometres: write 0.05 "),
    ] {
        check(from, to, key, "", "a number from", advice);
    }
    for (slip, unit) in [("638e-9", "metres"), ("0.638", "micrometres"), ("6380", "ångströms")] {
        let fault = fault_of("red = 638.0", &format!("red = {slip}"));
        let advice = format!("looks like {unit}: write 638 for 638 nm");
        assert_fault(&fault, "optics.wavelengths_nm.red", line_of("wavelengths_nm"), "", "380 to 780 nm", &advice);
    }
    let degrees = fault_of("red = 1.9921875", "red = 360");
    assert_fault(&degrees, "panel.stroke_pi.red", line_of("stroke_pi"), "360", "π", "looks like degrees: write 2 ");
}

#[test]
fn figures_out_of_range_are_refused() {
    for (from, to, key) in [
        ("width_px = 1920", "width_px = 0", "panel.width_px"),
        ("height_px = 1080", "height_px = -1080", "panel.height_px"),
        ("pixel_pitch_um = 8.0", "pixel_pitch_um = nan", "panel.pixel_pitch_um"),
        ("refresh_hz = 60.0", "refresh_hz = inf", "panel.refresh_hz"),
        ("bit_depth = 8", "bit_depth = 32", "panel.bit_depth"),
        ("settle_ms = 2.0", "settle_ms = -1", "panel.settle_ms"),
        ("eyepiece_focal_length_mm = 40.0", "eyepiece_focal_length_mm = 1", "optics.eyepiece_focal_length_mm"),
        ("depth_near_m = 0.35", "depth_near_m = 0", "optics.depth_near_m"),
        ("depth_near_m = 0.35", "depth_near_dpt = 25", "optics.depth_near_dpt"),
        ("on_delay_ms = 0.1", "on_delay_ms = -0.1", "lasers.on_delay_ms"),
        ("lit_ms = 3.0", "lit_ms = 0", "lasers.lit_ms"),
        ("heartbeat_timeout_ms = 100.0", "heartbeat_timeout_ms = 5000", "lasers.heartbeat_timeout_ms"),
        ("eye = \"both\"", "scale_mm_per_unit = 0\neye = \"both\"", "tracker.scale_mm_per_unit"),
        ("fallback_mm = 3.0", "fallback_mm = 0.5", "tracker.fallback_mm"),
        ("hold_ms = 1000.0", "hold_ms = 0", "tracker.hold_ms"),
    ] {
        check(from, to, key, "", "a number from", "");
    }
    let red = fault_of("red = 1.0,", "red = -1,");
    assert_fault(&red, "lasers.power_mw.red", line_of("power_mw"), "-1", "0 to 500 mW", "");
}

#[test]
fn wrong_types_are_named() {
    check(
        "width_px = 1920",
        "width_px = \"1920\"",
        "panel.width_px",
        "a string \"1920\"",
        "a number",
        "take the quotes away",
    );
    check("width_px = 1920", "width_px = 1920.5", "panel.width_px", "1920.5", "a whole number", "without a fraction");
    check("width_px = 1920", "width_px = 1921", "panel.width_px", "1921", "an even number", "leave out");
    check("bit_depth = 8", "bit_depth = 9", "panel.bit_depth", "9", "8, 10 or 16", "");
    check("bit_depth = 8", "bit_depth = true", "panel.bit_depth", "a boolean true", "a number", "");
    check("mode = ", "mode = 3 #", "panel.mode", "an integer 3", "\"channel-packed\"", "in double quotes");
    check("eye = \"both\"", "eye = \"\"", "tracker.eye", "\"\"", "\"left\"", "");
    check("eye = \"both\"", "eye = \"best\"", "tracker.eye", "", "\"better\"", "");
    let flag = faults_of(&changed(&[("lit_ms = 3.0", "lit_ms = 3.0\ngated_by_panel = \"no\"")]));
    assert!(flag.iter().any(|fault| fault.expected == "true or false" && fault.advice.contains("without quotes")));
    let stroke = fault_of("stroke_pi = {", "stroke_pi = 2.0 # {");
    assert_fault(
        &stroke,
        "panel.stroke_pi",
        line_of("stroke_pi"),
        "a float 2.0",
        "for each colour",
        "{ red = 2, green = 2, blue = 2 }",
    );
    let section = faults_of("panel = 3\n[optics]\n[[lasers]]\n");
    let keys: Vec<_> = section.iter().map(|fault| (fault.key.as_str(), fault.line)).collect();
    assert!(keys.contains(&("panel", Some(1))) && keys.contains(&("lasers", Some(3))), "{keys:?}");
}

#[test]
fn names_that_are_nearly_right_are_guessed() {
    let pitch = faults_of(&changed(&[("pixel_pitch_um", "pixel_pitch_mm")]));
    assert_eq!(pitch.len(), 2, "{pitch:#?}");
    let unknown = pitch.iter().find(|fault| fault.key == "panel.pixel_pitch_mm").unwrap();
    assert_fault(
        unknown,
        "panel.pixel_pitch_mm",
        Some(7),
        "an unknown key",
        "pixel_pitch_um",
        "did you mean `pixel_pitch_um`?",
    );
    let missing = pitch.iter().find(|fault| fault.key == "panel.pixel_pitch_um").unwrap();
    assert_fault(
        missing,
        "panel.pixel_pitch_um",
        line_of("[panel]"),
        "nothing",
        "1 to 50 µm",
        "add pixel_pitch_um to [panel]",
    );

    check(
        "mode = \"channel-packed\"",
        "mode = \"channel_packed\"",
        "panel.mode",
        "channel_packed",
        "",
        "did you mean \"channel-packed\"?",
    );
    check(
        "phase_sign = ",
        "phase_sign = \"+\" #",
        "panel.phase_sign",
        "\"+\"",
        "\"positive\", \"negative\"",
        "choose one",
    );
    check(
        "bit_depth = 8",
        "profile = \"holoeye-plut\"\nbit_depth = 8",
        "panel.profile",
        "plut",
        "",
        "did you mean \"holoeye-pluto\"?",
    );
}

#[test]
fn unknown_misplaced_and_superfluous_keys_are_refused() {
    check(
        "hold_ms = 1000.0",
        "settle_ms = 2\nhold_ms = 1000.0",
        "tracker.settle_ms",
        "an unknown key",
        "",
        "move `settle_ms` to [panel]",
    );
    check("hold_ms = 1000.0", "name = \"x\"\nhold_ms = 1000.0", "tracker.name", "", "", "above the first table");
    check("hold_ms = 1000.0", "zzz = 1\nhold_ms = 1000.0", "tracker.zzz", "", "one of spec, eye", "take it out");
    check("name = ", "nmae = ", "nmae", "an unknown key", "name, panel", "did you mean `name`?");
    let violet = fault_of("blue = 450.0 }", "blue = 450.0, violet = 405.0 }");
    assert_fault(
        &violet,
        "optics.wavelengths_nm.violet",
        line_of("wavelengths_nm"),
        "an unknown key",
        "red, green, blue",
        "take it out",
    );
}

#[test]
fn missing_tables_and_keys_are_named_once() {
    let keys: Vec<String> = faults_of("").into_iter().map(|fault| fault.key).collect();
    assert_eq!(keys, ["panel", "optics", "lasers"]);
    for (key, section) in [
        ("width_px", "panel"),
        ("refresh_hz", "panel"),
        ("mode", "panel"),
        ("field_order", "panel"),
        ("bit_depth", "panel"),
        ("phase_sign", "panel"),
        ("stroke_pi", "panel"),
        ("settle_ms", "panel"),
        ("wavelengths_nm", "optics"),
        ("eyepiece_focal_length_mm", "optics"),
        ("driver", "lasers"),
        ("power_mw", "lasers"),
        ("on_delay_ms", "lasers"),
        ("lit_ms", "lasers"),
        ("heartbeat_timeout_ms", "lasers"),
    ] {
        let fault = fault_of(&format!("{key} = "), &format!("# {key} = "));
        assert_fault(&fault, &format!("{section}.{key}"), line_of(&format!("[{section}]")), "nothing", "", "add ");
    }
    let blue = fault_of(", blue = 450.0", "");
    assert_fault(&blue, "optics.wavelengths_nm.blue", line_of("wavelengths_nm"), "nothing", "380", "add blue");
    let optional = changed(&[("[tracker]", "#"), ("eye =", "#"), ("fallback_mm", "#"), ("hold_ms", "#")]);
    let optional = optional.replace("[model]", "").replace("network", "#").replace("depth_", "# depth_");
    let rig = Rig::parse(&optional, Path::new("")).unwrap();
    assert_eq!(
        (rig.tracker, rig.model, rig.geometry),
        (Rig::default().tracker, Rig::default().model, DisplayGeometry::DEFAULT)
    );
}

#[test]
fn each_choice_of_eye_is_read() {
    for (name, eye) in Eye::NAMES {
        assert_eq!(eye.name(), name);
        let text = changed(&[("eye = \"both\"", &format!("eye = \"{name}\""))]);
        assert_eq!(Rig::parse(&text, Path::new("")).unwrap().tracker.eye, eye);
    }
}

#[test]
fn a_stall_timeout_may_be_left_to_the_frame_time() {
    let stall_timeout = |text: &str| Rig::parse(text, Path::new("rig.toml")).unwrap().lasers.stall_timeout;
    assert_eq!(stall_timeout(&changed(&[])), None);
    let given = changed(&[("lit_ms = 3.0", "lit_ms = 3.0\nstall_timeout_ms = 80")]);
    assert_eq!(stall_timeout(&given), Some(TimeNs(80_000_000)));
    check("lit_ms = 3.0", "stall_timeout_ms = 2\nlit_ms = 3.0", "lasers.stall_timeout_ms", "", "a number from", "");
    // Within a colour frame the frame that is shown grows old.
    let short = "stall_timeout_ms = 12\nlit_ms = 3.0";
    check(
        "lit_ms = 3.0",
        short,
        "lasers.stall_timeout_ms",
        "12 ms",
        "at least one colour frame, 16.667 ms",
        "lengthen",
    );
}

#[test]
fn a_field_order_is_a_permutation() {
    for order in
        ["[\"red\", \"red\", \"blue\"]", "[\"red\", \"green\"]", "[1, 2, 3]", "\"rgb\"", "[\"r\", \"g\", \"b\"]"]
    {
        check(
            "field_order = ",
            &format!("field_order = {order} #"),
            "panel.field_order",
            "",
            "each once",
            "field_order = [",
        );
    }
    let text = changed(&[("[\"red\", \"green\", \"blue\"]", "[\"green\", \"red\", \"blue\"]")]);
    let rig = Rig::parse(&text, Path::new("")).unwrap();
    assert_eq!(rig.panel.field_order, [Colour::Green, Colour::Red, Colour::Blue]);
}

#[test]
fn an_order_of_channels_is_a_permutation_and_for_channel_packed_panels() {
    let channels = "channel_order = [\"green\", \"red\", \"blue\"]\nmode = ";
    let rig = Rig::parse(&changed(&[("mode = ", channels)]), Path::new("")).unwrap();
    assert_eq!(
        (rig.panel.field_order, rig.panel.channel_order),
        (Colour::ALL, [Colour::Green, Colour::Red, Colour::Blue])
    );
    check(
        "mode = ",
        "channel_order = [\"green\"]\nmode = ",
        "panel.channel_order",
        "",
        "each once",
        "channel_order = [",
    );
    check(
        "mode = \"channel-packed\"",
        "channel_order = [\"green\", \"red\", \"blue\"]\nmode = \"field-sequential\"",
        "panel.channel_order",
        "field-sequential mode",
        "none outside channel-packed mode",
        "take it out",
    );
}

/// Its channel is the colour that such a panel lights.
#[test]
fn a_panel_that_lights_its_own_lasers_shows_each_colour_in_its_channel() {
    let green_first = "[\"green\", \"red\", \"blue\"]";
    let beam = "driver = \"ready-beam\"\ndevice = \"/dev/x\"\nfull_power_mw = { red = 9, green = 9, blue = 9 }";
    let parsed = |field_order: &str| {
        let text = changed(&[
            ("driver = \"simulated\"", &format!("{beam}\n{ACCEPTED}\ngated_by_panel = true")),
            ("field_order = [\"red\", \"green\", \"blue\"]", &format!("field_order = {field_order}")),
            ("mode = ", &format!("channel_order = {green_first}\nmode = ")),
        ]);
        Rig::parse(&text, Path::new(""))
    };
    let faults = parsed("[\"red\", \"green\", \"blue\"]").unwrap_err().faults;
    assert_eq!(faults.len(), 1, "{faults:?}");
    assert_eq!(faults[0].key, "lasers.gated_by_panel");
    assert!(faults[0].expected.contains("green, red, blue"), "{faults:?}");
    parsed(green_first).unwrap();
}

#[test]
fn behind_a_relay_the_panel_is_seen_as_behind_another_eyepiece() {
    let key = "eyepiece_focal_length_mm = 40.0";
    let with = |keys: &str| Rig::parse(&changed(&[(key, keys)]), Path::new(""));
    let plain = with(key).unwrap();
    assert_eq!(plain.relay_magnification, 1.0);
    let rig = with(&format!("{key}\nrelay_magnification = 0.75")).unwrap();
    // By hand: 2.5 dpt lie 4 mm from the panel's image, which is 4 mm/0.75² from the panel; a pixel of the image is 6 µm.
    let depth = Dioptres(2.5);
    assert!((rig.geometry.image_distance(depth).0 - 4e-3 / 0.5625).abs() < 1e-12);
    assert!((rig.geometry.pixel_angle_rad() - 6e-6 / 40e-3).abs() < 1e-15);
    assert_eq!(rig.geometry.pixel_pitch, plain.geometry.pixel_pitch, "the stop goes by the panel's own");
    let text = rig.meaning().to_string();
    assert!(text.contains("0.75 times as large") && text.contains("53.33 mm"), "{text}");
    assert!(!plain.meaning().to_string().contains("times as large"));
    assert_eq!(rig.differences(&plain), ["optics.relay_magnification"]);
    let other = with("eyepiece_focal_length_mm = 41.0\nrelay_magnification = 0.75").unwrap();
    assert_eq!(other.differences(&rig), ["optics.eyepiece_focal_length_mm"]);

    let faults = |keys: &str| with(keys).expect_err("a fault").faults;
    let percent = faults(&format!("{key}\nrelay_magnification = 75"));
    assert_eq!(percent.len(), 1, "{percent:?}");
    assert_eq!(percent[0].key, "optics.relay_magnification");
    assert!(percent[0].to_string().contains("looks like percent: write 0.75"), "{percent:?}");
    let far = faults("eyepiece_focal_length_mm = 200.0\nrelay_magnification = 0.25");
    assert_eq!((far.len(), far[0].key.as_str()), (1, "optics.relay_magnification"), "{far:?}");
    assert!(far[0].found.contains("800 mm") && far[0].expected.contains("500 mm"), "{far:?}");
}

#[test]
fn a_panel_may_lie_in_a_larger_video_frame() {
    let with =
        |keys: &str| Rig::parse(&changed(&[("refresh_hz = ", &format!("{keys}\nrefresh_hz = "))]), Path::new(""));
    let plain = with("").unwrap();
    assert_eq!(plain.panel.video_margins, VideoMargins::default());
    let Resolution { width, height } = plain.resolution();
    let keys = format!(
        "video_width_px = {}\nvideo_height_px = {}\nvideo_left_px = 8\nvideo_top_px = 1",
        width + 80,
        height + 4
    );
    let rig = with(&keys).unwrap();
    assert_eq!(rig.panel.video_margins, VideoMargins { left: 8, right: 72, top: 1, bottom: 3 });
    assert_eq!(rig.resolution(), plain.resolution(), "the panel's own pixels stay");
    let video = Resolution { width: width + 80, height: height + 4 };
    assert_eq!(rig.panel.video_margins.around(rig.resolution()), video);
    let text = rig.meaning().to_string();
    let said = format!("pixels in a video frame of {}x{} from column 8, row 1 on;", width + 80, height + 4);
    assert!(text.contains(&said), "{said} is not in\n{text}");
    let expected =
        ["video_width_px", "video_height_px", "video_left_px", "video_top_px"].map(|key| format!("panel.{key}"));
    assert_eq!(rig.differences(&plain), expected);

    let profile = format!("profile = \"hamamatsu-x15213\"\nwidth_px = {width}\nrefresh_hz = ");
    assert!(width > 1280, "the profile's frame is narrower");
    let text = changed(&[(&format!("width_px = {width}\n"), ""), ("refresh_hz = ", &profile)]);
    let faults = Rig::parse(&text, Path::new("")).unwrap_err().faults;
    assert_eq!(faults[0].key, "panel.video_width_px", "{faults:?}");
}

#[test]
fn a_video_frame_that_does_not_hold_the_panel_is_refused() {
    let fault = |keys: &str, key: &str, found: &str, expected: &str, advice: &str| {
        let fault = fault_of("refresh_hz = ", &format!("{keys}\nrefresh_hz = "));
        assert_fault(&fault, key, line_of("refresh_hz"), found, expected, advice);
    };
    let least = "at least 1920 px, width_px and video_left_px together";
    fault("video_width_px = 1280", "panel.video_width_px", "1280 px", least, "the mode");
    let rows = "video_height_px = 1080";
    let above = fault_of("refresh_hz = ", &format!("{rows}\nvideo_top_px = 2\nrefresh_hz = "));
    let least = "at least 1082 px, height_px and video_top_px together";
    assert_fault(&above, "panel.video_height_px", line_of("refresh_hz"), "1080 px", least, "");
    fault("video_left_px = 8", "panel.video_left_px", "alone", "video_width_px beside it", "add video_width_px");
    fault("video_left_px = -1", "panel.video_left_px", "-1", "16384", "");
}

#[test]
fn timings_that_do_not_fit_into_the_field_state_the_numbers() {
    check(
        "settle_ms = 2.0",
        "settle_ms = 6",
        "panel.settle_ms",
        "6 ms",
        "5.556 ms of one field (60 Hz, channel-packed)",
        "",
    );
    let lit = fault_of("lit_ms = 3.0", "lit_ms = 4");
    let sum = "settle 2 + on_delay 0.1 + lit 4 = 6.1 ms";
    assert_fault(
        &lit,
        "lasers.lit_ms",
        line_of("lit_ms"),
        sum,
        "5.556 ms of one field",
        "write lit_ms = 3.332 at most",
    );
    check("lit_ms = 3.0", "lit_ms = 3.456", "lasers.lit_ms", "= 5.556 ms", "", "");
    let cut = Rig::parse(&changed(&[("lit_ms = 3.0", "lit_ms = 3.455")]), Path::new("")).unwrap();
    let note = "lit_ms is cut to 3.332: a window ends 0.123 ms before its field at least";
    assert!(cut.meaning().to_string().contains(note), "{}", cut.meaning());
    let whole = Rig::parse(&changed(&[("lit_ms = 3.0", "lit_ms = 3.332")]), Path::new("")).unwrap();
    assert!(!whole.meaning().to_string().contains("is cut"));
    // No window at all would be left.
    let none = changed(&[("on_delay_ms = 0.1", "on_delay_ms = 3.45"), ("lit_ms = 3.0", "lit_ms = 0.05")]);
    let none = Rig::parse(&none, Path::new("")).unwrap_err().to_string();
    assert!(
        none.contains("= 5.5 ms") && none.contains("0.123 ms before its own") && none.contains("shorten"),
        "{none}"
    );
    check(
        "heartbeat_timeout_ms = 100.0",
        "heartbeat_timeout_ms = 30",
        "lasers.heartbeat_timeout_ms",
        "30 ms",
        "33.333 ms",
        "",
    );
    let slow = changed(&[("channel-packed", "field-sequential"), ("settle_ms = 2.0", "settle_ms = 6")]);
    let rig = Rig::parse(&slow, Path::new("")).unwrap();
    assert_eq!((rig.panel.mode, rig.panel.field_period()), (PanelMode::FieldSequential, TimeNs(16_666_667)));
}

#[test]
fn panel_modes_say_how_many_fields_a_colour_frame_has() {
    let fields = |changes: &[(&str, &str)]| {
        let panel = Rig::parse(&changed(changes), Path::new("")).unwrap().panel;
        (0..panel.fields()).map(|field| panel.colour_of_field(field)).collect::<Vec<_>>()
    };
    assert_eq!(fields(&[]), Colour::ALL);
    let sequential = ("mode = \"channel-packed\"", "mode = \"field-sequential\"\nframes_per_colour = 2");
    let fast = ("refresh_hz = 60.0", "refresh_hz = 180.0");
    let [red, green, blue] = Colour::ALL;
    assert_eq!(fields(&[fast, sequential]), [red, red, green, green, blue, blue]);
    let monochrome = ("mode = \"channel-packed\"", "mode = \"monochrome\"\ncolour = \"green\"");
    assert_eq!(fields(&[fast, monochrome]), [green]);
}

#[test]
fn keys_of_one_panel_mode_are_refused_in_another() {
    let fault = |mode: &str| fault_of("mode = \"channel-packed\"", mode);
    let line = |below_mode: usize| line_of("mode").map(|line| line + below_mode);
    let missing = fault("mode = \"monochrome\"");
    assert_fault(&missing, "panel.colour", line_of("[panel]"), "nothing", "\"green\"", "add colour");
    let colour = fault("mode = \"channel-packed\"\ncolour = \"green\"");
    assert_fault(&colour, "panel.colour", line(1), "channel-packed", "monochrome mode only", "take colour out");
    let frames = fault("mode = \"channel-packed\"\nframes_per_colour = 2");
    assert_fault(&frames, "panel.frames_per_colour", line(1), "2 in channel-packed", "1 outside", "field-sequential");
    let many = fault("mode = \"channel-packed\"\nframes_per_colour = 9");
    assert_fault(&many, "panel.frames_per_colour", line(1), "9", "8 video frames", "");
}

#[test]
fn depths_are_given_once_and_in_order() {
    let inverted = fault_of("depth_far_m = inf", "depth_far_m = 0.2");
    assert_fault(&inverted, "optics.depth_near", line_of("depth_near_m"), "near 2.857 and far 5", "nearer", "exchange");
    let centimetres = fault_of("depth_near_m = 0.35", "depth_near_m = 35");
    assert_fault(
        &centimetres,
        "optics.depth_near",
        line_of("depth_near_m"),
        "near 0.029",
        "0.1 dioptres apart",
        "35 cm",
    );
    let twice = fault_of("depth_near_m = 0.35", "depth_near_m = 0.35\ndepth_near_dpt = 2.5");
    assert_eq!(
        (twice.key.as_str(), twice.line),
        ("optics.depth_near_dpt", line_of("depth_near_m").map(|line| line + 1))
    );
    let text =
        changed(&[("depth_far_m = inf", "depth_far_dpt = 0.25"), ("depth_near_m = 0.35", "depth_near_dpt = 2.5")]);
    let geometry = Rig::parse(&text, Path::new("")).unwrap().geometry;
    assert_eq!((geometry.depth_far, geometry.depth_near), (Dioptres(0.25), Dioptres(2.5)));
    let quoted = Rig::parse(&changed(&[("= inf", "= \"inf\"")]), Path::new("")).unwrap();
    assert_eq!(quoted.geometry.depth_far, Dioptres(0.0));
}

#[test]
fn wavelengths_stand_under_their_own_colours() {
    let fault = fault_of("red = 638.0, green = 520.0", "red = 520.0, green = 638.0");
    assert_fault(
        &fault,
        "optics.wavelengths_nm",
        line_of("wavelengths_nm"),
        "520, 638 and 450 nm",
        "red longer",
        "own colour",
    );
}

#[test]
fn a_laser_box_needs_its_port() {
    check("driver = \"simulated\"", "driver = \"serial\"", "lasers.device", "nothing", "port", "/dev/holod-lasers");
    let fault = fault_of("driver = \"simulated\"", "driver = \"simulated\"\ndevice = \"/dev/ttyACM0\"");
    assert_fault(
        &fault,
        "lasers.device",
        line_of("driver").map(|line| line + 1),
        "simulated",
        "chosen driver",
        "take device out, or write driver = \"serial\" or \"ready-beam\"",
    );
}

#[test]
fn no_advice_has_a_figure_that_nobody_wrote() {
    let advice = |key: &str, given: &str| {
        let line = Rig::BUILT_IN_TOML.lines().find(|line| line.starts_with(key)).unwrap();
        let [fault] = faults_of(&changed(&[(line, &format!("{key} = {given}"))])).try_into().unwrap();
        assert_eq!(fault.key.split('.').next_back(), Some(key), "{fault}");
        fault.advice
    };
    let placeholder = "write it as { red = ..., green = ..., blue = ... }";
    let in_order = "if they are red, green and blue: write it as { red = ";
    for (key, given, expected) in [
        ("power_mw", "[1.2, 0.8, 1]", format!("{in_order}1.2, green = 0.8, blue = 1 }}")),
        ("wavelengths_nm", "[639, 532, 473]", format!("{in_order}639, green = 532, blue = 473 }}")),
        ("power_mw", "1.2", "write it as { red = 1.2, green = 1.2, blue = 1.2 }".into()),
        // Neither two numbers, nor one that is refused in the next round, nor texts say three powers.
        ("power_mw", "[1.2, 0.8]", placeholder.into()),
        ("power_mw", "[1.2, 0.8, 600]", placeholder.into()),
        ("power_mw", "600", placeholder.into()),
        ("power_mw", "\"1.2 0.8 1.0\"", placeholder.into()),
        ("power_mw", "[\"1.2\", \"0.8\", \"1.0\"]", placeholder.into()),
        ("stroke_pi", "[[1], [2], [3]]", placeholder.into()),
        ("wavelengths_nm", "[]", placeholder.into()),
    ] {
        assert_eq!(advice(key, given), expected, "{key} = {given}");
    }
    let beam = "driver = \"ready-beam\"\ndevice = \"/dev/x\"";
    for full_power in ["", "\nfull_power_mw = [40, 30]"] {
        let [fault] = with_driver(&format!("{beam}{full_power}\n{ACCEPTED}")).unwrap_err().faults.try_into().unwrap();
        assert!(fault.advice.contains("{ red = ..., green = ..., blue = ... }"), "{fault}");
    }
}

/// The driver's line with other lines in its place.
fn with_driver(lines: &str) -> Result<Rig, RigError> {
    Rig::parse(&changed(&[("driver = \"simulated\"", lines)]), Path::new("bench/rig.toml"))
}

const ACCEPTED: &str = "accept_no_heartbeat = \"these lasers stay lit when holod dies\"";
/// What lights lasers that cannot be switched for single fields in channel-packed mode.
const GATED: &str = "gated_by_panel = true";

#[test]
fn lasers_without_a_heartbeat_are_taken_only_where_the_rig_accepts_that_in_words() {
    let ready_beam =
        "driver = \"ready-beam\"\ndevice = \"/dev/x\"\nfull_power_mw = { red = 40, green = 30, blue = 50.5 }";
    let text = "driver = \"text\"\nprofile = \"cobolt\"\ndevices = { green = \"/dev/g\", blue = \"/dev/b\" }";
    for lines in [ready_beam, text] {
        for words in ["", "\naccept_no_heartbeat = \"yes\""] {
            let error = with_driver(&format!("{lines}\n{GATED}{words}")).unwrap_err();
            let [fault] = error.faults.as_slice() else { panic!("{error}") };
            assert_eq!(fault.key, "lasers.accept_no_heartbeat");
            assert!(fault.advice.contains("these lasers stay lit when holod dies"), "{fault}");
        }
        let rig = with_driver(&format!("{lines}\n{ACCEPTED}\n{GATED}")).unwrap();
        assert!(!rig.lasers.driver.has_heartbeat() && rig.lasers.accept_no_heartbeat && rig.lasers.gated_by_panel);
        match rig.lasers.driver {
            LaserDriver::ReadyBeam { path, full_power_uw } => {
                assert_eq!((path.to_str(), full_power_uw), (Some("/dev/x"), PerColour([40_000, 30_000, 50_500])));
            }
            LaserDriver::Text { profile, paths, transmission_ppb } => {
                assert_eq!(transmission_ppb, PerColour([1_000_000_000; 3]));
                assert_eq!(profile.as_ref(), TextLaserProfile::named("cobolt").unwrap());
                assert_eq!(paths, PerColour([None, Some("/dev/g".into()), Some("/dev/b".into())]));
            }
            other => panic!("{other:?}"),
        }
    }
}

const GREEN_ALONE: (&str, &str) = ("mode = \"channel-packed\"", "mode = \"monochrome\"\ncolour = \"green\"");
const SEQUENTIAL: (&str, &str) = ("mode = \"channel-packed\"", "mode = \"field-sequential\"");

#[test]
fn lasers_that_are_on_while_armed_are_lit_all_the_time() {
    let one = format!("driver = \"text\"\nprofile = \"cobolt\"\ndevices = {{ green = \"/dev/g\" }}\n{ACCEPTED}");
    let driver = |lines: &str| format!("{one}\n{lines}");
    let windowless = [("on_delay_ms = 0.1\n", ""), ("lit_ms = 3.0\n", "")];
    let rig = |changes: &[(&str, &str)]| Rig::parse(&changed(changes), Path::new("")).unwrap();
    let alone = driver("");
    let power = ("power_mw = { red = 1.0, green = 1.0, blue = 1.0 }", "power_mw = { green = 1.0 }");
    let meaning = rig(&[GREEN_ALONE, ("driver = \"simulated\"", &alone), power]).meaning();
    let text = meaning.to_string();
    for part in [
        "in one field   settled at 2.000 ms; the laser is on while it is armed: lit for 100 % of it",
        "\npower          green 1 mW without a power_limit_mw (500 at most)\n",
    ] {
        assert!(text.contains(part), "{part} is not in\n{text}");
    }
    assert!(!text.contains("red 1 mW") && !text.contains("so this colour stays dark"), "{text}");
    let json = serde_json::to_value(&meaning).unwrap();
    assert_eq!((&json["field"]["lit_share"], &json["field"]["time_share"]), (&json!(1.0), &json!(1.0)));
    for key in ["laser_on_ms", "laser_off_ms", "gated_by"] {
        assert_eq!(json["field"][key], json!(null), "{key}");
    }
    assert_eq!(json["lasers"]["power_mw"], json!({"red": null, "green": 1.0, "blue": null}));
    // Nothing is switched by the keys of a window, and so none of them is asked for.
    let windowless = rig(&[GREEN_ALONE, ("driver = \"simulated\"", &alone), windowless[0], windowless[1]]);
    assert_eq!(windowless.meaning().field, meaning.field);
    assert!(!windowless.meaning().to_string().contains("is cut"));
    // Nor is one judged that is there.
    let long = rig(&[GREEN_ALONE, ("driver = \"simulated\"", &alone), ("lit_ms = 3.0", "lit_ms = 20")]);
    assert_eq!((long.meaning().field, long.lasers), (windowless.meaning().field, windowless.lasers));
    let asked = faults_of(&changed(&[("lit_ms = 3.0\n", "")]));
    assert_eq!(asked[0].key, "lasers.lit_ms", "of lasers that are lit field by field");

    let gated = driver("gated_by_panel = true");
    let packed = rig(&[("driver = \"simulated\"", &gated)]).meaning();
    assert!(packed.to_string().contains("settled at 2.000 ms; lit as the panel gates the lasers"), "{packed}");
    let json = serde_json::to_value(&packed).unwrap();
    assert_eq!((&json["field"]["gated_by"], &json["field"]["lit_share"]), (&json!("panel"), &json!(null)));
    let alone = rig(&[GREEN_ALONE, ("driver = \"simulated\"", &gated)]).meaning();
    assert_eq!(alone.field.lit_share, Some(1.0));
    assert!(alone.notes.iter().any(|note| note.starts_with("gated_by_panel is without effect")), "{:?}", alone.notes);
    // Of several lasers one is shown in this mode.
    let all = rig(&[GREEN_ALONE]).meaning().to_string();
    assert!(all.contains("lit for 18 % of it, green for 18 % of the time"), "{all}");
    assert!(rig(&[]).meaning().to_string().contains("lit for 54 % of it, each colour for 18 % of the time"));
    assert!(all.contains("red 1 mW without a power_limit_mw (500 at most), not lit in this mode, green 1 mW"), "{all}");
}

#[test]
fn what_a_panel_does_in_channel_packed_mode_alone_is_refused_in_the_others() {
    let beam = "driver = \"ready-beam\"\ndevice = \"/dev/x\"\nfull_power_mw = { red = 9, green = 9, blue = 9 }";
    let gated = format!("{beam}\n{ACCEPTED}\ngated_by_panel = true");
    let wired = "driver = \"serial\"\ndevice = \"/dev/x\"\nsync_wire = true";
    for (lines, mode, key, advice) in [
        (gated.as_str(), SEQUENTIAL, "gated_by_panel", "show one colour"),
        (wired, SEQUENTIAL, "sync_wire", "take it out"),
        (wired, GREEN_ALONE, "sync_wire", "take it out"),
    ] {
        let text = changed(&[mode, ("driver = \"simulated\"", lines)]);
        let [fault] = faults_of(&text).try_into().unwrap();
        assert_eq!((fault.key, fault.line.is_some()), (format!("lasers.{key}"), true));
        assert!(fault.found.contains("true in ") && fault.expected.contains("channel-packed"), "{}", fault.expected);
        assert!(fault.advice.contains(advice), "{}", fault.advice);
        with_driver(lines).unwrap();
    }
    // A laser that has no such key is told of that alone.
    for mode in [
        SEQUENTIAL,
        ("field_order = [\"red\"", "channel_order = [\"green\", \"red\", \"blue\"]\nfield_order = [\"red\""),
    ] {
        let text = changed(&[
            mode,
            ("driver = \"simulated\"", "driver = \"serial\"\ndevice = \"/dev/x\"\ngated_by_panel = true"),
        ]);
        let [fault] = faults_of(&text).try_into().unwrap();
        assert!(fault.key == "lasers.gated_by_panel" && fault.found.contains("does not have"), "{}", fault.found);
    }
    // Nor can these be lit at all where nothing switches them for single fields.
    let bare = format!("{beam}\n{ACCEPTED}");
    for (modes, words) in [
        (&[("driver = \"simulated\"", bare.as_str())][..], &["gated_by_panel = true", "monochrome"][..]),
        (&[SEQUENTIAL, ("driver = \"simulated\"", &bare)], &["monochrome"]),
    ] {
        let [fault] = faults_of(&changed(modes)).try_into().unwrap();
        assert_eq!((fault.key.as_str(), fault.line.is_some()), ("lasers.driver", true));
        assert!(words.iter().all(|word| fault.advice.contains(word)), "{}", fault.advice);
        assert_eq!(fault.advice.contains("gated_by_panel"), words.len() == 2, "{}", fault.advice);
    }
    let late =
        changed(&[SEQUENTIAL, ("refresh_hz = 60.0", "refresh_hz = 180.0"), ("settle_ms = 2.0", "settle_ms = 7.5")]);
    let [fault] = faults_of(&late).try_into().unwrap();
    assert!(fault.advice.contains("panel.latency_ms"), "{}", fault.advice);
}

#[test]
fn a_panel_may_show_its_video_later() {
    assert_eq!(Rig::parse(&changed(&[]), Path::new("")).unwrap().panel.latency, TimeNs(0));
    let later = changed(&[("settle_ms = 2.0", "settle_ms = 2.0\nlatency_ms = 25")]);
    let rig = Rig::parse(&later, Path::new("")).unwrap();
    assert_eq!(rig.panel.latency, TimeNs(25_000_000));
    let meaning = rig.meaning();
    assert_eq!(meaning.field.latency_ms, 25.0);
    assert!(meaning.to_string().contains("\nlatency        25.000 ms, 1.50 refreshes: "), "{meaning}");
    let long = fault_of("settle_ms = 2.0", "settle_ms = 2.0\nlatency_ms = 16667");
    let line = line_of("settle_ms").map(|line| line + 1);
    assert_fault(&long, "panel.latency_ms", line, "16667", "0 to 100 ms", "looks like microseconds: write 16.667 ");
}

#[test]
fn a_laser_is_told_what_brings_its_power_to_the_panel() {
    let text = "driver = \"text\"\nprofile = \"cobolt\"\ndevices = { green = \"/dev/g\", blue = \"/dev/b\" }";
    let given = |lines: &str| with_driver(&format!("{text}\n{lines}\n{ACCEPTED}\n{GATED}"));
    let rig = given("transmission = { green = 0.3 }\nhead_limit_mw = { green = 4 }").unwrap();
    let driver = &rig.lasers.driver;
    let told = |colour, uw| driver.head_power_uw(colour, uw).unwrap();
    // Never more than that.
    assert_eq!((told(Colour::Green, 300), told(Colour::Green, 1000), told(Colour::Blue, 1000)), (1000, 3333, 1000));
    let meaning = rig.meaning();
    assert!(meaning.to_string().contains("\nat the laser   green 3.333 mW of at most 4, blue 1 mW\n"), "{meaning}");
    assert_eq!(meaning.lasers.power_mw.green, Some(1.0), "at the panel, as ever");
    let noted: Vec<_> = meaning.notes.iter().filter(|note| note.contains("transmission")).collect();
    assert!(matches!(&noted[..], [note] if note.starts_with("blue: ")), "{noted:?}");
    for (lines, key, words) in [
        ("transmission = { green = 30 }", "transmission.green", "percent"),
        ("transmission = { green = 0 }", "transmission.green", ""),
        ("transmission = { red = 0.3 }", "transmission.red", "name its port"),
        ("head_limit_mw = { red = 3 }", "head_limit_mw.red", "name its port"),
        // A slip in the share is one in what the laser gives, whatever the limit at the panel.
        ("transmission = { green = 0.3 }", "head_limit_mw", "write head_limit_mw = { green = ... }"),
        ("transmission = { green = 0.3 }\nhead_limit_mw = { blue = 4 }", "head_limit_mw.green", "add green"),
        (
            "transmission = { green = 0.03 }\nhead_limit_mw = { green = 4 }",
            "transmission.green",
            "correct transmission",
        ),
        ("transmission = { green = 0.0001 }\nhead_limit_mw = { green = 10000 }", "head_limit_mw.green", ""),
        ("head_limit_mw = { green = 0.9 }", "power_mw.green", "lower it"),
        ("full_power_mw = { red = 9, green = 9, blue = 9 }", "full_power_mw", "ready-beam"),
    ] {
        let [fault] = given(lines).unwrap_err().faults.try_into().unwrap();
        assert_eq!(fault.key, format!("lasers.{key}"));
        assert!(fault.advice.contains(words), "{fault}");
    }
    assert_eq!(Rig::default().lasers.driver.head_power_uw(Colour::Green, 1000), None);
}

#[test]
fn keys_of_another_laser_driver_and_keys_that_lack_are_named() {
    for (lines, key, words) in [
        ("driver = \"serial\"\ndevice = \"/dev/x\"\ngated_by_panel = true", "gated_by_panel", "ready-beam"),
        ("driver = \"simulated\"\nsync_wire = true", "sync_wire", "serial"),
        ("driver = \"ready-beam\"\ndevice = \"/dev/x\"", "full_power_mw", "full_power_mw = {"),
        ("driver = \"text\"\nprofile = \"cobolt\"", "devices", "devices = {"),
        ("driver = \"text\"\ndevices = { red = \"/dev/x\" }", "profile", "profile = "),
        ("driver = \"text\"\nprofile = \"cobold\"\ndevices = { red = \"/dev/x\" }", "profile", "did you mean"),
        (
            "driver = \"text\"\nprofile = \"cobolt\"\ndevices = { red = \"/dev/x\", blue = \"/dev/x\" }",
            "devices.blue",
            "own port",
        ),
        ("driver = \"text\"\nprofile_file = \"none.toml\"\ndevices = { red = \"/dev/x\" }", "profile_file", "path"),
    ] {
        let error = with_driver(&format!("{lines}\n{ACCEPTED}")).unwrap_err();
        let fault = error.faults.iter().find(|fault| fault.key == format!("lasers.{key}"));
        let fault = fault.unwrap_or_else(|| panic!("{lines}: {error}"));
        assert!(fault.line.is_some() && fault.advice.contains(words), "{fault}");
    }
}

#[test]
fn one_port_of_two_names_is_one_port() {
    let folder = tempfile::tempdir().unwrap();
    let [port, other, alias] = ["port", "other", "alias"].map(|name| folder.path().join(name));
    std::fs::write(&port, "").unwrap();
    std::fs::write(&other, "").unwrap();
    std::os::unix::fs::symlink(&port, &alias).unwrap();
    let faults = |red: &Path, blue: &Path| {
        let lines = format!(
            "driver = \"text\"\nprofile = \"cobolt\"\ndevices = {{ red = {red:?}, blue = {blue:?} }}\n{ACCEPTED}"
        );
        with_driver(&lines).err().map_or(Vec::new(), |error| error.faults)
    };
    let keys = |faults: Vec<Fault>| faults.into_iter().map(|fault| fault.key).collect::<Vec<_>>();
    let (apart, one) = (keys(faults(&port, &other)), keys(faults(&port, &alias)));
    assert!(!apart.contains(&"lasers.devices.blue".into()), "{apart:?}");
    assert!(one.contains(&"lasers.devices.blue".into()), "{one:?}");
}

#[test]
fn a_power_above_the_benchs_limit_is_refused() {
    let limited = "driver = \"simulated\"\npower_limit_mw = { red = 2.0, green = 0.5 }";
    let error = with_driver(limited).unwrap_err();
    let [fault] = error.faults.as_slice() else { panic!("{error}") };
    assert_eq!((fault.key.as_str(), fault.line.is_some()), ("lasers.power_mw.green", true));
    assert!(fault.expected.contains("0.5 mW") && fault.advice.starts_with("lower it"), "{fault}");
    // Of 120 it may be said that they are microwatts; of what is a little too much not.
    let advice = |power: &str, limit: &str| {
        let lines = format!("driver = \"simulated\"\npower_limit_mw = {{ green = {limit} }}");
        let text = changed(&[("driver = \"simulated\"", &lines), ("green = 1.0", &format!("green = {power}"))]);
        let [fault] = faults_of(&text).try_into().unwrap();
        fault.advice
    };
    assert_eq!(advice("120", "2"), "120 looks like microwatts: write 0.12 for 0.12 mW");
    assert_eq!(advice("1200", "2"), "1200 looks like microwatts: write 1.2 for 1.2 mW");
    for (power, limit) in [("2.5", "2"), ("19", "2"), ("1", "0")] {
        assert!(advice(power, limit).starts_with("lower it"), "{power} of {limit}");
    }
    let rig = with_driver("driver = \"simulated\"\npower_limit_mw = { red = 2.0 }").unwrap();
    assert_eq!(rig.lasers.power_limit_mw, PerColour([Some(2.0), None, None]));
}

#[test]
fn faults_of_a_laser_profile_are_told_with_its_own_lines() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("mine.toml"), "description = \"mine\"\n[line]\nbaud = 3\n").unwrap();
    let lines =
        format!("driver = \"text\"\nprofile_file = \"mine.toml\"\ndevices = {{ red = \"/dev/x\" }}\n{ACCEPTED}");
    let text = changed(&[("driver = \"simulated\"", &lines)]);
    let error = Rig::parse(&text, &folder.path().join("rig.toml")).unwrap_err();
    assert!(error.faults.len() > 3 && error.faults.iter().all(|fault| fault.key == "lasers.profile_file"), "{error}");
    assert!(error.faults.iter().any(|fault| fault.found.contains("mine.toml line 3, line.baud: 3")), "{error}");
}

#[test]
fn broken_toml_names_every_line_that_is_broken() {
    let text = changed(&[("width_px = 1920", "width_px = = 1920"), ("lit_ms = 3.0", "lit_ms 3.0")]);
    let faults = faults_of(&text);
    assert_eq!(faults.iter().map(|fault| fault.line).collect::<Vec<_>>(), [line_of("width_px"), line_of("lit_ms")]);
    assert_fault(&faults[0], "", line_of("width_px"), "`width_px = = 1920`", "TOML", "");
    let twice = fault_of("settle_ms = 2.0", "settle_ms = 2.0\nsettle_ms = 3.0");
    assert_fault(&twice, "", line_of("settle_ms").map(|line| line + 1), "`settle_ms = 3.0`", "TOML", "duplicate");
    let header = fault_of("[lasers]", "[lasers");
    assert_eq!(header.line, line_of("[lasers]"));
}

fn folder_error(make: impl FnOnce(&Path) -> PathBuf) -> RigError {
    let folder = tempfile::tempdir().unwrap();
    Rig::load(&make(folder.path())).unwrap_err()
}

#[test]
fn files_that_are_no_rig_file_are_named() {
    let missing = folder_error(|folder| folder.join("none.toml"));
    assert!(missing.origin.ends_with("none.toml") && missing.to_string().contains("No such file"), "{missing}");
    let directory = folder_error(Path::to_path_buf);
    assert!(directory.to_string().contains("a directory"), "{directory}");
    let binary = folder_error(|folder| {
        let path = folder.join("binary.toml");
        fs::write(&path, b"name = \"x\"\n# caf\xe9\n").unwrap();
        path
    });
    assert!(binary.to_string().contains("line 2 is not UTF-8"), "{binary}");
}

#[test]
fn a_profile_gives_way_to_explicit_keys() {
    let text = changed(&[
        ("width_px = 1920", "profile = \"holoeye-gaea-2.1\""),
        ("height_px = 1080\n", "\n"),
        ("pixel_pitch_um = 8.0", ""),
    ]);
    let rig = Rig::parse(&text, Path::new("")).unwrap();
    assert_eq!((rig.resolution(), rig.pixel_pitch()), (Resolution { width: 4160, height: 2464 }, Metres(3.74e-6)));
    assert!(rig.meaning().notes.iter().any(|note| note.contains("no source confirms width_px")));
    let pitch = Rig::parse(&text.replace("[optics]", "pixel_pitch_um = 3.7\n[optics]"), Path::new("")).unwrap();
    assert_eq!((pitch.resolution().width, pitch.pixel_pitch()), (4160, Metres(3.7e-6)));
}

#[test]
fn a_misspelt_profile_is_one_fault() {
    let text = changed(&[
        ("width_px = 1920", "profile = \"holoeye-plut\""),
        ("height_px = 1080\n", "\n"),
        ("pixel_pitch_um = 8.0", ""),
        ("refresh_hz = 60.0", ""),
        ("bit_depth = 8", ""),
    ]);
    let keys: Vec<String> = faults_of(&text).into_iter().map(|fault| fault.key).collect();
    assert_eq!(keys, ["panel.profile"]);
}

#[test]
fn every_profile_makes_a_rig() {
    for profile in PanelProfile::all() {
        let text = Rig::BUILT_IN_TOML
            .replace("width_px = 1920", &format!("profile = \"{}\"", profile.name))
            .replace("height_px = 1080", "")
            .replace("pixel_pitch_um = 8.0", "")
            .replace("refresh_hz = 60.0", "")
            .replace("bit_depth = 8", "")
            .replace("channel-packed", "field-sequential");
        let rig = Rig::parse(&text, Path::new("")).unwrap_or_else(|error| panic!("{}: {error}", profile.name));
        assert_eq!(rig.meaning().panel_profile.as_deref(), Some(profile.name));
    }
}

/// A folder with a rig file that names `name` under `key` for green, and that file.
fn load_with_file(key: &str, name: &str, write: impl FnOnce(&Path)) -> Result<Rig, RigError> {
    let folder = tempfile::tempdir().unwrap();
    write(&folder.path().join(name));
    let rig = folder.path().join("rig.toml");
    let text = changed(&[
        ("settle_ms = 2.0", &format!("settle_ms = 2.0\n{key} = {{ green = \"{name}\" }}")),
        ("width_px = 1920", "width_px = 64"),
        ("height_px = 1080", "height_px = 66"),
    ]);
    fs::write(&rig, text).unwrap();
    Rig::load(&rig)
}

fn lut_csv(phase_rad: impl Fn(usize) -> f64) -> String {
    let rows: Vec<String> = (0..256).map(|level| format!("{level},{}", phase_rad(level))).collect();
    format!("level,phase_rad\n# at 520 nm\n{}\n", rows.join("\n"))
}

fn load_lut(csv: &str) -> Result<Rig, RigError> {
    load_with_file("lut_file", "green.csv", |path| fs::write(path, csv).unwrap())
}

#[track_caller]
fn assert_lut_fault(csv: &str, found: &str, expected: &str) {
    let error = load_lut(csv).expect_err("a fault");
    assert_eq!(error.faults.len(), 1, "{error}");
    assert_fault(
        &error.faults[0],
        "panel.lut_file.green",
        line_of("settle_ms").map(|line| line + 1),
        found,
        expected,
        "",
    );
}

/// A rising table that ends at the stroke of the built-in rig.
fn straight(level: usize) -> f64 {
    level as f64 * TAU / 256.0
}

#[test]
fn a_lut_is_read_and_named_among_the_active_files() {
    let rig = load_lut(&lut_csv(|level| 0.1 + straight(level))).unwrap();
    let lut = rig.panel.lut[Colour::Green].as_ref().unwrap();
    assert_eq!((lut.len(), lut[0], lut[7]), (256, entry(0, 0.1), entry(7, 0.1 + straight(7))));
    assert!((rig.panel.stroke_rad[Colour::Green] - straight(255)).abs() < 1e-12);
    assert!(rig.panel.lut[Colour::Red].is_none());
    let files = rig.meaning().files;
    assert_eq!((files.len(), files[0].kind.as_str(), files[0].colour.as_str()), (1, "lut", "green"));
    assert!(files[0].path.is_absolute() && files[0].path.ends_with("green.csv"));
    let one_column: String = (0..256).map(|level| format!("{}\n", straight(level))).collect();
    assert_eq!(
        load_lut(&one_column).unwrap().panel.lut[Colour::Green].as_ref().unwrap()[255],
        entry(255, straight(255))
    );
}

#[test]
fn a_table_whose_range_is_like_multiples_of_pi_is_asked_for_its_unit() {
    let in_pi = "; where the phases in its table are multiples of π, multiply them by π";
    let [green] = strokes_told(&load_sparse_lut("0,0.0\n255,1.9921875\n").unwrap()).try_into().unwrap();
    assert!(green.starts_with("green: the panel's stroke is 0.634 π; ") && green.ends_with(in_pi), "{green}");
    let eleven: String = (0..11).map(|step| format!("{},{}\n", 20 * step, 0.5 * f64::from(step))).collect();
    let [green] = strokes_told(&load_sparse_lut(&eleven).unwrap()).try_into().unwrap();
    assert!(green.starts_with("green: the panel's stroke is 1.592 π; ") && !green.contains(in_pi), "{green}");
    // Without a table there is nothing to multiply.
    let text = changed(&[("green = 1.9921875", "green = 0.634")]);
    let [green] = strokes_told(&Rig::parse(&text, Path::new("")).unwrap()).try_into().unwrap();
    assert!(!green.contains(in_pi), "{green}");
    assert!(load_lut(&lut_csv(straight)).unwrap().warnings().is_empty());
}

#[test]
fn short_strokes_of_colours_that_are_not_lit_are_not_told() {
    let short = ("red = 1.9921875", "red = 0.8");
    let told = |changes: &[(&str, &str)]| strokes_told(&Rig::parse(&changed(changes), Path::new("")).unwrap()).len();
    assert_eq!(told(&[short]), 1);
    assert_eq!(told(&[short, ("power_mw = { red = 1.0", "power_mw = { red = 0.0")]), 0);
    let monochrome = ("mode = \"channel-packed\"", "mode = \"monochrome\"\ncolour = \"green\"");
    assert_eq!(told(&[short, monochrome]), 0);
}

fn strokes_told(rig: &Rig) -> Vec<String> {
    rig.warnings().into_iter().filter(|said| said.contains("the panel's stroke is")).collect()
}

/// A gap is what is wider than a step of the table's own levels, wherever on the circle it is.
#[test]
fn a_table_of_few_levels_all_round_has_no_short_stroke() {
    let eighth = |of_step: fn(u32) -> u32| -> Rig {
        let rows = (0..32).map(|step| format!("{},{}\n", 8 * step, f64::from(of_step(step)) * TAU / 32.0));
        load_sparse_lut(&rows.collect::<String>()).unwrap()
    };
    for (rig, is_in_order) in [(eighth(|step| step), true), (eighth(|step| step * 5 % 32), false)] {
        assert_eq!(strokes_told(&rig), Vec::<String>::new());
        let told = rig.warnings();
        assert!(told[0].starts_with("green: of 256 levels only the 32 in the table are used"), "{told:?}");
        match &told[1..] {
            [] => assert!(is_in_order),
            [unsigned] => assert!(!is_in_order && unsigned.contains("phase_sign is not applied"), "{unsigned}"),
            more => panic!("{more:?}"),
        }
    }
    // Of steps 0 to 3 none.
    let [green] = strokes_told(&eighth(|step| 4 + step * 5 % 28)).try_into().unwrap();
    assert!(green.starts_with("green: the panel's stroke is 1.688 π"), "{green}");
}

/// Of phases in any order neither the sign nor the first turn is known, and one noisy reading is not that.
#[test]
fn a_table_of_few_levels_that_steps_back_a_little_is_a_fault() {
    let table = |noise: f64| {
        let phase = |level: usize| if level == 8 { -noise } else { (level as f64 / 248.0).powi(2) * 2.257 * PI };
        (0..32).map(|step| format!("{},{:.4}\n", 8 * step, phase(8 * step))).collect::<String>()
    };
    let [fault] = load_sparse_lut(&table(0.004)).unwrap_err().faults.try_into().unwrap();
    assert_eq!(fault.key, "panel.lut_file.green");
    assert!(fault.found.contains("phase 0 at level 0, phase -0.004 at level 8"), "{fault}");
    assert!(fault.advice.starts_with("smooth the measurement, or leave out level 8; `holod lut`"), "{fault}");
    let smooth: String =
        table(0.004).lines().filter(|row| !row.starts_with("8,")).map(|row| format!("{row}\n")).collect();
    let told = load_sparse_lut(&smooth).unwrap().warnings();
    assert!(!told.iter().any(|told| told.contains("phase_sign")), "{told:?}");
    // The more noise, the more rows step back, and none of them is an order of its own.
    let mut state = 1u64;
    let mut noise = move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as f64 / f64::from(1u32 << 31) - 0.5
    };
    for (noise_rad, rows_back_min) in [(0.04, 10), (0.08, 30), (0.16, 60)] {
        let of_255: Vec<f64> =
            (0..255).map(|level| f64::from(level) * 2.2 * PI / 255.0 + noise_rad * noise()).collect();
        let back = of_255.windows(2).filter(|pair| pair[1] < pair[0]).count();
        assert!(back >= rows_back_min, "{noise_rad}: {back}");
        let csv: String = of_255.iter().enumerate().map(|(level, phase)| format!("{level},{phase}\n")).collect();
        let [fault] = load_sparse_lut(&csv).unwrap_err().faults.try_into().unwrap();
        assert!(fault.found.contains(&format!("the first of {back} rows that step back")), "{fault}");
        assert!(fault.advice.contains("`holod lut`") && !fault.advice.contains("leave out"), "{fault}");
    }
    // In no order there is as much back as forward.
    for step in [7, 101, 150] {
        let csv: String =
            (0..255).map(|level| format!("{level},{}\n", f64::from(level * step % 255) * 0.026)).collect();
        let told = load_sparse_lut(&csv).unwrap().warnings();
        assert!(told.iter().any(|told| told.contains("phase_sign is not applied")), "{step}: {told:?}");
    }
    // Of few rows one step back is an order.
    let told = load_sparse_lut("0,0\n60,2\n120,1\n180,4\n255,6\n").unwrap().warnings();
    assert!(told.iter().any(|told| told.contains("phase_sign is not applied")), "{told:?}");
}

#[test]
fn a_table_for_a_panel_of_fewer_bits_is_refused() {
    for (bits, rows) in [(7, 128), (6, 64)] {
        let csv: String = (0..rows).map(|level| format!("{level},{}\n", f64::from(level) * TAU / 256.0)).collect();
        let fault = load_sparse_lut(&csv).unwrap_err().to_string();
        assert!(fault.contains(&format!("a table of {bits} bits")) && fault.contains("correct bit_depth"), "{fault}");
    }
    let all_but_one: String = (0..127).map(|level| format!("{level},{}\n", f64::from(level) * 0.02)).collect();
    assert!(load_sparse_lut(&all_but_one).is_ok());
}

#[test]
fn a_byte_order_mark_before_a_text_is_no_part_of_it() {
    let table = |csv: &str| load_lut(csv).unwrap().panel.lut[Colour::Green].clone();
    let bare: String = (0..256).map(|level| format!("{level},{}\n", straight(level))).collect();
    let one_column: String = (0..256).map(|level| format!("{}\n", straight(level))).collect();
    for csv in [&bare, &one_column, &lut_csv(straight), &format!("# measured\n{bare}")] {
        assert_eq!(table(&format!("\u{feff}{csv}")), table(csv));
    }
    assert_lut_fault("\u{feff}100,0.5\n20,0.1\n", "green.csv: row 2 `20,0.1` should be level 101", "");

    let folder = tempfile::tempdir().unwrap();
    let rig = folder.path().join("rig.toml");
    fs::write(&rig, format!("\u{feff}{}", Rig::BUILT_IN_TOML)).unwrap();
    assert_eq!(Rig::load(&rig).unwrap().panel, Rig::default().panel);
}

fn entry(level: u16, phase_rad: f64) -> LevelPhase {
    LevelPhase { level, phase_rad }
}

/// The built-in rig whose green may have a stroke of any size, with a table of its own.
fn load_sparse_lut(csv: &str) -> Result<Rig, RigError> {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("green.csv"), csv).unwrap();
    let text = changed(&[(", green = 1.9921875", ""), ("settle_ms", "lut_file.green = \"green.csv\"\nsettle_ms")]);
    Rig::parse(&text, &folder.path().join("rig.toml"))
}

#[test]
fn a_lut_may_name_few_levels_with_phases_in_any_order() {
    let table = [entry(3, 0.5), entry(17, 0.1), entry(200, 5.0), entry(255, 2.25)];
    let csv: String = table.iter().map(|row| format!("{},{}\n", row.level, row.phase_rad)).collect();
    let rig = load_sparse_lut(&csv).unwrap();
    assert_eq!(rig.panel.lut[Colour::Green].as_deref(), Some(&table[..]));
    assert!((rig.panel.stroke_rad[Colour::Green] - 4.9).abs() < 1e-12);
    let notes = rig.meaning().notes;
    assert!(
        notes.iter().any(|note| note.contains("green: of 256 levels only the 4 in the table are used")),
        "{notes:?}"
    );

    for (csv, found) in [
        ("3,0.5\n2,5.0\n", "row 2 `2,5.0` should be level 4 or higher"),
        ("3,0.5\n3,5.0\n", "row 2 `3,5.0` should be level 4 or higher"),
        ("3,0.5\n256,5.0\n", "row 2 `256,5.0` has no level of 0 to 255"),
        ("3,0.5\n4.5,5.0\n", "row 2 `4.5,5.0` has no level"),
        ("3,0.5\n5.0\n", "2 rows"),
        ("3,0.5\n", "1 rows"),
        ("", "0 rows"),
        ("# nothing\n", "0 rows"),
        ("3,0.5\n200,0.6\n", "changes by 0.032 π"),
    ] {
        let error = load_sparse_lut(csv).expect_err(csv);
        assert!(error.to_string().contains(found), "{csv:?}: {error}");
    }
    let falling = load_sparse_lut("0,5.0\n100,2.0\n200,0.0\n").unwrap_err();
    assert!(falling.to_string().contains("a rising table, as phase_sign"), "{falling}");
}

#[test]
fn sixteen_bits_have_a_table_of_65536_levels_at_most() {
    let rows: String = (0..=65536).map(|level| format!("{}\n", f64::from(level) * 1e-4)).collect();
    let folder = tempfile::tempdir().unwrap();
    let parse = |csv: &str| {
        fs::write(folder.path().join("green.csv"), csv).unwrap();
        let text = changed(&[
            (", green = 1.9921875", ""),
            ("settle_ms", "lut_file.green = \"green.csv\"\nsettle_ms"),
            ("bit_depth = 8", "bit_depth = 16\npacking = \"red8-green8\""),
            ("channel-packed", "field-sequential"),
        ]);
        Rig::parse(&text, &folder.path().join("rig.toml"))
    };
    let one_too_many = parse(&rows).unwrap_err();
    assert!(one_too_many.to_string().contains("row 65537 `6.5536"), "{one_too_many}");
    let rig = parse(rows.rsplit_once("6.5536").unwrap().0).unwrap();
    assert_eq!((rig.panel.packing, rig.panel.lut[Colour::Green].as_ref().unwrap().len()), (Packing::Red8Green8, 65536));
}

#[test]
fn a_packing_fits_the_bits_and_the_mode() {
    let ten = |packing: &str| fault_of("bit_depth = 8", &format!("bit_depth = 10\n{packing}"));
    let (bits, packing) = (line_of("bit_depth"), line_of("bit_depth").map(|line| line + 1));
    let either = "\"gray10\" or \"red8-blue2\" or \"red3-green3-blue4\", as bit_depth is 10";
    assert_fault(&ten(""), "panel.packing", bits, "nothing", either, "add packing");
    assert_fault(&ten("packing = \"gray\""), "panel.packing", packing, "carries 8 bits", either, "correct packing");
    assert_fault(
        &ten("packing = \"red8blue2\""),
        "panel.packing",
        packing,
        "red8blue2",
        "",
        "did you mean \"red8-blue2\"?",
    );
    let packed = ten("packing = \"red8-blue2\"");
    let found = "\"red8-blue2\" in mode \"channel-packed\"";
    assert_fault(&packed, "panel.packing", packing, found, "\"gray\" or \"gray10\"", "\"field-sequential\"");
    let deep = changed(&[("bit_depth = 8", "bit_depth = 10\npacking = \"gray10\"")]);
    assert_eq!(Rig::parse(&deep, Path::new("")).unwrap().panel.packing, Packing::Gray10);
    let wide = fault_of("bit_depth = 8", "bit_depth = 8\npacking = \"red8-green8\"");
    assert_fault(&wide, "panel.packing", packing, "carries 16 bits", "\"gray\", as bit_depth is 8", "");
    let sequential = changed(&[
        ("bit_depth = 8", "bit_depth = 10\npacking = \"red8-blue2\""),
        ("channel-packed", "field-sequential"),
    ]);
    let rig = Rig::parse(&sequential, Path::new("")).unwrap();
    assert_eq!((rig.panel.bit_depth, rig.panel.packing), (10, Packing::Red8Blue2));
    assert!(rig.meaning().to_string().contains("levels         10 bits, packing red8-blue2"), "{}", rig.meaning());
}

#[test]
fn what_becomes_of_phases_out_of_stroke_is_chosen() {
    for way in OutOfStroke::ALL {
        let text = changed(&[
            ("blue = 1.9921875", "blue = 1.5"),
            ("settle_ms", &format!("out_of_stroke = \"{}\"\nsettle_ms", way.name())),
        ]);
        let rig = Rig::parse(&text, Path::new("")).unwrap();
        assert_eq!(rig.panel.out_of_stroke, way);
        let notes = rig.meaning().notes;
        assert!(notes.iter().any(|note| note.starts_with("blue") && note.ends_with(way.meaning())), "{notes:?}");
    }
    let line = line_of("settle_ms");
    let wrong = fault_of("settle_ms", "out_of_stroke = \"compress\"\nsettle_ms");
    assert_fault(
        &wrong,
        "panel.out_of_stroke",
        line,
        "\"compress\"",
        "\"nearest\", \"clip\", \"zero\", \"scale\"",
        "choose one",
    );
}

#[test]
fn how_patterns_lie_is_chosen() {
    assert_eq!(Rig::parse(&changed(&[]), Path::new("")).unwrap().panel.orientation, Orientation::Normal);
    for orientation in Orientation::ALL {
        let text = changed(&[("settle_ms", &format!("orientation = \"{}\"\nsettle_ms", orientation.name()))]);
        assert_eq!(Rig::parse(&text, Path::new("")).unwrap().panel.orientation, orientation);
    }
    let (instead, choices) =
        ("orientation = \"flipped\"\nsettle_ms", "\"normal\", \"half-turn\", \"mirror-x\", \"mirror-y\"");
    assert_fault(
        &fault_of("settle_ms", instead),
        "panel.orientation",
        line_of("settle_ms"),
        "\"flipped\"",
        choices,
        "choose one",
    );
}

#[test]
fn a_faulty_lut_names_its_file_and_row() {
    let good = lut_csv(straight);
    assert_lut_fault(&good.replacen("\n3,", "\n3;", 1), "green.csv: row 6 `3;0.07", "256 rows");
    assert_lut_fault(&good.replacen("\n5,", "\n6,", 1), "row 9 `6,0.14", "");
    assert_lut_fault(&good.replacen("\n5,", "\n5,nan #", 1), "row 8 `5,nan #", "");
    assert_lut_fault(&good.replacen("\n9,", "\n9,9e9\n#", 1), "row 12 `9,9e9` has no phase in radians", "");
    assert_lut_fault(&good.replacen("\n9,", "\n9,1,", 1), "has more than two columns", "");
    let one_column: String = (0..255).map(|level| format!("{}\n", straight(level))).collect();
    assert_lut_fault(&one_column, "255 rows", "256 rows");
    assert_lut_fault(
        &lut_csv(|level| straight(level) + if level == 40 { 0.1 } else { 0.0 }),
        "at level 40",
        "monotonic",
    );
    assert_lut_fault(&lut_csv(|level| straight(level) / TAU), "changes by 0.317 π", "0.5 to 6 π");
    let turns = load_lut(&lut_csv(|level| straight(level) / TAU)).unwrap_err().to_string();
    assert!(turns.contains("in radians: multiply turns by 2π, multiples of π by π"), "{turns}");
    assert_lut_fault(&lut_csv(|level| -straight(level)), "-1.992 π", "a rising table");
    assert_lut_fault(&lut_csv(|level| straight(level) * 1.03), "2.052 π", "1.992 π that stroke_pi states");
    for (unit_rad, cure) in
        [(PI, "like multiples of π: multiply them by 3.14159"), (TAU, "like turns: multiply them by 6.28319")]
    {
        // Of a stroke of 3.98 π the turns are a range of radians that a table may have.
        let stroke_pi = 1.9921875 * unit_rad / PI;
        let text = changed(&[
            ("settle_ms", "lut_file.green = \"green.csv\"\nsettle_ms"),
            ("green = 1.9921875", &format!("green = {stroke_pi}")),
        ]);
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("green.csv"), lut_csv(|level| straight(level) / PI)).unwrap();
        let refused = Rig::parse(&text, &folder.path().join("rig.toml")).unwrap_err().to_string();
        assert!(refused.contains(cure) && !refused.contains("take stroke_pi out"), "{refused}");
    }
    assert_lut_fault(&good.replace(',', ";"), "and 253 rows more", "");
    let missing = load_with_file("lut_file", "green.csv", |_| ()).unwrap_err();
    assert!(missing.to_string().contains("green.csv: No such file"), "{missing}");
    let directory = load_with_file("lut_file", "green.csv", |path| fs::create_dir(path).unwrap()).unwrap_err();
    assert!(directory.to_string().contains("a directory"), "{directory}");
}

#[test]
fn a_falling_lut_goes_with_the_negative_sign() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("green.csv"), lut_csv(|level| -straight(level))).unwrap();
    let text = changed(&[
        ("phase_sign = \"positive\"", "phase_sign = \"negative\"\nlut_file.green = \"green.csv\""),
        (", green = 1.9921875", ""),
    ]);
    let rig = Rig::parse(&text, &folder.path().join("rig.toml")).unwrap();
    assert!((rig.panel.stroke_rad[Colour::Green] - straight(255)).abs() < 1e-12);
    let rising = Rig::parse(&text.replace("negative", "positive"), &folder.path().join("rig.toml")).unwrap_err();
    assert!(rising.to_string().contains("phase_sign = \"negative\""), "{rising}");
}

#[test]
fn a_flatness_picture_is_read_at_either_depth() {
    let rig = load_with_file("flatness_file", "flat.png", |path| {
        GrayImage::from_fn(64, 66, |x, y| Luma([(x + 64 * y) as u8])).save(path).unwrap();
    });
    let rig = rig.unwrap();
    let flatness_rad = rig.panel.flatness_rad[Colour::Green].as_ref().unwrap();
    assert_eq!(flatness_rad.len(), 64 * 66);
    assert!((flatness_rad[128] - std::f32::consts::PI).abs() < 1e-6 && flatness_rad[256] == 0.0);
    assert_eq!(rig.meaning().files[0].kind, "flatness");
    let rig = load_with_file("flatness_file", "flat.png", |path| {
        ImageBuffer::<Luma<u16>, Vec<u16>>::from_pixel(64, 66, Luma([16384])).save(path).unwrap();
    });
    let flatness_rad = &rig.unwrap().panel.flatness_rad;
    assert!((f64::from(flatness_rad[Colour::Green].as_ref().unwrap()[0]) - PI / 2.0).abs() < 1e-6);
}

#[test]
fn a_faulty_flatness_picture_is_named() {
    type Write = fn(&Path);
    /// 64x66 pixels of 4 bits, all 1.
    const FOUR_BITS: &[u8] = b"\x89PNG\x0d\x0a\x1a\x0a\
        \x00\x00\x00\x0dIHDR\x00\x00\x00\x40\x00\x00\x00B\x04\x00\x00\x00\x00\x07:b\x08\
        \x00\x00\x00 IDATx\xdac\x10\x24\x00\x18F\x15\x8c\x2a\x18U0\
        \xaa\x60T\xc1\xa8\x82Q\x05\xa3\x0a\xa8\xad\x00\x00\xc7\xae\x8cAi9\x96\xcd\
        \x00\x00\x00\x00IEND\xaeB\x60\x82";
    let cases: [(Write, &str); 8] = [
        (|path| GrayImage::new(66, 64).save(path).unwrap(), "66x64 pixels"),
        (|path| fs::write(path, FOUR_BITS).unwrap(), "grays of 4 bits"),
        (
            |path| {
                let mut picture = RgbImage::new(64, 66);
                picture.put_pixel(5, 40, Rgb([7, 7, 8]));
                picture.save(path).unwrap();
            },
            "the colour 7, 7, 8 at column 5 of row 40",
        ),
        (|path| RgbaImage::new(64, 66).save(path).unwrap(), "Rgba8 pixels"),
        (|path| RgbImage::new(64, 66).save_with_format(path, ImageFormat::Jpeg).unwrap(), "neither PNG nor BMP"),
        (|path| GrayImage::new(66, 64).save_with_format(path, ImageFormat::Bmp).unwrap(), "66x64 pixels"),
        (|path| fs::write(path, b"no picture").unwrap(), "neither PNG nor BMP"),
        (
            |path| {
                GrayImage::from_fn(64, 66, |x, y| Luma([(x * y) as u8])).save(path).unwrap();
                let bytes = fs::read(path).unwrap();
                fs::write(path, &bytes[..bytes.len() / 2]).unwrap();
            },
            "flat.png: ",
        ),
    ];
    for (write, found) in cases {
        let error = load_with_file("flatness_file", "flat.png", write).expect_err(found);
        assert_eq!(error.faults.len(), 1, "{error}");
        let line = line_of("settle_ms").map(|line| line + 1);
        assert_fault(&error.faults[0], "panel.flatness_file.green", line, found, "64x66 pixels", "");
    }
}

/// A BMP of 64x66 pixels as vendors write them: 8 bits with a palette, rows from the bottom up. Byte `x + 64 y` from
/// the top is `index`; `palette` gives red, green and blue of an index.
fn paletted_bmp(index: impl Fn(usize) -> u8, palette: impl Fn(u8) -> [u8; 3]) -> Vec<u8> {
    const HEADERS: u32 = 14 + 40;
    const PALETTE: u32 = 4 * 256;
    let pixels = 64 * 66;
    let mut file = b"BM".to_vec();
    for word in [HEADERS + PALETTE + pixels, 0, HEADERS + PALETTE, 40, 64, 66] {
        file.extend(word.to_le_bytes());
    }
    file.extend(1u16.to_le_bytes());
    file.extend(8u16.to_le_bytes());
    for word in [0, pixels, 2835, 2835, 256, 0] {
        file.extend(word.to_le_bytes());
    }
    for entry in 0..=255 {
        let [red, green, blue] = palette(entry);
        file.extend([blue, green, red, 0]);
    }
    for row in (0..66).rev() {
        file.extend((0..64).map(|column| index(64 * row + column)));
    }
    file
}

fn load_flatness(bmp: &[u8], keys: &str) -> Result<Rig, RigError> {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("vendor.bmp"), bmp).unwrap();
    let text = changed(&[
        ("settle_ms = 2.0", &format!("settle_ms = 2.0\nflatness_file.green = \"vendor.bmp\"\n{keys}")),
        ("width_px = 1920", "width_px = 64"),
        ("height_px = 1080", "height_px = 66"),
    ]);
    Rig::parse(&text, &folder.path().join("rig.toml"))
}

#[test]
fn a_vendors_bmp_is_read_right_side_up_with_its_own_gray_of_2pi_and_sign() {
    let bmp = paletted_bmp(|pixel| (pixel / 64) as u8, |gray| [gray; 3]);
    let flatness = |keys| {
        let rig = load_flatness(&bmp, keys).unwrap();
        let flatness_rad = rig.panel.flatness_rad[Colour::Green].clone().unwrap();
        // Row 0 is gray 0, row 65 gray 65.
        [flatness_rad[63], flatness_rad[64], flatness_rad[64 * 65]].map(f64::from)
    };
    let close = |found: [f64; 3], expected: [f64; 3]| {
        found.iter().zip(expected).all(|(found, expected)| (found - expected).abs() < 1e-6)
    };
    let step = TAU / 256.0;
    assert!(close(flatness(""), [0.0, step, 65.0 * step]), "{:?}", flatness(""));
    let hamamatsu = TAU / 105.0;
    let scaled = flatness("flatness_2pi_gray = { green = 105 }");
    assert!(close(scaled, [0.0, hamamatsu, 65.0 * hamamatsu]), "{scaled:?}");
    let taken_off = flatness("flatness_sign = \"subtract\"");
    assert!(close(taken_off, [0.0, -step, -65.0 * step]), "{taken_off:?}");
    assert!(close(flatness("flatness_sign = \"add\""), flatness("")));
    // Canary: a picture that is upside down is another one.
    let upside_down = paletted_bmp(|pixel| 65 - (pixel / 64) as u8, |gray| [gray; 3]);
    let rig = load_flatness(&upside_down, "").unwrap();
    assert!(rig.panel.flatness_rad[Colour::Green].as_ref().unwrap()[63] > 1.0);
}

#[test]
fn flatness_keys_that_contradict_each_other_are_refused() {
    let bmp = paletted_bmp(|_| 1, |gray| [gray; 3]);
    let one = |error: RigError| {
        assert_eq!(error.faults.len(), 1, "{error}");
        error.faults.into_iter().next().unwrap()
    };
    let line = |below: usize| line_of("settle_ms").map(|line| line + below);
    let many = one(load_flatness(&bmp, "flatness_2pi_gray = { green = 300 }").unwrap_err());
    assert_fault(&many, "panel.flatness_file.green", line(1), "256 grays, of which 300", "", "flatness_2pi_gray");
    let none = one(load_flatness(&bmp, "flatness_2pi_gray = { green = 213, red = 213 }").unwrap_err());
    assert_fault(&none, "panel.flatness_2pi_gray.red", line(2), "no picture", "", "name red's picture");
    let sign = fault_of("settle_ms = 2.0", "settle_ms = 2.0\nflatness_sign = \"subtract\"");
    assert_fault(&sign, "panel.flatness_sign", line(1), "a sign of no picture", "flatness_file", "");
    let coloured = paletted_bmp(|_| 1, |gray| [gray, gray, 0]);
    let coloured = one(load_flatness(&coloured, "").unwrap_err());
    assert_fault(&coloured, "panel.flatness_file.green", line(1), "the colour 1, 1, 0 at column 0 of row 0", "", "");
    let cut = one(load_flatness(&bmp[..2000], "").unwrap_err());
    assert_fault(&cut, "panel.flatness_file.green", line(1), "vendor.bmp: ", "64x66 pixels", "");
}

#[test]
fn a_key_that_is_gone_is_told_with_what_to_do() {
    check(
        "network = \"standard\"",
        "allow_optics_mismatch = true",
        "model.allow_optics_mismatch",
        "an unknown key",
        "one of network, weights_file, gpu",
        "remove it: networks compute with the rig's own optics",
    );
}

#[test]
fn a_name_that_would_command_a_terminal_is_refused() {
    let name = Rig::BUILT_IN_TOML.lines().find(|line| line.starts_with("name = ")).unwrap();
    check(name, r#"name = "\u001b[2Jbench""#, "name", r"the control character '\u{1b}'", "a name for", "take that out");
}

#[test]
fn a_gpu_may_be_named() {
    let plain = Rig::parse(Rig::BUILT_IN_TOML, Path::new("")).unwrap();
    assert_eq!(plain.model.gpu, None);
    let text = changed(&[("network = \"standard\"", "network = \"standard\"\ngpu = \"RTX 4090\"")]);
    let named = Rig::parse(&text, Path::new("")).unwrap();
    assert_eq!(named.model.gpu.as_deref(), Some("RTX 4090"));
    assert_eq!(named.differences(&plain), ["model.gpu"]);
    check("network = \"standard\"", "gpu = \"\"", "model.gpu", "an empty text", "a part of a GPU's name", "");
    check(
        "network = \"standard\"",
        r#"gpu = "R\u0000""#,
        "model.gpu",
        "a NUL",
        "a part of a GPU's name",
        "take that out",
    );
}

#[test]
fn a_weights_file_must_be_there() {
    check(
        "network = \"standard\"",
        "weights_file = \"none.safetensors\"",
        "model.weights_file",
        "No such file",
        "",
        "rig file's folder",
    );
}

#[test]
fn a_network_is_built_in_or_a_file_and_never_both() {
    check(
        "network = \"standard\"",
        "network = \"smal\"",
        "model.network",
        "\"smal\"",
        "one of \"standard\", \"small\"",
        "did you mean \"small\"?",
    );
    let flag = "network = \"standard\"";
    let both = faults_of(&changed(&[(flag, "network = \"small\"\nweights_file = \".\"")]));
    assert!(both.iter().any(|fault| fault.advice.contains("remove network, or weights_file")), "{both:#?}");
    let small = Rig::parse(&changed(&[(flag, "network = \"small\"")]), Path::new("rig.toml")).unwrap();
    assert_eq!(small.model.weights, WeightsChoice::Small);
}

#[test]
fn meaning_warns_of_what_a_bench_cannot_do() {
    let text = changed(&[("blue = 1.9921875", "blue = 1.5"), ("green = 1.0", "green = 0")]);
    let notes = Rig::parse(&text, Path::new("")).unwrap().meaning().notes;
    for note in [
        "blue: the panel's stroke is 1.500 π",
        "green: the laser's power is 0",
        "simulated",
        "the half band fills red 1.59, green 1.30, blue 1.12 mm of the eyebox; a wider pupil is not filled",
    ] {
        assert!(notes.iter().any(|said| said.contains(note)), "{note}: {notes:?}");
    }
    assert!(!notes.iter().any(|said| said.starts_with("red: the panel's stroke")));
    let notes_at = |red_mw: &str| {
        let text = changed(&[("power_mw = { red = 1.0", &format!("power_mw = {{ red = {red_mw}"))]);
        Rig::parse(&text, Path::new("")).map(|rig| rig.meaning().notes)
    };
    let is_noted = |notes: &[String]| notes.iter().any(|said| said.starts_with("red: lit with 0.001 mW, as lasers"));
    assert!(is_noted(&notes_at("0.0015").unwrap()) && !is_noted(&notes_at("0.001").unwrap()));
    assert!(!notes_at("1.001").unwrap().iter().any(|said| said.contains("whole microwatts")));
    let too_small = notes_at("0.0004").unwrap_err().to_string();
    assert!(too_small.contains("0, or 0.001 mW at least: lasers are told whole microwatts"), "{too_small}");
}

#[test]
fn times_in_seconds_are_asked_for_their_unit() {
    let told = |changes: &[(&str, &str)]| {
        let rig = Rig::parse(&changed(changes), Path::new("")).unwrap();
        let warnings = rig.warnings();
        assert!(warnings.iter().all(|warning| rig.meaning().notes.contains(warning)), "{warnings:?}");
        warnings
    };
    let [settle, delay, lit] = [
        ("settle_ms = 2.0", "settle_ms = 0.002"),
        ("on_delay_ms = 0.1", "on_delay_ms = 0.0001"),
        ("lit_ms = 3.0", "lit_ms = 0.003"),
    ];
    assert_eq!(
        told(&[settle, delay, lit]),
        ["settle_ms = 0.002, on_delay_ms = 0.0001, lit_ms = 0.003: short for a field of 5.556 ms; where that is in \
          seconds, write settle_ms = 2, on_delay_ms = 0.1, lit_ms = 3"]
    );
    let [alone] = told(&[settle]).try_into().unwrap();
    assert!(alone.starts_with("settle_ms = 0.002: short") && alone.ends_with("write settle_ms = 2"), "{alone}");
    assert_eq!(told(&[delay]), [""; 0]);
    let [latency] = told(&[("settle_ms = 2.0", "settle_ms = 2.0\nlatency_ms = 0.0167")]).try_into().unwrap();
    assert!(latency.starts_with("latency_ms = 0.0167: ") && latency.ends_with("write latency_ms = 16.7"), "{latency}");
    assert_eq!(told(&[("settle_ms = 2.0", "settle_ms = 0")]), [""; 0]);
    // In seconds it would be longer than the field.
    assert_eq!(told(&[("settle_ms = 2.0", "settle_ms = 0.02")]), [""; 0]);
    assert_eq!(Rig::default().warnings(), [""; 0]);
}

#[test]
fn powers_in_watts_are_asked_for_their_unit() {
    let told = |limits: &str, power: &str| {
        let lasers = format!("driver = \"serial\"\ndevice = \"/dev/box\"\n{limits}");
        let text = changed(&[("driver = \"simulated\"", &lasers), ("green = 1.0", power)]);
        Rig::parse(&text, Path::new("")).unwrap().warnings()
    };
    let watts = ["green: the laser's power is 0.001 mW; where power_mw is in watts, write 1"];
    assert_eq!(told("", "green = 0.001"), watts);
    assert_eq!(told("power_limit_mw = { green = 0.0025 }", "green = 0.001"), watts);
    // A limit in milliwatts says that the power is in these, too.
    assert_eq!(told("power_limit_mw = { green = 2.5 }", "green = 0.001"), [""; 0]);
    assert_eq!(told("", "green = 0"), [""; 0]);
    let simulated = changed(&[("green = 1.0", "green = 0.001")]);
    assert_eq!(Rig::parse(&simulated, Path::new("")).unwrap().warnings(), [""; 0]);
}

#[test]
fn strokes_of_much_more_than_a_turn_are_asked_for_their_unit() {
    let told = |red: &str, green: &str, blue: &str| {
        let strokes = [("red = ", red), ("green = ", green), ("blue = ", blue)];
        let strokes = strokes.map(|(colour, stroke)| [format!("{colour}1.9921875"), format!("{colour}{stroke}")]);
        let changes = strokes.each_ref().map(|[from, to]| (from.as_str(), to.as_str()));
        Rig::parse(&changed(&changes), Path::new("")).unwrap().warnings()
    };
    let used = "green: of 256 levels only 0 to 90 are used, the first 2 π of the panel's 5.650 π";
    assert_eq!(told("2.0", "5.65", "2.4"), [used]);
    // Where all could be radians, they are asked.
    let warnings = told("5.7", "5.65", "3.2");
    assert_eq!(warnings.len(), 3);
    assert_eq!(warnings[1], format!("{used}; where stroke_pi is in radians, write 1.798"));
    // Of a table the phases say what they are, or are asked otherwise.
    let warnings = load_sparse_lut("0,0.0\n255,15.0\n").unwrap().warnings();
    assert!(!warnings.iter().any(|said| said.contains("stroke") || said.contains("2 π")), "{warnings:?}");
}

#[test]
fn times_are_told_as_they_were_written() {
    let text = changed(&[("heartbeat_timeout_ms = 100.0", "heartbeat_timeout_ms = 150.0")]);
    let told = Rig::parse(&text, Path::new("")).unwrap().meaning().to_string();
    assert!(told.contains("heard of holod for 150 ms"), "{told}");
}

#[test]
fn colours_that_are_never_seen_have_no_light() {
    let light = |changes: &[(&str, &str)]| Rig::parse(&changed(changes), Path::new("")).unwrap().light().0;
    assert_eq!(light(&[]), [1.0; 3]);
    assert_eq!(light(&[("\"channel-packed\"", "\"monochrome\"\ncolour = \"green\"")]), [0.0, 1.0, 0.0]);
    assert_eq!(light(&[("green = 1.0", "green = 0")]), [1.0, 0.0, 1.0]);
    let one =
        format!("driver = \"text\"\nprofile = \"cobolt\"\ndevices = {{ green = \"/dev/g\" }}\n{ACCEPTED}\n{GATED}");
    assert_eq!(with_driver(&one).unwrap().light().0, [0.0, 1.0, 0.0]);
}

#[test]
fn the_stop_is_set_for_the_longest_wavelength_of_lasers_with_power() {
    let mut rig = Rig::default();
    // A full-colour bench in alignment keeps its stop.
    rig.panel.mode = PanelMode::Monochrome(Colour::Green);
    assert_eq!(rig.stop_colour(), Colour::Red);
    for (power_mw, expected) in [
        ([0.0, 1.0, 0.0], Colour::Green),
        ([0.0, 1.0, 2.0], Colour::Green),
        ([0.0, 0.0, 2.0], Colour::Blue),
        ([0.0; 3], Colour::Red),
    ] {
        rig.lasers.power_mw = PerColour(power_mw);
        assert_eq!(rig.stop_colour(), expected, "{power_mw:?}");
    }
}

#[test]
fn meaning_says_the_lasers_powers_and_what_bounds_them() {
    let meaning = |lines: &str| with_driver(lines).unwrap().meaning();
    let unlimited = "no power_limit_mw, so that a power_mw of up to 500 is taken";
    let is_noted = |meaning: &Meaning, colours: &str| {
        meaning.notes.iter().any(|note| note.starts_with(&format!("{colours}: {unlimited}")))
    };
    let serial = "driver = \"serial\"\ndevice = \"/dev/box\"\nstall_timeout_ms = 900";
    let limited = meaning(&format!("{serial}\npower_limit_mw = {{ red = 2.5, green = 1, blue = 2 }}"));
    let text = limited.to_string();
    for part in [
        "lasers         serial /dev/box; dark when nothing is heard of holod for 100 ms, or when one hologram has \
         stayed for 900 ms\n",
        "power          red 1 mW of at most 2.5, green 1 mW of at most 1, blue 1 mW of at most 2\n",
        "tracker        none named; eye: both; no scale_mm_per_unit; lost, the last is held for 1000 ms, then 3 mm\n",
    ] {
        assert!(text.contains(part), "{part} is not in\n{text}");
    }
    assert!(!text.contains(unlimited));
    let json = serde_json::to_value(&limited).unwrap();
    assert_eq!((&json["lasers"]["driver"], &json["lasers"]["power_mw"]["red"]), (&json!("serial"), &json!(1.0)));
    assert_eq!(json["lasers"]["power_limit_mw"], json!({"red": 2.5, "green": 1.0, "blue": 2.0}));
    assert_eq!((&json["lasers"]["heartbeat_timeout_ms"], &json["tracker"]["eye"]), (&json!(100.0), &json!("both")));

    let in_part = meaning(&format!("{serial}\npower_limit_mw = {{ green = 1 }}"));
    assert!(is_noted(&in_part, "red, blue") && !is_noted(&limited, "red"), "{:?}", in_part.notes);
    assert!(in_part.to_string().contains("red 1 mW without a power_limit_mw (500 at most), green 1 mW of at most 1"));
    let json = serde_json::to_value(&in_part).unwrap();
    assert_eq!(json["lasers"]["power_limit_mw"], json!({"red": null, "green": 1.0, "blue": null}));
    assert_eq!(json["lasers"]["power_max_mw"], json!(500.0));
    // Of lasers that are not there nothing is asked, and of simulated ones no limit.
    let one = meaning(&format!(
        "driver = \"text\"\nprofile = \"cobolt\"\ndevices = {{ green = \"/dev/g\" }}\n{ACCEPTED}\n{GATED}"
    ));
    assert!(is_noted(&one, "green"), "{:?}", one.notes);
    // Nor is the stop set for one: λ·F/2p of 520 nm, 8 µm and 100 mm.
    let is_set_for = |meaning: &Meaning, text: &str| meaning.notes.iter().any(|note| note.contains(text));
    assert!(is_set_for(&one, "set it for green, λ·F/2p = 3.25 mm"), "{:?}", one.notes);
    assert!(is_set_for(&limited, "set it for red, λ·F/2p = 3.99 mm"), "{:?}", limited.notes);
    assert!(one.to_string().contains("lasers         text /dev/g; without a heartbeat: lit when holod dies\n"));
    assert!(!Rig::default().meaning().notes.iter().any(|note| note.contains(unlimited)));
    let beam = meaning(&format!(
        "driver = \"ready-beam\"\ndevice = \"/dev/b\"\n\
         full_power_mw = {{ red = 40, green = 30.5, blue = 50 }}\n{ACCEPTED}\n{GATED}"
    ));
    assert!(beam.to_string().contains("at 100 %       red 40, green 30.5, blue 50 mW\n"), "{beam}");
    let tracked = Rig::parse(
        "[tracker]\nspec = \"mock\"\neye = \"left\"\nscale_mm_per_unit = 0.0125\nfallback_mm = 3.3\n",
        Path::new(""),
    )
    .unwrap();
    assert!(tracked.meaning().to_string().contains(
        "tracker        mock; eye: left; 0.0125 mm for one unit of its figure; lost, the last is held for 1000 ms, \
             then 3.3 mm\n"
    ));
}

#[test]
fn meaning_is_readable_and_becomes_json() {
    let meaning = Rig::default().meaning();
    let text = meaning.to_string();
    for part in [
        "1920x1080 pixels; one pixel is 0.200 mrad",
        "0.000 to 2.857 dioptres: infinity to 0.35 m, u = 0.000 to 4.571 mm",
        "red 3.19, green 2.60, blue 2.25 mm",
        "pupil 4 mm     blur up to 57.1 px; needs 50.0 mrad, of the panel's band red 1.25, green 1.54, blue 1.78",
        "at 60 Hz: red, green, blue in the channels red, green, blue, 5.556 ms each, 60.0 colour frames a second",
        "settled at 2.000 ms, laser on at 2.100, off at 5.100: lit for 54 % of it",
        "pupil step     0.102 mm, 1.45 px of the largest blur: what moves less keeps its hologram",
    ] {
        assert!(text.contains(part), "{part} is not in\n{text}");
    }
    let json = serde_json::to_value(&meaning).unwrap();
    assert_eq!(json["eyebox_mm"]["red"].as_f64(), Some(meaning.eyebox_mm.red));
    assert_eq!(json["depth_far_m"], serde_json::Value::Null);
}

#[test]
fn the_pupil_step_is_an_arc_minute_of_blur_where_the_rig_says_nothing_else() {
    let parse = |text: &str| Rig::parse(text, Path::new("")).unwrap();
    let derived = parse(Rig::BUILT_IN_TOML);
    assert_eq!(derived.model.pupil_step, None);
    // 1' is 0.2909 mrad, of a pixel 0.2; half the depth range is blurred half as much.
    let blur_rad = derived.pupil_step().0 * derived.geometry.volume().0;
    assert!((blur_rad - 2.908_882e-4).abs() < 1e-9, "{blur_rad}");
    let shallow = parse(&changed(&[("depth_near_m = 0.35", "depth_near_m = 0.7")]));
    assert!((shallow.pupil_step().0 / derived.pupil_step().0 - 2.0).abs() < 1e-9);
    for (step, meters, says) in [
        ("0.05", 0.05e-3, "pupil step     0.050 mm, 0.71 px of the largest blur"),
        ("0", 0.0, "pupil step     none: each hologram is made for the pupil of its own time"),
    ] {
        let rig = parse(&changed(&[("[model]", &format!("[model]\npupil_step_mm = {step}"))]));
        assert_eq!(rig.pupil_step().0, meters);
        assert!(rig.meaning().to_string().contains(says), "{}", rig.meaning());
    }
}

#[test]
fn the_hash_follows_the_text() {
    let parse = |text: &str| Rig::parse(text, Path::new("")).unwrap().provenance.text_hash;
    assert_eq!(parse(Rig::BUILT_IN_TOML), parse(Rig::BUILT_IN_TOML));
    assert_ne!(parse(Rig::BUILT_IN_TOML), parse(&format!("{}\n", Rig::BUILT_IN_TOML)));
}

/// Values that a key might be given by mistake.
fn any_value() -> impl Strategy<Value = String> {
    prop_oneof![
        any::<f64>().prop_map(|value| format!("{value:?}")),
        any::<i64>().prop_map(|value| value.to_string()),
        "[ -~]{0,12}",
        "\\PC{0,8}",
        Just("[]".to_owned()),
        Just("{}".to_owned()),
        Just("{ red = 1, green = [], blue = {} }".to_owned()),
        Just("\"\"".to_owned()),
        Just("\"..\"".to_owned()),
        Just("1979-05-27".to_owned()),
        Just("true".to_owned()),
    ]
}

fn assert_sound(result: Result<Rig, RigError>) {
    match result {
        Ok(rig) => assert!(!rig.meaning().to_string().is_empty()),
        Err(error) => {
            assert!(!error.faults.is_empty());
            for fault in &error.faults {
                assert!(fault.line.is_some() || !fault.key.is_empty(), "{fault:?}");
                assert!(!fault.found.is_empty() && !fault.expected.is_empty() && !fault.advice.is_empty(), "{fault:?}");
            }
        }
    }
}

proptest! {
    #[test]
    fn no_value_of_any_key_panics(line in any::<prop::sample::Index>(), value in any_value()) {
        let text = fs::read_to_string(EXAMPLE).unwrap();
        let keys: Vec<&str> = text.lines().filter(|line| line.contains(" = ") && !line.starts_with('#')).collect();
        let line = *line.get(&keys);
        let key = line.split(" = ").next().unwrap();
        assert_sound(Rig::parse(&text.replacen(line, &format!("{key} = {value}"), 1), Path::new(EXAMPLE)));
    }

    #[test]
    fn no_damage_to_the_text_panics(at in any::<prop::sample::Index>(), length in 0usize..40, put in "\\PC{0,6}") {
        let mut characters: Vec<char> = Rig::BUILT_IN_TOML.chars().collect();
        let start = at.index(characters.len());
        let end = (start + length).min(characters.len());
        characters.splice(start..end, put.chars());
        assert_sound(Rig::parse(&characters.into_iter().collect::<String>(), Path::new("rig.toml")));
    }
}

#[test]
fn a_file_that_says_nothing_of_the_bench_is_of_the_built_in_one() {
    let parse = |text: &str| Rig::parse(text, Path::new("alone.toml"));
    let rig = parse("[tracker]\nspec = \"replay:log.asc\"\nscale_mm_per_unit = 0.0125\n").expect("reads");
    let built_in = Rig::default();
    assert_eq!((rig.tracker.scale, rig.name.as_str()), (Some(0.0125), "alone"));
    assert_eq!((&rig.panel, &rig.geometry, &rig.lasers), (&built_in.panel, &built_in.geometry, &built_in.lasers));
    assert_eq!(parse("[model]\nnetwork = \"small\"\n").expect("reads").panel, built_in.panel);
    // Its own faults are found, and a bench that is begun is described whole.
    assert!(parse("[tracker]\nscael = 1.0\n").unwrap_err().to_string().contains("scael"));
    let begun = parse("[tracker]\n[lasers]\n").unwrap_err().to_string();
    assert!(begun.contains("panel") && begun.contains("optics"), "{begun}");
    assert!(parse("name = \"nothing else\"\n").is_err());
}

//! Boxes that only set a power and switch it, spoken to over pseudo-terminals by devices that answer in real bytes.

use std::collections::HashMap;
use std::io::{ErrorKind, Read, Write};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use crc::{CRC_16_XMODEM, Crc};
use holod_calibration::rig::{LaserDriver, Lasers, PanelMode, Rig, TextLaserProfile};
use holod_calibration::{Colour, PerColour, TimeNs, host_now};
use holod_slm_output::laser::{
    BoxEvent, DarkReason, LaserBox, LaserError, LaserProgram, Refusal, make_dark, open_laser, takes,
};
use holod_slm_output::schedule::FieldGate;
use serialport::{SerialPort, TTYPort};

const MS: i64 = 1_000_000;

/// What a device was told and how it is, for both its thread and the test.
#[derive(Debug, Default)]
struct Device {
    /// Everything that it was sent, in order.
    heard: Vec<String>,
    /// Parameters of a MeCom device by (parameter, instance); a text laser's state by name.
    values: HashMap<(u16, u8), u32>,
    lit: bool,
    power_w: String,
    /// In which way a text laser says how bright it is.
    mode: &'static str,
    /// It is lit by a change of its mode.
    lit_by_mode: bool,
    /// It answers to a change of its mode, and keeps it.
    keeps_mode: bool,
    /// It knows the command for its mode by another name.
    knows_no_mode: bool,
    interlock: &'static str,
    mute: bool,
    /// How long it takes to answer.
    slow: Duration,
    /// So many commands to go out are not heard.
    deaf_to_off: usize,
    /// A write that a MeCom device refuses.
    refused: Option<(u16, u8)>,
}

/// A device behind a pseudo-terminal.
struct Bench {
    device: Arc<Mutex<Device>>,
    path: PathBuf,
    stop: Arc<AtomicBool>,
    /// Held open, so that the terminal outlives its hosts.
    _port: TTYPort,
    thread: Option<JoinHandle<()>>,
}

impl Bench {
    fn plug_in(end: u8, answer: impl Fn(&mut Device, &str) -> Vec<u8> + Send + 'static) -> Self {
        let (mut terminal, port) = TTYPort::pair().unwrap();
        terminal.set_timeout(Duration::from_millis(5)).unwrap();
        let path = PathBuf::from(port.name().unwrap());
        let device = Arc::new(Mutex::new(Device { interlock: "0", ..Device::default() }));
        let stop = Arc::new(AtomicBool::new(false));
        let (its_device, stopped) = (Arc::clone(&device), Arc::clone(&stop));
        let serve = move || {
            let mut line = Vec::new();
            while !stopped.load(Ordering::Relaxed) {
                let mut byte = [0];
                match terminal.read(&mut byte) {
                    Ok(1) if byte[0] == end => {
                        let text = String::from_utf8_lossy(&std::mem::take(&mut line)).trim().to_owned();
                        let mut device = its_device.lock().unwrap();
                        device.heard.push(text.clone());
                        let answer = answer(&mut device, &text);
                        let (mute, slow) = (device.mute, device.slow);
                        drop(device);
                        std::thread::sleep(slow);
                        if !mute {
                            terminal.write_all(&answer).unwrap();
                        }
                    }
                    Ok(1) => line.push(byte[0]),
                    Ok(_) => {}
                    Err(why) if why.kind() == ErrorKind::TimedOut => {}
                    Err(_) => return,
                }
            }
        };
        Self { device, path, stop, _port: port, thread: Some(std::thread::spawn(serve)) }
    }

    fn heard(&self) -> Vec<String> {
        self.device.lock().unwrap().heard.clone()
    }

    fn with<T>(&self, look: impl FnOnce(&mut Device) -> T) -> T {
        look(&mut self.device.lock().unwrap())
    }
}

impl Drop for Bench {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            thread.join().unwrap();
        }
    }
}

fn eventually(what: &str, mut holds: impl FnMut() -> bool) {
    let t_end = host_now() + TimeNs(30_000 * MS);
    while !holds() {
        assert!(host_now() < t_end, "never came: {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// A READYBeam, or a MeCom device of another type.
fn ready_beam(device_type: u32) -> Bench {
    let bench = Bench::plug_in(b'\r', |device, frame| {
        const CRC: Crc<u16> = Crc::<u16>::new(&CRC_16_XMODEM);
        let (text, crc) = frame.split_at(frame.len().saturating_sub(4));
        if !text.starts_with('#') || format!("{:04X}", CRC.checksum(text.as_bytes())) != crc {
            return Vec::new();
        }
        let hex = |from: usize, to: usize| u32::from_str_radix(&text[from..to], 16).unwrap();
        let with_crc = |text: String| format!("{text}{:04X}\r", CRC.checksum(text.as_bytes())).into_bytes();
        let begin = format!("!{}", &text[1..7]);
        if &text[7..10] == "?VR" {
            let key = (hex(10, 14) as u16, hex(14, 16) as u8);
            return with_crc(match device.values.get(&key) {
                Some(value) => format!("{begin}{value:08X}"),
                None => format!("{begin}+06"),
            });
        }
        let key = (hex(9, 13) as u16, hex(13, 15) as u8);
        if device.refused == Some(key) {
            return with_crc(format!("{begin}+07"));
        }
        device.values.insert(key, hex(15, 23));
        // The acknowledgement carries the request's own CRC.
        format!("{begin}{crc}\r").into_bytes()
    });
    bench.with(|device| {
        device.values.insert((100, 1), device_type);
        device.values.insert((104, 1), 2);
        for instance in 1..=3 {
            device.values.insert((7006, instance), 1);
        }
    });
    bench
}

/// A Cobolt laser, which begins lit, at constant current.
fn cobolt() -> Bench {
    let bench = Bench::plug_in(b'\r', |device, line| {
        let answer = match line {
            "sn?" => "12034".to_owned(),
            "ilk?" => device.interlock.to_owned(),
            "f?" => "0".to_owned(),
            "l0" if device.deaf_to_off > 0 => {
                device.deaf_to_off -= 1;
                return Vec::new();
            }
            "l1" | "l0" => {
                device.lit = line == "l1";
                "OK".to_owned()
            }
            "@cobas 0" => "OK".to_owned(),
            "gam?" => device.mode.to_owned(),
            "cp" if !device.knows_no_mode => {
                change_mode(device, "1");
                "OK".to_owned()
            }
            _ => match line.strip_prefix("p ") {
                Some(watts) => {
                    watts.clone_into(&mut device.power_w);
                    "OK".to_owned()
                }
                None => "Syntax error: illegal command".to_owned(),
            },
        };
        format!("{answer}\r\n").into_bytes()
    });
    bench.with(|device| (device.lit, device.mode) = (true, "0"));
    bench
}

fn change_mode(device: &mut Device, mode: &'static str) {
    if !device.keeps_mode {
        device.mode = mode;
    }
    device.lit |= device.lit_by_mode;
}

/// A Coherent OBIS laser with its handshake, which acknowledges questions, too. It begins under a digital input.
fn obis() -> Bench {
    let bench = Bench::plug_in(b'\n', |device, line| {
        let answer = match line {
            "SOUR:AM:SOUR?" => format!("{}\r\nOK", device.mode),
            "SOUR:AM:INT CWP" if !device.knows_no_mode => {
                change_mode(device, "CWP");
                "OK".to_owned()
            }
            "*IDN?" => "Coherent, Inc-OBIS 520nm 40mW C-V2.3\r\nOK".to_owned(),
            "SOUR:AM:STATE ON" | "SOUR:AM:STATE OFF" => {
                device.lit = line.ends_with("ON");
                "OK".to_owned()
            }
            _ => match line.strip_prefix("SOUR:POW:LEV:IMM:AMPL ") {
                Some(watts) => {
                    watts.clone_into(&mut device.power_w);
                    "OK".to_owned()
                }
                None => "ERR-100".to_owned(),
            },
        };
        format!("{answer}\r\n").into_bytes()
    });
    bench.with(|device| device.mode = "DIGITAL");
    bench
}

fn text_lasers(profile: &str, paths: [Option<&Bench>; 3]) -> LaserDriver {
    LaserDriver::Text {
        profile: Box::new(TextLaserProfile::named(profile).unwrap().clone()),
        paths: PerColour(paths.map(|bench| bench.map(|bench| bench.path.clone()))),
        transmission_ppb: PerColour([1_000_000_000; 3]),
    }
}

fn lasers(driver: LaserDriver) -> Lasers {
    Lasers { driver, accept_no_heartbeat: true, heartbeat_timeout: TimeNs(150 * MS), ..Rig::default().lasers }
}

fn program(mode: PanelMode) -> LaserProgram {
    let mut rig = Rig::default();
    rig.panel.mode = mode;
    rig.lasers.heartbeat_timeout = TimeNs(150 * MS);
    FieldGate::new(&rig.panel, &rig.lasers).unwrap().program(&rig.panel, &rig.lasers).unwrap()
}

const GREEN: PanelMode = PanelMode::Monochrome(Colour::Green);

/// Polls with heartbeats until `holds`; the events on the way.
fn alive_until(laser: &mut dyn LaserBox, mut holds: impl FnMut() -> bool) -> Vec<BoxEvent> {
    let mut events = Vec::new();
    eventually("what was waited for", || {
        laser.heartbeat(host_now()).unwrap();
        laser.poll(host_now(), &mut |event| events.push(event)).unwrap();
        holds()
    });
    events
}

#[test]
fn a_ready_beam_is_recognised_set_lit_in_one_colour_and_put_out() {
    let bench = ready_beam(1171);
    let full_power_uw = PerColour([40_000, 20_000, 50_000]);
    let driver = LaserDriver::ReadyBeam { path: bench.path.clone(), full_power_uw };
    let mut laser = open_laser(&lasers(driver.clone()), host_now).unwrap();
    let capability = laser.capability();
    assert!(!capability.simulated && !capability.gates_fields && !capability.has_heartbeat);
    let heard = bench.heard();
    assert!(heard[0].contains("?VR006401"), "the device type before anything else: {heard:?}");

    let refused = laser.arm(host_now()).unwrap_err();
    assert!(matches!(refused, LaserError::Refused { refusal: Refusal::NotProgrammed, .. }), "{refused}");
    laser.program(&program(GREEN), host_now()).unwrap();
    let on = |bench: &Bench| bench.with(|device| [1, 2, 3].map(|instance| device.values[&(7006, instance)]));
    assert_eq!(on(&bench), [0, 0, 0]);
    // 1 mW of 20 mW.
    assert_eq!(bench.with(|device| f32::from_bits(device.values[&(7013, 2)])), 5.0);
    laser.arm(host_now()).unwrap();
    let events = alive_until(laser.as_mut(), || on(&bench) == [0, 1, 0]);
    assert!(
        events.iter().all(|event| matches!(event, BoxEvent::Armed { .. })),
        "no edges of single fields: {events:?}"
    );
    laser.dark(DarkReason::Shutdown, host_now()).unwrap();
    assert_eq!(on(&bench), [0, 0, 0]);

    // It is somebody else's in the eyes of a second program, but anybody may put it out.
    let in_use = open_laser(&lasers(driver.clone()), host_now).err().unwrap();
    assert!(matches!(in_use, LaserError::InUse { .. }), "{in_use}");
    laser.arm(host_now()).unwrap();
    alive_until(laser.as_mut(), || on(&bench) == [0, 1, 0]);
    drop(laser);
    assert_eq!(on(&bench), [0, 0, 0], "put out before its port is closed");
    bench.with(|device| device.values.insert((7006, 3), 1));
    make_dark(&driver, host_now).unwrap();
    assert_eq!(on(&bench), [0, 0, 0]);
}

#[test]
fn another_device_on_the_port_is_refused_before_anything_is_set() {
    for (bench, found) in
        [(ready_beam(1089), "1089"), (Bench::plug_in(b'\r', |_, _| b"P1,1,1000,L,3.1,0.9*00\r\n".to_vec()), "P1,1")]
    {
        let driver = LaserDriver::ReadyBeam { path: bench.path.clone(), full_power_uw: PerColour([1000; 3]) };
        let error = open_laser(&lasers(driver), host_now).err().unwrap();
        assert!(matches!(&error, LaserError::NotABox { found: text, .. } if text.contains(found)), "{error}");
        assert!(bench.heard().iter().all(|frame| frame.contains("?VR")), "reads only: {:?}", bench.heard());
    }
    let bench = ready_beam(1171);
    let error = open_laser(&lasers(text_lasers("cobolt", [None, Some(&bench), None])), host_now).err().unwrap();
    assert!(matches!(error, LaserError::NoAnswerTo { .. }), "{error}");
    assert_eq!(bench.heard(), ["sn?"]);
    let bench = cobolt();
    let error = open_laser(&lasers(text_lasers("coherent-obis", [Some(&bench), None, None])), host_now).err();
    let error = error.unwrap();
    assert!(matches!(&error, LaserError::NoAnswerTo { .. } | LaserError::NotABox { .. }), "{error}");
    assert!(bench.heard().iter().all(|line| line == "*IDN?"), "{:?}", bench.heard());
}

#[test]
fn text_lasers_are_recognised_put_out_set_lit_and_put_out() {
    for (name, bench) in [("cobolt", cobolt()), ("coherent-obis", obis())] {
        let driver = text_lasers(name, [None, Some(&bench), None]);
        let mut laser = open_laser(&lasers(driver.clone()), host_now).unwrap();
        assert!(!bench.with(|device| device.lit), "{name}: out from the first moment on");
        laser.program(&program(GREEN), host_now()).unwrap();
        assert_eq!(bench.with(|device| device.power_w.clone()), "0.001000", "{name}");
        laser.arm(host_now()).unwrap();
        alive_until(laser.as_mut(), || bench.with(|device| device.lit));
        laser.dark(DarkReason::Asked, host_now()).unwrap();
        assert!(!bench.with(|device| device.lit), "{name}");

        let without_power = LaserProgram { power_uw: PerColour([0; 3]), ..program(GREEN) };
        laser.program(&without_power, host_now()).unwrap();
        laser.arm(host_now()).unwrap();
        let t_end = host_now() + TimeNs(300_000_000);
        alive_until(laser.as_mut(), || host_now() > t_end);
        assert!(!bench.with(|device| device.lit), "{name}: a laser without power stays off");
        assert_eq!(bench.with(|device| device.power_w.clone()), "0.001000", "{name}: and is told none");
        laser.dark(DarkReason::Asked, host_now()).unwrap();
        drop(laser);
        // A third of what the laser gives gets to the panel.
        let mut behind_a_fibre = driver.clone();
        if let LaserDriver::Text { transmission_ppb, .. } = &mut behind_a_fibre {
            transmission_ppb[Colour::Green] = 333_333_333;
        }
        // By the limit for the panel, which is 500 mW where none is written, it is told this by a slip in the share.
        let slip = Lasers { power_limit_mw: PerColour([Some(2.0); 3]), ..lasers(behind_a_fibre.clone()) };
        let mut laser = open_laser(&slip, host_now).unwrap();
        let refused = laser.program(&program(GREEN), host_now()).unwrap_err();
        assert!(matches!(refused, LaserError::BeyondHead { colour: Colour::Green, .. }), "{refused}");
        let foretold = takes(&slip, &program(GREEN), None).unwrap_err();
        assert_eq!(foretold.to_string(), refused.to_string());
        assert_eq!(bench.with(|device| device.power_w.clone()), "0.001000", "{name}: and is told nothing");
        drop(laser);
        let head_limit_mw = PerColour([None, Some(3.0), None]);
        let mut laser = open_laser(&Lasers { head_limit_mw, ..slip }, host_now).unwrap();
        laser.program(&program(GREEN), host_now()).unwrap();
        assert_eq!(bench.with(|device| device.power_w.clone()), "0.003000", "{name}");

        let missing = laser.program(&program(PanelMode::Monochrome(Colour::Red)), host_now()).unwrap_err();
        assert!(matches!(missing, LaserError::NoLaser { colour: Colour::Red }), "{missing}");
        let foretold = |mode| takes(&lasers(driver.clone()), &program(mode), None);
        let said = foretold(PanelMode::Monochrome(Colour::Red)).unwrap_err();
        assert_eq!(said.to_string(), missing.to_string());
        foretold(GREEN).unwrap();
        bench.with(|device| device.lit = true);
        make_dark(&driver, host_now).unwrap();
        assert!(!bench.with(|device| device.lit), "{name}");
    }
}

#[test]
fn lasers_that_cannot_gate_fields_light_several_colours_only_where_the_panel_gates_them() {
    let benches = [cobolt(), cobolt(), cobolt()];
    let driver = text_lasers("cobolt", [Some(&benches[0]), Some(&benches[1]), Some(&benches[2])]);
    let mut laser = open_laser(&lasers(driver.clone()), host_now).unwrap();
    for mode in [PanelMode::ChannelPacked, PanelMode::FieldSequential] {
        let refused = laser.program(&program(mode), host_now()).unwrap_err();
        assert!(matches!(refused, LaserError::CannotGate), "{refused}");
        let foretold = takes(&lasers(driver.clone()), &program(mode), None);
        assert!(matches!(foretold, Err(LaserError::CannotGate)), "{foretold:?}");
        assert!(laser.arm(host_now()).is_err());
    }
    drop(laser);
    let gated = Lasers { gated_by_panel: true, ..lasers(driver.clone()) };
    let mut laser = open_laser(&gated, host_now).unwrap();
    // Of a gray frame no panel knows the colour.
    let sequential = program(PanelMode::FieldSequential);
    assert!(matches!(takes(&gated, &sequential, None), Err(LaserError::CannotGate)));
    assert!(matches!(laser.program(&sequential, host_now()), Err(LaserError::CannotGate)));
    takes(&gated, &program(PanelMode::ChannelPacked), None).unwrap();
    laser.program(&program(PanelMode::ChannelPacked), host_now()).unwrap();
    laser.arm(host_now()).unwrap();
    alive_until(laser.as_mut(), || benches.iter().all(|bench| bench.with(|device| device.lit)));
    drop(laser);
    let unaccepted = Lasers { accept_no_heartbeat: false, ..gated };
    let heard = benches[0].heard().len();
    assert!(matches!(open_laser(&unaccepted, host_now).err(), Some(LaserError::NotAccepted)));
    assert_eq!(benches[0].heard().len(), heard, "not even opened");
}

#[test]
fn a_host_that_falls_silent_and_a_laser_that_complains_end_in_darkness() {
    let bench = cobolt();
    let mut laser = open_laser(&lasers(text_lasers("cobolt", [None, Some(&bench), None])), host_now).unwrap();
    laser.program(&program(GREEN), host_now()).unwrap();
    laser.arm(host_now()).unwrap();
    alive_until(laser.as_mut(), || bench.with(|device| device.lit));
    // No heartbeat any more.
    let mut dark = None;
    eventually("darkness", || {
        laser
            .poll(host_now(), &mut |event| {
                if let BoxEvent::Dark { reason, .. } = event {
                    dark = Some(reason);
                }
            })
            .unwrap();
        dark.is_some()
    });
    assert_eq!(dark, Some(DarkReason::Heartbeat));
    assert!(!bench.with(|device| device.lit));

    laser.arm(host_now()).unwrap();
    alive_until(laser.as_mut(), || bench.with(|device| device.lit));
    let watch = laser.watch().unwrap();
    bench.with(|device| device.interlock = "1");
    eventually("the interlock", || {
        let _lost = laser.heartbeat(host_now());
        let _lost = laser.poll(host_now(), &mut |_| ());
        watch.trouble().is_some_and(|trouble| trouble.contains("ilk?") && trouble.contains("interlock"))
    });
    eventually("darkness", || !bench.with(|device| device.lit));
    bench.with(|device| device.interlock = "0");
    eventually("the laser", || {
        laser.poll(host_now(), &mut |_| ()).unwrap();
        laser.arm(host_now()).is_ok()
    });
    alive_until(laser.as_mut(), || bench.with(|device| device.lit));
    bench.with(|device| device.mute = true);
    let unheard = laser.dark(DarkReason::Shutdown, host_now()).unwrap_err();
    assert!(matches!(unheard, LaserError::Lost), "no acknowledgement: {unheard}");
}

#[test]
fn a_laser_that_does_not_hear_that_it_must_go_out_is_told_again_beside_a_host_that_hangs() {
    let bench = cobolt();
    let mut laser = open_laser(&lasers(text_lasers("cobolt", [None, Some(&bench), None])), host_now).unwrap();
    laser.program(&program(GREEN), host_now()).unwrap();
    laser.arm(host_now()).unwrap();
    alive_until(laser.as_mut(), || bench.with(|device| device.lit));
    bench.with(|device| device.deaf_to_off = 3);
    // The host neither polls nor sends heartbeats from here on.
    eventually("darkness", || !bench.with(|device| device.lit));
    assert_eq!(bench.with(|device| device.deaf_to_off), 0);
}

#[test]
fn darkness_does_not_wait_for_all_the_questions_whether_lasers_are_well() {
    let benches = [cobolt(), cobolt(), cobolt()];
    let mut driver = text_lasers("cobolt", benches.each_ref().map(Some));
    // A busy machine may be late with a heartbeat or an answer, which is not what is looked at here.
    let heartbeat_timeout = TimeNs(5000 * MS);
    if let LaserDriver::Text { profile, .. } = &mut driver {
        profile.answer_timeout_ms = 5000;
    }
    let mut laser = open_laser(&Lasers { heartbeat_timeout, ..lasers(driver) }, host_now).unwrap();
    laser.program(&LaserProgram { heartbeat_timeout, ..program(GREEN) }, host_now()).unwrap();
    for bench in &benches {
        bench.with(|device| device.slow = Duration::from_millis(150));
    }
    for _ in 0..3 {
        laser.arm(host_now()).unwrap();
        alive_until(laser.as_mut(), || benches[1].with(|device| device.lit));
        let asked = || benches[0].heard().len();
        let before = asked();
        alive_until(laser.as_mut(), || asked() > before);
        let heard = benches.each_ref().map(|bench| bench.heard().len());
        laser.dark(DarkReason::Asked, host_now()).unwrap();
        let questions = benches.iter().zip(heard).flat_map(|(bench, heard)| bench.heard().split_off(heard));
        let questions: Vec<_> = questions.filter(|line| line.ends_with('?')).collect();
        // The one that was being asked, and on a busy machine one before the order came; of nine.
        assert!(questions.len() <= 2, "{questions:?} before the lasers went out");
    }
}

#[test]
fn one_laser_that_does_not_answer_keeps_none_of_the_others_lit() {
    let benches = [cobolt(), cobolt(), cobolt()];
    benches[0].with(|device| device.mute = true);
    let driver = text_lasers("cobolt", benches.each_ref().map(Some));
    let error = std::thread::scope(|scope| {
        let ended = scope.spawn(|| make_dark(&driver, host_now).unwrap_err());
        let all_are_out = || benches[1..].iter().all(|bench| !bench.with(|device| device.lit));
        eventually("darkness", all_are_out);
        assert!(!ended.is_finished(), "the mute one is told again for seconds meanwhile");
        ended.join().unwrap().to_string()
    });
    let [mute, others @ ..] = benches.each_ref().map(|bench| bench.path.display().to_string());
    let begin = format!("not known to be dark: {mute}: no answer to `sn?` within 500 ms");
    let end = format!("acknowledged that they are dark: {}", others.join(", "));
    assert!(error.starts_with(&begin) && error.ends_with(&end), "{error}");
}

#[test]
fn lasers_are_put_out_at_the_start_whatever_is_wrong_with_one_of_them() {
    let stranger = || Bench::plug_in(b'\r', |_, _| b"P1,1,1000,L,3.1,0.9*00\r\n".to_vec());
    for red in [cobolt(), stranger()] {
        red.with(|device| device.interlock = "1");
        let others = [cobolt(), cobolt()];
        let driver = text_lasers("cobolt", [Some(&red), Some(&others[0]), Some(&others[1])]);
        let error = open_laser(&lasers(driver), host_now).err().unwrap();
        assert!(others.iter().all(|bench| !bench.with(|device| device.lit)), "{error}");
        if let LaserError::Complaint { .. } = error {
            let text = error.to_string();
            assert!(
                text.ends_with("answered `1` to `ilk?`; expected `0`: check its interlock, faults and operating mode"),
                "{text}"
            );
        }
    }
}

/// In every other one the power that holod sets is without effect, and a stored current or an outer signal says how
/// bright it is.
#[test]
fn text_lasers_are_lit_in_the_mode_in_which_their_power_is_in_force_and_in_no_other() {
    for (name, bench, right, wrong, ask) in
        [("cobolt", cobolt(), "1", "2", "gam?"), ("coherent-obis", obis(), "CWP", "ANALOG", "SOUR:AM:SOUR?")]
    {
        let driver = text_lasers(name, [None, Some(&bench), None]);
        bench.with(|device| (device.keeps_mode, device.lit_by_mode) = (true, true));
        let error = open_laser(&lasers(driver.clone()), host_now).err().unwrap().to_string();
        assert!(error.contains(&format!("to `{ask}`; expected `{right}`")) && error.contains("mode"), "{error}");
        assert!(!bench.with(|device| device.lit), "{name}: whatever its mode does");

        // One that has another command for it is told so, and taken where it is in that mode already.
        bench.with(|device| device.knows_no_mode = true);
        let error = open_laser(&lasers(driver.clone()), host_now).err().unwrap().to_string();
        assert!(error.contains("another command") && error.contains("lasers.profile_file"), "{error}");
        let before = bench.with(|device| std::mem::replace(&mut device.mode, right));
        drop(open_laser(&lasers(driver.clone()), host_now).unwrap());
        bench.with(|device| (device.knows_no_mode, device.mode) = (false, before));

        bench.with(|device| device.keeps_mode = false);
        let mut laser = open_laser(&lasers(driver), host_now).unwrap();
        assert!(!bench.with(|device| device.lit), "{name}: whatever its mode does");
        assert_eq!(bench.with(|device| device.mode), right, "{name}");
        laser.program(&program(GREEN), host_now()).unwrap();
        laser.arm(host_now()).unwrap();
        alive_until(laser.as_mut(), || bench.with(|device| device.lit));
        // Its knob is turned, or a second program has its port.
        bench.with(|device| (device.mode, device.keeps_mode) = (wrong, true));
        let watch = laser.watch().unwrap();
        eventually("the mode", || {
            let _lost = laser.heartbeat(host_now());
            let _lost = laser.poll(host_now(), &mut |_| ());
            watch.trouble().is_some_and(|trouble| trouble.contains(ask))
        });
        eventually("darkness", || !bench.with(|device| device.lit));
    }
}

#[test]
fn a_ready_beam_that_says_error_is_dark_and_not_lit_again_until_it_is_well() {
    let bench = ready_beam(1171);
    let full_power_uw = PerColour([40_000; 3]);
    let driver = lasers(LaserDriver::ReadyBeam { path: bench.path.clone(), full_power_uw });
    let lit = || bench.with(|device| (1..=3).any(|instance| device.values[&(7006, instance)] == 1));
    let status = |status| bench.with(|device| device.values.extend([((104, 1), status)]));
    let mut laser = open_laser(&driver, host_now).unwrap();
    laser.program(&program(GREEN), host_now()).unwrap();
    laser.arm(host_now()).unwrap();
    alive_until(laser.as_mut(), lit);
    status(3);
    eventually("darkness", || {
        let _lost = laser.poll(host_now(), &mut |_| ());
        let _lost = laser.heartbeat(host_now());
        !lit()
    });
    let heard = bench.heard().len();
    // As a run does, which arms it again as soon as it may.
    let t_end = host_now() + TimeNs(3000 * MS);
    while host_now() < t_end {
        let _lost = laser.poll(host_now(), &mut |_| ());
        let _lost = laser.arm(host_now());
        let _lost = laser.heartbeat(host_now());
        std::thread::sleep(Duration::from_millis(2));
    }
    let lights = |frame: &String| frame.contains("VS1B5E") && frame[15..].starts_with("00000001");
    let again = bench.heard()[heard..].iter().filter(|frame| lights(frame)).count();
    assert_eq!(again, 0, "lit though it says error");
    status(2);
    eventually("light", || {
        let _lost = laser.poll(host_now(), &mut |_| ());
        let _lost = laser.arm(host_now());
        let _lost = laser.heartbeat(host_now());
        lit()
    });
    assert!(bench.heard()[heard..].iter().any(lights), "what lights it is seen");
    drop(laser);
    // One that is found like this does not stay lit.
    status(3);
    bench.with(|device| device.values.insert((7006, 3), 1));
    let error = open_laser(&driver, host_now).err().unwrap();
    assert!(matches!(error, LaserError::Complaint { .. }), "{error}");
    assert!(!lit());
}

#[test]
fn a_ready_beam_of_which_one_colour_does_not_obey_is_dark_in_the_others() {
    let bench = ready_beam(1171);
    let driver = LaserDriver::ReadyBeam { path: bench.path.clone(), full_power_uw: PerColour([40_000; 3]) };
    bench.with(|device| device.refused = Some((7006, 1)));
    let error = make_dark(&driver, host_now).unwrap_err();
    assert!(matches!(error, LaserError::Complaint { .. }), "{error}");
    assert_eq!(bench.with(|device| [1, 2, 3].map(|instance| device.values[&(7006, instance)])), [1, 0, 0]);
}

/// Set when it goes, also by a failed assertion.
struct SetAtTheEnd<'a>(&'a AtomicBool);

impl Drop for SetAtTheEnd<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// Runs `beside` again and again after `light`, next to a host that asks its device how it is all the while.
fn beside_a_live_host(driver: &LaserDriver, light: impl Fn() + Send, mut beside: impl FnMut()) {
    let stop = AtomicBool::new(false);
    let mut laser = open_laser(&lasers(driver.clone()), host_now).unwrap();
    laser.program(&program(GREEN), host_now()).unwrap();
    std::thread::scope(|scope| {
        scope.spawn(|| {
            while !stop.load(Ordering::Relaxed) {
                // It is found again where its answers were taken away.
                let _lost = laser.poll(host_now(), &mut |_| ());
                let _lost = laser.heartbeat(host_now());
                std::thread::sleep(Duration::from_millis(2));
            }
        });
        let _stop = SetAtTheEnd(&stop);
        for _ in 0..12 {
            light();
            beside();
        }
    });
}

#[test]
fn lasers_are_put_out_beside_a_host_that_talks_to_them() {
    let text = cobolt();
    text.with(|device| device.slow = Duration::from_millis(40));
    let driver = text_lasers("cobolt", [None, Some(&text), None]);
    let light = || text.with(|device| device.lit = true);
    beside_a_live_host(&driver, light, || {
        make_dark(&driver, host_now).unwrap();
        assert!(!text.with(|device| device.lit));
    });

    let beam = ready_beam(1171);
    beam.with(|device| device.slow = Duration::from_millis(20));
    let driver = LaserDriver::ReadyBeam { path: beam.path.clone(), full_power_uw: PerColour([40_000; 3]) };
    let light = || beam.with(|device| device.values.extend([((7006, 3), 1)]));
    beside_a_live_host(&driver, light, || {
        make_dark(&driver, host_now).unwrap();
        assert_eq!(beam.with(|device| device.values[&(7006, 3)]), 0);
    });
}

#[test]
fn a_laser_that_was_recognised_is_told_to_go_out_whether_or_not_it_answers() {
    let bench = cobolt();
    bench.with(|device| device.deaf_to_off = 2);
    let driver = text_lasers("cobolt", [None, Some(&bench), None]);
    make_dark(&driver, host_now).unwrap();
    assert!(!bench.with(|device| device.lit), "told again");
    // Whatever else is at the port is asked what it is, and told nothing.
    let stranger = Bench::plug_in(b'\r', |_, _| b"P1,1,1000,L,3.1,0.9*00\r\n".to_vec());
    let driver = text_lasers("cobolt", [None, Some(&stranger), None]);
    let error = make_dark(&driver, host_now).unwrap_err();
    assert!(matches!(error, LaserError::NotABox { .. }), "{error}");
    assert!(stranger.heard().iter().all(|line| line == "sn?"), "{:?}", stranger.heard());
}

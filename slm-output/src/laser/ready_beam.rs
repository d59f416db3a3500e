//! FISBA READYBeam: three lasers behind one serial port, spoken to in MeCom frames.
//!
//! It sets powers and switches lasers in tens of milliseconds, so it never gates single fields, and it stays as it is
//! when its host dies. Its usual port is the one that an eye tracker may get as well: nothing but a harmless read is
//! sent before it has said what it is.

use std::path::Path;

use holod_calibration::rig::Lasers;
use holod_calibration::{Colour, PerColour, TimeNs};

use super::line_link::Sharing;
use super::mecom::{Reply, Request, frame, reply};
use super::power_box::{Conversation, NONE_LIT, PowerBox, PowerDevice, put_out_beside, require_acceptance};
use super::program::within_powers;
use super::{LaserBox, LaserError};

const BAUD: u32 = 57_600;
/// A sound device answers within some tens of milliseconds.
const ANSWER_WAIT: TimeNs = TimeNs(300_000_000);
/// The same beside another program, so that the two do not ask again at the same moments for ever.
const BESIDE_ANSWER_WAIT: TimeNs = TimeNs(130_000_000);
/// How often a frame is sent before the device is taken for mute.
const TRIES: usize = 2;

const DEVICE_TYPE: u16 = 100;
const READY_BEAM: u32 = 1171;
const STATUS: u16 = 104;
/// What [`STATUS`] says of a device that has switched itself off.
const STATUS_ERROR: u32 = 3;
const DIGITAL_CONTROL: u16 = 7000;
const LASER_ON: u16 = 7006;
const POWER_PERCENT: u16 = 7013;

struct ReadyBeam {
    port: Conversation,
    sequence: u16,
    /// It has said what it is.
    recognised: bool,
    answer_wait: TimeNs,
    /// Power at the panel at 100 %.
    full_power_uw: PerColour<u32>,
}

/// Opens the device at `path`.
///
/// # Errors
/// [`LaserError::Open`], [`LaserError::InUse`], [`LaserError::NotABox`], [`LaserError::NoAnswer`],
/// [`LaserError::NotAccepted`].
pub(super) fn open(
    path: &Path,
    full_power_uw: PerColour<u32>,
    lasers: &Lasers,
    clock: fn() -> TimeNs,
) -> Result<Box<dyn LaserBox>, LaserError> {
    require_acceptance(lasers)?;
    let port = Conversation::open(path, BAUD, Sharing::Alone, clock)?;
    let mut device = ReadyBeam { port, sequence: 0, recognised: false, answer_wait: ANSWER_WAIT, full_power_uw };
    device.recognise()?;
    // Whatever is wrong with it, it does not stay lit.
    let put_out = device.set_lit(NONE_LIT);
    device.check()?;
    put_out?;
    Ok(Box::new(PowerBox::new(device, lasers, clock)?))
}

/// Puts out the lasers of the device at `path`, whoever else has its port open and speaks to it. A holod that drives it
/// does not know of that and lights them again the next time that it arms it.
///
/// # Errors
/// As [`open`], after some seconds.
pub(super) fn make_dark(path: &Path, clock: fn() -> TimeNs) -> Result<(), LaserError> {
    let open = || {
        let port = Conversation::open(path, BAUD, Sharing::Beside, clock)?;
        Ok(ReadyBeam {
            port,
            sequence: 0x8000,
            recognised: false,
            answer_wait: BESIDE_ANSWER_WAIT,
            full_power_uw: PerColour([1; 3]),
        })
    };
    let mut left = Colour::ALL.to_vec();
    put_out_beside(clock, open, ReadyBeam::recognise, |device| {
        let mut failed = None;
        left.retain(|&colour| device.switch(colour, false).map_err(|why| failed.get_or_insert(why)).is_err());
        failed.map_or(Ok(()), Err)
    })
}

impl ReadyBeam {
    fn recognise(&mut self) -> Result<(), LaserError> {
        let expected = "a MeCom device of type 1171 (READYBeam)";
        let found = match self.ask(Request::Read { parameter: DEVICE_TYPE, instance: 1 })? {
            Reply::Value(READY_BEAM) => {
                self.recognised = true;
                return Ok(());
            }
            Reply::Value(other) => format!("device type {other}"),
            other => format!("{other:?}"),
        };
        Err(LaserError::NotABox { path: self.port.path(), found, expected })
    }

    fn ask(&mut self, request: Request) -> Result<Reply, LaserError> {
        let mut stranger = None;
        for _ in 0..TRIES {
            self.sequence = self.sequence.wrapping_add(1);
            let sent = frame(self.sequence, request);
            self.port.send(sent.as_bytes())?;
            let t_end = self.port.t_end(self.answer_wait);
            while let Some(line) = self.port.line_until(t_end)? {
                match reply(&sent, &line) {
                    Some(reply) => return Ok(reply),
                    // A frame that was damaged, the answer to somebody else's, or what another program left of one;
                    // from a device that has not said what it is, whatever is no frame is a stranger's.
                    None if line.starts_with(b"!") || self.recognised => {}
                    None => {
                        stranger = Some(String::from_utf8_lossy(&line).chars().take(40).collect::<String>());
                        break;
                    }
                }
            }
        }
        let waited_ms = self.answer_wait.0 / 1_000_000 * TRIES as i64;
        Err(match stranger {
            Some(found) => LaserError::NotABox { path: self.port.path(), found, expected: "a MeCom frame" },
            None => LaserError::NoAnswer { command: "MeCom frame", waited_ms },
        })
    }

    fn write(&mut self, parameter: u16, colour: Colour, value: u32) -> Result<(), LaserError> {
        let instance = instance(colour);
        match self.ask(Request::Write { parameter, instance, value })? {
            Reply::Done => Ok(()),
            other => Err(self.complaint(format!("parameter {parameter} of laser {instance}"), &other)),
        }
    }

    fn read(&mut self, parameter: u16, instance: u8) -> Result<u32, LaserError> {
        match self.ask(Request::Read { parameter, instance })? {
            Reply::Value(value) => Ok(value),
            other => Err(self.complaint(format!("parameter {parameter} of {instance}"), &other)),
        }
    }

    /// Asks whether it is well.
    fn check(&mut self) -> Result<(), LaserError> {
        match self.read(STATUS, 1)? {
            STATUS_ERROR => {
                let (sent, found) = ("its status".into(), format!("{STATUS_ERROR} (error)"));
                let expected = "a device without errors: check its interlock and its own software".into();
                Err(LaserError::Complaint { path: self.port.path(), sent, found, expected })
            }
            _ => Ok(()),
        }
    }

    fn complaint(&self, sent: String, reply: &Reply) -> LaserError {
        let found = match reply {
            Reply::Error(code) => format!("error {code}"),
            other => format!("{other:?}"),
        };
        LaserError::Complaint { path: self.port.path(), sent, found, expected: "that it is done".into() }
    }
}

const fn instance(colour: Colour) -> u8 {
    1 + colour.index() as u8
}

impl PowerDevice for ReadyBeam {
    fn has(&self, _colour: Colour) -> bool {
        true
    }

    fn set_power(&mut self, power_uw: PerColour<u32>) -> Result<(), LaserError> {
        within_powers(power_uw, self.full_power_uw)?;
        for colour in Colour::ALL {
            let (asked, full) = (power_uw[colour], self.full_power_uw[colour]);
            let percent = (f64::from(asked) / f64::from(full) * 100.0) as f32;
            self.write(POWER_PERCENT, colour, percent.to_bits())?;
        }
        Ok(())
    }

    fn switch(&mut self, colour: Colour, on: bool) -> Result<(), LaserError> {
        if on {
            self.write(DIGITAL_CONTROL, colour, 1)?;
        }
        self.write(LASER_ON, colour, u32::from(on))?;
        let found = self.read(LASER_ON, instance(colour))?;
        if found == u32::from(on) {
            return Ok(());
        }
        let sent = format!("{colour} {}", if on { "on" } else { "off" });
        let (found, expected) = (found.to_string(), u32::from(on).to_string());
        Err(LaserError::Complaint { path: self.port.path(), sent, found, expected })
    }

    fn dark_wait(&self) -> TimeNs {
        // The question that goes on, and a write and a read for each colour.
        TimeNs((1 + 2 * Colour::ALL.len() as i64) * TRIES as i64 * self.answer_wait.0)
    }

    fn probe(&mut self, _asked: usize) -> Result<bool, LaserError> {
        self.check().map(|()| true)
    }
}

//! Lasers that take commands in text (SCPI and its like), one to a port, as a [`TextLaserProfile`] describes them.
//!
//! They are switched in tens of milliseconds, so they never gate single fields, and they stay as they are when their
//! host dies.

use std::path::{Path, PathBuf};

use holod_calibration::rig::{Expected, LaserDriver, Lasers, Question, TextLaserProfile};
use holod_calibration::{Colour, PerColour, TimeNs};

use super::line_link::Sharing;
use super::power_box::{Conversation, NONE_LIT, PowerBox, PowerDevice, put_out_beside, require_acceptance};
use super::{LaserBox, LaserError};

/// How long an acknowledgement after the answer to a question is waited for, so that it is not taken for the next
/// one's.
const TRAIL_WAIT: TimeNs = TimeNs(30_000_000);

/// One laser on its port.
struct TextLaser {
    port: Conversation,
    profile: TextLaserProfile,
    answer_wait: TimeNs,
}

/// The lasers of a bench.
struct TextLasers {
    lasers: PerColour<Option<TextLaser>>,
    /// What says which power each is told.
    driver: LaserDriver,
    /// The greatest power that each may be told.
    head_limit_uw: PerColour<u64>,
}

/// Opens the lasers at `paths`. Each is recognised before anything else is said to it, and those that are recognised are
/// put out even where that fails with another.
///
/// # Errors
/// [`LaserError::Open`], [`LaserError::InUse`], [`LaserError::NotABox`], [`LaserError::NoAnswerTo`],
/// [`LaserError::Complaint`], [`LaserError::NotAccepted`].
pub(super) fn open(
    profile: &TextLaserProfile,
    paths: &PerColour<Option<PathBuf>>,
    lasers: &Lasers,
    clock: fn() -> TimeNs,
) -> Result<Box<dyn LaserBox>, LaserError> {
    require_acceptance(lasers)?;
    let mut open = TextLasers {
        lasers: PerColour([None, None, None]),
        driver: lasers.driver.clone(),
        head_limit_uw: lasers.greatest_head_uw(),
    };
    let mut recognised = Ok(());
    for colour in Colour::ALL {
        if let Some(path) = &paths[colour] {
            let laser = TextLaser::open(profile, path, Sharing::Alone, clock)
                .and_then(|mut laser| laser.recognise().map(|()| laser));
            match laser {
                Ok(laser) => open.lasers[colour] = Some(laser),
                Err(why) => recognised = recognised.and(Err(why)),
            }
        }
    }
    // Whatever is wrong with one of them, no other stays lit.
    let put_out = open.set_lit(NONE_LIT);
    recognised.and(put_out)?;
    let prepared = open.lasers.0.iter_mut().flatten().try_for_each(TextLaser::prepare);
    // One that was lit by that, such as by a change of its mode, does not stay lit.
    let put_out = open.set_lit(NONE_LIT);
    prepared.and(put_out)?;
    open.lasers.0.iter_mut().flatten().try_for_each(TextLaser::check)?;
    Ok(Box::new(PowerBox::new(open, lasers, clock)?))
}

/// Puts out the laser at `path`, whoever else has its port open and speaks to it. A holod that drives it does not know
/// of that and lights it again the next time that it arms it.
///
/// # Errors
/// As [`open`], after some seconds.
pub(super) fn make_dark(profile: &TextLaserProfile, path: &Path, clock: fn() -> TimeNs) -> Result<(), LaserError> {
    let open = || TextLaser::open(profile, path, Sharing::Beside, clock);
    put_out_beside(clock, open, TextLaser::recognise, TextLaser::put_out)
}

impl TextLaser {
    fn open(
        profile: &TextLaserProfile,
        path: &Path,
        sharing: Sharing,
        clock: fn() -> TimeNs,
    ) -> Result<Self, LaserError> {
        let port = Conversation::open(path, profile.baud, sharing, clock)?;
        let answer_wait = TimeNs(i64::from(profile.answer_timeout_ms) * 1_000_000);
        Ok(Self { port, profile: profile.clone(), answer_wait })
    }

    fn send(&mut self, text: &str) -> Result<(), LaserError> {
        self.port.send(format!("{text}{}", self.profile.end_of_command).as_bytes())
    }

    fn ask(&mut self, question: &str) -> Result<String, LaserError> {
        self.send(question)?;
        let Some(answer) = self.port.line_until(self.port.t_end(self.answer_wait))? else {
            return Err(self.no_answer(question));
        };
        let answer = String::from_utf8_lossy(&answer).trim().to_owned();
        if answer != self.profile.acknowledge {
            let _acknowledged_or_not = self.port.line_until(self.port.t_end(TRAIL_WAIT))?;
        }
        Ok(answer)
    }

    fn recognise(&mut self) -> Result<(), LaserError> {
        self.profile.identify.clone().iter().try_for_each(|question| self.recognise_by(question))
    }

    fn recognise_by(&mut self, Question { ask, expect, .. }: &Question) -> Result<(), LaserError> {
        let answer = self.ask(ask)?;
        if expect.accepts(&answer) {
            return Ok(());
        }
        let found = answer.chars().take(40).collect();
        let expected = "what the laser's profile says that it answers";
        Err(LaserError::NotABox { path: self.port.path(), found, expected })
    }

    /// Brings the laser, which is dark, to where power alone lights nothing and sets how bright it is. A command for what
    /// it does already is not sent: it may not know it.
    fn prepare(&mut self) -> Result<(), LaserError> {
        self.profile.prepare.clone().iter().try_for_each(|command| self.prepare_by(command))?;
        for Question { ask, expect, otherwise } in self.profile.healthy.clone() {
            let Some(command) = otherwise else { continue };
            if !expect.accepts(&self.ask(&ask)?) {
                self.prepare_by(&command)?;
            }
        }
        Ok(())
    }

    fn prepare_by(&mut self, command: &str) -> Result<(), LaserError> {
        self.command(command).map_err(|why| match why {
            LaserError::Complaint { path, sent, found, expected } => {
                let expected = format!(
                    "{expected}: where this laser has another command for that, copy its profile, which is \
                     among the documentation's examples, write the command there, and name the copy in \
                     lasers.profile_file"
                );
                LaserError::Complaint { path, sent, found, expected }
            }
            other => other,
        })
    }

    fn check(&mut self) -> Result<(), LaserError> {
        self.profile.healthy.clone().iter().try_for_each(|question| self.check_by(question))
    }

    fn check_by(&mut self, Question { ask, expect, .. }: &Question) -> Result<(), LaserError> {
        let found = self.ask(ask)?;
        if expect.accepts(&found) {
            return Ok(());
        }
        let expected = format!("{}: check its interlock, faults and operating mode", text_of(expect));
        Err(LaserError::Complaint { path: self.port.path(), sent: ask.clone(), found, expected })
    }

    fn command(&mut self, command: &str) -> Result<(), LaserError> {
        self.send(command)?;
        let t_end = self.port.t_end(self.answer_wait);
        while let Some(line) = self.port.line_until(t_end)? {
            let answer = String::from_utf8_lossy(&line).trim().to_owned();
            if answer == self.profile.acknowledge {
                return Ok(());
            }
            if self.profile.error.as_ref().is_some_and(|error| answer.starts_with(error.as_str())) {
                let (path, expected) = (self.port.path(), format!("`{}`", self.profile.acknowledge));
                return Err(LaserError::Complaint { path, sent: command.into(), found: answer, expected });
            }
        }
        Err(self.no_answer(command))
    }

    fn no_answer(&self, sent: &str) -> LaserError {
        let waited_ms = self.answer_wait.0 / 1_000_000;
        LaserError::NoAnswerTo { path: self.port.path(), sent: sent.into(), waited_ms }
    }

    fn put_out(&mut self) -> Result<(), LaserError> {
        self.profile.off.clone().iter().try_for_each(|command| self.command(command))
    }
}

/// Whether none of the lasers is told more than `limit_uw` so that `power_uw` of it get to the panel.
///
/// # Errors
/// [`LaserError::BeyondHead`].
pub(super) fn within_head_limits(
    driver: &LaserDriver,
    power_uw: PerColour<u32>,
    limit_uw: PerColour<u64>,
) -> Result<(), LaserError> {
    for colour in Colour::ALL.into_iter().filter(|&colour| driver.has(colour)) {
        let told_uw = driver.head_power_uw(colour, power_uw[colour]).unwrap_or(0);
        if told_uw > limit_uw[colour] {
            let [told_mw, limit_mw] = [told_uw, limit_uw[colour]].map(|uw| uw as f64 / 1e3);
            return Err(LaserError::BeyondHead { colour, told_mw, limit_mw });
        }
    }
    Ok(())
}

/// Which answers are right, for messages.
fn text_of(expect: &Expected) -> String {
    match expect {
        Expected::Contains(text) => format!("an answer with `{text}` in it"),
        Expected::OneOf(texts) => format!("`{}`", texts.join("` or `")),
        Expected::Digits => "digits".into(),
    }
}

impl PowerDevice for TextLasers {
    fn has(&self, colour: Colour) -> bool {
        self.lasers[colour].is_some()
    }

    fn set_power(&mut self, power_uw: PerColour<u32>) -> Result<(), LaserError> {
        within_head_limits(&self.driver, power_uw, self.head_limit_uw)?;
        for colour in Colour::ALL {
            // One without power is not switched on, and may have no such power.
            let Some(laser) = self.lasers[colour].as_mut().filter(|_| power_uw[colour] > 0) else { continue };
            let Some(uw) = self.driver.head_power_uw(colour, power_uw[colour]) else { continue };
            let watts = format!("{}.{:06}", uw / 1_000_000, uw % 1_000_000);
            let milliwatts = format!("{}.{:03}", uw / 1000, uw % 1000);
            let command = laser.profile.power.replace("{power_w}", &watts).replace("{power_mw}", &milliwatts);
            laser.command(&command)?;
        }
        Ok(())
    }

    fn switch(&mut self, colour: Colour, on: bool) -> Result<(), LaserError> {
        match &mut self.lasers[colour] {
            Some(laser) if on => laser.profile.on.clone().iter().try_for_each(|command| laser.command(command)),
            Some(laser) => laser.put_out(),
            None if on => Err(LaserError::NoLaser { colour }),
            None => Ok(()),
        }
    }

    fn dark_wait(&self) -> TimeNs {
        // The question that goes on, and each laser's commands to go out.
        let wait_ns = |laser: &TextLaser| laser.profile.off.len() as i64 * laser.answer_wait.0;
        let lasers = || self.lasers.0.iter().flatten();
        let question_ns = lasers().map(|laser| laser.answer_wait.0 + TRAIL_WAIT.0).max().unwrap_or(0);
        TimeNs(question_ns + lasers().map(wait_ns).sum::<i64>())
    }

    fn probe(&mut self, asked: usize) -> Result<bool, LaserError> {
        let mut before = asked;
        for laser in self.lasers.0.iter_mut().flatten() {
            let TextLaserProfile { healthy, identify, .. } = &laser.profile;
            let questions = if healthy.is_empty() { identify } else { healthy };
            let Some(question) = questions.get(before).cloned() else {
                before -= questions.len();
                continue;
            };
            if laser.profile.healthy.is_empty() {
                laser.recognise_by(&question)?;
            } else {
                laser.check_by(&question)?;
            }
            return Ok(false);
        }
        Ok(true)
    }
}

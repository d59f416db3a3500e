//! A program as the commands that set it.

use holod_calibration::rig::Lasers;
use holod_calibration::{Colour, PerColour, TimeNs};
use holod_laser_firmware::{Command, Laser, Limits, Sequence, TimeUs, Trigger, Window};

use super::{LaserError, LaserProgram};

/// The rig's power limits in microwatts, rounded down.
pub(super) fn power_limit_uw(lasers: &Lasers) -> PerColour<u32> {
    lasers.greatest_power_mw().map(Lasers::whole_uw)
}

/// Whether a box that is built for `limits` takes `program`.
///
/// # Errors
/// [`LaserError::BeyondBox`].
pub(super) fn within_limits(program: &LaserProgram, limits: &Limits) -> Result<(), LaserError> {
    within_powers(program.power_uw, PerColour(limits.power_uw))?;
    let lit = program.windows.iter().map(|window| window.width.0 / 1000).max().unwrap_or(0);
    for (what, asked_us, limit_us) in [
        ("heartbeat timeout", program.heartbeat_timeout.0 / 1000, limits.timeout_us),
        ("lit time", lit - i64::from(limits.jitter_us), limits.lit_us),
    ] {
        if asked_us > i64::from(limit_us) {
            let (limit, asked) = (f64::from(limit_us) / 1e3, asked_us as f64 / 1e3);
            return Err(LaserError::BeyondBox { what: what.into(), limit, asked, unit: "ms" });
        }
    }
    Ok(())
}

/// Whether lasers of at most `limit_uw` can give `power_uw`.
///
/// # Errors
/// [`LaserError::BeyondBox`].
pub(super) fn within_powers(power_uw: PerColour<u32>, limit_uw: PerColour<u32>) -> Result<(), LaserError> {
    match Colour::ALL.into_iter().find(|&colour| power_uw[colour] > limit_uw[colour]) {
        None => Ok(()),
        Some(colour) => {
            let [limit, asked] = [limit_uw, power_uw].map(|power_uw| f64::from(power_uw[colour]) / 1e3);
            Err(LaserError::BeyondBox { what: format!("{colour} power"), limit, asked, unit: "mW" })
        }
    }
}

/// The laser of a colour.
pub(super) const fn laser_of(colour: Colour) -> Laser {
    Laser::ALL[colour.index()]
}

/// The colour of a laser.
pub(super) const fn colour_of(laser: Laser) -> Colour {
    Colour::ALL[laser.index()]
}

/// A time point in whole microseconds, not later than `t`; the clock's zero at the earliest.
pub(super) fn floor_us(t: TimeNs) -> TimeUs {
    TimeUs(u64::try_from(t.0.div_euclid(1000)).unwrap_or(0))
}

/// A time point in whole microseconds, not earlier than `t`.
pub(super) fn ceil_us(t: TimeNs) -> TimeUs {
    floor_us(TimeNs(t.0.saturating_add(999)))
}

/// The beginning of a microsecond.
pub(super) fn nanoseconds(t: TimeUs) -> TimeNs {
    TimeNs(i64::try_from(t.0).unwrap_or(i64::MAX).saturating_mul(1000))
}

/// The commands that set `program`, in the order in which a box takes them. Windows are rounded inwards to whole
/// microseconds and end `early_us` before their time.
///
/// # Errors
/// [`LaserError::Figure`] for a power above `power_limit_uw`, or a figure that no line can carry.
pub(super) fn commands(
    program: &LaserProgram,
    trigger: Trigger,
    power_limit_uw: PerColour<u32>,
    early_us: u32,
) -> Result<impl Iterator<Item = Command>, LaserError> {
    for ((colour, &power_uw), &limit_uw) in program.power_uw.iter().zip(&power_limit_uw.0) {
        if power_uw > limit_uw {
            let found = format!("{} mW for {colour}", f64::from(power_uw) / 1e3);
            return Err(LaserError::Figure { what: "power_mw", found, expected: "not more than power_limit_mw" });
        }
    }
    let figure = |what, time: TimeNs, expected| {
        let us = u32::try_from(time.0 / 1000).ok().filter(|&us| us > 0 && time > TimeNs(0));
        us.ok_or_else(|| LaserError::Figure { what, found: format!("{} ns", time.0), expected })
    };
    let mut windows = [Window { delay_us: 0, width_us: 0 }; crate::fields::FIELDS];
    for (window, field) in windows.iter_mut().zip(program.windows) {
        let t_off = floor_us(field.delay + field.width);
        let delay_us = ceil_us(field.delay);
        let width = TimeNs(1000 * (t_off.0 as i64 - i64::from(early_us) - delay_us.0 as i64));
        window.delay_us = u32::try_from(delay_us.0).unwrap_or(u32::MAX);
        window.width_us = figure("width", width, "more than 1 µs and the box's own jitter")?;
    }
    let sequence = Sequence::new(program.sequence.map(laser_of)).expect("a colour frame has one to 24 fields");
    let period_us = figure("frame period", program.frame_period, "more than 1 µs")?;
    let timeout_us = figure("heartbeat_timeout", program.heartbeat_timeout, "more than 1 µs")?;
    let first = Command::Sequence { sequence, period_us, trigger };
    // Where the host asks for each window the box needs none of its own.
    let fields = windows.into_iter().enumerate().filter(move |_| trigger != Trigger::Host);
    let fields = fields.map(|(field, window)| Command::Field { field, window });
    let last =
        [Command::PowerLimit(power_limit_uw.0), Command::Power(program.power_uw.0), Command::Timeout(timeout_us)];
    Ok([first].into_iter().chain(fields).chain(last))
}

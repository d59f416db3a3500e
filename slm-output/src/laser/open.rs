//! The laser box that a rig names.

use holod_calibration::TimeNs;
use holod_calibration::rig::{LaserDriver, Lasers};

use super::program::power_limit_uw;
use super::reconnect::Reconnecting;
use super::{LaserBox, LaserError, SerialBox, SerialOptions, SimulatedLaser, ready_beam, text_laser};

/// Opens the laser box of a bench, which is recognised before it is told anything. A box that is lost later is looked
/// for again by a thread of its own.
///
/// # Errors
/// [`LaserError`] where there is none, it is another device, another program uses it, or the rig does not accept its
/// kind.
pub fn open_laser(lasers: &Lasers, clock: fn() -> TimeNs) -> Result<Box<dyn LaserBox>, LaserError> {
    let opened = open_once(lasers, clock)?;
    if lasers.driver == LaserDriver::Simulated {
        return Ok(opened);
    }
    let lasers = lasers.clone();
    Ok(Box::new(Reconnecting::new(opened, move || open_once(&lasers, clock), clock)?))
}

fn open_once(lasers: &Lasers, clock: fn() -> TimeNs) -> Result<Box<dyn LaserBox>, LaserError> {
    Ok(match &lasers.driver {
        LaserDriver::Simulated => Box::new(SimulatedLaser::new(clock())),
        LaserDriver::Serial { path, sync_wire } => {
            Box::new(SerialBox::open(path, serial_options(lasers, *sync_wire), clock)?)
        }
        LaserDriver::ReadyBeam { path, full_power_uw } => ready_beam::open(path, *full_power_uw, lasers, clock)?,
        LaserDriver::Text { profile, paths } => text_laser::open(profile, paths, lasers, clock)?,
    })
}

fn serial_options(lasers: &Lasers, sync_wire: bool) -> SerialOptions {
    SerialOptions { sync_wire, power_limit_uw: power_limit_uw(lasers) }
}

/// Makes the lasers of a bench dark, whoever else has their ports open, and waits for their acknowledgement. All are
/// tried, even where one fails.
///
/// # Errors
/// The first [`LaserError`].
pub fn make_dark(driver: &LaserDriver, clock: fn() -> TimeNs) -> Result<(), LaserError> {
    match driver {
        LaserDriver::Simulated => Ok(()),
        LaserDriver::Serial { path, .. } => SerialBox::make_dark(path, clock),
        LaserDriver::ReadyBeam { path, .. } => ready_beam::make_dark(path, clock),
        LaserDriver::Text { profile, paths } => {
            let mut dark = Ok(());
            for path in paths.0.iter().flatten() {
                dark = dark.and(text_laser::make_dark(profile, path, clock));
            }
            dark
        }
    }
}

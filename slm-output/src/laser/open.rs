//! The laser box that a rig names.

use std::path::{Path, PathBuf};
use std::thread::ScopedJoinHandle;

use holod_calibration::rig::{LaserDriver, Lasers};
use holod_calibration::{Colour, PerColour, TimeNs};

use super::power_box::colours_lit;
use super::program::{power_limit_uw, within_limits, within_powers};
use super::reconnect::Reconnecting;
use super::{
    BoxReport, LaserBox, LaserError, LaserProgram, SerialBox, SerialOptions, SimulatedLaser, ready_beam, text_laser,
};

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
        LaserDriver::Text { profile, paths, .. } => text_laser::open(profile, paths, lasers, clock)?,
    })
}

fn serial_options(lasers: &Lasers, sync_wire: bool) -> SerialOptions {
    SerialOptions { sync_wire, power_limit_uw: power_limit_uw(lasers) }
}

/// Whether the lasers of a bench can do what its `program` asks for, as far as that is known before they are told:
/// `found` is what a box of holod's protocol says of itself.
///
/// # Errors
/// What [`LaserBox::program`] says then: [`LaserError::BeyondBox`], [`LaserError::BeyondHead`],
/// [`LaserError::CannotGate`], [`LaserError::NoLaser`].
pub fn takes(lasers: &Lasers, program: &LaserProgram, found: Option<&BoxReport>) -> Result<(), LaserError> {
    let has = PerColour(Colour::ALL.map(|colour| lasers.driver.has(colour)));
    match &lasers.driver {
        LaserDriver::Simulated => Ok(()),
        LaserDriver::Serial { .. } => found.map_or(Ok(()), |found| within_limits(program, &found.limits)),
        LaserDriver::ReadyBeam { full_power_uw, .. } => {
            colours_lit(program, lasers.gated_by_panel, has)?;
            within_powers(program.power_uw, *full_power_uw)
        }
        LaserDriver::Text { .. } => {
            colours_lit(program, lasers.gated_by_panel, has)?;
            text_laser::within_head_limits(&lasers.driver, program.power_uw, lasers.greatest_head_uw())
        }
    }
}

/// Makes the lasers of a bench dark, whoever else has their ports open, and waits for their acknowledgement. All are
/// tried, even where one fails.
///
/// # Errors
/// [`LaserError`]; of several lasers [`LaserError::NotAllDark`].
pub fn make_dark(driver: &LaserDriver, clock: fn() -> TimeNs) -> Result<(), LaserError> {
    match driver {
        LaserDriver::Simulated => Ok(()),
        LaserDriver::Serial { path, .. } => SerialBox::make_dark(path, clock),
        LaserDriver::ReadyBeam { path, .. } => ready_beam::make_dark(path, clock),
        LaserDriver::Text { profile, paths, .. } => {
            let paths: Vec<&Path> = paths.0.iter().flatten().map(PathBuf::as_path).collect();
            all_dark(&paths, |path| text_laser::make_dark(profile, path, clock))
        }
    }
}

/// Puts out the laser at each of `paths` by a thread of its own: one that does not answer, which takes seconds, keeps
/// none of the others lit.
fn all_dark(paths: &[&Path], put_out: impl Fn(&Path) -> Result<(), LaserError> + Sync) -> Result<(), LaserError> {
    if let [path] = paths {
        return put_out(path);
    }
    let put_out = &put_out;
    let ended = std::thread::scope(|scope| {
        let spawn = |path| std::thread::Builder::new().spawn_scoped(scope, move || put_out(path));
        let threads: Vec<_> = paths.iter().map(|&path| (path, spawn(path))).collect();
        let end = |(path, thread): (_, std::io::Result<ScopedJoinHandle<'_, _>>)| match thread {
            Ok(thread) => thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)),
            // A machine that starts no thread any more has this one.
            Err(_) => put_out(path),
        };
        threads.into_iter().map(end).collect::<Vec<Result<(), LaserError>>>()
    });
    let (mut lit, mut dark) = (Vec::new(), Vec::new());
    for (path, ended) in paths.iter().zip(ended) {
        let path = path.display().to_string();
        match ended {
            Ok(()) => dark.push(path),
            Err(why) if why.to_string().starts_with(&format!("{path}:")) => lit.push(why.to_string()),
            Err(why) => lit.push(format!("{path}: {why}")),
        }
    }
    if lit.is_empty() {
        return Ok(());
    }
    let dark = if dark.is_empty() { "none".to_owned() } else { dark.join(", ") };
    Err(LaserError::NotAllDark { lit: lit.join("; "), dark })
}

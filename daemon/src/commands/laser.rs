//! `holod laser` and `holod dark`: the laser box by itself.

use std::time::Duration;

use holod_calibration::rig::{LaserDriver, Rig};
use holod_calibration::{Colour, TimeNs};
use holod_pupil_input::host_now;
use holod_slm_output::laser::{
    BoxReport, DarkReason, LaserBox, LaserError, LaserProgram, SerialBox, SerialOptions, Trigger, make_dark, open_laser,
};
use holod_slm_output::schedule::FieldGate;

use crate::cli::{DarkArgs, LaserArgs, LaserCommand};
use crate::failure::{Exit, Failure};
use crate::service_lasers::ServiceLasers;
use crate::{results, setup};

/// How long beyond its own timeout a box is waited for that should go dark by itself.
const PATIENCE: TimeNs = TimeNs(2_000_000_000);

pub(super) fn laser(command: &LaserCommand) -> Result<(), Failure> {
    match command {
        LaserCommand::Status(args) => status(&bench(args)?),
        LaserCommand::Arm(args) => arm(&bench(args)?),
        LaserCommand::Dark(args) => dark(args),
    }
}

/// Puts the lasers out, unless it is run after a service's start that never opened them.
pub(super) fn dark(args: &DarkArgs) -> Result<(), Failure> {
    let Some(service) = ServiceLasers::of_this_process().filter(|_| args.after_service) else {
        return put_out(&args.lasers);
    };
    if service.are_untouched() {
        return results::print(
            "the service failed before it opened the lasers: they are left as they are, since another holod may drive them",
        );
    }
    service.owe_darkness();
    put_out(&args.lasers)?;
    service.are_dark();
    Ok(())
}

/// Puts the lasers out, whoever else has their ports open. The built-in rig has none: without a rig or a port nothing
/// would be put out.
fn put_out(args: &LaserArgs) -> Result<(), Failure> {
    if args.rig.config.is_none() && args.port.is_none() {
        let which = "holod dark: which lasers? say --config RIG, the rig file of the holod that drives them, or --port \
                     PATH, the port of a laser box; nothing was put out";
        return Err(Failure::new(Exit::Usage, which));
    }
    let driver = &lasers(args)?;
    if *driver == LaserDriver::Simulated {
        return results::print("no laser box on this bench: its simulated lasers ended with the daemon");
    }
    make_dark(driver, host_now).map_err(Failure::because(Exit::Unavailable))?;
    let who_knows = match driver {
        LaserDriver::Simulated => "",
        LaserDriver::Serial { .. } => {
            "; only a holod that is started anew lights them again, as a service that fails is by itself (`systemctl stop \
             holod` keeps it from that); end one that hangs before the box is reset"
        }
        LaserDriver::ReadyBeam { .. } | LaserDriver::Text { .. } => {
            "; a holod that still drives them does not know of it and may light them again: end it"
        }
    };
    results::print(&format!("{}: the lasers acknowledged that they are dark{who_knows}", ports(driver)))
}

/// The lasers of the rig that was named, whatever else is wrong with it, or the laser box at the port that was named.
fn lasers(args: &LaserArgs) -> Result<LaserDriver, Failure> {
    if let Some(path) = &args.port {
        return Ok(LaserDriver::Serial { path: path.clone(), sync_wire: false });
    }
    setup::rig_of_lasers(&args.rig).map(|rig| rig.lasers.driver).or_else(|failure| {
        let Some(driver) = args.rig.config.as_deref().and_then(Rig::laser_driver) else { return Err(failure) };
        tracing::warn!("{failure}; its lasers are put out nevertheless");
        Ok(driver)
    })
}

/// The rig that was named, or the built-in one with a laser box at the port that was named.
fn bench(args: &LaserArgs) -> Result<Rig, Failure> {
    let mut rig = setup::rig_of_lasers(&args.rig)?;
    if let Some(path) = &args.port {
        rig.lasers.driver = LaserDriver::Serial { path: path.clone(), sync_wire: false };
    }
    Ok(rig)
}

fn ports(driver: &LaserDriver) -> String {
    driver.paths().iter().map(|path| path.display().to_string()).collect::<Vec<_>>().join(", ")
}

fn status(rig: &Rig) -> Result<(), Failure> {
    let unavailable = Failure::because(Exit::Unavailable);
    let text = match &rig.lasers.driver {
        LaserDriver::Simulated => "simulated: no light leaves this bench".to_owned(),
        LaserDriver::Serial { path, .. } => {
            let found = SerialBox::inspect(path, host_now).map_err(unavailable)?;
            format!("{}: {}", path.display(), text_of(&found))
        }
        // These say who they are when they are opened, and are told to be dark when they are closed.
        driver => {
            drop(open_laser(&rig.lasers, host_now).map_err(unavailable)?);
            format!(
                "{}: recognised, dark; it cannot time single fields and stays lit when its host dies",
                ports(driver)
            )
        }
    };
    results::print(&text)
}

fn text_of(found: &BoxReport) -> String {
    let BoxReport { name, limits, state, clock_error_ns } = found;
    let lit = state.lit.map_or("none".to_owned(), |laser| Colour::ALL[laser as usize].name().to_owned());
    let [red, green, blue] = limits.power_uw.map(|uw| f64::from(uw) / 1e3);
    let sync = match (limits.sync_input, state.sync.t_last) {
        (false, _) => "it has none".to_owned(),
        (true, None) => "no edge since it booted".to_owned(),
        (true, Some(_)) => format!("{} edges since it booted", state.sync.count),
    };
    format!(
        "a laser box called {name}\n\
         state      {}; laser lit: {lit}; dark last because of {} ({})\n\
         interlock  {}\n\
         sync wire  {sync}\n\
         limits     red {red}, green {green}, blue {blue} mW; heartbeat timeout up to {} ms; gates up to {} µs late\n\
         clock      known to {:.0} µs from here",
        if state.armed { "armed" } else { "dark" },
        state.reason.name(),
        state.reason.meaning(),
        if state.interlock_closed { "closed" } else { "open: the box cannot be armed" },
        limits.timeout_us / 1000,
        limits.jitter_us,
        *clock_error_ns as f64 / 1e3,
    )
}

/// Programs the box, arms it, lights nothing, falls silent, and sees whether it goes dark by itself.
fn arm(rig: &Rig) -> Result<(), Failure> {
    let LaserDriver::Serial { path, .. } = &rig.lasers.driver else {
        return Err(Failure::new(
            Exit::Unavailable,
            "holod laser arm tries out whether a box goes dark by itself, which only one with a heartbeat does: name \
             its port with --port, or a rig whose lasers have driver = \"serial\"",
        ));
    };
    let unavailable = Failure::because(Exit::Unavailable);
    let program = FieldGate::new(&rig.panel, &rig.lasers).and_then(|gate| gate.program(&rig.panel, &rig.lasers));
    // Windows that the host asks for, of which it asks for none: whatever is on the sync wire, nothing is lit.
    let program = LaserProgram { trigger: Trigger::Host, ..program.map_err(Failure::because(Exit::Config))? };
    let options = SerialOptions { sync_wire: false, ..SerialOptions::default() };
    let mut laser = SerialBox::open(path, options, host_now).map_err(&unavailable)?;
    let silent = silence(&mut laser, &program);
    let acknowledged = laser.dark(DarkReason::Asked, host_now());
    let silent = silent.map_err(&unavailable)?;
    acknowledged.map_err(unavailable)?;
    let timeout_ms = program.heartbeat_timeout.seconds() * 1e3;
    let Some((t_dark, reason)) = silent else {
        return Err(Failure::new(
            Exit::Unavailable,
            format!(
                "{}: the box was still armed {:.0} ms after it had heard its last heartbeat, and its timeout is \
                 {timeout_ms:.0} ms: lasers would stay lit when holod dies; do not use this box, look at its firmware",
                path.display(),
                timeout_ms + PATIENCE.seconds() * 1e3
            ),
        ));
    };
    results::print(&format!(
        "{}: armed with no laser lit, and dark by itself after {:.0} ms of silence ({}; its timeout is {timeout_ms:.0} ms)",
        path.display(),
        t_dark.seconds() * 1e3,
        reason.name(),
    ))
}

/// After which silence the armed box is dark, and why; `None` where it stays armed.
fn silence(laser: &mut SerialBox, program: &LaserProgram) -> Result<Option<(TimeNs, DarkReason)>, LaserError> {
    laser.dark(DarkReason::Boot, host_now())?;
    laser.program(program, host_now())?;
    laser.arm(host_now())?;
    let t_armed = host_now();
    let t_end = t_armed + program.heartbeat_timeout + PATIENCE;
    while host_now() < t_end {
        // The box's own word, not what the host supposes of it. Nor is it polled: that tells a box to go dark which has
        // gone without a heartbeat for too long, and whether it does so by itself is what is looked for.
        let state = laser.report()?.state;
        if !state.armed {
            return Ok(Some((host_now() - t_armed, state.reason)));
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    Ok(None)
}

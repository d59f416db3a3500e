//! A simulated laser box as a process of its own: the reference firmware on a pseudo-terminal.
//!
//! `holod-simulated-laser LOG [OPTION...]` prints the path of the terminal at which it can be reached, serves one host
//! after another, and writes what its lasers do to LOG, as CSV in the host's monotonic time. It ends when its standard
//! input does; lines on that put faults into it.

use std::fs::File;
use std::io::{self, BufRead, Write};
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use holod_calibration::{TimeNs, host_now};
use holod_slm_output::laser::simulator::{Faults, SimulatedBox, SimulatedTerminal};

const USAGE: &str = "usage: holod-simulated-laser LOG [OPTION...]

  --clock-offset-us N   what the box's clock shows when it starts (0)
  --clock-drift-ppm N   by how much it runs faster than this computer's (0); a sound box stays within 100
  --no-hang-up          the line cannot hang up, as a bare serial line
  --name NAME           another name than `simulated`: the host takes its lasers for real
  --sync-hz F           edges on the sync wire from the start

Commands on standard input, a line each:

  interlock open|closed     open or close the interlock
  corrupt received|sent     damage the next bytes on the line
  freeze MS                 the firmware stands still
  reset                     the board resets itself
  sync HZ                   edges on the sync wire from now on; 0 for none
  end                       end, as at the end of the input";

fn main() -> ExitCode {
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(why) => {
            let usage = why.kind() == io::ErrorKind::InvalidInput;
            let _nobody_reads = writeln!(io::stderr(), "holod-simulated-laser: {why}");
            ExitCode::from(if usage { 64 } else { 74 })
        }
    }
}

fn wrong(what: impl std::fmt::Display) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidInput, format!("{what}\n{USAGE}"))
}

/// What the command line asks for.
struct Options {
    log: PathBuf,
    simulated: SimulatedBox,
    sync_hz: f64,
}

fn options(mut arguments: impl Iterator<Item = String>) -> io::Result<Options> {
    let mut log = None;
    let mut simulated = SimulatedBox::new(host_now());
    let mut sync_hz = 0.0;
    while let Some(argument) = arguments.next() {
        let mut value = || arguments.next().ok_or_else(|| wrong(format_args!("{argument}: a value is missing")));
        let number =
            |text: String| text.parse::<i64>().map_err(|_| wrong(format_args!("{text}: expected a whole number")));
        match argument.as_str() {
            "--clock-offset-us" => simulated.clock.offset_us = number(value()?)?.unsigned_abs(),
            "--clock-drift-ppm" => simulated.clock.drift_ppm = number(value()?)?,
            "--no-hang-up" => simulated.sees_hang_up = false,
            "--name" => simulated.name = String::leak(value()?),
            "--sync-hz" => sync_hz = hertz(&value()?)?,
            option if option.starts_with("--") => return Err(wrong(format_args!("{option}: no such option"))),
            _ if log.is_some() => return Err(wrong(format_args!("{argument}: one LOG only"))),
            _ => log = Some(PathBuf::from(argument)),
        }
    }
    Ok(Options { log: log.ok_or_else(|| wrong("LOG is missing"))?, simulated, sync_hz })
}

fn hertz(text: &str) -> io::Result<f64> {
    let hz: f64 = text.parse().map_err(|_| wrong(format_args!("{text}: expected a rate in Hz")))?;
    if (0.0..=1e4).contains(&hz) { Ok(hz) } else { Err(wrong(format_args!("{text}: expected 0 to 10000 Hz"))) }
}

fn set_sync(faults: &Faults, hz: f64) {
    let period_ns = if hz > 0.0 { (1e9 / hz) as i64 } else { 0 };
    faults.set_sync(host_now(), TimeNs(period_ns));
}

fn run() -> io::Result<()> {
    let Options { log, simulated, sync_hz } =
        options(std::env::args_os().skip(1).map(|argument| argument.to_string_lossy().into_owned()))?;
    let log = File::create(&log).map_err(|why| io::Error::new(why.kind(), format!("{}: {why}", log.display())))?;
    let terminal = SimulatedTerminal::open()?;
    writeln!(io::stdout(), "{}", terminal.path().display())?;
    io::stdout().flush()?;
    let faults = Arc::new(Faults::default());
    set_sync(&faults, sync_hz);
    let its_faults = Arc::clone(&faults);
    std::thread::spawn(move || {
        let ended = terminal.serve(simulated, log, &its_faults, host_now);
        let _nobody_reads = writeln!(io::stderr(), "holod-simulated-laser: {ended:?}");
    });
    for line in io::stdin().lock().lines() {
        let line = line?;
        match line.split_whitespace().collect::<Vec<_>>().as_slice() {
            [] => {}
            ["interlock", "open"] => faults.set_interlock_open(true),
            ["interlock", "closed"] => faults.set_interlock_open(false),
            ["corrupt", "received"] => faults.corrupt_received(),
            ["corrupt", "sent"] => faults.corrupt_sent(),
            ["freeze", ms] => {
                let ms = ms.parse().map_err(|_| wrong(format_args!("{line}: expected milliseconds")))?;
                faults.set_frozen(true);
                std::thread::sleep(Duration::from_millis(ms));
                faults.set_frozen(false);
            }
            ["reset"] => faults.reset(),
            ["sync", hz] => set_sync(&faults, hertz(hz)?),
            ["end"] => return Ok(()),
            _ => return Err(wrong(format_args!("{line}: no such command"))),
        }
    }
    Ok(())
}

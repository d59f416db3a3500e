//! A simulated laser box as a process of its own, on a pseudo-terminal.
//!
//! `holod-simulated-laser LOG`: prints the path of the terminal at which it can be reached, serves one host after
//! another, and writes what its lasers do to LOG, as CSV. It ends when its standard input does.

use std::fs::File;
use std::io::{self, Read, Write};
use std::process::ExitCode;

use holod_slm_output::laser::simulated_box::SimulatedTerminal;
use holod_slm_output::output::monotonic_now;

fn main() -> ExitCode {
    let arguments: Vec<_> = std::env::args_os().skip(1).collect();
    let [log] = arguments.as_slice() else {
        let _nobody_reads = writeln!(io::stderr(), "usage: holod-simulated-laser LOG");
        return ExitCode::from(64);
    };
    match run(log) {
        Ok(()) => ExitCode::SUCCESS,
        Err(why) => {
            let _nobody_reads = writeln!(io::stderr(), "holod-simulated-laser: {}: {why}", log.display());
            ExitCode::from(74)
        }
    }
}

fn run(log: &std::ffi::OsStr) -> io::Result<()> {
    let log = File::create(log)?;
    let terminal = SimulatedTerminal::open()?;
    writeln!(io::stdout(), "{}", terminal.path().display())?;
    io::stdout().flush()?;
    std::thread::spawn(move || {
        let ended = terminal.serve(log, monotonic_now);
        let _nobody_reads = writeln!(io::stderr(), "holod-simulated-laser: {ended:?}");
    });
    let mut until_the_end = Vec::new();
    io::stdin().read_to_end(&mut until_the_end)?;
    Ok(())
}

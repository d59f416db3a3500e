//! Reads a tracker for some seconds and prints its counters: `read_tracker SPEC SECONDS`.

use std::error::Error;
use std::io::{self, Write};
use std::process::ExitCode;
use std::time::{Duration, Instant};

use holod_calibration::rig;
use holod_pupil_input::{SampleEye, Tracker, host_now};

fn main() -> ExitCode {
    match read() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error}");
            ExitCode::FAILURE
        }
    }
}

fn read() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<_> = std::env::args().collect();
    let [_, spec, seconds] = &arguments[..] else { return Err("expected SPEC SECONDS".into()) };
    let settings = rig::Tracker { eye: rig::Eye::Left, ..rig::Rig::default().tracker };
    let mut handle = Tracker::start(&spec.parse()?, &settings, host_now())?;
    let end = Instant::now() + Duration::from_secs_f64(seconds.parse()?);
    let mut sums = [(0_u32, 0.0); SampleEye::ALL.len()];
    let mut running = true;
    while running {
        std::thread::sleep(Duration::from_millis(20));
        running = Instant::now() < end;
        if !running {
            // The gate lets go of the samples that it still holds.
            handle.stop();
        }
        while let Some(decision) = handle.decisions().pop() {
            let (count, sum_mm) = &mut sums[decision.sample.eye.index()];
            *count += 1;
            *sum_mm += f64::from(decision.sample.diameter_mm);
        }
    }
    let mut out = io::stdout();
    write!(out, "{{")?;
    for (name, count) in handle.counters().entries() {
        write!(out, r#""{name}": {count}, "#)?;
    }
    for (eye, (count, sum_mm)) in SampleEye::ALL.into_iter().zip(sums) {
        write!(out, r#""{eye}": {count}, "{eye}_mean_mm": {:.5}, "#, sum_mm / f64::from(count.max(1)))?;
    }
    writeln!(out, r#""spec": "{spec}"}}"#)?;
    Ok(())
}

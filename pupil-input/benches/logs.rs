//! How fast one-hour logs at 1 kHz open, and in how much memory.
//!
//! `cargo bench -p holod-pupil-input --bench logs`; set `TMPDIR` to a folder in memory to measure without a disk. Each
//! log is opened by a process of its own, so that its peak memory is known; the peer, a pass of the csv crate over the
//! records of the same file that keeps nothing, runs beside it. Seconds are those of the processor, one core, so that
//! other work on the machine spoils them less.

#![allow(clippy::print_stdout, reason = "a bench reports on stdout")]

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;
use std::process::{Command, ExitCode};

use holod_pupil_input::wire::line::{LineSample, encode_line};
use holod_pupil_input::{LogInfo, Recording, SampleEye};
use rustix::time::{ClockId, clock_gettime};

const ROWS: u32 = 3_600_000;
const REPEATS: usize = 3;

type Generate = fn(&mut dyn Write) -> std::io::Result<()>;

/// Name, what writes it, and what the peer takes for its separator.
const LOGS: [(&str, Generate, u8); 4] =
    [("eyelink", eyelink, b'\t'), ("core", core, b','), ("smi", smi, b';'), ("lines", lines, b',')];

fn pupil_mm(k: u32) -> f32 {
    4.0 + 0.5 * (f64::from(k) * 1e-3).sin() as f32
}

/// Two eyes, one row in ten seconds' last 150 ms lost.
fn eyelink(out: &mut dyn Write) -> std::io::Result<()> {
    writeln!(out, "** TYPE: EDF_FILE BINARY EVENT SAMPLE TAGGED\nSTART\t1408660 \tLEFT\tRIGHT\tSAMPLES\tEVENTS")?;
    writeln!(out, "PUPIL\tAREA\nSAMPLES\tGAZE\tLEFT\tRIGHT\tRATE\t1000.00\tTRACKING\tCR\tFILTER\t2")?;
    for k in 0..ROWS {
        let t_ms = 1_408_660 + k;
        if k % 10_000 < 9_850 {
            let area = 200.0 * pupil_mm(k);
            writeln!(out, "{t_ms}\t  964.3\t  541.5\t {area:6.1}\t  960.5\t  538.8\t {area:6.1}\t.....")?;
        } else {
            writeln!(out, "{t_ms}\t   .\t   .\t    0.0\t   .\t   .\t    0.0\t.C.C.")?;
        }
    }
    Ok(())
}

/// Two eyes, each frame a row of 2-D detection and one of the model; 34 columns.
fn core(out: &mut dyn Write) -> std::io::Result<()> {
    writeln!(
        out,
        "pupil_timestamp,world_index,eye_id,confidence,norm_pos_x,norm_pos_y,diameter,method,ellipse_center_x,\
         ellipse_center_y,ellipse_axis_a,ellipse_axis_b,ellipse_angle,diameter_3d,model_confidence,model_id,\
         sphere_center_x,sphere_center_y,sphere_center_z,sphere_radius,circle_3d_center_x,circle_3d_center_y,\
         circle_3d_center_z,circle_3d_normal_x,circle_3d_normal_y,circle_3d_normal_z,circle_3d_radius,theta,phi,\
         projected_sphere_center_x,projected_sphere_center_y,projected_sphere_axis_a,projected_sphere_axis_b,\
         projected_sphere_angle"
    )?;
    let figures = ",0.1234567890123456".repeat(18);
    for k in 0..ROWS {
        let t_s = f64::from(k / 2) * 2e-3 - 323_801.6;
        let (eye, mm) = (k / 2 % 2, pupil_mm(k));
        write!(out, "{t_s:.6},{},{eye},0.9876543210123456,0.4712345678901234,0.5123456789012345,", k / 33)?;
        let ellipse = "96.12345678901234,97.23456789012345,30.12345678901234,31.23456789012345,88.12345678901234";
        if k % 2 == 0 {
            writeln!(out, "{:.14},2d c++,{ellipse},,,,,,,,,,,,,,,,,,,,", 10.0 * mm)?;
        } else {
            writeln!(out, "{:.14},pye3d 0.3.0 real-time,{ellipse},{mm:.15},0.85,0{figures}", 10.0 * mm)?;
        }
    }
    Ok(())
}

fn smi(out: &mut dyn Write) -> std::io::Result<()> {
    write!(out, "## [BeGaze]\r\n## Sample Rate:\t1000\r\n")?;
    write!(out, "Time;Type;Trial;L Pupil Diameter [mm];R Pupil Diameter [mm]\r\n")?;
    for k in 0..ROWS {
        let (t_us, mm) = (8_412_345_678 + 1000 * u64::from(k), pupil_mm(k));
        write!(out, "{t_us};SMP;1;{mm:.2};{mm:.2}\r\n")?;
    }
    Ok(())
}

fn lines(out: &mut dyn Write) -> std::io::Result<()> {
    let mut line = String::new();
    for k in 0..ROWS {
        line.clear();
        let (sequence, device_us) = (u64::from(k), 1000 * i64::from(k));
        let sample =
            LineSample { sequence, device_us, eye: SampleEye::Left, diameter_mm: pupil_mm(k), confidence: 1.0 };
        encode_line(&sample, &mut line);
        out.write_all(line.as_bytes())?;
    }
    Ok(())
}

/// The peak of this process's resident memory so far, in bytes.
fn peak_bytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let peak = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    peak.and_then(|peak| peak.trim().trim_end_matches(" kB").parse::<u64>().ok()).map_or(0, |kib| 1024 * kib)
}

/// Processor time that this process has used, seconds.
fn used_s() -> f64 {
    let used = clock_gettime(ClockId::ProcessCPUTime);
    used.tv_sec as f64 + 1e-9 * used.tv_nsec as f64
}

/// Opens one log and prints what it took; run as a process of its own.
fn open(path: &Path, separator: u8) -> Result<(), Box<dyn std::error::Error>> {
    let before = peak_bytes();
    let mut seconds = f64::MAX;
    let mut peak = 0;
    let mut info_s = 0.0;
    let mut samples = 0;
    for repeat in 0..REPEATS {
        let begins = used_s();
        let recording = Recording::read(path)?;
        seconds = seconds.min(used_s() - begins);
        samples = recording.len();
        if repeat == 0 {
            peak = peak_bytes();
        } else if repeat + 1 == REPEATS {
            let begins = used_s();
            std::hint::black_box(LogInfo::of(&recording, None));
            info_s = used_s() - begins;
        }
    }
    let with_info = peak_bytes();
    let mut peer_s = f64::MAX;
    for _ in 0..REPEATS {
        let begins = used_s();
        let mut csv = csv::ReaderBuilder::new().delimiter(separator).flexible(true).from_path(path)?;
        let mut record = csv::ByteRecord::new();
        while csv.read_byte_record(&mut record)? {
            std::hint::black_box(&record);
        }
        peer_s = peer_s.min(used_s() - begins);
    }
    let megabytes = std::fs::metadata(path)?.len() as f64 * 1e-6;
    println!(
        "{:8} {megabytes:6.0} MB  {samples:8} samples  {seconds:5.2} s  {:5.0} MB/s  peak {:4.0} MB ({:+.0} over the \
         start, {:.0} with info)  info {info_s:.2} s  csv crate's pass {peer_s:.2} s, ratio {:.2}",
        path.file_name().unwrap_or_default().to_string_lossy(),
        megabytes / seconds,
        peak as f64 * 1e-6,
        (peak - before) as f64 * 1e-6,
        with_info as f64 * 1e-6,
        seconds / peer_s,
    );
    Ok(())
}

fn run() -> Result<bool, Box<dyn std::error::Error>> {
    let arguments: Vec<_> = std::env::args().collect();
    if let [_, command, path, separator] = &arguments[..]
        && command == "open"
    {
        open(Path::new(path), separator.parse()?)?;
        return Ok(true);
    }
    let dir = tempfile::TempDir::new()?;
    let mut well = true;
    for (name, generate, separator) in LOGS {
        let path = dir.path().join(name);
        let mut out = BufWriter::new(File::create(&path)?);
        generate(&mut out)?;
        out.into_inner()?.sync_all()?;
        let program = std::env::current_exe()?;
        well &= Command::new(program).arg("open").arg(&path).arg(separator.to_string()).status()?.success();
        std::fs::remove_file(&path)?;
    }
    Ok(well)
}

fn main() -> ExitCode {
    match run() {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(error) => {
            eprintln!("{error}");
            ExitCode::FAILURE
        }
    }
}

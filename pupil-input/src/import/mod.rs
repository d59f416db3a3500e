//! Logs of pupil diameters, told apart by their content and read into one shape: one file for each format, and a line
//! for it in [`IMPORTERS`].
//!
//! A log is read in one pass, as a stream: what stays in memory is 24 bytes a sample.

mod bids;
pub(crate) mod csv;
mod eyelink;
mod fault;
mod first_recording;
mod format;
mod gazepoint;
mod importer;
mod info;
mod input;
pub(crate) mod leaps;
mod lines;
mod neon;
mod parts;
mod pupil_labs_core;
mod pupilext;
pub(crate) mod raw;
mod recording;
mod rows;
mod size;
mod smi;
mod table;
mod text;
mod tobii;
mod unpack;
mod xdf;

use std::path::Path;

pub use fault::{LogFault, LogFaults, ReplayError};
pub use format::LogFormat;
use importer::Importer;
pub use info::{BlinkCounts, EyeInfo, FaultCount, LogInfo, Range};
use input::LogInput;
use recording::LogBuilder;
pub use recording::Recording;
pub use rows::Blink;

use crate::record::SAMPLES_HEADER;

/// In the order in which they are asked; no two recognise the same log.
const IMPORTERS: &[Importer] = &[
    raw::IMPORTER,
    lines::IMPORTER,
    neon::CLOUD,
    neon::NATIVE,
    pupil_labs_core::IMPORTER,
    eyelink::IMPORTER,
    smi::IMPORTER,
    csv::IMPORTER,
    xdf::IMPORTER,
    tobii::IMPORTER,
    gazepoint::IMPORTER,
    pupilext::IMPORTER,
    bids::IMPORTER,
];

impl Recording {
    /// Reads a log.
    ///
    /// # Errors
    /// It is no readable file, of no known format, without a single sample, or in no order of time. Single bad lines
    /// are counted instead: [`Self::faults`].
    pub fn read(path: &Path) -> Result<Self, ReplayError> {
        let kind = std::fs::metadata(path).map_err(|source| ReplayError::Io { path: path.into(), source })?.file_type();
        if kind.is_dir() {
            let hint = "; give the file in it, such as 3d_eye_states.csv";
            return Err(ReplayError::NotAFile { path: path.into(), found: "a directory", hint });
        }
        if !kind.is_file() {
            let hint = "; for a live tracker give `serial:PATH`";
            return Err(ReplayError::NotAFile { path: path.into(), found: "a device or pipe", hint });
        }
        let input = LogInput::new(path)?;
        input.failed()?;
        if input.head_lines().next() == Some(SAMPLES_HEADER.as_bytes()) {
            return Err(input.content(
                "the samples of a run's record with what the gate said of each",
                "what they were made of: play `tracker.holodraw` beside it again, or the log or scenario that the run had",
            ));
        }
        // First, since a log that is stored in an archive may be recognised behind the archive's own bytes.
        if let Some((_, found, advice)) = RELATIVES.iter().find(|(begins, ..)| input.head.starts_with(begins)) {
            return Err(unknown_format(path, (*found).into(), advice));
        }
        let importer = IMPORTERS
            .iter()
            .find(|importer| (importer.recognises)(&input))
            .ok_or_else(|| unknown_format(path, beginning(&input), "convert the log to one of these"))?;
        let mut builder = LogBuilder::default();
        (importer.read)(&input, &mut builder)?;
        input.failed()?;
        if let Some(shortened) = input.shortened() {
            builder.warn(shortened);
        }
        builder.finish(importer.format, path)
    }
}

fn unknown_format(path: &Path, found: String, advice: &'static str) -> ReplayError {
    let names: Vec<_> = IMPORTERS.iter().map(|importer| importer.format.name()).collect();
    ReplayError::UnknownFormat { path: path.into(), found, formats: names.join(", "), advice }
}

/// How files begin that are no logs and of which logs can be made: what they are, and what makes a log of one.
const RELATIVES: [(&[u8], &str, &str); 2] = [
    (b"SR_RESEARCH_COMBINED_FILE_FORMAT", "an EyeLink EDF file", "convert it to `.asc` with SR Research's `edf2asc`"),
    (b"PK\x03\x04", "a zip archive or a workbook", "unpack it, or export the sheet as CSV or TSV"),
];

/// How an unknown file begins, for people.
fn beginning(input: &LogInput<'_>) -> String {
    match input.head_lines().next() {
        None => "an empty file".into(),
        Some(line) => {
            let shown: String = String::from_utf8_lossy(&line[..line.len().min(120)]).escape_debug().collect();
            format!("`{shown}`{}", if line.len() > 120 { "..." } else { "" })
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// How a log of each format begins.
    fn beginnings() -> Vec<(LogFormat, Vec<u8>)> {
        let mut native = Vec::new();
        for record in 0..4 {
            for index in 0..20_u8 {
                let value = match index {
                    0 | 7 => 3.5 + 0.1 * record as f32,
                    5 | 12 => 0.6,
                    6 | 13 => 0.8,
                    4 | 11 => 0.0,
                    _ => f32::from(index),
                };
                native.extend(value.to_le_bytes());
            }
        }
        let text = |format, text: &str| (format, text.as_bytes().to_vec());
        let utf16 = "\u{feff}## [BeGaze]\r\nTime\tType\tTrial\tR Mapped Diameter [mm]\r\n";
        vec![
            text(LogFormat::Lines, "# converted\nP1,1,2,L,3,1*00\n"),
            text(LogFormat::NeonEyeStates, "section id,timestamp [ns],pupil diameter left [mm]\n0,1,3.5\n"),
            (LogFormat::NeonNative, native),
            text(
                LogFormat::Core,
                "pupil_timestamp,world_index,eye_id,confidence,norm_pos_x,norm_pos_y,diameter,method,diameter_3d\n",
            ),
            text(LogFormat::Core, "timestamp,index,id,confidence,norm_pos_x,norm_pos_y,diameter,method\n"),
            text(LogFormat::EyeLink, "** CONVERTED FROM a.edf\n** TYPE: EDF_FILE BINARY EVENT SAMPLE TAGGED\n"),
            text(LogFormat::EyeLink, "MSG\t12 hello\nSTART\t15 \tLEFT\tRIGHT\tSAMPLES\tEVENTS\n"),
            text(LogFormat::EyeLink, "1408660\t  964.3\t  541.5\t  288.0\t...\n"),
            text(LogFormat::EyeLink, "1408660.5\t   .\t   .\t    0.0\n"),
            text(LogFormat::Smi, "## [iView]\n## Sample Rate:\t60\nTime;Type;Trial;L Pupil Diameter [mm]\n"),
            text(LogFormat::Smi, "Time,Type,Trial,L Dia X [px],L Dia Y [px]\n1,SMP,1,20,20\n"),
            text(LogFormat::Smi, "RecordingTime [ms]\tTrial\tPupil Diameter Left [mm]\tCategory Left\n"),
            (LogFormat::Smi, utf16.encode_utf16().flat_map(u16::to_le_bytes).collect()),
            text(LogFormat::Csv, "t_ns,eye,diameter_mm,confidence,aperture_mm,valid\n"),
            text(LogFormat::Xdf, "XDF:\u{1}\u{14}"),
            text(LogFormat::Tobii, "Recording timestamp\tSensor\tPupil diameter left\tValidity left\n"),
            text(LogFormat::Tobii, "System\tx\n\nTimestamp\tPupilLeft\tValidityLeft\n"),
            text(LogFormat::Gazepoint, "MEDIA_ID,TIME(2020/11/03 12:00:00.000),LPD,LPV,LPMM,LPMMV\n"),
            text(LogFormat::PupilExt, "filename,timestamp_ms,algorithm,diameter_px\n"),
            text(LogFormat::PupilExt, "timestamp_ms;pupilDiameter_px_L_M\n"),
        ]
    }

    fn recognised(beginning: &[u8]) -> Vec<LogFormat> {
        let dir = tempfile::TempDir::new().expect("a folder");
        let path = dir.path().join("log");
        std::fs::write(&path, beginning).expect("writes");
        let input = LogInput::new(&path).expect("opens");
        IMPORTERS.iter().filter(|importer| (importer.recognises)(&input)).map(|importer| importer.format).collect()
    }

    #[test]
    fn each_log_is_recognised_by_its_format_alone() {
        for (format, beginning) in beginnings() {
            assert_eq!(recognised(&beginning), [format], "{}", String::from_utf8_lossy(&beginning));
        }
    }

    #[test]
    fn what_only_looks_like_a_log_is_not_recognised() {
        for beginning in [
            "",
            "\n\n",
            "1,2,3\n",
            "1408660\t964.3\t541.5\t288.0\n",
            "timestamp\tx\ty\tpupil\n1\t2\t3\t4\n",
            "Time;Type;Trial;L POR X [px]\n",
            "timestamp,confidence,diameter\n",
            "START\tSAMPLES\n",
            "Pupil,1,2\n",
            "P,1,2\n",
            "Recording timestamp\tSensor\tGaze point X\n",
            "Timestamp\tPupilLeft\n",
            "TIME,LPD\n",
            "timestamp_ms,diameter\n",
            "t_ns,eye,diameter_cm,confidence,aperture_mm,valid\n",
            "XDF",
        ] {
            assert_eq!(recognised(beginning.as_bytes()), [], "{beginning}");
        }
        assert_eq!(recognised(&[0; 800]), []);
    }

    #[test]
    fn a_gzip_that_ends_in_its_middle_is_told() {
        let dir = tempfile::TempDir::new().expect("a folder");
        let path = dir.path().join("log");
        std::fs::write(&path, b"\x1f\x8b\x08\x00\x00\x00\x00\x00\x00\x03").expect("writes");
        assert!(matches!(Recording::read(&path), Err(ReplayError::Io { .. })));
    }

    #[test]
    fn a_records_table_of_samples_is_refused_with_what_to_play_instead() {
        let dir = tempfile::TempDir::new().expect("a folder");
        let path = dir.path().join("samples.csv");
        std::fs::write(&path, format!("{SAMPLES_HEADER}\n1,2,3,left,3.5,1,,,1,accepted\n")).expect("writes");
        let error = Recording::read(&path).expect_err("is refused").to_string();
        assert!(error.contains("what the gate said of each") && error.contains("play `tracker.holodraw`"), "{error}");
    }

    #[test]
    fn lines_behind_what_a_board_says_first_are_a_log() {
        let mut lines = String::new();
        for sequence in 0..5 {
            let (eye, device_us) = (crate::SampleEye::Left, sequence as i64 * 5000);
            let sample = crate::wire::line::LineSample { sequence, device_us, eye, diameter_mm: 4.0, confidence: 1.0 };
            crate::wire::line::encode_line(&sample, &mut lines);
        }
        let putty = "=~=~=~=~=~=~=~=~=~=~=~= PuTTY log 2026.01.01 12:00:00 =~=~=~=~=~=~=~=~=~=~=~=\r\n";
        for before in [putty, "boot: tracker v1.2\n\nP\n", ",5000,L,4.000,1.00*00\n", "\u{1}\u{2}\n"] {
            assert_eq!(recognised(format!("{before}{lines}").as_bytes()), [LogFormat::Lines], "{before}");
        }
        assert_eq!(recognised(format!("boot\n{}", lines.replace('*', "*0")).as_bytes()), []);
    }
}

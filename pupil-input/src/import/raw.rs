//! holod's own recordings of the bytes of a link: read as a log, or played again byte for byte.

use std::fs::File;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};

use holod_calibration::TimeNs;

use super::fault::{LogFault, ReplayError};
use super::format::LogFormat;
use super::importer::Importer;
use super::input::LogInput;
use super::recording::{LogBuilder, LogSample};
use crate::PupilSample;
use crate::profile::Profile;
use crate::record::{Header, HeaderFault, Kind, MAGIC, RawReader};
use crate::stamp::Stamper;
use crate::wire::WireEvent;

pub(super) const IMPORTER: Importer = Importer { format: LogFormat::Raw, recognises, read };

fn recognises(input: &LogInput<'_>) -> bool {
    input.head.starts_with(&MAGIC)
}

/// The samples, on the host's clock at the time of the recording, by the way that they went when they came.
fn read(input: &LogInput<'_>, log: &mut LogBuilder) -> Result<(), ReplayError> {
    let mut raw = RawReader::new(input.open()?).map_err(|fault| header_error(input.path, fault))?;
    let profile = profile_of(raw.header(), input.path)?;
    log.unit = profile.unit;
    let Header { spec, profile: name, scale_mm_per_unit, .. } = raw.header();
    log.recorded_scale = *scale_mm_per_unit;
    let scale = scale_mm_per_unit.map_or(String::new(), |scale| format!(", scale_mm_per_unit = {scale}"));
    log.note(format!("recorded from `{spec}`, profile `{name}`{scale}"));
    let datagrams = raw.header().datagrams;
    let mut decoder = profile.decoder();
    let mut stamper = Stamper::new();
    let mut lost = 0_u64;
    let mut number = 0;
    while let Some((head, payload)) = raw.next().map_err(|source| input.io(source))? {
        number += 1;
        match head.kind {
            Kind::Connected => {
                if !decoder.rejoin() {
                    decoder = profile.decoder();
                }
                stamper = Stamper::new();
            }
            Kind::Bytes => {
                let mut take = |event| match event {
                    WireEvent::Sample(sample) => {
                        if let Some(sample) = stamper.take(sample, head.t) {
                            log.push(log_sample(&sample), number);
                        }
                    }
                    WireEvent::Rejected(fault) => log.count(LogFault::Wire(fault)),
                    WireEvent::Clock(t_device) => stamper.observe(t_device, head.t),
                    WireEvent::Note | WireEvent::Partial => {}
                };
                decoder.push(payload, &mut take);
                if datagrams {
                    decoder.finish(&mut take);
                }
                stamper.rest(head.t, |sample| log.push(log_sample(&sample), number));
            }
            Kind::Lost => lost = lost.saturating_add(lost_chunks(payload)),
            Kind::Disconnected | Kind::End => {}
        }
    }
    raw.flaws().chain(lost_in_words(lost)).for_each(|flaw| log.warn(flaw));
    Ok(())
}

const fn log_sample(sample: &PupilSample) -> LogSample {
    LogSample {
        t: sample.t_sample,
        eye: sample.eye,
        diameter: sample.diameter_mm,
        confidence: sample.confidence,
        aperture_mm: sample.aperture_mm,
        valid: sample.valid,
    }
}

/// How many pieces a record of [`Kind::Lost`] counts.
fn lost_chunks(payload: &[u8]) -> u64 {
    payload.first_chunk().map_or(0, |count| u64::from_le_bytes(*count))
}

fn lost_in_words(lost: u64) -> Option<String> {
    (lost > 0).then(|| format!("{lost} pieces of the link's bytes are missing: the disk was too slow for them"))
}

fn profile_of(header: &Header, path: &Path) -> Result<Profile, ReplayError> {
    let profile = match &header.profile_toml {
        Some(text) => Profile::from_toml(text, &header.profile),
        None => Profile::find(&header.profile),
    };
    let described = match &header.hid_descriptor {
        None => profile.map_err(|error| error.to_string()),
        Some(descriptor) => profile
            .map_err(|error| error.to_string())
            .and_then(|profile| profile.described(descriptor).map_err(|error| error.to_string())),
    };
    described.map_err(|error| ReplayError::Content {
        path: path.into(),
        at: String::new(),
        found: format!("a recording by a profile that cannot be had: {error}"),
        expected: "a profile that this holod knows; play it with the holod that recorded it".into(),
    })
}

fn header_error(path: &Path, fault: HeaderFault) -> ReplayError {
    match fault {
        HeaderFault::Io(source) => ReplayError::Io { path: path.into(), source },
        HeaderFault::Bad(found) => ReplayError::Content {
            path: path.into(),
            at: String::new(),
            found,
            expected: "a recording of version 1 with a whole header; a run that broke off at once has none".into(),
        },
    }
}

/// A recording that is to be played again.
pub(crate) struct RawLog {
    path: PathBuf,
    profile: Profile,
    datagrams: bool,
    /// Time of its first and of its last record.
    span: (TimeNs, TimeNs),
    recorded_scale: Option<f64>,
    /// What is wrong with it, a sentence each.
    flaws: Vec<String>,
}

impl RawLog {
    /// Whether it is a file, and such a recording.
    pub(crate) fn recognises(path: &Path) -> bool {
        let mut begin = [0; MAGIC.len()];
        // To open a pipe is to wait for whoever writes into it.
        path.is_file() && File::open(path).and_then(|mut file| file.read_exact(&mut begin)).is_ok() && begin == MAGIC
    }

    /// Reads all of it once, to find its end and what is missing.
    pub(crate) fn open(path: &Path) -> Result<Self, ReplayError> {
        let io = |source| ReplayError::Io { path: path.into(), source };
        let mut raw = reader(path)?;
        let profile = profile_of(raw.header(), path)?;
        let (datagrams, recorded_scale) = (raw.header().datagrams, raw.header().scale_mm_per_unit);
        let (mut span, mut lost, mut bytes) = (None, 0_u64, 0);
        while let Some((head, payload)) = raw.next().map_err(io)? {
            let (first, last) = span.unwrap_or((head.t, head.t));
            span = Some((first, last.max(head.t)));
            match head.kind {
                Kind::Bytes => bytes += payload.len(),
                Kind::Lost => lost = lost.saturating_add(lost_chunks(payload)),
                Kind::Connected | Kind::Disconnected | Kind::End => {}
            }
        }
        let flaws: Vec<_> = raw.flaws().chain(lost_in_words(lost)).collect();
        let Some(span) = span.filter(|_| bytes > 0) else {
            let why = std::iter::once("no bytes came".to_owned()).chain(flaws).collect::<Vec<_>>().join("; ");
            return Err(ReplayError::Empty { path: path.into(), why });
        };
        Ok(Self { path: path.into(), profile, datagrams, span, recorded_scale, flaws })
    }

    /// Reads the recording from its beginning.
    pub(crate) fn records(&self) -> Result<RawReader<BufReader<File>>, ReplayError> {
        reader(&self.path)
    }

    pub(crate) const fn profile(&self) -> &Profile {
        &self.profile
    }

    pub(crate) const fn datagrams(&self) -> bool {
        self.datagrams
    }

    /// Time of its first record.
    pub(crate) const fn begins(&self) -> TimeNs {
        self.span.0
    }

    /// By how much a repetition is later.
    pub(crate) fn period(&self) -> TimeNs {
        const PAUSE: TimeNs = TimeNs(1_000_000);
        self.span.1 - self.span.0 + PAUSE
    }

    /// What is missing in it.
    pub(crate) fn warnings(&self) -> Vec<String> {
        self.flaws.iter().map(|flaw| format!("{}: {flaw}", self.path.display())).collect()
    }

    /// Millimetres for one unit of its figures, where the run that recorded it had a scale.
    pub(crate) const fn recorded_scale(&self) -> Option<f64> {
        self.recorded_scale
    }
}

fn reader(path: &Path) -> Result<RawReader<BufReader<File>>, ReplayError> {
    let file = File::open(path).map_err(|source| ReplayError::Io { path: path.into(), source })?;
    RawReader::new(BufReader::with_capacity(1 << 18, file)).map_err(|fault| header_error(path, fault))
}

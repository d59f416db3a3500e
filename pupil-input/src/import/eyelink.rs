//! SR Research EyeLink: `.asc` as `edf2asc` writes it.
//!
//! A line that begins with a number is a sample: time in milliseconds, then x, y and pupil of the left eye, of the
//! right eye or of both in this order, then whatever else was asked for. All other lines begin with a word; of these
//! `START`, `END`, `PUPIL`, `SAMPLES`, `SBLINK` and `EBLINK` matter here. A lost eye has `.` for its gaze and 0.0 for
//! its pupil.

use std::f64::consts::PI;

use holod_calibration::TimeNs;

use super::fault::{LogFault, ReplayError};
use super::format::LogFormat;
use super::importer::Importer;
use super::input::LogInput;
use super::recording::{LogBuilder, LogSample};
use super::rows::Blink;
use super::text::{number, positive_size, time};
use crate::SampleEye;
use crate::size_unit::SizeUnit;

pub(super) const IMPORTER: Importer = Importer { format: LogFormat::EyeLink, recognises, read };

fn words(line: &[u8]) -> impl Iterator<Item = &[u8]> {
    line.split(|byte| matches!(byte, b' ' | b'\t')).filter(|word| !word.is_empty())
}

fn recognises(input: &LogInput<'_>) -> bool {
    let has = |line: &[u8], any: &[&[u8]]| words(line).any(|word| any.contains(&word));
    input.head_lines().take(1000).any(|line| match words(line).next() {
        Some(b"**") => has(line, &[b"EDF_FILE", b"EYELINK"]),
        Some(b"START") => has(line, &[b"LEFT", b"RIGHT"]) && has(line, &[b"SAMPLES", b"EVENTS"]),
        Some(b"SAMPLES") => has(line, &[b"GAZE", b"HREF", b"PUPIL"]) && has(line, &[b"LEFT", b"RIGHT"]),
        _ => false,
    }) || input.head_lines().next().is_some_and(is_bare_sample)
}

/// A sample of an export that has nothing but samples: padded with spaces between tabs, or ending in flags.
fn is_bare_sample(line: &[u8]) -> bool {
    let cells: Vec<_> = line.split(|byte| *byte == b'\t').collect();
    let is_figure = |cell: &&[u8]| cell.trim_ascii() == b"." || number(cell.trim_ascii()).is_some();
    let whole_time = cells[0].first().is_some_and(u8::is_ascii_digit) && time(cells[0], 3).is_some();
    let padded = cells.iter().skip(1).take(3).any(|cell| cell.starts_with(b" "));
    whole_time
        && cells.len() >= 4
        && cells[1..4].iter().all(is_figure)
        && (padded || cells.last().is_some_and(|flags| flag_count(flags).is_some()))
}

/// How many flags the last column of a sample has, if it is flags: 3 of one eye, 5 of two, 13 and 17 with a head
/// target.
fn flag_count(word: &[u8]) -> Option<usize> {
    let flags = matches!(word.len(), 3 | 5 | 13 | 17)
        && word.iter().all(|byte| *byte == b'.' || byte.is_ascii_uppercase())
        && word.contains(&b'.');
    flags.then_some(word.len())
}

/// Which eyes the samples hold, in this order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Eyes {
    One(SampleEye),
    Two,
}

impl Eyes {
    /// As a header line names them.
    fn named_by(line: &[u8]) -> Option<Self> {
        let has = |name: &[u8]| words(line).any(|word| word == name);
        match (has(b"LEFT"), has(b"RIGHT")) {
            (true, true) => Some(Self::Two),
            (true, false) => Some(Self::One(SampleEye::Left)),
            (false, true) => Some(Self::One(SampleEye::Right)),
            (false, false) => None,
        }
    }

    /// As the figures of a sample suggest, where no header names them, and how sure that is: flags tell, else the number
    /// of figures. One eye has 3, velocity and resolution 2 more each; two eyes have 6, and 4 and 2 more; either may
    /// have one of the input port besides.
    fn guessed_from(line: &[u8]) -> (Self, Guess) {
        let figures = words(line).skip(1).filter(|word| *word == b"." || number(word).is_some()).count();
        let (two, guess) = match words(line).last().and_then(flag_count) {
            Some(flags) => (matches!(flags, 5 | 17), Guess::Told),
            None => match figures {
                7 => (false, Guess::OneOfSeven),
                8 => (true, Guess::TwoOfEight),
                _ => (figures >= 6, Guess::Told),
            },
        };
        (if two { Self::Two } else { Self::One(SampleEye::Both) }, guess)
    }
}

/// How sure the eyes are that no header names.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Guess {
    Told,
    /// One eye with velocity and resolution; or two with the port.
    OneOfSeven,
    /// Two eyes with resolution; or one with all.
    TwoOfEight,
}

/// What a pupil's figure is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Measure {
    Area,
    Diameter,
}

struct Reader<'b> {
    log: &'b mut LogBuilder,
    eyes: Option<Eyes>,
    measure: Option<Measure>,
    rate_hz: Option<f64>,
    /// Of the sample before, in the same block.
    previous: Option<TimeNs>,
    shut_since: [Option<TimeNs>; 3],
    blocks: u64,
    measures_differ: bool,
    rates_differ: bool,
    /// No header named the eyes.
    guessed: Option<Guess>,
    samples: u64,
}

fn read(input: &LogInput<'_>, log: &mut LogBuilder) -> Result<(), ReplayError> {
    let mut lines = input.lines()?;
    log.unit = SizeUnit::Arbitrary;
    let mut reader = Reader {
        log,
        eyes: None,
        measure: None,
        rate_hz: None,
        previous: None,
        shut_since: [None; 3],
        blocks: 0,
        measures_differ: false,
        rates_differ: false,
        guessed: None,
        samples: 0,
    };
    while let Some(line) = lines.next(reader.log) {
        match line.bytes.first() {
            Some(b'0'..=b'9') => reader.sample(line.bytes, line.number),
            Some(b'A'..=b'Z') => reader.word(line.bytes, line.number),
            // Comments, the figures of a calibration, blank lines.
            _ => {}
        }
    }
    if reader.samples == 0 && reader.blocks > 0 {
        let expected = "samples, too: it was exported with events only; run edf2asc without -e";
        return Err(input.content("the events of a recording and no line that is a sample", expected));
    }
    reader.end_blinks(reader.previous);
    reader.notes();
    Ok(())
}

impl Reader<'_> {
    fn sample(&mut self, line: &[u8], number: u64) {
        self.samples += 1;
        let eyes = match self.eyes {
            Some(eyes) => eyes,
            None => {
                let (eyes, guess) = Eyes::guessed_from(line);
                self.guessed = Some(guess);
                *self.eyes.insert(eyes)
            }
        };
        let mut words = words(line);
        let Some(written) = words.next().and_then(|word| time(word, 3)) else {
            return self.log.count(LogFault::BadNumber);
        };
        // Before version 4 half milliseconds were written as whole ones, each twice.
        let half = self.previous == Some(written) && self.rate_hz.is_some_and(|rate_hz| rate_hz > 1500.0);
        self.previous = Some(written);
        let t = TimeNs(written.0.saturating_add(if half { 500_000 } else { 0 }));
        let eyes = match eyes {
            Eyes::One(eye) => [Some(eye), None],
            Eyes::Two => [Some(SampleEye::Left), Some(SampleEye::Right)],
        };
        for eye in eyes.into_iter().flatten() {
            let size = words.nth(2).map_or(Err(LogFault::Malformed), |word| self.diameter(word));
            self.log.push_sized(size, LogSample::lost(t, eye), number);
        }
    }

    /// 0 where the eye is lost.
    fn diameter(&self, word: &[u8]) -> Result<f64, LogFault> {
        let figure = positive_size(word)?;
        Ok(match self.measure {
            Some(Measure::Diameter) => figure,
            // The tracker's default.
            None | Some(Measure::Area) => 2.0 * (figure / PI).sqrt(),
        })
    }

    fn word(&mut self, line: &[u8], line_number: u64) {
        let mut words = words(line);
        match words.next() {
            Some(b"START") => {
                self.eyes = Eyes::named_by(line).or(self.eyes);
                self.blocks += 1;
                self.end_blinks(self.previous);
                self.previous = None;
                if let Some(t) = words.next().and_then(|word| time(word, 3)) {
                    self.log.recording_begins(t, line_number);
                }
            }
            Some(b"END") => {
                let t = words.next().and_then(|word| time(word, 3)).or(self.previous);
                self.end_blinks(t);
            }
            Some(b"PUPIL") => {
                let measure = match words.next() {
                    Some(b"AREA") => Measure::Area,
                    Some(b"DIAMETER") => Measure::Diameter,
                    _ => return,
                };
                self.measures_differ |= self.measure.replace(measure).is_some_and(|before| before != measure);
            }
            Some(b"SAMPLES") => {
                self.eyes = Eyes::named_by(line).or(self.eyes);
                let rate_hz = words.skip_while(|word| *word != b"RATE").nth(1).and_then(number);
                self.rate(rate_hz);
            }
            Some(b"MSG") => self.message(line),
            Some(b"SBLINK") => {
                if let Some((eye, t)) = words.next().and_then(eye).zip(words.next().and_then(|word| time(word, 3))) {
                    self.shut_since[eye.index()] = Some(t);
                }
            }
            Some(b"EBLINK") => {
                let eye = words.next().and_then(eye);
                let mut next = || words.next().and_then(|word| time(word, 3));
                let (begins, ends) = (next(), next());
                if let (Some(eye), Some(begins), Some(ends)) = (eye, begins, ends)
                    && begins <= ends
                {
                    self.shut_since[eye.index()] = None;
                    self.log.blink(Blink { eye, begins, ends });
                }
            }
            _ => {}
        }
    }

    /// `MSG <t> !MODE RECORD CR 1000 2 1 LR` says rate and eyes again, for exports that leave the header out.
    fn message(&mut self, line: &[u8]) {
        let mut words = words(line).skip(2);
        if words.next() != Some(b"!MODE") || words.next() != Some(b"RECORD") {
            return;
        }
        let rate_hz = words.nth(1).and_then(number);
        self.rate(rate_hz);
        if self.eyes.is_none() {
            self.eyes = match words.nth(2) {
                Some(b"L") => Some(Eyes::One(SampleEye::Left)),
                Some(b"R") => Some(Eyes::One(SampleEye::Right)),
                Some(b"LR") => Some(Eyes::Two),
                _ => None,
            };
        }
    }

    fn rate(&mut self, rate_hz: Option<f64>) {
        let Some(rate_hz) = rate_hz.filter(|rate_hz| (1.0..=1e5).contains(rate_hz)) else { return };
        self.rates_differ |= self.rate_hz.replace(rate_hz).is_some_and(|before| before != rate_hz);
        self.log.stated_rate_hz.get_or_insert(rate_hz);
    }

    /// Ends blinks that began and are told no end of, because the recording stopped.
    fn end_blinks(&mut self, t: Option<TimeNs>) {
        for eye in SampleEye::ALL {
            let begins = self.shut_since[eye.index()].take();
            if let Some((begins, ends)) = begins.zip(t).filter(|(begins, ends)| begins <= ends) {
                self.log.blink(Blink { eye, begins, ends });
            }
        }
    }

    fn notes(&mut self) {
        let what = match self.measure {
            Some(Measure::Diameter) => "as the tracker gives them",
            Some(Measure::Area) => "those of discs of the given areas, 2·√(A/π)",
            None => "those of discs of the given figures, taken to be areas as by default, 2·√(A/π): no header says",
        };
        self.log.note(format!(
            "its own diameters are in the tracker's arbitrary units, {what}; to have millimetres, record a printed disc of \
             known diameter at the eye's place and give the rig scale_mm_per_unit = its millimetres / the figure shown for it"
        ));
        match self.guessed {
            None => {}
            Some(Guess::Told) => self.log.note("no header names the eyes: they are told by the samples' columns"),
            Some(Guess::OneOfSeven) => self.log.warn(
                "no header names the eyes, and the samples have 7 figures: they were read as one eye with velocity and \
                 resolution, not as two eyes with the input port; where it is two, export the log again with its header \
                 or its flags",
            ),
            Some(Guess::TwoOfEight) => self.log.warn(
                "no header names the eyes, and the samples have 8 figures: they were read as two eyes with resolution, \
                 not as one eye with velocity, resolution and the input port; where it is one, export the log again \
                 with its header or its flags",
            ),
        }
        if self.blocks > 1 {
            self.log.note(format!("{} blocks of recording, with gaps between them", self.blocks));
        }
        if self.measures_differ {
            self.log.warn("some blocks give areas and some diameters: their units are not the same");
        }
        if self.rates_differ {
            self.log.warn("the blocks differ in rate: the stated one is the first's");
        }
    }
}

fn eye(word: &[u8]) -> Option<SampleEye> {
    match word {
        b"L" => Some(SampleEye::Left),
        b"R" => Some(SampleEye::Right),
        _ => None,
    }
}

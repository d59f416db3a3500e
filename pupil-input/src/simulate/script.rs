//! The text that tells a scenario.

use std::path::{Path, PathBuf};

use holod_calibration::TimeNs;

use crate::SampleEye;

use super::MOCK_SEED;

#[doc = include_str!("../../doc/scenarios.md")]
#[derive(Clone, Debug, PartialEq)]
pub struct Script {
    pub(super) rate_hz: f64,
    pub(super) eyes: Vec<SampleEye>,
    pub(super) free_running: bool,
    pub(super) apart_mm: f64,
    pub(super) starts_mm: Option<f64>,
    pub(super) hippus_mm: f64,
    pub(super) noise_mm: f64,
    pub(super) grain_mm: f64,
    /// The share of samples that do not come, 0 to 1.
    pub(super) missing: f64,
    pub(super) confidence_told: bool,
    pub(super) aperture_mm: Option<f64>,
    pub(super) zeros_in_blinks: bool,
    pub(super) delay_s: f64,
    pub(super) jitter_s: f64,
    pub(super) batch_s: f64,
    pub(super) ahead_s: f64,
    pub(super) drift: f64,
    pub(super) seed: u64,
    pub(super) ends_s: f64,
    pub(super) events: Vec<Event>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Event {
    at_s: f64,
    every_s: Option<f64>,
    pub(super) what: What,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum What {
    /// Luminance of what the viewer sees from then on, cd/m².
    Light(f64),
    /// The light from then on is that at which the pupil settles at this diameter, millimetres.
    Pupil(f64),
    Blink {
        lasts_s: f64,
        half: bool,
    },
    Squint {
        aperture_mm: f64,
        lasts_s: f64,
    },
    Lost {
        lasts_s: f64,
    },
    Zeros {
        lasts_s: f64,
    },
    Unsure {
        confidence: f64,
        lasts_s: f64,
    },
    Reads {
        diameter_mm: f64,
        lasts_s: f64,
    },
    Jump {
        by_mm: f64,
        lasts_s: f64,
    },
    /// Steps of the clock by this many seconds each.
    Steps(f64),
}

impl Event {
    /// Time since its latest occurrence, if it has occurred by `t_s`.
    pub(super) fn since_s(&self, t_s: f64) -> Option<f64> {
        let since_s = t_s - self.at_s;
        (since_s >= 0.0).then(|| self.every_s.map_or(since_s, |every_s| since_s % every_s))
    }

    /// How often it has occurred by `t_s`.
    pub(super) fn times(&self, t_s: f64) -> f64 {
        let since_s = t_s - self.at_s;
        if since_s < 0.0 { 0.0 } else { 1.0 + self.every_s.map_or(0.0, |every_s| (since_s / every_s).floor()) }
    }
}

/// What is wrong with a scenario's text.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "the messages say what the fields are")]
pub enum ScriptError {
    /// The file cannot be read.
    #[error("scenario {path}: {source}; expected a readable text file")]
    Io { path: PathBuf, source: std::io::Error },
    /// A line cannot be understood.
    #[error("scenario {name}, line {line}: found {found}, expected {expected}")]
    Line {
        /// The scenario's name or file.
        name: String,
        /// The line, from 1.
        line: usize,
        /// The word that is wrong.
        found: String,
        /// What should stand there.
        expected: String,
    },
}

const SETTINGS: &str = "rate, eyes, free-running, apart, starts, hippus, noise, grain, missing, confidence, aperture, \
                        blinks, delay, jitter, batch, ahead, drift, seed, ends";
const EVENTS: &str = "light, pupil, blink, squint, lost, zeros, unsure, reads, jump or steps";
/// A larger file is no scenario.
const GREATEST_BYTES: u64 = 1 << 20;

impl Default for Script {
    fn default() -> Self {
        Self {
            rate_hz: 200.0,
            eyes: vec![SampleEye::Left, SampleEye::Right],
            free_running: false,
            apart_mm: 0.2,
            starts_mm: None,
            hippus_mm: 0.1,
            noise_mm: 0.05,
            grain_mm: 0.0,
            missing: 0.0,
            confidence_told: true,
            aperture_mm: None,
            zeros_in_blinks: false,
            delay_s: 0.0,
            jitter_s: 0.0,
            batch_s: 0.0,
            ahead_s: 0.0,
            drift: 0.0,
            seed: MOCK_SEED,
            ends_s: f64::INFINITY,
            events: Vec::new(),
        }
    }
}

impl Script {
    /// Reads a scenario's text; `name` is for errors.
    ///
    /// # Errors
    /// A line is no setting and no event; the error names the line, the word, and what was expected.
    pub fn parse(name: &str, text: &str) -> Result<Self, ScriptError> {
        let mut script = Self::default();
        let mut settings: Vec<(&str, usize)> = Vec::new();
        let text = text.strip_prefix('\u{feff}').unwrap_or(text);
        for (number, line) in (1..).zip(text.lines()) {
            let line = line.split('#').next().unwrap_or_default();
            let first = line.split_whitespace().next().unwrap_or_default();
            let again = settings.iter().find(|(known, _)| *known == first);
            let taken = match again {
                Some((_, before)) => {
                    let expected = format!("each setting once: line {before} has it, too");
                    Err(Wrong { found: Some(first.into()), expected })
                }
                None => script.take(&mut Words(line.split_whitespace())),
            };
            if SETTINGS.split(", ").any(|setting| setting == first) {
                settings.push((first, number));
            }
            taken.map_err(|Wrong { found, expected }| ScriptError::Line {
                name: name.into(),
                line: number,
                found: found.map_or("the end of the line".into(), |word| format!("`{}`", word.escape_debug())),
                expected,
            })?;
        }
        Ok(script)
    }

    /// Reads a scenario's file.
    ///
    /// # Errors
    /// It cannot be read, or as for [`Self::parse`].
    pub fn read(path: &Path) -> Result<Self, ScriptError> {
        let wrong = |source| ScriptError::Io { path: path.into(), source };
        let length = std::fs::metadata(path).map_err(wrong)?.len();
        if length > GREATEST_BYTES {
            return Err(wrong(std::io::Error::other(format!("{length} bytes are too many for a scenario"))));
        }
        Self::parse(&path.display().to_string(), &std::fs::read_to_string(path).map_err(wrong)?)
    }

    /// Whether it says anything of the tracker's clock or link.
    pub(crate) fn has_link(&self) -> bool {
        let times = [self.delay_s, self.jitter_s, self.batch_s, self.ahead_s, self.drift];
        times != [0.0; 5] || self.events.iter().any(|event| matches!(event.what, What::Steps(_)))
    }

    /// Its end, where it has one.
    pub(crate) fn ends(&self) -> Option<TimeNs> {
        self.ends_s.is_finite().then(|| TimeNs::from_seconds(self.ends_s))
    }

    fn take(&mut self, words: &mut Words<'_>) -> Result<(), Wrong> {
        let Some(first) = words.0.next() else { return Ok(()) };
        match first {
            "rate" => self.rate_hz = words.number("", 1.0..=4000.0, "samples a second from 1 to 4000, such as 200")?,
            "eyes" => self.eyes = words.eyes()?,
            "free-running" => self.free_running = true,
            "apart" => self.apart_mm = words.number("mm", -2.0..=2.0, "a difference from -2mm to 2mm")?,
            "starts" => self.starts_mm = Some(words.diameter()?),
            "hippus" => self.hippus_mm = words.number("mm", 0.0..=2.0, "an amplitude such as 0.1mm")?,
            "noise" => self.noise_mm = words.number("mm", 0.0..=2.0, "a standard deviation such as 0.05mm")?,
            "grain" => self.grain_mm = words.number("mm", 0.0..=2.0, "a step such as 0.02mm")?,
            "missing" => self.missing = words.number("%", 0.0..=99.0, "a share from 0% to 99%")? / 100.0,
            "confidence" => self.confidence_told = words.choice([("told", true), ("none", false)])?,
            "aperture" => self.aperture_mm = Some(words.number("mm", 0.1..=20.0, "a distance such as 8mm")?),
            "blinks" => self.zeros_in_blinks = words.choice([("zeros", true), ("scatter", false)])?,
            "delay" => self.delay_s = words.span()?,
            "jitter" => self.jitter_s = words.span()?,
            "batch" => self.batch_s = words.span()?,
            "ahead" => self.ahead_s = words.seconds(-1e9, "a time such as 12s")?,
            "drift" => self.drift = words.number("ppm", -5e5..=5e5, "parts per million such as 80ppm")? * 1e-6,
            "seed" => self.seed = words.number("", 0.0..=1e15, "a whole number")? as u64,
            "ends" => self.ends_s = words.span()?,
            _ => {
                let expected = format!("a setting ({SETTINGS}) or a time such as 2.5s");
                let at_s = seconds(first).filter(|at_s| (0.0..=1e9).contains(at_s));
                let at_s = at_s.ok_or(Wrong { found: Some(first.into()), expected })?;
                self.events.push(words.event(at_s)?);
            }
        }
        words.end()
    }
}

struct Wrong {
    found: Option<String>,
    expected: String,
}

/// What is left of a line.
struct Words<'a>(std::str::SplitWhitespace<'a>);

impl Words<'_> {
    fn end(&mut self) -> Result<(), Wrong> {
        self.0.next().map_or(Ok(()), |word| Err(Wrong { found: Some(word.into()), expected: "the end".into() }))
    }

    fn read<T>(&mut self, read: impl Fn(&str) -> Option<T>, expected: &str) -> Result<T, Wrong> {
        let word = self.0.next();
        word.and_then(read).ok_or_else(|| Wrong { found: word.map(Into::into), expected: expected.into() })
    }

    fn number(&mut self, unit: &str, range: std::ops::RangeInclusive<f64>, expected: &str) -> Result<f64, Wrong> {
        self.read(|word| word.strip_suffix(unit)?.parse().ok().filter(|number| range.contains(number)), expected)
    }

    fn seconds(&mut self, least_s: f64, expected: &str) -> Result<f64, Wrong> {
        self.read(|word| seconds(word).filter(|s| (least_s..=1e9).contains(s)), expected)
    }

    fn span(&mut self) -> Result<f64, Wrong> {
        self.seconds(0.0, "a length of time such as 200ms or 1.5s")
    }

    fn diameter(&mut self) -> Result<f64, Wrong> {
        self.number("mm", 0.5..=12.0, "a pupil from 0.5mm to 12mm, such as 4.2mm")
    }

    fn choice(&mut self, choices: [(&str, bool); 2]) -> Result<bool, Wrong> {
        let expected = format!("{} or {}", choices[0].0, choices[1].0);
        self.read(|word| choices.iter().find(|choice| choice.0 == word).map(|choice| choice.1), &expected)
    }

    fn eyes(&mut self) -> Result<Vec<SampleEye>, Wrong> {
        let eye = |word: &str| SampleEye::ALL.into_iter().find(|eye| word.chars().eq([eye.letter()]));
        let mut eyes = vec![self.read(eye, "L, R or B")?];
        if let Some(second) = self.0.next() {
            let other = eye(second).filter(|other| *other != eyes[0] && *other != SampleEye::Both);
            let other = other.filter(|_| eyes[0] != SampleEye::Both);
            eyes.push(other.ok_or(Wrong { found: Some(second.into()), expected: "L, R, L R or B".into() })?);
            eyes.sort_by_key(|eye| eye.index());
        }
        Ok(eyes)
    }

    fn event(&mut self, at_s: f64) -> Result<Event, Wrong> {
        let mut word = self.0.next();
        let mut every_s = None;
        if word == Some("every") {
            every_s = Some(self.seconds(1e-3, "a period such as 3.5s")?);
            word = self.0.next();
        }
        let what = match word {
            Some("light") => What::Light(self.number("cd", 1e-6..=1e6, "a luminance in cd/m² such as 100cd")?),
            Some("pupil") => What::Pupil(self.diameter()?),
            Some("blink") => {
                let lasts_s = self.span()?;
                let half = match self.0.next() {
                    None => false,
                    Some("half") => true,
                    Some(word) => return Err(Wrong { found: Some(word.into()), expected: "half or the end".into() }),
                };
                What::Blink { lasts_s, half }
            }
            Some("squint") => {
                let aperture_mm = self.number("mm", 0.0..=20.0, "a distance of the lids such as 3mm")?;
                What::Squint { aperture_mm, lasts_s: self.span()? }
            }
            Some("lost") => What::Lost { lasts_s: self.span()? },
            Some("zeros") => What::Zeros { lasts_s: self.span()? },
            Some("unsure") => {
                let confidence = self.number("", 0.0..=1.0, "a confidence from 0 to 1")?;
                What::Unsure { confidence, lasts_s: self.span()? }
            }
            Some("reads") => {
                let diameter_mm = self.number("mm", -100.0..=100.0, "what is measured, such as 16.7mm")?;
                What::Reads { diameter_mm, lasts_s: self.span()? }
            }
            Some("jump") => {
                let by_mm = self.number("mm", -20.0..=20.0, "a difference such as 0.5mm")?;
                What::Jump { by_mm, lasts_s: self.span()? }
            }
            Some("steps") => What::Steps(self.seconds(-1e9, "a difference of time such as -400ms")?),
            other => return Err(Wrong { found: other.map(Into::into), expected: format!("every SPAN, or {EVENTS}") }),
        };
        Ok(Event { at_s, every_s, what })
    }
}

/// `200ms` or `1.5s` in seconds.
fn seconds(word: &str) -> Option<f64> {
    let (number, unit_s) = match word.strip_suffix("ms") {
        Some(number) => (number, 1e-3),
        None => (word.strip_suffix('s')?, 1.0),
    };
    number.parse().ok().filter(|number: &f64| number.is_finite()).map(|number| number * unit_s)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(text: &str) -> Script {
        Script::parse("test", text).expect(text)
    }

    #[test]
    fn lines_are_settings_events_and_comments() {
        let script = parsed(
            "# made up\n\nrate 123\neyes R L\nnoise 0.02mm # px\nmissing 2%\ndrift -80ppm\nahead -3s\n\
             2.5s every 10s blink 200ms half\n100ms light 30cd\n",
        );
        let expected = Script {
            rate_hz: 123.0,
            noise_mm: 0.02,
            missing: 0.02,
            drift: -80.0 * 1e-6,
            ahead_s: -3.0,
            events: vec![
                Event { at_s: 2.5, every_s: Some(10.0), what: What::Blink { lasts_s: 0.2, half: true } },
                Event { at_s: 0.1, every_s: None, what: What::Light(30.0) },
            ],
            ..Script::default()
        };
        assert_eq!(script, expected);
        assert_eq!(parsed("eyes B").eyes, [SampleEye::Both]);
        assert_eq!(parsed(""), Script::default());
        assert_eq!(parsed("\u{feff}rate 60\n\n\n1s lost 1s\n1s lost 1s"), parsed("rate 60\n1s lost 1s\n1s lost 1s"));
    }

    #[test]
    fn every_word_of_the_documentation_is_known() {
        let rows = include_str!("../../doc/scenarios.md").lines().filter_map(|line| line.strip_prefix("| `"));
        let examples: Vec<_> = rows.filter_map(|row| row.split('`').next()).collect();
        assert_eq!(examples.len(), 29, "{examples:?}");
        for example in &examples {
            parsed(example);
        }
        let known = |word: &str| examples.iter().any(|example| example.split(' ').any(|other| other == word));
        for word in SETTINGS.split(", ").chain(EVENTS.split(", ").flat_map(|words| words.split(" or "))) {
            assert!(known(word), "{word} is not documented");
        }
    }

    #[test]
    fn each_mistake_is_told_with_its_line_and_word() {
        let cases = [
            ("noise 0.1", "found `0.1`, expected a standard deviation such as 0.05mm"),
            ("noise", "found the end of the line, expected a standard deviation"),
            ("seed -1", "found `-1`, expected a whole number"),
            ("seed NaN", "found `NaN`"),
            ("seed 3 4", "found `4`, expected the end"),
            ("eyes L B", "found `B`, expected L, R, L R or B"),
            ("eyes L L", "found `L`"),
            ("eyes left", "found `left`, expected L, R or B"),
            ("confidence some", "found `some`, expected told or none"),
            ("colour red", "found `colour`, expected a setting (rate, eyes"),
            ("-1s lost 1s", "found `-1s`"),
            ("2s", "found the end of the line, expected every SPAN, or light, pupil"),
            ("2s light 10", "found `10`, expected a luminance in cd/m² such as 100cd"),
            ("2s every 0s lost 1s", "found `0s`, expected a period"),
            ("2s blink 0.2", "found `0.2`, expected a length of time such as 200ms"),
            ("2s blink 0.2s whole", "found `whole`, expected half or the end"),
            ("2s unsure 3 1s", "found `3`, expected a confidence from 0 to 1"),
            ("2s explode", "found `explode`, expected every SPAN, or light"),
            ("rate 100", "found `rate`, expected each setting once: line 1 has it, too"),
        ];
        for (line, told) in cases {
            let error = Script::parse("a.txt", &format!("rate 60\n{line}\n")).expect_err(line).to_string();
            assert!(error.starts_with("scenario a.txt, line 2: "), "{error}");
            assert!(error.contains(told), "{line}: {error}");
        }
        for (line, told) in [
            ("rate 0", "found `0`, expected samples a second from 1 to 4000"),
            ("rate NaN", "found `NaN`"),
            ("rate 200 Hz", "found `Hz`, expected the end"),
        ] {
            let error = Script::parse("a.txt", line).expect_err(line).to_string();
            assert!(error.starts_with("scenario a.txt, line 1: ") && error.contains(told), "{line}: {error}");
        }
    }

    #[test]
    fn a_file_that_cannot_be_read_is_told() {
        let error = Script::read(Path::new("/nonexistent.txt")).expect_err("is not there").to_string();
        assert!(error.contains("/nonexistent.txt") && error.contains("readable"), "{error}");
    }

    proptest::proptest! {
        #[test]
        fn any_text_is_read_or_refused(words in proptest::collection::vec("[0-9a-z.%-]{1,6}|2s|every|blink|200ms|\n", 0..40)) {
            let _ = Script::parse("any", &words.join(" "));
        }
    }
}

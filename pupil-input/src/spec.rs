//! Where samples come from, as named on the command line or in the rig file.

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

use crate::profile::DEFAULT_PROFILE;
use crate::source::mock::Scenario;

/// A parsed tracker spec.
#[derive(Clone, Debug, PartialEq)]
pub enum TrackerSpec {
    /// A path by itself: a log if it is a regular file, else a serial port.
    Path(PathBuf),
    /// `serial:PATH[,profile=NAME][,baud=N]`
    Serial {
        /// The port.
        path: PathBuf,
        /// The tracker's profile.
        profile: String,
        /// Bits a second; the profile's own where the spec names none.
        baud: Option<u32>,
    },
    /// `replay:FILE[,speed=X][,loop]`
    Replay {
        /// The log.
        path: PathBuf,
        /// How fast it is played.
        speed: ReplaySpeed,
        /// Begin again at its end.
        repeat: bool,
    },
    /// `mock[:SCENARIO]`
    Mock(Scenario),
}

/// How fast a log is played.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ReplaySpeed {
    /// This many recorded seconds in a second; 1 is true speed.
    Times(f64),
    /// As fast as it can be read.
    Fastest,
}

/// What is wrong with a tracker spec.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("tracker `{spec}`: {problem}")]
pub struct SpecError {
    spec: String,
    problem: String,
}

/// Bits a second where neither spec nor profile names any.
pub(crate) const DEFAULT_BAUD: u32 = 115_200;
const FORMS: &str = "`/dev/ttyUSB0`, `serial:PATH[,profile=NAME][,baud=N]`, `replay:FILE[,speed=X|max][,loop]`, a log \
                     file, or `mock[:SCENARIO]`";

impl FromStr for TrackerSpec {
    type Err = SpecError;

    fn from_str(spec: &str) -> Result<Self, SpecError> {
        parse(spec).map_err(|problem| SpecError { spec: spec.into(), problem })
    }
}

fn parse(spec: &str) -> Result<TrackerSpec, String> {
    let (scheme, rest) = match spec.split_once(':') {
        Some((scheme, rest)) => (scheme, Some(rest)),
        None => (spec, None),
    };
    match (scheme, rest) {
        ("", None) => Err(format!("is empty; expected {FORMS}")),
        ("mock", None) => Ok(TrackerSpec::Mock(Scenario::default())),
        ("mock", Some(name)) => Scenario::by_name(name)
            .map(TrackerSpec::Mock)
            .ok_or_else(|| format!("no scenario `{name}`; there are {}", Scenario::ALL.map(Scenario::name).join(", "))),
        ("serial", Some(rest)) => parse_serial(rest),
        ("replay", Some(rest)) => parse_replay(rest),
        ("serial" | "replay", None) => Err(format!("lacks a path: expected `{scheme}:PATH`")),
        ("hid", _) => Err("HID trackers are not supported by this version of holod; have a small bridge write the \
                           line protocol to a serial port or PTY and give that port's path"
            .into()),
        (scheme, Some(_)) if !scheme.contains('/') && !scheme.contains('.') => {
            Err(format!("unknown kind `{scheme}:`; expected {FORMS}"))
        }
        _ => Ok(TrackerSpec::Path(spec.into())),
    }
}

/// The path and the `key=value` or bare options behind it. Options are taken from the end, so that a path may hold a comma.
fn split_options(rest: &str) -> Result<(&str, Vec<&str>), String> {
    let mut path = rest;
    let mut options = Vec::new();
    while let Some((before, last)) = path.rsplit_once(',') {
        if is_word_option(last) {
            options.push(last);
            path = before;
        } else {
            break;
        }
    }
    if path.is_empty() { Err("lacks a path".into()) } else { Ok((path, options)) }
}

fn is_word_option(option: &str) -> bool {
    let key = option.split_once('=').map_or(option, |(key, _)| key);
    !key.is_empty() && key.bytes().all(|byte| byte.is_ascii_lowercase())
}

fn parse_serial(rest: &str) -> Result<TrackerSpec, String> {
    let (path, options) = split_options(rest)?;
    let mut baud = None;
    let mut profile = DEFAULT_PROFILE.to_owned();
    for option in options {
        match option.split_once('=') {
            Some(("baud", value)) => {
                baud = Some(value.parse().ok().filter(|baud| *baud > 0).ok_or_else(|| {
                    format!("baud `{value}` is not a whole number of bits a second, such as {DEFAULT_BAUD}")
                })?);
            }
            Some(("profile", name)) => name.clone_into(&mut profile),
            _ => return Err(format!("unknown option `{option}`; expected profile=NAME or baud=N")),
        }
    }
    Ok(TrackerSpec::Serial { path: path.into(), profile, baud })
}

fn parse_replay(rest: &str) -> Result<TrackerSpec, String> {
    let (path, options) = split_options(rest)?;
    let mut speed = ReplaySpeed::Times(1.0);
    let mut repeat = false;
    for option in options {
        match option.split_once('=') {
            Some(("speed", "max")) => speed = ReplaySpeed::Fastest,
            Some(("speed", value)) => {
                let times = value.parse().ok().filter(|times| (1e-3..=1e3).contains(times));
                speed = ReplaySpeed::Times(
                    times.ok_or_else(|| format!("speed `{value}` is neither a number from 0.001 to 1000 nor `max`"))?,
                );
            }
            None if option == "loop" => repeat = true,
            _ => return Err(format!("unknown option `{option}`; expected speed=X, speed=max or loop")),
        }
    }
    if repeat && speed == ReplaySpeed::Fastest {
        return Err("speed=max and loop together would never end; drop one of them".into());
    }
    Ok(TrackerSpec::Replay { path: path.into(), speed, repeat })
}

impl fmt::Display for TrackerSpec {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Path(path) => path.display().fmt(f),
            Self::Serial { path, profile, baud } => {
                write!(f, "serial:{},profile={profile}", path.display())?;
                baud.map_or(Ok(()), |baud| write!(f, ",baud={baud}"))
            }
            Self::Replay { path, speed, repeat } => {
                write!(f, "replay:{}", path.display())?;
                match speed {
                    ReplaySpeed::Times(times) => write!(f, ",speed={times}")?,
                    ReplaySpeed::Fastest => f.write_str(",speed=max")?,
                }
                if *repeat { f.write_str(",loop") } else { Ok(()) }
            }
            Self::Mock(scenario) => write!(f, "mock:{}", scenario.name()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(spec: &str) -> TrackerSpec {
        spec.parse().expect(spec)
    }

    #[test]
    fn each_form_is_read() {
        assert_eq!(parsed("/dev/ttyUSB0"), TrackerSpec::Path("/dev/ttyUSB0".into()));
        assert_eq!(parsed("./odd:name.csv"), TrackerSpec::Path("./odd:name.csv".into()));
        assert_eq!(parsed("/dev/serial/by-id/usb:1"), TrackerSpec::Path("/dev/serial/by-id/usb:1".into()));
        let profile = || "holod".to_owned();
        assert_eq!(
            parsed("serial:/dev/x"),
            TrackerSpec::Serial { path: "/dev/x".into(), profile: profile(), baud: None }
        );
        assert_eq!(
            parsed("serial:/dev/x,profile=holod,baud=9600"),
            TrackerSpec::Serial { path: "/dev/x".into(), profile: profile(), baud: Some(9600) }
        );
        assert_eq!(
            parsed("replay:a,B.csv,speed=2.5,loop"),
            TrackerSpec::Replay { path: "a,B.csv".into(), speed: ReplaySpeed::Times(2.5), repeat: true }
        );
        assert_eq!(
            parsed("replay:a.csv,speed=max"),
            TrackerSpec::Replay { path: "a.csv".into(), speed: ReplaySpeed::Fastest, repeat: false }
        );
        assert_eq!(parsed("mock"), TrackerSpec::Mock(Scenario::default()));
        assert_eq!(parsed("mock:blinks"), TrackerSpec::Mock(Scenario::Blinks));
    }

    #[test]
    fn what_is_shown_reads_as_the_same() {
        for spec in ["/dev/ttyUSB0", "serial:/dev/x,baud=9600", "replay:a.csv,speed=0.5,loop", "mock:steady"] {
            assert_eq!(parsed(&parsed(spec).to_string()), parsed(spec));
        }
    }

    #[test]
    fn each_mistake_is_told() {
        let cases = [
            ("", "is empty"),
            ("hid:1234:5678", "HID trackers are not supported"),
            ("hid", "HID trackers are not supported"),
            ("tcp:host", "unknown kind `tcp:`"),
            ("serial:", "lacks a path"),
            ("serial", "lacks a path"),
            ("serial:/dev/x,baud=fast", "baud `fast`"),
            ("serial:/dev/x,baud=0", "baud `0`"),
            ("serial:/dev/x,parity=odd", "unknown option `parity=odd`"),
            ("replay:x,speed=0", "speed `0`"),
            ("replay:x,speed=NaN", "speed `NaN`"),
            ("replay:x,speed=-1", "speed `-1`"),
            ("replay:x,repeat", "unknown option `repeat`"),
            ("replay:x,speed=max,loop", "never end"),
            ("mock:lights", "no scenario `lights`; there are light-steps"),
        ];
        for (spec, told) in cases {
            let error = spec.parse::<TrackerSpec>().expect_err(spec).to_string();
            assert!(error.contains(told), "{spec}: {error}");
            assert!(error.starts_with(&format!("tracker `{spec}`")), "{error}");
        }
    }
}

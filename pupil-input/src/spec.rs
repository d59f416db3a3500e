//! Where samples come from, as named on the command line or in the rig file.

use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use crate::profile::{DEFAULT_BAUD, Profile};
use crate::simulate::Scenario;
use crate::usb_ids::UsbIds;

/// A parsed tracker spec.
#[derive(Clone, Debug, PartialEq)]
#[allow(missing_docs, reason = "the variants say what their fields are")]
pub enum TrackerSpec {
    /// A path by itself: a log if it is a regular file, else a serial port.
    Path(PathBuf),
    /// `serial:PATH[,profile=NAME][,baud=N]`, or without `serial:` where there is an option
    Serial {
        path: PathBuf,
        /// The tracker's profile; [`DEFAULT_PROFILE`](crate::DEFAULT_PROFILE) where the spec names none.
        profile: Option<String>,
        /// Bits a second; the profile's own where the spec names none.
        baud: Option<u32>,
    },
    /// `hid[:VID:PID][,profile=NAME][,serial=TEXT]`: a device that sends HID reports
    Hid {
        /// USB vendor and product; the profile's own where the spec names none.
        ids: Option<UsbIds>,
        /// The device's serial number, to tell two of a kind apart.
        serial: Option<String>,
        /// The tracker's profile; the one that knows the ids where the spec names none.
        profile: Option<String>,
    },
    /// `tcp:HOST[:PORT],profile=NAME`: the profile's port where there is none
    Tcp {
        /// The tracker's host and port.
        address: HostPort,
        profile: String,
    },
    /// `udp:HOST[:PORT],profile=NAME`: listens there for datagrams
    Udp {
        /// Address of this machine and port.
        address: HostPort,
        profile: String,
    },
    /// `core[:HOST[:PORT]]`: Pupil Labs Core, its Pupil Remote
    Core(HostPort),
    /// `neon[:HOST[:PORT]]`: Pupil Labs Neon, its Companion's REST port
    Neon(HostPort),
    /// `replay:FILE[,speed=X][,loop]`, or without `replay:` where there is an option
    Replay {
        path: PathBuf,
        /// How fast it is played.
        speed: ReplaySpeed,
        /// Begin again at its end.
        repeat: bool,
    },
    /// `mock[:SCENARIO]`: a simulated eye
    Mock(Scenario),
    /// `mock:FILE`: the text of a [`Script`](crate::Script)
    MockFile(PathBuf),
}

impl TrackerSpec {
    /// The same as read in `folder`: where its relative paths start, those of a profile's file included.
    pub fn in_folder(self, folder: &Path) -> Self {
        let path = |path: PathBuf| folder.join(path);
        let profile = |name: String| profile_in(folder, &name);
        match self {
            Self::Path(named) => Self::Path(path(named)),
            Self::Serial { path: named, profile: of, baud } => {
                Self::Serial { path: path(named), profile: of.map(profile), baud }
            }
            Self::Hid { ids, serial, profile: of } => Self::Hid { ids, serial, profile: of.map(profile) },
            Self::Tcp { address, profile: of } => Self::Tcp { address, profile: profile(of) },
            Self::Udp { address, profile: of } => Self::Udp { address, profile: profile(of) },
            Self::Replay { path: named, speed, repeat } => Self::Replay { path: path(named), speed, repeat },
            Self::MockFile(named) => Self::MockFile(path(named)),
            Self::Core(_) | Self::Neon(_) | Self::Mock(_) => self,
        }
    }

    /// The files that are read for it, below `/dev` none: a log, a scenario or a profile of one's own.
    pub fn files(&self) -> Vec<PathBuf> {
        let profile = match self {
            Self::Path(path) if path.starts_with("/dev") => None,
            Self::Path(path) | Self::Replay { path, .. } | Self::MockFile(path) => return vec![path.clone()],
            Self::Serial { profile, .. } | Self::Hid { profile, .. } => profile.as_ref(),
            Self::Tcp { profile, .. } | Self::Udp { profile, .. } => Some(profile),
            Self::Core(_) | Self::Neon(_) | Self::Mock(_) => None,
        };
        profile.filter(|name| Profile::is_path(name)).map(PathBuf::from).into_iter().collect()
    }
}

/// A profile's name, or the path of its file where that starts at `folder`.
fn profile_in(folder: &Path, name: &str) -> String {
    if Profile::is_path(name) { folder.join(name).display().to_string() } else { name.to_owned() }
}

/// A name or address of a host, and a port.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct HostPort {
    /// Name or address; an IPv6 address without its brackets.
    pub host: String,
    /// Number of the TCP or UDP port.
    pub port: u16,
}

impl fmt::Display for HostPort {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { host, port } = self;
        if host.contains(':') { write!(f, "[{host}]:{port}") } else { write!(f, "{host}:{port}") }
    }
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

/// Port of Pupil Remote.
const CORE_PORT: u16 = 50020;
/// Port of the Companion's REST interface.
const NEON_PORT: u16 = 8080;
const FORMS: &str = "`/dev/ttyUSB0`, `serial:PATH[,profile=NAME][,baud=N]`, `hid:VID:PID[,profile=NAME][,serial=TEXT]`, \
                     `tcp:HOST[:PORT],profile=NAME`, `udp:HOST[:PORT],profile=NAME`, `core[:HOST[:PORT]]`, \
                     `neon[:HOST[:PORT]]`, `replay:FILE[,speed=X|max][,loop]`, a log file, or `mock[:SCENARIO|:FILE]`";

impl FromStr for TrackerSpec {
    type Err = SpecError;

    fn from_str(spec: &str) -> Result<Self, SpecError> {
        parse(spec, Path::new("")).map_err(|problem| SpecError { spec: spec.into(), problem })
    }
}

/// Reads a spec whose relative paths start at `folder`, as it is written; on error, what is wrong with it.
pub(crate) fn parse(spec: &str, folder: &Path) -> Result<TrackerSpec, String> {
    let network = |rest| parse_network(rest, folder);
    let (scheme, rest) = match spec.split_once(':') {
        Some((scheme, rest)) => (scheme, Some(rest)),
        None => (spec, None),
    };
    match (scheme, rest) {
        ("", None) => Err(format!("is empty; expected {FORMS}")),
        ("mock", None) => Ok(TrackerSpec::Mock(Scenario::default())),
        ("mock", Some(name)) => parse_mock(name),
        ("serial", Some(rest)) => parse_serial(rest),
        ("replay", Some(rest)) => parse_replay(rest),
        ("serial" | "replay", None) => Err(format!("lacks a path: expected `{scheme}:PATH`")),
        ("hid", rest) => parse_hid(rest.unwrap_or_default()),
        ("tcp", Some(rest)) => network(rest).map(|(address, profile)| TrackerSpec::Tcp { address, profile }),
        ("udp", Some(rest)) => network(rest).map(|(address, profile)| TrackerSpec::Udp { address, profile }),
        ("core", None) => Ok(TrackerSpec::Core(HostPort { host: "127.0.0.1".into(), port: CORE_PORT })),
        ("core", Some(rest)) => host_port(rest, Some(CORE_PORT)).map(TrackerSpec::Core),
        ("neon", None) => Ok(TrackerSpec::Neon(HostPort { host: "neon.local".into(), port: NEON_PORT })),
        ("neon", Some(rest)) => host_port(rest, Some(NEON_PORT)).map(TrackerSpec::Neon),
        (scheme, Some(rest)) if !scheme.contains('/') && !scheme.contains('.') => {
            let advice = match rest.contains('/') {
                true => format!("; for the file or port at that path write `./{spec}`"),
                false => String::new(),
            };
            Err(format!("unknown kind `{scheme}:`; expected {FORMS}{advice}"))
        }
        _ => parse_path(spec),
    }
}

/// A path by itself, or one with the options that `serial:` or `replay:` has.
fn parse_path(spec: &str) -> Result<TrackerSpec, String> {
    let (path, options) = split_options(spec)?;
    let any = |of: &[&str]| options.iter().any(|option| of.contains(&key_of(option)));
    match (any(&["profile", "baud"]), any(&["speed", "loop"])) {
        (false, false) => Ok(TrackerSpec::Path(spec.into())),
        (true, false) => parse_serial(spec),
        (false, true) => parse_replay(spec),
        (true, true) => Err(format!("`{path}` has options of a port and of a log; expected {FORMS}")),
    }
}

fn parse_mock(name: &str) -> Result<TrackerSpec, String> {
    match Scenario::by_name(name) {
        Some(scenario) => Ok(TrackerSpec::Mock(scenario)),
        None if name.contains(['/', '.']) => Ok(TrackerSpec::MockFile(name.into())),
        None => {
            let known = Scenario::ALL.map(Scenario::name).join(", ");
            Err(format!("no scenario `{name}`; there are {known}, and files such as ./{name}.txt"))
        }
    }
}

/// The path and the `key=value` or bare options behind it. Options are taken from the end, so that a path may hold a
/// comma.
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
    refuse_repeats(&options)?;
    if path.is_empty() { Err("lacks a path".into()) } else { Ok((path, options)) }
}

fn refuse_repeats(options: &[&str]) -> Result<(), String> {
    let keys: Vec<_> = options.iter().map(|option| key_of(option)).collect();
    let repeated = (1..keys.len()).find(|index| keys[..*index].contains(&keys[*index]));
    repeated.map_or(Ok(()), |index| Err(format!("the option `{}` is given twice; take one of them out", keys[index])))
}

fn key_of(option: &str) -> &str {
    option.split_once('=').map_or(option, |(key, _)| key)
}

fn is_word_option(option: &str) -> bool {
    let key = key_of(option);
    !key.is_empty() && key.bytes().all(|byte| byte.is_ascii_lowercase())
}

fn parse_serial(rest: &str) -> Result<TrackerSpec, String> {
    let (path, options) = split_options(rest)?;
    let mut baud = None;
    let mut profile = None;
    for option in options {
        match option.split_once('=') {
            Some(("baud", value)) => {
                baud = Some(value.parse().ok().filter(|baud| *baud > 0).ok_or_else(|| {
                    format!("baud `{value}` is not a whole number of bits a second, such as {DEFAULT_BAUD}")
                })?);
            }
            Some(("profile", name)) => profile = Some(name.to_owned()),
            _ => return Err(format!("unknown option `{option}`; expected profile=NAME or baud=N")),
        }
    }
    Ok(TrackerSpec::Serial { path: path.into(), profile, baud })
}

fn parse_hid(rest: &str) -> Result<TrackerSpec, String> {
    let (ids, options) = match rest.split_once(',') {
        Some((ids, options)) => (ids, options.split(',').collect()),
        None => (rest, Vec::new()),
    };
    refuse_repeats(&options)?;
    let ids = if ids.is_empty() { None } else { Some(ids.parse()?) };
    let (mut serial, mut profile) = (None, None);
    for option in options {
        match option.split_once('=') {
            Some(("profile", name)) => profile = Some(name.to_owned()),
            Some(("serial", text)) => serial = Some(text.to_owned()),
            _ => return Err(format!("unknown option `{option}`; expected profile=NAME or serial=TEXT")),
        }
    }
    if ids.is_none() && profile.is_none() {
        return Err("names no device: expected `hid:VID:PID` or `hid:,profile=NAME`".into());
    }
    Ok(TrackerSpec::Hid { ids, serial, profile })
}

fn parse_network(rest: &str, folder: &Path) -> Result<(HostPort, String), String> {
    let (address, option) = rest.split_once(',').unwrap_or((rest, ""));
    match option.split_once('=') {
        Some(("profile", name)) => {
            // Where the address has a port, a profile that cannot be had is told of when the tracker is opened.
            let address = match Profile::find(&profile_in(folder, name)) {
                Ok(profile) => host_port(address, profile.network.port),
                Err(error) => host_port(address, None).map_err(|wrong| match host_port(address, Some(1)) {
                    Ok(_) => error.to_string(),
                    Err(_) => wrong,
                }),
            };
            Ok((address?, name.to_owned()))
        }
        _ => Err(format!("found `{option}` behind the address, expected `profile=NAME`")),
    }
}

/// `HOST:PORT`, `[IPV6]:PORT`, or just a host where there is a default port.
fn host_port(text: &str, default_port: Option<u16>) -> Result<HostPort, String> {
    let wrong = || format!("`{text}` is no address such as 192.168.1.20:{}", default_port.unwrap_or(4242));
    let (host, port) = match text.strip_prefix('[').and_then(|rest| rest.split_once(']')) {
        Some((host, port)) => (host, port.strip_prefix(':')),
        None => match text.split_once(':') {
            Some((host, port)) => (host, Some(port)),
            None => (text, None),
        },
    };
    let port = match port {
        Some(port) => port.parse().ok().filter(|port| *port > 0),
        None => default_port,
    };
    if host.is_empty() {
        return Err(wrong());
    }
    Ok(HostPort { host: host.into(), port: port.ok_or_else(wrong)? })
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

fn write_option(f: &mut fmt::Formatter<'_>, key: &str, value: Option<&impl fmt::Display>) -> fmt::Result {
    value.map_or(Ok(()), |value| write!(f, ",{key}={value}"))
}

impl fmt::Display for TrackerSpec {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Path(path) => path.display().fmt(f),
            Self::Serial { path, profile, baud } => {
                write!(f, "serial:{}", path.display())?;
                write_option(f, "profile", profile.as_ref())?;
                write_option(f, "baud", baud.as_ref())
            }
            Self::Hid { ids, serial, profile } => {
                f.write_str("hid:")?;
                ids.map_or(Ok(()), |ids| ids.fmt(f))?;
                write_option(f, "profile", profile.as_ref())?;
                write_option(f, "serial", serial.as_ref())
            }
            Self::Tcp { address, profile } => write!(f, "tcp:{address},profile={profile}"),
            Self::Udp { address, profile } => write!(f, "udp:{address},profile={profile}"),
            Self::Core(address) => write!(f, "core:{address}"),
            Self::Neon(address) => write!(f, "neon:{address}"),
            Self::Replay { path, speed, repeat } => {
                write!(f, "replay:{}", path.display())?;
                match speed {
                    ReplaySpeed::Times(times) => write!(f, ",speed={times}")?,
                    ReplaySpeed::Fastest => f.write_str(",speed=max")?,
                }
                if *repeat { f.write_str(",loop") } else { Ok(()) }
            }
            Self::Mock(scenario) => write!(f, "mock:{}", scenario.name()),
            Self::MockFile(path) => write!(f, "mock:{}", path.display()),
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
        assert_eq!(parsed("serial:/dev/x"), TrackerSpec::Serial { path: "/dev/x".into(), profile: None, baud: None });
        assert_eq!(
            parsed("serial:/dev/x,profile=holod,baud=9600"),
            TrackerSpec::Serial { path: "/dev/x".into(), profile: Some("holod".into()), baud: Some(9600) }
        );
        assert_eq!(
            parsed("replay:a,B.csv,speed=2.5,loop"),
            TrackerSpec::Replay { path: "a,B.csv".into(), speed: ReplaySpeed::Times(2.5), repeat: true }
        );
        assert_eq!(
            parsed("replay:a.csv,speed=max"),
            TrackerSpec::Replay { path: "a.csv".into(), speed: ReplaySpeed::Fastest, repeat: false }
        );
        assert_eq!(parsed("/dev/ttyS0,profile=iscan"), parsed("serial:/dev/ttyS0,profile=iscan"));
        assert_eq!(parsed("/dev/ttyS0,baud=9600,profile=iscan"), parsed("serial:/dev/ttyS0,profile=iscan,baud=9600"));
        assert_eq!(parsed("a.csv,speed=max"), parsed("replay:a.csv,speed=max"));
        assert_eq!(parsed("./b,loop"), parsed("replay:./b,loop"));
        assert_eq!(parsed("./a,b.csv"), TrackerSpec::Path("./a,b.csv".into()));
        assert_eq!(parsed("mock"), TrackerSpec::Mock(Scenario::default()));
        assert_eq!(parsed("mock:blinks"), TrackerSpec::Mock(Scenario::Blinks));
        let address = HostPort { host: "host".into(), port: 4242 };
        assert_eq!(
            parsed("tcp:host,profile=open-gaze"),
            TrackerSpec::Tcp { address, profile: "open-gaze".into() },
            "the profile has the port"
        );
        assert_eq!(parsed("mock:my.txt"), TrackerSpec::MockFile("my.txt".into()));
    }

    #[test]
    fn what_is_shown_reads_as_the_same() {
        for spec in [
            "/dev/ttyUSB0",
            "serial:/dev/x,profile=iscan,baud=9600",
            "hid:1209:0001,profile=x,serial=A1",
            "hid:,profile=x",
            "tcp:host:4242,profile=open-gaze",
            "udp:[::1]:6900,profile=pupilext-csv",
            "core:10.0.0.2:50020",
            "neon:neon.local:8080",
            "replay:a.csv,speed=0.5,loop",
            "mock:steady",
            "mock:./steady",
        ] {
            assert_eq!(parsed(&parsed(spec).to_string()), parsed(spec));
        }
    }

    #[test]
    fn relative_paths_start_at_the_folder_that_is_named() {
        for (spec, expected) in [
            ("log.csv", "/rigs/a/log.csv"),
            ("/dev/ttyUSB0", "/dev/ttyUSB0"),
            ("replay:../log.csv,loop", "replay:/rigs/a/../log.csv,loop"),
            ("serial:/dev/x,profile=mine.toml", "serial:/dev/x,profile=/rigs/a/mine.toml"),
            ("serial:/dev/x,profile=iscan-etl", "serial:/dev/x,profile=iscan-etl"),
            ("udp:[::1]:6900,profile=./mine.toml", "udp:[::1]:6900,profile=/rigs/a/./mine.toml"),
            ("mock:my.txt", "mock:/rigs/a/my.txt"),
            ("mock:steady", "mock:steady"),
            ("neon", "neon"),
        ] {
            assert_eq!(parsed(spec).in_folder(Path::new("/rigs/a")), parsed(expected), "{spec}");
            assert_eq!(parsed(spec).in_folder(Path::new("")), parsed(spec), "{spec}");
        }
    }

    #[test]
    fn each_mistake_is_told() {
        let cases = [
            ("", "is empty"),
            ("hid:1234", "`1234` is no USB VID:PID"),
            ("hid:12345:1", "is no USB VID:PID"),
            ("hid", "names no device"),
            ("hid:1234:5678,port=1", "unknown option `port=1`"),
            ("tcp:host,profile=x", "no tracker profile `x`"),
            ("tcp:host,profile=holod", "`host` is no address"),
            ("tcp:host:0,profile=x", "`host:0` is no address"),
            ("tcp:host:4242", "expected `profile=NAME`"),
            ("core::1", "is no address"),
            ("usb:host", "unknown kind `usb:`"),
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
            ("/dev/ttyS0,baud=fast", "baud `fast`"),
            ("./x,baud=9600,loop", "options of a port and of a log"),
            ("replay:x,speed=2,speed=3", "the option `speed` is given twice"),
            ("./x,loop,loop", "the option `loop` is given twice"),
            ("/dev/ttyS0,baud=9600,profile=x,baud=9600", "the option `baud` is given twice"),
            ("hid:1209:0001,serial=A,serial=B", "the option `serial` is given twice"),
            ("2026-01-01T12:00:00/x.csv", "at that path write `./2026-01-01T12:00:00/x.csv`"),
            ("mock:lights", "no scenario `lights`; there are light-steps"),
        ];
        for (spec, told) in cases {
            let error = spec.parse::<TrackerSpec>().expect_err(spec).to_string();
            assert!(error.contains(told), "{spec}: {error}");
            assert!(error.starts_with(&format!("tracker `{spec}`")), "{error}");
        }
    }
}

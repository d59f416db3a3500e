//! Which panel, in words: what follows `--output`.

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

use holod_calibration::TimeNs;

use super::ReportFaults;
use super::drm::DrmTarget;

/// A panel by name.
#[derive(Clone, Debug, PartialEq)]
pub enum OutputSpec {
    /// `headless[:KEY=VALUE,...]`: a virtual panel, with what it does wrong on purpose.
    Headless(ReportFaults),
    /// `drm:CONNECTOR[,card=/dev/dri/cardN]`: a connector of a graphics card, or the monitor at it, without a display
    /// server.
    Drm(DrmTarget),
    /// `window[:MONITOR][,allow_primary]`: a window that covers a monitor of the desktop.
    Window(WindowSpec),
}

/// Which monitor a window covers.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct WindowSpec {
    /// The monitor's connector, model or serial number; none where there is but one that it can be.
    pub monitor: Option<String>,
    /// It may be the primary or the only monitor.
    pub allow_primary: bool,
}

/// A spec that names no panel.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("--output {spec}: found {found}; expected {expected}")]
pub struct SpecError {
    spec: String,
    found: String,
    expected: String,
}

impl OutputSpec {
    /// What a spec looks like, for help and errors.
    pub const FORMS: &str =
        "headless[:KEY=VALUE,...], window[:MONITOR][,allow_primary] or drm:CONNECTOR[,card=/dev/dri/cardN]";
}

impl FromStr for OutputSpec {
    type Err = SpecError;

    fn from_str(spec: &str) -> Result<Self, SpecError> {
        let kind_ends = spec.find([':', ',']).unwrap_or(spec.len());
        let (kind, rest) = spec.split_at(kind_ends);
        let parsed = match kind {
            "window" => window(rest).map(Self::Window),
            "headless" if !rest.starts_with(',') => report_faults(rest.trim_start_matches(':')).map(Self::Headless),
            "drm" => drm_target(rest.trim_start_matches(':')).map(Self::Drm),
            _ => Err((format!("\"{spec}\""), Self::FORMS.to_owned())),
        };
        parsed.map_err(|(found, expected)| SpecError { spec: spec.to_owned(), found, expected })
    }
}

impl fmt::Display for OutputSpec {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Headless(_) => f.write_str("headless"),
            Self::Drm(DrmTarget { connector, card: None }) => write!(f, "drm:{connector}"),
            Self::Drm(DrmTarget { connector, card: Some(card) }) => {
                write!(f, "drm:{connector},card={}", card.display())
            }
            Self::Window(WindowSpec { monitor, allow_primary }) => {
                f.write_str("window")?;
                if let Some(monitor) = monitor {
                    write!(f, ":{monitor}")?;
                }
                f.write_str(if *allow_primary { ",allow_primary" } else { "" })
            }
        }
    }
}

/// What was found and what was expected.
type Mismatch = (String, String);

fn window(rest: &str) -> Result<WindowSpec, Mismatch> {
    let (rest, allow_primary) = rest.strip_suffix(",allow_primary").map_or((rest, false), |rest| (rest, true));
    let monitor = match rest.strip_prefix(':') {
        Some(monitor) if !monitor.trim().is_empty() => Some(monitor.trim().to_owned()),
        None if rest.is_empty() => None,
        _ => {
            let expected = ":MONITOR, a connector, model or serial number, or ,allow_primary".to_owned();
            return Err((format!("\"{rest}\""), expected));
        }
    };
    Ok(WindowSpec { monitor, allow_primary })
}

/// Of a virtual panel's faults.
const LONGEST: Duration = Duration::from_secs(86_400);

fn report_faults(text: &str) -> Result<ReportFaults, Mismatch> {
    let mut faults = ReportFaults::NONE;
    for option in text.split(',').filter(|option| !option.is_empty()) {
        let (key, value) = option.split_once('=').unwrap_or((option, ""));
        let wrong = |expected: &str| (format!("\"{option}\""), format!("{key}={expected}"));
        let share = || {
            let share = value.parse().ok().filter(|share: &f64| (0.0..=1.0).contains(share));
            share.ok_or_else(|| wrong("a share from 0 to 1"))
        };
        match key {
            "refresh" => {
                let refresh_hz = value.parse().ok().filter(|hz: &f64| (1.0..=2000.0).contains(hz));
                faults.refresh_hz = Some(refresh_hz.ok_or_else(|| wrong("1 to 2000 Hz"))?);
            }
            "jitter" => faults.jitter = time(value).ok_or_else(|| wrong("a time such as 0.2ms, a day at most"))?,
            "late" => faults.late = share()?,
            "early" => faults.early = share()?,
            "doubled" => faults.doubled = share()?,
            "dropped" => faults.dropped = share()?,
            "unplug" => {
                let times = value.split_once('+').and_then(|(after, length)| Some((time(after)?, time(length)?)));
                faults.unplug = Some(
                    times.ok_or_else(|| wrong("two times such as 5s+2s, a day at most: after which, for how long"))?,
                );
            }
            "seed" => faults.seed = value.parse().map_err(|_| wrong("a whole number"))?,
            _ => {
                let keys = "refresh, jitter, late, early, doubled, dropped, unplug or seed";
                return Err((format!("\"{key}\""), keys.to_owned()));
            }
        }
    }
    Ok(faults)
}

/// A monitor's name may hold commas.
fn drm_target(text: &str) -> Result<DrmTarget, Mismatch> {
    let (connector, card) = match text.rsplit_once(",card=") {
        Some((connector, card)) => (connector, Some(PathBuf::from(card))),
        None => (text, None),
    };
    if connector.is_empty() {
        let expected = "a connector such as DP-1, or a monitor's name or serial number, after drm:";
        return Err(("nothing".to_owned(), expected.to_owned()));
    }
    if let Some(card) = card.as_ref().filter(|card| !card.starts_with("/dev/dri")) {
        return Err((format!("card={}", card.display()), "card=/dev/dri/cardN".to_owned()));
    }
    Ok(DrmTarget { connector: connector.to_owned(), card })
}

fn time(text: &str) -> Option<TimeNs> {
    let unit_at = text.find(|letter: char| letter.is_ascii_alphabetic() || letter == 'µ')?;
    let (number, unit) = text.split_at(unit_at);
    let unit_s = match unit {
        "us" | "µs" => 1e-6,
        "ms" => 1e-3,
        "s" => 1.0,
        _ => return None,
    };
    let duration = Duration::try_from_secs_f64(number.parse::<f64>().ok()? * unit_s).ok()?;
    (duration <= LONGEST).then_some(TimeNs(duration.as_nanos() as i64))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_virtual_panel_takes_its_faults_by_name() {
        assert_eq!("headless".parse(), Ok(OutputSpec::Headless(ReportFaults::NONE)));
        let spec =
            "headless:refresh=59.94,jitter=200us,late=0.1,early=0.2,doubled=0.3,dropped=0.4,unplug=5s+1.5s,seed=7";
        let faults = ReportFaults {
            refresh_hz: Some(59.94),
            jitter: TimeNs(200_000),
            late: 0.1,
            early: 0.2,
            doubled: 0.3,
            dropped: 0.4,
            unplug: Some((TimeNs(5_000_000_000), TimeNs(1_500_000_000))),
            seed: 7,
        };
        assert_eq!(spec.parse(), Ok(OutputSpec::Headless(faults)));
    }

    #[test]
    fn a_connector_may_be_named_with_its_card() {
        for (spec, connector, card) in [
            ("drm:DP-1", "DP-1", None),
            ("drm:HDMI-A-2,card=/dev/dri/card1", "HDMI-A-2", Some("/dev/dri/card1")),
            ("drm:PLUTO, second", "PLUTO, second", None),
        ] {
            let target = DrmTarget { connector: connector.to_owned(), card: card.map(PathBuf::from) };
            assert_eq!(spec.parse(), Ok(OutputSpec::Drm(target.clone())));
            assert_eq!(OutputSpec::Drm(target).to_string(), spec);
        }
    }

    #[test]
    fn a_window_takes_a_monitors_name_as_it_is() {
        for (text, monitor, allow_primary) in [
            ("window", None, false),
            ("window:DP-2", Some("DP-2"), false),
            ("window,allow_primary", None, true),
            ("window:PLUTO, 2nd,allow_primary", Some("PLUTO, 2nd"), true),
        ] {
            let spec = OutputSpec::Window(WindowSpec { monitor: monitor.map(str::to_owned), allow_primary });
            assert_eq!(text.parse().as_ref(), Ok(&spec));
            assert_eq!(spec.to_string(), text);
        }
    }

    #[test]
    fn a_spec_that_names_no_panel_is_refused_in_words() {
        for (spec, part) in [
            ("screen", "found \"screen\"; expected headless"),
            ("headless,late=0.1", "found \"headless,late=0.1\"; expected headless[:KEY"),
            ("headless:jitter", "found \"jitter\"; expected jitter=a time such as 0.2ms"),
            ("headless:late=2", "late=a share from 0 to 1"),
            ("headless:unplug=5s", "unplug=two times"),
            ("headless:refresh=0", "refresh=1 to 2000 Hz"),
            ("drm", "found nothing; expected a connector such as DP-1"),
            ("drm:DP-1,card=card0", "found card=card0; expected card=/dev/dri/cardN"),
            ("window:", "found \":\"; expected :MONITOR"),
            ("window,primary", "found \",primary\"; expected :MONITOR"),
            ("headless:speed=1", "found \"speed\"; expected refresh, jitter"),
        ] {
            let error = spec.parse::<OutputSpec>().unwrap_err().to_string();
            assert!(error.contains(part), "{error}");
        }
    }
}

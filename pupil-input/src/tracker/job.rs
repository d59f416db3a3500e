//! What a tracker's thread is to do, by its spec.

use std::path::{Path, PathBuf};

use holod_calibration::TimeNs;

use super::TrackerError;
use crate::import::Recording;
use crate::import::raw::RawLog;
use crate::profile::{DEFAULT_PROFILE, Profile};
use crate::simulate::Script;
use crate::size_unit::{Figures, SizeUnit};
use crate::source::hid::{self, HidFeed, Wanted};
use crate::source::neon::NeonFeed;
use crate::source::pupil_labs_core::CoreFeed;
use crate::source::serial::SerialFeed;
use crate::source::tcp::TcpFeed;
use crate::source::udp::UdpFeed;
use crate::source::{ByteSource, Feed, SourceError};
use crate::spec::{ReplaySpeed, TrackerSpec};
use crate::usb_ids::UsbIds;
use crate::wire::Format;

/// What the thread is to do.
pub(super) enum Job {
    Live {
        open: Box<dyn ByteSource>,
        feed: Box<dyn Feed>,
        profile: Box<Profile>,
    },
    Replay {
        recording: Box<Recording>,
        play: Play,
    },
    /// holod's own recording: its bytes come again.
    Rerun {
        raw: Box<RawLog>,
        play: Play,
    },
    Mock {
        script: Box<Script>,
        origin: TimeNs,
    },
}

/// How a log is played.
#[derive(Clone, Copy, Debug)]
pub(super) struct Play {
    pub(super) speed: ReplaySpeed,
    pub(super) repeat: bool,
    /// Host time at which it begins.
    pub(super) origin: TimeNs,
}

impl Job {
    pub(super) fn open(spec: &TrackerSpec, origin: TimeNs, forbidden: &[PathBuf]) -> Result<Self, TrackerError> {
        match spec {
            TrackerSpec::Path(path) if path.is_file() => {
                Self::log(path, Play { speed: ReplaySpeed::Times(1.0), repeat: false, origin })
            }
            TrackerSpec::Path(path) => Self::serial(path, None, None, forbidden),
            TrackerSpec::Serial { path, profile, baud } => Self::serial(path, profile.as_deref(), *baud, forbidden),
            TrackerSpec::Hid { ids, serial, profile } => Self::hid(*ids, serial.as_deref(), profile.as_deref()),
            TrackerSpec::Tcp { address, profile } => {
                let profile = Profile::find(profile)?;
                Self::live(Box::new(TcpFeed::new(address.clone(), &profile)), profile)
            }
            TrackerSpec::Udp { address, profile } => {
                let profile = Profile::find(profile)?;
                Self::live(Box::new(UdpFeed::new(address.clone(), &profile)), profile)
            }
            TrackerSpec::Core(address) => {
                Self::live(Box::new(CoreFeed { address: address.clone() }), Profile::find("core")?)
            }
            TrackerSpec::Neon(address) => Self::live(Box::new(NeonFeed::new(address.clone())), Profile::find("neon")?),
            TrackerSpec::Replay { path, speed, repeat } => {
                Self::log(path, Play { speed: *speed, repeat: *repeat, origin })
            }
            TrackerSpec::Mock(scenario) => Ok(Self::Mock { script: Box::new(scenario.script()), origin }),
            TrackerSpec::MockFile(path) => Ok(Self::Mock { script: Box::new(Script::read(path)?), origin }),
        }
    }

    /// [`Self::figures`], as far as can be told without opening a link: of a HID device that its profile does not know
    /// to the end, as far as the profile does.
    pub(super) fn figures_unopened(spec: &TrackerSpec) -> Result<Figures, TrackerError> {
        Ok(match Self::profile_unopened(spec)? {
            Some(profile) => profile.figures(),
            None => Self::open(spec, TimeNs(0), &[])?.figures(),
        })
    }

    /// The profile of a link, which is not opened; none of a log and of a simulated eye.
    pub(super) fn profile_unopened(spec: &TrackerSpec) -> Result<Option<Profile>, TrackerError> {
        Ok(Some(match spec {
            TrackerSpec::Path(path) if !path.is_file() => serial_profile(None)?,
            TrackerSpec::Serial { profile, .. } => serial_profile(profile.as_deref())?,
            TrackerSpec::Hid { ids, serial, profile } => {
                let profile = hid_profile(*ids, profile.as_deref())?;
                Wanted::new(*ids, serial.as_deref(), &profile).map_err(SourceError::from)?;
                profile
            }
            TrackerSpec::Tcp { profile, .. } | TrackerSpec::Udp { profile, .. } => Profile::find(profile)?,
            TrackerSpec::Core(_) => Profile::find("core")?,
            TrackerSpec::Neon(_) => Profile::find("neon")?,
            TrackerSpec::Path(_) | TrackerSpec::Replay { .. } | TrackerSpec::Mock(_) | TrackerSpec::MockFile(_) => {
                return Ok(None);
            }
        }))
    }

    /// What its sizes are before the rig's scale.
    pub(super) fn figures(&self) -> Figures {
        match self {
            Self::Live { profile, .. } => profile.figures(),
            Self::Replay { recording, .. } => {
                Figures { recorded_scale: recording.recorded_scale(), ..recording.unit().into() }
            }
            Self::Rerun { raw, .. } => Figures { recorded_scale: raw.recorded_scale(), ..raw.profile().figures() },
            Self::Mock { .. } => SizeUnit::Millimetres.into(),
        }
    }

    /// A link's profile, and whether it brings datagrams.
    pub(super) fn link(&self) -> Option<(&Profile, bool)> {
        match self {
            Self::Live { profile, feed, .. } => Some((profile, feed.datagrams())),
            Self::Replay { .. } | Self::Rerun { .. } | Self::Mock { .. } => None,
        }
    }

    /// The report descriptor of a HID device.
    pub(super) fn descriptor(&self) -> Option<&[u8]> {
        match self {
            Self::Live { feed, .. } => feed.descriptor(),
            Self::Replay { .. } | Self::Rerun { .. } | Self::Mock { .. } => None,
        }
    }

    /// What a user should know before it runs.
    pub(super) fn warnings(&self) -> Vec<String> {
        match self {
            Self::Live { feed, .. } => feed.warnings(),
            Self::Replay { recording, .. } => recording.warnings().to_vec(),
            Self::Rerun { raw, .. } => raw.warnings(),
            Self::Mock { .. } => Vec::new(),
        }
    }

    /// How a log was read.
    pub(super) fn remarks(&self) -> &[String] {
        match self {
            Self::Replay { recording, .. } => recording.remarks(),
            Self::Live { .. } | Self::Rerun { .. } | Self::Mock { .. } => &[],
        }
    }

    fn serial(
        path: &Path,
        profile: Option<&str>,
        baud: Option<u32>,
        forbidden: &[PathBuf],
    ) -> Result<Self, TrackerError> {
        let profile = serial_profile(profile)?;
        Self::live(Box::new(SerialFeed::new(path, baud, profile.clone(), forbidden)), profile)
    }

    fn hid(ids: Option<UsbIds>, serial: Option<&str>, profile: Option<&str>) -> Result<Self, TrackerError> {
        let profile = hid_profile(ids, profile)?;
        let wanted = Wanted::new(ids, serial, &profile).map_err(SourceError::from)?;
        let mut feed = HidFeed::new(wanted);
        let open = feed.open()?;
        let profile = feed.describe(profile).map_err(SourceError::from)?;
        Ok(Self::Live { open, feed: Box::new(feed), profile: Box::new(profile) })
    }

    fn live(mut feed: Box<dyn Feed>, profile: Profile) -> Result<Self, TrackerError> {
        Ok(Self::Live { open: feed.open()?, feed, profile: Box::new(profile) })
    }

    fn log(path: &Path, play: Play) -> Result<Self, TrackerError> {
        if RawLog::recognises(path) {
            return Ok(Self::Rerun { raw: Box::new(RawLog::open(path)?), play });
        }
        Ok(Self::Replay { recording: Box::new(Recording::read(path)?), play })
    }
}

fn serial_profile(name: Option<&str>) -> Result<Profile, TrackerError> {
    let profile = Profile::find(name.unwrap_or(DEFAULT_PROFILE))?;
    let other = match profile.format {
        Format::Report(_) | Format::Usages(_) => Some(("HID reports", "hid:VID:PID")),
        Format::CoreMsgpack => Some(("Pupil Labs Core's server", "core:HOST")),
        Format::NeonRtp => Some(("Pupil Labs Neon's Companion", "neon:HOST")),
        _ => None,
    };
    match other {
        Some((link, instead)) => Err(TrackerError::WrongLink { profile: profile.name, link, instead }),
        None => Ok(profile),
    }
}

fn hid_profile(ids: Option<UsbIds>, name: Option<&str>) -> Result<Profile, TrackerError> {
    Ok(match name {
        Some(name) => Profile::find(name)?,
        None => hid::profile_of(ids).map_err(SourceError::from)?,
    })
}

/// The text of the profile that a spec names, where it is a user's own and no name would find it again.
pub(super) fn own_profile(spec: &TrackerSpec) -> Option<String> {
    let name = match spec {
        TrackerSpec::Serial { profile, .. } | TrackerSpec::Hid { profile, .. } => profile.as_deref()?,
        TrackerSpec::Tcp { profile, .. } | TrackerSpec::Udp { profile, .. } => profile,
        _ => return None,
    };
    Profile::is_path(name).then(|| std::fs::read_to_string(name).ok()).flatten()
}

//! One card, opened for one connector: mode and settings, scan-out buffers, and what wakes the panel's thread.

use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::Path;

use drm::buffer::DrmFourcc;
use drm::control::{AtomicCommitFlags, Device as _, Mode, connector, plane, property};
use holod_calibration::{Resolution, TimeNs};
use rustix::event::epoll;
use rustix::io::Errno;

use super::card::{Card, Pipe, ScanBuffer, flip};
use super::check::{DisplayCheck, Verdict};
use super::error::DrmError;
use super::event::{Uevent, for_each_flip};
use super::find::{SYS_CLASS_DRM, SeenConnector, seen_connectors};
use super::hotplug::Hotplug;
use super::mode;
use super::monitor::Monitor;
use super::seat::Seat;
use super::settings::{self, Change, LinkStatus};
use super::target::DrmTarget;
use super::timing::FlipStamp;

/// On the screen, on its way there, being written, and one more: a driver may still read the last picture a while after
/// it has said that the next one is shown (vkms does), but the kernel takes no third commit before it has done so.
pub(crate) const BUFFERS: usize = 4;
/// Events that are read at once; one flip is under way at a time.
const EVENTS_MAX: usize = 32;

/// How often a connector's properties are read that change meanwhile.
const READINGS: usize = 3;

/// What is wanted of a connector.
#[derive(Clone, Debug)]
pub(crate) struct Wanted {
    pub(crate) target: DrmTarget,
    pub(crate) size: Resolution,
    pub(crate) refresh_hz: f64,
    pub(crate) channel_bits: u8,
}

/// An opened connector, with its card, mode and buffers.
#[derive(Debug)]
pub(crate) struct Link {
    card: Card,
    /// The end of the card's node, as the kernel's messages name it.
    node: Vec<u8>,
    seen: SeenConnector,
    pipe: Pipe,
    mode: Mode,
    buffer_property: property::Handle,
    link_status: Option<LinkStatus>,
    monitor: Option<Monitor>,
    /// The connector's properties and their values when it was last asked; their memory is taken when it is opened.
    connector_says: (Vec<u32>, Vec<u64>),
    pub(crate) buffers: [ScanBuffer; BUFFERS],
    changes: Vec<Change>,
    checks: Vec<DisplayCheck>,
    hotplug: Option<Hotplug>,
    wake: OwnedFd,
}

impl Link {
    /// Finds the connector, becomes master of its card and makes it ready: the first buffer, written by `write_flat`,
    /// is on the screen.
    pub(crate) fn open(
        wanted: &Wanted,
        seat: Option<&Seat>,
        write_flat: impl Fn(&mut ScanBuffer),
    ) -> Result<Self, DrmError> {
        let seen = wanted.target.find(Path::new(SYS_CLASS_DRM))?;
        let card = Card::open(&seen.card, seat)?;
        let format = format(wanted.channel_bits);
        let buffer = || ScanBuffer::new(&card, wanted.size, format);
        let mut buffers = [buffer()?, buffer()?, buffer()?, buffer()?];
        buffers.iter_mut().for_each(write_flat);
        let hotplug = Hotplug::open().ok();
        let wake = wake_fd(&card, hotplug.as_ref(), seat).map_err(|why| card.refused("waiting for it")(why.into()))?;
        let node = seen.card.file_name().map(|name| name.as_encoded_bytes().to_vec()).unwrap_or_default();
        let ready = Ready::make(&card, &seen, wanted, &buffers[0])?;
        let Ready { pipe, mode, buffer_property, link_status, monitor, changes, mut checks } = ready;
        checks.push(match hotplug {
            Some(_) => DisplayCheck::equal("hotplug messages", "heard", "heard"),
            None => DisplayCheck::unverified("hotplug messages", "the kernel's socket does not open", "heard"),
        });
        let connector_says = (Vec::new(), Vec::new());
        let mut link = Self {
            card,
            node,
            seen,
            pipe,
            mode,
            buffer_property,
            link_status,
            monitor,
            connector_says,
            buffers,
            changes,
            checks,
            hotplug,
            wake,
        };
        // What it says by now, `checks` have; this takes the memory that later answers go to.
        link.found().map_err(|why| link.card.refused("reading its connector")(why.into()))?;
        Ok(link)
    }

    /// Makes the connector ready again after mastership or the monitor had been lost; like [`Link::open`], but the card
    /// stays open, so that nobody else becomes its master meanwhile.
    pub(crate) fn reopen(&mut self, wanted: &Wanted, write_flat: impl Fn(&mut ScanBuffer)) -> Result<(), DrmError> {
        self.card.become_master(|_| Vec::new())?;
        // The kernel forgets what it knew of a monitor only when it is asked for it.
        let asked = self.card.is_connected(self.pipe.connector);
        if !asked.map_err(self.card.refused("asking the monitor"))? {
            return Err(self.disconnected());
        }
        let seen = wanted.target.find(Path::new(SYS_CLASS_DRM))?;
        if seen.card != self.seen.card {
            return Err(self.disconnected());
        }
        self.buffers.iter_mut().for_each(write_flat);
        let ready = Ready::make(&self.card, &seen, wanted, &self.buffers[0])?;
        let hotplug = self.checks.pop();
        (self.seen, self.pipe, self.mode, self.buffer_property) = (seen, ready.pipe, ready.mode, ready.buffer_property);
        (self.link_status, self.monitor) = (ready.link_status, ready.monitor);
        // What was there before holod came is known of the rest; what another connector had is put back, too.
        for change in ready.changes {
            if !self.changes.iter().any(|known| known.is_of_the_same(&change)) {
                self.changes.push(change);
            }
        }
        self.checks = ready.checks;
        self.checks.extend(hotplug);
        Ok(())
    }

    fn disconnected(&self) -> DrmError {
        DrmError::Disconnected {
            connector: self.seen.name.clone(),
            card: self.card.path().to_owned(),
            there: seen_connectors(Path::new(SYS_CLASS_DRM)),
        }
    }

    pub(crate) fn checks(&self) -> &[DisplayCheck] {
        &self.checks
    }

    pub(crate) fn period(&self) -> TimeNs {
        mode::period(&self.mode)
    }

    pub(crate) fn blank(&self) -> TimeNs {
        mode::blank(&self.mode)
    }

    pub(crate) fn is_monotonic(&self) -> bool {
        self.card.is_monotonic()
    }

    pub(crate) fn wake_fd(&self) -> BorrowedFd<'_> {
        self.wake.as_fd()
    }

    /// Puts the buffer `index` on the screen at the next refresh. Takes no memory.
    pub(crate) fn flip(&self, index: usize) -> Result<(), Errno> {
        flip(&self.card, self.pipe.plane, self.buffer_property, self.buffers[index].framebuffer)
    }

    /// What has been said of the connector since the last call. Takes no memory.
    pub(crate) fn hotplug(&self) -> Uevent {
        let connector = u32::from(self.pipe.connector);
        self.hotplug.as_ref().map_or(Uevent::Other, |hotplug| hotplug.news(&self.node, connector))
    }

    /// Asks the monitor whether it is there. Takes no memory; a driver may take milliseconds.
    pub(crate) fn is_connected(&self) -> Result<bool, Errno> {
        let connector: connector::Handle = self.pipe.connector;
        self.card.is_connected(connector).map_err(|why| Errno::from_io_error(&why).unwrap_or(Errno::IO))
    }

    /// What the driver says of the connected monitor and the link to it. Takes no memory.
    pub(crate) fn found(&mut self) -> Result<Found, Errno> {
        for _ in 1..READINGS {
            match self.read_found() {
                // Somebody else had the EDID read anew meanwhile.
                Err(Errno::NOENT) => {}
                found => return found,
            }
        }
        self.read_found()
    }

    fn read_found(&mut self) -> Result<Found, Errno> {
        let (properties, values) = &mut self.connector_says;
        drm_ffi::mode::get_properties(
            self.card.as_fd(),
            self.pipe.connector.into(),
            drm_ffi::DRM_MODE_OBJECT_CONNECTOR,
            Some(properties),
            Some(values),
        )
        .map_err(|why| Errno::from_io_error(&why).unwrap_or(Errno::IO))?;
        let said = properties.iter().copied().zip(values.iter().copied());
        let card = &self.card;
        let read = |blob: u64, bytes: &mut Vec<u8>| {
            let read = drm_ffi::mode::get_property_blob(card.as_fd(), blob as u32, Some(bytes));
            read.map(drop).map_err(|why| Errno::from_io_error(&why).unwrap_or(Errno::IO))
        };
        if let Some(monitor) = &mut self.monitor
            && !monitor.is_same(said.clone(), read)?
        {
            return Ok(Found::OtherMonitor);
        }
        let is_good = self.link_status.is_none_or(|status| status.is_good(said));
        Ok(if is_good { Found::Good } else { Found::BadLink })
    }

    /// The stamps of the connector's flips since the last call, in order. Takes no memory.
    pub(crate) fn flips(&self) -> Result<Flips, Errno> {
        let crtc = u32::from(self.pipe.crtc);
        let mut flips = Flips { stamps: [FlipStamp { sequence: 0, t: TimeNs(0) }; EVENTS_MAX], count: 0 };
        let mut bytes = [0u8; 1024];
        loop {
            match rustix::io::read(&self.card, &mut bytes) {
                Ok(0) | Err(Errno::AGAIN) => return Ok(flips),
                Ok(length) => for_each_flip(&bytes[..length], |of, stamp| {
                    if (of == crtc || of == 0) && flips.count < EVENTS_MAX {
                        flips.stamps[flips.count] = stamp;
                        flips.count += 1;
                    }
                }),
                Err(Errno::INTR) => {}
                Err(why) => return Err(why),
            }
        }
    }
}

impl Drop for Link {
    fn drop(&mut self) {
        settings::restore(&self.card, &self.changes);
    }
}

/// A connected monitor and the link to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Found {
    /// As they were, as far as the driver says.
    Good,
    BadLink,
    OtherMonitor,
}

/// The stamps of page flips that were read together.
pub(crate) struct Flips {
    stamps: [FlipStamp; EVENTS_MAX],
    count: usize,
}

impl Flips {
    pub(crate) fn stamps(&self) -> &[FlipStamp] {
        &self.stamps[..self.count]
    }
}

fn format(channel_bits: u8) -> DrmFourcc {
    if channel_bits == 10 { DrmFourcc::Xrgb2101010 } else { DrmFourcc::Xrgb8888 }
}

/// One descriptor that is readable when the card, the hotplug socket or the seat's bell is.
fn wake_fd(card: &Card, hotplug: Option<&Hotplug>, seat: Option<&Seat>) -> Result<OwnedFd, Errno> {
    let wake = epoll::create(epoll::CreateFlags::CLOEXEC)?;
    epoll::add(&wake, card, epoll::EventData::new_u64(0), epoll::EventFlags::IN)?;
    if let Some(hotplug) = hotplug {
        epoll::add(&wake, hotplug, epoll::EventData::new_u64(1), epoll::EventFlags::IN)?;
    }
    if let Some(seat) = seat {
        epoll::add(&wake, seat.bell(), epoll::EventData::new_u64(2), epoll::EventFlags::IN)?;
    }
    Ok(wake)
}

/// A connector with its mode and settings, and what was read back of them.
struct Ready {
    pipe: Pipe,
    mode: Mode,
    buffer_property: property::Handle,
    link_status: Option<LinkStatus>,
    monitor: Option<Monitor>,
    changes: Vec<Change>,
    checks: Vec<DisplayCheck>,
}

impl Ready {
    /// Sets mode and settings with `buffer` on the screen, and reads them back.
    fn make(card: &Card, seen: &SeenConnector, wanted: &Wanted, buffer: &ScanBuffer) -> Result<Self, DrmError> {
        let (pipe, info) = Pipe::find(card, seen, format(wanted.channel_bits))?;
        if info.state() == connector::State::Disconnected {
            return Err(DrmError::Disconnected {
                connector: seen.name.clone(),
                card: card.path().to_owned(),
                there: seen_connectors(Path::new(SYS_CLASS_DRM)),
            });
        }
        let native = seen.edid.as_ref().and_then(|edid| edid.native);
        if let Some(found) = native.filter(|&native| native != wanted.size) {
            return Err(DrmError::OtherSize { connector: seen.name.clone(), found, wanted: wanted.size });
        }
        let mode = mode::choose(info.modes(), wanted.size, wanted.refresh_hz).ok_or_else(|| DrmError::NoSuchMode {
            connector: seen.name.clone(),
            wanted: wanted.size,
            wanted_hz: wanted.refresh_hz,
            offered: mode::list(info.modes()),
        })?;
        let before = pipe.properties(card).map_err(card.refused("reading properties"))?;
        let buffer_property =
            before.plane.handle("FB_ID").ok_or_else(|| card.unsupported("its planes have no buffer"))?;
        let blob = card.create_property_blob(&drm_ffi::drm_mode_modeinfo::from(mode));
        let blob = u64::from(blob.map_err(card.refused("describing the mode"))?);
        let mut request = pipe.mode_request(&before, &mode, blob, buffer.framebuffer, card)?;
        let changes = settings::plan(card, &pipe, &before, wanted.channel_bits);
        settings::add_accepted(card, &mut request, &changes);
        let set = card.atomic_commit(AtomicCommitFlags::ALLOW_MODESET, request);
        // The mode's own reference to it stays.
        let _ = card.destroy_property_blob(blob);
        set.map_err(card.refused("setting the mode"))?;
        let link_status = LinkStatus::of(&before.connector);
        let monitor = Monitor::of(card, &before.connector);
        let mut ready = Self { pipe, mode, buffer_property, link_status, monitor, changes, checks: Vec::new() };
        ready.checks = ready.read_back(card, seen, wanted).inspect_err(|_| settings::restore(card, &ready.changes))?;
        let wrong: Vec<_> = ready.checks.iter().filter(|check| check.verdict == Verdict::Wrong).cloned().collect();
        if !wrong.is_empty() {
            settings::restore(card, &ready.changes);
            return Err(DrmError::NotAsSent { connector: seen.name.clone(), wrong });
        }
        let timing = ready.timing_checks(card);
        ready.checks.extend(timing);
        Ok(ready)
    }

    fn read_back(&self, card: &Card, seen: &SeenConnector, wanted: &Wanted) -> Result<Vec<DisplayCheck>, DrmError> {
        let properties = self.pipe.properties(card).map_err(card.refused("reading properties back"))?;
        let crtc = card.get_crtc(self.pipe.crtc).map_err(card.refused("reading the mode back"))?;
        let size = |size: Resolution| format!("{} by {}", size.width, size.height);
        let mode_words = |mode: &Mode| {
            let hz = mode::refresh_hz(mode);
            format!("{} at {hz:.3} Hz, pixel clock {} kHz", size(mode::resolution(mode)), mode.clock())
        };
        let found = crtc.mode().filter(|_| properties.crtc.value("ACTIVE") == Some(1));
        let opened_by = DisplayCheck {
            name: "card opened by".to_owned(),
            found: card.opened_by(),
            wanted: "a seat, or else holod itself".to_owned(),
            verdict: Verdict::Right,
        };
        let mut checks = vec![
            opened_by,
            DisplayCheck::equal("mode", found.as_ref().map_or("off".to_owned(), mode_words), mode_words(&self.mode)),
            match seen.edid.as_ref().and_then(|edid| edid.native) {
                Some(native) => DisplayCheck::equal("panel's own pixels (EDID)", size(native), size(wanted.size)),
                None => {
                    DisplayCheck::unverified("panel's own pixels (EDID)", "the panel does not say", size(wanted.size))
                }
            },
        ];
        let rectangle =
            |shift: u32, names: [&str; 4]| names.map(|name| properties.plane.value(name).map(|value| value >> shift));
        let words = |rectangle: [Option<u64>; 4]| match rectangle {
            [Some(x), Some(y), Some(width), Some(height)] => format!("{width} by {height} from {x}, {y}"),
            _ => "unknown".to_owned(),
        };
        let whole = format!("{} from 0, 0", size(wanted.size));
        let source = words(rectangle(16, ["SRC_X", "SRC_Y", "SRC_W", "SRC_H"]));
        let shown = words(rectangle(0, ["CRTC_X", "CRTC_Y", "CRTC_W", "CRTC_H"]));
        checks.push(DisplayCheck::equal("pixels taken from the buffer", source, &whole));
        checks.push(DisplayCheck::equal("pixels shown", shown, &whole));
        checks.extend(settings::read_back(&properties, wanted.channel_bits, seen));
        let covers =
            |plane: &plane::Handle| card.get_plane(*plane).is_ok_and(|info| info.crtc() == Some(self.pipe.crtc));
        let covering = self.pipe.other_planes.iter().filter(|plane| covers(plane)).count();
        checks.push(DisplayCheck::equal("cursor and overlay planes", covering, 0));
        Ok(checks)
    }

    /// Whether there are hardware times. Without them the panel still shows, but no laser is lit.
    fn timing_checks(&self, card: &Card) -> Vec<DisplayCheck> {
        let clock = if card.is_monotonic() { "monotonic" } else { "wall clock" };
        let counted = card.next_refresh(&self.pipe).and_then(|first| Ok((first, card.next_refresh(&self.pipe)?)));
        let counter = match counted {
            Ok((first, second)) if second.wrapping_sub(first) >= 1 && second != 0 => "counts".to_owned(),
            Ok((first, _)) => format!("stays at {first}"),
            Err(why) => format!("none ({why})"),
        };
        vec![
            DisplayCheck::equal("clock of flip events", clock, "monotonic"),
            DisplayCheck::equal(&format!("refresh counter of driver `{}`", card.driver()), counter, "counts"),
        ]
    }
}

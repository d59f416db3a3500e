//! A graphics card as its master sees it: the way to one connector, scan-out buffers, flips.

use std::fs::{self, File, OpenOptions};
use std::io::{self, ErrorKind};
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::fs::{MetadataExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};

use drm::buffer::{Buffer as _, DrmFourcc};
use drm::control::atomic::AtomicModeReq;
use drm::control::dumbbuffer::DumbBuffer;
use drm::control::{
    AtomicCommitFlags, Device as ControlDevice, Mode, PlaneType, ResourceHandles, connector, crtc, framebuffer, plane,
    property,
};
use drm::{ClientCapability, Device, DriverCapability, VblankWaitFlags, VblankWaitTarget};
use holod_calibration::{Resolution, is_kept_by_unit};
use memmap2::{MmapMut, MmapOptions};
use rustix::fs::OFlags;
use rustix::io::Errno;

use super::error::DrmError;
use super::find::SeenConnector;
use super::properties::{PipeProperties, Properties};
use super::seat::{Seat, SeatLease};

/// A graphics card whose node is open.
#[derive(Debug)]
pub(crate) struct Card {
    /// Given back before the file is closed.
    lease: Option<SeatLease>,
    file: File,
    path: PathBuf,
    driver: String,
}

impl AsFd for Card {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.file.as_fd()
    }
}

impl Device for Card {}
impl ControlDevice for Card {}

impl Card {
    /// Opens the card at `path`, through `seat` where there is one, and becomes its master.
    pub(crate) fn open(path: &Path, seat: Option<&Seat>) -> Result<Self, DrmError> {
        let (file, lease) = match seat {
            Some(seat) => {
                let not_given = |source| DrmError::NotOfSeat { card: path.to_owned(), source };
                let (file, lease) = seat.open_card(path).map_err(not_given)?;
                (file.into(), Some(lease))
            }
            None => (open_file(path)?, None),
        };
        let mut card = Self { lease, file, path: path.to_owned(), driver: "unknown".to_owned() };
        if let Ok(driver) = card.get_driver() {
            card.driver = driver.name().to_string_lossy().into_owned();
        }
        card.become_master(users_of)?;
        for (capability, lacks) in [
            (ClientCapability::UniversalPlanes, "universal planes"),
            (ClientCapability::Atomic, "atomic mode setting (nvidia-drm needs `modeset=1`)"),
        ] {
            card.set_client_capability(capability, true).map_err(|_| card.unsupported(lacks))?;
        }
        if card.get_driver_capability(DriverCapability::DumbBuffer).unwrap_or(0) == 0 {
            return Err(card.unsupported("dumb buffers"));
        }
        Ok(card)
    }

    /// The path of the card's node, such as `/dev/dri/card0`.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// The name of its driver, such as `amdgpu`.
    pub(crate) fn driver(&self) -> &str {
        &self.driver
    }

    /// Who opened the card: the seat's manager, or holod itself.
    pub(crate) fn opened_by(&self) -> String {
        self.lease.as_ref().map_or("holod itself".to_owned(), |lease| format!("seat `{}`", lease.seat()))
    }

    /// Who opens a card that has no master is its master; after mastership was lost it must be asked for. Of a card
    /// that a seat has opened its manager makes the file master when it opens it and when the session comes to the
    /// front; then it can only be seen whether it did. `users` tells who else has the card open.
    pub(crate) fn become_master(&self, users: impl FnOnce(&Path) -> Vec<String>) -> Result<(), DrmError> {
        let answer = match self.lease {
            None => self.acquire_master_lock(),
            // Only a master may be asked to vouch for another client; nobody has the number 0.
            Some(_) => drm_ffi::auth::auth_magic_token(self.as_fd(), 0).map(drop),
        };
        match mastership(answer, self.lease.is_some()) {
            Mastership::Ours => Ok(()),
            Mastership::OfAnother => Err(DrmError::OtherMaster { card: self.path.clone(), who: users(&self.path) }),
            Mastership::Refused(why) => Err(self.refused("becoming its master")(why)),
        }
    }

    /// Whether flips are stamped by the monotonic clock.
    pub(crate) fn is_monotonic(&self) -> bool {
        self.get_driver_capability(DriverCapability::MonotonicTimestamp).is_ok_and(|value| value == 1)
    }

    pub(crate) fn unsupported(&self, lacks: impl Into<String>) -> DrmError {
        DrmError::Unsupported { card: self.path.clone(), driver: self.driver.clone(), lacks: lacks.into() }
    }

    pub(crate) fn refused(&self, what: &'static str) -> impl Fn(io::Error) -> DrmError {
        move |source| DrmError::Refused { what, card: self.path.clone(), source }
    }

    /// Asks the monitor at `connector` anew; takes no memory.
    pub(crate) fn is_connected(&self, connector: connector::Handle) -> io::Result<bool> {
        let ask = || drm_ffi::mode::get_connector(self.as_fd(), connector.into(), None, None, None, None, true);
        let found = uninterrupted(ask)?;
        Ok(connector::State::from(found.connection) != connector::State::Disconnected)
    }

    /// The counter of refreshes once it has risen; waits up to two refreshes.
    pub(crate) fn next_refresh(&self, pipe: &Pipe) -> io::Result<u32> {
        let target = VblankWaitTarget::Relative(1);
        self.wait_vblank(target, VblankWaitFlags::empty(), pipe.crtc_index, 0).map(|reply| reply.frame())
    }
}

/// What came of asking to be a card's master.
#[derive(Debug)]
enum Mastership {
    Ours,
    OfAnother,
    /// For another reason, such as that the card is gone.
    Refused(io::Error),
}

/// What the kernel's `answer` says of mastership: to a client that asked for it, or to one that a seat has opened and
/// that asked for the client with the number 0.
fn mastership(answer: io::Result<()>, of_seat: bool) -> Mastership {
    let Err(why) = answer else { return Mastership::Ours };
    match Errno::from_io_error(&why) {
        // A master hears that there is no such client.
        Some(Errno::INVAL) if of_seat => Mastership::Ours,
        Some(Errno::BUSY | Errno::ACCESS | Errno::PERM | Errno::INVAL) => Mastership::OfAnother,
        _ => Mastership::Refused(why),
    }
}

fn open_file(path: &Path) -> Result<File, DrmError> {
    let flags = (OFlags::NONBLOCK | OFlags::CLOEXEC).bits() as i32;
    OpenOptions::new().read(true).write(true).custom_flags(flags).open(path).map_err(|source| not_opened(path, source))
}

fn not_opened(path: &Path, source: io::Error) -> DrmError {
    match source.kind() {
        ErrorKind::PermissionDenied if is_kept_by_unit(&source) => DrmError::NotAllowed { card: path.to_owned() },
        ErrorKind::PermissionDenied => permission(path),
        _ => DrmError::Refused { what: "opening", card: path.to_owned(), source },
    }
}

/// Who may open `path` instead.
fn permission(path: &Path) -> DrmError {
    let metadata = fs::metadata(path).ok();
    let id = metadata.as_ref().map_or(0, |metadata| metadata.gid());
    let groups = fs::read_to_string("/etc/group").unwrap_or_default();
    let name = groups.lines().find_map(|line| {
        let mut fields = line.split(':');
        let name = fields.next()?;
        (fields.nth(1)?.parse() == Ok(id)).then(|| name.to_owned())
    });
    DrmError::Permission {
        card: path.to_owned(),
        group: name.unwrap_or_else(|| id.to_string()),
        mode: metadata.map_or(0, |metadata| metadata.mode() & 0o7777),
        kernel: path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default(),
    }
}

/// Processes that have the card at `path` open, other than this one. Root sees all of them and which one is its master,
/// others only their own.
fn users_of(path: &Path) -> Vec<String> {
    let own = std::process::id();
    let master = master_by_debugfs(path);
    let mut users = Vec::new();
    for entry in fs::read_dir("/proc").into_iter().flatten().flatten() {
        let Some(id) = entry.file_name().to_str().and_then(|name| name.parse::<u32>().ok()) else { continue };
        let open = fs::read_dir(entry.path().join("fd")).into_iter().flatten().flatten();
        if id == own || !open.into_iter().any(|fd| fs::read_link(fd.path()).is_ok_and(|target| target == path)) {
            continue;
        }
        let name = fs::read_to_string(entry.path().join("comm")).unwrap_or_default();
        let user = format!("{} (process {id})", name.trim());
        let place = if master == Some(id) { 0 } else { users.len() };
        users.insert(place, user);
    }
    users
}

/// The master's process, from the kernel's table of a card's clients.
fn master_by_debugfs(path: &Path) -> Option<u32> {
    let minor = rustix::fs::minor(fs::metadata(path).ok()?.rdev());
    let table = fs::read_to_string(format!("/sys/kernel/debug/dri/{minor}/clients")).ok()?;
    let mut lines = table.lines();
    let titles: Vec<_> = lines.next()?.split_whitespace().collect();
    let master = titles.iter().position(|&title| title == "master")?;
    lines.find_map(|line| {
        let fields: Vec<_> = line.split_whitespace().collect();
        // The command comes first and may hold blanks; the process comes second.
        let blanks = fields.len().checked_sub(titles.len())?;
        (fields[master + blanks] == "y").then(|| fields[1 + blanks].parse().ok())?
    })
}

/// The objects on the way from a buffer to the connector.
#[derive(Clone, Debug)]
pub(crate) struct Pipe {
    pub(crate) connector: connector::Handle,
    pub(crate) crtc: crtc::Handle,
    /// The controller's number, by which its refreshes are asked for.
    pub(crate) crtc_index: u32,
    pub(crate) plane: plane::Handle,
    /// Cursor and overlay planes that the controller may blend over the picture.
    pub(crate) other_planes: Vec<plane::Handle>,
}

impl Pipe {
    /// The properties of its three objects as they are now.
    pub(crate) fn properties(&self, card: &Card) -> io::Result<PipeProperties> {
        PipeProperties::of(card, self.connector, self.crtc, self.plane)
    }

    /// The way to the connector `seen`, with what it says of its modes now.
    pub(crate) fn find(
        card: &Card,
        seen: &SeenConnector,
        format: DrmFourcc,
    ) -> Result<(Self, connector::Info), DrmError> {
        let resources = card.resource_handles().map_err(card.refused("listing connectors"))?;
        let mut connectors = resources.connectors().iter().filter_map(|&handle| card.get_connector(handle, false).ok());
        let named = connectors.find(|info| info.to_string() == seen.name).map(|info| info.handle());
        let named = named.ok_or_else(|| card.unsupported(format!("its connector {} is gone", seen.name)))?;
        let connector = card.get_connector(named, true).map_err(card.refused("asking the monitor"))?;
        let (index, crtc) = free_controller(card, &resources, &connector)?.ok_or_else(|| {
            card.unsupported(format!("every controller that {} can use drives another one", seen.name))
        })?;
        let (mut primary, mut other_planes) = (None, Vec::new());
        for handle in card.plane_handles().map_err(card.refused("listing planes"))? {
            let info = card.get_plane(handle).map_err(card.refused("listing planes"))?;
            if !resources.filter_crtcs(info.possible_crtcs()).contains(&crtc) {
                continue;
            }
            let properties = Properties::of(card, handle).map_err(card.refused("listing planes"))?;
            let usable = info.formats().contains(&(format as u32)) && info.crtc().is_none_or(|user| user == crtc);
            let is_primary = properties.value("type") == Some(PlaneType::Primary as u64);
            if is_primary && usable && primary.is_none() {
                primary = Some(handle);
            } else if info.crtc() == Some(crtc) {
                other_planes.push(handle);
            }
        }
        let plane =
            primary.ok_or_else(|| card.unsupported(format!("{} has no primary plane for {format:?}", seen.name)))?;
        Ok((Self { connector: named, crtc, crtc_index: index as u32, plane, other_planes }, connector))
    }

    /// A request that shows `buffer` on the whole of the connector in `mode`, and nothing else.
    pub(crate) fn mode_request(
        &self,
        properties: &PipeProperties,
        mode: &Mode,
        mode_blob: u64,
        buffer: framebuffer::Handle,
        card: &Card,
    ) -> Result<AtomicModeReq, DrmError> {
        let mut request = AtomicModeReq::new();
        let need = |found: Option<property::Handle>, name: &str| {
            found.ok_or_else(|| card.unsupported(format!("its property `{name}`")))
        };
        let (width, height) = mode.size();
        let crtc = u64::from(u32::from(self.crtc));
        request.add_raw_property(self.connector.into(), need(properties.connector.handle("CRTC_ID"), "CRTC_ID")?, crtc);
        for (name, value) in [("MODE_ID", mode_blob), ("ACTIVE", 1)] {
            request.add_raw_property(self.crtc.into(), need(properties.crtc.handle(name), name)?, value);
        }
        for (name, value) in [
            ("FB_ID", u64::from(u32::from(buffer))),
            ("CRTC_ID", crtc),
            ("SRC_X", 0),
            ("SRC_Y", 0),
            ("SRC_W", u64::from(width) << 16),
            ("SRC_H", u64::from(height) << 16),
            ("CRTC_X", 0),
            ("CRTC_Y", 0),
            ("CRTC_W", u64::from(width)),
            ("CRTC_H", u64::from(height)),
        ] {
            request.add_raw_property(self.plane.into(), need(properties.plane.handle(name), name)?, value);
        }
        for &other in &self.other_planes {
            let other_properties = Properties::of(card, other).map_err(card.refused("listing planes"))?;
            for name in ["FB_ID", "CRTC_ID"] {
                request.add_raw_property(other.into(), need(other_properties.handle(name), name)?, 0);
            }
        }
        Ok(request)
    }
}

/// A controller for `connector` that drives no other one; the one that drives it already, where there is one.
fn free_controller(
    card: &Card,
    resources: &ResourceHandles,
    connector: &connector::Info,
) -> Result<Option<(usize, crtc::Handle)>, DrmError> {
    let driven = |handle: connector::Handle| {
        let properties = Properties::of(card, handle).map_err(card.refused("reading a connector"))?;
        Ok::<_, DrmError>(properties.value("CRTC_ID").unwrap_or(0))
    };
    let own = driven(connector.handle())?;
    let mut taken = Vec::new();
    for &other in resources.connectors() {
        if other != connector.handle() {
            taken.push(driven(other)?);
        }
    }
    let mut possible = Vec::new();
    for &encoder in connector.encoders() {
        let encoder = card.get_encoder(encoder).map_err(card.refused("reading an encoder"))?;
        possible.extend(resources.filter_crtcs(encoder.possible_crtcs()));
    }
    let id = |crtc: crtc::Handle| u64::from(u32::from(crtc));
    possible.sort_by_key(|&crtc| id(crtc) != own);
    let free = possible.into_iter().find(|&crtc| !taken.contains(&id(crtc)));
    Ok(free.and_then(|crtc| Some((resources.crtcs().iter().position(|&other| other == crtc)?, crtc))))
}

/// A buffer that the controller scans out, in the processor's memory.
#[derive(Debug)]
pub(crate) struct ScanBuffer {
    pub(crate) framebuffer: framebuffer::Handle,
    dumb: DumbBuffer,
    pixels: MmapMut,
}

impl ScanBuffer {
    /// A black buffer of 32 bits a pixel. The card frees it when it is closed.
    pub(crate) fn new(card: &Card, size: Resolution, format: DrmFourcc) -> Result<Self, DrmError> {
        let refused = card.refused("making a scan-out buffer");
        let dumb = card.create_dumb_buffer((size.width as u32, size.height as u32), format, 32).map_err(&refused)?;
        let depth = if format == DrmFourcc::Xrgb2101010 { 30 } else { 24 };
        let framebuffer = card.add_framebuffer(&dumb, depth, 32).map_err(&refused)?;
        let place = drm_ffi::mode::dumbbuffer::map(card.as_fd(), u32::from(dumb.handle()), 0, 0).map_err(&refused)?;
        let length = dumb.pitch() as usize * size.height;
        // SAFETY: the memory belongs to the buffer, which nobody else has a handle of, and stays mapped until it is
        // dropped; the display controller only reads it.
        let pixels = unsafe { MmapOptions::new().offset(place.offset).len(length).map_mut(&card.file) };
        let mut pixels = pixels.map_err(&refused)?;
        pixels.fill(0);
        Ok(Self { framebuffer, dumb, pixels })
    }

    /// The rows, and how many bytes lie from one to the next.
    pub(crate) fn rows(&mut self) -> (&mut [u8], usize) {
        (&mut self.pixels, self.dumb.pitch() as usize)
    }
}

/// Asks for another buffer at the next refresh, and for the event that says when it came. Takes no memory.
pub(crate) fn flip(
    card: &Card,
    plane: plane::Handle,
    buffer_property: property::Handle,
    buffer: framebuffer::Handle,
) -> Result<(), Errno> {
    let flags = AtomicCommitFlags::PAGE_FLIP_EVENT | AtomicCommitFlags::NONBLOCK;
    let commit = || {
        drm_ffi::mode::atomic_commit(
            card.as_fd(),
            flags.bits(),
            &mut [plane.into()],
            &mut [1],
            &mut [buffer_property.into()],
            &mut [u64::from(u32::from(buffer))],
        )
    };
    uninterrupted(commit).map_err(|why| Errno::from_io_error(&why).unwrap_or(Errno::IO))
}

/// How often a call is made that is interrupted each time: no storm of signals lasts so long.
const CALLS: usize = 1000;

/// Calls the kernel until a signal or a lock that another task holds no longer keeps it from an answer, as the contract
/// of these calls asks for.
fn uninterrupted<T>(mut call: impl FnMut() -> io::Result<T>) -> io::Result<T> {
    for _ in 1..CALLS {
        match call() {
            Err(why) if matches!(Errno::from_io_error(&why), Some(Errno::INTR | Errno::AGAIN)) => {}
            answer => return answer,
        }
    }
    call()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_card_that_the_unit_keeps_is_told_from_one_of_another_group() {
        let says = |errno: Errno| not_opened(Path::new("/dev/dri/card7"), errno.into()).to_string();
        assert!(says(Errno::PERM).contains("/dev/dri/card7 does not open: the service's unit does not allow"));
        assert!(says(Errno::ACCESS).contains("permission denied. It belongs to group"));
        assert!(says(Errno::NODEV).contains("opening on /dev/dri/card7"));
    }

    #[test]
    fn another_master_is_told_from_a_card_that_is_gone() {
        let answered = |errno: Errno, of_seat| mastership(Err(errno.into()), of_seat);
        for of_seat in [false, true] {
            assert!(matches!(mastership(Ok(()), of_seat), Mastership::Ours));
            for errno in [Errno::BUSY, Errno::ACCESS, Errno::PERM] {
                assert!(matches!(answered(errno, of_seat), Mastership::OfAnother), "{errno}");
            }
            for errno in [Errno::NODEV, Errno::NXIO, Errno::IO] {
                assert!(matches!(answered(errno, of_seat), Mastership::Refused(_)), "{errno}");
            }
        }
        assert!(matches!(answered(Errno::INVAL, false), Mastership::OfAnother), "a lessee");
        assert!(matches!(answered(Errno::INVAL, true), Mastership::Ours), "no client has the number 0");
    }

    #[test]
    fn a_call_that_is_interrupted_is_made_again_and_a_refusal_is_handed_on() {
        for last in [Ok(7), Err(Errno::BUSY), Err(Errno::INVAL)] {
            let mut answers = [Err(Errno::INTR), Err(Errno::AGAIN), Err(Errno::INTR), last].into_iter();
            let answer = uninterrupted(|| answers.next().expect("no call more").map_err(io::Error::from));
            assert_eq!(answer.map_err(|why| Errno::from_io_error(&why).unwrap()), last);
            assert_eq!(answers.next(), None);
        }
        let mut calls = 0;
        let answer: io::Result<()> = uninterrupted(|| {
            calls += 1;
            Err(Errno::INTR.into())
        });
        assert_eq!((Errno::from_io_error(&answer.unwrap_err()), calls), (Some(Errno::INTR), CALLS));
    }
}

//! A panel on a connector of a graphics card, without a display server: atomic kernel mode setting.
//!
//! [`DrmPanel`] rules the card while it runs; where there is a seat manager, that opens it ([`seat`](self)). It finds
//! the connector by its name or its monitor ([`find`](self)), sets the panel's own mode and everything that keeps
//! levels from being changed on the way ([`DisplayCheck`]), and then flips once every refresh between four buffers,
//! also where no newer frame has come, so that each refresh is proven by an event of its own. What an event says is
//! judged by [`FlipClock`]; the frame for the next refresh is chosen as late as [`CommitMargin`] thinks safe.
//!
//! `slm-output/doc/drm.md` says how to give holod a connector and which drivers are known to tell wrong times.

mod card;
mod check;
mod edid;
mod error;
mod event;
mod find;
mod hotplug;
mod link;
mod margin;
mod mode;
mod monitor;
mod properties;
#[cfg(feature = "seat")]
mod seat;
#[cfg(not(feature = "seat"))]
#[path = "no_seat.rs"]
mod seat;
mod settings;
mod target;
mod timing;

pub use check::{DisplayCheck, Verdict};
pub use edid::Edid;
pub use error::DrmError;
pub use find::{ConnectorList, SeenConnector};
#[cfg(feature = "window")]
pub(crate) use find::{SYS_CLASS_DRM, seen_connectors};
pub use margin::CommitMargin;
pub use target::DrmTarget;
pub use timing::{FlipClock, FlipFaults, FlipStamp, Refresh};

use std::os::fd::BorrowedFd;

use holod_calibration::{TimeNs, host_now};
use rustix::io::Errno;

use super::{FrameSource, PanelFault, PanelSetup, PresentedRefresh, Presenter, TimestampSource};
use crate::fields::{FrameTag, LevelsFrame};
use crate::packing::{PixelFormat, write_frame};
use card::ScanBuffer;
use event::Uevent;
use link::{BUFFERS, Found, Link, Wanted};
use seat::{Seat, Standing};

/// A flip that has not come after this time never will.
const FLIP_WAIT: TimeNs = TimeNs(500_000_000);

/// A panel on a connector of a graphics card.
///
/// A refresh is reported once its time has come: drivers report a flip when the blank before it begins. A refresh on
/// which a flip came too late is not reported; it shows in the count of the next one.
#[derive(Debug)]
pub struct DrmPanel {
    wanted: Wanted,
    /// Closed before the seat is.
    link: Option<Link>,
    /// Whose manager opened the card.
    seat: Option<Seat>,
    period: TimeNs,
    clock: FlipClock,
    margin: CommitMargin,
    flat: LevelsFrame,
    flat_wanted: bool,
    /// The levels of the frame that was reported last, and of the one that is on its way.
    shown: LevelsFrame,
    sent: LevelsFrame,
    on_screen: Picture,
    /// What is on its way to the screen, and since when.
    under_way: Option<(Picture, TimeNs)>,
    /// What could not be sent because the kernel had not finished with the last one.
    refused: Option<Picture>,
    /// The last buffer that was written.
    written: usize,
    /// When the next picture is chosen.
    t_choose: TimeNs,
    held: Option<PresentedRefresh>,
    lost: Option<PanelFault>,
}

/// What one video frame shows.
#[derive(Clone, Copy, Debug)]
struct Picture {
    frame: Option<FrameTag>,
    /// Position of the refresh in its colour frame.
    refresh: usize,
    repeated: bool,
    /// The frame's levels are still in `sent`.
    fresh: bool,
    buffer: usize,
}

impl DrmPanel {
    /// Opens the connector that `target` names for the panel of `setup`, and shows the flat pattern there.
    ///
    /// # Errors
    /// [`DrmError`]: there is no such connector, it has another panel, or it may not be used.
    pub fn open(target: &DrmTarget, setup: &PanelSetup) -> Result<Self, DrmError> {
        let layout = setup.flat.layout();
        let wanted = Wanted {
            target: target.clone(),
            size: layout.video_resolution(),
            refresh_hz: setup.panel.refresh_hz,
            channel_bits: layout.packing.channel_bits(),
        };
        let write_flat = |buffer: &mut ScanBuffer| write(buffer, &setup.flat, 0);
        let mut seat = Seat::open();
        let mut link = Link::open(&wanted, seat.as_ref(), write_flat);
        if matches!(link, Err(DrmError::NotOfSeat { .. })) {
            // The card of another seat is one like any other.
            seat = None;
            link = Link::open(&wanted, None, write_flat);
        }
        let link = link?;
        let (period, blank) = (link.period(), link.blank());
        Ok(Self {
            wanted,
            period,
            clock: FlipClock::new(period, blank, link.is_monotonic()),
            margin: CommitMargin::new(period, blank),
            link: Some(link),
            seat,
            flat: setup.flat.clone(),
            flat_wanted: false,
            shown: setup.flat.clone(),
            sent: setup.flat.clone(),
            on_screen: Picture::first(layout.refreshes()),
            under_way: None,
            refused: None,
            written: 0,
            t_choose: host_now(),
            held: None,
            lost: None,
        })
    }

    /// How often a flip event was not believed, by reason.
    pub fn flip_faults(&self) -> FlipFaults {
        self.clock.faults()
    }

    fn link(&self) -> Result<&Link, PanelFault> {
        self.link.as_ref().ok_or(PanelFault::DeviceLost)
    }

    fn run(
        &mut self,
        now: TimeNs,
        frames: &mut FrameSource,
        presented: &mut dyn FnMut(PresentedRefresh),
    ) -> Result<(), PanelFault> {
        self.report_held(now, presented);
        match self.seat.as_ref().map(Seat::standing) {
            None | Some(Standing::InFront) => {}
            Some(Standing::Gone) => return Err(PanelFault::DeviceLost),
            Some(Standing::Leaving | Standing::Behind) => return Err(PanelFault::SwitchedAway),
        }
        match self.link()?.hotplug() {
            Uevent::Removed => return Err(PanelFault::DeviceLost),
            Uevent::Changed if !self.link()?.is_connected().map_err(fault_of)? => return Err(PanelFault::Unplugged),
            Uevent::Changed => {
                let link = self.link.as_mut().ok_or(PanelFault::DeviceLost)?;
                match link.found().map_err(fault_of)? {
                    Found::Good => {}
                    Found::BadLink => return Err(PanelFault::LinkBad),
                    Found::OtherMonitor => return Err(PanelFault::Unplugged),
                }
            }
            Uevent::Other => {}
        }
        for &stamp in self.link()?.flips().map_err(fault_of)?.stamps() {
            self.on_flip(stamp, now, presented);
        }
        match self.under_way {
            Some((_, t_sent)) if now >= t_sent + FLIP_WAIT => Err(PanelFault::DeviceLost),
            Some(_) => Ok(()),
            None if now >= self.t_choose => self.send(now, frames),
            None => Ok(()),
        }
    }

    fn on_flip(&mut self, stamp: FlipStamp, now: TimeNs, presented: &mut dyn FnMut(PresentedRefresh)) {
        // Without a flip under way it is the event of an earlier one, once more.
        let Some((picture, t_sent)) = self.under_way else { return };
        let Some(refresh) = self.clock.judge(stamp, now) else { return };
        self.under_way = None;
        self.on_screen = picture;
        if picture.fresh {
            std::mem::swap(&mut self.shown, &mut self.sent);
            self.on_screen.fresh = false;
        }
        if refresh.missed > 0 {
            self.margin.missed();
        }
        self.t_choose = self.margin.t_choose(refresh.t_present + self.period).max(t_sent);
        if refresh.timestamp_source != TimestampSource::Hardware {
            // Of two flips within half a refresh the clock takes the second for the first one's event, once more.
            self.t_choose = self.t_choose.max(TimeNs(refresh.t_present.0 + 5 * self.period.0 / 8));
        }
        if let Some(held) = self.held.take() {
            presented(held);
        }
        self.held = Some(PresentedRefresh {
            frame: picture.frame,
            field: picture.refresh * self.flat.layout().fields_per_refresh(),
            repeated: picture.repeated,
            t_present: refresh.t_present,
            timestamp_source: refresh.timestamp_source,
            refresh_count: refresh.refresh_count,
        });
        self.report_held(now, presented);
    }

    fn report_held(&mut self, now: TimeNs, presented: &mut dyn FnMut(PresentedRefresh)) {
        if let Some(held) = self.held.take_if(|held| held.t_present <= now) {
            presented(held);
        }
    }

    /// Chooses the next picture, writes it and asks for it.
    fn send(&mut self, now: TimeNs, frames: &mut FrameSource) -> Result<(), PanelFault> {
        let picture = match self.refused.take() {
            Some(picture) => picture,
            None => self.choose(frames)?,
        };
        match self.link()?.flip(picture.buffer) {
            Ok(()) => {
                self.margin.learn(self.t_choose, now, host_now());
                self.under_way = Some((picture, now));
                Ok(())
            }
            // An event came before its flip was done.
            Err(Errno::BUSY) => {
                self.refused = Some(picture);
                self.t_choose = TimeNs(now.0 + self.period.0 / 16);
                Ok(())
            }
            Err(why) => Err(fault_of(why)),
        }
    }

    /// The picture for the next refresh: a new one, or what is on the screen once more.
    fn choose(&mut self, frames: &mut FrameSource) -> Result<Picture, PanelFault> {
        let refreshes = self.flat.layout().refreshes();
        let refresh = (self.on_screen.refresh + 1) % refreshes;
        let mut next = Picture { refresh, fresh: false, ..self.on_screen };
        if refresh == 0 {
            next.repeated = next.frame.is_some();
            if self.flat_wanted {
                (next.frame, next.repeated) = (None, false);
            } else if frames.update() {
                std::mem::swap(&mut self.sent, frames.current_mut());
                (next.frame, next.repeated, next.fresh) = (Some(self.sent.tag()), false, true);
            }
        }
        let same_frame =
            next.frame.map(|tag| tag.frame_id) == self.on_screen.frame.map(|tag| tag.frame_id) && !next.fresh;
        if same_frame && refreshes == 1 {
            return Ok(next);
        }
        // The one after the last one: not on the screen, and not read any more even where an event came early.
        self.written = (self.written + 1) % BUFFERS;
        next.buffer = self.written;
        let link = self.link.as_mut().ok_or(PanelFault::DeviceLost)?;
        let levels = match next.frame {
            None => &self.flat,
            Some(_) if next.fresh => &self.sent,
            Some(_) => &self.shown,
        };
        write(&mut link.buffers[next.buffer], levels, refresh);
        Ok(next)
    }

    /// Whether the panel may be taken back as far as the seat goes. Lasers have been told of the loss by now, so the
    /// seat may be left to another session.
    fn follow_seat(&mut self) -> Result<(), PanelFault> {
        match self.seat.as_ref().map(Seat::standing) {
            None | Some(Standing::InFront) => Ok(()),
            Some(Standing::Leaving | Standing::Behind) => {
                self.seat.as_ref().inspect(|seat| seat.leave());
                Err(PanelFault::SwitchedAway)
            }
            Some(Standing::Gone) => {
                self.lost = Some(PanelFault::DeviceLost);
                Ok(())
            }
        }
    }

    fn take_back(&mut self) -> Result<(), DrmError> {
        let Self { wanted, link, seat, flat, .. } = self;
        let write_flat = |buffer: &mut ScanBuffer| write(buffer, flat, 0);
        match link {
            Some(link) if self.lost != Some(PanelFault::DeviceLost) => link.reopen(wanted, write_flat),
            _ => {
                // Closed first: a card has one master.
                *link = None;
                let is_there = |seat: &&Seat| seat.standing() != Standing::Gone;
                if seat.as_ref().is_some_and(|seat| !is_there(&seat)) {
                    // Of a seat manager that was started anew. Until there is one the card is tried as it is.
                    *seat = Seat::open().or(seat.take());
                }
                let manager = seat.as_ref().filter(is_there);
                *link = Some(Link::open(wanted, manager, write_flat)?);
                *seat = seat.take().filter(|seat| is_there(&seat));
                Ok(())
            }
        }
    }
}

impl Presenter for DrmPanel {
    fn is_virtual(&self) -> bool {
        false
    }

    fn wake_fd(&self) -> Option<BorrowedFd<'_>> {
        self.link.as_ref().map(Link::wake_fd)
    }

    fn t_next(&self) -> TimeNs {
        let next = match self.under_way {
            Some((_, t_sent)) => t_sent + FLIP_WAIT,
            None => self.t_choose,
        };
        self.held.map_or(next, |held| held.t_present.min(next))
    }

    fn tick(
        &mut self,
        now: TimeNs,
        frames: &mut FrameSource,
        presented: &mut dyn FnMut(PresentedRefresh),
    ) -> Result<(), PanelFault> {
        if self.lost.is_none() {
            self.lost = self.run(now, frames, presented).err();
        }
        self.lost.map_or(Ok(()), Err)
    }

    fn show_flat(&mut self) {
        self.flat_wanted = true;
    }

    fn recover(&mut self, now: TimeNs) -> Result<(), PanelFault> {
        self.follow_seat()?;
        // What was said meanwhile: a card that went away does not come back, though another may have its node by now.
        if self.link.as_ref().is_some_and(|link| link.hotplug() == Uevent::Removed) {
            self.lost = Some(PanelFault::DeviceLost);
        }
        if let Err(why) = self.take_back() {
            let fault = why.fault();
            // What is gone is opened anew from now on; and so is what another program is master of where only the
            // seat's manager can ask for it, which it does when it opens it.
            if fault == PanelFault::DeviceLost || (fault == PanelFault::MastershipLost && self.seat.is_some()) {
                self.lost = Some(PanelFault::DeviceLost);
            }
            return Err(fault);
        }
        let link = self.link()?;
        // What the card had still to say is of the time before.
        link.flips().map_err(fault_of)?;
        let (period, blank, monotonic) = (link.period(), link.blank(), link.is_monotonic());
        self.period = period;
        self.clock = FlipClock::new(period, blank, monotonic);
        self.margin = CommitMargin::new(period, blank);
        self.on_screen = Picture::first(self.flat.layout().refreshes());
        (self.under_way, self.refused, self.held, self.lost) = (None, None, None, None);
        (self.written, self.t_choose) = (0, now);
        Ok(())
    }

    fn checks(&self) -> &[DisplayCheck] {
        self.link.as_ref().map_or(&[], Link::checks)
    }

    fn shown(&self) -> Option<&LevelsFrame> {
        self.on_screen.frame.map(|_| &self.shown)
    }
}

impl Picture {
    /// The flat pattern in the first buffer, as the last refresh of a colour frame.
    fn first(refreshes: usize) -> Self {
        Self { frame: None, refresh: refreshes - 1, repeated: false, fresh: false, buffer: 0 }
    }
}

/// Writes what `levels` show at the `refresh`-th refresh of a colour frame.
fn write(buffer: &mut ScanBuffer, levels: &LevelsFrame, refresh: usize) {
    let layout = levels.layout();
    let format = if layout.packing.channel_bits() == 10 { PixelFormat::Xrgb10 } else { PixelFormat::Bgrx8 };
    let (pixels, pitch) = buffer.rows();
    write_frame(levels, refresh * layout.fields_per_refresh(), format, pitch, pixels);
}

/// What a refusal of the kernel means for a panel that was shown on.
fn fault_of(why: Errno) -> PanelFault {
    match why {
        Errno::ACCESS | Errno::PERM => PanelFault::MastershipLost,
        Errno::NODEV | Errno::NXIO | Errno::IO | Errno::NOENT => PanelFault::DeviceLost,
        Errno::INVAL | Errno::NOSPC | Errno::RANGE => PanelFault::ModeRefused,
        other => PanelFault::System(other),
    }
}

impl DrmError {
    /// What a panel that is being taken back reports; always something that may pass.
    fn fault(&self) -> PanelFault {
        match self {
            Self::OtherMaster { .. } => PanelFault::MastershipLost,
            Self::Disconnected { .. } | Self::NoSuchConnector { .. } | Self::Ambiguous { .. } => PanelFault::Unplugged,
            Self::OtherSize { .. } | Self::NoSuchMode { .. } | Self::NotAsSent { .. } => PanelFault::ModeRefused,
            Self::NoCard { .. }
            | Self::Permission { .. }
            | Self::NotAllowed { .. }
            | Self::NotOfSeat { .. }
            | Self::Unsupported { .. } => PanelFault::DeviceLost,
            Self::Refused { source, .. } => match Errno::from_io_error(source).map(fault_of) {
                Some(fault) if fault.is_recoverable() => fault,
                _ => PanelFault::DeviceLost,
            },
        }
    }
}

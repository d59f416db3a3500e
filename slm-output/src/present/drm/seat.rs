//! A seat: which session sits at the machine's screens, and so may rule their cards. The seat manager (seatd or logind)
//! opens the card, makes its file master, and takes mastership away and gives it back when terminals are switched.
//!
//! libseat may wait and takes memory, so the seat lives on a thread of its own, and the panel's thread reads an atomic.

use std::io;
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, FromRawFd, OwnedFd};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::mpsc::{Receiver, Sender, SyncSender, channel, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use libseat::{Device, SeatEvent};
use rustix::event::{EventfdFlags, PollFd, PollFlags, eventfd, poll};

/// A seat that has not said after this time that this session is in front is switched to another one.
const ENABLE_WAIT: Duration = Duration::from_secs(1);

/// What the seat manager said last.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub(crate) enum Standing {
    /// Another session is in front.
    Behind,
    /// Another session comes to the front once [`Seat::leave`] has said that this one has put its lasers out.
    Leaving,
    /// This session is in front, and its card is master.
    InFront,
    /// The seat manager has ended.
    Gone,
}

/// The seat that this process has a session on.
#[derive(Debug)]
pub(crate) struct Seat {
    name: String,
    shared: Arc<Shared>,
    orders: Sender<Order>,
    thread: Option<JoinHandle<()>>,
}

/// A card that the seat has opened, until this is dropped; then its file may be closed, and not before.
#[derive(Debug)]
pub(crate) struct SeatLease {
    seat: String,
    shared: Arc<Shared>,
    orders: Sender<Order>,
}

#[derive(Debug)]
struct Shared {
    standing: AtomicU8,
    /// Readable while this session is not in front.
    bell: OwnedFd,
    /// Wakes the seat's thread.
    order: OwnedFd,
}

#[derive(Debug)]
enum Order {
    Open(PathBuf, SyncSender<io::Result<OwnedFd>>),
    Close(SyncSender<()>),
    Leave,
    End,
}

impl Seat {
    /// The seat, where there is one and this process's session is in front.
    pub(crate) fn open() -> Option<Self> {
        // Unasked, libseat would fork a seat manager out of a process of root's, and root may use any card as it is.
        if rustix::process::geteuid().is_root() && std::env::var_os("LIBSEAT_BACKEND").is_none() {
            return None;
        }
        let descriptor = || eventfd(0, EventfdFlags::NONBLOCK | EventfdFlags::CLOEXEC).ok();
        let standing = AtomicU8::new(Standing::Behind as u8);
        let shared = Arc::new(Shared { standing, bell: descriptor()?, order: descriptor()? });
        let (orders, ordered) = channel();
        let (opened, name) = sync_channel(1);
        let its_shared = shared.clone();
        let hold = move || hold(&its_shared, &ordered, &opened);
        let thread = std::thread::Builder::new().name("holod-seat".into()).spawn(hold).ok()?;
        let name = name.recv().ok()?;
        Some(Self { name, shared, orders, thread: Some(thread) })
    }

    pub(crate) fn standing(&self) -> Standing {
        self.shared.standing()
    }

    /// Readable while this session is not in front.
    pub(crate) fn bell(&self) -> BorrowedFd<'_> {
        self.shared.bell.as_fd()
    }

    /// Opens a card. Its file is master, if nobody outside the seat is, for as long as this session is in front.
    pub(crate) fn open_card(&self, path: &Path) -> io::Result<(OwnedFd, SeatLease)> {
        let (reply, file) = sync_channel(1);
        self.shared.give(&self.orders, Order::Open(path.to_owned(), reply));
        let file = file.recv().unwrap_or_else(|_| Err(io::ErrorKind::NotConnected.into()))?;
        let lease = SeatLease { seat: self.name.clone(), shared: self.shared.clone(), orders: self.orders.clone() };
        Ok((file, lease))
    }

    /// Lets the other session come to the front.
    pub(crate) fn leave(&self) {
        self.shared.give(&self.orders, Order::Leave);
    }
}

impl Drop for Seat {
    fn drop(&mut self) {
        self.shared.give(&self.orders, Order::End);
        if let Some(thread) = self.thread.take() {
            let _ended = thread.join();
        }
    }
}

impl SeatLease {
    /// The name of the seat, such as `seat0`.
    pub(crate) fn seat(&self) -> &str {
        &self.seat
    }
}

impl Drop for SeatLease {
    fn drop(&mut self) {
        let (reply, closed) = sync_channel(1);
        self.shared.give(&self.orders, Order::Close(reply));
        let _closed = closed.recv();
    }
}

impl Shared {
    fn standing(&self) -> Standing {
        let code = self.standing.load(Ordering::Acquire);
        let known = [Standing::Behind, Standing::Leaving, Standing::InFront];
        known.into_iter().find(|&known| known as u8 == code).unwrap_or(Standing::Gone)
    }

    fn set(&self, standing: Standing) {
        self.standing.store(standing as u8, Ordering::Release);
        if standing == Standing::InFront {
            let _silent_already = rustix::io::read(&self.bell, &mut [0u8; 8]);
        } else {
            ring(&self.bell);
        }
    }

    /// A thread that has ended takes no orders; its answers do not come then.
    fn give(&self, orders: &Sender<Order>, order: Order) {
        let _sent = orders.send(order);
        ring(&self.order);
    }
}

/// A counter at its limit is rung already.
fn ring(bell: &OwnedFd) {
    let _rung = rustix::io::write(bell, &1u64.to_ne_bytes());
}

/// The seat's thread: says the seat's name through `opened` once this session is in front of it.
fn hold(shared: &Arc<Shared>, ordered: &Receiver<Order>, opened: &SyncSender<String>) {
    let told = shared.clone();
    let seat = libseat::Seat::open(move |_, event| match event {
        SeatEvent::Enable => told.set(Standing::InFront),
        SeatEvent::Disable => told.set(Standing::Leaving),
    });
    let Ok(mut seat) = seat else { return };
    let began = Instant::now();
    while shared.standing() != Standing::InFront {
        if seat.dispatch(100).is_err() || began.elapsed() > ENABLE_WAIT {
            return;
        }
    }
    // Whoever opens the seat waits for its name.
    let _heard = opened.send(seat.name().to_owned());
    if serve(&mut seat, shared, ordered).is_err() {
        shared.set(Standing::Gone);
    }
}

/// Follows the seat manager and orders, until the order to end.
fn serve(seat: &mut libseat::Seat, shared: &Shared, ordered: &Receiver<Order>) -> io::Result<()> {
    let mut card = None;
    loop {
        let connection = PollFd::from_borrowed_fd(seat.get_fd()?, PollFlags::IN);
        let mut polled = [connection, PollFd::new(&shared.order, PollFlags::IN)];
        // An interrupted wait is a short one.
        let _woken = poll(&mut polled, None);
        let hung_up = polled[0].revents().intersects(PollFlags::HUP | PollFlags::ERR);
        let _silent_already = rustix::io::read(&shared.order, &mut [0u8; 8]);
        for order in ordered.try_iter() {
            match order {
                Order::Open(path, reply) => {
                    let _heard = reply.send(open_card(seat, &path, &mut card));
                }
                Order::Close(reply) => {
                    close_card(seat, &mut card);
                    let _heard = reply.send(());
                }
                Order::Leave if shared.standing() == Standing::Leaving => {
                    shared.set(Standing::Behind);
                    seat.disable()?;
                }
                Order::Leave => {}
                Order::End => return Ok(()),
            }
        }
        // After the orders: what came while one waited for its answer may have been read already.
        seat.dispatch(0)?;
        if hung_up {
            return Err(io::ErrorKind::ConnectionAborted.into());
        }
    }
}

fn open_card(seat: &mut libseat::Seat, path: &Path, card: &mut Option<Device>) -> io::Result<OwnedFd> {
    close_card(seat, card);
    let opened = card.insert(seat.open_device(&path)?);
    // SAFETY: libseat leaves its descriptor to whoever opened the device, and `Device` does not close it.
    Ok(unsafe { OwnedFd::from_raw_fd(opened.as_fd().as_raw_fd()) })
}

fn close_card(seat: &mut libseat::Seat, card: &mut Option<Device>) {
    if let Some(card) = card.take() {
        // A manager that has ended has closed its own.
        let _closed = seat.close_device(card);
    }
}

//! The live feed: programs that hand pictures over while holod runs. The protocol's page is `daemon/doc/feed.md`.
//!
//! One ordinary thread listens, reads what clients send, and turns the newest picture of the one that is shown into a
//! frame. Pictures are copied out of the shared memory and never looked at in place, so a client that breaks
//! the rules harms its own picture only. Once its picture is copied a client has its slot back; the frame is made of
//! the copy after that.

mod client;
mod colours;
pub mod cost;
mod depths;
#[cfg(fuzzing)]
pub mod fuzzing;
mod line_limit;
mod message;
mod slots;

use std::collections::BTreeMap;
use std::io;
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use holod_calibration::{DisplayGeometry, Resolution, TimeNs};
use holod_model::RgbdFrame;
use holod_model::scene::{Fit, LiveError, LiveReport};
use holod_pupil_input::host_now;
use rustix::event::{EventfdFlags, PollFd, PollFlags, Timespec, eventfd, poll};
use rustix::io::Errno;
use rustix::net::{SocketFlags, SocketType, accept_with};
use serde::{Deserialize, Serialize};

use self::client::{Client, Copied, Gone, Refusal, TakeError, Target};
pub use self::colours::ClippedPixels;
pub use self::depths::BadDepths;
use self::line_limit::LineLimit;
use self::message::Outcome;
use self::slots::Picture;
use super::{LIVE_WITHIN, PictureSink, PictureTag, PictureView, scene};
use crate::local_socket::{self, LOOK, SocketError, SocketPlace};
use crate::tally_by::TallyBy;

/// Clients that may be connected at once.
const CLIENTS: usize = 8;
/// A client that has sent nothing for so long gives way to one that sends.
const SILENCE: TimeNs = TimeNs(2_000_000_000);
/// At first: three on their way to the frame thread, one that the renderer keeps, and one that is written.
const FRAMES: usize = 5;
/// Rest after a connection that could not be accepted.
const ACCEPT_AGAIN: Duration = Duration::from_millis(100);
/// Clients that go on doing wrong make one line in the log in this time.
const REFUSAL_EVERY: TimeNs = TimeNs(1_000_000_000);
/// A field of view that is off by more than this share is told.
const FIELD_TOLERANCE: f32 = 0.1;
/// The name of the socket in the runtime folder.
const SOCKET: &str = "feed";

/// What to listen for.
#[derive(Clone, Debug)]
pub struct FeedPlan {
    /// Path of the Unix socket to listen at.
    pub socket: PathBuf,
    /// Size of the frames.
    pub resolution: Resolution,
    /// How pictures of another size are brought to it.
    pub fit: Fit,
    /// What is shown until there is a picture. It lives as long as the plan: an engine keeps the last frame that it has
    /// seen.
    pub black: Arc<RgbdFrame>,
    /// Lasers are dark once no new picture has come for this long; without it the last one stays lit.
    pub dark_after: Option<TimeNs>,
}

impl FeedPlan {
    /// Listens at `socket` for pictures to be brought to `resolution`.
    pub fn new(socket: PathBuf, resolution: Resolution, fit: Fit) -> Self {
        Self { socket, resolution, fit, black: Arc::new(RgbdFrame::black(resolution)), dark_after: None }
    }
}

/// What can be said of the feed.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct FeedStatus {
    /// Path of the Unix socket that clients connect to.
    #[serde(serialize_with = "crate::results::path_text")]
    pub socket: PathBuf,
    /// Names that the connected clients gave themselves.
    pub clients: Vec<String>,
    /// Whose pictures are shown.
    pub shown: Option<String>,
    /// Pictures that were taken.
    pub taken: u64,
    /// Pictures that a newer one overtook before they were read.
    pub overtaken: u64,
    /// Pictures that could not be shown.
    pub refused: u64,
    /// Pictures of clients that were not shown, as another client or a scene was.
    pub not_shown: u64,
    /// Pictures that clients left out, by their numbers.
    pub left_out: u64,
    /// Connections that were refused or broken off for what they sent.
    pub connections_refused: u64,
    /// The same by reason.
    #[serde(default)]
    pub connections_refused_by: BTreeMap<String, u64>,
    /// Why a picture or a connection was refused last.
    pub last_refusal: Option<String>,
    /// How the newest picture was taken, where its client says so.
    #[serde(default)]
    pub view: PictureView,
    /// Depths of the newest picture, taken or refused, that cannot be shown as they are.
    #[serde(default)]
    pub bad_depths: BadDepths,
    /// The same of all pictures.
    #[serde(default)]
    pub bad_depths_in_all: BadDepths,
    /// Pictures that have some.
    #[serde(default)]
    pub pictures_with_bad_depths: u64,
    /// Pixels of the newest picture that was taken whose colours were clipped.
    #[serde(default)]
    pub clipped_colours: ClippedPixels,
    /// The same of all pictures.
    #[serde(default)]
    pub clipped_colours_in_all: ClippedPixels,
    /// Pictures that have some.
    #[serde(default)]
    pub pictures_with_clipped_colours: u64,
    /// Seconds since the newest picture was taken over.
    pub newest_age_s: Option<f64>,
    #[serde(skip)]
    t_newest: Option<TimeNs>,
    #[serde(skip)]
    t_told: Option<TimeNs>,
    #[serde(skip)]
    lines: LineLimit,
}

impl FeedStatus {
    /// That of a feed at `socket` to which nobody has come.
    fn at(socket: &Path) -> Self {
        let connections_refused_by = TallyBy::<Refusal>::default().map();
        Self { socket: socket.to_owned(), connections_refused_by, ..Self::default() }
    }

    fn count_depths(&mut self, bad: BadDepths) {
        self.bad_depths = bad;
        self.bad_depths_in_all.add(&bad);
        self.pictures_with_bad_depths += u64::from(bad.in_all() > 0);
    }

    fn count_colours(&mut self, clipped: ClippedPixels) {
        self.clipped_colours = clipped;
        self.clipped_colours_in_all.add(&clipped);
        self.pictures_with_clipped_colours += u64::from(clipped.in_all() > 0);
    }

    /// Says how clients come, what they send and how they go, as far as the log has room for it.
    fn tell(&mut self, line: &str) {
        if self.lines.has_room(host_now()) {
            tracing::info!("{line}");
        }
    }

    /// The same of what may be a mistake.
    fn warn(&mut self, line: &str) {
        if self.lines.has_room(host_now()) {
            tracing::warn!("{line}");
        }
    }

    fn tell_left_out(&mut self, now: TimeNs) {
        if let Some(lines) = self.lines.left_out(now) {
            tracing::warn!("{lines} lines about the feed's clients were left out: clients come and go all the time");
        }
    }

    fn tell_refusal(&mut self, what: &str, why: &str, now: TimeNs) {
        if self.t_told.is_none_or(|t| now - t >= REFUSAL_EVERY) {
            tracing::warn!("{what} is refused: {why}");
            self.t_told = Some(now);
        }
        self.last_refusal = Some(why.to_owned());
    }
}

/// Whether pictures of clients come, and are what is shown.
#[derive(Clone, Copy, Debug)]
pub struct FeedPulse {
    /// When the newest picture was taken over.
    pub t_newest: Option<TimeNs>,
    /// Whether live pictures are shown, and no scene.
    pub is_live: bool,
}

/// Why there is no feed.
#[derive(Debug, thiserror::Error)]
pub enum FeedError {
    /// There is no place for the socket.
    #[error("no folder for the feed's socket: name one with --scene feed:PATH")]
    NoFolder,
    /// The socket cannot be made.
    #[error("{0}; name another socket with --scene feed:PATH")]
    Socket(#[from] SocketError),
    /// Its thread cannot be started.
    #[error("the feed's thread cannot be started: {0}")]
    Thread(io::Error),
}

/// The socket that is meant by `feed` alone.
///
/// # Errors
/// This process has no runtime folder.
pub fn default_socket() -> Result<PathBuf, FeedError> {
    crate::runtime_folder::own().map(|folder| folder.join(SOCKET)).ok_or(FeedError::NoFolder)
}

/// A feed that is listening. Dropping it ends its clients' connections and takes the socket away.
pub struct Feed {
    /// Has the black frame, which the frame thread must not be the last to let go.
    _plan: Arc<FeedPlan>,
    place: Arc<SocketPlace>,
    sink: Arc<Mutex<PictureSink>>,
    stop: OwnedFd,
    thread: Option<JoinHandle<()>>,
    status: Arc<Mutex<FeedStatus>>,
}

impl Feed {
    /// Listens as planned, for the depth range of `geometry`, and shows the pictures through `sink`.
    ///
    /// # Errors
    /// The socket cannot be made.
    pub fn listen(
        plan: &Arc<FeedPlan>,
        geometry: &DisplayGeometry,
        sink: Arc<Mutex<PictureSink>>,
    ) -> Result<Self, FeedError> {
        let FeedPlan { socket, resolution, fit, .. } = FeedPlan::clone(plan);
        let (listener, place) = local_socket::listen(&socket, SocketType::SEQPACKET)?;
        let place = Arc::new(place);
        let stop = eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)
            .map_err(|error| FeedError::Thread(error.into()))?;
        let status = Arc::new(Mutex::new(FeedStatus::at(&socket)));
        let shown = Arc::clone(&sink);
        let mut server = Server {
            listener,
            place: Arc::clone(&place),
            t_looked: host_now(),
            stop: stop.try_clone().map_err(FeedError::Thread)?,
            target: Target { geometry: *geometry, resolution, fit },
            clients: Vec::new(),
            connections: 0,
            copied: Copied::default(),
            frames: (0..FRAMES).map(|_| Arc::new(RgbdFrame::black(resolution))).collect(),
            sink,
            shared: Arc::clone(&status),
            status: FeedStatus::at(&socket),
            left_out_of_gone: 0,
            refused: TallyBy::default(),
            shown_last: None,
        };
        let thread = std::thread::Builder::new()
            .name("holod-feed".into())
            .spawn(move || server.serve())
            .map_err(FeedError::Thread)?;
        tracing::info!("waiting for pictures on {}", socket.display());
        Ok(Self { _plan: Arc::clone(plan), place, sink: shown, stop, thread: Some(thread), status })
    }

    /// When the newest picture came, and whether pictures of clients are shown.
    pub fn pulse(&self) -> FeedPulse {
        FeedPulse {
            t_newest: self.status.lock().unwrap_or_else(PoisonError::into_inner).t_newest,
            is_live: self.sink.lock().unwrap_or_else(PoisonError::into_inner).is_live(),
        }
    }

    /// Whose pictures are shown.
    pub fn shown(&self) -> Option<String> {
        self.status.lock().unwrap_or_else(PoisonError::into_inner).shown.clone()
    }

    /// How it is at host time `now`.
    pub fn status(&self, now: TimeNs) -> FeedStatus {
        let mut status = self.status.lock().unwrap_or_else(PoisonError::into_inner).clone();
        status.newest_age_s = status.t_newest.map(|t| (now - t).seconds());
        if !self.sink.lock().unwrap_or_else(PoisonError::into_inner).is_live() {
            status.shown = None;
        }
        status
    }
}

impl Drop for Feed {
    fn drop(&mut self) {
        let _told = rustix::io::write(&self.stop, &1_u64.to_ne_bytes());
        if let Some(thread) = self.thread.take() {
            let _ended = thread.join();
        }
        self.place.take_away();
    }
}

/// What runs in the feed's own thread.
struct Server {
    listener: OwnedFd,
    place: Arc<SocketPlace>,
    /// When it was seen to that the socket is still there.
    t_looked: TimeNs,
    stop: OwnedFd,
    target: Target,
    /// In the order in which they came.
    clients: Vec<(u64, Client)>,
    connections: u64,
    /// The picture of which a frame is made.
    copied: Copied,
    frames: Vec<Arc<RgbdFrame>>,
    sink: Arc<Mutex<PictureSink>>,
    shared: Arc<Mutex<FeedStatus>>,
    status: FeedStatus,
    left_out_of_gone: u64,
    refused: TallyBy<Refusal>,
    /// Of which client a picture was taken last, since the feed is shown.
    shown_last: Option<u64>,
}

impl Server {
    fn serve(&mut self) {
        // Whose turn it is to be shown.
        let mut shown = None;
        while let Some(ready) = self.wait() {
            let now = host_now();
            if ready.connects {
                self.accept(now);
            }
            self.look_after_socket(now);
            self.status.tell_left_out(now);
            for number in ready.clients {
                self.with(number, &mut shown, |client, target, status| {
                    client.receive(target, host_now, |outcome| note(status, outcome))
                });
            }
            let connected: Vec<u64> = self.clients.iter().map(|(number, _)| *number).collect();
            for number in connected {
                self.with(number, &mut shown, |client, _, _| client.expect_hello(now));
            }
            if self.sink.lock().unwrap_or_else(PoisonError::into_inner).is_live() {
                self.choose(&mut shown, now);
            } else {
                (shown, self.shown_last) = (None, None);
            }
            let waiting: Vec<u64> =
                self.clients.iter().filter(|(_, client)| client.has_picture()).map(|(number, _)| *number).collect();
            for number in waiting {
                if shown == Some(number) {
                    self.show(number, &mut shown, now);
                } else {
                    self.with(number, &mut shown, |client, _, status| {
                        let Some(picture) = client.take() else { return Ok(()) };
                        note(status, &Outcome::NotShown);
                        client.free(&picture, &Outcome::NotShown)
                    });
                }
            }
            self.publish(shown);
        }
    }

    fn look_after_socket(&mut self, now: TimeNs) {
        if (now - self.t_looked).0.unsigned_abs() < LOOK.as_nanos() as u64 {
            return;
        }
        self.t_looked = now;
        if let Some(Ok(again)) = self.place.listen_again() {
            tracing::info!("waiting for pictures on {} again", self.place.path().display());
            self.listener = again;
        }
    }

    /// Waits until somebody has something to say, or some time; nothing where it is time to end.
    fn wait(&self) -> Option<Ready> {
        let mut waited: Vec<PollFd<'_>> = [&self.stop, &self.listener]
            .into_iter()
            .chain(self.clients.iter().map(|(_, client)| &client.socket))
            .map(|descriptor| PollFd::new(descriptor, PollFlags::IN))
            .collect();
        match poll(&mut waited, Timespec::try_from(LOOK).ok().as_ref()) {
            Ok(_) | Err(Errno::INTR) => {}
            Err(error) => {
                tracing::error!("the feed has ended: {error}");
                return None;
            }
        }
        let is_ready = |index: usize| !waited[index].revents().is_empty();
        let clients =
            (2..waited.len()).filter(|&index| is_ready(index)).map(|index| self.clients[index - 2].0).collect();
        (!is_ready(0)).then(|| Ready { connects: is_ready(1), clients })
    }

    fn accept(&mut self, now: TimeNs) {
        let Ok(socket) = accept_with(&self.listener, SocketFlags::CLOEXEC) else {
            // Too many open files, most likely, which the next look would find again at once.
            std::thread::sleep(ACCEPT_AGAIN);
            return;
        };
        self.connections += 1;
        let client = Client::new(socket, self.connections, now);
        if self.clients.len() == CLIENTS {
            let full = format!("{CLIENTS} clients are connected already; end one of them");
            self.refuse(&client.name, &client.show_out(Refusal::Full, &full));
            return;
        }
        self.clients.push((self.connections, client));
    }

    /// Does something with a client, and lets it go where that shows that it is to go.
    fn with(
        &mut self,
        number: u64,
        shown: &mut Option<u64>,
        act: impl FnOnce(&mut Client, &Target, &mut FeedStatus) -> Result<(), Gone>,
    ) {
        let Some(index) = self.clients.iter().position(|(one, _)| *one == number) else { return };
        let client = &mut self.clients[index].1;
        let Err(gone) = act(client, &self.target, &mut self.status) else { return };
        let (_, client) = self.clients.remove(index);
        if self.clients.is_empty() {
            // Its memory may be large.
            self.copied = Copied::default();
        }
        self.left_out_of_gone = self.left_out_of_gone.saturating_add(client.left_out());
        match gone {
            Gone::Closed => self.status.tell(&format!("the feed's client `{}` is gone", client.name)),
            Gone::Refused(..) => self.refuse(&client.name, &gone),
        }
        if self.shown_last == Some(number) {
            self.status.tell(&format!("the last picture of `{}` stays", client.name));
        }
        *shown = shown.filter(|one| *one != number);
    }

    fn refuse(&mut self, name: &str, gone: &Gone) {
        if let Gone::Refused(reason, why) = gone {
            self.status.connections_refused += 1;
            self.refused.count(*reason);
            self.status.connections_refused_by = self.refused.map();
            self.status.tell_refusal(&format!("the feed's client `{name}`"), why, host_now());
        }
    }

    /// Whose turn it is: the one's whose it was, while pictures of it are taken; else the next one's that sends some,
    /// in the order in which they came, round and round.
    fn choose(&self, shown: &mut Option<u64>, now: TimeNs) {
        let is_shown = |number: u64| *shown == Some(number);
        let gives = |(number, client): &(u64, Client)| is_shown(*number) && now - client.t_last < SILENCE;
        if self.clients.iter().any(gives) {
            return;
        }
        let place = self.clients.iter().position(|(number, _)| is_shown(*number));
        let (before, behind) = self.clients.split_at(place.map_or(0, |place| place + 1));
        let sends = |(number, client): &&(u64, Client)| !is_shown(*number) && client.has_picture();
        if let Some((number, _)) = behind.iter().chain(before).find(sends) {
            *shown = Some(*number);
        }
    }

    /// Turns the newest picture of a client into a frame, and hands that over.
    fn show(&mut self, number: u64, shown: &mut Option<u64>, now: TimeNs) {
        // While engines are changed both hold a frame.
        let free = self.frames.iter().position(|frame| Arc::strong_count(frame) == 1);
        let mut frame = free
            .map_or_else(|| Arc::new(RgbdFrame::black(self.target.resolution)), |free| self.frames.swap_remove(free));
        let sink = Arc::clone(&self.sink);
        let mut copied = std::mem::take(&mut self.copied);
        let was_shown = self.shown_last == Some(number);
        let mut is_shown = was_shown;
        self.with(number, shown, |client, target, status| {
            let Some(picture) = client.take() else { return Ok(()) };
            let taken = take_over(client, &picture, &mut copied, now);
            let outcome = taken.as_ref().map_or_else(|why| Outcome::Refused(why.to_string()), |_| Outcome::Taken);
            note(status, &outcome);
            let freed = client.free(&picture, &outcome);
            match taken {
                Ok(tag) => {
                    status.t_newest = Some(now);
                    client.t_last = now;
                    is_shown = true;
                    if !was_shown {
                        status.tell(&format!("the feed's client `{}` is shown", client.name));
                    }
                    status.view = tag.view;
                    let report = make(client, &copied, &mut frame);
                    sink.lock().unwrap_or_else(PoisonError::into_inner).show_live(Arc::clone(&frame), tag);
                    tell_age(client, tag, status);
                    tell_field_of_view(client, tag.view, target, status);
                    let bad = BadDepths::from(&report);
                    status.count_depths(bad);
                    status.count_colours(report.frame.colour_clipped.into());
                    tell_oddities(client, &bad, Some(&report), target, status);
                }
                Err(PictureRefusal::Picture(TakeError::Picture(LiveError::NoDepth { missing, .. }))) => {
                    let bad = BadDepths::from(missing);
                    status.count_depths(bad);
                    tell_oddities(client, &bad, None, target, status);
                }
                Err(_) => {}
            }
            freed
        });
        if is_shown {
            self.shown_last = Some(number);
        }
        // It may just have been the last client's.
        if !self.clients.is_empty() {
            self.copied = copied;
        }
        self.frames.push(frame);
    }

    fn publish(&mut self, shown: Option<u64>) {
        let name = |number: u64| self.clients.iter().find(|(one, _)| *one == number).map(|(_, one)| one.name.clone());
        self.status.shown = shown.filter(|_| shown == self.shown_last).and_then(name);
        self.status.clients = self.clients.iter().map(|(_, client)| client.name.clone()).collect();
        self.status.left_out =
            self.clients.iter().fold(self.left_out_of_gone, |sum, (_, client)| sum.saturating_add(client.left_out()));
        self.shared.lock().unwrap_or_else(PoisonError::into_inner).clone_from(&self.status);
    }
}

/// Who has said something.
struct Ready {
    connects: bool,
    clients: Vec<u64>,
}

/// Why a picture is refused.
#[derive(Debug, thiserror::Error)]
enum PictureRefusal {
    #[error(
        "a picture taken {ahead_s:.3} s from now was found, expected nanoseconds of CLOCK_MONOTONIC (not of the \
         calendar's clock) when it was taken (not when it is to be shown), or 0"
    )]
    Future { ahead_s: f64 },
    #[error("a picture taken at {t_ns} ns was found, expected nanoseconds of CLOCK_MONOTONIC, or 0")]
    BeforeTime { t_ns: i64 },
    #[error(transparent)]
    Picture(#[from] TakeError),
}

/// Copies a picture out of its slot, or says why it cannot be shown.
fn take_over(
    client: &mut Client,
    picture: &Picture,
    copied: &mut Copied,
    now: TimeNs,
) -> Result<PictureTag, PictureRefusal> {
    if picture.t_taken > picture.t_heard {
        return Err(PictureRefusal::Future { ahead_s: (picture.t_taken - picture.t_heard).seconds() });
    }
    if picture.t_taken < TimeNs(0) {
        return Err(PictureRefusal::BeforeTime { t_ns: picture.t_taken.0 });
    }
    client.stream().copy_out(picture, copied)?;
    Ok(PictureTag {
        number: picture.sequence,
        t_taken: Some(picture.t_taken),
        t_came: Some(now),
        view: client.stream().view(picture),
        order: 0,
    })
}

/// Makes `frame` of a picture that was taken over.
fn make(client: &mut Client, copied: &Copied, frame: &mut Arc<RgbdFrame>) -> LiveReport {
    let frame = Arc::get_mut(frame).expect("the frame is nobody else's");
    client.stream().make(copied, frame).expect("a picture that was taken over has a depth")
}

/// Says once of each client what is most often a mistake: depths of which most are bad, colours of which many were
/// clipped, and what is odd about the depth of its first picture of which a frame could be made.
fn tell_oddities(
    client: &mut Client,
    bad: &BadDepths,
    made: Option<&LiveReport>,
    target: &Target,
    status: &mut FeedStatus,
) {
    let name = format!("the feed's client `{}`", client.name);
    let format = client.stream().format();
    let pixels = format.resolution.pixels();
    let is_first = made.is_some() && !client.is_known;
    client.is_known |= made.is_some();
    let are_bad = 2 * bad.missing().max(bad.beyond()) > pixels as u64;
    if are_bad && !std::mem::replace(&mut client.told_depths, true) {
        let (text, cure) = (bad.text(), bad.likely_cure(format.depth));
        status.warn(&format!("{name}: of {pixels} depths, these cannot be shown as they are: {text}; {cure}"));
    }
    let Some(report) = made else { return };
    if is_first
        && !are_bad
        && let Some(oddity) = scene::depth_oddity(&report.frame, &target.geometry, client.sends_planes())
    {
        status.warn(&format!("{name}: {oddity}"));
    }
    if !client.told_colours {
        for oddity in scene::odd_colours(report.frame.colour_clipped, pixels) {
            client.told_colours = true;
            status.warn(&format!("{name}: {oddity}"));
        }
    }
}

/// Says once of each client that its pictures are too old to be live, most often since its clock is another one.
fn tell_age(client: &mut Client, tag: PictureTag, status: &mut FeedStatus) {
    let Some(age) = tag.age().filter(|_| !tag.is_live() && !client.told_age) else { return };
    client.told_age = true;
    status.warn(&format!(
        "the feed's client `{}`: a picture taken {:.1} s before it came was found, expected nanoseconds of \
         CLOCK_MONOTONIC (not of another clock, nor from a pipeline's start) when it was taken, or 0; the time from \
         picture to photons leaves out pictures that are older than {} s when they come",
        client.name,
        age.seconds(),
        LIVE_WITHIN.seconds()
    ));
}

/// Says once of each client that its pictures were taken with another field of view than they are seen with.
fn tell_field_of_view(client: &mut Client, view: PictureView, target: &Target, status: &mut FeedStatus) {
    let Some(taken_deg) = view.field_of_view_deg.filter(|_| !client.told_field_of_view) else { return };
    client.told_field_of_view = true;
    let shown_deg = client.stream().shown_field_of_view_deg(&target.geometry);
    let half_tangent = |deg: f32| (deg.to_radians() / 2.0).tan();
    let factor = half_tangent(shown_deg[0]) / half_tangent(taken_deg[0]);
    if (factor - 1.0).abs() > FIELD_TOLERANCE {
        let [[taken_x, taken_y], [shown_x, shown_y]] = [taken_deg, shown_deg];
        status.warn(&format!(
            "the feed's client `{}`: pictures taken with {taken_x:.1} x {taken_y:.1} degrees are shown in {shown_x:.1} x \
             {shown_y:.1}: things look {factor:.2} times as large as they are; set the camera's field of view to the latter",
            client.name
        ));
    }
}

/// Counts what became of a picture.
fn note(status: &mut FeedStatus, outcome: &Outcome) {
    match outcome {
        Outcome::Taken => status.taken += 1,
        Outcome::Overtaken => status.overtaken += 1,
        Outcome::NotShown => status.not_shown += 1,
        Outcome::Refused(why) => {
            status.refused += 1;
            status.tell_refusal("a picture of the feed", why, host_now());
        }
    }
}

#[cfg(test)]
mod tests;

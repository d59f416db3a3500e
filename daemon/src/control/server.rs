//! The control socket, in tokio, with one thread of its own and one for what takes long; no real-time thread waits for
//! either. On its own thread tasks take their turns in order: of two connections at rest the one that asks first is
//! obeyed first.

use std::cell::Cell;
use std::collections::BTreeMap;
use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU8, AtomicUsize, Ordering};
use std::sync::{Arc, mpsc};
use std::thread;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::net::SocketType;
use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::{UnixListener, UnixStream};
use tokio::runtime::Handle;
use tokio::sync::{Semaphore, SemaphorePermit, oneshot};
use tokio::task::{AbortHandle, yield_now};

use super::{Answer, Order, Ordered, Preparer, Request};
use crate::local_socket::{self, LOOK, SocketPlace};
use crate::tally_by::{Reason, TallyBy};

/// Connections at once. A further one takes the place of another, so that nobody who only holds on keeps others out.
const CONNECTIONS: usize = 32;
/// The longest request, in bytes.
const LONGEST: u64 = 1 << 16;
/// As much as the main thread has, which reads scenes, too.
const STACK_BYTES: usize = 8 << 20;
/// Longer than the control thread takes for anything; an order that nobody waits for any more is not obeyed.
const PATIENCE: Duration = Duration::from_secs(5);
/// How long the end of a run waits for answers to be sent.
const FAREWELL: Duration = Duration::from_millis(500);
/// Turns of the runtime after which all requests that had come before are read: one for the socket, one for a connection, and some more.
const TURNS: u32 = 4;

/// A control socket that listens. Dropping it ends that.
pub(crate) struct ControlServer {
    place: Arc<SocketPlace>,
    waiting: Arc<Waiting>,
    runtime: Handle,
    /// The thread ends when this is dropped.
    _end: oneshot::Sender<()>,
}

impl ControlServer {
    /// Listens at `socket`; what is asked for comes out of the receiver, ready to be obeyed.
    ///
    /// # Errors
    /// Why there is no socket.
    pub(crate) fn listen(
        socket: PathBuf,
        preparer: Preparer,
    ) -> Result<(Self, mpsc::Receiver<Ordered>), Box<dyn std::error::Error>> {
        let (listener, place) = local_socket::listen(&socket, SocketType::STREAM)?;
        let place = Arc::new(place);
        let runtime = tokio::runtime::Builder::new_current_thread()
            .max_blocking_threads(1)
            .thread_name("holod-control")
            .thread_stack_size(STACK_BYTES)
            .enable_io()
            .enable_time()
            .build()?;
        let (orders, receiver) = mpsc::channel();
        let listener = {
            let _inside = runtime.enter();
            UnixListener::from_std(listener.into())?
        };
        let waiting = Arc::new(Waiting::new(preparer, orders));
        let handle = runtime.handle().clone();
        handle.spawn(serve(listener, Arc::clone(&place), Arc::clone(&waiting)));
        let (end, ended) = oneshot::channel();
        thread::Builder::new().name("holod-control".into()).stack_size(STACK_BYTES).spawn(move || {
            let _dropped = runtime.block_on(ended);
            // What is still being made ready ends with the process.
            runtime.shutdown_background();
        })?;
        Ok((Self { place, waiting, runtime: handle, _end: end }, receiver))
    }

    /// Has the rig file read again for a signal, which cannot ask twice: after whatever takes long now. What came of it
    /// is said in the log.
    pub(crate) fn reload_by_signal(&self) {
        let waiting = Arc::clone(&self.waiting);
        // One that waits will read the file as it is then.
        if waiting.signal_waits.swap(true, Ordering::AcqRel) {
            return;
        }
        self.runtime.spawn(async move {
            let Ok(alone) = waiting.long_work.acquire().await else { return };
            waiting.signal_waits.store(false, Ordering::Release);
            match take_time(Request::Reload { changed: BTreeMap::new() }, &waiting, alone).await {
                Answer::Ok(said) => tracing::info!("SIGHUP: {}", said.as_str().unwrap_or_default()),
                Answer::Error(why) | Answer::Unanswered(why) => tracing::error!("SIGHUP: {why}"),
            }
        });
    }

    /// How many requests were refused, by reason.
    pub(crate) fn refused(&self) -> BTreeMap<String, u64> {
        self.waiting.refused.map()
    }

    pub(crate) fn socket(&self) -> &Path {
        self.place.path()
    }
}

impl Drop for ControlServer {
    fn drop(&mut self) {
        // Whoever asked for the end is told that it came.
        let t_end = Instant::now() + FAREWELL;
        while self.waiting.under_way.load(Ordering::Acquire) > 0 && Instant::now() < t_end {
            thread::sleep(Duration::from_millis(1));
        }
        self.place.take_away();
    }
}

async fn serve(mut listener: UnixListener, place: Arc<SocketPlace>, desk: Arc<Waiting>) {
    let mut connections: Vec<Connection> = Vec::new();
    loop {
        let Ok(accepted) = tokio::time::timeout(LOOK, listener.accept()).await else {
            if let Some(Ok(again)) = place.listen_again()
                && let Ok(again) = UnixListener::from_std(again.into())
            {
                tracing::info!("`holod ctl` reaches this run again, at {}", place.path().display());
                listener = again;
            }
            continue;
        };
        let Ok((stream, _)) = accepted else {
            // Too many open files, most likely.
            tokio::time::sleep(Duration::from_millis(100)).await;
            continue;
        };
        connections.retain(|connection| !connection.task.is_finished());
        if connections.len() == CONNECTIONS
            && let Some(place) = to_be_closed(connections.iter().map(|connection| connection.claim.get()))
        {
            connections.remove(place).task.abort();
        }
        let desk = Arc::clone(&desk);
        let claim = Arc::new(Claim::default());
        let its_claim = Arc::clone(&claim);
        let connection = tokio::spawn(async move {
            // A client that has gone away is no fault.
            let _gone = converse(stream, &desk, &its_claim).await;
        });
        connections.push(Connection { task: connection.abort_handle(), claim });
    }
}

struct Connection {
    task: AbortHandle,
    claim: Arc<Claim>,
}

/// What a connection's place is needed for.
#[derive(Default)]
struct Claim(AtomicU8);

impl Claim {
    const NOTHING: u8 = 0;
    const AN_ORDER: u8 = 1;
    const DARKNESS: u8 = 2;

    fn get(&self) -> u8 {
        self.0.load(Ordering::Relaxed)
    }

    fn set(&self, claim: u8) {
        self.0.store(claim, Ordering::Relaxed);
    }
}

/// Which connection makes way, of those that came in this order: the oldest of those that need their places least. An
/// answer to whoever wants the lasers dark is lost last.
fn to_be_closed(claims: impl Iterator<Item = u8>) -> Option<usize> {
    claims.enumerate().min_by_key(|(_, claim)| *claim).map(|(place, _)| place)
}

async fn converse(stream: UnixStream, desk: &Arc<Waiting>, claim: &Claim) -> io::Result<()> {
    let (read, mut write) = stream.into_split();
    let mut read = BufReader::new(read);
    loop {
        let mut line = Vec::new();
        (&mut read).take(LONGEST).read_until(b'\n', &mut line).await?;
        if line.is_empty() {
            return Ok(());
        }
        let _until_it_is_answered = UnderWay::count(&desk.under_way);
        let is_whole = line.ends_with(b"\n");
        let request = Request::from_line(&line);
        if let Ok(request) = &request
            && request.changes_something()
            && !matches!(request, Request::LasersDark {} | Request::Stop {})
            && has_gone(read.get_ref().as_ref())
        {
            // Who gave up waiting, or somebody else, may have wanted something else since.
            desk.refused.count(Refused::Unanswered);
            tracing::info!("left undone, as whoever asked has gone: {}", String::from_utf8_lossy(line.trim_ascii()));
            return Ok(());
        }
        claim.set(if request == Ok(Request::LasersDark {}) { Claim::DARKNESS } else { Claim::AN_ORDER });
        let answer = if is_whole {
            answer(request, desk).await
        } else {
            let why = format!("a request without an end was found, expected a line of at most {LONGEST} bytes");
            desk.refuse(Refused::Malformed, why)
        };
        let mut bytes = serde_json::to_vec(&answer).map_err(io::Error::other)?;
        bytes.push(b'\n');
        write.write_all(&bytes).await?;
        claim.set(Claim::NOTHING);
        if !is_whole {
            return Ok(());
        }
    }
}

/// Whether nobody is at the other end any more. One that sends nothing more may still wait for its answer.
fn has_gone(stream: &UnixStream) -> bool {
    let mut stream = [PollFd::new(stream, PollFlags::empty())];
    poll(&mut stream, Some(&Timespec::default())).is_ok() && stream[0].revents().contains(PollFlags::HUP)
}

async fn answer(request: Result<Request, String>, desk: &Arc<Waiting>) -> Answer {
    match request {
        Ok(request) => answer_to(request, desk).await,
        Err(error) => desk.refuse(Refused::Malformed, format!("the request is not understood: {error}")),
    }
}

async fn answer_to(request: Request, desk: &Arc<Waiting>) -> Answer {
    // Nothing that takes long stands before darkness.
    if !request.takes_long() {
        let wants_darkness = request == Request::LasersDark {};
        if request == (Request::LasersArm {}) && desk.dark_wishes.load(Ordering::Acquire) > 0 {
            // Which of them came first is not known.
            return desk.refuse(Refused::Declined, "`lasers dark` has been asked for at the same time: ask again");
        }
        let _wish = wants_darkness.then(|| UnderWay::count(&desk.dark_wishes));
        let prepared = desk.preparer.prepare(&request);
        let answer = hand_over(prepared, request, desk).await;
        for _ in 0..if wants_darkness { TURNS } else { 0 } {
            yield_now().await;
        }
        return answer;
    }
    match desk.long_work.try_acquire() {
        Ok(alone) => take_time(request, desk, alone).await,
        Err(_) => {
            desk.refuse(Refused::Busy, "holod is busy with another scene, other weights or the rig file: ask again")
        }
    }
}

/// Makes a request ready that takes long, for which one must be alone.
async fn take_time(request: Request, desk: &Arc<Waiting>, alone: SemaphorePermit<'_>) -> Answer {
    let (waiting, asked) = (Arc::clone(desk), request.clone());
    let prepared = tokio::task::spawn_blocking(move || waiting.prepare_long(&asked)).await;
    drop(alone);
    match prepared {
        Ok(prepared) => hand_over(prepared, request, desk).await,
        Err(_panic) => desk.refuse(Refused::Failed, "holod failed over this request, and goes on: see its log"),
    }
}

/// Has a request obeyed that is ready.
async fn hand_over(prepared: Result<Order, String>, request: Request, desk: &Waiting) -> Answer {
    let order = match prepared {
        Ok(order) => order,
        Err(why) => return desk.refuse(Refused::Impossible, why),
    };
    let wish = if let Order::LasersDark(wish) = &order { Some(wish.request()) } else { None };
    let (answer, answered) = oneshot::channel();
    let ending = || desk.refuse(Refused::Unanswered, "holod is ending");
    if desk.orders.send(Ordered { order, request, answer }).is_err() {
        return ending();
    }
    match tokio::time::timeout(PATIENCE, answered).await {
        Ok(Ok(Answer::Error(why))) => desk.refuse(Refused::Declined, why),
        Ok(Ok(done)) => done,
        Ok(Err(_dropped)) => ending(),
        Err(_elapsed) => {
            desk.refused.count(Refused::Unanswered);
            let acknowledged = wish.map(|wish| desk.preparer.lasers.answer_to(wish) == Some(true));
            Answer::Unanswered(format!(
                "holod's control thread does not answer: see its log; {}",
                what_holds(acknowledged)
            ))
        }
    }
}

/// What is known of an order that the control thread has not answered; of one for darkness, whether the laser box has
/// acknowledged it.
const fn what_holds(acknowledged: Option<bool>) -> &'static str {
    match acknowledged {
        Some(true) => {
            "the lasers have been put out beside it, as their box acknowledged, and stay dark until `lasers arm`"
        }
        Some(false) => {
            "the laser box has not acknowledged darkness: `holod dark --config RIG` puts the lasers out beside it; look \
             at them"
        }
        None => {
            "whether the order took effect, or still will, is not known; the lasers may be lit: `holod dark --config \
             RIG` puts them out beside it"
        }
    }
}

/// Counts a request for as long as it lives.
struct UnderWay<'a>(&'a AtomicUsize);

impl<'a> UnderWay<'a> {
    fn count(requests: &'a AtomicUsize) -> Self {
        requests.fetch_add(1, Ordering::Release);
        Self(requests)
    }
}

impl Drop for UnderWay<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Release);
    }
}

/// What every connection needs.
struct Waiting {
    preparer: Preparer,
    orders: mpsc::Sender<Ordered>,
    /// Of what takes long, one at a time.
    long_work: Semaphore,
    /// A signal asks for the rig file, and waits for the rest.
    signal_waits: AtomicBool,
    /// Requests that have no answer yet.
    under_way: AtomicUsize,
    /// Of these, wishes for darkness.
    dark_wishes: AtomicUsize,
    refused: TallyBy<Refused>,
}

/// Why a request was not carried out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Refused {
    /// It is none that holod knows.
    Malformed,
    /// Another one took its time.
    Busy,
    /// What it asks for is not there, or does not fit this run.
    Impossible,
    /// The run did not take it, or the laser box did not acknowledge darkness.
    Declined,
    /// holod failed over it.
    Failed,
    /// The run did not say anything or was ending, or whoever asked had gone.
    Unanswered,
}

impl Reason for Refused {
    const ALL: &'static [Self] =
        &[Self::Malformed, Self::Busy, Self::Impossible, Self::Declined, Self::Failed, Self::Unanswered];

    fn name(self) -> &'static str {
        match self {
            Self::Malformed => "malformed",
            Self::Busy => "busy",
            Self::Impossible => "impossible",
            Self::Declined => "declined",
            Self::Failed => "failed",
            Self::Unanswered => "unanswered",
        }
    }
}

thread_local! {
    static CATCHES_PANICS: Cell<bool> = const { Cell::new(false) };
}

/// Whether a panic of this thread is caught and is an error like any other: a decoder's, over somebody's file.
pub(crate) fn panic_is_caught() -> bool {
    CATCHES_PANICS.get()
}

impl Waiting {
    fn new(preparer: Preparer, orders: mpsc::Sender<Ordered>) -> Self {
        Self {
            preparer,
            orders,
            long_work: Semaphore::new(1),
            signal_waits: AtomicBool::new(false),
            under_way: AtomicUsize::new(0),
            dark_wishes: AtomicUsize::new(0),
            refused: TallyBy::default(),
        }
    }

    /// The answer to a request that is not carried out, which is counted.
    fn refuse(&self, reason: Refused, why: impl Into<String>) -> Answer {
        self.refused.count(reason);
        Answer::Error(why.into())
    }

    fn prepare_long(&self, request: &Request) -> Result<Order, String> {
        CATCHES_PANICS.set(true);
        let order = catch_unwind(AssertUnwindSafe(|| self.preparer.prepare(request)));
        CATCHES_PANICS.set(false);
        order.unwrap_or_else(|panic| resume_unwind(panic))
    }
}

#[cfg(test)]
mod tests {
    use std::io::{BufRead, Write};
    use std::net::Shutdown;
    use std::os::unix::net::UnixStream as Stream;

    use super::*;

    /// Waits for whatever a test waits for.
    const LONG: Duration = Duration::from_secs(20);

    /// A control socket; the test obeys.
    fn listen() -> (tempfile::TempDir, ControlServer, mpsc::Receiver<Ordered>) {
        let folder = tempfile::tempdir().unwrap();
        let (server, orders) =
            ControlServer::listen(folder.path().join("control"), Preparer::of_a_small_rig()).unwrap();
        (folder, server, orders)
    }

    fn send(stream: &mut impl Write, request: &Request) {
        let line = serde_json::to_string(request).unwrap() + "\n";
        stream.write_all(line.as_bytes()).unwrap();
    }

    fn answer_on(stream: &Stream) -> Answer {
        let mut line = String::new();
        std::io::BufReader::new(stream).read_line(&mut line).unwrap();
        serde_json::from_str(&line).unwrap()
    }

    #[test]
    fn light_is_refused_while_a_wish_for_darkness_has_no_answer() {
        let (_folder, server, orders) = listen();
        let [mut dark, mut arm] = [(); 2].map(|()| Stream::connect(server.socket()).unwrap());
        send(&mut dark, &Request::LasersDark {});
        let wish = orders.recv_timeout(LONG).unwrap();
        assert!(matches!(wish.order, Order::LasersDark(_)));
        send(&mut arm, &Request::LasersArm {});
        let refused = answer_on(&arm);
        assert!(matches!(&refused, Answer::Error(why) if why.contains("at the same time: ask again")), "{refused:?}");
        wish.answer.send(Answer::Ok("dark".into())).unwrap();
        assert_eq!(answer_on(&dark), Answer::Ok("dark".into()));
        send(&mut arm, &Request::LasersArm {});
        assert!(matches!(orders.recv_timeout(LONG).unwrap().order, Order::LasersArm));
    }

    #[test]
    fn of_two_connections_at_rest_the_one_that_asks_first_is_obeyed_first() {
        let (_folder, server, orders) = listen();
        let connect = || Stream::connect(server.socket()).unwrap();
        let pairs: Vec<_> = (0..15).map(|_| [connect(), connect()]).collect();
        let obey = || {
            let Ordered { request, answer, .. } = orders.recv_timeout(LONG).unwrap();
            answer.send(Answer::Ok("done".into())).unwrap();
            request
        };
        // With an answer to this one, all have been let in.
        let mut last = connect();
        send(&mut last, &Request::Status {});
        obey();
        answer_on(&last);
        let pupils = [3.0, 4.0].map(|mm| Request::Pupil { mm: Some(mm) });
        for (number, pair) in pairs.iter().enumerate() {
            pair.iter().zip(&pupils).for_each(|(mut connection, pupil)| send(&mut connection, pupil));
            assert_eq!([obey(), obey()], pupils, "pair {number}");
        }
    }

    #[test]
    fn of_whoever_has_gone_only_orders_that_end_in_darkness_are_obeyed() {
        let (sender, orders) = mpsc::channel();
        let waiting = Arc::new(Waiting::new(Preparer::of_a_small_rig(), sender));
        let obeyed = thread::spawn(move || {
            let obey = |Ordered { request, answer, .. }| {
                answer.send(Answer::Ok("done".into())).unwrap();
                request
            };
            orders.into_iter().map(obey).collect::<Vec<_>>()
        });
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let converse_over = |request: &Request, ends: &dyn Fn(Stream) -> Option<Stream>| {
            let (mut theirs, ours) = Stream::pair().unwrap();
            send(&mut theirs, request);
            let theirs = ends(theirs);
            ours.set_nonblocking(true).unwrap();
            runtime.block_on(async {
                let _gone = converse(UnixStream::from_std(ours).unwrap(), &waiting, &Claim::default()).await;
            });
            theirs.map(|theirs| answer_on(&theirs))
        };
        let [arm, resume] = [Request::LasersArm {}, Request::Resume {}];
        let [dark, stop] = [Request::LasersDark {}, Request::Stop {}];
        for request in [&arm, &resume, &dark, &stop] {
            converse_over(request, &|_gone| None);
        }
        // It sends nothing more, and waits.
        let half = |theirs: Stream| {
            theirs.shutdown(Shutdown::Write).unwrap();
            Some(theirs)
        };
        assert_eq!(converse_over(&arm, &half), Some(Answer::Ok("done".into())));
        assert_eq!(waiting.refused.map()["unanswered"], 2);
        drop(waiting);
        assert_eq!(obeyed.join().unwrap(), [dark, stop, arm]);
    }

    #[test]
    fn the_oldest_connection_makes_way_that_waits_for_nothing_and_last_one_that_waits_for_darkness() {
        use Claim as Of;
        for (claims, expected) in [
            ([Of::NOTHING, Of::NOTHING, Of::NOTHING], 0),
            ([Of::AN_ORDER, Of::NOTHING, Of::NOTHING], 1),
            ([Of::DARKNESS, Of::AN_ORDER, Of::AN_ORDER], 1),
            ([Of::DARKNESS, Of::DARKNESS, Of::DARKNESS], 0),
        ] {
            assert_eq!(to_be_closed(claims.into_iter()), Some(expected), "{claims:?}");
        }
    }
}

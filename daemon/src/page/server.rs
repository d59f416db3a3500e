//! The page's HTTP server: its routes, what each answers, and the event streams.

use std::io;
use std::net::SocketAddr;
use std::os::fd::AsFd;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use axum::body::{Body, Bytes};
use axum::extract::rejection::QueryRejection;
use axum::extract::{Query, State};
use axum::http::header::{
    CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, REFERRER_POLICY, X_CONTENT_TYPE_OPTIONS,
};
use axum::http::{HeaderName, HeaderValue, StatusCode};
use axum::middleware::{from_fn_with_state, map_response};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use axum::{Extension, Json, Router};
use holod_calibration::{Dioptres, host_now};
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use prometheus_client::registry::Registry;
use rustix::net::SocketType;
use rustix::net::sockopt::set_tcp_user_timeout;
use serde::Deserialize;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpListener, UnixListener};
use tokio::runtime::Runtime;
use tokio::task::AbortHandle;
use tokio_stream::StreamExt;
use tokio_stream::wrappers::BroadcastStream;
use tokio_stream::wrappers::errors::BroadcastStreamRecvError;

use super::address::PageAddress;
use super::door::{Door, Doorkeeper, Passed, Token, admit};
use super::eye::{Blind, EyeDesk, Gaze};
use super::give_up::GivesUp;
use super::live::{Live, Refused, Viewer};
use super::metrics;
use crate::cli::{focus_of_an_eye, human_pupil};
use crate::local_socket::{self, LOOK, SocketPlace};
use crate::scheduling;
use crate::snapshot::SnapshotNow;
use crate::status::stale;

/// Connections at once; a further one takes the place of one on which nobody has passed the door. A browser has up to six.
const CONNECTIONS: usize = 256;
/// Browsers that watch at once; each further one is told so.
const VIEWERS: usize = 64;
/// A client says what it wants within this time, and takes what it is given.
const PATIENCE: Duration = Duration::from_secs(10);
/// How long the end of a run waits for viewers to take the last event.
const FAREWELL: Duration = Duration::from_millis(500);

/// Why the page is not served.
#[derive(Debug, thiserror::Error)]
pub(super) enum ServeError {
    #[error("--page {address}: cannot listen there: {error}; {}", advice(.error))]
    Listen { address: SocketAddr, error: io::Error },
    #[error("--page unix: {0}")]
    Socket(#[from] local_socket::SocketError),
    #[error("--page: {0}")]
    Runtime(#[from] io::Error),
}

fn advice(error: &io::Error) -> &'static str {
    match error.kind() {
        io::ErrorKind::AddrInUse => "another program has the port: end it, or name another one",
        io::ErrorKind::PermissionDenied => "ports below 1024 are the administrator's: name a higher one",
        _ => "name an address of this machine",
    }
}

/// A page that is served. Dropping it ends that.
pub(super) struct PageServer {
    place: PageAddress,
    socket: Option<Arc<SocketPlace>>,
    live: Arc<Live>,
    runtime: Option<Runtime>,
}

impl PageServer {
    pub(super) fn start(
        address: &PageAddress,
        token: Option<Token>,
        live: Arc<Live>,
        eye: EyeDesk,
    ) -> Result<Self, ServeError> {
        let runtime = scheduling::patient(|| {
            tokio::runtime::Builder::new_multi_thread()
                .worker_threads(1)
                .max_blocking_threads(1)
                .thread_name("holod-page")
                .enable_io()
                .enable_time()
                .build()
        })?;
        let _inside = runtime.enter();
        let (listener, place, socket) = Listener::bind(address)?;
        let door = match (token, &place) {
            (Some(token), _) => Door::Token(token),
            (None, PageAddress::Tcp(_)) => Door::OwnName,
            (None, PageAddress::Unix(_)) => Door::Open,
        };
        let router = router(door, Arc::clone(&live), eye);
        runtime.spawn(serve(listener, router, Arc::clone(&live), PATIENCE));
        drop(_inside);
        Ok(Self { place, socket, live, runtime: Some(runtime) })
    }

    pub(super) fn place(&self) -> &PageAddress {
        &self.place
    }
}

impl Drop for PageServer {
    fn drop(&mut self) {
        // Streams end with the run; viewers are given the time to be told.
        let t_end = Instant::now() + FAREWELL;
        while self.live.viewers.load(Ordering::Relaxed) > 0 && Instant::now() < t_end {
            std::thread::sleep(Duration::from_millis(5));
        }
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
        if let Some(socket) = &self.socket {
            socket.take_away();
        }
    }
}

enum Listener {
    Tcp(TcpListener),
    Unix(UnixListener, Arc<SocketPlace>),
}

trait Stream: AsyncRead + AsyncWrite + Unpin + Send {}
impl<S: AsyncRead + AsyncWrite + Unpin + Send> Stream for S {}

impl Listener {
    /// With where it really is: port 0 is any port. A socket is to be taken away at the end.
    fn bind(address: &PageAddress) -> Result<(Self, PageAddress, Option<Arc<SocketPlace>>), ServeError> {
        match address {
            PageAddress::Tcp(address) => {
                let cannot = |error| ServeError::Listen { address: *address, error };
                let listener = std::net::TcpListener::bind(address).map_err(cannot)?;
                listener.set_nonblocking(true).map_err(cannot)?;
                let listener = TcpListener::from_std(listener).map_err(cannot)?;
                let place = listener.local_addr().map_err(cannot)?;
                Ok((Self::Tcp(listener), PageAddress::Tcp(place), None))
            }
            PageAddress::Unix(path) => {
                let (listener, place) = local_socket::listen(path, SocketType::STREAM)?;
                let (listener, place) = (UnixListener::from_std(listener.into())?, Arc::new(place));
                Ok((Self::Unix(listener, Arc::clone(&place)), address.clone(), Some(place)))
            }
        }
    }

    async fn accept(&self) -> io::Result<Box<dyn Stream>> {
        match self {
            Self::Tcp(listener) => {
                let (stream, _) = listener.accept().await?;
                stream.set_nodelay(true)?;
                // A viewer that is gone without a word.
                set_tcp_user_timeout(stream.as_fd(), PATIENCE.as_millis() as u32)?;
                Ok(Box::new(stream))
            }
            Self::Unix(listener, _) => Ok(Box::new(listener.accept().await?.0)),
        }
    }

    /// Listens again where the socket was taken away.
    fn look_after_socket(&mut self) {
        if let Self::Unix(listener, place) = self
            && let Some(Ok(again)) = place.listen_again()
            && let Ok(again) = UnixListener::from_std(again.into())
        {
            tracing::info!("the page is there again, at {}", place.path().display());
            *listener = again;
        }
    }
}

async fn serve(mut listener: Listener, router: Router, live: Arc<Live>, patience: Duration) {
    let mut connections: Vec<(AbortHandle, Passed)> = Vec::new();
    loop {
        let Ok(accepted) = tokio::time::timeout(LOOK, listener.accept()).await else {
            listener.look_after_socket();
            continue;
        };
        let Ok(stream) = accepted else {
            // Too many open files, most likely.
            tokio::time::sleep(Duration::from_millis(100)).await;
            continue;
        };
        connections.retain(|(task, _)| !task.is_finished());
        if connections.len() == CONNECTIONS {
            live.refused.count(Refused::Connections);
            let Some(oldest) = connections.iter().position(|(_, passed)| !passed.has()) else { continue };
            connections.remove(oldest).0.abort();
        }
        let passed = Passed::default();
        let service = TowerToHyperService::new(router.clone().layer(Extension(passed.clone())));
        let connection = tokio::spawn(async move {
            let mut server = http1::Builder::new();
            server.timer(TokioTimer::new()).header_read_timeout(patience);
            // A client that has gone away is no fault.
            let _gone = server.serve_connection(TokioIo::new(GivesUp::new(stream, patience)), service).await;
        });
        connections.push((connection.abort_handle(), passed));
    }
}

/// What every handler needs.
#[derive(Clone)]
struct Shown {
    live: Arc<Live>,
    eye: EyeDesk,
    registry: Arc<Registry>,
}

fn router(door: Door, live: Arc<Live>, eye: EyeDesk) -> Router {
    let registry = Arc::new(metrics::registry(&live));
    let keeper = Arc::new(Doorkeeper { door, live: Arc::clone(&live) });
    Router::new()
        .route("/", file("text/html; charset=utf-8", include_str!("assets/index.html")))
        .route("/page.css", file("text/css; charset=utf-8", include_str!("assets/page.css")))
        .route("/page.js", file("text/javascript; charset=utf-8", include_str!("assets/page.js")))
        .route("/plots.js", file("text/javascript; charset=utf-8", include_str!("assets/plots.js")))
        .route("/icon.svg", file("image/svg+xml", include_str!("assets/icon.svg")))
        .route("/events", get(events))
        .route("/eye.png", get(eye_picture))
        .route("/status.json", get(status))
        .route("/metrics", get(figures))
        .fallback(async || (StatusCode::NOT_FOUND, "there is no such page: see /\n"))
        .with_state(Shown { live, eye, registry })
        .layer(from_fn_with_state(keeper, admit))
        .layer(map_response(guarded))
}

fn file(kind: &'static str, content: &'static str) -> axum::routing::MethodRouter<Shown> {
    get(async move || ([(CONTENT_TYPE, kind)], content))
}

/// Nothing from elsewhere is loaded, nothing is kept, no other site may frame the page or show what is on it.
async fn guarded(mut response: Response) -> Response {
    let policy =
        "default-src 'self'; img-src 'self' blob:; frame-ancestors 'none'; base-uri 'none'; form-action 'none'";
    let headers: [(HeaderName, &'static str); 5] = [
        (CONTENT_SECURITY_POLICY, policy),
        (X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (REFERRER_POLICY, "no-referrer"),
        (CACHE_CONTROL, "no-store"),
        (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
    ];
    for (name, value) in headers {
        response.headers_mut().insert(name, HeaderValue::from_static(value));
    }
    response
}

async fn events(State(shown): State<Shown>) -> Response {
    let Some(viewer) = Viewer::come(&shown.live, VIEWERS) else {
        shown.live.refused.count(Refused::Viewers);
        let said = format!("{VIEWERS} browsers watch already: close one of them\n");
        return (StatusCode::SERVICE_UNAVAILABLE, said).into_response();
    };
    let Some((before, receiver)) = shown.live.watch() else { return over() };
    let before = tokio_stream::iter(before.into_iter().map(Ok::<Bytes, io::Error>));
    let from_now_on = BroadcastStream::new(receiver).map(move |event| {
        let _as_long_as_it_watches = &viewer;
        Ok(event.unwrap_or_else(|BroadcastStreamRecvError::Lagged(missed)| {
            Bytes::from(format!("event: missed\ndata: {missed}\n\n"))
        }))
    });
    ([(CONTENT_TYPE, "text/event-stream")], Body::from_stream(before.chain(from_now_on))).into_response()
}

/// What is asked of an eye.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct EyeQuery {
    #[serde(default)]
    focus_dpt: f64,
    pupil_mm: Option<f32>,
}

/// The gaze that is asked for, or what is wrong with the query.
pub(super) fn gaze_of(query: Result<Query<EyeQuery>, QueryRejection>) -> Result<Gaze, String> {
    let Query(EyeQuery { focus_dpt, pupil_mm }) = query.map_err(|rejection| rejection.body_text())?;
    let focus = focus_of_an_eye(focus_dpt).map_err(|why| format!("focus_dpt: {why}"))?;
    let pupil = pupil_mm.map(human_pupil).transpose().map_err(|why| format!("pupil_mm: {why}"))?;
    Ok(Gaze { focus, pupil })
}

async fn eye_picture(State(shown): State<Shown>, query: Result<Query<EyeQuery>, QueryRejection>) -> Response {
    let gaze = match gaze_of(query) {
        Ok(gaze) => gaze,
        Err(why) => {
            shown.live.refused.count(Refused::Query);
            return (StatusCode::BAD_REQUEST, format!("{why}\n")).into_response();
        }
    };
    let Gaze { focus: Dioptres(focus_dpt), .. } = gaze;
    match shown.eye.look(gaze).await {
        Ok(seen) => {
            let header = |name, value: String| (HeaderName::from_static(name), value);
            let headers = [
                (CONTENT_TYPE, "image/png".to_owned()),
                header("holod-frame", seen.frame.to_string()),
                header("holod-made-for-mm", seen.made_for.mm().to_string()),
                header("holod-pupil-mm", seen.pupil.mm().to_string()),
                header("holod-focus-dpt", focus_dpt.to_string()),
            ];
            (headers, seen.png).into_response()
        }
        Err(why @ Blind::Busy) => {
            shown.live.refused.count(Refused::Busy);
            (StatusCode::TOO_MANY_REQUESTS, format!("{why}\n")).into_response()
        }
        Err(why) => (StatusCode::SERVICE_UNAVAILABLE, format!("{why}\n")).into_response(),
    }
}

async fn status(State(shown): State<Shown>) -> Response {
    let Some(published) = shown.live.snapshot.load_full() else { return over() };
    let stale = stale(host_now() - published.t);
    let now = SnapshotNow { snapshot: &published.snapshot, stale_s: stale.map(|age| age.as_secs_f64()) };
    let code = if stale.is_some() { StatusCode::SERVICE_UNAVAILABLE } else { StatusCode::OK };
    (code, Json(now)).into_response()
}

async fn figures(State(shown): State<Shown>) -> Response {
    ([(CONTENT_TYPE, metrics::CONTENT_TYPE)], metrics::text(&shown.registry)).into_response()
}

fn over() -> Response {
    (StatusCode::SERVICE_UNAVAILABLE, format!("{}\n", Blind::NoRun)).into_response()
}

#[cfg(test)]
mod tests {
    use std::io::Write;
    use std::os::unix::net::UnixStream;

    use std::io::Read;

    use holod_calibration::TimeNs;

    use super::super::live::{Batch, Light};
    use super::*;
    use crate::snapshot::Snapshot;

    /// Short, so that the test is; a viewer is never closed for being slow to read less than its socket takes.
    const SHORT: Duration = Duration::from_millis(200);

    fn until(what: &str, done: impl Fn() -> bool) {
        let t_end = Instant::now() + Duration::from_secs(60);
        while !done() {
            assert!(Instant::now() < t_end, "{what}");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// Serves `live` at a socket.
    fn served(path: &std::path::Path, live: &Arc<Live>, patience: Duration) -> Runtime {
        served_behind(Door::Open, path, live, patience)
    }

    fn served_behind(door: Door, path: &std::path::Path, live: &Arc<Live>, patience: Duration) -> Runtime {
        let runtime =
            tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_io().enable_time().build().unwrap();
        let inside = runtime.enter();
        let (listener, ..) = Listener::bind(&PageAddress::Unix(path.to_owned())).unwrap();
        let router = router(door, Arc::clone(live), EyeDesk::default());
        runtime.spawn(serve(listener, router, Arc::clone(live), patience));
        drop(inside);
        runtime
    }

    #[test]
    fn figures_of_a_loop_that_does_not_turn_are_told_from_those_of_one_that_does() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("page");
        let live = Arc::new(Live::default());
        let _runtime = served(&path, &live, PATIENCE);
        let get = |page: &str| {
            let mut stream = UnixStream::connect(&path).unwrap();
            write!(stream, "GET {page} HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n").unwrap();
            let mut answer = String::new();
            stream.read_to_string(&mut answer).unwrap();
            answer
        };
        let running = Snapshot { state: "running".into(), ..Snapshot::default() };
        live.publish(&running, host_now() + TimeNs(3_600_000_000_000));
        let now = get("/status.json");
        assert!(now.starts_with("HTTP/1.1 200") && now.contains("\"stale_s\":null"), "{now}");
        live.publish(&running, host_now() - TimeNs(60_000_000_000));
        let old = get("/status.json");
        assert!(old.starts_with("HTTP/1.1 503") && old.contains("\"state\":\"running\""), "{old}");
        assert!(old.contains("\"stale_s\":6"), "{old}");
        let figures = get("/metrics");
        assert!(figures.starts_with("HTTP/1.1 200") && figures.contains("\nholod_snapshot_age_seconds 6"), "{figures}");
    }

    #[test]
    fn connections_that_say_nothing_or_have_no_token_make_way_for_whoever_has_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("page");
        let live = Arc::new(Live::default());
        let _runtime = served_behind(Door::Token(Token("0123456789abcdef".into())), &path, &live, PATIENCE);
        let ask = |page: &str, token: &str| {
            let mut stream = UnixStream::connect(&path).unwrap();
            write!(stream, "GET {page} HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {token}\r\n\r\n").unwrap();
            let mut head = [0; 12];
            let _closed = stream.read_exact(&mut head);
            (stream, String::from_utf8_lossy(&head).into_owned())
        };
        let (viewer, watches) = ask("/events", "0123456789abcdef");
        assert_eq!(watches, "HTTP/1.1 200");
        let mut strangers = Vec::new();
        for _ in 0..CONNECTIONS / 2 {
            strangers.push(UnixStream::connect(&path).unwrap());
            strangers.push(ask("/metrics", "none").0);
        }
        assert_eq!(ask("/metrics", "0123456789abcdef").1, "HTTP/1.1 200");
        assert_eq!(live.viewers.load(Ordering::Relaxed), 1, "the viewer keeps its place");
        drop((viewer, strangers));
    }

    #[test]
    fn a_viewer_who_takes_nothing_loses_its_place() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("page");
        let live = Arc::new(Live::default());
        let _runtime = served(&path, &live, SHORT);
        let mut viewer = UnixStream::connect(&path).unwrap();
        viewer.write_all(b"GET /events HTTP/1.1\r\nHost: x\r\n\r\n").unwrap();
        let watching = || live.viewers.load(Ordering::Relaxed);
        until("it watches", || watching() == 1);

        live.hand_out(Batch::default());
        std::thread::sleep(5 * SHORT);
        assert_eq!(watching(), 1, "what its socket takes is taken");
        until("its place comes free", || {
            let light = (0..1000).map(|t| Light(f64::from(t), None, None)).collect();
            live.hand_out(Batch { light, ..Batch::default() });
            watching() == 0
        });
        drop(viewer);
    }
}

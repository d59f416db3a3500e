//! What the log on standard error says, by `HOLOD_LOG`; its newest lines for the status page, and a file of it.
//!
//! Whoever logs never waits: lines go to a thread for each place, which leaves out and counts what it does not get rid
//! of.

mod outlet;

use std::backtrace::{Backtrace, BacktraceStatus};
use std::collections::VecDeque;
use std::fmt::{self, Write};
use std::fs::File;
use std::io::{self, IsTerminal, Write as _};
use std::os::fd::AsFd;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, Once, OnceLock, PoisonError};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use serde::Serialize;
use tracing::field::{Field, Visit};
use tracing::{Event, Level, Subscriber};
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::layer::{Context, Layer, SubscriberExt};
use tracing_subscriber::util::SubscriberInitExt;

use self::outlet::Outlet;

/// How long the end of a process, a panic or a report waits for the lines before it.
const PATIENCE: Duration = Duration::from_secs(1);

/// The way to standard error, once [`start`] has been called.
static STDERR: OnceLock<Outlet> = OnceLock::new();

/// Starts the log on standard error, which says as much as `HOLOD_LOG` asks for. A standard error that nobody reads,
/// that is closed or full, stops nobody. It says panics, too, but for those that become an error of the GPU.
///
/// # Errors
/// The system gives no thread for it.
pub fn start() -> io::Result<()> {
    let asked = std::env::var_os("HOLOD_LOG").map(|asked| asked.to_string_lossy().into_owned());
    let (filter, complaint) = filter(asked.as_deref());
    // A descriptor of its own: whoever else writes to standard error takes a lock.
    match io::stderr().as_fd().try_clone_to_owned() {
        Ok(stderr) => drop(STDERR.set(Outlet::start("holod-log", File::from(stderr))?)),
        Err(_closed) => drop(STDERR.set(Outlet::start("holod-log", io::sink())?)),
    }
    std::panic::set_hook(Box::new(|panic| {
        if holod_model::gpu::panic_is_caught() {
            return;
        }
        let backtrace = Backtrace::capture();
        let backtrace = match backtrace.status() {
            BacktraceStatus::Captured => format!("\n{backtrace}"),
            _ => String::new(),
        };
        let thread = std::thread::current();
        say(&format!("thread `{}` {panic}{backtrace}", thread.name().unwrap_or("without a name")));
        if may_wait() {
            flush();
        }
    }));
    let lines = tracing_subscriber::fmt::layer()
        .with_writer(|| ToStderr)
        .with_ansi(io::stderr().is_terminal())
        .with_target(false);
    let kept = KeepRecent.with_filter(kept(&filter));
    tracing_subscriber::registry().with(lines.with_filter(filter)).with(kept).init();
    if let Some(complaint) = complaint {
        tracing::warn!("{complaint}");
    }
    Ok(())
}

/// A line on standard error, in order with those of the log.
pub fn say(text: &str) {
    let line = format!("{text}\n").into_bytes();
    match STDERR.get() {
        Some(stderr) => stderr.put(line),
        // Nobody is there to be told that it cannot be said.
        None => drop(io::stderr().write_all(&line)),
    }
}

/// Waits until all that was said on standard error is out, a second at most.
pub fn flush() {
    if let Some(stderr) = STDERR.get() {
        stderr.flush(PATIENCE);
    }
}

/// Lines that standard error has not taken since the process began.
pub fn lines_lost() -> u64 {
    STDERR.get().map_or(0, Outlet::lost)
}

/// Takes an event's line whole.
struct ToStderr;

impl io::Write for ToStderr {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        if let Some(stderr) = STDERR.get() {
            stderr.put(line.to_vec());
        }
        Ok(line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

const LEVELS: [&str; 6] = ["off", "error", "warn", "info", "debug", "trace"];
const DEFAULT: &str = "info";

/// The filter that `HOLOD_LOG` asks for: a level, or directives such as `holod_daemon=debug`, separated by commas, over
/// the usual `info`. With what is wrong with it, which is then left out.
pub fn filter(asked: Option<&str>) -> (Targets, Option<String>) {
    let (mut directives, mut wrong) = (Vec::new(), Vec::new());
    for directive in asked.unwrap_or_default().split(',').map(str::trim).filter(|directive| !directive.is_empty()) {
        let level = directive.rsplit_once('=').map_or(directive, |(_, level)| level).to_lowercase();
        let is_right = LEVELS.contains(&level.as_str()) && directive.parse::<Targets>().is_ok();
        if is_right { directives.push(directive) } else { wrong.push(directive) }
    }
    // A directive for a part of the program leaves the rest as it is.
    if directives.iter().all(|directive| directive.contains('=')) {
        directives.push(DEFAULT);
    }
    let complaint = (!wrong.is_empty()).then(|| {
        format!(
            "HOLOD_LOG: found `{}`, expected one of {}, or directives such as holod_daemon=debug; it is left out",
            wrong.join(","),
            LEVELS.join(", ")
        )
    });
    (directives.join(",").parse().expect("each directive is right"), complaint)
}

/// What the page and a record's file have: as much as standard error, and all from `info` up however quiet that is,
/// since they say afterwards what happened.
fn kept(filter: &Targets) -> Targets {
    let at_least_info = |level: LevelFilter| level.max(LevelFilter::INFO);
    let directives = filter.iter().map(|(target, level)| (target.to_owned(), at_least_info(level)));
    let others = at_least_info(filter.default_level().unwrap_or(LevelFilter::INFO));
    directives.collect::<Targets>().with_default(others)
}

/// A line of the log.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Line {
    /// Milliseconds since 1970, UTC, when it was said.
    pub unix_ms: u64,
    /// `INFO`, `WARN` or `ERROR`.
    pub level: &'static str,
    /// The message, without time and level.
    pub text: String,
}

impl Line {
    fn now(level: Level, text: String) -> Self {
        let unix_ms = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_millis() as u64);
        Self { unix_ms, level: level.as_str(), text }
    }

    fn to_bytes(&self) -> Vec<u8> {
        let at = UNIX_EPOCH + Duration::from_millis(self.unix_ms);
        format!("{} {:5} {}\n", humantime::format_rfc3339_millis(at), self.level, self.text).into_bytes()
    }
}

/// Keeps the newest lines in memory, from `info` up. Real-time threads do not log, so none of them waits here.
pub struct KeepRecent;

/// Lines that are kept.
const KEPT: usize = 200;

struct Kept {
    lines: VecDeque<Line>,
    /// How many there ever were.
    ever: u64,
}

static RECENT: Mutex<Kept> = Mutex::new(Kept { lines: VecDeque::new(), ever: 0 });

impl<S: Subscriber> Layer<S> for KeepRecent {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        let level = *event.metadata().level();
        let file = FILE.lock().unwrap_or_else(PoisonError::into_inner);
        if level > Level::INFO && file.is_none() {
            return;
        }
        let line = Line::now(level, text_of(event));
        if let Some(file) = &*file {
            file.put(line.to_bytes());
        }
        drop(file);
        if level > Level::INFO {
            return;
        }
        let mut kept = RECENT.lock().unwrap_or_else(PoisonError::into_inner);
        if kept.lines.len() == KEPT {
            kept.lines.pop_front();
        }
        kept.lines.push_back(line);
        kept.ever += 1;
    }
}

/// What an event says: its message, and its fields by name.
pub fn text_of(event: &Event<'_>) -> String {
    let mut text = Text(String::new());
    event.record(&mut text);
    text.0
}

/// The file that takes every line that is kept.
static FILE: Mutex<Option<Arc<Outlet>>> = Mutex::new(None);

/// The log goes into a file for as long as this lives.
#[derive(Debug)]
pub struct LogFile {
    path: PathBuf,
}

impl LogFile {
    /// Begins a file with the lines that are kept already.
    ///
    /// # Errors
    /// The file cannot be created, or the system gives no thread for it.
    pub fn begin(path: &Path) -> io::Result<Self> {
        let mut place = FILE.lock().unwrap_or_else(PoisonError::into_inner);
        let mut file = File::create(path)?;
        for line in recent_since(&mut 0) {
            file.write_all(&line.to_bytes())?;
        }
        *place = Some(Arc::new(Outlet::start("holod-record-log", file)?));
        keep_panics();
        Ok(Self { path: path.to_owned() })
    }

    /// Writes down what ended the run, which is said elsewhere.
    pub fn ended_by(&self, failure: &impl fmt::Display) {
        if let Some(file) = &*FILE.lock().unwrap_or_else(PoisonError::into_inner) {
            file.put(Line::now(Level::ERROR, failure.to_string()).to_bytes());
        }
    }

    /// Why a line could not be written, where one could not.
    pub fn trouble(&self) -> Option<String> {
        let file = FILE.lock().unwrap_or_else(PoisonError::into_inner);
        let error = file.as_ref()?.first_error()?;
        Some(format!("cannot go on recording into {}: {error}", self.path.display()))
    }

    /// Waits until all lines are in it, a second at most.
    pub fn flush(&self) {
        let file = FILE.lock().unwrap_or_else(PoisonError::into_inner).clone();
        if let Some(file) = file {
            file.flush(PATIENCE);
        }
    }

    /// Nothing goes into it any more. Waits for what is on its way, a second at most.
    pub fn end(&mut self) {
        let file = FILE.lock().unwrap_or_else(PoisonError::into_inner).take();
        if let Some(file) = file {
            file.flush(PATIENCE);
        }
    }
}

impl Drop for LogFile {
    fn drop(&mut self) {
        self.end();
    }
}

/// Writes panics down, too, before anything else is done about them.
fn keep_panics() {
    static KEPT: Once = Once::new();
    KEPT.call_once(|| {
        let before = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |panic| {
            // Whoever panics may hold it.
            let file = FILE.try_lock().ok().and_then(|file| file.clone());
            if let Some(file) = file {
                file.put(Line::now(Level::ERROR, panic.to_string()).to_bytes());
                if may_wait() {
                    file.flush(PATIENCE);
                }
            }
            before(panic);
        }));
    });
}

/// Whether a thread that panics may wait for its last words: not those that make the lasers dark as they unwind.
fn may_wait() -> bool {
    !matches!(std::thread::current().name(), Some("holod-laser" | "holod-panel"))
}

struct Text(String);

impl Visit for Text {
    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        let gap = if self.0.is_empty() { "" } else { " " };
        let written = match field.name() {
            "message" => write!(self.0, "{gap}{value:?}"),
            name => write!(self.0, "{gap}{name}={value:?}"),
        };
        written.expect("a string takes everything");
    }
}

/// The lines that are kept of those after the first `seen` ever, which then are all.
pub fn recent_since(seen: &mut u64) -> Vec<Line> {
    let kept = RECENT.lock().unwrap_or_else(PoisonError::into_inner);
    let new = (kept.ever - *seen).min(kept.lines.len() as u64) as usize;
    *seen = kept.ever;
    kept.lines.range(kept.lines.len() - new..).cloned().collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use tracing_subscriber::Registry;

    /// The lines that are kept are those of the whole process.
    static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());

    #[test]
    fn the_newest_lines_are_kept() {
        let _alone = ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner);
        tracing::subscriber::with_default(tracing_subscriber::registry().with(KeepRecent), || {
            let mut seen = 0;
            recent_since(&mut seen);
            tracing::info!(channel = 3, "first {}", 1);
            tracing::debug!("not kept");
            tracing::error!("second");
            let lines: Vec<_> = recent_since(&mut seen).into_iter().map(|line| (line.level, line.text)).collect();
            assert_eq!(lines, [("INFO", "first 1 channel=3".to_owned()), ("ERROR", "second".to_owned())]);
            assert!(recent_since(&mut seen).is_empty());
            for number in 0..KEPT + 10 {
                tracing::warn!("{number}");
            }
            let lines = recent_since(&mut seen);
            assert_eq!((lines.len(), lines[0].text.as_str()), (KEPT, "10"));
        });
    }

    #[test]
    fn a_file_has_what_was_said_before_it_and_how_the_run_ended() {
        let _alone = ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log.txt");
        tracing::subscriber::with_default(tracing_subscriber::registry().with(KeepRecent), || {
            tracing::warn!("said before the file");
            let mut log = LogFile::begin(&path).unwrap();
            tracing::debug!(frame = 4, "in it");
            log.ended_by(&"the panel was pulled out");
            let _ = std::panic::catch_unwind(|| panic!("a panic for the log"));
            log.end();
            tracing::warn!("said after its end");
        });
        let text = std::fs::read_to_string(path).unwrap();
        for line in ["WARN  said before the file", "DEBUG in it frame=4", "ERROR the panel was pulled out"] {
            assert!(text.contains(&format!("Z {line}\n")), "{line}: {text}");
        }
        assert!(text.contains("a panic for the log") && text.contains("logging.rs"), "{text}");
        assert!(!text.contains("said after its end"), "{text}");
    }

    fn most(asked: &str) -> (Option<LevelFilter>, bool) {
        let (filter, complaint) = filter(Some(asked));
        (Layer::<Registry>::max_level_hint(&filter), complaint.is_some())
    }

    #[test]
    fn however_quiet_standard_error_is_what_happened_is_kept() {
        let level = |asked: &str| Layer::<Registry>::max_level_hint(&kept(&filter(Some(asked)).0));
        for (asked, most) in [
            ("off", LevelFilter::INFO),
            ("error", LevelFilter::INFO),
            ("", LevelFilter::INFO),
            ("holod_daemon=off", LevelFilter::INFO),
            ("debug", LevelFilter::DEBUG),
            ("warn,holod_daemon=trace", LevelFilter::TRACE),
        ] {
            assert_eq!(level(asked), Some(most), "{asked}");
        }
        let quiet = kept(&filter(Some("holod_daemon=off")).0);
        assert!(quiet.would_enable("holod_daemon::run", &Level::INFO) && !quiet.would_enable("wgpu", &Level::DEBUG));
    }

    #[test]
    fn levels_and_directives_are_taken_and_a_typo_silences_nothing() {
        assert_eq!(most(""), (Some(LevelFilter::INFO), false));
        assert_eq!(most("debug"), (Some(LevelFilter::DEBUG), false));
        assert_eq!(most("WARN"), (Some(LevelFilter::WARN), false));
        assert_eq!(most("holod_daemon=trace"), (Some(LevelFilter::TRACE), false));
        assert_eq!(most("debgu"), (Some(LevelFilter::INFO), true));
        assert_eq!(most("holod_daemon=loud"), (Some(LevelFilter::INFO), true));
        assert_eq!(most("debgu,debug"), (Some(LevelFilter::DEBUG), true));
        assert!(filter(Some("debgu")).1.unwrap().contains("`debgu`"));
    }
}

//! What the log on standard error says, by `HOLOD_LOG`; its newest lines for the status page, and a file of it.

use std::collections::VecDeque;
use std::fmt::{self, Write};
use std::fs::File;
use std::io::{self, Write as _};
use std::path::Path;
use std::sync::{Mutex, Once, PoisonError};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use serde::Serialize;
use tracing::field::{Field, Visit};
use tracing::{Event, Level, Subscriber};
use tracing_subscriber::EnvFilter;
use tracing_subscriber::layer::{Context, Layer};

const LEVELS: [&str; 6] = ["off", "error", "warn", "info", "debug", "trace"];
const DEFAULT: &str = "info";

/// The filter that `HOLOD_LOG` asks for: a level, or directives such as `holod_daemon=debug`, separated by commas, over the
/// usual `info`. With what is wrong with it, which is then left out.
pub fn filter(asked: Option<&str>) -> (EnvFilter, Option<String>) {
    let (mut directives, mut wrong) = (Vec::new(), Vec::new());
    for directive in asked.unwrap_or_default().split(',').map(str::trim).filter(|directive| !directive.is_empty()) {
        let level = directive.rsplit_once('=').map_or(directive, |(_, level)| level).to_lowercase();
        let is_right =
            LEVELS.contains(&level.as_str()) && directive.parse::<tracing_subscriber::filter::Directive>().is_ok();
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
    (EnvFilter::new(directives.join(",")), complaint)
}

/// A line of the log.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Line {
    /// Milliseconds since 1970.
    pub unix_ms: u64,
    /// `INFO`, `WARN` or `ERROR`.
    pub level: &'static str,
    /// What it says.
    pub text: String,
}

impl Line {
    fn now(level: Level, text: String) -> Self {
        let unix_ms = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_millis() as u64);
        Self { unix_ms, level: level.as_str(), text }
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
        let mut file = FILE.lock().unwrap_or_else(PoisonError::into_inner);
        if level > Level::INFO && file.is_none() {
            return;
        }
        let line = Line::now(level, text_of(event));
        if let Some(file) = &mut *file {
            // A disk that refuses is told of by whoever records.
            let _ = write_line(file, &line);
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

/// The file that takes every line that the filter lets through.
static FILE: Mutex<Option<File>> = Mutex::new(None);

/// The log goes into a file for as long as this lives.
#[derive(Debug)]
pub struct LogFile(());

impl LogFile {
    /// Begins a file with the lines that are kept already.
    ///
    /// # Errors
    /// The file cannot be created.
    pub fn begin(path: &Path) -> io::Result<Self> {
        let mut place = FILE.lock().unwrap_or_else(PoisonError::into_inner);
        let mut file = File::create(path)?;
        for line in recent_since(&mut 0) {
            write_line(&mut file, &line)?;
        }
        *place = Some(file);
        keep_panics();
        Ok(Self(()))
    }

    /// Writes down what ended the run, which is said elsewhere.
    pub fn ended_by(&self, failure: &impl fmt::Display) {
        if let Some(file) = &mut *FILE.lock().unwrap_or_else(PoisonError::into_inner) {
            let _ = write_line(file, &Line::now(Level::ERROR, failure.to_string()));
        }
    }

    /// Nothing goes into it any more.
    pub fn end(&mut self) {
        *FILE.lock().unwrap_or_else(PoisonError::into_inner) = None;
    }
}

impl Drop for LogFile {
    fn drop(&mut self) {
        self.end();
    }
}

/// Writes panics down, too, before whoever else hears of them.
fn keep_panics() {
    static KEPT: Once = Once::new();
    KEPT.call_once(|| {
        let before = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |panic| {
            // Whoever panics may hold it.
            if let Ok(mut file) = FILE.try_lock()
                && let Some(file) = &mut *file
            {
                let _ = write_line(file, &Line::now(Level::ERROR, panic.to_string()));
            }
            before(panic);
        }));
    });
}

fn write_line(file: &mut File, line: &Line) -> io::Result<()> {
    let at = UNIX_EPOCH + Duration::from_millis(line.unix_ms);
    writeln!(file, "{} {:5} {}", humantime::format_rfc3339_millis(at), line.level, line.text)
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
    use tracing_subscriber::filter::LevelFilter;

    /// The lines that are kept are those of the whole process.
    static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());

    #[test]
    fn the_newest_lines_are_kept() {
        use tracing_subscriber::layer::SubscriberExt;
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
        use tracing_subscriber::layer::SubscriberExt;
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
        (filter.max_level_hint(), complaint.is_some())
    }

    #[test]
    fn levels_and_directives_are_taken_and_a_typo_silences_nothing() {
        assert_eq!(filter(None).0.max_level_hint(), Some(LevelFilter::INFO));
        assert_eq!(most("debug"), (Some(LevelFilter::DEBUG), false));
        assert_eq!(most("WARN"), (Some(LevelFilter::WARN), false));
        assert_eq!(most("holod_daemon=trace"), (Some(LevelFilter::TRACE), false));
        assert_eq!(most("debgu"), (Some(LevelFilter::INFO), true));
        assert_eq!(most("holod_daemon=loud"), (Some(LevelFilter::INFO), true));
        assert_eq!(most("debgu,debug"), (Some(LevelFilter::DEBUG), true));
        assert!(filter(Some("debgu")).1.unwrap().contains("`debgu`"));
    }
}

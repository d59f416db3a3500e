//! Long work without the interpreter's lock; errors, panics and warnings of Rust as Python's.

use std::ffi::CString;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use holod_daemon::failure::{Exit, Failure};
use holod_daemon::logging::text_of;
use pyo3::exceptions::PyOverflowError;
use pyo3::prelude::*;
use pyo3::{PyTypeInfo, import_exception};
use tracing::span;

import_exception!(holod.errors, HolodError);
import_exception!(holod.errors, InputError);
import_exception!(holod.errors, RigError);
import_exception!(holod.errors, UnavailableError);
import_exception!(holod.errors, HolodWarning);

/// Does `work` while other threads of Python run. What it warns of becomes Python's warnings, a panic an exception.
pub(crate) fn without_lock<T: Send>(py: Python<'_>, work: impl FnOnce() -> Result<T, Failure> + Send) -> PyResult<T> {
    let told = Arc::<Mutex<Vec<String>>>::default();
    let listener = Listener(Arc::clone(&told));
    let done = py.detach(|| tracing::subscriber::with_default(listener, || catch_unwind(AssertUnwindSafe(work))));
    let warnings = std::mem::take(&mut *told.lock().unwrap_or_else(PoisonError::into_inner));
    for warning in warnings {
        let text = CString::new(warning.replace('\0', " ")).expect("it has no zero byte any more");
        PyErr::warn(py, &HolodWarning::type_object(py), &text, 1)?;
    }
    match done {
        Ok(done) => done.map_err(|failure| exception(&failure)),
        Err(panic) => {
            let text = panic.downcast_ref::<String>().map(String::as_str);
            let text = text.or(panic.downcast_ref::<&str>().copied()).unwrap_or("no message");
            Err(HolodError::new_err(format!("a fault of holod itself: {text}; its place stands on standard error")))
        }
    }
}

/// [`without_lock`] for work that is shared out among rayon's threads or the graphics driver's. A process that was
/// forked after such work has none of them and would wait for them for ever, so there it is an error.
pub(crate) fn with_threads<T: Send>(py: Python<'_>, work: impl FnOnce() -> Result<T, Failure> + Send) -> PyResult<T> {
    static STARTED_IN: OnceLock<u32> = OnceLock::new();
    let process = std::process::id();
    if *STARTED_IN.get_or_init(|| process) != process {
        return Err(HolodError::new_err(
            "this process was forked from one in which holod had computed, and the threads that compute stayed there: \
             start processes with multiprocessing's \"spawn\" or \"forkserver\", or compute and make renderers in the \
             forked processes only",
        ));
    }
    without_lock(py, work)
}

/// Options of the command line that failures name, and the arguments that they are here.
const ARGUMENTS: [(&str, &str); 5] = [
    ("--backend", "backend"),
    ("with --depth-encoding", "by depth_encoding"),
    ("--depth-encoding", "depth_encoding"),
    ("--border-px", "border_px"),
    ("with --pupil", "by pupils_mm"),
];

/// A failure as an exception with its whole text.
pub(crate) fn exception(failure: &Failure) -> PyErr {
    let named = |text: String, (option, argument): (&str, &str)| text.replace(option, argument);
    let text = ARGUMENTS.into_iter().fold(failure.to_string(), named);
    match failure.exit {
        Exit::Config => RigError::new_err(text),
        Exit::Unavailable => UnavailableError::new_err(text),
        Exit::Software | Exit::Different | Exit::Output => HolodError::new_err(text),
        Exit::Usage | Exit::Data | Exit::NoInput | Exit::CannotCreate => InputError::new_err(text),
    }
}

/// A whole number from 0 on as an argument, or what was given in its place: Python's own error for a negative one is
/// none of this package's, and does not name the argument.
pub(crate) struct Count(Result<usize, String>);

impl Count {
    /// The number; `argument` is the name that a refusal gives it.
    pub(crate) fn of(self, argument: &str) -> PyResult<usize> {
        let expected = usize::MAX;
        self.0.map_err(|found| {
            InputError::new_err(format!("{argument}: found {found}, expected a whole number from 0 to {expected}"))
        })
    }
}

/// The number of an argument that may be left out.
pub(crate) fn optional_count(given: Option<Count>, argument: &str) -> PyResult<Option<usize>> {
    given.map(|count| count.of(argument)).transpose()
}

impl<'py> FromPyObject<'_, 'py> for Count {
    type Error = PyErr;

    fn extract(given: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        match given.extract::<usize>() {
            Err(error) if error.is_instance_of::<PyOverflowError>(given.py()) => Ok(Self(Err(given.to_string()))),
            extracted => extracted.map(|count| Self(Ok(count))),
        }
    }
}

/// Keeps what is warned of in the thread that it is set for.
struct Listener(Arc<Mutex<Vec<String>>>);

impl tracing::Subscriber for Listener {
    fn enabled(&self, metadata: &tracing::Metadata<'_>) -> bool {
        metadata.is_event() && *metadata.level() <= tracing::Level::WARN
    }

    fn event(&self, event: &tracing::Event<'_>) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).push(text_of(event));
    }

    fn new_span(&self, _: &span::Attributes<'_>) -> span::Id {
        span::Id::from_u64(1)
    }

    fn record(&self, _: &span::Id, _: &span::Record<'_>) {}

    fn record_follows_from(&self, _: &span::Id, _: &span::Id) {}

    fn enter(&self, _: &span::Id) {}

    fn exit(&self, _: &span::Id) {}
}

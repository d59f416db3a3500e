//! What ends holod early, with its exit code.

use std::fmt;

/// Exit codes, after BSD's sysexits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Exit {
    /// What was compared differs, as `cmp` says it.
    Different = 1,
    /// The command line asks for something that cannot be had.
    Usage = 64,
    /// An input file's content is wrong.
    Data = 65,
    /// An input file is missing or unreadable.
    NoInput = 66,
    /// A device or service is not there.
    Unavailable = 69,
    /// A fault of holod itself.
    Software = 70,
    /// An output cannot be created.
    CannotCreate = 73,
    /// Standard output takes no more.
    Output = 74,
    /// The rig file is wrong.
    Config = 78,
}

/// An error as the user sees it.
#[derive(Debug)]
pub struct Failure {
    /// The process's exit code.
    pub exit: Exit,
    message: String,
}

impl Failure {
    /// A failure that says `message`.
    pub fn new(exit: Exit, message: impl fmt::Display) -> Self {
        Self { exit, message: message.to_string() }
    }

    /// Turns any error into a failure with this exit code: `.map_err(Failure::because(Exit::Data))`.
    pub fn because<E: std::error::Error>(exit: Exit) -> impl Fn(E) -> Self {
        move |error| {
            let mut message = error.to_string();
            let mut source = error.source();
            while let Some(cause) = source {
                let cause_text = cause.to_string();
                if !message.contains(&cause_text) {
                    message.push_str(": ");
                    message.push_str(&cause_text);
                }
                source = cause.source();
            }
            Self { exit, message }
        }
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message)
    }
}

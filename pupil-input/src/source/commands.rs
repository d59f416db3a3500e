//! What a tracker has to be told before it sends, and before the link is closed; and that it has understood.

use std::io::{self, ErrorKind, Read};
use std::time::{Duration, Instant};

use super::{ByteSource, ReadEvent};
use crate::profile::Command;

/// How often a command is sent until its answer comes: a board that was reset when its port was opened is deaf to the
/// first.
const TRIES: u32 = 3;
/// An answer is looked for in the last bytes that came, this many and what one read brings.
const KEPT_BYTES: usize = 1 << 12;

/// A link that can be talked to.
pub(crate) trait Dialogue {
    /// Sends all of it or fails; does not wait for ever.
    fn send(&mut self, bytes: &[u8]) -> io::Result<()>;

    /// Waits for bytes, for a short while at most; 0 if none came. An error if the link is gone.
    fn receive(&mut self, buffer: &mut [u8]) -> io::Result<usize>;
}

/// Why a tracker did not do as it was told.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "the messages say what the fields are")]
pub enum CommandError {
    /// The link failed while a command went out or its answer was awaited.
    #[error("the link failed at `{command}`: {source}")]
    Link {
        /// What was to be sent, or had been.
        command: String,
        source: io::Error,
    },
    /// It did not answer, or something else.
    #[error("`{command}` was sent {TRIES} times and answered by {found}; expected `{expected}` within {within:?}")]
    NoAnswer {
        command: String,
        found: String,
        expected: String,
        /// For how long each answer was waited for.
        within: Duration,
    },
}

/// Sends each command and waits for its answer. Gives what came behind the last answer: the stream may have begun.
pub(crate) fn perform(link: &mut dyn Dialogue, commands: &[Command]) -> Result<Vec<u8>, CommandError> {
    let mut heard = Vec::new();
    for command in commands {
        heard.clear();
        let failed = |source| CommandError::Link { command: in_words(&command.send), source };
        let Some(expected) = &command.expect else {
            link.send(&command.send).map_err(failed)?;
            continue;
        };
        let mut told = String::new();
        let answered = (0..TRIES).try_fold(false, |answered, _| {
            if answered {
                return Ok(true);
            }
            link.send(&command.send)?;
            let answered = listen(link, expected, command.within, &mut heard)?;
            if !heard.is_empty() {
                told = in_words(&heard[heard.len().saturating_sub(80)..]);
            }
            Ok(answered)
        });
        if !answered.map_err(failed)? {
            return Err(CommandError::NoAnswer {
                command: in_words(&command.send),
                found: if told.is_empty() { "nothing".into() } else { format!("`{told}`") },
                expected: in_words(expected),
                within: command.within,
            });
        }
    }
    Ok(heard)
}

/// Waits until `expected` comes; `heard` is then what stands behind it, else the last that came.
fn listen(link: &mut dyn Dialogue, expected: &[u8], within: Duration, heard: &mut Vec<u8>) -> io::Result<bool> {
    let until = Instant::now() + within;
    let mut buffer = [0; 1024];
    loop {
        if let Some(at) = heard.windows(expected.len().max(1)).position(|window| window == expected) {
            heard.drain(..at + expected.len());
            return Ok(true);
        }
        if Instant::now() >= until {
            return Ok(false);
        }
        let count = link.receive(&mut buffer)?;
        heard.drain(..heard.len().saturating_sub(KEPT_BYTES));
        heard.extend(&buffer[..count]);
    }
}

/// What comes within `during`, the first bytes of it.
pub(crate) fn overhear(link: &mut dyn Dialogue, during: Duration) -> io::Result<Vec<u8>> {
    let until = Instant::now() + during;
    let mut heard = Vec::new();
    let mut buffer = [0; 1024];
    while Instant::now() < until && heard.len() < KEPT_BYTES {
        let count = link.receive(&mut buffer)?;
        heard.extend(&buffer[..count]);
    }
    Ok(heard)
}

/// A link that was told to start. Dropping it tells it to stop.
pub(crate) struct StartedLink<L: Dialogue> {
    link: L,
    /// What came behind the answer to the last command.
    pending: Vec<u8>,
    stop: Vec<Command>,
    gone: bool,
}

impl<L: Dialogue> StartedLink<L> {
    /// Tells it to start.
    pub(crate) fn start(link: L, start: &[Command], stop: &[Command]) -> Result<Self, CommandError> {
        // From here on it is told to stop whatever happens.
        let mut this = Self { link, pending: Vec::new(), stop: stop.into(), gone: false };
        this.pending = perform(&mut this.link, start)?;
        Ok(this)
    }
}

impl<L: Dialogue + Send> ByteSource for StartedLink<L> {
    fn read(&mut self, buffer: &mut [u8]) -> ReadEvent {
        if !self.pending.is_empty() {
            let count = self.pending.len().min(buffer.len());
            buffer[..count].copy_from_slice(&self.pending[..count]);
            self.pending.drain(..count);
            return ReadEvent::Bytes(count);
        }
        match self.link.receive(buffer) {
            Ok(0) => ReadEvent::Silence,
            Ok(count) => ReadEvent::Bytes(count),
            Err(_) => {
                self.gone = true;
                ReadEvent::Gone
            }
        }
    }
}

impl<L: Dialogue> Drop for StartedLink<L> {
    fn drop(&mut self) {
        if !self.gone {
            // Nobody is left to be told that it did not stop; the next start begins with the start commands again.
            let _ = perform(&mut self.link, &self.stop);
        }
    }
}

/// Bytes as people read them.
pub(crate) fn in_words(bytes: &[u8]) -> String {
    bytes.escape_ascii().to_string()
}

/// What a link that waits for a while at most has brought: 0 bytes where that was nothing.
pub(crate) fn receive_from(link: &mut impl Read, buffer: &mut [u8]) -> io::Result<usize> {
    match link.read(buffer) {
        // End of file: a peer that has hung up. Some serial drivers tell an unplugged device in this way, at once and
        // for ever.
        Ok(0) => Err(hung_up()),
        Ok(count) => Ok(count),
        Err(error) => match error.kind() {
            ErrorKind::TimedOut | ErrorKind::WouldBlock | ErrorKind::Interrupted => Ok(0),
            _ => Err(error),
        },
    }
}

/// The error of a peer that has hung up.
fn hung_up() -> io::Error {
    io::Error::new(ErrorKind::UnexpectedEof, "the other end has hung up")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A tracker that answers the given command, after a number of deaf tries, in pieces.
    struct Script {
        deaf: u32,
        answers: Vec<(&'static [u8], Vec<&'static [u8]>)>,
        pending: Vec<&'static [u8]>,
        sent: Vec<Vec<u8>>,
    }

    impl Dialogue for Script {
        fn send(&mut self, bytes: &[u8]) -> io::Result<()> {
            self.sent.push(bytes.to_vec());
            if self.deaf > 0 {
                self.deaf -= 1;
            } else if let Some((_, answer)) = self.answers.iter().find(|(command, _)| *command == bytes) {
                self.pending = answer.iter().rev().copied().collect();
            }
            Ok(())
        }

        fn receive(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
            let Some(piece) = self.pending.pop() else { return Ok(0) };
            buffer[..piece.len()].copy_from_slice(piece);
            Ok(piece.len())
        }
    }

    fn command(send: &[u8], expect: Option<&[u8]>) -> Command {
        Command { send: send.into(), expect: expect.map(Into::into), within: Duration::from_millis(20) }
    }

    fn script(deaf: u32) -> Script {
        let answers = vec![(&b"start\r"[..], vec![&b"noise O"[..], b"K\rsam", b"ple"]), (b"bad\r", vec![b"ERR\x01"])];
        Script { deaf, answers, pending: Vec::new(), sent: Vec::new() }
    }

    #[test]
    fn an_answer_in_pieces_is_found_and_what_follows_is_kept() {
        let mut link = script(0);
        let commands = [command(b"hello\r", None), command(b"start\r", Some(b"OK\r"))];
        assert_eq!(perform(&mut link, &commands).expect("understood"), b"sam");
        assert_eq!(link.sent, [&b"hello\r"[..], b"start\r"]);
    }

    #[test]
    fn a_deaf_tracker_is_told_again_and_not_for_ever() {
        let start = [command(b"start\r", Some(b"OK\r"))];
        let mut link = script(TRIES - 1);
        perform(&mut link, &start).expect("understood at last");
        assert_eq!(link.sent.len(), TRIES as usize);
        let error = perform(&mut script(TRIES), &start).expect_err("never answers").to_string();
        assert_eq!(error, "`start\\r` was sent 3 times and answered by nothing; expected `OK\\r` within 20ms");
        let error = perform(&mut script(0), &[command(b"bad\r", Some(b"OK"))]).expect_err("another answer").to_string();
        assert!(error.contains("answered by `ERR\\x01ERR\\x01ERR\\x01`"), "{error}");
    }

    #[test]
    fn a_talkative_stranger_fills_no_memory() {
        struct Endless;
        impl Dialogue for Endless {
            fn send(&mut self, _: &[u8]) -> io::Result<()> {
                Ok(())
            }
            fn receive(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
                buffer.fill(b'x');
                Ok(buffer.len())
            }
        }
        let mut heard = Vec::new();
        assert!(!listen(&mut Endless, b"OK", Duration::from_millis(20), &mut heard).expect("goes on"));
        assert!(heard.len() <= KEPT_BYTES + 1024);
        assert!(overhear(&mut Endless, Duration::from_secs(60)).expect("ends early").len() <= KEPT_BYTES + 1024);
    }
}

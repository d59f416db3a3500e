//! The other end of the control socket.

use std::io::{self, ErrorKind, Read, Write};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::time::{Duration, Instant};

use serde_json::Value;

use super::{Answer, Request};
use crate::failure::{Exit, Failure};
use crate::local_socket::connect_within;

/// Longer than a scene of the largest size takes to read.
const LONG_PATIENCE: Duration = Duration::from_secs(120);
/// For orders that read nothing: holod itself answers after 5 s where its control thread does not.
const PATIENCE: Duration = Duration::from_secs(8);
/// Bytes of the longest answer.
const LONGEST: usize = 1 << 20;
/// A holod that turns lets everybody in within this time.
const CONNECT_PATIENCE: Duration = Duration::from_secs(3);

/// Asks the holod that listens at `socket`, and waits for its answer.
///
/// # Errors
/// It is not there, or refuses.
pub fn ask(socket: &Path, request: &Request) -> Result<Value, Failure> {
    let gone = |error: std::io::Error| {
        Failure::new(
            Exit::Unavailable,
            format!(
                "{}: holod does not answer there: {error}; `holod dark --config RIG` puts the lasers out beside it",
                socket.display()
            ),
        )
    };
    let unanswered = |error: std::io::Error| {
        Failure::new(
            Exit::Unavailable,
            format!(
                "{}: holod has the order and does not answer: {error}; whether it took effect, or still will, is not \
                 known: ask `holod status`; `holod dark --config RIG` puts the lasers out beside it",
                socket.display()
            ),
        )
    };
    let patience = if request.takes_long() { LONG_PATIENCE } else { PATIENCE };
    let mut stream = connect_within(socket, CONNECT_PATIENCE).map_err(gone)?;
    let mut line = serde_json::to_vec(request).map_err(Failure::because(Exit::Software))?;
    line.push(b'\n');
    stream.write_all(&line).map_err(gone)?;
    let answer = read_line(&mut stream, patience).map_err(unanswered)?;
    match serde_json::from_slice(&answer) {
        Ok(Answer::Ok(value)) => Ok(value),
        Ok(Answer::Error(why) | Answer::Unanswered(why)) => Err(Failure::new(Exit::Unavailable, why)),
        Err(_) => Err(unanswered(std::io::ErrorKind::UnexpectedEof.into())),
    }
}

/// One line, as far as it comes before the end of the stream.
///
/// # Errors
/// It is too long, or does not come within `patience`.
fn read_line(stream: &mut UnixStream, patience: Duration) -> io::Result<Vec<u8>> {
    let t_end = Instant::now() + patience;
    let mut line = Vec::new();
    let mut part = [0; 1 << 12];
    while !line.ends_with(b"\n") {
        let left = t_end.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return Err(io::Error::other(format!("nothing came for {} s", patience.as_secs())));
        }
        stream.set_read_timeout(Some(left))?;
        match stream.read(&mut part) {
            Ok(0) => break,
            Ok(length) => line.extend_from_slice(&part[..length]),
            Err(error) if matches!(error.kind(), ErrorKind::Interrupted | ErrorKind::WouldBlock) => {}
            Err(error) => return Err(error),
        }
        if line.len() > LONGEST {
            return Err(io::Error::other(format!("its answer is longer than {LONGEST} bytes: is it holod?")));
        }
    }
    Ok(line)
}

#[cfg(test)]
mod tests {
    use std::io::{BufRead, BufReader};
    use std::os::unix::net::UnixListener;

    use super::*;

    #[test]
    fn a_holod_that_hangs_and_lets_nobody_in_is_told_with_what_puts_the_lasers_out() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("control");
        let listener = UnixListener::bind(&path).unwrap();
        rustix::net::listen(&listener, 0).unwrap();
        let _waiting = connect_within(&path, CONNECT_PATIENCE).unwrap();
        let hangs = ask(&path, &Request::LasersDark {}).unwrap_err().to_string();
        assert!(hangs.contains("lets nobody in; `holod dark --config RIG`"), "{hangs}");
    }

    #[test]
    fn an_order_that_nobody_has_heard_is_told_from_one_without_an_answer() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("control");
        let listener = UnixListener::bind(&path).unwrap();
        let holod = std::thread::spawn(move || {
            let (stream, _) = listener.accept().unwrap();
            let mut order = String::new();
            BufReader::new(stream).read_line(&mut order).unwrap();
            order
        });
        let unanswered = ask(&path, &Request::Pause {}).unwrap_err().to_string();
        assert!(holod.join().unwrap().contains("pause") && unanswered.contains("is not known"), "{unanswered}");
        let unheard = ask(&path, &Request::Pause {}).unwrap_err().to_string();
        assert!(unheard.contains("does not answer there") && !unheard.contains("is not known"), "{unheard}");
    }

    #[test]
    fn an_answer_without_an_end_is_given_up() {
        let (mut ours, mut theirs) = UnixStream::pair().unwrap();
        let sends = std::thread::spawn(move || while theirs.write_all(&[b'x'; 4096]).is_ok() {});
        let late = PATIENCE;
        assert!(read_line(&mut ours, late).unwrap_err().to_string().contains("longer than 1048576 bytes"));
        drop(ours);
        sends.join().unwrap();
        let (mut ours, mut theirs) = UnixStream::pair().unwrap();
        theirs.write_all(b"{").unwrap();
        assert!(read_line(&mut ours, Duration::ZERO).is_err(), "no byte is waited for beyond the end");
        theirs.write_all(b"}\n").unwrap();
        assert_eq!(read_line(&mut ours, late).unwrap(), b"{}\n");
    }
}

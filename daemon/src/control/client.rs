//! The other end of the control socket.

use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::time::Duration;

use serde_json::Value;

use super::{Answer, Request};
use crate::failure::{Exit, Failure};
use crate::local_socket::connect_within;

/// Longer than a scene of the largest size takes to read.
const PATIENCE: Duration = Duration::from_secs(120);
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
    let mut stream = connect_within(socket, CONNECT_PATIENCE).map_err(gone)?;
    stream.set_read_timeout(Some(PATIENCE)).map_err(gone)?;
    let mut line = serde_json::to_vec(request).map_err(Failure::because(Exit::Software))?;
    line.push(b'\n');
    stream.write_all(&line).map_err(gone)?;
    let mut answer = String::new();
    BufReader::new(stream).read_line(&mut answer).map_err(unanswered)?;
    match serde_json::from_str(&answer) {
        Ok(Answer::Ok(value)) => Ok(value),
        Ok(Answer::Error(why) | Answer::Unanswered(why)) => Err(Failure::new(Exit::Unavailable, why)),
        Err(_) => Err(unanswered(std::io::ErrorKind::UnexpectedEof.into())),
    }
}

#[cfg(test)]
mod tests {
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
}

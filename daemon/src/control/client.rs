//! The other end of the control socket.

use std::io::{BufRead, BufReader, Write};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::time::Duration;

use serde_json::Value;

use super::{Answer, Request};
use crate::failure::{Exit, Failure};

/// Longer than a scene of the largest size takes to read.
const PATIENCE: Duration = Duration::from_secs(120);

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
    let mut stream = UnixStream::connect(socket).map_err(gone)?;
    stream.set_read_timeout(Some(PATIENCE)).map_err(gone)?;
    let mut line = serde_json::to_vec(request).map_err(Failure::because(Exit::Software))?;
    line.push(b'\n');
    stream.write_all(&line).map_err(gone)?;
    let mut answer = String::new();
    BufReader::new(stream).read_line(&mut answer).map_err(gone)?;
    match serde_json::from_str(&answer) {
        Ok(Answer::Ok(value)) => Ok(value),
        Ok(Answer::Error(why)) => Err(Failure::new(Exit::Unavailable, why)),
        Err(_) => Err(gone(std::io::ErrorKind::UnexpectedEof.into())),
    }
}

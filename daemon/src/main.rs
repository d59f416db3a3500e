//! holod: drives a holographic near-eye display in real time.

use std::io::IsTerminal;
use std::process::ExitCode;

use clap::Parser;
use holod_daemon::{cli::Cli, commands, logging};
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;

fn main() -> ExitCode {
    let cli = Cli::try_parse().unwrap_or_else(|error| {
        let code = if error.use_stderr() { 64 } else { 0 };
        let _ = error.print();
        std::process::exit(code)
    });
    let asked = std::env::var_os("HOLOD_LOG").map(|asked| asked.to_string_lossy().into_owned());
    let (filter, complaint) = logging::filter(asked.as_deref());
    let lines = tracing_subscriber::fmt::layer()
        .with_writer(std::io::stderr)
        .with_ansi(std::io::stderr().is_terminal())
        .with_target(false);
    tracing_subscriber::registry().with(filter).with(lines).with(logging::KeepRecent).init();
    if let Some(complaint) = complaint {
        tracing::warn!("{complaint}");
    }
    match commands::dispatch(cli) {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            eprintln!("holod: error: {failure}");
            ExitCode::from(failure.exit as u8)
        }
    }
}

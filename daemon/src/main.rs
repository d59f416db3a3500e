//! holod: drives a holographic near-eye display in real time.

use std::io;
use std::process::ExitCode;
use std::sync::Arc;

use clap::Parser;
use holod_daemon::failure::{Exit, Failure};
use holod_daemon::{cli::Cli, commands, logging};

fn main() -> ExitCode {
    keep_vulkan_from_desktop();
    let cli = Cli::try_parse().unwrap_or_else(|error| {
        let code = if error.use_stderr() { 64 } else { 0 };
        let _ = error.print();
        std::process::exit(code)
    });
    let started = logging::start().and_then(|()| outlive_file_limits()).map_err(Failure::because(Exit::Unavailable));
    let ended = started.and_then(|()| commands::dispatch(cli));
    let code = match ended {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            logging::say(&format!("holod: error: {failure}"));
            ExitCode::from(failure.exit as u8)
        }
    };
    logging::flush();
    code
}

/// Keeps a layer of Mesa's Vulkan from asking the desktop which graphics processor it uses: holod chooses its own. A
/// display server that hangs would be waited for without end, also by commands that show nothing; and where none can be
/// reached the layer says so for each device that is opened, as an error without a name.
fn keep_vulkan_from_desktop() {
    let is_set = |name| std::env::var_os(name).is_some();
    if !["NODEVICE_SELECT", "MESA_VK_DEVICE_SELECT"].into_iter().any(is_set) {
        // SAFETY: no other thread has been started, so nobody reads the environment meanwhile.
        unsafe { std::env::set_var("NODEVICE_SELECT", "1") };
    }
}

/// Makes a file that grows beyond the user's limit (`ulimit -f`) an error of whoever writes it, and not the process's
/// end.
fn outlive_file_limits() -> io::Result<()> {
    signal_hook::flag::register(libc::SIGXFSZ, Arc::default()).map(drop)
}

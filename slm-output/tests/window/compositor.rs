//! A Wayland compositor of a test's own, with two monitors without glass.

use std::fs;
use std::os::unix::fs::{PermissionsExt, chown};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};

use super::bench::wait_until;

/// The monitor that is a panel, and the other one.
pub(crate) const PANEL: &str = "HEADLESS-2";
pub(crate) const OTHER: &str = "HEADLESS-1";

const CONFIGURATION: &str = "\
output HEADLESS-1 mode --custom 800x600@60Hz pos 0 0
output HEADLESS-2 mode --custom 640x480@60Hz pos 800 0
default_border none
xwayland disable
";

/// The user without rights, whom a compositor that refuses root is run as.
const NOBODY: u32 = 65_534;

/// A running compositor; killed when it is dropped.
pub(crate) struct Compositor {
    process: Child,
    folder: tempfile::TempDir,
    monitors: u8,
}

impl Compositor {
    /// A compositor with the panel and another monitor.
    pub(crate) fn start() -> Self {
        Self::with_monitors(2)
    }

    pub(crate) fn with_monitors(monitors: u8) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        fs::write(folder.path().join("config"), CONFIGURATION).expect("a file");
        let mut compositor = Self { process: Self::process(&folder, monitors), folder, monitors };
        compositor.wait();
        compositor
    }

    fn process(folder: &tempfile::TempDir, monitors: u8) -> Child {
        let mut command = if rustix::process::geteuid().is_root() {
            fs::set_permissions(folder.path(), fs::Permissions::from_mode(0o700)).expect("a folder of one's own");
            chown(folder.path(), Some(NOBODY), Some(NOBODY)).expect("root may give a folder away");
            let mut command = Command::new("setpriv");
            command.args([&format!("--reuid={NOBODY}"), &format!("--regid={NOBODY}"), "--clear-groups", "sway"]);
            command
        } else {
            Command::new("sway")
        };
        command
            .arg("--config")
            .arg(folder.path().join("config"))
            .env("XDG_RUNTIME_DIR", folder.path())
            .env("WLR_HEADLESS_OUTPUTS", monitors.to_string())
            .env("WLR_BACKENDS", "headless")
            .envs([("WLR_RENDERER", "pixman"), ("WLR_LIBINPUT_NO_DEVICES", "1")])
            .env_remove("DISPLAY")
            .env_remove("WAYLAND_DISPLAY")
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap_or_else(|why| panic!("{command:?}: {why}; tests/all installs what the tests need"))
    }

    fn wait(&mut self) {
        assert!(wait_until(|| self.try_ask("nop")), "sway does not come up");
    }

    /// Where it is reached.
    pub(crate) fn socket(&self) -> PathBuf {
        self.folder.path().join("wayland-1")
    }

    /// Ends it at once, as a crash would.
    pub(crate) fn kill(&mut self) {
        self.process.kill().expect("the compositor is there");
        self.process.wait().expect("it ends");
        for entry in fs::read_dir(self.folder.path()).expect("a folder").flatten() {
            if entry.file_name() != "config" {
                fs::remove_file(entry.path()).expect("a socket can be removed");
            }
        }
    }

    /// Starts it again, after its end.
    pub(crate) fn restart(&mut self) {
        self.process = Self::process(&self.folder, self.monitors);
        self.wait();
    }

    /// Has it do something, in its own words.
    pub(crate) fn ask(&self, what: &str) {
        assert!(self.try_ask(what), "sway does not do: {what}");
    }

    fn try_ask(&self, what: &str) -> bool {
        let is_ipc = |name: &str| name.starts_with("sway-ipc");
        let entries = fs::read_dir(self.folder.path()).expect("a folder").flatten();
        let Some(ipc) = entries
            .map(|entry| entry.path())
            .find(|path| path.file_name().and_then(|name| name.to_str()).is_some_and(is_ipc))
        else {
            return false;
        };
        let status = Command::new("swaymsg")
            .arg("--socket")
            .arg(ipc)
            .arg("--")
            .arg(what)
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .status()
            .unwrap_or_else(|why| panic!("swaymsg: {why}; tests/all installs what the tests need"));
        status.success()
    }

    /// What a monitor shows: blue, green, red and an unused byte for each pixel.
    pub(crate) fn picture(&self, monitor: &str) -> Vec<u8> {
        let output = Command::new("grim")
            .args(["-o", monitor, "-t", "ppm", "-"])
            .env("XDG_RUNTIME_DIR", self.folder.path())
            .env("WAYLAND_DISPLAY", "wayland-1")
            .output()
            .unwrap_or_else(|why| panic!("grim: {why}; tests/all installs what the tests need"));
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        // Three lines of text, the last of which is the highest level, and then the pixels.
        let header = output.stdout.split_inclusive(|&byte| byte == b'\n').take(3).map(<[u8]>::len).sum::<usize>();
        output.stdout[header..].chunks_exact(3).flat_map(|pixel| [pixel[2], pixel[1], pixel[0], 0]).collect()
    }
}

impl Drop for Compositor {
    fn drop(&mut self) {
        let _ended = self.process.kill();
        let _ended = self.process.wait();
    }
}

//! An X server of a test's own: two dummy monitors, a look at what they show, and what a desktop's tools do to them.

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};

use super::bench::wait_until;
use x11rb::connection::Connection;
use x11rb::protocol::randr::{self, ConnectionExt as _, SetConfig};
use x11rb::protocol::xproto::{AtomEnum, ClientMessageEvent, ConnectionExt as _, EventMask, ImageFormat, PropMode};
use x11rb::rust_connection::RustConnection;

/// Where a monitor is and what it shows: left, top, width, height, in pixels.
pub(crate) type Place = (i16, i16, u16, u16);

/// A running X server; killed when it is dropped.
pub(crate) struct Desktop {
    server: Child,
    pub(crate) name: String,
    pub(crate) x: RustConnection,
    pub(crate) root: u32,
    kind: Kind,
    folder: Option<tempfile::TempDir>,
}

#[derive(Clone, Copy)]
enum Kind {
    Xorg,
    Xvfb,
}

const CONFIGURATION: &str = r#"
Section "ServerFlags"
    Option "AutoAddDevices" "false"
    Option "AutoEnableDevices" "false"
    Option "AutoAddGPU" "false"
    Option "AutoBindGPU" "false"
    Option "BlankTime" "0"
EndSection
Section "Device"
    Identifier "card"
    Driver "dummy"
    VideoRam 65536
EndSection
Section "Monitor"
    Identifier "monitor"
    HorizSync 5-1000
    VertRefresh 5-1000
EndSection
Section "Screen"
    Identifier "screen"
    Device "card"
    Monitor "monitor"
    DefaultDepth 24
    SubSection "Display"
        Depth 24
        Virtual 2560 1024
    EndSubSection
EndSection
"#;

/// The desktop's main monitor, and the one that is a panel.
pub(crate) const MAIN: &str = "DUMMY0";
pub(crate) const PANEL: &str = "DUMMY1";
/// The panel's pixels.
pub(crate) const PANEL_SIZE: (u16, u16) = (640, 480);
pub(crate) const MAIN_PLACE: Place = (0, 0, 800, 600);
pub(crate) const PANEL_PLACE: Place = (800, 0, PANEL_SIZE.0, PANEL_SIZE.1);

const UPRIGHT: randr::Rotation = randr::Rotation::ROTATE0;

impl Desktop {
    /// An X server whose primary monitor has the panel on its right.
    pub(crate) fn with_two_monitors() -> Self {
        let desktop = Self::xorg();
        desktop.lay_out();
        desktop
    }

    fn lay_out(&self) {
        self.place(MAIN, MAIN_PLACE, 60.0);
        self.place(PANEL, PANEL_PLACE, 60.0);
        self.set_primary(Some(MAIN));
    }

    /// An X server of the `dummy` driver, as it comes up.
    fn xorg() -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        std::fs::write(folder.path().join("xorg.conf"), CONFIGURATION).expect("a file");
        Self::start(Kind::Xorg, folder, None)
    }

    /// A server without a primary monitor or refresh rates that change.
    pub(crate) fn xvfb() -> Self {
        Self::start(Kind::Xvfb, tempfile::tempdir().expect("a folder"), None)
    }

    /// Starts the server, on the display `name` or on any that is free.
    fn start(kind: Kind, folder: tempfile::TempDir, name: Option<&str>) -> Self {
        let mut command = match kind {
            Kind::Xorg => {
                let mut command = Command::new("Xorg");
                command.args(["-novtswitch", "-sharevts", "-config"]).arg(folder.path().join("xorg.conf"));
                command.arg("-logfile").arg(folder.path().join("xorg.log"));
                command
            }
            Kind::Xvfb => {
                let mut command = Command::new("Xvfb");
                command.args(["-screen", "0", "640x480x24"]);
                command
            }
        };
        command.args(name).args(["-noreset", "-nolisten", "tcp", "-displayfd", "1"]);
        let what = format!("{command:?}");
        let mut server = command
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap_or_else(|why| panic!("{what}: {why}; tests/all installs what the tests need"));
        let mut number = String::new();
        let stdout = server.stdout.take().expect("a pipe");
        BufReader::new(stdout).read_line(&mut number).expect("a pipe can be read");
        let name = format!(":{}", number.trim());
        assert!(name.len() > 1, "{what} does not come up");
        let (x, screen) = x11rb::connect(Some(&name)).expect("a connection");
        let root = x.setup().roots[screen].root;
        Self { kind, server, name, x, root, folder: Some(folder) }
    }

    /// The same server again, after its end.
    pub(crate) fn restart(&mut self) {
        let folder = self.folder.take().expect("a desktop has a folder");
        *self = Self::start(self.kind, folder, Some(&self.name));
        self.lay_out();
    }

    /// A small window manager, once it is at work.
    pub(crate) fn window_manager(&self) -> Child {
        let child = self.run("openbox", &["--sm-disable"]);
        let check = self.atom("_NET_SUPPORTING_WM_CHECK");
        let at_work = || {
            let name = self.x.get_property(false, self.root, check, AtomEnum::WINDOW, 0, 1).unwrap().reply().unwrap();
            let window = name.value32().and_then(|mut windows| windows.next());
            window.is_some_and(|window| self.x.get_geometry(window).unwrap().reply().is_ok())
        };
        assert!(wait_until(at_work), "openbox does not come up");
        child
    }

    /// Ends the server at once, as a crash would.
    pub(crate) fn kill(&mut self) {
        self.server.kill().expect("the server is there");
        self.server.wait().expect("it ends");
    }

    /// Lets the server hang: it keeps its connections and answers nobody.
    pub(crate) fn suspend(&self) {
        let server = rustix::process::Pid::from_child(&self.server);
        rustix::process::kill_process(server, rustix::process::Signal::STOP).expect("the server is there");
    }

    /// Runs a program that finds this desktop in its environment.
    pub(crate) fn run(&self, program: &str, arguments: &[&str]) -> Child {
        Command::new(program)
            .args(arguments)
            .env("DISPLAY", &self.name)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap_or_else(|why| panic!("{program}: {why}; tests/all installs what the tests need"))
    }

    fn resources(&self) -> randr::GetScreenResourcesCurrentReply {
        self.x.randr_get_screen_resources_current(self.root).unwrap().reply().unwrap()
    }

    fn output(&self, name: &str) -> (u32, randr::GetOutputInfoReply) {
        let outputs = self.resources().outputs;
        let info = |output: u32| self.x.randr_get_output_info(output, 0).unwrap().reply().unwrap();
        outputs
            .into_iter()
            .map(|output| (output, info(output)))
            .find(|(_, info)| info.name == name.as_bytes())
            .unwrap_or_else(|| panic!("no output {name}"))
    }

    /// Switches a monitor on at `place`, at about `refresh_hz`, as `xrandr --output NAME --mode SIZE --pos X` does.
    pub(crate) fn place(&self, name: &str, (left, top, width, height): Place, refresh_hz: f64) {
        let resources = self.resources();
        let rate =
            |mode: &randr::ModeInfo| f64::from(mode.dot_clock) / (f64::from(mode.htotal) * f64::from(mode.vtotal));
        let mode = resources
            .modes
            .iter()
            .filter(|mode| (mode.width, mode.height) == (width, height))
            .min_by(|a, b| (rate(a) - refresh_hz).abs().total_cmp(&(rate(b) - refresh_hz).abs()))
            .unwrap_or_else(|| panic!("no mode of {width}x{height}"));
        let (output, info) = self.output(name);
        if !info.modes.contains(&mode.id) {
            self.x.randr_add_output_mode(output, mode.id).unwrap().check().unwrap();
        }
        self.x.randr_set_screen_size(self.root, 2560, 1024, 677, 271).unwrap().check().unwrap();
        let crtc = if info.crtc != 0 { info.crtc } else { info.crtcs[0] };
        let set = self.x.randr_set_crtc_config(crtc, 0, 0, left, top, mode.id, UPRIGHT, &[output]).unwrap();
        assert_eq!(set.reply().unwrap().status, SetConfig::SUCCESS, "{name}");
        // The driver finds an output connected when it is asked, and it has modes.
        self.x.randr_get_screen_resources(self.root).unwrap().reply().unwrap();
    }

    /// Switches a monitor off, which is what unplugging it comes to.
    pub(crate) fn switch_off(&self, name: &str) {
        let (_, info) = self.output(name);
        let set = self.x.randr_set_crtc_config(info.crtc, 0, 0, 0, 0, 0, UPRIGHT, &[]).unwrap();
        assert_eq!(set.reply().unwrap().status, SetConfig::SUCCESS, "{name}");
    }

    /// Makes a monitor the primary one.
    pub(crate) fn set_primary(&self, name: Option<&str>) {
        let output = name.map_or(0, |name| self.output(name).0);
        self.x.randr_set_output_primary(self.root, output).unwrap().check().unwrap();
    }

    /// Bends a monitor's levels, as night-light tools do.
    pub(crate) fn dim(&self, name: &str, factor: f64) {
        let (_, info) = self.output(name);
        let size = self.x.randr_get_crtc_gamma_size(info.crtc).unwrap().reply().unwrap().size;
        let ramp: Vec<u16> =
            (0..size).map(|index| (f64::from(index) / f64::from(size - 1) * 65_535.0 * factor) as u16).collect();
        self.x.randr_set_crtc_gamma(info.crtc, &ramp, &ramp, &ramp).unwrap().check().unwrap();
    }

    /// Gives a monitor an EDID with a model and a serial number.
    pub(crate) fn set_edid(&self, name: &str, model: &str, serial: &str) {
        let mut block = vec![0u8; 128];
        block[..10].copy_from_slice(&[0, 255, 255, 255, 255, 255, 255, 0, 0x21, 0xEC]);
        for (tag, text, at) in [(0xFC, model, 54), (0xFF, serial, 72)] {
            let text = format!("{text}\n{:13}", "");
            block[at + 3] = tag;
            block[at + 5..at + 18].copy_from_slice(&text.as_bytes()[..13]);
        }
        block[127] = block.iter().fold(0u8, |sum, byte| sum.wrapping_sub(*byte));
        let edid = self.atom("EDID");
        let integer = AtomEnum::INTEGER.into();
        let (output, _) = self.output(name);
        self.x
            .randr_change_output_property(output, edid, integer, 8, PropMode::REPLACE, 128, &block)
            .unwrap()
            .check()
            .unwrap();
    }

    /// What a part of the desktop shows: blue, green, red and an unused byte for each pixel.
    pub(crate) fn picture(&self, (left, top, width, height): Place) -> Vec<u8> {
        let image = self.x.get_image(ImageFormat::Z_PIXMAP, self.root, left, top, width, height, !0).unwrap();
        image.reply().unwrap().data
    }

    /// The number of a name.
    pub(crate) fn atom(&self, name: &str) -> u32 {
        self.x.intern_atom(false, name.as_bytes()).unwrap().reply().unwrap().atom
    }

    /// Asks the window manager to do something to a window.
    pub(crate) fn ask_manager(&self, window: u32, what: &str, arguments: [u32; 5]) {
        let message = ClientMessageEvent::new(32, window, self.atom(what), arguments);
        let managers = EventMask::SUBSTRUCTURE_REDIRECT | EventMask::SUBSTRUCTURE_NOTIFY;
        self.x.send_event(false, self.root, managers, message).unwrap().check().unwrap();
    }

    /// The window of holod's panel.
    pub(crate) fn panel_window(&self) -> Option<u32> {
        let windows = self.x.query_tree(self.root).unwrap().reply().unwrap().children;
        windows.into_iter().find(|&window| {
            let name = self.x.get_property(false, window, AtomEnum::WM_NAME, AtomEnum::STRING, 0, 64).unwrap();
            name.reply().is_ok_and(|name| name.value == b"holod panel")
        })
    }
}

impl Drop for Desktop {
    fn drop(&mut self) {
        let _ended = self.server.kill();
        let _ended = self.server.wait();
    }
}

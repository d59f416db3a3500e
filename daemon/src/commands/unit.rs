//! `holod unit`: the drop-in that opens the service's unit for one bench, and no further.

use std::collections::BTreeSet;
use std::ffi::OsString;
use std::fs;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr};
use std::path::{Component, Path, PathBuf};

use holod_calibration::rig::{Rig, WeightsChoice};
use holod_pupil_input::TrackerSpec;
use holod_slm_output::OutputSpec;
use holod_slm_output::present::drm::DrmTarget;

use super::run;
use super::service_facts::{BINARY, STATE_FOLDER, USUAL_RIG, below, files_of, unseen_by_service};
use crate::cli::{PageAddress, RunArgs, UnitArgs};
use crate::failure::{Exit, Failure};
use crate::source::feed_socket;
use crate::status::SERVICE_FOLDER;
use crate::{results, setup};

/// Networks that no address of the wider Internet is in.
const PRIVATE_NETWORKS: &str = "link-local 192.168.0.0/16 10.0.0.0/8 172.16.0.0/12 fc00::/7";
/// What a start waits for that fails where the network is not up.
const ONLINE_UNIT: &str = "network-online.target";
/// That target may be reached before an address or a route is there, so the starts that the unit grants are spread over
/// more than half a minute. Lasers are dark between them.
const ONLINE_SERVICE: &str = "RestartSec=10\n";

pub(super) fn unit(args: &UnitArgs) -> Result<(), Failure> {
    let words = std::env::args_os().skip_while(|word| word != "unit").skip(1).map(OsString::into_string);
    let words = words.collect::<Result<Vec<_>, _>>().map_err(|word| {
        let found = word.display();
        Failure::new(
            Exit::Usage,
            format!("found {found}, expected words in UTF-8, as a unit's file has them: rename it"),
        )
    })?;
    let rig = setup::rig_with_network(&args.run.rig, &args.run.network)?;
    results::print(drop_in(&rig, &args.run, &words, Path::new("/"))?.trim_end())
}

/// The drop-in for a run with these options, which `words` are; `/dev`, `/proc` and `/sys` are looked at below `root`.
pub(super) fn drop_in(rig: &Rig, run: &RunArgs, words: &[String], root: &Path) -> Result<String, Failure> {
    let usage = |says: String| Failure::new(Exit::Usage, says);
    if let Some(word) = words.iter().find(|word| word.contains(char::is_control)) {
        return Err(usage(format!(
            "found {word:?}, expected words without control characters, as a unit's file has them"
        )));
    }
    let config = run.rig.config.as_deref().ok_or_else(|| usage(format!("name the rig: --config {USUAL_RIG}")))?;
    visible_paths(rig, run).into_iter().try_for_each(|(what, path)| visible(what, &path))?;
    sockets(run).into_iter().try_for_each(|(what, socket)| makeable(what, &socket))?;
    if let Some(record) = &run.record {
        let found = record.display();
        return Err(usage(format!(
            "--record {found}: a service that starts again would find the record of its last start there; name \
             --record-in {STATE_FOLDER}/NAME, in which each start has a folder of its own"
        )));
    }
    let is_below = |folder: &Path| folder.starts_with(STATE_FOLDER) && !goes_up(folder);
    if let Some(folder) = run.record_in.as_deref().filter(|folder| !is_below(folder)) {
        let found = folder.display();
        return Err(usage(format!("--record-in {found}: the service may write below {STATE_FOLDER} only")));
    }
    run::judge(run, rig)?;
    let needs = needs(rig, run, root)?;
    let command: Vec<String> = words.iter().map(|word| quoted(word)).collect();
    let mut text =
        "# Written by `holod unit`: what this bench needs of the unit. Write it anew when rig or devices change.\n"
            .to_owned();
    let awaited: Vec<&str> =
        needs.online.then_some(ONLINE_UNIT).into_iter().chain(needs.modules.iter().map(String::as_str)).collect();
    if !awaited.is_empty() {
        let units = awaited.join(" ");
        text.push_str(&format!("[Unit]\nWants={units}\nAfter={units}\n"));
    }
    text.push_str(&format!("[Service]\nExecStart=\nExecStart={BINARY} run {}\n", command.join(" ")));
    if config != Path::new(USUAL_RIG) {
        let rig = quoted(&config.to_string_lossy());
        text.push_str(&format!("ExecStopPost=\nExecStopPost=-{BINARY} dark --after-service --config {rig}\n"));
    }
    if needs.online {
        text.push_str(ONLINE_SERVICE);
    }
    for device in &needs.devices {
        text.push_str(&format!("DeviceAllow={device} rw\n"));
    }
    if needs.network {
        let hosts: String = needs.hosts.iter().map(|host| format!(" {host}")).collect();
        text.push_str(&format!("RestrictAddressFamilies=AF_INET AF_INET6\nIPAddressAllow=localhost{hosts}\n"));
    }
    Ok(text)
}

/// What the run opens beyond files.
#[derive(Debug, Default)]
struct Needs {
    devices: BTreeSet<String>,
    /// The units that load drivers of its panel and GPU, without which it would find neither.
    modules: BTreeSet<String>,
    /// Whether it listens or connects on a network, if only this machine's own.
    network: bool,
    /// Other machines' addresses, as systemd writes them.
    hosts: BTreeSet<String>,
    /// Whether it cannot start before the network is up.
    online: bool,
}

/// What a host is to the run.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Role {
    /// Another machine, which it connects to.
    Peer,
    /// This machine, which it listens on; who sends is known when somebody does.
    Own,
}

impl Needs {
    fn reach(&mut self, host: &str, role: Role, root: &Path) {
        self.network = true;
        let address = host.parse::<IpAddr>().ok();
        if host.eq_ignore_ascii_case("localhost") || address.is_some_and(|address| address.is_loopback()) {
            return;
        }
        self.hosts.insert(match address {
            Some(address) if role == Role::Peer => address.to_string(),
            _ => bench_networks(root),
        });
        if address.is_none() {
            self.hosts.extend(name_servers(root));
        }
        // All of this machine's addresses can be listened on before there is one.
        self.online |= !address.is_some_and(|address| address.is_unspecified());
    }
}

fn needs(rig: &Rig, run: &RunArgs, root: &Path) -> Result<Needs, Failure> {
    let mut needs = Needs::default();
    for port in rig.lasers.driver.paths() {
        needs.devices.extend(serial_class(port, "the laser box", root)?);
    }
    if let Some(spec) = run.tracker.as_ref().or(rig.tracker.spec.as_ref()) {
        match spec.parse().map_err(Failure::because(Exit::Usage))? {
            TrackerSpec::Serial { path, .. } => needs.devices.extend(serial_class(&path, "the tracker", root)?),
            TrackerSpec::Path(path) if path.starts_with("/dev") => {
                needs.devices.extend(serial_class(&path, "the tracker", root)?);
            }
            TrackerSpec::Hid { .. } => needs.devices.extend(["char-hidraw".to_owned()]),
            TrackerSpec::Tcp { address, .. } | TrackerSpec::Core(address) | TrackerSpec::Neon(address) => {
                needs.reach(&address.host, Role::Peer, root);
            }
            TrackerSpec::Udp { address, .. } => needs.reach(&address.host, Role::Own, root),
            TrackerSpec::Path(_) | TrackerSpec::Replay { .. } | TrackerSpec::Mock(_) | TrackerSpec::MockFile(_) => {}
        }
    }
    if let Some(PageAddress::Tcp(address)) = &run.page.page {
        needs.reach(&address.ip().to_string(), Role::Own, root);
    }
    match run.output.parse().map_err(Failure::because(Exit::Usage))? {
        OutputSpec::Headless(_) => {}
        OutputSpec::Drm(target) => {
            needs.devices.insert(card(&target, root)?);
            needs.modules.extend(drivers("card", root));
        }
        OutputSpec::Window(_) => {
            let says = "--output window: the service has no desktop; give the panel a connector with --output drm:";
            return Err(Failure::new(Exit::Usage, format!("{says}CONNECTOR")));
        }
    }
    if run.backend.takes_a_gpu() {
        needs.devices.extend(gpus(root));
        needs.modules.extend(drivers("renderD", root));
    }
    Ok(needs)
}

/// Who is asked for names, where these are no addresses that are allowed anyway: systemd-resolved and avahi are asked
/// over Unix sockets or at a loopback address, but without them the C library asks the machine's name servers itself.
fn name_servers(root: &Path) -> Vec<String> {
    let text = read_below(root, "/etc/resolv.conf");
    let named = text.lines().filter_map(|line| line.trim().strip_prefix("nameserver")?.split_whitespace().next());
    let addresses = named.filter_map(|server| server.split('%').next()?.parse::<IpAddr>().ok());
    let is_allowed = |address: &IpAddr| match address {
        IpAddr::V4(address) => address.is_private() || address.is_link_local() || address.is_loopback(),
        IpAddr::V6(address) => address.is_unique_local() || address.is_unicast_link_local() || address.is_loopback(),
    };
    addresses.filter(|address| !is_allowed(address)).map(|address| address.to_string()).collect()
}

fn read_below(root: &Path, file: &str) -> String {
    fs::read_to_string(below(root, Path::new(file))).unwrap_or_default()
}

/// Where a page is looked at from, and a tracker may be that has a name and no address: private networks, and those
/// that this machine is in.
fn bench_networks(root: &Path) -> String {
    let (v4, v6) = (read_below(root, "/proc/net/route"), read_below(root, "/proc/net/if_inet6"));
    let own = v4.lines().filter_map(own_network_v4).chain(v6.lines().filter_map(own_network_v6));
    let own: BTreeSet<String> = own.collect();
    own.iter().fold(PRIVATE_NETWORKS.to_owned(), |all, network| format!("{all} {network}"))
}

/// The network of a line of `/proc/net/route` that is reached without a gateway, unless it is a private one.
fn own_network_v4(line: &str) -> Option<String> {
    let columns: Vec<&str> = line.split_whitespace().collect();
    let hex = |column: usize| u32::from_str_radix(columns.get(column)?, 16).ok();
    // The bytes of an address, in the machine's own order.
    let [network, gateway, mask] = [hex(1)?, hex(2)?, hex(7)?].map(|word| u32::from_be_bytes(word.to_ne_bytes()));
    let address = Ipv4Addr::from(network);
    let is_own =
        gateway == 0 && mask != 0 && !(address.is_private() || address.is_link_local() || address.is_loopback());
    is_own.then(|| format!("{address}/{}", mask.leading_ones()))
}

/// The network of a line of `/proc/net/if_inet6`, where its address is a global one.
fn own_network_v6(line: &str) -> Option<String> {
    const GLOBAL: &str = "00";
    let columns: Vec<&str> = line.split_whitespace().collect();
    let [address, _, prefix, scope, ..] = columns[..] else { return None };
    let (address, prefix) = (u128::from_str_radix(address, 16).ok()?, u32::from_str_radix(prefix, 16).ok()?);
    let network = Ipv6Addr::from(address & u128::MAX.checked_shl(128_u32.checked_sub(prefix)?).unwrap_or(0));
    (scope == GLOBAL && !network.is_unique_local()).then(|| format!("{network}/{prefix}"))
}

/// The class of a serial port: its number may be another after a replug, so that its own node would be too little.
fn serial_class(port: &Path, what: &str, root: &Path) -> Result<Option<String>, Failure> {
    let node = below(root, port).canonicalize().map_err(|error| {
        let port = port.display();
        Failure::new(Exit::Unavailable, format!("{port}: {error}: plug {what} in, its adapter says what to allow"))
    })?;
    let name = results::file_name(&node);
    Ok(match name.trim_end_matches(|c: char| c.is_ascii_digit()) {
        class @ ("ttyUSB" | "ttyACM") => Some(format!("char-{class}")),
        // A pseudo-terminal, which the unit allows anyway.
        "" => None,
        _ => Some(format!("/dev/{name}")),
    })
}

/// The card of a connector by a name that stays.
fn card(target: &DrmTarget, root: &Path) -> Result<String, Failure> {
    let node = match &target.card {
        Some(card) => card.clone(),
        None => target.find(&root.join("sys/class/drm")).map_err(Failure::because(Exit::Unavailable))?.card,
    };
    Ok(stable_name(&node, root))
}

/// What a Vulkan driver opens: render nodes, and NVIDIA's own devices.
fn gpus(root: &Path) -> Vec<String> {
    let nodes = names(&root.join("dev/dri"), "renderD");
    let mut devices: Vec<String> =
        nodes.iter().map(|name| stable_name(&Path::new("/dev/dri").join(name), root)).collect();
    let classes = fs::read_to_string(root.join("proc/devices")).unwrap_or_default();
    let characters = classes.lines().take_while(|line| !line.starts_with("Block"));
    let names = characters.filter_map(|line| line.split_whitespace().nth(1));
    devices.extend(names.filter(|name| name.starts_with("nvidia")).map(|name| format!("char-{name}")));
    devices
}

/// The units that load the drivers of these cards or render nodes, as far as the drivers are modules.
fn drivers(nodes: &str, root: &Path) -> Vec<String> {
    let class = root.join("sys/class/drm");
    let module = |node: &String| fs::read_link(class.join(node).join("device/driver/module")).ok();
    let modules = names(&class, nodes).iter().filter_map(module).collect::<BTreeSet<_>>();
    let names = modules.iter().filter_map(|module| module.file_name()?.to_str());
    // Its nodes come from a module of their own.
    let names = names.map(|name| if name == "nvidia" { "nvidia_drm" } else { name });
    names.map(|name| format!("modprobe@{name}.service")).collect()
}

/// A card or render node by the place where it sits, since numbers change.
fn stable_name(node: &Path, root: &Path) -> String {
    let wanted = below(root, node).canonicalize().ok();
    let by_path = Path::new("/dev/dri/by-path");
    let mut links = names(&below(root, by_path), "").into_iter().map(|name| by_path.join(name));
    let link = links.find(|link| wanted.is_some() && below(root, link).canonicalize().ok() == wanted);
    link.unwrap_or_else(|| node.to_owned()).to_string_lossy().into_owned()
}

/// Names in a folder that begin so, in order; none where there is no such folder.
pub(super) fn names(folder: &Path, prefix: &str) -> Vec<String> {
    let Ok(entries) = fs::read_dir(folder) else { return Vec::new() };
    let names = entries.filter_map(|entry| entry.ok()?.file_name().into_string().ok());
    let mut names: Vec<String> = names.filter(|name| name.starts_with(prefix)).collect();
    names.sort();
    names
}

/// The sockets that the run makes by names of one's own, and what named them.
fn sockets(run: &RunArgs) -> Vec<(&'static str, PathBuf)> {
    let mut sockets: Vec<(&str, PathBuf)> = Vec::new();
    if let Some(PageAddress::Unix(path)) = &run.page.page {
        sockets.push(("--page unix:", path.clone()));
    }
    if let Some(path) = run.scene.scene.as_deref().and_then(feed_socket).flatten() {
        sockets.push(("--scene feed:", PathBuf::from(path)));
    }
    sockets
}

/// Refuses a socket that the service cannot make.
fn makeable(what: &str, socket: &Path) -> Result<(), Failure> {
    // Nothing makes a folder in the former.
    if socket.parent() == Some(Path::new(SERVICE_FOLDER)) || (socket.starts_with(STATE_FOLDER) && !goes_up(socket)) {
        return Ok(());
    }
    let name = socket.file_name().unwrap_or_default().display();
    Err(Failure::new(
        Exit::Usage,
        format!(
            "{what}{}: the service may make sockets in {SERVICE_FOLDER} and below {STATE_FOLDER} only; write \
             {what}{SERVICE_FOLDER}/{name}",
            socket.display()
        ),
    ))
}

/// The files that the run reads, and what named them.
pub(super) fn visible_paths(rig: &Rig, run: &RunArgs) -> Vec<(&'static str, PathBuf)> {
    let mut paths: Vec<(&str, PathBuf)> = Vec::new();
    paths.extend(run.rig.config.clone().map(|path| ("--config", path)));
    paths.extend(run.page.page_token.clone().map(|path| ("--page-token", path)));
    if let Some(WeightsChoice::File(path)) = &run.network.weights {
        paths.push(("--weights", path.clone()));
    }
    let tracker = run.tracker.as_ref().and_then(|spec| spec.parse::<TrackerSpec>().ok());
    paths.extend(tracker.iter().flat_map(TrackerSpec::files).map(|path| ("--tracker", path)));
    if let Some(scene) = run.scene.scene.as_deref().filter(|scene| feed_socket(scene).is_none()) {
        paths.extend(scene.split(',').map(|path| ("--scene", PathBuf::from(path))));
    }
    // Another tracker's log or scenario is not opened; its profile is read with the rig.
    let replaced = match rig.tracker.spec.as_ref().and_then(|spec| spec.parse().ok()) {
        Some(spec @ (TrackerSpec::Path(_) | TrackerSpec::Replay { .. } | TrackerSpec::MockFile(_)))
            if tracker.is_some() =>
        {
            spec.files()
        }
        _ => Vec::new(),
    };
    paths.extend(files_of(rig).into_iter().filter(|path| !replaced.contains(path)).map(|path| ("the rig", path)));
    paths
}

/// Refuses a file that the service would not find.
fn visible(what: &str, path: &Path) -> Result<(), Failure> {
    let refused = |says: String| Err(Failure::new(Exit::Usage, says));
    let shown = path.display();
    if !path.is_absolute() {
        return refused(format!("{what}: found {shown}; the service starts in /, write the whole path"));
    }
    unseen_by_service(path).map_or(Ok(()), |why| refused(format!("{what}: found {why}")))
}

/// Whether a path has a `..`, and so may leave the folder that it begins with.
fn goes_up(path: &Path) -> bool {
    path.components().any(|part| part == Component::ParentDir)
}

/// A word of `ExecStart=`, in which systemd reads quotes, backslashes, `$` and `%`.
fn quoted(word: &str) -> String {
    let escaped = word.replace('\\', "\\\\").replace('"', "\\\"").replace('$', "$$").replace('%', "%%");
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_./:,=@+%$".contains(c);
    if !escaped.is_empty() && escaped.chars().all(plain) { escaped } else { format!("\"{escaped}\"") }
}

/// The words of an `ExecStart=` that [`quoted`] wrote, or a person did as it does.
pub(super) fn unquoted(line: &str) -> Vec<String> {
    let mut words = Vec::new();
    let mut word: Option<String> = None;
    let mut is_quoted = false;
    let mut letters = line.chars().peekable();
    while let Some(letter) = letters.next() {
        match letter {
            '"' => {
                is_quoted = !is_quoted;
                word.get_or_insert_default();
            }
            ' ' | '\t' if !is_quoted => words.extend(word.take()),
            _ => {
                let escapes = (letter == '\\') || ("$%".contains(letter) && letters.peek() == Some(&letter));
                let letter = if escapes { letters.next().unwrap_or(letter) } else { letter };
                word.get_or_insert_default().push(letter);
            }
        }
    }
    words.extend(word);
    words
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use clap::Parser;
    use holod_calibration::rig::{LaserDriver, Tracker};

    use super::*;
    use crate::cli::{Cli, Command};

    /// A machine with a tracker, a laser box, two cards and NVIDIA's driver.
    fn machine() -> tempfile::TempDir {
        let root = tempfile::tempdir().unwrap();
        let path = |name: &str| root.path().join(name);
        for folder in ["dev/dri/by-path", "sys/class/drm/card0-DP-1", "sys/class/drm/card1-DP-2", "proc"] {
            fs::create_dir_all(path(folder)).unwrap();
        }
        for node in ["ttyUSB3", "ttyACM0", "ttyS0", "dri/card0", "dri/card1", "dri/renderD128"] {
            fs::write(path("dev").join(node), "").unwrap();
        }
        symlink("ttyUSB3", path("dev/holod-tracker")).unwrap();
        symlink("ttyACM0", path("dev/holod-lasers")).unwrap();
        symlink("../card1", path("dev/dri/by-path/pci-0000:01:00.0-card")).unwrap();
        fs::write(path("proc/devices"), "Character devices:\n195 nvidia\n\nBlock devices:\n  8 nvidiablock\n").unwrap();
        root
    }

    fn drop_in_of(words: &[&str], rig: &Rig, root: &Path) -> Result<String, String> {
        let cli = Cli::try_parse_from(["holod", "unit"].iter().chain(words)).unwrap();
        let Some(Command::Unit(args)) = cli.command else { panic!("{cli:?}") };
        let words: Vec<String> = words.iter().map(|&word| word.to_owned()).collect();
        drop_in(rig, &args.run, &words, root).map_err(|failure| failure.to_string())
    }

    fn rig() -> Rig {
        let mut rig = Rig::default();
        rig.tracker.spec = Some("serial:/dev/holod-tracker".into());
        rig.lasers.driver = LaserDriver::Serial { path: "/dev/holod-lasers".into(), sync_wire: false };
        rig
    }

    fn allowed(text: &str) -> Vec<&str> {
        text.lines().filter_map(|line| line.strip_prefix("DeviceAllow=")?.strip_suffix(" rw")).collect()
    }

    const RIG: [&str; 2] = ["--config", "/etc/holod/rig.toml"];

    #[test]
    fn the_devices_that_the_rig_names_are_allowed_and_no_others() {
        let root = machine();
        let text = drop_in_of(&[&RIG[..], &["--output", "drm:DP-2"]].concat(), &rig(), root.path()).unwrap();
        let card = "/dev/dri/by-path/pci-0000:01:00.0-card";
        let all = [card, "/dev/dri/renderD128", "char-nvidia", "char-ttyACM", "char-ttyUSB"];
        assert_eq!(allowed(&text), all, "{text}");
        assert!(!text.contains("[Unit]"), "drivers that are no modules: {text}");
        assert!(
            text.contains("ExecStart=\nExecStart=/usr/bin/holod run --config /etc/holod/rig.toml --output drm:DP-2\n")
        );
        assert!(!text.contains("ExecStopPost") && !text.contains("AF_INET"), "{text}");

        let few =
            drop_in_of(&[&RIG[..], &["--backend", "cpu", "--tracker", "/dev/ttyS0"]].concat(), &rig(), root.path());
        assert_eq!(allowed(&few.unwrap()), ["/dev/ttyS0", "char-ttyACM"]);
        let none = drop_in_of(&[&RIG[..], &["--backend", "cpu"]].concat(), &Rig::default(), root.path()).unwrap();
        assert!(allowed(&none).is_empty(), "{none}");
    }

    /// The base block of a monitor's EDID that has a name and nothing else.
    fn edid(name: &str) -> [u8; 128] {
        let mut block = [0; 128];
        block[1..7].fill(0xff);
        block[57] = 0xfc;
        block[59..59 + name.len()].copy_from_slice(name.as_bytes());
        block[59 + name.len()] = b'\n';
        block[127] = block.iter().fold(0_u8, |sum, byte| sum.wrapping_sub(*byte));
        block
    }

    #[test]
    fn a_panel_is_at_a_card_or_its_name_is_refused() {
        let root = machine();
        fs::write(root.path().join("sys/class/drm/card1-DP-2/edid"), edid("PLUTO-2.1")).unwrap();
        let with = |output: &str| drop_in_of(&[&RIG[..], &["--output", output]].concat(), &rig(), root.path());
        let of_monitor = with("drm:PLUTO-2.1").unwrap();
        assert!(allowed(&of_monitor).contains(&"/dev/dri/by-path/pci-0000:01:00.0-card"), "{of_monitor}");
        for absent in ["drm:DP-9", "drm:DP1", "drm:PLUTO-3"] {
            let refused = with(absent).unwrap_err();
            assert!(refused.contains("no connector and no monitor is") && refused.contains("DP-2"), "{refused}");
        }
        fs::create_dir(root.path().join("sys/class/drm/card0-DP-2")).unwrap();
        assert!(with("drm:DP-2").unwrap_err().contains("card=/dev/dri/card"));
        assert!(allowed(&with("drm:DP-2,card=/dev/dri/card0").unwrap()).contains(&"/dev/dri/card0"));
    }

    #[test]
    fn links_and_steps_up_do_not_hide_where_a_file_is() {
        let root = machine();
        let hidden = tempfile::tempdir_in("/tmp").unwrap();
        let rig_file = hidden.path().join("rig.toml");
        fs::write(&rig_file, "").unwrap();
        // The tests' folder may be hidden, too.
        let link = Path::new("/dev/shm").join(hidden.path().file_name().unwrap());
        symlink(&rig_file, &link).unwrap();
        let refused = |words: &[&str]| drop_in_of(words, &rig(), root.path()).unwrap_err();
        let by_link = refused(&["--config", link.to_str().unwrap()]);
        fs::remove_file(&link).unwrap();
        assert!(by_link.contains("which leads into /tmp; the service does not see that"), "{by_link}");
        let up = refused(&[&RIG[..], &["--record-in", "/var/lib/holod/../runs"]].concat());
        assert!(up.contains("/var/lib/holod only"), "{up}");
        let socket = refused(&[&RIG[..], &["--page", "unix:/var/lib/holod/../x"]].concat());
        assert!(socket.contains("may make sockets in"), "{socket}");
    }

    #[test]
    fn a_line_break_is_no_part_of_a_unit() {
        let root = machine();
        let refused = drop_in_of(&[&RIG[..], &["--scene", "/srv/a\nExecStartPre=x"]].concat(), &rig(), root.path());
        assert!(refused.unwrap_err().contains("without control characters"));
    }

    #[test]
    fn drivers_of_panel_and_gpu_are_waited_for() {
        let root = machine();
        for (node, driver) in
            [("card0", "ast"), ("card1", "amdgpu"), ("renderD128", "amdgpu"), ("renderD129", "nvidia")]
        {
            let folder = root.path().join("sys/class/drm").join(node).join("device/driver");
            fs::create_dir_all(&folder).unwrap();
            symlink(format!("../../../../module/{driver}"), folder.join("module")).unwrap();
        }
        let waits = |words: &[&str]| {
            let text = drop_in_of(&[&RIG[..], words].concat(), &rig(), root.path()).unwrap();
            let of = |key: &str| text.lines().find_map(|line| line.strip_prefix(key).map(str::to_owned));
            assert_eq!(of("Wants="), of("After="), "{text}");
            of("After=")
        };
        let [amdgpu, ast, nvidia] = ["amdgpu", "ast", "nvidia_drm"].map(|module| format!("modprobe@{module}.service"));
        assert_eq!(waits(&[]), Some(format!("{amdgpu} {nvidia}")));
        assert_eq!(waits(&["--backend", "cpu"]), None);
        assert_eq!(waits(&["--backend", "cpu", "--output", "drm:DP-2"]), Some(format!("{amdgpu} {ast}")));
        let all = ["--tracker", "core:192.0.2.7", "--output", "drm:DP-2"];
        assert_eq!(waits(&all), Some(format!("network-online.target {amdgpu} {ast} {nvidia}")));
    }

    #[test]
    fn a_tracker_on_a_network_gets_its_own_address() {
        let root = machine();
        let with = |spec: &str| drop_in_of(&[&RIG[..], &["--tracker", spec]].concat(), &rig(), root.path()).unwrap();
        assert!(with("core:192.0.2.7").contains("IPAddressAllow=localhost 192.0.2.7\n"));
        assert!(with("neon").contains("IPAddressAllow=localhost link-local 192.168.0.0/16"));
        assert!(with("hid:1209:0001").contains("DeviceAllow=char-hidraw rw"));
        for here in ["core:127.0.0.1", "core:localhost", "udp:[::1]:4242,profile=open-gaze"] {
            assert!(with(here).contains("IPAddressAllow=localhost\n"), "{here}: {}", with(here));
        }
    }

    #[test]
    fn what_needs_the_network_at_its_start_waits_for_it() {
        let root = machine();
        let with = |words: &[&str]| drop_in_of(&[&RIG[..], words].concat(), &rig(), root.path()).unwrap();
        let waits = |text: &str| {
            let unit = text.contains("\n[Unit]\nWants=network-online.target\nAfter=network-online.target\n[Service]\n");
            assert_eq!(unit, text.contains("network-online"), "{text}");
            assert_eq!(unit, text.contains("\nRestartSec=10\n"), "{text}");
            unit
        };
        let token = ["--page-token", "/etc/holod/token"];
        for page in ["192.168.1.5:8420", "[2001:db8::7]:8420"] {
            assert!(waits(&with(&[&["--page", page], &token[..]].concat())), "{page}");
        }
        for tracker in ["core:192.0.2.7", "neon", "tcp:gazepc,profile=open-gaze", "udp:192.0.2.7:1,profile=open-gaze"] {
            assert!(waits(&with(&["--tracker", tracker])), "{tracker}");
        }
        for page in ["8420", "[::1]:8420", "unix:/run/holod/page"] {
            assert!(!waits(&with(&["--page", page])), "{page}");
        }
        assert!(!waits(&with(&[&["--page", "0.0.0.0:8420"], &token[..]].concat())), "there is one for all addresses");
        for tracker in ["mock", "core:localhost", "core:127.0.0.1", "udp:0.0.0.0:1,profile=open-gaze"] {
            assert!(!waits(&with(&["--tracker", tracker])), "{tracker}");
        }
    }

    #[test]
    fn the_servers_that_know_a_trackers_name_may_be_asked() {
        let root = machine();
        fs::create_dir_all(root.path().join("etc")).unwrap();
        let allowed = |spec: &str, servers: &str| {
            fs::write(root.path().join("etc/resolv.conf"), servers).unwrap();
            let text = drop_in_of(&[&RIG[..], &["--tracker", spec]].concat(), &rig(), root.path()).unwrap();
            text.lines().find_map(|line| line.strip_prefix("IPAddressAllow=").map(str::to_owned)).unwrap()
        };
        let servers = "# nameserver 192.0.2.1\nsearch uni.example\nnameserver 192.0.2.53 # of the institute\n\
            nameserver 2001:db8::53\nnameserver 127.0.0.53\nnameserver 192.168.1.1\nnameserver fe80::1%eth0\n";
        let named = format!("localhost 192.0.2.53 2001:db8::53 {PRIVATE_NETWORKS}");
        assert_eq!(allowed("tcp:gazepc.uni.example,profile=open-gaze", servers), named);
        assert_eq!(allowed("core:192.0.2.7", servers), "localhost 192.0.2.7", "an address is not asked for");
        assert_eq!(allowed("neon", "nameserver 127.0.0.53\n"), format!("localhost {PRIVATE_NETWORKS}"));
    }

    #[test]
    fn a_page_gets_the_network_that_it_is_for() {
        let root = machine();
        let with = |words: &[&str]| drop_in_of(&[&RIG[..], words].concat(), &rig(), root.path()).unwrap();
        let here = with(&["--page", "8420"]);
        assert!(here.contains("RestrictAddressFamilies=AF_INET AF_INET6\nIPAddressAllow=localhost\n"), "{here}");
        let others =
            with(&["--page", "0.0.0.0:8420", "--page-token", "/etc/holod/token", "--tracker", "core:192.0.2.7"]);
        assert!(others.contains("IPAddressAllow=localhost 192.0.2.7 link-local 192.168.0.0/16"), "{others}");
        assert!(!with(&["--page", "unix:/run/holod/page"]).contains("AF_INET"));
    }

    /// As a machine has it whose bench is 131.114.5.0/24 and 2001:db8:0:5::/64, beside 192.168.1.0/24 and fd00::/64.
    #[test]
    fn networks_that_the_machine_is_in_may_see_the_page_and_have_trackers_with_names() {
        let root = machine();
        fs::create_dir_all(root.path().join("proc/net")).unwrap();
        let routes = "Iface\tDestination\tGateway \tFlags\tRefCnt\tUse\tMetric\tMask\t\tMTU\tWindow\tIRTT\n\
            eth0\t00000000\t01057283\t0003\t0\t0\t100\t00000000\t0\t0\t0\n\
            eth0\t00057283\t00000000\t0001\t0\t0\t100\t00FFFFFF\t0\t0\t0\n\
            eth1\t0001A8C0\t00000000\t0001\t0\t0\t101\t00FFFFFF\t0\t0\t0\n";
        fs::write(root.path().join("proc/net/route"), routes).unwrap();
        let addresses = "00000000000000000000000000000001 01 80 10 80       lo\n\
            20010db8000000050000000000000007 02 40 00 80     eth0\n\
            fd000000000000000000000000000007 02 40 00 80     eth0\n\
            fe800000000000000000000000000007 02 40 20 80     eth0\n";
        fs::write(root.path().join("proc/net/if_inet6"), addresses).unwrap();
        let allowed = |options: &[&str]| {
            let text = drop_in_of(&[&RIG[..], options].concat(), &Rig::default(), root.path()).unwrap();
            text.lines().find_map(|line| line.strip_prefix("IPAddressAllow=").map(str::to_owned)).unwrap()
        };
        let expected = format!("localhost {PRIVATE_NETWORKS} 131.114.5.0/24 2001:db8:0:5::/64");
        let page = ["--page", "131.114.5.7:8420", "--page-token", "/etc/holod/token"];
        assert_eq!(allowed(&page), expected);
        assert_eq!(allowed(&["--tracker", "tcp:gazepc.uni.example:4242,profile=open-gaze"]), expected);
        assert_eq!(allowed(&["--tracker", "core:131.114.5.20"]), "localhost 131.114.5.20");
    }

    #[test]
    fn what_the_service_could_not_do_is_refused() {
        let root = machine();
        let refused = |words: &[&str]| drop_in_of(words, &rig(), root.path()).unwrap_err();
        assert!(refused(&[]).contains("name the rig"));
        assert!(refused(&["--config", "rig.toml"]).contains("whole path"));
        assert!(refused(&["--config", "/home/me/rig.toml"]).contains("does not see /home"));
        assert!(refused(&[&RIG[..], &["--output", "window"]].concat()).contains("no desktop"));
        let record = refused(&[&RIG[..], &["--record", "/var/lib/holod/run1"]].concat());
        assert!(record.contains("find the record of its last start") && record.contains("--record-in"), "{record}");
        assert!(refused(&[&RIG[..], &["--record-in", "/srv/runs"]].concat()).contains("/var/lib/holod only"));
        drop_in_of(&[&RIG[..], &["--record-in", "/var/lib/holod/runs"]].concat(), &rig(), root.path()).unwrap();
        assert!(refused(&[&RIG[..], &["--scene", "/srv/a.png,b.png"]].concat()).contains("found b.png"));
        assert!(refused(&[&RIG[..], &["--tracker", "/dev/ttyUSB9"]].concat()).contains("plug the tracker in"));
        assert!(refused(&[&RIG[..], &["--weights", "mine.safetensors"]].concat()).contains("found mine.safetensors"));
        let mut rig = rig();
        rig.model.weights = WeightsChoice::File("/home/me/weights.safetensors".into());
        assert!(drop_in_of(&RIG, &rig, root.path()).unwrap_err().contains("the rig: found /home"));
    }

    /// All of these are refused by `holod run`, too.
    #[test]
    fn what_holod_run_refuses_by_its_options_is_refused() {
        let root = machine();
        let with = |words: &[&str]| drop_in_of(&[&RIG[..], words].concat(), &rig(), root.path());
        let cases: [(&[&str], &str); 11] = [
            (&["--page", "192.168.1.5:8420"], "it needs a token: --page-token FILE"),
            (&["--feed-dark-after", "2"], "name it with --scene feed"),
            (&["--scene", "/srv/no.png,/srv/no.exr"], "give it with --depth-encoding"),
            (&["--scene", "/srv/no.png,/srv/no.exr", "--depth-encoding", "meters"], "found \"meters\""),
            (
                &["--scene", "/srv/no.png,/srv/no.exr", "--depth-encoding", "metres", "--resolution", "4000x4000"],
                "4000x4000",
            ),
            (&["--scene", "feed", "--depth-encoding", "metres"], "a feed's clients say"),
            (&["--scene", "feed", "--resolution", "4000x4000"], "larger than the panel of 1920x1080"),
            (&["--depth-encoding", "metres"], "name one with --scene"),
            (&["--resolution", "4000x4000"], "larger than the panel of 1920x1080"),
            (&["--tracker", "serial:/dev/ttyS0,profile=none"], "none"),
            (&["--tracker", "serial:/dev/ttyS0,profile=asl-eye-trac"], "give it with --scale"),
        ];
        for (words, says) in cases {
            let refused = with(words).unwrap_err();
            assert!(refused.contains(says), "{words:?}: {refused}");
        }
        for sound in [
            &["--scene", "feed", "--feed-dark-after", "2"][..],
            &["--scene", "/srv/no.png,/srv/no.exr", "--depth-encoding", "metres", "--resolution", "1920x1080"],
            &["--tracker", "serial:/dev/ttyS0,profile=asl-eye-trac", "--scale", "0.02"],
        ] {
            with(sound).unwrap_or_else(|refused| panic!("{sound:?}: {refused}"));
        }
    }

    #[test]
    fn a_trackers_files_must_be_where_the_service_sees_them() {
        let root = machine();
        let drop_in_of =
            |spec: &str, rig: &Rig| drop_in_of(&[&RIG[..], &["--tracker", spec]].concat(), rig, root.path());
        for spec in [
            "mock:/home/me/eye.txt",
            "replay:/tmp/log.csv",
            "/tmp/log.csv",
            "serial:/dev/holod-tracker,profile=/home/me/mine.toml",
            "udp:192.0.2.7:4242,profile=/home/me/mine.toml",
            "hid:1209:0001,profile=/home/me/mine.toml",
        ] {
            let refused = drop_in_of(spec, &rig()).unwrap_err();
            assert!(refused.contains("--tracker: found /") && refused.contains("does not see"), "{spec}: {refused}");
            drop_in_of(&spec.replace("/tmp", "/srv").replace("/home/me", "/srv"), &rig()).unwrap();
            let of_rig = Rig { tracker: Tracker { spec: Some(spec.into()), ..rig().tracker }, ..rig() };
            let beside_another = drop_in_of("mock", &of_rig).err();
            let is_refused = beside_another.is_some_and(|says| says.contains("the rig: found /"));
            assert_eq!(is_refused, spec.contains("profile="), "{spec}: a log is not opened, a profile is");
        }
        for spec in ["mock:./eye.txt", "replay:log.csv", "udp:192.0.2.7:4242,profile=mine.toml"] {
            assert!(drop_in_of(spec, &rig()).unwrap_err().contains("write the whole path"), "{spec}");
        }
        drop_in_of("udp:192.0.2.7:4242,profile=open-gaze", &rig()).unwrap();
    }

    #[test]
    fn sockets_are_made_only_where_the_service_may_write() {
        let root = machine();
        let with = |words: &[&str]| drop_in_of(&[&RIG[..], words].concat(), &rig(), root.path());
        for path in ["/run/bench/x", "/run/holod/deeper/x", "/srv/x", "x"] {
            for words in [["--scene", &format!("feed:{path}")], ["--page", &format!("unix:{path}")]] {
                let refused = with(&words).unwrap_err();
                let cure = format!("write {} {}:/run/holod/x", words[0], words[1].split(':').next().unwrap());
                assert!(refused.contains("may make sockets in /run/holod and") && refused.contains(&cure), "{refused}");
            }
        }
        for path in ["/run/holod/x", "/var/lib/holod/deeper/x"] {
            with(&["--scene", &format!("feed:{path}"), "--page", &format!("unix:{path}")]).unwrap();
        }
        with(&["--scene", "feed"]).unwrap();
    }

    #[test]
    fn words_reach_the_service_as_they_were_written() {
        for (word, written) in [
            ("--scene", "--scene"),
            ("/srv/two cards", "\"/srv/two cards\""),
            ("50%", "50%%"),
            ("$HOME", "$$HOME"),
            ("a\"b\\", "\"a\\\"b\\\\\""),
            ("", "\"\""),
            (";", "\";\""),
        ] {
            assert_eq!(quoted(word), written);
            let line = format!("{written} --after  {written}");
            assert_eq!(unquoted(&line), [word, "--after", word], "{line}");
        }
    }
}

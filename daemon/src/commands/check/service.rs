//! What `deploy/README.md` asks of a machine before the service is started: the unit and its drop-in, devices, records,
//! udev's rules.

use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use clap::Parser;
use holod_calibration::rig::Rig;
use holod_pupil_input::{RULE_FILE, TrackerSpec, UsbIds, udev_rule};
use rustix::fs::Access;

use super::Check;
use super::access::{REALTIME_PRIORITY, Runner, cure, named, serial_ports_of};
use crate::cli::{CheckArgs, Cli, Command, RunArgs};
use crate::commands::service_facts::{BINARY, STATE_FOLDER, USUAL_RIG, below};
use crate::commands::unit::{drop_in, names, unquoted, visible_paths};

/// Where units are, the first that has one counts; drop-ins of all of them do.
const UNIT_FOLDERS: [&str; 4] =
    ["etc/systemd/system", "run/systemd/system", "usr/lib/systemd/system", "lib/systemd/system"];
const UNIT: &str = "holod.service";
/// Where udev's rules are, likewise.
const RULE_FOLDERS: [&str; 4] = ["etc/udev/rules.d", "run/udev/rules.d", "usr/lib/udev/rules.d", "lib/udev/rules.d"];
const LATENCY_RULE: &str = "60-holod-latency.rules";
/// Some minutes of a record with all that it may hold.
const ROOM_MIB: u64 = 1024;

/// The service's own checks; files and devices are looked at below `root`.
pub(super) fn service(rig: &Rig, args: &CheckArgs, root: &Path) -> Vec<Check> {
    // Why there is none is told already.
    let Ok(runner) = Runner::service(root) else { return Vec::new() };
    let unit = Unit::read(root);
    let run = unit.as_ref().and_then(Unit::run);
    let planned = run.as_ref().and_then(|run| run.as_ref().ok()).map(|(run, _)| &**run);
    let mut checks = vec![
        named("unit", unit_fits(rig, args, unit.as_ref(), run.as_ref(), root)),
        named("realtime", realtime(unit.as_ref())),
        named("graphics", graphics(planned, &runner, root)),
        named("records", records(&runner, root)),
        named("rules", rules(rig, root)),
    ];
    checks.extend(hid(rig, planned, &runner, root).map(|found| named("hid", found)));
    checks.extend(planned.map(|run| named("options", options(rig, run, &runner, root))));
    checks
}

/// A unit and its drop-ins, as systemd reads them.
struct Unit {
    /// Keys and values in the order in which they count.
    lines: Vec<(String, String)>,
}

/// The options of `holod run` in a unit, and its words; or what is wrong with them.
type Planned = Result<(Box<RunArgs>, Vec<String>), String>;

impl Unit {
    fn read(root: &Path) -> Option<Self> {
        let unit = UNIT_FOLDERS.iter().find_map(|folder| fs::read_to_string(root.join(folder).join(UNIT)).ok())?;
        // A name in a folder that counts more hides the same one in the others.
        let mut drop_ins = BTreeMap::new();
        for folder in UNIT_FOLDERS.iter().rev().map(|folder| root.join(folder).join(format!("{UNIT}.d"))) {
            let conf = names(&folder, "").into_iter().filter(|name| name.ends_with(".conf"));
            drop_ins.extend(conf.map(|name| (name.clone(), folder.join(name))));
        }
        let texts = drop_ins.values().filter_map(|path| fs::read_to_string(path).ok());
        let texts: Vec<String> = std::iter::once(unit).chain(texts).collect();
        Some(Self { lines: texts.iter().flat_map(|text| lines_of(text)).collect() })
    }

    /// What a key that may be given several times comes to: an empty value takes back what was before.
    fn all(&self, key: &str) -> Vec<&str> {
        let mut values = Vec::new();
        for (_, value) in self.lines.iter().filter(|(known, _)| known == key) {
            match value.as_str() {
                "" => values.clear(),
                value => values.push(value),
            }
        }
        values
    }

    /// The options that the service runs with; nothing where there is no command.
    fn run(&self) -> Option<Planned> {
        let command = *self.all("ExecStart").last()?;
        let mut words = unquoted(command);
        let program = if words.is_empty() { String::new() } else { words.remove(0) };
        if program != BINARY {
            return Some(Err(format!("ExecStart= runs {program}, expected {BINARY}")));
        }
        if words.first().is_some_and(|word| word == "run") {
            words.remove(0);
        }
        let parsed = Cli::try_parse_from(["holod", "unit"].into_iter().map(str::to_owned).chain(words.clone()));
        Some(match parsed.map(|cli| cli.command) {
            Ok(Some(Command::Unit(args))) => Ok((Box::new(args.run), words)),
            Ok(_) => Err(format!("ExecStart={command} is no `holod run`")),
            Err(error) => {
                let said = error.to_string();
                Err(format!("ExecStart={command}: {}", said.lines().next().unwrap_or_default()))
            }
        })
    }
}

/// Keys and values; a line that ends with a backslash goes on.
fn lines_of(text: &str) -> Vec<(String, String)> {
    let joined = text.replace("\\\n", " ");
    let lines = joined.lines().map(str::trim).filter(|line| !line.starts_with(['#', ';', '[']));
    let lines = lines.filter_map(|line| line.split_once('='));
    lines.map(|(key, value)| (key.trim().to_owned(), value.trim().to_owned())).collect()
}

/// Whether the unit starts what is checked here, and is opened for what that needs.
fn unit_fits(
    rig: &Rig,
    args: &CheckArgs,
    unit: Option<&Unit>,
    run: Option<&Planned>,
    root: &Path,
) -> Result<String, Vec<String>> {
    let one = |fault: String| Err(vec![fault]);
    let Some(unit) = unit else { return one(format!("there is no {UNIT}: install the package")) };
    let output = args.output.as_deref().unwrap_or("OUTPUT");
    let config = args.rig.config.as_deref().unwrap_or(Path::new(USUAL_RIG));
    let anew = format!(
        "write it anew: holod unit --config {} --output {output}, with the run's other options after these, >bench.conf \
         && install -D -m 644 bench.conf /etc/systemd/system/{UNIT}.d/bench.conf && systemctl daemon-reload",
        config.display()
    );
    let (run, words) = match run {
        None => return one(format!("{UNIT} has no ExecStart=: {anew}")),
        Some(Err(fault)) => return one(format!("{fault}: {anew}")),
        Some(Ok((run, words))) => (run, words),
    };
    let mut faults = Vec::new();
    let its_config = run.rig.config.as_deref();
    if its_config != Some(config) {
        let its_config = its_config.map_or("none".into(), |path| path.display().to_string());
        faults.push(format!("the service runs with the rig {its_config}, this check is of {}", config.display()));
    }
    if args.output.as_ref().is_some_and(|wanted| *wanted != run.output) {
        faults.push(format!("the service shows on {}, this check is of {output}", run.output));
    }
    match drop_in(rig, run, words, root) {
        Err(failure) => faults.push(failure.to_string()),
        Ok(wanted) => {
            for (key, value) in lines_of(&wanted) {
                let allowed = || unit.all(&key).into_iter().flat_map(str::split_whitespace);
                let lacks = |word: &&str| !allowed().any(|known| known == *word || known == "any");
                let is_there = || unit.all(&key).contains(&value.as_str());
                let missing: Vec<&str> = match key.as_str() {
                    "DeviceAllow" => value.split_whitespace().take(1).filter(lacks).collect(),
                    "IPAddressAllow" | "RestrictAddressFamilies" | "Wants" | "After" => {
                        value.split_whitespace().filter(lacks).collect()
                    }
                    "ExecStopPost" if !value.is_empty() && !is_there() => vec![&value],
                    _ => Vec::new(),
                };
                if !missing.is_empty() {
                    faults.push(format!("{key}= lacks {}, which the rig or the options need", missing.join(", ")));
                }
            }
        }
    }
    if faults.is_empty() {
        Ok(format!("{UNIT} runs holod with {}, and is opened for what that needs", words.join(" ")))
    } else {
        faults.push(anew);
        Err(faults)
    }
}

/// Whether the unit lets threads ask for the priority that they want. holod locks no memory.
fn realtime(unit: Option<&Unit>) -> Result<String, Vec<String>> {
    let Some(unit) = unit else { return Ok("not judged without a unit".into()) };
    let last = |key: &str| unit.all(key).last().copied();
    let limit = last("LimitRTPRIO").map(|limit| limit.split(':').next().unwrap_or_default());
    let suffices =
        limit.is_some_and(|limit| limit == "infinity" || limit.parse().is_ok_and(|n: u64| n >= REALTIME_PRIORITY));
    if !suffices {
        let found = limit.unwrap_or("nothing");
        return Err(vec![format!(
            "LimitRTPRIO={found} was found, expected at least {REALTIME_PRIORITY}: fields would be late; take it out of \
             `systemctl edit holod`"
        )]);
    }
    if last("RestrictRealtime").is_some_and(|value| ["yes", "true", "on", "1"].contains(&value)) {
        return Err(vec!["RestrictRealtime= forbids real-time threads: take it out of `systemctl edit holod`".into()]);
    }
    Ok(format!("the service may ask for a real-time priority of {REALTIME_PRIORITY}"))
}

/// Whether the service's user may open cards and render nodes that its options name or let it use.
fn graphics(run: Option<&RunArgs>, runner: &Runner, root: &Path) -> Result<String, Vec<String>> {
    let computes_on_gpu = run.is_none_or(|run| run.backend.takes_a_gpu());
    let shows = run.is_some_and(|run| run.output.starts_with("drm:"));
    let dri = Path::new("/dev/dri");
    let of = |prefix: &str| names(&below(root, dri), prefix).into_iter().map(|name| dri.join(name)).collect::<Vec<_>>();
    let mut nodes = Vec::new();
    if computes_on_gpu {
        nodes.extend(of("renderD"));
        nodes.extend(names(&root.join("dev"), "nvidia").into_iter().map(|name| Path::new("/dev").join(name)));
        nodes.retain(|node| below(root, node).metadata().is_ok_and(|found| !found.is_dir()));
    }
    if shows {
        nodes.extend(of("card"));
    }
    let wanted = Access::READ_OK | Access::WRITE_OK;
    let closed = nodes.iter().filter(|node| !runner.may(&below(root, node), wanted));
    let faults: Vec<String> = closed
        .map(|node| format!("{} may not open {}: {}", runner.name(), node.display(), cure(&below(root, node), runner)))
        .collect();
    if !faults.is_empty() {
        return Err(faults);
    }
    let shown: Vec<_> = nodes.iter().map(|node| node.display().to_string()).collect();
    Ok(match (computes_on_gpu, shown.is_empty()) {
        (true, true) => "there is no graphics processor: holograms are computed on the processor's cores".into(),
        (false, true) => "none is used: --backend cpu".into(),
        (_, false) => format!("{} may open {}", runner.name(), shown.join(", ")),
    })
}

/// Whether records can be written where the unit lets them be.
fn records(runner: &Runner, root: &Path) -> Result<String, Vec<String>> {
    let folder = below(root, Path::new(STATE_FOLDER));
    if !folder.exists() {
        return Ok(format!("{STATE_FOLDER} is made at the first start"));
    }
    if !runner.may(&folder, Access::WRITE_OK | Access::EXEC_OK) {
        return Err(vec![format!(
            "{} may not write to {STATE_FOLDER}: chown holod:holod {STATE_FOLDER}",
            runner.name()
        )]);
    }
    let free_mib = rustix::fs::statvfs(&folder).map(|disk| disk.f_bavail.saturating_mul(disk.f_frsize) >> 20);
    Ok(match free_mib {
        Ok(free_mib) if free_mib < ROOM_MIB => {
            format!("warning: {STATE_FOLDER} has room for {free_mib} MiB: a record would fill it soon")
        }
        _ => format!("{} may write to {STATE_FOLDER}", runner.name()),
    })
}

/// Whether udev has the rule for the adapters that the rig's ports are behind.
fn rules(rig: &Rig, root: &Path) -> Result<String, Vec<String>> {
    let is_ftdi = |path: &PathBuf| {
        let Ok(node) = below(root, path).canonicalize() else { return false };
        let name = node.file_name().unwrap_or_default();
        let driver = fs::read_link(root.join("sys/class/tty").join(name).join("device/driver"));
        driver.is_ok_and(|driver| driver.ends_with("ftdi_sio"))
    };
    let ports: Vec<String> =
        serial_ports_of(rig).iter().filter(|path| is_ftdi(path)).map(|path| path.display().to_string()).collect();
    let found = RULE_FOLDERS.iter().map(|folder| root.join(folder).join(LATENCY_RULE)).find(|path| path.exists());
    let in_force = found.as_ref().and_then(|path| fs::read_to_string(path).ok()).filter(|text| !text.trim().is_empty());
    match (ports.is_empty(), in_force, found) {
        (true, ..) => Ok("no port of the rig needs one".into()),
        (false, Some(_), _) => Ok(format!("{LATENCY_RULE} is in force for {}", ports.join(", "))),
        (false, None, Some(path)) => Ok(format!(
            "warning: {} hides {LATENCY_RULE}, and {} may hold bytes back for 16 ms: delete it",
            path.display(),
            ports.join(", ")
        )),
        (false, None, None) => Err(vec![format!(
            "{LATENCY_RULE} is missing, and {} may hold bytes back for 16 ms: install the package again",
            ports.join(", ")
        )]),
    }
}

/// Whether a HID tracker's node may be read; nothing where the tracker is none whose ids are named.
fn hid(rig: &Rig, run: Option<&RunArgs>, runner: &Runner, root: &Path) -> Option<Result<String, Vec<String>>> {
    let spec = run.and_then(|run| run.tracker.as_ref()).or(rig.tracker.spec.as_ref())?;
    let Ok(TrackerSpec::Hid { ids: Some(ids), .. }) = spec.parse() else { return None };
    let nodes: Vec<String> = names(&root.join("sys/class/hidraw"), "hidraw");
    let nodes: Vec<PathBuf> = nodes
        .into_iter()
        .filter(|name| is_hid(&root.join("sys/class/hidraw").join(name).join("device/uevent"), ids))
        .map(|name| Path::new("/dev").join(name))
        .collect();
    let shown: Vec<_> = nodes.iter().map(|node| node.display().to_string()).collect();
    Some(match &nodes[..] {
        [] => Err(vec![format!("there is no HID device {ids}: plug the tracker in")]),
        nodes if nodes.iter().any(|node| runner.may(&below(root, node), Access::READ_OK)) => {
            Ok(format!("{} may read {}", runner.name(), shown.join(", ")))
        }
        _ => Err(vec![format!(
            "{} may not read {}: `holod tracker rule {ids} >{RULE_FILE}` writes the rule {}; then `udevadm control --reload \
             && udevadm trigger --subsystem-match=hidraw --action=add`",
            runner.name(),
            shown.join(", "),
            udev_rule(ids)
        )]),
    })
}

/// Whether a node's device has these ids, as the kernel writes them: `HID_ID=0003:00001209:00000001`.
fn is_hid(uevent: &Path, ids: UsbIds) -> bool {
    let text = fs::read_to_string(uevent).unwrap_or_default();
    let number = |text: &str| u32::from_str_radix(text, 16).ok();
    text.lines().filter_map(|line| line.strip_prefix("HID_ID=")).any(|line| {
        let mut parts = line.split(':').skip(1).map(number);
        (parts.next().flatten(), parts.next().flatten()) == (Some(ids.vendor.into()), Some(ids.product.into()))
    })
}

/// Whether the files among the service's options may be read by it, and the page's token by nobody else.
fn options(rig: &Rig, run: &RunArgs, runner: &Runner, root: &Path) -> Result<String, Vec<String>> {
    let read = visible_paths(rig, run);
    let mut faults = Vec::new();
    for (what, path) in &read {
        let shown = path.display();
        match below(root, path).metadata() {
            Err(error) => faults.push(format!("{what} {shown}: {error}")),
            Ok(found) => {
                let wanted = if found.is_dir() { Access::READ_OK | Access::EXEC_OK } else { Access::READ_OK };
                if !runner.may(&below(root, path), wanted) {
                    faults.push(format!(
                        "{what}: {} may not read {shown}: chmod a+r {shown}, and chmod a+x the folders above it",
                        runner.name()
                    ));
                }
                if *what == "--page-token" && found.mode() & 0o077 != 0 {
                    faults.push(format!(
                        "--page-token: others may read {shown}: chown holod {shown} && chmod 600 {shown}"
                    ));
                }
            }
        }
    }
    if faults.is_empty() {
        Ok(format!("{} may read the {} files that they name", runner.name(), read.len()))
    } else {
        Err(faults)
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::{PermissionsExt, symlink};

    use holod_calibration::rig::LaserDriver;

    use super::*;

    /// A machine on which all is as the README asks, whose service user is whoever runs this test.
    struct Machine(tempfile::TempDir);

    impl Machine {
        fn new() -> Self {
            let this = Self(tempfile::tempdir().unwrap());
            let own = fs::metadata(this.root()).unwrap();
            let (uid, gid) = (own.uid(), own.gid());
            this.put("etc/passwd", &format!("root:x:0:0::/:/bin/sh\nholod:x:{uid}:{gid}::/:/bin/false\n"));
            this.put("etc/group", "holod:x:64123:\ndialout:x:64124:\nvideo:x:64125:\nrender:x:64126:\n");
            this.put("usr/lib/systemd/system/holod.service", include_str!("../../../../deploy/systemd/holod.service"));
            this.put("usr/lib/udev/rules.d/60-holod-latency.rules", "SUBSYSTEM==\"usb-serial\"\n");
            this.put("etc/holod/rig.toml", "");
            this.put("dev/ttyUSB3", "");
            this.put("dev/ttyACM0", "");
            this.put("dev/dri/card0", "");
            this.put("dev/dri/renderD128", "");
            this.put("sys/class/drm/card0-DP-1/status", "connected\n");
            this.put("sys/class/tty/ttyUSB3/device/port_number", "0\n");
            symlink("/drivers/ftdi_sio", this.root().join("sys/class/tty/ttyUSB3/device/driver")).unwrap();
            symlink("ttyUSB3", this.root().join("dev/holod-tracker")).unwrap();
            symlink("ttyACM0", this.root().join("dev/holod-lasers")).unwrap();
            fs::create_dir_all(this.root().join("var/lib/holod")).unwrap();
            this.write_drop_in(&["--output", "drm:DP-1"]);
            this
        }

        fn root(&self) -> &Path {
            self.0.path()
        }

        fn put(&self, path: &str, text: &str) {
            let path = self.root().join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        }

        fn mode(&self, path: &str, mode: u32) {
            fs::set_permissions(self.root().join(path), fs::Permissions::from_mode(mode)).unwrap();
        }

        /// As `holod unit` with these options.
        fn write_drop_in(&self, options: &[&str]) {
            let words: Vec<String> =
                ["--config", USUAL_RIG].iter().chain(options).map(|word| (*word).to_owned()).collect();
            let cli =
                Cli::try_parse_from(["holod", "unit"].map(str::to_owned).into_iter().chain(words.clone())).unwrap();
            let Some(Command::Unit(args)) = cli.command else { panic!("{cli:?}") };
            let text = drop_in(&bench(), &args.run, &words, self.root()).unwrap();
            self.put("etc/systemd/system/holod.service.d/bench.conf", &text);
        }

        fn edit_drop_in(&self, from: &str, to: &str) {
            let path = "etc/systemd/system/holod.service.d/bench.conf";
            let text = fs::read_to_string(self.root().join(path)).unwrap();
            assert!(text.contains(from), "{text}");
            self.put(path, &text.replace(from, to));
        }

        fn checks(&self, rig: &Rig) -> BTreeMap<&'static str, (bool, String)> {
            let words = ["holod", "check", "--service", "--config", USUAL_RIG, "--output", "drm:DP-1"];
            let Some(Command::Check(args)) = Cli::try_parse_from(words).unwrap().command else { panic!() };
            let checks = service(rig, &args, self.root());
            checks.into_iter().map(|check| (check.name, (check.passed, check.says))).collect()
        }

        fn fault(&self, name: &str, parts: &[&str]) {
            let (passed, says) = self.checks(&bench()).remove(name).unwrap();
            assert!(!passed, "{says}");
            parts.iter().for_each(|part| assert!(says.contains(part), "`{part}` is not in: {says}"));
        }
    }

    fn bench() -> Rig {
        let mut rig = Rig::default();
        rig.tracker.spec = Some("serial:/dev/holod-tracker".into());
        rig.lasers.driver = LaserDriver::Serial { path: "/dev/holod-lasers".into(), sync_wire: false };
        rig
    }

    #[test]
    fn a_machine_that_is_as_the_readme_asks_passes_and_says_so() {
        let checks = Machine::new().checks(&bench());
        assert!(checks.values().all(|(passed, says)| *passed && !says.contains("warning: /")), "{checks:#?}");
        assert!(checks["unit"].1.contains("--config /etc/holod/rig.toml --output drm:DP-1"), "{checks:#?}");
        assert!(checks["graphics"].1.contains("/dev/dri/renderD128, /dev/dri/card0"), "{checks:#?}");
        assert!(checks["rules"].1.contains("in force for /dev/holod-tracker"), "{checks:#?}");
    }

    #[test]
    fn a_drop_in_that_is_missing_or_behind_the_bench_is_to_be_written_anew() {
        let machine = Machine::new();
        machine.edit_drop_in("DeviceAllow=char-ttyACM rw\n", "");
        machine.fault("unit", &["DeviceAllow= lacks char-ttyACM", "holod unit --config /etc/holod/rig.toml"]);
        let machine = Machine::new();
        machine.edit_drop_in("--output drm:DP-1", "--output drm:DP-1 --tracker core:192.0.2.7");
        machine.fault("unit", &["RestrictAddressFamilies= lacks AF_INET, AF_INET6", "IPAddressAllow= lacks localhost"]);
        machine.fault("unit", &["Wants= lacks network-online.target", "After= lacks network-online.target"]);
        let machine = Machine::new();
        machine.edit_drop_in("--output drm:DP-1", "--output drm:DP-1 --no-such-option");
        machine.fault("unit", &["--no-such-option", "write it anew"]);
        let machine = Machine::new();
        machine.edit_drop_in("--output drm:DP-1", "--output drm:DP-1 --page 192.168.1.5:8420");
        machine.fault("unit", &["--page 192.168.1.5:8420: other machines reach this address, so it needs a token"]);
        let machine = Machine::new();
        machine.write_drop_in(&[]);
        machine.fault("unit", &["shows on headless, this check is of drm:DP-1"]);
        let machine = Machine::new();
        machine.edit_drop_in("/etc/holod/rig.toml", "/srv/other.toml");
        machine.fault("unit", &["runs with the rig /srv/other.toml"]);
        let machine = Machine::new();
        fs::remove_dir_all(machine.root().join("etc/systemd/system/holod.service.d")).unwrap();
        machine.fault("unit", &["shows on headless", "lacks char-ttyACM"]);
        fs::remove_file(machine.root().join("usr/lib/systemd/system/holod.service")).unwrap();
        machine.fault("unit", &["there is no holod.service: install the package"]);
    }

    #[test]
    fn a_unit_that_keeps_threads_from_being_on_time_is_refused() {
        let machine = Machine::new();
        machine.put("etc/systemd/system/holod.service.d/override.conf", "[Service]\nLimitRTPRIO=5\n");
        machine.fault("realtime", &["LimitRTPRIO=5", "at least 10"]);
        machine.put("etc/systemd/system/holod.service.d/override.conf", "[Service]\nRestrictRealtime=yes\n");
        machine.fault("realtime", &["RestrictRealtime="]);
    }

    #[test]
    fn a_bench_that_fails_soon_after_its_start_is_not_started_for_ever_however_slowly_it_fails() {
        let machine = Machine::new();
        let pause_s = || {
            let unit = Unit::read(machine.root()).unwrap();
            let figure = |key: &str| unit.all(key).last().and_then(|value| value.parse::<u64>().ok()).unwrap();
            // It says nothing until it is given up, or its first frame stays; then it does not end by itself.
            let slowest_s: u64 =
                ["TimeoutStartSec", "WatchdogSec", "TimeoutStopSec", "RestartSec"].map(figure).into_iter().sum();
            let interval_s = figure("StartLimitIntervalSec");
            assert!(figure("StartLimitBurst") * slowest_s <= interval_s, "{slowest_s} s a start, {interval_s} s");
            (figure("StartLimitBurst") - 1) * figure("RestartSec")
        };
        pause_s();
        machine.write_drop_in(&["--output", "drm:DP-1", "--tracker", "core:192.0.2.7"]);
        assert!(pause_s() > 30, "a network may be so late");
        let example = include_str!("../../../../deploy/systemd/holod.service.d/network-tracker.conf");
        machine.put("etc/systemd/system/holod.service.d/bench.conf", example);
        assert!(pause_s() > 30, "a network may be so late");
    }

    #[test]
    fn what_the_services_user_may_not_open_is_named() {
        let machine = Machine::new();
        machine.mode("dev/dri/renderD128", 0o000);
        machine.mode("dev/dri/card0", 0o000);
        machine.fault("graphics", &["may not open /dev/dri/renderD128", "may not open /dev/dri/card0"]);
        machine.mode("var/lib/holod", 0o500);
        machine.fault("records", &["may not write to /var/lib/holod", "chown holod:holod"]);
        fs::remove_dir(machine.root().join("var/lib/holod")).unwrap();
        assert!(machine.checks(&bench())["records"].0, "systemd makes it");
        let machine = Machine::new();
        machine.put("etc/holod/token", "0123456789abcdef\n");
        machine.mode("etc/holod/token", 0o644);
        machine.write_drop_in(&["--output", "drm:DP-1", "--page", "8420", "--page-token", "/etc/holod/token"]);
        machine.fault("options", &["others may read /etc/holod/token", "chown holod /etc/holod/token && chmod 600"]);
        machine.mode("etc/holod/token", 0o600);
        assert!(machine.checks(&bench())["options"].0);
        machine.write_drop_in(&["--output", "drm:DP-1", "--scene", "/srv/cards"]);
        machine.fault("options", &["--scene /srv/cards: No such file"]);
    }

    #[test]
    fn a_rule_that_is_missing_or_hidden_is_told_where_a_port_needs_it() {
        let machine = Machine::new();
        machine.put("etc/udev/rules.d/60-holod-latency.rules", "");
        let (passed, says) = machine.checks(&bench()).remove("rules").unwrap();
        assert!(passed && says.contains("warning") && says.contains("hides 60-holod-latency.rules"), "{says}");
        for folder in ["etc", "usr/lib"] {
            fs::remove_file(machine.root().join(folder).join("udev/rules.d/60-holod-latency.rules")).unwrap();
        }
        machine.fault("rules", &["60-holod-latency.rules is missing"]);
        let mut other = bench();
        other.tracker.spec = Some("mock".into());
        assert!(machine.checks(&other)["rules"].0);
    }

    #[test]
    fn a_hid_tracker_that_the_service_may_not_read_gets_its_rule() {
        let machine = Machine::new();
        let mut rig = bench();
        assert!(!machine.checks(&rig).contains_key("hid"));
        rig.tracker.spec = Some("hid:1209:0001".into());
        let hid = |machine: &Machine| machine.checks(&rig).remove("hid").unwrap();
        machine.put("sys/class/hidraw/hidraw0/device/uevent", "HID_ID=0003:0000046D:0000C31C\n");
        machine.put("dev/hidraw0", "");
        assert!(!hid(&machine).0 && hid(&machine).1.contains("no HID device 1209:0001"), "a keyboard is none");
        machine.put("sys/class/hidraw/hidraw1/device/uevent", "DRIVER=hid\nHID_ID=0003:00001209:00000001\n");
        machine.put("dev/hidraw1", "");
        machine.mode("dev/hidraw1", 0o200);
        let (passed, says) = hid(&machine);
        assert!(!passed && says.contains("/dev/hidraw1") && says.contains("KERNELS==\"????:1209:0001.*\""), "{says}");
        machine.mode("dev/hidraw1", 0o600);
        assert!(hid(&machine).0);
    }
}

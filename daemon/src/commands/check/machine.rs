//! What else on this machine gets in the way: programs that have a port open or open it by themselves, another holod,
//! processors that go slow to save power.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use holod_calibration::rig::Rig;

use super::Check;
use super::access::{named, serial_ports_of};
use crate::commands::service_facts::below;
use crate::commands::unit::names;
use crate::results::file_name;

/// A process, by its number and name.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Process {
    pid: u32,
    name: String,
}

/// What is judged for whoever runs holod; `/proc`, `/sys` and `/run/udev` are those below `root`.
pub(super) fn machine(rig: &Rig, service: bool, root: &Path) -> Vec<Check> {
    let processes = others(root);
    let mut checks = vec![named("ports", ports(rig, &processes, root)), governor(root)];
    if service {
        checks.push(named("alone", alone(&processes)));
    }
    checks
}

/// Every process but this one.
fn others(root: &Path) -> Vec<Process> {
    let numbers = names(&root.join("proc"), "").into_iter().filter_map(|name| name.parse::<u32>().ok());
    let others = numbers.filter(|pid| *pid != std::process::id());
    let name = |pid| Some(fs::read_to_string(root.join(format!("proc/{pid}/comm"))).ok()?.trim().to_owned());
    others.filter_map(|pid| Some(Process { pid, name: name(pid)? })).collect()
}

/// Who has a device open. Processes of other users are seen by root alone.
fn holders<'p>(node: &Path, processes: &'p [Process], root: &Path) -> Vec<&'p Process> {
    let holds = |process: &&Process| {
        let folder = root.join(format!("proc/{}/fd", process.pid));
        let Ok(descriptors) = fs::read_dir(folder) else { return false };
        descriptors.flatten().any(|entry| fs::read_link(entry.path()).is_ok_and(|target| target == node))
    };
    processes.iter().filter(holds).collect()
}

/// The node that a name leads to, as processes below `root` see it.
fn node_of(path: &Path, root: &Path) -> Option<PathBuf> {
    let (node, root) = (below(root, path).canonicalize().ok()?, root.canonicalize().ok()?);
    Some(Path::new("/").join(node.strip_prefix(root).ok()?))
}

/// Whether the rig's serial ports are nobody else's, now and after a replug.
fn ports(rig: &Rig, processes: &[Process], root: &Path) -> Result<String, Vec<String>> {
    let (mut faults, mut said) = (Vec::new(), Vec::new());
    let runs = |name: &str| processes.iter().any(|process| process.name == name);
    // One that is not there is named elsewhere.
    let ports = serial_ports_of(rig).into_iter().filter_map(|path| Some((node_of(&path, root)?, path)));
    for (node, path) in ports {
        let shown = path.display();
        let holders = holders(&node, processes, root);
        for Process { pid, name } in &holders {
            faults.push(format!("{shown} is held by {name} (process {pid}): {}", release(name)));
        }
        if !holders.is_empty() {
            continue;
        }
        let is_usb =
            ["ttyUSB", "ttyACM"].iter().any(|class| node.starts_with("/dev") && file_name(&node).starts_with(class));
        let mut warnings = Vec::new();
        if is_usb && file_name(&path) == file_name(&node) {
            warnings
                .push("may have another number after a replug: name it in /dev/serial/by-id, or by a udev rule".into());
        }
        for meddler in ["ModemManager", "brltty"] {
            if is_usb && runs(meddler) && !(meddler == "ModemManager" && is_left_alone(&node, root)) {
                warnings.push(format!(
                    "{meddler} runs, which tries such ports when they are plugged in: {}",
                    release(meddler)
                ));
            }
        }
        said.push(if warnings.is_empty() {
            format!("{shown} is free")
        } else {
            format!("{shown} is free; warning: it {}", warnings.join("; "))
        });
    }
    match (faults.is_empty(), said.is_empty()) {
        (false, _) => Err(faults),
        (true, true) => Ok("the rig names no serial port that is there".into()),
        (true, false) => Ok(said.join("; ")),
    }
}

/// How a program is brought to let a port go.
fn release(name: &str) -> String {
    match name {
        "ModemManager" => {
            "add ENV{ID_MM_DEVICE_IGNORE}=\"1\" to the port's udev rule, or `systemctl disable --now ModemManager`"
                .into()
        }
        "brltty" => "`systemctl disable --now brltty-udev brltty`, or remove it where nobody reads Braille".into(),
        "holod" => "`systemctl stop holod`, or end the one that was started by hand".into(),
        _ => "end it".into(),
    }
}

/// Whether udev tells ModemManager to leave a port alone.
fn is_left_alone(node: &Path, root: &Path) -> bool {
    let number = fs::read_to_string(root.join("sys/class/tty").join(file_name(node)).join("dev")).unwrap_or_default();
    let known = fs::read_to_string(root.join("run/udev/data").join(format!("c{}", number.trim()))).unwrap_or_default();
    known.lines().any(|line| line == "E:ID_MM_DEVICE_IGNORE=1")
}

/// A service that starts beside another holod gets neither panel nor laser box.
fn alone(processes: &[Process]) -> Result<String, Vec<String>> {
    let holods: Vec<String> =
        processes.iter().filter(|process| process.name == "holod").map(|holod| holod.pid.to_string()).collect();
    if holods.is_empty() {
        Ok("no other holod runs".into())
    } else {
        let pids = holods.join(", ");
        Err(vec![format!("holod runs already (process {pids}), and has what the service needs: {}", release("holod"))])
    }
}

/// A warning where processors save power: what they were slow for has no second chance.
fn governor(root: &Path) -> Check {
    let folder = root.join("sys/devices/system/cpu");
    let mut governors = BTreeMap::<String, usize>::new();
    for core in names(&folder, "cpu") {
        if let Ok(governor) = fs::read_to_string(folder.join(core).join("cpufreq/scaling_governor")) {
            *governors.entry(governor.trim().to_owned()).or_default() += 1;
        }
    }
    let slow: Vec<String> = governors
        .iter()
        .filter(|(name, _)| *name != "performance")
        .map(|(name, cores)| format!("{cores} cores under `{name}`"))
        .collect();
    let says = match (governors.is_empty(), slow.is_empty()) {
        (true, _) => "the processors' clocks are not this system's to set".to_owned(),
        (false, true) => "all cores run under `performance`".to_owned(),
        (false, false) => format!(
            "warning: {}: a frame after a pause may come late; `cpupower frequency-set --governor performance` until the \
             next start",
            slow.join(", ")
        ),
    };
    Check { name: "governor", passed: true, says }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use holod_calibration::rig::LaserDriver;

    use super::*;

    /// A machine with a tracker and a laser box, whose processes are these.
    fn machine_with(processes: &[(u32, &str, &[&str])]) -> tempfile::TempDir {
        let root = tempfile::tempdir().unwrap();
        let put = |path: &str, text: &str| {
            let path = root.path().join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        };
        put("dev/ttyUSB3", "");
        put("dev/ttyACM0", "");
        put("sys/class/tty/ttyUSB3/dev", "188:3\n");
        put("sys/class/tty/ttyACM0/dev", "166:0\n");
        put("run/udev/data/c188:3", "E:ID_MM_DEVICE_IGNORE=1\n");
        put("run/udev/data/c166:0", "E:ID_MM_DEVICE_IGNORE=0\n");
        symlink("ttyUSB3", root.path().join("dev/holod-tracker")).unwrap();
        for (pid, name, open) in processes {
            put(&format!("proc/{pid}/comm"), &format!("{name}\n"));
            let folder = root.path().join(format!("proc/{pid}/fd"));
            fs::create_dir_all(&folder).unwrap();
            for (number, target) in open.iter().enumerate() {
                symlink(target, folder.join(number.to_string())).unwrap();
            }
        }
        root
    }

    fn bench() -> Rig {
        let mut rig = Rig::default();
        rig.tracker.spec = Some("serial:/dev/holod-tracker".into());
        rig.lasers.driver = LaserDriver::Serial { path: "/dev/ttyACM0".into(), sync_wire: false };
        rig
    }

    fn says(root: &Path, name: &str) -> (bool, String) {
        let check = machine(&bench(), true, root).into_iter().find(|check| check.name == name).unwrap();
        (check.passed, check.says)
    }

    #[test]
    fn whoever_has_a_port_open_is_named_with_what_makes_it_let_go() {
        let root = machine_with(&[(7, "bash", &["/dev/pts/1"]), (812, "ModemManager", &["/dev/null", "/dev/ttyUSB3"])]);
        let (passed, said) = says(root.path(), "ports");
        assert!(!passed);
        assert!(said.contains("/dev/holod-tracker is held by ModemManager (process 812)"), "{said}");
        assert!(said.contains("ID_MM_DEVICE_IGNORE"), "{said}");
        let root = machine_with(&[(7, "minicom", &["/dev/ttyACM0"]), (9, "holod", &["/dev/ttyUSB3"])]);
        let (passed, said) = says(root.path(), "ports");
        assert!(!passed && said.contains("held by minicom (process 7): end it"), "{said}");
        assert!(said.contains("held by holod (process 9): `systemctl stop holod`"), "{said}");
    }

    #[test]
    fn what_tries_ports_by_itself_is_a_warning_where_no_rule_keeps_it_off() {
        let root = machine_with(&[(7, "bash", &[])]);
        let (passed, said) = says(root.path(), "ports");
        assert!(passed && said.contains("/dev/holod-tracker is free") && !said.contains("ModemManager"), "{said}");
        assert!(said.contains("/dev/ttyACM0 is free; warning: it may have another number"), "{said}");
        let root = machine_with(&[(812, "ModemManager", &[])]);
        let (passed, said) = says(root.path(), "ports");
        let (lasers, tracker) = said.split_once("/dev/holod-tracker").unwrap();
        assert!(passed && lasers.contains("ModemManager runs") && !tracker.contains("ModemManager"), "{said}");
        let root = machine_with(&[(813, "brltty", &[])]);
        assert!(says(root.path(), "ports").1.split_once("/dev/holod-tracker").unwrap().1.contains("brltty runs"));
    }

    #[test]
    fn the_service_wants_to_be_the_only_holod() {
        let root = machine_with(&[(7, "holod", &[]), (std::process::id(), "holod", &[])]);
        let (passed, said) = says(root.path(), "alone");
        assert!(!passed && said.contains("(process 7)") && said.contains("systemctl stop holod"), "{said}");
        let root = machine_with(&[(7, "holodeck", &[]), (std::process::id(), "holod", &[])]);
        assert!(says(root.path(), "alone").0);
        assert!(machine(&bench(), false, root.path()).iter().all(|check| check.name != "alone"), "a caller may try");
    }

    #[test]
    fn cores_that_save_power_are_a_warning() {
        let root = machine_with(&[]);
        assert!(says(root.path(), "governor").1.contains("not this system's"));
        let set = |core: usize, governor: &str| {
            let folder = root.path().join(format!("sys/devices/system/cpu/cpu{core}/cpufreq"));
            fs::create_dir_all(&folder).unwrap();
            fs::write(folder.join("scaling_governor"), governor).unwrap();
        };
        set(0, "performance\n");
        set(1, "performance\n");
        let (passed, said) = says(root.path(), "governor");
        assert!(passed && !said.contains("warning"), "{said}");
        set(1, "powersave\n");
        let (passed, said) = says(root.path(), "governor");
        assert!(passed && said.contains("warning: 1 cores under `powersave`"), "{said}");
    }
}

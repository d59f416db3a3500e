//! Whether the user who is to run holod may open what the rig names: this one, or the service's.

use std::fs;
use std::io::ErrorKind;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use holod_calibration::rig::Rig;
use holod_pupil_input::TrackerSpec;
use rustix::fs::Access;
use rustix::process::{Resource, getrlimit};

use super::Check;
use crate::commands::service_facts::{files_of, unseen_by_service};
use crate::scheduling;

const SERVICE_USER: &str = "holod";
/// The groups that the unit adds.
const SERVICE_GROUPS: [&str; 3] = ["dialout", "video", "render"];
/// What the panel's, lasers' and tracker's threads ask for.
pub(super) const REALTIME_PRIORITY: u64 = scheduling::REALTIME_PRIORITY as u64;

/// Who is to run holod.
#[derive(Debug)]
pub(super) enum Runner {
    Caller,
    Service { uid: u32, gids: Vec<u32> },
}

/// Devices, files and real-time scheduling, for the caller or for the service; users and groups are those below `root`.
pub(super) fn access(rig: &Rig, service: bool, root: &Path) -> Vec<Check> {
    let runner = match service.then(|| Runner::service(root)) {
        None => Runner::Caller,
        Some(Ok(runner)) => runner,
        Some(Err(says)) => return vec![Check { name: "user", passed: false, says }],
    };
    let mut checks = vec![named("devices", devices(rig, &runner)), named("files", files(rig, &runner))];
    checks.extend((!service).then(|| realtime(getrlimit(Resource::Rtprio).current)));
    checks
}

/// One line: what is wrong, or what is right.
pub(super) fn named(name: &'static str, found: Result<String, Vec<String>>) -> Check {
    match found {
        Ok(says) => Check { name, passed: true, says },
        Err(faults) => Check { name, passed: false, says: faults.join("; ") },
    }
}

fn devices(rig: &Rig, runner: &Runner) -> Result<String, Vec<String>> {
    let mut paths = serial_ports_of(rig);
    // One that is not there is named elsewhere.
    paths.retain(|path| path.exists());
    let faults: Vec<String> = paths
        .iter()
        .filter(|path| !runner.may(path, Access::READ_OK | Access::WRITE_OK))
        .map(|path| format!("{} may not open {}: {}", runner.name(), path.display(), cure(path, runner)))
        .collect();
    match (&paths[..], faults.is_empty()) {
        (_, false) => Err(faults),
        ([], true) => Ok("the rig names no serial port that is there".into()),
        (paths, true) => {
            let paths: Vec<_> = paths.iter().map(|path| path.display().to_string()).collect();
            Ok(format!("{} may open {}", runner.name(), paths.join(", ")))
        }
    }
}

/// The serial ports that the rig names: those of the laser box, then the tracker's.
pub(super) fn serial_ports_of(rig: &Rig) -> Vec<PathBuf> {
    let lasers = rig.lasers.driver.paths().into_iter().map(Path::to_path_buf);
    let tracker = rig.tracker.spec.as_ref().and_then(|spec| match spec.parse() {
        Ok(TrackerSpec::Serial { path, .. }) => Some(path),
        Ok(TrackerSpec::Path(path)) if path.starts_with("/dev") => Some(path),
        _ => None,
    });
    lasers.chain(tracker).collect()
}

pub(super) fn cure(path: &Path, runner: &Runner) -> String {
    let gid = fs::metadata(path).map(|found| found.gid());
    let group = gid.ok().and_then(|gid| group_name(gid, Path::new("/")));
    match (group.filter(|group| group != "root"), runner) {
        (Some(group), Runner::Caller) => {
            format!("it is of the group {group}: usermod -aG {group} NAME, and log in anew")
        }
        (Some(group), Runner::Service { .. }) => {
            format!("it is of the group {group}: add SupplementaryGroups={group} with `systemctl edit holod`")
        }
        (None, _) => {
            "no group but root may: give it one with a udev rule, such as GROUP=\"dialout\", MODE=\"0660\"".into()
        }
    }
}

fn files(rig: &Rig, runner: &Runner) -> Result<String, Vec<String>> {
    let files = files_of(rig);
    let mut faults = Vec::new();
    for file in &files {
        let shown = file.display();
        match (runner, unseen_by_service(file)) {
            (Runner::Service { .. }, Some(why)) => faults.push(why),
            _ if matches!(file.metadata(), Err(error) if error.kind() == ErrorKind::NotFound) => {
                faults.push(format!("there is no {shown}: correct its path"));
            }
            _ if !runner.may(file, Access::READ_OK) => {
                faults.push(format!(
                    "{} may not read {shown}: chmod a+r {shown}, and chmod a+x the folders above it",
                    runner.name()
                ));
            }
            _ => {}
        }
    }
    match (files.len(), faults.is_empty()) {
        (_, false) => Err(faults),
        (0, true) => Ok("the rig names none".into()),
        (count, true) => Ok(format!("{} may read the {count} that the rig names, itself included", runner.name())),
    }
}

/// A warning where it is not allowed: a bench that nothing else runs on is on time without.
fn realtime(limit: Option<u64>) -> Check {
    let says = match limit {
        Some(limit) if limit < REALTIME_PRIORITY => format!(
            "warning: this user may ask for a real-time priority of {limit}, and holod asks for {REALTIME_PRIORITY}: \
             fields may be late on a busy machine; the service may, others with rtprio in /etc/security/limits.conf"
        ),
        _ => format!("this user may ask for a real-time priority of {REALTIME_PRIORITY}"),
    };
    Check { name: "realtime", passed: true, says }
}

impl Runner {
    /// The service's user.
    ///
    /// # Errors
    /// Why there is none, and what makes it.
    pub(super) fn service(root: &Path) -> Result<Self, String> {
        let field = |line: &str, n: usize| line.split(':').nth(n)?.parse::<u32>().ok();
        let line = line_of("passwd", SERVICE_USER, root)
            .ok_or_else(|| format!("there is no user {SERVICE_USER}: install the package, or run systemd-sysusers"))?;
        let (Some(uid), Some(gid)) = (field(&line, 2), field(&line, 3)) else {
            return Err(format!("/etc/passwd: found `{line}`, expected seven fields"));
        };
        let mut gids = vec![gid];
        for group in SERVICE_GROUPS {
            let line = line_of("group", group, root).and_then(|line| field(&line, 2));
            gids.push(line.ok_or_else(|| {
                format!(
                    "there is no group {group}, and no service without it: systemd-sysusers makes those of the package"
                )
            })?);
        }
        Ok(Self::Service { uid, gids })
    }

    pub(super) fn name(&self) -> &'static str {
        match self {
            Self::Caller => "this user",
            Self::Service { .. } => "the service",
        }
    }

    pub(super) fn may(&self, path: &Path, wanted: Access) -> bool {
        match self {
            Self::Caller => rustix::fs::access(path, wanted).is_ok(),
            Self::Service { uid, gids } => {
                let Ok(path) = path.canonicalize() else { return false };
                let folders = path.ancestors().skip(1);
                permits(&path, wanted, *uid, gids)
                    && folders.into_iter().all(|folder| permits(folder, Access::EXEC_OK, *uid, gids))
            }
        }
    }
}

/// The kernel's rule for a user without privileges: the first of owner, group and others that he is counts.
fn permits(path: &Path, wanted: Access, uid: u32, gids: &[u32]) -> bool {
    let Ok(found) = fs::metadata(path) else { return false };
    let shift = match () {
        () if found.uid() == uid => 6,
        () if gids.contains(&found.gid()) => 3,
        () => 0,
    };
    Access::from_bits_truncate(found.mode() >> shift & 0o7).contains(wanted)
}

/// The line of a name in `/etc/passwd` or `/etc/group`.
fn line_of(table: &str, name: &str, root: &Path) -> Option<String> {
    let text = fs::read_to_string(root.join("etc").join(table)).ok()?;
    text.lines().find(|line| line.split(':').next() == Some(name)).map(str::to_owned)
}

fn group_name(gid: u32, root: &Path) -> Option<String> {
    let text = fs::read_to_string(root.join("etc/group")).ok()?;
    let line = text.lines().find(|line| line.split(':').nth(2).and_then(|id| id.parse().ok()) == Some(gid))?;
    line.split(':').next().map(str::to_owned)
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use holod_calibration::rig::{LaserDriver, WeightsChoice};

    use super::*;

    /// A machine whose service user is somebody else than whoever runs this test, with its group that of a file here.
    fn machine(member: bool) -> tempfile::TempDir {
        // Below /srv or the like nobody needs rights here; what counts is the file's own mode.
        let root = tempfile::tempdir().unwrap();
        fs::set_permissions(root.path(), fs::Permissions::from_mode(0o755)).unwrap();
        fs::create_dir(root.path().join("etc")).unwrap();
        let gid = if member { fs::metadata(root.path()).unwrap().gid() } else { 54_321 };
        fs::write(root.path().join("etc/passwd"), "root:x:0:0::/:/bin/sh\nholod:x:64123:64123::/:/bin/false\n")
            .unwrap();
        fs::write(
            root.path().join("etc/group"),
            format!("holod:x:64123:\ndialout:x:{gid}:\nvideo:x:54322:\nrender:x:54323:\n"),
        )
        .unwrap();
        root
    }

    fn file(root: &Path, mode: u32) -> PathBuf {
        let path = root.join("port");
        fs::write(&path, "").unwrap();
        fs::set_permissions(&path, fs::Permissions::from_mode(mode)).unwrap();
        path
    }

    #[test]
    fn a_port_of_the_group_is_opened_by_its_members_only() {
        for (member, mode, expected) in [
            (true, 0o660, true),
            (true, 0o640, false),
            (true, 0o606, false),
            (false, 0o660, false),
            (false, 0o666, true),
        ] {
            let root = machine(member);
            let port = file(root.path(), mode);
            let mut rig = Rig::default();
            rig.lasers.driver = LaserDriver::Serial { path: port.clone(), sync_wire: false };
            let checks = access(&rig, true, root.path());
            let devices = checks.iter().find(|check| check.name == "devices").unwrap();
            assert_eq!(devices.passed, expected, "{member} {mode:o}: {}", devices.says);
            assert!(devices.says.contains(port.to_str().unwrap()), "{}", devices.says);
        }
    }

    #[test]
    fn a_machine_without_the_service_user_is_told_what_makes_it() {
        let root = tempfile::tempdir().unwrap();
        let checks = access(&Rig::default(), true, root.path());
        assert!(!checks[0].passed && checks[0].says.contains("install the package"), "{}", checks[0].says);
        assert!(access(&Rig::default(), false, root.path()).iter().all(|check| check.passed));
        let root = machine(true);
        assert!(access(&Rig::default(), true, root.path())[0].passed);
        let groups = fs::read_to_string(root.path().join("etc/group")).unwrap();
        fs::write(root.path().join("etc/group"), groups.replace("render:", "renderer:")).unwrap();
        let checks = access(&Rig::default(), true, root.path());
        assert!(!checks[0].passed && checks[0].says.contains("no group render"), "{}", checks[0].says);
    }

    #[test]
    fn a_file_that_the_service_does_not_see_is_refused_for_it_alone() {
        let root = machine(true);
        let mut rig = Rig::default();
        rig.model.weights = WeightsChoice::File(file(root.path(), 0o644));
        let passed =
            |service| access(&rig, service, root.path()).into_iter().find(|check| check.name == "files").unwrap();
        assert!(passed(false).passed);
        // tempfile's folder is below /tmp.
        if root.path().starts_with("/tmp") {
            assert!(!passed(true).passed && passed(true).says.contains("does not see /tmp"));
        }
    }

    #[test]
    fn every_file_that_a_rig_names_is_looked_at() {
        let root = machine(true);
        let path = |name: &str| root.path().join(name);
        fs::write(path("lasers.toml"), include_str!("../../../../calibration/profiles/lasers/cobolt.toml")).unwrap();
        fs::write(path("eye.txt"), "").unwrap();
        let text = Rig::BUILT_IN_TOML.replace(
            "driver = \"simulated\"",
            "driver = \"text\"\nprofile_file = \"lasers.toml\"\ndevices = { green = \"/dev/x\" }\ngated_by_panel = true\n\
             accept_no_heartbeat = \"these lasers stay lit when holod dies\"",
        );
        fs::write(path("rig.toml"), format!("{text}\n")).unwrap();
        let mut rig = Rig::load(&path("rig.toml")).unwrap();
        rig.tracker.spec = Some(format!("mock:{}", path("eye.txt").display()));
        assert_eq!(files_of(&rig), ["rig.toml", "lasers.toml", "eye.txt"].map(path));
        let told = || access(&rig, false, root.path()).into_iter().find(|check| check.name == "files").unwrap().says;
        assert!(told().contains("may read the 3 that"), "{}", told());
        fs::remove_file(path("lasers.toml")).unwrap();
        assert!(told().contains("there is no ") && told().contains("lasers.toml"), "{}", told());
    }

    #[test]
    fn too_low_a_limit_is_a_warning() {
        assert!(realtime(Some(0)).says.contains("warning"));
        assert!(realtime(Some(0)).passed);
        assert!(!realtime(Some(20)).says.contains("warning") && !realtime(None).says.contains("warning"));
    }
}

//! What a running holod says of itself: a small JSON file of its own that it writes anew each second and takes away at
//! its end.

use std::collections::{BTreeMap, VecDeque};
use std::fs::File;
use std::io::{ErrorKind, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread::{self, JoinHandle};
use std::time::Duration;

use holod_calibration::{TimeNs, host_now, write_atomically};
use rustix::fs::{Mode, OFlags};
use serde::{Deserialize, Serialize};

use crate::aside::{Queue, Taking, join_within};
use crate::failure::{Exit, Failure};
use crate::local_socket::connect_within;
use crate::runtime_folder;
use crate::snapshot::Snapshot;

/// The folder that the service's unit asks systemd for.
pub(crate) const SERVICE_FOLDER: &str = "/run/holod";
/// A file older than this was not written by a loop that still turns.
const STALE: TimeNs = TimeNs(5_000_000_000);
/// Bytes of the longest file that is read.
const LONGEST: u64 = 1 << 20;
/// Moments that may wait for the disk, of which the newest is written; what comes after them is left out.
const WAITING: usize = 4;
/// How long the end of a run waits for its file to be taken away.
const PATIENCE: Duration = Duration::from_secs(1);

/// The file of one process: each has its own, so that two holods know nothing of each other's.
fn file_name(pid: u32) -> String {
    format!("status-{pid}.json")
}

/// What the file holds.
#[derive(Serialize, Deserialize)]
struct Written<S> {
    /// When it was written, on the host's monotonic clock: the wall clock, and with it a file's own times, may be set
    /// while holod runs. Older versions do not say it.
    #[serde(default)]
    written_ns: Option<i64>,
    /// When the process began, as [`began_ticks`] has it. Older versions do not say it.
    #[serde(default)]
    began_ticks: Option<u64>,
    #[serde(flatten)]
    status: S,
}

/// The file of a running process, which a thread of its own writes. Dropping it takes the file away.
#[derive(Debug)]
pub(crate) struct StatusFile {
    newest: Arc<Queue<Vec<u8>>>,
    began_ticks: Option<u64>,
    writer: Option<JoinHandle<()>>,
}

impl StatusFile {
    /// The file, in the first folder that takes it; a process without any has none, which is no fault.
    pub(crate) fn create() -> Self {
        match runtime_folder::own() {
            Some(folder) => Self::of(std::process::id(), &folder),
            None => Self { newest: Arc::default(), began_ticks: None, writer: None },
        }
    }

    fn of(pid: u32, folder: &Path) -> Self {
        let path = folder.join(file_name(pid));
        let newest = Arc::new(Queue::default());
        let written = Arc::clone(&newest);
        let writer = thread::Builder::new().name("holod-status".into()).spawn(move || write(&written, &path));
        if let Err(error) = &writer {
            tracing::warn!("`holod status` will know nothing of this run: {error}");
        }
        Self { newest, began_ticks: began_ticks(pid), writer: writer.ok() }
    }

    /// Has the file written anew at host time `now`. Where the disk is still at what was written before, this one is
    /// left out.
    pub(crate) fn write(&mut self, status: &Snapshot, now: TimeNs) {
        if self.writer.is_none() {
            return;
        }
        match serde_json::to_vec(&Written { written_ns: Some(now.0), began_ticks: self.began_ticks, status }) {
            Ok(bytes) => drop(self.newest.put(bytes, WAITING)),
            Err(error) => tracing::warn!("`holod status` will not know of this: {error}"),
        }
    }
}

/// Writes what comes, and takes the file away at the end. A disk that refuses is told, and that it takes it again.
fn write(newest: &Queue<Vec<u8>>, path: &Path) {
    let mut taken = VecDeque::new();
    let mut refuses = false;
    while newest.take(&mut taken, Taking::AtOnce) {
        let Some(bytes) = taken.back() else { continue };
        let write = || write_atomically(path, |out| out.write_all(bytes));
        let mut written = write();
        let is_gone = written.as_ref().is_err_and(|error| error.kind() == ErrorKind::NotFound);
        if is_gone && path.parent().is_some_and(runtime_folder::make_again) {
            written = write();
        }
        match (&written, refuses) {
            (Err(error), false) => {
                let cure = if is_gone { format!("; {}", runtime_folder::LINGER) } else { String::new() };
                tracing::warn!("`holod status` knows nothing new of this run: {}: {error}{cure}", path.display());
            }
            (Ok(()), true) => tracing::info!("`holod status` knows of this run again"),
            _ => {}
        }
        refuses = written.is_err();
    }
    let _ = std::fs::remove_file(path);
}

/// Takes away what holods that were killed have left in this user's folders: nobody else does, and their numbers are
/// given out again. Call it before this process puts anything there.
pub(crate) fn remove_leftovers() {
    for folder in runtime_folder::candidates().into_iter().filter(|folder| runtime_folder::is_own(folder)) {
        remove_leftovers_in(&folder);
    }
}

fn remove_leftovers_in(folder: &Path) {
    let mut of_processes: BTreeMap<u32, Vec<PathBuf>> = BTreeMap::new();
    for path in std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path()) {
        let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        // Also a status that was being written.
        let of_status = name.trim_start_matches('.').strip_prefix("status-").and_then(|rest| rest.split('.').next());
        if let Some(pid) = of_status.or_else(|| name.strip_prefix("control-")).and_then(|pid| pid.parse().ok()) {
            of_processes.entry(pid).or_default().push(path);
        }
    }
    for (pid, paths) in of_processes {
        let status = std::fs::read(folder.join(file_name(pid))).unwrap_or_default();
        let began_ticks = serde_json::from_slice::<Written<()>>(&status).ok().and_then(|written| written.began_ticks);
        // The process of another container is not seen from here, but it answers.
        let answers = || match connect_within(&folder.join(format!("control-{pid}")), PATIENCE) {
            Ok(_) => true,
            Err(error) => error.kind() == ErrorKind::TimedOut,
        };
        if !lives(pid, began_ticks) && !answers() {
            paths.iter().for_each(|path| drop(std::fs::remove_file(path)));
        }
    }
}

/// Whether the process of this number lives and, where that is known, began then.
fn lives(pid: u32, began_ticks: Option<u64>) -> bool {
    let found = self::began_ticks(pid);
    found.is_some() && (began_ticks.is_none() || began_ticks == found)
}

/// When a process that lives began, in the kernel's clock ticks since the machine's start: with its number, it is this
/// process and no later one that was given the same number.
fn began_ticks(pid: u32) -> Option<u64> {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    // Field 22, see proc(5), the third being the first after the name, which may hold blanks and brackets.
    stat.rsplit_once(')')?.1.split_whitespace().nth(22 - 3)?.parse().ok()
}

impl Drop for StatusFile {
    fn drop(&mut self) {
        self.newest.close();
        if let Some(writer) = self.writer.take() {
            let _left = join_within(writer, PATIENCE);
        }
    }
}

/// What a running holod wrote last.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Found {
    pub pid: u32,
    /// Its control socket, where it has one.
    pub control: Option<PathBuf>,
    /// Nothing where it cannot be understood, as it may not be of another version.
    pub status: Option<Snapshot>,
    /// How long ago that was, where it is too long.
    pub stale: Option<Duration>,
}

/// What every version says of itself.
#[derive(Deserialize)]
struct Owner {
    pid: u32,
    #[serde(default)]
    control: Option<PathBuf>,
}

/// How old something is that a loop which turns says anew each second, where that is too old.
pub(crate) fn stale(age: TimeNs) -> Option<Duration> {
    (age > STALE).then(|| Duration::from_nanos(age.0.unsigned_abs()))
}

/// Every holod that runs, that of the service first, else in the order of their numbers.
///
/// # Errors
/// None runs, or what it says may not be read.
pub(crate) fn of_running() -> Result<Vec<Found>, Failure> {
    let mut folders = vec![PathBuf::from(SERVICE_FOLDER)];
    // In the folder for temporary files anybody could have made one of this user's name first.
    let is_trusted = |folder: &PathBuf| runtime_folder::is_own(folder) || !folder.exists();
    folders.extend(runtime_folder::candidates().into_iter().filter(is_trusted));
    folders.dedup();
    of_running_in(&folders, host_now())
}

/// Those that run and are meant: all, or the one of process `pid`.
///
/// # Errors
/// As [`of_running`], or that process is no holod.
pub(crate) fn of_running_as(pid: Option<u32>) -> Result<Vec<Found>, Failure> {
    let look = || {
        let mut running = of_running()?;
        running.retain(|found| pid.is_none_or(|pid| found.pid == pid));
        if running.is_empty() {
            return Err(Failure::new(Exit::Unavailable, "no holod of that process number is running"));
        }
        Ok(running)
    };
    // A listing that is read while a file is renamed may miss it.
    look().or_else(|_| look())
}

/// The only one.
///
/// # Errors
/// There are several.
pub(crate) fn only(running: &[Found]) -> Result<&Found, Failure> {
    if let [one] = running {
        return Ok(one);
    }
    let pids: Vec<_> = running.iter().map(|found| found.pid.to_string()).collect();
    let several = format!("{} holods are running, {}: name one with --pid", pids.len(), pids.join(" and "));
    Err(Failure::new(Exit::Usage, several))
}

fn of_running_in(folders: &[PathBuf], now: TimeNs) -> Result<Vec<Found>, Failure> {
    let mut running: Vec<Found> = Vec::new();
    let mut closed = None;
    for folder in folders {
        let entries = match std::fs::read_dir(folder) {
            Err(error) => {
                note_closed(&mut closed, folder, error);
                continue;
            }
            Ok(entries) => entries,
        };
        let mut found = Vec::new();
        for path in entries.flatten().map(|entry| entry.path()) {
            match read(&path, now) {
                Ok(one) => found.extend(one),
                Err(error) => note_closed(&mut closed, &path, error),
            }
        }
        found.sort_by_key(|found| found.pid);
        found.retain(|one| running.iter().all(|other| other.pid != one.pid));
        running.extend(found);
    }
    if !running.is_empty() {
        return Ok(running);
    }
    if let Some(closed) = closed {
        return Err(closed);
    }
    let folders: Vec<_> = folders.iter().map(|folder| folder.display().to_string()).collect();
    Err(Failure::new(
        Exit::Unavailable,
        format!(
            "no holod is running that wrote its status to {}; start it with `systemctl start holod` or `holod run`",
            folders.join(" or ")
        ),
    ))
}

/// The first place that may not be read, which matters where no other holod is found.
fn note_closed(closed: &mut Option<Failure>, place: &Path, error: std::io::Error) {
    if error.kind() == std::io::ErrorKind::PermissionDenied {
        let said = format!("{}: {error}; ask as root, or as a member of the group `holod`", place.display());
        closed.get_or_insert(Failure::new(Exit::NoInput, said));
    }
}

/// The status of a process that lives, out of its own file, at host time `now`.
fn read(path: &Path, now: TimeNs) -> std::io::Result<Option<Found>> {
    let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    if !(name.starts_with("status-") && name.ends_with(".json")) {
        return Ok(None);
    }
    let bytes = read_file(path)?;
    let written = serde_json::from_slice::<Written<Owner>>(&bytes);
    let Ok(Written { written_ns, began_ticks, status: Owner { pid, control } }) = written else { return Ok(None) };
    if name != file_name(pid) || !lives(pid, began_ticks) {
        return Ok(None);
    }
    // It is beside the file; its folder's name may be none that JSON can say.
    let control = control.and_then(|socket| Some(path.with_file_name(socket.file_name()?)));
    let age = written_ns.map_or(TimeNs(0), |written_ns| TimeNs(now.0.saturating_sub(written_ns)));
    Ok(Some(Found { pid, control, status: serde_json::from_slice(&bytes).ok(), stale: stale(age) }))
}

/// What a file holds, as far as a status goes; nothing of a link, a FIFO, which would be waited for, or a device.
fn read_file(path: &Path) -> std::io::Result<Vec<u8>> {
    let flags = OFlags::RDONLY | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC;
    let file = File::from(rustix::fs::open(path, flags, Mode::empty())?);
    let mut bytes = Vec::new();
    if file.metadata()?.is_file() {
        file.take(LONGEST).read_to_end(&mut bytes)?;
    }
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::ffi::OsStr;
    use std::os::unix::ffi::OsStrExt;
    use std::os::unix::net::UnixListener;
    use std::time::SystemTime;

    use super::*;
    use crate::snapshot::RecordState;
    use crate::source::feed::FeedStatus;

    const NOW: TimeNs = TimeNs(1_000_000_000_000);
    const LONG: Duration = Duration::from_secs(20);

    fn found_in(folders: &[PathBuf]) -> Result<Vec<Found>, Failure> {
        of_running_in(folders, NOW)
    }

    fn status() -> Snapshot {
        Snapshot { pid: std::process::id(), state: "running".into(), ..Snapshot::default() }
    }

    #[test]
    fn what_is_written_is_read_and_taken_away_at_the_end() {
        let folder = tempfile::tempdir().unwrap();
        let folders = [folder.path().join("absent"), folder.path().to_owned()];
        assert_eq!(found_in(&folders).unwrap_err().exit, Exit::Unavailable);
        let mut file = StatusFile::of(std::process::id(), folder.path());
        file.write(&status(), NOW);
        assert!(file.newest.wait_until_done(LONG));
        let found = Found { pid: std::process::id(), control: None, status: Some(status()), stale: None };
        assert_eq!(found_in(&folders).unwrap(), [found]);
        drop(file);
        assert!(found_in(&folders).is_err());
    }

    #[test]
    fn folders_whose_names_are_no_text_hide_nothing() {
        let parent = tempfile::tempdir().unwrap();
        let folder = parent.path().join(OsStr::from_bytes(b"m\xfcller"));
        std::fs::create_dir(&folder).unwrap();
        let control = Some(folder.join(format!("control-{}", std::process::id())));
        let mut status = Snapshot { control: control.clone(), ..status() };
        status.figures.record = Some(RecordState { folder: folder.clone(), ..RecordState::default() });
        let mut feed = FeedStatus::default();
        feed.socket = folder.join("feed");
        status.figures.feed = Some(feed);
        let mut file = StatusFile::of(std::process::id(), &folder);
        file.write(&status, NOW);
        assert!(file.newest.wait_until_done(LONG));
        let found = found_in(std::slice::from_ref(&folder)).unwrap();
        assert_eq!(found[0].control, control, "it can be asked");
        let record = found[0].status.as_ref().unwrap().figures.record.as_ref().unwrap();
        assert_eq!(record.folder, parent.path().join("m\u{fffd}ller"));
    }

    #[test]
    fn the_file_of_a_dead_or_a_stalled_process_is_told_from_that_of_a_running_one() {
        let folder = tempfile::tempdir().unwrap();
        let own = folder.path().join(file_name(std::process::id()));
        let folders = [folder.path().to_owned()];
        // No process has this number: the kernel's greatest is 2^22.
        let dead = serde_json::to_vec(&Snapshot { pid: u32::MAX, ..status() }).unwrap();
        std::fs::write(folder.path().join(file_name(u32::MAX)), &dead).unwrap();
        assert!(found_in(&folders).is_err());
        std::fs::write(&own, dead).unwrap();
        assert!(found_in(&folders).is_err(), "another's status in this one's file");
        std::fs::write(&own, serde_json::to_vec(&status()).unwrap()).unwrap();
        assert_eq!(found_in(&folders).unwrap()[0].stale, None, "an older holod does not say when");
        let mut file = StatusFile::of(std::process::id(), folder.path());
        file.write(&status(), NOW - TimeNs(60_000_000_000));
        assert!(file.newest.wait_until_done(LONG));
        // The wall clock was set back, so that the file's own time lies ahead, or forward.
        for later_s in [-3600, 0, 3600i64] {
            let wall =
                SystemTime::now() - Duration::from_secs(3600) + Duration::from_secs((3600 + later_s).unsigned_abs());
            std::fs::File::options().write(true).open(&own).unwrap().set_modified(wall).unwrap();
            assert_eq!(found_in(&folders).unwrap()[0].stale, Some(Duration::from_secs(60)));
        }
        file.write(&status(), NOW - TimeNs(1_000_000_000));
        assert!(file.newest.wait_until_done(LONG));
        let long_ago = SystemTime::now() - Duration::from_secs(60);
        std::fs::File::options().write(true).open(&own).unwrap().set_modified(long_ago).unwrap();
        assert_eq!(found_in(&folders).unwrap()[0].stale, None);
        std::fs::write(&own, "{").unwrap();
        assert!(found_in(&folders).is_err());
    }

    #[test]
    fn a_holod_that_lives_is_found_though_its_status_cannot_be_understood() {
        let folder = tempfile::tempdir().unwrap();
        let (pid, control) = (std::process::id(), folder.path().join("control-1"));
        let mut of_another_version =
            serde_json::to_value(Snapshot { control: Some(control.clone()), ..status() }).unwrap();
        of_another_version["uptime_s"] = "a while".into();
        std::fs::write(folder.path().join(file_name(pid)), of_another_version.to_string()).unwrap();
        let found = Found { pid, control: Some(control), status: None, stale: None };
        assert_eq!(found_in(&[folder.path().to_owned()]).unwrap(), [found]);
    }

    #[test]
    fn a_link_and_a_fifo_in_the_place_of_a_status_are_passed_over() {
        let folder = tempfile::tempdir().unwrap();
        let folders = [folder.path().to_owned()];
        let elsewhere = folder.path().join("elsewhere.json");
        std::fs::write(&elsewhere, serde_json::to_vec(&status()).unwrap()).unwrap();
        let own = folder.path().join(file_name(std::process::id()));
        std::os::unix::fs::symlink(&elsewhere, &own).unwrap();
        rustix::fs::mknodat(
            rustix::fs::CWD,
            folder.path().join(file_name(1)),
            rustix::fs::FileType::Fifo,
            Mode::RWXU,
            0,
        )
        .unwrap();
        assert!(found_in(&folders).is_err());
        std::fs::rename(&elsewhere, &own).unwrap();
        assert_eq!(found_in(&folders).unwrap().len(), 1);
    }

    #[test]
    fn processes_are_told_apart_by_their_beginning() {
        let own = began_ticks(std::process::id()).unwrap();
        let mut later = std::process::Command::new("sleep").arg("100").spawn().unwrap();
        let of_later = began_ticks(later.id()).unwrap();
        let again = began_ticks(later.id());
        later.kill().unwrap();
        later.wait().unwrap();
        assert!(own <= of_later && again == Some(of_later), "{own} {of_later} {again:?}");
        assert_eq!(began_ticks(later.id()), None);
        // No process has this number: the kernel's greatest is 2^22.
        assert_eq!(began_ticks(u32::MAX), None);
    }

    #[test]
    fn what_a_killed_holod_left_is_not_taken_for_a_later_process_of_its_number_and_is_taken_away() {
        let folder = tempfile::tempdir().unwrap();
        let folders = [folder.path().to_owned()];
        let pid = std::process::id();
        let own = folder.path().join(file_name(pid));
        let began_ticks = began_ticks(pid).unwrap();
        let write = |began_ticks, status| {
            let written = Written { written_ns: Some(NOW.0), began_ticks: Some(began_ticks), status };
            std::fs::write(&own, serde_json::to_vec(&written).unwrap()).unwrap();
        };
        let left = || {
            let names = std::fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().file_name());
            names.map(|name| name.into_string().unwrap()).collect::<BTreeSet<_>>()
        };
        // Of no process, or of a later one of the same number.
        let control = format!("control-{pid}");
        let names = ["control-4294967295", "status-4294967295.json", ".status-4294967295.json.4294967295.part"];
        for name in names.iter().chain(&["feed", "control-x", &control[..]]) {
            std::fs::write(folder.path().join(name), "{}").unwrap();
        }
        write(began_ticks, status());
        assert_eq!(found_in(&folders).unwrap().len(), 1);
        let elsewhere = UnixListener::bind(folder.path().join("control-4294967294")).unwrap();
        remove_leftovers_in(folder.path());
        let ours = ["control-4294967294", &control[..], "control-x", "feed", &file_name(pid)];
        assert_eq!(left(), ours.map(str::to_owned).into());
        drop(elsewhere);
        write(began_ticks - 1, status());
        assert!(found_in(&folders).is_err());
        remove_leftovers_in(folder.path());
        assert_eq!(left(), ["control-x", "feed"].map(str::to_owned).into());
    }

    #[test]
    fn two_that_run_are_both_found_and_the_end_of_one_leaves_the_other() {
        let folder = tempfile::tempdir().unwrap();
        let folders = [folder.path().to_owned(), folder.path().to_owned()];
        // The first process of all lives, whoever runs this.
        let [one, other] = [1, std::process::id()].map(|pid| {
            let mut file = StatusFile::of(pid, folder.path());
            file.write(&Snapshot { pid, ..status() }, NOW);
            assert!(file.newest.wait_until_done(LONG));
            file
        });
        let pids = || found_in(&folders).unwrap().iter().map(|found| found.pid).collect::<Vec<_>>();
        assert_eq!(pids(), [1, std::process::id()]);
        drop(other);
        assert_eq!(pids(), [1]);
        drop(one);
        assert!(found_in(&folders).is_err());
    }
}

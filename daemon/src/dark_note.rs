//! A person's wish for dark lasers as a note on disk: a holod that starts after one that failed keeps to it.
//!
//! A service has its note in its state folder, where it stays until lasers are armed again, whatever happens to the
//! service: a restart is not told from a stop. A run by hand has it in its runtime folder, which nobody else looks into,
//! and in the shared folders that take it, and takes it away at its end. Each looks in all of them.

use std::collections::BTreeMap;
use std::fs;
use std::io::{ErrorKind, Read, Write};
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};

use holod_calibration::rig::LaserDriver;
use twox_hash::XxHash3_64;

use crate::runtime_folder;

/// Names other shared folders than these, with colons between them.
const SHARED_VARIABLE: &str = "HOLOD_DARK_NOTES";
/// The state folder of the service's unit, and the folder for locks on devices, which the unit can see and, on Debian,
/// every user can write to.
const SHARED: &str = "/var/lib/holod:/run/lock";
/// Where links to ports are.
const LINK_FOLDERS: [&str; 3] = ["/dev", "/dev/serial/by-id", "/dev/serial/by-path"];

/// A note is read so far.
const CONTENT_BYTES_MAX: u64 = 1 << 14;

/// The notes on one rig's lasers. Simulated ones have none.
///
/// There is one for each name that a port has: as the rig calls it, where that leads to, and the links that lead there,
/// since another rig may call it so.
#[derive(Clone, Debug)]
pub(crate) struct DarkNote {
    /// The lasers' ports as the rig names them.
    ports: Vec<PathBuf>,
    folders: Folders,
    /// Where notes are looked for.
    looked_at: Vec<PathBuf>,
    of_service: bool,
}

#[derive(Clone, Debug, Default)]
struct Folders {
    /// Where nobody but this user, or this service, leaves one.
    own: Option<PathBuf>,
    /// Where others look for one of this process, too.
    shared: Vec<PathBuf>,
    /// Where another run of this user may have left one.
    runtime: Vec<PathBuf>,
    /// Where links to ports are.
    links: Vec<PathBuf>,
}

/// What a look for notes came to.
#[derive(Debug)]
pub(crate) enum Found {
    Nothing,
    Note(PathBuf),
    /// A folder cannot be read: why.
    Unreadable(String),
}

impl Found {
    /// Why the lasers stay dark, if they must, with what lets them be lit where there is a note, and where that cannot
    /// be known.
    pub(crate) fn why_dark(&self, if_noted: &str, if_unknown: &str) -> Option<String> {
        let why = match self {
            Self::Nothing => return None,
            Self::Note(note) => format!(
                "`holod ctl lasers dark` put them out before this holod was started, as {} says; {if_noted}",
                note.display()
            ),
            Self::Unreadable(error) => format!(
                "it cannot be known whether `holod ctl lasers dark` put them out before this holod was started: {error}; \
                 let this user read that folder{if_unknown}"
            ),
        };
        Some(format!("the lasers stay dark: {why}"))
    }
}

/// What became of a note that was to be left.
#[derive(Debug, Default)]
pub(crate) struct Left {
    /// It lies where a later run of this user, or this service, looks.
    pub(crate) is_there: bool,
    /// And where every holod looks.
    pub(crate) is_for_all: bool,
    /// Why it lies nowhere.
    pub(crate) error: Option<String>,
}

impl DarkNote {
    /// That on the lasers of `driver`.
    pub(crate) fn on(driver: &LaserDriver) -> Self {
        let state = runtime_folder::of_service("STATE_DIRECTORY");
        let of_service = state.is_some();
        let named = std::env::var_os(SHARED_VARIABLE).filter(|named| !named.is_empty());
        let shared = std::env::split_paths(&named.unwrap_or_else(|| SHARED.into()))
            .filter_map(|folder| std::path::absolute(folder).ok())
            .collect();
        let runtime = runtime_folder::candidates().into_iter().filter(|folder| runtime_folder::is_own(folder));
        let folders = Folders {
            own: state.or_else(runtime_folder::own),
            shared,
            runtime: runtime.collect(),
            links: LINK_FOLDERS.map(PathBuf::from).into(),
        };
        Self::in_folders(folders, driver, of_service)
    }

    fn in_folders(folders: Folders, driver: &LaserDriver, of_service: bool) -> Self {
        let ports: Vec<_> = driver.paths().into_iter().map(Path::to_owned).collect();
        if ports.is_empty() {
            return Self { ports, folders: Folders::default(), looked_at: vec![], of_service };
        }
        let mut looked_at = Vec::new();
        for folder in folders.own.iter().chain(&folders.shared).chain(&folders.runtime) {
            if !looked_at.contains(folder) {
                looked_at.push(folder.clone());
            }
        }
        Self { ports, folders, looked_at, of_service }
    }

    /// What is in each note, all names of its port, a line each, by what its name begins with, but for a `holod-` before it.
    fn contents(&self) -> BTreeMap<String, Vec<u8>> {
        let mut contents = BTreeMap::new();
        for port in &self.ports {
            let names = names_of(port, &self.folders.links);
            let lines = names.iter().map(|name| line(name)).collect::<Vec<_>>().concat();
            contents.extend(names.iter().map(|name| (stem(name), lines.clone())));
        }
        contents
    }

    /// Looks whether a holod before this one, or another user's, left one.
    pub(crate) fn look(&self) -> Found {
        let (notes, unreadable) = self.notes();
        match (notes.into_iter().next(), unreadable.into_iter().next()) {
            (Some(note), _) => Found::Note(note),
            (None, Some(error)) => Found::Unreadable(error),
            (None, None) => Found::Nothing,
        }
    }

    /// All notes on these lasers, and why folders cannot be read.
    fn notes(&self) -> (Vec<PathBuf>, Vec<String>) {
        let stems = self.contents();
        let ports: Vec<_> = self.ports.iter().map(|port| line(&whole(port))).collect();
        // One that lists a port as the rig names it is on that port, too, whatever links led there when it was left.
        let lists_a_port = |note: &Path| {
            // Anybody may put a pipe into a shared folder, whose reader waits for a writer.
            if !note.symlink_metadata().is_ok_and(|metadata| metadata.is_file()) {
                return false;
            }
            let read = fs::File::open(note).and_then(|file| {
                let mut content = Vec::new();
                file.take(CONTENT_BYTES_MAX).read_to_end(&mut content).map(|_| content)
            });
            read.is_ok_and(|content| {
                content.split_inclusive(|&byte| byte == b'\n').any(|at| ports.iter().any(|p| p == at))
            })
        };
        let is_on_these = |folder: &Path, name: &str| {
            is_note(name) && (stems.keys().any(|stem| is_named(name, stem)) || lists_a_port(&folder.join(name)))
        };
        let (mut notes, mut unreadable) = (Vec::new(), Vec::new());
        for folder in &self.looked_at {
            match names(folder) {
                Ok(names) => {
                    let on_these = names.into_iter().filter(|name| is_on_these(folder, name));
                    notes.extend(on_these.map(|name| folder.join(name)));
                }
                Err(error) if matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => {}
                Err(error) => unreadable.push(format!("{}: {error}", folder.display())),
            }
        }
        (notes, unreadable)
    }

    /// Leaves it wherever it is missing.
    pub(crate) fn leave(&self) -> Left {
        let Folders { own, shared, .. } = &self.folders;
        let contents = self.contents();
        let mut left = Left::default();
        if let Some(own) = own {
            if !self.of_service {
                let _is_made = runtime_folder::make_again(own);
            }
            match leave_in(own, &contents, |stem| self.own_name(stem)) {
                Ok(()) => (left.is_there, left.is_for_all) = (true, shared.contains(own)),
                Err(error) => left.error = Some(error),
            }
        }
        if !left.is_for_all {
            // Which of them takes one depends on the user.
            let is_left = |folder: &&PathBuf| leave_in(folder, &contents, |stem| self.shared_name(stem)).is_ok();
            if shared.iter().filter(is_left).count() > 0 {
                left = Left { is_there: true, is_for_all: true, error: None };
            }
        }
        left
    }

    fn own_name(&self, stem: &str) -> String {
        if self.of_service { stem.to_owned() } else { self.shared_name(stem) }
    }

    /// A run by hand must not take away that of a service of the same user.
    fn shared_name(&self, stem: &str) -> String {
        let service = if self.of_service { "service-" } else { "" };
        format!("holod-{stem}-{service}{}", rustix::process::getuid().as_raw())
    }

    /// Takes all of them away, those of others, too. Which stay, and how to take them away.
    pub(crate) fn take_away(&self) -> Option<String> {
        let (notes, unreadable) = self.notes();
        let mut stay = Vec::new();
        for note in notes {
            if let Err(error) = fs::remove_file(&note)
                && error.kind() != ErrorKind::NotFound
            {
                stay.push(format!("{error}; take it away with `sudo rm {}`", note.display()));
            }
        }
        stay.extend(unreadable.into_iter().map(|error| format!("{error}; let this user read that folder")));
        (!stay.is_empty()).then(|| stay.join("; "))
    }

    /// Takes its own away at the end of a run by hand, after which its lasers are known to be dark.
    pub(crate) fn take_away_unless_of_service(&self) {
        if self.of_service {
            return;
        }
        let own = format!("-{}", rustix::process::getuid().as_raw());
        for note in self.notes().0 {
            let name = note.file_name().and_then(|name| name.to_str()).unwrap_or_default();
            if name.ends_with(&own) && !name.contains("-service-") {
                let _not_there = fs::remove_file(note);
            }
        }
    }
}

/// The names of a port: as it is called, where that leads to, and what else in `link_folders` leads there.
fn names_of(port: &Path, link_folders: &[PathBuf]) -> Vec<PathBuf> {
    let mut names = vec![whole(port)];
    let Ok(device) = port.canonicalize() else { return names };
    let entries = link_folders.iter().filter_map(|folder| fs::read_dir(folder).ok()).flatten().flatten();
    // Others lead to files of this process, which may be on a disk that stands still.
    let is_of_device = |link: &PathBuf| fs::read_link(link).is_ok_and(|target| !target.starts_with("/proc"));
    let links = entries.filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_symlink())).map(|link| link.path());
    let links = links.filter(is_of_device);
    names.extend(links.filter(|link| link.canonicalize().is_ok_and(|leads_to| leads_to == device)));
    names.push(device);
    names
}

fn whole(path: &Path) -> PathBuf {
    std::path::absolute(path).unwrap_or_else(|_| path.to_owned())
}

fn line(port: &Path) -> Vec<u8> {
    [port.as_os_str().as_bytes(), b"\n"].concat()
}

/// What the name of a note on the port of this name begins with.
fn stem(port: &Path) -> String {
    format!("dark-{:016x}", XxHash3_64::oneshot(&line(port)))
}

fn is_note(name: &str) -> bool {
    name.strip_prefix("holod-").unwrap_or(name).starts_with("dark-")
}

fn is_named(name: &str, stem: &str) -> bool {
    let rest = name.strip_prefix("holod-").unwrap_or(name).strip_prefix(stem);
    rest.is_some_and(|rest| rest.is_empty() || rest.starts_with('-'))
}

/// Leaves notes of these contents in `folder`, where they are missing.
fn leave_in(folder: &Path, contents: &BTreeMap<String, Vec<u8>>, name: impl Fn(&str) -> String) -> Result<(), String> {
    for (stem, content) in contents {
        let path = folder.join(name(stem));
        // Only to look waits for no disk that stands still.
        if path.symlink_metadata().is_ok() {
            continue;
        }
        match fs::File::create_new(&path) {
            // That it is there counts; what is in it is for people.
            Ok(mut file) => drop(file.write_all(content)),
            Err(error) if error.kind() == ErrorKind::AlreadyExists => {}
            Err(error) => return Err(format!("{}: {error}", path.display())),
        }
    }
    Ok(())
}

/// Names in a folder; those that are no text are none of a note.
fn names(folder: &Path) -> std::io::Result<Vec<String>> {
    let names = fs::read_dir(folder)?.map(|entry| entry.map(|entry| entry.file_name().into_string().ok()));
    names.filter_map(Result::transpose).collect()
}

#[cfg(test)]
mod tests {
    use holod_calibration::rig::Rig;

    use super::*;

    /// Folders of a machine: a service's state, a user's runtime folder, one that everybody can write to.
    struct Machine(tempfile::TempDir);

    impl Machine {
        fn new() -> Self {
            let root = tempfile::tempdir().unwrap();
            let folders = ["state", "runtime", "lock", "dev"];
            folders.iter().for_each(|name| fs::create_dir(root.path().join(name)).unwrap());
            Self(root)
        }

        fn at(&self, name: &str) -> PathBuf {
            self.0.path().join(name)
        }

        fn note(&self, driver: &LaserDriver, of_service: bool) -> DarkNote {
            let runtime = self.at("runtime");
            let (own, runtime) = if of_service { (self.at("state"), vec![]) } else { (runtime.clone(), vec![runtime]) };
            let shared = ["no-such-folder", "lock"].map(|name| self.at(name)).into();
            let folders = Folders { own: Some(own), shared, runtime, links: vec![self.at("dev")] };
            DarkNote::in_folders(folders, driver, of_service)
        }

        fn on(&self, port: &str, of_service: bool) -> DarkNote {
            self.note(&LaserDriver::Serial { path: port.into(), sync_wire: false }, of_service)
        }
    }

    fn is_there(note: &DarkNote) -> bool {
        matches!(note.look(), Found::Note(_))
    }

    #[test]
    fn a_note_is_on_the_lasers_of_its_ports_alone() {
        let machine = Machine::new();
        let [left, right] =
            ["/dev/serial/by-id/left", &format!("/dev/{}", "r".repeat(300))].map(|port| machine.on(port, false));
        assert!(left.leave().is_there && left.leave().is_there);
        assert!(is_there(&left) && matches!(right.look(), Found::Nothing));
        assert_eq!(right.take_away(), None);
        assert!(right.leave().is_there && is_there(&right), "however long the port's name is");
        assert_eq!((left.take_away(), left.take_away()), (None, None));
        assert!(!is_there(&left) && is_there(&right));

        let simulated = machine.note(&Rig::default().lasers.driver, false);
        assert!(!simulated.leave().is_there && matches!(simulated.look(), Found::Nothing));
        let mut nowhere = machine.on("/dev/left", true);
        nowhere.folders.own = Some("/proc/no-such-folder".into());
        nowhere.folders.shared.clear();
        let left = nowhere.leave();
        assert!(!left.is_there && left.error.is_some_and(|error| error.starts_with("/proc/no-such-folder/dark-")));
        assert!(!is_there(&nowhere));
    }

    #[test]
    fn a_service_and_a_run_by_hand_see_each_others_note() {
        for of_service in [false, true] {
            let machine = Machine::new();
            let [one, other] = [of_service, !of_service].map(|of_service| machine.on("/dev/lasers", of_service));
            let left = one.leave();
            assert!(left.is_there && left.is_for_all && left.error.is_none(), "{left:?}");
            assert!(is_there(&one) && is_there(&other), "of a service: {of_service}");
            // The end of a run by hand takes away no note of a service.
            other.take_away_unless_of_service();
            assert!(is_there(&one) && is_there(&other));
            // That of the other's runtime folder is seen by its own user alone.
            assert_eq!(other.take_away(), None);
            assert!(!is_there(&other));
        }
    }

    #[test]
    fn a_note_of_an_older_holod_in_the_runtime_folder_is_seen() {
        let machine = Machine::new();
        let note = machine.on("/dev/lasers", false);
        fs::write(machine.at("runtime").join(stem(Path::new("/dev/lasers"))), "").unwrap();
        assert!(is_there(&note) && note.take_away().is_none() && !is_there(&note));
    }

    #[test]
    fn a_note_that_others_cannot_see_is_told_from_one_that_they_can() {
        let machine = Machine::new();
        let mut note = machine.on("/dev/lasers", false);
        note.folders.shared.pop();
        let left = note.leave();
        assert!(left.is_there && !left.is_for_all, "{left:?}");
    }

    #[test]
    fn a_note_is_left_again_where_its_folder_was_taken_away() {
        let machine = Machine::new();
        let note = machine.on("/dev/lasers", false);
        note.leave();
        let notes = || names(&machine.at("runtime")).unwrap();
        let before = notes();
        fs::remove_dir_all(machine.at("runtime")).unwrap();
        note.leave();
        assert_eq!((notes(), before.len()), (before, 1));
    }

    #[test]
    fn what_cannot_be_read_or_taken_away_is_told() {
        let machine = Machine::new();
        let note = machine.on("/dev/lasers", false);
        let lock = machine.at("lock");
        fs::remove_dir(&lock).unwrap();
        std::os::unix::fs::symlink(&lock, &lock).unwrap();
        let (found, stays) = (note.look(), note.take_away());
        let folder = lock.display().to_string();
        assert!(matches!(&found, Found::Unreadable(error) if error.starts_with(&folder)), "{found:?}");
        assert!(stays.is_some_and(|stays| stays.starts_with(&folder)));
        fs::remove_file(&lock).unwrap();
        // As root may take any file away, and nobody a directory so.
        let path = lock.join(format!("holod-{}-7", stem(Path::new("/dev/lasers"))));
        fs::create_dir_all(&path).unwrap();
        let stays = note.take_away();
        assert!(stays.is_some_and(|stays| stays.ends_with(&format!("`sudo rm {}`", path.display()))));
        assert!(is_there(&note));
    }

    #[test]
    fn lasers_are_known_by_each_name_of_their_ports() {
        let machine = Machine::new();
        let port = |name: &str| machine.at("dev").join(name).display().to_string();
        fs::write(port("ttyACM0"), "").unwrap();
        fs::write(port("ttyACM1"), "").unwrap();
        std::os::unix::fs::symlink("ttyACM0", port("lasers")).unwrap();
        std::os::unix::fs::symlink(port("ttyACM0"), port("other")).unwrap();
        for [named, also] in [["lasers", "ttyACM0"], ["ttyACM0", "lasers"], ["lasers", "other"]] {
            let [named, also] = [named, also].map(|name| machine.on(&port(name), false));
            assert!(named.leave().is_there);
            assert!(is_there(&also) && matches!(machine.on(&port("ttyACM1"), false).look(), Found::Nothing));
            // It is plugged out: links to it are gone.
            fs::remove_file(port("ttyACM0")).unwrap();
            assert!(is_there(&also) && is_there(&named));
            fs::write(port("ttyACM0"), "").unwrap();
            assert_eq!(named.take_away(), None);
            assert!(!is_there(&also));
        }
    }

    #[test]
    fn lasers_that_come_back_elsewhere_or_are_away_keep_no_note_that_arming_does_not_find() {
        let machine = Machine::new();
        let port = |name: &str| machine.at("dev").join(name).display().to_string();
        let plug = |number: usize| {
            let node = port(&format!("ttyACM{number}"));
            fs::write(&node, "").unwrap();
            let _the_first_time = fs::remove_file(port("lasers"));
            std::os::unix::fs::symlink(&node, port("lasers")).unwrap();
        };
        let [lasers, other] = ["lasers", "ttyACM2"].map(|name| machine.on(&port(name), true));
        fs::write(port("ttyACM2"), "").unwrap();
        for away in [false, true] {
            other.leave();
            for number in [0, 1] {
                plug(number);
                lasers.leave();
                fs::remove_file(port(&format!("ttyACM{number}"))).unwrap();
            }
            if away {
                fs::remove_file(port("lasers")).unwrap();
            }
            assert_eq!(names(&machine.at("state")).unwrap().len(), 4);
            assert_eq!(lasers.take_away(), None);
            assert_eq!(names(&machine.at("state")).unwrap().len(), 1, "that of the others; away: {away}");
            assert!(is_there(&other));
        }
    }

    #[test]
    fn a_pipe_among_notes_keeps_nobody_waiting() {
        let machine = Machine::new();
        let mode = rustix::fs::Mode::RUSR | rustix::fs::Mode::WUSR;
        rustix::fs::mkfifoat(rustix::fs::CWD, machine.at("lock").join("dark-0123456789abcdef"), mode).unwrap();
        assert!(!is_there(&machine.on("/dev/lasers", true)));
    }

    #[test]
    fn some_of_several_ports_are_enough() {
        let machine = Machine::new();
        let on = |ports: &[&str]| {
            let mut note = machine.on("/dev/lasers", true);
            note.ports = ports.iter().map(PathBuf::from).collect();
            note
        };
        let [all, green, other] = [on(&["/dev/red", "/dev/green"]), on(&["/dev/green"]), on(&["/dev/other"])];
        all.leave();
        assert!(is_there(&green) && !is_there(&other));
        // Red's stays.
        assert_eq!(green.take_away(), None);
        assert!(is_there(&all) && !is_there(&green));
        all.take_away();
        // An older holod left one for all together.
        fs::write(machine.at("state").join("dark-0123456789abcdef"), "/dev/red\n/dev/green\n").unwrap();
        assert!(is_there(&all));
    }

    #[test]
    fn a_services_note_outlasts_its_end() {
        for of_service in [false, true] {
            let machine = Machine::new();
            let note = machine.on("/dev/lasers", of_service);
            assert!(note.leave().is_there);
            note.take_away_unless_of_service();
            assert_eq!(is_there(&note), of_service);
        }
    }
}

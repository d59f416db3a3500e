//! Where one file of results goes, and whether something is there already: the same rule for every command.

use std::fs::File;
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use holod_calibration::special_file;

use crate::failure::{Exit, Failure};
use crate::overwriting::refuse_existing;
use crate::results;
use crate::staging::{Temporary, folder_of};

/// A file, or standard output where `-` is named.
#[derive(Debug)]
pub(crate) enum Destination {
    /// A file that is written beside its place and renamed.
    File(PathBuf),
    /// Standard output, named by `-`.
    Stdout,
}

impl Destination {
    /// The place that `option` names, in a folder that is made where it is missing. What is there already is overwritten
    /// with `force` only.
    ///
    /// # Errors
    /// A file is there already, or a directory, device, pipe or socket; or no file can be written there.
    pub(crate) fn new(path: &Path, option: &str, force: bool) -> Result<Self, Failure> {
        if path == Path::new("-") {
            return Ok(Self::Stdout);
        }
        let expected = "expected the name of a file to write";
        let trouble = match special_file(path) {
            Some(found) => Some(format!("found {found}, {expected}; {option} - is standard output")),
            None => names_a_directory(path).then(|| format!("found a directory, {expected}")),
        };
        if let Some(trouble) = trouble {
            return Err(Failure::new(Exit::CannotCreate, format!("{option} {}: {trouble}", path.display())));
        }
        refuse_existing([path.to_owned()], option, force)?;
        let folder = folder_of(path);
        std::fs::create_dir_all(folder).map_err(|error| {
            let what = format!("cannot make the folder {}: {error}; name one that can be", folder.display());
            Failure::new(Exit::CannotCreate, what)
        })?;
        // It goes at once: what takes long to compute should not be lost for want of a place.
        tempfile::tempfile_in(folder).map_err(|error| {
            let what = format!("{option} {}: cannot write into its folder: {error}; name another one", path.display());
            Failure::new(Exit::CannotCreate, what)
        })?;
        Ok(Self::File(path.to_owned()))
    }

    /// Whether results go where reports usually do, so that these must not.
    pub(crate) const fn is_stdout(&self) -> bool {
        matches!(self, Self::Stdout)
    }

    /// Refuses a report in JSON beside results on standard output.
    ///
    /// # Errors
    /// Both would be written there.
    pub(crate) fn refuse_json(&self, option: &str, json: bool) -> Result<(), Failure> {
        if !(json && self.is_stdout()) {
            return Ok(());
        }
        let says = format!("{option} - and --json would both write to standard output: give one of them");
        Err(Failure::new(Exit::Usage, says))
    }

    /// Refuses to take the place of one of the `inputs`, by whatever name: what the command reads would be lost.
    ///
    /// # Errors
    /// It is one of them.
    pub(crate) fn refuse_inputs(&self, option: &str, inputs: impl IntoIterator<Item = PathBuf>) -> Result<(), Failure> {
        let Self::File(path) = self else { return Ok(()) };
        let place = |path: &Path| path.metadata().ok().map(|found| (found.dev(), found.ino()));
        let Some(own) = place(path) else { return Ok(()) };
        match inputs.into_iter().find(|input| place(input) == Some(own)) {
            Some(input) => {
                let (path, input) = (path.display(), input.display());
                let says = format!("{option} {path}: this command reads {input}, which that is; name another file");
                Err(Failure::new(Exit::Usage, says))
            }
            None => Ok(()),
        }
    }

    /// Lets `write` write the file.
    ///
    /// # Errors
    /// That of `write`, or standard output takes no more.
    pub(crate) fn write(&self, write: impl FnOnce(&Path) -> Result<(), Failure>) -> Result<(), Failure> {
        match self {
            Self::File(path) => write(path),
            Self::Stdout => {
                let folder = Temporary::new("holod-").map_err(Failure::because(Exit::CannotCreate))?;
                let path = folder.path().join("out");
                write(&path)?;
                let copied = File::open(&path).and_then(|mut file| io::copy(&mut file, &mut io::stdout().lock()));
                match copied {
                    Err(error) if error.kind() != io::ErrorKind::BrokenPipe => Err(results::stdout_failure(&error)),
                    _ => Ok(()),
                }
            }
        }
    }
}

/// Whether `path` is a directory, or could be nothing else.
fn names_a_directory(path: &Path) -> bool {
    path.is_dir() || path.as_os_str().as_encoded_bytes().ends_with(b"/") || path.file_name().is_none()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_there_is_overwritten_by_force_only() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let put = |text: &'static str, force| {
            let destination = Destination::new(&path, "--out", force)?;
            destination.write(|path| std::fs::write(path, text).map_err(Failure::because(Exit::CannotCreate)))
        };
        put("first", false).unwrap();
        let refused = put("second", false).unwrap_err();
        assert_eq!(refused.exit, Exit::CannotCreate);
        assert!(refused.to_string().contains("a.png exists already") && refused.to_string().contains("--force"));
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "first");
        put("third", true).unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "third");
        assert!(Destination::new(folder.path(), "--out", true).is_err(), "a directory is no file");
        assert!(Destination::new(Path::new("-"), "--out", false).unwrap().is_stdout());
    }

    #[test]
    fn what_is_read_is_not_overwritten_even_by_force() {
        let folder = tempfile::tempdir().unwrap();
        let [log, other, alias] = ["log.csv", "other.csv", "alias.csv"].map(|name| folder.path().join(name));
        std::fs::write(&log, "1").unwrap();
        std::fs::write(&other, "2").unwrap();
        std::os::unix::fs::symlink(&log, &alias).unwrap();
        let refused = |out: &Path| Destination::new(out, "--out", true).unwrap().refuse_inputs("--out", [log.clone()]);
        for out in [&log, &alias] {
            let refused = refused(out).unwrap_err();
            assert_eq!(refused.exit, Exit::Usage);
            assert!(refused.to_string().contains("this command reads"), "{refused}");
        }
        refused(&other).unwrap();
        refused(&folder.path().join("new.csv")).unwrap();
        refused(Path::new("-")).unwrap();
    }

    #[test]
    fn a_folder_that_is_missing_is_made() {
        let folder = tempfile::tempdir().unwrap();
        let put = |path: &Path| {
            Destination::new(path, "--out", false)?
                .write(|path| std::fs::write(path, "x").map_err(Failure::because(Exit::CannotCreate)))
        };
        put(&folder.path().join("a/b/c.png")).unwrap();
        let refused = put(&folder.path().join("a/b/c.png/d.png")).unwrap_err();
        assert!(refused.to_string().contains("cannot make the folder"), "{refused}");
        assert_eq!(refused.exit, Exit::CannotCreate);
    }

    #[test]
    fn a_place_that_takes_no_file_is_refused_before_it_is_written() {
        let folder = tempfile::tempdir().unwrap();
        let refused = |path: &Path| Destination::new(path, "--out", false).unwrap_err().to_string();
        let slash = refused(&folder.path().join("new/"));
        assert!(slash.contains("found a directory, expected the name of a file"), "{slash}");
        assert!(!folder.path().join("new").exists());
        // Nobody, not even root, makes files there.
        let proc = refused(Path::new("/proc/y.png"));
        assert!(proc.contains("--out /proc/y.png: cannot write into its folder"), "{proc}");
        Destination::new(&folder.path().join("y.png"), "--out", false).unwrap();
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }

    #[test]
    fn a_device_is_not_replaced_by_a_file() {
        let folder = tempfile::tempdir().unwrap();
        let link = folder.path().join("link");
        std::os::unix::fs::symlink("/dev/null", &link).unwrap();
        for force in [false, true] {
            for path in [Path::new("/dev/null"), &link] {
                let refused = Destination::new(path, "--plot", force).unwrap_err();
                assert_eq!(refused.exit, Exit::CannotCreate);
                let says = "found a device, expected the name of a file to write; --plot - is standard output";
                assert!(refused.to_string().contains(says), "{refused}");
                let refused = refuse_existing([path.to_owned()], "--out", force).unwrap_err();
                assert!(refused.to_string().contains("is a device, which no file takes the place of"), "{refused}");
            }
        }
    }
}

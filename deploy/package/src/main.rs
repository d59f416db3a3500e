//! Writes what the Debian package holds beside binaries: man pages and shell completions from holod's own command line,
//! and the documentation of the sources, with links that lead to installed files: `holod-package SOURCES DIR`.

mod documentation;
mod pages;

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::{env, fs, io};

use clap::{Command, CommandFactory};
use clap_complete::Shell;
use holod_daemon::cli::Cli;

fn main() -> ExitCode {
    let folders: Vec<PathBuf> = env::args_os().skip(1).map(PathBuf::from).collect();
    let [sources, folder] = &folders[..] else {
        eprintln!("holod-package: expected two folders: holod-package SOURCES DIR");
        return ExitCode::from(64);
    };
    match write(folder).and_then(|()| documentation::write(sources, &folder.join("doc"))) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("holod-package: cannot write into {}: {error}", folder.display());
            ExitCode::from(73)
        }
    }
}

/// `man/*.1`, and the completions under the names that the shells look for.
fn write(folder: &Path) -> io::Result<()> {
    let man = folder.join("man");
    fs::create_dir_all(&man)?;
    for (name, page) in pages::all(&command())? {
        fs::write(man.join(name), page)?;
    }
    for (shell, file) in [(Shell::Bash, "bash/holod"), (Shell::Zsh, "zsh/_holod"), (Shell::Fish, "fish/holod.fish")] {
        let path = folder.join("completions").join(file);
        fs::create_dir_all(path.parent().expect("it is below the folder"))?;
        clap_complete::generate(shell, &mut command(), "holod", &mut fs::File::create(path)?);
    }
    Ok(())
}

/// The command line, with a version that is the same for each build of it.
fn command() -> Command {
    Cli::command().version(env!("CARGO_PKG_VERSION"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_shell_completes_every_subcommand() {
        let folder = tempfile::tempdir().unwrap();
        write(folder.path()).unwrap();
        for file in ["bash/holod", "zsh/_holod", "fish/holod.fish"] {
            let text = fs::read_to_string(folder.path().join("completions").join(file)).unwrap();
            for subcommand in command().get_subcommands() {
                assert!(text.contains(subcommand.get_name()), "{file} lacks {}", subcommand.get_name());
            }
            assert!(text.contains("depth-encoding") && !text.contains("no-such-option"), "{file}");
        }
    }
}

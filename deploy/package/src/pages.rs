//! A man page for holod and for each of its subcommands.

use std::io;

use clap::Command;
use clap_mangen::Man;
use clap_mangen::roff::{Inline, Roff, bold, roman};

const EXIT_STATUS: [(&str, &str); 10] = [
    ("0", "It did what was asked."),
    ("1", "A report's frames are shown again, and differ from the recorded ones."),
    ("64", "The command line asks for something that cannot be had."),
    ("65", "An input file's content is wrong."),
    ("66", "An input file is missing or unreadable."),
    ("69", "A device or service is not there, or the bench is not ready."),
    ("70", "A fault of holod itself."),
    ("73", "An output cannot be written."),
    ("74", "Standard output takes no more."),
    ("78", "The rig file is faulty, or weights, tracker or token do not go with it."),
];
const FILES: [(&str, &str); 4] = [
    ("/etc/holod/rig.toml", "What is true of the bench that the service drives."),
    ("/run/holod", "Status, control socket and feed of the service."),
    ("/var/lib/holod", "The service's own folder, for records."),
    ("/usr/share/doc/holod", "Everything else: README.md, examples of rig, udev rules and clients."),
];
const ENVIRONMENT: [(&str, &str); 1] =
    [("HOLOD_LOG", "What the log on standard error says: info (default), debug or trace, or a filter by module.")];

/// File names and pages.
pub(crate) fn all(command: &Command) -> io::Result<Vec<(String, Vec<u8>)>> {
    let mut command = command.clone().disable_help_subcommand(true);
    command.build();
    let mut pages = Vec::new();
    add(&command, &mut pages)?;
    Ok(pages)
}

fn add(command: &Command, pages: &mut Vec<(String, Vec<u8>)>) -> io::Result<()> {
    let name = command.get_display_name().unwrap_or(command.get_name()).to_owned();
    let source = format!("holod {}", env!("CARGO_PKG_VERSION"));
    let man = Man::new(command.clone()).manual("holod").source(source);
    let mut page = Vec::new();
    man.render(&mut page)?;
    if name == "holod" {
        section("EXIT STATUS", &EXIT_STATUS).to_writer(&mut page)?;
        section("FILES", &FILES).to_writer(&mut page)?;
        section("ENVIRONMENT", &ENVIRONMENT).to_writer(&mut page)?;
    }
    pages.push((man.get_filename(), page));
    command.get_subcommands().filter(|below| !below.is_hide_set()).try_for_each(|below| add(below, pages))
}

fn section(title: &str, entries: &[(&str, &str)]) -> Roff {
    let mut roff = Roff::new();
    roff.control("SH", [title]);
    for (term, meaning) in entries {
        let lines: [Vec<Inline>; 2] = [vec![bold(*term)], vec![roman(*meaning)]];
        roff.control("TP", []);
        lines.into_iter().for_each(|line| {
            roff.text(line);
        });
    }
    roff
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::fs;
    use std::path::Path;
    use std::process::Command as Process;

    use super::*;

    fn pages() -> Vec<(String, Vec<u8>)> {
        all(&crate::command()).unwrap()
    }

    #[test]
    fn each_subcommand_has_a_page_that_says_what_it_is_for() {
        let pages = pages();
        let names: BTreeSet<&str> = pages.iter().map(|(name, _)| name.as_str()).collect();
        fn expected(name: &str, command: &Command) -> Vec<String> {
            let below = command.get_subcommands();
            let below = below.flat_map(|below| expected(&format!("{name}-{}", below.get_name()), below));
            std::iter::once(format!("{name}.1")).chain(below).collect()
        }
        let expected = expected("holod", &crate::command());
        assert_eq!(names, expected.iter().map(String::as_str).collect());
        assert!(names.contains("holod-tracker-try.1") && names.contains("holod-ctl-pattern-lens.1"));
        for (name, page) in &pages {
            let text = String::from_utf8(page.clone()).unwrap();
            assert!(text.contains(".SH NAME") && text.contains(".SH SYNOPSIS"), "{name}: {text}");
            assert!(text.contains(".SH OPTIONS") && text.lines().count() > 10, "{name}: {text}");
        }
    }

    /// What `man` and `lexgrog` object to in a page; nothing where they are not installed.
    fn objections(path: &Path) -> String {
        let mut said = String::new();
        let mut man = Process::new("man");
        man.env("MANROFFSEQ", "").args(["--warnings", "-E", "UTF-8", "-l", "-Tutf8", "-Z"]);
        if let Ok(output) = man.arg(path).output() {
            said.push_str(&String::from_utf8_lossy(&output.stderr));
        }
        if let Ok(output) = Process::new("lexgrog").arg(path).output()
            && !output.status.success()
        {
            said.push_str(&String::from_utf8_lossy(&output.stdout));
            said.push_str(&String::from_utf8_lossy(&output.stderr));
        }
        said
    }

    #[test]
    fn man_has_no_objections() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("page.1");
        for (name, page) in pages() {
            fs::write(&path, page).unwrap();
            assert_eq!(objections(&path), "", "{name}");
        }
        if Process::new("lexgrog").arg("--version").output().is_ok() {
            fs::write(&path, ".TH nothing 1\n.SH OPTIONS\nno name\n").unwrap();
            assert_ne!(objections(&path), "", "a page without a name is refused");
        }
    }
}

//! Takes out of text who made it, and where: home directories, names of users and of the machine.

use std::collections::BTreeSet;
use std::fs;
use std::ops::RangeInclusive;
use std::path::Path;

/// Where people's directories are on most systems.
const HOMES: [&str; 3] = ["/var/home/", "/home/", "/Users/"];
/// Accounts and machines that have these names are nobody's.
const NOBODYS: [&str; 12] = [
    "root",
    "holod",
    "user",
    "admin",
    "nobody",
    "test",
    "host",
    "localhost",
    "localdomain",
    "ubuntu",
    "debian",
    "runner",
];
/// Shorter names are left: they would be found everywhere.
const SHORTEST_NAME: usize = 3;
/// How much is searched at once, and how much more where the next begins: longer than any name.
const WINDOW_BYTES: usize = 1 << 20;
const OVERLAP_BYTES: usize = 1 << 12;
/// Numbers that are given to people alone; the first that is on older systems; and that of nobody, above both.
const PEOPLE: RangeInclusive<u32> = 1000..=60_000;
const FIRST_PERSON: u32 = 500;
const NOBODY: u32 = 65_534;
/// The programs with which nobody logs in.
const NO_SHELLS: [&str; 2] = ["nologin", "false"];

/// What must not be said.
#[derive(Clone, Debug, Default)]
pub struct Scrubber {
    /// Home directories, the longest first.
    homes: Vec<String>,
    /// Names and what takes their place.
    names: Vec<(String, &'static str)>,
}

impl Scrubber {
    /// The names of this machine, of the one who asks, and of the people who have accounts here.
    pub fn of_this_machine() -> Self {
        let variable = |name: &str| std::env::var(name).unwrap_or_default();
        let line = |path: &str| fs::read_to_string(path).unwrap_or_default().trim().to_owned();
        let accounts = fs::read_to_string("/etc/passwd").unwrap_or_default();
        let people = accounts.lines().flat_map(person);
        let users = ["USER", "LOGNAME", "SUDO_USER"].map(variable).into_iter().map(|user| (user, String::new()));
        Self::new(
            people.chain(users).chain([(String::new(), variable("HOME"))]),
            ["/proc/sys/kernel/hostname", "/etc/hostname"].map(line),
        )
    }

    /// For users with their home directories, and names of the machine.
    pub(super) fn new(
        users: impl IntoIterator<Item = (String, String)>,
        hosts: impl IntoIterator<Item = String>,
    ) -> Self {
        let (users, homes): (BTreeSet<String>, BTreeSet<String>) = users.into_iter().unzip();
        let is_ones_own = |home: &String| home.starts_with('/') && Path::new(home).components().count() > 2;
        let mut homes: Vec<_> = homes.into_iter().filter(|home| is_ones_own(home) || home == "/root").collect();
        homes.sort_by_key(|home| std::cmp::Reverse(home.len()));
        let hosts: BTreeSet<String> =
            hosts.into_iter().flat_map(|host| [host.split('.').next().unwrap_or_default().to_owned(), host]).collect();
        let is_somebodys = |name: &str| name.len() >= SHORTEST_NAME && !NOBODYS.contains(&name);
        let mut names: Vec<(String, &str)> = Vec::new();
        for (known, place) in [(hosts, "HOST"), (users, "USER")] {
            let known = known.into_iter().map(|name| lower(&name));
            names.extend(known.filter(|name| is_somebodys(name)).map(|name| (name, place)));
        }
        // A machine's whole name goes before its first part.
        names.sort_by_key(|(name, _)| std::cmp::Reverse(name.len()));
        Self { homes, names }
    }

    /// Text with `~` for home directories, `USER` and `HOST` for names.
    pub fn text(&self, text: &str) -> String {
        let mut text = self.paths(text);
        for (name, place) in &self.names {
            text = replaced(&text, name, place, is_word_byte);
        }
        text
    }

    /// Text with `~` for home directories alone.
    pub fn paths(&self, text: &str) -> String {
        let mut text = text.to_owned();
        for home in &self.homes {
            text = replaced(&text, &lower(home), "~", is_name_byte);
        }
        for homes in HOMES {
            text = without_names_in(&text, homes);
        }
        text
    }

    /// Whether bytes hold a name or a home directory.
    pub fn finds(&self, bytes: &[u8]) -> bool {
        let starts = (0..bytes.len()).step_by(WINDOW_BYTES);
        starts.into_iter().any(|start| {
            // One byte before tells whether a word begins here.
            let end = bytes.len().min(start + WINDOW_BYTES + OVERLAP_BYTES);
            let text = String::from_utf8_lossy(&bytes[start.saturating_sub(1)..end]);
            self.text(&text) != text
        })
    }
}

/// Names, each with the home directory, of a line of `/etc/passwd`, where it is a person's or root's: that of the
/// account, and the person's own.
fn person(line: &str) -> Vec<(String, String)> {
    let fields: Vec<&str> = line.split(':').collect();
    let [name, _, uid, _, about, home, shell] = fields[..] else { return Vec::new() };
    let logs_in = !Path::new(shell).file_name().is_some_and(|program| NO_SHELLS.iter().any(|shell| program == *shell));
    let is_person = |uid: u32| uid == 0 || PEOPLE.contains(&uid) || uid >= FIRST_PERSON && uid != NOBODY && logs_in;
    if !uid.parse().is_ok_and(is_person) {
        return Vec::new();
    }
    // What follows a comma is a room or a telephone.
    let own = about.split(',').next().unwrap_or_default();
    [name, own].map(|name| (name.to_owned(), home.to_owned())).into()
}

const fn is_word_byte(byte: u8) -> bool {
    byte.is_ascii_alphanumeric() || byte == b'_'
}

/// A byte with which the name of a directory goes on.
const fn is_name_byte(byte: u8) -> bool {
    is_word_byte(byte) || matches!(byte, b'-' | b'.' | b'@')
}

/// Text in lower case, where a letter is as long in it: all places stay the same.
fn lower(text: &str) -> String {
    let lower = |letter: char| {
        let mut letters = letter.to_lowercase();
        letters.next().filter(|lower| letters.len() == 0 && lower.len_utf8() == letter.len_utf8()).unwrap_or(letter)
    };
    text.chars().map(lower).collect()
}

/// Each occurrence of `name`, which is in lower case, in any case and with nothing of a name around it.
fn replaced(text: &str, name: &str, place: &str, goes_on: fn(u8) -> bool) -> String {
    let (folded, bytes) = (lower(text), text.as_bytes());
    let mut out = String::with_capacity(text.len());
    let mut done = 0;
    for (at, found) in folded.match_indices(name) {
        let end = at + found.len();
        let is_whole = (at == 0 || !goes_on(bytes[at - 1])) && bytes.get(end).is_none_or(|&byte| !goes_on(byte));
        if at >= done && is_whole {
            out.push_str(&text[done..at]);
            out.push_str(place);
            done = end;
        }
    }
    out + &text[done..]
}

/// `~` for each directory in `homes`, whoever's it is, and `USER` for one in a folder of that name somewhere else.
fn without_names_in(text: &str, homes: &str) -> String {
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    while let Some((before, after)) = rest.split_once(homes) {
        let ends = |c: char| c == '/' || c.is_whitespace() || "\"'`,:;)]}\\".contains(c);
        let name = after.find(ends).unwrap_or(after.len());
        let goes_on = before.bytes().next_back().is_some_and(is_name_byte);
        out.push_str(before);
        if name == 0 || goes_on {
            out.push_str(homes);
            if name > 0 {
                out.push_str("USER");
            }
        } else {
            out.push('~');
        }
        rest = &after[name..];
    }
    out + rest
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scrubber() -> Scrubber {
        let user = |name: &str, home: &str| (name.to_owned(), home.to_owned());
        Scrubber::new(
            [
                user("anna", "/home/anna"),
                user("root", "/root"),
                user("", "/srv/people/anna"),
                user("al", "/"),
                user("Anna Huber", ""),
                user("Jörg Müller", "/data/müller"),
            ],
            ["Optics7.lab.example".to_owned(), String::new()],
        )
    }

    #[test]
    fn homes_users_and_hosts_are_taken_out() {
        for (text, expected) in [
            ("read /home/anna/rig.toml", "read ~/rig.toml"),
            ("/home/anna", "~"),
            ("\"/home/berta/x\",/home/c d", "\"~/x\",~ d"),
            ("/srv/people/anna/a /srv/people/annabel", "~/a /srv/people/annabel"),
            ("/root/weights and /rooted", "~/weights and /rooted"),
            ("/var/home/anna/x", "~/x"),
            ("anna@optics7: Anna's, annabel, anna_2", "USER@HOST: USER's, annabel, anna_2"),
            ("OPTICS7.lab.example and optics7.other", "HOST and HOST.other"),
            ("al is short, root is nobody's", "al is short, root is nobody's"),
            ("/media/anna/disk", "/media/USER/disk"),
            ("/mnt/home/berta/x of Anna Huber", "/mnt/home/USER/x of USER"),
            ("/home/ alone", "/home/ alone"),
            ("JÖRG MÜLLER, jörg müller in /data/MÜLLER/x", "USER, USER in ~/x"),
            ("İstanbul, ẞ and K of ANNA", "İstanbul, ẞ and K of USER"),
            ("nothing to hide: 0.125,üß", "nothing to hide: 0.125,üß"),
        ] {
            assert_eq!(scrubber().text(text), expected, "{text}");
            assert_eq!(scrubber().finds(text.as_bytes()), text != expected, "{text}");
        }
        assert_eq!(scrubber().paths("anna: /home/anna/x"), "anna: ~/x");
    }

    #[test]
    fn a_name_across_the_border_of_two_windows_is_found() {
        let blank = vec![b' '; 2 * WINDOW_BYTES];
        assert!(!scrubber().finds(&blank));
        for at in [WINDOW_BYTES - 9, WINDOW_BYTES - 2, WINDOW_BYTES, WINDOW_BYTES + OVERLAP_BYTES - 2] {
            let mut bytes = blank.clone();
            bytes[at..at + 4].copy_from_slice(b"anna");
            assert!(scrubber().finds(&bytes), "{at}");
        }
        // A window begins within a longer word.
        let mut bytes = blank;
        bytes[WINDOW_BYTES - 3..][..7].copy_from_slice(b"susanna");
        assert!(!scrubber().finds(&bytes));
    }

    #[test]
    fn what_is_scrubbed_twice_is_as_after_once() {
        let text = "anna on optics7 in /home/anna, /home/x/y";
        let once = scrubber().text(text);
        assert_eq!(scrubber().text(&once), once);
    }

    #[test]
    fn people_are_told_from_daemons() {
        let names = |line: &str| person(line).into_iter().map(|(name, _)| name).collect::<Vec<_>>();
        assert_eq!(names("anna:x:1000:1000:Anna Huber,7,,:/home/anna:/bin/sh"), ["anna", "Anna Huber"]);
        assert_eq!(person("anna:x:1000:1000::/home/anna:/bin/sh")[0].1, "/home/anna");
        assert_eq!(names("bertav:x:210045:210045:Berta Vogel:/data/bertav:/bin/bash"), ["bertav", "Berta Vogel"]);
        assert_eq!(names("claraw:x:501:100:Clara Wolf:/srv/clara:"), ["claraw", "Clara Wolf"]);
        assert_eq!(person("root:x:0:0:root:/root:/usr/sbin/nologin")[0].1, "/root");
        assert_eq!(names("dora:x:1002:1002:Dora Lang:/home/dora:/usr/sbin/nologin"), ["dora", "Dora Lang"]);
        for system in [
            "daemon:x:1:1:daemon:/usr/sbin:/usr/sbin/nologin",
            "sync:x:4:65534:sync:/bin:/bin/sync",
            "_apt:x:42:65534::/nonexistent:/usr/sbin/nologin",
            "nobody:x:65534:65534:nobody:/nonexistent:/bin/sh",
            "messagebus:x:100:107::/nonexistent:/usr/sbin/nologin",
            "Debian-gdm:x:107:115:Gnome Display Manager:/var/lib/gdm3:/bin/false",
            "postgres:x:110:118:PostgreSQL administrator,,,:/var/lib/postgresql:/bin/bash",
            "systemd-network:x:998:998:systemd Network Management:/:/usr/sbin/nologin",
            "libvirt-qemu:x:64055:64055:Libvirt Qemu:/var/lib/libvirt:/usr/sbin/nologin",
            "nonsense",
        ] {
            assert!(person(system).is_empty(), "{system}");
        }
        Scrubber::of_this_machine();
    }
}

//! The pages and examples of `/usr/share/doc/holod`: those of the sources, with links that lead to where things are
//! once they are installed. A link to what the package does not hold becomes its text.

use std::fs;
use std::io;
use std::path::{Component, Path, PathBuf};

/// Where it all is once it is installed.
const INSTALLED: &str = "/usr/share/doc/holod";

/// What is taken from the sources, a file or a folder with what lies in it, and its name among the documentation.
const HELD: [(&str, &str); 20] = [
    ("README.md", "README.md"),
    ("deploy/README.md", "service.md"),
    ("calibration/doc", ""),
    ("daemon/doc", ""),
    ("slm-output/doc", ""),
    ("pupil-input/doc", ""),
    ("pupil-input/profiles/README.md", "tracker-profiles.md"),
    ("pupil-input/profiles", "examples/tracker-profiles"),
    ("calibration/profiles/lasers", "examples/laser-profiles"),
    ("model/weights/README.md", "weights.md"),
    ("model/weights/recipe.md", "weights-recipe.md"),
    ("deploy/rigs/example.toml", "examples/rig.toml"),
    ("deploy/udev/60-holod-lasers.rules", "examples/udev/60-holod-lasers.rules"),
    ("deploy/udev/60-holod-tracker.rules", "examples/udev/60-holod-tracker.rules"),
    ("deploy/udev/61-holod-tracker-hid.rules", "examples/udev/61-holod-tracker-hid.rules"),
    ("deploy/udev/62-holod-panel.rules", "examples/udev/62-holod-panel.rules"),
    ("deploy/systemd/holod.service.d", "examples/holod.service.d"),
    ("deploy/clients/README.md", "examples/clients/README.md"),
    ("deploy/clients/c", "examples/clients/c"),
    ("deploy/clients/python/examples", "examples/clients/python"),
];

/// What the package has elsewhere.
const ELSEWHERE: [(&str, &str); 5] = [
    ("CHANGELOG.md", "/usr/share/doc/holod/changelog.gz"),
    ("LICENSE-MIT", "/usr/share/doc/holod/copyright"),
    ("LICENSE-APACHE", "/usr/share/doc/holod/copyright"),
    ("deploy/clients/python/holod_client", "/usr/lib/python3/dist-packages/holod_client"),
    ("deploy/udev/60-holod-latency.rules", "/usr/lib/udev/rules.d/60-holod-latency.rules"),
];

/// Writes all of it from the sources at `sources` into `folder`.
///
/// # Errors
/// A source is missing, or `folder` cannot be written to.
pub(crate) fn write(sources: &Path, folder: &Path) -> io::Result<()> {
    let held = held(sources)?;
    for (source, name) in &held {
        let path = folder.join(name);
        fs::create_dir_all(path.parent().expect("it is below the folder"))?;
        let content = fs::read(sources.join(source))?;
        let content = match source.extension() {
            Some(extension) if extension == "md" => {
                let page = String::from_utf8(content).map_err(io::Error::other)?;
                relinked(&page, |target| place(target, source, name, &held)).into_bytes()
            }
            _ => content,
        };
        fs::write(path, content)?;
    }
    Ok(())
}

/// Each file's name in the sources, and among the documentation.
fn held(sources: &Path) -> io::Result<Vec<(PathBuf, PathBuf)>> {
    let mut held: Vec<(PathBuf, PathBuf)> = Vec::new();
    for (source, name) in HELD {
        let path = sources.join(source);
        if !path.is_dir() {
            held.push((source.into(), name.into()));
            continue;
        }
        let mut entries = fs::read_dir(&path)?.map(|entry| Ok(entry?.path())).collect::<io::Result<Vec<_>>>()?;
        entries.sort();
        // What lies in folders of such a folder is for those who work on it.
        for entry in entries.into_iter().filter(|entry| entry.is_file()) {
            let file = entry.file_name().expect("an entry of a folder");
            let source = Path::new(source).join(file);
            // A file that has a name of its own above is not held twice.
            if held.iter().all(|(known, _)| *known != source) {
                held.push((source, Path::new(name).join(file)));
            }
        }
    }
    Ok(held)
}

/// Where a link on the page `source`, installed as `name`, leads to; nothing where that is not in the package.
fn place(target: &str, source: &Path, name: &Path, held: &[(PathBuf, PathBuf)]) -> Option<String> {
    let (path, part) = target.split_at(target.find('#').unwrap_or(target.len()));
    if path.is_empty() || target.contains("://") || target.starts_with("mailto:") {
        return Some(target.to_owned());
    }
    let wanted = plain(&source.parent()?.join(path));
    let documents = Path::new(INSTALLED);
    let files = held.iter().map(|(source, name)| (source.clone(), documents.join(name)));
    let folders =
        HELD.iter().filter(|(_, name)| !name.is_empty()).map(|(source, name)| (source.into(), documents.join(name)));
    let elsewhere = ELSEWHERE.iter().map(|(source, name)| (source.into(), name.into()));
    let found = files.chain(elsewhere).chain(folders).find(|(source, _): &(PathBuf, PathBuf)| *source == wanted)?.1;
    let from = documents.join(name);
    Some(format!("{}{part}", relative(from.parent()?, &found).display()))
}

/// A path without `.` and `..`.
fn plain(path: &Path) -> PathBuf {
    let mut plain = PathBuf::new();
    for part in path.components() {
        match part {
            Component::CurDir => {}
            Component::ParentDir => {
                plain.pop();
            }
            part => plain.push(part),
        }
    }
    plain
}

/// The way from a folder to a path, both absolute.
fn relative(from: &Path, to: &Path) -> PathBuf {
    let shared = from.components().zip(to.components()).take_while(|(a, b)| a == b).count();
    let up = from.components().skip(shared).map(|_| Component::ParentDir);
    up.chain(to.components().skip(shared)).collect()
}

/// A page whose links lead to where `place` says, or are nothing but their text. What stands between back-quotes is no
/// link.
fn relinked(page: &str, place: impl Fn(&str) -> Option<String>) -> String {
    let mut made = String::with_capacity(page.len());
    let mut rest = page;
    let mut is_code = false;
    // Where the text of a link began, in what is made.
    let mut open = Vec::new();
    while let Some(at) = rest.find(['`', '[', ']']) {
        made.push_str(&rest[..at]);
        rest = &rest[at..];
        let mark = &rest[..1];
        match mark {
            "`" => is_code = !is_code,
            "[" if !is_code => open.push(made.len()),
            "]" if !is_code => {
                let began = open.pop();
                let target = rest.strip_prefix("](").and_then(|link| link.split_once(')'));
                if let (Some(began), Some((target, after))) = (began, target) {
                    match place(target) {
                        Some(target) => made.push_str(&format!("]({target})")),
                        None => {
                            made.remove(began);
                            if made[..began].ends_with('!') {
                                made.remove(began - 1);
                            }
                        }
                    }
                    rest = after;
                    continue;
                }
            }
            _ => {}
        }
        made.push_str(mark);
        rest = &rest[1..];
    }
    made.push_str(rest);
    made
}

#[cfg(test)]
mod tests {
    use super::*;

    const SOURCES: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../..");

    /// The links of a page, by their targets.
    fn links(page: &str) -> Vec<String> {
        let found = std::cell::RefCell::new(Vec::new());
        relinked(page, |target| {
            found.borrow_mut().push(target.to_owned());
            None
        });
        found.into_inner()
    }

    fn pages(folder: &Path) -> Vec<PathBuf> {
        let entries = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
        entries
            .flat_map(|path| match path.is_dir() {
                true => pages(&path),
                false => vec![path].into_iter().filter(|path| path.extension().is_some_and(|it| it == "md")).collect(),
            })
            .collect()
    }

    /// Links of the pages in `folder` that lead to nothing there, or out of it and not to what the package has
    /// elsewhere.
    fn dead(folder: &Path) -> Vec<String> {
        let mut dead = Vec::new();
        for page in pages(folder) {
            for target in links(&fs::read_to_string(&page).unwrap()) {
                let path = target.split('#').next().unwrap();
                let to = plain(&page.parent().unwrap().join(path));
                let installed = to.strip_prefix(folder).map(|to| Path::new(INSTALLED).join(to));
                let outside = || {
                    plain(&Path::new(INSTALLED).join(page.strip_prefix(folder).unwrap().parent().unwrap()).join(path))
                };
                let installed = installed.unwrap_or_else(|_| outside());
                let is_elsewhere = ELSEWHERE.iter().any(|(_, known)| Path::new(known) == installed);
                if !(path.is_empty() || target.contains("://") || to.exists() || is_elsewhere) {
                    dead.push(format!("{}: {target}", page.display()));
                }
            }
        }
        dead
    }

    #[test]
    fn every_link_of_the_installed_pages_leads_somewhere() {
        let folder = tempfile::tempdir().unwrap();
        write(Path::new(SOURCES), folder.path()).unwrap();
        assert_eq!(dead(folder.path()), [""; 0]);
        for page in ["README.md", "service.md", "control.md", "laser-protocol.md", "examples/clients/README.md"] {
            assert!(folder.path().join(page).exists(), "{page}");
        }
        let readme = fs::read_to_string(folder.path().join("README.md")).unwrap();
        for link in ["](page.md)", "](service.md)", "](examples/rig.toml)", "](eye.jpg)", "](changelog.gz)"] {
            assert!(readme.contains(link), "{link} is not in:\n{readme}");
        }
        assert!(!readme.contains("](calibration"), "the sources are not there");
        let clients = fs::read_to_string(folder.path().join("examples/clients/README.md")).unwrap();
        assert!(clients.contains("](../../feed.md)") && clients.contains("](python/realsense.py)"), "{clients}");
        assert!(clients.contains("](../../../../../lib/python3/dist-packages/holod_client)"), "{clients}");
        fs::write(folder.path().join("examples/stray.md"), "[a](../README.md) and [b](../nowhere.md)").unwrap();
        assert_eq!(dead(folder.path()).len(), 1);
    }

    #[test]
    fn a_link_to_what_is_not_there_is_its_text() {
        let known = |target: &str| (target == "a.md#part").then(|| "b.md#part".to_owned());
        for (page, made) in [
            ("see [the page](a.md#part).", "see [the page](b.md#part)."),
            ("see [`x`\nand y](c.md), [z](a.md#part)", "see `x`\nand y, [z](b.md#part)"),
            ("![a picture](c.png) here", "a picture here"),
            ("[![in](a.md#part)](c.md)", "![in](b.md#part)"),
            ("`[no](c.md)` and [word] and ](c.md)", "`[no](c.md)` and [word] and ](c.md)"),
            ("DeviceAllow=[x] (y)", "DeviceAllow=[x] (y)"),
        ] {
            assert_eq!(relinked(page, known), made);
        }
    }
}

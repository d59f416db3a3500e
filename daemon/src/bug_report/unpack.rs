//! Takes a report apart into a folder of its own. What is in an archive is anybody's: nothing of it leads out of the
//! folder, and there is an end to its size.

use std::fs::{self, File, OpenOptions};
use std::io::{self, BufReader, Read, Write};
use std::path::{Component, Path, PathBuf};

use flate2::read::GzDecoder;
use tar::{Archive, EntryType};

use super::{Copy, FOLDER, MANIFEST, Manifest, Packed};
use crate::failure::{Exit, Failure};
use crate::record::content_xxh3;
use crate::staging::Temporary;

const GZIP: [u8; 2] = [0x1f, 0x8b];
/// A block of a tar archive, and what stands in its first one.
const BLOCK_BYTES: usize = 512;
const USTAR: std::ops::Range<usize> = 257..262;
/// More than a long sequence of pictures has.
const LARGEST: u64 = 64 << 30;
const MOST_ENTRIES: usize = 1 << 20;
const DEEPEST: usize = 4;
/// Longest list, and longest text: what stands for names in it may have made it longer than it was.
const LARGEST_TEXT: u64 = 2 * super::LARGEST_TEXT;
/// What a program may say of a file before it; nothing of it is used.
const LARGEST_REMARK: u64 = 1 << 16;

/// A report that was taken apart; its folder goes with it.
pub struct Unpacked {
    folder: Temporary,
    /// What it says of itself.
    pub manifest: Manifest,
}

impl Unpacked {
    /// A file or folder in it.
    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(FOLDER).join(name)
    }

    /// Whether a path leads to something in it and nowhere else.
    pub fn holds(&self, path: &Path) -> bool {
        let inside = path.strip_prefix(self.path(""));
        inside.is_ok_and(|inside| inside.components().all(|component| matches!(component, Component::Normal(_))))
    }

    /// The text of a file in it; nothing where there is none.
    ///
    /// # Errors
    /// It is longer than any that holod packs, or cannot be read.
    pub fn text(&self, name: &str) -> Result<Option<String>, Failure> {
        let read = read_text(&self.path(name));
        read.map_err(|error| Failure::new(Exit::Data, format!("{name}: {error}")))
    }
}

/// Whether a file is a tar archive, with gzip or without: no log of pupils is one.
pub fn is_archive(path: &Path) -> bool {
    let first_block = || -> io::Result<Vec<u8>> {
        let mut block = Vec::new();
        plain(path)?.take(BLOCK_BYTES as u64).read_to_end(&mut block)?;
        Ok(block)
    };
    path.is_file() && first_block().is_ok_and(|block| block.get(USTAR).is_some_and(|magic| magic == b"ustar"))
}

/// Refuses an archive where a log of pupils is wanted.
///
/// # Errors
/// It is one.
pub fn refuse_archive(path: &Path) -> Result<(), Failure> {
    if !is_archive(path) {
        return Ok(());
    }
    let shown = path.display();
    Err(Failure::new(
        Exit::Data,
        format!(
            "{shown}: found a tar archive, expected a log; where it is a report, `holod --tracker replay:{shown}` shows it, \
             and what the tracker sent is in it, {FOLDER}/tracker.holodraw"
        ),
    ))
}

/// Takes the report at `path` apart.
///
/// # Errors
/// It cannot be read, is damaged or cut off, is no report, or holds what none does.
pub fn unpack(path: &Path) -> Result<Unpacked, Failure> {
    let unpacked = open(path)?;
    let refused = |what: String| Failure::new(Exit::Data, format!("{}: {what}", path.display()));
    for Packed { name, bytes, xxh3, .. } in &unpacked.manifest.files {
        let found = within(name).map_err(|found| refused(format!("found {found} (`{name}`) in {MANIFEST}")))?;
        let found = File::open(unpacked.path(&found.to_string_lossy()));
        let found = found.and_then(|mut file| content_xxh3(&mut file));
        if found.map_err(|error| refused(format!("{name}: {error}")))? != (*bytes, xxh3.clone()) {
            return Err(refused(format!("{name} is another one than was packed: ask for the report again")));
        }
    }
    Ok(unpacked)
}

/// The same of a report whose files are not compared with its listing yet.
pub(super) fn open(path: &Path) -> Result<Unpacked, Failure> {
    let refused = |what: String| Failure::new(Exit::Data, format!("{}: {what}", path.display()));
    let folder = Temporary::new("holod-report-").map_err(Failure::because(Exit::CannotCreate))?;
    take_apart(path, folder.path()).map_err(|fault| match fault {
        Fault::Read(error) if error.kind() == io::ErrorKind::UnexpectedEof => {
            refused("it ends before its end: was it sent whole?".into())
        }
        Fault::Read(error) => refused(format!("the archive is damaged: {error}; ask for it again")),
        Fault::Write(failure) => failure,
        Fault::Entry { name, found } => refused(format!("found {found} (`{name}`), which no report of holod has")),
    })?;
    let manifest = folder.path().join(FOLDER).join(MANIFEST);
    let text = read_text(&manifest).map_err(|error| refused(format!("{MANIFEST}: {error}")))?.ok_or_else(|| {
        refused(format!("is no report of holod: found no {FOLDER}/{MANIFEST} in it; `holod report` makes one"))
    })?;
    let manifest: Manifest = serde_json::from_str(&text).map_err(|error| {
        refused(format!("found {MANIFEST} that this holod does not know: {error}; show it with the holod that made it"))
    })?;
    Ok(Unpacked { folder, manifest })
}

/// The text of a file, where there is one.
fn read_text(path: &Path) -> io::Result<Option<String>> {
    let file = match File::open(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        opened => opened?,
    };
    let mut text = String::new();
    file.take(LARGEST_TEXT + 1).read_to_string(&mut text)?;
    if text.len() as u64 > LARGEST_TEXT {
        return Err(io::Error::other(format!("found more than the {LARGEST_TEXT} bytes that it may have")));
    }
    Ok(Some(text))
}

/// What is wrong with an archive.
enum Fault {
    Read(io::Error),
    Write(Failure),
    Entry { name: String, found: &'static str },
}

fn plain(path: &Path) -> io::Result<Box<dyn Read>> {
    let mut begin = [0; GZIP.len()];
    let is_gzip = File::open(path)?.read_exact(&mut begin).is_ok() && begin == GZIP;
    let file = BufReader::new(File::open(path)?);
    Ok(if is_gzip { Box::new(GzDecoder::new(file)) } else { Box::new(file) })
}

fn take_apart(path: &Path, folder: &Path) -> Result<(), Fault> {
    // Raw: extensions of the format, which could bring anything, are seen and refused here.
    let mut archive = Archive::new(plain(path).map_err(Fault::Read)?);
    let mut left = LARGEST;
    for (index, entry) in archive.entries().map_err(Fault::Read)?.raw(true).enumerate() {
        let mut entry = entry.map_err(Fault::Read)?;
        let name = String::from_utf8_lossy(&entry.path_bytes()).into_owned();
        let refuse = |found| Fault::Entry { name: name.clone(), found };
        let size = entry.header().entry_size().map_err(Fault::Read)?;
        left = left.checked_sub(size).ok_or_else(|| refuse("more than 64 GiB"))?;
        if index >= MOST_ENTRIES {
            return Err(refuse("more than a million files"));
        }
        match entry.header().entry_type() {
            EntryType::Regular => {
                let inside = within(&name).map_err(refuse)?;
                let target = folder.join(&inside);
                let written = create(folder, &inside).and_then(|mut file| {
                    let copied = copy(&mut entry, &mut file);
                    Ok((copied, file.flush()?))
                });
                let cannot = |error: io::Error| {
                    let shown = target.display();
                    Fault::Write(Failure::new(
                        Exit::CannotCreate,
                        format!("cannot unpack {shown}: {error}; TMPDIR names another place"),
                    ))
                };
                let (copied, ()) = written.map_err(|error| match error.kind() {
                    io::ErrorKind::AlreadyExists => refuse("a file that comes twice"),
                    _ => cannot(error),
                })?;
                match copied {
                    Err(Copy::Read(error)) => return Err(Fault::Read(error)),
                    Err(Copy::Write(error)) => return Err(cannot(error)),
                    Ok(copied) if copied < size => return Err(Fault::Read(io::ErrorKind::UnexpectedEof.into())),
                    Ok(_) => {}
                }
            }
            EntryType::Directory => {
                within(&name).map_err(refuse)?;
            }
            EntryType::XHeader | EntryType::XGlobalHeader if size <= LARGEST_REMARK => {}
            EntryType::Symlink | EntryType::Link => return Err(refuse("a link")),
            EntryType::Char | EntryType::Block | EntryType::Fifo => return Err(refuse("a device")),
            _ => return Err(refuse("something that is no file")),
        }
    }
    // The checksum of gzip comes last.
    io::copy(&mut archive.into_inner().take(LARGEST), &mut io::sink()).map_err(Fault::Read)?;
    Ok(())
}

fn copy(from: &mut impl Read, to: &mut impl Write) -> Result<u64, Copy> {
    let mut buffer = vec![0; 1 << 18];
    let mut copied = 0;
    loop {
        let count = from.read(&mut buffer).map_err(Copy::Read)?;
        if count == 0 {
            return Ok(copied);
        }
        to.write_all(&buffer[..count]).map_err(Copy::Write)?;
        copied += count as u64;
    }
}

/// Creates a file in `folder`, which must be there: a signal may have taken it away.
fn create(folder: &Path, inside: &Path) -> io::Result<File> {
    let mut parent = folder.to_owned();
    for part in inside.parent().into_iter().flat_map(Path::components) {
        parent.push(part);
        match fs::create_dir(&parent) {
            Err(error) if error.kind() != io::ErrorKind::AlreadyExists => return Err(error),
            _ => {}
        }
    }
    OpenOptions::new().write(true).create_new(true).open(folder.join(inside))
}

/// A name in an archive as a path that stays within a folder.
fn within(name: &str) -> Result<PathBuf, &'static str> {
    let mut path = PathBuf::new();
    for component in Path::new(name).components() {
        match component {
            Component::Normal(part) => path.push(part),
            Component::CurDir => {}
            Component::ParentDir | Component::RootDir | Component::Prefix(_) => {
                return Err("a name that leads out of the folder");
            }
        }
    }
    match path.components().count() {
        0 => Err("no name"),
        1..=DEEPEST => Ok(path),
        _ => Err("folders within folders"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flate2::Compression;
    use flate2::write::GzEncoder;
    use tar::Header;

    /// An archive of one entry, whose header `change` changes.
    fn archive(folder: &Path, name: &[u8], content: &[u8], change: impl Fn(&mut Header)) -> PathBuf {
        let mut header = Header::new_ustar();
        header.as_mut_bytes()[..name.len()].copy_from_slice(name);
        header.set_size(content.len() as u64);
        header.set_mode(0o644);
        header.set_entry_type(EntryType::Regular);
        change(&mut header);
        header.set_cksum();
        let mut builder = tar::Builder::new(GzEncoder::new(Vec::new(), Compression::fast()));
        builder.append(&header, content).unwrap();
        let path = folder.join("archive");
        fs::write(&path, builder.into_inner().unwrap().finish().unwrap()).unwrap();
        path
    }

    fn refusal(path: &Path) -> String {
        let failure = unpack(path).err().unwrap();
        assert_eq!(failure.exit, Exit::Data, "{failure}");
        failure.to_string()
    }

    #[test]
    fn nothing_leads_out_of_the_folder() {
        let folder = tempfile::tempdir().unwrap();
        let outside = folder.path().join("outside");
        let absolute = outside.to_str().unwrap().to_owned();
        for name in [&b"../outside"[..], b"holod-report/../../outside", absolute.as_bytes()] {
            let path = archive(folder.path(), name, b"x", |_| ());
            assert!(is_archive(&path));
            assert!(refusal(&path).contains("leads out of the folder"), "{}", String::from_utf8_lossy(name));
        }
        for kind in [EntryType::Symlink, EntryType::Link, EntryType::Fifo, EntryType::Char, EntryType::GNULongName] {
            let path = archive(folder.path(), b"holod-report/x", b"", |header| {
                header.set_entry_type(kind);
                header.set_link_name(&absolute).unwrap();
            });
            assert!(refusal(&path).contains("which no report of holod has"), "{kind:?}");
        }
        assert!(!outside.exists());
    }

    #[test]
    fn sizes_counts_and_depths_have_an_end() {
        let folder = tempfile::tempdir().unwrap();
        let huge = archive(folder.path(), b"holod-report/x", b"x", |header| header.set_size(LARGEST + 1));
        assert!(refusal(&huge).contains("more than 64 GiB"));
        let deep = archive(folder.path(), b"a/b/c/d/e", b"x", |_| ());
        assert!(refusal(&deep).contains("folders within folders"));
        let nameless = archive(folder.path(), b"./.", b"x", |_| ());
        assert!(refusal(&nameless).contains("no name"));
        let mut twice = tar::Builder::new(Vec::new());
        for _ in 0..2 {
            let mut header = Header::new_ustar();
            header.set_size(1);
            twice.append_data(&mut header, "holod-report/x", &b"x"[..]).unwrap();
        }
        let path = folder.path().join("twice");
        fs::write(&path, twice.into_inner().unwrap()).unwrap();
        assert!(is_archive(&path), "gzip may be missing");
        assert!(refusal(&path).contains("comes twice"));
    }

    #[test]
    fn what_is_cut_off_damaged_or_something_else_is_said() {
        let folder = tempfile::tempdir().unwrap();
        let noise: Vec<u8> = (0..40_000_u32).map(|n| (n.wrapping_mul(2_654_435_761) >> 13) as u8).collect();
        let path = archive(folder.path(), b"holod-report/x", &noise, |_| ());
        let whole = fs::read(&path).unwrap();
        assert!(refusal(&path).contains("is no report of holod: found no holod-report/report.json"));
        fs::write(&path, &whole[..whole.len() / 2]).unwrap();
        assert!(refusal(&path).contains("was it sent whole?"));
        let mut damaged = whole.clone();
        let last = damaged.len() - 6;
        damaged[last] ^= 1;
        fs::write(&path, damaged).unwrap();
        assert!(refusal(&path).contains("damaged"));
        fs::write(&path, "t_ns,eye\n").unwrap();
        assert!(!is_archive(&path));
        assert!(!is_archive(folder.path()));
    }

    #[test]
    fn a_file_that_is_not_the_one_that_was_packed_is_found() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("archive");
        let write = |content: &[u8]| {
            let mut builder = tar::Builder::new(Vec::new());
            let manifest = Manifest { files: vec![Packed::of("frames.csv", b"12345")], ..Manifest::now(Vec::new()) };
            let manifest = serde_json::to_vec(&manifest).unwrap();
            for (name, content) in [("report.json", &manifest[..]), ("frames.csv", content)] {
                let mut header = Header::new_ustar();
                header.set_size(content.len() as u64);
                builder.append_data(&mut header, format!("{FOLDER}/{name}"), content).unwrap();
            }
            fs::write(&path, builder.into_inner().unwrap()).unwrap();
        };
        write(b"12345");
        let unpacked = unpack(&path).unwrap();
        let at = unpacked.path("frames.csv");
        assert!(unpacked.holds(&at) && unpacked.holds(&unpacked.path("scene").join("colour.png")));
        for outside in ["../x", "scene/../../../x", "/etc/hosts"] {
            assert!(!unpacked.holds(&unpacked.path(outside)), "{outside}");
        }
        assert_eq!(fs::read(&at).unwrap(), b"12345");
        drop(unpacked);
        assert!(!at.exists(), "the folder goes with it");
        write(b"12346");
        assert!(refusal(&path).contains("frames.csv is another one than was packed"));
    }

    #[test]
    fn text_as_long_as_any_that_is_packed_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("orders.jsonl");
        let file = File::create(&path).unwrap();
        file.set_len(super::super::LARGEST_TEXT).unwrap();
        assert_eq!(read_text(&path).unwrap().map(|text| text.len() as u64), Some(super::super::LARGEST_TEXT));
        file.set_len(LARGEST_TEXT + 1).unwrap();
        assert!(read_text(&path).is_err());
    }
}

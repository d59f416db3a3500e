//! What goes into a report.

use std::fs::{self, File};
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::time::{Duration, UNIX_EPOCH};

use flate2::Compression;
use flate2::write::GzEncoder;
use holod_calibration::rig::{LaserDriver, Provenance, Rig};
use holod_pupil_input::{RecordFiles, payloads, with_header};
use serde::de::DeserializeOwned;
use serde_json::Value;
use tar::{Builder, EntryType, Header};
use toml_edit::DocumentMut;

use super::{Copy, FOLDER, LARGEST_TEXT, MANIFEST, Manifest, Packed, SCENE_FOLDER, Scrubber, order_folder, unix_ms};
use crate::failure::{Exit, Failure, is_file};
use crate::record::{
    self, BENCH, EARLIER, Hashed, LOG, ORDER_FILES, ORDERS, OrderSource, RIG, RUN, RunFacts, SCENE, SceneSource,
    SourceFile, content_xxh3, is_of_bench, is_weights,
};
use crate::snapshot::Snapshot;

/// What a report will hold.
#[derive(Debug, Default)]
pub struct Contents {
    entries: Vec<Entry>,
    left_out: Vec<String>,
    /// When the run began, where there is one; milliseconds since 1970.
    started_unix_ms: Option<u64>,
}

#[derive(Debug)]
struct Entry {
    name: String,
    content: Content,
}

#[derive(Debug)]
enum Content {
    Bytes(Vec<u8>),
    File(PathBuf),
}

/// The name of a report of `contents` where none is given: it tells when the run began and nothing else.
pub fn default_name(contents: &Contents) -> PathBuf {
    let began = UNIX_EPOCH + Duration::from_millis(contents.started_unix_ms.unwrap_or_else(unix_ms));
    let began = humantime::format_rfc3339_seconds(began).to_string().replace(['-', ':', 'Z'], "").replace('T', "-");
    PathBuf::from(format!("holod-report-{began}.tar.gz"))
}

impl Contents {
    /// Without a record: what the holods that run say of themselves, or why nothing can be had of them.
    pub fn of_running(running: Result<Vec<Snapshot>, Failure>, scrubber: &Scrubber) -> Result<Self, Failure> {
        let mut contents = Self::default();
        let running = running.unwrap_or_else(|failure| {
            contents.left_out.push(format!("a status: {failure}"));
            Vec::new()
        });
        for status in &running {
            let text = serde_json::to_string_pretty(status).map_err(Failure::because(Exit::Software))? + "\n";
            contents.add_json::<Snapshot>(&format!("status-{}.json", status.pid), &text, scrubber);
        }
        contents.left_out.push(
            "frames: no record was named; `holod run --record DIR` writes one, `holod report DIR` packs it".into(),
        );
        Ok(contents)
    }

    /// Of the record in `folder`, with the pictures that it shows or without.
    ///
    /// # Errors
    /// The folder is no record, or cannot be read.
    pub fn of_record(folder: &Path, with_scene: bool, scrubber: &Scrubber) -> Result<Self, Failure> {
        let mut contents = Self::default();
        if !is_file(&folder.join(record::FRAMES))? {
            return Err(Failure::new(
                Exit::NoInput,
                format!(
                    "{}: found no {}, expected a directory that `holod run --record` wrote",
                    folder.display(),
                    record::FRAMES
                ),
            ));
        }
        let samples = RecordFiles::in_folder(folder);
        let facts = contents.text_of(folder, RUN)?;
        match facts.as_deref().map(serde_json::from_str::<RunFacts>) {
            Some(Ok(run)) => {
                contents.started_unix_ms = Some(run.started_unix_ms);
                contents.add_lines(RUN, facts.as_deref().unwrap_or_default(), scrubber);
                contents.add_scene(SCENE_FOLDER, &run.scene, with_scene, scrubber);
            }
            Some(Err(error)) => contents.left_out.push(format!("{RUN}, which is damaged: {error}; {NO_FRAMES}")),
            None => contents.left_out.push(format!(
                "{RUN}: the run broke off before its first frame, or an earlier holod, which wrote none, made it; \
                 {NO_FRAMES}"
            )),
        }
        contents.add_bench(folder, scrubber)?;
        if folder.join(EARLIER).exists() {
            contents.left_out.push(format!(
                "{EARLIER}/: an earlier record, whose place this one has not taken; the next run that records there puts \
                 it back"
            ));
        }
        contents.add_recorded(record::FRAMES, &folder.join(record::FRAMES));
        if let Some(path) = &samples.samples {
            contents.add_recorded("samples.csv", path);
        }
        if let Some(path) = &samples.raw {
            contents.add_tracker_bytes(path, scrubber)?;
        }
        if let Some(text) = contents.text_of(folder, ORDERS)? {
            contents.add_lines(ORDERS, &text, scrubber);
        }
        if let Some(text) = contents.text_of(folder, ORDER_FILES)? {
            contents.add_lines(ORDER_FILES, &text, scrubber);
            for line in text.lines() {
                if let Ok(source) = serde_json::from_str(line) {
                    contents.add_order(&source, with_scene, scrubber);
                }
            }
        }
        for name in ["summary.json", LOG] {
            if let Some(text) = contents.text_of(folder, name)? {
                contents.add_text(name, scrubber.text(&text));
            }
        }
        contents.add_shown_levels(folder, with_scene)?;
        Ok(contents)
    }

    fn text_of(&mut self, folder: &Path, name: &str) -> Result<Option<String>, Failure> {
        let path = folder.join(name);
        if !self.takes(name, &path) {
            return Ok(None);
        }
        let read = File::open(&path).and_then(|file| {
            let mut bytes = Vec::new();
            file.take(LARGEST_TEXT).read_to_end(&mut bytes)?;
            Ok(bytes)
        });
        match read {
            Ok(bytes) => {
                if bytes.len() as u64 == LARGEST_TEXT {
                    self.left_out.push(format!("{name} behind its first {} MiB", LARGEST_TEXT >> 20));
                }
                Ok(Some(String::from_utf8_lossy(&bytes).into_owned()))
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(Failure::new(Exit::NoInput, format!("{}: {error}", path.display()))),
        }
    }

    /// Whether something of a record is a plain file: a link may lead anywhere. What is something else is told.
    fn takes(&mut self, name: &str, path: &Path) -> bool {
        match path.symlink_metadata() {
            Ok(found) if found.is_file() => return true,
            Ok(_) => self.left_out.push(format!("{name}: no file, as a run writes one")),
            Err(_) => {}
        }
        false
    }

    /// Adds a file of the record, where it is there.
    fn add_recorded(&mut self, name: &str, path: &Path) {
        if self.takes(name, path) {
            self.add_file(name, path);
        }
    }

    fn add_file(&mut self, name: &str, path: &Path) {
        self.entries.push(Entry { name: name.to_owned(), content: Content::File(path.to_owned()) });
    }

    fn add_text(&mut self, name: &str, text: String) {
        self.entries.push(Entry { name: name.to_owned(), content: Content::Bytes(text.into_bytes()) });
    }

    /// Adds text that a program reads: where it would read something else without a name, the name stays.
    fn add_checked<T: PartialEq>(&mut self, name: &str, text: &str, scrubber: &Scrubber, read: impl Fn(&str) -> T) {
        let scrubbed = scrubber.text(text);
        let text = if read(text) == read(&scrubbed) {
            scrubbed
        } else {
            self.left_out.push(format!("no name in {name}: one of them is a word of its format; look at it"));
            scrubber.paths(text)
        };
        self.add_text(name, text);
    }

    fn add_json<T: DeserializeOwned>(&mut self, name: &str, text: &str, scrubber: &Scrubber) {
        self.add_checked(name, text, scrubber, |text| serde_json::from_str::<T>(text).is_ok());
    }

    /// Adds JSON that frames are made again by, a value or one in each line.
    fn add_lines(&mut self, name: &str, text: &str, scrubber: &Scrubber) {
        self.add_checked(name, text, scrubber, meaning);
    }

    /// The rig and its files, and nothing that somebody else has put beside them.
    fn add_bench(&mut self, folder: &Path, scrubber: &Scrubber) -> Result<(), Failure> {
        let bench = folder.join(BENCH);
        let cannot = |error: io::Error| Failure::new(Exit::NoInput, format!("{}: {error}", bench.display()));
        let entries = match fs::read_dir(&bench) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                self.left_out.push(format!("{BENCH}/: it is not in the record; {NO_FRAMES}"));
                return Ok(());
            }
            entries => entries.map_err(cannot)?,
        };
        let mut found = Vec::new();
        for entry in entries {
            let entry = entry.map_err(cannot)?;
            let name = entry.file_name().to_string_lossy().into_owned();
            // A link may lead anywhere.
            if is_of_bench(&name) && entry.file_type().map_err(cannot)?.is_file() {
                found.push((name, entry.path()));
            } else {
                self.left_out.push(format!("{BENCH}/{name}: no run has put it there"));
            }
        }
        found.sort();
        for (name, path) in &found {
            let packed = format!("{BENCH}/{name}");
            if is_weights(name) {
                self.add_file(&packed, path);
                continue;
            }
            match fs::read_to_string(path) {
                Ok(text) if name == RIG => {
                    // Its tables are found in its folder, whatever is in its text.
                    let read = |text: &str| Rig::parse(text, path).ok().map(without_names);
                    self.add_checked(&packed, &text, scrubber, read);
                }
                Ok(text) => self.add_text(&packed, scrubber.text(&text)),
                Err(error) if error.kind() == io::ErrorKind::InvalidData => self.add_file(&packed, path),
                Err(error) => return Err(Failure::new(Exit::NoInput, format!("{}: {error}", path.display()))),
            }
        }
        Ok(())
    }

    fn add_scene(&mut self, folder: &str, scene: &SceneSource, with_scene: bool, scrubber: &Scrubber) {
        let SceneSource::Files { description, files, .. } = scene else {
            if *scene == SceneSource::Feed {
                self.left_out.push("pictures of the live feed, which are not recorded".into());
            }
            return;
        };
        if !with_scene {
            let bytes: u64 = files.iter().map(|file| file.bytes).sum();
            let left = format!("{folder}/: {} files, {} of pictures, as asked; {NO_FRAMES}", files.len(), size(bytes));
            self.left_out.push(left);
            return;
        }
        // Its words are keys, numbers and the files' names in the report: names of others stand in comments alone.
        self.add_checked(&format!("{folder}/{SCENE}"), description, scrubber, scene_values);
        for file in files {
            self.add_source(folder, file);
        }
    }

    fn add_order(&mut self, source: &OrderSource, with_scene: bool, scrubber: &Scrubber) {
        let folder = order_folder(source.order);
        if let Some(scene) = &source.scene {
            self.add_scene(&folder, scene, with_scene, scrubber);
        }
        if let Some(weights) = &source.weights {
            self.add_source(&folder, weights);
        }
    }

    /// Adds a file that the run read, where it is still the same.
    fn add_source(&mut self, folder: &str, file: &SourceFile) {
        let name = format!("{folder}/{}", file.name);
        let now = File::open(&file.path).and_then(|mut file| content_xxh3(&mut file));
        match now {
            Ok(now) if now == (file.bytes, file.xxh3.clone()) => self.add_file(&name, &file.path),
            Ok(_) => self.left_out.push(format!("{name}: it has changed since the run; {NO_FRAMES}")),
            Err(error) => self.left_out.push(format!("{name}: {error}; {NO_FRAMES}")),
        }
    }

    /// The bytes that the tracker sent, with a header without names. Where a name is among the bytes, they stay out.
    fn add_tracker_bytes(&mut self, path: &Path, scrubber: &Scrubber) -> Result<(), Failure> {
        let name = "tracker.holodraw";
        if !self.takes(name, path) {
            return Ok(());
        }
        let cannot = |error: io::Error| Failure::new(Exit::NoInput, format!("{}: {error}", path.display()));
        let bytes = path.metadata().map_err(cannot)?.len();
        if bytes > LARGEST_TEXT {
            self.left_out.push(format!("{name}: {} are too many; samples.csv has the samples", size(bytes)));
            return Ok(());
        }
        let recording = fs::read(path).map_err(cannot)?;
        match (with_header(&recording, |header| scrubber.text(header)), payloads(&recording)) {
            (Some(_), Some(brought)) if scrubber.finds(&brought) => self.left_out.push(format!(
                "{name}: a name of a user or of this machine is among the tracker's bytes; samples.csv has the samples"
            )),
            (Some(changed), Some(_)) => {
                self.entries.push(Entry { name: name.into(), content: Content::Bytes(changed) });
            }
            _ => self.left_out.push(format!("{name}: it broke off within its header, or that cannot be understood")),
        }
        Ok(())
    }

    /// Levels are the pictures in another form.
    fn add_shown_levels(&mut self, folder: &Path, with_scene: bool) -> Result<(), Failure> {
        let names = record::shown_levels(folder)
            .map_err(|error| Failure::new(Exit::NoInput, format!("{}: {error}", folder.display())))?;
        match with_scene {
            true => names.iter().for_each(|name| self.add_recorded(name, &folder.join(name))),
            false if names.is_empty() => {}
            false => self.left_out.push(format!("{} pictures of levels that were shown, as asked", names.len())),
        }
        Ok(())
    }

    /// Writes the archive to `path` and says what is in it.
    ///
    /// # Errors
    /// A file cannot be read, or the archive cannot be written.
    pub fn write(self, path: &Path, scrubber: &Scrubber) -> Result<Manifest, Failure> {
        let cannot = |error: io::Error| Failure::new(Exit::CannotCreate, format!("cannot write the report: {error}"));
        let mut manifest = Manifest::now(self.left_out.iter().map(|left| scrubber.text(left)).collect());
        manifest.machine = manifest.machine.scrubbed(|text| scrubber.text(text));
        let encoder = GzEncoder::new(File::create(path).map_err(cannot)?, Compression::default());
        let mut archive = Builder::new(encoder);
        let t_s = manifest.packed_unix_ms / 1000;
        for Entry { name, content } in self.entries {
            let packed = match content {
                Content::Bytes(bytes) => {
                    append(&mut archive, &name, t_s, bytes.len() as u64, &bytes[..]).map_err(cannot)?;
                    Packed::of(&name, &bytes)
                }
                Content::File(path) => add_file(&mut archive, &name, t_s, &path).map_err(|fault| match fault {
                    Copy::Read(error) => Failure::new(Exit::NoInput, format!("{}: {error}", path.display())),
                    Copy::Write(error) => cannot(error),
                })?,
            };
            manifest.files.push(packed);
        }
        let text = serde_json::to_string_pretty(&manifest).map_err(Failure::because(Exit::Software))? + "\n";
        append(&mut archive, MANIFEST, t_s, text.len() as u64, text.as_bytes()).map_err(cannot)?;
        archive.into_inner().and_then(GzEncoder::finish).and_then(|file| file.sync_all()).map_err(cannot)?;
        Ok(manifest)
    }
}

/// What is added where frames lack something.
const NO_FRAMES: &str = "frames that need it cannot be shown again";

/// A rig without what may name somebody or something of a bench and makes no frame.
fn without_names(mut rig: Rig) -> Rig {
    rig.name.clear();
    rig.tracker.spec = None;
    rig.lasers.driver = LaserDriver::Simulated;
    rig.provenance = Provenance::default();
    rig
}

/// What frames are made again by, of a JSON value or of one in each line, without what is said to people alone and the
/// places where files were. A run that broke off may have left half a line, which says nothing.
fn meaning(text: &str) -> Vec<Value> {
    serde_json::Deserializer::from_str(text).into_iter().map_while(Result::ok).map(without_words).collect()
}

/// A value without the words that nothing is made by.
fn without_words(value: Value) -> Value {
    const WORDS: [&str; 6] = ["tracker", "panel", "machine", "path", "description", "holod"];
    match value {
        Value::String(text) if text.contains('/') => Value::Null,
        Value::Array(values) => values.into_iter().map(without_words).collect(),
        Value::Object(values) => {
            let kept = values.into_iter().filter(|(key, _)| !WORDS.contains(&key.as_str()));
            Value::Object(kept.map(|(key, value)| (key, without_words(value))).collect())
        }
        value => value,
    }
}

/// The keys of a scene file and their values, without its comments.
fn scene_values(text: &str) -> Option<Vec<(String, String)>> {
    let document: DocumentMut = text.parse().ok()?;
    let plain = |item: &toml_edit::Item| {
        item.as_value().map_or_else(|| item.to_string(), |value| value.clone().decorated("", "").to_string())
    };
    Some(document.iter().map(|(key, item)| (key.to_owned(), plain(item))).collect())
}

/// A reader that tells whether it was it that failed.
struct Source<R> {
    reader: R,
    has_failed: bool,
}

impl<R: Read> Read for Source<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        self.reader.read(buffer).inspect_err(|error| self.has_failed |= error.kind() != io::ErrorKind::Interrupted)
    }
}

/// Adds a file as long as it is now, whoever goes on writing it.
fn add_file(archive: &mut Builder<GzEncoder<File>>, name: &str, t_s: u64, path: &Path) -> Result<Packed, Copy> {
    let file = File::open(path).map_err(Copy::Read)?;
    let bytes = file.metadata().map_err(Copy::Read)?.len();
    let mut content = Source { reader: Hashed::new(file.take(bytes)), has_failed: false };
    let added = append(archive, name, t_s, bytes, &mut content);
    added.map_err(if content.has_failed { Copy::Read } else { Copy::Write })?;
    let (found, xxh3) = content.reader.finish();
    if found < bytes {
        let what = format!("it had {bytes} bytes and ended after {found}: something shortens it; pack again");
        return Err(Copy::Read(io::Error::other(what)));
    }
    Ok(Packed { name: name.to_owned(), bytes, xxh3 })
}

/// Adds a file without owner and rights.
fn append(
    archive: &mut Builder<GzEncoder<File>>,
    name: &str,
    t_s: u64,
    bytes: u64,
    content: impl Read,
) -> io::Result<()> {
    let mut header = Header::new_ustar();
    header.set_entry_type(EntryType::Regular);
    header.set_size(bytes);
    header.set_mode(0o644);
    header.set_mtime(t_s);
    archive.append_data(&mut header, format!("{FOLDER}/{name}"), content)
}

/// A number of bytes for people.
pub(super) fn size(bytes: u64) -> String {
    match bytes {
        0..10_000 => format!("{bytes} bytes"),
        10_000..10_000_000 => format!("{} kB", bytes / 1000),
        _ => format!("{} MB", bytes / 1_000_000),
    }
}

impl Manifest {
    /// What is in it and what is not, for whoever sends it.
    pub fn text(&self) -> String {
        let mut lines = Vec::new();
        let mut folders: Vec<(&str, usize, u64)> = Vec::new();
        for file in &self.files {
            match file.name.split_once('/') {
                None => lines.push(format!("  {:24} {:>12}", file.name, size(file.bytes))),
                Some((folder, _)) => match folders.iter_mut().find(|(known, ..)| *known == folder) {
                    Some((_, count, bytes)) => (*count, *bytes) = (*count + 1, *bytes + file.bytes),
                    None => folders.push((folder, 1, file.bytes)),
                },
            }
        }
        let folders = folders.into_iter().map(|(folder, count, bytes)| {
            format!("  {:24} {:>12}  in {count} files", format!("{folder}/"), size(bytes))
        });
        lines.extend(folders);
        lines.push(format!("  {MANIFEST:24} {:>12}", "this list"));
        if !self.left_out.is_empty() {
            lines.push("left out:".into());
            lines.extend(self.left_out.iter().map(|left| format!("  {left}")));
        }
        format!("in it, below {FOLDER}/:\n{}", lines.join("\n"))
    }
}

#[cfg(test)]
mod tests {
    use flate2::Crc;

    use super::*;

    #[test]
    fn the_name_says_when_the_run_began_and_no_more() {
        let contents = Contents { started_unix_ms: Some(1_795_491_696_989), ..Contents::default() };
        assert_eq!(default_name(&contents), Path::new("holod-report-20261124-034136.tar.gz"));
        assert!(default_name(&Contents::default()).to_str().unwrap().starts_with("holod-report-20"));
    }

    #[test]
    fn a_folder_that_is_no_record_is_refused_and_an_old_one_is_packed() {
        let folder = tempfile::tempdir().unwrap();
        let scrubber = Scrubber::default();
        let failure = Contents::of_record(folder.path(), true, &scrubber).unwrap_err();
        assert_eq!(failure.exit, Exit::NoInput);
        fs::write(folder.path().join(record::FRAMES), "frame,field\n").unwrap();
        fs::write(folder.path().join(LOG), "in /home/anna/lab\n").unwrap();
        let contents = Contents::of_record(folder.path(), true, &scrubber).unwrap();
        let names: Vec<_> = contents.entries.iter().map(|entry| entry.name.as_str()).collect();
        assert_eq!(names, ["frames.csv", "log.txt"]);
        assert!(contents.left_out[0].contains("an earlier holod"), "{:?}", contents.left_out);
        assert!(contents.left_out[1].contains("bench/: it is not in the record"), "{:?}", contents.left_out);

        let path = folder.path().join("report.tar.gz");
        let manifest = contents.write(&path, &scrubber).unwrap();
        assert!(manifest.text().contains("left out:\n  run.json"), "{}", manifest.text());
        let unpacked = super::super::unpack(&path).unwrap();
        assert_eq!(unpacked.manifest, manifest);
        assert_eq!(unpacked.text(LOG).unwrap().unwrap(), "in ~/lab\n");
        assert_eq!(unpacked.text("orders.jsonl").unwrap(), None);
    }

    fn anna() -> Scrubber {
        Scrubber::new([("anna".to_owned(), "/home/anna".to_owned())], [])
    }

    fn packed_text(contents: &Contents, name: &str) -> String {
        let entry = contents.entries.iter().find(|entry| entry.name == name).unwrap();
        match &entry.content {
            Content::Bytes(bytes) => String::from_utf8(bytes.clone()).unwrap(),
            Content::File(path) => fs::read_to_string(path).unwrap(),
        }
    }

    #[test]
    fn names_leave_the_comments_of_a_scene_and_its_values_stay() {
        let description = "# by Anna, in /home/anna/lab\ncolour = \"colour.png\" # anna's\n";
        let scene = SceneSource::Files { fit: Default::default(), description: description.into(), files: Vec::new() };
        let order = OrderSource { order: 2, scene: Some(scene.clone()), weights: None };
        let mut contents = Contents::default();
        contents.add_scene(SCENE_FOLDER, &scene, true, &anna());
        contents.add_order(&order, true, &anna());
        for name in ["scene/scene.toml", "order-2/scene.toml"] {
            let text = packed_text(&contents, name);
            assert_eq!(text, "# by USER, in ~/lab\ncolour = \"colour.png\" # USER's\n", "{name}");
        }
        assert!(contents.left_out.is_empty(), "{:?}", contents.left_out);

        // Whoever is called like a key.
        let mut contents = Contents::default();
        let scrubber = Scrubber::new([("colour".to_owned(), "/home/anna".to_owned())], []);
        contents.add_scene(SCENE_FOLDER, &scene, true, &scrubber);
        let text = packed_text(&contents, "scene/scene.toml");
        assert!(text.contains("colour = \"colour.png\"") && text.contains("in ~/lab"), "{text}");
        assert_eq!(contents.left_out.len(), 1);
    }

    #[test]
    fn of_the_bench_only_what_a_run_put_there_is_packed_and_its_text_without_names() {
        let folder = tempfile::tempdir().unwrap();
        let mut contents = Contents::default();
        contents.add_bench(folder.path(), &anna()).unwrap();
        assert!(contents.left_out[0].contains("bench/: it is not in the record"), "{:?}", contents.left_out);

        let bench = folder.path().join(BENCH);
        fs::create_dir_all(bench.join("lut-folder")).unwrap();
        for name in ["lut-green", "lut-red.txt", "lasers.toml", "notes.txt"] {
            fs::write(bench.join(name), "# anna in /home/anna\n").unwrap();
        }
        fs::write(bench.join("flatness-blue.png"), b"\x89PNG\xff").unwrap();
        fs::write(bench.join("weights.safetensors"), "anna").unwrap();
        std::os::unix::fs::symlink(bench.join("notes.txt"), bench.join("lut-blue")).unwrap();
        let mut contents = Contents::default();
        contents.add_bench(folder.path(), &anna()).unwrap();
        let names: Vec<_> = contents.entries.iter().map(|entry| entry.name.as_str()).collect();
        let expected = ["flatness-blue.png", "lasers.toml", "lut-green", "lut-red.txt", "weights.safetensors"];
        assert_eq!(names, expected.map(|name| format!("bench/{name}")));
        for name in &expected[1..4] {
            assert_eq!(packed_text(&contents, &format!("bench/{name}")), "# USER in ~\n");
        }
        assert_eq!(packed_text(&contents, "bench/weights.safetensors"), "anna", "as they are");
        contents.left_out.sort();
        let left = ["lut-blue", "lut-folder", "notes.txt"].map(|name| format!("bench/{name}: no run has put it there"));
        assert_eq!(contents.left_out, left);
    }

    #[test]
    fn what_frames_are_made_again_by_stays_where_it_is_called_like_a_name() {
        let named = |name: &str| Scrubber::new([(name.to_owned(), format!("/home/{name}"))], []);
        let reload = r#"{"request":{"do":"reload","changed":{"tracker.eye":"left"}},"t_ns":5}"#;
        let weights = r#"{"request":{"do":"weights","weights":"small"},"t_ns":6}"#;
        let file = r#"{"request":{"do":"weights","weights":"/home/anna/small.safetensors"},"t_ns":7}"#;
        let half = r#"{"request":{"do":"sc"#;
        let text = [reload, weights, file, half].join("\n");
        for (name, stays) in [("reload", true), ("small", true), ("anna", false), ("left", true), ("half", false)] {
            let mut contents = Contents::default();
            contents.add_lines(ORDERS, &text, &named(name));
            let packed = packed_text(&contents, ORDERS);
            assert_eq!(packed.contains(&format!("\"{name}\"")), stays, "{name}: {packed}");
            assert_eq!(contents.left_out.is_empty(), !stays, "{name}");
        }
        let run = r#"{"tracker":"mock","scene":{"kind":"files","files":[{"path":"/x/colour","name":"colour.png"}]}}"#;
        let mut contents = Contents::default();
        contents.add_lines(RUN, run, &named("colour"));
        assert_eq!(packed_text(&contents, RUN), run);
        let mut contents = Contents::default();
        contents.add_lines(RUN, run, &named("mock"));
        assert!(packed_text(&contents, RUN).contains("\"USER\"") && contents.left_out.is_empty());
    }

    #[test]
    fn links_in_a_record_are_not_followed() {
        let folder = tempfile::tempdir().unwrap();
        let secret = folder.path().join("secret");
        fs::write(&secret, "private").unwrap();
        let record = folder.path().join("record");
        fs::create_dir(&record).unwrap();
        fs::write(record.join(record::FRAMES), "frame,field\n").unwrap();
        let links =
            ["log.txt", "samples.csv", "tracker.holodraw", "orders.jsonl", "shown_pupil_2.00mm_frame_000001.png"];
        for name in links {
            std::os::unix::fs::symlink(&secret, record.join(name)).unwrap();
        }
        fs::create_dir(record.join("shown_pupil_3.00mm_frame_000002.png")).unwrap();
        let contents = Contents::of_record(&record, true, &Scrubber::default()).unwrap();
        let names: Vec<_> = contents.entries.iter().map(|entry| entry.name.as_str()).collect();
        assert_eq!(names, [record::FRAMES]);
        for name in links.iter().chain(&["shown_pupil_3.00mm_frame_000002.png"]) {
            assert!(contents.left_out.contains(&format!("{name}: no file, as a run writes one")), "{name}");
        }
    }

    #[test]
    fn a_file_that_becomes_shorter_while_it_is_packed_is_told() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x");
        fs::write(&path, "12345").unwrap();
        let archive = |name: &str| {
            let file = File::create(folder.path().join(name)).unwrap();
            Builder::new(GzEncoder::new(file, Compression::fast()))
        };
        let packed = add_file(&mut archive("a"), "x", 0, &path);
        assert!(packed.is_ok_and(|packed| packed == Packed::of("x", b"12345")));
        // Such files say that they have a page and bring fewer bytes.
        let error = add_file(&mut archive("b"), "x", 0, Path::new("/sys/kernel/mm/transparent_hugepage/enabled"));
        assert!(matches!(error, Err(Copy::Read(error)) if error.to_string().contains("something shortens it")));
    }

    #[test]
    fn a_disk_that_takes_no_report_is_told_from_a_file_that_cannot_be_read() {
        let folder = tempfile::tempdir().unwrap();
        let failure = |from: &Path, to: &Path| {
            let mut contents = Contents::default();
            contents.add_file("x", from);
            contents.write(to, &Scrubber::default()).unwrap_err()
        };
        let path = folder.path().join("x");
        fs::write(&path, "12345").unwrap();
        let full = failure(&path, Path::new("/dev/full"));
        assert!(full.to_string().starts_with("cannot write the report: No space left"), "{full}");
        assert_eq!(full.exit, Exit::CannotCreate);
        // A folder opens, and cannot be read.
        let unread = failure(folder.path(), &folder.path().join("report"));
        assert!(unread.to_string().starts_with(&format!("{}: ", folder.path().display())), "{unread}");
        assert_eq!(unread.exit, Exit::NoInput);
    }

    #[test]
    fn a_run_that_broke_off_at_its_start_is_packed_with_its_bench() {
        let folder = tempfile::tempdir().unwrap();
        for path in [BENCH, EARLIER] {
            fs::create_dir(folder.path().join(path)).unwrap();
        }
        fs::write(folder.path().join(record::FRAMES), "").unwrap();
        fs::write(folder.path().join(BENCH).join(RIG), Rig::BUILT_IN_TOML).unwrap();
        for run in [None, Some("{\"holod\":")] {
            if let Some(half) = run {
                fs::write(folder.path().join(RUN), half).unwrap();
            }
            let contents = Contents::of_record(folder.path(), true, &Scrubber::default()).unwrap();
            assert_eq!(packed_text(&contents, "bench/rig.toml"), Rig::BUILT_IN_TOML);
            assert_eq!(contents.left_out[0].contains("broke off before its first frame"), run.is_none());
            assert!(contents.left_out[1].contains(".holod-earlier/: an earlier record"), "{:?}", contents.left_out);
        }
    }

    /// A recording of a stream, which was read in these pieces.
    fn recording(reads: &[&str]) -> Vec<u8> {
        let framed = |mut bytes: Vec<u8>| {
            let mut crc = Crc::new();
            crc.update(&bytes);
            bytes.extend(crc.sum().to_le_bytes());
            bytes
        };
        let header =
            "spec = \"tcp:x:1\"\nprofile = \"holod\"\ndatagrams = false\nt_started_ns = 0\nstarted_unix_ns = 0\n";
        let lengths = [1_u32, header.len() as u32].map(u32::to_le_bytes).concat();
        let mut file = framed([b"HOLOD\x1a\r\n", &lengths[..], header.as_bytes()].concat());
        for read in reads {
            let head = [&(read.len() as u32).to_le_bytes()[..], &[2], &7_i64.to_le_bytes(), &1_u32.to_le_bytes()];
            file.extend(framed([&head.concat()[..], read.as_bytes()].concat()));
        }
        file
    }

    #[test]
    fn a_name_that_two_reads_tore_apart_keeps_the_trackers_bytes_out() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tracker.holodraw");
        for (reads, is_packed) in [(["subject: an", "na\n"], false), (["subject: an", "other\n"], true)] {
            fs::write(&path, recording(&reads)).unwrap();
            let mut contents = Contents::default();
            contents.add_tracker_bytes(&path, &anna()).unwrap();
            assert_eq!(contents.entries.len(), usize::from(is_packed), "{reads:?}: {:?}", contents.left_out);
        }
    }

    #[test]
    fn a_name_that_is_a_word_of_the_format_stays_and_is_told() {
        let scrubber = Scrubber::new([("native".to_owned(), "/home/native".to_owned())], []);
        let mut contents = Contents::default();
        let read = |text: &str| text.contains("native");
        contents.add_checked("a", "fit native in /home/native/x", &scrubber, read);
        assert!(contents.left_out[0].contains("no name in a"), "{:?}", contents.left_out);
        let Content::Bytes(bytes) = &contents.entries[0].content else { panic!() };
        assert_eq!(bytes, b"fit native in ~/x");
    }
}

//! What a run was made of: the files of its bench and its scenes, so that its frames can be made again.

use std::fs::{self, File};
use std::hash::Hasher;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use holod_calibration::rig::{Rig, TableFile, WeightsChoice};
use holod_calibration::{Colour, DisplayGeometry};
use holod_model::scene::{DepthEncoding, Fit, Scene};
use serde::{Deserialize, Serialize};
use toml_edit::{DocumentMut, value};
use twox_hash::XxHash3_64;

use crate::cli::SceneArgs;
use crate::failure::{Exit, Failure};

/// The folder in a record with the rig and the files that it names.
pub(crate) const BENCH: &str = "bench";
/// The rig in it.
pub(crate) const RIG: &str = "rig.toml";
/// The profile of its lasers, and its weights.
const LASERS: &str = "lasers.toml";
const WEIGHTS: &str = "weights.safetensors";
/// How the names of its tables begin: look-up tables and pictures of flatness, each with its colour behind it.
const TABLES: [&str; 2] = ["lut-", "flatness-"];
/// The file that says what a scene is made of, in its folder.
pub(crate) const SCENE: &str = "scene.toml";

/// A file as it was when a run read it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct SourceFile {
    #[serde(serialize_with = "crate::results::path_text")]
    pub path: PathBuf,
    /// What it is called in a report.
    pub name: String,
    pub bytes: u64,
    /// XXH3 of 64 bits of its content, hexadecimal.
    pub xxh3: String,
}

impl SourceFile {
    /// The file at `path`, read to its end.
    ///
    /// # Errors
    /// It cannot be read.
    pub(crate) fn of(path: &Path, name: String) -> io::Result<Self> {
        let path = std::path::absolute(path)?;
        let (bytes, xxh3) = content_xxh3(&mut File::open(&path)?)?;
        Ok(Self { path, name, bytes, xxh3 })
    }
}

/// Length and hash of all that `reader` brings.
///
/// # Errors
/// The reader's.
pub(crate) fn content_xxh3(reader: &mut impl Read) -> io::Result<(u64, String)> {
    let mut hashed = Hashed::new(reader);
    let mut buffer = vec![0; 1 << 18];
    loop {
        match hashed.read(&mut buffer) {
            Ok(0) => return Ok(hashed.finish()),
            Ok(_) => {}
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
}

/// A reader that counts and hashes what is read of it.
pub(crate) struct Hashed<R> {
    reader: R,
    hasher: XxHash3_64,
    bytes: u64,
}

impl<R: Read> Hashed<R> {
    /// Of what `reader` brings from here on.
    pub(crate) fn new(reader: R) -> Self {
        Self { reader, hasher: XxHash3_64::new(), bytes: 0 }
    }

    /// How many bytes there were, and their hash.
    pub(crate) fn finish(self) -> (u64, String) {
        (self.bytes, hash_text(self.hasher.finish()))
    }
}

impl<R: Read> Read for Hashed<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let count = self.reader.read(buffer)?;
        self.hasher.write(&buffer[..count]);
        self.bytes += count as u64;
        Ok(count)
    }
}

/// A hash as records write it.
pub(crate) fn hash_text(hash: u64) -> String {
    format!("{hash:016x}")
}

/// The file that holds weights, where they are in a file.
///
/// # Errors
/// It cannot be read.
pub(crate) fn weights_file(weights: &WeightsChoice) -> Result<Option<SourceFile>, Failure> {
    let WeightsChoice::File(path) = weights else { return Ok(None) };
    SourceFile::of(path, WEIGHTS.into()).map(Some).map_err(Failure::because(Exit::NoInput))
}

/// What a run shows.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub(crate) enum SceneSource {
    /// The scene that holod composes itself.
    BuiltIn,
    /// Pictures of a live feed, which are not kept.
    Feed,
    /// Files, known by their lengths and hashes.
    Files {
        /// How its pictures were brought to the hologram's size.
        fit: Fit,
        /// A `scene.toml` for them, with the names that they have in a report.
        description: String,
        files: Vec<SourceFile>,
    },
}

impl SceneSource {
    /// The scene that `args` name.
    ///
    /// # Errors
    /// Its files cannot be read.
    pub(crate) fn of(args: &SceneArgs, geometry: &DisplayGeometry) -> Result<Self, Failure> {
        let Some(spec) = &args.scene else { return Ok(Self::BuiltIn) };
        if crate::source::is_feed(spec) {
            return Ok(Self::Feed);
        }
        let encoding = args.depth_encoding.as_deref().map(|text| DepthEncoding::parse(text, geometry)).transpose();
        let encoding = encoding.map_err(Failure::because(Exit::Usage))?;
        let scene = Scene::open(spec, encoding).map_err(Failure::because(Exit::NoInput))?;
        let text = scene.file().map(fs::read_to_string).transpose().map_err(Failure::because(Exit::NoInput))?;
        let mut document: DocumentMut = text.unwrap_or_default().parse().map_err(Failure::because(Exit::Data))?;
        if scene.file().is_none() {
            describe_encoding(&mut document, encoding);
        }
        let pictures: Vec<_> = (0..scene.frames()).map(|index| scene.pictures(index)).collect();
        let has_depth_files = pictures.iter().any(|[colour, depth]| colour != depth);
        let mut named = name_pictures(&mut document, "colour", pictures.iter().map(|[colour, _]| colour.clone()));
        match has_depth_files {
            true => {
                named.extend(name_pictures(&mut document, "depth", pictures.iter().map(|[_, depth]| depth.clone())));
            }
            false => drop(document.remove("depth")),
        }
        for key in ["first", "step", "count"] {
            document.remove(key);
        }
        if scene.frames() > 1 {
            document["count"] = value(scene.frames() as i64);
        }
        let read = |(path, name): (PathBuf, String)| {
            let shown = path.display().to_string();
            SourceFile::of(&path, name).map_err(|error| Failure::new(Exit::NoInput, format!("{shown}: {error}")))
        };
        let files = named.into_iter().map(read).collect::<Result<_, _>>()?;
        Ok(Self::Files { fit: args.fit.into(), description: document.to_string(), files })
    }
}

/// Writes the encoding that was named beside two files as a scene file has it.
fn describe_encoding(document: &mut DocumentMut, encoding: Option<DepthEncoding>) {
    let name = match encoding {
        None => return,
        Some(DepthEncoding::Metres) => "metres",
        Some(DepthEncoding::Millimetres) => "millimetres",
        Some(DepthEncoding::Dioptres) => "dioptres",
        Some(DepthEncoding::NormalisedDioptres { far_dpt, near_dpt }) => {
            document["far_dpt"] = value(far_dpt);
            document["near_dpt"] = value(near_dpt);
            "normalised_dioptres"
        }
    };
    document["depth_encoding"] = value(name);
}

/// Writes the names under which one part of a scene's pictures goes into a report; each file with its name.
fn name_pictures(
    document: &mut DocumentMut,
    key: &str,
    paths: impl Iterator<Item = PathBuf>,
) -> Vec<(PathBuf, String)> {
    let mut paths: Vec<_> = paths.collect();
    let ending = extension(&paths[0]);
    paths.dedup();
    if let [path] = &paths[..] {
        let name = format!("{key}{ending}");
        document[key] = value(&name);
        return vec![(path.clone(), name)];
    }
    document[key] = value(format!("{key}-{{:06}}{ending}"));
    paths.into_iter().enumerate().map(|(index, path)| (path, format!("{key}-{index:06}{ending}"))).collect()
}

/// Whether a record keeps a file of the bench, its rig or what the rig names, under this name.
pub(crate) fn is_of_bench(name: &str) -> bool {
    is_weights(name) || [RIG, LASERS].contains(&name) || is_table(name)
}

/// Whether a record calls a table so: what it is, its colour and its file's ending.
fn is_table(name: &str) -> bool {
    let ending = extension(Path::new(name));
    let stem = name.strip_suffix(&ending).unwrap_or(name);
    let colour = TABLES.iter().find_map(|table| stem.strip_prefix(table));
    colour.is_some_and(|named| Colour::ALL.iter().any(|colour| colour.name() == named))
}

/// Whether a file of the bench with this name holds its weights.
pub(crate) fn is_weights(name: &str) -> bool {
    name == WEIGHTS
}

/// The files that [`keep_bench`] has put into [`BENCH`] of `folder`, by their names there.
///
/// # Errors
/// The folder cannot be read.
pub(super) fn names_of_bench(folder: &Path) -> io::Result<Vec<String>> {
    let entries = match fs::read_dir(folder.join(BENCH)) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        entries => entries?,
    };
    let mut names = Vec::new();
    for entry in entries {
        names.extend(entry?.file_name().into_string().ok().filter(|name| is_of_bench(name)));
    }
    names.sort();
    Ok(names)
}

/// The ending of a file's name with its dot, where it is a plain one.
fn extension(path: &Path) -> String {
    let extension = path.extension().and_then(|extension| extension.to_str()).unwrap_or_default();
    let is_plain = (1..=8).contains(&extension.len()) && extension.bytes().all(|byte| byte.is_ascii_alphanumeric());
    if is_plain { format!(".{extension}") } else { String::new() }
}

/// Copies the rig at `config` (the built-in one where there is none) and the files that it names into the folder
/// [`BENCH`] of `folder`, with names that hold there. `rig` is the rig as it runs: with its weights.
///
/// # Errors
/// A file cannot be read or written, or the rig file is another one than what runs.
pub(super) fn keep_bench(folder: &Path, config: Option<&Path>, rig: &Rig) -> Result<(), Failure> {
    let bench = folder.join(BENCH);
    let cannot = |path: &Path, error: io::Error| {
        Failure::new(Exit::CannotCreate, format!("cannot record {}: {error}", path.display()))
    };
    fs::create_dir_all(&bench).map_err(|error| cannot(&bench, error))?;
    let keep = |path: &Path, name: String| {
        fs::copy(path, bench.join(&name)).map_err(|error| cannot(path, error))?;
        Ok::<_, Failure>(value(name))
    };
    let text = match config {
        None => Rig::BUILT_IN_TOML.to_owned(),
        Some(path) => fs::read_to_string(path).map_err(|error| cannot(path, error))?,
    };
    let mut document: DocumentMut = text.parse().map_err(Failure::because(Exit::Config))?;
    for colour in Colour::ALL {
        for (key, what, files) in [
            ("lut_file", TABLES[0], &rig.provenance.lut_files),
            ("flatness_file", TABLES[1], &rig.provenance.flatness_files),
        ] {
            if let Some(TableFile { path, .. }) = &files[colour] {
                document["panel"][key][colour.name()] = keep(path, format!("{what}{colour}{}", extension(path)))?;
            }
        }
    }
    if let Some(path) = &rig.provenance.laser_profile_file {
        document["lasers"]["profile_file"] = keep(path, LASERS.into())?;
    }
    let (key, other, named) = match (&rig.model.weights, rig.model.weights.built_in_name()) {
        (WeightsChoice::File(path), _) => ("weights_file", "network", keep(path, WEIGHTS.into())?),
        (_, Some(name)) => ("network", "weights_file", value(name)),
        (_, None) => return Err(Failure::new(Exit::Software, "weights without a name")),
    };
    let model = document.entry("model").or_insert(toml_edit::table());
    model[key] = named;
    if let Some(model) = model.as_table_like_mut() {
        model.remove(other);
    }
    let path = bench.join(RIG);
    fs::write(&path, document.to_string()).map_err(|error| cannot(&path, error))?;
    let kept = Rig::load(&path).map_err(Failure::because(Exit::Software))?;
    if (&kept.panel, &kept.geometry) == (&rig.panel, &rig.geometry) {
        return Ok(());
    }
    Err(Failure::new(Exit::Config, "the rig file was changed while holod started: start it again"))
}

#[cfg(test)]
mod tests {
    use std::ffi::OsStr;
    use std::os::unix::ffi::OsStrExt;

    use super::*;
    use crate::cli::FitArg;

    fn files(folder: &Path, names: &[&str]) {
        for name in names {
            let path = folder.join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, name).unwrap();
        }
    }

    fn source(scene: &str, depth_encoding: Option<&str>) -> SceneSource {
        let args = SceneArgs {
            scene: Some(scene.to_owned()),
            depth_encoding: depth_encoding.map(str::to_owned),
            fit: FitArg::Cover,
            resolution: None,
        };
        SceneSource::of(&args, &DisplayGeometry::DEFAULT).unwrap()
    }

    /// What the scene is made of where its files have the names that they have in a report.
    fn relocated(source: &SceneSource) -> (Scene, Vec<String>) {
        let SceneSource::Files { fit, description, files } = source else { panic!("{source:?}") };
        assert_eq!(*fit, Fit::Cover);
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join(SCENE), description).unwrap();
        let scene = Scene::open(folder.path().to_str().unwrap(), None).unwrap();
        let named = |path: &PathBuf| path.file_name().unwrap().to_string_lossy().into_owned();
        let of_scene: Vec<_> = (0..scene.frames()).flat_map(|index| scene.pictures(index)).map(|p| named(&p)).collect();
        assert!(of_scene.iter().all(|name| files.iter().any(|file| file.name == *name)), "{of_scene:?}");
        (scene, files.iter().map(|file| file.name.clone()).collect())
    }

    #[test]
    fn a_pair_becomes_a_scene_with_its_encoding() {
        let folder = tempfile::tempdir().unwrap();
        files(folder.path(), &["a b.JPG", "d.png"]);
        let at = |name: &str| folder.path().join(name).display().to_string();
        let pair = source(&format!("{},{}", at("a b.JPG"), at("d.png")), Some("normalised_dioptres:0.25,2.5"));
        let (_, names) = relocated(&pair);
        assert_eq!(names, ["colour.JPG", "depth.png"]);
        let SceneSource::Files { description, files, .. } = &pair else { panic!() };
        for key in ["far_dpt = 0.25", "near_dpt = 2.5", "depth_encoding = \"normalised_dioptres\""] {
            assert!(description.contains(key), "{description}");
        }
        assert_eq!((files[1].bytes, files[1].path.clone()), (5, folder.path().join("d.png")));
        assert_eq!(files[1].xxh3, content_xxh3(&mut &b"d.png"[..]).unwrap().1);
        assert_ne!(files[1].xxh3, content_xxh3(&mut &b"e.png"[..]).unwrap().1);

        let no_text = folder.path().join(OsStr::from_bytes(b"d\xff.png"));
        fs::write(&no_text, "d.png").unwrap();
        let json = serde_json::to_value(SourceFile::of(&no_text, "depth.png".into()).unwrap()).unwrap();
        assert!(json["path"].as_str().unwrap().ends_with("/d\u{fffd}.png"), "{json}");
    }

    #[test]
    fn a_sequence_keeps_its_order_wherever_its_files_were() {
        let folder = tempfile::tempdir().unwrap();
        files(folder.path(), &["else/c7.exr", "else/c9.exr", "here/x"]);
        let text = "colour = \"../else/c{}.exr\"\ndepth_encoding = \"metres\"\nfirst = 7\nstep = 2\nfps = 12.5\n";
        fs::write(folder.path().join("here/scene.toml"), text).unwrap();
        let (scene, names) = relocated(&source(folder.path().join("here").to_str().unwrap(), None));
        assert_eq!(names, ["colour-000000.exr", "colour-000001.exr"]);
        assert_eq!((scene.frames(), scene.fps()), (2, Some(12.5)));
        assert_eq!(scene.pictures(1)[0], scene.pictures(1)[1], "colour and depth are one file");
    }

    #[test]
    fn the_built_in_scene_and_a_feed_have_no_files() {
        assert_eq!(source("feed", None), SceneSource::Feed);
        assert_eq!(SceneSource::of(&SceneArgs::default(), &DisplayGeometry::DEFAULT).unwrap(), SceneSource::BuiltIn);
        assert_eq!(extension(Path::new("a.tar.g\u{e4}")), "");
    }

    #[test]
    fn a_bench_is_kept_with_its_files_and_means_the_same() {
        let folder = tempfile::tempdir().unwrap();
        let record = folder.path().join("record");
        let lut: String = (0..256).map(|level| format!("{level},{}\n", f64::from(level) * 0.0246)).collect();
        fs::create_dir(folder.path().join("luts")).unwrap();
        fs::write(folder.path().join("luts/green"), lut).unwrap();
        fs::write(folder.path().join("w.safetensors"), "weights").unwrap();
        let text = Rig::BUILT_IN_TOML
            .replace("settle_ms", "lut_file = { green = \"luts/green\" } # measured\nsettle_ms")
            .replace("green = 1.9921875, ", "")
            .replace("network = \"standard\"", "weights_file = \"w.safetensors\"");
        fs::create_dir(&record).unwrap();
        let config = folder.path().join("lab.toml");
        fs::write(&config, text).unwrap();
        let rig = Rig::load(&config).unwrap();
        keep_bench(&record, Some(&config), &rig).unwrap();
        fs::remove_dir_all(folder.path().join("luts")).unwrap();
        let kept = Rig::load(&record.join(BENCH).join(RIG)).unwrap();
        assert_eq!((&kept.panel, &kept.geometry, &kept.lasers), (&rig.panel, &rig.geometry, &rig.lasers));
        assert_eq!(kept.model.weights, WeightsChoice::File(record.join(BENCH).join("weights.safetensors")));
        assert!(fs::read_to_string(record.join(BENCH).join(RIG)).unwrap().contains("# measured"));

        let named = Rig {
            model: holod_calibration::rig::Model { weights: WeightsChoice::Fast, ..rig.model.clone() },
            ..Rig::default()
        };
        for name in ["other", "third"] {
            fs::create_dir(folder.path().join(name)).unwrap();
        }
        keep_bench(&folder.path().join("other"), None, &named).unwrap();
        let kept = Rig::load(&folder.path().join("other").join(BENCH).join(RIG)).unwrap();
        assert_eq!(kept.model.weights, WeightsChoice::Fast);
        // The file says something else than what runs.
        let failure = keep_bench(&folder.path().join("third"), None, &rig).unwrap_err();
        assert_eq!(failure.exit, Exit::CannotCreate, "{failure}");

        // What somebody else has put there, under names that a run does not give.
        for name in ["notes.txt", "lut-notes.csv", "lut-green-old.csv", "flatness-measured-2026.png", "lut-green."] {
            fs::write(record.join(BENCH).join(name), "mine").unwrap();
        }
        assert_eq!(names_of_bench(&record).unwrap(), ["lut-green", RIG, WEIGHTS]);
        assert!(names_of_bench(&folder.path().join("absent")).unwrap().is_empty());
    }
}

//! Shards: scenes with focal stacks that `holod-scenes` writes, one safetensors file for each.
//!
//! `scene_000123.safetensors` holds `image` F16 [3, H, W] (linear light, pinhole), `depth` F32 [H, W] (normalised, 0
//! far, 1 near) and `stack_0` … `stack_n` F16 [planes, 3, H, W] (linear light, one for each pupil). Its metadata are
//! strings: `format` = "holod-scene-1", `generator` (the scenes that `holod-scenes` draws are the same within one
//! generation), `kind`, `seed`, `index`, `pupils_mm` and `focus_dpt` (JSON lists, which other scenes of the folder need
//! not share), those of the bench on which the scene is seen: `far_dpt`, `near_dpt`, `pixel_angle_rad`,
//! `wavelengths_nm` (JSON list), `pixel_pitch_um`; `rays`, and `traced_by`: `cpu` or a device's name.
//!
//! A shard's header is checked when it is opened; its pixels are read when they are asked for, one stack at a time.

use std::fs::{self, File};
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use half::f16;
use holod_calibration::{Dioptres, DisplayGeometry, PupilDiameter, Resolution};
use safetensors::Dtype;
use safetensors::tensor::Metadata;

use crate::{LinearImage, RgbdFrame};

/// The `format` that a shard's metadata names.
pub const FORMAT: &str = "holod-scene-1";
/// Longer headers are refused: a shard's takes some kilobytes.
const LONGEST_HEADER_BYTES: u64 = 1 << 20;
/// Relative difference below which two optical figures are the same.
const OPTICS_TOLERANCE: f64 = 1e-4;
/// Pupils outside this range are no pupils.
const PUPILS_MM: std::ops::RangeInclusive<f64> = 0.1..=100.0;

/// What a random scene is for. The kinds never share a scene: each has a seed space of its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SceneKind {
    /// For training, with none of the textures and ranges that [`Self::Test`] has for itself.
    Train,
    /// For testing: families of textures, and ranges, that no training scene has.
    Test,
    /// The refocus test: fine marks on a near and a far card, at 7/8 and 7/80 of the depth range in dioptres, which are
    /// 2.5 and 0.25 on the default bench; dark on bright where the index is even, bright on dark where it is odd.
    Cards,
    /// What black stays: bright marks in the lower half of a picture that is exactly black else, as near and as far as
    /// the cards. By the index in turn dots of 1 to 3 px, thin lines, many of them diagonal, and stars.
    Marks,
}

impl SceneKind {
    /// The name in files and on the command line.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Train => "train",
            Self::Test => "test",
            Self::Cards => "cards",
            Self::Marks => "marks",
        }
    }
}

/// What is bright on the black ground of a scene of [`SceneKind::Marks`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Marks {
    /// Discs, from a pixel to nine.
    Dots,
    /// Strokes of 1 to 2 px, 14 px long.
    Lines,
    /// Soft points of 2 to 100 % of the light.
    Stars,
}

impl Marks {
    /// Every kind, in the order in which scenes take turns.
    pub const ALL: [Self; 3] = [Self::Dots, Self::Lines, Self::Stars];

    /// Those of the scene with this number.
    pub fn of_index(index: u64) -> Self {
        Self::ALL[(index % 3) as usize]
    }

    /// Its name in tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::Dots => "dots",
            Self::Lines => "lines",
            Self::Stars => "stars",
        }
    }
}

/// A shard that cannot be used.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "the messages say what the fields are")]
pub enum SceneShardError {
    /// A folder or file cannot be read.
    #[error("{path}: {source}; expected scenes that `holod-scenes generate` wrote", path = path.display())]
    Read {
        /// The folder or file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The folder holds no shard.
    #[error(
        "{folder}: found no scene_*.safetensors; write some with `holod-scenes generate --out {folder}`",
        folder = folder.display()
    )]
    Empty { folder: PathBuf },
    /// The file is cut short or no safetensors file at all.
    #[error(
        "{path}: found {found}; expected a whole safetensors file: delete it and run `holod-scenes generate` again",
        path = path.display()
    )]
    Damaged {
        path: PathBuf,
        /// What is wrong with it.
        found: String,
    },
    /// A tensor or a metadata entry is missing or is not what it should be.
    #[error("{path}: {what} is {found}; expected {expected}", path = path.display())]
    Content {
        path: PathBuf,
        /// The tensor or metadata key.
        what: String,
        found: String,
        /// What was expected, and what to do.
        expected: String,
    },
}

/// The shards of `folder` by name, of which there is one at least.
///
/// # Errors
/// [`SceneShardError::Empty`] where there is none, [`SceneShardError::Read`] where the folder cannot be read.
pub fn files_of(folder: &Path) -> Result<Vec<PathBuf>, SceneShardError> {
    let unreadable = |source| SceneShardError::Read { path: folder.to_owned(), source };
    let mut paths = Vec::new();
    for entry in fs::read_dir(folder).map_err(unreadable)? {
        let path = entry.map_err(unreadable)?.path();
        let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        if name.starts_with("scene_") && name.ends_with(".safetensors") {
            paths.push(path);
        }
    }
    if paths.is_empty() {
        return Err(SceneShardError::Empty { folder: folder.to_owned() });
    }
    paths.sort();
    Ok(paths)
}

/// One scene on disk, its header checked.
#[derive(Debug)]
pub struct SceneShard {
    path: PathBuf,
    header: Metadata,
    /// Where the tensors begin in the file.
    data_start: u64,
    resolution: Resolution,
    kind: String,
    seed: u64,
    index: u64,
    pupils: Vec<PupilDiameter>,
    focuses: Vec<Dioptres>,
}

impl SceneShard {
    /// Opens the first `limit` shards of `folder` by name, all where there is no limit.
    ///
    /// # Errors
    /// [`SceneShardError::Empty`] where there is none, and what [`open`](Self::open) finds in the first bad one.
    pub fn open_folder(
        folder: &Path,
        limit: Option<usize>,
        geometry: &DisplayGeometry,
    ) -> Result<Vec<Self>, SceneShardError> {
        let paths = files_of(folder)?;
        paths.iter().take(limit.unwrap_or(usize::MAX)).map(|path| Self::open(path, geometry)).collect()
    }

    /// Opens the shard at `path`, which must have been rendered for `geometry`'s depth range and pixel angle.
    ///
    /// # Errors
    /// [`SceneShardError`] for whatever is wrong with the file, its header or its optics.
    pub fn open(path: &Path, geometry: &DisplayGeometry) -> Result<Self, SceneShardError> {
        let (header, data_start) = read_header(path)?;
        let entries = Entries { path, header: &header };
        entries.require_text("format", FORMAT, "write the scenes with this version's `holod-scenes`")?;
        let numbers = |key| entries.numbers(key);
        let pupils_mm = numbers("pupils_mm")?;
        let focus_dpt = numbers("focus_dpt")?;
        if let Some(pupil_mm) = pupils_mm.iter().find(|&&mm| !PUPILS_MM.contains(&mm)) {
            return Err(entries.error("metadata `pupils_mm`", format!("{pupil_mm}"), "diameters of 0.1 to 100 mm"));
        }
        for (key, expected) in [
            ("far_dpt", geometry.depth_far.0),
            ("near_dpt", geometry.depth_near.0),
            ("pixel_angle_rad", geometry.pixel_angle_rad()),
        ] {
            let found: f64 = entries.parsed(key, "a number")?;
            let difference = (found - expected).abs();
            if difference.is_nan() || difference > OPTICS_TOLERANCE * expected.abs().max(1e-3) {
                let expected = format!("{expected}, the bench's: use scenes that were rendered for this bench");
                return Err(entries.error(&format!("metadata `{key}`"), found.to_string(), &expected));
            }
        }
        let resolution = match header.info("depth").map(|info| info.shape.as_slice()) {
            Some(&[height, width]) if width > 0 && height > 0 => Resolution { width, height },
            Some(shape) => return Err(entries.error("tensor `depth`", format!("{shape:?}"), "[height, width]")),
            None => return Err(entries.error("tensor `depth`", "absent".into(), "[height, width]")),
        };
        let Resolution { width, height } = resolution;
        entries.require_tensor("depth", Dtype::F32, &[height, width])?;
        entries.require_tensor("image", Dtype::F16, &[3, height, width])?;
        for number in 0..pupils_mm.len() {
            entries.require_tensor(&format!("stack_{number}"), Dtype::F16, &[focus_dpt.len(), 3, height, width])?;
        }
        let kind = entries.text("kind")?.to_owned();
        let seed = entries.parsed("seed", "the number that scenes were drawn with")?;
        let index = entries.parsed("index", "a scene's number")?;
        Ok(Self {
            path: path.to_owned(),
            data_start,
            resolution,
            kind,
            seed,
            index,
            pupils: pupils_mm.into_iter().map(|pupil_mm| PupilDiameter::from_mm(pupil_mm as f32)).collect(),
            focuses: focus_dpt.into_iter().map(Dioptres).collect(),
            header,
        })
    }

    /// Where the shard lies.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Pixels of each picture.
    pub fn resolution(&self) -> Resolution {
        self.resolution
    }

    /// What the scene is for: `train`, `test`, `cards` or `marks`.
    pub fn kind(&self) -> &str {
        &self.kind
    }

    /// The seed that the scene was drawn with.
    pub fn seed(&self) -> u64 {
        self.seed
    }

    /// The scene's number among those of its seed.
    pub fn index(&self) -> u64 {
        self.index
    }

    /// The pupils that there are stacks for, in the stacks' order.
    pub fn pupils(&self) -> &[PupilDiameter] {
        &self.pupils
    }

    /// What the planes of each stack are focused at.
    pub fn focuses(&self) -> &[Dioptres] {
        &self.focuses
    }

    /// The scene as a network reads it: the square root of what a pinhole sees, and depth.
    ///
    /// # Errors
    /// [`SceneShardError`] where the file cannot be read or holds a number that is not finite.
    pub fn frame(&self) -> Result<RgbdFrame, SceneShardError> {
        let image = half_values(&self.bytes("image")?);
        let depth: Vec<f32> =
            self.bytes("depth")?.as_chunks().0.iter().map(|&bytes| f32::from_le_bytes(bytes)).collect();
        self.check_finite("image", &image)?;
        self.check_finite("depth", &depth)?;
        Ok(RgbdFrame {
            resolution: self.resolution,
            amplitude: image.into_iter().map(|light| light.max(0.0).sqrt()).collect(),
            depth_normalised: depth,
        })
    }

    /// What an eye with pupil number `pupil_index` sees, one picture for each of [`focuses`](Self::focuses).
    ///
    /// # Errors
    /// As [`frame`](Self::frame).
    ///
    /// # Panics
    /// Where there are not as many pupils.
    pub fn stack(&self, pupil_index: usize) -> Result<Vec<LinearImage>, SceneShardError> {
        assert!(pupil_index < self.pupils.len(), "the shard has {} stacks", self.pupils.len());
        let name = format!("stack_{pupil_index}");
        let values = half_values(&self.bytes(&name)?);
        self.check_finite(&name, &values)?;
        let picture = |pixels: &[f32]| LinearImage { resolution: self.resolution, pixels: pixels.to_vec() };
        Ok(values.chunks_exact(3 * self.resolution.pixels()).map(picture).collect())
    }

    fn bytes(&self, name: &str) -> Result<Vec<u8>, SceneShardError> {
        let (begin, end) =
            self.header.info(name).expect("the tensors were checked when the shard was opened").data_offsets;
        let mut bytes = vec![0; end - begin];
        File::open(&self.path)
            .and_then(|mut file| {
                file.seek(SeekFrom::Start(self.data_start + begin as u64))?;
                file.read_exact(&mut bytes)
            })
            .map_err(|source| SceneShardError::Read { path: self.path.clone(), source })?;
        Ok(bytes)
    }

    fn check_finite(&self, name: &str, values: &[f32]) -> Result<(), SceneShardError> {
        match values.iter().position(|value| !value.is_finite()) {
            None => Ok(()),
            Some(index) => Err(SceneShardError::Content {
                path: self.path.clone(),
                what: format!("tensor `{name}`"),
                found: format!("{} at index {index}", values[index]),
                expected: "finite numbers: delete the file and run `holod-scenes generate` again".into(),
            }),
        }
    }
}

fn half_values(bytes: &[u8]) -> Vec<f32> {
    bytes.as_chunks().0.iter().map(|&pair| f16::from_le_bytes(pair).to_f32()).collect()
}

/// A safetensors file's header, and where its tensors begin; the file has the length that the header says.
fn read_header(path: &Path) -> Result<(Metadata, u64), SceneShardError> {
    let unreadable = |source| SceneShardError::Read { path: path.to_owned(), source };
    let damaged = |found: String| SceneShardError::Damaged { path: path.to_owned(), found };
    let mut file = File::open(path).map_err(unreadable)?;
    let length = file.metadata().map_err(unreadable)?.len();
    let mut prefix = [0; 8];
    if length < prefix.len() as u64 {
        return Err(damaged(format!("{length} bytes")));
    }
    file.read_exact(&mut prefix).map_err(unreadable)?;
    let header_length = u64::from_le_bytes(prefix);
    if header_length > LONGEST_HEADER_BYTES.min(length - 8) {
        return Err(damaged(format!("a header of {header_length} bytes in a file of {length}")));
    }
    let mut text = vec![0; header_length as usize];
    file.read_exact(&mut text).map_err(unreadable)?;
    let header: Metadata =
        serde_json::from_slice(&text).map_err(|error| damaged(format!("a header that cannot be used ({error})")))?;
    let data_start = 8 + header_length;
    let expected = data_start + header.data_len() as u64;
    if length != expected {
        return Err(damaged(format!("{length} bytes where its header says {expected}")));
    }
    Ok((header, data_start))
}

/// The header's entries with the path that errors give it.
struct Entries<'a> {
    path: &'a Path,
    header: &'a Metadata,
}

impl Entries<'_> {
    fn error(&self, what: &str, found: String, expected: &str) -> SceneShardError {
        SceneShardError::Content { path: self.path.to_owned(), what: what.into(), found, expected: expected.into() }
    }

    fn text(&self, key: &str) -> Result<&str, SceneShardError> {
        let entry = self.header.metadata().as_ref().and_then(|entries| entries.get(key));
        entry.map(String::as_str).ok_or_else(|| {
            self.error(&format!("metadata `{key}`"), "absent".into(), "an entry that `holod-scenes` writes")
        })
    }

    fn require_text(&self, key: &str, expected: &str, remedy: &str) -> Result<(), SceneShardError> {
        let found = self.text(key)?;
        if found == expected {
            return Ok(());
        }
        Err(self.error(&format!("metadata `{key}`"), format!("\"{found}\""), &format!("\"{expected}\": {remedy}")))
    }

    fn parsed<T: serde::de::DeserializeOwned>(&self, key: &str, expected: &str) -> Result<T, SceneShardError> {
        let text = self.text(key)?;
        serde_json::from_str(text)
            .map_err(|_| self.error(&format!("metadata `{key}`"), format!("\"{text}\""), expected))
    }

    fn numbers(&self, key: &str) -> Result<Vec<f64>, SceneShardError> {
        const EXPECTED: &str = "a JSON list of at least one number";
        let numbers: Vec<f64> = self.parsed(key, EXPECTED)?;
        if numbers.is_empty() {
            return Err(self.error(&format!("metadata `{key}`"), "an empty list".into(), EXPECTED));
        }
        Ok(numbers)
    }

    fn require_tensor(&self, name: &str, dtype: Dtype, shape: &[usize]) -> Result<(), SceneShardError> {
        let found = match self.header.info(name) {
            Some(info) if info.dtype == dtype && info.shape == shape => return Ok(()),
            Some(info) => format!("{:?} {:?}", info.dtype, info.shape),
            None => "absent".into(),
        };
        Err(self.error(&format!("tensor `{name}`"), found, &format!("{dtype:?} {shape:?}")))
    }
}

#[cfg(test)]
mod tests {
    use holod_calibration::write_atomically;

    use super::*;
    use crate::safetensors_file::{self, Tensor};

    const BENCH: DisplayGeometry = DisplayGeometry::DEFAULT;
    const SIZE: Resolution = Resolution { width: 32, height: 24 };

    /// A folder with one small shard of two pupils and two planes, whose values are all different.
    fn written() -> (tempfile::TempDir, PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scene_000005.safetensors");
        let count = 2 * 3 * SIZE.pixels();
        let halves = |first: usize, count: usize| -> Vec<u8> {
            (first..first + count).flat_map(|n| f16::from_f32(n as f32 * 1e-4).to_le_bytes()).collect()
        };
        let stacks = [halves(0, count), halves(count, count)];
        let image = halves(2 * count, count / 2);
        let depth: Vec<u8> = (0..SIZE.pixels()).flat_map(|n| (n as f32 * 1e-3).to_le_bytes()).collect();
        let tensor = |name: &str, dtype, shape: &[usize], bytes| Tensor {
            name: name.to_owned(),
            dtype,
            shape: shape.to_vec(),
            bytes,
        };
        let Resolution { width, height } = SIZE;
        let tensors = vec![
            tensor("image", Dtype::F16, &[3, height, width], &image[..]),
            tensor("depth", Dtype::F32, &[height, width], &depth),
            tensor("stack_0", Dtype::F16, &[2, 3, height, width], &stacks[0]),
            tensor("stack_1", Dtype::F16, &[2, 3, height, width], &stacks[1]),
        ];
        let focus_dpt = [BENCH.depth_far.0, BENCH.depth_near.0];
        let metadata = [
            ("format", FORMAT.to_owned()),
            ("kind", SceneKind::Test.name().to_owned()),
            ("seed", "3".to_owned()),
            ("index", "5".to_owned()),
            ("pupils_mm", "[1.5, 4.0]".to_owned()),
            ("focus_dpt", format!("{focus_dpt:?}")),
            ("far_dpt", BENCH.depth_far.0.to_string()),
            ("near_dpt", BENCH.depth_near.0.to_string()),
            ("pixel_angle_rad", BENCH.pixel_angle_rad().to_string()),
        ];
        let metadata = metadata.map(|(key, value)| (key.to_owned(), value)).into();
        write_atomically(&path, |out| safetensors_file::write(out, tensors, &metadata)).unwrap();
        (folder, path)
    }

    /// The message of what is wrong once `old` is `new` in the header, which both leave as long as it was.
    fn message_with(old: &str, new: &str) -> String {
        let (_folder, path) = written();
        let mut bytes = fs::read(&path).unwrap();
        let at = bytes.windows(old.len()).position(|window| window == old.as_bytes()).unwrap();
        assert_eq!(old.len(), new.len());
        bytes[at..at + new.len()].copy_from_slice(new.as_bytes());
        fs::write(&path, bytes).unwrap();
        let message = SceneShard::open(&path, &BENCH).unwrap_err().to_string();
        assert!(message.contains(&path.display().to_string()), "{message}");
        message
    }

    #[test]
    fn what_was_written_is_read() {
        let (folder, path) = written();
        let shard = SceneShard::open_folder(folder.path(), None, &BENCH).unwrap().remove(0);
        assert_eq!((shard.path(), shard.resolution(), shard.kind(), shard.index()), (path.as_path(), SIZE, "test", 5));
        assert_eq!(shard.pupils(), [1.5, 4.0].map(PupilDiameter::from_mm));
        assert_eq!(shard.focuses(), [BENCH.depth_far, BENCH.depth_near]);

        let bytes = fs::read(&path).unwrap();
        let tensors = safetensors::SafeTensors::deserialize(&bytes).unwrap();
        let tensor = |name: &str| half_values(tensors.tensor(name).unwrap().data());
        let frame = shard.frame().unwrap();
        let squares = frame.amplitude.iter().map(|amplitude| amplitude * amplitude);
        assert!(squares.zip(tensor("image")).all(|(square, light)| (square - light).abs() < 1e-6));
        assert!(frame.depth_normalised.iter().any(|&depth| depth > 0.0));
        for pupil in 0..2 {
            let pixels: Vec<f32> = shard.stack(pupil).unwrap().into_iter().flat_map(|plane| plane.pixels).collect();
            assert_eq!(pixels, tensor(&format!("stack_{pupil}")));
        }
        assert_ne!(shard.stack(0).unwrap(), shard.stack(1).unwrap());
    }

    #[test]
    fn a_cut_or_foreign_file_is_damaged() {
        let (_folder, path) = written();
        let whole = fs::read(&path).unwrap();
        let mut longer = whole.clone();
        longer.push(0);
        for bytes in [&whole[..0], &whole[..7], &whole[..60], &whole[..whole.len() - 1], &longer, &[0x7f; 100][..]] {
            fs::write(&path, bytes).unwrap();
            let error = SceneShard::open(&path, &BENCH).unwrap_err();
            assert!(matches!(error, SceneShardError::Damaged { .. }), "{} bytes: {error}", bytes.len());
            assert!(error.to_string().contains("holod-scenes generate"), "{error}");
        }
    }

    #[test]
    fn each_wrong_entry_is_named_with_what_was_expected() {
        let says = |message: String, words: &[&str]| {
            assert!(words.iter().all(|word| message.contains(word)), "{words:?} in {message}");
        };
        says(message_with("holod-scene-1", "holod-scene-9"), &["format", "holod-scene-9", "holod-scene-1"]);
        says(message_with("\"near_dpt\":\"2", "\"near_dpt\":\"3"), &["near_dpt", "3.857", "2.857", "this bench"]);
        says(message_with("pixel_angle_rad", "pixel_angle_deg"), &["pixel_angle_rad", "absent"]);
        says(message_with("\"[1.5, 4.0]\"", "\"[-1.5, 4.]\""), &["pupils_mm", "list"]);
        says(message_with("\"[1.5, 4.0]\"", "\"[-1.5, 40]\""), &["pupils_mm", "-1.5", "0.1 to 100"]);
        says(message_with("\"[1.5, 4.0]\"", "\"[1, 9e300]\""), &["pupils_mm", "9000", "0.1 to 100"]);
        says(message_with("\"[1.5, 4.0]\"", "\"[1.5,4,4.]\""), &["pupils_mm", "[1.5,4,4.]"]);
        says(message_with("\"[1.5, 4.0]\"", "\"[1, 4, 2 ]\""), &["stack_2", "absent", "F16 [2, 3, 24, 32]"]);
        says(message_with("\"stack_1\"", "\"stack_7\""), &["stack_1", "absent"]);
        says(message_with("\"image\"", "\"imago\""), &["image", "absent", "F16 [3, 24, 32]"]);
        says(message_with("[3,24,32]", "[3,32,24]"), &["image", "[3, 32, 24]", "[3, 24, 32]"]);
        says(message_with("\"depth\"", "\"depht\""), &["depth", "absent"]);
    }

    #[test]
    fn a_number_that_is_not_finite_is_found_when_it_is_read() {
        let (_folder, path) = written();
        let mut bytes = fs::read(&path).unwrap();
        let last = bytes.len() - 2;
        bytes[last..].copy_from_slice(&f16::NAN.to_le_bytes());
        fs::write(&path, bytes).unwrap();
        let shard = SceneShard::open(&path, &BENCH).unwrap();
        let index = 2 * 3 * SIZE.pixels() - 1;
        let message = shard.stack(1).unwrap_err().to_string();
        assert!(message.contains("stack_1") && message.contains(&format!("NaN at index {index}")), "{message}");
        assert!(shard.stack(0).is_ok() && shard.frame().is_ok());
    }

    #[test]
    fn a_folder_without_scenes_says_how_to_make_some() {
        let folder = tempfile::tempdir().unwrap();
        let open = |path: &Path| SceneShard::open_folder(path, None, &BENCH).unwrap_err();
        let message = open(folder.path()).to_string();
        assert!(message.contains("scene_*.safetensors") && message.contains("holod-scenes generate"), "{message}");
        assert!(matches!(open(&folder.path().join("absent")), SceneShardError::Read { .. }));
        let (folder, _) = written();
        assert_eq!(SceneShard::open_folder(folder.path(), Some(1), &BENCH).unwrap().len(), 1);
    }
}

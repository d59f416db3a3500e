//! Writes shards, one file for each scene with its picture, depth and focal stacks (format in
//! [`holod_model::scene_shard`]).
//!
//! While a shard is made, memory holds its stacks as F16 and, once, the F32 sums of one: at 1920x1080 12 MB and 25 MB a
//! plane. It is written from there, and read for a sheet, without a copy of the whole.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};

use half::f16;
use holod_calibration::{Dioptres, DisplayGeometry, PupilDiameter, Resolution, write_atomically};
use holod_model::gpu::GpuError;
use holod_model::safetensors_file::{self, Tensor};
use holod_model::scene_shard::{FORMAT, SceneKind};
use safetensors::tensor::{Dtype, Metadata};

use super::random::{Random, mix, stream};
use super::{Scene, Tracer, generator};

/// Blur over the depth volume, in panel pixels, that scenes are made for: less is hardly any, and more would be as
/// large as the objects.
pub const BLUR_RANGE_PX: (f64, f64) = (5.0, 250.0);
/// No eye's is wider; of small displays whose pixels subtend much, a wider one may be asked for all the same.
const WIDEST_MM: f32 = 20.0;
/// The range that [`PupilPlan::Strata`] divides.
const STRATA_RANGE_MM: (f32, f32) = (1.0, 5.0);
/// The range that [`PupilPlan::LogStrata`] divides: the blur of 0.35 to 8 mm on the default bench.
const LOG_STRATA_BLUR_PX: (f64, f64) = (5.0, 800.0 / 7.0);

/// Which pupils a scene is rendered for.
#[derive(Clone, Debug, PartialEq)]
pub enum PupilPlan {
    /// One random pupil in each of this many equal parts of 1 to 5 mm, drawn anew for each scene.
    Strata(usize),
    /// One random pupil in each of this many parts, equal in logarithm, of those that blur by 5 to 114 pixels over the
    /// depth volume: for networks that serve many benches, on which eyes see such blurs.
    LogStrata(usize),
    /// These, in every scene.
    Fixed(Vec<PupilDiameter>),
}

impl PupilPlan {
    /// The pupils of one scene on a bench.
    pub fn pupils(&self, bench: &DisplayGeometry, kind: SceneKind, seed: u64, index: u64) -> Vec<PupilDiameter> {
        let in_strata = |parts: usize, mm_at: &dyn Fn(f32) -> f32| {
            let mut random = Random::new(mix(seed ^ 0x7075_7069_6c73) ^ stream(kind), index);
            (0..parts).map(|part| PupilDiameter::from_mm(mm_at((part as f32 + random.unit()) / parts as f32))).collect()
        };
        match self {
            Self::Fixed(pupils) => pupils.clone(),
            Self::Strata(parts) => {
                let (low, high) = STRATA_RANGE_MM;
                in_strata(*parts, &|share| low + (high - low) * share)
            }
            Self::LogStrata(parts) => {
                let [low, high] = log_strata_mm(bench);
                in_strata(*parts, &|share| low * (high / low).powf(share))
            }
        }
    }

    /// The widest pupil that any scene has on a bench.
    pub fn widest(&self, bench: &DisplayGeometry) -> PupilDiameter {
        PupilDiameter::from_mm(match self {
            Self::Fixed(pupils) => pupils.iter().map(|pupil| pupil.mm()).fold(0.0, f32::max),
            Self::Strata(_) => STRATA_RANGE_MM.1,
            Self::LogStrata(_) => log_strata_mm(bench)[1],
        })
    }

    /// The narrowest pupil that any scene has on a bench.
    fn narrowest(&self, bench: &DisplayGeometry) -> PupilDiameter {
        PupilDiameter::from_mm(match self {
            Self::Fixed(pupils) => pupils.iter().map(|pupil| pupil.mm()).fold(f32::INFINITY, f32::min),
            Self::Strata(_) => STRATA_RANGE_MM.0,
            Self::LogStrata(_) => log_strata_mm(bench)[0],
        })
    }

    /// The least number of planes, uniform in dioptres over the depth range, between any two neighbours of which the
    /// widest pupil's circle of confusion changes by less than one pixel.
    pub fn planes(&self, bench: &DisplayGeometry) -> usize {
        bench.largest_coc_px(self.widest(bench)) as usize + 2
    }

    /// Whether scenes are made for such pupils on a bench.
    ///
    /// # Errors
    /// What was found and expected, in millimetres and pixels.
    pub fn check(&self, bench: &DisplayGeometry) -> Result<(), String> {
        let (least_px, most_px) = BLUR_RANGE_PX;
        let per_mm = bench.largest_coc_px(PupilDiameter::from_mm(1.0));
        for pupil in [self.narrowest(bench), self.widest(bench)] {
            let blur_px = bench.largest_coc_px(pupil);
            // A pupil is an f32.
            if blur_px < least_px * 0.999 || blur_px > most_px * 1.001 {
                return Err(format!(
                    "a pupil of {} mm blurs by {blur_px:.1} px over this bench's depth volume; expected {least_px} to \
                     {most_px} px, which are pupils of {:.2} to {:.2} mm here",
                    pupil.mm(),
                    least_px / per_mm,
                    most_px / per_mm,
                ));
            }
        }
        Ok(())
    }
}

fn log_strata_mm(bench: &DisplayGeometry) -> [f32; 2] {
    let per_mm = bench.largest_coc_px(PupilDiameter::from_mm(1.0));
    [LOG_STRATA_BLUR_PX.0, LOG_STRATA_BLUR_PX.1].map(|blur_px| (blur_px / per_mm) as f32)
}

impl FromStr for PupilPlan {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if let Some((kind @ ("strata" | "log-strata"), parts)) = text.split_once(':') {
            return match parts.parse() {
                Ok(parts @ 1..=64) if kind == "strata" => Ok(Self::Strata(parts)),
                Ok(parts @ 1..=64) => Ok(Self::LogStrata(parts)),
                _ => Err(format!("`{parts}` after `{kind}:` is not a whole number from 1 to 64")),
            };
        }
        let pupil = |item: &str| match item.trim().parse::<f32>() {
            Ok(mm) if mm > 0.0 && mm <= WIDEST_MM => Ok(PupilDiameter::from_mm(mm)),
            _ => Err(format!(
                "`{item}` is not a pupil diameter of up to {WIDEST_MM} mm; give a list such as 1,2,3,4,5, strata:4 or \
                 log-strata:4"
            )),
        };
        Ok(Self::Fixed(text.split(',').map(pupil).collect::<Result<_, _>>()?))
    }
}

/// At which focus planes a scene is rendered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PlanePlan {
    /// This many, at least two, uniform in dioptres, both ends of the depth range included.
    Uniform(usize),
    /// One at random in each of this many parts, at least two, of the depth range, equal in dioptres, drawn anew for
    /// each scene: so a network cannot learn to be sharp at a few focuses only.
    Strata(usize),
}

impl PlanePlan {
    /// The number of planes of each scene.
    pub fn count(self) -> usize {
        match self {
            Self::Uniform(count) | Self::Strata(count) => count,
        }
    }

    /// The planes of one scene, far to near.
    pub fn focus(self, bench: &DisplayGeometry, kind: SceneKind, seed: u64, index: u64) -> Vec<Dioptres> {
        let mut random = Random::new(mix(seed ^ 0x706c_616e_6573) ^ stream(kind), index);
        let mut position = |plane: usize| match self {
            Self::Uniform(count) => plane as f64 / (count - 1) as f64,
            Self::Strata(parts) => (plane as f64 + f64::from(random.unit())) / parts as f64,
        };
        (0..self.count()).map(|plane| bench.depth_at(position(plane))).collect()
    }
}

impl FromStr for PlanePlan {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (plan, number): (fn(usize) -> Self, _) = match text.strip_prefix("strata:") {
            Some(parts) => (Self::Strata, parts),
            None => (Self::Uniform, text),
        };
        match number.parse() {
            Ok(count @ 2..=256) => Ok(plan(count)),
            _ => Err(format!("`{text}` is neither a number from 2 to 256 nor strata:N of such a number")),
        }
    }
}

/// What the scenes of one shard folder have in common.
#[derive(Clone, Debug)]
pub struct ShardPlan {
    /// What the scenes are for.
    pub kind: SceneKind,
    /// With the index, says which scene it is.
    pub seed: u64,
    /// Pixels of each picture.
    pub resolution: Resolution,
    /// The bench on which the scenes are seen; its resolution does not matter.
    pub bench: DisplayGeometry,
    /// Pupils of each scene.
    pub pupils: PupilPlan,
    /// Focus planes of each scene.
    pub planes: PlanePlan,
    /// Rays for each pixel of each plane and pupil, at least.
    pub rays: usize,
}

/// A scene, and what is asked of it in the terms of the bench that it is laid out for.
pub struct PlannedScene {
    /// The surfaces and the resolution at which they are rendered.
    pub scene: Scene,
    /// On the default bench.
    pub pupils: Vec<PupilDiameter>,
    /// On the default bench, far to near.
    pub focus: Vec<Dioptres>,
}

/// Why a shard could not be written.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "the messages say what the fields are")]
pub enum ShardError {
    /// The output folder cannot be made or written to.
    #[error("cannot write to the folder {}: {source}; choose another with --out", path.display())]
    Folder {
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// A file could not be read.
    #[error("cannot read {}: {source}; choose another folder with --out", path.display())]
    Read {
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// A file could not be written.
    #[error("cannot write {}: {reason}", path.display())]
    Write { path: PathBuf, reason: String },
    /// A file of that name is there and holds something else.
    #[error("{} is there already, but {found}, where {expected} was expected; remove it or choose another --out", path.display())]
    Occupied {
        path: PathBuf,
        /// What the file holds.
        found: String,
        /// What it should hold.
        expected: String,
    },
    /// A file is not a shard.
    #[error("{} is not a scene shard: {reason}", path.display())]
    Malformed {
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The graphics processor could not render the scene.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// Nothing is written any more, since [`stop_writing`] was called.
    #[error("no scene is written any more: the program ends")]
    Stopped,
}

/// What became of one scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// It was rendered and written.
    Written {
        /// Aperture rays traced for it.
        rays_traced: u64,
    },
    /// A complete file was there already.
    Present,
}

/// The file name of scene `index`.
pub fn file_name(index: u64) -> String {
    format!("scene_{index:06}.safetensors")
}

impl ShardPlan {
    /// The focus planes of scene `index`, far to near.
    pub fn focus(&self, index: u64) -> Vec<Dioptres> {
        self.planes.focus(&self.bench, self.kind, self.seed, index)
    }

    /// The pupils of scene `index`.
    pub fn pupils(&self, index: u64) -> Vec<PupilDiameter> {
        self.pupils.pupils(&self.bench, self.kind, self.seed, index)
    }

    /// Scene `index` with the pupils and focuses that see of it, on the default bench for which scenes are laid out,
    /// what the plan's see on its own: how a scene blurs depends on the blur over its depth volume in pixels alone.
    pub fn scene(&self, index: u64) -> PlannedScene {
        let (bench, laid_out) = (&self.bench, &DisplayGeometry::DEFAULT);
        let one_mm = PupilDiameter::from_mm(1.0);
        let mm_per_mm = bench.largest_coc_px(one_mm) / laid_out.largest_coc_px(one_mm);
        let moved = |pupil: PupilDiameter| PupilDiameter::from_mm((f64::from(pupil.mm()) * mm_per_mm) as f32);
        let widest = moved(self.pupils.widest(bench));
        PlannedScene {
            scene: Scene::random_for(self.kind, self.seed, index, self.resolution, widest),
            pupils: self.pupils(index).into_iter().map(moved).collect(),
            focus: self.focus(index).into_iter().map(|f| laid_out.depth_at(bench.normalised_depth(f))).collect(),
        }
    }

    fn metadata(&self, index: u64) -> BTreeMap<String, String> {
        let bench = &self.bench;
        let pupils_mm: Vec<f32> = self.pupils(index).iter().map(|p| p.mm()).collect();
        let wavelengths_nm = bench.wavelengths.0.map(|wavelength| wavelength.0 * 1e9);
        let focus_dpt: Vec<f64> = self.focus(index).iter().map(|f| f.0).collect();
        [
            ("format", FORMAT.to_owned()),
            ("generator", generator(self.kind, self.seed, index).to_string()),
            ("kind", self.kind.name().to_owned()),
            ("seed", self.seed.to_string()),
            ("index", index.to_string()),
            ("pupils_mm", format!("{pupils_mm:?}")),
            ("focus_dpt", format!("{focus_dpt:?}")),
            ("far_dpt", bench.depth_far.0.to_string()),
            ("near_dpt", bench.depth_near.0.to_string()),
            ("pixel_angle_rad", bench.pixel_angle_rad().to_string()),
            ("wavelengths_nm", format!("{wavelengths_nm:?}")),
            ("pixel_pitch_um", (bench.pixel_pitch.0 * 1e6).to_string()),
            ("rays", self.rays.to_string()),
        ]
        .map(|(key, value)| (key.to_owned(), value))
        .into()
    }

    /// Renders scene `index` into `folder`, unless its complete file is there already. The file appears whole or not
    /// at all.
    pub fn write(&self, folder: &Path, index: u64, tracer: &Tracer) -> Result<Outcome, ShardError> {
        let path = folder.join(file_name(index));
        if self.is_present(&path, index)? {
            return Ok(Outcome::Present);
        }
        fs::create_dir_all(folder).map_err(|source| ShardError::Folder { path: folder.to_owned(), source })?;

        let PlannedScene { scene, pupils, focus } = self.scene(index);
        let picture = scene.picture();
        let mut stacks = vec![Vec::new(); pupils.len()];
        let rays_traced = tracer.trace(&scene, &pupils, &focus, self.rays, |pupil, sums, share| {
            stacks[pupil] = half_bytes(sums.iter().map(|sum| sum * share));
        })?;

        let Resolution { width, height } = self.resolution;
        let depth: Vec<u8> = picture.depth.iter().flat_map(|value| value.to_le_bytes()).collect();
        let image = half_bytes(picture.image.iter().copied());
        let tensor = |name: &str, dtype, shape: &[usize], bytes| Tensor {
            name: name.to_owned(),
            dtype,
            shape: shape.to_vec(),
            bytes,
        };
        let mut tensors = vec![
            tensor("image", Dtype::F16, &[3, height, width], &image[..]),
            tensor("depth", Dtype::F32, &[height, width], &depth),
        ];
        for (number, stack) in stacks.iter().enumerate() {
            let shape = [self.planes.count(), 3, height, width];
            tensors.push(tensor(&format!("stack_{number}"), Dtype::F16, &shape, stack));
        }
        let mut metadata = self.metadata(index);
        metadata.insert("traced_by".to_owned(), tracer.name().to_owned());
        let on_disk = ON_DISK.lock().unwrap_or_else(PoisonError::into_inner);
        let written = write_unless(&STOPPED, &path, tensors, &metadata);
        drop(on_disk);
        written.map_err(|error| {
            if STOPPED.load(Ordering::Acquire) {
                ShardError::Stopped
            } else {
                ShardError::Write { path, reason: error.to_string() }
            }
        })?;
        Ok(Outcome::Written { rays_traced })
    }

    /// Whether `path` is the complete shard of scene `index`; an error if it is a whole shard of something else.
    fn is_present(&self, path: &Path, index: u64) -> Result<bool, ShardError> {
        if !path.try_exists().map_err(|source| ShardError::Read { path: path.to_owned(), source })? {
            return Ok(false);
        }
        let Some(header) = Header::read(path)? else { return Ok(false) };
        let mut expected: Vec<(String, String)> = self.metadata(index).into_iter().collect();
        expected.push(("size".to_owned(), self.resolution.to_string()));
        expected.sort();
        let size = header.resolution.to_string();
        for (key, value) in expected {
            let found = match key.as_str() {
                "size" => size.clone(),
                key => header
                    .metadata
                    .metadata()
                    .as_ref()
                    .and_then(|values| values.get(key))
                    .cloned()
                    .unwrap_or_else(|| "nothing".to_owned()),
            };
            if found != value {
                let (found, expected) = (format!("its `{key}` is {found}"), value);
                return Err(ShardError::Occupied { path: path.to_owned(), found, expected });
            }
        }
        Ok(true)
    }
}

/// Held while a shard is on its way to the disk.
static ON_DISK: Mutex<()> = Mutex::new(());
/// Nothing is written any more.
static STOPPED: AtomicBool = AtomicBool::new(false);

/// Takes away a shard that is half written, and lets none be written any more: for a program that a signal ends.
pub fn stop_writing() {
    STOPPED.store(true, Ordering::Release);
    // Held for good: who writes has given up by then, and nobody begins again.
    std::mem::forget(ON_DISK.lock().unwrap_or_else(PoisonError::into_inner));
}

/// Writes a whole file or, once `stopped` is true, none.
fn write_unless(
    stopped: &AtomicBool,
    path: &Path,
    tensors: Vec<Tensor<'_>>,
    metadata: &BTreeMap<String, String>,
) -> io::Result<()> {
    write_atomically(path, |out| safetensors_file::write(&mut Stoppable { out, stopped }, tensors, metadata))
}

/// A file that takes no more once it is stopped.
struct Stoppable<'a> {
    out: &'a mut dyn Write,
    stopped: &'a AtomicBool,
}

impl Write for Stoppable<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        /// So much is written in some milliseconds.
        const MOST_BYTES: usize = 1 << 20;
        if self.stopped.load(Ordering::Acquire) {
            return Err(io::Error::other("stopped"));
        }
        self.out.write(&bytes[..bytes.len().min(MOST_BYTES)])
    }

    fn flush(&mut self) -> io::Result<()> {
        self.out.flush()
    }
}

fn half_bytes(values: impl ExactSizeIterator<Item = f32>) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(2 * values.len());
    values.for_each(|value| bytes.extend(f16::from_f32(value).to_le_bytes()));
    bytes
}

/// A shard's header, read without its tensors.
struct Header {
    metadata: Metadata,
    resolution: Resolution,
    /// Where the tensors begin in the file.
    start: u64,
}

impl Header {
    /// The header of a shard; nothing if the file is cut short.
    fn read(path: &Path) -> Result<Option<Self>, ShardError> {
        /// As the format has it.
        const LONGEST: u64 = 100_000_000;
        let unreadable = |source| ShardError::Read { path: path.to_owned(), source };
        let malformed = |reason: String| ShardError::Malformed { path: path.to_owned(), reason };
        let mut file = File::open(path).map_err(unreadable)?;
        let file_length = file.metadata().map_err(unreadable)?.len();
        if file_length < 8 {
            return Ok(None);
        }
        let mut length = [0; 8];
        file.read_exact(&mut length).map_err(unreadable)?;
        let length = u64::from_le_bytes(length);
        if length > LONGEST {
            return Err(malformed(format!("its header would be {length} bytes long")));
        }
        let start = 8 + length;
        if file_length < start {
            return Ok(None);
        }
        let mut bytes = vec![0; length as usize];
        file.read_exact(&mut bytes).map_err(unreadable)?;
        let metadata: Metadata = serde_json::from_slice(&bytes).map_err(|error| malformed(error.to_string()))?;
        if file_length < start + metadata.data_len() as u64 {
            return Ok(None);
        }
        let resolution = match metadata.info("depth").map(|info| info.shape.as_slice()) {
            Some(&[height, width]) => Resolution { width, height },
            _ => return Err(malformed("it has no depth of two dimensions".to_owned())),
        };
        Ok(Some(Self { metadata, resolution, start }))
    }

    /// Which of the shard's pupils is the widest; nothing where it does not say.
    fn widest_pupil(&self) -> Option<usize> {
        let pupils_mm: Vec<f32> = serde_json::from_str(self.metadata.metadata().as_ref()?.get("pupils_mm")?).ok()?;
        (0..pupils_mm.len()).max_by(|&one, &other| pupils_mm[one].total_cmp(&pupils_mm[other]))
    }
}

/// The parts of a shard that a person wants to see.
#[derive(Debug)]
pub struct Preview {
    /// Pixels of each picture.
    pub resolution: Resolution,
    /// Linear light, [3, height, width].
    pub image: Vec<f32>,
    /// Normalised depth, [height, width].
    pub depth: Vec<f32>,
    /// The widest pupil's image focused at the farthest plane, [3, height, width].
    pub focused_far: Vec<f32>,
    /// The widest pupil's image focused at the nearest plane, [3, height, width].
    pub focused_near: Vec<f32>,
}

impl Preview {
    /// Reads the shard at `path`.
    pub fn read(path: &Path) -> Result<Self, ShardError> {
        let malformed = |reason: String| ShardError::Malformed { path: path.to_owned(), reason };
        let unreadable = |source| ShardError::Read { path: path.to_owned(), source };
        let header = Header::read(path)?.ok_or_else(|| malformed("it is cut short".to_owned()))?;
        let resolution = header.resolution;
        let mut file = File::open(path).map_err(unreadable)?;
        // The first or last `count` values of a tensor.
        let mut read = |name: &str, dtype: Dtype, count: usize, last: bool| {
            let info = header.metadata.info(name).ok_or_else(|| malformed(format!("it has no `{name}`")))?;
            let (begin, end) = info.data_offsets;
            let length = count * dtype.bitsize() / 8;
            if info.dtype != dtype || end - begin < length || !(end - begin).is_multiple_of(length) {
                return Err(malformed(format!("`{name}` is {:?} {:?}", info.dtype, info.shape)));
            }
            let from = if last { end - length } else { begin };
            let mut bytes = vec![0; length];
            file.seek(SeekFrom::Start(header.start + from as u64)).map_err(unreadable)?;
            file.read_exact(&mut bytes).map_err(unreadable)?;
            Ok(bytes)
        };
        let widest = format!("stack_{}", header.widest_pupil().unwrap_or(0));
        let pixels = resolution.pixels();
        let depth = read("depth", Dtype::F32, pixels, false)?;
        Ok(Self {
            resolution,
            image: half_values(&read("image", Dtype::F16, 3 * pixels, false)?),
            depth: depth.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect(),
            focused_far: half_values(&read(&widest, Dtype::F16, 3 * pixels, false)?),
            focused_near: half_values(&read(&widest, Dtype::F16, 3 * pixels, true)?),
        })
    }
}

fn half_values(bytes: &[u8]) -> Vec<f32> {
    bytes.chunks_exact(2).map(|pair| f16::from_le_bytes([pair[0], pair[1]]).to_f32()).collect()
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    fn tensor(bytes: &[u8]) -> Tensor<'_> {
        Tensor { name: "image".to_owned(), dtype: Dtype::F16, shape: vec![bytes.len() / 2], bytes }
    }

    #[test]
    fn a_file_that_is_stopped_halfway_leaves_nothing() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join(file_name(0));
        let bytes = vec![7; 1 << 22];
        let stopped = AtomicBool::new(false);
        let begun = write_atomically(&path, |out| {
            let mut out = Stoppable { out, stopped: &stopped };
            out.write_all(&bytes)?;
            assert_eq!(fs::read_dir(folder.path())?.count(), 1, "half of it is there");
            stopped.store(true, Ordering::Release);
            out.write_all(&bytes)
        });
        assert!(begun.is_err());
        assert!(write_unless(&stopped, &path, vec![tensor(&bytes)], &BTreeMap::new()).is_err());
        assert_eq!(fs::read_dir(folder.path()).expect("the folder").count(), 0);
    }

    #[test]
    fn a_file_has_the_mode_that_others_of_the_folder_get() {
        let folder = tempfile::tempdir().expect("a folder");
        let [shard, other] = [file_name(0), "other".to_owned()].map(|name| folder.path().join(name));
        fs::write(&other, "").expect("a file");
        write_unless(&AtomicBool::new(false), &shard, vec![tensor(&[1, 2])], &BTreeMap::new()).expect("a shard");
        let mode = |path: &Path| fs::metadata(path).expect("a file").permissions().mode();
        assert_eq!(mode(&shard), mode(&other));
    }
}

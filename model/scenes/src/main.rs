//! Writes random scenes with their thin-lens focal stacks, for training and judging a network.

use std::io::{Cursor, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::thread;
use std::time::Instant;

use clap::{Args, Parser, Subcommand, ValueEnum};
use holod_calibration::rig::{Rig, RigError};
use holod_calibration::{DisplayGeometry, PupilDiameter, Resolution, Sorted, hangup_is_ignored, write_atomically};
use holod_model::gpu::GpuError;
use holod_model::scene::FocalStack;
use holod_model::scene_shard::{self, SceneKind, SceneShard, SceneShardError};
use holod_model::srgb8;
use holod_scenes::Tracer;
use holod_scenes::shard::{Outcome, PlanePlan, PlannedScene, Preview, PupilPlan, ShardError, ShardPlan, stop_writing};
use indicatif::{ProgressBar, ProgressStyle};
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};

/// Random scenes and their thin-lens focal stacks.
#[derive(Parser)]
#[command(version, about)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Write one file for each scene; complete files that are there already are kept.
    Generate(Generate),
    /// Put scenes of a folder on one picture: all in focus, depth, and the widest pupil focused far and near.
    Sheet(Sheet),
    /// Write what one pupil sees of a scene as pictures, for `holod render --focal-stack`.
    FocalStack(FocalStackOf),
    /// Measure how many aperture rays are traced in a second.
    Bench(Bench),
    /// Measure the noise of the thin-lens images, in and out of focus, for each pupil.
    Noise(Measure),
}

#[derive(Args)]
struct Generate {
    /// Folder to write to; made if it is not there.
    #[arg(long)]
    out: PathBuf,
    /// With the kind and the index, says which scene it is.
    #[arg(long)]
    seed: u64,
    /// Number of scenes to generate.
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    count: u64,
    /// Index of the first scene.
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u64).range(0..=100_000_000))]
    first: u64,
    #[command(flatten)]
    look: Look,
    /// What traces the rays; scenes agree to rounding.
    #[arg(long, value_enum, default_value_t = Backend::Cpu)]
    backend: Backend,
}

#[derive(Clone, Copy, ValueEnum)]
enum Backend {
    /// All cores of the processor.
    Cpu,
    /// The best graphics processor that Vulkan shows (in a build with `--features gpu`).
    Gpu,
    /// A processor that plays one, Mesa's llvmpipe: slow, to test the shaders (likewise).
    Software,
}

impl Backend {
    fn open(self) -> Result<Tracer, GpuError> {
        match self {
            Self::Cpu => Ok(Tracer::cpu()),
            Self::Gpu => Tracer::gpu(),
            Self::Software => Tracer::software_gpu(),
        }
    }
}

/// What the scenes are like.
#[derive(Args)]
struct Look {
    /// What the scenes are for.
    #[arg(long, value_enum, default_value_t = Kind::Train)]
    kind: Kind,
    /// Pixels: one number for a square, or WIDTHxHEIGHT.
    #[arg(long, default_value = "256", value_parser = even_size)]
    size: Resolution,
    /// The bench on which the scenes are seen: a rig file. The default bench where left out.
    #[arg(long, alias = "config")]
    rig: Option<PathBuf>,
    /// Pupils in mm; strata:N for one random pupil in each N-th of 1 to 5 mm; or log-strata:N for one in each N-th, by
    /// logarithm, of those that blur by 5 to 114 px over the depth volume, as networks for many benches want them.
    #[arg(long, default_value = "strata:4")]
    pupils: PupilPlan,
    /// Focus planes, uniform in dioptres, both ends included; `auto`: as many as keep the widest pupil's blur from
    /// changing by a pixel between neighbours; or strata:N for one at random in each N-th of the depth range, as
    /// training wants it.
    #[arg(long, default_value = "6", value_parser = planes)]
    planes: Planes,
    /// Rays for each pixel of each plane and pupil, at least.
    #[arg(long, default_value_t = 128, value_parser = clap::value_parser!(u32).range(1..=65_536))]
    rays: u32,
}

impl Look {
    fn plan(&self, seed: u64) -> Result<ShardPlan, Failure> {
        let bench = bench_of(self.rig.as_deref())?;
        self.pupils
            .check(&bench)
            .map_err(|fault| Failure { code: exit::USAGE, message: format!("--pupils: {fault}") })?;
        Ok(ShardPlan {
            kind: match self.kind {
                Kind::Train => SceneKind::Train,
                Kind::Test => SceneKind::Test,
                Kind::Cards => SceneKind::Cards,
                Kind::Marks => SceneKind::Marks,
            },
            seed,
            resolution: self.size,
            planes: match self.planes {
                Planes::Given(planes) => planes,
                Planes::Auto => PlanePlan::Uniform(self.pupils.planes(&bench)),
            },
            bench,
            pupils: self.pupils.clone(),
            rays: self.rays as usize,
        })
    }
}

/// The bench of a rig file, or the default one.
fn bench_of(rig: Option<&Path>) -> Result<DisplayGeometry, RigError> {
    rig.map_or(Ok(DisplayGeometry::DEFAULT), |path| Ok(Rig::load(path)?.geometry))
}

#[derive(Clone, Copy, ValueEnum)]
enum Kind {
    /// Scenes for training a network.
    Train,
    /// For testing, with textures that no training scene has.
    Test,
    /// The refocus test: a near and a far card of fine marks.
    Cards,
    /// Bright dots, lines and stars, near and far, on exact black.
    Marks,
}

#[derive(Args)]
struct Sheet {
    /// Folder of scenes, as `generate` writes them.
    folder: PathBuf,
    /// PNG file to write.
    #[arg(long, value_parser = png)]
    out: PathBuf,
    /// Overwrite what is there already.
    #[arg(long)]
    force: bool,
    /// Scenes to show, the first of the folder.
    #[arg(long, default_value_t = 12, value_parser = clap::value_parser!(u16).range(1..=400))]
    scenes: u16,
}

#[derive(Args)]
struct FocalStackOf {
    /// File of the scene.
    scene: PathBuf,
    /// Pupil diameter in millimetres, one of those that the scene was rendered for.
    #[arg(long)]
    pupil: f32,
    /// Bench that the scene was rendered for, from a rig file; the built-in one when left out.
    #[arg(long, value_name = "FILE")]
    rig: Option<PathBuf>,
    /// Folder to make, for the pictures and their stack.toml.
    #[arg(long)]
    out: PathBuf,
}

#[derive(Args)]
struct Bench {
    #[command(flatten)]
    measure: Measure,
    /// What is measured beside the processor; `cpu`: nothing.
    #[arg(long, value_enum, default_value_t = Backend::Cpu)]
    backend: Backend,
}

#[derive(Args)]
struct Measure {
    /// How many scenes to render.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u64).range(1..=1000))]
    scenes: u64,
    #[command(flatten)]
    look: Look,
}

fn even_size(text: &str) -> Result<Resolution, String> {
    let length = |text: &str| match text.parse() {
        Ok(length @ 16..=8192) if length % 2 == 0 => Ok(length),
        _ => Err("expected even numbers from 16 to 8192: SIZE or WIDTHxHEIGHT".to_owned()),
    };
    let (width, height) = text.split_once('x').unwrap_or((text, text));
    Ok(Resolution { width: length(width)?, height: length(height)? })
}

fn png(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    match path.extension() {
        Some(extension) if extension.eq_ignore_ascii_case("png") => Ok(path),
        _ => Err("expected the name of a PNG file, FILE.png".to_owned()),
    }
}

#[derive(Clone, Copy)]
enum Planes {
    Given(PlanePlan),
    Auto,
}

fn planes(text: &str) -> Result<Planes, String> {
    if text == "auto" {
        return Ok(Planes::Auto);
    }
    text.parse().map(Planes::Given).map_err(|error| format!("{error}, nor `auto`"))
}

/// Exit codes of sysexits.h.
mod exit {
    pub(super) const USAGE: u8 = 64;
    pub(super) const DATA: u8 = 65;
    pub(super) const NO_INPUT: u8 = 66;
    pub(super) const UNAVAILABLE: u8 = 69;
    pub(super) const CANNOT_CREATE: u8 = 73;
    pub(super) const IO: u8 = 74;
    pub(super) const CONFIG: u8 = 78;
}

struct Failure {
    code: u8,
    message: String,
}

impl From<ShardError> for Failure {
    fn from(error: ShardError) -> Self {
        let code = match error {
            ShardError::Folder { .. } | ShardError::Occupied { .. } => exit::CANNOT_CREATE,
            ShardError::Read { .. } => exit::NO_INPUT,
            ShardError::Write { .. } => exit::IO,
            ShardError::Malformed { .. } => exit::DATA,
            ShardError::Gpu(_) => exit::UNAVAILABLE,
            // The thread that stopped it ends the program.
            ShardError::Stopped => loop {
                thread::park();
            },
        };
        Self { code, message: error.to_string() }
    }
}

impl From<SceneShardError> for Failure {
    fn from(error: SceneShardError) -> Self {
        let code = match error {
            SceneShardError::Read { .. } | SceneShardError::Empty { .. } => exit::NO_INPUT,
            SceneShardError::Damaged { .. } | SceneShardError::Content { .. } => exit::DATA,
        };
        Self { code, message: error.to_string() }
    }
}

impl From<RigError> for Failure {
    fn from(error: RigError) -> Self {
        Self { code: exit::CONFIG, message: error.to_string() }
    }
}

impl From<GpuError> for Failure {
    fn from(error: GpuError) -> Self {
        ShardError::Gpu(error).into()
    }
}

fn main() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(error) => {
            // Help and version are no errors; where standard output is closed there is nobody to tell.
            let _ = error.print();
            return if error.use_stderr() { ExitCode::from(exit::USAGE) } else { ExitCode::SUCCESS };
        }
    };
    let done = match cli.command {
        Command::Generate(options) => generate(&options),
        Command::Sheet(options) => sheet(&options),
        Command::FocalStack(options) => focal_stack(&options),
        Command::Bench(options) => bench(&options),
        Command::Noise(options) => noise(&options),
    };
    match done {
        Ok(report) => {
            let _ = writeln!(std::io::stdout(), "{report}");
            ExitCode::SUCCESS
        }
        Err(failure) => {
            let _ = writeln!(std::io::stderr(), "holod-scenes: {}", failure.message);
            ExitCode::from(failure.code)
        }
    }
}

/// The smallest picture that has room for a row of marks near and far.
const LEAST_MARKS: Resolution = Resolution { width: 96, height: 120 };

fn generate(options: &Generate) -> Result<String, Failure> {
    let size = options.look.size;
    if matches!(options.look.kind, Kind::Marks) && (size.width < LEAST_MARKS.width || size.height < LEAST_MARKS.height)
    {
        let message = format!("--size: found {size}, expected {LEAST_MARKS} or more with --kind marks");
        return Err(Failure { code: exit::USAGE, message });
    }
    let plan = options.look.plan(options.seed)?;
    let style = ProgressStyle::with_template("{bar:40} {pos}/{len} scenes by {msg}, {eta} left")
        .expect("the template is constant");
    let tracer = options.backend.open()?;
    take_away_on_signals();
    let bar = ProgressBar::new(options.count).with_style(style).with_message(tracer.name().to_owned());
    let (mut written, mut present) = (0, 0);
    for index in options.first..options.first + options.count {
        match plan.write(&options.out, index, &tracer)? {
            Outcome::Written { .. } => written += 1,
            Outcome::Present => present += 1,
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    Ok(format!("{written} scenes written to {}, {present} were there already", options.out.display()))
}

/// From now on a signal ends the program without a file that is half written. Where no thread can wait for signals, they
/// end it as ever.
fn take_away_on_signals() {
    let hangup = (!hangup_is_ignored()).then_some(SIGHUP);
    let Ok(mut signals) = signal_hook::iterator::Signals::new([SIGINT, SIGTERM].into_iter().chain(hangup)) else {
        return;
    };
    let wait = move || {
        if let Some(signal) = signals.forever().next() {
            stop_writing();
            std::process::exit(128 + signal);
        }
    };
    let _ = thread::Builder::new().name("signals".into()).spawn(wait);
}

fn focal_stack(options: &FocalStackOf) -> Result<String, Failure> {
    let bench = bench_of(options.rig.as_deref())?;
    let shard = SceneShard::open(&options.scene, &bench)?;
    let wanted = |pupil: &PupilDiameter| (pupil.mm() - options.pupil).abs() < 1e-4;
    let index = shard.pupils().iter().position(wanted).ok_or_else(|| {
        let there: Vec<String> = shard.pupils().iter().map(|pupil| pupil.mm().to_string()).collect();
        let message = format!(
            "--pupil: found {}, expected one of {} mm, which {} was rendered for",
            options.pupil,
            there.join(", "),
            options.scene.display()
        );
        Failure { code: exit::USAGE, message }
    })?;
    let images = shard.stack(index)?;
    FocalStack::save(&options.out, &images, shard.focuses(), shard.pupils()[index]).map_err(|error| Failure {
        code: exit::CANNOT_CREATE,
        message: match error.kind() {
            std::io::ErrorKind::AlreadyExists => {
                format!("{}: found a file or folder; name a new one with --out", options.out.display())
            }
            _ => format!("{}: {error}", options.out.display()),
        },
    })?;
    Ok(format!("{} pictures and stack.toml written to {}", images.len(), options.out.display()))
}

fn bench(options: &Bench) -> Result<String, Failure> {
    let Measure { scenes, look } = &options.measure;
    let plan = look.plan(1)?;
    let mut tracers = vec![Tracer::cpu()];
    if !matches!(options.backend, Backend::Cpu) {
        tracers.push(options.backend.open()?);
    }
    let mut composing_s = Vec::new();
    let (mut tracing_s, mut rates) = (vec![Vec::new(); tracers.len()], vec![Vec::new(); tracers.len()]);
    for index in 0..*scenes {
        let begin = Instant::now();
        let PlannedScene { scene, pupils, focus } = plan.scene(index);
        composing_s.push(begin.elapsed().as_secs_f64());
        for (tracer, (tracing_s, rates)) in tracers.iter().zip(tracing_s.iter_mut().zip(&mut rates)) {
            let begin = Instant::now();
            let (_, rays) = scene.traced_focal_stacks(tracer, &pupils, &focus, plan.rays)?;
            let seconds = begin.elapsed().as_secs_f64();
            tracing_s.push(seconds);
            rates.push(rays as f64 * 1e-6 / seconds);
        }
    }
    let threads = rayon::current_num_threads();
    let mut report = format!(
        "{scenes} scenes of {}, {} planes; medians\n{:>8.2} s to compose a scene",
        plan.resolution,
        plan.planes.count(),
        median(&composing_s)
    );
    let of_cpu = median(&rates[0]);
    for (place, (tracing_s, rates)) in tracing_s.iter_mut().zip(&mut rates).enumerate() {
        let tracer = &tracers[place];
        let rate = median(rates);
        report += &format!(
            "\n{:>8.2} s to trace it by {}: {rate:.2} million aperture rays/s",
            median(tracing_s),
            tracer.name()
        );
        report += &if place == 0 {
            format!(", {:.2} on each of {threads} threads", rate / threads as f64)
        } else {
            format!(", {:.2} times the cpu's", rate / of_cpu)
        };
    }
    Ok(report)
}

fn median(values: &[f64]) -> f64 {
    Sorted::new(values.iter().copied()).expect("at least one round").median()
}

/// Noise is averaged as power over the scenes.
fn noise(options: &Measure) -> Result<String, Failure> {
    let plan = options.look.plan(1)?;
    let power = |db: f64| 10f64.powf(0.1 * db);
    let mut sums: Vec<(f32, [(f64, u32); 3])> = Vec::new();
    let begin = Instant::now();
    for index in 0..options.scenes {
        let PlannedScene { mut scene, pupils, focus } = plan.scene(index);
        let measured = scene.noise(&pupils, &focus, plan.rays);
        sums.resize(measured.len(), (0.0, [(0.0, 0); 3]));
        for ((pupil, (pupil_mm, sums)), noise) in plan.pupils(index).iter().zip(&mut sums).zip(measured) {
            *pupil_mm += pupil.mm() / options.scenes as f32;
            for (sum, db) in sums.iter_mut().zip([noise.all_db, noise.in_focus_db, noise.out_of_focus_db]) {
                if !db.is_nan() {
                    *sum = (sum.0 + power(db), sum.1 + 1);
                }
            }
        }
    }
    let mut report = format!(
        "{} rays, {} scenes of {}, {:.2} s a rendering; noise in dB\n  pupil/mm       all  in focus  out of focus",
        plan.rays,
        options.scenes,
        plan.resolution,
        0.5 * begin.elapsed().as_secs_f64() / options.scenes as f64
    );
    for (pupil_mm, sums) in sums {
        let [all, sharp, soft] = sums.map(|(sum, count)| 10.0 * (sum / f64::from(count)).log10());
        report += &format!("\n  {pupil_mm:8.2}  {all:8.1}  {sharp:8.1}  {soft:12.1}");
    }
    Ok(report)
}

fn sheet(options: &Sheet) -> Result<String, Failure> {
    if !options.force && options.out.symlink_metadata().is_ok() {
        let message =
            format!("--out: found {}; name another file, or overwrite it with --force", options.out.display());
        return Err(Failure { code: exit::CANNOT_CREATE, message });
    }
    let files = scene_shard::files_of(&options.folder)?;
    let shown = files.iter().take(usize::from(options.scenes));
    let previews = shown.map(|path| Preview::read(path)).collect::<Result<Vec<_>, _>>()?;
    let picture = contact_sheet(&previews);
    save_png(&picture, &options.out)?;
    Ok(format!(
        "{} scenes on {} (all in focus, depth, focused far, focused near)",
        previews.len(),
        options.out.display()
    ))
}

/// Four pictures for each scene, and scenes below and beside one another so that the sheet is about square.
fn contact_sheet(previews: &[Preview]) -> image::RgbImage {
    const GAP: u32 = 4;
    let cell_width = previews.iter().map(|p| p.resolution.width).max().unwrap_or(0) as u32 + GAP;
    let cell_height = previews.iter().map(|p| p.resolution.height).max().unwrap_or(0) as u32 + GAP;
    let across = ((0.25 * previews.len() as f32).sqrt().round() as usize).max(1);
    let down = previews.len().div_ceil(across) as u32;
    let mut sheet = image::RgbImage::new(4 * cell_width * across as u32, cell_height * down);
    for (place, preview) in previews.iter().enumerate() {
        let (row, first_column) = (place / across, 4 * (place % across) as u32);
        let pixels = preview.resolution.pixels();
        let mut put = |column: u32, colour: &dyn Fn(usize) -> [u8; 3]| {
            for pixel in 0..pixels {
                let x = (pixel % preview.resolution.width) as u32 + (first_column + column) * cell_width;
                let y = (pixel / preview.resolution.width) as u32 + row as u32 * cell_height;
                sheet.put_pixel(x, y, image::Rgb(colour(pixel)));
            }
        };
        let coloured = |image: &[f32], pixel: usize| [0, 1, 2].map(|c| srgb8(image[c * pixels + pixel]));
        put(0, &|pixel| coloured(&preview.image, pixel));
        put(1, &|pixel| [(preview.depth[pixel] * 255.0) as u8; 3]);
        put(2, &|pixel| coloured(&preview.focused_far, pixel));
        put(3, &|pixel| coloured(&preview.focused_near, pixel));
    }
    sheet
}

fn save_png(picture: &image::RgbImage, path: &Path) -> Result<(), Failure> {
    let mut bytes = Cursor::new(Vec::new());
    picture
        .write_to(&mut bytes, image::ImageFormat::Png)
        .map_err(|error| error.to_string())
        .and_then(|()| write_atomically(path, |out| out.write_all(bytes.get_ref())).map_err(|error| error.to_string()))
        .map_err(|reason| Failure {
            code: exit::CANNOT_CREATE,
            message: format!("cannot write {}: {reason}", path.display()),
        })
}

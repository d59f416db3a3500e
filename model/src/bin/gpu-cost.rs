//! What the built-in networks cost on graphics cards that are not there, by a model.

use std::fmt::Write as _;
use std::io::Write as _;
use std::process::ExitCode;

use clap::{Parser, ValueEnum};
use holod_calibration::Resolution;
use holod_model::Weights;
use holod_model::engine::gpu_cost::{
    CARDS, Card, Compiler, CostError, CountedBy, FrameCost, FramePlan, Products, SERVE, serve,
};
use serde::Serialize;

/// What one frame of the built-in networks costs on graphics cards that are not there, by a model.
///
/// Each shader is compiled by Mesa's RADV for a card that it only pretends to have, and its time is worked out: by
/// arithmetic, the instructions of its loops times their trips at the card's clock, and by bytes, each buffer once at
/// the card's bandwidth. A dispatch takes the longer of the two, and a frame the sum of its dispatches.
///
/// Nothing is run or measured: the model knows neither latency nor caches nor the time between dispatches. It compares
/// kernels and finds registers that spill; it does not replace a measurement.
///
/// Needs Mesa 22.3 to 25 with RADV (Debian: mesa-vulkan-drivers), or that which VK_DRIVER_FILES names. Exit code 70: a
/// register spills or a shader does not compile; 69: there is no such driver.
#[derive(Parser)]
#[command(version)]
struct Cli {
    /// Compile for this card alone.
    #[arg(long, value_enum)]
    card: Option<CardName>,
    /// Compile the shaders of this network alone.
    #[arg(long, value_enum)]
    network: Option<Network>,
    /// Only frames of this size; 512x512, 1920x1080 and 3840x2160 otherwise.
    #[arg(long, value_name = "WxH", value_parser = parse_resolution)]
    resolution: Option<Resolution>,
    /// With features in half precision: two products at once.
    #[arg(long)]
    half_precision: bool,
    /// With features in half precision whose layers multiply matrices, on units of their own. Needs Mesa 25.0 and a
    /// card of RDNA 3: without --card, the RX 7900 XTX.
    #[arg(long, conflicts_with = "half_precision")]
    matrix_units: bool,
    /// Print the costs of each dispatch as JSON.
    #[arg(long)]
    json: bool,
    /// Print the instructions of the shader of this label instead; an unknown label lists them all.
    #[arg(long, value_name = "SHADER", conflicts_with = "json")]
    assembly: Option<String>,
}

#[derive(Clone, Copy, PartialEq, ValueEnum)]
enum CardName {
    /// RX 7900 XTX, RDNA 3.
    #[value(name = "rx-7900-xtx")]
    Rx7900Xtx,
    /// RX 6800 XT, RDNA 2.
    #[value(name = "rx-6800-xt")]
    Rx6800Xt,
}

#[derive(Clone, Copy, PartialEq, ValueEnum)]
enum Network {
    Standard,
    Small,
    Fast,
}

impl Network {
    fn name(self) -> &'static str {
        match self {
            Self::Standard => "standard",
            Self::Small => "small",
            Self::Fast => "fast",
        }
    }

    fn weights(self) -> Weights {
        match self {
            Self::Standard => Weights::builtin(),
            Self::Small => Weights::builtin_small(),
            Self::Fast => Weights::builtin_fast(),
        }
    }
}

const RESOLUTIONS: [Resolution; 3] = [
    Resolution { width: 512, height: 512 },
    Resolution { width: 1920, height: 1080 },
    Resolution { width: 3840, height: 2160 },
];

fn parse_resolution(text: &str) -> Result<Resolution, String> {
    let length = |text: &str| match text.parse() {
        Ok(length @ 1..=16384) => Ok(length),
        _ => Err("expected WIDTHxHEIGHT, each from 1 to 16384".to_owned()),
    };
    let (width, height) = text.split_once('x').unwrap_or((text, ""));
    Ok(Resolution { width: length(width)?, height: length(height)? })
}

/// Exit codes as in sysexits(3).
mod exit {
    pub(super) const USAGE: u8 = 64;
    pub(super) const UNAVAILABLE: u8 = 69;
    pub(super) const SOFTWARE: u8 = 70;
}

struct Failure {
    code: u8,
    message: String,
}

impl From<CostError> for Failure {
    fn from(error: CostError) -> Self {
        let code = match error {
            CostError::Shader { .. } => exit::SOFTWARE,
            _ => exit::UNAVAILABLE,
        };
        Self { code, message: error.to_string() }
    }
}

/// One frame's cost, as it is told in JSON.
#[derive(Serialize)]
struct Report {
    network: &'static str,
    width: usize,
    height: usize,
    seconds: f64,
    #[serde(flatten)]
    cost: FrameCost,
}

fn main() -> ExitCode {
    if std::env::args().nth(1).as_deref() == Some(SERVE) {
        return if serve().is_ok() { ExitCode::SUCCESS } else { ExitCode::from(exit::UNAVAILABLE) };
    }
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(error) => {
            // Help and version are no errors; where standard output is closed there is nobody to tell.
            let _ = error.print();
            return if error.use_stderr() { ExitCode::from(exit::USAGE) } else { ExitCode::SUCCESS };
        }
    };
    match run(&cli, |text| drop(write!(std::io::stdout(), "{text}"))) {
        Ok(()) => ExitCode::SUCCESS,
        Err(Failure { code, message }) => {
            let _ = writeln!(std::io::stderr(), "gpu-cost: {message}");
            ExitCode::from(code)
        }
    }
}

fn run(cli: &Cli, say: impl Fn(&str)) -> Result<(), Failure> {
    let program = std::env::current_exe()
        .map_err(|error| Failure { code: exit::UNAVAILABLE, message: format!("this program's own file: {error}") })?;
    let networks = [Network::Standard, Network::Small, Network::Fast].into_iter();
    let networks: Vec<_> = networks.filter(|network| cli.network.is_none_or(|wanted| wanted == *network)).collect();
    let products = match (cli.matrix_units, cli.half_precision) {
        (true, _) => Products::Matrices,
        (_, true) => Products::Half,
        _ => Products::Single,
    };
    let card = cli.card.or(cli.matrix_units.then_some(CardName::Rx7900Xtx));
    let names = [CardName::Rx7900Xtx, CardName::Rx6800Xt];
    let cards: Vec<Card> = names
        .into_iter()
        .zip(CARDS)
        .filter(|(name, _)| card.is_none_or(|card| card == *name))
        .map(|(_, c)| c)
        .collect();
    let resolutions = cli.resolution.map_or(RESOLUTIONS.to_vec(), |resolution| vec![resolution]);

    let mut reports = Vec::new();
    for card in cards {
        let mut compiler = Compiler::new(&program, card)?;
        compiler.check(products)?;
        for network in &networks {
            let weights = network.weights();
            for &resolution in &resolutions {
                let plan = FramePlan::new(&weights, resolution, products)
                    .map_err(|error| Failure { code: exit::USAGE, message: error.to_string() })?;
                if let Some(label) = &cli.assembly {
                    let texts = compiler.assembly(&plan, label)?;
                    if texts.is_empty() {
                        let labels = plan.shaders().join("\n  ");
                        let message = format!("--assembly: no shader `{label}`; expected one of\n  {labels}");
                        return Err(Failure { code: exit::USAGE, message });
                    }
                    texts.iter().for_each(|text| {
                        say(&format!("; {label}, {} {resolution}, {}\n{text}\n", network.name(), compiler.device()));
                    });
                    continue;
                }
                let cost = compiler.cost(&plan)?;
                let Resolution { width, height } = resolution;
                let report = Report { network: network.name(), width, height, seconds: cost.seconds(), cost };
                if !cli.json {
                    say(&table(&report));
                }
                reports.push(report);
            }
        }
    }
    if cli.json {
        say(&(serde_json::to_string_pretty(&reports).expect("costs are plain data") + "\n"));
    }
    let spills = reports.iter().flat_map(|Report { network, width, height, cost, .. }| {
        let told = move |(shader, count)| format!("{shader} ({network} {width}x{height}, {}): {count}", cost.card);
        cost.spills().map(told)
    });
    let spills: Vec<_> = spills.collect();
    if spills.is_empty() {
        return Ok(());
    }
    Err(Failure { code: exit::SOFTWARE, message: format!("registers spill: {}", spills.join("; ")) })
}

fn table(Report { network, width, height, seconds, cost }: &Report) -> String {
    let mut text = format!("{network} {width}x{height} on {} (a model, not a measurement)\n", cost.card);
    let mut say = |row: [&str; 10]| {
        let [name, columns @ ..] = row;
        let widths = [8, 8, 5, 6, 6, 5, 10, 8, 8];
        write!(text, "  {name:<28}").expect("text grows");
        columns.iter().zip(widths).for_each(|(column, width)| write!(text, " {column:>width$}").expect("text grows"));
        text.push('\n');
    };
    say(["stage", "GFLOP", "MB", "VGPR", "spills", "waves", "fma %", "vector ms", "MB ms", "ms"]);
    let ms = |seconds: f64| format!("{:.3}", seconds * 1e3);
    for stage in &cost.stages {
        let sum = |value: &dyn Fn(&_) -> f64| stage.dispatches.iter().map(value).sum::<f64>();
        let estimated = stage.dispatches.iter().any(|dispatch| dispatch.counted_by == CountedBy::Compiler);
        let most = |value: &dyn Fn(&_) -> u64| stage.dispatches.iter().map(value).max().unwrap_or(0).to_string();
        say([
            &stage.name,
            &format!("{:.2}", stage.flop as f64 / 1e9),
            &format!("{:.1}", sum(&|dispatch| dispatch.bytes as f64) / 1e6),
            &most(&|dispatch| dispatch.vector_registers),
            &most(&|dispatch| dispatch.spilled_registers),
            &stage.dispatches.iter().map(|dispatch| dispatch.waves_per_simd).min().unwrap_or(0).to_string(),
            &stage.longest().map_or(String::new(), |longest| format!("{:.0}", 100.0 * longest.multiply_add_share)),
            &(String::from(if estimated { "~" } else { "" }) + &ms(sum(&|dispatch| dispatch.arithmetic_s()))),
            &ms(sum(&|dispatch| dispatch.bytes_s)),
            &ms(stage.seconds()),
        ]);
    }
    let flop: u64 = cost.stages.iter().map(|stage| stage.flop).sum();
    let dispatches = cost.stages.iter().flat_map(|stage| &stage.dispatches);
    let (count, bytes) = dispatches.fold((0, 0), |(count, bytes), dispatch| (count + 1, bytes + dispatch.bytes));
    let (flop, bytes) = (flop as f64 / 1e9, bytes as f64 / 1e6);
    writeln!(text, "  frame: {flop:.1} GFLOP, {bytes:.0} MB, {count} dispatches, {} ms\n", ms(*seconds))
        .expect("text grows");
    text
}

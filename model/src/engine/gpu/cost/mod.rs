//! A model of what a plan costs on cards that are not there.
//!
//! Every shader of a plan is compiled by the real driver's own compiler, Mesa's RADV with its null device, and what it
//! costs is counted from its instructions, the trips of its loops, and the bytes of its buffers. **Nothing is run or
//! measured.** The model knows neither latency nor caches, nor the time between two dispatches; it takes every branch
//! that goes forward as not taken, the bytes of a dispatch as moved once, and the vector port as the only one besides
//! the workgroup's memory that can be busy. Real cards are slower than this where too few waves hide their loads, and
//! faster where a map stays in a cache.
//!
//! Cards of RDNA 3 can issue two operations of some kinds together: in waves of 32 threads as instructions of their
//! own, `v_dual_*`, which count as two in one cycle here; in waves of 64 the hardware does it unasked where registers
//! allow, which is not counted here.

mod assembly;
mod null_device;
mod spirv;

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::path::{Path, PathBuf};

use holod_calibration::{Colour, DisplayGeometry, LevelTables, PerColour, Resolution};
use serde::Serialize;

use self::assembly::{Assembly, Work};
use self::null_device::{Binary, NullDevice, Request};
use super::conv::Method;
use super::fft::WorkgroupLimits;
use super::map::Format;
use super::network::NetworkPlan;
use super::plan::{Dispatch, Plan, Shader};
use super::trunk::Features;
use crate::Weights;
use crate::engine::EngineError;
use crate::gpu::MatrixUnits;

pub use self::null_device::serve;

/// The argument with which a [`Compiler`] starts its program, which then calls [`serve`].
pub const SERVE: &str = "--serve-null-device";

/// A graphics card, as the model of its cost knows it.
#[derive(Clone, Copy, Debug)]
pub struct Card {
    /// As it is sold.
    pub name: &'static str,
    /// What versions of the driver call its processor.
    families: &'static [&'static str],
    /// Each with two SIMDs of 32 lanes.
    compute_units: u32,
    clock_hz: f64,
    bytes_per_s: f64,
}

/// An RDNA 3 card and an RDNA 2 card.
pub const CARDS: [Card; 2] = [
    Card {
        name: "RX 7900 XTX",
        families: &["gfx1100", "navi31"],
        compute_units: 96,
        clock_hz: 2.5e9,
        bytes_per_s: 960e9,
    },
    Card { name: "RX 6800 XT", families: &["navi21"], compute_units: 72, clock_hz: 2.25e9, bytes_per_s: 512e9 },
];

/// What a compute unit reads or writes of the workgroup's memory in a cycle.
const WORKGROUP_BYTES_PER_CYCLE: f64 = 128.0;

/// As the driver tells them of both cards.
const LIMITS: WorkgroupLimits = WorkgroupLimits { bytes: 65536, threads: 1024 };

/// Why there is no cost, or none that may be.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "the messages say what the fields are")]
pub enum CostError {
    /// Mesa's driver is not there.
    #[error("Mesa's driver RADV is not installed: no radeon_icd*.json; install mesa-vulkan-drivers")]
    NoDriver,
    /// The driver does not play the card.
    #[error(
        "{driver} has no null device for the {card} ({said}); Mesa 26 has dropped it: install mesa-vulkan-drivers of Debian 12 or 13, and libvulkan1",
        driver = driver.display()
    )]
    NoNullDevice { card: &'static str, driver: PathBuf, said: String },
    /// The card, or the driver, multiplies no matrices.
    #[error(
        "{driver} lists no matrices of 16x16x16 numbers of half precision for the {card}; \
         expected a card of RDNA 3, and Mesa 25.0 (mesa-vulkan-drivers of Debian 13)"
    )]
    NoMatrices { card: &'static str, driver: String },
    /// The program that runs the compiler does not start.
    #[error("{program} cannot be started: {source}", program = program.display())]
    Process {
        program: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A shader is none.
    #[error("shader `{label}` does not compile: {reason}")]
    Shader {
        label: String,
        /// What the compiler said.
        reason: String,
    },
    /// The driver leaves out what is looked for.
    #[error("shader `{label}`: the driver does not tell its {what}; the versions that are known to are 22.3 to 25.0")]
    Untold { label: String, what: &'static str },
}

/// What one frame costs on one card.
#[derive(Clone, Debug, Serialize)]
pub struct FrameCost {
    /// The card's name, as in [`Card`].
    pub card: &'static str,
    /// In the order in which they run.
    pub stages: Vec<StageCost>,
}

/// What one stage costs.
#[derive(Clone, Debug, Serialize)]
pub struct StageCost {
    /// As in [`StageTiming`](crate::engine::StageTiming).
    pub name: String,
    /// Operations of its definition, two to a multiply-add; 0 where it is no matrix-like work.
    pub flop: u64,
    /// In the order in which they run, none beside another.
    pub dispatches: Vec<DispatchCost>,
}

/// What one dispatch costs.
#[derive(Clone, Debug, Serialize)]
pub struct DispatchCost {
    /// The shader's label, which [`Compiler::assembly`] takes.
    pub shader: String,
    /// Vector registers of a thread.
    pub vector_registers: u64,
    /// Registers that did not fit, vector and scalar.
    pub spilled_registers: u64,
    /// Waves of 32 threads that fit on a SIMD at once, one of 64 counted as two; as the driver says.
    pub waves_per_simd: u64,
    /// Threads of a wave.
    pub wave_threads: u32,
    /// Of the vector operations of the loop that takes the most time.
    pub multiply_add_share: f64,
    /// Where the cycles come from.
    pub counted_by: CountedBy,
    /// Time of the busiest SIMD's vector port.
    pub vector_s: f64,
    /// Time of the workgroups' memories.
    pub workgroup_memory_s: f64,
    /// Bytes that have to be read and written.
    pub bytes: u64,
    /// Time of those at the card's bandwidth.
    pub bytes_s: f64,
}

/// Where a shader's cycles come from.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum CountedBy {
    /// Instructions times the trips of their loops.
    Assembly,
    /// The compiler's own estimate, which guesses trips: those of a loop are not plain.
    Compiler,
}

impl FrameCost {
    /// The whole frame's time.
    pub fn seconds(&self) -> f64 {
        self.stages.iter().map(StageCost::seconds).sum()
    }

    /// Labels of shaders whose registers did not fit, each with how many.
    pub fn spills(&self) -> impl Iterator<Item = (&str, u64)> {
        let dispatches = self.stages.iter().flat_map(|stage| &stage.dispatches);
        dispatches.map(|cost| (cost.shader.as_str(), cost.spilled_registers)).filter(|(_, spilled)| *spilled > 0)
    }
}

impl StageCost {
    /// Its dispatches' times together.
    pub fn seconds(&self) -> f64 {
        self.dispatches.iter().map(DispatchCost::seconds).sum()
    }

    /// The dispatch that takes the most time.
    pub fn longest(&self) -> Option<&DispatchCost> {
        self.dispatches.iter().max_by(|a, b| a.seconds().total_cmp(&b.seconds()))
    }
}

impl DispatchCost {
    /// By arithmetic or by bytes, whichever is longer.
    pub fn seconds(&self) -> f64 {
        self.arithmetic_s().max(self.bytes_s)
    }

    /// By instructions: of vectors or of the workgroup's memory, whichever takes longer.
    pub fn arithmetic_s(&self) -> f64 {
        self.vector_s.max(self.workgroup_memory_s)
    }
}

/// What a driver compiles for one card, each shader once.
pub struct Compiler {
    card: Card,
    device: NullDevice,
    compiled: HashMap<String, Compiled>,
}

/// A compiled shader.
struct Compiled {
    binary: Binary,
    assembly: Assembly,
    threads: u32,
    bindings: Vec<spirv::Binding>,
}

/// What is done for one frame: a network, double phase and levels.
pub struct FramePlan(Plan);

/// Of what features are, and so most products.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Products {
    /// Vectors in single precision.
    Single,
    /// Vectors in half precision, two at once.
    Half,
    /// Matrices in half precision, on units of their own.
    Matrices,
}

impl FramePlan {
    /// The plan of `weights` on the default bench at `resolution`.
    ///
    /// # Errors
    /// The size is nothing, or too large.
    pub fn new(weights: &Weights, resolution: Resolution, products: Products) -> Result<Self, EngineError> {
        let format = match products {
            Products::Single => Format::Single,
            Products::Half => Format::Half,
            Products::Matrices => Format::HalfTiles(MatrixUnits::DeviceOfAnySubgroups),
        };
        let features = Features { format, method: Method::Winograd };
        // A panel of 8 bits.
        let levels = [0; 3].map(|_| (0..256).collect());
        let tables = LevelTables {
            panel: resolution,
            pattern: resolution,
            origin: [0, 0],
            mirrors: [false; 2],
            interleaved: false,
            field_order: Colour::ALL,
            levels: PerColour(levels),
            flatness: PerColour([None, None, None]),
        };
        Ok(Self(NetworkPlan::new(weights, &DisplayGeometry::DEFAULT, &tables, features, LIMITS)?.plan))
    }

    /// Labels of the shaders, each once.
    pub fn shaders(&self) -> Vec<&str> {
        let mut labels: Vec<_> = self.dispatches().map(|dispatch| dispatch.shader.label.as_str()).collect();
        labels.sort_unstable();
        labels.dedup();
        labels
    }

    fn dispatches(&self) -> impl Iterator<Item = &Dispatch> {
        self.0.stages.iter().flat_map(|stage| &stage.dispatches)
    }
}

impl Compiler {
    /// Starts the driver in a process of its own: `program` with [`SERVE`].
    ///
    /// # Errors
    /// The driver or its null device is not there.
    pub fn new(program: &Path, card: Card) -> Result<Self, CostError> {
        Ok(Self { card, device: NullDevice::open(program, &card)?, compiled: HashMap::new() })
    }

    /// What the driver calls its device.
    pub fn device(&self) -> &str {
        &self.device.opened.name
    }

    /// Whether it can compile what multiplies so.
    ///
    /// # Errors
    /// Matrices are asked for, and the driver has none for the card.
    pub fn check(&self, products: Products) -> Result<(), CostError> {
        let null_device::Opened { has_matrices, driver, .. } = &self.device.opened;
        if products == Products::Matrices && !has_matrices {
            return Err(CostError::NoMatrices { card: self.card.name, driver: driver.clone() });
        }
        Ok(())
    }

    /// What one frame costs.
    ///
    /// # Errors
    /// A shader does not compile.
    pub fn cost(&mut self, plan: &FramePlan) -> Result<FrameCost, CostError> {
        let FramePlan(plan) = plan;
        let mut stages = Vec::new();
        for stage in &plan.stages {
            let dispatches = stage.dispatches.iter().map(|dispatch| self.dispatch_cost(plan, dispatch));
            let dispatches = dispatches.collect::<Result<_, _>>()?;
            stages.push(StageCost { name: stage.name.clone(), flop: stage.flop, dispatches });
        }
        Ok(FrameCost { card: self.card.name, stages })
    }

    /// The instructions of the shaders with this label.
    ///
    /// # Errors
    /// One does not compile.
    pub fn assembly(&mut self, plan: &FramePlan, label: &str) -> Result<Vec<String>, CostError> {
        let mut texts = Vec::new();
        for dispatch in plan.dispatches().filter(|dispatch| dispatch.shader.label == label) {
            let text = &self.compile(&dispatch.shader)?.binary.assembly;
            if !texts.contains(text) {
                texts.push(text.clone());
            }
        }
        Ok(texts)
    }

    fn compile(&mut self, shader: &Shader) -> Result<&Compiled, CostError> {
        let place = match self.compiled.entry(format!("{}\n{}", shader.entry, shader.source)) {
            Entry::Occupied(compiled) => return Ok(compiled.into_mut()),
            Entry::Vacant(place) => place,
        };
        let spirv::Module { words, threads, bindings } = spirv::Module::new(shader)?;
        let numbers = bindings.iter().map(|binding| binding.number).collect();
        let request = Request { spirv: words, entry: shader.entry.to_owned(), bindings: numbers };
        let refused = |reason| CostError::Shader { label: shader.label.clone(), reason };
        let binary = self.device.compile(&request).map_err(refused)?;
        let assembly = Assembly::new(&binary.assembly);
        if assembly.is_empty() {
            return Err(CostError::Untold { label: shader.label.clone(), what: "instructions" });
        }
        Ok(place.insert(Compiled { binary, assembly, threads, bindings }))
    }

    fn dispatch_cost(&mut self, plan: &Plan, dispatch: &Dispatch) -> Result<DispatchCost, CostError> {
        let Card { compute_units, clock_hz, bytes_per_s, .. } = self.card;
        let Compiled { binary, assembly, threads, bindings } = self.compile(&dispatch.shader)?;
        let label = &dispatch.shader.label;
        let statistic = |what| binary.statistic(what).ok_or(CostError::Untold { label: label.clone(), what });
        let waves_of_workgroup = u64::from(threads.div_ceil(binary.wave_threads.max(1)));
        let waves = dispatch.workgroups.iter().map(|&count| u64::from(count)).product::<u64>() * waves_of_workgroup;
        let (work, counted_by) = match assembly.work(binary.wave_threads) {
            Some(work) => (work, CountedBy::Assembly),
            None => {
                let estimate = Work { vector_cycles: statistic("Inverse Throughput")?, workgroup_bytes: 0 };
                (estimate, CountedBy::Compiler)
            }
        };
        let busiest_simd_waves = waves.div_ceil(u64::from(2 * compute_units));
        let workgroup_bytes = waves * work.workgroup_bytes;
        let bytes = dispatch.bytes.unwrap_or_else(|| {
            let times = |number: u32| {
                let found = bindings.iter().find(|binding| binding.number == number);
                found.map_or(0, |binding| u64::from(binding.read) + u64::from(binding.written))
            };
            dispatch.bindings.iter().map(|&(number, id)| times(number) * plan.buffers[id.0].bytes).sum()
        });
        Ok(DispatchCost {
            shader: label.clone(),
            vector_registers: statistic("VGPRs")?,
            spilled_registers: statistic("Spilled VGPRs")? + statistic("Spilled SGPRs")?,
            waves_per_simd: statistic("Subgroups per SIMD")?,
            wave_threads: binary.wave_threads,
            multiply_add_share: assembly.hot_loop().multiply_add_share(),
            counted_by,
            vector_s: (busiest_simd_waves * work.vector_cycles) as f64 / clock_hz,
            workgroup_memory_s: workgroup_bytes as f64
                / (f64::from(compute_units) * WORKGROUP_BYTES_PER_CYCLE * clock_hz),
            bytes,
            bytes_s: bytes as f64 / bytes_per_s,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn dispatch(spilled_registers: u64, vector_s: f64, bytes_s: f64) -> DispatchCost {
        DispatchCost {
            shader: "layer 1".into(),
            vector_registers: 100,
            spilled_registers,
            waves_per_simd: 8,
            wave_threads: 64,
            multiply_add_share: 0.9,
            counted_by: CountedBy::Assembly,
            vector_s,
            workgroup_memory_s: 0.0,
            bytes: 1,
            bytes_s,
        }
    }

    /// Canary: one shader that spills among others is named.
    #[test]
    fn a_spill_is_seen() {
        let frame = |spilled| {
            let dispatches = vec![dispatch(0, 1.0, 2.0), dispatch(spilled, 3.0, 1.0)];
            FrameCost { card: "a card", stages: vec![StageCost { name: "layer".into(), flop: 1, dispatches }] }
        };
        assert_eq!(frame(0).spills().count(), 0);
        assert_eq!(frame(3).spills().collect::<Vec<_>>(), [("layer 1", 3)]);
        assert_eq!(frame(0).seconds(), 5.0);
    }

    #[test]
    fn what_is_no_shader_is_an_error() {
        let module = |source: &str| spirv::Module::new(&Shader::new("broken", &[], source, "main"));
        let error = module("@compute @workgroup_size(1) fn main() { nonsense(); }").err().expect("nonsense");
        assert!(error.to_string().contains("broken") && error.to_string().contains("nonsense"), "{error}");
        let error = module("@compute @workgroup_size(1) fn other() {}").err().expect("another entry point");
        assert!(error.to_string().contains("main"), "{error}");
        let good = "@group(0) @binding(2) var<storage, read_write> to: array<u32>;
            @compute @workgroup_size(8, 4) fn main() { to[1] = 2u; }";
        let module = module(good).expect("a shader");
        assert_eq!(module.threads, 32);
        let [spirv::Binding { number: 2, read: false, written: true }] = module.bindings.as_slice() else {
            panic!("one binding, written");
        };
    }
}

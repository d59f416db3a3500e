//! A network on the GPU as data: its buffers, and its stages as lists of dispatches.
//!
//! Nothing here needs a device, so the same plan is run by [`GpuEngine`](super::GpuEngine) and looked at by `gpu-cost`.

use std::fmt::Write;
use std::sync::Arc;

/// What a shader begins with that has numbers of half precision.
pub(crate) const ENABLE_F16: &str = "enable f16;\n";

/// Buffers and stages of one network for frames of one size.
#[derive(Default)]
pub(crate) struct Plan {
    pub(crate) buffers: Vec<Buffer>,
    pub(crate) stages: Vec<Stage>,
}

/// One of a plan's buffers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) struct BufferId(pub(crate) usize);

/// Memory of the device that shaders read and write.
pub(crate) struct Buffer {
    /// For errors and captures.
    pub(crate) what: &'static str,
    pub(crate) bytes: u64,
    /// What it holds before the first frame; zeros where this is empty.
    pub(crate) contents: Vec<u8>,
}

/// One step of a frame.
pub(crate) struct Stage {
    pub(crate) name: String,
    /// As in [`StageTiming`](crate::engine::StageTiming).
    pub(crate) flop: u64,
    /// They run one after the other, each seeing what those before it wrote.
    pub(crate) dispatches: Vec<Dispatch>,
}

/// A shader run over a grid of workgroups.
pub(crate) struct Dispatch {
    pub(crate) shader: Arc<Shader>,
    /// The bindings that the entry point uses, in group 0.
    pub(crate) bindings: Vec<(u32, BufferId)>,
    pub(crate) workgroups: [u32; 3],
    /// The fewest bytes that have to be read and written, where that is not each buffer once.
    pub(crate) bytes: Option<u64>,
}

/// WGSL with its constants filled in.
#[derive(Debug)]
pub(crate) struct Shader {
    /// For errors, captures and tables of costs.
    pub(crate) label: String,
    pub(crate) source: String,
    pub(crate) entry: &'static str,
}

impl Shader {
    /// The entry point `entry` of `source` after the constants that `source` uses without declaring them. The lines
    /// with which `source` enables extensions come before these.
    pub(crate) fn new(
        label: impl Into<String>,
        constants: &[(&str, Constant)],
        source: &str,
        entry: &'static str,
    ) -> Self {
        let directives = source.split_inclusive('\n').take_while(|line| line.starts_with("enable "));
        let (directives, source) = source.split_at(directives.map(str::len).sum());
        let mut text = String::from(directives);
        for (name, value) in constants {
            let (kind, value) = match value {
                Constant::U32(value) => ("u32", format!("{value}u")),
                // The shortest text that is read back as the same number; WGSL wants a point or an exponent.
                Constant::F32(value) => ("f32", format!("{value:?}f")),
                Constant::Bool(value) => ("bool", value.to_string()),
            };
            writeln!(text, "const {name}: {kind} = {value};").expect("text grows");
        }
        text.push_str(source);
        Self { label: label.into(), source: text, entry }
    }
}

/// The value of a shader's constant.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Constant {
    U32(u32),
    /// A finite number.
    F32(f32),
    Bool(bool),
}

impl From<usize> for Constant {
    fn from(value: usize) -> Self {
        Self::U32(u32::try_from(value).expect("sizes on a device fit in 32 bits"))
    }
}

impl From<f32> for Constant {
    fn from(value: f32) -> Self {
        assert!(value.is_finite(), "a shader's constant is {value}");
        Self::F32(value)
    }
}

impl From<bool> for Constant {
    fn from(value: bool) -> Self {
        Self::Bool(value)
    }
}

impl Plan {
    /// A buffer of `count` values of type `T`, zero before the first frame.
    pub(crate) fn buffer<T>(&mut self, what: &'static str, count: usize) -> BufferId {
        self.add(Buffer { what, bytes: (count.max(1) * size_of::<T>()) as u64, contents: Vec::new() })
    }

    /// A buffer that holds `values`.
    pub(crate) fn table<T: bytemuck::NoUninit>(&mut self, what: &'static str, values: &[T]) -> BufferId {
        let contents = bytemuck::cast_slice(values).to_vec();
        self.add(Buffer { what, bytes: contents.len().max(4) as u64, contents })
    }

    fn add(&mut self, buffer: Buffer) -> BufferId {
        self.buffers.push(buffer);
        BufferId(self.buffers.len() - 1)
    }

    /// A stage without dispatches yet, after those that there are.
    pub(crate) fn stage(&mut self, name: impl Into<String>, flop: u64) -> &mut Stage {
        self.stages.push(Stage { name: name.into(), flop, dispatches: Vec::new() });
        self.stages.last_mut().expect("one was added")
    }
}

impl Stage {
    /// Adds a dispatch of `workgroups` with `buffers` bound as 0, 1, 2, ….
    pub(crate) fn dispatch(&mut self, shader: Shader, buffers: &[BufferId], workgroups: [usize; 3]) -> &mut Dispatch {
        self.dispatch_with(Arc::new(shader), &(0..).zip(buffers.iter().copied()).collect::<Vec<_>>(), workgroups)
    }

    /// As [`Self::dispatch`], for an entry point that leaves out some bindings of its file.
    pub(crate) fn dispatch_with(
        &mut self,
        shader: Arc<Shader>,
        bindings: &[(u32, BufferId)],
        workgroups: [usize; 3],
    ) -> &mut Dispatch {
        let workgroups = workgroups.map(|count| u32::try_from(count).expect("a grid on a device fits in 32 bits"));
        self.dispatches.push(Dispatch { shader, bindings: bindings.to_vec(), workgroups, bytes: None });
        self.dispatches.last_mut().expect("one was added")
    }
}

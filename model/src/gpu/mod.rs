//! The graphics processor, through Vulkan. Without the feature `gpu` no device can be opened.

#[cfg(feature = "gpu")]
mod device;

use std::cell::Cell;
use std::time::Duration;

#[cfg(feature = "gpu")]
pub use device::Gpu;
#[cfg(feature = "gpu")]
pub(crate) use device::first_that_opens;
#[cfg(all(test, feature = "gpu"))]
pub(crate) use device::tests::{test_adapters, test_gpu};

/// Which devices will do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Adapters {
    /// Graphics processors, and no program that plays one.
    Hardware,
    /// A processor that plays one: right, and slow.
    Software,
}

/// Which device is wanted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GpuChoice<'a> {
    /// The kind of device that it is chosen from.
    pub adapters: Adapters,
    /// The one that has this in its name, whatever its case, or is at this place of the PCI bus (`0000:01:00.0`); the
    /// best one where none is named.
    pub named: Option<&'a str>,
}

impl From<Adapters> for GpuChoice<'_> {
    fn from(adapters: Adapters) -> Self {
        Self { adapters, named: None }
    }
}

/// What multiplies matrices of 16 by 16 numbers of half precision, and sums up in single precision.
#[cfg(feature = "gpu")]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum MatrixUnits {
    /// The device's own, which a subgroup of 32 threads drives (Vulkan's cooperative matrices).
    Device,
    /// The same in subgroups of 32 or 64 threads, as the driver chooses.
    DeviceOfAnySubgroups,
    /// A workgroup of 32 threads that multiplies as they do: for tests, since software devices have none.
    #[cfg(test)]
    Threads,
    /// A workgroup of 64 threads that does so, as one subgroup or as two.
    #[cfg(test)]
    ThreadsOfAnySubgroups { in_one: bool },
}

#[cfg(feature = "gpu")]
impl MatrixUnits {
    /// Whether the driver chooses between subgroups of 32 and 64 threads.
    pub(crate) fn of_any_subgroups(self) -> bool {
        match self {
            Self::Device => false,
            Self::DeviceOfAnySubgroups => true,
            #[cfg(test)]
            Self::Threads => false,
            #[cfg(test)]
            Self::ThreadsOfAnySubgroups { .. } => true,
        }
    }

    /// Whether networks have run with them on a card, so that an engine may take them unasked.
    pub(crate) fn have_run(self) -> bool {
        self != Self::DeviceOfAnySubgroups
    }

    /// Whether layers of so many channels take less time with them than in packed half precision: subgroups of any size
    /// make 32 outputs at once.
    pub(crate) fn suit(self, channels: usize) -> bool {
        self != Self::DeviceOfAnySubgroups || channels >= 32
    }
}

/// The name of the device among `adapters` that an engine would take.
///
/// # Errors
/// There is none that can be opened.
pub fn find(adapters: Adapters) -> Result<String, GpuError> {
    #[cfg(feature = "gpu")]
    return Gpu::open(adapters.into()).map(|gpu| gpu.name().to_owned());
    #[cfg(not(feature = "gpu"))]
    {
        let _ = adapters;
        Err(GpuError::NotBuilt)
    }
}

thread_local! {
    static CATCHES: Cell<bool> = const { Cell::new(false) };
}

/// Whether a panic of this thread would be caught and become a [`GpuError`]: wgpu panics where it finds a device lost.
/// A panic hook leaves such a one alone.
pub fn panic_is_caught() -> bool {
    CATCHES.get()
}

/// What `work` gives, or the panic that it ended with.
#[cfg(feature = "gpu")]
fn caught<T>(work: impl FnOnce() -> T) -> std::thread::Result<T> {
    CATCHES.set(true);
    let done = std::panic::catch_unwind(std::panic::AssertUnwindSafe(work));
    CATCHES.set(false);
    done
}

/// Why the graphics processor cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[allow(missing_docs, reason = "the messages say what the fields are")]
pub enum GpuError {
    /// The program holds no code for it.
    #[error("this program was built without the GPU; build it with `--features gpu`, or choose --backend cpu")]
    NotBuilt,
    /// No device is there.
    #[error("Vulkan shows {} and no {wanted}, or choose --backend cpu", found(passed_over))]
    None {
        /// What was looked for, and what to do.
        wanted: &'static str,
        /// Names of devices of the other kind, such as a processor that plays a GPU.
        passed_over: Vec<String>,
    },
    /// The one that was named is not there.
    #[error(
        "Vulkan shows {}, of which none that is a GPU has `{named}` in its name or is at that place; correct the rig's model.gpu, or take it out for the best GPU",
        found(there)
    )]
    NotNamed {
        /// A part of its name, or its place.
        named: String,
        /// The devices that are there, by name and place.
        there: Vec<String>,
    },
    /// The device could not be opened.
    #[error("the GPU {name} could not be opened: {reason}; choose --backend cpu")]
    Refused {
        name: String,
        /// What its driver said.
        reason: String,
    },
    /// Something does not fit.
    #[error(
        "no room for {what}: {bytes} bytes, of which the GPU {name} can see {limit} as one; choose --backend cpu, or a smaller size"
    )]
    TooLarge {
        /// What does not fit.
        what: &'static str,
        bytes: u64,
        name: String,
        limit: u64,
    },
    /// A row or a column of the network's grid does not fit in the memory that a workgroup's threads share.
    #[error(
        "a line of {samples} samples needs {bytes} bytes of a workgroup's memory, and this GPU has {limit}; choose --backend cpu, or a smaller size"
    )]
    LineTooLong {
        /// Samples of the line.
        samples: usize,
        bytes: usize,
        limit: usize,
    },
    /// The device failed at work.
    #[error(
        "the GPU {name} failed: {reason}; start again, choose a smaller size if its memory was full, or --backend cpu"
    )]
    Failed {
        name: String,
        /// What its driver said.
        reason: String,
    },
    /// The device does not end its work. Whoever drops what it holds waits for that work, for ever perhaps.
    #[error(
        "the GPU {name} has not ended its work within {} s: it hangs; choose --backend cpu, and look at the kernel's log",
        waited.as_secs()
    )]
    Hung { name: String, waited: Duration },
}

impl GpuError {
    /// What is so, without what to do about it: for those who go on without a GPU.
    pub fn reason(&self) -> String {
        match self {
            Self::NotBuilt => "this program was built without the GPU".to_owned(),
            Self::None { passed_over, .. } => format!("Vulkan shows {} and no GPU", found(passed_over)),
            Self::NotNamed { named, there } => format!("Vulkan shows {}, of which no GPU is `{named}`", found(there)),
            Self::Refused { name, reason } => format!("the GPU {name} could not be opened: {reason}"),
            Self::TooLarge { what, bytes, name, limit } => {
                format!("{what} takes {bytes} bytes, of which the GPU {name} can see {limit} as one")
            }
            Self::LineTooLong { samples, bytes, limit } => format!(
                "a line of {samples} samples needs {bytes} bytes of a workgroup's memory, and the GPU has {limit}"
            ),
            Self::Failed { name, reason } => format!("the GPU {name} failed: {reason}"),
            Self::Hung { name, waited } => format!("the GPU {name} did not end its work within {} s", waited.as_secs()),
        }
    }
}

fn found(passed_over: &[String]) -> String {
    if passed_over.is_empty() { "nothing".to_owned() } else { passed_over.join(", ") }
}

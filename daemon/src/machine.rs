//! What can be said of this machine without naming it.

use std::fs;
use std::path::Path;

use rustix::process::{Resource, getrlimit};
use serde::{Deserialize, Serialize};

/// Class of display controllers on PCI, the first byte of three.
const PCI_DISPLAY: &str = "0x03";

/// A machine, and what holod may do on it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Machine {
    /// Version of the kernel, and its build.
    pub kernel: String,
    /// Name of the distribution.
    pub os: String,
    /// Architecture that holod was built for.
    pub architecture: String,
    /// Name of the processor.
    pub cpu: String,
    /// Cores that holod may use.
    pub cores: usize,
    /// Memory of the machine, MiB; 0 where the kernel does not tell.
    pub memory_mib: u64,
    /// Graphics cards: vendor and device on PCI, driver, and a name where the driver tells one.
    pub gpus: Vec<String>,
    pub under_systemd: bool,
    /// Greatest real-time priority that may be asked for; no limit where absent.
    pub realtime_priority_max: Option<u64>,
    /// Greatest amount of locked memory, bytes; no limit where absent.
    pub locked_memory_max: Option<u64>,
}

impl Machine {
    /// The machine that holod runs on.
    pub fn this() -> Self {
        Self::below(Path::new("/"))
    }

    /// The one whose `/proc` and `/sys` are below `root`.
    fn below(root: &Path) -> Self {
        let text = |path: &str| fs::read_to_string(root.join(path)).unwrap_or_default();
        let line = |path: &str| text(path).trim().to_owned();
        let after = |text: &str, key: &str, sign: char| {
            let lines = text.lines().filter_map(|line| line.split_once(sign));
            lines.into_iter().find(|(name, _)| name.trim() == key).map(|(_, value)| value.trim().to_owned())
        };
        let memory = after(&text("proc/meminfo"), "MemTotal", ':').unwrap_or_default();
        let kib = memory.split_whitespace().next().and_then(|kib| kib.parse::<u64>().ok());
        Self {
            kernel: format!("{} {}", line("proc/sys/kernel/osrelease"), line("proc/sys/kernel/version")),
            os: after(&text("etc/os-release"), "PRETTY_NAME", '=').unwrap_or_default().trim_matches('"').to_owned(),
            architecture: std::env::consts::ARCH.to_owned(),
            cpu: after(&text("proc/cpuinfo"), "model name", ':').unwrap_or_default(),
            cores: std::thread::available_parallelism().map_or(0, usize::from),
            memory_mib: kib.unwrap_or(0) / 1024,
            gpus: gpus(root),
            under_systemd: std::env::var_os("INVOCATION_ID").is_some(),
            realtime_priority_max: getrlimit(Resource::Rtprio).current,
            locked_memory_max: getrlimit(Resource::Memlock).current,
        }
    }

    /// The same with each of its texts as `scrub` leaves it.
    pub fn scrubbed(self, scrub: impl Fn(&str) -> String) -> Self {
        Self {
            kernel: scrub(&self.kernel),
            os: scrub(&self.os),
            architecture: scrub(&self.architecture),
            cpu: scrub(&self.cpu),
            gpus: self.gpus.iter().map(|gpu| scrub(gpu)).collect(),
            ..self
        }
    }

    /// A few lines for people.
    pub fn text(&self) -> String {
        let limit = |limit: Option<u64>| limit.map_or("none".to_owned(), |limit| limit.to_string());
        let gpus = if self.gpus.is_empty() { "none".to_owned() } else { self.gpus.join("; ") };
        format!(
            "system    {}, kernel {}, {}\n\
             processor {}, {} cores, {} MiB of memory\n\
             graphics  {gpus}\n\
             rights    real-time priority at most {}, locked memory at most {} bytes; under systemd: {}",
            self.os,
            self.kernel,
            self.architecture,
            self.cpu,
            self.cores,
            self.memory_mib,
            limit(self.realtime_priority_max),
            limit(self.locked_memory_max),
            self.under_systemd,
        )
    }
}

/// Cards on PCI, as the kernel knows them: no driver is asked.
fn gpus(root: &Path) -> Vec<String> {
    let folder = root.join("sys/bus/pci/devices");
    let Ok(entries) = fs::read_dir(folder) else { return Vec::new() };
    let mut devices: Vec<_> = entries.flatten().map(|entry| entry.path()).collect();
    devices.sort();
    let described = devices.into_iter().filter_map(|device| {
        let line = |name: &str| fs::read_to_string(device.join(name)).unwrap_or_default().trim().to_owned();
        if !line("class").starts_with(PCI_DISPLAY) {
            return None;
        }
        let driver = fs::read_link(device.join("driver")).ok();
        let driver = driver.as_deref().and_then(Path::file_name).map_or("none".into(), |name| name.to_string_lossy());
        let address = device.file_name().unwrap_or_default().to_string_lossy();
        let nvidia = fs::read_to_string(root.join(format!("proc/driver/nvidia/gpus/{address}/information")));
        let model = nvidia.unwrap_or_default();
        let model = model.lines().find_map(|line| line.strip_prefix("Model:")).map(str::trim);
        let model = model.map_or(String::new(), |model| format!(", {model}"));
        Some(format!("{}:{}, driver {driver}{model}", line("vendor"), line("device")))
    });
    described.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn facts_are_read_and_no_name_is() {
        let root = tempfile::tempdir().unwrap();
        let put = |path: &str, text: &str| {
            let path = root.path().join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        };
        put("proc/sys/kernel/osrelease", "6.1.0-18-amd64\n");
        put("proc/sys/kernel/version", "#1 SMP PREEMPT_DYNAMIC\n");
        put("proc/sys/kernel/hostname", "secret-bench\n");
        put("etc/os-release", "NAME=\"Debian\"\nPRETTY_NAME=\"Debian GNU/Linux 12\"\n");
        put("proc/cpuinfo", "processor\t: 0\nmodel name\t: A Processor @ 3 GHz\n");
        put("proc/meminfo", "MemTotal:       16384000 kB\n");
        for (device, class) in [("0000:01:00.0", "0x030000"), ("0000:02:00.0", "0x020000")] {
            put(&format!("sys/bus/pci/devices/{device}/class"), class);
            put(&format!("sys/bus/pci/devices/{device}/vendor"), "0x10de\n");
            put(&format!("sys/bus/pci/devices/{device}/device"), "0x2335\n");
        }
        put("proc/driver/nvidia/gpus/0000:01:00.0/information", "Model: \t NVIDIA H200\nIRQ: 5\n");
        let machine = Machine::below(root.path());
        assert_eq!(machine.kernel, "6.1.0-18-amd64 #1 SMP PREEMPT_DYNAMIC");
        assert_eq!((machine.os.as_str(), machine.memory_mib), ("Debian GNU/Linux 12", 16_000));
        assert_eq!(machine.cpu, "A Processor @ 3 GHz");
        assert_eq!(machine.gpus, ["0x10de:0x2335, driver none, NVIDIA H200"]);
        let said = machine.text() + &serde_json::to_string(&machine).unwrap();
        assert!(said.contains("NVIDIA H200") && !said.contains("secret-bench"), "{said}");
        let empty = tempfile::tempdir().unwrap();
        assert!(Machine::below(empty.path()).text().contains("graphics  none"));
    }
}

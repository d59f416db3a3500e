//! This process under the names that Prometheus's own libraries give every process, so that their rules and dashboards
//! fit.

use std::fmt;
use std::fs;

use prometheus_client::collector::Collector;
use prometheus_client::encoding::DescriptorEncoder;
use prometheus_client::metrics::counter::ConstCounter;
use prometheus_client::registry::Unit;
use rustix::param::{clock_ticks_per_second, page_size};
use rustix::process::{Resource, getrlimit};

use super::Teller;

/// Read from the kernel each time that it is asked for; what the kernel does not tell is left out.
#[derive(Debug)]
pub(super) struct OfProcess;

impl Collector for OfProcess {
    fn encode(&self, encoder: DescriptorEncoder) -> fmt::Result {
        let mut told = Teller(encoder);
        let text = |path| fs::read_to_string(path).unwrap_or_default();
        let units = Units { ticks_hz: clock_ticks_per_second() as f64, page_bytes: page_size() as f64 };
        if let Some(account) = Account::parse(&text("/proc/self/stat"), units) {
            let cpu_s = ConstCounter::new(account.cpu_s);
            told.tell("process_cpu", "Time that processors spent on it", Some(Unit::Seconds), &cpu_s)?;
            let bytes = || Some(Unit::Bytes);
            told.gauge("process_resident_memory", "Memory in use", bytes(), account.resident_bytes)?;
            told.gauge("process_virtual_memory", "Addresses in use", bytes(), account.virtual_bytes)?;
            told.gauge("process_threads", "Threads", None, account.threads)?;
            if let Some(t_boot_s) = boot_time_s(&text("/proc/stat")) {
                let t_start_s = t_boot_s + account.since_boot_s;
                told.gauge("process_start_time", "When it began, since 1970", Some(Unit::Seconds), t_start_s)?;
            }
        }
        if let Ok(descriptors) = fs::read_dir("/proc/self/fd") {
            // One of them is the folder that is read.
            let open = descriptors.count().saturating_sub(1);
            told.gauge("process_open_fds", "Open file descriptors", None, open as f64)?;
        }
        // No limit is one that nobody reaches.
        let max_fds = getrlimit(Resource::Nofile).current.map_or(f64::INFINITY, |limit| limit as f64);
        told.gauge("process_max_fds", "Open file descriptors that it may have", None, max_fds)
    }
}

/// What the kernel counts in.
#[derive(Clone, Copy)]
struct Units {
    ticks_hz: f64,
    page_bytes: f64,
}

/// What the kernel has on its account of a process.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Account {
    cpu_s: f64,
    threads: f64,
    /// From the machine's start to the process's.
    since_boot_s: f64,
    virtual_bytes: f64,
    resident_bytes: f64,
}

impl Account {
    /// Reads `/proc/PID/stat`, see proc(5). The name in it may hold blanks and brackets.
    fn parse(stat: &str, units: Units) -> Option<Self> {
        let after_name = stat.rsplit_once(')')?.1;
        let fields: Vec<&str> = after_name.split_whitespace().collect();
        // The first of these is the page's third.
        let field = |number: usize| fields.get(number - 3)?.parse::<f64>().ok();
        Some(Self {
            cpu_s: (field(14)? + field(15)?) / units.ticks_hz,
            threads: field(20)?,
            since_boot_s: field(22)? / units.ticks_hz,
            virtual_bytes: field(23)?,
            resident_bytes: field(24)? * units.page_bytes,
        })
    }
}

/// When the machine started, in seconds since 1970, as `/proc/stat` says.
fn boot_time_s(stat: &str) -> Option<f64> {
    stat.lines().find_map(|line| line.strip_prefix("btime ")?.trim().parse().ok())
}

#[cfg(test)]
mod tests {
    use std::time::{SystemTime, UNIX_EPOCH};

    use prometheus_client::encoding::text;
    use prometheus_client::registry::Registry;

    use super::*;

    const UNITS: Units = Units { ticks_hz: 100.0, page_bytes: 4096.0 };

    #[test]
    fn a_known_account_is_read() {
        let stat = "4711 (a ) b) S 1 4711 4711 0 -1 4194304 9 0 0 0 150 50 7 7 20 0 12 0 30000 8192000 250 1844 1 1";
        let expected = Account {
            cpu_s: 2.0,
            threads: 12.0,
            since_boot_s: 300.0,
            virtual_bytes: 8_192_000.0,
            resident_bytes: 1_024_000.0,
        };
        assert_eq!(Account::parse(stat, UNITS), Some(expected));
        assert_eq!(Account::parse(stat.rsplit_once(" 8192000").unwrap().0, UNITS), None, "it is cut short");
        assert_eq!(boot_time_s("cpu 1 2\nbtime 1790000000\nprocesses 5\n"), Some(1.79e9));
        assert_eq!(boot_time_s("cpu 1 2\n"), None);
    }

    #[test]
    fn this_process_is_told_as_it_is() {
        let mut registry = Registry::default();
        registry.register_collector(Box::new(OfProcess));
        let told = move || {
            let mut told = String::new();
            text::encode(&mut told, &registry).unwrap();
            told
        };
        let value = |told: &str, name: &str| -> f64 {
            let line = told.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' '));
            line.unwrap_or_else(|| panic!("{name} is not in:\n{told}")).parse().unwrap()
        };
        let before = told();
        let since_start_s = SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_secs_f64()
            - value(&before, "process_start_time_seconds");
        assert!((-2.0..86_400.0).contains(&since_start_s), "{since_start_s} s old");
        assert!(value(&before, "process_resident_memory_bytes") > 1e6);
        assert!(value(&before, "process_virtual_memory_bytes") > value(&before, "process_resident_memory_bytes"));
        assert!(value(&before, "process_max_fds") > value(&before, "process_open_fds"));
        let cpu_s = value(&before, "process_cpu_seconds_total");
        let held = [(); 300].map(|()| fs::File::open("/dev/null").unwrap());
        let worked = std::thread::spawn(move || {
            while value(&told(), "process_cpu_seconds_total") < cpu_s + 0.05 {
                std::hint::spin_loop();
            }
            let told = told();
            [value(&told, "process_open_fds"), value(&told, "process_threads")]
        });
        let [open_fds, threads] = worked.join().unwrap();
        assert!(open_fds >= 303.0 && threads >= 2.0, "{open_fds} {threads}");
        drop(held);
    }
}

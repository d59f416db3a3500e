//! Whether the end of a terminal is to end a program.

use std::fs;
use std::sync::OnceLock;

/// Whether the process was started so that its terminal's end is nothing to it, as `nohup` does.
pub fn hangup_is_ignored() -> bool {
    const SIGHUP: u32 = 1;
    static IGNORED: OnceLock<bool> = OnceLock::new();
    *IGNORED.get_or_init(|| {
        let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
        let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
        let mask = mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
        mask.is_some_and(|mask| mask >> (SIGHUP - 1) & 1 == 1)
    })
}

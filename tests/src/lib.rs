//! A simulated bench: the daemon as a process, a tracker on a pseudo-terminal, a judge of `frames.csv`.

pub mod counting;
pub mod daemon;
pub mod feed;
pub mod frames;
pub mod tracker;
mod worst;

use std::path::{Path, PathBuf};

use rustix::fs::statvfs;
use tempfile::TempDir;

pub use worst::worst;

/// A new folder in memory, or where there is little of that, on the disk: a disk that is busy with other work, such as
/// what a build has written, holds status files and records up for minutes.
///
/// # Panics
/// Where no folder can be made.
pub fn new_folder() -> TempDir {
    let free_bytes = statvfs(MEMORY).map_or(0, |disk| disk.f_bavail * disk.f_frsize);
    let in_memory = (free_bytes > MEMORY_BYTES).then(|| tempfile::tempdir_in(MEMORY).ok()).flatten();
    in_memory.unwrap_or_else(|| tempfile::tempdir().expect("a temporary folder"))
}

/// The folder of the recordings and scenes outside the repository.
pub fn shared_data() -> PathBuf {
    let beside = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data");
    std::env::var_os("HOLOD_SHARED_DATA").map_or_else(beside, PathBuf::from)
}

/// The built-in weights `fast`, of which every number is so large that holograms are none.
///
/// # Panics
/// Where the weights are not there.
pub fn diverged_weights() -> Vec<u8> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../model/weights/fast.safetensors");
    let mut file = std::fs::read(path).expect("the built-in weights");
    let header_bytes = u64::from_le_bytes(file[..8].try_into().expect("eight bytes")) as usize;
    for number in file[8 + header_bytes..].chunks_exact_mut(4) {
        number.copy_from_slice(&1e30f32.to_le_bytes());
    }
    file
}

/// Whether tests of shaders run on the machine's graphics card, as `HOLOD_TEST_GPU=hardware` says, and not on Mesa's
/// software device.
///
/// # Panics
/// Where the variable says something else.
pub fn on_a_graphics_card() -> bool {
    match std::env::var("HOLOD_TEST_GPU").as_deref() {
        Err(_) | Ok("software") => false,
        Ok("hardware") => true,
        Ok(other) => panic!("HOLOD_TEST_GPU is `{other}`; expected software or hardware"),
    }
}

const MEMORY: &str = "/dev/shm";
/// More than what the tests that run at one time leave in their folders.
const MEMORY_BYTES: u64 = 1 << 28;

/// A rig file for tests: the default optics on a panel of `width` x `height` pixels, which a processor keeps up with.
/// `lasers` is the text of the `[lasers]` table's driver.
pub fn small_rig(width: usize, height: usize, lasers: &str) -> String {
    format!(
        "name = \"test bench\"\n\
         [panel]\n\
         width_px = {width}\nheight_px = {height}\npixel_pitch_um = 8.0\nrefresh_hz = 60.0\nbit_depth = 8\n\
         mode = \"channel-packed\"\nfield_order = [\"green\", \"red\", \"blue\"]\nphase_sign = \"positive\"\n\
         stroke_pi = {{ red = 1.9921875, green = 1.9921875, blue = 1.9921875 }}\nsettle_ms = 2.0\n\
         [optics]\n\
         wavelengths_nm = {{ red = 638.0, green = 520.0, blue = 450.0 }}\neyepiece_focal_length_mm = 40.0\n\
         depth_far_m = inf\ndepth_near_m = 0.35\n\
         [lasers]\n\
         {lasers}\n\
         power_mw = {{ red = 1.0, green = 1.0, blue = 1.0 }}\non_delay_ms = 0.1\nlit_ms = 3.0\n\
         heartbeat_timeout_ms = 100.0\n\
         [tracker]\n\
         eye = \"left\"\nfallback_mm = 3.0\nhold_ms = 1000.0\n"
    )
}

/// The panel's field order in [`small_rig`].
pub const FIELD_ORDER: [&str; 3] = ["green", "red", "blue"];

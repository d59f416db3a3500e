//! Time to write one video frame of 1920x1080 levels as scan-out pixels, beside a bare copy of as many bytes:
//! `cargo run --release --example scan_out_speed`.

use std::hint::black_box;
use std::io::{self, Write};
use std::time::Instant;

use holod_calibration::Colour;
use holod_calibration::rig::{Packing, PanelMode, Rig};
use holod_slm_output::packing::{PIXEL_BYTES, PixelFormat, write_frame};
use holod_slm_output::{FrameLayout, LevelsFrame};

const RUNS: usize = 200;

fn main() -> io::Result<()> {
    let rig = Rig::default();
    let size = rig.resolution();
    let pitch = PIXEL_BYTES * size.width;
    let mut pixels = vec![0u8; pitch * size.height];
    let from = vec![1u8; pitch * size.height];
    report("a bare copy of the same bytes", || pixels.copy_from_slice(black_box(&from)))?;
    for mode in [PanelMode::ChannelPacked, PanelMode::FieldSequential] {
        for packing in
            Packing::ALL.into_iter().filter(|packing| mode != PanelMode::ChannelPacked || packing.fits_a_channel())
        {
            let mut frame = LevelsFrame::new(FrameLayout { mode, packing, ..FrameLayout::new(&rig.panel, size) });
            let noise = |index: u32| index.wrapping_mul(2_654_435_761) >> (32 - packing.bit_depth());
            let levels: Vec<u16> = (0..size.pixels() as u32).map(|index| noise(index) as u16).collect();
            for colour in Colour::ALL {
                frame.field_mut(colour).write(&levels);
            }
            let format = if packing.channel_bits() == 10 { PixelFormat::Xrgb10 } else { PixelFormat::Bgrx8 };
            report(&format!("{}, {}", mode.name(), packing.name()), || {
                write_frame(black_box(&frame), 0, format, pitch, black_box(&mut pixels));
            })?;
        }
    }
    report("a bare copy again", || pixels.copy_from_slice(black_box(&from)))
}

fn report(name: &str, mut work: impl FnMut()) -> io::Result<()> {
    let mut times_ms: Vec<f64> = (0..RUNS)
        .map(|_| {
            let begin = Instant::now();
            work();
            begin.elapsed().as_secs_f64() * 1e3
        })
        .collect();
    times_ms.sort_by(f64::total_cmp);
    writeln!(io::stdout(), "{name}: median {:.3} ms, best {:.3} ms", times_ms[RUNS / 2], times_ms[0])
}

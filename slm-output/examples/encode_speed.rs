//! Time to encode one frame of three patterns for a 1920x1080 panel: `cargo run --release --example encode_speed`.

use std::io::{self, Write};
use std::time::Instant;

use holod_calibration::PerColour;
use holod_calibration::rig::{PanelMode, Rig};
use holod_slm_output::{FrameLayout, LevelsFrame, PanelEncoder};

fn main() -> io::Result<()> {
    let mut rig = Rig::default();
    let size = rig.resolution();
    let noise = |index: usize| (index as u32).wrapping_mul(2_654_435_761) as f32 / u32::MAX as f32;
    let phases: Vec<f32> = (0..size.pixels()).map(|index| noise(index) * std::f32::consts::TAU).collect();
    for (name, flatness) in [("no flatness", None), ("flatness", Some(phases.clone()))] {
        rig.panel.flatness_rad = PerColour([flatness.clone(), flatness.clone(), flatness]);
        for mode in [PanelMode::ChannelPacked, PanelMode::FieldSequential] {
            rig.panel.mode = mode;
            let encoder = PanelEncoder::new(&rig.panel, size, size).map_err(io::Error::other)?;
            let mut frame = LevelsFrame::new(FrameLayout::new(&rig.panel, size));
            let mut times_ms: Vec<f64> = (0..50)
                .map(|_| {
                    let begin = Instant::now();
                    encoder.encode(PerColour([&phases; 3]), &mut frame);
                    begin.elapsed().as_secs_f64() * 1e3
                })
                .collect();
            times_ms.sort_by(f64::total_cmp);
            writeln!(io::stdout(), "{mode:?}, {name}: median {:.2} ms, best {:.2} ms", times_ms[25], times_ms[0])?;
        }
    }
    Ok(())
}

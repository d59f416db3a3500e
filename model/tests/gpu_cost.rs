//! The program `gpu-cost`, with Mesa's compiler: `mesa-vulkan-drivers` is installed where the tests run.

use std::process::{Command, Output};
use std::thread;

use serde_json::Value;

fn gpu_cost() -> Command {
    Command::new(env!("CARGO_BIN_EXE_gpu-cost"))
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// The costs of the frames that are asked for, with the least share of multiply-adds that a hot loop of products may have, and
/// the fewest waves on a SIMD.
/// The program's exit code is not 0 where a register spills or a shader does not compile.
fn judge_frames(asked: &[&str], least_share: f64, least_waves: f64) -> Vec<f64> {
    let output = gpu_cost().arg("--json").args(asked).output().expect("it starts");
    assert!(output.status.success(), "{}", said(&output));
    let frames: Vec<Value> = serde_json::from_slice(&output.stdout).expect("JSON");
    let judge = |frame: &Value| {
        let mut seconds = 0.0;
        for stage in frame["stages"].as_array().expect("stages") {
            for dispatch in stage["dispatches"].as_array().expect("dispatches") {
                let number = |key: &str| dispatch[key].as_f64().unwrap_or_else(|| panic!("{key} in {dispatch}"));
                assert_eq!(number("spilled_registers"), 0.0, "{dispatch}");
                if stage["flop"].as_u64() > Some(0) {
                    assert_eq!(dispatch["counted_by"], "assembly", "{dispatch}");
                    assert!(
                        number("multiply_add_share") >= least_share && number("waves_per_simd") >= least_waves,
                        "{dispatch}"
                    );
                }
                seconds += number("vector_s").max(number("workgroup_memory_s")).max(number("bytes_s"));
            }
        }
        let told = frame["seconds"].as_f64().expect("seconds");
        assert!((told - seconds).abs() < 1e-9 && told > 1e-4 && told < 1.0, "{told} {seconds}");
        told
    };
    frames.iter().map(judge).collect()
}

#[test]
fn no_shader_spills_what_convolves_multiplies_and_adds_and_costs_follow_pixels_and_cards() {
    let half = ["--resolution", "1920x1080", "--half-precision"];
    let asked: [(&[&str], f64); 3] =
        [(&["--card", "rx-7900-xtx"], 0.86), (&["--card", "rx-6800-xt"], 0.86), (&half, 0.75)];
    let [fast, slow, half] = thread::scope(|scope| {
        let judged = asked.map(|(asked, share)| scope.spawn(move || judge_frames(asked, share, 8.0)));
        judged.map(|judged| judged.join().expect("its frames are as they should be"))
    });
    assert_eq!([fast.len(), slow.len(), half.len()], [9, 9, 6], "three networks, of three sizes or on two cards");
    let single = fast.chunks(3).chain(slow.chunks(3));
    assert!(single.zip(&half).all(|(single, half)| *half < 0.9 * single[1]), "{fast:?} {slow:?} {half:?}");
    for (fast, slow) in fast.chunks(3).zip(slow.chunks(3)) {
        assert!(fast[2] > 3.5 * fast[1] && fast[2] < 4.5 * fast[1], "{fast:?}");
        assert!(slow[1] > 1.2 * fast[1], "{slow:?} {fast:?}");
    }
}

#[test]
fn instructions_are_printed_and_an_unknown_shader_is_told_the_known_ones() {
    let only = ["--network", "small", "--card", "rx-6800-xt", "--resolution", "512x512", "--assembly"];
    let output = gpu_cost().args(only).arg("correction layer 1").output().expect("it starts");
    assert!(output.status.success(), "{}", said(&output));
    assert!(String::from_utf8_lossy(&output.stdout).contains("v_fmac_f32"));
    let output = gpu_cost().args(only).arg("no layer").output().expect("it starts");
    assert_eq!(output.status.code(), Some(64));
    assert!(said(&output).contains("correction layer 1"), "{}", said(&output));
}

/// Where the driver has the card's matrices they are counted, and else it says what it takes to have them.
#[test]
fn matrix_units_are_costed_where_the_driver_lists_them() {
    let only = ["--matrix-units", "--network", "standard", "--resolution", "1920x1080"];
    let output = gpu_cost().args(only).output().expect("it starts");
    if output.status.success() {
        let packed =
            ["--half-precision", "--network", "standard", "--card", "rx-7900-xtx", "--resolution", "1920x1080"];
        let (matrices, packed) = (judge_frames(&only, 0.15, 6.0), judge_frames(&packed, 0.75, 8.0));
        assert!(matrices[0] < packed[0], "{matrices:?} {packed:?}");
    } else {
        assert_eq!(output.status.code(), Some(69), "{}", said(&output));
        assert!(said(&output).contains("Mesa 25.0") && said(&output).contains("16x16x16"), "{}", said(&output));
    }
    // No driver has any for a card of RDNA 2.
    let output = gpu_cost().args(only).args(["--card", "rx-6800-xt"]).output().expect("it starts");
    assert_eq!(output.status.code(), Some(69), "{}", said(&output));
    assert!(said(&output).contains("RX 6800 XT") && said(&output).contains("RDNA 3"), "{}", said(&output));
    let output = gpu_cost().args(only).arg("--half-precision").output().expect("it starts");
    assert_eq!(output.status.code(), Some(64), "{}", said(&output));
}

#[test]
fn a_driver_that_is_not_there_is_told_with_what_to_install() {
    let missing = gpu_cost().env("VK_DRIVER_FILES", "/nowhere/radeon_icd.json").output().expect("it starts");
    assert_eq!(missing.status.code(), Some(69), "{}", said(&missing));
    assert!(said(&missing).contains("mesa-vulkan-drivers"), "{}", said(&missing));
}

//! Weights made up, and what is refused of files.

use std::collections::HashMap;

use holod_calibration::Metres;
use rand::RngExt;
use safetensors::Dtype;
use safetensors::tensor::TensorView;

use super::config::{default_correction_layers, default_depth_layers, default_planes};
use super::error::{FORMAT, OLD_FORMAT};
use super::layers::{FEEDBACK_SHARE, LayerShape, SHARPNESS};
use super::metadata::VERSION;
use super::*;
use crate::conditions::TrainedRange;

/// A network with random weights of such a size that its features keep their scale and its offsets reach a few
/// pixels.
pub(crate) fn random_weights(config: NetworkConfig, seed: u64) -> Weights {
    let mut random = rand_pcg::Pcg32::new(seed, 1);
    let mut tensor = |count: usize, scale: f32| -> Vec<f32> {
        (0..count).map(|_| random.random_range(-1.0f32..1.0) * scale).collect()
    };
    let layer = |shape: &LayerShape| {
        let &LayerShape { in_channels, out_channels, .. } = shape;
        let scale = (3.0 / (9 * in_channels) as f32).sqrt();
        let modulated = OFFSET_CHANNELS * in_channels + OFFSET_CHANNELS;
        let adjustable = shape.modulation_hidden.map(|hidden| Adjustable {
            offset_weight: tensor(OFFSET_CHANNELS * in_channels * 9, 4.0 * scale),
            offset_bias: tensor(OFFSET_CHANNELS, 1.0),
            modulation: [(CONDITIONS, hidden), (hidden, hidden), (hidden, modulated)].map(|(inputs, outputs)| Dense {
                inputs,
                weight: tensor(inputs * outputs, (1.0 / inputs as f32).sqrt()),
                bias: tensor(outputs, 0.1),
            }),
        });
        Ok::<_, std::convert::Infallible>(Layer {
            out_channels,
            in_channels,
            weight: tensor(out_channels * in_channels * 9, scale),
            bias: tensor(out_channels, 0.1),
            adjustable,
        })
    };
    let number = |name: &str| Ok(if name == SHARPNESS { 1.3 } else { 0.6 });
    let family = Family::read(&config, layer, number).unwrap();
    Weights { config, family, metrics: serde_json::Value::Null, provenance: serde_json::Value::Null, file_xxh3: None }
}

/// The tensors of `weights` under the names and shapes of the file format.
fn tensors(weights: &Weights) -> Vec<(String, Vec<usize>, Vec<f32>)> {
    let stacks = match &weights.family {
        Family::Direct { layers } => vec![("layers", layers)],
        Family::ExpectedStack { lighting, correction, .. } | Family::FocalStack { lighting, correction, .. } => {
            vec![("lighting", lighting), ("correction", correction)]
        }
    };
    let layers = stacks.into_iter().flat_map(|(stack, layers)| {
        layers.iter().enumerate().map(move |(index, layer)| (format!("{stack}.{index}"), layer))
    });
    let mut tensors = Vec::new();
    for (prefix, layer) in layers {
        let Layer { out_channels, in_channels, weight, bias, adjustable } = layer;
        let mut add = |name: &str, shape: Vec<usize>, values: &Vec<f32>| {
            tensors.push((format!("{prefix}.{name}"), shape, values.clone()));
        };
        add("weight", vec![*out_channels, *in_channels, 3, 3], weight);
        add("bias", vec![*out_channels], bias);
        if let Some(Adjustable { offset_weight, offset_bias, modulation }) = adjustable {
            add("offset.weight", vec![18, *in_channels, 3, 3], offset_weight);
            add("offset.bias", vec![18], offset_bias);
            for (step, Dense { inputs, weight, bias }) in modulation.iter().enumerate() {
                add(&format!("modulation.{step}.weight"), vec![bias.len(), *inputs], weight);
                add(&format!("modulation.{step}.bias"), vec![bias.len()], bias);
            }
        }
    }
    if let Family::ExpectedStack { feedback: Feedback { share, sharpness }, .. } = weights.family {
        tensors.push((FEEDBACK_SHARE.into(), vec![1], vec![share]));
        tensors.push((SHARPNESS.into(), vec![1], vec![sharpness]));
    }
    if let Family::FocalStack { feedback_share, .. } = weights.family {
        tensors.push((FEEDBACK_SHARE.into(), vec![1], vec![feedback_share]));
    }
    tensors
}

type Tensors = Vec<(String, Vec<usize>, Vec<f32>)>;
type Entries = HashMap<String, String>;

pub(crate) fn config() -> NetworkConfig {
    NetworkConfig {
        architecture: Architecture::Direct,
        version: VERSION,
        grid: Grid::HalfBand,
        layers: 4,
        channels: 5,
        adjustable_layers: vec![2],
        modulation_hidden: 3,
        leaky_slope: 0.1,
        // On the default bench pupils of 1 to 5 mm.
        trained: TrainedRange { volume_blur_px: [100.0 / 7.0, 500.0 / 7.0], volume_fresnel_px2: [32.0, 46.0] },
        amplitude_constant: 1.4,
        depth_layers: default_depth_layers(),
        correction_layers: default_correction_layers(),
        refined_stack: false,
        planes: default_planes(),
        feedback: false,
    }
}

pub(crate) fn expected_stack_config() -> NetworkConfig {
    NetworkConfig { architecture: Architecture::ExpectedStack, depth_layers: 5, correction_layers: 4, ..config() }
}

pub(crate) fn focal_stack_config() -> NetworkConfig {
    NetworkConfig {
        architecture: Architecture::FocalStack,
        correction_layers: 4,
        planes: 3,
        feedback: true,
        ..config()
    }
}

/// A file with small random weights, after `change` has changed it.
fn file(change: impl FnOnce(&mut Tensors, &mut Entries)) -> Vec<u8> {
    file_of(config(), change)
}

fn file_of(config: NetworkConfig, change: impl FnOnce(&mut Tensors, &mut Entries)) -> Vec<u8> {
    let weights = random_weights(config, 1);
    let mut tensors = tensors(&weights);
    let mut entries = Entries::from([
        ("format".into(), FORMAT.into()),
        ("config".into(), serde_json::to_string(&weights.config).unwrap()),
        ("metrics".into(), r#"{"psnr_db": 29.0}"#.into()),
    ]);
    change(&mut tensors, &mut entries);
    let bytes: Vec<(String, Vec<usize>, Vec<u8>)> = tensors
        .into_iter()
        .map(|(name, shape, values)| (name, shape, values.into_iter().flat_map(f32::to_le_bytes).collect()))
        .collect();
    let views =
        bytes.iter().map(|(name, shape, bytes)| (name, TensorView::new(Dtype::F32, shape.clone(), bytes).unwrap()));
    safetensors::serialize(views, Some(entries)).unwrap()
}

fn error_of(change: impl FnOnce(&mut Tensors, &mut Entries)) -> String {
    Weights::from_bytes(&file(change), "test.safetensors").unwrap_err().to_string()
}

fn assert_mentions(message: &str, parts: &[&str]) {
    for part in parts {
        assert!(message.contains(part), "`{part}` is not in: {message}");
    }
}

#[test]
fn a_file_round_trips() {
    let weights = Weights::from_bytes(&file(|_, _| {}), "test").unwrap();
    let expected = random_weights(config(), 1);
    assert_eq!((&weights.config, &weights.family), (&expected.config, &expected.family));
    let refined = NetworkConfig { refined_stack: true, ..expected_stack_config() };
    for other in [expected_stack_config(), refined, focal_stack_config()] {
        let read = Weights::from_bytes(&file_of(other.clone(), |_, _| {}), "test").unwrap();
        assert_eq!((&read.config, &read.family), (&other, &random_weights(other.clone(), 1).family));
    }
    let written = |config: NetworkConfig| serde_json::to_string(&config).unwrap();
    assert!(!written(config()).contains("depth_layers") && !written(config()).contains("refined_stack"));
    assert!(written(expected_stack_config()).contains("\"depth_layers\":5,\"correction_layers\":4"));
    assert_eq!(weights.metrics()["psnr_db"], 29.0);
    assert!(weights.provenance().is_null());

    let remarked = file(|_, entries| drop(entries.insert("metrics".into(), "{\"psnr_db\": NaN}".into())));
    assert_eq!(Weights::from_bytes(&remarked, "test").unwrap().metrics(), "{\"psnr_db\": NaN}");
}

#[test]
fn the_built_in_weights_are_valid_and_fit_the_built_in_bench() {
    let weights = Weights::builtin();
    assert_eq!((weights.config().layer_count(), weights.config().channels), (18, 32));
    let small = Weights::builtin_small();
    assert_eq!((small.config().layer_count(), small.config().channels), (10, 24));
    let fast = Weights::builtin_fast();
    assert_eq!((fast.config().layer_count(), fast.config().channels), (8, 16));
    // 3.74 µm with 40 mm has the most diffraction of the benches that networks are judged on, 12.5 µm with 50 mm the
    // least.
    let gaea = DisplayGeometry { pixel_pitch: Metres(3.74e-6), ..DisplayGeometry::DEFAULT };
    let x15213 = DisplayGeometry {
        pixel_pitch: Metres(12.5e-6),
        eyepiece_focal_length: Metres(50e-3),
        ..DisplayGeometry::DEFAULT
    };
    for weights in [weights, small, fast] {
        for bench in [DisplayGeometry::DEFAULT, gaea, x15213] {
            assert_eq!(weights.fit(&bench), BenchFit::Inside);
        }
        let [narrowest, widest] = weights.trained_pupils(&DisplayGeometry::DEFAULT).map(PupilDiameter::mm);
        assert!(narrowest <= 1.0 && widest >= 8.0, "{narrowest} to {widest} mm");
    }
}

#[test]
fn the_bench_that_is_most_alike_is_quoted() {
    let bench = |name: &str, fresnel: f64, blurs: [f64; 2]| {
        let row = |blur: f64| {
            serde_json::json!({"volume_blur_px": blur, "psnr_db": fresnel + blur, "psnr_in_focus_db": 24.0,
                "slope": 0.5, "over_smooth_phase_db": 4.0})
        };
        serde_json::json!({"bench": name, "volume_fresnel_px2": [fresnel, fresnel, fresnel], "rows": blurs.map(row)})
    };
    let metrics = serde_json::json!({"benches": [
        bench("coarse", 20.0, [10.0, 30.0]), bench("alike", 36.0, [28.0, 57.0]), bench("fine", 170.0, [60.0, 90.0]),
    ]});
    let told = file(|_, entries| drop(entries.insert("metrics".into(), metrics.to_string())));
    let weights = Weights::from_bytes(&told, "test").unwrap();
    let quoted = |bench: &DisplayGeometry, pupil_mm| {
        weights.judged_on_the_like_of(bench, PupilDiameter::from_mm(pupil_mm)).map(|of| (of.name, of.judged.psnr_db))
    };
    assert_eq!(quoted(&DisplayGeometry::DEFAULT, 2.0), Some(("alike".into(), 64.0)));
    assert_eq!(quoted(&DisplayGeometry::DEFAULT, 5.0), Some(("alike".into(), 93.0)));
    let gaea = DisplayGeometry { pixel_pitch: Metres(3.74e-6), ..DisplayGeometry::DEFAULT };
    assert_eq!(quoted(&gaea, 3.0), Some(("fine".into(), 260.0)));
    for silent in ["{}", "{\"benches\": 3}", "{\"benches\": []}"] {
        let silent = file(|_, entries| drop(entries.insert("metrics".into(), silent.into())));
        let weights = Weights::from_bytes(&silent, "test").unwrap();
        assert_eq!(weights.judged_on_the_like_of(&gaea, PupilDiameter::from_mm(3.0)), None);
    }
}

#[test]
fn faulty_tensors_are_named() {
    let missing = error_of(|tensors, _| tensors.retain(|(name, ..)| name != "layers.2.offset.bias"));
    assert_mentions(&missing, &["test.safetensors", "`layers.2.offset.bias`", "absent", "[18]"]);
    let reshaped = error_of(|tensors, _| tensors[2].1 = vec![5, 5, 9, 1]);
    assert_mentions(&reshaped, &["`layers.1.weight`", "[5, 5, 9, 1]", "[5, 5, 3, 3]"]);
    let fed_back = |change: &dyn Fn(&mut Tensors)| {
        let file = file_of(expected_stack_config(), |tensors, _| change(tensors));
        Weights::from_bytes(&file, "test").unwrap_err().to_string()
    };
    for number in [FEEDBACK_SHARE, SHARPNESS] {
        let absent = fed_back(&|tensors| tensors.retain(|(name, ..)| name != number));
        assert_mentions(&absent, &[&format!("`{number}`"), "absent", "[1]"]);
    }
    let two = fed_back(&|tensors| *tensors.last_mut().unwrap() = (SHARPNESS.into(), vec![2], vec![1.0; 2]));
    assert_mentions(&two, &["`sharpness`", "[2]", "[1]"]);
    let nan = error_of(|tensors, _| tensors[1].2[3] = f32::NAN);
    assert_mentions(&nan, &["`layers.0.bias`", "NaN at index 3", "finite"]);
}

#[test]
fn faulty_metadata_is_named() {
    let set = |key: &'static str, value: &'static str| {
        error_of(move |_, entries| drop(entries.insert(key.into(), value.into())))
    };
    assert_mentions(&set("format", "holod-weights-9"), &["`format`", "holod-weights-9", "holod-weights-2"]);
    assert_mentions(&error_of(|_, entries| entries.clear()), &["`format`", "absent"]);
    assert_mentions(&set("config", "{}"), &["`config`", "missing field"]);
    let configured = |change: &dyn Fn(&mut NetworkConfig)| {
        error_of(|_, entries| {
            let mut changed = config();
            change(&mut changed);
            entries.insert("config".into(), serde_json::to_string(&changed).unwrap());
        })
    };
    // `layered` is a family that the trainer knows and no engine runs.
    for family in ["diffusion", "layered"] {
        let unknown = error_of(|_, entries| {
            let config = entries["config"].replace("\"direct\"", &format!("\"{family}\""));
            entries.insert("config".into(), config);
        });
        assert_mentions(&unknown, &["`config`", family, "`direct`", "`expected-stack`"]);
    }
    let full = file_of(NetworkConfig { grid: Grid::Full, ..expected_stack_config() }, |_, _| {});
    let full = Weights::from_bytes(&full, "test").unwrap_err().to_string();
    assert_mentions(&full, &["config.grid", "\"full\"", "half-band", "`expected-stack`"]);
    assert_mentions(&configured(&|c| c.correction_layers = 3), &["config.correction_layers", "3", "even"]);
    assert_mentions(&configured(&|c| c.depth_layers = 1), &["config.depth_layers", "1"]);
    assert_mentions(&configured(&|c| c.depth_layers = 65), &["config.depth_layers", "65", "2 to 64"]);
    assert_mentions(&configured(&|c| c.refined_stack = true), &["config.refined_stack", "true", "`expected-stack`"]);
    assert_mentions(&configured(&|c| c.planes = 1), &["config.planes", "1", "2 to 64"]);
    assert_mentions(&configured(&|c| c.feedback = true), &["config.feedback", "true", "only `focal-stack`"]);
    let without = file_of(NetworkConfig { feedback: false, ..focal_stack_config() }, |_, _| {});
    let without = Weights::from_bytes(&without, "test").unwrap_err().to_string();
    assert_mentions(&without, &["config.feedback", "false", "`--variant focal-stack-feedback`"]);
    assert_mentions(&configured(&|c| c.version = 7), &["config.version", "7"]);
    assert_mentions(&configured(&|c| c.layers = 5), &["config.layers", "5", "even"]);
    assert_mentions(&configured(&|c| c.channels = 100_000), &["config.channels", "100000"]);
    assert_mentions(&configured(&|c| c.adjustable_layers = vec![3]), &["config.adjustable_layers", "[3]"]);
    for unusable in [[5.0, 1.0], [0.0, 5.0], [-1.0, 5.0]] {
        let blur = configured(&|c| c.trained.volume_blur_px = unusable);
        assert_mentions(&blur, &["config.trained.volume_blur_px", "ascending"]);
        let fresnel = configured(&|c| c.trained.volume_fresnel_px2 = unusable);
        assert_mentions(&fresnel, &["config.trained.volume_fresnel_px2", "ascending"]);
    }
    // The reciprocal of 1e-40 is no number of single precision.
    for constant in [0.0, 1e-40] {
        assert_mentions(&configured(&|c| c.amplitude_constant = constant), &["config.amplitude_constant"]);
    }
}

#[test]
fn truncated_and_foreign_files_are_refused() {
    let whole = file(|_, _| {});
    for length in [0, 4, 9, whole.len() / 2, whole.len() - 1] {
        assert!(matches!(Weights::from_bytes(&whole[..length], "test"), Err(WeightsError::Damaged { .. })), "{length}");
    }
    let folder = tempfile::tempdir().unwrap();
    assert!(matches!(Weights::load(folder.path()), Err(WeightsError::NotAFile { .. })));
    assert!(matches!(Weights::load(&folder.path().join("absent")), Err(WeightsError::Read { .. })));
}

#[test]
fn a_file_of_the_old_format_is_told_what_it_is_and_what_to_do() {
    let old = set_format(OLD_FORMAT);
    assert_mentions(
        &old,
        &[
            "test.safetensors",
            "holod-weights-1",
            "one bench",
            "holod-weights-2",
            "`python -m holod_training export --source FILE --out NEW`",
            "short training",
            "model/training/README.md",
        ],
    );
    assert!(!set_format("holod-weights-9").contains("holod_training export"));
}

fn set_format(format: &str) -> String {
    error_of(|_, entries| drop(entries.insert("format".into(), format.into())))
}

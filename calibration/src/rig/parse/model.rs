//! `[model]`.

use std::path::Path;

use crate::Metres;
use crate::rig::files::plain_file;
use crate::rig::reader::Span;
use crate::rig::{Model, WeightsChoice};
use crate::toml_reader::Section;

const PUPIL_STEP: Span = Span::new(0.0, 1.0, "mm").slips(&[("micrometres", 1e-3)]);

pub(super) fn read_model(model: &Section<'_>, folder: &Path) -> Option<Model> {
    let network = model.choice("network", &WeightsChoice::BUILT_IN, false);
    let file = model.text("weights_file", "a safetensors file's path").map(|path| {
        let file = folder.join(path.value);
        let there = plain_file(&file).map(|_| file);
        path.with(path.of_file(there))
    });
    if let (Some(_), Some(file)) = (&network, &file) {
        let expected = "either a built-in network or a weights file";
        let advice = "remove network, or weights_file";
        file.fault("a second network", expected, advice);
    }
    let weights = match file.and_then(|file| file.value) {
        Some(file) => WeightsChoice::File(file),
        None => network.map_or(WeightsChoice::Standard, |network| network.value),
    };
    let gpu = model.text("gpu", "a part of a GPU's name, or its place on the PCI bus");
    let step_mm = model.number("pupil_step_mm", PUPIL_STEP);
    Some(Model {
        weights,
        gpu: gpu.map(|gpu| gpu.value.to_owned()),
        pupil_step: step_mm.map(|mm| Metres(mm.value / 1e3)),
    })
}

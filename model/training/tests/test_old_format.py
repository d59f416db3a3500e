"""Weights of the format before this one, made here from a network of today by taking away what it is told more."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from holod_training.config import NetworkConfig, OpticsConfig
from holod_training.export import WeightsError, export, load_weights, save_weights
from holod_training.old_format import OldFormatError, from_old_format
from holod_training.variants import build_network, variant

FIRST_LAYERS = {
    "encoded": "layers.0.weight",
    "lighting.encoded": "lighting.0.weight",
    "correction.encoded": "correction.0.weight",
}


def told_of_the_bench(config: NetworkConfig) -> dict[str, int]:
    """At which of its inputs each first layer is told the diffraction, as the network itself lays them out."""
    network = build_network(config).on(OpticsConfig(pixel_pitch_um=6.0))
    pupil_mm, trace = torch.tensor([2.8]), {}
    images = (config.planes, 3) if config.architecture == "focal-stack" else (3,)
    with torch.no_grad():
        network(torch.rand(1, *images, 16, 16), torch.rand(1, 16, 16), pupil_mm, trace)
    fresnel = network.told(pupil_mm)[0, 1]
    places = {}
    for key, name in FIRST_LAYERS.items():
        if key in trace:
            (places[name],) = (trace[key][0] == fresnel).all(dim=(1, 2)).nonzero().flatten().tolist()
    return places


def written_old(folder: Path, config: NetworkConfig, changes: dict[str, str] | None = None) -> Path:
    new = folder / "new.safetensors"
    save_weights(new, build_network(config), {"rows": 3}, {"seed": 1})
    tensors = load_file(new)
    for name, at in told_of_the_bench(config).items():
        tensors[name] = torch.cat((tensors[name][:, :at], tensors[name][:, at + 1 :]), dim=1).contiguous()
    for name in [name for name in tensors if name.endswith("modulation.0.weight")]:
        tensors[name] = tensors[name][:, :1].contiguous()
    values = json.loads(config.to_json())
    del values["trained"]
    optics = {
        "wavelengths_nm": [638.0, 520.0, 450.0],
        "pixel_pitch_um": 8.0,
        "eyepiece_focal_length_mm": 40.0,
        "depth_far_dpt": 0.0,
        "depth_near_dpt": 1 / 0.35,
    }
    values |= {"version": 1, "optics": optics, "pupil_range_mm": [1.0, 5.0]}
    metadata = {"format": "holod-weights-1", "config": json.dumps(values), "metrics": "{}", "provenance": "{}"}
    old = folder / "old.safetensors"
    save_file(tensors, old, metadata | (changes or {}))
    return old


@pytest.mark.parametrize(
    "name", ["half-band-14", "half-band-blur-input", "refined-stack-small", "focal-stack-feedback"]
)
def test_an_old_network_is_the_same_where_it_is_told_the_same(name: str, tmp_path: Path) -> None:
    """At 40 px of blur, for which it was told 2.8 mm and is told as much still but for a quarter of a map."""
    torch.manual_seed(5)
    config = variant(name)
    old = written_old(tmp_path, config)
    with pytest.raises(
        WeightsError, match=r"holod-weights-1.*convert it by `python -m holod_training export --source`"
    ):
        load_weights(old)
    network = load_weights(export(old, tmp_path / "converted.safetensors", None, None))
    assert network.config.trained.volume_blur_px == pytest.approx((100 / 7, 500 / 7))
    assert network.config.trained.volume_fresnel_px2 == pytest.approx((225 / 7, 319 / 7))
    expected = load_weights(tmp_path / "new.safetensors")
    first = told_of_the_bench(config)
    assert first
    with torch.no_grad():
        for key, value in network.state_dict().items():
            wanted = expected.state_dict()[key]
            if key in first:
                at = first[key]
                assert (value[:, at] == 0).all() and (value[:, at + 1 :] == wanted[:, at + 1 :]).all()
                assert (value[:, :at] == wanted[:, :at]).all()
            elif key.endswith("modulation.0.weight"):
                assert (value[:, 1] == 0).all() and (value[:, 0] == wanted[:, 0]).all()
            else:
                assert torch.equal(value, wanted), key
        images = (config.planes, 3) if config.architecture == "focal-stack" else (3,)
        field = network(torch.rand(1, *images, 16, 16), torch.rand(1, 16, 16), torch.tensor([2.8]))
        assert torch.isfinite(torch.view_as_real(field)).all()
        assert network.on(OpticsConfig(pixel_pitch_um=3.74)).optics.pixel_pitch_um == 3.74


def test_an_old_file_that_is_not_as_it_was_written_is_named(tmp_path: Path) -> None:
    old = written_old(tmp_path, variant("refined-stack-small"), {"config": "{}"})
    with pytest.raises(OldFormatError, match=r"old\.safetensors: found holod-weights-1 that is not as it was written"):
        from_old_format(old)

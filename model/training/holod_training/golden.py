"""Golden vectors: what each engine must reproduce, stage by stage. model/golden/README.md names the tensors.

Everything is computed in double precision from the float32 weights and inputs, and stored as float32.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors.torch import save
from torch import Tensor

from holod_training.config import ENGINE_ARCHITECTURES, NetworkConfig, OpticsConfig
from holod_training.export import check_takes_pictures, load_weights, refuse_existing, save_weights, write_beside
from holod_training.golden_evaluation import write_evaluation
from holod_training.network import AdjustableLayer, FieldNetwork, Trunk
from holod_training.optics import (
    Eye,
    double_phase,
    panel_field,
    propagate,
    propagate_padded,
    upsample_half_band,
)
from holod_training.plane_light import LIT
from holod_training.variants import build_network

GOLDEN_FORMAT = "holod-golden-1"
FOCUS_DPT = (0.25, 2.5)
ASM_DISTANCE_M = 0.0032


class Narrow(NamedTuple):
    """A random network, the size of the scene that it answers, the pupil and the bench."""

    config: NetworkConfig
    height: int
    width: int
    pupil_mm: float = 2.7
    optics: OpticsConfig = OpticsConfig()


SMALL = NetworkConfig(
    architecture="expected-stack",
    layers=4,
    channels=4,
    adjustable_layers=(2,),
    modulation_hidden=8,
    correction_layers=4,
)
OTHER_BENCH = OpticsConfig((633.0, 532.0, 473.0), 4.5, 32.0, 0.5, 3.25)
# Depth layers are left at their default, so that no engine has another.
NARROW: dict[str, Narrow] = {
    "direct-narrow": Narrow(NetworkConfig(channels=8, modulation_hidden=8), 32, 48),
    "direct-narrow-full": Narrow(NetworkConfig(grid="full", channels=8, modulation_hidden=8), 12, 16),
    # A pupil that cuts the half band; more diffraction than was trained, and a volume that does not begin at infinity.
    "expected-stack-narrow": Narrow(SMALL, 16, 24, pupil_mm=1.6, optics=OTHER_BENCH),
    "expected-stack-narrow-refined": Narrow(dataclasses.replace(SMALL, refined_stack=True), 16, 24),
    "focal-stack-narrow": Narrow(
        dataclasses.replace(SMALL, architecture="focal-stack", planes=3, feedback=True),
        16,
        24,
        pupil_mm=1.6,
        optics=OTHER_BENCH,
    ),
}


def narrow_network(config: NetworkConfig, seed: int) -> FieldNetwork:
    """Random weights; offsets of some pixels and outputs of some tenths, so that no stage is idle."""
    torch.manual_seed(seed)
    network = build_network(config)
    with torch.no_grad():
        for trunk in (module for module in network.children() if isinstance(module, Trunk)):
            for layer in trunk:
                if isinstance(layer, AdjustableLayer):
                    layer.offset.get_parameter("weight").mul_(6)
                    layer.offset.get_parameter("bias").uniform_(-1.5, 1.5)
                    layer.modulation.get_parameter("2.bias").uniform_(-0.3, 0.3)
            trunk[-1].get_parameter("weight").mul_(6)
        if config.refined_stack:
            # Some amplitudes would fall below 0.
            network.get_parameter(f"lighting.{config.layers - 1}.bias")[LIT * config.depth_layers :].uniform_(-2.5, 0.5)
    return network


def scene(height: int, width: int, seed: int) -> tuple[Tensor, Tensor]:
    """Amplitude [3, H, W] and depth [H, W]: waves, a bright disc before a dark ground, a little noise."""
    generator = torch.Generator().manual_seed(seed)
    y = torch.arange(height, dtype=torch.float32)[:, None]
    x = torch.arange(width, dtype=torch.float32)[None, :]
    waves = torch.stack([0.3 + 0.2 * torch.sin(0.4 * (c + 1) * x + 0.3 * y + c) for c in range(3)])
    disc = (y - height / 2) ** 2 + (x - width / 3) ** 2 < (height / 4) ** 2
    light = torch.where(disc, 0.9 - 0.5 * waves, 0.6 * waves)
    light = (light + 0.03 * torch.rand(light.shape, generator=generator)).clamp(0, 1)
    depth = torch.where(disc, torch.tensor(0.85), 0.1 + 0.3 * x / width + 0 * y)
    return light.sqrt(), depth


def focal_images(planes: int, height: int, width: int, seed: int) -> Tensor:
    """Amplitudes [planes, 3, H, W]: another scene's at each focus, so that none can stand for another."""
    return torch.stack([scene(height, width, seed + 1 + plane)[0].roll(5 * plane, dims=-1) for plane in range(planes)])


def complex_parts(field: Tensor) -> Tensor:
    """Complex [...] -> [2, ...]: real, imaginary."""
    return torch.stack((field.real, field.imag))


def told_layers(config: NetworkConfig) -> set[str]:
    """The trace's names of what is kept of a large network: the first, the adjustable and the last layer of a net."""
    nets = {"": (config.layers, config.adjustable_layers)}
    if config.architecture != "direct":
        nets = {"lighting.": nets[""], "correction.": (config.correction_layers, ())}
    return {
        f"{net}layer_{index}" for net, (layers, adjustable) in nets.items() for index in (0, *adjustable, layers - 1)
    }


@torch.no_grad()
def vectors(
    network: FieldNetwork, amplitude: Tensor, depth: Tensor, pupil_mm: float, every_layer: bool = True
) -> dict[str, Tensor]:
    """Every stage's answer, float64; without `every_layer` only the maps of `told_layers`. `amplitude` [3, H, W], or
    [planes, 3, H, W] for a `focal-stack`, which does not look at `depth` [H, W]."""
    config = network.config
    height, width = depth.shape
    trace: dict[str, Tensor] = {}
    pupil = torch.tensor([pupil_mm], dtype=torch.float64)
    low = network(amplitude[None].double(), depth[None].double(), pupil, trace)[0]
    field = upsample_half_band(low) if config.grid == "half-band" else low
    phase, clipped = double_phase(field, config.amplitude_constant)
    eye = Eye(network.optics, height, width, list(FOCUS_DPT))
    result = {"amplitude": amplitude, "depth": depth, "pupil_mm": pupil}
    told = told_layers(config)
    for name, value in trace.items():
        if every_layer or "layer_" not in name or name in told:
            result[name] = complex_parts(value[0]) if value.is_complex() else value[0]
    if config.grid == "half-band":
        result["low"] = complex_parts(low)
    result["field"] = complex_parts(field)
    result["clipped_share"] = torch.tensor([clipped])
    result["phase"] = phase
    result["eye_field"] = eye.look(field, pupil_mm)
    result["eye_panel"] = eye.look(panel_field(phase), pupil_mm) * config.amplitude_constant**2
    result["asm_circular"] = complex_parts(propagate(field, network.optics, ASM_DISTANCE_M))
    result["asm_padded"] = complex_parts(propagate_padded(field, network.optics, ASM_DISTANCE_M))
    return result


def write_vectors(path: Path, result: dict[str, Tensor], about: dict[str, Any]) -> None:
    metadata = {
        "format": GOLDEN_FORMAT,
        "script": "python -m holod_training golden",
        "focus_dpt": json.dumps(FOCUS_DPT),
        "asm_distance_m": json.dumps(ASM_DISTANCE_M),
        **{key: json.dumps(value) for key, value in about.items()},
    }
    tensors = {name: value.float().contiguous() for name, value in result.items()}
    write_beside(path, save(tensors, metadata))


def write_golden(
    out: Path,
    standard: Path | None,
    small: Path | None = None,
    fast: Path | None = None,
    seed: int = 20,
    force: bool = False,
) -> list[Path]:
    """Writes every golden file into `out`; `standard`, `small` and `fast` are the weights that the product has, and a
    file of another family's in their place goes. Raises WeightsError, also where such a file is there already without
    `force`."""
    shipped_as = [(suffix, path) for suffix, path in (("", standard), ("-small", small), ("-fast", fast)) if path]
    names = [f"{name}{kind}" for name in NARROW for kind in (".weights", "")]
    names += [f"{family}-shipped{suffix}" for suffix, _ in shipped_as for family in ENGINE_ARCHITECTURES]
    names += ["evaluation"] if standard else []
    refuse_existing([out / f"{name}.safetensors" for name in names], force)
    written = []
    for name, (config, height, width, pupil_mm, optics) in NARROW.items():
        weights = out / f"{name}.weights.safetensors"
        provenance = {"script": "python -m holod_training golden", "seed": seed}
        save_weights(weights, narrow_network(config, seed), {}, provenance)
        amplitude, depth = scene(height, width, seed)
        if config.architecture == "focal-stack":
            amplitude = focal_images(config.planes, height, width, seed)
        result = vectors(load_weights(weights).double().on(optics), amplitude, depth, pupil_mm)
        about = {"seed": seed, "weights": weights.name, "optics": dataclasses.asdict(optics)}
        write_vectors(out / f"{name}.safetensors", result, about)
        written += [weights, out / f"{name}.safetensors"]
    for suffix, shipped in shipped_as:
        built_in = load_weights(shipped)
        check_takes_pictures(built_in.config, shipped)
        family = built_in.config.architecture
        path = out / f"{family}-shipped{suffix}.safetensors"
        amplitude, depth = scene(32, 48, seed)
        result = vectors(built_in.double(), amplitude, depth, 3.4, every_layer=False)
        about = {"seed": seed, "weights": shipped.name, "optics": dataclasses.asdict(built_in.optics)}
        write_vectors(path, result, about)
        written.append(path)
        for other in ENGINE_ARCHITECTURES:
            if other != family:
                (out / f"{other}-shipped{suffix}.safetensors").unlink(missing_ok=True)
    if standard:
        write_evaluation(out / "evaluation.safetensors", standard, seed)
        written.append(out / "evaluation.safetensors")
    return written

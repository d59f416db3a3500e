"""Golden vectors: what each engine must reproduce, stage by stage. model/golden/README.md names the tensors.

Everything is computed in double precision from the float32 weights and inputs, and stored as float32.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save
from torch import Tensor

from holod_training.config import NetworkConfig
from holod_training.export import load_weights, save_weights, write_beside
from holod_training.golden_evaluation import write_evaluation
from holod_training.network import AdjustableLayer, DirectNetwork, FieldNetwork
from holod_training.optics import (
    Eye,
    double_phase,
    panel_field,
    propagate,
    propagate_padded,
    upsample_half_band,
)

GOLDEN_FORMAT = "holod-golden-1"
FOCUS_DPT = (0.25, 2.5)
ASM_DISTANCE_M = 0.0032


def narrow_network(grid: str, seed: int) -> DirectNetwork:
    """Eight channels, random weights; offsets of some pixels and outputs of some tenths, so that no stage is idle."""
    torch.manual_seed(seed)
    network = DirectNetwork(NetworkConfig(grid=grid, channels=8, modulation_hidden=8))
    with torch.no_grad():
        for layer in network.layers:
            if isinstance(layer, AdjustableLayer):
                layer.offset.get_parameter("weight").mul_(6)
                layer.offset.get_parameter("bias").uniform_(-1.5, 1.5)
                layer.modulation.get_parameter("2.bias").uniform_(-0.3, 0.3)
        network.get_parameter(f"layers.{network.config.layers - 1}.weight").mul_(6)
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


def complex_parts(field: Tensor) -> Tensor:
    """Complex [...] -> [2, ...]: real, imaginary."""
    return torch.stack((field.real, field.imag))


@torch.no_grad()
def vectors(
    network: FieldNetwork, amplitude: Tensor, depth: Tensor, pupil_mm: float, layers: tuple[int, ...] | None
) -> dict[str, Tensor]:
    """Every stage's answer, float64. `layers`, where given, are the only ones whose maps are kept."""
    config = network.config
    height, width = depth.shape
    trace: dict[str, Tensor] = {}
    pupil = torch.tensor([pupil_mm], dtype=torch.float64)
    low = network(amplitude[None].double(), depth[None].double(), pupil, trace)[0]
    field = upsample_half_band(low) if config.grid == "half-band" else low
    phase, clipped = double_phase(field, config.amplitude_constant)
    eye = Eye(config.optics, height, width, list(FOCUS_DPT))
    result = {"amplitude": amplitude, "depth": depth, "pupil_mm": pupil}
    result["encoded"] = trace.pop("encoded")[0]
    for name, value in trace.items():
        if layers is None or name.startswith("offsets") or int(name.removeprefix("layer_")) in layers:
            result[name] = value[0]
    if config.grid == "half-band":
        result["low"] = complex_parts(low)
    result["field"] = complex_parts(field)
    result["clipped_share"] = torch.tensor([clipped])
    result["phase"] = phase
    result["eye_field"] = eye.look(field, pupil_mm)
    result["eye_panel"] = eye.look(panel_field(phase), pupil_mm) * config.amplitude_constant**2
    result["asm_circular"] = complex_parts(propagate(field, config.optics, ASM_DISTANCE_M))
    result["asm_padded"] = complex_parts(propagate_padded(field, config.optics, ASM_DISTANCE_M))
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


def write_golden(out: Path, standard: Path | None, small: Path | None = None, seed: int = 20) -> list[Path]:
    """Writes every golden file into `out`; `standard` and `small` are the weights that the product has."""
    written = []
    for name, grid, height, width in (
        ("direct-narrow", "half-band", 32, 48),
        ("direct-narrow-full", "full", 12, 16),
    ):
        network = narrow_network(grid, seed)
        weights = out / f"{name}.weights.safetensors"
        save_weights(weights, network, {}, {"script": "python -m holod_training golden", "seed": seed})
        amplitude, depth = scene(height, width, seed)
        result = vectors(load_weights(weights).double(), amplitude, depth, 2.7, None)
        write_vectors(out / f"{name}.safetensors", result, {"seed": seed, "weights": weights.name})
        written += [weights, out / f"{name}.safetensors"]
    for name, shipped in (("direct-shipped", standard), ("direct-shipped-small", small)):
        if not shipped:
            continue
        built_in = load_weights(shipped)
        amplitude, depth = scene(32, 48, seed)
        kept = (0, *built_in.config.adjustable_layers, built_in.config.layers - 1)
        result = vectors(built_in.double(), amplitude, depth, 3.4, kept)
        write_vectors(out / f"{name}.safetensors", result, {"seed": seed, "weights": shipped.name})
        written.append(out / f"{name}.safetensors")
    if standard:
        write_evaluation(out / "evaluation.safetensors", standard, seed)
        written.append(out / "evaluation.safetensors")
    return written

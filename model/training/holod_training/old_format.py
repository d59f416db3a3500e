"""Weights files of the format `holod-weights-1`, which were for one bench and told of pupils in millimetres, as those
of today."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from holod_training.config import ConfigError, NetworkConfig, OpticsConfig, TrainedRange
from holod_training.network import OUTPUT_CHANNELS, FieldNetwork
from holod_training.variants import build_network

OLD_FORMAT = "holod-weights-1"


class OldFormatError(ConfigError):
    """An old file that cannot be converted; the message names it and says why."""


def is_old(path: Path) -> bool:
    try:
        with safe_open(path, framework="pt") as file:
            return (file.metadata() or {}).get("format") == OLD_FORMAT
    except (SafetensorError, OSError):
        return False


def from_old_format(path: Path) -> tuple[FieldNetwork, dict[str, Any], dict[str, Any]]:
    """Network, metrics and provenance of an old file. The network is told the logarithm of a blur where it learned the
    line of a pupil, from which it differs by up to a third of a millimetre from 2 to 5 mm on its own bench, and by 1
    at 1 mm: it needs a short training.

    Raises OldFormatError.
    """
    with safe_open(path, framework="pt") as file:
        metadata = file.metadata()
        state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    try:
        values = json.loads(metadata["config"])
        bench = values.pop("optics")
        optics = OpticsConfig(**{**bench, "wavelengths_nm": tuple(bench["wavelengths_nm"])})
        pupils_mm = values.pop("pupil_range_mm")
        fresnel = optics.volume_fresnel_px2
        trained = TrainedRange(
            volume_blur_px=(optics.volume_blur_px(pupils_mm[0]), optics.volume_blur_px(pupils_mm[1])),
            volume_fresnel_px2=(min(fresnel), max(fresnel)),
        )
        config = NetworkConfig.from_json(json.dumps({**values, "version": 2, "trained": vars(trained)}))
        network = build_network(config)
        network.load_state_dict(converted(state, config))
        return network.eval(), json.loads(metadata["metrics"]), json.loads(metadata["provenance"])
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise OldFormatError(f"{path}: found {OLD_FORMAT} that is not as it was written ({error})") from error


def converted(state: dict[str, Tensor], config: NetworkConfig) -> dict[str, Tensor]:
    """Every net's first layer and every modulation with one input more, for the bench, that they do not yet heed."""
    maps = 3 * config.planes if config.architecture == "focal-stack" else 5 + config.blur_input
    told = maps * (4 if config.grid == "half-band" else 1) + 1
    inserted = {"layers.0.weight": told, "lighting.0.weight": told, "correction.0.weight": OUTPUT_CHANNELS + told}
    result = dict(state)
    for name, weight in state.items():
        if name in inserted:
            at = inserted[name]
            result[name] = torch.cat((weight[:, :at], torch.zeros_like(weight[:, :1]), weight[:, at:]), dim=1)
        elif name.endswith("modulation.0.weight"):
            result[name] = torch.cat((weight, torch.zeros_like(weight)), dim=1)
    return result

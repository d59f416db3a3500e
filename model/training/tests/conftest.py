"""Small made-up shards: the format of `holod-scenes`, pictures that need no renderer."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from holod_training.config import OpticsConfig

torch.set_num_threads(1)


def write_shard(
    path: Path,
    seed: int = 0,
    size: int | tuple[int, int] = 64,
    pupils_mm: tuple[float, ...] = (1.0, 2.0, 3.0, 4.0),
    planes: int = 3,
    metadata: dict[str, str] | None = None,
    places: tuple[float, ...] | None = None,
    depth_dpt: tuple[float, float] = (OpticsConfig.depth_far_dpt, OpticsConfig.depth_near_dpt),
) -> Path:
    """A flat picture with a brighter square that fades with |focus - depth|: enough for a loss to fall. `places`, where
    given, are the focuses in place of uniform `planes`, 0 far .. 1 near; `depth_dpt` is the bench's depth range."""
    optics = OpticsConfig(depth_far_dpt=depth_dpt[0], depth_near_dpt=depth_dpt[1])
    height, width = size if isinstance(size, tuple) else (size, size)
    generator = torch.Generator().manual_seed(seed)
    image = torch.rand(3, height, width, generator=generator) * 0.2 + 0.3
    image[:, height // 4 : height // 2, width // 4 : width // 2] += 0.4
    depth = torch.linspace(0, 1, width).expand(height, width).contiguous()
    places = places or tuple(k / (planes - 1) for k in range(planes))
    focus = [optics.dioptres(place) for place in places]
    tensors = {"image": image.half(), "depth": depth}
    for index, pupil in enumerate(pupils_mm):
        mean = image.mean(dim=(1, 2), keepdim=True)
        share = torch.stack([(depth - place).abs() for place in places])[:, None] * pupil / 5
        tensors[f"stack_{index}"] = (image * (1 - share) + mean * share).half()
    values = {
        "format": "holod-scene-1",
        "seed": str(seed),
        "index": str(seed),
        "kind": "test",
        "pupils_mm": json.dumps(pupils_mm),
        "focus_dpt": json.dumps(focus),
        "far_dpt": str(optics.depth_far_dpt),
        "near_dpt": str(optics.depth_near_dpt),
        "pixel_angle_rad": str(optics.pixel_angle_rad),
        "rays": "64",
        **(metadata or {}),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    save_file(tensors, path, values)
    return path


@pytest.fixture
def no_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing curves costs more than training a tiny run does."""
    monkeypatch.setattr("holod_training.train.plot_curves", lambda run: run)


@pytest.fixture
def shards(tmp_path: Path) -> Path:
    folder = tmp_path / "shards"
    for index in range(2):
        write_shard(folder / f"scene_{index:06}.safetensors", seed=index)
    return folder

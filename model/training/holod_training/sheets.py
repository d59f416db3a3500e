"""Sheets of pictures, and the pictures that go on them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image
from torch import Tensor

from holod_training.judging import Bench, Method
from holod_training.shards import Shard
from holod_training.srgb import srgb_encoded

SHEET_SCENES = 2
SHEET_PUPILS_MM = (2.0, 4.0)


def srgb(linear: Tensor) -> np.ndarray:
    """Linear light [3, H, W] -> 8-bit sRGB [H, W, 3]."""
    return (srgb_encoded(linear.cpu()) * 255 + 0.5).byte().permute(1, 2, 0).numpy()


def save_sheet(path: Path, lines: list[list[Tensor]], gap_px: int = 4) -> None:
    """One row of tiles for each line, all tiles of one size [3, H, W], linear light."""
    rows = []
    for line in lines:
        tiles = [np.pad(srgb(t), ((0, gap_px), (0, gap_px), (0, 0)), constant_values=255) for t in line]
        rows.append(np.concatenate(tiles, axis=1))
    part = path.with_name(f".{path.name}.part")
    Image.fromarray(np.concatenate(rows, axis=0)).save(part, format="PNG", optimize=True)
    part.replace(path)


def write_sheet(path: Path, shards: list[Shard], ours: Method, bench: Bench) -> None:
    """Rows: scenes by pupils; columns: target far, ours far, target near, ours near (after double phase)."""
    lines = []
    for shard in shards[:SHEET_SCENES]:
        chosen = [i for i, p in enumerate(shard.pupils_mm) if p in SHEET_PUPILS_MM] or [len(shard.pupils_mm) - 1]
        for index in chosen:
            stack = bench.read(shard, index)
            panel, _ = bench.panel(ours.field(stack, stack.pupil_mm), ours.amplitude_constant)
            far, near = bench.look(panel, stack.pupil_mm, (stack.focus_dpt[0], stack.focus_dpt[-1]))
            lines.append([stack.target[0], far, stack.target[-1], near])
    save_sheet(path, lines)

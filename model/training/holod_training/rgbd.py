"""Real RGB-D pictures through the network: nothing to measure against, so a sheet to look at."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from holod_training.config import OpticsConfig
from holod_training.judging import Bench, Method
from holod_training.shards import Stack
from holod_training.sheets import SHEET_PUPILS_MM, save_sheet

COLOUR_SUFFIXES = (".jpg", ".jpeg", ".png")
MOST_PAIRS = 4
NEAR_SHARE, FAR_SHARE = 0.95, 0.05


class RgbdError(ValueError):
    """A folder of RGB-D pictures that cannot be used; the message names it and what was expected."""


def find_pairs(folder: Path) -> list[tuple[Path, Path]]:
    """(colour, depth) for every `rgb/NAME.jpg` or `.png` below `folder` that has a `depth/NAME.png` beside it."""
    pairs = [
        (colour, depth)
        for colour in sorted(folder.rglob("rgb/*"))
        if colour.suffix.lower() in COLOUR_SUFFIXES
        and (depth := colour.parent.parent / "depth" / f"{colour.stem}.png").is_file()
    ]
    if not pairs:
        raise RgbdError(
            f"{folder}: no RGB-D pairs in it; expected rgb/NAME.jpg (or .png) and depth/NAME.png in 16-bit millimetres"
        )
    return pairs


def read_pair(colour: Path, depth: Path, optics: OpticsConfig) -> tuple[Tensor, Tensor]:
    """Linear light [3, H, W] and normalised depth [H, W]; depth in millimetres, 0 = missing, filled from around it.

    Odd sizes lose their last row or column; what lies outside the bench's depth volume is put on its near or far end.
    """
    encoded = torch.from_numpy(np.array(Image.open(colour).convert("RGB"), dtype=np.float32) / 255)
    linear = torch.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4).permute(2, 0, 1)
    millimetres = torch.from_numpy(np.array(Image.open(depth)).astype(np.float32))
    if millimetres.dim() != 2 or millimetres.shape != linear.shape[1:]:
        raise RgbdError(
            f"{depth}: shape {list(millimetres.shape)}, expected one channel of {list(linear.shape[1:])} as in "
            f"{colour.name}"
        )
    valid = millimetres > 0
    if not valid.any():
        raise RgbdError(f"{depth}: every pixel is 0, which means missing")
    dioptres = torch.where(valid, 1000 / millimetres.clamp_min(1), torch.zeros(()))
    volume = optics.depth_near_dpt - optics.depth_far_dpt
    normalised = ((fill_missing(dioptres, valid) - optics.depth_far_dpt) / volume).clamp(0, 1)
    height, width = (size // 2 * 2 for size in normalised.shape)
    return linear[:, :height, :width].contiguous(), normalised[:height, :width].contiguous()


def fill_missing(values: Tensor, valid: Tensor) -> Tensor:
    """Pixels of [H, W] that are not valid, from the rim of each hole inwards, become the mean of known neighbours."""
    known = valid.to(values.dtype)[None, None]
    filled = values[None, None] * known
    while not bool(known.all()):
        weight = F.avg_pool2d(known, 3, stride=1, padding=1)
        mean = F.avg_pool2d(filled, 3, stride=1, padding=1) / weight.clamp_min(1e-9)
        reached = (known == 0) & (weight > 0)
        filled = torch.where(reached, mean, filled)
        known = torch.where(reached, torch.ones_like(known), known)
    return filled[0, 0]


def write_rgbd_sheet(path: Path, folder: Path, ours: Method, bench: Bench) -> int:
    """Rows: pictures; columns: the picture, then near and far focus at s = 2 and 4 mm after double phase.

    Near and far are the dioptres that 5 % of the picture's pixels lie beyond on either side. Returns how many pictures.
    """
    lines = []
    for colour, depth in find_pairs(folder)[:MOST_PAIRS]:
        image, normalised = (t.to(bench.device) for t in read_pair(colour, depth, bench.optics))
        ends = np.quantile(normalised.cpu().numpy(), (NEAR_SHARE, FAR_SHARE))
        focus = tuple(bench.optics.dioptres(float(end)) for end in ends)
        line = [image]
        for pupil in SHEET_PUPILS_MM:
            panel, _ = bench.panel(ours.field(Stack(image, normalised, image[None], pupil, focus), pupil))
            line += list(bench.look(panel, pupil, focus))
        lines.append(line)
    if len({tuple(line[0].shape) for line in lines}) > 1:
        raise RgbdError(f"{folder}: pictures of different sizes; a sheet needs one size")
    save_sheet(path, lines)
    return len(lines)

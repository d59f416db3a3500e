"""Real RGB-D pictures through the network: nothing to measure against, so a sheet to look at."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageOps
from torch import Tensor

from holod_training.config import OpticsConfig
from holod_training.depth_faults import fill_holes
from holod_training.judging import Bench, Method
from holod_training.shards import Stack
from holod_training.sheets import SHEET_PUPILS_MM, save_sheet
from holod_training.srgb import srgb_decoded

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


def read_image(path: Path, mode: str | None = None) -> Tensor:
    """The file's values, float32, turned by its EXIF orientation; as they are, or converted to a mode of Pillow's."""
    try:
        with Image.open(path) as image:
            turned = ImageOps.exif_transpose(image)
            return torch.from_numpy(np.array(turned if mode is None else turned.convert(mode)).astype(np.float32))
    except (OSError, SyntaxError) as error:
        raise RgbdError(f"{path}: not a readable picture ({error})") from error


def read_pair(colour: Path, depth: Path, optics: OpticsConfig) -> tuple[Tensor, Tensor]:
    """Linear light [3, H, W] and normalised depth [H, W]; depth in millimetres, 0 = missing, filled as holod does.

    Odd sizes lose their last row or column; what lies outside the bench's depth volume is put on its near or far end.
    """
    linear = srgb_decoded(read_image(colour, "RGB") / 255).permute(2, 0, 1)
    millimetres = read_image(depth)
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
    normalised = ((fill_holes(dioptres, ~valid) - optics.depth_far_dpt) / volume).clamp(0, 1)
    height, width = (size // 2 * 2 for size in normalised.shape)
    return linear[:, :height, :width].contiguous(), normalised[:height, :width].contiguous()


def read_pictures(folder: Path, optics: OpticsConfig) -> list[tuple[Tensor, Tensor]]:
    """The first four of `find_pairs`, read. Raises RgbdError for one of another size than the first, too."""
    pairs = find_pairs(folder)[:MOST_PAIRS]
    pictures = [read_pair(colour, depth, optics) for colour, depth in pairs]
    for (colour, _), (image, _) in zip(pairs, pictures, strict=True):
        found, expected = list(image.shape[1:]), list(pictures[0][0].shape[1:])
        if found != expected:
            raise RgbdError(f"{colour}: shape {found}, expected {expected} as in {pairs[0][0]}: a sheet needs one size")
    return pictures


def write_rgbd_sheet(path: Path, pictures: list[tuple[Tensor, Tensor]], ours: Method, bench: Bench) -> None:
    """Rows: pictures; columns: the picture, then near and far focus at s = 2 and 4 mm after double phase.

    Near and far are the dioptres that 5 % of the picture's pixels lie beyond on either side.
    """
    lines = []
    for image, depth in pictures:
        image, depth = image.to(bench.device), depth.to(bench.device)
        ends = np.quantile(depth.cpu().numpy(), (NEAR_SHARE, FAR_SHARE))
        focus = tuple(bench.optics.dioptres(float(end)) for end in ends)
        line = [image]
        for pupil in SHEET_PUPILS_MM:
            field = ours.field(Stack(image, depth, image[None], pupil, focus), pupil)
            panel, _ = bench.panel(field, ours.amplitude_constant)
            line += list(bench.look(panel, pupil, focus))
        lines.append(line)
    save_sheet(path, lines)

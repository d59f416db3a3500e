"""What depth cameras get wrong: noise, holes, edges beside the picture's, coarse steps.

Depth is [H, W], 0 far .. 1 near, uniform in dioptres, as are disparities: noise of stereo and structured light is
alike at all depths there.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

LARGEST_NOISE = 0.02
MOST_HOLES = 6
LARGEST_HOLE_PX = 10
STEPS = 255


def faulty_depth(depth: Tensor, rng: np.random.Generator) -> Tensor:
    """Depth with each of the four faults at even chance; the same shape, 0 .. 1."""
    moved, pierced, noisy, coarse = (bool(b) for b in rng.integers(0, 2, 4))
    result = depth
    if moved:
        result = move_edges(result, int(rng.integers(4)))
    if pierced:
        result = fill_holes(result, holes(depth.shape, rng))
    if noisy:
        sigma = np.float32(rng.uniform(0, LARGEST_NOISE))
        noise = rng.standard_normal(tuple(depth.shape), dtype=np.float32) * sigma
        result = result + torch.from_numpy(noise)
    result = result.clamp(0, 1)
    return coarse_steps(result) if coarse else result


def move_edges(depth: Tensor, way: int) -> Tensor:
    """Near things grown (0) or shrunk (1) by a pixel, or all depth a pixel to the right (2) or down (3)."""
    if way < 2:
        sign = 1 if way == 0 else -1
        return sign * F.max_pool2d(sign * depth[None, None], 3, stride=1, padding=1)[0, 0]
    return torch.cat((depth[:, :1], depth[:, :-1]), 1) if way == 2 else torch.cat((depth[:1], depth[:-1]), 0)


def holes(shape: torch.Size, rng: np.random.Generator) -> Tensor:
    """Where depth is missing, bool [H, W]: ellipses of up to `LARGEST_HOLE_PX` radius, one at least."""
    height, width = shape
    rows, columns = torch.arange(height)[:, None], torch.arange(width)
    missing = torch.zeros(height, width, dtype=torch.bool)
    for _ in range(int(rng.integers(1, MOST_HOLES + 1))):
        y, x = int(rng.integers(height)), int(rng.integers(width))
        ry, rx = rng.uniform(1, LARGEST_HOLE_PX, 2)
        missing |= ((rows - y) / ry) ** 2 + ((columns - x) / rx) ** 2 <= 1
    return missing


def fill_holes(depth: Tensor, missing: Tensor) -> Tensor:
    """Missing pixels get the farthest of the nearest known ones to their left, right, top and bottom, as holod fills
    them; those that see none, of the pixels that were filled so. All missing gives 0."""
    if bool(missing.all()):
        return torch.zeros_like(depth)
    while bool(missing.any()):
        unseen = torch.where(missing, torch.inf, depth)
        farthest = torch.full_like(depth, torch.inf)
        for axis in (0, 1):
            farthest = farthest.minimum(_last_known(unseen, axis))
            farthest = farthest.minimum(_last_known(unseen.flip(axis), axis).flip(axis))
        depth = torch.where(missing, farthest, depth)
        missing = depth.isinf()
    return depth


def _last_known(depth: Tensor, axis: int) -> Tensor:
    """For each pixel the last finite one up to it along `axis`; infinity where there is none."""
    places = torch.arange(depth.shape[axis], device=depth.device)
    places = places[:, None] if axis == 0 else places
    last = torch.where(depth.isinf(), -1, places).cummax(axis).values
    return torch.where(last < 0, torch.inf, depth.gather(axis, last.clamp_min(0)))


def coarse_steps(depth: Tensor) -> Tensor:
    """Rounded to 8 bits."""
    return (depth * STEPS).round() / STEPS

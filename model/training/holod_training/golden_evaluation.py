"""The golden shard: a small scene with what the evaluation finds on it, for `holod evaluate` to find again."""

from __future__ import annotations

import json
import math
import tempfile
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from safetensors.torch import save
from torch import Tensor

from holod_training.config import OpticsConfig
from holod_training.export import load_weights, write_beside
from holod_training.judging import Bench, network_field
from holod_training.loss import inner
from holod_training.metrics import gradient_energy, psnr_db
from holod_training.rivals import flat_oracle
from holod_training.shards import SHARD_FORMAT, Shard

HEIGHT, WIDTH = 80, 112
PUPILS_MM = (2.0, 4.0)
BORDER_PX = 16
SEAM_PX = 16
NEAR_DPT, MIDDLE_DPT, FAR_DPT = 2.5, (1.03, 1.77), 0.25
FOCUS_DPT = (FAR_DPT, 1.4, NEAR_DPT)
COLUMNS = (range(0, 48), range(48, 64), range(64, WIDTH))  # near, slanted middle, far


def textures(seed: int) -> Tensor:
    """Linear light [3, H, W], float64: waves, bright ticks and one spot that is too bright."""
    generator = torch.Generator().manual_seed(seed)
    y = torch.arange(HEIGHT, dtype=torch.float64)[:, None]
    x = torch.arange(WIDTH, dtype=torch.float64)[None, :]
    waves = torch.stack([0.4 + 0.2 * torch.sin(0.11 * (c + 1) * x + 0.09 * (3 - c) * y + c) for c in range(3)])
    ticks = (x % 15 < 4) & (y % 19 < 12)
    bright = torch.tensor([0.9, 1.0, 0.75], dtype=torch.float64)[:, None, None]
    light = torch.where(ticks, bright, waves)
    light[:, 40:46, 84:90] = 1.9  # more than double phase can show
    return light + 0.02 * torch.rand(light.shape, generator=generator, dtype=torch.float64)


def blurred(light: Tensor, diameter_px: float) -> Tensor:
    """Light [3, H, W] averaged over a disc; beyond its edges the picture is mirrored."""
    radius = math.ceil(diameter_px / 2)
    offsets = torch.arange(-radius, radius + 1, dtype=light.dtype)
    disc = (diameter_px / 2 + 0.5 - torch.hypot(offsets[:, None], offsets[None, :])).clamp(0, 1)
    padded = F.pad(light[:, None], (radius,) * 4, mode="reflect") if radius else light[:, None]
    return F.conv2d(padded, (disc / disc.sum())[None, None])[:, 0]


def scene(optics: OpticsConfig, seed: int) -> tuple[Tensor, Tensor, list[Tensor]]:
    """image [3, H, W], depth [H, W] and a stack [K, 3, H, W] for each pupil: three cards side by side, each blurred as
    a whole, and their mean. No eye sees exactly that, but what is compared with it does not matter here."""
    light = textures(seed)
    dioptres = torch.full((HEIGHT, WIDTH), FAR_DPT, dtype=torch.float64)
    near, middle, _ = COLUMNS
    dioptres[:, near.start : near.stop] = NEAR_DPT
    dioptres[:, middle.start : middle.stop] = torch.linspace(
        MIDDLE_DPT[1], MIDDLE_DPT[0], len(middle), dtype=torch.float64
    )
    stacks = []
    for pupil_mm in PUPILS_MM:
        planes = []
        for focus_dpt in FOCUS_DPT:
            picture, cover = torch.zeros_like(light), torch.zeros_like(light)
            for columns in COLUMNS:
                card = torch.zeros_like(light)
                card[..., columns.start : columns.stop] = 1
                defocus_dpt = abs(float(dioptres[0, columns.start : columns.stop].mean()) - focus_dpt)
                diameter_px = defocus_dpt * pupil_mm * 1e-3 / optics.pixel_angle_rad
                picture += blurred(card * light, diameter_px)
                cover += blurred(card, diameter_px)
            planes.append(picture / cover)
        stacks.append(torch.stack(planes))
    depth = (dioptres - optics.depth_far_dpt) / (optics.depth_near_dpt - optics.depth_far_dpt)
    return light, depth, stacks


def card_area(columns: range) -> Tensor:
    """A card without the picture's border and a strip along its edges, [H, W] bool."""
    area = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    left = BORDER_PX if columns.start == 0 else columns.start + SEAM_PX
    right = WIDTH - BORDER_PX if columns.stop == WIDTH else columns.stop - SEAM_PX
    area[BORDER_PX : HEIGHT - BORDER_PX, left:right] = True
    return area


@torch.no_grad()
def found(shard: Shard, weights: Path) -> dict[str, Any]:
    """What the evaluation finds from 8-bit panel levels: a row for each pupil, and the matrix PSNR(given, judged)."""
    network = load_weights(weights)
    bench = Bench(network.optics, network.config.amplitude_constant, BORDER_PX)
    stacks = list(shard.stacks())
    areas = {name: card_area(columns) for name, columns in (("near", COLUMNS[0]), ("far", COLUMNS[2]))}
    rows, matrix = [], []
    for stack in stacks:
        shown, clipped = bench.panel(network_field(network, stack, stack.pupil_mm))
        near_focus, far_focus = bench.look(shown, stack.pupil_mm, (NEAR_DPT, FAR_DPT))
        judged = bench.judge(bench.look(shown, stack.pupil_mm, stack.focus_dpt), stack).known()
        near, far = ([gradient_energy(p, areas[name]) for p in (near_focus, far_focus)] for name in ("near", "far"))
        rows.append(
            {
                "pupil_mm": stack.pupil_mm,
                **judged,
                "flat_oracle_psnr_db": bench.judge(flat_oracle(stack.target), stack).psnr_db,
                "clipped_share": clipped,
                "near_card": near[0] / near[1],
                "far_card": far[1] / far[0],
            }
        )
        pictures = [bench.look(shown, seen.pupil_mm, seen.focus_dpt) for seen in stacks]
        errors = [inner(p - seen.target, BORDER_PX).square() for p, seen in zip(pictures, stacks, strict=True)]
        matrix.append([psnr_db(error) for error in errors])
    return {"rows": rows, "matrix_psnr_db": matrix}


def write_evaluation(path: Path, weights: Path, seed: int) -> None:
    """A shard that serves as a test scene and, once its `kind` says so, as cards, whose metadata has `weights`,
    `border_px` and what is to be `found` besides."""
    optics = OpticsConfig()
    image, depth, stacks = scene(optics, seed)
    tensors = {"image": image.half(), "depth": depth.float()}
    tensors |= {f"stack_{index}": stack.half() for index, stack in enumerate(stacks)}
    metadata = {
        "format": SHARD_FORMAT,
        "script": "python -m holod_training golden",
        "kind": "test",
        "seed": json.dumps(seed),
        "index": "0",
        "pupils_mm": json.dumps(PUPILS_MM),
        "focus_dpt": json.dumps(FOCUS_DPT),
        "far_dpt": json.dumps(optics.depth_far_dpt),
        "near_dpt": json.dumps(optics.depth_near_dpt),
        "pixel_angle_rad": json.dumps(optics.pixel_angle_rad),
        "rays": "0",
        "weights": json.dumps(weights.name),
        "border_px": json.dumps(BORDER_PX),
    }
    with tempfile.TemporaryDirectory() as folder:
        unjudged = Path(folder) / path.name
        write_beside(unjudged, save(tensors, metadata))
        metadata["found"] = json.dumps(found(Shard(unjudged), weights))
    write_beside(path, save(tensors, metadata))

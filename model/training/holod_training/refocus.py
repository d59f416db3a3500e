"""The refocus ratio of text-like cards: gradient energy in focus over out of focus."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from holod_training.config import OpticsConfig
from holod_training.judging import OURS, Bench, Method, means
from holod_training.loss import inner
from holod_training.metrics import gradient_energy
from holod_training.shards import Shard, ShardError, check_kind
from holod_training.sheets import SHEET_PUPILS_MM, save_sheet

# On the default bench, for which scenes are laid out; on another, at the same place of its depth range.
CARDS_DPT = {"near": 2.5, "far": 0.25}
LAID_OUT = OpticsConfig()
SEAM_PX = 16
LEAST_AREA_PX = 256
PUPILS_MM = (1.0, 2.0, 3.0, 4.0, 5.0)


def cards_dpt(optics: OpticsConfig) -> tuple[float, ...]:
    """Where the near and the far card stand on a bench."""
    return tuple(
        optics.dioptres((card_dpt - LAID_OUT.depth_far_dpt) / LAID_OUT.volume_dpt) for card_dpt in CARDS_DPT.values()
    )


def card_areas(depth: Tensor, border_px: int) -> dict[str, Tensor]:
    """Where each card is, [H, W] bool, without the picture's border and a strip along the card's edges."""
    areas = {}
    for name, card_dpt in CARDS_DPT.items():
        dioptres = LAID_OUT.depth_far_dpt + depth * LAID_OUT.volume_dpt
        outside = ((dioptres - card_dpt).abs() > 0.05).float()
        near_edge = F.max_pool2d(outside[None, None], 2 * SEAM_PX + 1, stride=1, padding=SEAM_PX)[0, 0] > 0
        area = ~near_edge
        kept = torch.zeros_like(area)
        inner(kept, border_px).copy_(inner(area, border_px))
        areas[name] = kept
    return areas


def refocus_cards(
    shards: list[Shard],
    methods: list[Method],
    bench: Bench,
    sheet: Path | None = None,
    pupils_mm: Sequence[float] = PUPILS_MM,
) -> list[dict[str, Any]]:
    """The ratio of every method that does not need a target, after double phase, at these pupils, means over the scenes
    of each contrast; and a sheet of ours, where it is named. Methods that are given focal stacks are judged at the
    pupils that all cards have these for."""
    rows = []
    pictures = []
    focus = cards_dpt(bench.optics)
    of_all = [pupil for pupil in pupils_mm if all(pupil in shard.pupils_mm for shard in shards)]
    for shard in shards:
        check_kind(shard, "cards")
        stack = bench.read(shard, 0)
        areas = card_areas(stack.depth, bench.border_px)
        for name, area in areas.items():
            if int(area.sum()) < LEAST_AREA_PX:
                raise ShardError(f"{shard.path}: no {name} card found at its depth; write it with --kind cards")
        line = [stack.image]
        for method in methods:
            panel = None
            for pupil in of_all if method.takes_stack else pupils_mm:
                if panel is None or method.adapts:
                    given = shard.pupils_mm.index(pupil) if pupil in shard.pupils_mm else 0
                    field = method.field(bench.read(shard, given), pupil)
                    panel, _ = bench.panel(field, method.amplitude_constant)
                near_focus, far_focus = bench.look(panel, pupil, focus)
                energy = {
                    name: (gradient_energy(near_focus, area), gradient_energy(far_focus, area))
                    for name, area in areas.items()
                }
                rows.append(
                    {
                        "method": method.name,
                        "contrast": "dark on bright" if shard.index % 2 == 0 else "bright on dark",
                        "pupil_mm": pupil,
                        "near_card": energy["near"][0] / energy["near"][1],
                        "far_card": energy["far"][1] / energy["far"][0],
                    }
                )
                if method.name == OURS and pupil in SHEET_PUPILS_MM:
                    line += [near_focus, far_focus]
        pictures.append(line)
    if sheet:
        save_sheet(sheet, pictures)
    return means(rows, ("method", "contrast", "pupil_mm"))

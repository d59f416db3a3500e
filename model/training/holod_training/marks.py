"""Bright marks on exact black: how much light is seen of what was put in, and how much where there is none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torch import Tensor

from holod_training.judging import AFTER, BEFORE, OURS, Bench, Method, means
from holod_training.loss import LEAST_LIGHT, dark_area
from holod_training.shards import Shard, ShardError, check_kind
from holod_training.sheets import save_sheet

KINDS = ("dots", "lines", "stars")
LEAST_AREA_PX = 256


def light_ratio(picture: Tensor, target: Tensor) -> float:
    """All light of a stack [K, 3, H, W] over that of its target."""
    return float(picture.double().sum() / target.double().sum())


def judge_marks(shards: list[Shard], methods: list[Method], bench: Bench, sheet: Path) -> list[dict[str, Any]]:
    """A row for each kind of marks, method and pupil, before and after double phase, means over scenes; and a sheet of
    ours, focused near and far at the widest pupil. Raises ShardError for scenes of another kind."""
    rows, pictures = [], []
    for shard in shards:
        check_kind(shard, "marks")
        for index, pupil in enumerate(shard.pupils_mm):
            stack = bench.read(shard, index)
            dark = dark_area(stack.target)
            if int(dark.sum()) < LEAST_AREA_PX:
                raise ShardError(f"{shard.path}: nothing of it stays black; write larger ones with --kind marks")
            if not float(stack.target.amax()) > LEAST_LIGHT:
                raise ShardError(
                    f"{shard.path}: {stack.target.shape[-1]}x{stack.target.shape[-2]} has no room for marks, expected "
                    "96x120 or more; write larger ones with --kind marks"
                )
            for method in methods:
                field = method.field(stack, pupil)
                panel, _ = bench.panel(field, method.amplitude_constant)
                for stage, shown in ((BEFORE, field), (AFTER, panel)):
                    seen = bench.look(shown, bench.same_to_the_eye(pupil), stack.focus_dpt)
                    rows.append(
                        {
                            "marks": KINDS[shard.index % len(KINDS)],
                            "method": method.name,
                            "double_phase": stage,
                            "pupil_mm": pupil,
                            "light_ratio": light_ratio(seen, stack.target),
                            "dark_mean": float(seen[..., dark].double().mean()),
                        }
                    )
                    if method.name == OURS and stage == AFTER and index == len(shard.pupils_mm) - 1:
                        pictures.append([stack.image, seen[-1], seen[0]])
    save_sheet(sheet, pictures)
    return means(rows, ("marks", "method", "double_phase", "pupil_mm"))

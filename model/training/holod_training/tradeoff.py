"""The curve between sharp in focus and soft out of focus: what one frame can have of both."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from tqdm import tqdm

from holod_training.judging import AFTER, Bench, Judged, Method
from holod_training.metrics import Judgement
from holod_training.shards import Shard
from holod_training.solver import SolverConfig, optimise

CURVE_PUPILS_MM = (2.0, 3.0, 4.0)


def focus_curve(
    shards: list[Shard], start: Method, bench: Bench, config: SolverConfig, in_focus_weights: Sequence[float]
) -> list[dict[str, Any]]:
    """The solver's optimum for each weight on what is in focus, from `start`'s field; after double phase, means over
    `shards`."""
    pupils = [p for p in shards[0].pupils_mm if p in CURVE_PUPILS_MM] or [shards[0].pupils_mm[-1]]
    found: dict[tuple[float, float], list[Judgement]] = {}
    with tqdm(total=len(shards) * len(pupils) * len(in_focus_weights), unit="field", disable=None) as progress:
        for shard in shards:
            for pupil in pupils:
                stack = bench.read(shard, shard.pupils_mm.index(pupil))
                judged = bench.read_judged(shard, shard.pupils_mm.index(pupil))
                field = start.field(stack, pupil)
                for weight in sorted(in_focus_weights):
                    loss = dataclasses.replace(config.loss, in_focus=weight)
                    weighted = dataclasses.replace(config, loss=loss, frames=1)
                    optimum = optimise(stack, field, bench.optics, bench.amplitude_constant, weighted).field[0]
                    picture = bench.look(bench.panel(optimum)[0], pupil, judged.focus_dpt)
                    found.setdefault((weight, pupil), []).append(bench.judge(picture, judged))
                    progress.update()
    return [
        {"in_focus_weight": weight, "pupil_mm": pupil, "scenes": len(of), **Judgement.mean(of).known()}
        for (weight, pupil), of in found.items()
    ]


def on_the_same_scenes(judged: Judged, scenes: int) -> list[dict[str, Any]]:
    """Every other method's numbers after double phase on the curve's own scenes, the first `scenes`."""
    rows = []
    for (method, stage, pupil), of in judged.values.items():
        if stage == AFTER and all(scene in of for scene in range(scenes)):
            mean = Judgement.mean([of[scene] for scene in range(scenes)])
            rows.append({"method": method, "pupil_mm": pupil, "scenes": scenes, **mean.known()})
    return rows

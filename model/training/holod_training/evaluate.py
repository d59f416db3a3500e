"""Judges a weights file on held-out scenes and refocus cards, beside its rivals: numbers, report, plots and sheets."""

from __future__ import annotations

import dataclasses
import datetime
import json
from typing import Any

import torch

from holod_training.config import FARTHEST_OUTSIDE, SAME
from holod_training.costs import network_cost, time_methods
from holod_training.evaluate_config import EvaluateConfig
from holod_training.export import (
    WeightsError,
    check_folder,
    load_weights,
    read_metadata,
    weights_sha256,
    write_beside,
)
from holod_training.judging import (
    ASKED,
    BETWEEN,
    OURS,
    Bench,
    Method,
    check_alike,
    judge_scenes,
    network_field,
    network_method,
    open_alike,
    rivals,
    table_pupils,
)
from holod_training.lpips import SMALLEST_PX, Lpips
from holod_training.marks import judge_marks
from holod_training.metrics import SSIM_WINDOW_PX
from holod_training.network import FieldNetwork
from holod_training.offsets import offset_statistics
from holod_training.plots import write_plots
from holod_training.refocus import refocus_cards
from holod_training.report import markdown
from holod_training.rgbd import read_pictures, write_rgbd_sheet
from holod_training.shards import Shard, check_border, open_held_out
from holod_training.sheets import write_sheet
from holod_training.solver import optimise
from holod_training.tradeoff import focus_curve, on_the_same_scenes

__all__ = ["evaluate", "network_field"]

TIMED_PUPIL_MM = 3.0


@torch.no_grad()
def evaluate(config: EvaluateConfig, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Writes evaluation.json, scenes.json, evaluation.md, plots and sheets into `config.out`.

    Raises ConfigError, WeightsError, ShardError, RgbdError, JudgementError.
    """
    check_folder(config.out)
    metadata = read_metadata(config.weights)
    networks = _load(config, device)
    network = networks[OURS]
    shards = open_alike(config.test, config.limit, config.judge_between)
    optics = shards[0].optics
    for name, one in networks.items():
        _check_bench(name, one.on(optics), config)
    cards = open_held_out(config.cards, optics) if config.cards else []
    check_alike(cards, ("size",), "with one `--size`")
    marks = open_held_out(config.marks, optics) if config.marks else []
    check_alike(marks, ("pupils_mm", "size"), "with one `--size` and given `--pupils`, such as 1,2,3,4,5")
    pictures = read_pictures(config.rgbd, optics) if config.rgbd else []
    lpips = Lpips.open(config.lpips_backbone, config.lpips_linear, device)
    least_px = SMALLEST_PX if lpips else SSIM_WINDOW_PX
    check_border(shards, config.border_px, "--border-px", least_px)
    check_border(cards, config.border_px, "--border-px")
    bench = Bench(optics, network.config.amplitude_constant, config.border_px, device, lpips, config.judge_between)
    trained = [network_method(name, one) for name, one in networks.items()]
    learned_and_rivals = [*trained, *rivals(optics)]
    start = next(method for method in learned_and_rivals if method.name == config.solver_start)
    methods = [*learned_and_rivals, *_solvers(config, start, bench, min(config.solver_scenes, len(shards)))]
    timed = shards[0].nearest_pupil(TIMED_PUPIL_MM)

    config.out.mkdir(parents=True, exist_ok=True)
    # Real pictures and cards first: they are few, and what is wrong with them is told before the long work.
    if pictures:
        write_rgbd_sheet(config.out / "rgbd.png", pictures, trained[0], bench)
    refocus = refocus_cards(cards, learned_and_rivals, bench, config.out / "cards.png") if cards else []
    of_marks = judge_marks(marks, learned_and_rivals, bench, config.out / "marks.png") if marks else []
    judged = judge_scenes(shards, methods, bench)
    result: dict[str, Any] = {
        "weights": config.weights.name,
        "provenance": metadata["provenance"],
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "optics": dataclasses.asdict(optics),
        "scenes": len(shards),
        "numbers_of_seed": _numbers_of_seed(shards),
        "size": [shards[0].height, shards[0].width],
        "focus_dpt": list(shards[0].focus_dpt[BETWEEN] if config.judge_between else shards[0].focus_dpt),
        "border_px": config.border_px,
        "amplitude_constant": network.config.amplitude_constant,
        "pupils_mm": table_pupils(shards[0].pupils_mm),
        "all_pupils_mm": list(shards[0].pupils_mm),
        "solver": {
            "start": config.solver_start,
            "scenes": min(config.solver_scenes, len(shards)),
            "iterations": config.solver.iterations,
            "loss": dataclasses.asdict(config.solver.loss),
            "focus_dpt": list(shards[0].focus_dpt[ASKED] if config.judge_between else shards[0].focus_dpt),
        },
        **judged.summary(),
    }
    per_scene = judged.per_scene([shard.path.name for shard in shards])
    write_beside(config.out / "scenes.json", (json.dumps(per_scene) + "\n").encode())
    if cards:
        result["refocus"] = refocus
    if marks:
        result["marks"] = of_marks
    result["run_time"] = {
        "pupil_mm": shards[0].pupils_mm[timed],
        "rows": time_methods(methods, bench.read(shards[0], timed), config.timing_calls),
    }
    result["networks"] = [
        {
            "method": name,
            **network_cost(one),
            "weights_sha256": weights_sha256(one),
            "amplitude_constant": one.config.amplitude_constant,
            "outside_training": _outside(one),
        }
        for name, one in networks.items()
    ]
    result["offsets"] = offset_statistics(network, shards, bench)
    if config.focus_curve_weights and config.solver_scenes:
        scenes = shards[: config.solver_scenes]
        result["focus_curve"] = {
            "solver": focus_curve(scenes, start, bench, config.solver, config.focus_curve_weights),
            "methods": on_the_same_scenes(judged, len(scenes)),
        }
    write_sheet(config.out / "sheet.png", shards, trained[0], bench)
    result["plots"] = write_plots(config.out, result)
    write_beside(config.out / "evaluation.json", (json.dumps(result, indent=1) + "\n").encode())
    write_beside(config.out / "evaluation.md", markdown(result).encode())
    return result


def _numbers_of_seed(shards: list[Shard]) -> dict[str, list[int]]:
    """Which scenes `holod-scenes` made these, by their seed."""
    found: dict[str, list[int]] = {}
    for shard in shards:
        found.setdefault(shard.seed, []).append(shard.index)
    return {seed: sorted(numbers) for seed, numbers in sorted(found.items())}


def _outside(network: FieldNetwork) -> str | None:
    trained = network.config.trained
    return trained.told_of(network.optics) if trained.outside(network.optics) > 1 else None


def _check_bench(name: str, network: FieldNetwork, config: EvaluateConfig) -> None:
    """Raises WeightsError where `holod evaluate` refuses the bench, too."""
    trained = network.config.trained
    if trained.outside(network.optics) > FARTHEST_OUTSIDE * (1 + SAME):
        raise WeightsError(
            f"{config.weights if name == OURS else name}: {trained.told_of(network.optics)}: judge it on scenes of a "
            "bench like those, train a network for this bench (README.md), or see by `across-benches` how it does"
        )


def _load(config: EvaluateConfig, device: torch.device | str) -> dict[str, FieldNetwork]:
    """Ours and the further ones by file name. Raises WeightsError where two have one name."""
    networks = {OURS: load_weights(config.weights).to(device)}
    for path in config.also:
        if path.stem in networks:
            raise WeightsError(f"{path}: a second method named {path.stem!r}; give each file a name of its own")
        networks[path.stem] = load_weights(path).to(device)
    return networks


def _solvers(config: EvaluateConfig, start: Method, bench: Bench, scenes: int) -> list[Method]:
    """Direct optimisation from the start's field, for each number of frames; named by it."""
    if scenes == 0:
        return []

    def solver(frames: int) -> Method:
        solver_config = dataclasses.replace(config.solver, frames=frames)
        name = f"optimised, {frames} frame{'s' if frames > 1 else ''}"
        return Method(
            name,
            lambda stack, pupil: (
                optimise(stack, start.field(stack, pupil), bench.optics, bench.amplitude_constant, solver_config).field
            ),
            adapts=True,
            scenes=scenes,
        )

    return [solver(frames) for frames in config.solver_frames]

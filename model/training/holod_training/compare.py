"""Several variants, each trained for the same time on the same scenes and seed, then judged: one Markdown table."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import statistics
import time
from pathlib import Path
from typing import Any

import torch

from holod_training.config import ConfigError, NetworkConfig, require
from holod_training.costs import operations_per_pixel
from holod_training.curves import read_rows
from holod_training.export import check_folder, load_weights, write_beside
from holod_training.metrics import Judgement, judge
from holod_training.network import FieldNetwork
from holod_training.optics import Eye, coc_px, double_phase, panel_field, through_levels, upsample_half_band
from holod_training.report import NUMBERS
from holod_training.rivals import flat_oracle
from holod_training.shards import Shard, check_pupils, open_held_out
from holod_training.train import VALIDATION_PUPILS_MM, Run, TrainConfig, TrainingError, train
from holod_training.variants import VARIANTS, network_amplitude, variant

WARM_STEPS, TIMED_STEPS = 2, 7
NO_STOP = -10.0
FLAT_ORACLE = "flat oracle"
# What a variant's training was begun for, and with how many steps: so it can be gone on with.
BEGUN = "begun.json"
FIVE_NUMBERS = NUMBERS[:5]


def seconds_per_step(config: TrainConfig, device: torch.device) -> float:
    """The median of a few training steps, after some to warm up; on a CPU by the time that its threads were given,
    which other programs do not stretch."""

    def now() -> float:
        return time.process_time() / torch.get_num_threads() if device.type == "cpu" else time.monotonic()

    run = Run(dataclasses.replace(config, steps=WARM_STEPS + TIMED_STEPS), device)
    taken = []
    for _ in range(run.config.steps):
        began = now()
        run.train_step()
        taken.append(now() - began)
    return statistics.median(taken[WARM_STEPS:])


@torch.no_grad()
def judge_held_out(network: FieldNetwork, shards: list[Shard], border_px: int) -> dict[str, dict[str, float]]:
    """The five numbers after double phase, means over scenes: {"2.0": {psnr_db: ...}, ...}."""
    config = network.config
    result = {}
    for pupil_mm in VALIDATION_PUPILS_MM:
        judged = []
        for shard in shards:
            stack = shard.read(shard.nearest_pupil(pupil_mm))
            pupil = torch.tensor([stack.pupil_mm])
            field = network.on(stack.optics)(network_amplitude(config, stack)[None], stack.depth[None], pupil)[0]
            if config.grid == "half-band":
                field = upsample_half_band(field)
            phase, _ = double_phase(field, config.amplitude_constant)
            eye = Eye(stack.optics, shard.height, shard.width, list(stack.focus_dpt))
            picture = eye.look(panel_field(through_levels(phase)), stack.pupil_mm) * config.amplitude_constant**2
            blur = coc_px(stack.optics, stack.depth, list(stack.focus_dpt), stack.pupil_mm)
            judged.append(judge(picture, stack.target, blur, border_px, with_ssim=False))
        result[str(pupil_mm)] = Judgement.mean(judged).known()
    return result


def judge_flat_oracle(shards: list[Shard], border_px: int) -> dict[str, dict[str, float]]:
    result = {}
    for pupil_mm in VALIDATION_PUPILS_MM:
        stacks = [shard.read(shard.nearest_pupil(pupil_mm)) for shard in shards]
        judged = [
            judge(
                flat_oracle(s.target),
                s.target,
                coc_px(s.optics, s.depth, list(s.focus_dpt), s.pupil_mm),
                border_px,
                with_ssim=False,
            )
            for s in stacks
        ]
        result[str(pupil_mm)] = Judgement.mean(judged).known()
    return result


def compare(base: TrainConfig, names: list[str], seconds: float, device: torch.device) -> str:
    """Trains each variant for `seconds`, writes comparison.md and .json into `base.out` and returns the table.

    What a step takes is measured first, and gives the number of steps: so each run has its whole learning-rate
    schedule and can be had again from its config.json. A variant whose folder holds its row already is not trained
    again, and one that was interrupted goes on from its checkpoint. Raises ConfigError, ShardError, TrainingError,
    JudgementError.
    """
    if not base.validation:
        raise ConfigError("validation: found no folder of held-out scenes; variants are compared on them")
    if os.environ.get("WORLD_SIZE", "1") != "1":
        raise ConfigError("WORLD_SIZE: found several processes; variants are compared by one, run it without torchrun")
    require("--minutes", seconds / 60, 0 < seconds < math.inf, "a number above 0")
    require("--variants", ",".join(names), bool(names), f"some of {', '.join(VARIANTS)}")
    networks = {name: variant(name) for name in names}
    check_folder(Path(base.out))
    shards = open_held_out(Path(base.validation), limit=base.validation_scenes)
    check_pupils(shards, VALIDATION_PUPILS_MM)
    out = Path(base.out)
    rows = []
    for name, network in networks.items():
        known = out / name / "comparison.json"
        judged_with = {key: getattr(base.network, key) for key in ("trained", "amplitude_constant")}
        network = dataclasses.replace(network, **judged_with)
        config = dataclasses.replace(base, network=network, out=str(out / name), stop_below_slope=NO_STOP)
        terms = {"minutes": seconds / 60, **json.loads(json.dumps(dataclasses.asdict(config)))}
        del terms["steps"]
        if known.is_file():
            _require_same_terms(known, json.loads(known.read_text())["terms"], terms)
            print(f"{name}: taken from {known}")
        else:
            row = {"variant": name, "terms": terms, **_contest(config, terms, shards, device)}
            write_beside(known, (json.dumps(row, indent=1) + "\n").encode())
        rows.append(json.loads(known.read_text()))
    flat = judge_flat_oracle(shards, base.validation_border_px)
    table = markdown(rows, flat, len(shards))
    result = {"rows": rows, FLAT_ORACLE: flat, "scenes": [s.path.name for s in shards]}
    write_beside(out / "comparison.json", (json.dumps(result, indent=1) + "\n").encode())
    write_beside(out / "comparison.md", table.encode())
    return table


def _require_same_terms(path: Path, kept: dict[str, Any], terms: dict[str, Any]) -> None:
    """Raises ConfigError where a variant was trained, or begun, on other terms."""
    # They may be from before a key of networks was there.
    network = {**json.loads(json.dumps(dataclasses.asdict(NetworkConfig()))), **kept["network"]}
    if other := [key for key in terms if {**kept, "network": network}.get(key) != terms[key]]:
        raise ConfigError(f"{path}: found another {', '.join(other)}; choose another --out, or delete {path.parent}")


def _contest(config: TrainConfig, terms: dict[str, Any], shards: list[Shard], device: torch.device) -> dict[str, Any]:
    """Trains one variant, or goes on with it where its folder has a checkpoint that was begun on the same terms, and
    judges it by `shards`."""
    begun = Path(config.out) / BEGUN
    has_checkpoint = begun.with_name("checkpoint.pt").is_file()
    goes_on = has_checkpoint and begun.is_file()
    if goes_on:
        kept = json.loads(begun.read_text())
        _require_same_terms(begun, kept["terms"], terms)
    elif has_checkpoint:
        raise TrainingError(f"{config.out}: holds a run of no comparison; choose another --out, or delete it")
    else:
        step_seconds = seconds_per_step(config, device)
        steps = max(1, round(60 * terms["minutes"] / step_seconds))
        kept = {"terms": terms, "steps": steps, "step_seconds": step_seconds}
        write_beside(begun, (json.dumps(kept, indent=1) + "\n").encode())
    steps = kept["steps"]
    config = dataclasses.replace(config, steps=steps, validate_every=steps, checkpoint_every=steps)
    try:
        network = load_weights(train(config, device, resume=goes_on))
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"{config.out} is begun: the same command goes on with it") from None
    return {
        "parameters": sum(p.numel() for p in network.parameters()),
        "operations_per_pixel": operations_per_pixel(config.network),
        "steps": steps,
        "step_seconds": kept["step_seconds"],
        "seconds": read_rows(Path(config.out))[-1]["seconds"],
        "pupils": judge_held_out(network, shards, config.validation_border_px),
    }


def markdown(rows: list[dict[str, Any]], flat: dict[str, dict[str, float]], scenes: int) -> str:
    """One table: a row a variant, s = 2 / 3 / 4 mm in each cell."""

    def cells(pupils: dict[str, dict[str, float]]) -> str:
        def cell(key: str, digits: int) -> str:
            values = [p[key] for p in pupils.values() if key in p]
            return " / ".join(f"{v:.{digits}f}" for v in values) or "-"

        return " | ".join(cell(key, digits) for key, _, digits in FIVE_NUMBERS)

    named = " | ".join(label for _, label, _ in FIVE_NUMBERS)
    lines = [
        f"After double phase, means over {scenes} held-out scenes, s = 2 / 3 / 4 mm in each cell.",
        "",
        f"| variant | parameters | kFLOP a pixel | steps | minutes | ms a step | {named} |",
        "|---|" + "---|" * (5 + len(FIVE_NUMBERS)),
    ]
    for row in rows:
        lines.append(
            f"| {row['variant']} | {row['parameters']} | {row['operations_per_pixel'] / 1000:.1f} | {row['steps']} "
            f"| {row['seconds'] / 60:.1f} | {1000 * row['step_seconds']:.0f} | {cells(row['pupils'])} |"
        )
    lines.append(f"| {FLAT_ORACLE} | | | | | | {cells(flat)} |")
    return "\n".join(lines) + "\n"

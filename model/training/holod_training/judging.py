"""Judges methods on held-out scenes, scene by scene and focus by focus, so that large stacks fit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from holod_training.config import OpticsConfig
from holod_training.intervals import interval_95
from holod_training.loss import inner
from holod_training.lpips import Lpips
from holod_training.metrics import Judgement, JudgementError, judge, psnr_db
from holod_training.network import FieldNetwork
from holod_training.optics import Eye, coc_px, double_phase, panel_field, through_levels, upsample_half_band
from holod_training.rivals import (
    all_in_focus,
    flat_oracle,
    layered_asm,
    rgbd_blur,
    smooth_phase,
    transport_of_intensity,
)
from holod_training.shards import Shard, ShardError, Stack, open_test
from holod_training.solver import SolverConfig
from holod_training.variants import network_amplitude

OURS = "holod"
LAYERED_ASM, FLAT_ORACLE, RGBD_BLUR = "layered ASM", "flat oracle", "RGB-D blur"
# Pictures that no hologram makes.
PICTURES = (RGBD_BLUR, FLAT_ORACLE)
BEFORE, AFTER = "before", "after"
NUMBERS = tuple(f.name for f in fields(Judgement))
KEPT_EYE_ELEMENTS = 2**23
LEAST_AMPLITUDE_STRIDE = 7
# Of a stack's focuses where it is judged between what a solver is asked for.
ASKED, BETWEEN = slice(0, None, 2), slice(1, None, 2)
MOST_AMPLITUDES = 2**16


@dataclass(frozen=True)
class Method:
    """One way to make a hologram: (scene, given pupil) -> complex field [3, H, W] at the SLM plane, half band; or
    [N, 3, H, W], N frames whose intensities the eye averages. `adapts`: whether the field depends on the pupil.
    `scenes`: only the first so many, where it is slow. `takes_stack`: it is given what its pupil sees.
    `amplitude_constant`: of its double phase, where that is not the bench's."""

    name: str
    field: Callable[[Stack, float], Tensor]
    adapts: bool = False
    scenes: int | None = None
    takes_stack: bool = False
    amplitude_constant: float | None = None


def network_field(network: FieldNetwork, stack: Stack, pupil_mm: float) -> Tensor:
    """The network's field on the full grid, complex [3, H, W]."""
    pupil = torch.tensor([pupil_mm], device=stack.depth.device)
    out: Tensor = network(network_amplitude(network.config, stack)[None], stack.depth[None], pupil)[0]
    return upsample_half_band(out) if out.shape[-2:] != stack.depth.shape else out


def network_method(name: str, network: FieldNetwork) -> Method:
    return Method(
        name,
        lambda stack, pupil: network_field(network, stack, pupil),
        adapts=True,
        takes_stack=network.config.architecture == "focal-stack",
        amplitude_constant=network.config.amplitude_constant,
    )


def rivals(optics: OpticsConfig) -> list[Method]:
    def method(name: str, make: Callable[[Tensor, Tensor, OpticsConfig], Tensor]) -> Method:
        return Method(name, lambda stack, _: make(stack.amplitude, stack.depth, optics))

    return [
        method("all-in-focus", all_in_focus),
        method(LAYERED_ASM, layered_asm),
        method("smooth phase", smooth_phase),
        method("transport of intensity", transport_of_intensity),
    ]


class Bench:
    """Looks at fields before and after double phase. With `between`, methods know every second focus of a stack, from
    the first to the last, and all of them are judged at those between."""

    def __init__(
        self,
        optics: OpticsConfig,
        amplitude_constant: float,
        border_px: int,
        device: torch.device | str = "cpu",
        lpips: Lpips | None = None,
        between: bool = False,
    ) -> None:
        self.optics = optics
        self.amplitude_constant = amplitude_constant
        self.border_px = border_px
        self.device = device
        self.lpips = lpips
        self.between = between
        self.eyes: dict[tuple[Any, ...], Eye] = {}
        self.widest_cut_mm = 1e3 * max(optics.wavelengths_m) * optics.focal_length_m / (2 * optics.pitch_m) * 2**0.5

    def read(self, shard: Shard, pupil_index: int) -> Stack:
        """What a method may know."""
        stack = shard.read(pupil_index).to(self.device)
        return stack.at(ASKED) if self.between else stack

    def read_judged(self, shard: Shard, pupil_index: int) -> Stack:
        """What pictures are judged by."""
        stack = shard.read(pupil_index).to(self.device)
        return stack.at(BETWEEN) if self.between else stack

    def look(self, field: Tensor, pupil_mm: float, focus_dpt: Sequence[float]) -> Tensor:
        """Field [3, H, W] or frames [N, 3, H, W] -> linear intensity [K, 3, H, W], frames averaged."""
        frames = field if field.dim() == 4 else field[None]
        height, width = field.shape[-2:]
        pictures = torch.empty(len(focus_dpt), 3, height, width, device=field.device)
        planes = max(1, KEPT_EYE_ELEMENTS // (3 * height * width))
        for first in range(0, len(focus_dpt), planes):
            chunk = tuple(focus_dpt[first : first + planes])
            eye = self._eye(height, width, chunk)
            looks = [eye.look(frame, pupil_mm) for frame in frames]
            pictures[first : first + planes] = looks[0] if len(looks) == 1 else torch.stack(looks).mean(dim=0)
        return pictures

    def _eye(self, height: int, width: int, focus_dpt: tuple[float, ...]) -> Eye:
        """Kept only while it is the one that every picture needs: a large stack's would fill the memory."""
        key = (height, width, focus_dpt)
        if key not in self.eyes:
            if 3 * height * width * (len(focus_dpt) + sum(len(k[2]) for k in self.eyes)) > KEPT_EYE_ELEMENTS:
                self.eyes.clear()
            self.eyes[key] = Eye(self.optics, height, width, list(focus_dpt), self.device)
        return self.eyes[key]

    def panel(self, field: Tensor, amplitude_constant: float | None = None) -> tuple[Tensor, float]:
        """The field after double phase, with the bench's constant where none is given, scaled so that its signal is
        `field` again; and the clipped share."""
        constant = amplitude_constant or self.amplitude_constant
        phase, clipped = double_phase(field, constant)
        return panel_field(through_levels(phase)) * constant, clipped

    def same_to_the_eye(self, pupil_mm: float) -> float:
        """Pupils wider than the stop's diagonal all see alike: the widest that must be told apart."""
        return min(pupil_mm, self.widest_cut_mm + 0.01)

    def judge(self, picture: Tensor, stack: Stack) -> Judgement:
        """What a stack's focuses show, [K, 3, H, W], against its target."""
        return judge(picture, stack.target, self.blur_px(stack), self.border_px, lpips=self.lpips)

    def blur_px(self, stack: Stack) -> Tensor:
        return coc_px(self.optics, stack.depth, list(stack.focus_dpt), stack.pupil_mm)


def check_alike(shards: Sequence[Shard], in_what: Sequence[str], cure: str) -> None:
    """Raises ShardError that names the first that is not as the first of all, or that is one of the others."""
    for shard in shards[1:]:
        for what in in_what:
            found, expected = getattr(shard, what), getattr(shards[0], what)
            if found != expected:
                raise ShardError(
                    f"{shard.path}: {what} is {found}, but {expected} in {shards[0].path.name}; "
                    f"evaluate scenes that are alike, each kind in its own folder, {cure}"
                )
    known: dict[tuple[str, str, int], Shard] = {}
    for shard in shards:
        same = known.setdefault((shard.kind, shard.seed, shard.index), shard)
        if same is not shard:
            raise ShardError(
                f"{shard.path}: found number {shard.index} of seed {shard.seed}, as in {same.path}, expected each "
                "scene once, for intervals take scenes for independent: delete one of the two"
            )


def open_alike(folder: Path, limit: int | None = None, between: bool = False) -> list[Shard]:
    """The shards of one evaluation: held out, of one bench, same size, pupils and focuses; to judge `between`, an odd
    number of focuses. Raises ShardError that names the odd one."""
    shards = open_test(folder, limit)
    first = shards[0]
    check_alike(shards, ("pupils_mm", "focus_dpt", "size"), "rendered with `--planes N` or `auto`")
    if list(first.pupils_mm) != sorted(set(first.pupils_mm)):
        raise ShardError(f"{first.path}: pupils_mm is {first.pupils_mm}, expected rising values, each once")
    most = 2 * SolverConfig().planes - 1
    if between and (len(first.focus_dpt) % 2 == 0 or not 3 <= len(first.focus_dpt) <= most):
        raise ShardError(
            f"{first.path}: {len(first.focus_dpt)} focuses, expected an odd number from 3 to {most} to judge at those "
            "between the others; render such scenes with `holod-scenes generate --planes 21`"
        )
    return shards


def means(rows: list[dict[str, Any]], keys: tuple[str, ...]) -> list[dict[str, Any]]:
    """Of rows that are alike in `keys`, scenes each, one with the number of `scenes` and the means of all else."""
    grouped: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in rows:
        grouped.setdefault(tuple(row[key] for key in keys), []).append(row)
    return [
        {
            **dict(zip(keys, of, strict=True)),
            "scenes": len(found),
            **{name: sum(row[name] for row in found) / len(found) for name in found[0] if name not in keys},
        }
        for of, found in grouped.items()
    ]


def table_pupils(pupils_mm: Sequence[float]) -> list[float]:
    """The whole millimetres, which tables and the matrix show; all pupils where fewer than two are whole."""
    whole = [p for p in pupils_mm if p == round(p)]
    return whole if len(whole) > 1 else list(pupils_mm)


@dataclass
class Judged:
    """Every scene's numbers: values[method, stage, pupil][scene index]; matrix[stage], one [given, judged] a scene."""

    pupils_mm: tuple[float, ...]
    matrix_pupils_mm: list[float]
    matrix: dict[str, list[np.ndarray]]
    values: dict[tuple[str, str, float], dict[int, Judgement]] = field(default_factory=dict)
    clipped: dict[tuple[str, float], list[float]] = field(default_factory=dict)
    amplitudes: list[Tensor] = field(default_factory=list)

    def add(self, method: str, stage: str, pupil_mm: float, scene: int, found: Judgement) -> None:
        self.values.setdefault((method, stage, pupil_mm), {})[scene] = found

    def rows(self) -> list[dict[str, Any]]:
        """Means over scenes with their intervals, one row for each method, stage and pupil."""
        return [
            {
                "method": method,
                "double_phase": stage,
                "pupil_mm": pupil,
                "scenes": len(of),
                **Judgement.mean(list(of.values())).known(),
                "interval_95": _intervals({n: [getattr(j, n) for j in of.values()] for n in NUMBERS}),
            }
            for (method, stage, pupil), of in self.values.items()
        ]

    def paired(self) -> list[dict[str, Any]]:
        """Ours less each other method after double phase, scene by scene, over the scenes that both were judged on.

        What has no hologram is taken as it is.
        """
        rows = []
        for (method, stage, pupil), of in self.values.items():
            if method == OURS or (stage == BEFORE) != (method in PICTURES):
                continue
            ours = self.values[OURS, AFTER, pupil]
            common = sorted(of.keys() & ours.keys())
            differences = {n: [getattr(ours[k], n) - getattr(of[k], n) for k in common] for n in NUMBERS}
            means = {n: float(np.nanmean(v)) for n, v in differences.items() if not np.all(np.isnan(v))}
            rows.append(
                {
                    "method": method,
                    "pupil_mm": pupil,
                    "scenes": len(common),
                    "difference": means,
                    "interval_95": _intervals(differences),
                }
            )
        return rows

    def summary(self) -> dict[str, Any]:
        pooled = torch.cat(self.amplitudes).sort().values
        return {
            "rows": self.rows(),
            "paired": self.paired(),
            "matrix_psnr_db": {stage: np.mean(of, axis=0).round(3).tolist() for stage, of in self.matrix.items()},
            "clipped_share": [
                {"method": name, "pupil_mm": pupil, "share": float(np.mean(shares))}
                for (name, pupil), shares in self.clipped.items()
            ],
            "amplitude_quantiles": {
                str(q): round(float(pooled[min(len(pooled) - 1, int(q * len(pooled)))]), 4)
                for q in (0.5, 0.99, 0.999, 0.9999, 1.0)
            },
        }

    def per_scene(self, names: list[str]) -> list[dict[str, Any]]:
        return [
            {"scene": names[scene], "method": method, "double_phase": stage, "pupil_mm": pupil, **found.known()}
            for (method, stage, pupil), of in self.values.items()
            for scene, found in of.items()
        ]


def _intervals(numbers: dict[str, list[float]]) -> dict[str, list[float]]:
    found = {name: interval_95(values) for name, values in numbers.items()}
    return {name: list(interval) for name, interval in found.items() if interval}


def judge_scenes(shards: list[Shard], methods: list[Method], bench: Bench, after_alone: bool = False) -> Judged:
    """Every method at every pupil, and for ours the matrix PSNR(given, judged); one scene in memory at a time. With
    `after_alone` neither fields before double phase nor the two references that are no holograms, in a third of the
    time. Raises ShardError and JudgementError for scenes and pictures with values that are no numbers."""
    pupils = shards[0].pupils_mm
    stages = (AFTER,) if after_alone else (BEFORE, AFTER)
    judged = Judged(pupils, table_pupils(pupils), matrix={stage: [] for stage in stages})
    for scene, shard in enumerate(tqdm(shards, unit="scene", disable=None)):
        for index in range(0 if after_alone else len(pupils)):
            stack = bench.read_judged(shard, index)
            blurred = rgbd_blur(stack.amplitude, stack.depth, bench.optics, list(stack.focus_dpt), stack.pupil_mm)
            judged.add(RGBD_BLUR, BEFORE, stack.pupil_mm, scene, bench.judge(blurred, stack))
            judged.add(FLAT_ORACLE, BEFORE, stack.pupil_mm, scene, bench.judge(flat_oracle(stack.target), stack))
        for method in methods:
            if method.scenes is None or scene < method.scenes:
                _judge_method(judged, scene, shard, method, bench)
    return judged


def _judge_method(judged: Judged, scene: int, shard: Shard, method: Method, bench: Bench) -> None:
    of_matrix = judged.matrix_pupils_mm if method.name == OURS else []
    psnr = {stage: np.zeros((len(of_matrix), len(of_matrix))) for stage in judged.matrix}
    for given, given_mm in enumerate(judged.pupils_mm[: None if method.adapts else 1]):
        field_ = method.field(bench.read(shard, given), given_mm)
        panel, share = bench.panel(field_, method.amplitude_constant)
        if method.name == OURS:
            stride = max(LEAST_AMPLITUDE_STRIDE, field_.numel() // MOST_AMPLITUDES)
            judged.amplitudes.append(field_.abs().flatten()[::stride].cpu())
        wanted = [given] if method.adapts else list(range(len(judged.pupils_mm)))
        crossed = [i for i, p in enumerate(judged.pupils_mm) if given_mm in of_matrix and p in of_matrix and i != given]
        for index in wanted:
            judged.clipped.setdefault((method.name, judged.pupils_mm[index]), []).append(share)
        for stage in psnr:
            shown = panel if stage == AFTER else field_
            picture, seen_with = None, 0.0
            for index in sorted(wanted + crossed):
                pupil = judged.pupils_mm[index]
                stack = bench.read_judged(shard, index)
                if picture is None or bench.same_to_the_eye(pupil) != seen_with:
                    picture, seen_with = None, bench.same_to_the_eye(pupil)
                    picture = bench.look(shown, seen_with, stack.focus_dpt)
                if index in wanted:
                    try:
                        found = bench.judge(picture, stack)
                    except JudgementError as error:
                        raise JudgementError(
                            f"{shard.path}: {method.name} for s = {given_mm:g} mm: {error}; leave that method out, or "
                            "name other weights"
                        ) from error
                    judged.add(method.name, stage, pupil, scene, found)
                    cell = found.psnr_db
                else:
                    cell = psnr_db(inner(picture - stack.target, bench.border_px).square())
                if given_mm in of_matrix and pupil in of_matrix:
                    psnr[stage][of_matrix.index(given_mm), of_matrix.index(pupil)] = cell
    if of_matrix:
        for stage, values in psnr.items():
            judged.matrix[stage].append(values)

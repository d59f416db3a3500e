"""Judges a weights file on held-out scenes and refocus cards, beside its rivals: evaluation.json, .md and sheets."""

from __future__ import annotations

import datetime
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor
from tqdm import tqdm

from holod_training.config import OpticsConfig
from holod_training.export import load_weights, read_metadata, write_beside
from holod_training.loss import inner
from holod_training.metrics import Judgement, gradient_energy, judge, psnr_db
from holod_training.network import DirectNetwork
from holod_training.optics import Eye, coc_px, double_phase, panel_field, upsample_half_band
from holod_training.report import markdown
from holod_training.rivals import all_in_focus, flat_oracle, layered_asm
from holod_training.shards import Shard, ShardError, Stack, open_shards

PUPILS_MM = (1.0, 2.0, 3.0, 4.0, 5.0)
CARD_NEAR_DPT = 2.5
CARD_FAR_DPT = 0.25
SEAM_PX = 16
SHEET_SCENES = 2
SHEET_PUPILS_MM = (2.0, 4.0)
OURS = "holod"
BEFORE, AFTER = "before", "after"


@dataclass(frozen=True)
class Method:
    """One way to make a hologram: (scene, given pupil) -> complex field [3, H, W], half band."""

    name: str
    field: Callable[[Stack, float], Tensor]


def network_field(network: DirectNetwork, stack: Stack, pupil_mm: float) -> Tensor:
    field = network(stack.amplitude[None], stack.depth[None], torch.tensor([pupil_mm]))[0]
    return upsample_half_band(field) if network.config.grid == "half-band" else field


class Bench:
    """Looks at fields before and after double phase."""

    def __init__(self, optics: OpticsConfig, amplitude_constant: float, border_px: int) -> None:
        self.optics = optics
        self.amplitude_constant = amplitude_constant
        self.border_px = border_px
        self.eyes: dict[tuple[Any, ...], Eye] = {}
        self.widest_cut_mm = 1e3 * max(optics.wavelengths_m) * optics.focal_length_m / (2 * optics.pitch_m) * 2**0.5

    def look(self, field: Tensor, pupil_mm: float, focus_dpt: tuple[float, ...]) -> Tensor:
        key = (*field.shape[-2:], focus_dpt)
        if key not in self.eyes:
            self.eyes[key] = Eye(self.optics, field.shape[-2], field.shape[-1], list(focus_dpt))
        return self.eyes[key].look(field, pupil_mm)

    def panel(self, field: Tensor) -> tuple[Tensor, float]:
        """The field after double phase, scaled so that its signal is `field` again; and the clipped share."""
        phase, clipped = double_phase(field, self.amplitude_constant)
        return panel_field(phase) * self.amplitude_constant, clipped

    def same_to_the_eye(self, pupil_mm: float) -> float:
        """Pupils wider than the stop's diagonal all see alike: the widest that must be told apart."""
        return min(pupil_mm, self.widest_cut_mm + 0.01)


def rivals(optics: OpticsConfig) -> list[Method]:
    return [
        Method("all-in-focus", lambda stack, _: all_in_focus(stack.amplitude, stack.depth, optics)),
        Method("layered ASM", lambda stack, _: layered_asm(stack.amplitude, stack.depth, optics)),
    ]


@torch.no_grad()
def evaluate(
    weights: Path, test: Path, cards: Path | None, out: Path, border_px: int = 24, limit: int | None = None
) -> dict[str, Any]:
    """Writes evaluation.json, evaluation.md and sheets into `out`. Raises WeightsError, ShardError."""
    metadata = read_metadata(weights)
    network = load_weights(weights)
    optics = network.config.optics
    shards = open_shards(test, optics, limit)
    for shard in shards:
        if tuple(round(p, 6) for p in shard.pupils_mm) != PUPILS_MM:
            raise ShardError(f"{shard.path}: pupils {shard.pupils_mm}, evaluation needs {PUPILS_MM}")
    bench = Bench(optics, network.config.amplitude_constant, border_px)
    ours = Method(OURS, lambda stack, pupil: network_field(network, stack, pupil))
    out.mkdir(parents=True, exist_ok=True)
    result: dict[str, Any] = {
        "weights": weights.name,
        "provenance": metadata["provenance"],
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "scenes": len(shards),
        "size": [shards[0].height, shards[0].width],
        "focus_dpt": list(shards[0].focus_dpt),
        "border_px": border_px,
        "amplitude_constant": network.config.amplitude_constant,
        "pupils_mm": list(PUPILS_MM),
        **judge_scenes(shards, ours, bench),
    }
    if cards:
        result["refocus"] = refocus_cards(open_shards(cards, optics), ours, bench, out)
    write_sheet(out / "sheet.png", shards[:SHEET_SCENES], ours, bench)
    write_beside(out / "evaluation.json", (json.dumps(result, indent=1) + "\n").encode())
    write_beside(out / "evaluation.md", markdown(result).encode())
    return result


def judge_scenes(shards: list[Shard], ours: Method, bench: Bench) -> dict[str, Any]:
    """The five numbers of every method, and the matrix PSNR(given, judged) of ours, means over scenes."""
    methods = [ours, *rivals(bench.optics)]
    judged: dict[tuple[str, str, float], list[Judgement]] = {}
    matrix: dict[str, list[np.ndarray]] = {BEFORE: [], AFTER: []}
    clipped: dict[tuple[str, float], list[float]] = {}
    amplitudes = []
    for shard in tqdm(shards, unit="scene", disable=None):
        stacks = list(shard.stacks())
        blurs = [coc_px(bench.optics, s.depth, list(s.focus_dpt), s.pupil_mm) for s in stacks]
        for stack, blur in zip(stacks, blurs, strict=True):
            found = judge(flat_oracle(stack.target), stack.target, blur, bench.border_px)
            judged.setdefault(("flat oracle", BEFORE, stack.pupil_mm), []).append(found)
        for method in methods:
            psnr = {stage: np.zeros((len(stacks), len(stacks))) for stage in matrix}
            field = None
            for given, stack in enumerate(stacks):
                if field is None or method is ours:
                    field = method.field(stack, stack.pupil_mm)
                    panel, share = bench.panel(field)
                    pictures: dict[tuple[str, float], Tensor] = {}
                clipped.setdefault((method.name, stack.pupil_mm), []).append(share)
                if method is ours:
                    amplitudes.append(field.abs().flatten()[::7])
                for other, (judge_stack, blur) in enumerate(zip(stacks, blurs, strict=True)):
                    if method is not ours and other != given:
                        continue
                    pupil = bench.same_to_the_eye(judge_stack.pupil_mm)
                    for stage, shown in ((BEFORE, field), (AFTER, panel)):
                        if (stage, pupil) not in pictures:
                            pictures[stage, pupil] = bench.look(shown, pupil, stack.focus_dpt)
                        picture = pictures[stage, pupil]
                        if other == given:
                            found = judge(picture, judge_stack.target, blur, bench.border_px)
                            judged.setdefault((method.name, stage, stack.pupil_mm), []).append(found)
                            psnr[stage][given, other] = found.psnr_db
                        else:
                            error = inner(picture - judge_stack.target, bench.border_px).square()
                            psnr[stage][given, other] = psnr_db(error)
            if method is ours:
                for stage, values in psnr.items():
                    matrix[stage].append(values)
    rows = [
        {"method": name, "double_phase": stage, "pupil_mm": pupil, **Judgement.mean(of).known()}
        for (name, stage, pupil), of in judged.items()
    ]
    pooled = torch.cat(amplitudes).sort().values
    return {
        "rows": rows,
        "matrix_psnr_db": {stage: np.mean(values, axis=0).round(3).tolist() for stage, values in matrix.items()},
        "clipped_share": [
            {"method": name, "pupil_mm": pupil, "share": float(np.mean(shares))}
            for (name, pupil), shares in clipped.items()
        ],
        "amplitude_quantiles": {
            str(q): round(float(pooled[min(len(pooled) - 1, int(q * len(pooled)))]), 4)
            for q in (0.5, 0.99, 0.999, 0.9999, 1.0)
        },
    }


def card_areas(depth: Tensor, optics: OpticsConfig, border_px: int) -> dict[str, Tensor]:
    """Where each card is, [H, W] bool, without the picture's border and a strip along the card's edges."""
    areas = {}
    for name, card_dpt in (("near", CARD_NEAR_DPT), ("far", CARD_FAR_DPT)):
        dioptres = optics.depth_far_dpt + depth * (optics.depth_near_dpt - optics.depth_far_dpt)
        outside = ((dioptres - card_dpt).abs() > 0.05).float()
        near_edge = F.max_pool2d(outside[None, None], 2 * SEAM_PX + 1, stride=1, padding=SEAM_PX)[0, 0] > 0
        area = ~near_edge
        kept = torch.zeros_like(area)
        inner(kept, border_px).copy_(inner(area, border_px))
        areas[name] = kept
    return areas


def refocus_cards(shards: list[Shard], ours: Method, bench: Bench, out: Path) -> list[dict[str, Any]]:
    """Refocus ratio: a card's gradient energy in focus over out of focus, after double phase, and its sheet."""
    rows = []
    pictures = []
    focus = (CARD_NEAR_DPT, CARD_FAR_DPT)
    for index, shard in enumerate(shards):
        stack = shard.read(0)
        areas = card_areas(stack.depth, bench.optics, bench.border_px)
        for name, area in areas.items():
            if int(area.sum()) < 256:
                raise ShardError(f"{shard.path}: no {name} card found at its depth; write it with --kind cards")
        line = [stack.image]
        for method in (ours, *rivals(bench.optics)):
            for pupil in PUPILS_MM:
                panel, _ = bench.panel(method.field(stack, pupil))
                near_focus, far_focus = bench.look(panel, pupil, focus)
                energy = {
                    name: (gradient_energy(near_focus, area), gradient_energy(far_focus, area))
                    for name, area in areas.items()
                }
                rows.append(
                    {
                        "method": method.name,
                        "contrast": "dark on bright" if index % 2 == 0 else "bright on dark",
                        "pupil_mm": pupil,
                        "near_card": energy["near"][0] / energy["near"][1],
                        "far_card": energy["far"][1] / energy["far"][0],
                    }
                )
                if method is ours and pupil in SHEET_PUPILS_MM:
                    line += [near_focus, far_focus]
        pictures.append(line)
    save_sheet(out / "cards.png", pictures)
    return rows


def write_sheet(path: Path, shards: list[Shard], ours: Method, bench: Bench) -> None:
    """Rows: scenes by pupils; columns: target far, ours far, target near, ours near (after double phase)."""
    lines = []
    for shard in shards:
        for index, pupil in enumerate(shard.pupils_mm):
            if pupil not in SHEET_PUPILS_MM:
                continue
            stack = shard.read(index)
            panel, _ = bench.panel(ours.field(stack, pupil))
            picture = bench.look(panel, pupil, stack.focus_dpt)
            lines.append([stack.target[0], picture[0], stack.target[-1], picture[-1]])
    save_sheet(path, lines)


def srgb(linear: Tensor) -> np.ndarray:
    """Linear light [3, H, W] -> 8-bit sRGB [H, W, 3]."""
    x = linear.clamp(0, 1)
    encoded = torch.where(x <= 0.0031308, 12.92 * x, 1.055 * x.clamp_min(1e-8) ** (1 / 2.4) - 0.055)
    return (encoded * 255 + 0.5).byte().permute(1, 2, 0).numpy()


def save_sheet(path: Path, lines: list[list[Tensor]], gap_px: int = 4) -> None:
    rows = []
    for line in lines:
        tiles = [np.pad(srgb(t), ((0, gap_px), (0, gap_px), (0, 0)), constant_values=255) for t in line]
        rows.append(np.concatenate(tiles, axis=1))
    part = path.with_name(f".{path.name}.part")
    Image.fromarray(np.concatenate(rows, axis=0)).save(part, format="PNG", optimize=True)
    part.replace(path)

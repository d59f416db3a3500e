"""The eyebox study: where smooth and random phase put their light in the pupil's plane, and how far an eye may move.

A plane wave of spatial frequency ν leaves the eyepiece through the point λ·f·ν of the pupil's plane (Goodman,
Introduction to Fourier Optics), so a field's spectrum *is* its light there.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import torch
from torch import Tensor
from tqdm import tqdm

from holod_training.config import OpticsConfig
from holod_training.evaluate import network_field
from holod_training.export import check_folder, load_weights, write_beside
from holod_training.loss import inner
from holod_training.metrics import psnr_db
from holod_training.optics import frequencies, half_band_mask, intensity, pupil_mask, transfer
from holod_training.rivals import all_in_focus, layered_asm
from holod_training.shards import Stack, check_border, open_test

PUPILS_MM = (1.0, 2.0, 3.0, 4.0, 5.0)
SHARES = (0.5, 0.9, 0.99)
DIAMETERS_MM = (0.02, 0.05, *(round(0.1 * k, 1) for k in range(1, 26)))
SHIFTS_MM = (0.0, 0.01, 0.02, 0.05, *(round(0.1 * k, 1) for k in range(1, 26)))
LIGHT_SHIFT_MM = 0.5
SAME_PICTURE_DB = 30.0
GREEN = 1
NETWORK_PUPIL_MM = 3.0
BORDER_PX = 24

NETWORK, ALL_IN_FOCUS, LAYERED, RANDOM = "network", "all-in-focus", "layered, zero phase", "layered, random phase"


@dataclass(frozen=True)
class Study:
    """Means over scenes. `share_inside` [method][diameter]: the part of green light inside a centred disc;
    `light` and `alike_db` [method, pupil][shift]: the light that a shifted pupil still takes, relative to the centred
    one, all colours, and the PSNR of what it shows against what the centred one shows."""

    share_inside: dict[str, list[float]]
    light: dict[tuple[str, float], list[float]]
    alike_db: dict[tuple[str, float], list[float]]


def random_phase(stack: Stack, optics: OpticsConfig, seed: int) -> Tensor:
    """The layered field of a surface that scatters: independent uniform phase at every pixel, half band."""
    generator = torch.Generator().manual_seed(seed)
    angle = 2 * math.pi * torch.rand(stack.amplitude.shape, generator=generator)
    return layered_asm(torch.polar(stack.amplitude, angle.to(stack.depth.device)), stack.depth, optics)


def share_inside(spectrum: Tensor, optics: OpticsConfig, fx: Tensor, fy: Tensor) -> list[float]:
    """The share of the green spectrum [3, H, W]'s energy inside each of DIAMETERS_MM."""
    energy = intensity(spectrum[GREEN]).double()
    inside = [pupil_mask(optics, fx, fy, diameter)[GREEN] for diameter in DIAMETERS_MM]
    return [float((energy * mask).sum() / energy.sum()) for mask in inside]


def diameter_holding(share: float, shares: list[float]) -> float | None:
    """The diameter in mm inside which `share` of the light is, interpolated; None where it is beyond the widest."""
    last_diameter, last_share = 0.0, 0.0
    for diameter, found in zip(DIAMETERS_MM, shares, strict=True):
        if found >= share:
            return last_diameter + (diameter - last_diameter) * (share - last_share) / (found - last_share)
        last_diameter, last_share = diameter, found
    return None


def sampling_interval(alike_db: list[float]) -> float | None:
    """How far in mm a pupil may move until what it shows differs by more than SAME_PICTURE_DB allows; None: farther
    than was looked at."""
    for index in range(1, len(SHIFTS_MM)):
        before, after = alike_db[index - 1], alike_db[index]
        if after < SAME_PICTURE_DB:
            if index == 1:
                # From nothing the error grows with the square of the shift.
                return SHIFTS_MM[1] * 10 ** ((after - SAME_PICTURE_DB) / 20)
            part = (before - SAME_PICTURE_DB) / (before - after)
            return SHIFTS_MM[index - 1] + part * (SHIFTS_MM[index] - SHIFTS_MM[index - 1])
    return None


def study(stacks: list[Stack], methods: dict[str, Callable[[Stack], Tensor]], optics: OpticsConfig) -> Study:
    """Looks at every method's field of every scene; the eye is focused on the middle of the depth volume."""
    inside: dict[str, list[list[float]]] = {name: [] for name in methods}
    light: dict[tuple[str, float], list[list[float]]] = {}
    alike: dict[tuple[str, float], list[list[float]]] = {}
    for stack in tqdm(stacks, unit="scene", disable=None):
        (height, width), device = stack.depth.shape, stack.depth.device
        fy, fx = frequencies(height, optics.pitch_m, device), frequencies(width, optics.pitch_m, device)
        kernel = transfer(optics, fx, fy, [optics.distance_m(optics.dioptres(0.5))])[0].to(torch.complex64)
        for name, field_of in methods.items():
            spectrum = torch.fft.fft2(field_of(stack)) * half_band_mask(height, width, device)
            inside[name].append(share_inside(spectrum, optics, fx, fy))
            for pupil_mm in PUPILS_MM:
                pictures = [
                    intensity(torch.fft.ifft2(spectrum * kernel * pupil_mask(optics, fx, fy, pupil_mm, shift)))
                    for shift in SHIFTS_MM
                ]
                centred = pictures[0]
                light.setdefault((name, pupil_mm), []).append([float(p.sum() / centred.sum()) for p in pictures])
                alike.setdefault((name, pupil_mm), []).append(
                    [psnr_db(inner(p - centred, BORDER_PX).square()) for p in pictures]
                )

    def mean(rows: list[list[float]]) -> list[float]:
        return [sum(column) / len(column) for column in zip(*rows, strict=True)]

    return Study(
        share_inside={name: mean(rows) for name, rows in inside.items()},
        light={key: mean(rows) for key, rows in light.items()},
        alike_db={key: mean(rows) for key, rows in alike.items()},
    )


@torch.no_grad()
def write_eyebox(weights: Path, test: Path, out: Path, limit: int | None, device: torch.device | str = "cpu") -> str:
    """Writes eyebox.md, eyebox.json and eyebox.png into `out`; returns the Markdown.

    Raises ConfigError, WeightsError, ShardError.
    """
    check_folder(out)
    network = load_weights(weights).to(device)
    shards = open_test(test, limit)
    check_border(shards, BORDER_PX)
    optics = network.on(shards[0].optics).optics
    stacks = [shard.read(0).to(device) for shard in shards]
    methods: dict[str, Callable[[Stack], Tensor]] = {
        NETWORK: lambda stack: network_field(network, stack, NETWORK_PUPIL_MM),
        ALL_IN_FOCUS: lambda stack: all_in_focus(stack.amplitude, stack.depth, optics),
        LAYERED: lambda stack: layered_asm(stack.amplitude, stack.depth, optics),
        RANDOM: lambda stack: random_phase(stack, optics, seed=1),
    }
    found = study(stacks, methods, optics)
    out.mkdir(parents=True, exist_ok=True)
    text = markdown(found, optics, len(stacks), weights.name)
    record: dict[str, Any] = {
        "weights": weights.name,
        "scenes": len(stacks),
        "diameters_mm": DIAMETERS_MM,
        "shifts_mm": SHIFTS_MM,
        "share_inside_green": found.share_inside,
        "rows": [
            {"method": name, "pupil_mm": pupil_mm, "light": found.light[name, pupil_mm], "alike_db": alike}
            for (name, pupil_mm), alike in found.alike_db.items()
        ],
    }
    plot(found, out / "eyebox.png")
    write_beside(out / "eyebox.json", (json.dumps(record, indent=1) + "\n").encode())
    write_beside(out / "eyebox.md", text.encode())
    return text


def markdown(found: Study, optics: OpticsConfig, scenes: int, weights: str) -> str:
    def mm(value: float | None, widest: float) -> str:
        return f"> {widest:.1f}" if value is None else f"{value:.2f}"

    orders = [wavelength * optics.focal_length_m / optics.pitch_m * 1e3 for wavelength in optics.wavelengths_m]
    lines = [
        "# The eyebox, and why the hologram must know the pupil",
        "",
        f"Written by `python -m holod_training eyebox`, {scenes} held-out scenes, {weights}; means over scenes.",
        f"The network's holograms are all made for a pupil of {NETWORK_PUPIL_MM:g} mm, whichever looks.",
        "",
        "A wave of spatial frequency ν leaves the eyepiece through the point λ·f·ν of the pupil's plane. The panel's",
        f"pixels repeat that plane every λ·f/pitch = {orders[0]:.2f} / {orders[1]:.2f} / {orders[2]:.2f} mm (red, "
        "green, blue); the 4f stop of double phase keeps half of",
        f"it: a square of {orders[0] / 2:.2f} / {orders[1] / 2:.2f} / {orders[2] / 2:.2f} mm. "
        "All light is inside that square, so a centred pupil wider than its diagonal,",
        f"{orders[0] / 2**0.5:.2f} / {orders[1] / 2**0.5:.2f} / {orders[2] / 2**0.5:.2f} mm, takes everything and "
        "sees the same as any wider one: the blur of a 4 mm pupil has to be",
        "*in the hologram*. That is why the network is told the pupil.",
        "",
        "## Where the light is",
        "",
        "Diameter of the centred disc, in mm, that holds a share of the green light:",
        "",
        "| field | " + " | ".join(f"{share:.0%}" for share in SHARES) + " |",
        "|---|" + "---|" * len(SHARES),
    ]
    for name, shares in found.share_inside.items():
        cells = [mm(diameter_holding(share, shares), DIAMETERS_MM[-1]) for share in SHARES]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    lines += [
        "",
        "Smooth phase keeps most of the light in a spot much smaller than any pupil; random phase fills the stop.",
        "",
        "## How far an eye may move",
        "",
        f"Shift in mm at which what a pupil sees falls below {SAME_PICTURE_DB:.0f} dB PSNR against what the "
        "centred one sees (the pupil sampling",
        "interval: holograms for a moving eye must be made anew at least that often), and in brackets the light that",
        f"is left at {LIGHT_SHIFT_MM} mm:",
        "",
        "| field | " + " | ".join(f"s = {pupil_mm:g} mm" for pupil_mm in PUPILS_MM) + " |",
        "|---|" + "---|" * len(PUPILS_MM),
    ]
    for name in found.share_inside:
        cells = [
            f"{mm(sampling_interval(found.alike_db[name, pupil_mm]), SHIFTS_MM[-1])} "
            f"({found.light[name, pupil_mm][SHIFTS_MM.index(LIGHT_SHIFT_MM)]:.0%})"
            for pupil_mm in PUPILS_MM
        ]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    lines += [
        "",
        "The eye is focused on the middle of the depth volume; a shift is sideways, along x. Curves: `eyebox.png`.",
        "",
    ]
    return "\n".join(lines)


def plot(found: Study, path: Path) -> None:
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.8), constrained_layout=True)
    for name, shares in found.share_inside.items():
        left.plot((0.0, *DIAMETERS_MM), (0.0, *shares), label=name)
        line = found.alike_db[name, 3.0]
        right.plot(SHIFTS_MM[1:], line[1:], label=name)
    left.set(
        xlabel="diameter of a centred disc in the pupil's plane, mm", ylabel="share of the green light", ylim=(0, 1.02)
    )
    right.axhline(SAME_PICTURE_DB, color="grey", linewidth=0.8, linestyle="--")
    right.set(xlabel="shift of a 3 mm pupil, mm", ylabel="PSNR against the centred view, dB")
    right.set_ylim(10, 60)
    left.legend(fontsize=8)
    for axes in (left, right):
        axes.grid(alpha=0.3)
    part = path.with_name(f".{path.name}.part")
    figure.savefig(part, dpi=110, format="png")
    plt.close(figure)
    part.replace(path)

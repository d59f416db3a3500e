"""Light on planes of the depth volume: carried to the SLM plane, and what an eye lacks of it there, fed back."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor

from holod_training.config import OpticsConfig
from holod_training.optics import frequencies, intensity, pupil_mask, transfer

# What a net gives for each plane: the phases of three colours and a mask.
LIT = 4
# The share of what is fed back that a field takes before training.
FEEDBACK_SHARE = 0.5
# Keeps the phase of what is dark defined.
DARK = 1e-6


@lru_cache(maxsize=8)
def carriers(
    optics: OpticsConfig,
    distances_m: tuple[float, ...],
    scale: int,
    height: int,
    width: int,
    dtype: torch.dtype,
    device: str,
) -> Tensor:
    """Transfer functions [planes, 3, height, width] from the SLM plane to planes at `distances_m` on a grid of `scale`
    times the panel's pitch."""
    fy, fx = (frequencies(size, scale * optics.pitch_m, device) for size in (height, width))
    return transfer(optics, fx, fy, list(distances_m)).to(dtype)


def light_planes(
    out: Tensor, wanted: Tensor, optics: OpticsConfig, distances_m: tuple[float, ...], scale: int
) -> Tensor:
    """The field at the SLM plane, complex [N, 3, h, w], when amplitudes `wanted` [N, planes, 3, h, w] light planes at
    `distances_m`. `out` [N, LIT · planes, h, w] holds for each plane three phases over π and a mask's logit; masks of
    logit 0 share the light evenly."""
    count = len(distances_m)
    phase, mask = out.unflatten(1, (count, LIT)).split((3, 1), dim=2)
    phase = math.pi * phase
    light = torch.sigmoid(mask - math.log(count - 1)) * wanted
    planes = torch.complex(light * torch.cos(phase), light * torch.sin(phase))
    height, width = planes.shape[-2:]
    kernels = carriers(optics, distances_m, scale, height, width, planes.dtype, str(planes.device))
    return torch.fft.ifft2((torch.fft.fft2(planes) * kernels.conj()).sum(dim=1))


def feed_back(
    field: Tensor,
    wanted: Tensor,
    weight: Tensor | float,
    pupil_mm: Tensor,
    optics: OpticsConfig,
    distances_m: tuple[float, ...],
    scale: int,
) -> tuple[Tensor, Tensor]:
    """What eyes with pupils [N] lack of the amplitudes `wanted` [N, planes, 3, h, w] when they focus on the planes at
    `distances_m`, and the mean of the changes of `field` [N, 3, h, w] at the SLM plane that would give it, each with
    its `weight` [N, planes, 1, h, w]: one step of Gerchberg and Saxton (1972) at all planes at once, with the phases
    that are there.
    Pupils of 2.3 mm and more cut nothing of the half band of the default bench.
    """
    height, width = field.shape[-2:]
    fy, fx = (frequencies(size, scale * optics.pitch_m, field.device) for size in (height, width))
    pupil = pupil_mask(optics, fx, fy, pupil_mm[:, None, None])
    kernels = carriers(optics, distances_m, scale, height, width, field.dtype, str(field.device))
    arriving = torch.fft.ifft2((torch.fft.fft2(field) * pupil)[:, None] * kernels)
    amplitude = torch.sqrt(intensity(arriving) + DARK)
    lack = wanted - amplitude
    changes = torch.fft.fft2(arriving * (weight * lack / amplitude)) * kernels.conj()
    return lack, torch.fft.ifft2(changes.mean(dim=1) * pupil)

"""What the network must beat: holograms made without learning, and the oracle that has no focus."""

from __future__ import annotations

import torch
from torch import Tensor

from holod_training.config import OpticsConfig
from holod_training.optics import half_band_mask, propagate

OCCLUSION_LAYERS = 8


def stop_half_band(field: Tensor) -> Tensor:
    return torch.fft.ifft2(torch.fft.fft2(field) * half_band_mask(*field.shape[-2:]))


def all_in_focus(amplitude: Tensor, depth: Tensor, optics: OpticsConfig) -> Tensor:
    """The picture's amplitude with zero phase at the middle of the depth volume: sharp there, hardly blurred elsewhere.

    amplitude [3, H, W], depth [H, W] (unused) -> complex [3, H, W] at the SLM plane, half band.
    """
    middle = optics.distance_m(optics.dioptres(0.5))
    return stop_half_band(propagate(amplitude.to(torch.complex64), optics, -middle))


def layered_asm(amplitude: Tensor, depth: Tensor, optics: OpticsConfig) -> Tensor:
    """Eight depth layers composed far to near with occlusion, zero phase on the object.

    f ← f·(1 − m) + O·m, where m covers the layer and its next nearer one (no seams on slanted surfaces), propagated
    by one layer's distance between them. Same shapes as `all_in_focus`.
    """
    layer = (depth * OCCLUSION_LAYERS).long().clamp(0, OCCLUSION_LAYERS - 1)
    centres = [optics.distance_m(optics.dioptres((k + 0.5) / OCCLUSION_LAYERS)) for k in range(OCCLUSION_LAYERS)]
    source = amplitude.to(torch.complex64)
    field = torch.zeros_like(source)
    for k, centre in enumerate(centres):
        if k:
            field = propagate(field, optics, centre - centres[k - 1])
        field = torch.where((layer == k) | (layer == k + 1), source, field)
    return stop_half_band(propagate(field, optics, -centres[-1]))


def flat_oracle(target: Tensor) -> Tensor:
    """The mean of the target stack [K, 3, H, W] at every focus: it wins PSNR and has no focus at all."""
    return target.mean(dim=0, keepdim=True).expand_as(target)

"""Foam: fine structure that a picture shows out of focus and its target does not.

Coherent light that is out of focus interferes: text and dots turn into cell walls and rings. Three octaves of structure
count, which blocks of 4, 8 and 16 px hold; what a block of 2 px holds is beyond what an eye makes out (on the default
bench above 22 cycles a degree).

Blocks stand still: a regular pattern that is shifted against its target's may have all of its energy
counted. In pictures that averages out: the blur that an incoherent display would show has a tenth of `standard`'s foam.
"""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

OUT_OF_FOCUS_PX = 8.0
FINEST_PX = 2
OCTAVES = 3
REGION_PX = 32


def _octaves(light: Tensor) -> list[Tensor]:
    """Means of 2, 4 and 8 px of [..., H, W], each less those of twice that: a Laplacian pyramid, finest first."""
    fine, found = F.avg_pool2d(light, FINEST_PX), []
    for _ in range(OCTAVES):
        coarse = F.avg_pool2d(fine, 2)
        found.append(fine - F.interpolate(coarse, scale_factor=2.0))
        fine = coarse
    return found


def foam_energy(picture: Tensor, target: Tensor, coc_px: Tensor) -> tuple[Tensor, Tensor]:
    """picture, target [K, 3, H, W] linear light, coc_px [K, H, W] -> foam's energy, summed over octaves and over the
    regions' pixels and colours, white = 1; and over how many pixels and colours.

    In regions of 32x32 px each octave's energy over that of the target counts, of blocks all of which is out of focus.
    What is left of a region at the right and the bottom is left out. Raises ValueError where no region fits.
    """
    if min(picture.shape[-2:]) < REGION_PX:
        raise ValueError(
            f"foam: pictures of {tuple(picture.shape[-2:])} pixels have no region of {REGION_PX}x{REGION_PX}; "
            "take a larger crop or a narrower border"
        )
    height, width = (size // REGION_PX * REGION_PX for size in picture.shape[-2:])
    picture, target, coc_px = (t[..., :height, :width] for t in (picture, target, coc_px))
    energy, pixels = picture.new_zeros(()), picture.new_zeros(())
    for octave, (shown, wanted) in enumerate(zip(_octaves(picture), _octaves(target), strict=True)):
        sample_px = FINEST_PX << octave
        whole = (-F.max_pool2d(-coc_px[:, None], 2 * sample_px) > OUT_OF_FOCUS_PX).to(picture.dtype)
        counted = F.interpolate(whole, scale_factor=2.0)
        excess = F.avg_pool2d(counted * (shown.square() - wanted.square()), REGION_PX // sample_px)
        energy = energy + REGION_PX**2 * excess.clamp_min(0).sum()
        pixels = pixels + 3 * (2 * sample_px) ** 2 * whole.sum() / OCTAVES
    return energy, pixels

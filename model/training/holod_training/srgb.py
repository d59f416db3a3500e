"""sRGB's transfer function (IEC 61966-2-1): linear light to code values of 0 to 1, and back."""

from __future__ import annotations

import torch
from torch import Tensor


def srgb_encoded(light: Tensor) -> Tensor:
    """Linear light, cut to 0 .. 1, as sRGB of 0 .. 1; the slope is finite everywhere."""
    x = light.clamp(0, 1)
    return torch.where(x <= 0.0031308, 12.92 * x, 1.055 * x.clamp_min(0.0031308) ** (1 / 2.4) - 0.055)


def srgb_decoded(encoded: Tensor) -> Tensor:
    """sRGB of 0 .. 1 as linear light."""
    return torch.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)

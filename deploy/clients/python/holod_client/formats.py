"""What a picture may be made of."""

from __future__ import annotations

import enum

import numpy as np


class Colour(enum.StrEnum):
    """White is 1 (255 in 8 bits); the fourth channel, A, is ignored."""

    RGBA8 = "rgba8"
    """(height, width, 4) of uint8, sRGB"""
    RGBA16F = "rgba16f"
    """(height, width, 4) of float16, linear light"""
    RGB32F = "rgb32f"
    """(3, height, width) of float32, linear light"""

    @classmethod
    def _missing_(cls, value: object) -> None:
        raise ValueError(f"colour: found {value!r}, expected one of {', '.join(cls)}")

    @property
    def number(self) -> int:
        """What the protocol calls it."""
        return {Colour.RGBA8: 1, Colour.RGBA16F: 2, Colour.RGB32F: 3}[self]

    @property
    def dtype(self) -> np.dtype:
        return np.dtype({Colour.RGBA8: np.uint8, Colour.RGBA16F: np.float16, Colour.RGB32F: np.float32}[self])

    def shape(self, width_px: int, height_px: int) -> tuple[int, ...]:
        return (3, height_px, width_px) if self is Colour.RGB32F else (height_px, width_px, 4)


class Depth(enum.StrEnum):
    """(height, width), from the eye along the axis of view (z, not along the ray)."""

    NONE = "none"
    """the picture is a plane"""
    U16_MM = "u16_mm"
    """uint16, millimetres; 0 is no depth"""
    F16_M = "f16_m"
    """float16, metres; NaN, 0 and negative are no depth"""
    F16_DPT = "f16_dpt"
    """float16, dioptres; NaN, infinite and negative are no depth"""
    F32_M = "f32_m"
    """float32, metres; NaN, 0 and negative are no depth"""
    F32_DPT = "f32_dpt"
    """float32, dioptres; NaN, infinite and negative are no depth"""

    @classmethod
    def _missing_(cls, value: object) -> None:
        raise ValueError(f"depth: found {value!r}, expected one of {', '.join(cls)}")

    @property
    def number(self) -> int:
        """What the protocol calls it."""
        return {
            Depth.NONE: 0,
            Depth.U16_MM: 1,
            Depth.F16_M: 2,
            Depth.F16_DPT: 3,
            Depth.F32_M: 4,
            Depth.F32_DPT: 5,
        }[self]

    @property
    def dtype(self) -> np.dtype:
        """Without depth it is of no importance: there are no elements."""
        prefix = self.value.partition("_")[0]
        return np.dtype({"none": np.uint8, "u16": np.uint16, "f16": np.float16, "f32": np.float32}[prefix])

    def shape(self, width_px: int, height_px: int) -> tuple[int, ...]:
        return (0, 0) if self is Depth.NONE else (height_px, width_px)

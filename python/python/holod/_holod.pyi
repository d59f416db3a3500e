import os
from typing import Any, Literal, final

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "Hologram",
    "Renderer",
    "Rig",
    "evaluate",
    "read_samples",
    "read_scene",
    "render_builtin_scene",
    "to_srgb8",
    "view",
]

_Backend = Literal["auto", "cpu", "cpu-half", "gpu", "gpu-half"]
_DepthUnit = Literal["metres", "millimetres", "dioptres", "normalised_dioptres"]
_Levels = NDArray[np.uint8] | NDArray[np.uint16]
_Path = str | os.PathLike[str]

@final
class Rig:
    @staticmethod
    def load(path: _Path) -> Rig: ...
    @staticmethod
    def builtin() -> Rig: ...
    @property
    def name(self) -> str: ...
    @property
    def width_px(self) -> int: ...
    @property
    def height_px(self) -> int: ...
    @property
    def pixel_pitch_m(self) -> float: ...
    @property
    def wavelengths_m(self) -> tuple[float, float, float]: ...
    @property
    def eyepiece_focal_length_m(self) -> float: ...
    @property
    def depth_far_dpt(self) -> float: ...
    @property
    def depth_near_dpt(self) -> float: ...
    @property
    def bit_depth(self) -> int: ...
    @property
    def mode(self) -> Literal["channel-packed", "field-sequential", "monochrome"]: ...
    @property
    def field_order(self) -> tuple[str, str, str]: ...
    @property
    def refresh_hz(self) -> float: ...
    @property
    def stroke_rad(self) -> tuple[float, float, float]: ...
    @property
    def weights(self) -> str: ...
    def image_distance_m(self, depth_dpt: float) -> float: ...
    def levels_of(self, phase_rad: NDArray[np.float32]) -> _Levels: ...
    def phase_of(
        self, levels: _Levels, *, width_px: int | None = None, height_px: int | None = None
    ) -> NDArray[np.float32]: ...
    def read_levels(self, path: _Path) -> _Levels: ...

@final
class Renderer:
    def __new__(
        cls,
        rig: Rig | None = None,
        weights: _Path | None = None,
        *,
        width_px: int | None = None,
        height_px: int | None = None,
        backend: _Backend = "auto",
    ) -> Renderer: ...
    def render(
        self,
        rgb: NDArray[np.uint8] | NDArray[np.float32],
        depth: NDArray[np.float32] | NDArray[np.uint16],
        pupil_mm: float,
        *,
        depth_unit: _DepthUnit,
        colour: Literal["srgb", "linear"] | None = None,
        fill_missing: bool = False,
        field: bool = False,
        out_levels: _Levels | None = None,
        out_phase_rad: NDArray[np.float32] | None = None,
    ) -> Hologram: ...
    @property
    def width_px(self) -> int: ...
    @property
    def height_px(self) -> int: ...
    @property
    def trained_pupils_mm(self) -> tuple[float, float]: ...
    @property
    def amplitude_constant(self) -> float: ...
    @property
    def engine(self) -> str: ...

@final
class Hologram:
    @property
    def levels(self) -> _Levels: ...
    @property
    def phase_rad(self) -> NDArray[np.float32]: ...
    @property
    def field(self) -> NDArray[np.complex64] | None: ...
    def shown_phase_rad(self) -> NDArray[np.float32]: ...
    def view(self, focus_dpt: float, pupil_mm: float | None = None) -> NDArray[np.float32]: ...
    @property
    def pupil_mm(self) -> float: ...
    @property
    def clipped_share(self) -> float: ...
    @property
    def unreachable_share(self) -> tuple[float, float, float]: ...
    @property
    def amplitude_constant(self) -> float: ...
    @property
    def depth_missing_px(self) -> int: ...
    @property
    def depth_clamped_far_px(self) -> int: ...
    @property
    def depth_clamped_near_px(self) -> int: ...
    @property
    def engine(self) -> str: ...
    @property
    def frame_ms(self) -> float: ...

def view(
    phase_rad: NDArray[np.float32],
    *,
    pupil_mm: float,
    focus_dpt: float,
    rig: Rig | None = None,
    amplitude_constant: float = 1.0,
) -> NDArray[np.float32]: ...
def to_srgb8(rgb: NDArray[np.float32]) -> NDArray[np.uint8]: ...
def evaluate(
    scenes: _Path,
    weights: _Path | None = None,
    *,
    rig: Rig | None = None,
    cards: _Path | None = None,
    marks: _Path | None = None,
    pupils_mm: list[float] | None = None,
    limit: int | None = None,
    border_px: int = 24,
    backend: _Backend = "auto",
) -> dict[str, Any]: ...
def read_scene(
    path: str,
    rig: Rig | None,
    depth_encoding: str | None,
    frame: int,
    width_px: int | None,
    height_px: int | None,
    fit: str,
) -> tuple[NDArray[np.float32], NDArray[np.float32], int, float | None, int, int]: ...
def render_builtin_scene(
    width_px: int | None, height_px: int | None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]: ...
def read_samples(path: _Path, scale_mm_per_unit: float | None) -> dict[str, Any]: ...

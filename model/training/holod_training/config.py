"""What a network and the bench it is made for are, as the weights file states them."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field
from typing import Any

WEIGHTS_FORMAT = "holod-weights-1"


class ConfigError(ValueError):
    """A configuration that cannot be used; the message says which key, what was found and what is expected."""


@dataclass(frozen=True)
class OpticsConfig:
    """The bench: units are in the names; `depth_*_dpt` bound the volume, dioptres."""

    wavelengths_nm: tuple[float, float, float] = (638.0, 520.0, 450.0)
    pixel_pitch_um: float = 8.0
    eyepiece_focal_length_mm: float = 40.0
    depth_far_dpt: float = 0.0
    depth_near_dpt: float = 1.0 / 0.35

    @property
    def pitch_m(self) -> float:
        return self.pixel_pitch_um * 1e-6

    @property
    def focal_length_m(self) -> float:
        return self.eyepiece_focal_length_mm * 1e-3

    @property
    def wavelengths_m(self) -> tuple[float, ...]:
        return tuple(nm * 1e-9 for nm in self.wavelengths_nm)

    @property
    def pixel_angle_rad(self) -> float:
        return self.pitch_m / self.focal_length_m

    def distance_m(self, depth_dpt: float) -> float:
        """u = f² · dioptres: metres from the SLM plane to the image plane of a depth."""
        return self.focal_length_m**2 * depth_dpt

    def dioptres(self, normalised: float) -> float:
        return self.depth_far_dpt + normalised * (self.depth_near_dpt - self.depth_far_dpt)


@dataclass(frozen=True)
class NetworkConfig:
    """The `direct` family; `model/weights` carries this as JSON under the key `config`."""

    architecture: str = "direct"
    version: int = 1
    grid: str = "half-band"
    layers: int = 14
    channels: int = 32
    adjustable_layers: tuple[int, ...] = (7,)
    modulation_hidden: int = 32
    leaky_slope: float = 0.1
    optics: OpticsConfig = field(default_factory=OpticsConfig)
    pupil_range_mm: tuple[float, float] = (1.0, 5.0)
    amplitude_constant: float = 1.4

    def __post_init__(self) -> None:
        if self.architecture != "direct":
            raise ConfigError(f"architecture: found {self.architecture!r}, this trainer builds 'direct'")
        if self.version != 1:
            raise ConfigError(f"version: found {self.version}, this trainer builds version 1")
        if self.grid not in ("half-band", "full"):
            raise ConfigError(f"grid: found {self.grid!r}, expected 'half-band' or 'full'")
        if self.layers < 4 or self.layers % 2:
            raise ConfigError(f"layers: found {self.layers}, expected an even number of at least 4")
        for index in self.adjustable_layers:
            if not 1 <= index <= self.layers - 2:
                raise ConfigError(
                    f"adjustable_layers: found {index}, expected layers of the body, 1 to {self.layers - 2}"
                )

    def to_json(self) -> str:
        return json.dumps(dataclasses.asdict(self))

    @classmethod
    def from_json(cls, text: str) -> NetworkConfig:
        """Raises ConfigError for text that is no object, or for a key that is missing or unknown."""
        try:
            found = json.loads(text)
        except json.JSONDecodeError as error:
            raise ConfigError(f"network config is not JSON: {error}") from error
        values = _checked(cls, found, "network config")
        values["optics"] = OpticsConfig(**_checked(OpticsConfig, values["optics"], "network config, optics"))
        return cls(**values)


def _checked(cls: type, found: Any, where: str) -> dict[str, Any]:
    if not isinstance(found, dict):
        raise ConfigError(f"{where}: found {type(found).__name__}, expected an object")
    expected = {f.name for f in dataclasses.fields(cls)}
    if missing := sorted(expected - found.keys()):
        raise ConfigError(f"{where}: keys missing: {', '.join(missing)}")
    if unknown := sorted(found.keys() - expected):
        raise ConfigError(f"{where}: unknown keys: {', '.join(unknown)}")
    return {key: tuple(value) if isinstance(value, list) else value for key, value in found.items()}

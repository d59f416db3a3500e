"""What a network is and which benches it was trained for, as the weights file states it; and what a bench is."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

WEIGHTS_FORMAT = "holod-weights-2"
ARCHITECTURES = ("direct", "layered", "expected-stack", "focal-stack")
# Those of them that the engines run; a `focal-stack` with feedback.
ENGINE_ARCHITECTURES = ("direct", "expected-stack", "focal-stack")
CONDITIONINGS = ("adjustable", "deformable", "modulated")
# By which factor a bench's diffraction may lie outside what was trained before `holod` no longer runs it.
FARTHEST_OUTSIDE = 1.5
# Relative difference below which two figures are the same.
SAME = 1e-4


class ConfigError(ValueError):
    """A configuration that cannot be used; the message says which key, what was found and what is expected."""


def require(name: str, found: object, met: bool, expected: str) -> None:
    """Raises ConfigError for an option or key whose value is not `met`."""
    if not met:
        raise ConfigError(f"{name}: found {found!r}, expected {expected}")


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

    @property
    def volume_dpt(self) -> float:
        return self.depth_near_dpt - self.depth_far_dpt

    def volume_blur_px(self, pupil_mm: float) -> float:
        """s·(f/p)·V: the circle of confusion of one end of the depth volume, in panel pixels, for an eye with a pupil
        of s that is focused on the other."""
        return 1e-3 * pupil_mm / self.pixel_angle_rad * self.volume_dpt

    def pupil_mm(self, volume_blur_px: float) -> float:
        """The pupil for which `volume_blur_px` is so much."""
        return volume_blur_px * 1e3 * self.pixel_angle_rad / self.volume_dpt

    @property
    def volume_fresnel_px2(self) -> tuple[float, ...]:
        """λ·(f/p)²·V of each colour: the distance u = f²·V that the volume's images span, times the wavelength, in
        squared panel pixels. Its root is how far light of that colour spreads by diffraction over the volume."""
        return tuple(w / self.pixel_angle_rad**2 * self.volume_dpt for w in self.wavelengths_m)

    def distance_m(self, depth_dpt: float) -> float:
        """u = f² · dioptres: metres from the SLM plane to the image plane of a depth."""
        return self.focal_length_m**2 * depth_dpt

    def dioptres(self, normalised: float) -> float:
        return self.depth_far_dpt + normalised * (self.depth_near_dpt - self.depth_far_dpt)


@dataclass(frozen=True)
class TrainedRange:
    """The least and the most, of all benches and pupils that a network was trained for, of `OpticsConfig`'s
    `volume_blur_px` and of its `volume_fresnel_px2`; as they stand, of the default bench and pupils of 1 to 5 mm."""

    volume_blur_px: tuple[float, float] = (14.0, 72.0)
    volume_fresnel_px2: tuple[float, float] = (32.0, 46.0)

    def outside(self, optics: OpticsConfig) -> float:
        """By what factor the diffraction of a bench lies outside, of the colour that is farthest; 1 where none is."""
        least, most = self.volume_fresnel_px2
        worst = max(max(least / px2, px2 / most) for px2 in optics.volume_fresnel_px2)
        return worst if worst > 1 + SAME else 1.0

    def blurs_outside(self, volume_blur_px: float) -> bool:
        """Whether a pupil blurs less or more than any that was trained for."""
        least, most = self.volume_blur_px
        return not least / (1 + SAME) <= volume_blur_px <= most * (1 + SAME)

    def told_of(self, optics: OpticsConfig) -> str:
        """How a bench lies outside, in `holod`'s words."""
        found, (least, most) = optics.volume_fresnel_px2, self.volume_fresnel_px2
        return (
            f"diffraction over this bench's depth range, λ·(f/p)²·V, is {min(found):.2f} to {max(found):.2f} px²; the "
            f"network was trained for {least:.2f} to {most:.2f} px²"
        )


def _optional(default: Any) -> Any:
    """A key that a weights file carries only where it differs from the default: readers that do not know it keep on."""
    return field(default=default, metadata={"optional": True})


def _rises(values: Sequence[float]) -> bool:
    return all(a < b for a, b in pairwise(values))


@dataclass(frozen=True)
class NetworkConfig:
    """One network; `model/weights` carries this as JSON under the key `config`. `variants.py` has a table of them.

    direct: field at the SLM plane from amplitude and depth. layered: light on the objects' surfaces, carried by
    physics. expected-stack: phases and masks for what an eye should see at each depth layer, carried by physics.
    focal-stack: phases and masks for `planes` images, uniform in dioptres, carried back and summed.
    """

    architecture: str = "direct"
    version: int = 2
    grid: str = "half-band"
    layers: int = 14
    channels: int = 32
    adjustable_layers: tuple[int, ...] = (7,)
    modulation_hidden: int = 32
    leaky_slope: float = 0.1
    trained: TrainedRange = field(default_factory=TrainedRange)
    amplitude_constant: float = 1.4
    # One for each layer; none stands for all 1.
    dilations: tuple[int, ...] = _optional(())
    # What stands at `adjustable_layers`: the ADC, a deformable layer or a modulated one.
    conditioning: str = _optional("adjustable")
    # Whether s and s·(D − ½) are inputs.
    pupil_inputs: bool = _optional(True)
    # Whether the mean CoC over all focuses is an input (`direct` only).
    blur_input: bool = _optional(False)
    # Time-multiplexed frames, whose intensities the eye averages (`direct` only).
    frames: int = _optional(1)
    # One whole network for each of these pupils, the nearest serves; none stands for one network for all.
    specialists_mm: tuple[float, ...] = _optional(())
    depth_layers: int = _optional(8)
    transport_prior: bool = _optional(True)
    # The second net of `layered`, `expected-stack` and a fed-back `focal-stack`; dilations as above.
    correction_layers: int = _optional(10)
    correction_dilations: tuple[int, ...] = _optional(())
    # Whether the first net also corrects the expected images before they light the layers and are asked for by the
    # feedback (`expected-stack` only).
    refined_stack: bool = _optional(False)
    planes: int = _optional(6)
    # Whether what the field lacks of the images is fed back and a second net corrects it (`focal-stack` only).
    feedback: bool = _optional(False)

    def __post_init__(self) -> None:
        self._require("architecture", self.architecture in ARCHITECTURES, f"one of {', '.join(ARCHITECTURES)}")
        self._require("version", self.version == 2, "version 2, which this trainer builds")
        self._require("grid", self.grid in ("half-band", "full"), "'half-band' or 'full'")
        # The bounds are those of the engines.
        for key in ("layers", "correction_layers"):
            count = getattr(self, key)
            self._require(key, 4 <= count <= 64 and count % 2 == 0, "an even number from 4 to 64")
        self._require("channels", 1 <= self.channels <= 256, "1 to 256")
        self._require("depth_layers", 2 <= self.depth_layers <= 64, "2 to 64")
        self._require(
            "adjustable_layers",
            all(1 <= index <= self.layers - 2 for index in self.adjustable_layers) and _rises(self.adjustable_layers),
            f"layers of the body, 1 to {self.layers - 2}, in rising order",
        )
        self._require("modulation_hidden", 1 <= self.modulation_hidden <= 1024, "1 to 1024")
        known = f"one of {', '.join(CONDITIONINGS)}"
        self._require("conditioning", self.conditioning in CONDITIONINGS, known)
        self._require(
            "dilations",
            len(self.dilations) in (0, self.layers) and all(d >= 1 for d in self.dilations),
            f"none, or {self.layers} numbers of at least 1, one for each layer",
        )
        self._require(
            "dilations",
            not self.dilations or all(self.dilations[i] == 1 for i in self.adjustable_layers),
            f"1 at the adjustable layers {self.adjustable_layers}",
        )
        for key, found in dataclasses.asdict(self.trained).items():
            if len(found) != 2 or not 0 < found[0] <= found[1] < math.inf:
                raise ConfigError(f"trained.{key}: found {list(found)}, expected two above 0, in ascending order")
        constant = self.amplitude_constant
        self._require("amplitude_constant", 0 < constant < math.inf, "a number above 0")
        direct = self.architecture == "direct"
        self._require("frames", self.frames >= 1 and (direct or self.frames == 1), "1; `direct` may have more")
        self._require("blur_input", direct or not self.blur_input, "false; only `direct` can have it")
        expecting = self.architecture == "expected-stack"
        self._require("grid", self.grid == "half-band" or not expecting, "'half-band' for `expected-stack`")
        self._require("refined_stack", expecting or not self.refined_stack, "false; only `expected-stack` can have it")
        fed_back = self.architecture == "focal-stack" and self.grid == "half-band"
        self._require("feedback", fed_back or not self.feedback, "false; only a half-band `focal-stack` can have it")
        always_told = self.architecture in ("layered", "expected-stack")
        self._require("pupil_inputs", self.pupil_inputs or not always_told, f"true for `{self.architecture}`")
        self._require(
            "correction_dilations",
            len(self.correction_dilations) in (0, self.correction_layers)
            and all(d >= 1 for d in self.correction_dilations),
            f"none, or {self.correction_layers} numbers of at least 1, one for each layer",
        )
        self._require("planes", 2 <= self.planes <= 64, "2 to 64")
        self._require("specialists_mm", _rises(self.specialists_mm), "pupils in rising order")

    def _require(self, key: str, met: bool, expected: str) -> None:
        require(key, getattr(self, key), met, expected)

    def to_json(self) -> str:
        values = dataclasses.asdict(self)
        for f in dataclasses.fields(self):
            if f.metadata.get("optional") and getattr(self, f.name) == f.default:
                del values[f.name]
        return json.dumps(values)

    @classmethod
    def from_json(cls, text: str) -> NetworkConfig:
        """Raises ConfigError for text that is no object, or for a key that is missing or unknown."""
        try:
            found = json.loads(text)
        except json.JSONDecodeError as error:
            raise ConfigError(f"network config is not JSON: {error}") from error
        values = _checked(cls, found, "network config")
        values["trained"] = TrainedRange(**_checked(TrainedRange, values["trained"], "network config, trained"))
        return cls(**values)


def _checked(cls: type, found: Any, where: str) -> dict[str, Any]:
    if not isinstance(found, dict):
        raise ConfigError(f"{where}: found {type(found).__name__}, expected an object")
    expected = {f.name for f in dataclasses.fields(cls)}
    optional = {f.name for f in dataclasses.fields(cls) if f.metadata.get("optional")}
    if missing := sorted(expected - optional - found.keys()):
        raise ConfigError(f"{where}: keys missing: {', '.join(missing)}")
    if unknown := sorted(found.keys() - expected):
        raise ConfigError(f"{where}: unknown keys: {', '.join(unknown)}")
    return {key: tuple(value) if isinstance(value, list) else value for key, value in found.items()}

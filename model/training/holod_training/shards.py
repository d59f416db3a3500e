"""Random-scene shards: one safetensors file per scene, written by `holod-scenes` (format `holod-scene-1`)."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from holod_training.config import ConfigError, OpticsConfig, require

SHARD_FORMAT = "holod-scene-1"
# A pupil as near to another is the same.
PUPIL_TOLERANCE_MM = 0.05
TRAINING_KIND = "train"
SPECIAL_KINDS = ("cards", "marks")
DEFAULT_BENCH = OpticsConfig()


class ShardError(ValueError):
    """A shard that cannot be used; the message names the file, what was found and what to do."""


def same_focuses(found: Sequence[float], expected: Sequence[float]) -> bool:
    """Whether two lists of focuses are one within a thousandth of a dioptre."""
    return len(found) == len(expected) and all(abs(f - e) <= 1e-3 for f, e in zip(found, expected, strict=True))


def same_bench(one: OpticsConfig, other: OpticsConfig) -> bool:
    """Whether benches are alike to 1e-4 in everything."""
    pairs = zip((*one.wavelengths_nm, one.pixel_pitch_um), (*other.wavelengths_nm, other.pixel_pitch_um), strict=True)
    return _same_blur(one, other) and all(abs(a - b) <= 1e-4 * b for a, b in pairs)


def _same_blur(one: OpticsConfig, other: OpticsConfig) -> bool:
    """Whether benches have the same depth volume and pixel angle to 1e-4: then pupils and focuses stay as written."""
    keys = ("depth_far_dpt", "depth_near_dpt", "pixel_angle_rad")
    pairs = [(getattr(one, key), getattr(other, key)) for key in keys]
    return all(abs(a - b) <= 1e-4 * max(1e-3, abs(b)) for a, b in pairs)


@dataclass(frozen=True)
class Stack:
    """One scene, or a crop of it, for one pupil. Linear light, 0 .. 1; float32.

    image [3, H, W] all in focus; depth [H, W], 0 far .. 1 near; target [K, 3, H, W] thin-lens pictures; pupil_mm and
    focus_dpt are those that show it on the bench of `optics`; faulty_depth [H, W] what a poor depth camera would give
    the network in place of `depth`, where that was drawn.
    """

    image: Tensor
    depth: Tensor
    target: Tensor
    pupil_mm: float
    focus_dpt: tuple[float, ...]
    faulty_depth: Tensor | None = None
    optics: OpticsConfig = DEFAULT_BENCH

    @property
    def given_depth(self) -> Tensor:
        """What the network is given; targets and CoC go by `depth`."""
        return self.depth if self.faulty_depth is None else self.faulty_depth

    @property
    def amplitude(self) -> Tensor:
        return self.image.clamp_min(0).sqrt()

    def at(self, focuses: slice) -> Stack:
        """The same with only some of its focuses."""
        return replace(self, target=self.target[focuses], focus_dpt=self.focus_dpt[focuses])

    def to(self, device: torch.device | str) -> Stack:
        return replace(
            self,
            image=self.image.to(device),
            depth=self.depth.to(device),
            target=self.target.to(device),
            faulty_depth=None if self.faulty_depth is None else self.faulty_depth.to(device),
        )


class Shard:
    """A checked header; pixels are read (memory-mapped) only when they are asked for.

    How a scene blurs depends on the circle of confusion over its depth volume in pixels, s·(f/p)·V, and on nothing else
    of a bench: so one file shows what eyes see on every bench, with other pupils and focuses. `pupils_mm` and
    `focus_dpt` are those of the bench of `optics`.
    """

    def __init__(self, path: Path) -> None:
        """Raises ShardError for a file that is no complete shard."""
        self.path = path
        try:
            with safe_open(path, framework="pt") as file:
                metadata = file.metadata() or {}
                names = set(file.keys())
                self.height, self.width = self._size(file, names)
                self.kind = metadata.get("kind", "")
                self._check_format(metadata)
                self.index = int(self._number(metadata, "index"))
                self.seed = metadata.get("seed", "")
                self.pupils_mm: tuple[float, ...] = tuple(self._list(metadata, "pupils_mm"))
                self.focus_dpt: tuple[float, ...] = tuple(self._list(metadata, "focus_dpt"))
                self.optics = self._rendered_for(metadata)
                for index in range(len(self.pupils_mm)):
                    self._check_shape(file, names, f"stack_{index}", [len(self.focus_dpt), 3, self.height, self.width])
                self._check_shape(file, names, "depth", [self.height, self.width])
        except FileNotFoundError as error:
            raise ShardError(f"{path}: no such shard; write some with `holod-scenes generate`") from error
        except (SafetensorError, OSError) as error:
            raise ShardError(
                f"{path}: not a whole safetensors file ({error}); delete it and run `holod-scenes generate` again"
            ) from error

    def _check_format(self, metadata: dict[str, str]) -> None:
        if metadata.get("format") != SHARD_FORMAT:
            raise ShardError(
                f"{self.path}: metadata format is {metadata.get('format')!r}, expected {SHARD_FORMAT!r}; "
                "write the shards with this version's `holod-scenes`"
            )

    def _size(self, file: Any, names: set[str]) -> tuple[int, int]:
        if "image" not in names:
            raise ShardError(f"{self.path}: no tensor 'image'; found {', '.join(sorted(names)) or 'none'}")
        shape = file.get_slice("image").get_shape()
        if len(shape) != 3 or shape[0] != 3:
            raise ShardError(f"{self.path}: image has shape {shape}, expected [3, height, width]")
        return shape[1], shape[2]

    def _check_shape(self, file: Any, names: set[str], name: str, expected: list[int]) -> None:
        found = file.get_slice(name).get_shape() if name in names else None
        if found != expected:
            raise ShardError(f"{self.path}: {name} has shape {found}, expected {expected}")

    def _value(self, metadata: dict[str, str], key: str) -> Any:
        if key not in metadata:
            raise ShardError(f"{self.path}: metadata key '{key}' is missing")
        try:
            return json.loads(metadata[key])
        except json.JSONDecodeError as error:
            raise ShardError(f"{self.path}: metadata {key} = {metadata[key]!r} is not JSON") from error

    def _number(self, metadata: dict[str, str], key: str) -> float:
        value = self._value(metadata, key)
        if not isinstance(value, int | float):
            raise ShardError(f"{self.path}: metadata {key} = {value!r}, expected a number")
        return float(value)

    def _list(self, metadata: dict[str, str], key: str) -> list[float]:
        value = self._value(metadata, key)
        if not isinstance(value, list) or not value or not all(isinstance(v, int | float) for v in value):
            raise ShardError(f"{self.path}: metadata {key} = {value!r}, expected a list of numbers")
        return [float(v) for v in value]

    def _rendered_for(self, metadata: dict[str, str]) -> OpticsConfig:
        """The bench on which the scene is seen. Older shards do not name wavelengths and pitch, which do
        not matter to a scene: they have those of the default bench."""
        far, near, angle = (self._number(metadata, key) for key in ("far_dpt", "near_dpt", "pixel_angle_rad"))
        pitch_um = self._number(metadata, "pixel_pitch_um") if "pixel_pitch_um" in metadata else None
        wavelengths_nm = self._list(metadata, "wavelengths_nm") if "wavelengths_nm" in metadata else None
        if wavelengths_nm and (len(wavelengths_nm) != 3 or not all(200 < nm < 2000 for nm in wavelengths_nm)):
            raise ShardError(
                f"{self.path}: metadata wavelengths_nm = {wavelengths_nm}, expected those of three colours in "
                "nanometres"
            )
        if not (0 <= far < near and angle > 0):
            raise ShardError(
                f"{self.path}: metadata far_dpt = {far}, near_dpt = {near}, pixel_angle_rad = {angle}, expected a "
                "depth volume of rising dioptres and an angle above 0"
            )
        pitch_um = pitch_um or DEFAULT_BENCH.pixel_pitch_um
        red, green, blue = wavelengths_nm or DEFAULT_BENCH.wavelengths_nm
        # As the rig had it: the angle is what is left of a division.
        focal_length_mm = float(f"{pitch_um * 1e-3 / angle:.9g}")
        found = OpticsConfig((red, green, blue), pitch_um, focal_length_mm, far, near)
        return DEFAULT_BENCH if same_bench(found, DEFAULT_BENCH) else found

    def on(self, optics: OpticsConfig) -> Shard:
        """The same scene with the pupils and focuses that show its pictures on another bench."""
        theirs, volume = self.optics, self.optics.volume_dpt
        shard = copy.copy(self)
        shard.optics = optics
        if not _same_blur(theirs, optics):
            shard.pupils_mm = tuple(optics.pupil_mm(theirs.volume_blur_px(mm)) for mm in self.pupils_mm)
            shard.focus_dpt = tuple(optics.dioptres((dpt - theirs.depth_far_dpt) / volume) for dpt in self.focus_dpt)
        return shard

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.width, self.height

    def nearest_pupil(self, pupil_mm: float) -> int:
        """The index of the stack whose pupil is nearest."""
        return min(range(len(self.pupils_mm)), key=lambda i: abs(self.pupils_mm[i] - pupil_mm))

    def read(self, pupil_index: int, top: int = 0, left: int = 0, size: int | None = None) -> Stack:
        """The stack of one pupil, whole or a square crop. Raises ShardError for values that are no numbers."""
        rows = slice(top, self.height if size is None else top + size)
        columns = slice(left, self.width if size is None else left + size)
        with safe_open(self.path, framework="pt") as file:

            def part(name: str) -> Tensor:
                found: Tensor = file.get_slice(name)[..., rows, columns].float()
                if not found.isfinite().all():
                    raise ShardError(
                        f"{self.path}: {name} has values that are no numbers, expected finite ones; delete the file "
                        "and run `holod-scenes generate` again"
                    )
                return found

            return Stack(
                image=part("image"),
                depth=part("depth"),
                target=part(f"stack_{pupil_index}"),
                pupil_mm=self.pupils_mm[pupil_index],
                focus_dpt=self.focus_dpt,
                optics=self.optics,
            )

    def stacks(self) -> Iterator[Stack]:
        for index in range(len(self.pupils_mm)):
            yield self.read(index)


def shard_names(folder: Path) -> list[str]:
    """Complete shards in a folder, by name. Raises ShardError where the folder is missing."""
    if not folder.is_dir():
        raise ShardError(f"{folder}: no such folder of shards; write some with `holod-scenes generate --out {folder}`")
    return sorted(path.name for path in folder.glob("scene_*.safetensors"))


def open_shards(folder: Path, optics: OpticsConfig | None = None, limit: int | None = None) -> list[Shard]:
    """Every shard of a folder, headers checked, as they look on a bench; without one on that which they were
    rendered for. Raises ShardError for none at all, for the first bad one and for shards of several benches, and
    ConfigError for a limit that leaves none."""
    require("--limit", limit, limit is None or limit >= 1, "at least 1 scene")
    names = shard_names(folder)[:limit]
    if not names:
        raise ShardError(f"{folder}: no scene_*.safetensors in it; write some with `holod-scenes generate`")
    shards = [Shard(folder / name) for name in names]
    if optics is not None:
        return [shard.on(optics) for shard in shards]
    for shard in shards[1:]:
        if not same_bench(shard.optics, shards[0].optics):
            raise ShardError(
                f"{shard.path}: rendered for {shard.optics}, but {shards[0].path.name} for {shards[0].optics}; "
                "expected one bench: keep the scenes of each in a folder of its own"
            )
    return shards


def open_held_out(folder: Path, optics: OpticsConfig | None = None, limit: int | None = None) -> list[Shard]:
    """`open_shards` for judging. Raises ShardError for a scene that was rendered for training, too."""
    shards = open_shards(folder, optics, limit)
    for shard in shards:
        if shard.kind == TRAINING_KIND:
            raise ShardError(
                f"{shard.path}: metadata kind is {shard.kind!r}, expected held-out scenes: networks are not judged on "
                "what they learn from; write others with `holod-scenes generate --kind test`"
            )
    return shards


def open_test(folder: Path, limit: int | None = None) -> list[Shard]:
    """`open_held_out` for the scenes of `--test`. Raises ShardError for cards and marks, too, of which PSNR and slope
    tell nothing."""
    shards = open_held_out(folder, limit=limit)
    for shard in shards:
        if shard.kind in SPECIAL_KINDS:
            raise ShardError(
                f"{shard.path}: metadata kind is {shard.kind!r}, expected scenes of `holod-scenes generate --kind "
                f"test`: name a folder of {shard.kind} with `evaluate --{shard.kind}`"
            )
    return shards


def check_kind(shard: Shard, kind: str) -> None:
    """Raises ShardError for a scene of another kind."""
    if shard.kind != kind:
        raise ShardError(f"{shard.path}: a scene of kind {shard.kind!r}, expected {kind}; write it with --kind {kind}")


def check_pupils(shards: Sequence[Shard], pupils_mm: Sequence[float]) -> None:
    """Raises ShardError for scenes that lack one of the pupils which they are judged with."""
    for shard in shards:
        nearest = [shard.pupils_mm[shard.nearest_pupil(pupil_mm)] for pupil_mm in pupils_mm]
        if any(abs(found - mm) > PUPIL_TOLERANCE_MM for found, mm in zip(nearest, pupils_mm, strict=True)):
            found, expected = (",".join(f"{mm:g}" for mm in some) for some in (shard.pupils_mm, pupils_mm))
            raise ShardError(
                f"{shard.path}: pupils_mm is {found}, expected {expected} among them, which validation has figures of; "
                f"render such scenes with `holod-scenes generate --kind test --pupils {expected}`"
            )


def check_border(shards: Sequence[Shard], border_px: int, option: str = "", least_px: int = 1) -> None:
    """Raises for scenes of which a border leaves fewer than `least_px` pixels either way: ConfigError for an option
    that asks for too much, ShardError for scenes that are too small for any."""
    if option:
        require(option, border_px, border_px >= 0, "at least 0")
    for shard in shards:
        most = (min(shard.height, shard.width) - least_px) // 2
        if border_px > most:
            size = f"{shard.width}x{shard.height} pixels"
            if option and most >= 0:
                raise ConfigError(f"{option}: found {border_px}, expected at most {most}: {shard.path} has {size}")
            least = least_px + 2 * border_px
            raise ShardError(f"{shard.path}: {size}, expected at least {least}x{least} within a border of {border_px}")

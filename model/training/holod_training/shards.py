"""Random-scene shards: one safetensors file per scene, written by `holod-scenes` (format `holod-scene-1`)."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from holod_training.config import OpticsConfig

SHARD_FORMAT = "holod-scene-1"
TRAINING_KIND = "train"


class ShardError(ValueError):
    """A shard that cannot be used; the message names the file, what was found and what to do."""


def same_focuses(found: Sequence[float], expected: Sequence[float]) -> bool:
    """Whether two lists of focuses are one within a thousandth of a dioptre."""
    return len(found) == len(expected) and all(abs(f - e) <= 1e-3 for f, e in zip(found, expected, strict=True))


@dataclass(frozen=True)
class Stack:
    """One scene, or a crop of it, for one pupil. Linear light, 0 .. 1; float32.

    image [3, H, W] all in focus; depth [H, W], 0 far .. 1 near; target [K, 3, H, W] thin-lens pictures;
    faulty_depth [H, W] what a poor depth camera would give the network in place of `depth`, where that was drawn.
    """

    image: Tensor
    depth: Tensor
    target: Tensor
    pupil_mm: float
    focus_dpt: tuple[float, ...]
    faulty_depth: Tensor | None = None

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
        return Stack(
            self.image.to(device),
            self.depth.to(device),
            self.target.to(device),
            self.pupil_mm,
            self.focus_dpt,
            None if self.faulty_depth is None else self.faulty_depth.to(device),
        )


class Shard:
    """A checked header; pixels are read (memory-mapped) only when they are asked for."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with safe_open(path, framework="pt") as file:
                metadata = file.metadata() or {}
                names = set(file.keys())
                self.height, self.width = self._size(file, names)
                self.kind = metadata.get("kind", "")
                self._check_format(metadata)
                self.index = int(self._number(metadata, "index"))
                self.pupils_mm: tuple[float, ...] = tuple(self._list(metadata, "pupils_mm"))
                self.focus_dpt: tuple[float, ...] = tuple(self._list(metadata, "focus_dpt"))
                self.far_dpt = self._number(metadata, "far_dpt")
                self.near_dpt = self._number(metadata, "near_dpt")
                self.pixel_angle_rad = self._number(metadata, "pixel_angle_rad")
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

    def require_optics(self, optics: OpticsConfig) -> None:
        """Raises ShardError where the shard was rendered for another bench."""
        found = (self.far_dpt, self.near_dpt, self.pixel_angle_rad)
        expected = (optics.depth_far_dpt, optics.depth_near_dpt, optics.pixel_angle_rad)
        for name, f, e in zip(("far_dpt", "near_dpt", "pixel_angle_rad"), found, expected, strict=True):
            if abs(f - e) > 1e-4 * max(1e-3, abs(e)):
                raise ShardError(f"{self.path}: {name} is {f}, the network is made for {e}")

    def nearest_pupil(self, pupil_mm: float) -> int:
        """The index of the stack whose pupil is nearest."""
        return min(range(len(self.pupils_mm)), key=lambda i: abs(self.pupils_mm[i] - pupil_mm))

    def read(self, pupil_index: int, top: int = 0, left: int = 0, size: int | None = None) -> Stack:
        """The stack of one pupil, whole or a square crop."""
        rows = slice(top, self.height if size is None else top + size)
        columns = slice(left, self.width if size is None else left + size)
        with safe_open(self.path, framework="pt") as file:
            return Stack(
                image=file.get_slice("image")[:, rows, columns].float(),
                depth=file.get_slice("depth")[rows, columns].float(),
                target=file.get_slice(f"stack_{pupil_index}")[:, :, rows, columns].float(),
                pupil_mm=self.pupils_mm[pupil_index],
                focus_dpt=self.focus_dpt,
            )

    def stacks(self) -> Iterator[Stack]:
        for index in range(len(self.pupils_mm)):
            yield self.read(index)


def shard_names(folder: Path) -> list[str]:
    """Complete shards in a folder, by name. Raises ShardError where the folder is missing."""
    if not folder.is_dir():
        raise ShardError(f"{folder}: no such folder of shards; write some with `holod-scenes generate --out {folder}`")
    return sorted(path.name for path in folder.glob("scene_*.safetensors"))


def open_shards(folder: Path, optics: OpticsConfig, limit: int | None = None) -> list[Shard]:
    """Every shard of a folder, headers checked. Raises ShardError for none at all and for the first bad one."""
    names = shard_names(folder)[:limit]
    if not names:
        raise ShardError(f"{folder}: no scene_*.safetensors in it; write some with `holod-scenes generate`")
    shards = [Shard(folder / name) for name in names]
    for shard in shards:
        shard.require_optics(optics)
    return shards


def open_held_out(folder: Path, optics: OpticsConfig, limit: int | None = None) -> list[Shard]:
    """`open_shards` for judging. Raises ShardError for a scene that was rendered for training, too."""
    shards = open_shards(folder, optics, limit)
    for shard in shards:
        if shard.kind == TRAINING_KIND:
            raise ShardError(
                f"{shard.path}: metadata kind is {shard.kind!r}, expected held-out scenes: networks are not judged on "
                "what they learn from; write others with `holod-scenes generate --kind test`"
            )
    return shards

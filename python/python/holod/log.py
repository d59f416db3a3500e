"""Logs of pupil diameters."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from holod._holod import read_samples
from holod.errors import InputError


class Blink(NamedTuple):
    """A blink that the log itself tells."""

    eye: str
    """ "left", "right" or "both" """
    begin_ns: int
    end_ns: int


@dataclass(frozen=True)
class PupilLog:
    """The samples of a log in order of time, an array for each column."""

    t_ns: NDArray[np.int64]
    """when it was taken on the log's own clock, nanoseconds"""
    eye: NDArray[np.str_]
    """ "left", "right" or "both" """
    diameter: NDArray[np.float32]
    """in `unit`, as the log has it; means nothing where not `valid`"""
    confidence: NDArray[np.float32]
    """0 to 1; 1 where the log has none"""
    aperture_mm: NDArray[np.float32]
    """distance between the lids, NaN where the log has none"""
    valid: NDArray[np.bool_]
    """False where the tracker saw no pupil"""
    blinks: list[Blink]
    """those that the log itself tells"""
    info: dict[str, Any] = field(repr=False)
    """what `holod log info --json` says of the log, without the gate's word"""
    unit: str
    """of `diameter`: "mm", "camera pixels" or "arbitrary units" """
    scale_mm_per_unit: float | None
    """given, or else the one that a recording of holod's began with"""

    @property
    def t_s(self) -> NDArray[np.float64]:
        """Seconds since the first sample."""
        return (self.t_ns - self.t_ns[0]) * 1e-9

    @property
    def diameter_mm(self) -> NDArray[np.float32]:
        """Millimetres. Raises InputError for a log in another unit that was read without a scale."""
        if self.scale_mm_per_unit is not None:
            return (self.diameter * np.float64(self.scale_mm_per_unit)).astype(np.float32)
        if self.unit != "mm":
            raise InputError(
                f"diameter_mm: the log is in {self.unit}; give read_log its scale_mm_per_unit, measured with a printed "
                "disc of known diameter, or use `diameter`"
            )
        return self.diameter

    @property
    def format(self) -> str:
        """The kind of log that was recognised."""
        return self.info["format"]

    @property
    def rejected(self) -> dict[str, int]:
        """How many lines or cells were rejected, by reason."""
        return {fault["name"]: fault["count"] for fault in self.info["faults"]}

    @property
    def notes(self) -> list[str]:
        """What a user should know of how the log was read."""
        return self.info["notes"]

    def __len__(self) -> int:
        return len(self.t_ns)


def read_log(path: str | os.PathLike[str], *, scale_mm_per_unit: float | None = None) -> PupilLog:
    """Reads a log of any format that holod knows, told by its content.

    `scale_mm_per_unit` is for logs that are not in millimetres: it changes `diameter_mm` and what `info` finds. A
    recording of holod's has the scale that its run began with, which is taken unless another is given.

    Raises InputError for a file that cannot be read, is of no known format, or holds no sample. Single bad lines are
    counted in `rejected`.
    """
    read = read_samples(os.fspath(path), scale_mm_per_unit)
    eyes = np.array(["left", "right", "both"])
    return PupilLog(
        t_ns=read["t_ns"],
        eye=eyes[read["eye"]],
        diameter=read["diameter"],
        confidence=read["confidence"],
        aperture_mm=read["aperture_mm"],
        valid=read["valid"],
        blinks=[Blink(*blink) for blink in read["blinks"]],
        info=read["info"],
        unit=read["unit"],
        scale_mm_per_unit=read["scale_mm_per_unit"],
    )

"""Pictures with depth, as the daemon reads them."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from holod._holod import Rig, read_scene, render_builtin_scene


@dataclass(frozen=True, eq=False)
class Scene:
    """A picture with depth; `colour` and `depth_unit` are what `Renderer.render` is to be told of it."""

    rgb: NDArray[np.float32]
    """(rows, columns, 3), linear light from 0 to 1"""
    depth: NDArray[np.float32]
    """(rows, columns)"""
    depth_unit: Literal["dioptres", "normalised_dioptres"]
    colour: Literal["linear"] = "linear"
    frames: int = 1
    """how many pictures the scene has"""
    fps: float | None = None
    """how many of them a second, where the scene says so"""
    depth_missing_px: int = 0
    """pixels without a depth, which were filled from their surroundings"""
    colour_clipped_px: int = 0
    """pixels with a colour above white, below 0 or not finite, which was clipped"""


def load_scene(
    path: str | os.PathLike[str],
    *,
    depth_encoding: str | None = None,
    frame: int = 0,
    width_px: int | None = None,
    height_px: int | None = None,
    fit: Literal["native", "contain", "cover", "crop"] = "native",
    rig: Rig | None = None,
) -> Scene:
    """Reads a picture of a scene as the daemon would, with depth in dioptres.

    `path` is a folder with a scene.toml, that file, "COLOUR,DEPTH", or an OpenEXR file with both. For the latter two
    `depth_encoding` says what the depth file's numbers are: "metres", "millimetres", "dioptres", or
    "normalised_dioptres:FAR,NEAR" in dioptres, whose ends are those of `rig` where they are left out; a scene.toml
    names its own, and another one beside it is refused. `frame` is the picture's place in a sequence. `width_px` and
    `height_px` bring it to another size in the way of `fit`; nothing is stretched. What the picture does not reach is
    black, at the far end of the depth range of `rig`, the built-in one without.

    Raises InputError with the file, what was found in it and what was expected.
    """
    rgb, depth, frames, fps, missing_px, clipped_px = read_scene(
        os.fspath(path), rig, depth_encoding, frame, width_px, height_px, fit
    )
    return Scene(rgb, depth, "dioptres", "linear", frames, fps, missing_px, clipped_px)


def builtin_scene(width_px: int | None = None, height_px: int | None = None) -> Scene:
    """The daemon's built-in scene at any size, 512 x 512 where it is left out: text cards, objects between them, and a
    floor through all depths.

    Its depth is normalised to the rig's depth range. The cards stand at 0.875 and 0.0875 of it: on the built-in bench
    at 2.5 and 0.25 dioptres, 40 cm and 4 m, as is written on them; on another one at
    `rig.depth_far_dpt + 0.875 * (rig.depth_near_dpt - rig.depth_far_dpt)` dioptres, and likewise."""
    rgb, depth = render_builtin_scene(width_px, height_px)
    return Scene(rgb, depth, "normalised_dioptres")

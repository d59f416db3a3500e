from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import holod
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

SIZE = (96, 64)
"""width and height of most pictures here"""

RIG = """
name = "a small bench"

[panel]
width_px = 160
height_px = 120
pixel_pitch_um = 8.0
refresh_hz = 60.0
mode = "field-sequential"
field_order = ["green", "red", "blue"]
bit_depth = 8
phase_sign = "negative"
stroke_pi = { red = 1.9921875, green = 2.2, blue = 2.6 }
settle_ms = 1.0

[optics]
wavelengths_nm = { red = 638.0, green = 520.0, blue = 450.0 }
eyepiece_focal_length_mm = 40.0
depth_far_m = inf
depth_near_m = 0.35

[lasers]
driver = "simulated"
power_mw = { red = 1.0, green = 1.0, blue = 1.0 }
on_delay_ms = 0.1
lit_ms = 3.0
heartbeat_timeout_ms = 100.0

[tracker]
eye = "both"
fallback_mm = 3.0
hold_ms = 1000.0

[model]
network = "fast"
"""


class Daemon:
    """The binary that $HOLOD names."""

    def __init__(self, binary: str, folder: Path) -> None:
        self.binary = binary
        self.folder = folder

    def run(self, *arguments: str | Path) -> str:
        """What it prints; it must succeed."""
        ended = self.try_run(*arguments)
        assert ended.returncode == 0, ended.stderr
        return ended.stdout

    def try_run(self, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
        command = [self.binary, *map(str, arguments)]
        return subprocess.run(command, cwd=self.folder, capture_output=True, text=True, check=False)

    def json(self, *arguments: str | Path) -> Any:
        return json.loads(self.run(*arguments, "--json"))


@pytest.fixture
def daemon(tmp_path: Path) -> Daemon:
    binary = os.environ.get("HOLOD")
    if binary is None:
        assert "CI" not in os.environ, "HOLOD must name the daemon: the package is compared with it"
        pytest.skip("HOLOD does not name the daemon, such as target/release/holod")
    return Daemon(binary, tmp_path)


@pytest.fixture(scope="session")
def renderer() -> holod.Renderer:
    """One of the smallest network, for pictures of SIZE."""
    return holod.Renderer(weights="fast", width_px=SIZE[0], height_px=SIZE[1], backend="cpu")


@pytest.fixture(scope="session")
def scene() -> holod.Scene:
    return holod.builtin_scene(*SIZE)


@pytest.fixture
def picture_files(tmp_path: Path) -> tuple[Path, Path]:
    """A colour file of 8 bits and a depth file of 16, in millimetres with holes, of another size than SIZE."""
    random = np.random.default_rng(7)
    colour, depth = tmp_path / "colour.png", tmp_path / "depth.png"
    Image.fromarray(random.integers(0, 256, (54, 70, 3), np.uint8)).save(colour)
    columns = np.linspace(250, 6000, 70)
    depth_mm = np.repeat(columns[np.newaxis], 54, axis=0).astype(np.uint16)
    depth_mm[10:14, 20:30] = 0
    Image.fromarray(depth_mm).save(depth)
    return colour, depth


def read_png(path: Path) -> NDArray[Any]:
    return np.asarray(Image.open(path))

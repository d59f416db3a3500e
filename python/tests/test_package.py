"""The package as a whole: what it says of itself, its types, its examples and the README."""

from __future__ import annotations

import importlib.util
import inspect
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import holod
import holod_client
import numpy as np
import pytest
from PIL import Image

PROJECT = Path(__file__).parents[1]


def test_everything_public_is_documented() -> None:
    for name in holod.__all__:
        thing = getattr(holod, name)
        assert inspect.getdoc(thing), name
        if not inspect.isclass(thing):
            continue
        for member, value in vars(thing).items():
            if not member.startswith("_") and (callable(value) or inspect.isdatadescriptor(value)):
                documented = inspect.getdoc(value) or issubclass(thing, tuple)
                assert documented or thing.__module__.startswith("holod_client"), f"{name}.{member}"


def test_the_stub_is_what_the_module_is() -> None:
    checked = subprocess.run(
        [sys.executable, "-m", "mypy.stubtest", "holod"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert checked.returncode == 0, checked.stdout + checked.stderr


def test_errors_are_of_one_family() -> None:
    assert issubclass(holod.RigError, holod.InputError)
    assert issubclass(holod.InputError, (holod.HolodError, ValueError))
    assert issubclass(holod.UnavailableError, holod.HolodError)


def test_the_clients_come_along() -> None:
    assert holod.Feed is holod_client.Feed
    with pytest.raises(holod.FeedError):
        holod.Feed(8, 8, depth="none", plane_dpt=1.0, path="/nowhere/feed")
    with pytest.raises(holod.ControlError):
        holod.Control("/nowhere/control")
    linked = PROJECT / "python/holod_client"
    package = PROJECT.parent / "deploy/clients/python/holod_client"
    for file in package.iterdir():
        if file.suffix == ".py" or file.name == "py.typed":
            assert (linked / file.name).resolve() == file.resolve(), f"link {file.name} in {linked}, as the others"


def test_the_readme_runs(tmp_path: Path) -> None:
    code = (PROJECT / "README.md").read_text().split("```python\n")[1].split("```")[0]
    code = code.replace("512", "128")
    ended = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.startswith("<holod.Hologram 128x128 for 3 mm")
    picture = np.asarray(Image.open(tmp_path / "near-and-far.png")).astype(int)
    assert picture.shape == (128, 256, 3)
    near, far = picture[:, :128], picture[:, 128:]
    assert near.std() > 20
    assert np.abs(near - far).mean() > 1


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, PROJECT / f"examples/{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_picture_in_open3ds_conventions_is_a_hologram(renderer: holod.Renderer, scene: holod.Scene) -> None:
    """With an object as Open3D's RGBDImage is; Open3D itself is too large to be installed for this."""
    rgb = holod.to_srgb8(scene.rgb)
    metres = 1 / np.maximum(scene.depth * np.float32(1 / 0.35), np.float32(0.1))
    metres[10:20, 30:50] = 0
    rgbd = SimpleNamespace(color=rgb, depth=metres)
    hologram = example("open3d_scene").render(renderer, rgbd, 3.0)
    assert hologram.depth_missing_px == 200
    expected = renderer.render(rgb, metres, 3.0, depth_unit="metres", fill_missing=True)
    assert np.array_equal(hologram.levels, expected.levels)
    wrong = renderer.render(rgb, metres * 1.2, 3.0, depth_unit="metres", fill_missing=True)
    assert not np.array_equal(hologram.levels, wrong.levels)


def test_slmsuite_shows_the_levels_that_holod_would(renderer: holod.Renderer, scene: holod.Scene) -> None:
    simulated = pytest.importorskip("slmsuite.hardware.slms.simulated")
    height_px, width_px = scene.depth.shape
    slm = simulated.SimulatedSLM((width_px, height_px), pitch_um=(8, 8))
    hologram = renderer.render(scene.rgb, scene.depth, 3.0, colour=scene.colour, depth_unit=scene.depth_unit)
    example("slmsuite_slm").show(slm, hologram, "green")
    left, top = (1920 - width_px) // 2, (1080 - height_px) // 2
    levels = hologram.levels[:, top : top + height_px, left : left + width_px].astype(int)

    def apart(levels: np.ndarray) -> np.ndarray:
        # slmsuite's SLMs darken with rising phase.
        steps = (255 - slm.display.astype(int) - levels) % 256
        return np.minimum(steps, 256 - steps)

    assert apart(levels[1]).max() <= 1
    assert apart(levels[0]).max() > 5

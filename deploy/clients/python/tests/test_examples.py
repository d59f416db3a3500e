"""The numbers that the examples make of a camera's and a network's depth."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def monocular(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Without OpenCV, which reads and resizes pictures and has no part in their depth."""
    monkeypatch.setitem(sys.modules, "cv2", ModuleType("cv2"))
    return load("monocular_depth")


@pytest.mark.parametrize(
    ("unit_m", "raw", "expected"),
    [
        (0.001, [0, 1, 400, 65535], [0, 1, 400, 65535]),
        (0.0010000000474974513, [0, 1, 400, 65535], [0, 1, 400, 65535]),
        (0.0001, [0, 1, 4, 16, 4004, 65535], [0, 1, 1, 2, 400, 6554]),
        (0.01, [0, 1, 40, 6553, 6554, 65535], [0, 10, 400, 65530, 65535, 65535]),
    ],
)
def test_a_cameras_units_become_millimetres(unit_m: float, raw: list[int], expected: list[int]) -> None:
    mm = load("realsense").millimetres(np.array(raw, np.uint16), unit_m)
    assert mm.dtype == np.uint16
    assert mm.tolist() == expected


def test_a_cameras_time_is_of_the_monotonic_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    realsense = load("realsense")
    clocks = SimpleNamespace(monotonic_ns=lambda: 5_000_000_000, time_ns=lambda: 1_700_000_000_040_000_000)
    monkeypatch.setattr(realsense, "time", clocks)
    frame = SimpleNamespace(get_timestamp=lambda: 1_700_000_000_000.0, get_frame_timestamp_domain=lambda: "system")
    assert realsense.capture_time_ns(frame, {"system"}) == 5_000_000_000 - 40_000_000
    assert realsense.capture_time_ns(frame, {"global"}) == 0
    for set_by_ns, expected_ns in [(-3_600_000_000_000, 5_000_000_000), (3_600_000_000_000, 0)]:
        clocks.time_ns = lambda set_by_ns=set_by_ns: 1_700_000_000_040_000_000 + set_by_ns
        assert realsense.capture_time_ns(frame, {"system"}) == expected_ns


def test_relative_depth_fills_the_displays_range(monocular: ModuleType) -> None:
    relative = np.array([[7, 9], [8, 11]], np.float32)
    dioptres = monocular.dioptres(relative, 2.5, 0.5)
    assert dioptres.dtype == np.float32
    np.testing.assert_allclose(dioptres, [[0.5, 1.5], [1.0, 2.5]])
    np.testing.assert_allclose(monocular.dioptres(relative * 30 - 4, 2.5, 0.5), dioptres, rtol=1e-6)


@pytest.mark.parametrize(
    ("shape", "expected"), [((480, 640), (480, 640)), ((600, 900), (600, 800)), ((1000, 400), (300, 400))]
)
def test_pictures_are_cut_and_not_stretched(
    monocular: ModuleType, shape: tuple[int, int], expected: tuple[int, int]
) -> None:
    picture = np.arange(np.prod(shape)).reshape(shape)
    part = monocular.middle(picture, (640, 480))
    assert part.shape == expected
    assert abs(int(part[0, 0]) + int(part[-1, -1]) - int(picture[-1, -1])) <= shape[1]


def test_relative_depth_that_is_not_there(monocular: ModuleType) -> None:
    relative = np.array([[np.nan, 1], [np.inf, 3]], np.float32)
    np.testing.assert_allclose(monocular.dioptres(relative, 2, 0), [[np.nan, 0], [np.nan, 2]])
    np.testing.assert_array_equal(monocular.dioptres(np.full((2, 2), 4, np.float32), 2, 0.25), np.full((2, 2), 0.25))


def test_without_the_packages_there_is_no_network(
    monocular: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    assert monocular.network("any") is None
    assert capsys.readouterr().err == "torch is missing: each picture is a plane\n"


def test_the_camera_example_explains_itself() -> None:
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / "realsense.py"), "--help"],
        capture_output=True,
        env={"PYTHONPATH": str(EXAMPLES.parent)},
    )
    assert done.returncode == 0

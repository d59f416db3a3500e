"""The clients against a real holod, which $HOLOD names."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from holod_client import Control, ControlError, Feed, FeedError, UnansweredError

HERE = Path(__file__).parent
STAND_INS = HERE / "stand_ins"
SIZE = 64


class Holod:
    """A holod that listens on `socket` until `end()`, which returns its summary.

    Its runtime folder is in `folder`, or without that where the environment says, and then so is the socket."""

    def __init__(self, binary: str, folder: Path | None, sockets: Path) -> None:
        self.socket = sockets / "feed" if folder is None else folder / "pictures"
        options = ["--resolution", f"{SIZE}x{SIZE}", "--fit", "contain", "--weights", "fast", "--backend", "cpu"]
        self.process = subprocess.Popen(
            [binary, "run", "--scene", "feed" if folder is None else f"feed:{self.socket}", *options, "--json"],
            env={**os.environ, **({} if folder is None else {"XDG_RUNTIME_DIR": str(folder)})},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        patience_s = time.monotonic() + 60
        # The control socket comes last.
        while not self.socket.exists() or not list(sockets.glob("control-*")):
            assert self.process.poll() is None, self.process.communicate()[1]
            assert time.monotonic() < patience_s, "holod does not listen"
            time.sleep(0.02)

    def example(self, name: str, *options: str, stand_ins: Path | None = None) -> subprocess.CompletedProcess[str]:
        """Runs an example until it ends; what is in `stand_ins` takes the place of what it imports."""
        folders = [HERE.parent, *([stand_ins] if stand_ins else [])]
        return subprocess.run(
            [sys.executable, HERE.parent / f"examples/{name}.py", *options, "--socket", self.socket],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, folders))},
            capture_output=True,
            text=True,
            timeout=120,
        )

    def end(self) -> dict:
        self.process.terminate()
        said, log = self.process.communicate(timeout=60)
        assert self.process.returncode == 0, log
        return json.loads(said)


@pytest.fixture
def binary() -> str:
    named = os.environ.get("HOLOD")
    if named is None:
        assert "CI" not in os.environ, "HOLOD must name the daemon: its clients are tested against it"
        pytest.skip("HOLOD does not name the daemon, such as target/release/holod")
    return named


@pytest.fixture
def holod(binary: str, tmp_path: Path) -> Iterator[Holod]:
    running = Holod(binary, tmp_path, tmp_path / "holod")
    yield running
    running.process.kill()
    running.process.wait()


def test_pictures_from_python_are_taken_and_faults_are_told(holod: Holod) -> None:
    rgb = np.full((SIZE, SIZE, 3), 90, np.uint8)
    depth_mm = np.full((SIZE, SIZE), 800, np.uint16)
    with Feed(SIZE, SIZE, depth="u16_mm", name="arrays", path=holod.socket) as feed:
        for _ in range(20):
            feed.send(rgb, depth_mm, t_capture_ns=time.monotonic_ns())
            feed.wait()
        feed.send(rgb, np.zeros_like(depth_mm))
        feed.wait()
        assert feed.refusal == "found no pixel with a valid depth, expected millimetres above 0"
        feed.send(rgb, depth_mm, t_capture_ns=time.time_ns())
        feed.wait()
        assert "not of the calendar's clock" in feed.refusal
        assert (feed.outcomes.taken, feed.outcomes.refused) == (20, 2)
    with pytest.raises(FeedError, match="plane_dpt 300 was found, expected 0 to 20 dioptres"):
        Feed(SIZE, SIZE, depth="none", plane_dpt=300.0, path=holod.socket)
    told = holod.end()["feed"]
    assert (told["taken"], told["refused"], told["connections_refused"]) == (20, 2, 1)


@pytest.mark.parametrize("colour", ["rgba8", "rgba16f", "rgb32f"])
@pytest.mark.parametrize("depth", ["u16_mm", "f16_m", "f16_dpt", "f32_m", "f32_dpt"])
def test_every_format_is_taken(holod: Holod, colour: str, depth: str) -> None:
    with Feed(2 * SIZE, SIZE, colour=colour, depth=depth, path=holod.socket) as feed:
        with feed.slot() as slot:
            slot.colour[...] = 0.5 if slot.colour.dtype.kind == "f" else 128
            slot.depth[...] = 1000 if depth == "u16_mm" else 1
        feed.wait()
        assert feed.outcomes.taken == 1, feed.refusal


def test_a_holod_without_a_runtime_folder_is_found(
    binary: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its sockets are where $TMPDIR says then, and all clients look there."""
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/dev/null")
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    c = HERE.parents[1] / "c"
    example = tmp_path / "example"
    subprocess.run(["cc", "-O2", "-o", example, c / "example.c", c / "holod_feed.c"], check=True, timeout=120)
    folder = tmp_path / f"holod-{os.getuid()}"
    running = Holod(binary, None, folder)
    try:
        with Feed(SIZE, SIZE, depth="u16_mm") as feed:
            assert feed.path == folder / "feed"
        with Control() as control:
            assert control.path.parent == folder
        done = subprocess.run([example, "-", "320x240", "0.2"], capture_output=True, text=True, timeout=60)
        assert done.returncode == 0, done.stderr
    finally:
        running.process.kill()
        running.process.wait()


def test_the_c_example_and_a_pipe_are_shown(holod: Holod, tmp_path: Path) -> None:
    c = HERE.parents[1] / "c"
    example = tmp_path / "example"
    subprocess.run(["cc", "-O2", "-o", example, c / "example.c", c / "holod_feed.c"], check=True, timeout=120)
    done = subprocess.run([example, holod.socket, "320x240", "1"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    command = [sys.executable, "-m", "holod_client", "stdin", "--size", "320x240", "--plane", "1", "--socket"]
    pictures = bytes(320 * 240 * 4 * 3)
    done = subprocess.run([*command, holod.socket], input=pictures, capture_output=True, timeout=60, cwd=HERE.parent)
    assert done.returncode == 0, done.stderr
    told = holod.end()["feed"]
    assert told["taken"] >= 4 and told["refused"] == told["connections_refused"] == 0, told


def needed(program: str) -> None:
    if shutil.which(program) is None:
        assert "CI" not in os.environ, f"{program} must be there: tests/all installs it"
        pytest.skip(f"{program} is not installed")


def test_a_picture_of_gstreamer_is_shown(holod: Holod) -> None:
    """The pipeline of the README, with an end."""
    needed("gst-launch-1.0")
    source = "gst-launch-1.0 -q videotestsrc is-live=true num-buffers=20 pattern=ball"
    caps = "video/x-raw,format=RGBA,width=320,height=240,framerate=30/1"
    client = f"{sys.executable} -m holod_client stdin --size 320x240 --plane 1.0 --name GStreamer"
    pipe = f"set -o pipefail; {source} ! {caps} ! fdsink | {client} --socket {holod.socket}"
    done = subprocess.run(["bash", "-c", pipe], capture_output=True, text=True, timeout=120, cwd=HERE.parent)
    assert done.returncode == 0, done.stderr
    assert "20 sent: " in done.stderr and " 0 refused" in done.stderr
    told = holod.end()["feed"]
    assert told["taken"] >= 1 and told["taken"] + told["overtaken"] == 20, told


def test_the_realsense_example_shows_what_a_camera_gives(holod: Holod) -> None:
    """Without a camera: a module that gives what one would takes the place of Intel's."""
    done = holod.example("realsense", "--size", "64x48", stand_ins=STAND_INS)
    assert (done.returncode, done.stderr) == (1, "error: Frame didn't arrive within 5000\n")
    told = holod.end()["feed"]
    assert told["taken"] >= 1 and told["taken"] + told["overtaken"] == 10 and told["refused"] == 0, told
    assert told["pictures_with_bad_depths"] == told["taken"], "its camera sees no depth in some pixels"
    assert told["bad_depths"]["zero"] > 100 and told["bad_depths"]["beyond_near"] == 0
    np.testing.assert_allclose(told["view"]["field_of_view_deg"], [60, 45], rtol=1e-5)


@pytest.mark.parametrize("has_network", [True, False])
def test_the_monocular_example_shows_a_folder_of_pictures(holod: Holod, tmp_path: Path, has_network: bool) -> None:
    """With OpenCV as it is. The network is too large to be had for this: a stand-in estimates, or there is none."""
    try:
        import cv2
        from PIL import Image  # noqa: F401
    except ImportError:
        assert "CI" not in os.environ, "opencv-python-headless and pillow must be there: tests/all installs them"
        pytest.skip("opencv-python-headless or pillow is not installed")
    pictures = tmp_path / "folder"
    pictures.mkdir()
    for name in ["one.png", "other.png"]:
        assert cv2.imwrite(str(pictures / name), np.full((90, 120, 3), 120, np.uint8))
    absent = tmp_path / "absent"
    absent.mkdir()
    for name in ["torch", "transformers"]:
        (absent / f"{name}.py").write_text(f"raise ImportError(name={name!r})\n")
    stand_ins = STAND_INS / "network" if has_network else absent
    options = ["--size", "64x48", "--seconds", "0.2"]
    done = holod.example("monocular_depth", str(pictures), *options, stand_ins=stand_ins)
    said = "" if has_network else "torch is missing: each picture is a plane\n"
    assert (done.returncode, done.stderr) == (0, said)
    told = holod.end()["feed"]
    assert (told["taken"], told["refused"], told["pictures_with_bad_depths"]) == (2, 0, 0), told


def test_orders_that_a_hanging_holod_does_not_answer_are_told_apart_from_refused_ones(holod: Holod) -> None:
    with Control(next(holod.socket.parent.glob("holod/control-*"))) as control:
        control.lasers_dark()
        holod.process.send_signal(signal.SIGSTOP)
        control.timeout_s = 0.5
        with pytest.raises(UnansweredError, match="whether `pupil` took effect is not known"):
            control.pupil(3.5)
        holod.process.send_signal(signal.SIGCONT)
        control.timeout_s = 60
        assert control.status()["lasers_kept_dark"]
        assert control.lasers_arm() == "lasers are lit again by the rules"
        assert not control.status()["lasers_kept_dark"]


def test_a_running_holod_is_changed(holod: Holod, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(holod.socket.parent))
    with monkeypatch.context() as as_another, pytest.raises(ControlError, match="no holod runs"):
        as_another.setattr(os, "geteuid", lambda: os.getuid() + 1)
        Control()
    with Control() as control:
        assert control.pupil(3.5) == "the pupil is 3.5 mm until further notice"
        patience_s = time.monotonic() + 60
        while (status := control.status())["pupil_mm"] != 3.5:
            assert time.monotonic() < patience_s, status
        assert (status["pupil_state"], status["scene"]) == ("fixed", "the live feed")
        assert "dark" in control.lasers_dark()
        assert control.status()["lasers_kept_dark"]
        control.lasers_arm()
        control.pause()
        control.resume()
        assert "grating" in control.pattern("grating", period_px=8, profile="blazed", colours=["red"])
        assert control.status()["pattern"].startswith("blazed grating, 8 px a line")
        assert "lens, f = -150 mm" in control.pattern("lens", focal_length_m=-0.15)
        control.flat()
        assert control.status()["pattern"] == "flat"
        control.hologram()
        assert control.status()["pattern"] is None
        control.weights("small")
        control.scene("feed")
        control.pupil(None)
        for order, fault in [
            (lambda: control.pupil(0.35), "expected a human pupil"),
            (lambda: control.scene("absent", depth_encoding="metres"), str(Path("absent").absolute())),
            (lambda: control.weights("smal"), "did you mean `small`"),
            (lambda: control.ask("dance"), "unknown variant `dance`"),
        ]:
            with pytest.raises(ControlError, match=fault):
                order()
        assert control.status()["weights"] == "small"
        control.stop()
    assert json.loads(holod.process.communicate(timeout=60)[0])["ended_by"] == "holod ctl stop"
    with pytest.raises(ControlError, match="no holod runs that has a control socket"):
        Control()


def test_the_sweep_of_the_page_on_calibration_becomes_a_table(
    binary: str, holod: Holod, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = (HERE.parents[3] / "calibration/doc/calibrate.md").read_text()
    script = page.split("```python\n")[1].split("```")[0]
    phase_rad = 2.1 * np.pi * (np.arange(256) / 255) ** 1.2
    powers_mw = iter(0.4 * np.sin(phase_rad[[*range(0, 256, 2), 255]] / 2) ** 2)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("time.sleep", lambda _: None)
    monkeypatch.setattr("builtins.input", lambda _: str(next(powers_mw)))
    exec(compile(script, "calibrate.md", "exec"), {})

    command = [binary, "lut", "green-powers.csv", "--out", "-"]
    table = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout
    found_rad = np.loadtxt(table.splitlines(), delimiter=",", skiprows=2)[:, 1]
    assert np.abs(found_rad - phase_rad).max() < 0.03
    assert np.abs(found_rad - np.roll(phase_rad, 2)).max() > 0.03

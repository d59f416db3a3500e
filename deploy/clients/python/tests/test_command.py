"""python -m holod_client, as a process with pictures on its standard input."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from fake_holod import REFUSED, TAKEN, FakeHolod

WIDTH, HEIGHT = 16, 9


def stdin(path: Path, *options: str, pictures: bytes) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        [sys.executable, "-m", "holod_client", "stdin", "--size", f"{WIDTH}x{HEIGHT}", "--socket", str(path), *options],
        input=pictures,
        capture_output=True,
        timeout=30,
        cwd=Path(__file__).parents[1],
    )
    assert done.stdout == b""
    return subprocess.CompletedProcess(done.args, done.returncode, "", done.stderr.decode())


def noise(seed: int, pixel_bytes: int) -> bytes:
    return np.random.default_rng(seed).bytes(WIDTH * HEIGHT * pixel_bytes)


def test_pictures_on_a_plane(path: Path) -> None:
    pictures = [noise(seed, 4) for seed in range(5)]
    with FakeHolod(path) as holod:
        holod.serve()
        done = stdin(path, "--plane", "1.5", "--name", "film", pictures=b"".join(pictures))
        frames = holod.served()
    assert (done.returncode, done.stderr) == (
        0,
        "5 sent: 5 taken, 0 overtaken, 0 refused, 0 while another client was shown\n",
    )
    hello = holod.hello()
    assert (hello.width_px, hello.height_px, hello.colour, hello.depth) == (WIDTH, HEIGHT, 1, 0)
    assert (hello.plane_dpt, hello.name) == (1.5, "film")
    assert [(frame.sequence, frame.t_capture_ns) for frame in frames] == [(1, 0), (2, 0), (3, 0), (4, 0), (5, 0)]
    for frame, colour in zip(frames, pictures, strict=True):
        frame.check(colour, b"")


def test_depth_follows_each_picture(path: Path) -> None:
    pictures = [(noise(seed, 12), noise(100 + seed, 2)) for seed in range(3)]
    with FakeHolod(path) as holod:
        holod.serve()
        raw = b"".join(colour + depth for colour, depth in pictures)
        done = stdin(path, "--depth", "u16_mm", "--colour", "rgb32f", pictures=raw)
        frames = holod.served()
    assert done.returncode == 0
    for frame, (colour, depth) in zip(frames, pictures, strict=True):
        frame.check(colour, depth)


def test_no_pictures_at_all(path: Path) -> None:
    with FakeHolod(path) as holod:
        holod.serve()
        done = stdin(path, "--plane", "0", pictures=b"")
        assert holod.served() == []
    assert done.returncode == 0
    assert done.stderr.startswith("0 sent")


@pytest.mark.parametrize(
    ("rest", "expected"),
    [
        (b"x", "ends inside the colour of picture 2: found 1 bytes, expected 576"),
        (noise(1, 4), "ends inside the depth of picture 2: found 0 bytes, expected 288"),
    ],
)
def test_a_picture_that_is_cut_off(path: Path, rest: bytes, expected: str) -> None:
    with FakeHolod(path) as holod:
        holod.serve()
        done = stdin(path, "--depth", "u16_mm", pictures=noise(0, 4) + noise(0, 2) + rest)
        assert len(holod.served()) == 1
    assert done.returncode == 65
    assert expected in done.stderr
    assert "1 sent" in done.stderr


def test_refusals_are_printed(path: Path) -> None:
    with FakeHolod(path) as holod:
        holod.serve(lambda frame: (REFUSED, "no pixel has a depth") if frame.sequence == 1 else (TAKEN, ""))
        done = stdin(path, "--depth", "u16_mm", pictures=2 * (noise(0, 4) + noise(0, 2)))
    assert done.returncode == 0
    assert done.stderr == (
        "holod refused a picture: no pixel has a depth\n"
        "2 sent: 1 taken, 0 overtaken, 1 refused, 0 while another client was shown\n"
    )


def test_pictures_a_second(path: Path) -> None:
    with FakeHolod(path) as holod:
        times: list[float] = []
        holod.serve(lambda frame: (times.append(time.monotonic()), (TAKEN, ""))[1])
        assert stdin(path, "--plane", "0", "--fps", "20", pictures=6 * noise(0, 4)).returncode == 0
        holod.served()
    assert times[-1] - times[0] > 5 / 20 / 2


def test_an_interrupt_ends_it_between_pictures(path: Path) -> None:
    command = [sys.executable, "-m", "holod_client", "stdin", "--size", f"{WIDTH}x{HEIGHT}", "--plane", "0"]
    with FakeHolod(path) as holod:
        process = subprocess.Popen(
            [*command, "--socket", str(path)],
            stdin=subprocess.PIPE,
            stderr=subprocess.PIPE,
            cwd=Path(__file__).parents[1],
            # A program in the background may be started with it ignored.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )
        process.stdin.write(noise(0, 4) + b"the beginning of another")
        process.stdin.flush()
        holod.free(holod.frame())
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=30)
    assert process.returncode == 130
    # It may come before the picture that has arrived is counted.
    assert errors.startswith((b"0 sent", b"1 sent")) and b"Traceback" not in errors


def test_a_closed_standard_input_is_told(path: Path) -> None:
    command = [sys.executable, "-m", "holod_client", "stdin", "--size", "4x4", "--plane", "0", "--socket", str(path)]
    done = subprocess.run(
        ["sh", "-c", 'exec "$@" <&-', "sh", *command], capture_output=True, timeout=30, cwd=Path(__file__).parents[1]
    )
    assert done.returncode == 2
    assert b"error: standard input is closed: pipe pictures into it" in done.stderr


def test_a_name_that_is_no_text(path: Path) -> None:
    with FakeHolod(path) as holod:
        holod.serve()
        done = stdin(path, "--plane", "0", "--name", os.fsdecode(b"film \xff"), pictures=noise(0, 4))
        holod.served()
    assert (done.returncode, holod.hello().name) == (0, "film ?")


def test_no_holod(path: Path) -> None:
    done = stdin(path, "--plane", "0", pictures=noise(0, 4))
    assert done.returncode == 69
    assert done.stderr.startswith(f"error: no holod listens on {path}: start it with")


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ((), "give one of --plane DPT"),
        (("--plane", "1", "--depth", "u16_mm"), "give one of --plane DPT"),
        (("--depth", "mm"), "invalid choice: 'mm'"),
        (("--plane", "1", "--size", "640"), "invalid WxH value: '640'"),
        (("--plane", "1", "--size", "0x9"), "invalid WxH value: '0x9'"),
        (("--plane", "1", "--size", "99999999999x1"), "invalid WxH value: '99999999999x1'"),
        (("--plane", "1", "--fps", "0"), "invalid pictures a second value: '0'"),
    ],
)
def test_options_that_do_not_fit(path: Path, options: tuple[str, ...], expected: str) -> None:
    done = stdin(path, *options, pictures=b"")
    assert done.returncode == 2
    assert expected in done.stderr

"""`evaluate` finds what `holod evaluate` finds, and other threads and Ctrl-C are served meanwhile."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from pathlib import Path

import holod
import pytest
from conftest import Daemon

GOLDEN = Path(__file__).parents[2] / "model/golden/evaluation.safetensors"


def with_entries(**entries: str) -> bytes:
    """The shard that the trainer judged with other entries in its metadata."""
    golden = GOLDEN.read_bytes()
    start = 8 + int.from_bytes(golden[:8], "little")
    header = json.loads(golden[8:start])
    header["__metadata__"] |= entries
    text = json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + golden[start:]


@pytest.fixture
def scenes(tmp_path: Path) -> Path:
    """A folder with the scene that the trainer judged."""
    folder = tmp_path / "scenes"
    folder.mkdir()
    (folder / "scene_000000.safetensors").write_bytes(with_entries())
    return folder


@pytest.fixture
def cards(tmp_path: Path) -> Path:
    """A folder with the same scene as cards."""
    folder = tmp_path / "cards"
    folder.mkdir()
    (folder / "scene_000000.safetensors").write_bytes(with_entries(kind="cards"))
    return folder


def test_the_figures_are_those_of_the_command(daemon: Daemon, scenes: Path, cards: Path) -> None:
    options = {"cards": cards, "border_px": 8, "backend": "cpu"}
    found = holod.evaluate(scenes, "fast", **options)  # type: ignore[arg-type]
    command = ["evaluate", "--scenes", scenes, "--cards", cards, "--backend", "cpu", "--weights", "fast"]
    assert found == daemon.json(*command, "--border-px", 8)
    assert found != daemon.json(*command, "--border-px", 9)
    assert found["rows"][0]["psnr_db"]["mean"] > 10
    assert found["colours"] == ["red", "green", "blue"]
    assert found["engine"].startswith("cpu, ")
    pupil_mm = found["rows"][0]["pupil_mm"]
    one = holod.evaluate(scenes, "fast", pupils_mm=[pupil_mm], limit=1, **options)  # type: ignore[arg-type]
    assert one["rows"] == found["rows"][:1]


def test_what_cannot_be_judged_is_told(scenes: Path, tmp_path: Path) -> None:
    for said, options in [
        ("absent", {"scenes": tmp_path / "absent"}),
        ("border_px: found 400, expected at most", {"border_px": 400}),
        ("expected one for 8.25 mm in every scene", {"pupils_mm": [8.25]}),
        ("or choose among theirs by pupils_mm", {"pupils_mm": [8.25]}),
        ("pupils_mm: found none, expected some of the scenes' own", {"pupils_mm": []}),
        ("limit: found 0, expected at least 1", {"limit": 0}),
        ("limit: found -1", {"limit": -1}),
        ("pupils_mm: found 0 mm, expected diameters above 0 mm", {"pupils_mm": [2.0, 0.0]}),
        ("pupils_mm: found NaN mm", {"pupils_mm": [float("nan")]}),
        ("pupils_mm: found inf mm", {"pupils_mm": [float("inf")]}),
        # Scenes for benches of little blur have such pupils, for which the command looks, too.
        ("expected one for 12.5 mm in every scene", {"pupils_mm": [12.5]}),
        ("expected one for 0.25 mm in every scene", {"pupils_mm": [0.25]}),
    ]:
        with pytest.raises(holod.InputError) as raised:
            holod.evaluate(**({"scenes": scenes, "weights": "fast"} | options))  # type: ignore[arg-type]
        assert said in str(raised.value)


def test_an_interrupt_ends_an_evaluation(scenes: Path) -> None:
    # More than any machine judges before the interrupt comes.
    for number in range(1, 200):
        (scenes / f"scene_{number:06}.safetensors").write_bytes(with_entries(index=str(number)))
    ends: list[str] = []

    def note(_frame: object, event: str, called: object) -> None:
        if called is holod.evaluate and event != "c_call":
            ends.append(event)

    # A shell's background jobs inherit that it is ignored.
    inherited = signal.signal(signal.SIGINT, signal.default_int_handler)
    interrupt = threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT))
    sys.setprofile(note)
    try:
        holod.evaluate(scenes, "fast", border_px=8, limit=1, backend="cpu")
        assert ends == ["c_return"], "its end is seen"
        with pytest.raises(KeyboardInterrupt):
            interrupt.start()
            holod.evaluate(scenes, "fast", border_px=8, backend="cpu")
    finally:
        interrupt.join()
        sys.setprofile(None)
        signal.signal(signal.SIGINT, inherited)
    # An evaluation that only ended would return first, and the interrupt would come after it.
    assert "c_return" not in ends[1:]

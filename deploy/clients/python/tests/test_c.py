"""The C client and its example, built with the address and undefined-behaviour sanitizers."""

from __future__ import annotations

import dataclasses
import os
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from fake_holod import NOT_SHOWN, OVERTAKEN, REFUSED, TAKEN, FakeHolod, Frame, Layout, ObjectionError

HERE = Path(__file__).parent
C = HERE.parents[1] / "c"
CC = ["cc", "-std=c11", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O2", f"-I{C}"]
SANITIZERS = ["-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
WIDTH, HEIGHT = 24, 16


def build(out: Path, source: Path, *options: str) -> Path:
    subprocess.run([*CC, *options, "-o", str(out), str(source), str(C / "holod_feed.c")], check=True, timeout=120)
    return out


@pytest.fixture(scope="session")
def driver(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Beside it is the folder of its service."""
    out = tmp_path_factory.mktemp("c") / "driver"
    (out.parent / "service").mkdir()
    return build(out, HERE / "driver.c", f'-DSERVICE_PATH="{out.parent}/service/feed"', *SANITIZERS)


@pytest.fixture(scope="session", params=["plain", "sanitized"])
def example(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    options = SANITIZERS if request.param == "sanitized" else []
    return build(tmp_path_factory.mktemp("c") / "example", C / "example.c", *options)


class Driver:
    """A running driver.c: each call is a line to it, and returns what it answers."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process
        self.opened = self._answer()

    def tell(self, line: str) -> None:
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def _answer(self) -> str:
        return self.process.stdout.readline().rstrip("\n")

    def ask(self, line: str) -> str:
        self.tell(line)
        return self._answer()

    def picture(self, seed: int, t_capture_ns: int = 0) -> None:
        assert [self.ask("begin 0"), self.ask(f"fill {seed}"), self.ask(f"send {t_capture_ns}")] == ["ok"] * 3


@contextmanager
def drive(
    driver: Path,
    path: Path | str,
    colour: int = 1,
    depth: int = 1,
    plane_dpt: float = 0,
    name: str = "C",
    *,
    tells_view: bool = False,
    **environment: str,
) -> Iterator[Driver]:
    """Ends the driver as well, which must leave nothing behind and object to nothing."""
    arguments = [str(driver), str(path), f"{WIDTH}x{HEIGHT}", str(colour), str(depth), str(plane_dpt), name]
    arguments += ["tells_view"] if tells_view else []
    process = subprocess.Popen(
        arguments,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "RUNTIME_DIRECTORY": "", **environment},
    )
    try:
        yield Driver(process)
        rest, errors = process.communicate(timeout=30)
        assert (process.returncode, rest, errors) == (0, "", "")
    finally:
        process.kill()
        process.wait()


def filled(frame: Frame) -> Callable[[int], None]:
    """Checks that `frame` was filled by the driver with a seed."""

    def pattern(count: int, seed: int) -> bytes:
        k = np.arange(count)
        return (seed + k * 7 + k // 251).astype(np.uint8).tobytes()

    def check(seed: int) -> None:
        frame.check(pattern(len(frame.colour), seed), pattern(len(frame.depth), seed + 128))

    return check


@pytest.mark.parametrize("depth", range(6))
@pytest.mark.parametrize("colour", [1, 2, 3])
def test_every_format_arrives_byte_for_byte(driver: Path, path: Path, colour: int, depth: int) -> None:
    plane_dpt = 0 if depth else 2.5
    with FakeHolod(path) as holod, drive(driver, path, colour, depth, plane_dpt, "Gerät") as feed:
        assert feed.opened == "ok"
        hello = holod.hello()
        assert dataclasses.astuple(hello) == (WIDTH, HEIGHT, colour, depth, plane_dpt, "Gerät", 1)
        for seed in range(5):
            feed.picture(seed, seed - 2)
            frame = holod.frame()
            filled(frame)(seed)
            assert (frame.sequence, frame.t_capture_ns) == (seed + 1, seed - 2)
            assert len(frame.depth) == WIDTH * HEIGHT * (0, 2, 2, 2, 4, 4)[depth]
            holod.free(frame)
        assert feed.ask("wait 5000") == "ok"


def test_pictures_say_how_they_were_taken(driver: Path, path: Path) -> None:
    with FakeHolod(path) as holod, drive(driver, path, tells_view=True) as feed:
        assert holod.hello().version == 2
        for line, view in [
            (None, (None, None)),
            ("view 1.25 60 45.5", (1.25, (60.0, 45.5))),
            ("view 0 0 0", (0.0, None)),
            ("view -1 90 60", (None, (90.0, 60.0))),
            ("view", (None, None)),
        ]:
            assert line is None or feed.ask(line) == "ok"
            feed.picture(1)
            frame = holod.frame()
            assert (frame.focus_dpt, frame.field_of_view_deg) == view
            holod.free(frame)
        for line, said in [
            ("view 20.5 0 0", "a focus of 20.5 dioptres was given, expected 0"),
            ("view nan 0 0", "a focus of nan dioptres"),
            ("view 1 60 0", "a field of view of 60 x 0 degrees was given"),
            ("view 1 180 45", "expected two angles"),
            ("view 1 nan 45", "expected two angles"),
        ]:
            assert said in feed.ask(line)
    with FakeHolod(path) as holod, drive(driver, path) as feed:
        assert feed.ask("view 1 60 45") == "failed: the feed was opened without tells_view"
        feed.picture(1)
        holod.free(holod.frame())
        assert holod.hello().version == 1


def test_the_check_of_a_picture_objects_to_another(driver: Path, path: Path) -> None:
    with FakeHolod(path) as holod, drive(driver, path) as feed:
        feed.picture(3)
        frame = holod.frame()
        with pytest.raises(ObjectionError, match="colour, byte 0: found 3, expected 4"):
            filled(frame)(4)


@pytest.mark.parametrize("slots", [1, 64])
def test_any_number_of_slots(driver: Path, path: Path, slots: int) -> None:
    with FakeHolod(path, slots=slots) as holod, drive(driver, path) as feed:
        frames = []
        for seed in range(slots):
            feed.picture(seed)
            frames.append(holod.frame())
            filled(frames[-1])(seed)
        assert feed.ask("begin 0").startswith("timeout: holod has kept all")
        for frame in frames:
            holod.free(frame)
        assert feed.ask("begin 5000") == "ok"


def test_waits_for_a_slot_through_signals(driver: Path, path: Path) -> None:
    with FakeHolod(path) as holod, drive(driver, path) as feed:
        for seed in range(3):
            feed.picture(seed)
        frames = [holod.frame() for _ in range(3)]
        feed.tell("begin -1")
        for _ in range(20):
            time.sleep(0.01)
            feed.process.send_signal(signal.SIGUSR1)
        holod.free(frames[2])
        assert feed.ask("fill 9") == "ok"
        assert feed.ask("send 0") == "ok"
        assert feed._answer() == "ok"
        frame = holod.frame()
        assert frame.slot == frames[2].slot
        filled(frame)(9)


def test_a_slow_holod_is_a_timeout_and_no_end(driver: Path, path: Path) -> None:
    with FakeHolod(path) as holod, drive(driver, path) as feed:
        for seed in range(3):
            feed.picture(seed)
        began = time.monotonic()
        assert feed.ask("begin 100") == "timeout: holod has kept all 3 slots for 100 ms: is it busy?"
        assert 0.09 < time.monotonic() - began < 5
        assert feed.ask("wait 0").startswith("timeout: holod has not said in 0 ms what became of 3 pictures")
        assert feed.ask("leave_out 5") == "ok"
        frames = [holod.frame() for _ in range(3)]
        for frame in frames:
            holod.free(frame)
        assert feed.ask("wait 5000") == "ok"
        feed.picture(3)
        assert holod.frame().sequence == 9


def test_a_picture_begun_twice_is_one(driver: Path, path: Path) -> None:
    with FakeHolod(path, slots=1) as holod, drive(driver, path) as feed:
        assert feed.ask("send 0") == "failed: no picture was begun: call holod_feed_begin first"
        assert [feed.ask("begin 0"), feed.ask("fill 1"), feed.ask("begin 0"), feed.ask("send 0")] == ["ok"] * 4
        filled(holod.frame())(1)


def test_what_became_of_pictures(driver: Path, path: Path) -> None:
    outcomes = [TAKEN, OVERTAKEN, OVERTAKEN, REFUSED, REFUSED, REFUSED, NOT_SHOWN, NOT_SHOWN, NOT_SHOWN, NOT_SHOWN]
    with FakeHolod(path) as holod, drive(driver, path) as feed:
        assert feed.ask("outcomes") == "0 0 0 0 0 0 0 "
        for seed, outcome in enumerate(outcomes):
            feed.picture(seed)
            holod.free(holod.frame(), outcome, f"schräg {seed}" if outcome == REFUSED else "")
            assert feed.ask("wait 5000") == "ok"
        assert feed.ask("outcomes") == f"10 1 2 3 4 10 {NOT_SHOWN} schräg 5"


def test_a_long_refusal_is_cut(driver: Path, path: Path) -> None:
    with FakeHolod(path) as holod, drive(driver, path) as feed:
        feed.picture(0)
        holod.free(holod.frame(), REFUSED, "x" * 5000)
        assert feed.ask("wait 5000") == "ok"
        assert feed.ask("outcomes") == "1 0 0 1 0 1 2 " + "x" * 1023


def test_holod_refuses_the_format(driver: Path, path: Path) -> None:
    with FakeHolod(path, nope="found a width of 9000 pixels"), drive(driver, path) as feed:
        refusal = f"failed: holod refused the connection on {path}: found a width of 9000 pixels"
        assert feed.opened == refusal
        assert [feed.ask("begin 0"), feed.ask("send 0"), feed.ask("wait 0")] == [refusal] * 3


@pytest.mark.parametrize("call", ["send 0", "begin 0", "wait 5000"])
def test_holod_refuses_in_the_middle_with_pictures_unread(driver: Path, path: Path, call: str) -> None:
    with FakeHolod(path) as holod, drive(driver, path) as feed:
        feed.picture(0)
        assert feed.ask("begin 0") == "ok"
        holod.refuse("found slot 7")
        assert feed.ask("fill 1") == "ok"
        assert feed.ask(call) == f"failed: holod refused the connection on {path}: found slot 7"


def test_holod_dies_in_the_middle(driver: Path, path: Path) -> None:
    with FakeHolod(path) as holod, drive(driver, path) as feed:
        feed.picture(0)
        assert feed.ask("begin 0") == "ok"
        holod.die()
        assert feed.ask("fill 1") == "ok"
        assert feed.ask("send 0").startswith("failed: holod closed the connection")
        assert feed.ask("begin 0").startswith("failed: holod closed the connection")


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda ring: dataclasses.replace(ring, slots=0), "0 slots"),
        (lambda ring: dataclasses.replace(ring, slots=65), "65 slots"),
        (lambda ring: dataclasses.replace(ring, colour_bytes=1), "1 bytes of colour"),
        (lambda ring: dataclasses.replace(ring, depth_bytes=7), "7 of depth"),
        (lambda ring: dataclasses.replace(ring, colour_offset=ring.colour_offset + 4), "not multiples"),
        (lambda ring: dataclasses.replace(ring, depth_offset=ring.distance), "outside"),
        (lambda ring: dataclasses.replace(ring, depth_offset=2**64 - 64), "outside"),
        (lambda ring: dataclasses.replace(ring, distance=2**63), "outside"),
        (lambda ring: dataclasses.replace(ring, slots=4), "holod's memory has"),
    ],
)
def test_memory_that_does_not_fit(driver: Path, path: Path, change: Callable[[Layout], Layout], expected: str) -> None:
    with FakeHolod(path, change=change), drive(driver, path) as feed:
        assert feed.opened.startswith("failed: ") and expected in feed.opened


def test_messages_of_another_protocol(driver: Path, path: Path) -> None:
    with FakeHolod(path) as holod, drive(driver, path) as feed:
        holod.hello()
        holod.connection.send(b"W\nAT is this")
        assert "'W?AT' of 12 bytes, expected FREE" in feed.ask("begin 0")


def test_a_slot_that_holod_did_not_have(driver: Path, path: Path) -> None:
    with FakeHolod(path) as holod, drive(driver, path) as feed:
        holod.hello()
        feed.picture(0)
        frame = holod.frame()
        holod.free(frame)
        assert feed.ask("begin 5000") == "ok"
        holod.free(frame)
        assert feed.ask("begin 0").startswith(f"failed: holod gave back slot {frame.slot}")


def test_nobody_listens(driver: Path, path: Path) -> None:
    with drive(driver, path) as feed:
        assert feed.opened.startswith(f"failed: no holod listens on {path}: start it with `holod run --scene feed`")
    with drive(driver, path / ("x" * 100)) as feed:
        assert "a socket's at most 107" in feed.opened


def leave_behind(path: Path) -> Path:
    """What a holod that was killed leaves: a socket on which nobody listens."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as left_behind:
        left_behind.bind(str(path))
    return path


@pytest.mark.parametrize("is_left_behind", [True, False])
def test_the_service_is_found_behind_a_socket_that_was_left(driver: Path, tmp_path: Path, is_left_behind: bool) -> None:
    service, own = driver.parent / "service" / "feed", tmp_path / "holod" / "feed"
    if is_left_behind:
        leave_behind(own)
    with FakeHolod(service) as holod, drive(driver, "", XDG_RUNTIME_DIR=str(tmp_path)) as feed:
        assert (feed.opened, feed.ask("error")) == ("ok", "")
        feed.picture(3)
        filled(holod.frame())(3)
    with drive(driver, "", XDG_RUNTIME_DIR=str(tmp_path)) as feed:
        assert feed.opened.startswith(f"failed: no holod listens on {own} or ")
        assert f"{service}: start it with" in feed.opened
    # A path that was named is the one that is meant.
    named = leave_behind(tmp_path / "named")
    with FakeHolod(service), drive(driver, service), drive(driver, named) as feed:
        assert feed.opened.startswith(f"failed: no holod listens on {named}: start it with")


def test_a_holod_of_ones_own_goes_before_the_service(driver: Path, tmp_path: Path) -> None:
    service, own = driver.parent / "service" / "feed", tmp_path / "holod" / "feed"
    own.parent.mkdir()
    with FakeHolod(service), drive(driver, service), FakeHolod(own) as holod:
        with drive(driver, "", name="mine", XDG_RUNTIME_DIR=str(tmp_path)) as feed:
            assert feed.opened == "ok"
        assert holod.hello().name == "mine"


@pytest.mark.parametrize("named", ["/dev/null", "relative", ""])
def test_holod_is_found_in_the_folder_for_temporary_files(driver: Path, tmp_path: Path, named: str) -> None:
    """Where it has no folder of its own elsewhere, or may not write there."""
    environment = {"RUNTIME_DIRECTORY": named, "XDG_RUNTIME_DIR": named, "TMPDIR": str(tmp_path)}
    folder = tmp_path / f"holod-{os.getuid()}"
    folder.mkdir()
    with FakeHolod(folder / "feed"), drive(driver, "", **environment) as feed:
        assert feed.opened == "ok"
    with drive(driver, "", **environment) as feed:
        assert f"{folder}/feed or {driver.parent}/service/feed: start it with" in feed.opened
        assert "is used" not in feed.opened


@pytest.mark.parametrize("is_link", [True, False])
def test_a_folder_of_somebody_elses_is_not_used(driver: Path, tmp_path: Path, is_link: bool) -> None:
    environment = {"XDG_RUNTIME_DIR": "/dev/null", "TMPDIR": str(tmp_path)}
    folder = tmp_path / f"holod-{os.getuid()}"
    if is_link:
        (tmp_path / "elsewhere").mkdir()
        folder.symlink_to(tmp_path / "elsewhere")
    else:
        if os.geteuid() != 0:
            pytest.skip("only root can give a folder away")
        folder.mkdir()
        os.chown(folder, 65534, 65534)
    trap = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    trap.bind(str(folder / "feed"))
    trap.listen()
    with trap, FakeHolod(driver.parent / "service" / "feed"), drive(driver, "", **environment) as feed:
        assert feed.opened == "ok"
        trap.setblocking(False)
        with pytest.raises(BlockingIOError):
            trap.accept()
    with drive(driver, "", **environment) as feed:
        assert feed.opened.startswith("failed: no holod listens on /dev/null/holod/feed or ")
        assert feed.opened.endswith(f"; nothing in {folder} is used, which is no folder of this user's")


def test_holod_says_nothing(driver: Path, path: Path) -> None:
    with FakeHolod(path, silent=True), drive(driver, path) as feed:
        assert feed.opened == f"failed: holod said nothing on {path} for 5 s: see its log, start it again"


@pytest.mark.parametrize(
    ("name", "expected"),
    [("a" * 33, "a" * 32), ("a" * 31 + "ü", "a" * 31), ("a" * 29 + "眼鏡", "a" * 29 + "眼"), ("🔴" * 9, "🔴" * 8)],
)
def test_a_long_name_is_cut_between_characters(driver: Path, path: Path, name: str, expected: str) -> None:
    with FakeHolod(path) as holod, drive(driver, path, name=name):
        assert holod.hello().name == expected


def test_no_descriptor_is_left_and_none_is_inherited(driver: Path, path: Path) -> None:
    def descriptors(feed: Driver) -> dict[str, str]:
        folder = Path(f"/proc/{feed.process.pid}/fd")
        return {one.name: os.readlink(one) for one in folder.iterdir()}

    with drive(driver, path) as feed:
        without = descriptors(feed)
    with FakeHolod(path) as holod, drive(driver, path) as feed:
        extra = set(descriptors(feed)) - set(without)
        assert len(extra) == 1
        flags = Path(f"/proc/{feed.process.pid}/fdinfo/{extra.pop()}").read_text()
        assert int(flags.split("flags:")[1].split()[0], 8) & os.O_CLOEXEC
        holod.die()
        assert feed.ask("begin 0").startswith("failed")
        assert len(descriptors(feed)) == len(without)


def cards(width: int, height: int, frame: int) -> tuple[bytes, bytes]:
    """The picture of example.c."""
    y, x = np.mgrid[:height, :width]
    colour = np.zeros((height, width, 4), np.uint8)
    colour[...] = np.stack([0 * y + 40, 0 * y + 40, y * 128 // height, 0 * y + 255], axis=-1)
    depth_mm = np.full((height, width), 4000, np.uint16)

    far = (slice(height // 8, height // 8 + height // 2), slice(width // 8, width // 8 + width // 2))
    stripe = np.where((y[far] - height // 8) // 8 % 2, 220, 60)
    colour[far] = np.stack([0 * stripe + 60, stripe, stripe, 0 * stripe + 255], axis=-1)
    depth_mm[far] = 2000

    travel = width - width // 4
    left = travel - abs(travel - frame * 4 % (2 * travel))
    near = (slice(height // 2, height // 2 + height // 3), slice(left, left + width // 4))
    stripe = np.where((x[near] - left) // 8 % 2, 240, 30)
    colour[near] = np.stack([stripe, stripe, 0 * stripe + 30, 0 * stripe + 255], axis=-1)
    depth_mm[near] = 400
    return colour.tobytes(), depth_mm.tobytes()


def run_example(example: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(example), *arguments],
        capture_output=True,
        text=True,
        timeout=60,
        env={**os.environ, "RUNTIME_DIRECTORY": "", **environment},
    )


def test_the_example_shows_two_cards(example: Path, path: Path) -> None:
    with FakeHolod(path) as holod:
        holod.serve()
        done = run_example(example, str(path), "200x120", "0.75", "80")
        frames = holod.served()
    assert (done.returncode, done.stderr) == (0, "")
    hello = holod.hello()
    assert (hello.width_px, hello.height_px, hello.colour, hello.depth) == (200, 120, 1, 1)
    counts = f"{len(frames)} sent: {len(frames)} taken, 0 overtaken, 0 refused, 0 while another client was shown\n"
    assert done.stdout == counts
    assert 10 < len(frames) <= 60
    first_ns = frames[0].t_capture_ns
    for frame in frames:
        frame.check(*cards(200, 120, frame.sequence - 1))
        assert abs(frame.t_capture_ns - first_ns - (frame.sequence - frames[0].sequence) / 80 * 1e9) < 2
        assert 0 < time.monotonic_ns() - frame.t_capture_ns < 60e9


def test_the_example_finds_holod_by_itself(example: Path, tmp_path: Path) -> None:
    (tmp_path / "holod").mkdir()
    with FakeHolod(tmp_path / "holod" / "feed") as holod:
        holod.serve()
        done = run_example(example, "-", "8x8", "0.1", XDG_RUNTIME_DIR=str(tmp_path))
        assert len(holod.served()) == 3
    assert done.returncode == 0
    (tmp_path / "runtime").mkdir()
    with FakeHolod(tmp_path / "runtime" / "feed") as holod:
        holod.serve()
        runtime = {"RUNTIME_DIRECTORY": str(tmp_path / "runtime"), "XDG_RUNTIME_DIR": str(tmp_path)}
        assert run_example(example, "-", "8x8", "0.1", **runtime).returncode == 0
        assert len(holod.served()) == 3


def test_the_example_tells_what_goes_wrong(example: Path, path: Path) -> None:
    done = run_example(example, str(path))
    assert done.returncode == 69
    assert done.stderr.startswith(f"error: no holod listens on {path}")
    assert run_example(example, str(path), "640").returncode == 64

    with FakeHolod(path) as holod:
        holod.serve(lambda frame: (REFUSED, "no pixel has a depth"))
        done = run_example(example, str(path), "8x8", "0.1")
    assert done.returncode == 0
    assert done.stdout.endswith("refused because: no pixel has a depth\n")

    with FakeHolod(path) as holod:
        process = subprocess.Popen([str(example), str(path), "8x8", "10"], stderr=subprocess.PIPE, text=True)
        for _ in range(3):
            holod.free(holod.frame())
        holod.die()
        _, errors = process.communicate(timeout=30)
    assert process.returncode == 69
    assert errors.startswith("error: holod closed the connection")

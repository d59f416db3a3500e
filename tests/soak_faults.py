"""What users make go wrong, one after the other, while holod runs; for `tests/soak --faults`."""

from __future__ import annotations

import contextlib
import itertools
import os
import shutil
import signal
import socket
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from holod_client import Control, ControlError
from soak_bench import SIZE, Bench, How
from soak_judge import Fault, Row, judge_fault, tell

LASTS_S = 2.0
"""the shortest a fault lasts"""
PATIENCE_S = 20.0
"""in which a fault must be told"""
AFTER_S = 3.0
"""in which frames must come after a fault was taken back"""
SMALL_DISK = "16m"
PIPE_BYTES = 65536
RECORD_LOG = "log.txt"
BENCH = """name = "bench of faults"
[panel]
width_px = {size}
height_px = {size}
pixel_pitch_um = 8.0
refresh_hz = 60.0
bit_depth = 8
mode = "channel-packed"
field_order = ["green", "red", "blue"]
phase_sign = "positive"
stroke_pi = {{ red = 1.9921875, green = 1.9921875, blue = 1.9921875 }}
settle_ms = 2.0
[optics]
wavelengths_nm = {{ red = 638.0, green = 520.0, blue = 450.0 }}
eyepiece_focal_length_mm = 40.0
depth_far_m = inf
depth_near_m = 0.35
[lasers]
driver = "serial"
device = "{device}"
power_mw = {{ red = 1.0, green = 1.0, blue = 1.0 }}
on_delay_ms = 0.1
lit_ms = 3.0
heartbeat_timeout_ms = 100.0
"""
RECORD_LOST = (73,)
"""how a run ends whose record could not be written"""
OUTPUT_GONE = (74,)
"""how a run ends whose summary could not be written"""
NAMESPACE = "HOLOD_SOAK_NAMESPACE"


class LaserBox:
    """The reference firmware as a process of its own, at the end of a link that can be pulled."""

    def __init__(self, program: Path, folder: Path) -> None:
        self.program = program
        self.log = folder / "lasers.csv"
        self.link = folder / "lasers"
        self.process: subprocess.Popen | None = None

    def plug_in(self) -> None:
        self.process = subprocess.Popen(
            [self.program, self.log],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        following = self.link.with_suffix(".next")
        following.symlink_to(self.process.stdout.readline().strip())
        following.rename(self.link)

    def unplug(self) -> None:
        self.link.unlink(missing_ok=True)
        if self.process is not None:
            self.process.kill()
            self.process.wait()
            self.process.stdin.close()
            self.process.stdout.close()
            self.process = None

    def windows(self) -> int:
        """Lit so far."""
        return sum(",on," in line for line in self.log.read_text().splitlines())


class Stage:
    """A run with a tracker and a laser box that work, and faults that are made in it."""

    def __init__(self, holod: Path, folder: Path, seed: int, how: How) -> None:
        folder.mkdir()
        self.box = LaserBox(holod.with_name("holod-simulated-laser"), folder)
        self.box.plug_in()
        how.bench = BENCH.format(size=SIZE, device=self.box.link)
        self.bench = Bench(holod, folder, seed, how)
        self.answers: list[str] = []
        self.rows: list[Row] = []
        self.tracker = threading.Thread(target=self.bench.track, kwargs={"faults": False}, daemon=True)
        self.tracker.start()
        time.sleep(AFTER_S)

    def lives(self) -> bool:
        return self.bench.process.poll() is None

    def said(self) -> str:
        """The log so far, where it is read, and that of the record where it is not; and what was answered."""
        log = self.bench.record / RECORD_LOG if self.bench.how.log_to_pipe else self.bench.log
        text = log.read_text(errors="replace") if log.exists() else ""
        return text + "".join(self.answers)

    def make(
        self, name: str, expected: Sequence[str], begin: Callable[[], None], end: Callable[[], None] = lambda: None
    ) -> None:
        """Makes a fault, waits until it is told, takes it back, and judges."""
        counts = [self.bench.frames_shown()]
        time.sleep(1)
        counts.append(self.bench.frames_shown())
        before = len(self.said())
        began = time.monotonic()
        begin()
        while time.monotonic() < began + PATIENCE_S and self.lives():
            time.sleep(0.2)
            if time.monotonic() > began + LASTS_S and (
                not expected or any(w in self.said()[before:] for w in expected)
            ):
                break
        counts.append(self.bench.frames_shown())
        end()
        time.sleep(AFTER_S)
        counts.append(self.bench.frames_shown())
        # A holod that has ended has no count.
        shown = [max(later - sooner, 0) for sooner, later in itertools.pairwise(counts)]
        fault = Fault(name, *shown, expected, self.said()[before:], self.lives())
        self.rows.append(judge_fault(fault))

    def end(self, right: Sequence[int] = (0,)) -> list[Row]:
        """Ends the run in order, with an exit code that is right; rows of all faults, and of the end."""
        bench = self.bench
        bench.stop.set()
        self.tracker.join()
        bench.process.terminate()
        try:
            status = bench.process.wait(timeout=30)
            self.rows.append(Row("the end", f"exit code {status}", status in right))
        except subprocess.TimeoutExpired:
            bench.process.kill()
            bench.process.wait()
            self.rows.append(Row("the end", "holod did not end within 30 s", False))
        bench.process.stdout.close()
        self.box.unplug()
        if not all(row.right for row in self.rows):
            print(textwrap.indent(self.said()[-3000:], "    "))
        return self.rows

    def unplug_tracker(self) -> None:
        os.close(self.bench.port)
        self.bench.tracker.unlink()

    def plug_tracker_in(self) -> None:
        self.bench.plug_tracker_in()
        os.set_blocking(self.bench.port, False)

    def die_while_writing(self) -> None:
        """A client that is killed in the middle of a picture."""
        program = """
            import os, signal, sys
            from holod_client import Feed
            with Feed(320, 240, depth="f32_m", name="mortal", path=sys.argv[1]) as client:
                with client.slot() as slot:
                    slot.colour[...] = 99
                    slot.depth[...] = 0.7
                with client.slot() as slot:
                    slot.colour[: 100] = 1
                    os.kill(os.getpid(), signal.SIGKILL)
        """
        ended = subprocess.run([sys.executable, "-c", textwrap.dedent(program), str(self.bench.pictures)], check=False)
        if ended.returncode != -signal.SIGKILL:
            self.rows.append(Row("a client to be killed", f"ended with {ended.returncode}", False))

    def reload_faulty_rig(self) -> None:
        self.bench.write_rig(fault="an unknown key")
        with contextlib.suppress(ControlError), Control(self.bench.control) as control:
            try:
                control.reload()
            except ControlError as error:
                self.answers.append(f"answer: {error}\n")

    def hostile(self, kind: int, path: Path, messages: Sequence[bytes]) -> None:
        """Sends what no client would, and keeps what is answered."""
        for message in messages:
            with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, kind) as stranger:
                stranger.settimeout(1)
                stranger.connect(str(path))
                stranger.sendall(message)
                self.answers.append(stranger.recv(1 << 16).decode(errors="replace"))


def noise(stage: Stage) -> list[bytes]:
    random = stage.bench.random
    return [random.randbytes(60), bytes(100), b"\xff" * 4000, random.randbytes(20000) + b"\n\r\n\r\n"]


def strangers_and_cables(holod: Path, folder: Path, seed: int) -> list[Row]:
    """What comes from outside and what is pulled out of it."""
    stage = Stage(holod, folder, seed, How())
    bench = stage.bench
    stage.make("laser box unplugged", ["the laser box is lost"], stage.box.unplug, stage.box.plug_in)
    stage.make("tracker unplugged", ["tracker down"], stage.unplug_tracker, stage.plug_tracker_in)
    stage.make("feed client dies in a picture", ["`mortal` is gone"], stage.die_while_writing)
    stage.make("faulty rig reloaded", ["hold_ms"], stage.reload_faulty_rig, bench.write_rig)
    stream, packets = socket.SOCK_STREAM, socket.SOCK_SEQPACKET
    requests = [b'{"do": "nothing"}\n', b'{"do":' + b"[" * 5000 + b"\n"]
    stage.make(
        "hostile bytes to the control socket",
        ['"error"'],
        lambda: stage.hostile(stream, bench.control, requests + noise(stage)),
    )
    requests = [b"GET / HTTP/9.9\r\n\r\n", b"GET /" + b"a" * 60000 + b" HTTP/1.1\r\n\r\n"]
    stage.make(
        "hostile bytes to the page",
        [" 400 ", " 414 ", " 431 "],
        lambda: stage.hostile(stream, bench.page, requests + noise(stage)),
    )
    stage.make(
        "hostile bytes to the feed",
        ["NOPE"],
        lambda: stage.hostile(packets, bench.pictures, [b"HELO" + bytes(36), b"FRAM" + bytes(36), *noise(stage)]),
    )
    return stage.end()


def closed_outputs(holod: Path, folder: Path, seed: int) -> list[Row]:
    """Whoever read standard output and error goes away; the record's log tells on."""
    stage = Stage(holod, folder, seed, How(log_to_pipe=True))

    def close() -> None:
        stage.bench.process.stdout.close()
        stage.bench.process.stderr.close()

    stage.make("stdout and stderr closed", [], close)
    stage.make("tracker unplugged after that", ["tracker down"], stage.unplug_tracker, stage.plug_tracker_in)
    return stage.end(OUTPUT_GONE)


def unread_log(holod: Path, folder: Path, seed: int) -> list[Row]:
    """Nobody reads a log that is long. Light is judged by the laser box."""
    stage = Stage(holod, folder, seed, How(log_to_pipe=True, log_level="trace"))

    said: list[bytes] = []

    def read() -> None:
        said.append(stage.bench.process.stderr.read())

    reader = threading.Thread(target=read, daemon=True)
    # Until the pipe is full.
    time.sleep(5)
    lit = [stage.box.windows()]
    time.sleep(5)
    lit.append(stage.box.windows())
    reader.start()
    time.sleep(AFTER_S)
    lit.append(stage.box.windows())
    meanwhile, after = lit[1] - lit[0], lit[2] - lit[1]
    stage.rows.append(Row("log not read", f"{meanwhile} windows lit meanwhile, {after} after", meanwhile > 0 < after))
    rows = stage.end()
    reader.join(timeout=PATIENCE_S)
    length = len(said[0]) if said else 0
    rows.append(Row("longer than its pipe", f"{length} bytes of log", length > PIPE_BYTES))
    return rows


def full_disk(holod: Path, folder: Path, seed: int) -> list[Row]:
    """The disk of the record is full for a while."""
    disk = folder.with_name("disk")
    disk.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={SMALL_DISK}", "none", disk], check=True)
    stage = Stage(holod, folder, seed, How(record=disk / "run"))
    filler = disk / "filler"

    def fill() -> None:
        with contextlib.suppress(OSError), open(filler, "wb", buffering=0) as file:
            while file.write(bytes(1 << 12)):
                pass

    stage.make("disk full under the record", ["the record is lost from here on"], fill, filler.unlink)
    rows = stage.end(RECORD_LOST)
    subprocess.run(["umount", "--lazy", disk], check=True)
    return rows


def removed_record(holod: Path, folder: Path, seed: int) -> list[Row]:
    """Somebody tidies up."""
    stage = Stage(holod, folder, seed, How(record=folder / "run"))
    stage.make("record removed", ["the record is lost from here on"], lambda: shutil.rmtree(stage.bench.record))
    return stage.end(RECORD_LOST)


def run(holod: Path, folder: Path, seed: int) -> int:
    """Makes all faults; the exit code. In namespaces of its own, where a small disk may be mounted."""
    if NAMESPACE not in os.environ:
        command = ["unshare", "--user", "--map-root-user", "--mount", sys.executable, *sys.argv]
        return subprocess.run(command, env={**os.environ, NAMESPACE: "1"}, check=False).returncode
    right = True
    for number, stage in enumerate([strangers_and_cables, closed_outputs, unread_log, full_disk, removed_record]):
        print(f"{stage.__name__.replace('_', ' ')}:")
        right &= tell(stage(holod, folder / str(number), seed))
    return 0 if right else 1

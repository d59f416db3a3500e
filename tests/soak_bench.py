"""A holod that runs, and programs that come, go and misbehave; for `tests/soak`."""

from __future__ import annotations

import contextlib
import os
import pty
import random
import signal
import socket
import subprocess
import sys
import threading
import time
import tty
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from holod_client import Control, ControlError, Feed, FeedError
from soak_judge import Sample

SIZE = 128
VIEWERS = 1000


@dataclass
class How:
    """What may be otherwise about a run."""

    bench: str = ""
    """what the rig file says of panel, optics and lasers; nothing for the built-in bench"""
    record: Path | None = None
    log_to_pipe: bool = False
    log_level: str = "info"


class Bench:
    """A running holod and those who use it."""

    def __init__(self, holod: Path, folder: Path, seed: int, how: How | None = None) -> None:
        self.folder = folder
        self.how = how or How()
        self.random = random.Random(seed)
        self.stop = threading.Event()
        self.done: dict[str, int] = {}
        self.tracker = folder / "tracker"
        self.pictures = folder / "pictures"
        self.page = folder / "page"
        self.plug_tracker_in()
        self.log = folder / "log"
        self.rig = folder / "rig.toml"
        self.write_rig()
        self.record = self.how.record or folder / "record"
        options = ["--resolution", f"{SIZE}x{SIZE}", "--fit", "cover", "--config", str(self.rig), "--backend", "cpu"]
        options += ["--record", str(self.record), "--json", "--page", f"unix:{self.page}"]
        with open(self.log, "w") as log:
            self.process = subprocess.Popen(
                [holod, "run", "--scene", f"feed:{self.pictures}", *options],
                env={**os.environ, "XDG_RUNTIME_DIR": str(folder), "HOLOD_LOG": self.how.log_level},
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE if self.how.log_to_pipe else log,
                # Without a terminal, SIGHUP asks for the rig file.
                start_new_session=True,
            )
        self.control = folder / f"holod/control-{self.process.pid}"
        patience_s = time.monotonic() + 60
        while not self.control.exists():
            if self.process.poll() is not None or time.monotonic() > patience_s:
                sys.exit(f"holod did not start:\n{self.log.read_text()}")
            time.sleep(0.05)

    def count(self, what: str) -> None:
        self.done[what] = self.done.get(what, 0) + 1

    def rest(self, least_s: float, most_s: float) -> None:
        self.stop.wait(self.random.uniform(least_s, most_s))

    def write_rig(self, eye: str = "both", hold_ms: float = 1000, network: str = "fast", fault: str = "") -> None:
        spec = "mock" if fault == "another tracker" else str(self.tracker)
        key = "hold" if fault == "an unknown key" else "hold_ms"
        following = self.folder / "next.toml"
        tracker = f'[tracker]\nspec = "{spec}"\neye = "{eye}"\nfallback_mm = 3.0\n{key} = {hold_ms}\n'
        following.write_text(f'{self.how.bench}{tracker}[model]\nnetwork = "{network}"\n')
        following.rename(self.rig)

    def reload(self, control: Control) -> None:
        """Another rig, of which half cannot be taken."""
        eye, network = self.random.choice(["left", "both", "better"]), self.random.choice(["small", "fast"])
        fault = self.random.choice(["", "", "another tracker", "an unknown key"])
        self.write_rig(eye, round(self.random.uniform(100, 2000)), network, fault)
        if self.random.random() < 0.3:
            self.count("reloads by SIGHUP")
            self.process.send_signal(signal.SIGHUP)
            # Done by then, so that it is not taken for the next one's doing.
            self.rest(2, 3)
            return
        before = control.status()["eye"]
        try:
            control.reload()
            right = not fault and control.status()["eye"] == eye
        except ControlError as error:
            # A signal's reload may be under way, and has taken the same file or refused it.
            right = "ask again" in str(error) or (bool(fault) and control.status()["eye"] == before)
        self.count("reloads" if right else "WRONG RELOADS")

    def plug_tracker_in(self) -> None:
        self.port, device = pty.openpty()
        tty.setraw(device)
        link = self.folder / "next"
        link.symlink_to(os.ttyname(device))
        os.close(device)
        link.rename(self.tracker)

    def track(self, faults: bool = True) -> None:
        """200 samples a second; now and then silence, noise, or no tracker at all."""
        began, sequence = time.monotonic(), 0
        t_fault = began + self.random.uniform(5, 30) if faults else float("inf")
        os.set_blocking(self.port, False)
        while not self.stop.is_set():
            now = time.monotonic()
            if now > t_fault:
                t_fault = now + self.random.uniform(5, 30)
                fault = self.random.choice(["silence", "noise", "unplugged"])
                self.count(f"tracker: {fault}")
                if fault == "unplugged":
                    os.close(self.port)
                    self.tracker.unlink()
                    self.rest(0.5, 4)
                    self.plug_tracker_in()
                    os.set_blocking(self.port, False)
                elif fault == "silence":
                    self.rest(0.5, 4)
                else:
                    self._write(self.random.randbytes(300) + b"\n")
            mm = 4 + 1.5 * np.sin((now - began) / 3)
            body = f"P1,{sequence % 65536},{int((now - began) * 1e6)},L,{mm:.3f},0.95"
            self._write(f"{body}*{crc8(body.encode()):02X}\n".encode())
            sequence += 1
            time.sleep(0.005)

    def _write(self, line: bytes) -> None:
        with contextlib.suppress(BlockingIOError, OSError):
            os.write(self.port, line)

    def feed(self) -> None:
        """Clients with pictures of several sizes and formats; some leave in order, some die in the middle."""
        while not self.stop.is_set():
            width, height = self.random.choice([(SIZE, SIZE), (320, 240), (640, 360)])
            depth = self.random.choice(["u16_mm", "f32_m", "f16_dpt"])
            try:
                client = Feed(width, height, depth=depth, name="soak", path=self.pictures)
                t_end = time.monotonic() + self.random.uniform(0.2, 8)
                while time.monotonic() < t_end and not self.stop.is_set():
                    with client.slot() as slot:
                        slot.colour[...] = self.random.randrange(256)
                        slot.depth[...] = 700 if depth == "u16_mm" else 0.7
                    time.sleep(self.random.choice([0.0, 0.016, 0.033]))
                if self.random.random() < 0.5:
                    client.wait()
                client.close()
                self.count("feed clients")
            except FeedError as error:
                if not self.stop.is_set():
                    self.count(f"feed refused: {error}")
            self.rest(0, 1)

    def order(self) -> None:
        """Orders that change something, and some that cannot be obeyed."""
        while not self.stop.is_set():
            try:
                with Control(self.control) as control:
                    for _ in range(self.random.randrange(1, 20)):
                        self.random.choice(
                            [
                                lambda c: c.pupil(self.random.uniform(2, 6)),
                                lambda c: c.pupil(None),
                                lambda c: c.weights(self.random.choice(["small", "fast"])),
                                lambda c: c.pause(),
                                lambda c: c.resume(),
                                lambda c: (c.flat(), c.hologram()),
                                lambda c: (c.pattern("dots", spacing_px=20, diameter_px=6), c.hologram()),
                                lambda c: c.pattern("dots", spacing_px=0, diameter_px=6),
                                lambda c: c.lasers_dark(),
                                lambda c: c.lasers_arm(),
                                lambda c: c.eye(self.random.choice(["left", "both", "better"])),
                                self.reload,
                                lambda c: c.scene("feed"),
                                lambda c: c.scene("absent"),
                                lambda c: c.pupil(99),
                                lambda c: c.status(),
                            ]
                        )(control)
                        self.count("orders")
                        self.rest(0, 0.5)
            except ControlError:
                self.count("orders refused")

    def watch(self) -> None:
        """Browsers that watch, look, ask for figures, and go, some without reading what they asked for."""
        while not self.stop.is_set():
            asked = self.random.choice(
                ["/events", "/eye.png?focus_dpt=1", "/metrics", "/status.json", "/", "/eye.png?x"]
            )
            with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as viewer:
                viewer.settimeout(1)
                viewer.connect(str(self.page))
                self.count(f"viewers of {asked.split('?')[0]}")
                viewer.send(f"GET {asked} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
                t_end = time.monotonic() + self.random.uniform(0, 5)
                while self.random.random() > 0.02 and time.monotonic() < t_end and not self.stop.is_set():
                    if not viewer.recv(1 << 16):
                        break

    def annoy(self) -> None:
        """Noise, silence and half messages on all sockets."""
        while not self.stop.is_set():
            kind, path = self.random.choice(
                [
                    (socket.SOCK_SEQPACKET, self.pictures),
                    (socket.SOCK_STREAM, self.control),
                    (socket.SOCK_STREAM, self.page),
                ]
            )
            with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, kind) as stranger:
                stranger.settimeout(1)
                stranger.connect(str(path))
                for _ in range(self.random.randrange(4)):
                    stranger.send(self.random.choice([b"HELO", b"FRAM" + bytes(36), b'{"do":']) + os.urandom(30))
                self.rest(0, 1)
                self.count("strangers")

    def frames_shown(self) -> int:
        """So far; that of a holod that has ended, or does not answer, is 0."""
        try:
            with Control(self.control) as control:
                return control.status()["frames_shown"]
        except (ControlError, OSError):
            return 0

    def sample(self) -> Sample | None:
        process = Path(f"/proc/{self.process.pid}")
        try:
            with Control(self.control) as control:
                status = control.status()
            fields = dict(line.split(":", 1) for line in (process / "status").read_text().splitlines())
            return Sample(
                time.monotonic(),
                int(fields["VmRSS"].split()[0]) / 1024,
                len(list((process / "fd").iterdir())),
                int(fields["Threads"]),
                status["frames_shown"],
                (status["frame_time"] or {}).get("median_ms", 0.0),
                (status["sample_to_photon"] or {}).get("median_ms", 0.0),
            )
        except (ControlError, OSError):
            return None


class Company:
    """A thousand viewers and all else that may attach, and leave again."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.stop = threading.Event()
        self.threads: list[threading.Thread] = []

    def come(self) -> None:
        self.stop.clear()
        work = [self.crowd, self.look, self.feed, self.order, self.annoy]
        self.threads = [threading.Thread(target=one, daemon=True) for one in work]
        for thread in self.threads:
            thread.start()

    def leave(self) -> None:
        self.stop.set()
        for thread in self.threads:
            thread.join()

    def crowd(self) -> None:
        """Viewers of the events, of which holod lets in as many as it has places for; the others come again."""
        viewers: list[socket.socket] = []
        while not self.stop.is_set():
            while len(viewers) < VIEWERS and not self.stop.is_set():
                viewer = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
                viewer.settimeout(0.05)
                try:
                    viewer.connect(str(self.bench.page))
                    viewer.send(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
                except OSError:
                    viewer.close()
                    break
                viewer.setblocking(False)
                viewers.append(viewer)
                self.bench.count("viewers")
            viewers = [viewer for viewer in viewers if self.still_watches(viewer)]
            self.stop.wait(0.1)
        for viewer in viewers:
            viewer.close()

    @staticmethod
    def still_watches(viewer: socket.socket) -> bool:
        try:
            if viewer.recv(1 << 20):
                return True
        except BlockingIOError:
            return True
        except OSError:
            pass
        viewer.close()
        return False

    def look(self) -> None:
        while not self.stop.is_set():
            with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as viewer:
                viewer.settimeout(1)
                viewer.connect(str(self.bench.page))
                asked = self.bench.random.choice(["/eye.png?focus_dpt=1", "/metrics", "/status.json"])
                viewer.send(f"GET {asked} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n".encode())
                while viewer.recv(1 << 16):
                    pass
                self.bench.count("looks")
            self.stop.wait(0.1)

    def feed(self) -> None:
        with Feed(320, 240, depth="f32_m", name="company", path=self.bench.pictures) as client:
            while not self.stop.is_set():
                with client.slot() as slot:
                    slot.colour[...] = self.bench.random.randrange(256)
                    slot.depth[...] = 0.7
                self.bench.count("pictures")
                self.stop.wait(0.033)

    def order(self) -> None:
        with Control(self.bench.control) as control:
            while not self.stop.is_set():
                for order in (control.status, lambda: control.pupil(99), control.resume):
                    with contextlib.suppress(ControlError):
                        order()
                self.bench.count("orders")
                self.stop.wait(0.1)

    def annoy(self) -> None:
        while not self.stop.is_set():
            for kind, path in [(socket.SOCK_SEQPACKET, self.bench.pictures), (socket.SOCK_STREAM, self.bench.control)]:
                with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, kind) as stranger:
                    stranger.connect(str(path))
                    stranger.send(os.urandom(60))
                    self.bench.count("strangers")
            self.stop.wait(0.05)


def crc8(body: bytes) -> int:
    crc = 0
    for byte in body:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x07 if crc & 0x80 else crc << 1) & 0xFF
    return crc

"""The daemon's side of daemon/doc/feed.md for one client, written from that page and not from the clients."""

from __future__ import annotations

import contextlib
import fcntl
import mmap
import os
import socket
import struct
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

TIMEOUT_S = 10.0
TAKEN, OVERTAKEN, REFUSED, NOT_SHOWN = range(4)
COLOUR_PIXEL_BYTES = {1: 4, 2: 8, 3: 12}
DEPTH_PIXEL_BYTES = {0: 0, 1: 2, 2: 2, 3: 2, 4: 4, 5: 4}


class ObjectionError(AssertionError):
    """The client did what the page does not allow, or sent another picture than it should have."""


@dataclass(frozen=True)
class Hello:
    width_px: int
    height_px: int
    colour: int
    depth: int
    plane_dpt: float
    name: str
    version: int = 1


@dataclass(frozen=True)
class Frame:
    slot: int
    sequence: int
    t_capture_ns: int
    colour: bytes
    depth: bytes
    focus_dpt: float | None = None
    field_of_view_deg: tuple[float, float] | None = None

    def check(self, colour: bytes, depth: bytes) -> None:
        """Raises ObjectionError at the first byte that is not as it should be."""
        for label, found, expected in (("colour", self.colour, colour), ("depth", self.depth, depth)):
            if len(found) != len(expected):
                raise ObjectionError(f"{label}: found {len(found)} bytes, expected {len(expected)}")
            if found != expected:
                at = next(at for at, (one, other) in enumerate(zip(found, expected, strict=True)) if one != other)
                raise ObjectionError(f"{label}, byte {at}: found {found[at]}, expected {expected[at]}")


@dataclass(frozen=True)
class Layout:
    """Of the shared memory. Depth lies first, and nothing follows anything directly."""

    slots: int
    distance: int
    colour_offset: int
    colour_bytes: int
    depth_offset: int
    depth_bytes: int

    @staticmethod
    def of(hello: Hello, slots: int) -> Layout:
        pixels = hello.width_px * hello.height_px
        colour_bytes = pixels * COLOUR_PIXEL_BYTES[hello.colour]
        depth_bytes = pixels * DEPTH_PIXEL_BYTES[hello.depth]
        colour_offset = 128 + -(-depth_bytes // 64) * 64
        distance = colour_offset + -(-colour_bytes // 64) * 64 + 192
        return Layout(slots, distance, colour_offset, colour_bytes, 64, depth_bytes)


def parse_hello(message: bytes) -> Hello:
    if len(message) != 64 or message[:4] != b"HELO":
        raise ObjectionError(f"found {message!r}, expected HELO of 64 bytes")
    version, width_px, height_px, colour, depth = struct.unpack_from("=5I", message, 4)
    plane_dpt, reserved = struct.unpack_from("=fI", message, 24)
    name, _, padding = message[32:].partition(b"\0")
    if version not in (1, 2) or reserved or padding.strip(b"\0"):
        raise ObjectionError(f"HELO: found version {version}, reserved {reserved}, behind the name {padding!r}")
    if depth and plane_dpt:
        raise ObjectionError(f"HELO: found plane_dpt {plane_dpt} with depth")
    return Hello(width_px, height_px, colour, depth, plane_dpt, name.decode(), version)


class FakeHolod:
    """Lets one client in as soon as it comes, and then does what a test tells it to.

    `change` may spoil the layout that RING tells; `memory_bytes` the memory's size. `nope` answers HELO with a refusal;
    `silent` does not answer it.
    """

    def __init__(
        self,
        path: Path,
        *,
        slots: int = 3,
        nope: str | None = None,
        silent: bool = False,
        change: Callable[[Layout], Layout] = lambda layout: layout,
        memory_bytes: int | None = None,
    ) -> None:
        self.path = path
        self.frames: list[Frame] = []
        self._slots = slots
        self._nope = nope
        self._silent = silent
        self._change = change
        self._memory_bytes = memory_bytes
        self._held: set[int] = set()
        self._sequence = 0
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.bind(str(path))
        self._listener.listen()
        self._listener.settimeout(TIMEOUT_S)
        self._work = _Work(self._let_in)

    def __enter__(self) -> FakeHolod:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._listener.close()
        self.path.unlink()
        if error is None:
            self._work.join()
        if hasattr(self, "connection"):
            self.connection.close()

    def hello(self) -> Hello:
        """What the client said of its pictures, once it is let in."""
        self._work.join()
        return self._hello

    def frame(self) -> Frame:
        """The next picture, which stays with holod until `free`."""
        self._work.join()
        return self._frame(self.connection.recv(4096))

    def free(self, frame: Frame, outcome: int = TAKEN, text: str = "") -> None:
        self._held.discard(frame.slot)
        self.connection.send(struct.pack("=4sIQII", b"FREE", frame.slot, frame.sequence, outcome, 0) + text.encode())

    def refuse(self, text: str) -> None:
        """NOPE, and closes. What the client has sent until then stays unread."""
        self._work.join()
        self.connection.send(b"NOPE" + text.encode())
        self.connection.close()

    def wait_for_the_end(self) -> None:
        """Of the connection, by its client."""
        assert self.connection.recv(4096) == b""

    def die(self) -> None:
        self._work.join()
        self.connection.close()

    def serve(self, outcome: Callable[[Frame], tuple[int, str]] = lambda frame: (TAKEN, "")) -> None:
        """From now on keeps every picture in `frames` and says of it what `outcome` says."""
        greeting = self._work
        self._work = _Work(lambda: self._serve(greeting, outcome))

    def served(self) -> list[Frame]:
        """All pictures, once the client has left."""
        self._work.join()
        return self.frames

    def _let_in(self) -> None:
        self.connection, _ = self._listener.accept()
        self.connection.settimeout(TIMEOUT_S)
        message = self.connection.recv(4096)
        if self._silent:
            return
        if self._nope is not None:
            self.connection.send(b"NOPE" + self._nope.encode())
            self.connection.close()
            return
        self._hello = parse_hello(message)
        self._layout = Layout.of(self._hello, self._slots)
        size = self._slots * self._layout.distance
        memory = os.memfd_create("fake-holod", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        try:
            os.ftruncate(memory, size if self._memory_bytes is None else self._memory_bytes)
            fcntl.fcntl(memory, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW)
            if self._memory_bytes is None:
                self._memory = mmap.mmap(memory, size)
            told = self._change(self._layout)
            ring = struct.pack(
                "=4sI5Q",
                b"RING",
                told.slots,
                told.distance,
                told.colour_offset,
                told.colour_bytes,
                told.depth_offset,
                told.depth_bytes,
            )
            socket.send_fds(self.connection, [ring], [memory])
        finally:
            os.close(memory)

    def _frame(self, message: bytes) -> Frame:
        if len(message) != 40 or message[:4] != b"FRAM":
            raise ObjectionError(f"found {message!r}, expected FRAM of 40 bytes")
        if self._hello.version == 1 and message[24:] != bytes(16):
            raise ObjectionError(f"found {message!r}, expected 0 in the last 16 bytes in version 1")
        slot, sequence, t_capture_ns, given, focus_dpt, across_deg, up_deg = struct.unpack_from("=IQqI3f", message, 4)
        if given > 3 or (not given & 1 and focus_dpt) or (not given & 2 and (across_deg or up_deg)):
            raise ObjectionError(f"FRAM: found {message[24:]!r}, expected 0 for figures that are not given")
        if slot >= self._slots or slot in self._held:
            raise ObjectionError(f"FRAM: found slot {slot}, which does not belong to the client")
        if sequence <= self._sequence:
            raise ObjectionError(f"FRAM: found sequence {sequence}, expected more than {self._sequence}")
        self._held.add(slot)
        self._sequence = sequence
        colour = slot * self._layout.distance + self._layout.colour_offset
        depth = slot * self._layout.distance + self._layout.depth_offset
        return Frame(
            slot,
            sequence,
            t_capture_ns,
            self._memory[colour : colour + self._layout.colour_bytes],
            self._memory[depth : depth + self._layout.depth_bytes],
            focus_dpt if given & 1 else None,
            (across_deg, up_deg) if given & 2 else None,
        )

    def _serve(self, greeting: _Work, outcome: Callable[[Frame], tuple[int, str]]) -> None:
        greeting.join()
        while message := self._receive():
            frame = self._frame(message)
            self.frames.append(frame)
            # A client that ends for a fault of its own does not wait for what becomes of its pictures.
            with contextlib.suppress(BrokenPipeError):
                self.free(frame, *outcome(frame))

    def _receive(self) -> bytes:
        try:
            return self.connection.recv(4096)
        except ConnectionResetError:
            # Once, where the client left messages unread; what it sent comes after.
            return self.connection.recv(4096)


class _Work:
    """A thread whose exception comes out of `join`."""

    def __init__(self, work: Callable[[], None]) -> None:
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, args=(work,), daemon=True)
        self._thread.start()

    def join(self) -> None:
        self._thread.join(TIMEOUT_S)
        if self._thread.is_alive():
            raise ObjectionError(f"the client did not do its part within {TIMEOUT_S} s")
        if self._error is not None:
            raise self._error

    def _run(self, work: Callable[[], None]) -> None:
        try:
            work()
        except BaseException as error:
            self._error = error

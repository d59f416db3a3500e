"""The connection to holod."""

from __future__ import annotations

import errno
import logging
import math
import mmap
import operator
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from holod_client import messages
from holod_client.folders import is_own, own_folders, temporary_folder, warning_of
from holod_client.formats import Colour, Depth

ANSWER_TIMEOUT_S = 5.0
MOST_MESSAGE_BYTES = 16384
MOST_PX = 2**32
"""More than a side of a picture can be said to have."""
NEAREST_DPT = 20.0
SERVICE_PATH = Path("/run/holod/feed")

_log = logging.getLogger("holod_client")


class FeedError(Exception):
    """holod is not there, has gone, or refused the connection. The feed is closed."""


class FeedTimeoutError(FeedError, TimeoutError):
    """holod did not give a slot back in time. An open feed is as good as before."""


@dataclass
class Outcomes:
    """How many pictures were sent, and what became of them as far as holod has said."""

    sent: int = 0
    taken: int = 0
    overtaken: int = 0
    """a newer one came before holod needed them"""
    refused: int = 0
    """the last good one stays on the panel"""
    not_shown: int = 0
    """another client or a scene is shown"""

    @property
    def unknown(self) -> int:
        return self.sent - self.taken - self.overtaken - self.refused - self.not_shown

    def __str__(self) -> str:
        return (
            f"{self.sent} sent: {self.taken} taken, {self.overtaken} overtaken, {self.refused} refused, "
            f"{self.not_shown} while another client was shown"
        )


_NOBODY = (errno.ENOENT, errno.ENOTDIR, errno.ECONNREFUSED)
"""Also where a holod that was killed has left its socket."""
_OUTCOMES = ("taken", "overtaken", "refused", "not_shown")


@dataclass
class Slot:
    """Shared memory for one picture, to be written into: slot.colour[...] = picture. What it holds at first is an old
    one, or 0.

    numpy converts and repeats what is assigned, without a word: of floats from 0 to 1 the 8-bit colours are black, of
    metres the millimetres are 1 or 2, one row becomes all of them, and a masked array loses its mask. `Feed.send`
    checks all that."""

    colour: NDArray[Any]
    """of the shape and type of the feed's `Colour`"""
    depth: NDArray[Any]
    """(height, width) of the type of the feed's `Depth`; (0, 0) where that is NONE"""
    t_capture_ns: int = 0
    """when the picture was taken, as time.monotonic_ns() tells it; 0 where that is not known"""
    focus_dpt: float | None = None
    """the distance at which the camera was focused, in dioptres, 0 to 20, where that is known"""
    field_of_view_deg: tuple[float, float] | None = None
    """the camera's field of view across and up, where that is known: twice atan(width_px / (2 * fx)) in degrees"""


class Feed:
    """Pictures of one size and format on their way to holod.

    `colour` and `depth` are formats or their names. Without depth ("none") a picture is a plane at `plane_dpt`
    dioptres. `name` is for holod's log and status, which keep 32 bytes of it. `path` is the socket; without one it is
    that of this user's holod, or of the service where no holod of this user listens.

    With `tells_view` pictures may say where the camera was focused and what its field of view was, which holod records
    and shows; a holod that knows version 1 of the feed alone refuses such a feed.

    All calls wait for holod up to `timeout_s` seconds, which may be changed at any time: 0 does not wait, and None
    waits for ever. They raise FeedTimeoutError.

    A picture that holod refuses raises nothing, because the feed goes on: it is counted in `outcomes`, `refusal` says
    why, and a new reason is logged as a warning by the logger "holod_client", which prints it where a program has not
    set up logging. As holod answers later, all this is up to date after the next call; `wait()` waits for it.

    As a context manager it waits for all answers and closes. One feed must not be used by two threads at the same time.

    Raises ValueError for an unknown format, TypeError for a size that is no whole number, FeedError where no holod
    listens or where it refuses the connection.
    """

    def __init__(
        self,
        width_px: int,
        height_px: int,
        *,
        colour: Colour | str = Colour.RGBA8,
        depth: Depth | str,
        plane_dpt: float | None = None,
        name: str = "Python",
        path: str | os.PathLike[str] | None = None,
        timeout_s: float | None = 5.0,
        tells_view: bool = False,
    ) -> None:
        self.width_px = width_px
        self.height_px = height_px
        self.colour = Colour(colour)
        self.depth = Depth(depth)
        self.timeout_s = timeout_s
        self.tells_view = tells_view
        self.outcomes = Outcomes()
        self.refusal: str | None = None
        """why holod refused a picture last"""
        if (self.depth is Depth.NONE) != (plane_dpt is not None):
            raise ValueError(f"plane_dpt: found {plane_dpt} with depth {str(self.depth)!r}, expected one of the two")
        for label, size in (("width_px", width_px), ("height_px", height_px)):
            if not 0 < _whole(label, size, "a whole number of pixels") < MOST_PX:
                raise ValueError(f"{label}: found {size}, expected 1 to {MOST_PX - 1}")

        self._sequence = 0
        self._memory: mmap.mmap | None = None
        self._closed_because = "the feed is closed"
        self.path, connection = _connect(None if path is None else Path(path))
        self._socket: socket.socket | None = connection
        try:
            numbers = (self.colour.number, self.depth.number)
            self._say(messages.helo(width_px, height_px, *numbers, plane_dpt or 0.0, name, tells_view=tells_view))
            self._ring, self._memory = self._receive_ring()
        except BaseException:
            self.close()
            raise
        self._free = set(range(self._ring.slots))
        self._sent: set[int] = set()

    def send(
        self,
        colour: NDArray[Any],
        depth: NDArray[Any] | None = None,
        t_capture_ns: int = 0,
        *,
        focus_dpt: float | None = None,
        field_of_view_deg: tuple[float, float] | None = None,
    ) -> None:
        """Copies one picture into shared memory and hands it over.

        `colour` and `depth` have the shape and type of the feed's formats; (height, width, 3) does for the formats
        with A. Nothing is converted, and arrays with a mask are refused. `t_capture_ns` is when the picture was taken,
        as time.monotonic_ns() tells it; 0 where that is not known. `focus_dpt` and `field_of_view_deg` are those of a
        `Slot`: for a feed that `tells_view`.

        Raises ValueError for a wrong shape, time or view, TypeError for a wrong type, FeedTimeoutError, FeedError.
        """
        self._check_colour(colour)
        self._check_depth(depth)
        t_capture_ns = _time(t_capture_ns)
        with self.slot() as slot:
            slot.t_capture_ns = t_capture_ns
            slot.focus_dpt = focus_dpt
            slot.field_of_view_deg = field_of_view_deg
            slot.colour[..., : colour.shape[-1]] = colour
            if depth is not None:
                slot.depth[...] = depth

    @contextmanager
    def slot(self) -> Iterator[Slot]:
        """Gives the memory for a picture to write into, and hands it over at the end of the block; not where that
        raises. The slot's arrays are read-only afterwards; their slices must not be written to either.

        Raises FeedTimeoutError, FeedError; ValueError for a time or a view that cannot be, a view that the feed does
        not tell, or an array that was put in the place of the slot's own; TypeError for a time that is no whole number.
        """
        index = self._begin()
        slot = self._slot(index)
        colour, depth = slot.colour, slot.depth
        try:
            yield slot
            for label, own, found in (("colour", colour, slot.colour), ("depth", depth, slot.depth)):
                if found is not own:
                    raise ValueError(f"{label}: found another array in the slot's place: slot.{label}[...] = ...")
            self._check_view(slot)
            if self._sequence == messages.MOST_SEQUENCE:
                raise FeedError("this feed has no numbers left for pictures: open it again")
            # In here as well, so that nothing that cannot be said costs a slot.
            view = (slot.focus_dpt, slot.field_of_view_deg)
            message = messages.fram(index, self._sequence + 1, _time(slot.t_capture_ns), *view)
        except BaseException:
            self._free.add(index)
            raise
        finally:
            colour.flags.writeable = False
            depth.flags.writeable = False
        self._say(message)
        self._sent.add(index)
        self._sequence += 1
        self.outcomes.sent += 1

    def leave_out(self, pictures: int = 1) -> None:
        """Tells holod, with the next picture, that some were left out before it: for a program that does not wait.

        Raises ValueError for fewer than none, TypeError for what is no whole number.
        """
        pictures = _whole("pictures", pictures, "a whole number")
        most = messages.MOST_SEQUENCE - 1 - self._sequence
        if not 0 <= pictures <= most:
            raise ValueError(f"pictures: found {pictures}, expected 0 or more, and fewer than {most + 1}")
        self._sequence += pictures

    def wait(self) -> None:
        """Waits until it is known of every picture sent what became of it. Raises FeedTimeoutError, FeedError."""
        deadline = self._deadline()
        self._receive_what_is_there()
        while self.outcomes.unknown > 0:
            if not self._receive_free(deadline):
                raise FeedTimeoutError(
                    f"holod has not said in {self.timeout_s} s what became of {self.outcomes.unknown} pictures: "
                    "is it busy?"
                )

    def close(self) -> None:
        """Does not wait. The last picture stays on the panel. May be called again."""
        if self._socket is not None:
            # A program that was forked has the socket, too, and would keep the place of this feed.
            with suppress(OSError):
                self._socket.shutdown(socket.SHUT_RDWR)
            self._socket.close()
            self._socket = None
            # Not closed: arrays of a slot may still look into it.
            self._memory = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            if error is None and self._socket is not None:
                self.wait()
        finally:
            self.close()

    def _check_colour(self, colour: NDArray[Any]) -> None:
        shapes = [self.colour.shape(self.width_px, self.height_px)]
        if self.colour is not Colour.RGB32F:
            shapes.append((self.height_px, self.width_px, 3))
        _check("colour", colour, shapes, self.colour.dtype, "filled(0), which is black")

    def _check_depth(self, depth: NDArray[Any] | None) -> None:
        if self.depth is Depth.NONE:
            if depth is not None:
                raise ValueError("depth: found an array, expected none: the feed was opened without depth")
        elif depth is None:
            raise ValueError(f"depth: found none, expected {self.depth.dtype}: the feed was opened with depth")
        else:
            filled = "filled(0)" if self.depth is Depth.U16_MM else "filled(np.nan)"
            shape = self.depth.shape(self.width_px, self.height_px)
            _check("depth", depth, [shape], self.depth.dtype, f"{filled}, which is no depth")

    def _check_view(self, slot: Slot) -> None:
        focus_dpt, field_deg = slot.focus_dpt, slot.field_of_view_deg
        if not self.tells_view and (focus_dpt is not None or field_deg is not None):
            raise ValueError(
                "focus_dpt or field_of_view_deg: found one, expected a feed that was opened with tells_view"
            )
        if focus_dpt is not None and not 0 <= focus_dpt <= NEAREST_DPT:
            raise ValueError(f"focus_dpt: found {focus_dpt}, expected 0 (infinity) to {NEAREST_DPT:g} dioptres")
        if field_deg is not None and not (len(field_deg) == 2 and all(0 < angle < 180 for angle in field_deg)):
            raise ValueError(f"field_of_view_deg: found {field_deg}, expected two angles between 0 and 180 degrees")

    def _begin(self) -> int:
        deadline = self._deadline()
        self._receive_what_is_there()
        while not self._free:
            if not self._receive_free(deadline):
                raise FeedTimeoutError(
                    f"holod has kept all {self._ring.slots} slots for {self.timeout_s} s: is it busy?"
                )
        return self._free.pop()

    def _slot(self, index: int) -> Slot:
        start = self._ring.distance * index

        def plane(format: Colour | Depth, offset: int) -> NDArray[Any]:
            return np.ndarray(format.shape(self.width_px, self.height_px), format.dtype, self._memory, start + offset)

        return Slot(plane(self.colour, self._ring.colour_offset), plane(self.depth, self._ring.depth_offset))

    def _receive_ring(self) -> tuple[messages.Ring, mmap.mmap]:
        descriptors: list[int] = []
        try:
            message = self._receive(time.monotonic() + ANSWER_TIMEOUT_S, descriptors)
            if message is None:
                raise FeedTimeoutError(f"holod said nothing on {self.path} for {ANSWER_TIMEOUT_S:.0f} s: see its log")
            try:
                ring = messages.ring(message)
            except messages.MessageError as error:
                raise self._unexpected(error) from error
            return ring, self._map(ring, descriptors)
        finally:
            for descriptor in descriptors:
                os.close(descriptor)

    def _map(self, ring: messages.Ring, descriptors: list[int]) -> mmap.mmap:
        """Maps what holod sent, where it has room for this feed's pictures. Raises FeedError."""
        if ring.slots < 1:
            raise FeedError("holod offers 0 slots, expected some: report this")
        for label, format, offset, found in (
            ("colour", self.colour, ring.colour_offset, ring.colour_bytes),
            ("depth", self.depth, ring.depth_offset, ring.depth_bytes),
        ):
            expected = math.prod(format.shape(self.width_px, self.height_px)) * format.dtype.itemsize
            if found != expected:
                raise FeedError(f"holod has room for {found} bytes of {label}, expected {expected}: report this")
            if offset % messages.ALIGNMENT or ring.distance % messages.ALIGNMENT or offset + found > ring.distance:
                raise FeedError(
                    f"holod put {label} at {offset} in slots of {ring.distance} bytes: not multiples of "
                    f"{messages.ALIGNMENT}, or outside; report this"
                )
        if not descriptors:
            raise FeedError("holod sent no memory, or this program has too many files open")
        try:
            return mmap.mmap(descriptors[0], ring.slots * ring.distance)
        except (OSError, ValueError) as error:
            raise FeedError(f"cannot map {ring.slots * ring.distance} bytes of holod's memory: {error}") from error

    def _deadline(self) -> float | None:
        return None if self.timeout_s is None else time.monotonic() + self.timeout_s

    def _receive_what_is_there(self) -> None:
        while self._receive_free(deadline=0):
            pass

    def _receive_free(self, deadline: float | None) -> bool:
        """Takes one slot back; False where holod gives none back in time."""
        message = self._receive(deadline)
        if message is None:
            return False
        try:
            free = messages.free(message)
        except messages.MessageError as error:
            raise self._unexpected(error) from error
        if free.slot not in self._sent or free.outcome >= len(_OUTCOMES):
            raise self._lost(
                f"holod gave back slot {free.slot} with outcome {free.outcome}, which was not to be: report this"
            )
        outcome = _OUTCOMES[free.outcome]
        setattr(self.outcomes, outcome, getattr(self.outcomes, outcome) + 1)
        if outcome == "refused":
            if free.text != self.refusal:
                _log.warning("holod refused a picture: %s", free.text)
            self.refusal = free.text
        self._sent.remove(free.slot)
        self._free.add(free.slot)
        return True

    def _receive(self, deadline: float | None, descriptors: list[int] | None = None) -> bytes | None:
        """One message; None where none comes until the deadline. Raises FeedError where holod has closed."""
        connection = self._open_socket()
        was_reset = False
        while True:
            connection.settimeout(None if deadline is None else max(0.0, deadline - time.monotonic()))
            try:
                if descriptors is None:
                    message = connection.recv(MOST_MESSAGE_BYTES)
                else:
                    message, received, _, _ = socket.recv_fds(
                        connection, MOST_MESSAGE_BYTES, 1, socket.MSG_CMSG_CLOEXEC
                    )
                    descriptors += received
            except (BlockingIOError, TimeoutError):
                return None
            except ConnectionResetError:
                # Linux reports once that holod closed without reading everything, before what it wrote.
                if not was_reset:
                    was_reset = True
                    continue
                message = b""
            except OSError as error:
                raise self._lost(f"cannot read from {self.path}: {error.strerror}") from error
            break
        if not message:
            raise self._lost(
                f"holod closed the connection on {self.path}: it was stopped or has crashed; see its log, start it and "
                "open the feed again"
            )
        refusal = messages.nope(message)
        if refusal is not None:
            raise self._lost(f"holod refused the connection on {self.path}: {refusal}")
        return message

    def _say(self, message: bytes) -> None:
        connection = self._open_socket()
        connection.settimeout(ANSWER_TIMEOUT_S)
        try:
            connection.send(message)
        except TimeoutError as error:
            raise self._lost(
                f"holod read nothing from {self.path} for {ANSWER_TIMEOUT_S:.0f} s: see its log"
            ) from error
        except ConnectionError as error:
            # holod has closed, and may have said why. What it said before that is of no use any more.
            deadline = time.monotonic() + ANSWER_TIMEOUT_S
            while self._receive(deadline) is not None:
                pass
            raise self._lost(f"holod reads no more from {self.path}: see its log, start it again") from error
        except OSError as error:
            raise self._lost(f"cannot send to {self.path}: {error.strerror}") from error

    def _open_socket(self) -> socket.socket:
        if self._socket is None:
            raise FeedError(self._closed_because)
        return self._socket

    def _unexpected(self, error: messages.MessageError) -> FeedError:
        return self._lost(
            f"{self.path} sent {error}: is it holod, of a version that speaks version 1 or {messages.VERSION} of the "
            "feed?"
        )

    def _lost(self, reason: str) -> FeedError:
        """Closes the feed, which says the same from now on."""
        self._closed_because = reason
        self.close()
        return FeedError(reason)


def default_path() -> Path:
    """Where a holod has its socket by itself, of this user's or else of the service, as far as files tell: nobody may
    listen there. A `Feed` without a path tries all of them."""
    paths = _default_paths()
    return next((path for path in paths if _may_be_used(path) and os.path.exists(path)), paths[0])


def _default_paths() -> list[Path]:
    return list(dict.fromkeys([*(folder / "feed" for folder in own_folders()), SERVICE_PATH]))


def _may_be_used(path: Path) -> bool:
    return path.parent != temporary_folder() or is_own(path.parent)


def _connect(named: Path | None) -> tuple[Path, socket.socket]:
    """To the path that is named, or else to the first one of its own on which a holod listens. Raises FeedError."""
    paths = _default_paths() if named is None else [named]
    reason: OSError | None = None
    for path in paths:
        if named is None and not _may_be_used(path):
            continue
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        connection.settimeout(ANSWER_TIMEOUT_S)
        try:
            connection.connect(str(path))
            return path, connection
        except OSError as error:
            connection.close()
            # Without a number where a path is too long for a socket: nobody listens there either.
            if named is not None or error.errno not in (*_NOBODY, None):
                raise FeedError(_why_not_connected(path, error)) from error
            reason = error
    raise FeedError(_nobody(" or ".join(map(str, paths))) + warning_of(temporary_folder())) from reason


def _whole(label: str, number: object, expected: str) -> int:
    try:
        return operator.index(number)  # type: ignore[arg-type]
    except TypeError:
        raise TypeError(f"{label}: found {number!r} ({type(number).__name__}), expected {expected}") from None


def _time(t_capture_ns: object) -> int:
    time_ns = _whole("t_capture_ns", t_capture_ns, "whole nanoseconds, as time.monotonic_ns() tells them")
    if not 0 <= time_ns <= messages.MOST_TIME_NS:
        raise ValueError(f"t_capture_ns: found {time_ns}, expected 0 to {messages.MOST_TIME_NS}")
    return time_ns


def _check(label: str, array: NDArray[Any], shapes: list[tuple[int, ...]], dtype: np.dtype, filled: str) -> None:
    """`filled` is what a masked array may be made of: numpy copies what lies under the mask without a word."""
    if not isinstance(array, np.ndarray):
        raise TypeError(f"{label}: found {type(array).__name__}, expected a numpy array")
    if isinstance(array, np.ma.MaskedArray):
        raise TypeError(f"{label}: found a masked array, expected one without a mask, such as its {filled}")
    if array.dtype != dtype:
        raise TypeError(f"{label}: found {array.dtype}, expected {dtype}; nothing is converted silently")
    if array.shape not in shapes:
        raise ValueError(f"{label}: found shape {array.shape}, expected {' or '.join(map(str, shapes))}")


def _nobody(paths: str) -> str:
    return f"no holod listens on {paths}: start it with `holod run --scene feed`, or give the path that its log names"


def _why_not_connected(path: Path, error: OSError) -> str:
    if error.errno in _NOBODY:
        return _nobody(str(path))
    if error.errno == errno.EACCES:
        return (
            f"this user may not open {path}: run as the user that holod runs as, or as one who may write to that socket"
        )
    if error.errno == errno.EPROTOTYPE:
        return (
            f"{path} is a socket of another type than holod's (SOCK_SEQPACKET): it belongs to another program; give "
            "the path that holod's log names"
        )
    if isinstance(error, BlockingIOError | TimeoutError):
        return f"holod lets nobody in on {path}: see its log, start it again"
    return f"cannot connect to {path}: {error.strerror or error}"

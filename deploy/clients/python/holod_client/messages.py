"""The messages of daemon/doc/feed.md, in the machine's byte order."""

from __future__ import annotations

import struct
from typing import NamedTuple

VERSION = 2
"""The newest; pictures say how they were taken from this one on. What they do not need is said in version 1."""
NAME_BYTES = 32
ALIGNMENT = 64
MOST_SEQUENCE = 2**64 - 1
MOST_TIME_NS = 2**63 - 1

_HELO = struct.Struct(f"=4s5If4x{NAME_BYTES}s")
_RING = struct.Struct("=4sI5Q")
_FRAM = struct.Struct("=4sIQqI3f")
_HAS_FOCUS, _HAS_FIELD_OF_VIEW = 1, 2
_FREE = struct.Struct("=4sIQI4x")


class MessageError(Exception):
    """A message that is not of this version of the protocol."""


class Ring(NamedTuple):
    """The shared memory: offsets and sizes in bytes."""

    slots: int
    distance: int
    colour_offset: int
    colour_bytes: int
    depth_offset: int
    depth_bytes: int


class Free(NamedTuple):
    """A slot that holod gives back, and what became of the picture in it (0 to 3)."""

    slot: int
    sequence: int
    outcome: int
    text: str


def helo(
    width_px: int, height_px: int, colour: int, depth: int, plane_dpt: float, name: str, *, tells_view: bool
) -> bytes:
    version = VERSION if tells_view else 1
    return _HELO.pack(b"HELO", version, width_px, height_px, colour, depth, plane_dpt, cut(name))


def cut(name: str) -> bytes:
    """As much of `name` in UTF-8 as fits, without breaking a character; `?` for what is no character."""
    return name.encode(errors="replace")[:NAME_BYTES].decode(errors="ignore").encode()


def fram(
    slot: int,
    sequence: int,
    t_capture_ns: int,
    focus_dpt: float | None = None,
    field_of_view_deg: tuple[float, float] | None = None,
) -> bytes:
    given = (focus_dpt is not None) * _HAS_FOCUS | (field_of_view_deg is not None) * _HAS_FIELD_OF_VIEW
    across_deg, up_deg = (0.0, 0.0) if field_of_view_deg is None else field_of_view_deg
    return _FRAM.pack(b"FRAM", slot, sequence, t_capture_ns, given, focus_dpt or 0.0, across_deg, up_deg)


def ring(message: bytes) -> Ring:
    """Raises MessageError."""
    if len(message) != _RING.size or message[:4] != b"RING":
        raise MessageError(f"{_kind(message)}, expected RING of {_RING.size} bytes")
    return Ring(*_RING.unpack(message)[1:])


def free(message: bytes) -> Free:
    """Raises MessageError."""
    if len(message) < _FREE.size or message[:4] != b"FREE":
        raise MessageError(f"{_kind(message)}, expected FREE with at least {_FREE.size} bytes")
    _, slot, sequence, outcome = _FREE.unpack_from(message)
    return Free(slot, sequence, outcome, message[_FREE.size :].decode(errors="replace"))


def nope(message: bytes) -> str | None:
    """The text where holod refuses the connection."""
    return message[4:].decode(errors="replace") if message[:4] == b"NOPE" else None


def _kind(message: bytes) -> str:
    return f"{message[:4].decode('ascii', errors='replace')!r} of {len(message)} bytes"

"""Feeds holod from the command line: python -m holod_client COMMAND"""

from __future__ import annotations

import argparse
import os
import sys
import time
from io import BufferedReader
from typing import Any

import numpy as np
from numpy.typing import NDArray

from holod_client.feed import MOST_PX, Feed, FeedError
from holod_client.formats import Colour, Depth


class InputError(Exception):
    """Standard input holds something else than whole pictures."""


def main(arguments: list[str] | None = None) -> int:
    parser = _parser()
    options = parser.parse_args(arguments)
    if (options.depth == Depth.NONE) != (options.plane is not None):
        parser.error("give one of --plane DPT, the distance of pictures without depth, and --depth FORMAT")
    # What python makes of one that was closed before it began.
    if sys.stdin is None:
        parser.error("standard input is closed: pipe pictures into it, such as from ffmpeg or GStreamer")
    if sys.stdin.isatty():
        parser.error("standard input is a terminal: pipe pictures into it, such as from ffmpeg or GStreamer")
    try:
        with open(sys.stdin.fileno(), "rb", closefd=False) as stream:
            feed_pictures(options, stream)
    except (FeedError, InputError) as error:
        print(f"error: {error}", file=sys.stderr)
        return os.EX_DATAERR if isinstance(error, InputError) else os.EX_UNAVAILABLE
    except KeyboardInterrupt:
        return 130
    return os.EX_OK


def feed_pictures(options: argparse.Namespace, stream: BufferedReader) -> None:
    """Hands over one picture after another until `stream` ends: colour, and depth behind it where there is one.

    Raises FeedError, InputError.
    """
    width_px, height_px = options.size
    with Feed(
        width_px,
        height_px,
        colour=options.colour,
        depth=options.depth,
        plane_dpt=options.plane,
        name=options.name,
        path=options.socket,
    ) as feed:
        due_s = time.monotonic()
        try:
            while stream.peek(1):
                with feed.slot() as slot:
                    _fill(stream, slot.colour, f"the colour of picture {feed.outcomes.sent + 1}")
                    _fill(stream, slot.depth, f"the depth of picture {feed.outcomes.sent + 1}")
                    if options.fps is not None:
                        time.sleep(max(0.0, due_s - time.monotonic()))
                        due_s = max(due_s + 1 / options.fps, time.monotonic())
            feed.wait()
        finally:
            print(feed.outcomes, file=sys.stderr)


def _fill(stream: BufferedReader, plane: NDArray[Any], label: str) -> None:
    """Reads the whole of `plane`. Raises InputError where `stream` ends before."""
    rest = plane.reshape(-1).view(np.uint8).data
    while rest:
        found = stream.readinto(rest)
        if not found:
            raise InputError(
                f"standard input ends inside {label}: found {plane.nbytes - len(rest)} bytes, expected {plane.nbytes}; "
                "are the size and the formats those of the pictures?"
            )
        rest = rest[found:]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="holod_client", description="Feeds holod from the command line.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    stdin = commands.add_parser(
        "stdin",
        help="raw pictures from standard input, as ffmpeg and GStreamer write them",
        description="Hands over raw pictures from standard input, one behind the other: rows from the top, without "
        "padding. With --depth the depth of each picture follows its colour.",
    )
    stdin.add_argument("--size", type=_size, required=True, metavar="WxH", help="of all pictures, in pixels")
    stdin.add_argument("--plane", type=float, metavar="DPT", help="distance of pictures without depth, in dioptres")
    stdin.add_argument("--depth", choices=[*map(str, Depth)], default="none", metavar="FORMAT", help=", ".join(Depth))
    stdin.add_argument(
        "--colour", choices=[*map(str, Colour)], default="rgba8", metavar="FORMAT", help=", ".join(Colour)
    )
    stdin.add_argument("--fps", type=_fps, metavar="N", help="hand over N pictures a second at most")
    stdin.add_argument("--name", default="standard input", help="for holod's log and status")
    stdin.add_argument("--socket", metavar="PATH", help="where holod listens, if not in its runtime folder")
    return parser


def _size(text: str) -> tuple[int, int]:
    width_px, height_px = (int(part) for part in text.split("x"))
    if not (0 < width_px < MOST_PX and 0 < height_px < MOST_PX):
        raise ValueError
    return width_px, height_px


def _fps(text: str) -> float:
    fps = float(text)
    if not fps > 0:
        raise ValueError
    return fps


# argparse names these in its errors.
_size.__name__ = "WxH"
_fps.__name__ = "pictures a second"

if __name__ == "__main__":
    sys.exit(main())

"""Hands live pictures with depth to a running holod, and changes what it does.

holod must listen (`holod run --scene feed`). Then:

    import holod_client

    with holod_client.Feed(640, 480, colour="rgba8", depth="u16_mm", name="my camera") as feed:
        for rgb, depth_mm in camera:
            feed.send(rgb, depth_mm)

    with holod_client.Control() as holod:
        holod.pupil(3.5)
        print(holod.status()["frames_shown_hz"])
"""

from holod_client.control import Control, ControlError, UnansweredError
from holod_client.feed import Feed, FeedError, FeedTimeoutError, Outcomes, Slot, default_path
from holod_client.formats import Colour, Depth

__all__ = [
    "Colour",
    "Control",
    "ControlError",
    "Depth",
    "Feed",
    "FeedError",
    "FeedTimeoutError",
    "Outcomes",
    "Slot",
    "UnansweredError",
    "default_path",
]

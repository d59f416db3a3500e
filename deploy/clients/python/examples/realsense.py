"""Feeds holod from an Intel RealSense depth camera: pip install pyrealsense2, then python realsense.py"""

from __future__ import annotations

import argparse
import math
import sys
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

import holod_client

WAIT_MS = 5000


def millimetres(raw: NDArray[np.uint16], unit_m: float) -> NDArray[np.uint16]:
    """Depth of any shape, in units of `unit_m` metres, to millimetres; 0 stays 0, which is no depth.

    Nothing that has a depth becomes 0: below 1 mm is 1 mm. Above 65535 mm is 65535 mm.
    """
    if np.isclose(unit_m, 0.001):
        return raw
    mm = np.clip(np.rint(raw * (unit_m * 1000)), 1, 65535).astype(np.uint16)
    return np.where(raw > 0, mm, np.uint16(0))


def field_of_view_deg(width_px: int, height_px: int, intrinsics: Any) -> tuple[float, float]:
    """Across and up, of a camera whose axis is in the picture's middle, as it nearly is."""
    across, up = (2 * math.atan(side / (2 * f)) for side, f in ((width_px, intrinsics.fx), (height_px, intrinsics.fy)))
    return math.degrees(across), math.degrees(up)


def capture_time_ns(frame: Any, domains: set[Any]) -> int:
    """On the clock of time.monotonic_ns(); 0 where the camera tells the time of another clock than the computer's."""
    if frame.get_frame_timestamp_domain() not in domains:
        return 0
    # The wall clock may have been set since the frame was taken.
    age_ns = max(0, time.time_ns() - int(frame.get_timestamp() * 1e6))
    return max(0, time.monotonic_ns() - age_ns)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", default="640x480", metavar="WxH", help="a size that the camera has for both streams")
    parser.add_argument("--fps", type=int, default=30)
    parser.add_argument("--socket", metavar="PATH", help="where holod listens, if not in its runtime folder")
    options = parser.parse_args()
    width_px, height_px = (int(part) for part in options.size.split("x"))

    import pyrealsense2 as rs

    config = rs.config()
    config.enable_stream(rs.stream.color, width_px, height_px, rs.format.rgb8, options.fps)
    config.enable_stream(rs.stream.depth, width_px, height_px, rs.format.z16, options.fps)
    pipeline = rs.pipeline()
    profile = pipeline.start(config)
    try:
        # 1 mm with most cameras, 0.1 mm with a D405, and a setting in all of them.
        unit_m = profile.get_device().first_depth_sensor().get_depth_scale()
        computers_clock = {rs.timestamp_domain.system_time, rs.timestamp_domain.global_time}
        # Depth as the colour camera would see it: both planes of a picture show the same in the same pixel.
        align = rs.align(rs.stream.color)
        intrinsics = profile.get_stream(rs.stream.color).as_video_stream_profile().get_intrinsics()
        field_deg = field_of_view_deg(width_px, height_px, intrinsics)
        with holod_client.Feed(
            width_px, height_px, depth="u16_mm", name="RealSense", path=options.socket, tells_view=True
        ) as feed:
            while True:
                frames = align.process(pipeline.wait_for_frames(WAIT_MS))
                colour, depth = frames.get_color_frame(), frames.get_depth_frame()
                if colour and depth:
                    feed.send(
                        np.asanyarray(colour.get_data()),
                        millimetres(np.asanyarray(depth.get_data()), unit_m),
                        capture_time_ns(colour, computers_clock),
                        field_of_view_deg=field_deg,
                    )
    finally:
        pipeline.stop()


if __name__ == "__main__":
    try:
        main()
    except (holod_client.FeedError, RuntimeError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit(130)

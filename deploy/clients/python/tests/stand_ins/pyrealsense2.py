"""A RealSense camera as far as the example asks of one: a card at 40 cm before a wall at 2 m, ten times."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import numpy as np

PICTURES = 10
UNIT_M = 0.0001

stream = SimpleNamespace(color="color", depth="depth")
format = SimpleNamespace(rgb8="rgb8", z16="z16")
timestamp_domain = SimpleNamespace(system_time="system", global_time="global")


class Frame:
    def __init__(self, pixels: np.ndarray) -> None:
        self._pixels = pixels

    def get_data(self) -> np.ndarray:
        return self._pixels

    def get_timestamp(self) -> float:
        return time.time() * 1000

    def get_frame_timestamp_domain(self) -> str:
        return "system"


class config:  # noqa: N801
    def enable_stream(self, stream: str, width_px: int, height_px: int, format: str, fps: int) -> None:
        self.size, self.fps = (height_px, width_px), fps


class align:  # noqa: N801
    def __init__(self, to: str) -> None:
        assert to == stream.color

    def process(self, frames: Any) -> Any:
        return frames


class pipeline:  # noqa: N801
    def start(self, config: config) -> Any:
        self._config, self._left = config, PICTURES
        height_px, width_px = config.size
        sensor = SimpleNamespace(get_depth_scale=lambda: UNIT_M)
        # fx and fy of 60 x 45 degrees.
        intrinsics = SimpleNamespace(fx=width_px / 2 / np.tan(np.pi / 6), fy=height_px / 2 / np.tan(np.pi / 8))
        video = SimpleNamespace(get_intrinsics=lambda: intrinsics)
        return SimpleNamespace(
            get_device=lambda: SimpleNamespace(first_depth_sensor=lambda: sensor),
            get_stream=lambda which: SimpleNamespace(as_video_stream_profile=lambda: video),
        )

    def wait_for_frames(self, wait_ms: int) -> Any:
        if self._left == 0:
            raise RuntimeError(f"Frame didn't arrive within {wait_ms}")
        self._left -= 1
        time.sleep(1 / self._config.fps)
        rgb = np.full((*self._config.size, 3), 90, np.uint8)
        raw = np.full(self._config.size, 2 / UNIT_M, np.uint16)
        raw[::4, ::4] = 0
        raw[10:30, 10:30] = 0.4 / UNIT_M
        return SimpleNamespace(get_color_frame=lambda: Frame(rgb), get_depth_frame=lambda: Frame(raw))

    def stop(self) -> None:
        pass

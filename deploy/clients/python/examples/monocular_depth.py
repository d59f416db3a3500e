"""Feeds holod colour pictures whose depth a network estimates: from a camera, or a folder of pictures.

    pip install opencv-python torch transformers
    python monocular_depth.py 0                    # the first camera
    python monocular_depth.py FOLDER --near 2.5

Such a network does not know how far things are. What it gives is *relative*: the nearer the larger, and except for a
factor and a summand, which differ from picture to picture, in dioptres. Here the farthest point of each picture comes
to --far and the nearest to --near. So the order of things is right and their distances are made up; and in a film they
shift when something nearer or farther enters the picture.

Where torch or transformers is missing, each picture is a plane at --far instead.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

import holod_client

Estimate = Callable[[NDArray[Any]], NDArray[np.float32]]


def dioptres(relative: NDArray[np.float32], near_dpt: float, far_dpt: float) -> NDArray[np.float32]:
    """(height, width) of relative depth, the nearer the larger, to dioptres between far and near.

    What is not finite becomes NaN, which is no depth. Where all is equally far, it is far.
    """
    known = np.where(np.isfinite(relative), relative, np.nan)
    farthest, nearest = np.nanmin(known), np.nanmax(known)
    share = (known - farthest) / max(nearest - farthest, np.finfo(np.float32).tiny)
    return (far_dpt + share * (near_dpt - far_dpt)).astype(np.float32)


def network(name: str) -> Estimate | None:
    """RGB to relative depth, both (height, width); None where the packages are missing."""
    try:
        import torch
        from PIL import Image
        from transformers import pipeline
    except ImportError as error:
        print(f"{error.name} is missing: each picture is a plane", file=sys.stderr)
        return None
    estimator = pipeline("depth-estimation", model=name, device=0 if torch.cuda.is_available() else -1)

    def estimate(rgb: NDArray[Any]) -> NDArray[np.float32]:
        relative = estimator(Image.fromarray(rgb))["predicted_depth"].squeeze().float().cpu().numpy()
        return cv2.resize(relative, rgb.shape[1::-1], interpolation=cv2.INTER_LINEAR)

    return estimate


def middle(picture: NDArray[Any], size_px: tuple[int, int]) -> NDArray[Any]:
    """The largest part of a picture around its middle that has the shape of the size."""
    height, width = picture.shape[:2]
    size_x, size_y = size_px
    part_x, part_y = min(width, height * size_x // size_y), min(height, width * size_y // size_x)
    part_x, part_y = max(part_x, 1), max(part_y, 1)
    left, top = (width - part_x) // 2, (height - part_y) // 2
    return picture[top : top + part_y, left : left + part_x]


def pictures(source: str, size_px: tuple[int, int], seconds: float) -> Iterator[tuple[NDArray[Any], int]]:
    """RGB of one size, and when it was taken: a camera by its number, or each picture of a folder for some seconds."""
    if source.isdecimal():
        camera = cv2.VideoCapture(int(source))
        while True:
            found, bgr = camera.read()
            if not found:
                sys.exit(f"error: camera {source} gives no picture")
            yield cv2.cvtColor(cv2.resize(middle(bgr, size_px), size_px), cv2.COLOR_BGR2RGB), time.monotonic_ns()
    for path in sorted(Path(source).iterdir()):
        picture = cv2.imread(str(path))
        if picture is not None:
            yield cv2.cvtColor(cv2.resize(middle(picture, size_px), size_px), cv2.COLOR_BGR2RGB), 0
            time.sleep(seconds)


def size(text: str) -> tuple[int, int]:
    width_px, height_px = (int(part) for part in text.split("x"))
    if width_px < 1 or height_px < 1:
        raise ValueError
    return width_px, height_px


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", help="a camera's number, or a folder of pictures")
    parser.add_argument("--near", type=float, default=2.5, metavar="DPT", help="the display's nearest distance")
    parser.add_argument("--far", type=float, default=0.0, metavar="DPT", help="the display's farthest distance")
    parser.add_argument(
        "--size", type=size, default=(640, 480), metavar="WxH", help="to which pictures are cut and brought: 640x480"
    )
    parser.add_argument("--seconds", type=float, default=2.0, help="for each picture of a folder")
    parser.add_argument(
        "--network", default="depth-anything/Depth-Anything-V2-Small-hf", help="on the Hugging Face hub"
    )
    parser.add_argument("--socket", metavar="PATH", help="where holod listens, if not in its runtime folder")
    options = parser.parse_args()
    width_px, height_px = options.size

    estimate = network(options.network)
    depth, plane_dpt = ("none", options.far) if estimate is None else ("f32_dpt", None)
    with holod_client.Feed(
        width_px, height_px, depth=depth, plane_dpt=plane_dpt, name="monocular depth", path=options.socket
    ) as feed:
        for rgb, t_capture_ns in pictures(options.source, (width_px, height_px), options.seconds):
            estimated = None if estimate is None else dioptres(estimate(rgb), options.near, options.far)
            feed.send(rgb, estimated, t_capture_ns)


if __name__ == "__main__":
    try:
        main()
    except (holod_client.FeedError, OSError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit(130)

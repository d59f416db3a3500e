"""A picture with depth of Open3D as a hologram: `python open3d_scene.py colour.jpg depth.png out.png`.

    pip install open3d pillow

Open3D gives depth along the axis of view in metres, after its own scale (1000 to the metre by default), and sets to 0
what has none or lies beyond `depth_trunc`. holod fills such pixels from their surroundings; a wall beyond
`depth_trunc` would be filled too, so nothing is truncated here.
"""

from __future__ import annotations

import argparse
from typing import Any

import holod
import numpy as np
from PIL import Image

FARTHEST_M = 1e4


def render(renderer: holod.Renderer, rgbd: Any, pupil_mm: float) -> holod.Hologram:
    """The hologram of an `open3d.geometry.RGBDImage` in colours (made with convert_rgb_to_intensity=False)."""
    return renderer.render(
        np.asarray(rgbd.color), np.asarray(rgbd.depth), pupil_mm, depth_unit="metres", fill_missing=True
    )


def main() -> None:
    import open3d

    parser = argparse.ArgumentParser(description="What an eye sees of a picture of Open3D on a holographic display")
    parser.add_argument("colour")
    parser.add_argument("depth")
    parser.add_argument("out", help="PNG: focused at the focus that is named")
    parser.add_argument("--depth-scale", type=float, default=1000.0, help="numbers of the depth file to a metre")
    parser.add_argument("--pupil-mm", type=float, default=3.0)
    parser.add_argument("--focus-m", type=float, default=1.0, help="where the eye is focused")
    parser.add_argument("--weights", default="small", help="standard, small, fast or a file")
    options = parser.parse_args()

    rgbd = open3d.geometry.RGBDImage.create_from_color_and_depth(
        open3d.io.read_image(options.colour),
        open3d.io.read_image(options.depth),
        depth_scale=options.depth_scale,
        depth_trunc=FARTHEST_M,
        convert_rgb_to_intensity=False,
    )
    height_px, width_px = np.asarray(rgbd.depth).shape
    renderer = holod.Renderer(weights=options.weights, width_px=width_px, height_px=height_px)
    hologram = render(renderer, rgbd, options.pupil_mm)
    print(f"{hologram}: {hologram.depth_missing_px} pixels had no depth")
    Image.fromarray(holod.to_srgb8(hologram.view(focus_dpt=1 / options.focus_m))).save(options.out)


if __name__ == "__main__":
    main()

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from holod_training.config import OpticsConfig
from holod_training.rgbd import RgbdError, fill_missing, find_pairs, read_pair

OPTICS = OpticsConfig()
SHARED = Path(os.environ.get("HOLOD_SHARED_DATA", Path(__file__).parents[3].parent / "shared" / "data")) / "rgbd"


def write_pair(
    folder: Path, millimetres: np.ndarray, colour: tuple[int, int, int] = (255, 188, 0)
) -> tuple[Path, Path]:
    paths = folder / "rgb" / "a.png", folder / "depth" / "a.png"
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
    height, width = millimetres.shape
    Image.new("RGB", (width, height), (255, 188, 0)).save(paths[0])
    Image.fromarray(millimetres.astype("uint16")).save(paths[1])
    return paths


def test_holes_fill_from_their_rim_inwards() -> None:
    values = torch.full((7, 7), 4.0)
    values[:, 4:] = 8.0
    valid = torch.ones(7, 7, dtype=torch.bool)
    valid[2:5, 1:4] = False
    values[~valid] = 100.0
    filled = fill_missing(values, valid)
    assert torch.equal(filled[valid], values[valid])
    assert (filled[3, 1], filled[3, 3]) == (4, 8)
    assert 4 < filled[3, 2] < 8


def test_a_pair_becomes_linear_light_and_dioptres(tmp_path: Path) -> None:
    millimetres = np.full((5, 6), 1000)
    millimetres[:, 3:], millimetres[0, 0], millimetres[4, 5] = 200, 0, 60000
    image, depth = read_pair(*write_pair(tmp_path, millimetres), OPTICS)
    assert image.shape == (3, 4, 6) and depth.shape == (4, 6)
    assert image[:, 0, 0].tolist() == pytest.approx([1.0, 0.503, 0.0], abs=1e-3)
    assert depth[2, 0] == depth[0, 0] == pytest.approx(1 / OPTICS.depth_near_dpt)
    assert depth[0, 5] == 1
    assert find_pairs(tmp_path) == [(tmp_path / "rgb" / "a.png", tmp_path / "depth" / "a.png")]


def test_what_is_wrong_is_said(tmp_path: Path) -> None:
    with pytest.raises(RgbdError, match="no RGB-D pairs"):
        find_pairs(tmp_path)
    colour, depth = write_pair(tmp_path, np.zeros((4, 4)))
    with pytest.raises(RgbdError, match="every pixel is 0"):
        read_pair(colour, depth, OPTICS)
    Image.fromarray(np.ones((4, 5), "uint16")).save(depth)
    with pytest.raises(RgbdError, match=r"shape \[4, 5\], expected one channel of \[4, 4\]"):
        read_pair(colour, depth, OPTICS)


@pytest.mark.skipif(not SHARED.is_dir(), reason=f"no real RGB-D pictures at {SHARED}")
def test_real_rgbd_pictures_are_read() -> None:
    image, depth = read_pair(*find_pairs(SHARED)[0], OPTICS)
    assert image.shape == (3, 480, 640) and depth.shape == (480, 640)
    metres = 1 / (depth.median() * OPTICS.depth_near_dpt)
    assert 1 < metres < 2.8

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import ExifTags, Image

from holod_training.config import OpticsConfig
from holod_training.rgbd import RgbdError, find_pairs, read_pair, read_pictures

OPTICS = OpticsConfig()
SHARED = Path(os.environ.get("HOLOD_SHARED_DATA", Path(__file__).parents[3].parent / "shared" / "data")) / "rgbd"


def write_pair(folder: Path, millimetres: np.ndarray, name: str = "a") -> tuple[Path, Path]:
    paths = folder / "rgb" / f"{name}.png", folder / "depth" / f"{name}.png"
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
    height, width = millimetres.shape
    Image.new("RGB", (width, height), (255, 188, 0)).save(paths[0])
    Image.fromarray(millimetres.astype("uint16")).save(paths[1])
    return paths


def test_a_pair_becomes_linear_light_and_dioptres(tmp_path: Path) -> None:
    millimetres = np.full((5, 6), 1000)
    millimetres[:, 3:], millimetres[0, 0], millimetres[4, 5] = 200, 0, 60000
    image, depth = read_pair(*write_pair(tmp_path, millimetres), OPTICS)
    assert image.shape == (3, 4, 6) and depth.shape == (4, 6)
    assert image[:, 0, 0].tolist() == pytest.approx([1.0, 0.503, 0.0], abs=1e-3)
    assert depth[2, 0] == depth[0, 0] == pytest.approx(1 / OPTICS.depth_near_dpt)
    assert depth[0, 5] == 1
    assert find_pairs(tmp_path) == [(tmp_path / "rgb" / "a.png", tmp_path / "depth" / "a.png")]


def test_holes_take_the_farther_side_as_holod_fills_them(tmp_path: Path) -> None:
    """Background that a nearer edge hides from the camera is background."""
    millimetres = np.full((6, 8), 500)
    millimetres[:, 4:], millimetres[:, 2:4] = 2000, 0
    _, depth = read_pair(*write_pair(tmp_path, millimetres), OPTICS)
    assert torch.equal(depth[:, 2:4], depth[:, 4:6]) and not torch.equal(depth[:, 2:4], depth[:, :2])


def test_each_picture_is_turned_by_its_own_orientation(tmp_path: Path) -> None:
    """A telephone's JPEG lies on its side and says so; holod turns it."""
    colour, depth = write_pair(tmp_path, np.full((4, 6), 1000))
    on_its_side = Image.new("RGB", (6, 4), (0, 0, 0))
    on_its_side.paste((255, 255, 255), (0, 0, 3, 2))
    turned = Image.Exif()
    turned[ExifTags.Base.Orientation] = 6
    on_its_side.save(colour, exif=turned)
    with pytest.raises(RgbdError, match=r"shape \[4, 6\], expected one channel of \[6, 4\]"):
        read_pair(colour, depth, OPTICS)
    millimetres = np.full((6, 4), 1000, "uint16")
    millimetres[:3, 2:] = 500
    Image.fromarray(millimetres).save(depth)
    image, upright = read_pair(colour, depth, OPTICS)
    near = upright > upright.min()
    assert near.sum() == 6 and torch.equal(image[0] > 0.5, near)
    # A wrong turn is noticed.
    turned[ExifTags.Base.Orientation] = 8
    on_its_side.save(colour, exif=turned)
    assert not torch.equal(read_pair(colour, depth, OPTICS)[0][0] > 0.5, near)
    Image.fromarray(np.rot90(millimetres).copy()).save(depth, exif=Image.Exif())
    with pytest.raises(RgbdError, match=r"shape \[4, 6\], expected one channel of \[6, 4\]"):
        read_pair(colour, depth, OPTICS)
    turned[ExifTags.Base.Orientation] = 6
    Image.fromarray(np.rot90(millimetres).copy()).save(depth, exif=turned)
    assert torch.equal(read_pair(colour, depth, OPTICS)[1], upright)


def test_what_is_wrong_is_said(tmp_path: Path) -> None:
    with pytest.raises(RgbdError, match="no RGB-D pairs"):
        find_pairs(tmp_path)
    colour, depth = write_pair(tmp_path, np.zeros((4, 4)))
    with pytest.raises(RgbdError, match="every pixel is 0"):
        read_pair(colour, depth, OPTICS)
    Image.fromarray(np.ones((4, 5), "uint16")).save(depth)
    with pytest.raises(RgbdError, match=r"shape \[4, 5\], expected one channel of \[4, 4\]"):
        read_pair(colour, depth, OPTICS)
    depth.write_bytes(depth.read_bytes()[:50])
    with pytest.raises(RgbdError, match=r"depth/a\.png: not a readable picture"):
        read_pair(colour, depth, OPTICS)


def test_pictures_of_one_sheet_are_few_and_of_one_size(tmp_path: Path) -> None:
    for name in "abcdef":
        write_pair(tmp_path, np.full((4, 6), 1000), name)
    assert [image.shape for image, _ in read_pictures(tmp_path, OPTICS)] == [(3, 4, 6)] * 4
    write_pair(tmp_path, np.full((4, 8), 1000), "b")
    with pytest.raises(RgbdError, match=r"rgb/b\.png: shape \[4, 8\], expected \[4, 6\] as in .*rgb/a\.png"):
        read_pictures(tmp_path, OPTICS)


@pytest.mark.skipif(not SHARED.is_dir(), reason=f"no real RGB-D pictures at {SHARED}")
def test_real_rgbd_pictures_are_read() -> None:
    image, depth = read_pair(*find_pairs(SHARED)[0], OPTICS)
    assert image.shape == (3, 480, 640) and depth.shape == (480, 640)
    metres = 1 / (depth.median() * OPTICS.depth_near_dpt)
    assert 1 < metres < 2.8

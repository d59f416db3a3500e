from pathlib import Path

import pytest
import torch
from conftest import write_shard
from PIL import Image
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from holod_training.config import OpticsConfig
from holod_training.judging import AFTER, BEFORE, OURS, Bench, Method, rivals
from holod_training.loss import AWAY_PX, dark_area
from holod_training.marks import judge_marks, light_ratio
from holod_training.optics import stop_half_band
from holod_training.shards import Shard, ShardError

OPTICS = OpticsConfig()
BENCH = Bench(OPTICS, 1.25, 4)


def write_marks(path: Path, kind: str = "marks") -> Shard:
    """Four soft dots, 9 px across, in the lower half of a black picture at 0 dpt."""
    write_shard(path, size=128, pupils_mm=(2.0, 4.0), metadata={"kind": kind, "index": "0"})
    with safe_open(path, framework="pt") as file:
        metadata = file.metadata()
    tensors = load_file(path)
    y, x = torch.meshgrid(torch.arange(128.0), torch.arange(128.0), indexing="ij")
    distances = [torch.hypot(x - column, y - row) for row in (80, 100) for column in (30, 90)]
    light = sum(torch.exp(-(distance**2) / 3) * (distance <= 4) for distance in distances).expand(3, -1, -1)
    stacks = {name: light.expand(3, -1, -1, -1).half() for name in ("stack_0", "stack_1")}
    save_file({**tensors, "image": light.half(), "depth": torch.zeros(128, 128), **stacks}, path, metadata)
    return Shard(path)


def test_rows_tell_light_that_is_added_and_black_that_is_none(tmp_path: Path) -> None:
    shard = write_marks(tmp_path / "scene_000000.safetensors")
    black = 0.03 * torch.randn(3, 128, 128, dtype=torch.complex64, generator=torch.Generator().manual_seed(3))
    methods = [
        Method(OURS, lambda stack, _: stop_half_band(stack.amplitude.to(torch.complex64))),
        Method("lit black", lambda stack, _: stop_half_band(stack.amplitude + black)),
    ]
    rows = judge_marks([shard, shard], methods, BENCH, tmp_path / "sheet.png")
    assert len(rows) == 2 * 2 * 2
    by_key = {(row["method"], row["double_phase"], row["pupil_mm"]): row for row in rows}
    for pupil in (2.0, 4.0):
        before, after = by_key[OURS, BEFORE, pupil], by_key[OURS, AFTER, pupil]
        assert before["marks"] == "dots" and before["scenes"] == 2
        assert after["light_ratio"] == pytest.approx(before["light_ratio"], rel=0.2)
        assert before["dark_mean"] < 1e-4 and after["dark_mean"] < 1e-3
        assert by_key["lit black", BEFORE, pupil]["dark_mean"] > 2e-4
        assert by_key["lit black", BEFORE, pupil]["light_ratio"] > before["light_ratio"] + 0.05
    assert Image.open(tmp_path / "sheet.png").size == (3 * 132, 2 * 132)


def test_black_is_what_is_far_from_light_at_every_focus(tmp_path: Path) -> None:
    stack = write_marks(tmp_path / "scene_000000.safetensors").read(0)
    dark = dark_area(stack.target)
    assert dark[:50].all() and not dark[80, 30] and not dark[76 - AWAY_PX, 30] and dark[75 - AWAY_PX, 30]
    assert light_ratio(0.5 * stack.target, stack.target) == pytest.approx(0.5)


def test_scenes_without_marks_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "scene_000000.safetensors"
    write_marks(path)
    with safe_open(path, framework="pt") as file:
        metadata = file.metadata()
    tensors = load_file(path)
    save_file({**tensors, **{name: 0 * tensors[name] for name in ("image", "stack_0", "stack_1")}}, path, metadata)
    with pytest.raises(ShardError, match="128x128 has no room for marks"):
        judge_marks([Shard(path)], rivals(OPTICS), BENCH, tmp_path / "sheet.png")


def test_scenes_of_another_kind_are_refused(tmp_path: Path) -> None:
    shard = write_marks(tmp_path / "scene_000000.safetensors", kind="test")
    with pytest.raises(ShardError, match="kind 'test', expected marks"):
        judge_marks([shard], rivals(OPTICS), BENCH, tmp_path / "sheet.png")

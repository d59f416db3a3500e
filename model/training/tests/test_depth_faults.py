from pathlib import Path

import numpy as np
import pytest
import torch

from holod_training.depth_faults import STEPS, coarse_steps, faulty_depth, fill_holes, holes, move_edges
from holod_training.sampling import AugmentConfig, Sampler


def sampler(shards: Path, chance: float) -> Sampler:
    made = Sampler(shards, 32, 1, 0, AugmentConfig(faulty_depth=chance))
    made.rescan()
    return made


def test_faults_change_what_the_network_is_given_and_nothing_else(shards: Path) -> None:
    without, always, sometimes = (sampler(shards, chance) for chance in (0, 1, 0.5))
    changed = 0
    for step in range(8):
        for plain, poor in zip(without.draw(step, 2), always.draw(step, 2), strict=True):
            for name in ("image", "depth", "target"):
                assert torch.equal(getattr(plain, name), getattr(poor, name)), name
            assert plain.pupil_mm == poor.pupil_mm
            assert plain.faulty_depth is None and plain.given_depth is plain.depth
            assert poor.given_depth is poor.faulty_depth is not None
            assert poor.given_depth.shape == poor.depth.shape
            assert poor.given_depth.min() >= 0 and poor.given_depth.max() <= 1
            changed += not torch.equal(poor.given_depth, poor.depth)
    assert changed > 8
    drawn = [s.faulty_depth is None for step in range(12) for s in sometimes.draw(step, 2)]
    assert 4 < sum(drawn) < 20
    one, again = (always.draw(3, 1)[0].given_depth for _ in range(2))
    assert torch.equal(one, again)


def test_edges_move_by_one_pixel() -> None:
    depth = torch.zeros(9, 9)
    depth[3:6, 3:6] = 1
    grown, shrunk, right, down = (move_edges(depth, way) for way in range(4))
    assert (grown.sum(), shrunk.sum(), right.sum(), down.sum()) == (25, 1, 9, 9)
    assert torch.equal(right[:, 4:7], depth[:, 3:6]) and torch.equal(down[4:7], depth[3:6])


def filled_one_by_one(depth: torch.Tensor, missing: torch.Tensor) -> torch.Tensor:
    """holod's rule (`fill_missing` of `model/src/scene/depth.rs`), pixel by pixel."""
    filled, missing = depth.clone(), missing.clone()
    height, width = depth.shape
    while missing.any():
        known, seen = filled.clone(), missing.clone()
        for y, x in missing.nonzero().tolist():
            ways = (
                [(y, k) for k in range(x - 1, -1, -1)],
                [(y, k) for k in range(x + 1, width)],
                [(k, x) for k in range(y - 1, -1, -1)],
                [(k, x) for k in range(y + 1, height)],
            )
            nearest = [next((known[at] for at in way if not missing[at]), None) for way in ways]
            if found := [value for value in nearest if value is not None]:
                filled[y, x], seen[y, x] = min(found), False
        missing = seen
    return filled


def test_holes_take_the_farther_side_as_holod_fills_them() -> None:
    row, hole = torch.tensor([[2.0, 7.0, 7.0, 0.5, 7.0]]), torch.tensor([[0, 1, 1, 0, 1]]) > 0
    assert fill_holes(row, hole).tolist() == [[2, 0.5, 0.5, 0.5, 0.5]]
    assert fill_holes(row.T, hole.T).tolist() == [[2], [0.5], [0.5], [0.5], [0.5]]
    corner = torch.full((3, 3), torch.nan)
    corner[2, 2] = 1.5
    assert fill_holes(corner, corner.isnan()).tolist() == [[1.5] * 3] * 3
    generator = torch.Generator().manual_seed(4)
    for share in (0.1, 0.6, 0.97):
        depth = torch.rand(13, 17, generator=generator)
        missing = torch.rand(13, 17, generator=generator) < share
        poisoned = torch.where(missing, torch.tensor(-7.0), depth)
        filled = fill_holes(poisoned, missing)
        assert torch.equal(filled, filled_one_by_one(depth, missing)) and torch.equal(filled[~missing], depth[~missing])
    wrong = missing.clone()
    wrong[tuple((~missing).nonzero()[0])] = True
    assert not torch.equal(fill_holes(depth, wrong), filled)
    flat = torch.full((5, 5), 0.3)
    torch.testing.assert_close(fill_holes(flat, torch.eye(5) > 0), flat)
    assert fill_holes(flat, torch.ones(5, 5) > 0).abs().max() == 0


def test_holes_and_steps_are_as_large_as_stated() -> None:
    rng = np.random.default_rng(1)
    shares = [float(holes(torch.Size((64, 64)), rng).float().mean()) for _ in range(20)]
    assert min(shares) > 0 and max(shares) < 0.5
    depth = torch.rand(20, 20, generator=torch.Generator().manual_seed(1))
    coarse = coarse_steps(depth)
    assert (coarse - depth).abs().max() == pytest.approx(0.5 / STEPS, rel=0.05)
    assert len(coarse.unique()) <= STEPS + 1


def test_each_fault_is_drawn() -> None:
    """On flat depth noise alone shows; on a slope with a box all of them do."""
    rng = np.random.default_rng(2)
    flat = torch.full((16, 16), 0.5)
    noisy = [float(faulty_depth(flat, rng).std()) for _ in range(30)]
    assert 5 < sum(n > 1e-3 for n in noisy) < 25
    assert max(noisy) < 0.03

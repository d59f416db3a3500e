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


def test_holes_are_filled_from_their_rims() -> None:
    depth = torch.linspace(0, 1, 40).expand(30, 40).contiguous()
    missing = torch.zeros(30, 40, dtype=torch.bool)
    missing[8:20, 10:22] = True
    filled = fill_holes(depth, missing)
    assert torch.equal(filled[~missing], depth[~missing])
    error = (filled - depth)[missing].abs()
    assert 0.01 < error.max() < 0.2
    poisoned = torch.where(missing, torch.tensor(7.0), depth)
    assert torch.equal(fill_holes(poisoned, missing), filled)
    step, hole = torch.full((7, 7), 4.0), torch.zeros(7, 7, dtype=torch.bool)
    step[:, 4:], hole[2:5, 1:4] = 8.0, True
    across = fill_holes(step, hole)
    assert (across[3, 1], across[3, 3]) == (4, 8) and 4 < across[3, 2] < 8
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

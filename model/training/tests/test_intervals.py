import math

import numpy as np
import pytest

from holod_training.intervals import interval_95, t_quantile


def test_quantiles_are_those_of_the_tables() -> None:
    for degrees, expected in ((1, 12.706), (2, 4.303), (7, 2.365), (15, 2.131), (99, 1.984)):
        assert t_quantile(degrees) == pytest.approx(expected, abs=6e-4)


@pytest.mark.parametrize("scenes", [3, 40])
def test_the_interval_covers_the_true_mean_as_often_as_it_says(scenes: int) -> None:
    rng = np.random.default_rng(1)
    covered = 0
    for _ in range(2000):
        low, high = interval_95(rng.normal(30, 2, scenes)) or (0, 0)
        covered += low < 30 < high
    assert 0.935 < covered / 2000 < 0.965


def test_it_narrows_with_scenes_and_leaves_nan_out() -> None:
    values = np.random.default_rng(2).normal(0, 1, 400)
    few, many = (interval_95(values[:n]) or (0, 0) for n in (25, 400))
    assert few[1] - few[0] > 3 * (many[1] - many[0])
    assert interval_95([1.0, math.nan, 3.0]) == interval_95([1.0, 3.0])
    assert interval_95([1.0, math.nan]) is None
    assert interval_95([2.0, 2.0]) == (2.0, 2.0)


def test_paired_differences_see_what_means_cannot() -> None:
    """Scenes differ far more than methods: the methods' own intervals overlap, that of their differences excludes 0."""
    rng = np.random.default_rng(3)
    theirs = rng.normal(25, 4, 30)
    ours = theirs + rng.normal(0.5, 0.3, 30)
    (ours_low, _), (_, theirs_high) = interval_95(ours) or (0, 0), interval_95(theirs) or (0, 0)
    assert ours_low < theirs_high
    paired, shuffled = (interval_95(d) or (0, 0) for d in (ours - theirs, rng.permutation(ours) - theirs))
    assert paired[0] > 0 > shuffled[0]

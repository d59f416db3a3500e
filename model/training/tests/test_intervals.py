import math

import numpy as np
import pytest

from holod_training.intervals import bootstrap_interval


def test_the_interval_covers_the_true_mean_about_as_often_as_it_says() -> None:
    rng = np.random.default_rng(1)
    covered = 0
    for trial in range(200):
        low, high = bootstrap_interval(rng.normal(30, 2, 40), seed=trial)
        covered += low <= 30 <= high
    assert 0.90 <= covered / 200 <= 0.98


def test_it_narrows_with_the_number_of_scenes() -> None:
    values = np.random.default_rng(2).normal(30, 2, 400)
    few, many = (bootstrap_interval(values[:n]) for n in (25, 400))
    assert (many[1] - many[0]) == pytest.approx((few[1] - few[0]) / 4, rel=0.35)
    assert bootstrap_interval(values) == bootstrap_interval(values)
    assert bootstrap_interval(values) != bootstrap_interval(values, seed=1)


def test_what_is_unknown_is_left_out() -> None:
    assert bootstrap_interval([1.0, math.nan, 3.0]) == bootstrap_interval([1.0, 3.0])
    assert bootstrap_interval([1.0, math.nan]) is None
    assert bootstrap_interval([2.0, 2.0]) == (2.0, 2.0)


def test_a_small_steady_difference_shows_only_in_pairs() -> None:
    """Scenes differ far more than methods: the methods' own intervals overlap, that of their differences excludes 0."""
    rng = np.random.default_rng(3)
    theirs = rng.normal(28, 3, 30)
    ours = theirs + 0.3 + rng.normal(0, 0.2, 30)
    assert bootstrap_interval(ours)[0] < bootstrap_interval(theirs)[1]
    assert bootstrap_interval(ours - theirs)[0] > 0
    assert bootstrap_interval(rng.permutation(ours) - theirs)[0] < 0

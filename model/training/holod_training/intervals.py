"""How sure a mean over scenes is: bootstrap intervals."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

RESAMPLES = 2000
LEVEL = 0.95


def bootstrap_interval(values: Iterable[float], seed: int = 0) -> tuple[float, float] | None:
    """The percentile bootstrap's 95 % interval of the mean (Efron 1979), NaN left out; None for fewer than two values.

    With few scenes it is too narrow: of normal values it covers the mean 88 % of the time for 8, 93 % for 16.
    """
    known = np.array([v for v in values if not math.isnan(v)], dtype=np.float64)
    if len(known) < 2:
        return None
    draws = np.random.default_rng(seed).integers(0, len(known), (RESAMPLES, len(known)))
    tail = (1 - LEVEL) / 2
    low, high = np.quantile(known[draws].mean(axis=1), (tail, 1 - tail))
    return float(low), float(high)

"""How sure a mean over scenes is: Student's t, as `holod evaluate` has it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import cache

import numpy as np

LEVEL = 0.95


@cache
def t_quantile(degrees: int) -> float:
    """The t that |T| exceeds with probability 1 − LEVEL (Student 1908), by bisection of the integral."""
    scale = math.exp(math.lgamma((degrees + 1) / 2) - math.lgamma(degrees / 2)) / math.sqrt(degrees * math.pi)

    def inside(t: float) -> float:
        # x = √n·tan θ turns the density into cos^(n−1) θ, smooth on a finite stretch.
        theta = np.linspace(0, math.atan(t / math.sqrt(degrees)), 2001)
        return 2 * scale * math.sqrt(degrees) * float(np.trapezoid(np.cos(theta) ** (degrees - 1), theta))

    low, high = 0.0, 100.0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if inside(middle) < LEVEL else (low, middle)
    return (low + high) / 2


def interval_95(values: Iterable[float]) -> tuple[float, float] | None:
    """The 95 % interval of the mean, NaN left out; None for fewer than two values."""
    known = np.array([v for v in values if not math.isnan(v)], dtype=np.float64)
    if len(known) < 2:
        return None
    half = t_quantile(len(known) - 1) * float(known.std(ddof=1)) / math.sqrt(len(known))
    mean = float(known.mean())
    return mean - half, mean + half

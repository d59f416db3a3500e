"""What an evaluation is to judge; light to import, for the command line."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

from holod_training.config import require
from holod_training.judging import OURS
from holod_training.loss import option_of
from holod_training.solver import SolverConfig


@dataclass(frozen=True)
class EvaluateConfig:
    """`also`: further weights files, each a method. `solver_scenes`: direct optimisation runs on the first so many
    scenes from the field of the method `solver_start`, once for each of `solver_frames`; 0 leaves it out.
    `focus_curve_weights`: in-focus weights of the curve between sharp in focus and soft out of it, on the same
    scenes; none leaves it out. `judge_between`: methods, such as the solver, know every second focus, and all are
    judged at those between. `lpips_*`: files of LPIPS's weights, see `lpips.py`; both or none."""

    weights: Path
    test: Path
    out: Path
    cards: Path | None = None
    marks: Path | None = None
    rgbd: Path | None = None
    also: tuple[Path, ...] = ()
    limit: int | None = None
    border_px: int = 24
    solver: SolverConfig = field(default_factory=SolverConfig)
    solver_start: str = OURS
    solver_scenes: int = 2
    solver_frames: tuple[int, ...] = (1, 2)
    focus_curve_weights: tuple[float, ...] = ()
    judge_between: bool = False
    timing_calls: int = 5
    lpips_backbone: Path | None = None
    lpips_linear: Path | None = None

    def __post_init__(self) -> None:
        """Raises ConfigError for what cannot be judged."""
        require("--limit", self.limit, self.limit is None or self.limit >= 1, "at least 1 scene")
        require("--border-px", self.border_px, self.border_px >= 0, "at least 0")
        require("--solver-scenes", self.solver_scenes, self.solver_scenes >= 0, "at least 0")
        require("--solver-iterations", self.solver.iterations, self.solver.iterations >= 0, "at least 0")
        frames = self.solver_frames
        once = bool(frames) and len(set(frames)) == len(frames)
        require("--solver-frames", frames, once and min(frames) >= 1, "numbers of at least 1, each once")
        for term in ("focus", "in_focus"):
            weight = getattr(self.solver.loss, term)
            require(option_of(f"solver_{term}"), weight, 0 <= weight < math.inf, "a number of at least 0")
        weights = self.focus_curve_weights
        met = all(0 <= weight < math.inf for weight in weights)
        require("--focus-curve-weights", weights, met, "numbers of at least 0")
        require("--timing-calls", self.timing_calls, self.timing_calls >= 1, "at least 1")

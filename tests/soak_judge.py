"""Judges what `tests/soak` saw: figures and texts in, rows of what was judged out. Reads no clock, file or process."""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

MOST_GROWTH_MIB = 24.0
"""of resident memory in a third of the run, by its slope over the last two thirds: what the allocator keeps of engines
that were replaced comes and goes by about as much, so that an hour shows a leak of some 70 MiB an hour, and a day one
of 3"""
MOST_SLOWER = 1.3
"""times of the last third against those of the first: the machine does other things, too"""
MOST_STANDSTILL = 3
"""seconds without a new frame, in a whole run"""
MOST_SLOWED = 1.25
"""the median frame and its way to light with company against without, in the middle pair of turns"""
MOST_SLOWED_LONGEST = 2.0
"""the same of the 99th percentile"""
MOST_LATE = 0.02
"""share of frames that company makes late"""
LEAST_FRAMES_A_TURN = 20
POINTS = 300
"""of a slope; more of them say no more, and take the square of the time"""


class Row(NamedTuple):
    """What was judged, what was found, and whether that is right."""

    what: str
    found: str
    right: bool


@dataclass
class Sample:
    """What the process has, and how it does."""

    t_s: float
    rss_mib: float
    descriptors: int
    threads: int
    frames_shown: int
    frame_ms: float
    light_ms: float


@dataclass
class Turn:
    """One turn of a comparison: each frame's time, and its way from the tracker's sample to light."""

    company: bool
    frame_ms: list[float] = field(default_factory=list)
    light_ms: list[float] = field(default_factory=list)
    late: int = 0

    def late_share(self) -> float:
        return self.late / len(self.frame_ms)


@dataclass
class Fault:
    """One fault that was made, and what came of it."""

    name: str
    frames_before: int
    """shown in the second before it"""
    frames_meanwhile: int
    frames_after: int
    """shown while it lasted, and in the seconds after it was taken back"""
    expected: Sequence[str]
    """words of which one tells of it"""
    said: str
    """all that was said from its beginning on"""
    lives: bool = True


def slope(points: Sequence[tuple[float, float]]) -> float:
    """The median of the slopes between all pairs of points (Theil and Sen): a few jumps do not move it."""
    step = max(1, len(points) // POINTS)
    points = points[::step]
    slopes = [(b[1] - a[1]) / (b[0] - a[0]) for a, b in itertools.combinations(points, 2) if b[0] > a[0]]
    return statistics.median(slopes) if slopes else 0.0


def quantile(times: Sequence[float], share: float) -> float:
    return sorted(times)[int(share * (len(times) - 1))]


def judge_soak(
    samples: Sequence[Sample], summary: dict, quiet: Sample | None, first: Sample, done: dict[str, int]
) -> list[Row]:
    """Judges a run by its samples, its summary and what was done to it. `quiet` is from when all others had gone."""
    third = len(samples) // 3
    steady = samples[third:]
    growth_mib = slope([(s.t_s, s.rss_mib) for s in steady]) * (steady[-1].t_s - steady[0].t_s) / 2
    standstill = sum(b.frames_shown == a.frames_shown for a, b in itertools.pairwise(samples))
    memory = (
        f"{first.rss_mib:.0f} MiB at first, {samples[-1].rss_mib:.0f} at last; {growth_mib:+.1f} in a third of the run"
    )
    lasers = summary["lasers"]["unsafe_findings"]
    reloads = "WRONG RELOADS" not in done and "reloads" in done
    rows = [
        Row("memory", memory, growth_mib < MOST_GROWTH_MIB),
        Row(
            "frames",
            f"{samples[-1].frames_shown} shown; in {standstill} of {len(samples)} seconds none",
            standstill < MOST_STANDSTILL and samples[-1].frames_shown > samples[0].frames_shown,
        ),
        Row("records lost", str(summary["records_lost"]), summary["records_lost"] == 0),
        Row("recording lost", str(summary["tracker_records_lost"]), summary["tracker_records_lost"] == 0),
        Row("unsafe light", str(lasers), lasers == 0),
        Row("reloads", f"{done.get('reloads', 0)} as they should be", reloads),
        Row("lasers dark at the end", str(summary["lasers_dark_at_end"]), bool(summary["lasers_dark_at_end"])),
    ]
    for what, key in (("frame time", "frame_ms"), ("time to light", "light_ms")):
        early, late = (statistics.median(getattr(s, key) for s in part) for part in (samples[:third], samples[-third:]))
        # A run without light has no time to it.
        right = late <= MOST_SLOWER * early if early > 0 else late == 0
        rows.append(Row(what, f"{early:.1f} ms at first, {late:.1f} ms at last", right))
    for what in ("descriptors", "threads"):
        before, after = getattr(first, what), getattr(quiet, what) if quiet else -1
        rows.append(Row(what, f"{before} at first, {after} when all others are gone", 0 <= after <= before + 1))
    return rows


def judge_turns(turns: Sequence[Turn]) -> list[Row]:
    """Judges turns with and without company, in pairs, so that what the machine does besides takes no side."""
    alone = [turn for turn in turns if not turn.company]
    attached = [turn for turn in turns if turn.company]
    fewest = min((min(len(turn.frame_ms), len(turn.light_ms)) for turn in turns), default=0)
    enough = fewest >= LEAST_FRAMES_A_TURN and len(alone) == len(attached) > 0
    rows = [Row("frames", f"{fewest} at least in a turn, {len(alone)} pairs of turns", enough)]
    if not enough:
        return rows
    for what, key, share, most in (
        ("frame median", "frame_ms", 0.5, MOST_SLOWED),
        ("frame p99", "frame_ms", 0.99, MOST_SLOWED_LONGEST),
        ("to light median", "light_ms", 0.5, MOST_SLOWED),
        ("to light p99", "light_ms", 0.99, MOST_SLOWED_LONGEST),
    ):
        ratios = [
            quantile(getattr(b, key), share) / quantile(getattr(a, key), share)
            for a, b in zip(alone, attached, strict=True)
        ]
        ratio = statistics.median(ratios)
        found = f"{ratio:.2f} times as long with company, {min(ratios):.2f} to {max(ratios):.2f}"
        rows.append(Row(what, found, ratio <= most))
    more = statistics.median(b.late_share() - a.late_share() for a, b in zip(alone, attached, strict=True))
    rows.append(Row("late frames", f"{more:+.2%} with company", more <= MOST_LATE))
    return rows


def judge_fault(fault: Fault) -> Row:
    """Whether frames went on through a fault, and whether it was told."""
    told = next((words for words in fault.expected if words in fault.said), None)
    went_on = fault.frames_meanwhile > 0 and fault.frames_after > 0 and fault.frames_before > 0
    found = f"{fault.frames_before} frames before, {fault.frames_meanwhile} meanwhile, {fault.frames_after} after"
    if not fault.lives:
        found += "; holod has ended"
    if fault.expected:
        found += f"; told: `{told}`" if told else f"; NOT TOLD: none of {', '.join(fault.expected)}"
    return Row(fault.name, found, went_on and fault.lives and (told is not None or not fault.expected))


def tell(rows: Sequence[Row]) -> bool:
    """Prints the rows; whether all is right."""
    for what, found, right in rows:
        print(f"{'ok ' if right else 'BAD'}  {what:28} {found}")
    return all(row.right for row in rows)

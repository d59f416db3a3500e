"""The judge of tests/soak must find each thing that may be wrong, and nothing else."""

from __future__ import annotations

import dataclasses
import random

import pytest
from soak_judge import Fault, Sample, Turn, judge_fault, judge_soak, judge_turns, quantile, slope, tell

SUMMARY = {
    "records_lost": 0,
    "tracker_records_lost": 0,
    "lasers": {"unsafe_findings": 0},
    "lasers_dark_at_end": True,
}
DONE = {"reloads": 3}
FIRST = Sample(0.0, 200.0, 30, 12, 0, 8.0, 20.0)


def hour(**changes) -> list[Sample]:
    """A sample each second of an hour; `changes` are functions of the share of the hour that has gone by."""
    noise = random.Random(5)
    samples = []
    for second in range(1, 3601):
        sample = Sample(float(second), 210 + noise.uniform(-8, 8), 45, 17, 60 * second, 8.0 + noise.random(), 20.0)
        share = second / 3600
        figures = {key: getattr(sample, key) + change(share) for key, change in changes.items()}
        samples.append(dataclasses.replace(sample, **figures))
    return samples


def wrong(samples=None, summary=SUMMARY, quiet=FIRST, done=DONE) -> list[str]:
    return [row.what for row in judge_soak(samples or hour(), summary, quiet, FIRST, done) if not row.right]


def test_a_sound_hour_is_right():
    assert wrong() == []
    # An engine that was replaced leaves some memory for a while.
    assert wrong(hour(rss_mib=lambda share: 60.0 if 0.4 < share < 0.5 else 0.0)) == []


@pytest.mark.parametrize(
    ("what", "samples"),
    [
        ("memory", hour(rss_mib=lambda share: 100 * share)),
        ("frame time", hour(frame_ms=lambda share: 5 * share)),
        ("time to light", hour(light_ms=lambda share: 12 * share)),
        ("frames", [dataclasses.replace(s, frames_shown=min(s.frames_shown, 60 * 3590)) for s in hour()]),
        ("frames", [dataclasses.replace(s, frames_shown=0) for s in hour()]),
    ],
)
def test_what_drifts_or_stands_still_is_found(what, samples):
    assert wrong(samples) == [what]


@pytest.mark.parametrize(
    ("what", "change"),
    [
        ("records lost", {"records_lost": 1}),
        ("recording lost", {"tracker_records_lost": 1}),
        ("unsafe light", {"lasers": {"unsafe_findings": 1}}),
        ("lasers dark at the end", {"lasers_dark_at_end": False}),
    ],
)
def test_what_the_summary_tells_is_found(what, change):
    assert wrong(summary=SUMMARY | change) == [what]


def test_what_is_left_behind_is_found():
    assert wrong(quiet=dataclasses.replace(FIRST, descriptors=32)) == ["descriptors"]
    assert wrong(quiet=dataclasses.replace(FIRST, threads=14)) == ["threads"]
    assert wrong(quiet=None) == ["descriptors", "threads"]
    assert wrong(done={}) == ["reloads"]
    assert wrong(done={"reloads": 3, "WRONG RELOADS": 1}) == ["reloads"]


def test_a_slope_is_that_of_most_points():
    assert slope([(float(t), 3.0 * t) for t in range(1000)]) == pytest.approx(3.0)
    assert slope([(float(t), 3.0 * t + (500 if t == 40 else 0)) for t in range(100)]) == pytest.approx(3.0)
    assert slope([(1.0, 2.0)]) == 0.0
    assert quantile([3.0, 1.0, 2.0], 0.5) == 2.0


def turns(pairs: int = 6, slower: float = 1.0, tail: float = 1.0, light: float = 1.0, late: int = 0) -> list[Turn]:
    """Turns by turns on a machine that gets slower by itself all the while."""
    noise = random.Random(7)
    made = []
    for index in range(2 * pairs):
        company = index % 2 == 1
        by_itself = 1 + 0.02 * index
        frames = [by_itself * (8 + noise.random()) for _ in range(300)]
        if company:
            frames = [slower * ms for ms in frames]
            frames[:6] = [tail * ms for ms in frames[:6]]
        way = [by_itself * (20 + noise.random()) * (light if company else 1) for _ in range(300)]
        made.append(Turn(company, frames, way, late if company else 0))
    return made


def judged(made: list[Turn]) -> list[str]:
    return [row.what for row in judge_turns(made) if not row.right]


def test_company_that_costs_nothing_is_right():
    assert judged(turns()) == []


def test_company_that_costs_something_is_found():
    assert judged(turns(slower=1.4)) == ["frame median"]
    assert judged(turns(tail=3.0)) == ["frame p99"]
    assert judged(turns(light=1.4)) == ["to light median"]
    assert judged(turns(late=9)) == ["late frames"]


def test_too_few_frames_prove_nothing():
    assert judged([]) == ["frames"]
    assert judged(turns()[:-1]) == ["frames"]
    few = turns()
    few[3].frame_ms = few[3].frame_ms[:5]
    assert judged(few) == ["frames"]


GOOD = Fault("tracker unplugged", 60, 120, 90, ("tracker down", "not found"), "WARN degraded: tracker down, pupil 4.0")


def test_a_fault_that_was_told_and_stopped_nothing_is_right():
    assert judge_fault(GOOD).right
    assert judge_fault(dataclasses.replace(GOOD, expected=(), said="")).right, "nobody is there who could be told"


@pytest.mark.parametrize(
    "change",
    [
        {"said": "INFO running: tracker up"},
        {"frames_before": 0},
        {"frames_meanwhile": 0},
        {"frames_after": 0},
        {"lives": False},
    ],
)
def test_a_fault_that_was_not_told_or_stopped_something_is_found(change):
    assert not judge_fault(dataclasses.replace(GOOD, **change)).right


def test_one_wrong_row_is_a_wrong_run(capsys):
    assert tell([judge_fault(GOOD)])
    assert not tell([judge_fault(GOOD), judge_fault(dataclasses.replace(GOOD, said=""))])
    assert "BAD  tracker unplugged" in capsys.readouterr().out

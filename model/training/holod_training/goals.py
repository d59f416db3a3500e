"""What weights must reach, after double phase, and whether they did."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from holod_training.config import OpticsConfig
from holod_training.shards import DEFAULT_BENCH, same_bench, same_focuses

Check = tuple[str, str, str, bool]
"""(what, found, wanted, passed)."""

GOALS = {
    2.0: {"psnr_db": 27.3, "psnr_in_focus_db": 24.9, "slope": 0.50},
    3.0: {"psnr_db": 26.0, "psnr_in_focus_db": 24.8, "slope": 0.47},
    4.0: {"psnr_db": 25.1, "psnr_in_focus_db": 24.8, "slope": 0.43},
}
"""Of `standard` on the default bench, on the card's six scenes at eleven focuses that it never saw."""
GOALS_SCENES = "the default bench's scenes 300 to 305 of seed 9001, 256x256 at eleven focuses, without 24 px of border"
GOALS_SEED, GOALS_NUMBERS = "9001", [300, 301, 302, 303, 304, 305]
GOALS_SIZE, GOALS_BORDER_PX = [256, 256], 24
GOALS_FOCUS_DPT = [DEFAULT_BENCH.dioptres(k / 10) for k in range(11)]
BEHIND_DB = {"small": 0.15, "fast": 0.6}
"""By how much other networks may be behind on the same scenes, over all and in focus."""
REFOCUS_RATIO = 2.0
"""On the default bench."""
LIGHT_RATIO = (0.8, 1.2)
DARK_MEAN = 0.0005
FOAM = {2.0: 0.00093, 3.0: 0.00133, 4.0: 0.00159}
"""Half of what `standard-10` of the model card's recipe has on the card's scenes."""
OVER_RIVAL_DB, OVER_RIVAL_WHERE_DIFFRACTION_IS_MORE_DB = 4.0, 3.0
MORE_DIFFRACTION_PX2 = 100.0
"""Green's λ·(f/p)²·V from which on the second of these is asked for: on the bench `gaea-40` alone."""
BELOW_RIVAL_IN_FOCUS_DB = 0.2
REFOCUS_RATIO_OF_ANY_BENCH = 1.8
LABELS = {
    "psnr_db": "PSNR, dB,",
    "psnr_in_focus_db": "PSNR in focus, dB,",
    "slope": "slope",
}


class ReportError(ValueError):
    """An evaluation whose parts do not belong together."""


def find_row(result: dict[str, Any], method: str, stage: str, pupil_mm: float) -> dict[str, Any] | None:
    for row in result["rows"]:
        if (row["method"], row["double_phase"], row["pupil_mm"]) == (method, stage, pupil_mm):
            return dict(row)
    return None


def row_of(result: dict[str, Any], method: str, stage: str, pupil_mm: float) -> dict[str, Any]:
    row = find_row(result, method, stage, pupil_mm)
    if row is None:
        raise KeyError(f"no row for {method}, {stage} double phase, s = {pupil_mm} mm")
    return row


def require_one_set_of_pupils(result: dict[str, Any]) -> None:
    """Raises ReportError where our rows or the matrix belong to other pupils than `pupils_mm` and `all_pupils_mm`."""
    stated, every = result["pupils_mm"], result["all_pupils_mm"]
    found = sorted({row["pupil_mm"] for row in result["rows"]})
    if found != every or not set(stated) <= set(every):
        raise ReportError(f"evaluation: rows are for s = {found} mm, but it states {every} and tables of {stated}")
    for row in result["rows"]:
        if row["method"] == "holod" and row["scenes"] != result["scenes"]:
            raise ReportError(
                f"evaluation: s = {row['pupil_mm']} mm was judged on {row['scenes']} scenes, it states "
                f"{result['scenes']}"
            )
    for stage, matrix in result["matrix_psnr_db"].items():
        if [len(line) for line in matrix] != [len(stated)] * len(stated):
            raise ReportError(f"evaluation: the matrix {stage} double phase is not {len(stated)} by {len(stated)}")


def checks(result: dict[str, Any]) -> list[Check]:
    """Every goal that the evaluation's scenes, pupils, networks, cards and marks allow to judge."""
    of_the_scenes = [*_numbers(result), *_others(result)] if on_the_goals_scenes(result) else []
    return [*of_the_scenes, *_right_pupil(result), *_refocus(result), *_marks(result)]


def on_the_goals_scenes(result: dict[str, Any]) -> bool:
    """Whether the evaluation is of `GOALS_SCENES`: what is wanted in dB, slope and foam holds for these alone."""
    return (
        _on_default_bench(result)
        and result["numbers_of_seed"] == {GOALS_SEED: GOALS_NUMBERS}
        and (result["size"], result["border_px"]) == (GOALS_SIZE, GOALS_BORDER_PX)
        and same_focuses(result["focus_dpt"], GOALS_FOCUS_DPT)
    )


def _on_default_bench(result: dict[str, Any]) -> bool:
    return same_bench(OpticsConfig(**result["optics"]), DEFAULT_BENCH)


def right_pupil_margins_db(matrix: list[list[float]]) -> list[float]:
    """For each judged pupil, the columns of PSNR(given, judged), by how much the same given one is ahead of the best
    other; none of a single pupil."""
    others = range(len(matrix))
    return [
        row[judged] - max(matrix[given][judged] for given in others if given != judged)
        for judged, row in enumerate(matrix)
        if len(matrix) > 1
    ]


def bench_checks(bench: dict[str, Any], method: str) -> list[Check]:
    """The goals of one network on one bench of `across-benches`, each by the least of its pupils."""
    over, in_focus = (
        [gain[key]["mean"] for gain in bench["gain_over_rival"][method] if key in gain]
        for key in ("psnr_db", "psnr_in_focus_db")
    )
    margins = right_pupil_margins_db(bench["matrix_psnr_db"][method])
    ratios = [min(row["near_card"], row["far_card"]) for row in bench.get("refocus", []) if row["method"] == method]
    diffracts = sorted(bench["volume_fresnel_px2"])[1] > MORE_DIFFRACTION_PX2
    least = OVER_RIVAL_WHERE_DIFFRACTION_IS_MORE_DB if diffracts else OVER_RIVAL_DB
    found = [
        ("over smooth phase, dB", over, least, "+.2f"),
        ("in focus over smooth phase, dB", in_focus, -BELOW_RIVAL_IN_FOCUS_DB, "+.2f"),
        ("right pupil ahead by, dB", margins, 0.0, "+.2f"),
        ("refocus ratio", ratios, REFOCUS_RATIO_OF_ANY_BENCH, ".2f"),
    ]
    return [
        (what, f"{min(values):{digits}}", f"at least {wanted:g}", min(values) >= wanted)
        for what, values, wanted, digits in found
        if values
    ]


def _at_least(what: str, found: float, wanted: float) -> Check:
    return what, f"{found:.3f}", f"at least {wanted:g}", found >= wanted


def _numbers(result: dict[str, Any]) -> Iterator[Check]:
    for pupil, wanted in GOALS.items():
        if pupil not in result["pupils_mm"]:
            continue
        row = row_of(result, "holod", "after", pupil)
        at = f"at s = {pupil:g} mm"
        for key, least in wanted.items():
            yield _at_least(f"{LABELS[key]} {at}", row.get(key, math.nan), least)
        if "foam" in row:
            most = FOAM[pupil]
            yield f"foam, thousandths, {at}", f"{1e3 * row['foam']:.2f}", f"at most {1e3 * most:g}", row["foam"] <= most


def _others(result: dict[str, Any]) -> Iterator[Check]:
    names = {row["method"] for row in result["networks"]}
    for name, most in BEHIND_DB.items():
        for pupil in GOALS:
            if name not in names or pupil not in result["pupils_mm"]:
                continue
            ours, other = (row_of(result, method, "after", pupil) for method in ("holod", name))
            for key, where in (("psnr_db", "over all"), ("psnr_in_focus_db", "in focus")):
                behind = ours.get(key, math.nan) - other.get(key, math.nan)
                what = f"{name} behind {where}, dB, at s = {pupil:g} mm"
                yield what, f"{behind:.3f}", f"at most {most:g}", behind <= most


def _right_pupil(result: dict[str, Any]) -> Iterator[Check]:
    margins = right_pupil_margins_db(result["matrix_psnr_db"]["after"])
    for pupil, margin in zip(result["pupils_mm"], margins, strict=False):
        yield _at_least(f"right pupil ahead by, dB, judged s = {pupil:g} mm", margin, 0.0)


def _refocus(result: dict[str, Any]) -> Iterator[Check]:
    least = REFOCUS_RATIO if _on_default_bench(result) else REFOCUS_RATIO_OF_ANY_BENCH
    for row in result.get("refocus", []):
        if row["method"] == "holod":
            for card in ("near_card", "far_card"):
                what = f"refocus ratio, {card.replace('_', ' ')}, {row['contrast']}, s = {row['pupil_mm']:g} mm"
                yield _at_least(what, row[card], least)


def _marks(result: dict[str, Any]) -> Iterator[Check]:
    rows = [row for row in result.get("marks", []) if row["double_phase"] == "after"]
    for method, marks in dict.fromkeys((row["method"], row["marks"]) for row in rows):
        if method not in ("holod", *BEHIND_DB):
            continue
        of = [row for row in rows if (row["method"], row["marks"]) == (method, marks)]
        pupils = [row["pupil_mm"] for row in of]
        at = f"of {marks}, {method}, s = {min(pupils):g} to {max(pupils):g} mm"
        light, (least, most) = [row["light_ratio"] for row in of], LIGHT_RATIO
        within = least <= min(light) and max(light) <= most
        yield f"light {at}", f"{min(light):.2f} to {max(light):.2f}", f"{least:g} to {most:g}", within
        dark = max(row["dark_mean"] for row in of)
        yield f"light on black {at}", f"{dark:.6f}", f"at most {DARK_MEAN:g}", dark <= DARK_MEAN

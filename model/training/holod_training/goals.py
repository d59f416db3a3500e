"""What weights must reach, after double phase, and whether they did."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

Check = tuple[str, str, str, bool]
"""(what, found, wanted, passed)."""

GOALS = {
    2.0: {"psnr_db": 30.0, "psnr_in_focus_db": 30.5, "slope": 0.50, "correlation": 0.75},
    3.0: {"psnr_db": 28.2, "psnr_in_focus_db": 28.5, "slope": 0.42, "correlation": 0.68},
    4.0: {"psnr_db": 26.8, "psnr_in_focus_db": 28.0, "slope": 0.35, "correlation": 0.62},
}
"""For 512x512."""
PAPER_PSNR_DB = {2.0: 34.0, 3.0: 32.2, 4.0: 30.7}
"""What the paper reports at 1920x1080 on scenes of its own."""
PAPER_SIZE = [1080, 1920]
OVER_FLAT_ORACLE_DB = 1.0
DOUBLE_PHASE_DB = 0.3
MATRIX_TOLERANCE_DB = 0.0
CORNER_DB = 1.0
REFOCUS_RATIO = 2.0
LABELS = {
    "psnr_db": "PSNR, dB,",
    "psnr_in_focus_db": "PSNR in focus, dB,",
    "slope": "slope",
    "correlation": "correlation",
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
    """Every goal that the evaluation's pupils allow to judge."""
    return [*_numbers(result), *_matrix(result), *_refocus(result)]


def _at_least(what: str, found: float, wanted: float) -> Check:
    return what, f"{found:.3f}", f"at least {wanted:g}", found >= wanted


def _numbers(result: dict[str, Any]) -> Iterator[Check]:
    for pupil, wanted in GOALS.items():
        if pupil not in result["pupils_mm"]:
            continue
        row, before = row_of(result, "holod", "after", pupil), row_of(result, "holod", "before", pupil)
        at = f"at s = {pupil:g} mm"
        for key, least in wanted.items():
            yield _at_least(f"{LABELS[key]} {at}", row.get(key, math.nan), least)
        if result["size"] == PAPER_SIZE:
            yield _at_least(f"the paper's PSNR, dB, {at}", row["psnr_db"], PAPER_PSNR_DB[pupil])
        margin = row["psnr_db"] - row_of(result, "flat oracle", "before", pupil)["psnr_db"]
        yield _at_least(f"over the flat oracle, dB, {at}", margin, OVER_FLAT_ORACLE_DB)
        cost = before["psnr_db"] - row["psnr_db"]
        yield f"double phase costs, dB, {at}", f"{cost:.3f}", f"at most {DOUBLE_PHASE_DB}", abs(cost) <= DOUBLE_PHASE_DB


def _matrix(result: dict[str, Any]) -> Iterator[Check]:
    matrix, pupils = result["matrix_psnr_db"]["after"], result["pupils_mm"]
    for column, pupil in enumerate(pupils):
        behind = max(row[column] for row in matrix) - matrix[column][column]
        what = f"right s behind the best, dB, judged s = {pupil:g} mm"
        yield what, f"{behind:.3f}", f"at most {MATRIX_TOLERANCE_DB}", behind <= MATRIX_TOLERANCE_DB
    last = len(pupils) - 1
    for column in (0, last) if last else ():
        margin = matrix[column][column] - matrix[last - column][column]
        yield _at_least(f"right over opposite s, dB, judged s = {pupils[column]:g} mm", margin, CORNER_DB)


def _refocus(result: dict[str, Any]) -> Iterator[Check]:
    for row in result.get("refocus", []):
        if row["method"] == "holod":
            for card in ("near_card", "far_card"):
                what = f"refocus ratio, {card.replace('_', ' ')}, {row['contrast']}, s = {row['pupil_mm']:g} mm"
                yield _at_least(what, row[card], REFOCUS_RATIO)

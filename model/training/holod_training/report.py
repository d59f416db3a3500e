"""The evaluation as Markdown."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from holod_training.export import write_beside
from holod_training.goals import (
    GOALS_SCENES,
    ReportError,
    checks,
    find_row,
    on_the_goals_scenes,
    require_one_set_of_pupils,
    row_of,
)
from holod_training.judging import OURS, PICTURES

NUMBERS = (
    ("psnr_db", "PSNR dB", 2),
    ("psnr_in_focus_db", "in focus", 2),
    ("psnr_out_of_focus_db", "out of focus", 2),
    ("slope", "slope", 3),
    ("correlation", "correlation", 3),
    ("ssim", "SSIM", 3),
    ("foam", "foam", 5),
)
LPIPS = ("lpips", "LPIPS", 4)
PAIRED = NUMBERS[:4]
PLOTS = {
    "pupils": "PSNR and slope against the pupil",
    "focus_curve": "sharp in focus against right over all",
    "offsets": "how far the adjustable layers reach",
    "capacity": "quality against capacity",
    "run_time": "quality against run time",
}


LINE = 100


def prose(text: str) -> str:
    """In lines of the pages' length; no name is broken at its hyphens."""
    return textwrap.fill(text, LINE, break_on_hyphens=False, break_long_words=False)


def markdown(result: dict[str, Any]) -> str:
    """Raises ReportError where the evaluation's parts do not belong together."""
    require_one_set_of_pupils(result)
    parts = [_opening, _numbers, _paired, _matrix, _refocus, _marks, _costs, _double_phase, _plots, _goals]
    return "\n\n".join("\n".join(lines) for part in parts if (lines := part(result))) + "\n"


def rewrite(folder: Path, pages: dict[str, Callable[[dict[str, Any]], str]]) -> list[Path]:
    """Writes NAME.md from NAME.json for each of `pages` that is there; returns what was written. Raises ReportError."""
    found = {name: path for name in pages if (path := folder / f"{name}.json").is_file()}
    if not found:
        raise ReportError(f"{folder}: found neither {' nor '.join(f'{name}.json' for name in pages)}")
    written = []
    for name, path in found.items():
        try:
            text = pages[name](json.loads(path.read_text()))
        except (UnicodeDecodeError, json.JSONDecodeError, KeyError, TypeError, AttributeError) as error:
            raise ReportError(f"{path}: no figures to report of ({error!r}); write them again") from error
        write_beside(path.with_suffix(".md"), text.encode())
        written.append(path.with_suffix(".md"))
    return written


def _opening(result: dict[str, Any]) -> list[str]:
    height, width = result["size"]
    solver = result["solver"]
    between = solver["focus_dpt"] != result["focus_dpt"]
    planes = (
        f"{len(result['focus_dpt'])} focal planes between the {len(solver['focus_dpt'])} that methods may know"
        if between
        else f"all {len(result['focus_dpt'])} focal planes"
    )
    optimised = (
        f" Rows named optimised: Adam on each field, {solver['iterations']} iterations from {solver['start']}'s, with "
        f"the target known{' where methods may know it' if between else ''}, only on as many scenes as their row says."
        if solver["scenes"]
        else ""
    )
    own = {row["method"]: row.get("amplitude_constant", result["amplitude_constant"]) for row in result["networks"]}
    other = [f"{name}: {constant}" for name, constant in own.items() if constant != result["amplitude_constant"]]
    others = f" ({', '.join(other)})" if other else ""
    outside = [
        f"Not what {row['method']} is for: {told}."
        for row in result["networks"]
        if (told := row.get("outside_training"))
    ]
    return [
        f"# Evaluation of {result['weights']}",
        "",
        prose(
            f"{result['date']}: {result['scenes']} held-out scenes of {width}x{height}, "
            f"{planes}, a border of {result['border_px']} px left out; linear light, peak 1; means over "
            f"scenes, in brackets their 95 % interval (Student's t). Amplitude constant {result['amplitude_constant']}"
            f"{others}. Slope and correlation: P_k − mean_k P against R_k − mean_k R (1 = the target's full refocus, "
            "0 = one picture at all depths). In focus: CoC < 2 px; out of focus: CoC > 8 px. Foam: mean energy of "
            "structure of 4 to 16 px out of focus that the target does not have there; less is better. Everything is "
            f"after double phase.{optimised} Two rows are no holograms: the flat oracle is the target's mean at every "
            "focus, RGB-D blur is what a simple incoherent display would show that knows the picture and its depth "
            "alone, and guesses nothing that is hidden."
        ),
        *(line for told in outside for line in ("", prose(told))),
    ]


def _numbers(result: dict[str, Any]) -> list[str]:
    lines = ["## Methods", ""]
    numbers: tuple[tuple[str, str, int], ...] = NUMBERS
    if any("lpips" in row for row in result["rows"]):
        lines += ["LPIPS: AlexNet's, of sRGB pictures, mean over the focal planes; less is better.", ""]
        numbers = (*NUMBERS, LPIPS)
    lines += _header(["s mm", "method", "scenes", *(label for _, label, _ in numbers)])
    for pupil in result["pupils_mm"]:
        for method in _methods(result):
            row = find_row(result, method, "before" if method in PICTURES else "after", pupil)
            if row:
                cells = [_with_interval(row, row["interval_95"], key, digits) for key, _, digits in numbers]
                lines.append(_line([f"{pupil:g}", method, row["scenes"], *cells]))
    return lines


def _paired(result: dict[str, Any]) -> list[str]:
    lines = [
        "## Ours less each other, scene by scene",
        "",
        prose(
            "Means of the differences on the scenes that both were judged on; an interval without 0 is a difference "
            "that scenes alone hardly make."
        ),
        "",
    ]
    paired = {row["method"] for row in result["paired"]}
    if means_alone := [name for name in _methods(result) if name not in (OURS, *paired)]:
        kept = "Of an evaluation before this one, of which means alone were kept, and so without differences"
        lines += [prose(f"{kept}: {'; '.join(means_alone)}."), ""]
    lines += _header(["s mm", "against", "scenes", *(label for _, label, _ in PAIRED)])
    for pupil in result["pupils_mm"]:
        for method in _methods(result):
            for row in result["paired"]:
                if (row["method"], row["pupil_mm"]) == (method, pupil):
                    cells = [
                        _with_interval(row["difference"], row["interval_95"], key, digits, "+")
                        for key, _, digits in PAIRED
                    ]
                    lines.append(_line([f"{pupil:g}", method, row["scenes"], *cells]))
    return lines


def _matrix(result: dict[str, Any]) -> list[str]:
    lines = ["## Given pupil, judged pupil", "", "PSNR in dB, given s in rows, judged s in columns.", ""]
    lines += _header(["given", *(f"{p:g}" for p in result["pupils_mm"])])
    for pupil, values in zip(result["pupils_mm"], result["matrix_psnr_db"]["after"], strict=True):
        lines.append(_line([f"{pupil:g}", *(f"{v:.2f}" for v in values)]))
    return lines


def _refocus(result: dict[str, Any]) -> list[str]:
    if "refocus" not in result:
        return []
    rows = result["refocus"]
    pupils = sorted({row["pupil_mm"] for row in rows})
    lines = [
        "## Refocus ratio",
        "",
        prose(
            "Gradient energy of a card in focus over out of focus; near card at 7/8 of the depth range in dioptres, "
            "far card at 7/80 (default bench: 2.5 and 0.25 dpt)."
        ),
        "",
    ]
    lines += _header(["method", "marks", "card", *(f"s = {p:g}" for p in pupils)])
    by_key = {(row["method"], row["contrast"], row["pupil_mm"]): row for row in rows}
    for method, contrast in dict.fromkeys((row["method"], row["contrast"]) for row in rows):
        for card in ("near", "far"):
            found = [by_key.get((method, contrast, p), {}).get(f"{card}_card") for p in pupils]
            lines.append(_line([method, contrast, card, *("-" if v is None else f"{v:.2f}" for v in found)]))
    return lines


def _marks(result: dict[str, Any]) -> list[str]:
    if "marks" not in result:
        return []
    rows = result["marks"]
    pupils = sorted({row["pupil_mm"] for row in rows})
    lines = [
        "## Bright marks on exact black",
        "",
        prose(
            "All light that is seen over what was put in, before and after double phase, and the mean light after it, "
            "in thousandths of white, more than 16 px from where any should be."
        ),
        "",
    ]
    lines += _header(["marks", "method", *(f"s = {p:g}" for p in pupils)])
    by_key = {(row["marks"], row["method"], row["double_phase"], row["pupil_mm"]): row for row in rows}
    for marks, method in dict.fromkeys((row["marks"], row["method"]) for row in rows):
        cells = []
        for pupil in pupils:
            before, after = (by_key[marks, method, stage, pupil] for stage in ("before", "after"))
            ratios = f"{before['light_ratio']:.2f} → {after['light_ratio']:.2f}"
            cells.append(f"{ratios}, {1e3 * after['dark_mean']:.3f}")
        lines.append(_line([marks, method, *cells]))
    return lines


def _costs(result: dict[str, Any]) -> list[str]:
    lines = [
        "## Costs",
        "",
        prose(
            f"Time for one field at s = {result['run_time']['pupil_mm']:g} mm, all methods in turn in this run, median "
            "of the calls, as ratio to ours: one thread's CPU time, or wall time on a GPU. Operations: convolutions, "
            "matrix products (two a multiply-add), bilinear taps and FFTs."
        ),
        "",
    ]
    networks = {row["method"]: row for row in result["networks"]}
    lines += _header(["method", "time / ours", "calls", "parameters", "operations a pixel"])
    for row in result["run_time"]["rows"]:
        network = networks.get(row["method"])
        capacity = [f"{network['parameters']:,}", f"{network['operations_per_px']:,.0f}"] if network else ["-", "-"]
        lines.append(_line([row["method"], f"{row['ratio_to_ours']:.3g}", row["calls"], *capacity]))
    return lines


def _double_phase(result: dict[str, Any]) -> list[str]:
    costs, shares = [], []
    for pupil in result["pupils_mm"]:
        before, after = (row_of(result, "holod", stage, pupil)["psnr_db"] for stage in ("before", "after"))
        costs.append(f"{before - after:.3f} dB at s = {pupil:g}")
    for row in result["clipped_share"]:
        if row["method"] == "holod" and row["pupil_mm"] in result["pupils_mm"]:
            shares.append(f"{100 * row['share']:.4f} % at s = {row['pupil_mm']:g}")
    quantiles = ", ".join(f"{q}: {v:.3f}" for q, v in result["amplitude_quantiles"].items())
    return [
        "## Double phase",
        "",
        prose(
            f"It costs ours {', '.join(costs)} mm. Clipped pixels: {', '.join(shares)} mm. Quantiles of the field's "
            f"amplitude: {quantiles}."
        ),
    ]


def _plots(result: dict[str, Any]) -> list[str]:
    if not result["plots"]:
        return []
    return ["## Plots", "", *(f"- [{PLOTS[name]}]({name}.png)" for name in result["plots"])]


def _goals(result: dict[str, Any]) -> list[str]:
    lines = ["## Goals", ""]
    if not on_the_goals_scenes(result):
        set_for = f"What is wanted in dB, slope and foam was set for {GOALS_SCENES}; these are others."
        lines += [prose(f"{set_for} So only what is wanted on any scenes is asked for here."), ""]
    lines += _header(["what", "found", "wanted", ""])
    return lines + [
        _line([what, found, wanted, "yes" if ok else "**no**"]) for what, found, wanted, ok in checks(result)
    ]


def _methods(result: dict[str, Any]) -> list[str]:
    """In the order in which they were judged, what has no hologram last."""
    names = dict.fromkeys(row["method"] for row in result["rows"])
    return [*(name for name in names if name not in PICTURES), *(name for name in PICTURES if name in names)]


def _with_interval(
    values: dict[str, float], intervals: dict[str, list[float]], key: str, digits: int, sign: str = ""
) -> str:
    if key not in values:
        return "-"
    mean = f"{values[key]:{sign}.{digits}f}"
    if key not in intervals:
        return mean
    fewer = digits - 1
    return f"{mean} [{', '.join(f'{end:{sign}.{fewer}f}' for end in intervals[key])}]"


def _header(cells: list[str]) -> list[str]:
    return [_line(cells), "|---" * len(cells) + "|"]


def _line(cells: Iterable[Any]) -> str:
    return f"| {' | '.join(str(cell) for cell in cells)} |"

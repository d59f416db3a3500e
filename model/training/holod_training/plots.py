"""Plots of an evaluation, drawn from what evaluation.json holds."""

from __future__ import annotations

import io
import itertools
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure

from holod_training.export import write_beside
from holod_training.judging import FLAT_ORACLE, PICTURES, RGBD_BLUR

MARKERS = "osD^vPX*<>"
# Colour, marker and line.
FIXED_STYLES = {
    "holod": ("#0b5fa5", "o", "-"),
    "small": ("#3d9be9", ">", "--"),
    "fast": ("#64b5d9", "<", "-."),
    "all-in-focus": ("tab:brown", "v", "-"),
    "layered ASM": ("tab:orange", "s", "-"),
    "smooth phase": ("tab:green", "P", "-"),
    "transport of intensity": ("tab:purple", "D", "-"),
    "optimised, 1 frame": ("tab:pink", "^", "-"),
    "optimised, 2 frames": ("0.1", "^", "-"),
    RGBD_BLUR: ("0.6", "", ":"),
    FLAT_ORACLE: ("0.45", "", "--"),
}
FAMILY_COLOURS = ("#b3202c", "tab:olive", "k", "#c2479b", "#12806a", "#7a5c00")
DEPTH_MARKERS = "*Xdph8"
# How much white the last depth of a family has.
MOST_LIGHTER = 0.5
# Line and marker's filling.
LOSS_LINES = (("-", "full"), ("--", "none"), (":", "left"), ("-.", "bottom"))
DPI = 110


def write_plots(out: Path, result: dict[str, Any]) -> list[str]:
    """Each plot for which the result has the data, into NAME.png of `out`; returns the names."""
    drawn = {
        "pupils": pupil_plot(result) if len(result["all_pupils_mm"]) > 1 else None,
        "focus_curve": focus_curve_plot(result["focus_curve"]) if "focus_curve" in result else None,
        "offsets": offset_plot(result["offsets"]) if result["offsets"] else None,
        "capacity": capacity_plot(result) if len(result["networks"]) > 1 else None,
        "run_time": run_time_plot(result),
    }
    for name, figure in drawn.items():
        if figure:
            buffer = io.BytesIO()
            figure.savefig(buffer, dpi=DPI, format="png")
            plt.close(figure)
            write_beside(out / f"{name}.png", buffer.getvalue())
    return [name for name, figure in drawn.items() if figure]


def pupil_plot(result: dict[str, Any]) -> Figure:
    """PSNR and slope after double phase against s (the paper's figure 16), ours with its 95 % interval."""
    figure, axes = plt.subplots(1, 2, figsize=(10, 5), layout="constrained")
    styles = _styles(_on_every_scene(result))
    for ax, key, label in zip(axes, ("psnr_db", "slope"), ("PSNR, dB", "focus slope"), strict=True):
        for method, style in styles.items():
            rows = _shown_rows(result, method)
            ax.plot([r["pupil_mm"] for r in rows], [r[key] for r in rows], ms=5.5, **style, label=method)
            if method == "holod" and all(key in r["interval_95"] for r in rows):
                ends = list(zip(*(r["interval_95"][key] for r in rows), strict=True))
                ax.fill_between([r["pupil_mm"] for r in rows], *ends, color=style["color"], alpha=0.15, lw=0)
        _label(ax, "pupil s, mm", label)
        ax.set_xticks(sorted({round(p) for p in result["all_pupils_mm"]}))
    # Room for a whole period of each broken line.
    _legend(figure, axes[0], handlelength=4.0)
    return figure


def focus_curve_plot(curve: dict[str, Any]) -> Figure:
    """PSNR in focus against PSNR over all: the solver's optima joined in the order of their weights, methods beside."""
    pupils = sorted({row["pupil_mm"] for row in curve["solver"]})
    figure, axes = plt.subplots(
        1,
        len(pupils),
        figsize=(1.5 + 3.3 * len(pupils), 4),
        layout="constrained",
        squeeze=False,
        sharex=True,
        sharey=True,
    )
    styles = _styles(dict.fromkeys(row["method"] for row in curve["methods"]))
    scenes = curve["solver"][0]["scenes"]
    label = f"optimised, 1 frame, by in-focus\nweight (all on {scenes} scene{'s' if scenes > 1 else ''})"
    for ax, pupil in zip(axes[0], pupils, strict=True):
        rows = [r for r in curve["solver"] if r["pupil_mm"] == pupil]
        x, y = [r["psnr_db"] for r in rows], [r["psnr_in_focus_db"] for r in rows]
        ax.plot(x, y, "k.-", lw=1, label=label)
        for row in rows:
            at = (row["psnr_db"], row["psnr_in_focus_db"])
            ax.annotate(f"{row['in_focus_weight']:g}", at, (-5, 0), textcoords="offset points", fontsize=7, ha="right")
        for row in curve["methods"]:
            if row["pupil_mm"] == pupil:
                style = {**styles[row["method"]], "ls": ""}
                ax.plot(row["psnr_db"], row["psnr_in_focus_db"], ms=6, **style, label=row["method"])
        ax.set_title(f"s = {pupil:g} mm", fontsize=10)
        _label(ax, "PSNR over all, dB", "PSNR in focus, dB" if ax is axes[0][0] else "")
        ax.margins(0.12)
    _legend(figure, axes[0][0])
    return figure


def offset_plot(rows: list[dict[str, Any]]) -> Figure:
    """Mean offset length by depth interval, a bar of one standard deviation either way, one line a pupil."""
    layers = list(dict.fromkeys(row["layer"] for row in rows))
    pupils = [p for p in sorted({row["pupil_mm"] for row in rows}) if p == round(p)] or sorted(
        {row["pupil_mm"] for row in rows}
    )
    figure, axes = plt.subplots(
        1, len(layers), figsize=(1.5 + 4.5 * len(layers), 4), layout="constrained", squeeze=False
    )
    for ax, layer in zip(axes[0], layers, strict=True):
        for k, (colour, pupil) in enumerate(zip(_sequence(len(pupils)), pupils, strict=True)):
            chosen = [r for r in rows if (r["layer"], r["pupil_mm"]) == (layer, pupil)]
            width = chosen[0]["to_dpt"] - chosen[0]["from_dpt"]
            shift = width * 0.12 * (k - (len(pupils) - 1) / 2)
            ax.errorbar(
                [(r["from_dpt"] + r["to_dpt"]) / 2 + shift for r in chosen],
                [r["mean_px"] for r in chosen],
                [r["deviation_px"] for r in chosen],
                fmt="o-",
                ms=4,
                lw=1,
                capsize=2,
                color=colour,
                label=f"s = {pupil:g} mm",
            )
        for edge in sorted({r["from_dpt"] for r in rows} | {r["to_dpt"] for r in rows}):
            ax.axvline(edge, color="0.85", lw=0.8, zorder=0)
        ax.set_title(f"adjustable layer {layer.removeprefix('layers.')}", fontsize=10)
        _label(ax, "depth, dpt (far to near)", "offset, panel px: mean ± deviation" if ax is axes[0][0] else "")
        ax.grid(visible=False, axis="x")
    _legend(figure, axes[0][0])
    return figure


def capacity_plot(result: dict[str, Any]) -> Figure:
    """PSNR after double phase against parameters and operations a pixel (the paper's figure 15): colours are pupils,
    markers networks."""
    figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained", sharey=True)
    pupils = [p for p in result["pupils_mm"] if p in (2.0, 3.0, 4.0)] or result["pupils_mm"][-1:]
    labels = {"parameters": "parameters, thousands", "operations_per_px": "operations a pixel, thousands"}
    for ax, (key, label) in zip(axes, labels.items(), strict=True):
        for network, marker in zip(result["networks"], itertools.cycle(MARKERS)):
            for colour, pupil in zip(_sequence(len(pupils)), pupils, strict=True):
                psnr_db = _row(result, network["method"], pupil)["psnr_db"]
                ax.plot(network[key] / 1e3, psnr_db, marker, ms=6, color=colour)
            ax.plot([], [], marker, color="k", label=network["method"])
        for colour, pupil in zip(_sequence(len(pupils)), pupils, strict=True):
            ax.plot([], [], "s", color=colour, label=f"s = {pupil:g} mm")
        _label(ax, label, "PSNR, dB" if ax is axes[0] else "")
        ax.margins(0.15)
    _legend(figure, axes[0])
    return figure


def run_time_plot(result: dict[str, Any]) -> Figure:
    """PSNR and slope after double phase against run time over ours, at the pupil that was timed."""
    figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    timed = result["run_time"]
    styles = _styles(row["method"] for row in timed["rows"])
    for ax, key, label in zip(axes, ("psnr_db", "slope"), ("PSNR, dB", "focus slope"), strict=True):
        for row in timed["rows"]:
            value = on_all_scenes(result, row["method"], timed["pupil_mm"], key)
            style = {**styles[row["method"]], "ls": ""}
            ax.plot(row["ratio_to_ours"], value, ms=7, **style, label=_with_scenes(result, row["method"]))
        ax.set_xscale("log")
        ax.xaxis.set_major_formatter("{x:g}")
        _label(ax, "time / ours (log scale)", f"{label} at s = {timed['pupil_mm']:g} mm")
        ax.margins(0.1)
    _legend(figure, axes[0])
    return figure


def on_all_scenes(result: dict[str, Any], method: str, pupil_mm: float, key: str) -> float:
    """A method's mean over all scenes. Of one that was judged on a few: ours on all, less our lead on those few, since
    scenes differ more than methods do."""
    row = _row(result, method, pupil_mm)
    if row["scenes"] == result["scenes"]:
        return float(row[key])
    pair = next(p for p in result["paired"] if (p["method"], p["pupil_mm"]) == (method, pupil_mm))
    return float(_row(result, "holod", pupil_mm)[key] - pair["difference"][key])


def _row(result: dict[str, Any], method: str, pupil_mm: float) -> dict[str, Any]:
    return next(row for row in _shown_rows(result, method) if row["pupil_mm"] == pupil_mm)


def _shown_rows(result: dict[str, Any], method: str) -> list[dict[str, Any]]:
    stage = "before" if method in PICTURES else "after"
    return [row for row in result["rows"] if (row["method"], row["double_phase"]) == (method, stage)]


def _on_every_scene(result: dict[str, Any]) -> Iterable[str]:
    """Methods that can share an axis with ours: means over other scenes would not compare."""
    return dict.fromkeys(row["method"] for row in result["rows"] if row["scenes"] == result["scenes"])


def _with_scenes(result: dict[str, Any], method: str) -> str:
    found, every = _shown_rows(result, method)[0]["scenes"], result["scenes"]
    return method if found == every else f"{method} (by difference, {found} of {every} scenes)"


def _styles(methods: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Ours bold and blue, what has no hologram grey and broken, each rival the same in every plot. Of the rest a family
    has a colour, each depth of it a shade and a marker, each loss a line and a filling: no two methods look alike, with
    lines or without."""
    names = sorted(methods, key=lambda method: method in PICTURES)
    kinds = {name: _kind(name) for name in names if name not in FIXED_STYLES}
    families = list(dict.fromkeys(family for family, _, _ in kinds.values()))
    depths = list(dict.fromkeys((family, depth) for family, depth, _ in kinds.values()))
    styles: dict[str, dict[str, Any]] = {}
    taken = set()
    for name in names:
        if name in FIXED_STYLES:
            colour, marker, line = FIXED_STYLES[name]
            styles[name] = {"color": colour, "marker": marker, "ls": line, "fillstyle": "full", "lw": 1.2}
            continue
        family, depth, loss = kinds[name]
        losses = list(dict.fromkeys(of for other, _, of in kinds.values() if other == family))
        wanted = (
            FAMILY_COLOURS[families.index(family) % len(FAMILY_COLOURS)],
            DEPTH_MARKERS[depths.index((family, depth)) % len(DEPTH_MARKERS)],
            LOSS_LINES[losses.index(loss) % len(LOSS_LINES)],
        )
        others = ((c, m, of) for of, m, c in itertools.product(LOSS_LINES, DEPTH_MARKERS, FAMILY_COLOURS))
        chosen = next((style for style in (wanted, *others) if style not in taken), wanted)
        taken.add(chosen)
        colour, marker, (line, filling) = chosen
        of_family = [of for other, of in depths if other == family]
        shade = _lighter(colour, MOST_LIGHTER * of_family.index(depth) / max(1, len(of_family) - 1))
        styles[name] = {"color": shade, "marker": marker, "ls": line, "fillstyle": filling, "lw": 1.2}
    for name, of in (("holod", {"lw": 2.2, "zorder": 3}), ("small", {"zorder": 3.1}), ("fast", {"zorder": 3.1})):
        if name in styles:
            styles[name].update(of)
    return styles


def _lighter(colour: str, share: float) -> str:
    """A colour of which so much is white."""
    red, green, blue = (value + share * (1 - value) for value in to_rgb(colour))
    return to_hex((red, green, blue))


def _kind(name: str) -> tuple[str, str, str]:
    """Family, depth and loss of a network by its name, such as `direct-26-paper`; a name of another form is a family
    of its own."""
    found = re.fullmatch(r"(.+?)-(\d+)(?:-(.+))?", name)
    return (found[1], found[2], found[3] or "") if found else (name, "", "")


def _sequence(count: int) -> list[tuple[float, ...]]:
    """Colours that go from dark to light, for things that have an order."""
    return [plt.get_cmap("viridis")(0.9 * k / max(1, count - 1)) for k in range(count)]


def _label(ax: Axes, x: str, y: str) -> None:
    ax.set_xlabel(x)
    ax.set_ylabel(y)
    ax.grid(alpha=0.25)
    ax.spines[["top", "right"]].set_visible(False)


def _legend(figure: Figure, ax: Axes, handlelength: float = 2.0) -> None:
    handles, labels = ax.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", fontsize=8, frameon=False, handlelength=handlelength)

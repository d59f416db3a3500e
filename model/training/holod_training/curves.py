"""Plots of a run's metrics.jsonl."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

PANELS = (
    ("loss", "loss"),
    ("psnr_db", "PSNR, dB (dotted: flat oracle)"),
    ("psnr_in_focus_db", "PSNR in focus, dB"),
    ("psnr_out_of_focus_db", "PSNR out of focus, dB"),
    ("slope", "focus slope"),
    ("correlation", "focus correlation"),
)


def read_rows(run: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]


def held_out(rows: list[dict[str, Any]], pupil: str, key: str) -> tuple[list[int], list[float]]:
    """Steps and values of one number, where the run has it."""
    found = [(r["step"], r["pupils"][pupil][key]) for r in rows if key in r["pupils"].get(pupil, {})]
    return [step for step, _ in found], [value for _, value in found]


def plot_curves(run: Path) -> Path:
    """Loss and the five numbers against steps, into curves.png; beside PSNR what the flat oracle scores."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    rows = read_rows(run)
    trained = [r for r in rows if r["kind"] == "train"]
    judged = [r for r in rows if r["kind"] == "validation" and r["pupils"]]
    pupils = list(judged[-1]["pupils"]) if judged else []
    figure, axes = plt.subplots(2, 3, figsize=(15, 7), constrained_layout=True)
    for ax, (key, title) in zip(axes.flat, PANELS, strict=True):
        if trained and key in trained[0]:
            ax.plot([r["step"] for r in trained], [r[key] for r in trained], lw=0.6, alpha=0.5, label="training")
        if key == "loss":
            ax.set_yscale("log")
        else:
            for index, pupil in enumerate(pupils):
                ax.plot(*held_out(judged, pupil, key), color=f"C{index + 1}", label=f"held out, {pupil} mm")
        if key == "psnr_db":
            for index, pupil in enumerate(pupils):
                ax.plot(*held_out(judged, pupil, "flat_oracle_db"), color=f"C{index + 1}", ls=":")
        ax.set_title(title)
        ax.set_xlabel("step")
        ax.grid(alpha=0.3)
        if ax.lines:
            ax.legend(fontsize=7)
    part = run / ".curves.png.part"
    figure.savefig(part, dpi=80, format="png")
    plt.close(figure)
    return part.replace(run / "curves.png")

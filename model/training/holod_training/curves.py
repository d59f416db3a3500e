"""Plots of a run's metrics.jsonl."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def read_rows(run: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]


def plot_curves(run: Path) -> Path:
    """Loss, PSNR, slope and correlation against steps, into curves.png."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    rows = read_rows(run)
    trained = [r for r in rows if r["kind"] == "train"]
    judged = [r for r in rows if r["kind"] == "validation" and r["pupils"]]
    figure, axes = plt.subplots(2, 2, figsize=(11, 7), constrained_layout=True)
    panels = (
        ("loss", None),
        ("psnr_db", "PSNR, dB"),
        ("slope", "focus slope"),
        ("correlation", "focus correlation"),
    )
    for ax, (key, label) in zip(axes.flat, panels, strict=True):
        ax.plot([r["step"] for r in trained], [r[key] for r in trained], lw=0.6, alpha=0.5, label="training")
        if label:
            for pupil in judged[0]["pupils"] if judged else ():
                ax.plot(
                    [r["step"] for r in judged],
                    [r["pupils"][pupil][key] for r in judged],
                    label=f"held out, {pupil} mm",
                )
        else:
            ax.set_yscale("log")
        ax.set_title(label or "loss")
        ax.set_xlabel("step")
        ax.grid(alpha=0.3)
        ax.legend(fontsize=7)
    path = run / "curves.png"
    figure.savefig(path, dpi=80)
    plt.close(figure)
    return path

from __future__ import annotations

import json
from colorsys import rgb_to_hsv
from pathlib import Path

import pytest
from matplotlib import pyplot as plt
from matplotlib.colors import to_hex, to_rgb

from holod_training.plots import FIXED_STYLES, _styles, pupil_plot, run_time_plot

EVALUATION = Path(__file__).parents[2] / "weights" / "evaluation" / "evaluation.json"
OF_THE_CARD = tuple(dict.fromkeys(row["method"] for row in json.loads(EVALUATION.read_text())["rows"]))


@pytest.mark.parametrize(
    "methods",
    [
        OF_THE_CARD,
        tuple(FIXED_STYLES),
        ("holod", *(f"network{chr(97 + k)}" for k in range(20))),
        ("holod", *(f"direct-{layers}-{loss}" for layers in range(10, 30, 2) for loss in "abcdef")),
        ("holod", *(f"{family}-{layers}" for family in ("direct", "layered") for layers in (4, 8, 12, 14))),
    ],
    ids=("card", "rivals", "plain names", "many losses", "families"),
)
def test_no_two_methods_look_alike(methods: tuple[str, ...]) -> None:
    """With lines, and without where a plot has markers alone."""
    styles = _styles(methods)
    assert set(styles) == set(methods)
    for told_by in (("color", "marker", "ls"), ("color", "marker", "fillstyle")):
        looks = [(to_hex(s["color"]), *(s[key] for key in told_by[1:])) for s in styles.values()]
        assert len(set(looks)) == len(methods), told_by


def test_a_family_has_a_colour_a_depth_a_marker_and_a_loss_a_line() -> None:
    styles = _styles(OF_THE_CARD)
    direct = {(n, of): styles[f"direct-{n}-{of}"] for n in (26, 20, 14) for of in ("paper", "ours")}
    assert max(hues := [rgb_to_hsv(*to_rgb(style["color"]))[0] for style in direct.values()]) - min(hues) < 0.01
    for key, index in (("color", 0), ("marker", 0), ("ls", 1), ("fillstyle", 1)):
        for one, first in direct.items():
            assert all((first[key] == second[key]) == (one[index] == other[index]) for other, second in direct.items())
    # So they are told apart in print without colours, too.
    assert len({style["marker"] for style in styles.values()}) >= 11


def test_the_plots_draw_them() -> None:
    result = json.loads(EVALUATION.read_text())
    for plot, told_by in ((pupil_plot, "get_linestyle"), (run_time_plot, "get_fillstyle")):
        figure = plot(result)
        for ax in figure.axes:
            looks = [(to_hex(li.get_color()), li.get_marker(), getattr(li, told_by)()) for li in ax.lines]
            assert len(looks) > 10 and len(set(looks)) == len(looks)
        plt.close(figure)

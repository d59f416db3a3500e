import copy
import json
import math
import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import write_shard
from PIL import Image
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from test_lpips import random_lpips_files
from test_marks import write_marks
from test_rgbd import write_pair

from holod_training.cli import main
from holod_training.config import NetworkConfig, OpticsConfig, TrainedRange
from holod_training.export import load_weights, read_metadata, save_weights
from holod_training.goals import ReportError, checks, row_of
from holod_training.intervals import interval_95
from holod_training.judging import Bench, Method, judge_scenes, network_field, rivals
from holod_training.lpips import Lpips
from holod_training.metrics import JudgementError
from holod_training.network import DirectNetwork
from holod_training.optics import coc_px, intensity, propagate
from holod_training.plots import on_all_scenes
from holod_training.refocus import card_areas, refocus_cards
from holod_training.report import _refocus, markdown
from holod_training.rivals import (
    all_in_focus,
    flat_oracle,
    layered_asm,
    rgbd_blur,
    smooth_phase,
    transport_of_intensity,
)
from holod_training.shards import Shard, ShardError, Stack
from holod_training.solver import Solution, optimise
from holod_training.variants import build_network, variant

PUPILS = (1.0, 2.0, 2.5, 4.0)
TABLE_PUPILS = (1.0, 2.0, 4.0)
RIVALS = ("all-in-focus", "layered ASM", "smooth phase", "transport of intensity")
OPTICS = OpticsConfig()
SHIPPED = Path(__file__).parents[2] / "weights" / "evaluation"


def write_card(path: Path, seed: int, metadata: dict[str, str] | None = None) -> None:
    write_shard(path, seed=seed, size=128, pupils_mm=(1.0, 2.0), metadata={"kind": "cards", **(metadata or {})})
    with safe_open(path, framework="pt") as file:
        metadata = file.metadata()
    tensors = load_file(path)
    near, far = 2.5 / OPTICS.depth_near_dpt, 0.25 / OPTICS.depth_near_dpt
    tensors["depth"] = torch.where(torch.arange(128) < 64, near, far).expand(128, 128).contiguous()
    save_file(tensors, path, metadata)


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenes that are not square, two networks with a constant each, cards and a real-looking RGB-D pair,
    everything on."""
    torch.manual_seed(1)
    tmp_path = tmp_path_factory.mktemp("evaluation")
    for name, layers, constant in (("w", 4, 1.4), ("deeper", 6, 0.8)):
        config = NetworkConfig(layers=layers, channels=8, adjustable_layers=(1,), amplitude_constant=constant)
        save_weights(tmp_path / f"{name}.safetensors", DirectNetwork(config), {}, {"seed": 1})
    for index in range(2):
        write_shard(tmp_path / "test" / f"scene_{index:06}.safetensors", index, size=(64, 80), pupils_mm=PUPILS)
        write_card(tmp_path / "cards" / f"scene_{index:06}.safetensors", seed=index)
    for kind, name in (("rgb", "0.jpg"), ("depth", "0.png")):
        (tmp_path / "real" / kind).mkdir(parents=True)
        millimetres = torch.full((48, 65), 1500, dtype=torch.int32)
        millimetres[:, :20], millimetres[10:14, 30:34] = 500, 0
        if kind == "rgb":
            Image.new("RGB", (65, 48), (200, 120, 60)).save(tmp_path / "real" / kind / name)
        else:
            Image.fromarray(millimetres.numpy().astype("uint16")).save(tmp_path / "real" / kind / name)
    write_marks(tmp_path / "marks" / "scene_000000.safetensors")
    folders = ["--test", tmp_path / "test", "--cards", tmp_path / "cards", "--rgbd", tmp_path / "real"]
    folders += ["--marks", tmp_path / "marks"]
    weights = ["--weights", tmp_path / "w.safetensors", "--also", tmp_path / "deeper.safetensors"]
    solver = [
        "--solver-start",
        "layered-asm",
        "--solver-scenes",
        "1",
        "--solver-iterations",
        "5",
        "--solver-frames",
        "2",
    ]
    options = [*folders, *weights, *solver, "--focus-curve-weights", "0,100", "--timing-calls", "1"]
    assert main(["evaluate", *map(str, options), "--out", str(tmp_path / "out")]) == 0
    return tmp_path


def read(evaluation: Path) -> dict:
    return json.loads((evaluation / "out" / "evaluation.json").read_text())


def page(folder: Path) -> str:
    """The page in one line, wherever its lines break."""
    return " ".join((folder / "evaluation.md").read_text().split())


def test_evaluation_is_complete(evaluation: Path) -> None:
    result = read(evaluation)
    assert (result["pupils_mm"], result["all_pupils_mm"]) == (list(TABLE_PUPILS), list(PUPILS))
    for method in ("holod", "deeper", *RIVALS, "optimised, 2 frames"):
        for stage in ("before", "after"):
            for pupil in PUPILS:
                row = row_of(result, method, stage, pupil)
                assert row["psnr_db"] > 5
                assert row["scenes"] == (1 if "optimised" in method else 2)
                assert ("psnr_db" in row["interval_95"]) == (row["scenes"] == 2)
    assert row_of(result, "flat oracle", "before", 4.0)["slope"] == 0
    assert row_of(result, "RGB-D blur", "before", 4.0)["slope"] > 0.2
    matrix = result["matrix_psnr_db"]["after"]
    for index, pupil in enumerate(TABLE_PUPILS):
        assert matrix[index][index] == pytest.approx(row_of(result, "holod", "after", pupil)["psnr_db"], abs=1e-3)
    assert matrix[0][2] != pytest.approx(matrix[2][2], abs=1e-3)
    assert len(result["refocus"]) == 2 * 6 * 5
    text = (evaluation / "out" / "evaluation.md").read_text()
    assert "refocus ratio, near card, bright on dark, s = 5 mm" in text and "these are others" in text
    assert Image.open(evaluation / "out" / "sheet.png").size == (4 * 84, 4 * 68)
    assert Image.open(evaluation / "out" / "cards.png").size == (5 * 132, 2 * 132)
    assert Image.open(evaluation / "out" / "marks.png").size == (3 * 132, 132)
    assert Image.open(evaluation / "out" / "rgbd.png").size == (5 * 68, 52)
    assert result["plots"] == ["pupils", "focus_curve", "offsets", "capacity", "run_time"]
    for name in result["plots"]:
        assert Image.open(evaluation / "out" / f"{name}.png").size[0] > 500


def test_means_and_pairs_are_those_of_the_scenes(evaluation: Path) -> None:
    result, scenes = read(evaluation), json.loads((evaluation / "out" / "scenes.json").read_text())

    def values(method: str, stage: str) -> list[float]:
        key = (method, stage, 2.0)
        return [s["psnr_db"] for s in scenes if (s["method"], s["double_phase"], s["pupil_mm"]) == key]

    ours, theirs = values("holod", "after"), values("smooth phase", "after")
    assert row_of(result, "holod", "after", 2.0)["psnr_db"] == pytest.approx(sum(ours) / 2)
    pairs = {(r["method"], r["pupil_mm"]): r for r in result["paired"]}
    found = pairs["smooth phase", 2.0]
    differences = [a - b for a, b in zip(ours, theirs, strict=True)]
    assert found["difference"]["psnr_db"] == pytest.approx(sum(differences) / 2)
    assert found["interval_95"]["psnr_db"] == pytest.approx(interval_95(differences))
    flat = pairs["flat oracle", 2.0]["difference"]["psnr_db"]
    assert flat == pytest.approx((sum(ours) - sum(values("flat oracle", "before"))) / 2)
    few = pairs["optimised, 2 frames", 2.0]
    shown = on_all_scenes(result, "optimised, 2 frames", 2.0, "psnr_db")
    assert shown == pytest.approx(sum(ours) / 2 - (ours[0] - values("optimised, 2 frames", "after")[0]))
    assert on_all_scenes(result, "smooth phase", 2.0, "psnr_db") == pytest.approx(sum(theirs) / 2)
    assert few["scenes"] == 1 and ("holod", 2.0) not in pairs


def test_each_network_is_judged_with_its_own_amplitude_constant(evaluation: Path) -> None:
    result = read(evaluation)
    network = load_weights(evaluation / "deeper.safetensors")
    stack = Shard(evaluation / "test" / "scene_000000.safetensors").read(1)

    def psnr_db(constant: float) -> float:
        bench = Bench(OPTICS, constant, result["border_px"])
        with torch.no_grad():
            panel, _ = bench.panel(network_field(network, stack, 2.0))
        return bench.judge(bench.look(panel, 2.0, stack.focus_dpt), stack).psnr_db

    scenes = json.loads((evaluation / "out" / "scenes.json").read_text())
    (found,) = [
        row["psnr_db"]
        for row in scenes
        if (row["scene"], row["method"], row["double_phase"], row["pupil_mm"])
        == ("scene_000000.safetensors", "deeper", "after", 2.0)
    ]
    assert found == pytest.approx(psnr_db(0.8), abs=1e-4) and abs(found - psnr_db(1.4)) > 0.01
    assert [row["amplitude_constant"] for row in result["networks"]] == [1.4, 0.8]
    assert "Amplitude constant 1.4 (deeper: 0.8)." in page(evaluation / "out")


def test_costs_and_offsets(evaluation: Path) -> None:
    result = read(evaluation)
    networks = {row["method"]: row for row in result["networks"]}
    assert networks["holod"]["parameters"] == sum(
        p.numel() for p in load_weights(evaluation / "w.safetensors").parameters()
    )
    # Two more layers: 9 taps, 8 channels in and out, two operations, on a quarter of the pixels.
    more = networks["deeper"]["operations_per_px"] - networks["holod"]["operations_per_px"]
    assert more == pytest.approx(2 * 9 * 8 * 8 * 2 / 4)
    times = {row["method"]: row["ratio_to_ours"] for row in result["run_time"]["rows"]}
    assert times["holod"] == 1 and times["optimised, 2 frames"] > 1
    assert {(r["layer"], r["from_dpt"]) for r in result["offsets"]} == {
        ("layers.1", round(OPTICS.dioptres(k / 5), 4)) for k in range(5)
    }
    curve = result["focus_curve"]
    assert {(r["in_focus_weight"], r["pupil_mm"]) for r in curve["solver"]} == {
        (w, s) for w in (0, 100) for s in (2, 4)
    }
    assert {r["scenes"] for r in curve["methods"]} == {1}


def test_pictures_that_cannot_be_used_are_refused_before_the_work(evaluation: Path, tmp_path: Path, capsys) -> None:
    arguments = ["--weights", str(evaluation / "w.safetensors"), "--test", str(evaluation / "test")]
    arguments = ["evaluate", *arguments, "--rgbd", str(tmp_path), "--out", str(tmp_path / "out")]
    assert main(arguments) == 65
    assert "no RGB-D pairs in it" in capsys.readouterr().err
    write_pair(tmp_path, np.zeros((4, 4)))
    assert main(arguments) == 65
    assert "depth/a.png: every pixel is 0" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_lpips_has_a_column_where_its_files_are_given(evaluation: Path, tmp_path: Path, capsys) -> None:
    backbone, linear = random_lpips_files(tmp_path)
    write_shard(tmp_path / "test" / "scene_000000.safetensors", size=(64, 80), pupils_mm=(2.0,))
    arguments = ["evaluate", "--weights", evaluation / "w.safetensors", "--test", tmp_path / "test", "--border-px", "0"]
    arguments += ["--solver-scenes", "0", "--timing-calls", "1", "--out", tmp_path / "out"]
    arguments = [*map(str, arguments), "--lpips-backbone", str(backbone)]
    assert main(arguments) == 65
    assert "LPIPS: found one of its two weights files" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert main([*arguments, "--lpips-linear", str(linear)]) == 0
    result = json.loads((tmp_path / "out" / "evaluation.json").read_text())
    target = Shard(tmp_path / "test" / "scene_000000.safetensors").read(0).target
    expected = Lpips(backbone, linear)(flat_oracle(target), target)
    assert expected.max() > 1.2 * expected.min()
    found = row_of(result, "flat oracle", "before", 2.0)["lpips"]
    assert found == pytest.approx(float(expected.mean()), rel=1e-4)
    assert all(row["lpips"] > 2 * found for row in result["rows"] if row["method"] not in ("flat oracle", "RGB-D blur"))
    line = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("| 2 | flat oracle "))
    assert line.endswith(f" | {found:.4f} |")
    heading = "| s mm | method | scenes | PSNR dB | in focus | out of focus | slope | correlation | SSIM | foam |"
    assert f"{heading} LPIPS |" in (tmp_path / "out" / "evaluation.md").read_text()
    without = (evaluation / "out" / "evaluation.md").read_text()
    assert heading in without and "LPIPS" not in without
    assert not any("lpips" in row for row in read(evaluation)["rows"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--border-px 27", "--border-px: found 27, expected at most 26: "),
        ("--border-px 60", "--border-px: found 60, expected at most 26: "),
        ("--border-px -1", "--border-px: found -1, expected at least 0"),
        ("--limit 0", "--limit: found 0, expected at least 1 scene"),
        ("--limit -1", "--limit: found -1, expected at least 1 scene"),
        ("--solver-scenes -1", "--solver-scenes: found -1, expected at least 0"),
        ("--solver-iterations -1", "--solver-iterations: found -1, expected at least 0"),
        ("--solver-frames 0,1", "--solver-frames: found (0, 1), expected numbers of at least 1, each once"),
        ("--solver-frames 2,2", "--solver-frames: found (2, 2), expected numbers of at least 1, each once"),
        ("--solver-focus-weight -1", "--solver-focus-weight: found -1.0, expected a number of at least 0"),
        ("--solver-in-focus-weight nan", "--solver-in-focus-weight: found nan, expected a number of at least 0"),
        ("--focus-curve-weights 1,-1", "--focus-curve-weights: found (1.0, -1.0), expected numbers of at least 0"),
        ("--timing-calls 0", "--timing-calls: found 0, expected at least 1"),
    ],
)
def test_what_cannot_be_judged_is_refused_before_the_work(
    options: str, message: str, evaluation: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The scenes are 80x64: within a border of 26 px there is just one window of SSIM."""
    arguments = ["--weights", str(evaluation / "w.safetensors"), "--test", str(evaluation / "test")]
    arguments = ["evaluate", *arguments, "--out", str(tmp_path / "out"), "--device", "cpu"]
    assert main([*arguments, *options.split()]) == 65
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_widest_border_is_judged(evaluation: Path, tmp_path: Path) -> None:
    arguments = ["--weights", str(evaluation / "w.safetensors"), "--test", str(evaluation / "test"), "--limit", "1"]
    arguments += ["--out", str(tmp_path), "--solver-scenes", "0", "--timing-calls", "1", "--border-px", "26"]
    assert main(["evaluate", *arguments]) == 0
    assert row_of(json.loads((tmp_path / "evaluation.json").read_text()), "holod", "after", 2.0)["ssim"] < 1


def test_two_methods_of_one_name_are_refused(evaluation: Path, tmp_path: Path, capsys) -> None:
    weights = str(evaluation / "deeper.safetensors")
    arguments = ["--weights", weights, "--also", weights, "--also", weights, "--test", str(evaluation / "test")]
    assert main(["evaluate", *arguments, "--out", str(tmp_path / "out")]) == 65
    assert "a second method named 'deeper'" in capsys.readouterr().err


def verdicts(result: dict) -> dict[str, bool]:
    return {what: passed for what, _, _, passed in checks(result)}


def on_the_goals_scenes(result: dict) -> dict:
    """As if the evaluation were of the scenes that the goals were set for."""
    shipped = json.loads((SHIPPED / "evaluation.json").read_text())
    keys = ("optics", "numbers_of_seed", "size", "border_px", "focus_dpt")
    return {**result, **{key: shipped[key] for key in keys}}


def test_what_was_set_for_other_scenes_is_not_asked_for(evaluation: Path) -> None:
    result = read(evaluation)
    assert result["numbers_of_seed"] == {"0": [0], "1": [1]} and result["optics"]["pixel_pitch_um"] == 8
    of_the_scenes = on_the_goals_scenes(result)
    of_other_networks = [{**row, "method": row["method"].replace("deeper", "small")} for row in result["networks"]]
    small = [{**row, "method": row["method"].replace("deeper", "small"), "foam": 0.001} for row in result["rows"]]
    of_the_scenes.update(networks=of_other_networks, rows=small)
    asked, set_for = ("PSNR", "slope", "foam", "small behind"), "What is wanted in dB, slope and foam was set for"

    def judged(changed: dict) -> set[str]:
        return {what for what in asked if any(goal.startswith(what) for goal in verdicts(changed))}

    assert judged(of_the_scenes) == set(asked) and set_for not in markdown(of_the_scenes)
    for change in (
        {"optics": {**result["optics"], "pixel_pitch_um": 3.74}},
        {"numbers_of_seed": {"9002": [300, 301, 302, 303, 304, 305]}},
        {"numbers_of_seed": {"9001": [300, 301]}},
        {"size": [256, 512]},
        {"border_px": 8},
        {"focus_dpt": of_the_scenes["focus_dpt"][1::2]},
    ):
        other = {**of_the_scenes, **change}
        assert judged(other) == set() and set_for in markdown(other)
        assert any(goal.startswith("right pupil") for goal in verdicts(other))
    other = {**of_the_scenes, "optics": {**result["optics"], "pixel_pitch_um": 3.74}}
    assert {least for what, _, least, _ in checks(other) if what.startswith("refocus")} == {"at least 1.8"}
    assert {least for what, _, least, _ in checks(result) if what.startswith("refocus")} == {"at least 2"}


def test_goals_reject_a_flat_network_and_an_ignored_pupil(evaluation: Path) -> None:
    result = on_the_goals_scenes(read(evaluation))
    rows = [r for r in result["rows"] if (r["method"], r["double_phase"], r["pupil_mm"]) == ("holod", "after", 2.0)]
    for slope, psnr_db, foam in ((0.51, 27.31, 0.0009), (0.49, 27.29, 0.0010)):
        rows[0].update(slope=slope, psnr_db=psnr_db, foam=foam)
        found = verdicts(result)
        assert found["slope at s = 2 mm"] == (slope > 0.5)
        assert found["PSNR, dB, at s = 2 mm"] == (psnr_db > 27.3)
        assert found["foam, thousandths, at s = 2 mm"] == (foam < 0.00093)
    result["matrix_psnr_db"]["after"] = [[20.0] * 3 for _ in range(3)]
    assert verdicts(result)["right pupil ahead by, dB, judged s = 2 mm"]
    result["matrix_psnr_db"]["after"][0][1] = 20.2
    assert not verdicts(result)["right pupil ahead by, dB, judged s = 2 mm"]
    result["refocus"][0]["near_card"] = 1.99
    assert not verdicts(result)["refocus ratio, near card, dark on bright, s = 1 mm"]


def test_goals_of_other_networks_are_beside_ours_and_those_of_marks_are_for_each(evaluation: Path) -> None:
    result = on_the_goals_scenes(read(evaluation))
    for part in ("rows", "networks", "marks"):
        result[part] = [{**row, "method": row["method"].replace("deeper", "small")} for row in result[part]]
    ours, small = (
        row_of(result, "holod", "after", 2.0),
        [r for r in result["rows"] if (r["method"], r["double_phase"], r["pupil_mm"]) == ("small", "after", 2.0)],
    )
    for behind_db in (0.14, 0.16):
        small[0]["psnr_db"] = ours["psnr_db"] - behind_db
        assert verdicts(result)["small behind over all, dB, at s = 2 mm"] == (behind_db < 0.15)
    marks = [r for r in result["marks"] if (r["method"], r["double_phase"]) == ("small", "after")]
    what = f"{marks[0]['marks']}, small, s = {marks[0]['pupil_mm']:g} to {marks[-1]['pupil_mm']:g} mm"
    for row in marks:
        row.update(light_ratio=1.0, dark_mean=0.0004)
    assert verdicts(result)[f"light of {what}"] and verdicts(result)[f"light on black of {what}"]
    marks[-1].update(light_ratio=1.21, dark_mean=0.0006)
    assert not verdicts(result)[f"light of {what}"] and not verdicts(result)[f"light on black of {what}"]
    assert not any("smooth phase" in what for what in verdicts(result))


def test_the_shipped_pages_are_those_of_their_figures(tmp_path: Path) -> None:
    """And are written again without judging anything."""
    for name in ("evaluation", "benches"):
        shutil.copy(SHIPPED / f"{name}.json", tmp_path)
    assert main(["report", "--folder", str(tmp_path)]) == 0
    for name in ("evaluation.md", "benches.md"):
        text = (tmp_path / name).read_text()
        assert text == (SHIPPED / name).read_text()
        assert all(len(line) <= 100 for line in text.splitlines() if not line.startswith("|"))


def test_methods_of_which_means_alone_were_kept_are_named(evaluation: Path) -> None:
    result = read(evaluation)
    told = "which means alone were kept, and so without differences"
    assert told not in " ".join(markdown(result).split())
    result["paired"] = [row for row in result["paired"] if row["method"] not in ("deeper", "layered ASM")]
    assert f"{told}: deeper; layered ASM." in " ".join(markdown(result).split())


def test_a_report_of_nothing_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["report", "--folder", str(tmp_path)]
    assert main(command) == 65
    assert f"{tmp_path}: found neither evaluation.json nor benches.json" in capsys.readouterr().err
    for name in ("evaluation.json", "benches.json"):
        for content in (b"{", b"[]", b"{}", b"\xff", b'{"benches": [1], "border_px": 24}'):
            (tmp_path / name).write_bytes(content)
            assert main(command) == 65
            assert f"{tmp_path / name}: no figures to report of" in capsys.readouterr().err
        (tmp_path / name).unlink()
    assert not list(tmp_path.iterdir())


def test_the_report_refuses_mixed_pupils(evaluation: Path) -> None:
    result = read(evaluation)
    assert markdown(result).startswith("# Evaluation of w.safetensors")
    for change, message in (
        (lambda r: r["rows"][0].update(pupil_mm=3.0), "rows are for s ="),
        (lambda r: r["matrix_psnr_db"]["after"].pop(), "not 3 by 3"),
        (lambda r: r.update(scenes=3), "was judged on 2 scenes, it states 3"),
    ):
        mixed = copy.deepcopy(result)
        change(mixed)
        with pytest.raises(ReportError, match=message):
            markdown(mixed)


def test_a_method_that_gives_no_numbers_is_told_and_not_left_out(evaluation: Path) -> None:
    """A scene on which it fails would be missing in its mean, and it would look the better for it."""

    def field(stack: Stack, pupil_mm: float) -> torch.Tensor:
        return all_in_focus(stack.amplitude, stack.depth, OPTICS) * (math.nan if pupil_mm == 2.5 else 1)

    shard = Shard(evaluation / "test" / "scene_000001.safetensors")
    with pytest.raises(JudgementError, match=r"scene_000001\.safetensors: failing for s = 2\.5 mm: found a picture"):
        judge_scenes([shard], [Method("failing", field, adapts=True)], Bench(OPTICS, 1.25, 8))


def test_what_is_judged_after_double_phase_alone_is_the_same(evaluation: Path) -> None:
    def field(stack: Stack, pupil_mm: float) -> torch.Tensor:
        return all_in_focus(stack.amplitude, stack.depth, OPTICS)

    shard = Shard(evaluation / "test" / "scene_000001.safetensors")
    methods, bench = [Method("holod", field, adapts=True)], Bench(OPTICS, 1.25, 8)
    every, alone = (judge_scenes([shard], methods, bench, after_alone) for after_alone in (False, True))
    after = {of: found for of, found in every.values.items() if of[:2] == ("holod", "after")}
    assert alone.values == after and 0 < len(after) < len(every.values)
    assert alone.summary()["matrix_psnr_db"] == {"after": every.summary()["matrix_psnr_db"]["after"]}


def test_a_bench_that_weights_are_not_for_is_told(evaluation: Path, tmp_path: Path, capsys) -> None:
    """Refused where `holod evaluate` does, noted where it warns."""
    weights, trained = tmp_path / "w.safetensors", {"near": (40.0, 60.0), "far": (140.0, 400.0)}
    arguments = ["evaluate", "--weights", str(weights), "--test", str(evaluation / "test"), "--limit", "1"]
    arguments += ["--solver-scenes", "0", "--timing-calls", "1", "--out"]
    for name, fresnel_px2 in trained.items():
        config = NetworkConfig(
            layers=4, channels=4, adjustable_layers=(1,), trained=TrainedRange((14, 72), fresnel_px2)
        )
        save_weights(weights, DirectNetwork(config), {}, {})
        assert main([*arguments, str(tmp_path / name)]) == (65 if name == "far" else 0)
    told = "diffraction over this bench's depth range, λ·(f/p)²·V, is 32.14 to 45.57 px²; the network was trained for "
    assert f"{weights}: {told}140.00 to 400.00 px²: " in capsys.readouterr().err and not (tmp_path / "far").exists()
    assert f"Not what holod is for: {told}40.00 to 60.00 px²." in page(tmp_path / "near")
    assert "Not what" not in page(evaluation / "out")


@pytest.mark.parametrize(
    ("odd", "message"),
    [({"pupils_mm": (1.0, 3.0)}, "pupils_mm is"), ({"size": 80}, "size is"), ({"planes": 4}, "focus_dpt is")],
)
def test_scenes_must_be_alike(tmp_path: Path, evaluation: Path, capsys, odd: dict, message: str) -> None:
    write_shard(tmp_path / "scene_000000.safetensors", pupils_mm=(1.0, 2.0))
    write_shard(tmp_path / "scene_000001.safetensors", **{"pupils_mm": (1.0, 2.0), **odd})
    arguments = ["--weights", str(evaluation / "w.safetensors"), "--test", str(tmp_path)]
    assert main(["evaluate", *arguments, "--out", str(tmp_path / "out")]) == 65
    error = capsys.readouterr().err
    assert "scene_000001.safetensors" in error and message in error
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("option", "odd", "message"),
    [
        (
            "--marks",
            {"pupils_mm": (1.9, 4.0)},
            r"pupils_mm is \(1\.9, 4\.0\), but \(2\.0, 4\.0\) in .*given `--pupils`",
        ),
        ("--marks", {"size": 64}, r"size is \(64, 64\), but \(128, 128\) in scene_000000"),
        ("--cards", {"size": 64}, r"size is \(64, 64\), but \(128, 128\) in scene_000000"),
    ],
)
def test_cards_and_marks_must_be_alike(
    evaluation: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str, odd: dict, message: str
) -> None:
    for index, changes in enumerate(({}, odd)):
        path = tmp_path / "odd" / f"scene_{index:06}.safetensors"
        write_shard(path, **{"pupils_mm": (2.0, 4.0), "size": 128, "metadata": {"kind": option[2:]}, **changes})
    arguments = ["--weights", str(evaluation / "w.safetensors"), "--test", str(evaluation / "test")]
    assert main(["evaluate", *arguments, option, str(tmp_path / "odd"), "--out", str(tmp_path / "out")]) == 65
    assert re.search(rf"scene_000001\.safetensors: {message}", capsys.readouterr().err)
    assert not (tmp_path / "out").exists()


def test_a_scene_that_is_there_twice_is_refused(evaluation: Path, tmp_path: Path, capsys) -> None:
    for name in ("scene_000000", "scene_000007"):
        write_shard(tmp_path / "test" / f"{name}.safetensors", seed=3, pupils_mm=PUPILS)
        write_card(tmp_path / "cards" / f"{name}.safetensors", seed=3)
    command = ["evaluate", "--weights", str(evaluation / "w.safetensors"), "--out", str(tmp_path / "out"), "--test"]
    for options in (
        [str(tmp_path / "test")],
        [str(evaluation / "test"), "--cards", str(tmp_path / "cards")],
    ):
        assert main([*command, *options]) == 65
        error = capsys.readouterr().err
        assert re.search(r"scene_000007\.safetensors: found number 3 of seed 3, as in .*scene_000000", error)
    assert not (tmp_path / "out").exists()


def test_scenes_of_another_kind_are_no_cards(tmp_path: Path) -> None:
    write_card(tmp_path / "scene_000000.safetensors", seed=0, metadata={"kind": "marks"})
    shards = [Shard(tmp_path / "scene_000000.safetensors")]
    with pytest.raises(ShardError, match="kind 'marks', expected cards"):
        refocus_cards(shards, rivals(OPTICS)[:1], Bench(OPTICS, 1.25, 8), tmp_path / "sheet.png")


def test_judged_between_what_methods_know(tmp_path: Path, evaluation: Path, capsys, monkeypatch) -> None:
    """Changes the pictures at the focuses that are asked for, or those between, and sees whose numbers change."""
    known: dict[str, set[tuple[float, ...]]] = {"evaluate": set(), "tradeoff": set()}

    def watch(module: str) -> None:
        def watched(stack: Stack, *rest: Any) -> Solution:
            known[module].add(stack.focus_dpt)
            return optimise(stack, *rest)

        monkeypatch.setattr(f"holod_training.{module}.optimise", watched)

    for module in known:
        watch(module)

    def numbers(name: str, changed: slice) -> tuple[float, float, float]:
        path = write_shard(tmp_path / name / "scene_000000.safetensors", pupils_mm=(2.0,), planes=7)
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata()
        tensors = load_file(path)
        tensors["stack_0"][changed] = tensors["stack_0"][changed].flip(-1)
        save_file(tensors, path, metadata)
        options = ["--test", str(path.parent), "--judge-between", "--solver-scenes", "1", "--solver-iterations", "4"]
        options += ["--solver-frames", "1", "--focus-curve-weights", "50", "--timing-calls", "1"]
        out = tmp_path / name / "out"
        assert main(["evaluate", "--weights", str(evaluation / "w.safetensors"), *options, "--out", str(out)]) == 0
        result = json.loads((out / "evaluation.json").read_text())
        whole = Shard(path).focus_dpt
        assert result["focus_dpt"] == list(whole[1::2])
        assert result["solver"]["focus_dpt"] == list(whole[0::2])
        assert all(focuses == {whole[0::2]} for focuses in known.values())
        assert "3 focal planes between the 4 that methods may know" in (out / "evaluation.md").read_text()
        ours, optimised = (row_of(result, m, "after", 2.0)["psnr_db"] for m in ("holod", "optimised, 1 frame"))
        return ours, optimised, result["focus_curve"]["solver"][0]["psnr_db"]

    none = numbers("none", slice(0))
    asked, between = numbers("asked", slice(0, None, 2)), numbers("between", slice(1, None, 2))
    assert asked[0] == none[0]
    assert all(changed < before - 0.01 for changed, before in zip(asked[1:], none[1:], strict=True))
    assert all(changed < before - 0.1 for changed, before in zip(between, none, strict=True))

    for planes in (2, 4, 25):
        folder = tmp_path / f"wrong-{planes}"
        write_shard(folder / "scene_000000.safetensors", pupils_mm=(2.0,), planes=planes)
        arguments = [
            "--weights",
            str(evaluation / "w.safetensors"),
            "--test",
            str(folder),
            "--out",
            str(folder / "out"),
        ]
        assert main(["evaluate", *arguments, "--judge-between"]) == 65
        assert f"{planes} focuses, expected an odd number from 3 to 23" in capsys.readouterr().err
        assert not (folder / "out").exists()


def test_scenes_of_training_are_refused(tmp_path: Path, evaluation: Path, capsys) -> None:
    write_shard(tmp_path / "scene_000000.safetensors", metadata={"kind": "train"})
    for command in ("evaluate", "eyebox"):
        arguments = [command, "--weights", str(evaluation / "w.safetensors"), "--test", str(tmp_path)]
        assert main([*arguments, "--out", str(tmp_path / "out")]) == 65
        assert "scene_000000.safetensors: metadata kind is 'train', expected held-out" in capsys.readouterr().err
    for folder in ("cards", "marks"):
        arguments = ["evaluate", "--weights", str(evaluation / "w.safetensors"), "--test", str(evaluation / "test")]
        assert main([*arguments, f"--{folder}", str(tmp_path), "--out", str(tmp_path / "out")]) == 65
        assert "scene_000000.safetensors: metadata kind is 'train', expected held-out" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("kind", ["cards", "marks"])
def test_cards_and_marks_are_no_test_scenes(kind: str, tmp_path: Path, evaluation: Path, capsys) -> None:
    write_shard(tmp_path / "scene_000000.safetensors", metadata={"kind": kind})
    for command in ("evaluate", "eyebox", "across-benches"):
        arguments = [command, "--weights", str(evaluation / "w.safetensors"), "--test", str(tmp_path)]
        assert main([*arguments, "--out", str(tmp_path / "out")]) == 65
        assert f"metadata kind is {kind!r}, expected scenes of" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_export_stamps_the_constant_and_the_evaluation(
    evaluation: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = evaluation / "shipped.safetensors"
    arguments = ["--source", str(evaluation / "w.safetensors"), "--out", str(out), "--amplitude-constant", "1.25"]
    assert main(["export", *arguments]) == 0
    metadata = read_metadata(out)
    assert metadata["config"].amplitude_constant == 1.25 and metadata["metrics"] == {}
    # What was judged at another constant, or is of other weights, is none of its figures.
    judged = ["--evaluation", str(evaluation / "out" / "evaluation.json"), "--force"]
    capsys.readouterr()
    assert main(["export", *arguments, *judged]) == 65
    assert "amplitude_constant: found 1.4, expected 1.25, that of the file to write" in capsys.readouterr().err
    network = load_weights(evaluation / "w.safetensors")
    with torch.no_grad():
        next(network.parameters())[0] += 1e-6
    save_weights(tmp_path / "near.safetensors", network, {}, {})
    for source, key in (
        (tmp_path / "near.safetensors", "weights_sha256"),
        (evaluation / "deeper.safetensors", "param"),
    ):
        assert main(["export", "--source", str(source), "--out", str(tmp_path / "x.safetensors"), *judged]) == 65
        assert f"evaluation.json: {key}" in capsys.readouterr().err
    assert not (tmp_path / "x.safetensors").exists()
    arguments = [*arguments[:4], *judged]
    assert main(["export", *arguments]) == 0
    metadata = read_metadata(out)
    assert {row["method"] for row in metadata["metrics"]["rows"]} == {"holod"}
    assert metadata["provenance"] == {"seed": 1}
    before, after = load_weights(evaluation / "w.safetensors").state_dict(), load_weights(out).state_dict()
    assert all(torch.equal(before[name], after[name]) for name in before)
    for constant in ("0", "inf", "nan"):
        assert main(["export", *arguments[:4], "--amplitude-constant", constant, "--force"]) == 65
        assert "amplitude constant: found" in capsys.readouterr().err
    for method in ("layered ASM", "nobody"):
        assert main(["export", *arguments, "--evaluation-method", method]) == 65
    also = ["--source", str(evaluation / "deeper.safetensors"), "--out", str(out), *judged]
    assert main(["export", *also, "--evaluation-method", "deeper"]) == 0
    assert "matrix_psnr_db" not in read_metadata(out)["metrics"]


def test_figures_stay_with_their_amplitude_constant(evaluation: Path, tmp_path: Path) -> None:
    source, out = tmp_path / "source.safetensors", tmp_path / "out.safetensors"
    network = load_weights(evaluation / "w.safetensors")
    save_weights(source, network, {"rows": [1]}, {})
    for constant, expected in (("1.4", {"rows": [1]}), ("4", {})):
        assert (
            main(["export", "--source", str(source), "--out", str(out), "--amplitude-constant", constant, "--force"])
            == 0
        )
        assert read_metadata(out)["metrics"] == expected


def test_what_is_no_evaluation_is_told_without_a_traceback(
    evaluation: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--source", str(evaluation / "w.safetensors"), "--out", str(tmp_path / "x.safetensors")]
    for option, told in (("--evaluation", "not an evaluation"), ("--benches", "not a table across benches")):
        assert main(["export", *arguments, option, str(evaluation / "out" / "scenes.json")]) == 65
        assert f"scenes.json: {told}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("focal-stack", "`focal-stack` network without feedback; the engines run those with it"),
        (
            "half-band-layered-small",
            "found a `layered` network; the engines run `direct`, `expected-stack` and `focal-stack` networks only",
        ),
    ],
)
def test_networks_that_no_engine_runs_are_not_exported(name: str, told: str, tmp_path: Path, capsys) -> None:
    source, out = tmp_path / "w.safetensors", tmp_path / "out.safetensors"
    save_weights(source, build_network(variant(name)), {}, {})
    assert main(["export", "--source", str(source), "--out", str(out)]) == 65
    assert told in capsys.readouterr().err
    assert not out.exists()


def test_a_focal_stack_with_feedback_is_exported(tmp_path: Path) -> None:
    source, out = tmp_path / "w.safetensors", tmp_path / "out.safetensors"
    save_weights(source, build_network(variant("focal-stack-feedback")), {}, {})
    assert main(["export", "--source", str(source), "--out", str(out)]) == 0
    assert read_metadata(out)["config"].planes == 6


def test_card_areas_leave_out_border_and_seam() -> None:
    depth = torch.where(torch.arange(128) < 64, 2.5 / OPTICS.depth_near_dpt, 0.25 / OPTICS.depth_near_dpt)
    areas = card_areas(depth.expand(128, 128), border_px=10)
    assert areas["near"].nonzero().amin(0).tolist() == [10, 10]
    assert areas["near"].nonzero().amax(0).tolist() == [117, 47]
    assert areas["far"].nonzero().amin(0).tolist() == [10, 80]


def test_cards_of_one_contrast_have_one_row_for_each_pupil(tmp_path: Path) -> None:
    for index in range(3):
        write_card(tmp_path / f"scene_{index:06}.safetensors", seed=index)
    shards = [Shard(path) for path in sorted(tmp_path.iterdir())]
    method, bench = rivals(OPTICS)[0], Bench(OPTICS, 1.25, 8)

    def rows(*indices: int) -> dict[tuple[str, float], dict[str, Any]]:
        of = refocus_cards([shards[i] for i in indices], [method], bench, tmp_path / "sheet.png")
        return {(row["contrast"], row["pupil_mm"]): row for row in of}

    one, other, found = rows(0), rows(2), rows(0, 1, 2)
    assert len(found) == 2 * 5 and found["bright on dark", 2.0]["scenes"] == 1
    key = ("dark on bright", 2.0)
    assert one[key]["near_card"] != other[key]["near_card"] and found[key]["scenes"] == 2
    assert found[key]["near_card"] == pytest.approx((one[key]["near_card"] + other[key]["near_card"]) / 2)


def test_a_method_that_is_given_stacks_is_judged_at_the_cards_own_pupils(tmp_path: Path) -> None:
    """The images that another pupil sees are none of its."""
    write_card(tmp_path / "scene_000000.safetensors", seed=0)
    given: list[tuple[float, float]] = []

    def field(stack: Stack, pupil_mm: float) -> torch.Tensor:
        given.append((stack.pupil_mm, pupil_mm))
        return all_in_focus(stack.amplitude, stack.depth, OPTICS)

    methods = [Method("stacks", field, adapts=True, takes_stack=True), rivals(OPTICS)[0]]
    rows = refocus_cards(
        [Shard(tmp_path / "scene_000000.safetensors")], methods, Bench(OPTICS, 1.25, 8), tmp_path / "sheet.png"
    )
    assert given == [(1.0, 1.0), (2.0, 2.0)] and len(rows) == 2 + 5
    (line,) = [line for line in _refocus({"refocus": rows}) if line.startswith("| stacks | dark on bright | near |")]
    assert line.endswith(" | - | - | - |")


def test_cards_are_judged_on_a_bench_with_another_depth_range(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They stand at the same place of every bench's depth range, and the eye is focused there."""
    bench = {"far_dpt": "0.5", "near_dpt": "2.0"}
    path = tmp_path / "scene_000000.safetensors"
    write_card(path, seed=0, metadata=bench)
    shard = Shard(path)
    looked: list[tuple[float, ...]] = []

    def look(self: Bench, field: torch.Tensor, pupil_mm: float, focus_dpt: Sequence[float]) -> torch.Tensor:
        looked.append(tuple(focus_dpt))
        return torch.rand(2, 3, 128, 128)

    monkeypatch.setattr(Bench, "look", look)
    rows = refocus_cards([shard], rivals(shard.optics)[:1], Bench(shard.optics, 1.25, 8), tmp_path / "sheet.png")
    assert len(rows) == 5
    for focuses in looked:
        assert focuses == pytest.approx((0.5 + 1.5 * 2.5 * 0.35, 0.5 + 1.5 * 0.25 * 0.35))


def smooth_scene() -> tuple[torch.Tensor, torch.Tensor]:
    y, x = torch.meshgrid(torch.arange(64.0), torch.arange(64.0), indexing="ij")
    light = 0.5 + 0.3 * torch.sin(2 * torch.pi * x / 16) * torch.cos(2 * torch.pi * y / 32)
    return light.expand(3, -1, -1).sqrt(), torch.full((64, 64), 0.5)


def test_all_in_focus_is_sharp_in_the_middle() -> None:
    amplitude, depth = smooth_scene()
    field = all_in_focus(amplitude, depth, OPTICS)
    back = intensity(propagate(field, OPTICS, OPTICS.distance_m(OPTICS.dioptres(0.5))))
    assert (back - amplitude.square()).abs().max() < 0.01


def test_smooth_phase_is_sharp_in_the_middle() -> None:
    amplitude, depth = smooth_scene()
    depth = depth + 0.5 / 24
    field = smooth_phase(amplitude, depth, OPTICS)
    back = intensity(propagate(field, OPTICS, OPTICS.distance_m(OPTICS.dioptres(12.5 / 24))))
    assert (back - amplitude.square()).abs().max() < 0.02
    spectrum = torch.fft.fft2(field).abs()
    assert spectrum[:, 17:48].max() < 1e-3


def test_transport_of_intensity_blurs_far_marks_towards_the_near_focus() -> None:
    """A bright square on dark, far away: with the prior its peak falls faster when the eye looks near."""
    image = torch.full((3, 64, 64), 0.2)
    image[:, 28:36, 28:36] = 0.8
    amplitude, depth = image.sqrt(), torch.full((64, 64), 0.5 / 8)
    peak = {}
    for make in (layered_asm, transport_of_intensity):
        field = make(amplitude, depth, OPTICS)
        far, near = (intensity(propagate(field, OPTICS, OPTICS.distance_m(OPTICS.dioptres(d)))) for d in (0.0625, 0.5))
        peak[make] = float(near[:, 30:34, 30:34].mean() / far[:, 30:34, 30:34].mean())
    assert peak[transport_of_intensity] < 0.9 * peak[layered_asm]


@pytest.mark.parametrize("layer", [0, 3, 7])
def test_layered_asm_is_sharp_at_its_own_layer(layer: int) -> None:
    amplitude, _ = smooth_scene()
    normalised = (layer + 0.5) / 8
    field = layered_asm(amplitude, torch.full((64, 64), normalised), OPTICS)
    back = intensity(propagate(field, OPTICS, OPTICS.distance_m(OPTICS.dioptres(normalised))))
    assert (back - amplitude.square()).abs().max() < 0.01
    elsewhere = intensity(propagate(field, OPTICS, OPTICS.distance_m(OPTICS.dioptres(1 - normalised))))
    assert layer == 3 or (elsewhere - amplitude.square()).abs().max() > 0.02


def test_rgbd_blur_is_a_disc_of_confusion_that_nearer_things_hide() -> None:
    near, far = (17.5 / 24, 3.5 / 24)
    focus = [OPTICS.dioptres(near), OPTICS.dioptres(far)]
    point = torch.zeros(3, 64, 64)
    point[:, 32, 32] = 1
    sharp, soft = rgbd_blur(point, torch.full((64, 64), near), OPTICS, focus, 2.0)
    torch.testing.assert_close(sharp, point, atol=1e-4, rtol=0)
    assert soft.sum().item() == pytest.approx(3, rel=0.02)
    diameter = coc_px(OPTICS, torch.tensor([[near]]), [focus[1]], 2.0).item()
    offsets = torch.arange(64) - 32.0
    radius = torch.hypot(offsets[:, None], offsets[None])
    inside = soft[0][radius < 0.5 * diameter - 1]
    expected = 4 / (math.pi * diameter**2)
    assert inside.mean().item() == pytest.approx(expected, rel=0.1)
    assert soft[0][radius > 0.5 * diameter + 1].abs().max() < 0.3 * expected

    # A bright half in front of a dark one: where its disc covers the share α of a pixel, α of its light is there.
    depth = torch.full((64, 64), far)
    depth[:, :32] = near
    amplitude = torch.where(depth == near, 0.9, 0.1).expand(3, -1, -1)
    sharp, soft = rgbd_blur(amplitude, depth, OPTICS, focus, 2.0)
    torch.testing.assert_close(sharp, amplitude.square(), atol=1e-3, rtol=0)
    for column in (33, 35, 37):
        t = (column + 0.5 - 32) / (0.5 * diameter)
        cover = (math.acos(t) - t * math.sqrt(1 - t * t)) / math.pi
        assert soft[0, 32, column].item() == pytest.approx(0.01 + 0.8 * cover, abs=0.02)

    # A slope of one colour has no seams.
    slope = torch.linspace(0.1, 0.9, 64).expand(64, -1)
    assert (rgbd_blur(torch.full((3, 64, 64), 0.7), slope, OPTICS, focus, 3.0) - 0.49).abs().max() < 0.01


def test_flat_oracle_shows_one_picture() -> None:
    target = torch.rand(4, 3, 5, 5)
    flat = flat_oracle(target)
    assert torch.equal(flat[0], flat[3])
    torch.testing.assert_close(flat.mean(0), target.mean(0))
    assert coc_px(OPTICS, torch.zeros(2, 2), [0.0], 4.0).max() == 0

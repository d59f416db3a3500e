"""The table across benches, from tiny networks and made-up scenes."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest
import torch
from conftest import write_shard
from test_evaluate import write_card

from holod_training.cli import main
from holod_training.config import NetworkConfig
from holod_training.export import load_weights, read_metadata, save_weights
from holod_training.goals import bench_checks, right_pupil_margins_db
from holod_training.judging import Bench, network_field, network_method, open_alike
from holod_training.refocus import refocus_cards
from holod_training.shards import Shard
from holod_training.variants import build_network

TINY = NetworkConfig(layers=4, channels=4, adjustable_layers=(1,), modulation_hidden=4)
PUPILS = (2.0, 4.0)
SHIPPED = Path(__file__).parents[2] / "weights"
GAEA = {"pixel_angle_rad": str(3.74e-6 / 40e-3), "pixel_pitch_um": "3.74", "wavelengths_nm": "[633.0, 532.0, 473.0]"}


@torch.no_grad()
def psnr_db(folder: Path, bench_name: str, network_name: str, amplitude_constant: float) -> float:
    """At a pupil of 2 mm, mean over scenes."""
    network = load_weights(folder / f"{network_name}.safetensors")
    found = []
    for shard in open_alike(folder / bench_name):
        index = shard.nearest_pupil(2.0)
        bench = Bench(shard.optics, amplitude_constant, 8)
        stack = bench.read(shard, index)
        panel, _ = bench.panel(network_field(network.on(shard.optics), stack, stack.pupil_mm))
        found.append(bench.judge(bench.look(panel, stack.pupil_mm, stack.focus_dpt), stack).psnr_db)
    return sum(found) / len(found)


def test_each_bench_has_a_row_for_each_network_and_one_for_the_rival(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    torch.manual_seed(1)
    command = ["across-benches", "--out", str(tmp_path / "out"), "--border-px", "8"]
    for name, constant in (("one", 1.4), ("other", 0.8)):
        network = build_network(dataclasses.replace(TINY, amplitude_constant=constant))
        save_weights(tmp_path / f"{name}.safetensors", network, {}, {})
        command += ["--weights", str(tmp_path / f"{name}.safetensors")]
    for folder, metadata in (("default", {}), ("gaea-40", GAEA)):
        for index in range(2):
            write_shard(tmp_path / folder / f"scene_{index:06}.safetensors", seed=index, metadata=metadata)
        command += ["--test", str(tmp_path / folder)]
    assert main(command) == 0
    table = capsys.readouterr().out
    found = json.loads((tmp_path / "out" / "benches.json").read_text())["benches"]
    assert [bench["bench"] for bench in found] == ["default", "gaea-40"]
    for bench in found:
        assert len(bench["rows"]) == 3 * 4 and bench["scenes"] == 2
        assert {row["method"] for row in bench["rows"]} == {"one", "other", "smooth phase"}
        assert bench["gain_over_rival"].keys() == bench["matrix_psnr_db"].keys() == {"one", "other"}
        at_two = {row["method"]: row["psnr_db"] for row in bench["rows"] if row["pupil_mm"] == 2.0}
        gain = bench["gain_over_rival"]["one"][1]["psnr_db"]["mean"]
        assert gain == pytest.approx(at_two["one"] - at_two["smooth phase"], abs=1e-4)
        assert bench["matrix_psnr_db"]["one"][1][1] == pytest.approx(at_two["one"], abs=1e-3)
        assert at_two["one"] != at_two["other"]
        own, others = (psnr_db(tmp_path, bench["bench"], "other", constant) for constant in (0.8, 1.4))
        assert at_two["other"] == pytest.approx(own, abs=1e-3) and abs(own - others) > 0.01
        # The rival is seen with the constant of the network that it stands beside; its row has the first one's.
        beside_other = at_two["other"] - bench["gain_over_rival"]["other"][1]["psnr_db"]["mean"]
        assert abs(beside_other - at_two["smooth phase"]) > 0.01
    default, gaea = found
    assert default["volume_fresnel_px2"] == pytest.approx([45.57, 37.14, 32.14])
    assert gaea["volume_fresnel_px2"][1] == pytest.approx(532e-9 * (40e-3 / 3.74e-6) ** 2 / 0.35, abs=0.01)
    assert gaea["volume_blur_px"][1] / default["volume_blur_px"][1] == pytest.approx(8 / 3.74, rel=1e-3)
    assert default["rows"][0]["psnr_db"] != gaea["rows"][0]["psnr_db"]
    assert "**gaea-40**: 3.74 um, 40 mm, 633/532/473 nm, 0 to 2.86 dpt" in table
    assert "2 scenes of 64x64; outside what one, other were trained for" in " ".join(table.split())
    assert (default["outside_training"], gaea["outside_training"]) == ([], ["one", "other"])
    assert default["pupils_outside_training_mm"] == {}
    assert gaea["pupils_outside_training_mm"] == {name: [3.0, 4.0] for name in ("one", "other")}
    for name in ("one", "other"):
        cells = [line.split(" | ") for line in table.splitlines() if line.startswith(f"| {name} |")]
        assert [[cell.endswith(" †") for cell in row[1:5]] for row in cells] == [[False] * 4, [False] * 2 + [True] * 2]
        assert f"| default | {name} |" in table and f"| gaea-40 | {name} † |" in table
    assert "; † a blur that the network was not trained for" in " ".join(table.split())
    assert table.count("| smooth phase | ") == 2 and "refocus ratio |" not in table
    for bench in found:
        matrix = bench["matrix_psnr_db"]["one"]
        others = max(matrix[given][1] for given in (0, 2, 3))
        assert bench["right_pupil_margin_db"]["one"][1] == pytest.approx(matrix[1][1] - others, abs=2e-3)
        (row,) = [line for line in table.splitlines() if line.startswith(f"| {bench['bench']} | one ")]
        assert f"{min(bench['right_pupil_margin_db']['one']):+.2f}" in row.replace("*", "")


def write_benches(tmp_path: Path) -> list[str]:
    """One network, two benches with cards of both contrasts; the command without --cards."""
    torch.manual_seed(1)
    save_weights(tmp_path / "one.safetensors", build_network(TINY), {}, {})
    command = ["across-benches", "--out", str(tmp_path / "out"), "--border-px", "8"]
    command += ["--weights", str(tmp_path / "one.safetensors")]
    for bench, metadata in (("default", {}), ("gaea-40", GAEA)):
        write_shard(tmp_path / "test" / bench / "scene_000000.safetensors", pupils_mm=PUPILS, metadata=metadata)
        for index in range(2):
            write_card(tmp_path / "cards" / bench / f"scene_{index:06}.safetensors", index, metadata)
        command += ["--test", str(tmp_path / "test" / bench)]
    return command


@torch.no_grad()
def test_refocus_ratios_are_of_each_bench_at_the_pupils_of_the_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = write_benches(tmp_path)
    assert main([*command, "--cards", str(tmp_path / "cards" / "gaea-40")]) == 0
    default, gaea = json.loads((tmp_path / "out" / "benches.json").read_text())["benches"]
    assert "refocus" not in default
    assert [row["pupil_mm"] for row in gaea["refocus"]] == [*PUPILS] * 4
    cards = [Shard(tmp_path / "cards" / "gaea-40" / f"scene_{index:06}.safetensors") for index in range(2)]
    network = load_weights(tmp_path / "one.safetensors").on(cards[0].optics)
    bench = Bench(cards[0].optics, network.config.amplitude_constant, 8)
    ours = refocus_cards(cards, [network_method("one", network)], bench, pupils_mm=PUPILS)
    assert [row for row in gaea["refocus"] if row["method"] == "one"] == ours
    assert {row["method"] for row in gaea["refocus"]} == {"one", "smooth phase"}
    table = capsys.readouterr().out
    tables, _, goals = table.partition("## Goals")
    (head,) = [line for line in tables.splitlines() if "| refocus, dark marks | refocus, bright marks |" in line]
    assert head.startswith("| method | s = 2 mm | s = 4 mm | right pupil ahead, dB | foam |")
    dark = [min(row["near_card"], row["far_card"]) for row in ours if row["contrast"] == "dark on bright"]
    assert f"| {dark[0]:.2f} / {dark[1]:.2f} |" in tables
    least = min(min(row["near_card"], row["far_card"]) for row in ours)
    cells = {line.split(" | ")[0]: line.split(" | ")[-1] for line in goals.splitlines() if " | one " in line}
    assert cells == {"| default": "- |", "| gaea-40": f"**{least:.2f}** (at least 1.8) |"} and least < 1.8


def test_cards_of_no_bench_and_other_scenes_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = write_benches(tmp_path)
    cards = tmp_path / "cards"
    (cards / "leto-40").mkdir()
    for folders, message in (
        ([cards / "leto-40"], "--cards: found a folder named 'leto-40', expected the name of one of --test's"),
        ([cards / "default"] * 2, "--cards: found a folder named 'default', expected the name of one of --test's"),
        ([tmp_path / "test" / "default"], "a scene of kind 'test', expected cards"),
    ):
        assert main([*command, *(word for folder in folders for word in ("--cards", str(folder)))]) == 65
        assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def bench_result(**changes: object) -> dict:
    """What `across-benches` found of a network that reaches everything, with changes."""
    gains = [{"psnr_db": {"mean": 4.5}, "psnr_in_focus_db": {"mean": 0.1}} for _ in range(2)]
    ratios = {"method": "one", "contrast": "dark on bright", "pupil_mm": 2.0, "near_card": 1.9, "far_card": 2.4}
    return {
        "volume_fresnel_px2": [71.0, 60.0, 53.0],
        "gain_over_rival": {"one": gains},
        "matrix_psnr_db": {"one": [[27.0, 24.0], [26.0, 26.5]]},
        "refocus": [ratios, {**ratios, "method": "smooth phase", "near_card": 1.1}],
        **changes,
    }


def test_goals_of_a_bench_are_judged_by_the_least_of_its_pupils() -> None:
    met = {what: (found, passed) for what, found, _, passed in bench_checks(bench_result(), "one")}
    assert met == {
        "over smooth phase, dB": ("+4.50", True),
        "in focus over smooth phase, dB": ("+0.10", True),
        "right pupil ahead by, dB": ("+1.00", True),
        "refocus ratio": ("1.90", True),
    }
    for changes, missed in (
        ({"gain_over_rival": {"one": [{"psnr_db": {"mean": 5.0}}, {"psnr_db": {"mean": 3.9}}]}}, "over smooth phase"),
        ({"gain_over_rival": {"one": [{"psnr_in_focus_db": {"mean": -0.21}}]}}, "in focus over smooth phase"),
        ({"matrix_psnr_db": {"one": [[27.0, 26.6], [26.0, 26.5]]}}, "right pupil ahead by"),
        ({"refocus": [{"method": "one", "near_card": 1.9, "far_card": 1.79}]}, "refocus ratio"),
    ):
        found = bench_checks(bench_result(**changes), "one")
        assert [what.partition(", dB")[0] for what, _, _, passed in found if not passed] == [missed]
    diffracting = bench_result(volume_fresnel_px2=[209.0, 170.0, 147.0])
    assert ("over smooth phase, dB", "+4.50", "at least 3", True) in bench_checks(diffracting, "one")
    assert ("over smooth phase, dB", "+4.50", "at least 4", True) in bench_checks(bench_result(), "one")
    assert right_pupil_margins_db([[27.0]]) == []


def test_a_folder_without_scenes_is_said_before_the_long_work(tmp_path: Path) -> None:
    save_weights(tmp_path / "one.safetensors", build_network(TINY), {}, {})
    command = ["across-benches", "--weights", str(tmp_path / "one.safetensors"), "--out", str(tmp_path / "out")]
    assert main([*command, "--test", str(tmp_path / "none")]) == 65
    assert not (tmp_path / "out").exists()


def test_two_benches_of_one_name_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_weights(tmp_path / "one.safetensors", build_network(TINY), {}, {})
    command = ["across-benches", "--weights", str(tmp_path / "one.safetensors"), "--out", str(tmp_path / "out")]
    for bench, metadata in (("default", {}), ("gaea", GAEA)):
        write_shard(tmp_path / bench / "test" / "scene_000000.safetensors", metadata=metadata)
        command += ["--test", str(tmp_path / bench / "test")]
    assert main([*command, "--border-px", "8"]) == 65
    assert "--test: found two folders of one name" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_borders_and_limits_that_leave_nothing_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_weights(tmp_path / "one.safetensors", build_network(TINY), {}, {})
    write_shard(tmp_path / "test" / "scene_000000.safetensors")
    command = ["across-benches", "--weights", str(tmp_path / "one.safetensors"), "--out", str(tmp_path / "out")]
    command += ["--test", str(tmp_path / "test")]
    for options, message in (
        (("--border-px", "27"), "--border-px: found 27, expected at most 26: "),
        (("--border-px", "-1"), "--border-px: found -1, expected at least 0"),
        (("--limit", "0"), "--limit: found 0, expected at least 1 scene"),
    ):
        assert main([*command, *options]) == 65
        assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_export_carries_what_a_network_reached_on_each_bench(tmp_path: Path) -> None:
    torch.manual_seed(1)
    source, out = tmp_path / "one.safetensors", tmp_path / "exported.safetensors"
    save_weights(source, build_network(TINY), {"seed": 1}, {})
    write_shard(tmp_path / "gaea-40" / "scene_000000.safetensors", metadata=GAEA)
    command = ["across-benches", "--weights", str(source), "--test", str(tmp_path / "gaea-40"), "--border-px", "8"]
    assert main([*command, "--out", str(tmp_path)]) == 0
    export = ["export", "--source", str(source), "--out", str(out), "--benches", str(tmp_path / "benches.json")]
    assert main(export) == 65 and not out.exists(), "nothing of that name was judged"
    assert main([*export, "--benches-method", "one"]) == 0
    metrics = read_metadata(out)["metrics"]
    (bench,) = metrics["benches"]
    judged = json.loads((tmp_path / "benches.json").read_text())["benches"][0]
    assert metrics["seed"] == 1 and bench["bench"] == "gaea-40"
    assert [row["volume_blur_px"] for row in bench["rows"]] == judged["volume_blur_px"]
    assert bench["rows"][1]["psnr_db"] == pytest.approx(judged["rows"][1]["psnr_db"], abs=0.006)
    gain = judged["gain_over_rival"]["one"][1]["psnr_db"]["mean"]
    assert bench["rows"][1]["over_smooth_phase_db"] == pytest.approx(gain, abs=0.006)


def test_figures_of_other_weights_or_of_another_constant_are_not_exported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    torch.manual_seed(1)
    source, out, table = (tmp_path / name for name in ("one.safetensors", "out/one.safetensors", "benches.json"))
    network = build_network(TINY)
    save_weights(source, network, {"seed": 1}, {})
    write_shard(tmp_path / "default" / "scene_000000.safetensors")
    command = ["across-benches", "--weights", str(source), "--test", str(tmp_path / "default"), "--border-px", "8"]
    assert main([*command, "--out", str(tmp_path)]) == 0
    export = ["export", "--source", str(source), "--out", str(out), "--benches", str(table)]

    def refused(*options: str) -> str:
        capsys.readouterr()
        assert main([*export, *options]) == 65 and not out.exists()
        return capsys.readouterr().err

    told = refused("--amplitude-constant", "4")
    assert "benches.json: amplitude_constant: found 1.4, expected 4, that of the file to write" in told
    with torch.no_grad():
        next(network.parameters())[0] += 1e-6
    save_weights(source, network, {"seed": 1}, {})
    assert "benches.json: weights_sha256 of 'one': found " in refused()
    older = {key: value for key, value in json.loads(table.read_text()).items() if key != "networks"}
    table.write_text(json.dumps(older))
    assert "does not say of which weights its figures are" in refused()
    for content in ("[]", "{}", '{"benches": [1], "networks": [1]}', '{"benches": 1, "networks": 1}'):
        table.write_text(content)
        assert "benches.json: " in refused()
    table.write_bytes(b"\xff")
    assert "benches.json: not a table across benches" in refused()


@pytest.mark.parametrize("name", ["standard", "small", "fast"])
def test_the_shipped_table_is_of_the_shipped_weights(name: str, tmp_path: Path) -> None:
    shipped, out = SHIPPED / f"{name}.safetensors", tmp_path / f"{name}.safetensors"
    benches = SHIPPED / "evaluation" / "benches.json"
    assert main(["export", "--source", str(shipped), "--out", str(out), "--benches", str(benches)]) == 0
    assert read_metadata(out) == read_metadata(shipped)

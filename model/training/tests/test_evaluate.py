import json
from pathlib import Path

import pytest
import torch
from conftest import write_shard
from PIL import Image
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from holod_training.cli import main
from holod_training.config import NetworkConfig, OpticsConfig
from holod_training.evaluate import card_areas
from holod_training.export import load_weights, read_metadata, save_weights
from holod_training.network import DirectNetwork
from holod_training.optics import coc_px, intensity, propagate
from holod_training.report import bars, row_of
from holod_training.rivals import all_in_focus, flat_oracle, layered_asm

PUPILS = (1.0, 2.0, 3.0, 4.0, 5.0)
OPTICS = OpticsConfig()


def write_card(path: Path, seed: int) -> None:
    write_shard(path, seed=seed, size=128, pupils_mm=PUPILS)
    with safe_open(path, framework="pt") as file:
        metadata = file.metadata()
    tensors = load_file(path)
    near, far = 2.5 / OPTICS.depth_near_dpt, 0.25 / OPTICS.depth_near_dpt
    tensors["depth"] = torch.where(torch.arange(128) < 64, near, far).expand(128, 128).contiguous()
    save_file(tensors, path, metadata)


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(1)
    tmp_path = tmp_path_factory.mktemp("evaluation")
    weights = tmp_path / "w.safetensors"
    save_weights(weights, DirectNetwork(NetworkConfig(layers=4, channels=8, adjustable_layers=(1,))), {}, {"seed": 1})
    write_shard(tmp_path / "test" / "scene_000000.safetensors", size=64, pupils_mm=PUPILS)
    for index in range(2):
        write_card(tmp_path / "cards" / f"scene_{index:06}.safetensors", seed=index)
    arguments = ["--weights", weights, "--test", tmp_path / "test", "--cards", tmp_path / "cards"]
    assert main(["evaluate", *map(str, arguments), "--out", str(tmp_path / "out")]) == 0
    return tmp_path


def test_evaluation_is_complete(evaluation: Path) -> None:
    result = json.loads((evaluation / "out" / "evaluation.json").read_text())
    for method in ("holod", "all-in-focus", "layered ASM"):
        for stage in ("before", "after"):
            for pupil in PUPILS:
                assert row_of(result, method, stage, pupil)["psnr_db"] > 5
    assert row_of(result, "flat oracle", "before", 4.0)["slope"] == 0
    matrix = result["matrix_psnr_db"]["after"]
    for index, pupil in enumerate(PUPILS):
        assert matrix[index][index] == pytest.approx(row_of(result, "holod", "after", pupil)["psnr_db"], abs=1e-3)
    assert matrix[0][4] != pytest.approx(matrix[4][4], abs=1e-3)
    assert len(result["refocus"]) == 2 * 3 * 5
    text = (evaluation / "out" / "evaluation.md").read_text()
    assert "## After double phase" in text and "refocus ratio, near card, bright on dark, s = 4 mm" in text
    assert Image.open(evaluation / "out" / "sheet.png").size == (4 * 68, 2 * 68)
    assert Image.open(evaluation / "out" / "cards.png").size == (5 * 132, 2 * 132)


def test_bars_reject_a_flat_network_and_an_ignored_pupil(evaluation: Path) -> None:
    result = json.loads((evaluation / "out" / "evaluation.json").read_text())
    row_of(result, "holod", "after", 2.0)["slope"] = 0.19
    result["matrix_psnr_db"]["after"] = [[20.0] * 5 for _ in range(5)]
    verdicts = {what: passed for what, _, _, passed in bars(result)}
    assert not verdicts["slope at s = 2 mm"]
    assert not verdicts["right over opposite s, judged s = 1 mm"]
    assert verdicts["right s behind the best, judged s = 3 mm"]
    result["matrix_psnr_db"]["after"][0][2] = 20.2
    assert not {what: passed for what, _, _, passed in bars(result)}["right s behind the best, judged s = 3 mm"]


def test_evaluation_needs_the_five_pupils(evaluation: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_shard(evaluation / "few" / "scene_000000.safetensors", pupils_mm=(1.0, 2.0))
    arguments = ["--weights", str(evaluation / "w.safetensors"), "--test", str(evaluation / "few")]
    assert main(["evaluate", *arguments, "--out", str(evaluation / "none")]) == 65
    assert "evaluation needs (1.0, 2.0, 3.0, 4.0, 5.0)" in capsys.readouterr().err


def test_export_stamps_the_constant_and_the_evaluation(evaluation: Path) -> None:
    out = evaluation / "shipped.safetensors"
    arguments = ["--source", str(evaluation / "w.safetensors"), "--out", str(out), "--amplitude-constant", "1.25"]
    assert main(["export", *arguments, "--evaluation", str(evaluation / "out" / "evaluation.json")]) == 0
    metadata = read_metadata(out)
    assert metadata["config"].amplitude_constant == 1.25
    assert {row["method"] for row in metadata["metrics"]["rows"]} == {"holod"}
    assert metadata["provenance"] == {"seed": 1}
    before, after = load_weights(evaluation / "w.safetensors").state_dict(), load_weights(out).state_dict()
    assert all(torch.equal(before[name], after[name]) for name in before)
    assert main(["export", *arguments[:4], "--amplitude-constant", "0"]) == 65


def test_card_areas_leave_out_border_and_seam() -> None:
    depth = torch.where(torch.arange(128) < 64, 2.5 / OPTICS.depth_near_dpt, 0.25 / OPTICS.depth_near_dpt)
    areas = card_areas(depth.expand(128, 128), OPTICS, border_px=10)
    assert areas["near"].nonzero().amin(0).tolist() == [10, 10]
    assert areas["near"].nonzero().amax(0).tolist() == [117, 47]
    assert areas["far"].nonzero().amin(0).tolist() == [10, 80]


def smooth_scene() -> tuple[torch.Tensor, torch.Tensor]:
    y, x = torch.meshgrid(torch.arange(64.0), torch.arange(64.0), indexing="ij")
    light = 0.5 + 0.3 * torch.sin(2 * torch.pi * x / 16) * torch.cos(2 * torch.pi * y / 32)
    return light.expand(3, -1, -1).sqrt(), torch.full((64, 64), 0.5)


def test_all_in_focus_is_sharp_in_the_middle() -> None:
    amplitude, depth = smooth_scene()
    field = all_in_focus(amplitude, depth, OPTICS)
    back = intensity(propagate(field, OPTICS, OPTICS.distance_m(OPTICS.dioptres(0.5))))
    assert (back - amplitude.square()).abs().max() < 0.01


@pytest.mark.parametrize("layer", [0, 3, 7])
def test_layered_asm_is_sharp_at_its_own_layer(layer: int) -> None:
    amplitude, _ = smooth_scene()
    normalised = (layer + 0.5) / 8
    field = layered_asm(amplitude, torch.full((64, 64), normalised), OPTICS)
    back = intensity(propagate(field, OPTICS, OPTICS.distance_m(OPTICS.dioptres(normalised))))
    assert (back - amplitude.square()).abs().max() < 0.01
    elsewhere = intensity(propagate(field, OPTICS, OPTICS.distance_m(OPTICS.dioptres(1 - normalised))))
    assert layer == 3 or (elsewhere - amplitude.square()).abs().max() > 0.02


def test_flat_oracle_shows_one_picture() -> None:
    target = torch.rand(4, 3, 5, 5)
    flat = flat_oracle(target)
    assert torch.equal(flat[0], flat[3])
    torch.testing.assert_close(flat.mean(0), target.mean(0))
    assert coc_px(OPTICS, torch.zeros(2, 2), [0.0], 4.0).max() == 0

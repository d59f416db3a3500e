from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from holod_training.golden import write_golden

COMMITTED = Path(__file__).parents[2] / "golden"
SHIPPED = Path(__file__).parents[2] / "weights" / "direct-halfband-14.safetensors"


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("golden")
    write_golden(out, SHIPPED)
    return out


@pytest.mark.parametrize("name", ["direct-narrow", "direct-narrow-full", "direct-shipped"])
def test_committed_vectors_are_what_the_script_writes(name: str, written: Path) -> None:
    files = [f"{name}.safetensors"] + ([f"{name}.weights.safetensors"] if name != "direct-shipped" else [])
    for file in files:
        ours, committed = load_file(written / file), load_file(COMMITTED / file)
        assert ours.keys() == committed.keys()
        for key, value in ours.items():
            torch.testing.assert_close(value, committed[key], rtol=1e-5, atol=1e-5, msg=lambda m, k=key: f"{k}: {m}")


def test_comparison_would_notice_one_wrong_value(written: Path) -> None:
    tensors = load_file(written / "direct-narrow.safetensors")
    wrong = tensors["layer_7"].clone()
    wrong[3, 5, 7] += 1e-3
    with pytest.raises(AssertionError):
        torch.testing.assert_close(wrong, tensors["layer_7"], rtol=1e-5, atol=1e-5)


def test_no_stage_of_the_vectors_is_idle() -> None:
    vectors = load_file(COMMITTED / "direct-narrow.safetensors")
    assert vectors["offsets_7"].abs().max() > 1.5
    assert vectors["low"][1].abs().mean() > 0.01
    assert (vectors["eye_field"][0] - vectors["eye_field"][1]).abs().mean() > 1e-3
    assert (vectors["eye_field"] - vectors["eye_panel"]).abs().mean() < 0.05

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file

from holod_training.config import OpticsConfig
from holod_training.export import WeightsError, save_weights, write_beside
from holod_training.golden import NARROW, narrow_network, scene, vectors, write_golden
from holod_training.optics import coc_px, frequencies, pupil_mask
from holod_training.shards import Shard
from holod_training.variants import build_network, variant

COMMITTED = Path(__file__).parents[2] / "golden"
WEIGHTS = Path(__file__).parents[2] / "weights"
NETS = ("lighting", "correction")


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("golden")
    write_golden(out, *(WEIGHTS / f"{name}.safetensors" for name in ("standard", "small", "fast")))
    return out


@pytest.mark.parametrize(
    "name",
    [*NARROW, *(f"expected-stack-shipped{suffix}" for suffix in ("", "-small", "-fast"))],
)
def test_committed_vectors_are_what_the_script_writes(name: str, written: Path) -> None:
    files = [f"{name}.safetensors"] + ([f"{name}.weights.safetensors"] if "narrow" in name else [])
    for file in files:
        ours, committed = load_file(written / file), load_file(COMMITTED / file)
        assert ours.keys() == committed.keys()
        for key, value in ours.items():
            torch.testing.assert_close(value, committed[key], rtol=1e-5, atol=1e-5, msg=lambda m, k=key: f"{k}: {m}")


@pytest.mark.parametrize(
    ("name", "key"), [("direct-narrow", "layer_7"), ("expected-stack-narrow", "correction.layer_3")]
)
def test_comparison_would_notice_one_wrong_value(name: str, key: str, written: Path) -> None:
    tensors = load_file(written / f"{name}.safetensors")
    wrong = tensors[key].clone()
    wrong[3, 5, 7] += 1e-3
    with pytest.raises(AssertionError):
        torch.testing.assert_close(wrong, tensors[key], rtol=1e-5, atol=1e-5)


def test_no_stage_of_the_vectors_is_idle() -> None:
    found = load_file(COMMITTED / "direct-narrow.safetensors")
    assert found["offsets_7"].abs().max() > 1.5
    assert found["low"][1].abs().mean() > 0.01
    assert (found["eye_field"][0] - found["eye_field"][1]).abs().mean() > 1e-3
    assert (found["eye_field"] - found["eye_panel"]).abs().mean() < 0.05


def test_no_stage_of_the_expected_stack_vectors_is_idle() -> None:
    found = load_file(COMMITTED / "expected-stack-narrow.safetensors")
    carried, low = (torch.complex(*found[name]) for name in ("carried", "low"))
    seen = found["correction.encoded"]
    assert seen.shape == (82, 8, 12) and found["lighting.encoded"].shape == (46, 8, 12)
    torch.testing.assert_close(seen[6:52], found["lighting.encoded"])
    field, change = (torch.complex(*seen[first : first + 6].split(3)) for first in (0, 52))
    torch.testing.assert_close(field, carried + 0.5 * change, rtol=1e-5, atol=1e-5)
    residual = torch.complex(*found["correction.layer_3"].split(3))
    torch.testing.assert_close(low, field + 0.3 * residual, rtol=1e-5, atol=1e-5)
    for part in (carried, change, seen[58:], residual):
        assert part.abs().mean() > 0.01
    assert found["pupil_mm"].item() == pytest.approx(1.6)
    optics = NARROW["expected-stack-narrow"].optics
    inside = pupil_mask(optics, *(frequencies(n, 2 * optics.pitch_m) for n in (12, 8)), 1.6)
    spectrum = torch.fft.fft2(change).abs()
    assert not inside.all() and spectrum[~inside].max() < 1e-5 * spectrum.max()


def test_the_vectors_of_a_refined_stack_change_what_is_told() -> None:
    found = load_file(COMMITTED / "expected-stack-narrow-refined.safetensors")
    assert found["lighting.layer_3"].shape == (56, 8, 12)
    refined = found["lighting.encoded"][22:] + 0.4 + 0.3 * found["lighting.layer_3"][32:]
    assert 0.05 < (refined < 0).float().mean() < 0.5


def test_no_stage_of_the_focal_stack_vectors_is_idle() -> None:
    found = load_file(COMMITTED / "focal-stack-narrow.safetensors")
    carried, low = (torch.complex(*found[name]) for name in ("carried", "low"))
    seen, told = found["correction.encoded"], found["lighting.encoded"]
    assert found["amplitude"].shape == (3, 3, 16, 24) and told.shape == (38, 8, 12) and seen.shape == (59, 8, 12)
    for image, other in ((0, 1), (1, 2), (2, 0)):
        assert (found["amplitude"][image] - found["amplitude"][other]).abs().mean() > 0.05
    torch.testing.assert_close(seen[6:44], told)
    field, change = (torch.complex(*seen[first : first + 6].split(3)) for first in (0, 44))
    torch.testing.assert_close(field, carried + 0.5 * change, rtol=1e-5, atol=1e-5)
    residual = torch.complex(*found["correction.layer_3"].split(3))
    torch.testing.assert_close(low, field + 0.3 * residual, rtol=1e-5, atol=1e-5)
    for part in (carried, change, seen[50:], residual, found["lighting.offsets_2"]):
        assert part.abs().mean() > 0.01


def test_vectors_are_computed_in_double_precision() -> None:
    network = narrow_network(NARROW["expected-stack-narrow"].config, 3)
    amplitude, depth = scene(32, 48, 3)
    double = vectors(network.double(), amplitude, depth, 2.7)
    single = network.float()(amplitude[None], depth[None], torch.tensor([2.7]))[0]
    for name in ("carried", "low", "field", "correction.encoded", "correction.layer_3"):
        assert double[name].dtype == torch.float64, name
    assert 1e-9 < (single - torch.complex(*double["low"])).abs().max() < 1e-5


def test_shipped_weights_have_files_named_for_them(tmp_path: Path) -> None:
    """The first, the adjustable and the last layer of both nets, and every other stage. What another family left in
    their place goes, and nothing else."""
    shipped = tmp_path / "shipped.safetensors"
    save_weights(shipped, narrow_network(NARROW["expected-stack-narrow"].config, 3), {}, {})
    stale, other = (tmp_path / "out" / f"direct-shipped{suffix}.safetensors" for suffix in ("-small", ""))
    for path in (stale, other):
        write_beside(path, b"")
    with pytest.raises(WeightsError, match=r"direct-shipped-small\.safetensors exists already; .* with --force"):
        write_golden(tmp_path / "out", None, shipped)
    assert sorted((tmp_path / "out").iterdir()) == [stale, other], "nothing was written"
    files = write_golden(tmp_path / "out", None, shipped, force=True)
    assert files[-1] == tmp_path / "out" / "expected-stack-shipped-small.safetensors"
    assert other.exists() and not stale.exists()
    written = load_file(files[-1]).keys()
    assert written >= {"carried", "lighting.encoded", "correction.encoded", "lighting.offsets_2", "low"}
    layers = {net: [name for name in sorted(written) if name.startswith(f"{net}.layer_")] for net in NETS}
    assert layers["lighting"] == ["lighting.layer_0", "lighting.layer_2", "lighting.layer_3"]
    assert layers["correction"] == ["correction.layer_0", "correction.layer_3"]


@pytest.mark.parametrize("name", ["focal-stack", "half-band-layered-small"])
def test_networks_that_no_engine_runs_have_no_vectors(name: str, tmp_path: Path) -> None:
    shipped = tmp_path / "shipped.safetensors"
    save_weights(shipped, build_network(variant(name)), {}, {})
    with pytest.raises(WeightsError, match=f"found a `{variant(name).architecture}` network"):
        write_golden(tmp_path / "out", None, shipped)


def found_in(path: Path) -> Any:
    with safe_open(path, framework="pt") as file:
        return json.loads(file.metadata()["found"])


def flattened(found: Any) -> list[float]:
    rows = [value for row in found["rows"] for value in row.values()]
    return rows + [value for row in found["matrix_psnr_db"] for value in row]


def test_committed_evaluation_is_what_the_script_writes(written: Path) -> None:
    ours, committed = (load_file(folder / "evaluation.safetensors") for folder in (written, COMMITTED))
    assert ours.keys() == committed.keys()
    for key, value in ours.items():
        torch.testing.assert_close(value, committed[key], rtol=1e-3, atol=1e-3, msg=lambda m, k=key: f"{k}: {m}")
    found, expected = (flattened(found_in(folder / "evaluation.safetensors")) for folder in (written, COMMITTED))
    assert found == pytest.approx(expected, abs=2e-3)
    expected[4] += 5e-3
    assert found != pytest.approx(expected, abs=2e-3), "the comparison is blind"


def test_committed_evaluation_tells_right_from_wrong() -> None:
    """Every figure is one that a fault would change: far from what a picture without focus would score."""
    found = found_in(COMMITTED / "evaluation.safetensors")
    for row in found["rows"]:
        assert row["psnr_db"] > row["flat_oracle_psnr_db"] + 0.5
        assert row["slope"] > 0.2 and row["correlation"] > 0.5 and row["ssim"] > 0.4
        assert min(row["near_card"], row["far_card"]) > 2 and 0 < row["clipped_share"] < 0.02
    given_narrow, given_wide = found["matrix_psnr_db"]
    assert given_narrow[0] > given_wide[0] and given_wide[1] > given_narrow[1]


def test_no_blur_of_the_committed_evaluation_lies_on_the_rim_of_in_or_out_of_focus() -> None:
    """There single and double precision may decide differently, and the comparison would compare roundings."""
    for stack in Shard(COMMITTED / "evaluation.safetensors").stacks():
        blur = coc_px(OpticsConfig(), stack.depth, list(stack.focus_dpt), stack.pupil_mm)
        assert min((blur - rim).abs().min() for rim in (2.0, 8.0)) > 1e-3
        assert (blur < 2).any() and (blur > 8).any()

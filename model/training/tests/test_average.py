from __future__ import annotations

from pathlib import Path

import pytest
import torch

from holod_training.cli import main
from holod_training.export import load_weights, read_metadata, save_weights
from holod_training.golden import narrow_network
from holod_training.variants import variant

ENDS = (("first", 1), ("second", 2))


@pytest.fixture
def files(tmp_path: Path) -> dict[str, str]:
    config = variant("refined-stack-fast")
    for name, seed in ENDS:
        save_weights(tmp_path / f"{name}.safetensors", narrow_network(config, seed), {}, {"seed": seed})
    return {name: str(tmp_path / f"{name}.safetensors") for name in ("first", "second", "mean")}


def test_each_weight_lies_between_its_parts_by_the_shares(files: dict[str, str]) -> None:
    parts = ["--weights", files["first"], "0.25", "--weights", files["second"], "0.75"]
    assert main(["average", *parts, "--out", files["mean"]]) == 0
    states = {name: load_weights(Path(path)).state_dict() for name, path in files.items()}
    for name, mean in states["mean"].items():
        torch.testing.assert_close(mean, 0.25 * states["first"][name] + 0.75 * states["second"][name])
    assert any(not torch.equal(mean, states["first"][name]) for name, mean in states["mean"].items())
    parts = read_metadata(Path(files["mean"]))["provenance"]["parts"]
    assert parts == [{"share": 0.25, "of": {"seed": 1}}, {"share": 0.75, "of": {"seed": 2}}]


@pytest.mark.parametrize(
    ("shares", "told"),
    [
        (["0.5", "0.6"], "found shares of 0.5, 0.6, expected numbers above 0 that sum to 1"),
        (["1.5", "-0.5"], "found shares of 1.5, -0.5"),
        (["nan", "0.5"], "found shares of nan, 0.5"),
        (["half", "0.5"], "found a share of 'half', expected a number"),
    ],
)
def test_shares_that_make_no_mean_are_refused(files: dict[str, str], shares: list[str], told: str, capsys) -> None:
    parts = ["--weights", files["first"], shares[0], "--weights", files["second"], shares[1]]
    assert main(["average", *parts, "--out", files["mean"]]) != 0
    assert told in capsys.readouterr().err
    assert not Path(files["mean"]).exists()


def test_another_network_is_refused(files: dict[str, str], capsys) -> None:
    config = variant("refined-stack")
    save_weights(Path(files["second"]), narrow_network(config, 3), {}, {})
    parts = ["--weights", files["first"], "0.5", "--weights", files["second"], "0.5"]
    assert main(["average", *parts, "--out", files["mean"]]) != 0
    told = capsys.readouterr().err
    assert f"{files['second']}: found " in told
    assert f"expected the network of {files['first']}" in told
    assert not Path(files["mean"]).exists()


def test_one_file_has_no_mean(files: dict[str, str], capsys) -> None:
    assert main(["average", "--weights", files["first"], "1", "--out", files["mean"]]) != 0
    assert "found 1 file(s)" in capsys.readouterr().err


def test_what_is_there_is_overwritten_by_force_only(files: dict[str, str], tmp_path: Path, capsys) -> None:
    """One's own trial in the place of the built-in weights would be holod's `standard` at its next build."""
    mean = Path(files["mean"])
    parts = ["--weights", files["first"], "0.5", "--weights", files["second"], "0.5"]
    for command in (["average", *parts], ["export", "--source", files["first"]]):
        mean.write_bytes(b"shipped")
        assert main([*command, "--out", files["mean"]]) == 65
        told = f"error: {mean} exists already; name another place with --out, or overwrite it with --force\n"
        assert capsys.readouterr().err == told
        assert mean.read_bytes() == b"shipped"
        assert main([*command, "--out", files["mean"], "--force"]) == 0
        load_weights(mean)
    mean.unlink()
    mean.symlink_to(tmp_path / "nowhere")
    assert main(["export", "--source", files["first"], "--out", files["mean"]]) == 65
    golden = ["golden", "--out", str(tmp_path / "golden")]
    (tmp_path / "golden").mkdir()
    vector = tmp_path / "golden" / "focal-stack-narrow.safetensors"
    vector.write_bytes(b"committed")
    assert main(golden) == 65
    assert capsys.readouterr().err.splitlines()[-1].startswith(f"error: {vector} exists already; ")
    assert [*vector.parent.iterdir()] == [vector] and vector.read_bytes() == b"committed"
    assert main([*golden, "--force"]) == 0
    assert vector.stat().st_size > 1000

import dataclasses
import json
import signal
from pathlib import Path

import pytest
import torch
from conftest import write_shard
from matplotlib.figure import Figure

from holod_training.cli import main
from holod_training.compare import compare, judge_held_out
from holod_training.config import ConfigError, NetworkConfig
from holod_training.costs import operations_per_pixel
from holod_training.curves import plot_curves
from holod_training.network import DirectNetwork
from holod_training.shards import ShardError, open_shards
from holod_training.train import Run, TrainConfig, TrainingError

CPU = torch.device("cpu")


@pytest.mark.usefixtures("no_plots")
def test_variants_compete_for_the_same_time(shards: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    command = ["compare", "--shards", str(shards), "--validation", str(shards), "--out", str(out), "--crop", "48"]
    command += ["--border-px", "8", "--validation-border-px", "8", "--variants", "half-band-8,two-frames"]
    command += ["--minutes", "0.003", "--device", "cpu"]
    assert main(command) == 0
    table = capsys.readouterr().out
    assert (out / "comparison.md").read_text() == table
    result = json.loads((out / "comparison.json").read_text())
    small, two = result["rows"]
    assert (small["variant"], two["variant"]) == ("half-band-8", "two-frames")
    assert small["steps"] >= 1 and small["parameters"] == 57234
    assert small["operations_per_pixel"] < two["operations_per_pixel"]
    for row in (*result["rows"], {"pupils": result["flat oracle"]}):
        assert set(row["pupils"]) == {"2.0", "3.0", "4.0"}
        for numbers in row["pupils"].values():
            assert numbers["psnr_db"] > 5
    assert result["flat oracle"]["2.0"]["slope"] == pytest.approx(0, abs=1e-6)
    config = json.loads((out / "half-band-8" / "config.json").read_text())
    assert (config["steps"], config["network"]["layers"]) == (small["steps"], 8)
    line = next(line for line in table.splitlines() if line.startswith("| half-band-8 "))
    assert f"| 57234 | {small['operations_per_pixel'] / 1000:.1f} | {small['steps']} |" in line
    assert f"{small['pupils']['2.0']['psnr_db']:.2f} / " in line
    # Asked again, what is known is not trained again, and a new one joins.
    assert main([*command[:-5], "half-band-8,half-band-blur-input", *command[-4:]]) == 0
    again = json.loads((out / "comparison.json").read_text())["rows"]
    assert again[0] == small and again[1]["variant"] == "half-band-blur-input"
    # So does a row from before a network had some of its keys.
    known = out / "half-band-8" / "comparison.json"
    older = json.loads(known.read_text())
    for key in ("refined_stack", "feedback"):
        del older["terms"]["network"][key]
    older["terms"]["steps"] = 0
    known.write_text(json.dumps(older))
    assert main([*command[:-5], "half-band-8", *command[-4:]]) == 0
    # Rows of other terms never share a table.
    assert main([*command, "--in-focus-weight", "7"]) == 65
    assert "half-band-8/comparison.json: found another loss" in capsys.readouterr().err


@pytest.mark.usefixtures("no_plots")
def test_an_interrupted_variant_goes_on_from_its_checkpoint(
    shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = TrainConfig(
        str(shards), str(tmp_path / "out"), 1, validation=str(shards), crop=32, border_px=4, validation_border_px=8
    )
    steps_run = []
    train_step = Run.train_step

    def step(self: Run) -> dict[str, float]:
        if self.config.out.endswith("half-band-8") and self.config.checkpoint_every == self.config.steps:
            steps_run.append(self.step)
        return train_step(self)

    def interrupted(self: Run) -> dict[str, dict[str, float]]:
        raise KeyboardInterrupt

    monkeypatch.setattr(Run, "train_step", step)
    monkeypatch.setattr("holod_training.compare.seconds_per_step", lambda config, device: 0.5)
    with monkeypatch.context() as patch:
        patch.setattr(Run, "validate", interrupted)
        with pytest.raises(KeyboardInterrupt):
            compare(config, ["half-band-8"], 1, CPU)
    assert steps_run == [0, 1]
    monkeypatch.setattr("holod_training.compare.seconds_per_step", lambda config, device: 0.1)
    with pytest.raises(ConfigError, match=r"half-band-8/begun\.json: found another seed; choose another"):
        compare(dataclasses.replace(config, seed=2), ["half-band-8"], 1, CPU)
    compare(config, ["half-band-8"], 1, CPU)
    assert steps_run == [0, 1], "no step was run again"
    row = json.loads((tmp_path / "out" / "half-band-8" / "comparison.json").read_text())
    assert (row["steps"], row["step_seconds"]) == (2, 0.5) and row["pupils"]["2.0"]["psnr_db"] > 5


@pytest.mark.usefixtures("no_plots")
def test_an_interrupt_in_a_variants_last_step_begins_no_other_variant(
    shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = TrainConfig(
        str(shards), str(tmp_path / "out"), 1, validation=str(shards), crop=32, border_px=4, validation_border_px=8
    )
    train_step = Run.train_step

    def last_step(self: Run) -> dict[str, float]:
        signal.raise_signal(signal.SIGINT)
        return train_step(self)

    monkeypatch.setattr("holod_training.compare.seconds_per_step", lambda config, device: 1.0)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with monkeypatch.context() as patch:
            patch.setattr(Run, "train_step", last_step)
            with pytest.raises(KeyboardInterrupt, match=r"half-band-8 is begun: the same command goes on with it"):
                compare(config, ["half-band-8", "half-band-14"], 1, CPU)
    finally:
        signal.signal(signal.SIGINT, before)
    assert [folder.name for folder in (tmp_path / "out").iterdir()] == ["half-band-8"]
    foreign = tmp_path / "foreign" / "half-band-8"
    foreign.mkdir(parents=True)
    (foreign / "checkpoint.pt").touch()
    with pytest.raises(TrainingError, match=r"foreign/half-band-8: holds a run of no comparison; choose"):
        compare(dataclasses.replace(config, out=str(tmp_path / "foreign")), ["half-band-8"], 1, CPU)
    assert [path.name for path in foreign.iterdir()] == ["checkpoint.pt"]


def test_comparison_says_what_is_missing(shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = TrainConfig(str(shards), str(tmp_path / "out"), 1)
    with pytest.raises(ConfigError, match="validation: found no folder"):
        compare(config, ["half-band-8"], 1, CPU)
    with pytest.raises(ConfigError, match="variant: found 'half'"):
        compare(TrainConfig(str(shards), str(tmp_path), 1, validation=str(shards)), ["half"], 1, CPU)
    write_shard(tmp_path / "own" / "scene_000000.safetensors", metadata={"kind": "train"})
    own = TrainConfig(str(shards), str(tmp_path / "out"), 1, validation=str(tmp_path / "own"), crop=48, border_px=8)
    with pytest.raises(ShardError, match=r"own/scene_000000\.safetensors: metadata kind is 'train'"):
        compare(own, ["half-band-8"], 1, CPU)
    sound = TrainConfig(str(shards), str(tmp_path / "out"), 1, validation=str(shards))
    for names, seconds, message in (
        (["half-band-8"], float("inf"), "--minutes: found inf, expected a number above 0"),
        (["half-band-8"], 0, "--minutes: found 0.0, expected a number above 0"),
        ([], 1, "--variants: found '', expected some of direct-26"),
    ):
        with pytest.raises(ConfigError, match=message):
            compare(sound, names, seconds, CPU)
    assert not (tmp_path / "out").exists()
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(ConfigError, match="WORLD_SIZE: found several processes"):
        compare(TrainConfig(str(shards), str(tmp_path), 1, validation=str(shards)), ["half-band-8"], 1, CPU)


def test_operations_are_counted() -> None:
    """Layer by layer: 3x3 kernels at a quarter of the pixels, offsets, 8 a bilinear tap."""
    config = NetworkConfig(layers=4, channels=8, adjustable_layers=(1,), modulation_hidden=4)
    kernels = 2 * 9 * (22 * 8 + 2 * 8 * 8 + 8 * 18 + 8 * 6)
    assert operations_per_pixel(config) == pytest.approx((kernels + 9 * 8 * 8) / 4, rel=0.01)


def test_held_out_numbers_are_those_after_double_phase(shards: Path) -> None:
    """An amplitude constant far below the picture's clips every pixel: before double phase nothing would change."""
    torch.manual_seed(1)
    network = DirectNetwork(NetworkConfig(layers=4, channels=8, adjustable_layers=(1,)))
    scenes = open_shards(shards)
    fair = judge_held_out(network, scenes, 8)["2.0"]["psnr_db"]
    network.config = NetworkConfig(layers=4, channels=8, adjustable_layers=(1,), amplitude_constant=0.3)
    assert judge_held_out(network, scenes, 8)["2.0"]["psnr_db"] < fair - 3


def test_curves_draw_the_five_numbers_and_skip_what_old_rows_lack(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    five = {"psnr_db": 21, "psnr_in_focus_db": 22, "psnr_out_of_focus_db": 23, "slope": 0.4, "correlation": 0.5}
    rows = [
        {"kind": "validation", "step": 1, "pupils": {"2.0": {"psnr_db": 20}}},
        {"kind": "validation", "step": 2, "pupils": {"2.0": {**five, "flat_oracle_db": 25}}},
    ]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    drawn: list[list[tuple[list[float], list[float]]]] = []

    def keep(figure: Figure, path: Path, **_: object) -> None:
        drawn.extend([(list(li.get_xdata()), list(li.get_ydata())) for li in ax.lines] for ax in figure.axes)
        path.write_bytes(b"")

    monkeypatch.setattr(Figure, "savefig", keep)
    plot_curves(tmp_path)
    later = [[([2], [value])] for key, value in five.items() if key != "psnr_db"]
    assert drawn == [[], [([1, 2], [20, 21]), ([2], [25])], *later]

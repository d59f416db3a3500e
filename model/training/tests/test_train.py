import dataclasses
import errno
import json
import math
import os
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from conftest import write_shard
from safetensors.torch import load_file
from test_lpips import random_lpips_files

from holod_training import cli
from holod_training import train as train_module
from holod_training.benches import ANY_BENCH, BenchDraw
from holod_training.cli import main
from holod_training.compare import compare
from holod_training.config import ConfigError, NetworkConfig, OpticsConfig, TrainedRange
from holod_training.export import WeightsError, export, load_weights, read_checkpoint, read_metadata, save_weights
from holod_training.loss import LossWeights, focus_loss
from holod_training.network import DirectNetwork
from holod_training.optics import HalfBandEye
from holod_training.sampling import AugmentConfig
from holod_training.shards import ShardError, Stack
from holod_training.train import Run, TrainConfig, TrainingError, see, train
from holod_training.variants import build_network, variant

CPU = torch.device("cpu")
TINY = NetworkConfig(layers=4, channels=8, adjustable_layers=(1,), modulation_hidden=4)


def tiny(shards: Path, out: Path, **changes: object) -> TrainConfig:
    config = TrainConfig(
        shards=str(shards),
        out=str(out),
        steps=6,
        validation=str(shards),
        network=TINY,
        crop=48,
        border_px=8,
        validation_border_px=8,
        log_every=2,
        checkpoint_every=3,
        validate_every=6,
        rescan_every=2,
        stop_below_slope=-10,
    )
    return dataclasses.replace(config, **changes)


def test_a_run_learns_and_leaves_its_folder(shards: Path, tmp_path: Path) -> None:
    config = tiny(
        shards,
        tmp_path / "run",
        steps=60,
        crop=64,
        augment=AugmentConfig(permute_colours=0, desaturate=0, dim=0, invert=0),
        validate_every=30,
        warm_up_steps=5,
        learning_rate=5e-3,
    )
    weights = train(config, CPU)
    rows = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    losses = [r["loss"] for r in rows if r["kind"] == "train"]
    assert sum(losses[-8:]) < 0.9 * sum(losses[:8])
    assert sum(r["kind"] == "validation" for r in rows) == 2
    assert json.loads((tmp_path / "run" / "config.json").read_text())["steps"] == 60
    assert (tmp_path / "run" / "curves.png").stat().st_size > 1000
    metadata = read_metadata(weights)
    assert metadata["config"] == TINY
    assert metadata["provenance"]["steps"] == 60
    assert metadata["metrics"]["validation_before_double_phase"]["2.0"]["psnr_db"] > 10


@pytest.mark.usefixtures("no_plots")
def test_the_full_grid_trains_too(shards: Path, tmp_path: Path) -> None:
    config = tiny(shards, tmp_path / "run", steps=2, network=dataclasses.replace(TINY, grid="full"))
    assert read_metadata(train(config, CPU))["config"].grid == "full"


def rows_of(run: Path) -> list[dict[str, object]]:
    """metrics.jsonl without the time that each row took."""
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return [{key: value for key, value in row.items() if key != "seconds"} for row in rows]


@pytest.mark.usefixtures("no_plots")
def test_resume_is_bit_exact(shards: Path, tmp_path: Path) -> None:
    random = {"augment": AugmentConfig(faulty_depth=0.5), "loss": LossWeights(structure=1.0), "log_every": 1}
    whole = load_file(train(tiny(shards, tmp_path / "whole", **random), CPU))

    class StopError(Exception):
        pass

    from holod_training import train as module

    original = module.Run.train_step

    def interrupted(self: module.Run) -> dict[str, float]:
        if self.step == 4:
            raise StopError
        return original(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module.Run, "train_step", interrupted)
        with pytest.raises(StopError):
            train(tiny(shards, tmp_path / "cut", **random), CPU)
    state = torch.load(tmp_path / "cut" / "checkpoint.pt", weights_only=True)
    assert state["step"] == 3
    with pytest.raises(TrainingError, match="optimizer: found a checkpoint of 'muon', expected 'adam'"):
        train(tiny(shards, tmp_path / "cut", optimizer="adam", **random), CPU, resume=True)
    assert [row["step"] for row in rows_of(tmp_path / "cut")] == [1, 2, 3, 4]
    with (tmp_path / "cut" / "metrics.jsonl").open("a") as file:
        file.write('{"kind": "tra')
    resumed = load_file(train(tiny(shards, tmp_path / "cut", **random), CPU, resume=True))
    assert rows_of(tmp_path / "cut") == rows_of(tmp_path / "whole")
    assert resumed.keys() == whole.keys()
    for name, value in whole.items():
        assert torch.equal(value, resumed[name]), name
    other = load_file(train(tiny(shards, tmp_path / "other", seed=2, **random), CPU))
    assert not torch.equal(other["layers.0.weight"], whole["layers.0.weight"])


def test_a_checkpoint_of_another_network_or_of_another_loss_is_refused(shards: Path, tmp_path: Path) -> None:
    """Before there was a choice of optimizers, the weight of what is in focus did not grow with the pupil."""
    run = Run(tiny(shards, tmp_path / "run", optimizer="adam"), CPU)
    run.train_step()
    state = run.state()

    def resumed(in_focus: float | None, older: bool, **changes: object) -> Run:
        stored = json.loads(state["config"])
        stored["loss"]["in_focus"] = in_focus
        if in_focus is None:
            del stored["loss"]["in_focus"]
        if older:
            del stored["optimizer"]
        changes = {"loss": LossWeights() if in_focus is None else LossWeights(in_focus=in_focus), **changes}
        again = Run(tiny(shards, tmp_path / "run", optimizer="adam", **changes), CPU)
        try:
            again.load_state({**state, "config": json.dumps(stored)})
        except TrainingError:
            assert again.step == 0
            raise
        return again

    for in_focus, older in ((20.0, False), (0.0, True), (None, True)):
        assert resumed(in_focus, older).step == 1
    for loss in (LossWeights(), LossWeights(in_focus=20.0)):
        with pytest.raises(TrainingError, match=r"loss\.in_focus: found 20\.0 in a checkpoint .* --initial-weights"):
            resumed(20.0, True, loss=loss)
    # Of a checkpoint whose config does not say so.
    state["network"]["layers.0.weight"] = state["network"]["layers.0.weight"][:, :3]
    with pytest.raises(TrainingError, match="of a network with other layers than this run's"):
        resumed(0.0, False)


def test_other_options_than_the_checkpoints_are_refused_by_name(shards: Path, tmp_path: Path) -> None:
    """What makes network, loss and crops stays; where files lie, how long a run is and when it is looked at may not."""
    run = Run(tiny(shards, tmp_path / "run"), CPU)
    run.train_step()
    state = run.state()

    def resume(**changes: object) -> int:
        again = Run(dataclasses.replace(run.config, **changes), CPU)
        again.load_state(state)
        return again.step

    for changes, message in (
        ({"network": dataclasses.replace(TINY, layers=6)}, r"network\.layers: found a checkpoint of 4, expected 6;"),
        (
            {"network": dataclasses.replace(TINY, trained=ANY_BENCH)},
            r"network\.trained: found a checkpoint of .*\[14\.0, 72\.0\].*, expected .*\[5\.0, 115\.0\].*;",
        ),
        ({"loss": LossWeights(foam=3.0)}, r"loss\.foam: found a checkpoint of 0.*, expected 3\.0;"),
        ({"augment": AugmentConfig(dim=0.9)}, r"augment\.dim: found a checkpoint of 0\.3, expected 0\.9;"),
        ({"double_phase": 1.25}, r"double_phase: found a checkpoint of None, expected 1\.25;"),
        ({"crop": 32, "seed": 3}, r"crop: found .* 48, expected 32; seed: found .* 1, expected 3; resume with"),
    ):
        with pytest.raises(TrainingError, match=message):
            resume(**changes)
    elsewhere = {"out": str(tmp_path / "moved"), "initial_weights": None, "validation": None}
    assert resume(steps=9, validate_every=1, learning_rate=1e-3, precision="bf16", **elsewhere) == 1
    state["processes"] = 2
    with pytest.raises(TrainingError, match=r"found a checkpoint of 2 process\(es\), expected 1: .* with `torchrun"):
        resume()
    # An older checkpoint lacks what is as it was.
    del state["processes"]
    stored = json.loads(state["config"])
    del stored["double_phase"], stored["loss"]["foam"], stored["network"]["feedback"]
    state["config"] = json.dumps(stored)
    assert resume() == 1


@pytest.mark.parametrize(
    "network",
    [
        dataclasses.replace(variant("layered-4"), channels=4),
        dataclasses.replace(variant("half-band-layered-small"), channels=4),
        dataclasses.replace(variant("focal-stack"), channels=4, planes=3),
        dataclasses.replace(variant("focal-stack-feedback"), channels=4, planes=3),
        dataclasses.replace(variant("two-frames"), layers=4, channels=4, adjustable_layers=(1,)),
        dataclasses.replace(variant("ablation-three-plain"), layers=4, channels=4),
    ],
    ids=lambda network: f"{network.grid}-{network.architecture}" + "-feedback" * network.feedback,
)
@pytest.mark.usefixtures("no_plots")
def test_other_networks_train_and_come_back_from_their_file(
    network: NetworkConfig, shards: Path, tmp_path: Path
) -> None:
    weights = train(tiny(shards, tmp_path / "run", steps=2, network=network), CPU)
    assert load_weights(weights).config == network
    numbers = read_metadata(weights)["metrics"]["validation_before_double_phase"]["3.0"]
    assert {"psnr_db", "psnr_in_focus_db", "slope", "correlation", "flat_oracle_db"} <= numbers.keys()


def test_specialists_reach_the_sampler(shards: Path, tmp_path: Path) -> None:
    assert Run(tiny(shards, tmp_path / "run", network=variant("deh-like")), CPU).sampler.specialists_mm == (3.0,)


def test_a_focal_stack_network_refuses_scenes_with_other_planes(shards: Path, tmp_path: Path) -> None:
    with pytest.raises(ShardError, match=r"scene_000000.*focus_dpt is .*1\.42.* expected those .*--planes 6"):
        train(tiny(shards, tmp_path / "run", network=variant("focal-stack")), CPU)


@pytest.mark.usefixtures("no_plots")
def test_a_focal_stack_network_trains_on_a_bench_with_another_depth_range(tmp_path: Path) -> None:
    """Its images are focused uniformly over the depth range of the bench that its scenes are seen on."""
    write_shard(tmp_path / "s" / "scene_000000.safetensors", depth_dpt=(0.5, 3.0))
    network = dataclasses.replace(variant("focal-stack"), channels=4, planes=3, trained=ANY_BENCH)
    train(tiny(tmp_path / "s", tmp_path / "run", steps=2, network=network), CPU)
    write_shard(tmp_path / "s" / "scene_000000.safetensors", depth_dpt=(0.5, 3.0), places=(0.0, 0.4, 1.0))
    with pytest.raises(ShardError, match=r"focus_dpt is \(0\.5, 1\.5, 3\.0\), expected .* \(0\.5, 1\.75, 3\.0\)"):
        train(tiny(tmp_path / "s", tmp_path / "other", network=network, validation=None), CPU)


def test_validation_scenes_at_other_focuses_are_refused_before_the_first_step(shards: Path, tmp_path: Path) -> None:
    write_shard(tmp_path / "v" / "scene_000000.safetensors", planes=4)
    network = dataclasses.replace(variant("focal-stack"), channels=4, planes=3)
    config = tiny(shards, tmp_path / "run", network=network, validation=str(tmp_path / "v"))
    with pytest.raises(ShardError, match=r"v/scene_000000\.safetensors: focus_dpt is .* expected those .*--planes 3"):
        train(config, CPU)
    assert not (tmp_path / "run").exists()
    Run(dataclasses.replace(config, network=TINY), CPU)


def test_validation_scenes_without_its_pupils_are_refused_before_the_first_step(shards: Path, tmp_path: Path) -> None:
    """Figures of the nearest pupil would stand under the name of the one that is missing."""
    write_shard(tmp_path / "v" / "scene_000000.safetensors", pupils_mm=(1.0, 2.04, 3.0, 3.9))
    config = tiny(shards, tmp_path / "run", validation=str(tmp_path / "v"))
    with pytest.raises(ShardError, match=r"v/scene_000000\.safetensors: pupils_mm is 1,2\.04,3,3\.9, expected 2,3,4 "):
        train(config, CPU)
    with pytest.raises(ShardError, match="pupils_mm is"):
        compare(config, ["half-band-8"], 1, CPU)
    assert not (tmp_path / "run").exists()
    write_shard(tmp_path / "v" / "scene_000000.safetensors", pupils_mm=(2.04, 3.0, 3.96))
    Run(config, CPU)


def test_bf16_is_near_f32_and_leaves_the_weights_f32(shards: Path, tmp_path: Path) -> None:
    runs = {p: Run(tiny(shards, tmp_path, precision=p), CPU) for p in ("f32", "bf16")}
    rows = {p: [run.train_step() for _ in range(3)] for p, run in runs.items()}
    assert rows["bf16"][0]["loss"] == pytest.approx(rows["f32"][0]["loss"], rel=0.02)
    assert rows["bf16"][0]["loss"] != rows["f32"][0]["loss"]
    assert all(p.dtype == torch.float32 for p in runs["bf16"].network.parameters())
    with pytest.raises(ConfigError, match="--precision: found 'f16'"):
        tiny(shards, tmp_path, precision="f16")


@pytest.mark.parametrize("grid", ["half-band", "full"])
def test_the_loss_may_be_of_what_a_panel_shows(shards: Path, tmp_path: Path, grid: str) -> None:
    """Which is nearly the field where that is bright and within the constant, and far too dark where it is clipped."""
    network = dataclasses.replace(TINY, grid=grid)
    field, shown, clipped = (
        Run(tiny(shards, tmp_path, network=network, double_phase=constant), CPU) for constant in (None, 1.4, 0.05)
    )
    before = [p.clone() for p in shown.network.parameters()]
    of_field, of_panel, of_clipped = (run.train_step()["loss_squared"] for run in (field, shown, clipped))
    assert of_panel != of_field and of_panel == pytest.approx(of_field, rel=0.1)
    assert of_clipped > 2 * of_panel
    assert any((p != q).any() for p, q in zip(shown.network.parameters(), before, strict=True))


def test_a_teacher_is_compared_by_its_pictures(shards: Path, tmp_path: Path) -> None:
    """Against itself the term is nothing, against another grid something; its own weights never move."""
    itself = tmp_path / "itself.safetensors"
    torch.manual_seed(3)
    save_weights(itself, DirectNetwork(TINY), {}, {})
    started = tiny(shards, tmp_path / "run", initial_weights=str(itself))
    run = Run(dataclasses.replace(started, teacher=str(itself)), CPU)
    before = {k: v.clone() for k, v in run.teacher.state_dict().items()}
    first, second = run.train_step(), run.train_step()
    assert first["loss_teacher"] < 1e-9 < second["loss_teacher"]
    assert all(torch.equal(v, before[k]) for k, v in run.teacher.state_dict().items())
    larger = dataclasses.replace(TINY, grid="full", layers=6)
    save_weights(tmp_path / "larger.safetensors", DirectNetwork(larger), {}, {})
    taught = Run(dataclasses.replace(started, teacher=str(tmp_path / "larger.safetensors")), CPU)
    assert taught.train_step()["loss_teacher"] > 0
    with pytest.raises(TrainingError, match="its network has other layers"):
        Run(dataclasses.replace(started, initial_weights=str(tmp_path / "larger.safetensors")), CPU)


@pytest.mark.usefixtures("no_plots")
def test_a_run_that_refines_its_stack_starts_from_one_that_did_not(shards: Path, tmp_path: Path) -> None:
    small = dataclasses.replace(variant("expected-stack-small"), channels=4)
    weights = train(tiny(shards, tmp_path / "plain", steps=1, network=small), CPU)
    network = dataclasses.replace(small, refined_stack=True)
    run = Run(tiny(shards, tmp_path / "refined", network=network, initial_weights=str(weights)), CPU)
    scene = torch.rand(1, 3, 32, 32), torch.rand(1, 32, 32), torch.tensor([3.0])
    with torch.no_grad():
        torch.testing.assert_close(run.network(*scene), load_weights(weights)(*scene), rtol=1e-5, atol=1e-6)
    before = run.network.lighting[-1].weight[-1].clone()
    run.train_step()
    assert not torch.equal(run.network.lighting[-1].weight[-1], before)
    layered = tmp_path / "layered.safetensors"
    save_weights(layered, build_network(dataclasses.replace(variant("half-band-layered"), channels=4)), {}, {})
    with pytest.raises(TrainingError, match="its network has other layers"):
        Run(tiny(shards, tmp_path / "other", network=network, initial_weights=str(layered)), CPU)
    refined = train(tiny(shards, tmp_path / "refined-too", steps=1, network=network), CPU)
    with pytest.raises(TrainingError, match="its network has other layers"):
        Run(tiny(shards, tmp_path / "back", network=small, initial_weights=str(refined)), CPU)


def test_scenes_may_each_have_their_own_focuses_but_not_for_a_focal_stack(tmp_path: Path) -> None:
    places = [(0.1, 0.5, 0.8), (0.2, 0.6, 1.0)]
    for index, of in enumerate(places):
        write_shard(tmp_path / "s" / f"scene_{index:06d}.safetensors", seed=1, places=of)
    run = Run(tiny(tmp_path / "s", tmp_path / "run", batch=4), CPU)
    run.sampler.rescan()
    stacks = run.sampler.draw(0, 4)
    assert len({s.focus_dpt for s in stacks}) == 2
    field = torch.polar(torch.rand(3, 24, 24), torch.rand(3, 24, 24))
    for stack in stacks:
        eye = HalfBandEye(OpticsConfig(), 48, 48, list(stack.focus_dpt), "cpu")
        torch.testing.assert_close(see(field, stack), eye.look(field, stack.pupil_mm))
    assert torch.isfinite(torch.tensor(run.train_step()["loss"]))
    network = dataclasses.replace(variant("focal-stack-feedback"), channels=4, planes=3)
    with pytest.raises(ShardError, match=r"scene_000000.*focus_dpt is .* expected those .*--planes 3"):
        Run(tiny(tmp_path / "s", tmp_path / "focal", network=network), CPU).sampler.rescan()


def test_lpips_joins_the_loss_where_its_files_are_given(shards: Path, tmp_path: Path) -> None:
    backbone, linear = random_lpips_files(tmp_path)
    config = tiny(shards, tmp_path / "run", crop=64, border_px=0, lpips_backbone=str(backbone))
    with pytest.raises(ConfigError, match="LPIPS: found one of its two weights files"):
        Run(config, CPU)
    run = Run(dataclasses.replace(config, lpips_linear=str(linear)), CPU)
    assert run.train_step()["loss_lpips"] > 0
    assert not any("lpips" in key for key in run.state()["network"])


def test_the_in_focus_term_counts_by_the_pupil_of_each_crop(shards: Path, tmp_path: Path) -> None:
    """The shards' pupils are 1 to 4 mm: the total has the weight of the one that was drawn."""
    run = Run(tiny(shards, tmp_path, loss=LossWeights(in_focus=20.0)), CPU)
    run.sampler.rescan()
    drawn = set()
    for step in range(4):
        pupil_mm = run.sampler.draw(step, 1)[0].pupil_mm
        row = run.train_step()
        weights = LossWeights(in_focus=10.0 * pupil_mm)
        total = sum(getattr(weights, key.removeprefix("loss_")) * row[key] for key in row if key.startswith("loss_"))
        assert row["loss"] == pytest.approx(total, rel=1e-4)
        drawn.add(pupil_mm)
    assert len(drawn) > 1


def test_options_change_the_variant_that_they_name() -> None:
    common = ["train", "--shards", "s", "--out", "o", "--steps", "1"]

    def network(*options: str) -> NetworkConfig:
        return cli._network(cli._parser().parse_args([*common, *options]))

    assert network() == NetworkConfig()
    assert network("--layers", "20") == NetworkConfig(layers=20, adjustable_layers=(10,))
    assert network("--layers", "20", "--adjustable-layers", "5,9").adjustable_layers == (5, 9)
    assert network("--variant", "layered-12", "--no-transport-prior") == variant("layered-12-no-prior")
    corrected = network(
        "--variant", "half-band-layered", "--correction-layers", "4", "--correction-dilations", "1,2,2,1"
    )
    assert (corrected.correction_layers, corrected.correction_dilations) == (4, (1, 2, 2, 1))
    dilated = network("--layers", "10", "--dilations", "1,1,2,4,8,1,8,4,2,1")
    assert dilated == variant("half-band-dilated")
    chosen = ["--in-focus-weight", "7", "--in-focus-growth", "2", "--faulty-depth", "0.5", "--crop", "96"]
    config = cli._train_config(cli._parser().parse_args([*common, *chosen]))
    assert (config.loss.in_focus, config.loss.in_focus_growth) == (7, 2)
    assert (config.augment.faulty_depth, config.crop) == (0.5, 96)
    assert config.benches is None and config.network.trained == TrainedRange()

    def benches(*options: str) -> TrainConfig:
        return cli._train_config(cli._parser().parse_args([*common, *options]))

    assert benches("--benches", "any").network.trained == ANY_BENCH == BenchDraw().trained
    wide = benches("--benches", "any", "--volume-fresnel-px2", "150,400")
    assert wide.network.trained == TrainedRange((5.0, 115.0), (150.0, 400.0)) == (wide.benches or BenchDraw()).trained
    assert benches("--double-phase", "1.25").network.amplitude_constant == 1.25
    assert benches("--volume-blur-px", "20,250").network.trained.volume_blur_px == (20.0, 250.0)
    with pytest.raises(ConfigError, match=r"trained\.volume_blur_px: found \[20\.0\], expected two above 0"):
        benches("--volume-blur-px", "20")


def test_what_initial_weights_are_for_stays_unless_options_name_it(tmp_path: Path) -> None:
    network = dataclasses.replace(TINY, trained=TrainedRange((10.0, 90.0), (20.0, 50.0)), amplitude_constant=1.25)
    start = tmp_path / "start.safetensors"
    save_weights(start, build_network(network), {}, {})

    def going_on(*more: str) -> NetworkConfig:
        common = ["--shards", "a", "--out", "b", "--steps", "1", "--initial-weights", str(start)]
        options = cli._parser().parse_args(["train", *common, *more])
        return cli._train_config(options, network=cli._network(options)).network

    assert (going_on().trained, going_on().amplitude_constant) == (network.trained, 1.25)
    assert going_on("--volume-blur-px", "5,115").trained == TrainedRange((5.0, 115.0), (20.0, 50.0))
    assert going_on("--benches", "any").trained == ANY_BENCH
    assert going_on("--double-phase", "1.1").amplitude_constant == 1.1
    with pytest.raises(WeightsError, match="not a readable weights file"):
        going_on("--initial-weights", str(tmp_path / "none.safetensors"))


def test_each_step_has_a_bench_of_its_own(shards: Path, tmp_path: Path) -> None:
    """The network makes its field for the bench that the crop was drawn for."""
    network = dataclasses.replace(TINY, trained=ANY_BENCH)
    run = Run(tiny(shards, tmp_path / "run", network=network, benches=BenchDraw()), CPU)
    run.sampler.rescan()
    seen = []
    for step in range(3):
        drawn = run.sampler.draw(step, 1)[0].optics
        assert torch.isfinite(torch.tensor(run.train_step()["loss"]))
        assert run.network.optics == drawn
        seen.append(drawn)
    assert len(set(seen)) > 1
    with pytest.raises(ConfigError, match="--batch: found 2, expected 1 where each crop has a bench of its own"):
        tiny(shards, tmp_path / "two", network=network, benches=BenchDraw(), batch=2)


def test_the_loss_is_of_the_bench_that_a_scene_is_seen_on(tmp_path: Path) -> None:
    """Its eye, its circles of confusion, and the weight of what is in focus, which grows with the blur."""
    bench = OpticsConfig((650.0, 530.0, 460.0), 6.0, 40.0, depth_far_dpt=0.5, depth_near_dpt=3.0)
    metadata = {"pixel_pitch_um": "6.0", "pixel_angle_rad": str(6e-6 / 40e-3), "wavelengths_nm": "[650.0,530.0,460.0]"}
    write_shard(tmp_path / "s" / "scene_000000.safetensors", metadata=metadata, depth_dpt=(0.5, 3.0))
    network = dataclasses.replace(TINY, trained=ANY_BENCH)
    weights = LossWeights(in_focus=20.0)
    run = Run(tiny(tmp_path / "s", tmp_path / "run", network=network, loss=weights, validation=None), CPU)
    run.sampler.rescan()
    (stack,) = run.sampler.draw(0, 1)

    def loss(optics: OpticsConfig) -> dict[str, float]:
        pupil_mm, focus_dpt = stack.pupil_mm, list(stack.focus_dpt)
        with torch.no_grad():
            field = run.network.on(bench)(stack.amplitude[None], stack.depth[None], torch.tensor([pupil_mm]))[0]
        dioptres = 0.5 + 2.5 * stack.depth
        blur = torch.stack([(dioptres - dpt).abs() * 1e-3 * pupil_mm / optics.pixel_angle_rad for dpt in focus_dpt])
        picture = HalfBandEye(optics, 48, 48, focus_dpt, "cpu").look(field, pupil_mm)
        counted = weights.for_bench(optics, pupil_mm)
        found = focus_loss(picture, stack.target, blur, counted, border_px=8)
        return {"loss": found.total.item(), **{f"loss_{name}": value for name, value in found.terms.items()}}

    expected, of_default = loss(bench), loss(OpticsConfig())
    row = run.train_step()
    assert row["loss_in_focus"] > 0
    for name, value in expected.items():
        assert row[name] == pytest.approx(value, rel=1e-4), name
        assert row[name] != pytest.approx(of_default[name], rel=1e-3), f"{name}: the comparison is blind"


def test_what_is_validated_and_exported_is_the_average(shards: Path, tmp_path: Path) -> None:
    """Of the first weights and those after each step: a tenth of the way stays after the first, 2 of 11 after the
    second, until `ema_decay` is less."""
    run = Run(tiny(shards, tmp_path / "run", learning_rate=0.05, ema_decay=0.15), CPU)
    expected = [p.detach().clone() for p in run.network.parameters()]
    for kept in (1 / 10, 0.15):
        run.train_step()
        pairs = zip(expected, run.network.parameters(), strict=True)
        expected = [kept * before + (1 - kept) * live.detach() for before, live in pairs]
    averaged = list(run.average.parameters())
    for wanted, found in zip(expected, averaged, strict=True):
        torch.testing.assert_close(found, wanted)
    live = [p.detach() for p in run.network.parameters()]
    assert any(not torch.allclose(p, q, rtol=1e-3) for p, q in zip(live, averaged, strict=True))
    run.save_checkpoint()
    exported = load_weights(export(tmp_path / "run" / "checkpoint.pt", tmp_path / "w.safetensors", None, None))
    assert all(torch.equal(p, q) for p, q in zip(exported.parameters(), averaged, strict=True))
    before = run.validate()
    with torch.no_grad():
        for parameter in run.network.parameters():
            parameter.zero_()
    assert run.validate() == before


def test_gradients_are_clipped(shards: Path, tmp_path: Path) -> None:
    run = Run(tiny(shards, tmp_path / "run", gradient_clip=1e-3), CPU)
    row = run.train_step()
    clipped = torch.cat([p.grad.flatten() for p in run.network.parameters()]).norm()
    assert row["gradient_norm"] > 2e-3 and clipped.item() == pytest.approx(1e-3, rel=1e-2)


def test_scenes_of_another_bench_are_refused(shards: Path, tmp_path: Path) -> None:
    other = {"pixel_angle_rad": str(3.74e-6 / 40e-3)}
    for index in range(2, 4):
        write_shard(shards / f"scene_{index:06}.safetensors", seed=index, metadata=other)
    run = Run(tiny(shards, tmp_path / "mixed", batch=8, validation=None), CPU)
    with pytest.raises(TrainingError, match="found scenes of several benches in a batch of 8, expected one bench"):
        run.train_step()
    for index in range(2):
        (shards / f"scene_{index:06}.safetensors").unlink()
    with pytest.raises(TrainingError, match=r"diffraction is 147\.\d to 208\.\d px2, expected 32 to 46"):
        Run(tiny(shards, tmp_path / "other", batch=4, validation=None), CPU).train_step()
    network = dataclasses.replace(TINY, trained=TrainedRange((5.0, 125.0), ANY_BENCH.volume_fresnel_px2))
    assert Run(tiny(shards, tmp_path / "told", batch=4, network=network, validation=None), CPU).train_step()["loss"] > 0


def test_validation_scenes_of_another_bench_are_refused_before_the_first_step(shards: Path, tmp_path: Path) -> None:
    """Such as of the default one, where `--rig` was forgotten: the network would be told a wrong diffraction."""
    gaea = dataclasses.replace(TINY, trained=TrainedRange((20.0, 250.0), (140.0, 400.0)))
    for benches in (None, BenchDraw(trained=gaea.trained)):
        with pytest.raises(
            TrainingError, match=r"shards: found .* diffraction is 32\.1 to 45\.6 px2, expected 140 to 400"
        ):
            Run(tiny(shards, tmp_path / "run", network=gaea, benches=benches), CPU)
    any_bench = dataclasses.replace(TINY, trained=ANY_BENCH)
    Run(tiny(shards, tmp_path / "run", network=any_bench, benches=BenchDraw()), CPU)


def test_scenes_of_pupils_that_the_network_is_not_told_are_refused(tmp_path: Path) -> None:
    for index, pupils_mm in enumerate(((0.4, 2.0), (3.0, 7.99))):
        write_shard(tmp_path / "s" / f"scene_{index:06}.safetensors", seed=index, pupils_mm=pupils_mm)
    config = tiny(tmp_path / "s", tmp_path / "run", validation=None)
    told = (
        r"s: found scenes whose pupils blur by 5\.7 to 114\.1 px .*, expected 14 to 72 px, .*`--volume-blur-px 5,115`"
    )
    with pytest.raises(TrainingError, match=told):
        train(config, CPU)
    assert not (tmp_path / "run").exists()
    run = Run(config, CPU)
    run.step = 1
    run.sampler.rescan()
    run.train_step()
    wide = dataclasses.replace(TINY, trained=TrainedRange((5.0, 115.0)))
    Run(dataclasses.replace(config, network=wide), CPU).train_step()
    specialists = dataclasses.replace(TINY, specialists_mm=(2.0, 3.0))
    Run(dataclasses.replace(config, network=specialists), CPU).train_step()


@pytest.mark.usefixtures("no_plots")
def test_a_flat_run_is_stopped(shards: Path, tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match="shows one blurred picture"):
        train(tiny(shards, tmp_path / "run", stop_below_slope=2.0), CPU)


@pytest.mark.usefixtures("no_plots")
def test_training_scenes_are_no_validation(shards: Path, tmp_path: Path) -> None:
    """They may be trained on; that they are refused is told before the first step."""
    own = tmp_path / "own"
    write_shard(own / "scene_000000.safetensors", metadata={"kind": "train"})
    config = tiny(own, tmp_path / "run", steps=1, validation=str(shards))
    train(config, CPU)
    with pytest.raises(ShardError, match="metadata kind is 'train', expected held-out scenes"):
        train(dataclasses.replace(config, out=str(tmp_path / "other"), validation=str(own)), CPU)
    assert not (tmp_path / "other").exists()


@pytest.mark.usefixtures("no_plots")
def test_an_old_run_is_not_overwritten(shards: Path, tmp_path: Path) -> None:
    train(tiny(shards, tmp_path / "run", steps=1), CPU)
    with pytest.raises(TrainingError, match="holds a run already"):
        train(tiny(shards, tmp_path / "run"), CPU)
    with pytest.raises(TrainingError, match="no checkpoint to resume"):
        train(tiny(shards, tmp_path / "none"), CPU, resume=True)


def test_learning_rate_warms_up_and_ends_at_three_percent() -> None:
    config = TrainConfig("", "", steps=1000)
    assert config.learning_rate_at(0) == pytest.approx(2e-3 / 30, rel=0.01)
    assert config.learning_rate_at(30) == pytest.approx(2e-3, rel=0.01)
    assert config.learning_rate_at(1000) == pytest.approx(6e-5)


@pytest.mark.usefixtures("no_plots")
def test_two_processes_agree(shards: Path, tmp_path: Path) -> None:
    """Under torchrun with gloo: both ranks see other crops, one writes, and the result is not that of one alone."""
    script = tmp_path / "two.py"
    script.write_text(
        "import sys, torch\n"
        "torch.set_num_threads(1)\n"
        f"sys.path[:0] = {[str(Path(__file__).parent), str(Path(__file__).parents[1])]!r}\n"
        "from pathlib import Path\n"
        "from test_train import tiny, CPU\n"
        "from holod_training import train as module\n"
        "module.plot_curves = lambda run: run\n"
        f"module.train(tiny(Path({str(shards)!r}), Path({str(tmp_path / 'two')!r}), steps=3), CPU)\n"
    )
    command = [
        sys.executable,
        "-m",
        "torch.distributed.run",
        "--standalone",
        "--nproc-per-node=2",
        str(script),
    ]
    done = subprocess.run(
        command,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    two = load_file(tmp_path / "two" / "weights.safetensors")
    one = load_file(train(tiny(shards, tmp_path / "one", steps=3), CPU))
    assert not torch.equal(two["layers.0.weight"], one["layers.0.weight"])
    assert "2 x 1 thread(s)" in read_metadata(tmp_path / "two" / "weights.safetensors")["provenance"]["machine"]


def test_weights_round_trip_and_errors(tmp_path: Path) -> None:
    network = DirectNetwork(TINY)
    path = tmp_path / "w.safetensors"
    save_weights(path, network, {}, {})
    back = load_weights(path).state_dict()
    for name, value in network.state_dict().items():
        assert torch.equal(value, back[name])
    network.layers[0] = torch.nn.Conv2d(20, 8, 3, padding=1)
    save_weights(path, network, {}, {})
    with pytest.raises(WeightsError, match=r"layers\.0\.weight has shape \[8, 20, 3, 3\], expected \[8, 22, 3, 3\]"):
        load_weights(path)
    path.write_bytes(b"garbage")
    with pytest.raises(WeightsError, match="not a readable weights file"):
        load_weights(path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--crop 64 --border-px 32", "--border-px: found 32, expected less than half the crop of 64 px"),
        ("--crop 64 --border-px 40", "--border-px: found 40, expected less than half the crop of 64 px"),
        ("--border-px -1", "--border-px: found -1, expected at least 0"),
        ("--validation-border-px -1", "--validation-border-px: found -1, expected at least 0"),
        ("--steps 0", "--steps: found 0, expected at least 1"),
        ("--steps -1", "--steps: found -1, expected at least 1"),
        ("--learning-rate -1", "--learning-rate: found -1.0, expected a number above 0"),
        ("--learning-rate 0", "--learning-rate: found 0.0, expected a number above 0"),
        ("--learning-rate nan", "--learning-rate: found nan, expected a number above 0"),
        ("--learning-rate inf", "--learning-rate: found inf, expected a number above 0"),
        ("--batch 0", "--batch: found 0, expected at least 1"),
        ("--batch -1", "--batch: found -1, expected at least 1"),
        ("--crop 63 --border-px 8", "--crop: found 63, expected an even number of at least 2"),
        ("--crop -64", "--crop: found -64, expected an even number of at least 2"),
        ("--crop 0", "--crop: found 0, expected an even number of at least 2"),
        ("--crop 36 --border-px 8 --foam-weight 1", "--crop: found 36, expected at least 48 for foam within a border"),
        ("--crop 20 --border-px 8 --structure-weight 1", "--crop: found 20, expected at least 24 for structure"),
        ("--crop 64 --border-px 8 --lpips-backbone a --lpips-linear b", "--crop: found 64, expected at least 79 for L"),
        ("--crop 14 --border-px 2 --light-weight 1", "--crop: found 14, expected at least 16 for the light"),
        ("--warm-up-steps -1", "--warm-up-steps: found -1, expected at least 0"),
        ("--seed -1", "--seed: found -1, expected a whole number from 0 to"),
        ("--double-phase 0", "--double-phase: found 0.0, expected a number above 0"),
        ("--validate-every 0", "--validate-every: found 0, expected at least 1"),
        ("--validation-scenes 0", "--validation-scenes: found 0, expected at least 1"),
        ("--stop-below-slope nan", "--stop-below-slope: found nan, expected a number"),
        ("--faulty-depth 1.5", "--faulty-depth: found 1.5, expected 0 to 1"),
        ("--focus-weight -1", "--focus-weight: found -1.0, expected a number of at least 0"),
        ("--in-focus-growth nan", "--in-focus-growth: found nan, expected a number of at least 0"),
        ("--coc-floor-px 0", "--coc-floor-px: found 0.0, expected a number above 0"),
        ("--threads -1", "--threads: found -1, expected at least 0"),
    ],
)
def test_what_no_run_can_do_is_refused_before_anything_is_written(
    options: str, message: str, shards: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["train", "--shards", str(shards), "--out", str(tmp_path / "run"), "--steps", "1", "--device", "cpu"]
    assert main([*command, "--crop", "48", "--border-px", "8", *options.split()]) == 65
    assert message in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_border_that_leaves_nothing_to_validate_is_refused_before_the_first_step(
    shards: Path, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=r"--validation-border-px: found 32, expected at most 31: .* has 64x64 pix"):
        train(tiny(shards, tmp_path / "run", validation_border_px=32), CPU)
    assert not (tmp_path / "run").exists()


def test_a_gpu_that_is_not_there_is_refused(
    shards: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    command = ["train", "--shards", str(shards), "--out", str(tmp_path / "run"), "--steps", "1", "--device", "cuda"]
    assert main(command) == 65
    assert "error: --device: found 'cuda', expected cpu or auto: PyTorch finds no GPU" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_device_is_offered_where_it_is_used(
    shards: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    save_weights(tmp_path / "w.safetensors", DirectNetwork(TINY), {}, {})
    judged = ["--weights", str(tmp_path / "w.safetensors"), "--test", str(shards), "--limit", "1"]
    seen: list[torch.device] = []

    def render(network: object, stack: Stack, pupil_mm: float) -> None:
        seen.append(stack.depth.device)
        raise ShardError("seen")

    def study(stacks: list[Stack], *_: object) -> None:
        seen.append(stacks[0].depth.device)
        raise ShardError("seen")

    monkeypatch.setattr("holod_training.judging.network_field", render)
    monkeypatch.setattr("holod_training.eyebox.study", study)
    # A device that needs no machine: it has shapes and no values.
    monkeypatch.setattr(cli, "choose_device", lambda name: torch.device("meta" if name == "cuda" else name))
    for command in ("across-benches", "eyebox"):
        for device in ("cpu", "cuda"):
            assert main([command, *judged, "--out", str(tmp_path / command), "--device", device]) == 65
            assert capsys.readouterr().err == "error: seen\n"
    assert [device.type for device in seen] == ["cpu", "meta", "cpu", "meta"]
    for command in ("export", "average", "golden"):
        with pytest.raises(SystemExit):
            main([command, "--device", "cpu"])
        assert "--device" not in capsys.readouterr().err.split("error:")[0]


def test_programs_are_told_of_what_has_no_option(shards: Path, tmp_path: Path) -> None:
    for changes, message in (
        ({"log_every": 0}, "log_every: found 0, expected at least 1"),
        ({"ema_decay": 1.5}, r"ema_decay: found 1\.5, expected 0 to 1"),
        ({"gradient_clip": 0}, "gradient_clip: found 0, expected a number above 0"),
        ({"augment": AugmentConfig(dim=-1)}, r"augment\.dim: found -1, expected 0 to 1"),
    ):
        with pytest.raises(ConfigError, match=f"^{message}"):
            tiny(shards, tmp_path / "run", **changes)


def test_a_run_that_fails_before_its_first_step_leaves_nothing(tmp_path: Path) -> None:
    """Scenes are looked at in the first step, where they are too small for the crop or of other benches."""
    write_shard(tmp_path / "small" / "scene_000000.safetensors", size=40)
    with pytest.raises(ShardError, match="40x40 pixels, smaller than the crop 48"):
        train(tiny(tmp_path / "small", tmp_path / "run", validation=None), CPU)
    write_shard(tmp_path / "nan" / "scene_000000.safetensors")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("holod_training.train.focus_loss", lambda *_: SimpleNamespace(total=torch.tensor(math.nan)))
        with pytest.raises(TrainingError, match="step 0: the loss is nan"):
            train(tiny(tmp_path / "nan", tmp_path / "run", validation=None), CPU)
    assert not (tmp_path / "run").exists()


def test_a_loss_that_is_no_number_is_told_with_its_likely_cause(shards: Path, tmp_path: Path) -> None:
    broken = DirectNetwork(TINY)
    with torch.no_grad():
        next(broken.parameters()).fill_(math.nan)
    save_weights(tmp_path / "broken.safetensors", broken, {}, {})

    def cause(step: int = 0, **changes: object) -> str:
        run = Run(tiny(shards, tmp_path / "run", **changes), CPU)
        run.network.load_state_dict(broken.state_dict())
        run.step = step
        run.sampler.rescan()
        with pytest.raises(TrainingError, match=f"^step {step}: the loss is nan: ") as error:
            run.train_step()
        return str(error.value)

    given = str(tmp_path / "broken.safetensors")
    assert "it is not the learning rate; lower the loss's weights" in cause()
    assert "lower --learning-rate, lengthen --warm-up-steps, lower the weight of the term that grew" in cause(3)
    assert "--precision" not in cause(3) and "or train with --precision f32" in cause(3, precision="bf16")
    for option in ("initial_weights", "teacher"):
        assert f"{given} has values that are no numbers" in cause(**{option: given})
    run = Run(tiny(shards, tmp_path / "run"), CPU)
    run.average.load_state_dict(broken.state_dict())
    with pytest.raises(TrainingError, match=r"^step 0: .*scene_000000.* at s = 2 mm: found a picture with values that"):
        run.validate()


def test_a_damaged_checkpoint_is_named_with_a_way_on(
    shards: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tiny(shards, tmp_path / "run")
    run = Run(config, CPU)
    run.train_step()
    run.save_checkpoint()
    checkpoint = tmp_path / "run" / "checkpoint.pt"
    whole = checkpoint.read_bytes()
    others = []
    for other in ({"step": 1}, [1, 2], 3.0):
        torch.save(other, tmp_path / "other.pt")
        others.append((tmp_path / "other.pt").read_bytes())
    for content in (b"", whole[:100], whole[: len(whole) // 2], whole[:-1], b"no checkpoint", *others):
        checkpoint.write_bytes(content)
        with pytest.raises(
            TrainingError, match=r"checkpoint\.pt: not a .*; go on from .*weights\.safetensors by --initial"
        ):
            train(config, CPU, resume=True)
        assert main(["export", "--source", str(checkpoint), "--out", str(tmp_path / "w.safetensors")]) == 65
        assert f"error: {checkpoint}: not a " in capsys.readouterr().err
    checkpoint.write_bytes(whole)
    assert main(["export", "--source", str(checkpoint), "--out", str(tmp_path / "w.safetensors")]) == 0


@pytest.mark.usefixtures("no_plots")
def test_a_run_that_is_done_says_so_and_has_its_weights(shards: Path, tmp_path: Path) -> None:
    weights = train(tiny(shards, tmp_path / "run"), CPU)
    with pytest.raises(TrainingError, match=r"--steps: found 5, expected at least 6, where .*checkpoint\.pt is"):
        train(tiny(shards, tmp_path / "run", steps=5), CPU, resume=True)
    done = weights.read_bytes(), rows_of(tmp_path / "run")
    assert train(tiny(shards, tmp_path / "run"), CPU, resume=True) == weights
    assert (weights.read_bytes(), rows_of(tmp_path / "run")) == done
    before = load_file(weights)
    weights.unlink()
    assert train(tiny(shards, tmp_path / "run"), CPU, resume=True) == weights
    after = load_file(weights)
    assert all(torch.equal(value, after[name]) for name, value in before.items())


@pytest.mark.usefixtures("no_plots")
def test_weights_of_an_earlier_step_are_not_taken_for_those_of_the_last(
    shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run that is interrupted while it validates its last step has that step's checkpoint, but older weights."""
    config = tiny(shards, tmp_path / "run", validate_every=4)
    original = train_module.save_weights

    def interrupted(*arguments: Any) -> None:
        if arguments[3]["steps"] == 6:
            raise KeyboardInterrupt
        original(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(train_module, "save_weights", interrupted)
        with pytest.raises(KeyboardInterrupt):
            train(config, CPU)
    old = tmp_path / "run" / "weights.safetensors"
    assert read_metadata(old)["provenance"]["steps"] == 4
    assert read_metadata(train(config, CPU, resume=True))["provenance"]["steps"] == 6
    whole = load_file(train(dataclasses.replace(config, out=str(tmp_path / "whole")), CPU))
    assert all(torch.equal(value, load_file(old)[name]) for name, value in whole.items())
    assert rows_of(tmp_path / "run") == rows_of(tmp_path / "whole"), "validation of the last step has one row"


@pytest.mark.usefixtures("no_plots")
def test_an_interrupt_leaves_a_checkpoint_and_no_traceback(
    shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Ctrl-C within a step counts at its end; what is resumed then is the run that was never interrupted."""
    command = ["train", "--shards", str(shards), "--steps", "5", "--crop", "32", "--border-px", "4", "--device", "cpu"]
    command += ["--variant", "half-band-8", "--channels", "4", "--layers", "4", "--validate-every", "3", "--out"]
    assert main([*command, str(tmp_path / "whole")]) == 0
    original = Run.train_step

    def step(self: Run) -> dict[str, float]:
        if self.step == 2:
            signal.raise_signal(signal.SIGINT)
        return original(self)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with monkeypatch.context() as patch:
            patch.setattr(Run, "train_step", step)
            capsys.readouterr()
            assert main([*command, str(tmp_path / "cut")]) == 130
            said = capsys.readouterr().err
            assert "interrupted: " in said and "checkpoint.pt is of step 3: go on with --resume" in said
            assert read_metadata(tmp_path / "cut" / "weights.safetensors")["provenance"]["steps"] == 3, "it was due"
            assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
            # As in the background of a script.
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            assert main([*command, str(tmp_path / "ignored")]) == 0
    finally:
        signal.signal(signal.SIGINT, before)
    assert main([*command, str(tmp_path / "cut"), "--resume"]) == 0
    whole, cut = (load_file(tmp_path / name / "weights.safetensors") for name in ("whole", "cut"))
    assert all(torch.equal(value, cut[name]) for name, value in whole.items())


@pytest.mark.usefixtures("no_plots")
def test_an_interrupt_while_a_step_is_validated_leaves_its_checkpoint(
    shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    validate = Run.validate

    def interrupted(self: Run) -> dict[str, dict[str, float]]:
        signal.raise_signal(signal.SIGINT)
        return validate(self)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        monkeypatch.setattr(Run, "validate", interrupted)
        with pytest.raises(KeyboardInterrupt, match=r"checkpoint\.pt is of step 2: go on with --resume"):
            train(tiny(shards, tmp_path / "run", validate_every=2), CPU)
    finally:
        signal.signal(signal.SIGINT, before)
    assert read_checkpoint(tmp_path / "run" / "checkpoint.pt")["step"] == 2


def test_an_out_that_is_no_folder_is_refused_before_the_work(
    shards: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "w.safetensors").touch()
    data = ["--shards", str(shards), "--validation", str(shards)]
    judged = ["--weights", str(tmp_path / "w.safetensors"), "--test", str(shards)]
    for command in (
        ["train", *data, "--steps", "1"],
        ["compare", *data, "--variants", "half-band-8", "--minutes", "1"],
        ["evaluate", *judged],
        ["across-benches", *judged],
        ["eyebox", *judged],
    ):
        for out in ("file", "file/below/it"):
            assert main([*command, "--out", str(tmp_path / out)]) == 65
            expected = f"error: --out: found {tmp_path / 'file'}, which is no folder, expected one to write into\n"
            assert capsys.readouterr().err == expected


def test_what_cannot_be_written_or_read_is_an_error_not_a_traceback(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = tmp_path / "source.safetensors"
    save_weights(source, DirectNetwork(TINY), {}, {})
    (tmp_path / "folder").mkdir()
    assert main(["export", "--source", str(source), "--out", str(tmp_path / "folder"), "--force"]) == 65
    assert capsys.readouterr().err == f"error: {tmp_path / 'folder'}: Is a directory\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder", "source.safetensors"]
    assert main(["export", "--source", str(source), "--out", str(source / "below")]) == 65
    assert f"error: {source}: " in capsys.readouterr().err


@pytest.mark.usefixtures("no_plots")
def test_a_full_disk_is_told_with_the_file(
    shards: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    source = tmp_path / "source.safetensors"
    save_weights(source, DirectNetwork(TINY), {}, {})
    run = Run(tiny(shards, tmp_path / "run"), CPU)
    log = train_module.RunLog(tmp_path / "run", run.config, 0)
    monkeypatch.setattr(os, "fsync", full)
    assert main(["export", "--source", str(source), "--out", str(tmp_path / "out.safetensors")]) == 65
    assert capsys.readouterr().err == f"error: {tmp_path / 'out.safetensors'}: No space left on device\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run", "shards", "source.safetensors"]
    log.path = Path("/dev/full")
    with pytest.raises(OSError, match="No space left on device: '/dev/full'"):
        log.write("train", run, {})


def test_cli_says_what_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["train", "--shards", str(tmp_path / "none"), "--out", str(tmp_path / "run"), "--steps", "1"])
    assert code == 65
    assert "no such folder of shards" in capsys.readouterr().err

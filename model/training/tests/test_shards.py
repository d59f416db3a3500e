from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import write_shard
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from holod_training.benches import ANY_BENCH, BenchDraw
from holod_training.config import ConfigError, OpticsConfig, TrainedRange
from holod_training.optics import coc_px
from holod_training.sampling import AugmentConfig, Sampler, augment
from holod_training.shards import Shard, ShardError, Stack, open_held_out, open_shards, shard_names


def test_crop_is_a_window_of_the_whole(shards: Path) -> None:
    shard = Shard(shards / "scene_000000.safetensors")
    whole, crop = shard.read(1), shard.read(1, top=5, left=9, size=32)
    assert crop.pupil_mm == 2.0
    assert len(crop.focus_dpt) == 3
    torch.testing.assert_close(crop.target, whole.target[:, :, 5:37, 9:41])
    torch.testing.assert_close(crop.image, whole.image[:, 5:37, 9:41])
    torch.testing.assert_close(crop.depth, whole.depth[5:37, 9:41])


def test_truncated_file_is_named(tmp_path: Path) -> None:
    path = write_shard(tmp_path / "scene_000000.safetensors")
    path.write_bytes(path.read_bytes()[:-1000])
    with pytest.raises(ShardError, match=r"scene_000000\.safetensors: not a whole safetensors file"):
        Shard(path)


@pytest.mark.parametrize("name", ["image", "depth", "stack_1"])
def test_values_that_are_no_numbers_are_named(name: str, tmp_path: Path) -> None:
    path = write_shard(tmp_path / "scene_000000.safetensors")
    with safe_open(path, framework="pt") as file:
        metadata = file.metadata()
    tensors = load_file(path)
    tensors[name][..., 5, 7] = float("nan")
    save_file(tensors, path, metadata)
    shard = Shard(path)
    with pytest.raises(ShardError, match=rf"scene_000000\.safetensors: {name} has values that are no numbers"):
        shard.read(1)
    assert shard.read(1, top=6, left=0, size=8).target.isfinite().all(), "a crop without them is whole"


def test_garbage_is_named(tmp_path: Path) -> None:
    path = tmp_path / "scene_000000.safetensors"
    path.write_bytes(b"no shard at all")
    with pytest.raises(ShardError, match="not a whole safetensors file"):
        Shard(path)


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        ({"format": "holod-scene-2"}, "format is 'holod-scene-2', expected 'holod-scene-1'"),
        ({"pupils_mm": "2.0"}, "pupils_mm = 2.0, expected a list of numbers"),
        ({"focus_dpt": "[0.0, 1.0]"}, r"stack_0 has shape \[3, 3, 64, 64\], expected \[2, 3, 64, 64\]"),
        ({"near_dpt": "-1.0"}, r"near_dpt = -1\.0, pixel_angle_rad = .* expected a depth volume of rising dioptres"),
        ({"pixel_angle_rad": "0"}, "pixel_angle_rad = 0.0, expected a depth volume .* and an angle above 0"),
        ({"far_dpt": "far"}, "far_dpt = 'far' is not JSON"),
        ({"pupils_mm": "[1.0, 2.0, 3.0, 4.0, 5.0]"}, "stack_4 has shape None"),
    ],
)
def test_wrong_metadata_is_said(tmp_path: Path, metadata: dict[str, str], message: str) -> None:
    write_shard(tmp_path / "scene_000000.safetensors", metadata=metadata)
    with pytest.raises(ShardError, match=message):
        open_shards(tmp_path)


def test_a_scene_shows_on_another_bench_what_other_pupils_and_focuses_see(tmp_path: Path) -> None:
    """The blur of every pixel at every focus is the same number of pixels, and so are the pictures."""
    shard = Shard(write_shard(tmp_path / "scene_000000.safetensors"))
    other = OpticsConfig((633.0, 532.0, 473.0), 3.74, 40.0, 0.5, 3.5)
    moved = shard.on(other)
    assert shard.on(OpticsConfig()).pupils_mm == shard.pupils_mm == (1.0, 2.0, 3.0, 4.0)
    assert moved.focus_dpt[0] == pytest.approx(0.5) and moved.focus_dpt[-1] == pytest.approx(3.5)
    # 5 px a dioptre and mm over 20/7 dpt; 10.695 px over 3 dpt.
    assert moved.pupils_mm[1] == pytest.approx(2 * 5 * 20 / 7 / (40 / 3.74 * 3))
    here, there = shard.read(1), moved.read(1)
    assert torch.equal(here.target, there.target) and there.optics == other

    def blur_px(stack: Stack) -> torch.Tensor:
        return coc_px(stack.optics, stack.depth, list(stack.focus_dpt), stack.pupil_mm)

    torch.testing.assert_close(blur_px(here), blur_px(there), rtol=1e-5, atol=1e-4)
    with pytest.raises(AssertionError):
        torch.testing.assert_close(blur_px(here), blur_px(shard.on(other).read(2)), rtol=1e-5, atol=1e-4)
    back = moved.on(OpticsConfig())
    assert back.pupils_mm == pytest.approx(shard.pupils_mm) and back.focus_dpt == pytest.approx(shard.focus_dpt)


def test_scenes_of_several_benches_are_not_judged_together(tmp_path: Path) -> None:
    """What a shard says of its bench is read to what the rig file had; an older one's wavelengths are the default's."""
    gaea = {
        "pixel_angle_rad": str(3.74e-6 / 40e-3),
        "pixel_pitch_um": "3.74",
        "wavelengths_nm": "[633.0, 532.0, 473.0]",
    }
    for index in range(2):
        write_shard(tmp_path / f"scene_{index:06}.safetensors", metadata=gaea)
    found = open_shards(tmp_path)[0].optics
    assert found == OpticsConfig((633.0, 532.0, 473.0), 3.74, 40.0, 0.0, OpticsConfig().depth_near_dpt)
    write_shard(tmp_path / "scene_000002.safetensors")
    with pytest.raises(
        ShardError, match=r"scene_000002.*rendered for .* expected one bench: keep the scenes of each in"
    ):
        open_shards(tmp_path)
    assert {shard.optics for shard in open_shards(tmp_path, OpticsConfig())} == {OpticsConfig()}
    (tmp_path / "scene_000002.safetensors").unlink()
    write_shard(tmp_path / "scene_000000.safetensors", metadata=gaea | {"wavelengths_nm": "[6.3e-7, 5.3e-7, 4.7e-7]"})
    with pytest.raises(ShardError, match=r"wavelengths_nm = .* expected those of three colours in nanometres"):
        open_shards(tmp_path)


def test_scenes_of_training_are_not_held_out(tmp_path: Path) -> None:
    """Of any other kind they are, also where a shard does not say."""
    for index, kind in enumerate(("test", "cards", "")):
        write_shard(tmp_path / f"scene_{index:06}.safetensors", metadata={"kind": kind})
    assert len(open_held_out(tmp_path)) == 3
    write_shard(tmp_path / "scene_000003.safetensors", metadata={"kind": "train"})
    with pytest.raises(ShardError, match=r"scene_000003\.safetensors: metadata kind is 'train'.* --kind test"):
        open_held_out(tmp_path)
    assert len(open_held_out(tmp_path, limit=3)) == 3
    assert len(open_shards(tmp_path)) == 4


def test_no_shards(tmp_path: Path) -> None:
    with pytest.raises(ShardError, match="holod-scenes generate"):
        open_shards(tmp_path)
    with pytest.raises(ShardError, match="no such folder"):
        shard_names(tmp_path / "missing")
    with pytest.raises(ShardError, match="no such shard"):
        Shard(tmp_path / "scene_000000.safetensors")


def sampler(folder: Path, crop: int = 32, seed: int = 1) -> Sampler:
    made = Sampler(folder, crop, seed, 0, AugmentConfig())
    made.rescan()
    return made


def test_draws_depend_on_seed_and_step_alone(shards: Path) -> None:
    first, again = sampler(shards).draw(7, 3), sampler(shards).draw(7, 3)
    for a, b in zip(first, again, strict=True):
        assert torch.equal(a.target, b.target)
    assert not torch.equal(sampler(shards).draw(8, 1)[0].target, first[0].target)
    assert not torch.equal(sampler(shards, seed=2).draw(7, 1)[0].target, first[0].target)


def test_each_crop_has_a_bench_of_its_own_where_benches_are_drawn(shards: Path) -> None:
    blurs = {OpticsConfig().volume_blur_px(mm) for mm in Shard(shards / "scene_000000.safetensors").pupils_mm}
    made = Sampler(shards, 32, 1, 0, AugmentConfig(), benches=BenchDraw())
    made.rescan()
    drawn = [made.draw(step, 1)[0] for step in range(60)]
    assert 5 < sum(stack.optics == OpticsConfig() for stack in drawn) < 30
    assert len({stack.optics for stack in drawn}) > 30
    for stack in drawn:
        assert 1 - 1e-9 <= stack.pupil_mm <= 8 + 1e-9
        assert min(abs(stack.optics.volume_blur_px(stack.pupil_mm) - blur) for blur in blurs) < 1e-6
        least, most = ANY_BENCH.volume_fresnel_px2
        assert all(least <= fresnel <= most for fresnel in stack.optics.volume_fresnel_px2)
        assert 0 <= stack.optics.depth_far_dpt <= 1
        red, green, blue = stack.optics.wavelengths_nm
        assert 630 <= red <= 665 and 512 <= green <= 536 and 442 <= blue <= 475
    again = Sampler(shards, 32, 1, 0, AugmentConfig(), benches=BenchDraw())
    again.rescan()
    assert again.draw(7, 1)[0].optics == drawn[7].optics


def test_the_default_bench_is_not_drawn_where_networks_are_not_for_it() -> None:
    rng, apart = np.random.default_rng(1), TrainedRange((20.0, 250.0), (100.0, 400.0))
    drawn = [BenchDraw(apart).draw(60.0, rng) for _ in range(40)]
    assert all(100 <= fresnel <= 400 for bench in drawn for fresnel in bench.volume_fresnel_px2)


def test_a_blur_that_no_bench_shows_is_said() -> None:
    with pytest.raises(ConfigError, match=r"has a volume_blur_px of 9000\.0 for a pupil of 1 to 8 mm; train on scenes"):
        BenchDraw().draw(9000.0, np.random.default_rng(1))


def test_specialists_are_shown_what_is_nearest_to_their_pupils(shards: Path) -> None:
    pupils = Shard(shards / "scene_000000.safetensors").pupils_mm
    assert len(pupils) > 1
    free = sampler(shards)
    assert {stack.pupil_mm for step in range(40) for stack in free.draw(step, 1)} == set(pupils)
    bound = Sampler(shards, 32, 1, 0, AugmentConfig(), specialists_mm=(pupils[-1] + 0.1,))
    bound.rescan()
    assert {stack.pupil_mm for step in range(40) for stack in bound.draw(step, 1)} == {pupils[-1]}
    two = Sampler(shards, 32, 1, 0, AugmentConfig(), specialists_mm=(pupils[0], pupils[-1]))
    two.rescan()
    assert {stack.pupil_mm for step in range(40) for stack in two.draw(step, 1)} == {pupils[0], pupils[-1]}


def test_rescan_takes_in_new_shards_and_refuses_small_ones(shards: Path) -> None:
    growing = sampler(shards)
    write_shard(shards / "scene_000009.safetensors", seed=9)
    growing.rescan()
    assert growing.names[-1] == "scene_000009.safetensors"
    with pytest.raises(ShardError, match="64x64 pixels, smaller than the crop 80"):
        sampler(shards, crop=80)


def test_augmentation_changes_picture_and_targets_alike(shards: Path) -> None:
    """Where a target equals the picture (at the depth in focus), it must do so after every change, too."""
    stack = Shard(shards / "scene_000000.safetensors").read(0)
    always = AugmentConfig(permute_colours=1, desaturate=1, dim=1, invert=0.5)
    changed = 0
    for seed in range(12):
        out = augment(stack, always, np.random.default_rng(seed))
        sharp = (out.depth < 1e-6)[None]
        assert sharp.any()
        torch.testing.assert_close(out.target[0][sharp.expand(3, -1, -1)], out.image[sharp.expand(3, -1, -1)])
        assert out.target.min() >= 0 and out.target.max() <= 1
        changed += not torch.equal(out.image, stack.image)
    assert changed == 12


def test_no_augmentation_but_turns_keeps_every_value(shards: Path) -> None:
    stack = Shard(shards / "scene_000000.safetensors").read(0)
    none = AugmentConfig(permute_colours=0, desaturate=0, dim=0, invert=0)
    out = augment(stack, none, np.random.default_rng(1))
    assert torch.equal(out.target.flatten().sort().values, stack.target.flatten().sort().values)
    turned = [augment(stack, none, np.random.default_rng(seed)).depth for seed in range(16)]
    assert {bool((depth[0] == depth[1]).all()) for depth in turned} == {False, True}, "upright and by a quarter"

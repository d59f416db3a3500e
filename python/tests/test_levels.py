"""The package's levels, phases and views are the daemon's, bit for bit."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import holod
import numpy as np
import pytest
from conftest import RIG, SIZE, Daemon, read_png
from numpy.typing import NDArray
from safetensors import safe_open

COLOURS = ("red", "green", "blue")
OPTIONS = ["--weights", "fast", "--backend", "cpu"]


def as_stored(phase_rad: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Phases as `holod render` writes them to PNG: 16 bits, in the arithmetic of 32."""
    scaled = phase_rad / np.float32(2 * np.pi) * np.float32(65536)
    return ((np.floor(scaled + np.float32(0.5))).astype(np.int64) % 65536).astype(np.uint16)


def differences(hologram: holod.Hologram, folder: Path) -> list[str]:
    """In what a hologram is not that of `holod render --out FOLDER`."""
    wrong = []
    for phase_rad, colour in zip(hologram.phase_rad, COLOURS, strict=True):
        if not np.array_equal(as_stored(phase_rad), read_png(folder / f"phase_{colour}.png")):
            wrong.append(f"phase of {colour}")
    with safe_open(folder / "field.safetensors", "np") as stored:
        expected = stored.get_tensor("field")
    assert hologram.field is not None
    found = hologram.field.view(np.float32).reshape(expected.shape)
    if not np.array_equal(found.view(np.uint32), expected.view(np.uint32)):
        wrong.append("field")
    return wrong


def render(scene: holod.Scene, pupil_mm: float) -> holod.Hologram:
    height_px, width_px = scene.depth.shape
    renderer = holod.Renderer(weights="fast", width_px=width_px, height_px=height_px, backend="cpu")
    return renderer.render(
        scene.rgb, scene.depth, pupil_mm, colour=scene.colour, depth_unit=scene.depth_unit, field=True
    )


def test_the_builtin_scene_has_the_daemons_phases_and_view(daemon: Daemon) -> None:
    size = f"{SIZE[0]}x{SIZE[1]}"
    daemon.run("render", "--pupil", "3.5", "--resolution", size, "--out", "out", *OPTIONS)
    hologram = render(holod.builtin_scene(*SIZE), 3.5)
    assert differences(hologram, daemon.folder / "out") == []
    # A comparison that a smaller pupil passes too compares nothing.
    other = render(holod.builtin_scene(*SIZE), 3.0)
    assert differences(other, daemon.folder / "out") == ["phase of red", "phase of green", "phase of blue", "field"]

    view = ["view", "--pupil", "3.5", "--resolution", size, "--focus", "2.5", "--out", "view.png", *OPTIONS]
    daemon.run(*view)
    expected = read_png(daemon.folder / "view.png")
    assert np.array_equal(holod.to_srgb8(hologram.view(2.5)), expected)
    assert not np.array_equal(holod.to_srgb8(hologram.view(2.4)), expected)
    daemon.run(*view, "--force", "--eye-pupil", "5")
    assert np.array_equal(holod.to_srgb8(hologram.view(2.5, 5.0)), read_png(daemon.folder / "view.png"))
    by_hand = holod.view(
        hologram.shown_phase_rad(), pupil_mm=5.0, focus_dpt=2.5, amplitude_constant=hologram.amplitude_constant
    )
    assert np.array_equal(by_hand, hologram.view(2.5, 5.0))


def test_a_scene_of_files_has_the_daemons_phases_however_it_is_read(
    daemon: Daemon, picture_files: tuple[Path, Path]
) -> None:
    named = ",".join(map(str, picture_files))
    told = ["--scene", named, "--depth-encoding", "millimetres"]
    daemon.run("render", "--pupil", "4", "--out", "out", *told, *OPTIONS)
    scene = holod.load_scene(named, depth_encoding="millimetres")
    assert (scene.rgb.shape, scene.depth.shape, scene.depth_missing_px) == ((54, 70, 3), (54, 70), 40)
    assert differences(render(scene, 4.0), daemon.folder / "out") == []

    renderer = holod.Renderer(weights="fast", width_px=70, height_px=54, backend="cpu")
    rgb, depth_mm = (read_png(path) for path in picture_files)
    hologram = renderer.render(rgb, depth_mm, 4.0, depth_unit="millimetres", fill_missing=True, field=True)
    assert differences(hologram, daemon.folder / "out") == []
    assert hologram.depth_missing_px == 40
    depth_mm = depth_mm.copy()
    depth_mm[30, 40] += 200
    changed = renderer.render(rgb, depth_mm, 4.0, depth_unit="millimetres", fill_missing=True, field=True)
    assert "field" in differences(changed, daemon.folder / "out")

    daemon.run("render", "--pupil", "4", "--out", "fitted", "--resolution", "64x64", "--fit", "cover", *told, *OPTIONS)
    fitted = holod.load_scene(named, depth_encoding="millimetres", width_px=64, height_px=64, fit="cover")
    assert differences(render(fitted, 4.0), daemon.folder / "fitted") == []


def test_what_a_picture_does_not_reach_is_at_the_rigs_far_end(daemon: Daemon, picture_files: tuple[Path, Path]) -> None:
    path = daemon.folder / "rig.toml"
    path.write_text(RIG.replace("depth_far_m = inf", "depth_far_m = 3.0"))
    named = ",".join(map(str, picture_files))
    told = ["--scene", named, "--depth-encoding", "millimetres", "--resolution", "90x70"]
    daemon.run("render", "--config", path, "--pupil", "3", "--out", "out", *told, *OPTIONS)
    report = json.loads((daemon.folder / "out" / "report.json").read_text())
    rig = holod.Rig.load(path)
    scene = holod.load_scene(named, depth_encoding="millimetres", width_px=90, height_px=70, rig=rig)
    renderer = holod.Renderer(rig, "fast", width_px=90, height_px=70, backend="cpu")
    hologram = renderer.render(
        scene.rgb, scene.depth, 3.0, colour=scene.colour, depth_unit=scene.depth_unit, field=True
    )
    assert hologram.depth_clamped_far_px == report["depth_clamped_far_px"] > 0
    assert differences(hologram, daemon.folder / "out") == []


def test_a_monochrome_panel_shows_one_colour(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    mode = 'mode = "field-sequential"\nfield_order = ["green", "red", "blue"]'
    assert mode in RIG
    path.write_text(RIG.replace(mode, 'mode = "monochrome"\ncolour = "green"'))
    flat = np.zeros((3, 16, 16), np.float32)
    seen = holod.view(flat, pupil_mm=3.0, focus_dpt=0.0, rig=holod.Rig.load(path))
    assert (seen[..., 0].max(), seen[..., 2].max()) == (0, 0)
    assert seen[..., 1].max() > 0.1


def test_levels_are_those_that_a_run_sends_to_its_panel(daemon: Daemon) -> None:
    rig = daemon.folder / "rig.toml"
    rig.write_text(RIG)
    size = ["--resolution", "80x60", "--pupil", "3"]
    daemon.run("run", "--config", rig, *size, "--frames", "3", "--record", "record", *OPTIONS)
    (recorded,) = (daemon.folder / "record").glob("shown_pupil_*.png")
    expected = np.moveaxis(read_png(recorded), -1, 0)

    renderer = holod.Renderer(holod.Rig.load(rig), "fast", width_px=80, height_px=60, backend="cpu")
    scene = holod.builtin_scene(80, 60)
    given = {"colour": scene.colour, "depth_unit": scene.depth_unit}
    assert np.array_equal(renderer.render(scene.rgb, scene.depth, 3.0, **given).levels, expected)
    assert not np.array_equal(renderer.render(scene.rgb, scene.depth, 3.01, **given).levels, expected)


@pytest.mark.parametrize("bits", [8, 10])
def test_levels_in_a_record_are_read_and_looked_at_as_its_page_says(daemon: Daemon, bits: int) -> None:
    text = RIG if bits == 8 else RIG.replace("bit_depth = 8", 'bit_depth = 10\npacking = "gray10"')
    (daemon.folder / "rig.toml").write_text(text)
    size = ["--resolution", "80x60", "--pupil", "3"]
    daemon.run("run", "--config", "rig.toml", *size, "--frames", "3", "--record", "run1", *OPTIONS)
    rig = holod.Rig.load(daemon.folder / "rig.toml")
    renderer = holod.Renderer(rig, "fast", width_px=80, height_px=60, backend="cpu")
    scene = holod.builtin_scene(80, 60)
    hologram = renderer.render(scene.rgb, scene.depth, 3.0, colour=scene.colour, depth_unit=scene.depth_unit)
    (recorded,) = (daemon.folder / "run1").glob("shown_pupil_*.png")
    levels = rig.read_levels(recorded)
    assert levels.dtype == (np.uint8 if bits == 8 else np.uint16)
    assert np.array_equal(levels, hologram.levels)

    page = (Path(__file__).parents[2] / "daemon/doc/record.md").read_text()
    code = page.split("```python\n")[1].split("```")[0].replace("run1/", f"{daemon.folder}/run1/")
    made: dict[str, Any] = {}
    exec(code, made)
    assert np.array_equal(made["seen"], hologram.view(2.5))
    with pytest.raises(holod.InputError, match="expected one of 1920x1080 with 3 of 8"):
        holod.Rig.builtin().read_levels(recorded)


def test_levels_and_phases_lead_to_each_other(renderer: holod.Renderer, scene: holod.Scene) -> None:
    hologram = renderer.render(scene.rgb, scene.depth, 3.0, colour=scene.colour, depth_unit=scene.depth_unit)
    rig = holod.Rig.builtin()
    assert hologram.levels.shape == (3, 1080, 1920)
    assert hologram.levels.dtype == np.uint8
    levels = rig.levels_of(hologram.phase_rad)
    assert np.array_equal(levels, hologram.levels)
    shown = rig.phase_of(levels, width_px=SIZE[0], height_px=SIZE[1])
    assert np.array_equal(shown, hologram.shown_phase_rad())
    apart = np.abs(np.angle(np.exp(1j * (shown.astype(np.float64) - hologram.phase_rad))))
    assert 0 < apart.max() <= np.pi / 256 * 1.001
    whole = rig.phase_of(levels)
    assert whole.shape == (3, 1080, 1920)
    assert np.array_equal(rig.levels_of(whole), levels)
    assert not np.array_equal(rig.levels_of(hologram.phase_rad + np.float32(0.1)), levels)


def test_levels_of_ten_bits_are_whole(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(RIG.replace("bit_depth = 8", 'bit_depth = 10\npacking = "gray10"'))
    rig = holod.Rig.load(path)
    assert rig.bit_depth == 10
    phase_rad = np.linspace(0, 6.28, 3 * 160 * 120, dtype=np.float32).reshape(3, 120, 160)
    levels = rig.levels_of(phase_rad)
    assert levels.dtype == np.uint16
    assert levels.max() > 1000
    shown = rig.phase_of(levels)
    assert np.abs(np.angle(np.exp(1j * (shown.astype(np.float64) - phase_rad)))).max() < 0.02
    levels[1, 2, 3] = 1024
    with pytest.raises(
        holod.InputError, match=r"levels: found level 1024 \(green, row 2, column 3\), expected levels of"
    ):
        rig.phase_of(levels)


def test_holograms_are_written_to_arrays_that_are_given(renderer: holod.Renderer, scene: holod.Scene) -> None:
    given = {"colour": scene.colour, "depth_unit": scene.depth_unit}
    expected = renderer.render(scene.rgb, scene.depth, 3.0, **given)
    levels = np.zeros((3, 1080, 1920), np.uint8)
    phase_rad = np.zeros((3, SIZE[1], SIZE[0]), np.float32)
    hologram = renderer.render(scene.rgb, scene.depth, 3.0, out_levels=levels, out_phase_rad=phase_rad, **given)
    assert hologram.levels is levels
    assert hologram.phase_rad is phase_rad
    assert hologram.field is None
    assert np.array_equal(levels, expected.levels)
    assert np.array_equal(phase_rad, expected.phase_rad)
    # What is written over them later does not change what the eye sees of this one.
    levels[...] = 0
    assert np.array_equal(hologram.view(1.0), expected.view(1.0))


def test_arrays_that_are_not_contiguous_are_copied(renderer: holod.Renderer, scene: holod.Scene) -> None:
    given = {"colour": scene.colour, "depth_unit": scene.depth_unit}
    expected = renderer.render(scene.rgb, scene.depth, 3.0, **given).levels
    backwards = np.ascontiguousarray(scene.rgb[..., ::-1])
    for rgb, depth in [
        (backwards[..., ::-1], np.asfortranarray(scene.depth)),
        (np.repeat(scene.rgb, 2, axis=1)[:, ::2], scene.depth),
    ]:
        assert not (rgb.flags.c_contiguous and depth.flags.c_contiguous)
        assert np.array_equal(renderer.render(rgb, depth, 3.0, **given).levels, expected)
    assert not np.array_equal(renderer.render(backwards, scene.depth, 3.0, **given).levels, expected)

"""What is wrong is told in words, and nothing is guessed."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import holod
import numpy as np
import pytest
from conftest import RIG, SIZE
from PIL import Image

WIDTH, HEIGHT = SIZE
RGB8 = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
LINEAR = np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)
METRES = np.full((HEIGHT, WIDTH), 0.5, np.float32)
METRES[:, : WIDTH // 2] = 2.0


def changed(array: np.ndarray, where: Any, value: float) -> np.ndarray:
    array = array.copy()
    array[where] = value
    return array


def wrong(said: str, rgb: Any = RGB8, depth: Any = METRES, pupil_mm: Any = 3.0, **options: Any) -> Any:
    return pytest.param(rgb, depth, pupil_mm, {"depth_unit": "metres"} | options, said, id=said[:60])


def masked(array: np.ndarray) -> np.ndarray:
    return np.ma.masked_array(array, np.zeros(array.shape, bool))


@pytest.mark.parametrize(
    ("rgb", "depth", "pupil_mm", "options", "said"),
    [
        wrong("rgb: found list, expected a numpy array", rgb=[[0]]),
        wrong("rgb: found an array of shape (3, 64, 96), expected (64, 96, 3)", rgb=np.moveaxis(RGB8, -1, 0)),
        wrong(
            "rgb: found an array of shape (64, 96, 4), expected (64, 96, 3)", rgb=np.zeros((HEIGHT, WIDTH, 4), np.uint8)
        ),
        wrong("rgb: found an array of shape (64, 96), expected", rgb=METRES),
        wrong("rgb: found an array of float64, expected uint8", rgb=LINEAR.astype(np.float64)),
        wrong("rgb: found an array of >f4, expected uint8", rgb=LINEAR.astype(">f4")),
        wrong("colour: found none for float32, expected", rgb=LINEAR),
        wrong('colour: found "gamma" for float32', rgb=LINEAR, colour="gamma"),
        wrong('colour: found "linear" for uint8, expected "srgb"', colour="linear"),
        wrong(
            "rgb: colours: 1 values are outside 0..=1 or not finite, the first NaN (green in row 2, column 3)",
            rgb=changed(LINEAR, (2, 3, 1), np.nan),
            colour="linear",
        ),
        wrong("the first 255 (red in row 0, column 0)", rgb=LINEAR * 510, colour="srgb"),
        wrong("rgb: found a masked array, expected one without a mask, such as its filled(0)", rgb=masked(RGB8)),
        wrong(
            "depth: found a masked array, expected one without a mask, such as its filled(numpy.nan), for which there "
            "is fill_missing=True",
            depth=masked(METRES),
        ),
        wrong(
            "depth: found a masked array, expected one without a mask, such as its filled(0), for which there is "
            "fill_missing=True",
            depth=masked((METRES * 1000).astype(np.uint16)),
            depth_unit="millimetres",
        ),
        wrong(
            "out_levels: found a masked array, expected one without a mask",
            out_levels=masked(np.zeros((3, 1080, 1920), np.uint8)),
        ),
        wrong("depth: found an array of shape (96, 64), expected (64, 96)", depth=METRES.T),
        wrong("depth: found an array of float64, expected float32", depth=METRES.astype(np.float64)),
        wrong("depth: found an array of uint16, expected float32, or uint16 with", depth=METRES.astype(np.uint16)),
        wrong('depth_unit: found "m", expected "metres"', depth_unit="m"),
        wrong(
            "depths: 2 of 6144 pixels have none, the first NaN in row 4, column 5; expected metres above 0",
            depth=changed(METRES, (4, slice(5, 7)), np.nan),
        ),
        wrong("the first 0 in row 0, column 0", depth=changed(METRES, (0, 0), 0)),
        wrong("the first -1 in row 0, column 0", depth=changed(METRES, (0, 0), -1), depth_unit="dioptres"),
        wrong(
            "the first inf in row 0, column 0; expected finite numbers, 0 the far end",
            depth=changed(METRES, (0, 0), np.inf),
            depth_unit="normalised_dioptres",
        ),
        wrong("no pixel with a valid one; expected metres above 0", depth=METRES * 0, fill_missing=True),
        wrong("pupil_mm: found 0.003 mm, expected a human pupil of 0.5 to 9 mm", pupil_mm=0.003),
        wrong("pupil_mm: found NaN", pupil_mm=float("nan")),
        wrong(
            "out_levels: found an array of shape (3, 2, 2), expected (3, 1080, 1920)",
            out_levels=np.zeros((3, 2, 2), np.uint8),
        ),
        wrong("out_levels: found an array of uint16", out_levels=np.zeros((3, 1080, 1920), np.uint16)),
        wrong(
            "out_phase_rad: found a strided array", out_phase_rad=np.zeros((3, HEIGHT, 2 * WIDTH), np.float32)[..., ::2]
        ),
        wrong(
            "out_phase_rad: found a read-only array",
            out_phase_rad=np.broadcast_to(np.float32(0), (3, HEIGHT, WIDTH)).copy().view(),
        ),
    ],
)
def test_arrays_that_are_none_are_refused(
    renderer: holod.Renderer, rgb: Any, depth: Any, pupil_mm: float, options: dict[str, Any], said: str
) -> None:
    if said.endswith("read-only array"):
        options["out_phase_rad"].flags.writeable = False
    with pytest.raises(holod.InputError) as raised:
        renderer.render(rgb, depth, pupil_mm, **options)
    assert said in str(raised.value)


def test_what_is_refused_above_is_taken_when_it_is_right(renderer: holod.Renderer) -> None:
    def phases(rgb: np.ndarray, depth: np.ndarray, **options: Any) -> np.ndarray:
        return renderer.render(rgb, depth, 3.0, **options).phase_rad

    def share_apart(found: np.ndarray, expected: np.ndarray) -> float:
        return float(np.mean(np.abs(np.exp(1j * found) - np.exp(1j * expected)) > 1e-2))

    expected = phases(RGB8, METRES, depth_unit="metres")
    same_light = ((RGB8 / np.float32(255) + np.float32(0.055)) / np.float32(1.055)) ** np.float32(2.4)
    for rgb, colour in [(RGB8, "srgb"), (RGB8 / np.float32(255), "srgb"), (same_light, "linear")]:
        assert share_apart(phases(rgb, METRES, colour=colour, depth_unit="metres"), expected) < 1e-3, colour
    for rgb, colour in [(RGB8 + np.uint8(2), "srgb"), (RGB8 / np.float32(255), "linear"), (same_light, "srgb")]:
        assert share_apart(phases(rgb, METRES, colour=colour, depth_unit="metres"), expected) > 1e-2, colour
    millimetres = (METRES * 1000).astype(np.uint16)
    for depth, unit in [
        (millimetres, "millimetres"),
        (millimetres.astype(np.float32), "millimetres"),
        (1 / METRES, "dioptres"),
        ((1 / METRES) * np.float32(0.35), "normalised_dioptres"),
    ]:
        assert share_apart(phases(RGB8, depth, depth_unit=unit), expected) < 1e-3, unit
    for other, unit in [(METRES, "dioptres"), (METRES * np.float32(1.05), "metres")]:
        assert share_apart(phases(RGB8, other, depth_unit=unit), expected) > 1e-2, unit
    filled = renderer.render(RGB8, changed(METRES, (4, 5), np.nan), 3.0, depth_unit="metres", fill_missing=True)
    assert filled.depth_missing_px == 1


def test_infinity_is_a_distance_and_what_cannot_be_shown_is_counted(renderer: holod.Renderer) -> None:
    depth = changed(changed(METRES, (0, slice(0, 5)), np.inf), (1, slice(0, 7)), 0.1)
    hologram = renderer.render(RGB8, depth, 3.0, depth_unit="metres")
    assert (hologram.depth_clamped_far_px, hologram.depth_clamped_near_px) == (0, 7)


@pytest.mark.parametrize("fill_missing", [False, True])
def test_normalised_depths_outside_the_range_are_clamped_and_counted(
    renderer: holod.Renderer, fill_missing: bool
) -> None:
    beyond = changed(changed(METRES * 0 + np.float32(0.5), (0, slice(0, 5)), 1.2), (1, slice(0, 7)), -0.1)
    told = {"depth_unit": "normalised_dioptres", "fill_missing": fill_missing}
    hologram = renderer.render(RGB8, beyond, 3.0, **told)
    assert (hologram.depth_clamped_far_px, hologram.depth_clamped_near_px, hologram.depth_missing_px) == (7, 5, 0)
    assert np.array_equal(hologram.levels, renderer.render(RGB8, beyond.clip(0, 1), 3.0, **told).levels)
    assert not np.array_equal(hologram.levels, renderer.render(RGB8, beyond.clip(0, 0.5), 3.0, **told).levels)


def test_depth_of_a_wrong_unit_is_warned_of(renderer: holod.Renderer) -> None:
    with pytest.warns(
        holod.HolodWarning, match=r"the picture: all depths lie within 0\.00. dpt: is the depth encoding"
    ):
        renderer.render(RGB8, METRES * 1000, 3.0, depth_unit="metres")
    with pytest.warns(holod.HolodWarning, match="6144 of 6144 pixels lie outside the display's depth range"):
        renderer.render(RGB8, METRES, 3.0, depth_unit="millimetres")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        renderer.render(RGB8, METRES, 3.0, depth_unit="metres")
        with pytest.raises(holod.HolodWarning):
            renderer.render(RGB8, METRES * 1000, 3.0, depth_unit="metres")


def test_a_renderer_that_cannot_be_had_says_why(tmp_path: Path) -> None:
    for said, options in [
        ('weights: found "standart", expected one of standard, small, fast, or a file', {"weights": "standart"}),
        ("found a pattern of 0x5, expected 1x1 to the panel's 1920x1080", {"width_px": 0, "height_px": 5}),
        ("found a pattern of 1921x1080", {"width_px": 1921}),
        ('backend: found "cuda", expected "auto", "cpu", "cpu-half", "gpu" or "gpu-half"', {"backend": "cuda"}),
    ]:
        with pytest.raises(holod.InputError) as raised:
            holod.Renderer(**options)  # type: ignore[arg-type]
        assert said in str(raised.value)
    damaged = tmp_path / "weights.safetensors"
    damaged.write_bytes(b"nothing")
    with pytest.raises(holod.InputError, match=r"weights\.safetensors"):
        holod.Renderer(weights=damaged)


def test_all_faults_of_a_rig_are_told(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(RIG.replace("bit_depth = 8", "bit_depth = 9").replace("settle_ms = 1.0", "settle_ms = -1.0"))
    with pytest.raises(holod.RigError) as raised:
        holod.Rig.load(path)
    said = str(raised.value)
    assert said.startswith(f"rig file {path}: 2 faults\n")
    assert "line 11, panel.bit_depth: found 9" in said
    assert "panel.settle_ms: found -1" in said
    with pytest.raises(holod.RigError, match="No such file"):
        holod.Rig.load(tmp_path / "absent.toml")
    # Far from what the weights know: a rig that is right in itself.
    path.write_text(RIG.replace("= 40.0", "= 500.0"))
    with pytest.raises(holod.RigError, match="trained"):
        holod.Renderer(holod.Rig.load(path), width_px=16, height_px=16)


def test_a_rig_says_what_is_true_of_it(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(RIG)
    rig = holod.Rig.load(path)
    assert (rig.name, rig.width_px, rig.height_px, rig.bit_depth) == ("a small bench", 160, 120, 8)
    assert (rig.mode, rig.field_order, rig.refresh_hz) == ("field-sequential", ("green", "red", "blue"), 60.0)
    assert rig.pixel_pitch_m == pytest.approx(8e-6)
    assert rig.wavelengths_m == pytest.approx((638e-9, 520e-9, 450e-9))
    assert rig.eyepiece_focal_length_m == pytest.approx(0.04)
    assert (rig.depth_far_dpt, rig.depth_near_dpt) == pytest.approx((0.0, 1 / 0.35))
    assert rig.stroke_rad == pytest.approx((1.9921875 * np.pi, 2.2 * np.pi, 2.6 * np.pi))
    assert rig.weights == "fast"
    assert rig.image_distance_m(2.0) == pytest.approx(0.0032)


def test_views_of_what_is_no_phase_are_refused() -> None:
    flat = np.zeros((3, 8, 8), np.float32)
    for said, phase_rad, options in [
        ("phase_rad: found an array of shape [8, 8]", flat[0], {}),
        ("phase_rad: found an array of float64, expected float32", flat.astype(float), {}),
        ("phase_rad: found a masked array, expected one without a mask", masked(flat), {}),
        ("phase_rad: found NaN (blue, row 1, column 2)", changed(flat, (2, 1, 2), np.nan), {}),
        ("phase_rad: found 1000", changed(flat, (0, 0, 0), 1000), {}),
        ("pupil_mm: found 40", flat, {"pupil_mm": 40.0}),
        ("focus_dpt: found 400", flat, {"focus_dpt": 400.0}),
        ("amplitude_constant: found 0", flat, {"amplitude_constant": 0.0}),
    ]:
        with pytest.raises(holod.InputError) as raised:
            holod.view(phase_rad, **({"pupil_mm": 3.0, "focus_dpt": 1.0} | options))
        assert said in str(raised.value)
    assert holod.view(flat, pupil_mm=3.0, focus_dpt=1.0).shape == (8, 8, 3)
    with pytest.raises(holod.InputError, match=r"levels: found an array of shape \(3, 8, 8\)"):
        holod.Rig.builtin().phase_of(flat.astype(np.uint8))


def test_scenes_that_cannot_be_read_are_told(tmp_path: Path, picture_files: tuple[Path, Path]) -> None:
    named = ",".join(map(str, picture_files))
    for said, path, options in [
        ("absent", tmp_path / "absent", {}),
        ("depth encoding: found", named, {}),
        ("where they are left out): give it by depth_encoding", named, {}),
        ("found 1 frames; expected more than 3", named, {"frame": 3, "depth_encoding": "millimetres"}),
        ("expected at most 8x8", named, {"width_px": 8, "height_px": 8, "depth_encoding": "millimetres"}),
        ("fit: unknown variant `stretch`, expected one of `native`, `contain`", named, {"fit": "stretch"}),
        ("width_px and height_px: found one of them", named, {"width_px": 8}),
        ("width_px and height_px: found 0x8, expected at least one", named, {"width_px": 0, "height_px": 8}),
        ("found 7680x4321, expected at least one pixel", named, {"width_px": 7680, "height_px": 4321}),
        ("found 1x9223372036854775807", named, {"width_px": 1, "height_px": 2**63 - 1}),
    ]:
        with pytest.raises(holod.InputError) as raised:
            holod.load_scene(path, **options)  # type: ignore[arg-type]
        assert said in str(raised.value)


def most_turns_during(work: Callable[[], object], calls: int, enough: int) -> int:
    """The most turns that `work` gives this thread in one of so many calls by another one, which end when it is enough.

    No thread takes a turn by itself meanwhile: the interpreter would have to wait for longer than the test.
    """
    turns = [0] * calls
    inside: int | None = None

    def make_calls() -> None:
        nonlocal inside
        for call in range(calls):
            inside = call
            work()
            inside = None
            if turns[call] >= enough:
                break

    usual_s = sys.getswitchinterval()
    sys.setswitchinterval(1000.0)
    try:
        thread = threading.Thread(target=make_calls)
        thread.start()
        while thread.is_alive():
            time.sleep(0.0005)
            if inside is not None:
                turns[inside] += 1
    finally:
        sys.setswitchinterval(usual_s)
    return max(turns)


def test_other_threads_run_while_a_hologram_is_computed() -> None:
    renderer = holod.Renderer(weights="standard", width_px=512, height_px=512, backend="cpu")
    scene = holod.builtin_scene(512, 512)
    given = {"colour": scene.colour, "depth_unit": scene.depth_unit}
    hologram = renderer.render(scene.rgb, scene.depth, 3.0, **given)
    # On a busy machine this thread may sleep through some of them.
    assert most_turns_during(lambda: renderer.render(scene.rgb, scene.depth, 3.0, **given), 100, 5) >= 5
    assert most_turns_during(lambda: hologram.view(1.0), 100, 5) >= 5
    # One long operation of Python's own keeps the lock, however long it takes.
    assert most_turns_during(lambda: pow(7, 2_000_000), 3, 1) == 0, "the measurement is blind"


def test_threads_take_turns_at_one_renderer(renderer: holod.Renderer, scene: holod.Scene) -> None:
    given = {"colour": scene.colour, "depth_unit": scene.depth_unit}
    pupils_mm = (2.0, 3.0, 4.0, 5.0)
    expected = [renderer.render(scene.rgb, scene.depth, pupil_mm, **given).phase_rad for pupil_mm in pupils_mm]
    assert not np.array_equal(expected[0], expected[1])
    found: dict[float, np.ndarray] = {}

    def work(pupil_mm: float) -> None:
        found[pupil_mm] = renderer.render(scene.rgb, scene.depth, pupil_mm, **given).phase_rad

    threads = [threading.Thread(target=work, args=(pupil_mm,)) for pupil_mm in pupils_mm]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(np.array_equal(found[pupil_mm], phase) for pupil_mm, phase in zip(pupils_mm, expected, strict=True))


def resident_bytes() -> int:
    pages = Path("/proc/self/statm").read_text().split()[1]
    return int(pages) * 4096


def test_holograms_are_given_back(tmp_path: Path) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text(RIG)
    renderer = holod.Renderer(holod.Rig.load(rig), width_px=160, height_px=120, backend="cpu")
    scene = holod.builtin_scene(160, 120)
    given = {"colour": scene.colour, "depth_unit": scene.depth_unit}
    kept = []

    def grown_by(rounds: int, keep: bool) -> int:
        before = resident_bytes()
        for _ in range(rounds):
            hologram = renderer.render(scene.rgb, scene.depth, 3.0, field=True, **given)
            view = hologram.view(1.0)
            if keep:
                kept.append((hologram, view))
        return resident_bytes() - before

    grown_by(20, keep=False)
    # A hologram with its arrays and its view is 0.8 MB: of 200, even the smallest array would be 12 MB.
    assert grown_by(200, keep=False) < 10e6
    assert grown_by(60, keep=True) > 30e6, "the measurement is blind"


FORKS = """
import multiprocessing

import holod
import numpy as np

FLAT = np.zeros((3, 8, 8), np.float32)
RENDERERS = []


def seen():
    return str(holod.view(FLAT, pupil_mm=3.0, focus_dpt=1.0).shape)


def levels():
    return str(holod.Rig.builtin().levels_of(FLAT).shape)


def rendered():
    scene = holod.builtin_scene(16, 16)
    told = {"colour": scene.colour, "depth_unit": scene.depth_unit}
    return str(RENDERERS[0].render(scene.rgb, scene.depth, 3.0, **told).levels.shape)


def told(work):
    try:
        return work()
    except holod.HolodError as error:
        return str(error)


def forked(*work):
    with multiprocessing.get_context("fork").Pool(1) as pool:
        return pool.map(told, work, chunksize=1)


print(forked(seen, levels, seen))
print(seen())
RENDERERS.append(holod.Renderer(weights="fast", width_px=16, height_px=16, backend="cpu"))
for said in forked(seen, levels, rendered):
    print(said)
"""


def test_a_forked_process_is_told_that_it_has_no_threads(tmp_path: Path) -> None:
    script = tmp_path / "forks.py"
    script.write_text(FORKS)
    ended = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False, timeout=120)
    assert ended.returncode == 0, ended.stderr
    before, parent, *after = ended.stdout.splitlines()
    assert before == "['(8, 8, 3)', '(3, 1080, 1920)', '(8, 8, 3)']"
    assert parent == "(8, 8, 3)"
    assert len(after) == 3
    assert all("this process was forked" in said and '"spawn"' in said for said in after), after


def test_numbers_that_are_none_are_input_errors() -> None:
    with pytest.raises(holod.InputError, match="width_px: found -1, expected a whole number from 0 to"):
        holod.Renderer(width_px=-1, height_px=8)
    with pytest.raises(holod.InputError, match="height_px: found -2, expected a whole number"):
        holod.builtin_scene(8, -2)
    with pytest.raises(holod.InputError, match="border_px: found -3, expected a whole number"):
        holod.evaluate("scenes", border_px=-3)
    with pytest.raises(TypeError):
        holod.Renderer(width_px=1.5)  # type: ignore[arg-type]
    for depth_dpt in (float("nan"), float("inf")):
        with pytest.raises(holod.InputError, match="depth_dpt: found"):
            holod.Rig.builtin().image_distance_m(depth_dpt)


def test_scenes_are_compared_and_hashed_as_objects(scene: holod.Scene) -> None:
    other = holod.builtin_scene(*SIZE)
    assert scene == scene
    assert scene != other
    assert len({scene, other}) == 2


def rewritten_weights(folder: Path, *, number: float | None = None, amplitude_constant: float | None = None) -> Path:
    """The built-in `fast` with every number exchanged, or with another amplitude constant."""
    file = (Path(__file__).parents[2] / "model/weights/fast.safetensors").read_bytes()
    header_end = 8 + int.from_bytes(file[:8], "little")
    header, numbers = file[:header_end], file[header_end:]
    if number is not None:
        numbers = np.full(len(numbers) // 4, number, np.float32).tobytes()
    if amplitude_constant is not None:
        before = header
        header = header.replace(
            b'amplitude_constant\\": 1.25', f'amplitude_constant\\": {amplitude_constant:.2f}'.encode()
        )
        assert len(header) == len(before) and header != before
    path = folder / "weights.safetensors"
    path.write_bytes(header + numbers)
    return path


def test_holograms_that_are_no_numbers_are_refused_and_clipped_ones_warned_of(tmp_path: Path) -> None:
    def render(weights: Path) -> holod.Hologram:
        renderer = holod.Renderer(weights=weights, width_px=WIDTH, height_px=HEIGHT, backend="cpu")
        return renderer.render(RGB8, METRES, 3.0, depth_unit="metres")

    with pytest.raises(holod.InputError, match="values are no finite numbers"):
        render(rewritten_weights(tmp_path, number=1e30))
    with pytest.warns(holod.HolodWarning, match="above the amplitude_constant of the weights, and were clipped"):
        clipped = render(rewritten_weights(tmp_path, amplitude_constant=0.01))
    assert clipped.clipped_share > 0.5


def test_what_the_daemon_warns_of_in_a_scene_is_warned_of(tmp_path: Path) -> None:
    Image.fromarray(RGB8).save(tmp_path / "colour.png")
    depth_mm = np.zeros((HEIGHT, WIDTH), np.uint16)
    depth_mm[:20] = 500
    Image.fromarray(depth_mm).save(tmp_path / "depth.png")
    named = f"{tmp_path}/colour.png,{tmp_path}/depth.png"
    with pytest.warns(holod.HolodWarning, match="depths .* are missing and were filled from their surroundings"):
        holod.load_scene(named, depth_encoding="millimetres")


def test_a_display_server_that_hangs_is_not_asked_for_the_graphics_processor(tmp_path: Path) -> None:
    """A layer of Mesa's Vulkan asks it where nobody forbids that."""
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "wayland-0"))
        server.listen()
        make = "import holod; print(holod.Renderer(weights='fast', width_px=64, height_px=64).engine)"
        environment = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path), "WAYLAND_DISPLAY": "wayland-0"}
        environment.pop("NODEVICE_SELECT", None)
        made = subprocess.run(
            [sys.executable, "-c", make], env=environment, capture_output=True, timeout=60, check=True
        )
    assert made.stdout


def test_errors_name_this_packages_arguments(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(RIG + 'gpu = "a card that nobody has"\n')
    with pytest.raises(holod.UnavailableError, match=r"^backend gpu: ") as told:
        holod.Renderer(holod.Rig.load(path), "fast", width_px=64, height_px=64, backend="gpu")
    assert "--backend" not in str(told.value)

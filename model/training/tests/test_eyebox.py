import math
from pathlib import Path

import pytest
import torch
from conftest import write_shard

from holod_training.cli import main
from holod_training.config import NetworkConfig, OpticsConfig
from holod_training.export import save_weights
from holod_training.eyebox import (
    ALL_IN_FOCUS,
    DIAMETERS_MM,
    LIGHT_SHIFT_MM,
    RANDOM,
    SAME_PICTURE_DB,
    SHIFTS_MM,
    diameter_holding,
    random_phase,
    sampling_interval,
    share_inside,
    study,
)
from holod_training.network import DirectNetwork
from holod_training.optics import frequencies, pupil_mask
from holod_training.rivals import all_in_focus
from holod_training.shards import Shard

OPTICS = OpticsConfig()


def test_a_plane_wave_leaves_through_its_point_of_the_pupil() -> None:
    size, bin_x = 64, 10
    f = frequencies(size, OPTICS.pitch_m)
    spectrum = torch.zeros(3, size, size, dtype=torch.complex64)
    spectrum[:, 0, bin_x] = 1
    radius_mm = 1e3 * OPTICS.wavelengths_m[1] * OPTICS.focal_length_m * float(f[bin_x])
    shares = share_inside(spectrum, OPTICS, f, f)
    found = diameter_holding(0.99, shares)
    assert found is not None and abs(found - 2 * radius_mm) < 0.1
    away = pupil_mask(OPTICS, f, f, 0.1, radius_mm)[1]
    assert away[0, bin_x] and not away[0, 0]


def test_random_phase_fills_the_stop_and_tolerates_shifts_less_than_smooth_phase(tmp_path: Path) -> None:
    stack = Shard(write_shard(tmp_path / "scene_000000.safetensors")).read(0)
    found = study(
        [stack],
        {
            ALL_IN_FOCUS: lambda s: all_in_focus(s.amplitude, s.depth, OPTICS),
            RANDOM: lambda s: random_phase(s, OPTICS, seed=3),
        },
        OPTICS,
    )
    smooth, rough = (diameter_holding(0.5, found.share_inside[name]) for name in (ALL_IN_FOCUS, RANDOM))
    assert smooth is not None and rough is not None and smooth < 0.2 < 0.7 < rough
    assert found.light[ALL_IN_FOCUS, 3.0][0] == 1
    half = SHIFTS_MM.index(LIGHT_SHIFT_MM)
    assert found.light[RANDOM, 1.0][half] > 4 * found.light[ALL_IN_FOCUS, 1.0][half]
    # A shift that leaves the whole stop inside the pupil changes nothing.
    assert found.alike_db[RANDOM, 5.0][half] == found.alike_db[RANDOM, 5.0][0]


def test_the_interval_lies_where_the_curve_crosses_the_bar() -> None:
    falling = [120.0, *(SAME_PICTURE_DB + 60 - 200 * shift for shift in SHIFTS_MM[1:])]
    assert sampling_interval(falling) == pytest.approx(0.3)
    squares = [120.0, *(-20 * math.log10(shift / 0.004) + SAME_PICTURE_DB for shift in SHIFTS_MM[1:])]
    assert sampling_interval(squares) == pytest.approx(0.004)
    assert sampling_interval([120.0] * len(SHIFTS_MM)) is None
    assert diameter_holding(0.9, [0.0] * len(DIAMETERS_MM)) is None


def test_the_command_writes_page_record_and_plot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_shard(tmp_path / "shards" / "scene_000000.safetensors")
    save_weights(
        tmp_path / "w.safetensors", DirectNetwork(NetworkConfig(layers=4, channels=4, adjustable_layers=(1,))), {}, {}
    )
    arguments = ["--weights", str(tmp_path / "w.safetensors"), "--test", str(tmp_path / "shards")]
    assert main(["eyebox", *arguments, "--out", str(tmp_path / "out")]) == 0
    page = capsys.readouterr().out
    assert "| layered, random phase |" in page and "all made for a pupil of 3 mm, whichever looks" in page
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"eyebox.md", "eyebox.json", "eyebox.png"}
    assert main(["eyebox", *arguments[:2], "--test", str(tmp_path / "none"), "--out", str(tmp_path / "out")]) == 65
    capsys.readouterr()
    assert main(["eyebox", *arguments, "--limit", "0", "--out", str(tmp_path / "other")]) == 65
    assert "--limit: found 0, expected at least 1 scene" in capsys.readouterr().err
    write_shard(tmp_path / "small" / "scene_000000.safetensors", size=48)
    assert main(["eyebox", *arguments[:2], "--test", str(tmp_path / "small"), "--out", str(tmp_path / "other")]) == 65
    assert "48x48 pixels, expected at least 49x49 within a border of 24" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()

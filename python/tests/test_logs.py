"""Logs are what `holod log` says that they are."""

from __future__ import annotations

import csv
import os
from pathlib import Path
from typing import Any

import holod
import numpy as np
import pytest
from conftest import Daemon


def disagreements(log: holod.PupilLog, daemon: Daemon, path: Path) -> list[str]:
    """In what a log is not that of `holod log info` and `holod log convert`."""
    wrong = []
    info: dict[str, Any] = daemon.json("log", "info", path)
    del info["gate"]
    if log.info != info:
        wrong.append("info")
    daemon.run("log", "convert", path, "--to", "csv", "--out", "log.csv", "--force")
    with open(daemon.folder / "log.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    diameter = next(name for name in rows[0] if name.startswith("diameter_"))
    columns = {
        "t_ns": [int(row["t_ns"]) for row in rows],
        "eye": [row["eye"] for row in rows],
        "diameter": [np.float32(row[diameter] or "nan") for row in rows],
        "confidence": [np.float32(row["confidence"]) for row in rows],
        "aperture_mm": [np.float32(row["aperture_mm"] or "nan") for row in rows],
        "valid": [row["valid"] == "1" for row in rows],
    }
    for name, expected in columns.items():
        found = getattr(log, name)
        is_number = found.dtype == np.float32
        if not np.array_equal(found, np.array(expected, found.dtype), equal_nan=is_number):
            wrong.append(name)
    return wrong


@pytest.fixture
def log_file(tmp_path: Path) -> Path:
    """holod's own CSV of two eyes, with blinks, a line that is none and one that goes back."""
    lines = ["t_ns,eye,diameter_mm,confidence,aperture_mm,valid"]
    for sample in range(400):
        for eye, offset in (("left", 0.0), ("right", 0.1)):
            shut = 100 <= sample < 120
            figure = "" if shut else f"{3.5 + offset + 0.001 * sample:.4f}"
            lines.append(
                f"{5_000_000 * sample},{eye},{figure},{0.0 if shut else 0.9},{'' if shut else 9.5},{int(not shut)}"
            )
    lines.insert(50, "nonsense")
    lines.append("3,left,3.5,1,,1")
    path = tmp_path / "log.txt"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_log_is_read_as_the_daemon_reads_it(daemon: Daemon, log_file: Path) -> None:
    log = holod.read_log(log_file)
    assert disagreements(log, daemon, log_file) == []
    assert (len(log), log.format, log.unit) == (800, "holod CSV", "mm")
    assert sum(log.rejected.values()) == 2
    assert log.t_s[-1] == pytest.approx(1.995)
    assert np.array_equal(log.diameter_mm, log.diameter, equal_nan=True)
    left = log.valid & (log.eye == "left")
    assert (int(left.sum()), log.diameter_mm[left].min()) == (380, pytest.approx(3.5))
    # The comparison sees one sample that is another.
    log.diameter[7] += np.float32(1e-6)
    log.t_ns[9] += 1
    assert disagreements(log, daemon, log_file) == ["t_ns", "diameter"]


def test_a_log_in_another_unit_wants_a_scale(tmp_path: Path, log_file: Path) -> None:
    path = tmp_path / "pixels.txt"
    path.write_text(log_file.read_text().replace("diameter_mm", "diameter_px"))
    log = holod.read_log(path)
    assert log.unit == "camera pixels"
    with pytest.raises(holod.InputError, match="the log is in camera pixels; give read_log its scale_mm_per_unit"):
        _ = log.diameter_mm
    scaled = holod.read_log(path, scale_mm_per_unit=0.05)
    assert scaled.diameter_mm[0] == pytest.approx(0.175)
    assert (scaled.unit, scaled.diameter[0]) == ("camera pixels", pytest.approx(3.5))
    # The last looks like micrometres.
    for scale in (0.0, -1.0, float("nan"), 125.0):
        with pytest.raises(holod.InputError, match="scale_mm_per_unit: found"):
            holod.read_log(path, scale_mm_per_unit=scale)


def test_what_is_no_log_is_refused_with_the_whole_text(tmp_path: Path, daemon: Daemon) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("shopping: bread\n")
    for name in (path, tmp_path, tmp_path / "absent"):
        with pytest.raises(holod.InputError) as raised:
            holod.read_log(name)
        ended = daemon.try_run("log", "info", name)
        assert ended.returncode != 0
        assert f"holod: error: {raised.value}\n" in ended.stderr


SHARED = Path(os.environ.get("HOLOD_SHARED_DATA", Path(__file__).parents[3] / "shared/data")) / "pupil"


@pytest.mark.skipif(not SHARED.is_dir(), reason="the recordings outside the repository are not here")
def test_shared_data_is_read_as_the_daemon_reads_it(daemon: Daemon) -> None:
    read = 0
    for path in sorted(path for path in SHARED.glob("**/*") if path.is_file()):
        if daemon.try_run("log", "info", path).returncode != 0:
            with pytest.raises(holod.InputError):
                holod.read_log(path)
            continue
        assert disagreements(holod.read_log(path), daemon, path) == [], path
        read += 1
    assert read >= 3


def test_blinks_that_a_log_tells_have_times(tmp_path: Path) -> None:
    lines = [
        "** CONVERTED FROM x.edf",
        "START\t1000 \tLEFT\tSAMPLES\tEVENTS",
        "PUPIL\tDIAMETER",
        "SAMPLES\tGAZE\tLEFT\tRATE\t500.00\tTRACKING\tCR\tFILTER\t2",
    ]
    for sample in range(100):
        if sample == 40:
            lines.append("SBLINK L 1080")
        lines.append(f"{1000 + 2 * sample}\t512.0\t384.0\t{0.0 if 40 <= sample < 60 else 1200.0}\t...")
        if sample == 60:
            lines.append("EBLINK L 1080\t1118\t40")
    path = tmp_path / "log.asc"
    path.write_text("\n".join(lines) + "\n")
    log = holod.read_log(path)
    assert log.format == "EyeLink .asc"
    assert [(blink.eye, blink.end_ns - blink.begin_ns) for blink in log.blinks] == [("left", 38_000_000)]

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A socket for the test to listen on."""
    return tmp_path / "feed"


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No test finds a holod that runs on this machine, in the folder for temporary files."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))

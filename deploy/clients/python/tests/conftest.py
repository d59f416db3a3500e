from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A socket for the test to listen on."""
    return tmp_path / "feed"

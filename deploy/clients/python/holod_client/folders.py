"""Where a holod has its sockets by itself, as daemon/src/runtime_folder.rs says."""

from __future__ import annotations

import os
from pathlib import Path


def own_folders() -> list[Path]:
    """Those of this user's holod, the best one first."""
    runtime, xdg_runtime = os.environ.get("RUNTIME_DIRECTORY"), os.environ.get("XDG_RUNTIME_DIR")
    user_runtime = Path(f"/run/user/{os.getuid()}")
    if runtime:
        return [Path(runtime)]
    if xdg_runtime:
        return [Path(xdg_runtime) / "holod"]
    if user_runtime.exists():
        return [user_runtime / "holod"]
    return [Path(f"/tmp/holod-{os.getuid()}")]

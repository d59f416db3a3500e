"""Where a holod has its sockets by itself, as daemon/src/runtime_folder.rs says."""

from __future__ import annotations

import os
import stat
from pathlib import Path


def own_folders() -> list[Path]:
    """Where this user's holod may have them, the best place first: it takes the first one that it may write to."""
    runtime, xdg_runtime = _named("RUNTIME_DIRECTORY"), _named("XDG_RUNTIME_DIR")
    login = Path(f"/run/user/{os.getuid()}")
    if xdg_runtime is None and login.is_dir():
        xdg_runtime = login
    folders = [] if runtime is None else [runtime]
    folders += [] if xdg_runtime is None else [xdg_runtime / "holod"]
    return [*folders, temporary_folder()]


def temporary_folder() -> Path:
    """The last one of these. Anybody could have made it first: it must be used only where it `is_own`."""
    return Path(os.environ.get("TMPDIR", "/tmp")) / f"holod-{os.getuid()}"


def is_own(folder: Path) -> bool:
    """Whether it is there, no link, and this user's."""
    try:
        found = os.lstat(folder)
    except OSError:
        return False
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid()


def warning_of(folder: Path) -> str:
    """For an error where nothing was found, that something else lies in the place of one's own folder, or nothing."""
    if is_own(folder) or not os.path.lexists(folder):
        return ""
    return f"; nothing in {folder} is used, which is no folder of this user's"


def _named(variable: str) -> Path | None:
    path = Path(os.environ.get(variable, ""))
    return path if path.is_absolute() else None

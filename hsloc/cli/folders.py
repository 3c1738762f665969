"""The folder that a command leaves its results in."""

from __future__ import annotations

import contextlib
import os
from datetime import datetime
from pathlib import Path


def default_folder(name: str) -> Path:
    """results/<name>-<time>."""
    stamp = datetime.now().astimezone().strftime("%Y-%m-%d_%H-%M-%S")
    return Path("results") / f"{name}-{stamp}"


def refuse_early(folder: Path, overwrite: bool) -> None:
    """A folder that cannot be written is told before the work, not after it: raises OutputError."""
    from hsloc.errors import OutputError
    from hsloc.export.results_folder import refuse_folder

    refuse_folder(folder, overwrite)
    parent = folder.resolve().parent
    while not parent.exists():
        parent = parent.parent
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise OutputError(f"{folder}: cannot be written: {parent} is not a folder that may be written to")


def link_latest(folder: Path) -> None:
    """`results/latest` points to the newest results; without it (no symbolic links here) nothing is lost."""
    link = folder.parent / "latest"
    with contextlib.suppress(OSError):
        if link.is_symlink():
            link.unlink()
        link.symlink_to(folder.name, target_is_directory=True)

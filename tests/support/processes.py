"""What other processes do, asked of the kernel."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path


def in_session(leader: int) -> list[int]:
    """The processes of a session, which its leader and their children have started."""
    found = []
    for folder in Path("/proc").iterdir():
        with contextlib.suppress(OSError, ValueError):
            if os.getsid(int(folder.name)) == leader:
                found.append(int(folder.name))
    return found


def has_open(process: int, path: Path) -> bool:
    """Whether a process has a file open."""
    with contextlib.suppress(OSError):
        return any(os.path.samefile(each, path) for each in Path(f"/proc/{process}/fd").iterdir() if each.exists())
    return False

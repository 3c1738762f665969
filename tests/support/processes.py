"""What other processes do, asked of the kernel."""

from __future__ import annotations

import contextlib
import ctypes
import os
from pathlib import Path

_PR_CAPBSET_DROP = 24
_OVERRIDES = (1, 2)
"""CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH of capability.h: with them root reads and writes whatever the rights say."""


def heed_rights() -> None:
    """For `preexec_fn`: the program that follows heeds the rights of files, also as root."""
    for capability in _OVERRIDES:
        ctypes.CDLL(None).prctl(_PR_CAPBSET_DROP, capability, 0, 0, 0)


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

"""What other processes do, asked of the kernel."""

from __future__ import annotations

import contextlib
import ctypes
import os
import platform
import struct
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

T = TypeVar("T")

_CAPGET, _CAPSET = {"x86_64": (125, 126), "aarch64": (90, 91)}.get(platform.machine(), (None, None))
_VERSION_3 = 0x20080522
_OVERRIDES = 1 << 1 | 1 << 2
"""CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH of capability.h: with them root reads and writes whatever the rights say."""


def heeding_rights(work: Callable[[], T]) -> T:
    """What `work` returns in a thread that heeds the rights of files, also as root; what it starts does not."""
    with ThreadPoolExecutor(1, initializer=_heed_rights) as executor:
        return executor.submit(work).result()


def _heed_rights() -> None:
    """Of this thread: capabilities of Linux are those of a thread, and access(2) asks for the permitted ones."""
    libc = ctypes.CDLL(None, use_errno=True)
    header = struct.pack("Ii", _VERSION_3, 0)
    held = ctypes.create_string_buffer(24)  # effective, permitted and inheritable, the lower 32 bits and the others
    if _CAPGET is None or libc.syscall(_CAPGET, header, held) != 0:
        raise OSError(ctypes.get_errno(), "capget")
    effective, permitted, *others = struct.unpack("6I", held.raw)
    wanted = struct.pack("6I", effective & ~_OVERRIDES, permitted & ~_OVERRIDES, *others)
    if libc.syscall(_CAPSET, header, wanted) != 0:
        raise OSError(ctypes.get_errno(), "capset")


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

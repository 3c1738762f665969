"""Limits that a job's process puts on itself before it touches a byte of the upload. Standard library only."""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
import signal
import sys
from typing import TYPE_CHECKING, Any

from hsloc_service.execution import landlock

if TYPE_CHECKING:
    from collections.abc import Mapping

PR_SET_PDEATHSIG = 1
PR_SET_NO_NEW_PRIVS = 38


def apply(limits: Mapping[str, Any], parent: int) -> None:
    """Die with the server, then bound memory, processor time, file size, open files and, by Landlock, what is visible.

    Raises SystemExit if the server died before the first of these.
    """
    if sys.platform == "linux":
        libc = ctypes.CDLL(None, use_errno=True)
        libc.prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        libc.prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
        if os.getppid() != parent:
            raise SystemExit("the server is gone")
    _limit(resource.RLIMIT_AS, int(limits["memory_bytes"]))
    cpu = max(1, int(limits["cpu_s"]))
    _limit(resource.RLIMIT_CPU, cpu, cpu + 5)
    _limit(resource.RLIMIT_FSIZE, int(limits["output_bytes"]))
    _limit(resource.RLIMIT_NOFILE, int(limits["open_files"]))
    _limit(resource.RLIMIT_CORE, 0)
    with contextlib.suppress(OSError):
        os.nice(10)  # the API answers first
    os.umask(0o077)
    if limits.get("landlock") is not None:
        landlock.restrict(limits["landlock"]["read"], limits["landlock"]["write"])


def _limit(which: int, soft: int, hard: int | None = None) -> None:
    """Set a limit, never above the hard one that is in force."""
    ceiling = resource.getrlimit(which)[1]
    hard = soft if hard is None else hard
    if ceiling != resource.RLIM_INFINITY:
        soft, hard = min(soft, ceiling), min(hard, ceiling)
    resource.setrlimit(which, (soft, hard))

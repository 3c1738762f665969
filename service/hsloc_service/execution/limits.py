"""Limits that a job's process puts on itself before it touches a byte of the upload. Standard library only.

Of memory, time and files by `setrlimit`; of what it can see by Landlock and seccomp (Linux), for machines without
bubblewrap. After `restrict` the process, and all that it starts, can read and write only below the folders that it
named, open no socket but pairs of its own, change no permission, owner or time of a file, and signal only its own
children. It cannot be undone.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import platform
import resource
import signal
import struct
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

PR_SET_PDEATHSIG = 1

CREATE_RULESET, ADD_RULE, RESTRICT_SELF = 444, 445, 446
"""System calls, the same on every architecture."""
EXECUTE, WRITE_FILE, READ_FILE, READ_DIR = (1 << bit for bit in range(4))
MAKE_CHAR, MAKE_BLOCK, REFER, TRUNCATE, IOCTL_DEV = (1 << bit for bit in (6, 11, 13, 14, 15))
READ = EXECUTE | READ_FILE | READ_DIR
FILE = EXECUTE | WRITE_FILE | READ_FILE | TRUNCATE
"""Rights that a rule for a single file may have."""
DEVICES = ("/dev/null", "/dev/zero", "/dev/urandom", "/dev/random")
MIN_LANDLOCK_ABI = 3
"""Linux 6.2: before, a file could be truncated without a right to."""
PR_SET_NO_NEW_PRIVS, PR_SET_SECCOMP, SECCOMP_MODE_FILTER = 38, 22, 2
_REFUSED = {
    "x86_64": (0xC000003E, (41, 90, 91, 92, 93, 94, 132, 188, 189, 190, 197, 198, 199, 235, 260, 261, 268, 280)),
    "aarch64": (0xC00000B7, (198, 5, 6, 7, 14, 15, 16, 52, 53, 54, 55, 88)),
}
"""Audit architecture, and system calls that Landlock lets pass: `socket`, as it knows TCP alone, and a socket in a
folder may be that of a database; of any file, changes of its permissions, owner, times and extended attributes."""
_REFUSED_EVERYWHERE = (425, 452, 463, 466, 469)
"""io_uring_setup, which would open sockets, too, fchmodat2, setxattrat, removexattrat and file_setattr, the same on
every architecture."""


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
        restrict(limits["landlock"]["read"], limits["landlock"]["write"])


def _limit(which: int, soft: int, hard: int | None = None) -> None:
    """Set a limit, never above the hard one that is in force."""
    ceiling = resource.getrlimit(which)[1]
    hard = soft if hard is None else hard
    if ceiling != resource.RLIM_INFINITY:
        soft, hard = min(soft, ceiling), min(hard, ceiling)
    resource.setrlimit(which, (soft, hard))


def landlock_abi() -> int:
    """Version of Landlock that the kernel has; 0 if it has none, or if `_REFUSED` lacks the architecture."""
    if platform.machine() not in _REFUSED:
        return 0
    return max(int(_libc().syscall(CREATE_RULESET, None, 0, 1)), 0)


def restrict(readable: Iterable[str], writable: Iterable[str]) -> None:
    """Allow this process to read below `readable` and to write below `writable`, and nothing else.

    Raises OSError if the kernel refuses, in which case the process must end.
    """
    libc, version = _libc(), landlock_abi()
    if version < MIN_LANDLOCK_ABI:
        raise OSError(errno.ENOSYS, "the kernel has no Landlock")
    libc.prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
    handled = (1 << (16 if version >= 5 else 15)) - 1
    # The network (TCP) and, from Linux 6.12 on, signals and abstract sockets.
    attributes = struct.pack("QQQ", handled, 3 if version >= 4 else 0, 3 if version >= 6 else 0)
    size = 24 if version >= 6 else 16 if version >= 4 else 8
    ruleset = _checked(libc.syscall(CREATE_RULESET, attributes, size, 0))
    everything = handled & ~(MAKE_CHAR | MAKE_BLOCK | IOCTL_DEV)
    rules = [(path, READ) for path in readable] + [(path, everything) for path in writable]
    for path, access in [*rules, *((path, READ_FILE | WRITE_FILE) for path in DEVICES)]:
        _allow(libc, ruleset, path, access & handled)
    _checked(libc.syscall(RESTRICT_SELF, ruleset, 0))
    os.close(ruleset)
    _refuse_calls(libc)


def _allow(libc: ctypes.CDLL, ruleset: int, path: str, access: int) -> None:
    try:
        descriptor = os.open(path, os.O_PATH | os.O_CLOEXEC)
    except FileNotFoundError:
        return
    try:
        if not os.path.isdir(path):
            access &= FILE
        _checked(libc.syscall(ADD_RULE, ruleset, 1, struct.pack("=Qi", access, descriptor), 0))
    finally:
        os.close(descriptor)


def _refuse_calls(libc: ctypes.CDLL) -> None:
    """Let the system calls fail with EACCES that Landlock lets pass."""
    architecture, own = _REFUSED[platform.machine()]
    numbers = (*own, *_REFUSED_EVERYWHERE)
    load, equal, at_least, result = 0x20, 0x15, 0x35, 0x06
    allow, refuse = 0x7FFF0000, 0x00050000 | errno.EACCES
    program = [
        (load, 0, 0, 4),  # the architecture of the call
        (equal, 1, 0, architecture),
        (result, 0, 0, refuse),  # of a foreign one, whose numbers differ
        (load, 0, 0, 0),  # the number of the call
        (at_least, len(numbers) + 1, 0, 0x40000000),  # the same calls once more, of x32
        *((equal, len(numbers) - index, 0, number) for index, number in enumerate(numbers)),
        (result, 0, 0, allow),
        (result, 0, 0, refuse),
    ]
    code = b"".join(struct.pack("HBBI", *each) for each in program)
    buffer = ctypes.create_string_buffer(code)

    class Program(ctypes.Structure):
        _fields_ = (("length", ctypes.c_ushort), ("filter", ctypes.c_void_p))

    filled = Program(len(program), ctypes.cast(buffer, ctypes.c_void_p))
    _checked(libc.prctl(PR_SET_SECCOMP, SECCOMP_MODE_FILTER, ctypes.byref(filled), 0, 0))


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def _checked(result: int) -> int:
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, f"Landlock: {os.strerror(number)}")
    return int(result)

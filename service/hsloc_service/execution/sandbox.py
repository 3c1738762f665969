"""What a job's process sees of the machine: Python and its libraries, its input, its own folder; no network.

bubblewrap gives it namespaces of its own (mounts, processes, network), Landlock and seccomp take the rest away from it
in the namespaces of the server.
"""

from __future__ import annotations

import logging
import os
import shutil
import subprocess
import sys
import sysconfig
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import hsloc
import hsloc_service
from hsloc_service.execution import limits
from hsloc_service.logs import log
from hsloc_service.settings import SettingsError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

SYSTEM = ("/usr", "/bin", "/sbin", "/lib", "/lib32", "/lib64", "/libx32")
SYSTEM_FILES = ("/etc/ld.so.cache", "/etc/ld.so.conf", "/etc/ld.so.conf.d", "/etc/fonts", "/etc/localtime")
PROBE_S = 10.0


@dataclass(frozen=True)
class Sandbox:
    """`kind` is `bubblewrap`, `landlock` or `none`; `hidden` is the data folder, of which a job sees its part only."""

    kind: str
    hidden: Path
    command: tuple[str, ...]
    """The worker's program; files that it names, and what is beside them, are visible."""

    def wrap(self, command: Sequence[str], folder: Path, inputs: Iterable[Path]) -> list[str]:
        """The command, in bubblewrap if that is the kind. `inputs` are visible to it, `folder` can be written to."""
        if self.kind != "bubblewrap":
            return list(command)
        options = ["--unshare-all", "--die-with-parent", "--proc", "/proc", "--dev", "/dev", "--tmpfs", "/tmp"]
        for path in SYSTEM:
            if os.path.islink(path):
                options += ["--symlink", os.readlink(path), path]
            else:
                options += ["--ro-bind-try", path, path]
        for path in (*SYSTEM_FILES, *map(str, self.python)):
            options += ["--ro-bind-try", path, path]
        hidden = str(self.hidden)
        if any(self.hidden.is_relative_to(path) for path in (*map(Path, SYSTEM), *self.python)):
            options += ["--tmpfs", hidden]
        options += ["--bind", str(folder), str(folder)]
        for path in map(str, inputs):
            options += ["--ro-bind", path, path]
        return [_bubblewrap(), *options, "--chdir", str(folder), "--", *command]

    def landlock(self, folder: Path, inputs: Iterable[Path]) -> dict[str, list[str]] | None:
        """What the process is to allow itself; None for the other kinds."""
        if self.kind != "landlock":
            return None
        visible = [each for path in self.python for each in _without(path, self.hidden)]
        read = [*SYSTEM, *SYSTEM_FILES, *map(str, visible), *map(str, inputs)]
        return {"read": read, "write": [str(folder)]}

    @cached_property
    def python(self) -> tuple[Path, ...]:
        """Folders of Python, of its modules, and of the worker's program."""
        found = {Path(path).absolute() for path in (sys.prefix, sys.base_prefix, *sysconfig.get_paths().values())}
        found |= {Path(path).absolute() for path in sys.path if path}
        found |= {path for path in map(Path, os.environ.get("PYTHONPATH", "").split(":")) if path.is_absolute()}
        # An editable install finds its packages through a hook, outside sys.path.
        found |= {Path(each).absolute() for package in (hsloc, hsloc_service) for each in package.__path__}
        programs = [Path(each) for each in self.command if os.path.isabs(each)]
        found |= {path.parent for each in programs for path in (each, each.resolve())}
        found |= {each.resolve() for each in tuple(found)}
        return tuple(sorted(path for path in found if path.exists() and path != Path("/")))

    def caches(self, folder: Path, shared: Path) -> dict[str, str]:
        """Variables that name the caches of numba and matplotlib: copies of its own for a job in a sandbox.

        What is in them is executed. If jobs could write to a common one, a hostile job would run in those of others.
        """
        own = folder / "tmp" / "cache"
        found = {}
        for name, source in caches_of(shared).items():
            found[name] = str(source)
            if self.kind != "none":
                found[name] = str(own / name)
                with suppress(OSError, shutil.Error):
                    shutil.copytree(source, own / name)
        return found


def caches_of(shared: Path) -> dict[str, Path]:
    """Variables and folders of the caches that the server fills itself."""
    return {
        "NUMBA_CACHE_DIR": Path(os.environ.get("NUMBA_CACHE_DIR") or shared / "numba"),
        "MPLCONFIGDIR": Path(os.environ.get("MPLCONFIGDIR") or shared / "matplotlib"),
    }


def choose_sandbox(wanted: str, data: Path, command: tuple[str, ...]) -> Sandbox:
    """The sandbox of this machine. Raises SettingsError where what is wanted cannot be had."""
    hidden = data.absolute().resolve()
    if wanted == "none":
        return Sandbox("none", hidden, command)
    reasons = []
    if wanted in ("auto", "if-possible", "bubblewrap"):
        if (reason := bubblewrap_problem()) is None:
            return Sandbox("bubblewrap", hidden, command)
        reasons.append(f"bubblewrap: {reason}")
    if wanted in ("auto", "if-possible", "landlock"):
        if (version := limits.landlock_abi()) >= limits.MIN_LANDLOCK_ABI:
            return Sandbox("landlock", hidden, command)
        reasons.append(f"Landlock: the kernel has version {version}, {limits.MIN_LANDLOCK_ABI} is needed")
    problem = f"jobs cannot be kept apart on this machine ({'; '.join(reasons)})"
    if wanted == "if-possible":
        log("sandbox.none", logging.WARNING, problem=problem)
        return Sandbox("none", hidden, command)
    raise SettingsError(
        f"{problem}; install bubblewrap, or, where all who may upload trust each other, set HSLOC_SANDBOX=none"
    )


def bubblewrap_problem() -> str | None:
    """Why bubblewrap does not work here; None if it does."""
    if not _bubblewrap():
        return "not installed"
    command = [_bubblewrap(), "--unshare-all", "--die-with-parent", "--ro-bind", "/", "/", "--proc", "/proc", "true"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=PROBE_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return str(error)
    return None if done.returncode == 0 else (done.stderr.strip().splitlines() or ["it fails"])[-1][:200]


def _bubblewrap() -> str:
    return shutil.which("bwrap") or ""


def _without(path: Path, hidden: Path) -> Iterator[Path]:
    """`path`, or what is in it but for `hidden`: Landlock can allow a folder, and not take away a part of it."""
    if path.is_relative_to(hidden):
        return
    if not hidden.is_relative_to(path):
        yield path
        return
    for each in sorted(path.iterdir()):
        yield from _without(each, hidden)

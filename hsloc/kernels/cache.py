"""Where compiled kernels are kept, and what is reported while they are compiled.

numba keeps them beside the sources, else in the user's cache folder, and raises where it may write to neither: a user
without a home, or a read-only container. Then a private folder among the temporary files is used, and without that
they are compiled again in each process.

A compiled kernel contains those that it calls. numba compares the source of the kernel alone, so that after an upgrade
it would run old code where only a called kernel has changed; here all sources count.
"""

from __future__ import annotations

import hashlib
import os
import stat
import tempfile
import warnings
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numba
from numba.core import caching, config, environment, event
from numba.core.dispatcher import Dispatcher
from numba.core.runtime.nrt import rtsys

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

_PARENTS = ("/dev/shm",)
"""Tried after the folder of temporary files."""
_SOURCES = Path(__file__).parent
"""Every kernel is in this folder."""


def choose_cache() -> None:
    """Give numba a folder that can be written, or leave its cache out with a warning."""
    if _can_cache():
        return
    folder = _private_folder()
    if folder is not None:
        setattr(config, "CACHE_DIR", str(folder))  # noqa: B010
        if _can_cache():
            return
    warnings.warn(
        "no folder for compiled kernels can be written, so they are compiled in every process (about 20 s); "
        "set NUMBA_CACHE_DIR to a folder that can be written",
        RuntimeWarning,
        stacklevel=2,
    )
    # The decorators ask for a cache, and numba raises where it finds no place for one.
    setattr(Dispatcher, "enable_caching", lambda _: None)  # noqa: B010


def compare_all_sources() -> None:
    """Let numba take a kernel from its cache only if no kernel's source has changed since."""
    locator = caching._SourceFileBackedLocatorMixin
    of_one_file: Callable[[Any], Any] = locator.get_source_stamp

    def stamp(self: Any) -> Any:
        found = of_one_file(self)
        return (found, _digest(_SOURCES)) if Path(self._py_file).parent == _SOURCES else found

    setattr(locator, "get_source_stamp", stamp)  # noqa: B010


def load_without_compiler() -> None:
    """Let numba load a kernel from its cache without what only its compiler needs.

    Before it looks into the cache numba imports the declarations of all functions that can be compiled, and SciPy's
    linear algebra with them: 0.25 s of each command. Whatever is not in the cache is compiled as ever.
    """

    def load_overload(self: Any, signature: Any, target_context: Any) -> Any:
        # The memory manager, which compiled kernels call, is set up with those declarations.
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(signature, target_context)

    def rebuild_environment(module: str, constants: list[Any], name: str) -> Any:
        # Compiled code without Python objects uses the constants alone. numba imports the module for its globals: for
        # a sum in a kernel those of all array functions, and SciPy's linear algebra.
        known: Any = environment.Environment._memo
        found = known.get(name)
        if found is None:
            found = environment.Environment({"__name__": module})
            found.consts[:] = constants
            found.env_name = name
            known[name] = found
        return found

    if hasattr(caching.Cache, "_load_overload"):
        setattr(caching.Cache, "load_overload", load_overload)  # noqa: B010
    if hasattr(environment, "_rebuild_env") and hasattr(environment.Environment, "_memo"):
        setattr(environment, "_rebuild_env", rebuild_environment)  # noqa: B010


@cache
def _digest(folder: Path) -> str:
    """SHA-256 of all modules of a folder."""
    found = hashlib.sha256()
    for path in sorted(folder.glob("*.py")):
        found.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return found.hexdigest()


def _can_cache() -> bool:
    def probe() -> None: ...

    try:
        numba.njit(cache=True)(probe)
    except RuntimeError:
        return False
    return True


def _private_folder() -> Path | None:
    """A folder among the temporary files that belongs to this user alone: what is loaded from it is executed."""
    user = os.getuid() if hasattr(os, "getuid") else 0
    for parent in (tempfile.gettempdir(), *_PARENTS):
        folder = Path(parent) / f"hsloc-kernels-{user}"
        try:
            folder.mkdir(mode=0o700, exist_ok=True)
            found = folder.lstat()
        except OSError:
            continue
        if stat.S_ISDIR(found.st_mode) and found.st_uid == user and not found.st_mode & 0o022:
            return folder
    return None


class _Count(event.Listener):
    def __init__(self, report: Callable[[int], None]) -> None:
        self._report = report
        self._count = 0

    def on_start(self, event: Any) -> None:
        self._report(self._count)

    def on_end(self, event: Any) -> None:
        self._count += 1
        self._report(self._count)


@contextmanager
def compilation_reported(report: Callable[[int], None]) -> Iterator[None]:
    """`report` gets the number of kernels compiled so far, whenever one is compiled because no cache holds it."""
    with event.install_listener("numba:compile", _Count(report)):
        yield

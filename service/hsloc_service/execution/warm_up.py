"""Fill the caches of numba and matplotlib: `python -m hsloc_service.execution.warm_up`.

Jobs in a sandbox get copies of these caches and cannot add to them, so the server fills them itself, with a log of a
simulated robot, once for each version.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import tempfile
from pathlib import Path

from hsloc.version import __version__
from hsloc_service.execution.processes import kill_group
from hsloc_service.execution.sandbox import caches_of
from hsloc_service.logs import log


class WarmUp:
    """Fills the caches in a process of low priority, in the background, unless this version has filled them."""

    def __init__(self, shared: Path) -> None:
        self._caches = caches_of(shared)
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Begin."""
        if stamp(self._caches["NUMBA_CACHE_DIR"]).exists():
            return
        command = ["nice", "-n", "15", sys.executable, "-P", "-m", "hsloc_service.execution.warm_up"]
        chosen = {**os.environ, **{name: str(path) for name, path in self._caches.items()}}
        chosen.pop("HSLOC_TOKEN", None)
        try:
            for folder in self._caches.values():
                folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            quiet = subprocess.DEVNULL
            self._process = subprocess.Popen(
                command,
                env=chosen,
                stdin=quiet,
                stdout=quiet,
                stderr=quiet,
                start_new_session=True,
            )
        except OSError as error:
            log("warm_up.error", error=str(error))  # jobs compile for themselves

    def stop(self) -> None:
        """End, done or not."""
        if self._process is not None:
            kill_group(self._process.pid)
            self._process.wait()


def stamp(kernels: Path) -> Path:
    """The file that says that a cache of kernels is full for this version of hsloc and of Python."""
    return kernels / f".hsloc-{__version__}-{platform.python_version()}"


def main() -> int:
    """Record a short log, localise it on its map, and map it; then leave a stamp in $NUMBA_CACHE_DIR, if it is set."""
    from hsloc.cli.main import main as program

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.mcap"
        recorded = program(["record", str(path), "--world", "office", "--duration", "15", "--quiet"])
        codes = [program(["replay", str(path), "--quiet", "--out", str(Path(folder) / "localise"), "--unknown-start"])]
        codes += [program(["replay", str(path), "--quiet", "--out", str(Path(folder) / "map"), "--mode", "slam"])]
    if max(recorded, *codes) == 0 and (kernels := os.environ.get("NUMBA_CACHE_DIR")):
        stamp(Path(kernels)).touch()
    return max(recorded, *codes)


if __name__ == "__main__":
    sys.exit(main())

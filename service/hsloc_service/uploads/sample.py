"""A log to try the service with: simulated when it is first asked for, and kept."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import uuid
from typing import TYPE_CHECKING

from hsloc.version import __version__
from hsloc_service.errors import ServiceError

if TYPE_CHECKING:
    from pathlib import Path

    from hsloc_service.storage import Storage

SECONDS = 60
"""Length of the log [s]."""
TIMEOUT_S = 120.0
_making = threading.Lock()


def sample_log(storage: Storage) -> Path:
    """The log, made by `hsloc record` in a process of its own. Raises ServiceError 503 where that fails."""
    path = storage.cache / f"sample-{__version__}.mcap"
    with _making:
        if not path.exists():
            storage.need_space(4 << 20)
            made = storage.work / f"sample-{uuid.uuid4().hex}.mcap"
            command = [sys.executable, "-m", "hsloc.cli.main", "record", str(made), "--world", "office", "-q"]
            try:
                subprocess.run([*command, "--duration", str(SECONDS)], check=True, timeout=TIMEOUT_S)
            except (OSError, subprocess.SubprocessError) as error:
                made.unlink(missing_ok=True)
                raise ServiceError(503, "sample", "the sample could not be made; upload a log of your own") from error
            os.replace(made, path)
    return path

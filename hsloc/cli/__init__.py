"""The command line: one module a command."""

from __future__ import annotations

import importlib
import time
from typing import Any

BEGIN = time.perf_counter()
"""When the program began, but for Python's own start [s]."""


def service_module(name: str) -> Any:
    """A module of `hsloc_service`, found by name: the library does not import the service."""
    from hsloc.errors import ConfigError

    try:
        return importlib.import_module(f"hsloc_service.{name}")
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"{error.name} is not installed; install the service with: pip install 'hsloc[serve]'"
        ) from error

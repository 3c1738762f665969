"""The command line: one module a command."""

from __future__ import annotations

import importlib
import time
from typing import Any

BEGIN = time.perf_counter()
"""When the program began, but for Python's own start [s]."""


def service_module(name: str) -> Any:
    """A module of `hsloc_service`, found by name: the library does not import the service."""
    from hsloc.errors import ConfigError, install_hint

    try:
        return importlib.import_module(f"hsloc_service.{name}")
    except ModuleNotFoundError as error:
        what = f"{error.name}, which the service needs, is not installed"
        raise ConfigError(f"{what}: {install_hint('serve')}") from error

"""What the figures were measured on: without it they mean nothing."""

from __future__ import annotations

import os
import platform
from importlib import metadata
from pathlib import Path

from hsloc.version import __version__

PACKAGES = ("numpy", "numba", "scipy", "mealpy", "small-gicp")


def machine() -> dict[str, object]:
    """Processor, cores, load and versions; a package that is missing is None."""
    return {
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "load_average": load(),
        "platform": platform.platform(),
        "python": platform.python_version(),
        "hsloc": __version__,
        **{name: _version(name) for name in PACKAGES},
    }


def load() -> tuple[float, ...] | None:
    """Load over 1, 5 and 15 minutes: above 0 before a benchmark somebody else is at work."""
    return tuple(round(value, 2) for value in os.getloadavg()) if hasattr(os, "getloadavg") else None


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None

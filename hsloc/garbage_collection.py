"""How often Python looks for unreachable cycles of objects."""

from __future__ import annotations

import gc
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

_COLLECT_AFTER = 500_000
"""New objects after which the garbage collector looks at the youngest; Python's own limit is 700. A run leaves 20,000
to 100,000 in cycles, a few megabytes: those of matplotlib, and of numba's imports."""


@contextmanager
def rarely_collected() -> Iterator[None]:
    """Let the garbage collector run rarely: events and poses are many, live long, and none is part of a cycle."""
    before = gc.get_threshold()
    if before[0] > 0:  # 0 is never, as somebody wants it.
        gc.set_threshold(max(before[0], _COLLECT_AFTER), *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)

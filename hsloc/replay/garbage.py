"""The garbage collector while a log streams by."""

from __future__ import annotations

import gc
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

_COLLECT_AFTER = 50_000
"""Objects more than before, until the collector looks at the youngest; Python's own limit is 700."""


@contextmanager
def seldom_collected() -> Iterator[None]:
    """Have the collector look seldom: events are many, and none of them is part of a cycle."""
    before = gc.get_threshold()
    if before[0] > 0:  # 0 is never, by somebody's own will.
        gc.set_threshold(max(before[0], _COLLECT_AFTER), *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)

"""Waiting for what must come, on any machine: that it comes late is no defect, that it never comes is one."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

T = TypeVar("T")
LIMIT_S = 300
"""Far more than anything here takes, also on a machine that is slow and busy. Who passes never waits for it."""


def until(get: Callable[[], T], what: str, is_it: Callable[[T], bool] = bool) -> T:
    """The first value of `get` that is true, or that `is_it` accepts. Fails with `what` if none comes.

    The longer it takes, the less often it is asked for: asking takes of a processor that others need.
    """
    begin = time.monotonic()
    while not is_it(found := get()):
        waited = time.monotonic() - begin
        assert waited < LIMIT_S, f"{what}: not within {LIMIT_S:g} s; at last there was {found!r}"
        time.sleep(min(0.02 + 0.1 * waited, 0.5))
    return found

"""Calls that may never return: a store that is slow or dead must hold up neither the event loop nor a worker.

Each call has a thread of its own. anyio's threads will not do: calls that hang would use up the shared ones,
and would keep the process from ending.
"""

from __future__ import annotations

import asyncio
import threading
from concurrent.futures import Future
from contextlib import suppress
from typing import TYPE_CHECKING, TypeVar

from hsloc_service.errors import StoreError

if TYPE_CHECKING:
    from collections.abc import Callable

T = TypeVar("T")
MIN_BYTES_PER_S = 1 << 18
"""A store that is slower than this counts as dead [B/s]."""


def start_call(work: Callable[[], T]) -> Future[T]:
    """Start `work` in a daemon thread."""
    future: Future[T] = Future()
    future.set_running_or_notify_cancel()  # it cannot be cancelled: it is done when the thread is

    def run() -> None:
        try:
            result = work()
        except BaseException as error:
            future.set_exception(error)
        else:
            future.set_result(result)

    threading.Thread(target=run, name="store", daemon=True).start()
    return future


def call_within(timeout_s: float, work: Callable[[], T]) -> T:
    """The result of `work`, for a thread that may block. Raises StoreError if it takes longer."""
    try:
        return start_call(work).result(timeout_s)
    except TimeoutError as error:
        raise StoreError(f"no answer within {timeout_s:g} s") from error


class BoundedExecutor:
    """Runs the calls of the routes: at most `max_calls` at a time, each with a time limit that includes its wait."""

    def __init__(self, timeout_s: float, max_calls: int = 64) -> None:
        self._timeout_s, self._free = timeout_s, asyncio.Semaphore(max_calls)

    async def run(self, work: Callable[[], T]) -> T:
        """The result of `work`. Raises StoreError if it takes too long, or if too many calls are running."""
        try:
            async with asyncio.timeout(self._timeout_s):
                await self._free.acquire()
                loop, future = asyncio.get_running_loop(), start_call(work)
                # Its place is free when the thread has ended, not when the caller stops waiting.
                future.add_done_callback(lambda _: self._release(loop))
                return await asyncio.wrap_future(future)
        except TimeoutError as error:
            raise StoreError(f"no answer within {self._timeout_s:g} s") from error

    def _release(self, loop: asyncio.AbstractEventLoop) -> None:
        with suppress(RuntimeError):  # the loop has ended meanwhile
            loop.call_soon_threadsafe(self._free.release)

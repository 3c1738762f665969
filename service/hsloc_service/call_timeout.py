"""Calls that may never come back: a store that is slow or dead must hold up neither the event loop nor a worker.

Each call has a thread of its own. anyio's threads will not do: calls that hang would use up what all routes share, and
keep the process from ending.
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


def begin(work: Callable[[], T]) -> Future[T]:
    """Start `work` in a thread that dies with the process."""
    future: Future[T] = Future()
    future.set_running_or_notify_cancel()  # from here on nobody can cancel it: it is done when the thread is

    def run() -> None:
        try:
            result = work()
        except BaseException as error:
            future.set_exception(error)
        else:
            future.set_result(result)

    threading.Thread(target=run, name="store", daemon=True).start()
    return future


def wait(work: Callable[[], T], timeout_s: float) -> T:
    """The result of `work`, in a thread that may block. Raises StoreError if it takes longer."""
    try:
        return begin(work).result(timeout_s)
    except TimeoutError as error:
        raise StoreError(f"no answer within {timeout_s:g} s") from error


class BoundedExecutor:
    """Takes the calls of the routes: so many at a time, each for so long, the wait for its turn included."""

    def __init__(self, timeout_s: float, most: int = 64) -> None:
        self._timeout_s, self._turns = timeout_s, asyncio.Semaphore(most)

    async def ask(self, work: Callable[[], T]) -> T:
        """The result of `work`. Raises StoreError if it takes too long, or if too many others do."""
        try:
            async with asyncio.timeout(self._timeout_s):
                await self._turns.acquire()
                loop, future = asyncio.get_running_loop(), begin(work)
                # Its place is free when the thread has ended, not when nobody waits for it any more.
                future.add_done_callback(lambda _: self._free(loop))
                return await asyncio.wrap_future(future)
        except TimeoutError as error:
            raise StoreError(f"no answer within {self._timeout_s:g} s") from error

    def _free(self, loop: asyncio.AbstractEventLoop) -> None:
        with suppress(RuntimeError):  # the loop has ended meanwhile, and nobody counts any more
            loop.call_soon_threadsafe(self._turns.release)

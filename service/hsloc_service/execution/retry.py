"""Calls of a worker to a store of results: repeated until the store answers, while the job is held."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, TypeVar

from hsloc_service.call_timeout import start_call
from hsloc_service.errors import StoreError
from hsloc_service.logs import log

if TYPE_CHECKING:
    from collections.abc import Callable


T = TypeVar("T")
TICK_S = 0.05
FIRST_WAIT_S = 1.0
MAX_WAIT_S = 30.0


class Interrupted(Exception):
    """The attempt has to stop; `reason` is the heartbeat's."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


class Retry:
    """Repeats calls that fail. `cancel_reason` is asked many times a second; it also renews the job's lease."""

    def __init__(self, cancel_reason: Callable[[], str | None], job_id: str, failed: Callable[[], None]) -> None:
        self._cancel_reason, self._job_id, self._failed = cancel_reason, job_id, failed

    def retry(self, what: str, work: Callable[[], T], timeout_s: float) -> T:
        """The result of `work`, repeated after each StoreError and each `timeout_s`, without an end.

        A result that took hours to compute is not thrown away because a store is away for an hour. Raises Interrupted
        where `cancel_reason` gives one, and whatever else `work` raises.
        """
        wait_s = FIRST_WAIT_S
        while True:
            try:
                return self._run_once(work, timeout_s)
            except StoreError as error:
                self._failed()
                log("store.error", job=self._job_id, what=what, error=str(error), again_in_s=wait_s)
            until = time.monotonic() + wait_s
            while time.monotonic() < until:
                self._check()
                time.sleep(TICK_S)
            wait_s = min(2.0 * wait_s, MAX_WAIT_S)

    def _run_once(self, work: Callable[[], T], timeout_s: float) -> T:
        future, until = start_call(work), time.monotonic() + timeout_s
        while True:
            try:
                return future.result(TICK_S)
            except TimeoutError:
                if future.done():
                    raise
            self._check()
            if time.monotonic() > until:
                raise StoreError(f"no answer within {timeout_s:g} s")

    def _check(self) -> None:
        reason = self._cancel_reason()
        if reason is not None:
            raise Interrupted(reason)

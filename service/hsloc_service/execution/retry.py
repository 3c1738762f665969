"""A worker's calls to the store: tried until the store answers, while the job stays ours."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, TypeVar

from hsloc_service.call_timeout import begin
from hsloc_service.errors import StoreError
from hsloc_service.logs import log

if TYPE_CHECKING:
    from collections.abc import Callable

T = TypeVar("T")
TICK_S = 0.05
FIRST_WAIT_S = 1.0
LONGEST_WAIT_S = 30.0
BYTES_PER_S = 1 << 18
"""A store that is slower than this is taken for dead."""


class Interrupted(Exception):
    """The job is not to go on; `why` is what `look` said."""

    def __init__(self, why: str) -> None:
        super().__init__(why)
        self.why = why


class Retry:
    """`look` is asked many times a second: it prolongs the job's lease, and says `go`, or why the job must end."""

    def __init__(self, look: Callable[[], str], job_id: str, failed: Callable[[], None]) -> None:
        self._look, self._job_id, self._failed = look, job_id, failed

    def retry(self, what: str, work: Callable[[], T], timeout_s: float) -> T:
        """The result of `work`, which is begun anew after StoreError or `timeout_s`, for as long as it takes.

        What is computed is not thrown away because a store is gone for an hour. Raises Interrupted where `look` says
        so, and whatever else `work` raises.
        """
        wait = FIRST_WAIT_S
        while True:
            try:
                return self._once(work, timeout_s)
            except StoreError as error:
                self._failed()
                log("store.error", job=self._job_id, what=what, error=str(error), again_in_s=wait)
            until = time.monotonic() + wait
            while time.monotonic() < until:
                self._run_once()
                time.sleep(TICK_S)
            wait = min(2.0 * wait, LONGEST_WAIT_S)

    def _once(self, work: Callable[[], T], timeout_s: float) -> T:
        future, until = begin(work), time.monotonic() + timeout_s
        while True:
            try:
                return future.result(TICK_S)
            except TimeoutError:
                if future.done():
                    raise
            self._run_once()
            if time.monotonic() > until:
                raise StoreError(f"no answer within {timeout_s:g} s")

    def _run_once(self) -> None:
        why = self._look()
        if why != "go":
            raise Interrupted(why)

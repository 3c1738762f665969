"""A sweep in other processes: of its own, which survive runs that end theirs and Ctrl-C, or of a cluster."""

from __future__ import annotations

import multiprocessing
import os
import signal
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from hsloc.errors import HslocError
from hsloc.interrupts import interrupts_held_back
from hsloc.sweep.runs import BROKEN, FAILED, STOP, Outcome, SweepRun, sweep

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from hsloc.sweep.remote import UrlFolder

_THREADS = "NUMBA_NUM_THREADS"
DASK_TIMEOUT_S = 10.0
"""Time within which a scheduler must answer [s]."""


def sweep_in_processes(
    runs: Sequence[SweepRun], folder: Path | UrlFolder, jobs: int, progress: Callable[[Outcome], None] | None = None
) -> list[Outcome]:
    """As `sweep`, in `jobs` processes.

    If one dies, the executor loses all that were under way: these are run again, each in a process of its own, so
    that only the guilty one fails. On KeyboardInterrupt the processes are told, and end without leaving halves.
    """

    def tell(outcome: Outcome) -> None:
        if progress is not None and not _is_broken(outcome):
            progress(outcome)

    with _threads(jobs), _interruptible(_Pool(jobs, **_options())) as pool:
        outcomes = sweep(runs, folder, pool, tell)
    again = [index for index, outcome in enumerate(outcomes) if _is_broken(outcome)]
    if again:
        with _threads(jobs), _interruptible(_OneEach(jobs)) as each:
            repeated = sweep([runs[index] for index in again], folder, each, progress)
        for index, outcome in zip(again, repeated, strict=True):
            outcomes[index] = outcome
    return outcomes


def sweep_on_dask(
    runs: Sequence[SweepRun], folder: Path | UrlFolder, address: str, progress: Callable[[Outcome], None] | None = None
) -> list[Outcome]:
    """As `sweep`, on the workers of the Dask scheduler at `address` (`tcp://HOST:PORT`), which see the same folders.

    A run whose worker dies is begun again on another one, as often as the scheduler's `allowed-failures` says. Raises
    HslocError without the package `distributed`, and where no scheduler answers.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise HslocError(
            "--executor dask://...: the package distributed is missing; pip install distributed"
        ) from error
    try:
        client = Client(address, timeout=DASK_TIMEOUT_S, set_as_default=False)
    except OSError as error:
        raise HslocError(f"{address}: no Dask scheduler answers there; start one with: dask scheduler") from error
    with client, client.get_executor(pure=False) as executor:
        return sweep(runs, folder, _InFolder(executor, os.getcwd()), progress)


class _InFolder(Executor):
    """Every call in the working directory of the caller, to which the paths of a run are relative."""

    def __init__(self, executor: Executor, folder: str) -> None:
        self._executor, self._folder = executor, folder

    def submit(self, call: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        return self._executor.submit(_call_in, self._folder, call, *arguments, **named)


def _call_in(folder: str, call: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
    os.chdir(folder)
    return call(*arguments, **named)


def _is_broken(outcome: Outcome) -> bool:
    return outcome.state == FAILED and outcome.error.startswith(BROKEN)


def _options() -> dict[str, Any]:
    # A fork would copy the compiler's threads in any state.
    return {"mp_context": multiprocessing.get_context("spawn"), "initializer": _note_interrupts}


def _note_interrupts() -> None:
    """Ctrl-C ends a worker's run at its next scan: an exception out of the blue would leave halves behind."""
    signal.signal(signal.SIGINT, lambda *_: STOP.set())
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def _start_tracker() -> None:
    """Start multiprocessing's tracker, if it does not run: its start ends with SIGINT unblocked in this thread."""
    if hasattr(signal, "pthread_sigmask"):
        from multiprocessing import resource_tracker

        with interrupts_held_back():
            resource_tracker.ensure_running()


class _Pool(ProcessPoolExecutor):
    """Its processes hold back Ctrl-C until `_note_interrupts`: while they import, it would end in a traceback."""

    def submit(self, call: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        _start_tracker()
        with interrupts_held_back():
            return super().submit(call, *arguments, **named)


class _OneEach(Executor):
    """Every call in a process of its own, `jobs` at a time."""

    def __init__(self, jobs: int) -> None:
        self._threads = ThreadPoolExecutor(jobs)

    def submit(self, call: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        return self._threads.submit(self._alone, call, *arguments, **named)

    @staticmethod
    def _alone(call: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        with _Pool(1, **_options()) as pool:
            return pool.submit(call, *arguments, **named).result()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        self._threads.shutdown(wait, cancel_futures=cancel_futures)


@contextmanager
def _interruptible(pool: Executor) -> Iterator[Executor]:
    """The pool, shut down at the end; on KeyboardInterrupt its workers are interrupted first."""
    before = set(multiprocessing.active_children())
    try:
        yield pool
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in set(multiprocessing.active_children()) - before:
            if process.pid is not None and process.is_alive():
                os.kill(process.pid, signal.SIGINT)
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def _threads(jobs: int) -> Iterator[None]:
    """The processes share the processors among them: each gets its part of the threads."""
    before = os.environ.get(_THREADS)
    share = max((os.cpu_count() or 1) // jobs, 1)
    if before is None:
        os.environ[_THREADS] = str(share)
    try:
        yield
    finally:
        if before is None:
            os.environ.pop(_THREADS, None)

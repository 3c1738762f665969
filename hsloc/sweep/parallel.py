"""A sweep on several cores or machines: in processes, or in parts.

Processes are its own, which survive runs that end theirs and Ctrl-C, or a cluster's. Of N parts each does every N-th
run, in a process or on a machine of its own; their tables are merged into one.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import re
import signal
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from hsloc.atomic_write import write_text_atomically
from hsloc.errors import HslocError, not_read
from hsloc.interrupts import interrupts_held_back
from hsloc.sweep.remote import UrlFolder
from hsloc.sweep.runs import BROKEN, DONE, FAILED, SKIPPED, STOP, Outcome, SweepRun, request_values, sweep
from hsloc.sweep.table import COLUMNS, rows

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

_THREADS = "NUMBA_NUM_THREADS"
DASK_TIMEOUT_S = 10.0
"""Time within which a scheduler must answer [s]."""

_FILES = "sweep-shard-*-of-*.json"


def sweep_in_processes(
    runs: Sequence[SweepRun], folder: Path | UrlFolder, jobs: int, progress: Callable[[Outcome], None] | None = None
) -> list[Outcome]:
    """As `sweep`, in `jobs` processes.

    If one dies, the executor loses all that were under way: these are run again, each in a process of its own, so
    that only the guilty one fails. On KeyboardInterrupt the processes are interrupted, and leave no incomplete folder.
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
    """Ctrl-C ends a worker's run at its next scan: an exception at any point would leave halves behind."""
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

    _manager: threading.Thread | None = None

    def submit(self, call: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        _start_tracker()
        with interrupts_held_back():
            return super().submit(call, *arguments, **named)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Wait also for what an earlier call did not wait for: the executor forgets its thread, and a program that
        ends while that thread closes its pipe ends in a traceback."""
        self._manager = getattr(self, "_executor_manager_thread", None) or self._manager
        super().shutdown(wait, cancel_futures=cancel_futures)
        if wait and self._manager is not None:
            self._manager.join()


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


@dataclass(frozen=True, slots=True)
class Shard:
    """Part `index` (from 0) of `count`. Raises ValueError for an index that is not in the range."""

    index: int
    count: int

    def __post_init__(self) -> None:
        if not 0 <= self.index < self.count:
            raise ValueError(
                f"shard {self.index} of {self.count} does not exist; the first is 0, the last {self.count - 1}"
            )

    def part(self, runs: Sequence[SweepRun]) -> list[SweepRun]:
        """The runs of this part: every `count`-th, so that a long log is spread over all parts."""
        return list(runs[self.index :: self.count])


def parse_shard(text: str, environment: Mapping[str, str] = os.environ) -> Shard:
    """`I/N`; or `auto`, `auto/N`: the index, and where it is known the count, of an array job.

    Known are Kubernetes' Indexed Jobs, which do not name the count, Slurm's job arrays, and AWS Batch's. Raises
    ValueError with a reason.
    """
    index, slash, count = text.partition("/")
    if index != "auto":
        if not index.isdecimal() or not count.isdecimal():
            raise ValueError(f"{text!r} is not I/N, such as 0/4, and not auto or auto/N")
        return Shard(int(index), int(count))
    found = _from_environment(environment)
    if slash:
        if not count.isdecimal():
            raise ValueError(f"{text!r} is not auto/N, such as auto/4")
        return Shard(found[0], int(count))
    if found[1] is None:
        raise ValueError("the environment names the index of the job, but not how many there are; give auto/N")
    return Shard(found[0], found[1])


def _from_environment(environment: Mapping[str, str]) -> tuple[int, int | None]:
    """Index from 0, and the count if it is named. Raises ValueError unless exactly one array job is found."""
    found: dict[str, tuple[int, int | None]] = {}

    def number(name: str, default: int | None = None) -> int:
        text = environment.get(name, "" if default is None else str(default))
        if not text.isdecimal():
            raise ValueError(f"{name} is {text!r}, which is not a number")
        return int(text)

    if "JOB_COMPLETION_INDEX" in environment:
        found["JOB_COMPLETION_INDEX"] = number("JOB_COMPLETION_INDEX"), None
    if "AWS_BATCH_JOB_ARRAY_INDEX" in environment:
        size = number("AWS_BATCH_JOB_ARRAY_SIZE") if "AWS_BATCH_JOB_ARRAY_SIZE" in environment else None
        found["AWS_BATCH_JOB_ARRAY_INDEX"] = number("AWS_BATCH_JOB_ARRAY_INDEX"), size
    if "SLURM_ARRAY_TASK_ID" in environment:
        # The array may begin anywhere, and have steps: --array=1-7:2.
        first, step = number("SLURM_ARRAY_TASK_MIN", 0), max(number("SLURM_ARRAY_TASK_STEP", 1), 1)
        size = number("SLURM_ARRAY_TASK_COUNT") if "SLURM_ARRAY_TASK_COUNT" in environment else None
        found["SLURM_ARRAY_TASK_ID"] = (number("SLURM_ARRAY_TASK_ID") - first) // step, size
    if len(found) != 1:
        names = "JOB_COMPLETION_INDEX, SLURM_ARRAY_TASK_ID, AWS_BATCH_JOB_ARRAY_INDEX"
        what = f"several of them are set: {', '.join(found)}" if found else "none of them is set"
        raise ValueError(f"auto takes the index from {names}, but {what}; give I/N")
    return next(iter(found.values()))


def plan_hash(runs: Sequence[SweepRun]) -> str:
    """Hash of what a sweep is: names and options of all its runs, without the bytes and the places of their logs."""
    values = [[item.name, {**request_values(item.request), "bare_names": False}] for item in runs]
    return hashlib.sha256(json.dumps(values, sort_keys=True, default=str).encode()).hexdigest()


def write_shard(
    folder: Path | UrlFolder, shard: Shard, runs: Sequence[SweepRun], outcomes: Sequence[Outcome]
) -> Path | UrlFolder:
    """Write the table of one part of a sweep of `runs`, whole or not at all; its path. Raises OutputError."""
    path = folder / f"sweep-shard-{shard.index}-of-{shard.count}.json"
    content = {
        "sweep": plan_hash(runs),
        "shard": shard.index,
        "of": shard.count,
        "runs": len(runs),
        "rows": rows(outcomes),
    }
    text = json.dumps(content, indent=2) + "\n"
    if isinstance(path, UrlFolder):
        path.write_text(text)
    else:
        write_text_atomically(path, text)
    return path


def merge(folders: Sequence[Path | UrlFolder]) -> list[dict[str, Any]]:
    """The rows of a whole sweep, in the order of its plan, from the tables of its parts in any of the folders.

    Where a part was done twice, a row that did not fail counts, then that of the folder named first. A run that was
    skipped because it was done before is done. Raises HslocError where parts are missing, or are not of one sweep.
    """
    parts = [(path, _read(path)) for folder in folders for path in _tables(folder)]
    names = ", ".join(map(str, folders))
    if not parts:
        raise HslocError(f"{names}: no tables of shards ({_FILES}); run hsloc sweep --shard I/N --out there first")
    first_path, first = parts[0]
    for path, part in parts:
        if any(part[name] != first[name] for name in ("sweep", "of", "runs")):
            raise HslocError(f"{path}: is of another sweep than {first_path}; remove the table that is not meant")
    missing = sorted(set(range(first["of"])) - {part["shard"] for _, part in parts})
    if missing:
        raise HslocError(f"{names}: shards {', '.join(map(str, missing))} of {first['of']} are missing; run them first")
    merged: dict[int, dict[str, Any]] = {}
    for _, part in parts:
        for k, row in enumerate(part["rows"]):
            index = part["shard"] + k * part["of"]
            if index not in merged or (merged[index]["state"] == FAILED and row["state"] != FAILED):
                merged[index] = row | {"state": DONE if row["state"] == SKIPPED else row["state"]}
    return [merged[index] for index in sorted(merged)]


def _tables(folder: Path | UrlFolder) -> list[Path | UrlFolder]:
    found = [(re.findall(r"\d+", path.name), path) for path in folder.glob(_FILES)]
    return [path for _, path in sorted(found, key=lambda each: ([int(text) for text in each[0]], str(each[1])))]


def _read(path: Path | UrlFolder) -> dict[str, Any]:
    """The table of a part. Raises HslocError for anything else."""
    try:
        part = json.loads(path.read_text(encoding="utf-8"))
        shard, total = Shard(part["shard"], part["of"]), int(part["runs"])
        good = len(part["rows"]) == len(range(shard.index, total, shard.count)) and isinstance(part["sweep"], str)
        good = good and all(set(row) == set(COLUMNS) for row in part["rows"])
    except OSError as error:
        raise HslocError(not_read(path, error)) from error
    except (ValueError, KeyError, TypeError):
        good = False
    if not good:
        raise HslocError(f"{path}: is not the table of a shard of this version of hsloc; run that shard again")
    found: dict[str, Any] = part
    return found

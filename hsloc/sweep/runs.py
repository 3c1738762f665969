"""Many runs: logs x configurations x seeds, side by side, each with its own folder of results.

A finished run is known by the hash of everything that decides it, and is not done again. A run that fails, or takes
its process with it, is a row of the table like the others.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
import threading
import traceback
from concurrent.futures import as_completed
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hsloc.analysis.quality import exceeded_limits
from hsloc.config import to_dict
from hsloc.errors import HslocError, no_such, not_read
from hsloc.export.results_folder import write_results
from hsloc.log import open_log
from hsloc.options import OPTIONS
from hsloc.replay.map_and_start import map_files, state_file
from hsloc.replay.run import run
from hsloc.request import RunRequest
from hsloc.run_metrics import RunMetrics, RunTimings
from hsloc.sweep import log_labels
from hsloc.sweep.remote import RemoteLog, UrlFolder
from hsloc.version import __version__

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence
    from concurrent.futures import Executor, Future

    from hsloc.config import Config
    from hsloc.replay.run import Result

KEY_FILE = "sweep_key.json"
"""In a run's folder: what it was made of."""
STOP = threading.Event()
"""Set in a process, it has the runs there end at the next scan, in good order, with KeyboardInterrupt."""
DONE, SKIPPED, FAILED = "done", "skipped", "failed"


@dataclass(frozen=True, slots=True)
class SweepRun:
    """One run: the name of its folder, the labels of its row, and what to run.

    The logs of the request are names only where `remote` has the log.
    """

    name: str
    log: str
    config: str
    request: RunRequest
    remote: RemoteLog | None = None


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a run: `done`, `skipped` (it was done before) or `failed` with the reason in `error`.

    `metrics` and `timings` are None where the run failed.
    """

    run: SweepRun
    state: str
    folder: Path | UrlFolder
    metrics: RunMetrics | None = None
    timings: RunTimings | None = None
    error: str = ""

    @property
    def limits(self) -> tuple[str, ...]:
        """The limits of the request that the result does not keep."""
        return () if self.metrics is None else exceeded_limits(self.run.request, self.metrics)

    @property
    def data_lost(self) -> bool:
        """Whether part of the input could not be read."""
        return self.metrics is not None and self.metrics.losses.data_lost


def plan(
    logs: Sequence[Path | RemoteLog | Sequence[Path]],
    configs: Mapping[str, Config | tuple[str, Config]],
    seeds: Iterable[int] = (0,),
    **common: Any,
) -> list[SweepRun]:
    """All combinations; a sequence of paths is one log in parts. `common` are further options, or `read`.

    A configuration may come with the name of its preset.
    """
    runs: list[SweepRun] = []
    seeds = list(seeds)
    places = [_parts(log) for log in logs]
    for log, parts, label in zip(logs, places, log_labels([each[0].name for each in places]), strict=True):
        remote = log if isinstance(log, RemoteLog) else None
        for name, item in configs.items():
            preset, config = item if isinstance(item, tuple) else ("default", item)
            for seed in seeds:
                values = {**common, "preset": preset, "config": config, "seed": seed}
                if remote is not None:
                    values["bare_names"] = True  # The folder of its copy must not be a part of the results.
                request = RunRequest.from_values(parts, values)
                runs.append(SweepRun(f"{label}-{name}-seed{seed}".replace("/", "_"), label, name, request, remote))
    return runs


def _parts(log: Path | RemoteLog | Sequence[Path]) -> tuple[Path, ...]:
    """The paths of a log; of one at a URL its name."""
    if isinstance(log, RemoteLog):
        return (Path(log.name),)
    return (log,) if isinstance(log, Path) else tuple(log)


def sweep(
    runs: Sequence[SweepRun],
    folder: Path | UrlFolder,
    executor: Executor,
    progress: Callable[[Outcome], None] | None = None,
) -> list[Outcome]:
    """Do all runs that are not done yet, in an executor of any kind; outcomes in the order of `runs`.

    `progress` is called with each outcome as it comes. Nothing that happens in a run is raised; where the executor
    itself breaks, the runs it did not finish have failed. On KeyboardInterrupt the waiting runs are cancelled, and
    what is finished stays.
    """
    outcomes: dict[int, Outcome] = {}
    hashes: dict[Path, str] = {}
    waiting: dict[Future[Outcome], int] = {}

    def settle(index: int, outcome: Outcome) -> None:
        outcomes[index] = outcome
        if progress is not None:
            progress(outcome)

    try:
        for index, item in enumerate(runs):
            try:
                key = run_key(item.request, hashes, item.remote)
                known = finished(item, folder, key)
            except HslocError as error:
                settle(index, Outcome(item, FAILED, folder / item.name, error=str(error)))
                continue
            if known is not None:
                settle(index, known)
                continue
            try:
                waiting[executor.submit(do_run, item, folder, key)] = index
            except RuntimeError as error:  # The executor broke, or was shut down.
                settle(index, _broken(item, folder, error))
        for future in as_completed(waiting):
            item = runs[waiting[future]]
            try:
                settle(waiting[future], future.result())
            except Exception as error:  # `do_run` raises none: it is the executor's, and each has its own.
                settle(waiting[future], _broken(item, folder, error))
    except BaseException:
        for future in waiting:
            future.cancel()
        raise
    return [outcomes[index] for index in range(len(runs))]


BROKEN = "the process ended: "


def _broken(item: SweepRun, folder: Path | UrlFolder, error: Exception) -> Outcome:
    reason = (str(error).splitlines() or [type(error).__name__])[0]
    return Outcome(item, FAILED, folder / item.name, error=f"{BROKEN}{reason}")


def do_run(item: SweepRun, folder: Path | UrlFolder, key: str) -> Outcome:
    """One run, in whatever process the executor chose; raises nothing but BaseException."""
    target = folder / item.name
    try:
        request = item.request
        if item.remote is not None:
            request = replace(request, logs=(item.remote.fetch(),))
        result = run(request, _heed_stop)
        if isinstance(target, Path):
            metrics, timings = _write(result, target, key)
        else:
            with tempfile.TemporaryDirectory(prefix="hsloc-run-") as local:
                metrics, timings = _write(result, Path(local) / item.name, key)
                target.replace(Path(local) / item.name, KEY_FILE)
        return Outcome(item, DONE, target, metrics, timings)
    except HslocError as error:
        return Outcome(item, FAILED, target, error=str(error))
    except Exception as error:  # A defect of ours must not end the sweep; its trace is kept for the report of it.
        reason = (str(error).splitlines() or [""])[0]
        trace = folder / f"{item.name}.error.txt"
        with suppress(OSError, HslocError):
            trace.write_text(traceback.format_exc(), encoding="utf-8")
        return Outcome(item, FAILED, target, error=f"{type(error).__name__}: {reason} (see {trace})")


def _write(result: Result, target: Path, key: str) -> tuple[RunMetrics, RunTimings]:
    # Only what looks like a run of ours is replaced.
    written = write_results(result, target, overwrite=(target / "metrics.json").exists(), progress=_heed_stop)
    (target / KEY_FILE).write_text(json.dumps({"key": key}) + "\n", encoding="utf-8")
    return written.metrics, written.timings


def _heed_stop(_: object) -> None:
    if STOP.is_set():
        raise KeyboardInterrupt


def finished(item: SweepRun, folder: Path | UrlFolder, key: str) -> Outcome | None:
    """The outcome of a run that was done before with the same key."""
    target = folder / item.name
    try:
        if json.loads((target / KEY_FILE).read_text(encoding="utf-8"))["key"] != key:
            return None
        metrics = RunMetrics.from_json(json.loads((target / "metrics.json").read_text(encoding="utf-8")))
        timings = RunTimings.from_json(json.loads((target / "timings.json").read_text(encoding="utf-8")))
    except (OSError, ValueError, KeyError, TypeError, HslocError):
        return None
    return Outcome(item, SKIPPED, target, metrics, timings)


def run_key(request: RunRequest, hashes: dict[Path, str] | None = None, remote: RemoteLog | None = None) -> str:
    """Hash of all that decides a run: version, options, and the bytes of its files; of a log at a URL what its store
    says of them.

    `hashes` remembers those of files between calls. Raises HslocError where a file cannot be read.
    """
    hashes = {} if hashes is None else hashes
    values: dict[str, Any] = {"hsloc": __version__, **request_values(request)}
    for name in ("map_path", "align_to"):
        given: Path | None = getattr(request, name)
        if given is not None:
            values[name] = [given.name, *(_digest(part, hashes) for part in map_files(given))]
    if request.resume is not None:
        values["resume"] = [request.resume.name, _digest(state_file(request.resume), hashes)]
    for name in ("relations", "reference", "calibration"):
        path: str | Path | None = getattr(request, name)
        if path is not None and Path(path).is_file():
            values[name] = [Path(path).name, _digest(Path(path), hashes)]
    if remote is not None:
        values["input"] = [[file.path, file.size, file.version] for file in remote.files]
    else:
        values["input"] = [_log_digest(path, hashes) for path in request.logs]
    return hashlib.sha256(json.dumps(values, sort_keys=True, default=str).encode()).hexdigest()


def request_values(request: RunRequest) -> dict[str, Any]:
    """What a request says, as plain data; of files their names alone, wherever they are."""
    values: dict[str, Any] = {}
    limits = {option.target for option in OPTIONS if option.place == "check"}
    for item in fields(request):
        if item.name not in limits:  # They decide no file.
            value = getattr(request, item.name)
            if item.name == "logs":
                values[item.name] = [path.name for path in value]
            else:
                values[item.name] = value.name if isinstance(value, Path) else to_dict(value)
    return values


def _digest(path: Path, hashes: dict[Path, str]) -> str:
    if path not in hashes:
        try:
            with path.open("rb") as stream:
                hashes[path] = hashlib.file_digest(stream, "sha256").hexdigest()
        except FileNotFoundError as error:
            raise HslocError(no_such(path)) from error
        except OSError as error:
            raise HslocError(not_read(path, error)) from error
    return hashes[path]


def _log_digest(path: Path, hashes: dict[Path, str]) -> str:
    """Of a file's bytes; of a folder by the log that it is."""
    if not path.is_dir():
        return _digest(path, hashes)
    if path not in hashes:
        from hsloc.log import ReadOptions

        hashes[path] = open_log(path, ReadOptions(require_scan=False, require_odometry=False)).sha256()
    return hashes[path]

"""One attempt at one job: a process of its own, watched until it is dead, its results published whole or not at all."""

from __future__ import annotations

import json
import os
import random
import selectors
import shutil
import signal
import subprocess
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from service.logs import log
from service.processes import MARK, end_job
from service.storage import folder_bytes, safe_name

if TYPE_CHECKING:
    import threading

    from service.leases import Claim, Leases
    from service.settings import Settings
    from service.storage import Storage

_LINE_BYTES = 1 << 18
"""The longest line of the pipe; more is a job gone mad."""
_KEPT = ("PATH", "LANG", "LC_ALL", "TZ", "MPLCONFIGDIR", "PYTHONPATH", "VIRTUAL_ENV")
_KEPT_PREFIXES = ("OPENBLAS_", "OMP_", "MKL_", "NPY_", "NUMBA_")
"""What a job's process sees of the server's environment: no token, no password; but all that decides the last bits of
its arithmetic, which are to be those of `hsloc replay` in the same environment."""
TICK_S = 0.1
LOOK_S = 0.5
"""Time between two looks at the size of the folder, and between two notes of progress."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """How an attempt ended: `done`, `failed`, `crashed`, `again` (to be tried again) or `lost` (fenced off)."""

    kind: str
    reason: str = ""
    message: str = ""
    summary: dict[str, Any] | None = None


class Attempt:
    """Runs a claimed job to its end. Made and used in the thread of one slot."""

    def __init__(
        self,
        claim: Claim,
        leases: Leases,
        storage: Storage,
        settings: Settings,
        *,
        stop: threading.Event,
        cancel: threading.Event,
    ) -> None:
        self._claim, self._leases, self._storage, self._settings = claim, leases, storage, settings
        self._stop, self._cancel = stop, cancel
        self._folder = storage.work_path(claim.job_id, claim.attempt)
        self._mark = f"{storage.instance}:{claim.job_id}.{claim.attempt}"
        self._buffer = b""
        self._final: dict[str, Any] | None = None
        self._progress: dict[str, Any] | None = None
        self._told: dict[str, Any] | None = None
        self._beaten = 0.0

    def run(self) -> str:
        """The final state that was written, or `queued` or `lost`."""
        try:
            outcome = self._attempt()
            return self._settle(outcome)
        finally:
            self._storage.remove_work(self._folder)

    def _attempt(self) -> Outcome:
        """Prepare the folder, start the process, watch it."""
        try:
            self._prepare()
            log("job.start", job=self._claim.job_id, tenant=self._claim.tenant, attempt=self._claim.attempt)
            if random.random() < self._settings.fault_fail_jobs:
                return Outcome("failed", "fault_injection", "this server fails jobs on purpose (fault_fail_jobs)")
            process, pipe = self._start()
        except OSError as error:
            return Outcome("again", "start", f"the job could not be started: {error.strerror or error}")
        try:
            outcome = self._watch(process, pipe)
        finally:
            # Whatever happened: the slot is free only when every process of the job is dead.
            end_job(process, self._mark, 0.0)
            os.close(pipe)
        return outcome

    def _prepare(self) -> None:
        """`job.json`, the input under its own name (read-only), and an empty folder for temporary files."""
        claim, settings = self._claim, self._settings
        shutil.rmtree(self._folder, ignore_errors=True)
        for name in ("input", "map", "tmp"):
            (self._folder / name).mkdir(parents=True, mode=0o700)
        request = claim.request
        job: dict[str, Any] = {
            "request": request,
            "log": self._link("input", request["log"], "log"),
            "limits": {
                "memory_bytes": settings.job_memory_bytes,
                "cpu_s": settings.job_cpu_s,
                "output_bytes": settings.job_output_bytes,
                "open_files": settings.job_open_files,
            },
        }
        if request.get("map") is not None:
            job["map"] = self._link("map", request["map"]["yaml"], "map.yaml")
            # Any name but those that the YAML may ask for; the worker links the one it does ask for.
            (self._folder / "map" / ".image").symlink_to(self._storage.upload_path(request["map"]["image"]).absolute())
            job["map_image"] = ".image"
        (self._folder / "job.json").write_text(json.dumps(job), encoding="utf-8")

    def _link(self, folder: str, file_id: str, default: str) -> str:
        name = safe_name(self._claim.names.get(file_id, ""), default)
        (self._folder / folder / name).symlink_to(self._storage.upload_path(file_id).absolute())
        return name

    def _start(self) -> tuple[subprocess.Popen[bytes], int]:
        """The process in a session and process group of its own; the reading end of its pipe."""
        environment = {k: v for k, v in os.environ.items() if k in _KEPT or k.startswith(_KEPT_PREFIXES)}
        environment.setdefault("MPLCONFIGDIR", str(self._storage.cache.absolute()))
        threads = str(self._settings.job_threads)
        environment |= {
            MARK: self._mark,
            "HOME": str((self._folder / "tmp").absolute()),
            "TMPDIR": str((self._folder / "tmp").absolute()),
            "PYTHONUNBUFFERED": "1",
            "NUMBA_NUM_THREADS": threads,
            "OMP_NUM_THREADS": threads,
            "OPENBLAS_NUM_THREADS": threads,
        }
        reading, writing = os.pipe()
        pipe_to = ("--fd", str(writing), "--parent", str(os.getpid()))
        try:
            with (self._folder / "log.txt").open("wb") as output:
                process = subprocess.Popen(
                    [*self._settings.worker_command, str(self._folder.absolute()), *pipe_to],
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    pass_fds=(writing,),
                    cwd=self._folder,
                    env=environment,
                    start_new_session=True,
                )
        except OSError:
            os.close(reading)
            raise
        finally:
            os.close(writing)
        os.set_blocking(reading, False)
        return process, reading

    def _watch(self, process: subprocess.Popen[bytes], pipe: int) -> Outcome:
        """Read the pipe, prolong the lease, keep the limits; until the process has ended or must."""
        settings, begin = self._settings, time.monotonic()
        beat_at = size_at = begin
        with selectors.DefaultSelector() as selector:
            selector.register(pipe, selectors.EVENT_READ)
            while process.poll() is None:
                if selector.select(TICK_S) and not self._read(pipe):
                    if len(self._buffer) > _LINE_BYTES:
                        return Outcome("crashed", "protocol", "the job's process wrote nonsense")
                    time.sleep(TICK_S / 2)  # the pipe is closed, the process lives on
                now = time.monotonic()
                if self._stop.is_set():
                    return Outcome("again", "shutdown", "the server was stopped")
                if now - begin > settings.job_wall_s:
                    return Outcome("failed", "wall_limit", f"the job took longer than {settings.job_wall_s:.0f} s")
                if now >= size_at:
                    size_at = now + LOOK_S
                    if folder_bytes(self._folder) > settings.job_output_bytes:
                        return Outcome("failed", "output_limit", "the job wrote more than it is allowed")
                    if self._storage.free_bytes() < self._storage.min_free_bytes // 2:
                        return Outcome("failed", "disk_full", "the server's disk became full while the job ran")
                if now >= beat_at or self._cancel.is_set():
                    beat_at = now + min(LOOK_S, settings.heartbeat_s)
                    held = self._beat(now, begin)
                    if held == "lost":
                        return Outcome("lost")
                    if held == "cancel":
                        end_job(process, self._mark, settings.grace_s)
                        return Outcome("failed", "cancelled", "cancelled")
        while self._read(pipe):
            pass
        return self._judge(process.returncode)

    def _beat(self, now: float, begin: float) -> str:
        """Tell the database, if there is something new or it is time; `lost`, `cancel` or `go`."""
        progress = None
        if self._progress is not None and self._progress is not self._told:
            self._told = self._progress
            done = self._progress["done"]
            progress = {**self._progress, "speed": round(done / max(now - begin, 1e-3), 3)}
        elif now - self._beaten < self._settings.heartbeat_s and not self._cancel.is_set():
            return "go"
        self._beaten = now
        beat = self._leases.beat(self._claim, progress)
        return "lost" if not beat.mine else "cancel" if beat.cancel else "go"

    def _read(self, pipe: int) -> bool:
        """Take what the pipe has; False when it is at its end (or the process writes nonsense)."""
        try:
            block = os.read(pipe, 1 << 16)
        except BlockingIOError:
            return False
        *lines, self._buffer = (self._buffer + block).split(b"\n")
        for line in lines:
            with suppress(ValueError, KeyError, TypeError):
                self._take(json.loads(line))
        return bool(block) and len(self._buffer) <= _LINE_BYTES

    def _take(self, line: dict[str, Any]) -> None:
        if "done" in line or "failed" in line:
            self._final = line
        else:
            self._progress = {
                "phase": str(line["phase"])[:40],
                "done": float(line["part"]),
                "total": float(line["total"]),
                "scans": int(line["scans"]),
            }

    def _judge(self, code: int) -> Outcome:
        """What the exit of the process means. Its own words count, but not its claim of success over its exit code."""
        final = self._final or {}
        if code == 0 and isinstance(final.get("done"), dict) and (self._folder / "output").is_dir():
            return Outcome("done", summary=final["done"])
        if "failed" in final:
            reason = str(final["failed"])[:40]
            state = "crashed" if reason == "internal_error" else "failed"
            return Outcome(state, reason, str(final.get("message", ""))[:2000])
        if code == -signal.SIGXCPU:
            return Outcome(
                "failed", "cpu_limit", f"the job used more than {self._settings.job_cpu_s:.0f} s of processor"
            )
        if code == -signal.SIGKILL:
            # The kernel (no memory) or an operator: not the job's own doing, so it is tried again, but not for ever.
            return Outcome("again", "killed", "the job's process was killed")
        if code < 0:
            name = signal.Signals(-code).name if -code in list(signal.Signals) else str(-code)
            return Outcome("crashed", "signal", f"the job's process was ended by {name}")
        return Outcome("crashed", "exit", f"the job's process ended with code {code}{self._last_words()}")

    def _last_words(self) -> str:
        with suppress(OSError):
            text = (self._folder / "log.txt").read_bytes()[-2000:].decode("utf-8", "replace").strip()
            if text:
                return f": {text.splitlines()[-1][:300]}"
        return ""

    def _settle(self, outcome: Outcome) -> str:
        """Write the outcome, under the fence."""
        claim, state = self._claim, outcome.kind
        if outcome.kind == "done":
            state = self._publish(outcome.summary or {})
        elif outcome.kind == "again":
            self._leases.release(claim, outcome.message, counts=outcome.reason != "shutdown")
            state = "queued"
        elif outcome.kind != "lost":
            self._leases.fail(claim, outcome.kind, outcome.reason, outcome.message)
        log("job.end", job=claim.job_id, attempt=claim.attempt, state=state, reason=outcome.reason)
        return state

    def _publish(self, summary: dict[str, Any]) -> str:
        """Rename the output into place, then commit; a crash between the two leaves a folder that is swept later."""
        claim = self._claim
        name = f"{claim.job_id}.{claim.attempt}"
        try:
            assets = self._storage.publish(self._folder / "output", name)
        except OSError as error:
            self._leases.fail(claim, "failed", "disk_full", f"the results could not be kept: {error.strerror}")
            return "failed"
        if self._leases.succeed(claim, name, assets, summary):
            return "succeeded"
        self._storage.remove(name)
        self._leases.fail(claim, "failed", "cancelled", "cancelled")
        return "lost"

"""The settings of the service; the defaults are those of a server for one person on one machine."""

from __future__ import annotations

import dataclasses
import difflib
import math
import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_type_hints

if TYPE_CHECKING:
    from collections.abc import Mapping

MIB, GIB = 1 << 20, 1 << 30
WORKER = (sys.executable, "-P", "-m", "hsloc_service.execution.worker")
UNLIMITED = 1_000_000
RETRIED = (
    "signal", "exit", "internal_error", "protocol", "out_of_memory", "cpu_limit", "wall_limit", "output_limit",
    "disk_full", "store", "invalid_input", "fault_injection",
)  # fmt: skip
"""Reasons of a job's end that another attempt may be made after."""
SANDBOXES = ("auto", "bubblewrap", "landlock", "if-possible", "none")


class SettingsError(ValueError):
    """A setting that cannot be used; one line that names it, its value and the remedy."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """How the service runs. Sizes in bytes, times in seconds; `None` where it says so means without limit."""

    data: Path = Path("hsloc-data")
    """Folder of the database, the uploads and the results; on a local disk."""
    database_url: str = field(default="", repr=False)
    """Database that several servers share, such as `postgresql://user@host/hsloc`; empty: SQLite in the data folder."""
    store_url: str = ""
    """Object store, or folder that all see, for uploads and results of several servers and workers: `s3://bucket/prefix`,
    `file:///mnt/hsloc`; empty: the data folder."""
    cache_bytes: int = 16 * GIB
    """Maximum size of the copies of uploads that a server or worker keeps where `store_url` is set [B]; those that a
    job reads are kept in any case."""
    results_url: str = ""
    """Where results go instead of the data folder, as fsspec knows it: `s3://bucket/prefix`, `file:///mnt/results`."""
    store_timeout_s: float = 30.0
    """Time limit for one call to a store of results [s]; then it counts as dead (503)."""
    slots: int = 1
    """Number of jobs that run at the same time; 0 where workers run them all."""
    tags: tuple[str, ...] = ()
    """Tags of jobs that run here, such as `big-memory`; jobs without a tag run everywhere."""

    require_token: bool = False
    """Refuse requests without a bearer token. `hsloc serve` sets it unless it listens on loopback without tokens."""
    allowed_hosts: tuple[str, ...] = ("localhost", "127.0.0.1", "[::1]", "testserver")
    """Values of the Host header that are answered; `*` for any. Keeps DNS rebinding out."""

    trusted_proxies: tuple[str, ...] = ()
    """Addresses of proxies whose `X-Forwarded-For` counts as the client's address; by default none's."""

    max_upload_bytes: int = 64 * GIB
    """Maximum size of an upload [B]."""
    tenant_bytes: int = 256 * GIB
    """Maximum size of the uploads and results of one tenant together [B]; more are refused (507)."""
    min_free_bytes: int = 256 * MIB
    """Free space of the disk below which uploads and jobs are refused (507) [B]; the database needs it."""
    upload_ttl_s: float = 24 * 3600.0
    """Time after the last byte at which an unfinished upload is deleted [s]."""
    housekeeping_s: float = 60.0
    """Time between two searches for expired uploads and old jobs [s]."""
    retention_s: float | None = None
    """Age at which finished jobs are deleted with their results [s]; None keeps them."""

    max_queued: int = 100
    """Maximum number of waiting jobs of one tenant; more are refused (429)."""
    max_running: int = UNLIMITED
    """Maximum number of jobs of one tenant that run at the same time, on all servers and workers together."""
    max_streams: int = 64
    """Maximum number of event streams of one tenant at the same time."""
    requests_per_s: float = 200.0
    """Maximum rate of requests of one tenant [1/s]; a burst of twice as many passes."""
    refusals_per_s: float = 1.0
    """Maximum rate of requests of one address without a valid token [1/s]; a burst of 20 times as many passes."""

    job_memory_bytes: int = 4 * GIB
    """Address space of a job's process (RLIMIT_AS)."""
    job_cpu_s: float = 4 * 3600.0
    """Processor time of a job's process (RLIMIT_CPU)."""
    job_wall_s: float = 6 * 3600.0
    """Wall time after which a job is killed [s]."""
    job_output_bytes: int = 8 * GIB
    """Maximum size of all that a job writes, and of one file (RLIMIT_FSIZE) [B]."""
    job_open_files: int = 256
    """RLIMIT_NOFILE of a job's process."""
    job_threads: int = 1
    """NUMBA_NUM_THREADS of a job's process."""
    sandbox: str = "auto"
    """What keeps a job's process from the server's files and the network: `bubblewrap`, `landlock`, `auto` for the
    first of them that this machine has (none: the server does not start), `if-possible` for the same with a warning
    instead of a refusal, or `none`."""
    grace_s: float = 3.0
    """Time between SIGTERM and SIGKILL when a job is cancelled [s]."""
    max_attempts: int = 3
    """Number of attempts after which a job whose process or server was killed ends as crashed."""
    retry: tuple[str, ...] = ()
    """Number of attempts at a job that ends for a reason, such as `signal=3,store=5`: it goes back into the queue until
    it has had that number. What is not named is not tried again."""
    retry_wait_s: float = 10.0
    """Wait before the second attempt by `retry` [s]; doubled for each further one, up to an hour."""
    lease_s: float = 30.0
    """Time without a heartbeat after which a job goes back into the queue [s]."""
    heartbeat_s: float = 5.0
    """Time between two heartbeats of a running job [s]."""

    header_timeout_s: float = 5.0
    """Time within which a client must send its request line and headers [s]."""
    body_timeout_s: float = 8.0
    """Time without a byte of an announced body after which the connection is closed [s]."""
    min_body_bytes_per_s: int = 512
    """Minimum rate of a body, averaged over 2.5 times `body_timeout_s` [B/s]; a slower connection is closed."""
    write_timeout_s: float = 60.0
    """Time without progress of an answer after which the connection is closed [s]."""
    max_connections: int = 4096
    """Maximum number of connections at the same time; more are closed at once."""

    webhook_private: bool = False
    """Deliver webhooks to private and loopback addresses, too."""
    webhook_attempts: int = 8
    """Number of attempts after which a webhook is given up."""
    webhook_backoff_s: float = 2.0
    """Wait after the first failed attempt [s]; doubled after each further one, up to an hour."""

    fault_drop_uploads: float = 0.0
    """TEST ONLY: share of upload requests that are cut off in the middle, 0 to 1."""
    fault_fail_requests: float = 0.0
    """TEST ONLY: share of API requests that are answered with 503, 0 to 1."""
    fault_fail_jobs: float = 0.0
    """TEST ONLY: share of jobs that fail, 0 to 1."""

    worker_command: tuple[str, ...] = field(default=WORKER, repr=False)
    """Program of a job's process; its arguments are the job's folder, a pipe and the server's process id."""

    def __post_init__(self) -> None:
        for each in dataclasses.fields(self):
            value = getattr(self, each.name)
            if isinstance(value, int | float) and not isinstance(value, bool):
                _check_number(each.name, value)
        if self.sandbox not in SANDBOXES:
            raise SettingsError(f"sandbox is {self.sandbox!r}; it must be one of {', '.join(SANDBOXES)}")
        self.attempts_by_reason()
        for name in ("allowed_hosts", "worker_command"):
            if not getattr(self, name):
                raise SettingsError(f"{name} is empty; give at least one value, or leave it out")
        if self.store_url and self.results_url:
            raise SettingsError(
                "store_url and results_url are both set; results go to store_url, so leave results_url out"
            )
        if not 0.0 < self.heartbeat_s < self.lease_s:
            raise SettingsError(
                f"heartbeat_s is {self.heartbeat_s}; it must be above 0 and below lease_s {self.lease_s}"
            )

    def attempts_by_reason(self) -> dict[str, int]:
        """The table of `retry`. Raises SettingsError."""
        found = {}
        for part in self.retry:
            reason, _, count = part.partition("=")
            if reason not in RETRIED or not count.isdecimal() or not 1 <= int(count) <= 100:
                raise SettingsError(
                    f"retry has {part!r}; it must be REASON=ATTEMPTS with 1 to 100 attempts, and one of the reasons "
                    f"{', '.join(RETRIED)}"
                )
            found[reason] = int(count)
        return found


MAY_BE_ZERO = ("retry_wait_s", "slots", "cache_bytes", "min_free_bytes", "grace_s", "webhook_backoff_s")
MAX_SECONDS = 1e9
"""Thirty years: times beyond that are misprints, and overflow."""


def _check_number(name: str, value: float) -> None:
    """Raises SettingsError for a number that makes no sense: not finite, negative, zero, or no part of 1."""
    if name.startswith("fault_"):
        if not 0.0 <= value <= 1.0:
            raise SettingsError(f"{name} is {value}; it must be from 0 to 1")
        return
    least = "0 or more" if name in MAY_BE_ZERO else "1 or more" if isinstance(value, int) else "above 0"
    if not math.isfinite(value) or value < 0 or (value == 0 and name not in MAY_BE_ZERO):
        raise SettingsError(f"{name} is {value}; it must be {least}, and finite")
    if name.endswith("_s") and not name.endswith("per_s") and value > MAX_SECONDS:
        raise SettingsError(f"{name} is {value:g} s; it must be at most {MAX_SECONDS:g} s")


OTHER_VARIABLES = ("HSLOC_DATA", "HSLOC_SERVE_DATA", "HSLOC_TOKEN", "HSLOC_URL", "HSLOC_PORT", "HSLOC_JOB")
"""Variables of hsloc that are no settings: a folder of logs, the data folder, the operator's token, the server that
`hsloc submit` asks, the port of compose.yaml, the mark of a job's processes."""


def _check_names(environment: Mapping[str, str]) -> None:
    """Raises SettingsError for a variable `HSLOC_...` that is no setting: misspelt, its value would be ignored."""
    known = [f"HSLOC_{each.name.upper()}" for each in dataclasses.fields(Settings) if each.name != "data"]
    for name in sorted(environment):
        if name.startswith("HSLOC_") and name not in known and name not in OTHER_VARIABLES:
            names = [each.removeprefix("HSLOC_") for each in (*known, *OTHER_VARIABLES)]
            close = difflib.get_close_matches(name.removeprefix("HSLOC_"), names, 1)
            remedy = f"did you mean HSLOC_{close[0]}?" if close else "remove it, or see settings.py for the names"
            raise SettingsError(f"{name} is not a setting of the service; {remedy}")


def from_environment(environment: Mapping[str, str] = os.environ, **changes: Any) -> Settings:
    """Settings from `HSLOC_<NAME>` variables; `changes` (those that are not None) stand above them.

    The folder is `HSLOC_SERVE_DATA`: elsewhere `HSLOC_DATA` is a folder of logs, not to be written to.
    Raises SettingsError for a value that cannot be used, and for a variable `HSLOC_...` that is no setting.
    """
    _check_names(environment)
    values: dict[str, Any] = {}
    hints = get_type_hints(Settings)
    for each in dataclasses.fields(Settings):
        text = environment.get("HSLOC_SERVE_DATA" if each.name == "data" else f"HSLOC_{each.name.upper()}")
        if text is not None:
            values[each.name] = _parse(each.name, text, hints[each.name])
    values |= {name: value for name, value in changes.items() if value is not None}
    return Settings(**values)


def _parse(name: str, text: str, hint: Any) -> Any:
    """One value; sizes may end with K, M, G or T (powers of 1024)."""
    try:
        if hint is bool:
            return {"1": True, "true": True, "yes": True, "0": False, "false": False, "no": False}[text.lower()]
        if hint is int:
            return parse_size(text)
        if hint is Path:
            return Path(text)
        if hint is str:
            return text
        if hint == tuple[str, ...]:
            return tuple(part.strip() for part in text.split(",") if part.strip())
        return float(text)
    except (ValueError, KeyError) as error:
        raise SettingsError(f"HSLOC_{name.upper()} is {text!r}, which cannot be read as a value of {name}") from error


def parse_size(text: str) -> int:
    """A whole number; K, M, G or T behind it stand for powers of 1024. Raises ValueError."""
    factor = {"K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40}.get(text[-1:].upper())
    return int(text) if factor is None else int(text[:-1]) * factor

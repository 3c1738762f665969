"""Everything that an operator can set, with the defaults of a server for one person on one machine."""

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
SANDBOXES = ("auto", "bubblewrap", "landlock", "if-possible", "none")


class SettingsError(ValueError):
    """A setting that cannot be used; one line that names it, its value and the remedy."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """How the service runs. Sizes in bytes, times in seconds; `None` where it says so means without limit."""

    data: Path = Path("hsloc-data")
    """Folder of the database, the uploads and the results; on a local disk."""
    results_url: str = ""
    """Where results go instead of the data folder, as fsspec knows it: `s3://bucket/prefix`, `file:///mnt/results`."""
    store_timeout_s: float = 30.0
    """A store that takes longer for one call is taken for dead (503); a job's results are tried again."""
    slots: int = 1
    """Jobs that run at the same time."""

    require_token: bool = False
    """Refuse requests without a bearer token. `hsloc serve` sets it unless it listens on loopback without tokens."""
    allowed_hosts: tuple[str, ...] = ("localhost", "127.0.0.1", "[::1]", "testserver")
    """Values of the Host header that are answered; `*` for any. Keeps DNS rebinding out."""

    trusted_proxies: tuple[str, ...] = ()
    """Addresses of proxies whose `X-Forwarded-For` counts as the client's address; nobody's otherwise."""

    max_upload_bytes: int = 64 * GIB
    """The largest file that is taken."""
    tenant_bytes: int = 256 * GIB
    """What the uploads and results of one tenant may take together; more are refused (507)."""
    min_free_bytes: int = 256 * MIB
    """Uploads and jobs are refused (507) when the disk has less; keeps room for the database and for deleting."""
    upload_ttl_s: float = 24 * 3600.0
    """An upload that was not finished by then is removed."""
    housekeeping_s: float = 60.0
    """How often expired uploads and old jobs are looked for."""
    retention_s: float | None = None
    """Finished jobs older than this are removed with their results; None keeps them."""

    max_queued: int = 100
    """Jobs of one tenant that may wait; more are refused (429)."""
    max_streams: int = 64
    """Event streams of one tenant at the same time."""
    requests_per_s: float = 200.0
    """Requests of one tenant, on average; a burst of twice as many passes."""
    refusals_per_s: float = 1.0
    """Requests of one address without a valid token, on average; a burst of twenty times as many passes."""

    job_memory_bytes: int = 4 * GIB
    """Address space of a job's process (RLIMIT_AS)."""
    job_cpu_s: float = 4 * 3600.0
    """Processor time of a job's process (RLIMIT_CPU)."""
    job_wall_s: float = 6 * 3600.0
    """A job that takes longer is killed."""
    job_output_bytes: int = 8 * GIB
    """What a job may write, together (and RLIMIT_FSIZE, for one file)."""
    job_open_files: int = 256
    """RLIMIT_NOFILE of a job's process."""
    job_threads: int = 1
    """NUMBA_NUM_THREADS of a job's process."""
    sandbox: str = "auto"
    """What keeps a job's process from the server's files and the network: `bubblewrap`, `landlock`, `auto` for the
    first of them that this machine has (none: the server does not start), `if-possible` for the same with a warning
    instead of a refusal, or `none`."""
    grace_s: float = 3.0
    """Time between SIGTERM and SIGKILL when a job is cancelled."""
    max_attempts: int = 3
    """A job whose process or server died so often is given up as crashed."""
    lease_s: float = 30.0
    """A job whose server has not said for so long that it lives goes back into the queue."""
    heartbeat_s: float = 5.0
    """How often it says so."""

    header_timeout_s: float = 5.0
    """A client must send its request line and headers within this time."""
    body_timeout_s: float = 8.0
    """A client that sends nothing of its announced body for so long is cut off."""
    min_body_bytes_per_s: int = 512
    """A client whose body comes more slowly than this, over 2.5 times `body_timeout_s`, is cut off [B/s]."""
    write_timeout_s: float = 60.0
    """A client that takes nothing of its answer for so long is cut off."""
    max_connections: int = 4096
    """Connections at the same time; more are closed at once."""

    webhook_private: bool = False
    """Deliver webhooks to private and loopback addresses, too."""
    webhook_attempts: int = 8
    """A webhook is given up after so many attempts."""
    webhook_backoff_s: float = 2.0
    """Wait after the first failed attempt; doubled after each more, up to an hour."""

    fault_drop_uploads: float = 0.0
    """TEST ONLY: the part of upload requests that is cut off in the middle."""
    fault_fail_requests: float = 0.0
    """TEST ONLY: the part of API requests that is answered with 503."""
    fault_fail_jobs: float = 0.0
    """TEST ONLY: the part of jobs that fails."""

    worker_command: tuple[str, ...] = field(default=WORKER, repr=False)
    """The program of a job's process; gets the job's folder, a pipe and the server's process id."""

    def __post_init__(self) -> None:
        for each in dataclasses.fields(self):
            value = getattr(self, each.name)
            if isinstance(value, int | float) and not isinstance(value, bool):
                _check_number(each.name, value)
        if self.sandbox not in SANDBOXES:
            raise SettingsError(f"sandbox is {self.sandbox!r}; it must be one of {', '.join(SANDBOXES)}")
        for name in ("allowed_hosts", "worker_command"):
            if not getattr(self, name):
                raise SettingsError(f"{name} is empty; give at least one value, or leave it out")
        if not 0.0 < self.heartbeat_s < self.lease_s:
            raise SettingsError(
                f"heartbeat_s is {self.heartbeat_s}; it must be above 0 and below lease_s {self.lease_s}"
            )


MAY_BE_ZERO = ("min_free_bytes", "grace_s", "webhook_backoff_s")
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

    The folder is `HSLOC_SERVE_DATA`: elsewhere `HSLOC_DATA` is where somebody keeps logs, no place to write to.
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

"""Everything that an operator can set, with the defaults of a server for one person on one machine."""

from __future__ import annotations

import dataclasses
import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_type_hints

if TYPE_CHECKING:
    from collections.abc import Mapping

MIB, GIB = 1 << 20, 1 << 30


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

    max_upload_bytes: int = 64 * GIB
    """The largest file that is taken."""
    tenant_bytes: int = 256 * GIB
    """What the uploads and results of one tenant may take together; more are refused (507)."""
    min_free_bytes: int = 256 * MIB
    """Uploads and jobs are refused (507) when the disk has less; keeps room for the database and for deleting."""
    upload_ttl_s: float = 24 * 3600.0
    """An upload that was not finished by then is removed."""
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

    worker_command: tuple[str, ...] = field(
        default=(sys.executable, "-P", "-m", "hsloc_service.execution.worker"), repr=False
    )
    """The program of a job's process; gets the job's folder, a pipe and the server's process id."""

    def __post_init__(self) -> None:
        for name in ("slots", "max_upload_bytes", "max_queued", "max_attempts", "job_memory_bytes", "job_output_bytes"):
            if getattr(self, name) < 1:
                raise SettingsError(f"{name} is {getattr(self, name)}; it must be 1 or more")
        for name in ("requests_per_s", "refusals_per_s", "store_timeout_s", "body_timeout_s", "header_timeout_s"):
            if not getattr(self, name) > 0.0:
                raise SettingsError(f"{name} is {getattr(self, name)}; it must be above 0")
        if not 0.0 < self.heartbeat_s < self.lease_s:
            raise SettingsError(
                f"heartbeat_s is {self.heartbeat_s}; it must be above 0 and below lease_s {self.lease_s}"
            )


def from_environment(environment: Mapping[str, str] = os.environ, **changes: Any) -> Settings:
    """Settings from `HSLOC_<NAME>` variables; `changes` (those that are not None) stand above them.

    The folder is `HSLOC_SERVE_DATA`: elsewhere `HSLOC_DATA` is where somebody keeps logs, no place to write to.
    Raises SettingsError for a value that cannot be read.
    """
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

"""A worker: slots without HTTP, for jobs that servers with the same database and object store have taken."""

from __future__ import annotations

import signal
import threading
import time
from typing import TYPE_CHECKING, Any

from prometheus_client import start_http_server

from hsloc.version import __version__
from hsloc_service.execution.warm_up import WarmUp
from hsloc_service.http import metrics
from hsloc_service.jobs.workers import Presence
from hsloc_service.logs import configure, log
from hsloc_service.parts import open_parts
from hsloc_service.settings import WORKER, SettingsError

if TYPE_CHECKING:
    from collections.abc import Callable

    from hsloc_service.settings import Settings

POLL_S = 0.1


def work(settings: Settings, drain_s: float, metrics_at: str | None = None) -> int:
    """Run jobs until SIGTERM or SIGINT; the exit code.

    `metrics_at` is an address `[HOST:]PORT` at which Prometheus finds this worker's metrics, without a token.

    Then no job is begun any more. Those that run may end for `drain_s` seconds, or until the next signal; what still
    runs then goes back into the queue, and that attempt does not count. Raises SettingsError.
    """
    if not settings.database_url.startswith("postgresql"):
        raise SettingsError(
            "a worker shares its database with servers: set HSLOC_DATABASE_URL=postgresql://..., as on the servers"
        )
    if not settings.store_url:
        raise SettingsError(
            "a worker fetches uploads from where the servers put them: set HSLOC_STORE_URL, as on the servers"
        )
    if settings.slots < 1:
        raise SettingsError(f"slots is {settings.slots}; a worker needs 1 or more")
    close_metrics = serve_metrics(metrics_at)
    try:
        parts = open_parts(settings, ended=metrics.attempt_ended, store_failed=metrics.STORE_ERRORS.inc)
    except BaseException:
        close_metrics()
        raise
    configure()
    asked = threading.Semaphore(0)

    def ask(_signal: int, _frame: Any) -> None:
        asked.release()

    for which in (signal.SIGTERM, signal.SIGINT):
        signal.signal(which, ask)
    dispatcher = parts.dispatcher
    metrics.SLOTS.set(settings.slots)
    metrics.BUSY.set_function(lambda: dispatcher.capacity().busy)
    metrics.FREE.set_function(parts.storage.free_bytes)
    presence = Presence(
        parts.database, dispatcher.owner, "worker", settings.slots, settings.heartbeat_s, lambda: dispatcher.is_draining
    )
    warm_up = None
    if dispatcher.sandbox_kind != "none" and settings.worker_command == WORKER:
        warm_up = WarmUp(parts.storage.cache.absolute())
    try:
        dispatcher.start()
        presence.start()
        if warm_up is not None:
            warm_up.start()
        log("start", version=__version__, kind="worker", slots=settings.slots, sandbox=dispatcher.sandbox_kind)
        # A signal that reaches another thread does not end the wait: Python acts on it when this thread wakes up.
        while not asked.acquire(timeout=1.0):
            pass
        dispatcher.drain()
        presence.beat()
        log("drain", busy=dispatcher.capacity().busy, within_s=drain_s)
        until = time.monotonic() + drain_s
        while dispatcher.capacity().busy and time.monotonic() < until and not asked.acquire(timeout=POLL_S):
            pass
    finally:
        dispatcher.stop()
        presence.stop()
        if warm_up is not None:
            warm_up.stop()
        parts.close()
        close_metrics()
        log("stop")
    return 0


def serve_metrics(address: str | None) -> Callable[[], None]:
    """Answer HTTP requests at `[HOST:]PORT` with the metrics of this machine; what ends that.

    Raises SettingsError for an address that is none, or cannot be listened at.
    """
    if address is None:
        return lambda: None
    host, _, port = address.rpartition(":")
    if not port.isdecimal() or int(port) > 65535:
        raise SettingsError(f"--metrics is {address!r}; it must be a port, or an address such as 0.0.0.0:9100")
    try:
        server, thread = start_http_server(int(port), host.strip("[]") or "127.0.0.1", metrics.MACHINE)
    except OSError as error:
        raise SettingsError(f"--metrics {address}: cannot be listened at: {error.strerror}; give another") from error

    def close() -> None:
        server.shutdown()
        server.server_close()
        thread.join()

    return close

"""A worker: slots without HTTP, for jobs that servers with the same database and object store have taken."""

from __future__ import annotations

import signal
import threading
import time
from typing import TYPE_CHECKING, Any

from hsloc.version import __version__
from hsloc_service.execution.warm_up import WarmUp
from hsloc_service.jobs.workers import Presence
from hsloc_service.logs import configure, log
from hsloc_service.parts import open_parts
from hsloc_service.settings import WORKER, SettingsError

if TYPE_CHECKING:
    from hsloc_service.settings import Settings

POLL_S = 0.1


def work(settings: Settings, drain_s: float) -> int:
    """Run jobs until SIGTERM or SIGINT; the exit code.

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
    parts = open_parts(settings)
    configure()
    asked = threading.Semaphore(0)

    def ask(_signal: int, _frame: Any) -> None:
        asked.release()

    for which in (signal.SIGTERM, signal.SIGINT):
        signal.signal(which, ask)
    dispatcher = parts.dispatcher
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
        while not asked.acquire(timeout=60.0):
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
        log("stop")
    return 0

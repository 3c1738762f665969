"""What a server and a worker have in common: data folder, database, stores, and the dispatcher of their slots."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from hsloc_service.db.database import open_database
from hsloc_service.execution.dispatcher import LocalDispatcher
from hsloc_service.execution.input_cache import InputCache
from hsloc_service.execution.inspection import Inspector
from hsloc_service.execution.sandbox import choose_sandbox
from hsloc_service.execution.supervisor import Supervisor
from hsloc_service.jobs.leases import Leases, RetryPolicy
from hsloc_service.results.deletion_queue import DeletionQueue
from hsloc_service.results.stores import ResultStores
from hsloc_service.results.upload_parts import UploadParts
from hsloc_service.settings import SettingsError
from hsloc_service.storage import Storage

if TYPE_CHECKING:
    from collections.abc import Callable

    from hsloc_service.db.database import Database
    from hsloc_service.settings import Settings


@dataclass(frozen=True, slots=True)
class Parts:
    """The parts on one data folder, which they lock; nothing runs yet."""

    storage: Storage
    database: Database
    stores: ResultStores
    upload_parts: UploadParts | None
    deletions: DeletionQueue
    dispatcher: LocalDispatcher
    inspector: Inspector

    def close(self) -> None:
        """Close the database and release the data folder."""
        self.database.close()
        self.storage.close()


def open_parts(
    settings: Settings,
    *,
    ended: Callable[[str, float, float], None] = lambda state, seconds, waited_s: None,
    store_failed: Callable[[], None] = lambda: None,
) -> Parts:
    """The parts that the settings describe. Raises SettingsError."""
    storage = Storage(settings.data, settings.min_free_bytes)
    try:
        sandbox = choose_sandbox(settings.sandbox, settings.data, settings.worker_command)
        database, stores = open_database(settings), ResultStores(storage, settings)
    except SettingsError:
        storage.close()
        raise
    stores.expect(database)
    upload_parts = None
    if stores.parts_store is not None:
        upload_parts = UploadParts(database, stores.parts_store, settings.store_timeout_s)
    deletions = DeletionQueue(database, storage, stores, settings.store_timeout_s, upload_parts)
    policy = RetryPolicy(settings.max_attempts, settings.attempts_by_reason(), settings.retry_wait_s)
    leases = Leases(database, settings.lease_s, policy, settings.tags, settings.max_running)
    inputs = InputCache(storage, upload_parts, settings.cache_bytes)
    supervisor = Supervisor(leases, storage, settings, stores, sandbox, inputs, store_failed)
    dispatcher = LocalDispatcher(supervisor, deletions, ended)
    inspector = Inspector(storage, settings, sandbox, inputs, store_failed)
    return Parts(storage, database, stores, upload_parts, deletions, dispatcher, inspector)

"""How long common calls take with 100,000 jobs in the database, on SQLite and PostgreSQL; the goal is 50 ms at 99 %.

Nine of ten jobs have ended long ago, with results and events; a hundred wait. The calls are those of the repositories,
without HTTP. What cannot be below 50 ms for its size, such as the count of all matches of a search, is measured too.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
import time
import uuid
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "support"))
import postgresql
from live_service import settings
from sqlalchemy import func, insert, select, text

from hsloc_service.auth import ANYBODY
from hsloc_service.db.database import Database
from hsloc_service.db.tables import AssetRow, CounterRow, EventRow, FileRow, JobRow
from hsloc_service.housekeeping import Housekeeping
from hsloc_service.jobs.leases import Leases
from hsloc_service.jobs.repository import SEQ, JobFilter, Jobs
from hsloc_service.results.deletion_queue import DeletionQueue
from hsloc_service.results.stores import ResultStores
from hsloc_service.storage import Storage

if TYPE_CHECKING:
    from collections.abc import Callable

WAITING = 100
TENANTS = 5
OLD_S = 100 * 86400.0
BLOCK = 5000
GOAL_S = 0.05


def fill(database: Database, count: int) -> str:
    """Jobs of several tenants, the caller's half of them; the id of an upload."""
    file_id, now = str(uuid.uuid4()), time.time()
    summary = {"metrics": {"verdict": "good"}, "figures": [{"name": "APE rmse", "values": ["1.2 cm", "0.3"]}]}
    base = {
        "file_id": file_id,
        "request": {"log": file_id},
        "attempt": 1,
        "cancel": False,
        "labels": ",",
        "priority": 0,
    }
    with database.write() as session:
        session.add(
            FileRow(
                id=file_id, tenant=ANYBODY.tenant, name="run.mcap", state="complete", size=9, received=9, created=now
            )
        )
        session.add(CounterRow(name=SEQ, value=count))
    for begin in range(0, count, BLOCK):
        jobs, assets, events = [], [], []
        for k in range(begin, min(begin + BLOCK, count)):
            ident, old = str(uuid.uuid4()), k < 0.9 * count
            tenant = ANYBODY.tenant if k % 2 else f"tenant-{k % TENANTS}"
            at = now - (OLD_S if old else 1000.0) + 1e-3 * k
            ended = k < count - WAITING
            row = {"seq": k + 1, "id": ident, "tenant": tenant, "log_name": f"run-{k % 997}.mcap", "created": at}
            row |= {"state": "succeeded" if ended else "queued", "bytes": 1000 if ended else 0}
            row |= {"started": at, "ended": at + 60.0} if ended else {"started": None, "ended": None}
            row |= {"summary": summary if ended else None, "folder": f"{ident}.1" if ended else None}
            jobs.append(base | row)
            assets += [
                {"job_id": ident, "name": name, "size": 500, "sha256": "0" * 64, "media_type": "x"} for name in "ab"
            ]
            events += [
                {"tenant": tenant, "job_id": ident, "at": at, "kind": "state", "data": {"state": state}}
                for state in ("queued", "running", "succeeded")
            ]
        with database.write() as session:
            for table, rows in ((JobRow, jobs), (AssetRow, assets), (EventRow, events)):
                session.execute(insert(table), rows)
    return file_id


def measure(database: Database, folder: Path, file_id: str, repeats: int) -> dict[str, list[float]]:
    """Times of each call [s]."""
    chosen = settings(folder, max_queued=10**6, retention_s=30 * 86400.0)
    storage = Storage(chosen.data)
    jobs, stores = Jobs(database, storage, chosen), ResultStores(storage, chosen)
    house = Housekeeping(database, storage, chosen, DeletionQueue(database, storage, stores, 30.0))
    leases = Leases(database, 30.0)
    times: dict[str, list[float]] = {}

    def repeat(name: str, work: Callable[[], object], count: int = repeats) -> None:
        found = times.setdefault(name, [])
        for _ in range(count):
            begin = time.perf_counter()
            work()
            found.append(time.perf_counter() - begin)

    newest = jobs.list(ANYBODY, JobFilter(), limit=1)[0].seq
    repeat("list, newest 50", lambda: jobs.list(ANYBODY, JobFilter()))
    repeat("list, 50 from the middle", lambda: jobs.list(ANYBODY, JobFilter(), before=newest // 2))
    repeat("list, queued", lambda: jobs.list(ANYBODY, JobFilter(state="queued")))
    repeat("count of all", lambda: jobs.count(ANYBODY, JobFilter()))
    repeat("list, search", lambda: jobs.list(ANYBODY, JobFilter(search="run-99")))
    repeat("list, by name", lambda: jobs.list(ANYBODY, JobFilter(order="name")), repeats // 10)
    repeat("submit", lambda: jobs.submit(ANYBODY, {"log": file_id, "map": None}))
    repeat("claim", lambda: leases.claim("bench:1"))
    seq, before = 0, time.time() - 30 * 86400.0

    def delete() -> None:
        nonlocal seq
        seq = house._delete_jobs(before, seq) or 0

    repeat("retention, one batch", delete)
    storage.close()
    return times


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--jobs", type=int, default=100_000)
    parser.add_argument("--repeats", type=int, default=200)
    parser.add_argument("--only", choices=("sqlite", "postgresql"))
    arguments = parser.parse_args()
    print(f"{arguments.jobs} jobs; load {os.getloadavg()[0]:.1f}")
    print("call                          database    p50 [ms]  p99 [ms]")
    with postgresql.running(fsync=True) as server, tempfile.TemporaryDirectory() as name:
        for kind in ("sqlite", "postgresql"):
            if arguments.only not in (None, kind):
                continue
            folder = Path(name) / kind
            (folder / "data").mkdir(parents=True)
            database = Database(folder / "bench.db" if kind == "sqlite" else server.new_database())
            file_id = fill(database, arguments.jobs)
            with database.write() as session:
                if kind == "postgresql":
                    session.execute(text("ANALYZE"))  # as autovacuum does; SQLite's is never run by the service
                assert session.scalar(select(func.count()).select_from(JobRow)) == arguments.jobs
            for call, times in measure(database, folder, file_id, arguments.repeats).items():
                late = statistics.quantiles(times, n=100)[98]
                mark = "" if late < GOAL_S else "  over 50 ms"
                print(f"{call:29} {kind:11} {1e3 * statistics.median(times):8.1f} {1e3 * late:9.1f}{mark}", flush=True)
            database.close()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

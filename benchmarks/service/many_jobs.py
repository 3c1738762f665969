"""How long common calls take with 100,000 jobs in the database, on SQLite and PostgreSQL; the goal is 50 ms at 99 %.

Nine of ten jobs have ended long ago, with results and events; a hundred wait. The calls are those of the repositories,
without HTTP. What cannot be below 50 ms for its size, such as the count of all matches of a search, is measured too.
Besides the time of the clock, which is that of a busy machine and of its disk, the processor time of the caller is
given, and that of PostgreSQL.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
import time
import uuid
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

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


class Times(NamedTuple):
    """Of the calls of one kind [s]: by the clock, by the processor for the caller, and that of PostgreSQL for all."""

    clock: list[float]
    processor: list[float]
    server: list[float]


def server_s() -> float:
    """Processor time of all PostgreSQL on this machine, with that of connections that have ended [s]."""
    found = 0.0
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            name, _, rest = path.read_text().partition(") ")
            if name.endswith("(postgres"):
                found += sum(map(int, rest.split()[11:15])) / os.sysconf("SC_CLK_TCK")
    return found


def measure(database: Database, folder: Path, file_id: str, repeats: int) -> dict[str, Times]:
    """Times of each call."""
    chosen = settings(folder, max_queued=10**6, retention_s=30 * 86400.0)
    storage = Storage(chosen.data)
    jobs, stores = Jobs(database, storage, chosen), ResultStores(storage, chosen)
    house = Housekeeping(database, storage, chosen, DeletionQueue(database, storage, stores, 30.0))
    leases = Leases(database, 30.0)
    times: dict[str, Times] = {}

    def repeat(name: str, work: Callable[[], object], count: int = repeats) -> None:
        found = times.setdefault(name, Times([], [], []))
        of_server = server_s()
        for _ in range(count):
            begin, used = time.perf_counter(), time.thread_time()
            work()
            found.clock.append(time.perf_counter() - begin)
            found.processor.append(time.thread_time() - used)
        found.server.append((server_s() - of_server) / count)

    newest = jobs.list(ANYBODY, JobFilter(), limit=1)[0].seq
    repeat("list, newest 50", lambda: jobs.list(ANYBODY, JobFilter()))
    repeat("list, 50 from the middle", lambda: jobs.list(ANYBODY, JobFilter(), before=newest // 2))
    repeat("list, queued", lambda: jobs.list(ANYBODY, JobFilter(state="queued")))
    repeat("count of all", lambda: jobs.count(ANYBODY, JobFilter()))
    repeat("list, search", lambda: jobs.list(ANYBODY, JobFilter(search="run-99")))
    repeat("list, by name", lambda: jobs.list(ANYBODY, JobFilter(order="name")))
    repeat("submit", lambda: jobs.submit(ANYBODY, {"log": file_id, "map": None}))
    repeat("claim", lambda: leases.claim("bench:1"))
    last, before = (0.0, 0), time.time() - 30 * 86400.0

    def delete() -> None:
        nonlocal last
        last = house._delete_jobs(before, last) or (0.0, 0)

    repeat("retention, one batch", delete)
    repeat("retention, nothing old", lambda: house._delete_jobs(before - OLD_S, (0.0, 0)))
    storage.close()
    return times


def late(times: list[float]) -> float:
    """What 99 % keep."""
    return statistics.quantiles(times, n=100)[98]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--jobs", type=int, default=100_000)
    parser.add_argument("--repeats", type=int, default=200)
    parser.add_argument("--only", choices=("sqlite", "postgresql"))
    arguments = parser.parse_args()
    print(f"{arguments.jobs} jobs; load {os.getloadavg()[0]:.1f}")
    print(f"{'':41}{'clock p50, p99':>18}{'processor p50, p99':>20}{'server':>8} [ms]")
    with postgresql.running(fsync=True) as server, tempfile.TemporaryDirectory() as name:
        for kind in ("sqlite", "postgresql"):
            if arguments.only not in (None, kind):
                continue
            folder = Path(name) / kind
            (folder / "data").mkdir(parents=True)
            database = Database(folder / "bench.db" if kind == "sqlite" else server.new_database())
            file_id = fill(database, arguments.jobs)
            if kind == "postgresql":  # as autovacuum does; SQLite's ANALYZE is never run by the service
                with database._engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
                    connection.execute(text("VACUUM ANALYZE"))
            with database.read() as session:
                assert session.scalar(select(func.count()).select_from(JobRow)) == arguments.jobs
            for call, times in measure(database, folder, file_id, arguments.repeats).items():
                values = [1e3 * each for found in times[:2] for each in (statistics.median(found), late(found))]
                mark = "" if late(times.clock) < GOAL_S else "  over 50 ms"
                values.append(1e3 * times.server[0] if kind == "postgresql" else 0.0)
                print(f"{call:29} {kind:11}" + "{:9.1f}{:9.1f}{:11.1f}{:9.1f}{:8.1f}".format(*values), mark, flush=True)
            database.close()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

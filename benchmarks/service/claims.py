"""How fast workers take jobs from one database: N threads claim and end jobs that do nothing, or sleep."""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import threading
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "support"))
import postgresql
from sqlalchemy import insert, select

from hsloc_service.db.database import Database
from hsloc_service.db.tables import JobRow
from hsloc_service.jobs.leases import Leases

TENANTS = 4


def fill(database: Database, count: int) -> None:
    """Waiting jobs of several tenants."""
    rows = [
        {
            "seq": k + 1,
            "id": f"job-{k}",
            "tenant": f"tenant-{k % TENANTS}",
            "file_id": "",
            "log_name": "",
            "request": {"log": ""},
            "state": "queued",
            "created": time.time(),
            "attempt": 0,
            "cancel": False,
            "bytes": 0,
        }
        for k in range(count)
    ]
    with database.write() as session:
        session.execute(insert(JobRow), rows)


def measure(databases: list[Database], workers: int, count: int, sleep_s: float = 0.0) -> tuple[float, list[float]]:
    """Jobs per second, and the time of each claim [s]. A claim that finds nothing, while jobs wait, is tried again."""
    database = databases[0]
    fill(database, count)
    times = list[float]()

    def run(name: str, database: Database) -> None:
        leases = Leases(database, 30.0)
        while True:
            begin = time.perf_counter()
            claim = leases.claim(name)
            if claim is None:
                with database.read() as session:
                    if session.scalar(select(JobRow.seq).where(JobRow.state == "queued").limit(1)) is None:
                        return
                continue
            times.append(time.perf_counter() - begin)
            time.sleep(sleep_s)
            leases.fail(claim, "failed", "none", "")

    threads = [threading.Thread(target=run, args=(f"w:{k}", databases[k % len(databases)])) for k in range(workers)]
    begin = time.perf_counter()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return len(times) / (time.perf_counter() - begin), times


def sleeping(jobs: int, sleep_s: float) -> int:
    """How the throughput grows with the workers: a job takes `sleep_s` wherever it runs."""
    print("workers  jobs/s  of the ideal  claim p50 [ms]  p99 [ms]")
    with postgresql.running(fsync=True) as server:
        for workers in (1, 2, 4, 8, 16, 32, 64):
            url = server.new_database()
            # A process has up to 16 connections: with one for 64 threads they would wait for each other.
            databases = [Database(url) for _ in range((workers + 7) // 8)]
            rate, times = measure(databases, workers, jobs * workers, sleep_s)
            for database in databases:
                database.close()
            middle, late = statistics.median(times), statistics.quantiles(times, n=100)[98]
            share = rate * sleep_s / workers
            print(f"{workers:7} {rate:7.1f} {share:13.0%} {1e3 * middle:15.1f} {1e3 * late:9.1f}", flush=True)
    return 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--jobs", type=int, default=400)
    parser.add_argument(
        "--sleep-s",
        type=float,
        help="Jobs that sleep so long, one to 64 workers on PostgreSQL; --jobs is for each worker.",
    )
    arguments = parser.parse_args()
    if arguments.sleep_s is not None:
        return sleeping(arguments.jobs, arguments.sleep_s)
    print("database    workers  jobs/s  claim p50 [ms]  p99 [ms]")
    with postgresql.running(fsync=True) as server, tempfile.TemporaryDirectory() as folder:
        for name in ("sqlite", "postgresql"):
            for workers in (1, 4, 16, 64):
                path = Path(folder) / f"{workers}.db"
                database = Database(path if name == "sqlite" else server.new_database())
                rate, times = measure([database], workers, arguments.jobs)
                database.close()
                middle, late = statistics.median(times), statistics.quantiles(times, n=100)[98]
                print(f"{name:11} {workers:7} {rate:7.0f} {1e3 * middle:15.1f} {1e3 * late:9.1f}", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

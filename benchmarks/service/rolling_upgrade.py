"""A rolling upgrade: a server and a worker of an older hsloc go on beside those of this one, on one PostgreSQL.

`--old` is a checkout of the older version: `git worktree add /tmp/old v0.2.0`.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "support"))
import postgresql
from rig import Server, Worker, kill_all

from hsloc.client import Client

ROOT = Path(__file__).parents[2]


def of(tree: Path) -> dict[str, str]:
    """Variables by which a process runs the code of a checkout."""
    fake = tree / "tests" / "service" / "fake_worker.py"
    return {"PYTHONPATH": f"{tree}:{tree}/service", "HSLOC_WORKER_COMMAND": f"{sys.executable},-P,{fake}"}


def submit(client: Client, folder: Path, count: int, seconds: float = 0.3) -> list[str]:
    log, ids = folder / "run.mcap", []
    for k in range(count):
        log.write_bytes(f"slow {seconds} {k} ".encode() + os.urandom(1000))
        ids.append(client.submit(client.upload(log), seed=k)["id"])
    return ids


def ends(client: Client, ids: list[str]) -> set[str]:
    return {client.wait(job)["state"] for job in ids}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--old", type=Path, required=True, help="Checkout of the older version.")
    old, new = of(parser.parse_args().old.resolve()), of(ROOT)
    folder = Path(tempfile.mkdtemp(prefix="hsloc-rolling-"))
    found: dict[str, set[str]] = {}
    with postgresql.running() as database:
        shared = {
            "HSLOC_DATABASE_URL": database.new_database(),
            "HSLOC_STORE_URL": f"file://{folder}/store",
            "HSLOC_LEASE_S": "8",
            "HSLOC_HEARTBEAT_S": "1",
        }
        servers = [Server(folder / f"s{k}", **shared, HSLOC_SLOTS="0", **code) for k, code in enumerate((old, new))]
        workers = [Worker(folder / f"w{k}", **shared, HSLOC_SLOTS="1", **code) for k, code in enumerate((old, new))]
        before, after = (Client(server.url) for server in servers)
        try:
            servers[0].start()
            workers[0].start()
            found["old alone"] = ends(before, submit(before, folder, 4))
            servers[1].start()
            ids = submit(after, folder, 3) + submit(before, folder, 3)
            found["both servers, old worker"] = ends(before, ids)
            workers[1].start()
            ids = submit(after, folder, 6) + submit(before, folder, 6)
            found["both servers, both workers"] = ends(after, ids)
            (slow,) = submit(after, folder, 1, 60.0)
            time.sleep(2.0)
            before.cancel(slow)
            found["cancelled at the old server"] = ends(after, [slow])
            for each in (workers[0], servers[0]):
                each.end()
            found["new alone"] = ends(after, submit(after, folder, 3))
        finally:
            kill_all(*servers, *workers)
    for name, states in found.items():
        print(f"{name}: {states}")
    cancelled = found.pop("cancelled at the old server")
    return 0 if cancelled == {"cancelled"} and all(states == {"succeeded"} for states in found.values()) else 1


if __name__ == "__main__":
    raise SystemExit(main())

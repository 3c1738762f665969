"""300 jobs are submitted while the server and the jobs' processes are killed with -9, 100 times in all.

Afterwards: every accepted job has ended exactly once, its results are right and there once, every upload is whole, and
no process is left.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import random
import shutil
import signal
import sqlite3
import tempfile
import threading
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

from rig import Server, jobs_processes

from hsloc.client import Client, ClientError


def submit_all(url: str, count: int, seed: int, accepted: dict[str, tuple[int, str]], done: threading.Event) -> None:
    """Upload and submit, as a client that tries again; one in ten is cancelled soon after."""
    rng = random.Random(seed)
    client = Client(url, attempts=200, timeout_s=10.0, block=20_000)
    for k in range(count):
        path = Path(tempfile.gettempdir()) / f"chaos-{os.getpid()}-{seed}.mcap"
        path.write_bytes(f"slow {rng.uniform(0.05, 0.6):.3f} {k} ".encode() + rng.randbytes(50_000))
        log = client.upload(path)
        number = seed * 100_000 + k
        job = client.submit(log, seed=number)
        accepted[job["id"]] = (number, hashlib.sha256(path.read_bytes()).hexdigest())
        if rng.random() < 0.1:
            with suppress(ClientError):
                client.cancel(job["id"])
        path.unlink()
        time.sleep(rng.uniform(0.0, 0.6))
    done.set()


def kill_things(server: Server, kills: int, rng: random.Random) -> Counter[str]:
    """Kill the server or a job's process, at random times; the server is started again."""
    counted: Counter[str] = Counter()
    while sum(counted.values()) < kills:
        time.sleep(rng.uniform(0.05, 1.0))
        pids = jobs_processes(server.data)
        if pids and rng.random() < 0.5:
            with suppress(ProcessLookupError):
                os.kill(rng.choice(pids), signal.SIGKILL)
                counted["job process"] += 1
        else:
            server.end(signal.SIGKILL)
            counted["server"] += 1
            server.start()
    return counted


def judge(data: Path, accepted: dict[str, tuple[int, str]]) -> list[str]:
    """What is wrong; nothing, if all is well."""
    wrong: list[str] = []
    with sqlite3.connect(data / "hsloc.db") as base:
        if base.execute("pragma integrity_check").fetchone() != ("ok",):
            wrong.append("the database is damaged")
        jobs = dict(base.execute("select id, state from job"))
        ends = Counter(
            job
            for (job,) in base.execute(
                "select job_id from event where kind='state' and json_extract(data,'$.state') in "
                "('succeeded','failed','crashed','cancelled')"
            )
        )
        folders = dict(base.execute("select id, folder from job where folder is not null"))
        files = dict(base.execute("select id, sha256 from file where state='complete'"))
        logs = dict(base.execute("select id, file_id from job"))
    for job, (number, digest) in accepted.items():
        if job not in jobs:
            wrong.append(f"{job}: lost")
        elif ends[job] != 1:
            wrong.append(f"{job}: ended {ends[job]} times, is {jobs[job]}")
        elif files.get(logs[job]) != digest or sha256(data / "uploads" / logs[job]) != digest:
            wrong.append(f"{job}: its upload is not what was sent")
        elif jobs[job] == "succeeded":
            text = (data / "results" / folders[job] / "trajectory.tum").read_text()
            if not text.startswith(f"{number} "):
                wrong.append(f"{job}: has the results of another")
    if len(jobs) != len(accepted):
        wrong.append(f"{len(jobs)} jobs in the database, {len(accepted)} accepted")
    there = {path.name for path in (data / "results").iterdir()}
    if there != set(folders.values()):
        wrong.append(f"{len(there)} folders of results, {len(folders)} jobs that succeeded")
    if list((data / "work").iterdir()):
        wrong.append("folders of attempts are left")
    if left := jobs_processes(data):
        wrong.append(f"processes are left: {left}")
    return wrong


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--jobs", type=int, default=300)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="hsloc-chaos-"))
    begin = time.monotonic()
    server = Server(folder / "data", HSLOC_SLOTS="3", HSLOC_MAX_ATTEMPTS="60", HSLOC_MAX_QUEUED="1000").start()
    accepted: dict[str, tuple[int, str]] = {}
    flags = [threading.Event() for _ in range(3)]
    for k, flag in enumerate(flags):
        work = (server.url, arguments.jobs // len(flags), arguments.seed * 10 + k, accepted, flag)
        threading.Thread(target=submit_all, args=work, daemon=True).start()
    counted = kill_things(server, arguments.kills, random.Random(arguments.seed))
    for flag in flags:
        flag.wait(300.0)
    client = Client(server.url)
    states = Counter(client.wait(job)["state"] for job in accepted)
    attempts = Counter(client.job(job)["attempt"] for job in accepted)
    server.end()
    # One more start and stop: what a killed server left behind is swept at the start.
    server.start()
    server.end()
    wrong = judge(folder / "data", accepted)
    print(f"{len(accepted)} jobs accepted; killed with -9: {dict(counted)}; {time.monotonic() - begin:.0f} s")
    print(f"states: {dict(states)}; attempts: {dict(sorted(attempts.items()))}")
    print("\n".join(wrong) or "nothing lost, nothing twice, no process left")
    if not wrong:
        shutil.rmtree(folder)
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())

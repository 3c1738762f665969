"""Jobs on two servers and several workers that share a PostgreSQL and a store, while all of them are mistreated.

At random: kill -9 of workers, servers and jobs' processes, a worker that stands still for longer than its lease and
comes back, a restart of PostgreSQL. With `--network` (as root) each server and worker is a network namespace of its
own, and the store is S3 (moto's server): then a worker or server is cut off from the network for longer than a lease,
the store is away for a minute, and a clock is set an hour forward, PostgreSQL's among them. With `--real N` each N-th
job is the real localiser's, whose results must have the SHA-256 of those of `hsloc replay`; the others sleep.
Afterwards: every accepted job has ended exactly once, its results are right and there once, every upload is whole,
every webhook came, and no process is left.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from contextlib import ExitStack, closing, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "support"))
import postgresql
from network import S3, Clock, Machine, Network
from rig import FAKE_WORKER, Server, Worker, jobs_processes, kill_all
from sqlalchemy import select

from hsloc.client import Client, ClientError
from hsloc_service.db.database import Database
from hsloc_service.db.tables import AssetRow, EventRow, FileRow, JobRow
from hsloc_service.results.stores import ObjectStore
from hsloc_service.results.upload_parts import UploadParts

ENDS = ("succeeded", "failed", "crashed", "cancelled")
LEASE_S = 4.0
"""By default; a busy machine needs more, or jobs are requeued because nothing is scheduled."""
HOUR_S = 3600
AWAY_S = 60.0
"""Time for which the store cannot be reached."""
RECORDING = Path(__file__).parents[2] / "recordings" / "paper.mcap"
END_S = 1.0
"""How much of the recording a job of the real localiser reads [s]: most of its time is that of any start."""
SEEDS = (1, 2, 3)
COMPARED = ("trajectory.tum", "odometry.tum", "reference.tum", "states.csv", "metrics.json", "report.png")
"""Results without wall times and without the command line, which names the caller's files."""


class Fleet:
    def __init__(
        self,
        folder: Path,
        database: postgresql.Server,
        workers: int,
        lease_s: float,
        network: Network | None,
        store: S3 | None,
        clock: Clock | None,
    ) -> None:
        self.lease_s = lease_s
        self.folder, self.database, self.url = folder, database, database.new_database()
        self.store = f"file://{folder}/store" if store is None else "s3://fleet/jobs"
        self.s3, self.clock = store, clock
        shared = {
            "HSLOC_DATABASE_URL": self.url,
            "HSLOC_STORE_URL": self.store,
            "HSLOC_LEASE_S": str(lease_s),
            "HSLOC_HEARTBEAT_S": "0.5",
            "HSLOC_MAX_ATTEMPTS": "60",
            "HSLOC_MAX_QUEUED": "10000",
            "HSLOC_WEBHOOK_PRIVATE": "1",
            "HSLOC_WEBHOOK_ATTEMPTS": "50",
            "HSLOC_WEBHOOK_BACKOFF_S": "0.2",
            "HSLOC_STORE_TIMEOUT_S": "10",
            "HSLOC_WORKER_COMMAND": f"{sys.executable},-P,{Path(__file__).with_name('mixed_worker.py')},{FAKE_WORKER}",
            **({} if store is None else store.variables),
        }
        machines = [None if network is None else network.machine() for _ in range(2 + workers)]
        variables = [shared if each is None else shared | each.clock.variables for each in machines]
        self.servers = [
            Server(folder / f"s{k}", machine=machines[k], HSLOC_SLOTS="0", **variables[k]).start() for k in range(2)
        ]
        self.workers = [
            Worker(folder / f"w{k}", machine=machines[2 + k], HSLOC_SLOTS="2", **variables[2 + k]).start()
            for k in range(workers)
        ]

    def folders(self) -> list[Path]:
        return [each.data for each in (*self.servers, *self.workers)]

    def mistreat(self, rng: random.Random) -> str:
        """Do one thing to one of them; what it was."""
        for each in (*self.servers, *self.workers):
            if each.process is not None and each.process.poll() is not None:
                each.start()  # as the system's manager of services does: it was started while PostgreSQL was away
        kinds = {"worker": 40, "job process": 30, "server": 20, "stop": 7, "database": 3}
        if self.s3 is not None:
            kinds |= {"cut worker": 12, "cut server": 4, "store": 4, "clock": 3, "clock of the database": 2}
        kind = rng.choices(list(kinds), list(kinds.values()))[0]
        if kind == "job process":
            pids = [pid for folder in self.folders() for pid in jobs_processes(folder)]
            if not pids:
                return self.mistreat(rng)
            with suppress(ProcessLookupError):
                os.kill(rng.choice(pids), signal.SIGKILL)
        elif kind == "server":
            server = rng.choice(self.servers)
            server.end(signal.SIGKILL)
            server.start()
        elif kind in ("cut worker", "cut server"):
            self.cut(rng.choice(self.workers if kind == "cut worker" else self.servers).machine)
        elif kind == "store":
            self.cut(None if self.s3 is None else self.s3.machine, AWAY_S)
        elif kind == "clock":
            machine = rng.choice((*self.servers, *self.workers)).machine
            assert machine is not None
            machine.clock.set_forward(HOUR_S)
        elif kind == "clock of the database":
            assert self.clock is not None
            self.clock.set_forward(HOUR_S)
        elif kind == "database":
            self.database.stop("immediate")
            time.sleep(rng.uniform(0.0, 2.0))
            self.database.start()
        else:
            worker = rng.choice(self.workers)
            if kind == "stop":
                assert worker.process is not None
                worker.process.send_signal(signal.SIGSTOP)
                time.sleep(1.5 * self.lease_s)
                worker.process.send_signal(signal.SIGCONT)
            else:
                worker.end(signal.SIGKILL)
                worker.start()
        return kind

    def cut(self, machine: Machine | None, seconds: float = 0.0) -> None:
        """A machine without network for longer than a lease."""
        assert machine is not None
        machine.cut()
        time.sleep(max(1.5 * self.lease_s, seconds))
        machine.join()


class Receiver(ThreadingHTTPServer):
    """Counts webhooks by their event's id."""

    def __init__(self, address: str) -> None:
        super().__init__((address, 0), Handler)
        self.jobs: dict[str, str] = {}
        self.count: Counter[str] = Counter()


class Handler(BaseHTTPRequestHandler):
    server: Receiver

    def do_POST(self) -> None:
        body = json.loads(self.rfile.read(int(self.headers["content-length"])))
        self.server.count[body["event_id"]] += 1
        self.server.jobs[body["event_id"]] = body["job"]
        self.send_response(200)
        self.end_headers()

    def log_message(self, *_: object) -> None:
        pass


def of_the_command_line(folder: Path) -> dict[int, dict[str, str]]:
    """SHA-256 of the results of `hsloc replay` for each seed, by their names."""
    shutil.copy(RECORDING, folder)
    found = {}
    for seed in SEEDS:
        command = [sys.executable, "-m", "hsloc.cli.main", "replay", RECORDING.name, "-q", "--end", str(END_S)]
        subprocess.run([*command, "--seed", str(seed), "--out", f"cli-{seed}"], check=True, cwd=folder)
        paths = [folder / f"cli-{seed}" / name for name in COMPARED]
        found[seed] = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}
    return found


def submit_all(
    client: Client, numbers: range, real: int, hook: str, accepted: dict[str, tuple[int, str]], until: float
) -> None:
    """Upload and submit, as a client that tries again; one in ten is cancelled soon after.

    A job of the real localiser is known by its number, which is one of SEEDS.
    """
    rng = random.Random(numbers[0])
    path = Path(tempfile.gettempdir()) / f"fleet-{os.getpid()}-{numbers[0]}.mcap"
    for number in numbers:
        if time.monotonic() > until:
            break
        log, seed, more = path, number, {}
        if real and number % real == 0:
            log, seed, more = RECORDING, rng.choice(SEEDS), {"read": {"end_s": END_S}}
        else:
            path.write_bytes(f"slow {rng.uniform(0.5, 3.0):.3f} {number} ".encode() + rng.randbytes(50_000))
        job = client.submit(client.upload(log), seed=seed, webhook=hook, **more)
        accepted[job["id"]] = (seed, hashlib.sha256(log.read_bytes()).hexdigest())
        if rng.random() < 0.1:
            with suppress(ClientError):
                client.cancel(job["id"])
        time.sleep(rng.uniform(0.0, 0.6))
    path.unlink(missing_ok=True)


def judge(
    fleet: Fleet, accepted: dict[str, tuple[int, str]], receiver: Receiver, expected: dict[int, dict[str, str]]
) -> list[str]:
    """What is wrong; nothing, if all is well. `expected`: SHA-256 of the command line's results for each seed."""
    wrong: list[str] = []
    database = Database(fleet.url)
    results, uploads = ObjectStore(fleet.store, "results"), ObjectStore(fleet.store, "uploads")
    parts = UploadParts(database, uploads, 30.0)
    with database.read() as session:
        jobs = {job.id: job for job in session.scalars(select(JobRow))}
        files = {row.id: row for row in session.scalars(select(FileRow))}
        events: list[Any] = list(session.scalars(select(EventRow).where(EventRow.kind == "state")))
        assets = list(session.scalars(select(AssetRow)))
    ends = Counter(event.job_id for event in events if event.data["state"] in ENDS)
    for job_id, (number, digest) in accepted.items():
        job = jobs.get(job_id)
        if job is None:
            wrong.append(f"{job_id}: lost")
        elif ends[job_id] != 1 or job.state not in ENDS:
            wrong.append(f"{job_id}: ended {ends[job_id]} times, is {job.state}")
        elif files[job.file_id].sha256 != digest or parts.hash(job.file_id)[1] != digest:
            wrong.append(f"{job_id}: its upload is not what was sent")
        elif job.state == "succeeded":
            own = [each for each in assets if each.job_id == job_id]
            if missing := {"trajectory.tum", *expected.get(number, ())} - {each.name for each in own}:
                wrong.append(f"{job_id}: lacks {', '.join(sorted(missing))}")
            for asset in own:
                content = results.read(job.folder or "", asset.name, 0, asset.size)
                if hashlib.sha256(content).hexdigest() != asset.sha256:
                    wrong.append(f"{job_id}: {asset.name} is not what its manifest says")
                if number in SEEDS:
                    if expected[number].get(asset.name, asset.sha256) != asset.sha256:
                        wrong.append(f"{job_id}: {asset.name} is not that of the command line")
                elif asset.name == "trajectory.tum" and not content.startswith(f"{number} ".encode()):
                    wrong.append(f"{job_id}: has the results of another")
    folders = {job.folder for job in jobs.values() if job.folder is not None}
    if set(jobs) != set(accepted):
        wrong.append(f"{len(jobs)} jobs in the database, {len(accepted)} accepted")
    if set(results.names()) != folders:
        wrong.append(f"{len(results.names())} folders of results, {len(folders)} jobs that succeeded")
    if set(receiver.jobs.values()) != set(accepted) or len(receiver.jobs) != len(accepted):
        wrong.append(f"{len(receiver.jobs)} webhooks for {len(accepted)} jobs")
    for folder in fleet.folders():
        if left := jobs_processes(folder):
            wrong.append(f"processes are left: {left}")
        if list((folder / "work").iterdir()):
            wrong.append(f"{folder.name}: folders of attempts are left")
    database.close()
    return wrong


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--jobs", type=int, default=100)
    parser.add_argument("--kills", type=int, default=60)
    parser.add_argument("--workers", type=int, default=3)
    parser.add_argument("--lease-s", type=float, default=LEASE_S)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=60.0, help="Time to submit and mistreat, at most.")
    parser.add_argument("--network", action="store_true", help="Network namespaces and S3; needs root and moto.")
    parser.add_argument("--clients", type=int, default=2)
    parser.add_argument("--real", type=int, default=0, metavar="N", help="Each N-th job is the real localiser's.")
    arguments = parser.parse_args()
    folder, rng = Path(tempfile.mkdtemp(prefix="hsloc-fleet-")), random.Random(arguments.seed)
    accepted: dict[str, tuple[int, str]] = {}
    expected = of_the_command_line(folder) if arguments.real else {}
    with ExitStack() as stack:
        network = store = clock = None
        if arguments.network:
            network = stack.enter_context(closing(Network(folder)))
            store = stack.enter_context(closing(S3(network.machine(), folder / "s3.log")))
            os.environ |= store.variables  # what is judged is read by this process
            clock = Clock(Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="hsloc-clock-"))) / "database")
            clock.path.parent.chmod(0o755)
        address = "" if network is None else network.address
        receiver = Receiver(address or "127.0.0.1")
        threading.Thread(target=receiver.serve_forever, daemon=True).start()
        hook = f"http://{address or '127.0.0.1'}:{receiver.server_port}/"
        variables = {} if clock is None else clock.variables
        database = stack.enter_context(postgresql.running(address=address, variables=variables))
        fleet = Fleet(folder, database, arguments.workers, arguments.lease_s, network, store, clock)
        stack.callback(kill_all, *fleet.servers, *fleet.workers)
        begin = time.monotonic()
        until = begin + 60.0 * arguments.minutes
        clients = []
        first = 100_000 * arguments.seed
        for k in range(arguments.clients):
            client = Client(fleet.servers[k % 2].url, attempts=300, timeout_s=10.0, block=20_000)
            client.request("GET", "/healthz")  # a server that never answered is given up sooner
            numbers = range(first + k, first + arguments.jobs, arguments.clients)
            work = (client, numbers, arguments.real, hook, accepted, until)
            clients.append(threading.Thread(target=submit_all, args=work, daemon=True))
            clients[-1].start()
        done: Counter[str] = Counter()
        while sum(done.values()) < arguments.kills and time.monotonic() < until:
            time.sleep(rng.uniform(0.05, 1.5))
            done[fleet.mistreat(rng)] += 1
        for thread in clients:
            thread.join()
        client = Client(fleet.servers[0].url, attempts=300, timeout_s=10.0)
        states = Counter(client.wait(job)["state"] for job in list(accepted))
        attempts = Counter(client.job(job)["attempt"] for job in accepted)
        seconds = time.monotonic() - begin
        deadline = time.monotonic() + 60.0
        while len(receiver.jobs) < len(accepted) and time.monotonic() < deadline:
            time.sleep(0.2)
        for each in (*fleet.workers, *fleet.servers):
            each.end()
        # One more start and stop: what killed ones left behind is swept in a server's first round.
        for server in fleet.servers:
            server.start()
        time.sleep(3.0)
        for server in fleet.servers:
            server.end()
        for worker in fleet.workers:
            worker.start()
        time.sleep(5.0)
        for worker in fleet.workers:
            worker.end()
        wrong = judge(fleet, accepted, receiver, expected)
    real = sum(number in SEEDS for number, _ in accepted.values())
    print(f"{len(accepted)} of {arguments.jobs} jobs accepted, {real} with the real localiser; {seconds:.0f} s")
    print(f"{sum(done.values())} mishaps: {dict(done)}")
    print(f"states: {dict(states)}; attempts: {dict(sorted(attempts.items()))}")
    print(f"webhooks: {len(receiver.count)} events, {sum(receiver.count.values()) - len(receiver.count)} sent again")
    print("\n".join(wrong) or "nothing lost, nothing twice, no process left")
    if not wrong:
        shutil.rmtree(folder)
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())

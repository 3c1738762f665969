"""50 clients poll while 2 jobs of the real localiser run: how long the API takes."""

from __future__ import annotations

import argparse
import http.client
import json
import shutil
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path

from rig import Server

from hsloc.client import Client

RECORDINGS = Path(__file__).parents[2] / "recordings"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clients", type=int, default=50)
    parser.add_argument("--every", type=float, default=1.0, help="seconds between two polls of a client")
    parser.add_argument("--seconds", type=float, default=20.0)
    arguments = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="hsloc-load-"))
    server = Server(folder / "data", real=True, HSLOC_SLOTS="2").start()
    client = Client(server.url)
    log = client.upload(RECORDINGS / "office.mcap")
    jobs = [client.submit(log, seed=k)["id"] for k in range(40)]
    stop, waits, codes = threading.Event(), [], Counter[int]()
    threads = [
        threading.Thread(target=poll, args=(server.port, jobs, k, arguments, stop, waits, codes))
        for k in range(arguments.clients)
    ]
    for thread in threads:
        thread.start()
    time.sleep(arguments.seconds)
    stop.set()
    for thread in threads:
        thread.join()
    states = Counter(client.job(job)["state"] for job in jobs)
    for job in jobs:
        client.cancel(job)
    memory = server.memory_mib(peak=True)
    server.end()
    shutil.rmtree(folder)
    waits.sort()
    at = [1e3 * waits[min(int(len(waits) * part), len(waits) - 1)] for part in (0.5, 0.9, 0.99, 1.0)]
    print(
        f"{arguments.clients} clients, a poll each {arguments.every} s, 2 jobs at a time; "
        f"jobs meanwhile: {dict(states)}"
    )
    print(f"{len(waits)} requests, answers {dict(codes)}; server's memory at its peak {memory:.0f} MiB")
    print("median {:.0f} ms, p90 {:.0f} ms, p99 {:.0f} ms, longest {:.0f} ms".format(*at))
    return 0 if at[2] < 100.0 else 1


def poll(
    port: int,
    jobs: list[str],
    number: int,
    arguments: argparse.Namespace,
    stop: threading.Event,
    waits: list[float],
    codes: Counter[int],
) -> None:
    line = http.client.HTTPConnection("127.0.0.1", port, timeout=30.0)
    stop.wait(arguments.every * number / arguments.clients)
    paths = (f"/v1/jobs/{jobs[number % len(jobs)]}", "/v1/jobs?limit=20", "/healthz")
    for k in range(10_000):
        begin = time.monotonic()
        line.request("GET", paths[k % len(paths)])
        with line.getresponse() as answer:
            body = answer.read()
        waits.append(time.monotonic() - begin)
        codes[answer.status] += 1
        json.loads(body)
        if stop.wait(arguments.every):
            return


if __name__ == "__main__":
    raise SystemExit(main())

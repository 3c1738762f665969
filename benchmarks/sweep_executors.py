"""One sweep three ways: in one process, on Dask while a worker is killed, and in shards of which one is done twice.

    python benchmarks/sweep_executors.py [--seeds N] [--end S]

Two logs with N seeds each. The tables have to be the same but for the columns of times, and so have all files of all
runs, byte for byte, but for timings.json. Exit code 1 if they are not.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LOGS = ("office.mcap", "kidnapped.mcap")
TIMES = ("seconds", "times_real_time")
SHARDS = 4


def hsloc(*words: str, check: bool = True) -> None:
    command = [sys.executable, "-m", "hsloc.cli.main", *words]
    subprocess.run(command, cwd=ROOT / "recordings", check=check, stdout=subprocess.DEVNULL)


def on_dask(words: list[str], folder: Path, runs: int) -> str:
    """The sweep on a scheduler with two workers, one of which is killed when a third of the runs are done."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    host, port = address.split(":")
    environment = {**os.environ, "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "10"}

    def dask(*words: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "dask", *words, "--no-dashboard"]
        return subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    started = [dask("scheduler", "--host", host, "--port", port)]
    try:
        time.sleep(3.0)
        for k in range(2):
            place = ("--local-directory", str(folder.parent / f"worker{k}"))
            started.append(dask("worker", f"tcp://{address}", "--nthreads", "1", "--no-nanny", *place))
        command = [sys.executable, "-m", "hsloc.cli.main", *words, "--out", str(folder)]
        command += ["--executor", f"dask://{address}"]
        sweep = subprocess.Popen(command, cwd=ROOT / "recordings", stdout=subprocess.DEVNULL)
        while sweep.poll() is None and len(list(folder.glob("*/timings.json"))) < runs // 3:
            time.sleep(0.05)
        done = len(list(folder.glob("*/timings.json")))
        os.kill(started[1].pid, signal.SIGKILL)
        assert sweep.wait() == 0
        return f"a worker killed after {done} of {runs} runs"
    finally:
        for process in started:
            process.kill()  # a worker whose scheduler has ended waits for another one
        for process in started:
            process.wait()


def in_shards(words: list[str], folder: Path) -> str:
    """The sweep in shards, the second of them twice."""
    for k in range(SHARDS):
        hsloc(*words, "--out", str(folder), "--shard", f"{k}/{SHARDS}")
    hsloc(*words, "--out", str(folder), "--shard", f"1/{SHARDS}")
    hsloc("sweep", "--merge", "--out", str(folder), "-q")
    return f"{SHARDS} shards, one of them twice"


def table(folder: Path) -> list[dict[str, object]]:
    """Without what depends on the machine; runs that were there already count as done."""
    found = json.loads((folder / "sweep.json").read_text())
    for row in found:
        for name in TIMES:
            del row[name]
        row["state"] = row["state"].replace("skipped", "done")
    return sorted(found, key=lambda row: str(row["run"]))


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of the files of all runs."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.glob("*/*"))
        if path.name != "timings.json"
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--end", type=float, default=3.0)
    arguments = parser.parse_args()
    runs = len(LOGS) * arguments.seeds
    words = ["sweep", *LOGS, "--seeds", f"0-{arguments.seeds - 1}", "--end", str(arguments.end), "-q"]
    same = True
    with tempfile.TemporaryDirectory() as name:
        one, dask, shards = (Path(name) / kind for kind in ("one", "dask", "shards"))
        begin = time.monotonic()
        hsloc(*words, "--out", str(one))
        print(f"one process: {runs} runs in {time.monotonic() - begin:.0f} s", flush=True)
        for folder in (dask, shards):
            begin = time.monotonic()
            text = on_dask(words, dask, runs) if folder is dask else in_shards(words, shards)
            seconds = time.monotonic() - begin
            theirs, ours = digests(folder), digests(one)
            equal = sum(theirs.get(path) == digest for path, digest in ours.items())
            is_table = table(folder) == table(one)
            same &= is_table and theirs == ours
            print(f"{text}: {seconds:.0f} s; the same table: {is_table}, the same files: {equal} of {len(ours)}")
    return 0 if same else 1


if __name__ == "__main__":
    raise SystemExit(main())

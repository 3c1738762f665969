"""A job's process that does what the first word of the log commands; runs like `hsloc_service.execution.worker`."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import sqlite3
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from hsloc_service.execution import limits

if TYPE_CHECKING:
    from collections.abc import Callable


def main() -> int:
    folder, fd, parent = Path(sys.argv[1]), int(sys.argv[3]), int(sys.argv[5])
    job = json.loads((folder / "job.json").read_text())
    limits.apply(job["limits"], parent)
    word, *rest = (folder / "input" / job["log"]).read_bytes()[:200].decode("latin-1").split() or ["ok"]

    def emit(line: dict[str, object]) -> None:
        os.write(fd, json.dumps(line).encode() + b"\n")

    if job["request"].get("inspect"):
        (folder / "output").mkdir()
        if word == "fifo":
            os.mkfifo(folder / "output" / "viewer.json")
        elif word == "hard-link":
            (folder / "secret").write_text("{}")
            os.link(folder / "secret", folder / "output" / "viewer.json")
            (folder / "output" / "viewer-map.png").write_bytes(b"picture")
        read = dict.fromkeys(("scan_topic", "odom_topic", "truth_topic", "initial_pose", "findings"))
        emit({"done": {"format": word, "duration_s": 1.0, "topics": [], "warnings": [], **read}})
        return 0
    if word == "ignore-term":
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        spawn_sleeper(new_session=False)
        spawn_sleeper(new_session=True)  # leaves the process group
    if word == "held" or (word == "held-first" and folder.name.endswith(".1")):
        hold(folder, emit)
    if word == "compiling":
        hold(folder, emit, "compile", 0)
    if word in ("slow", "ignore-term"):
        seconds = float(rest[0])
        begin = time.monotonic()
        while (done := time.monotonic() - begin) < seconds:
            emit({"phase": "replay", "part": done, "total": seconds, "scans": int(done * 10)})
            time.sleep(0.05)
    elif word == "allocate":
        kept = []
        try:
            while True:
                kept.append(bytearray(64 << 20))
        except MemoryError:
            emit({"failed": "out_of_memory", "message": "no memory"})
            return 1
    elif word == "spin":
        while True:
            pass
    elif word == "fill":
        for k in range(1000):
            (folder / f"junk{k}").write_bytes(bytes(4 << 20))
    elif word == "fill-one":
        with (folder / "junk").open("wb") as file:
            try:
                while True:
                    file.write(bytes(1 << 20))
                    file.flush()
            except OSError:
                emit({"failed": "output_limit", "message": "too much"})
                return 1
    elif word == "abort":
        os.abort()
    elif word == "exit":
        sys.stdout.write("last words\n")
        return int(rest[0])
    elif word == "lie":
        emit({"done": {}})
        return 0  # but there is no output
    elif word == "nonsense":
        os.write(fd, b"\x00\xff not json\n" + b"x" * (1 << 20))
        time.sleep(600)
    elif word == "mad":  # JSON, of which a part cannot be kept, or read by others
        for text in ("[" * 3000, '["done"]', '"failed"', "1" * 5000, "\xff", '{"phase": 1}'):
            os.write(fd, text.encode("latin-1") + b"\n")
        for part in ("NaN", "1e999", "-Infinity", '"x"', "[]"):
            os.write(fd, f'{{"phase": "\\ud800", "part": {part}, "total": 1, "scans": {part}}}\n'.encode())
        os.write(fd, b'{"phase": "replay", "part": 0.5, "total": 1, "scans": 123456789012345678901234567890}\n')
        os.write(fd, b'{"phase": "\\ud800", "part": 0.5, "total": 1, "scans": 7}\n')
        hold(folder, lambda _: None)
        os.write(fd, b'{"failed": "mad\\ud800", "message": "NaN: \\udcff"}\n')
        return 1
    elif word == "mad-end":
        (folder / "output").mkdir()
        os.write(fd, b'{"done": {"warnings": ["\\udcff"], "metrics": {"ape": [NaN, 1e999, 1.5]}}}\n')
        return 0
    elif word == "link":
        (folder / "output").symlink_to(rest[0])
        emit({"done": {}})
        return 0
    elif word == "silent":
        os.close(fd)
        time.sleep(600)
    elif word == "kill-self":
        os.kill(os.getpid(), signal.SIGKILL)
    elif word == "bad-input":
        emit({"failed": "invalid_input", "message": "run.mcap: no scan"})
        return 1
    output = folder / "output"
    output.mkdir()
    (output / "trajectory.tum").write_text(f"{job['request']['seed']} {rest}\n")
    (output / "metrics.json").write_text("{}\n")
    if word == "attack":
        (output / "report.json").write_text(json.dumps(attack(folder, rest)))
    if word == "nest":
        deep = folder
        for _ in range(int(rest[0])):
            (Path("d")).mkdir()
            os.chdir("d")
        os.chdir(deep)
    if word == "large":
        (output / "large.bin").write_bytes(os.urandom(1 << 20) * int(rest[0]))
    if word == "tricks":
        (output / "passwd").symlink_to("/etc/passwd")
        (output / "sub").mkdir()
        (output / "sub" / "x").write_text("x")
        (output / "<img src=x>").write_text("x")
    warning = {"code": "clocks_apart", "text": "the stamps are 3.0 s apart", "remedy": "check the clocks"}
    figure = {"name": "APE rmse", "values": ["1.23 cm", "0.45°"]}
    summary = {"metrics": {"verdict": "check"}, "figures": [figure], "warnings": [warning]}
    emit({"done": {**summary, "data_lost": False, "notes": [], "timings": {}}})
    return 0


def hold(folder: Path, emit: Callable[[dict[str, object]], None], phase: str = "replay", total: int = 10_000) -> None:
    """Go on when a test says so (`live_service.go_on`), with progress meanwhile."""
    scans = 0
    while not (folder / "go on").exists():
        scans += 1
        emit({"phase": phase, "part": scans, "total": total, "scans": scans})
        time.sleep(0.05)


def attack(folder: Path, rest: list[str]) -> dict[str, str]:
    """What a hostile job may try, and what came of it; `rest` is the port of the server and its process."""
    data, port, server = folder.parent.parent, int(rest[0]), rest[1]
    found = {}

    def attempt(name: str, work: Callable[[], object]) -> None:
        try:
            found[name] = f"done: {work()!r}"[:200]
        except (OSError, ValueError, sqlite3.Error) as error:
            found[name] = f"refused: {type(error).__name__}"

    def connect(kind: int, address: tuple[str, int]) -> None:
        with socket.socket(socket.AF_INET, kind) as line:
            line.settimeout(1.0)
            line.connect(address)
            line.send(b"x")

    def connect_to_a_file() -> None:
        with socket.socket(socket.AF_UNIX) as line:
            line.connect(str(data.parent / "line"))

    def write_database() -> None:
        with sqlite3.connect(f"file:{data / 'hsloc.db'}?mode=rw", uri=True) as database:
            database.execute("INSERT INTO secret VALUES ('planted', 'x')")

    attempt("read database", (data / "hsloc.db").read_bytes)
    attempt("write database", write_database)
    attempt("link database", lambda: os.link(data / "hsloc.db", folder / "output" / "stolen.db"))
    attempt("change permissions", lambda: (data / "hsloc.db").chmod(0o600))
    attempt("change times", lambda: os.utime(data / "hsloc.db"))
    attempt("list uploads", lambda: len(os.listdir(data / "uploads")) > 1 or os.listdir(data / "none"))
    attempt("write elsewhere", lambda: (data / "results" / "planted").write_text("x"))
    attempt("write input", lambda: next((folder / "input").iterdir()).write_bytes(b"changed"))
    attempt("read outside", (data.parent / "server.log").read_bytes)
    attempt("read password file", Path("/etc/passwd").read_bytes)
    attempt("environment of the server", lambda: b"PATH" in Path(f"/proc/{server}/environ").read_bytes() or 1 / 0)
    attempt("signal to the server", lambda: os.kill(int(server), 0))
    attempt("socket of another program", connect_to_a_file)
    attempt("tcp", lambda: connect(socket.SOCK_STREAM, ("127.0.0.1", port)))
    with contextlib.suppress(OSError):  # in a network of its own it arrives nowhere
        connect(socket.SOCK_DGRAM, ("127.0.0.1", int(rest[2])))
    return found


def spawn_sleeper(new_session: bool) -> None:
    subprocess.Popen(["sleep", "300"], start_new_session=new_session)


if __name__ == "__main__":
    sys.exit(main())

"""A job's process that does what the first word of the log says; runs like `hsloc_service.execution.worker`."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from hsloc_service.execution import limits


def main() -> int:
    folder, fd, parent = Path(sys.argv[1]), int(sys.argv[3]), int(sys.argv[5])
    job = json.loads((folder / "job.json").read_text())
    limits.apply(job["limits"], parent)
    word, *rest = (folder / "input" / job["log"]).read_bytes()[:200].decode("latin-1").split() or ["ok"]

    def tell(line: dict[str, object]) -> None:
        os.write(fd, json.dumps(line).encode() + b"\n")

    if word == "ignore-term":
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        spawn_sleeper(new_session=False)
        spawn_sleeper(new_session=True)  # leaves the process group
    if word in ("slow", "ignore-term"):
        seconds = float(rest[0])
        begin = time.monotonic()
        while (done := time.monotonic() - begin) < seconds:
            tell({"phase": "replay", "part": done, "total": seconds, "scans": int(done * 10)})
            time.sleep(0.05)
    elif word == "allocate":
        kept = []
        try:
            while True:
                kept.append(bytearray(64 << 20))
        except MemoryError:
            tell({"failed": "out_of_memory", "message": "no memory"})
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
                tell({"failed": "output_limit", "message": "too much"})
                return 1
    elif word == "abort":
        os.abort()
    elif word == "exit":
        sys.stdout.write("last words\n")
        return int(rest[0])
    elif word == "lie":
        tell({"done": {}})
        return 0  # but there is no output
    elif word == "nonsense":
        os.write(fd, b"\x00\xff not json\n" + b"x" * (1 << 20))
        time.sleep(60)
    elif word == "mad":  # JSON, of which a part cannot be kept, or read by others
        for text in ("[" * 3000, '["done"]', '"failed"', "1" * 5000, "\xff", '{"phase": 1}'):
            os.write(fd, text.encode("latin-1") + b"\n")
        for part in ("NaN", "1e999", "-Infinity", '"x"', "[]"):
            os.write(fd, f'{{"phase": "\\ud800", "part": {part}, "total": 1, "scans": {part}}}\n'.encode())
        os.write(fd, b'{"phase": "replay", "part": 0.5, "total": 1, "scans": 123456789012345678901234567890}\n')
        os.write(fd, b'{"phase": "\\ud800", "part": 0.5, "total": 1, "scans": 7}\n')
        time.sleep(1.5)
        os.write(fd, b'{"failed": "mad\\ud800", "message": "NaN: \\udcff"}\n')
        return 1
    elif word == "mad-end":
        (folder / "output").mkdir()
        os.write(fd, b'{"done": {"warnings": ["\\udcff"], "metrics": {"ape": [NaN, 1e999, 1.5]}}}\n')
        return 0
    elif word == "link":
        (folder / "output").symlink_to(rest[0])
        tell({"done": {}})
        return 0
    elif word == "silent":
        os.close(fd)
        time.sleep(60)
    elif word == "kill-self":
        os.kill(os.getpid(), signal.SIGKILL)
    elif word == "bad-input":
        tell({"failed": "invalid_input", "message": "run.mcap: no scan"})
        return 1
    output = folder / "output"
    output.mkdir()
    (output / "trajectory.tum").write_text(f"{job['request']['seed']} {rest}\n")
    (output / "metrics.json").write_text("{}\n")
    if word == "tricks":
        (output / "passwd").symlink_to("/etc/passwd")
        (output / "sub").mkdir()
        (output / "sub" / "x").write_text("x")
        (output / "<img src=x>").write_text("x")
    tell({"done": {"metrics": {}, "data_lost": False, "warnings": [], "notes": [], "timings": {}}})
    return 0


def spawn_sleeper(new_session: bool) -> None:
    subprocess.Popen(["sleep", "300"], start_new_session=new_session)


if __name__ == "__main__":
    sys.exit(main())

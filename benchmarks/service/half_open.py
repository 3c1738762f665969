"""500 half-open connections: how soon are they closed, and how long do real clients wait meanwhile?"""

from __future__ import annotations

import select
import shutil
import socket
import tempfile
import time
import urllib.request
from pathlib import Path

from rig import Server

COUNT = 500
SECONDS = 20.0


def main() -> int:
    folder = Path(tempfile.mkdtemp(prefix="hsloc-half-open-"))
    server = Server(folder / "data").start()
    host = f"Host: 127.0.0.1:{server.port}\r\n"
    begins = (
        b"",
        f"GET /v1/jobs HTTP/1.1\r\n{host}".encode(),
        f"POST /v1/files HTTP/1.1\r\n{host}Content-Length: 100000\r\n\r\nabc".encode(),
        f"POST /v1/jobs HTTP/1.1\r\n{host}Content-Type: application/json\r\nContent-Length: 100\r\n\r\n{{".encode(),
    )
    lines = []
    for k in range(COUNT):
        line = socket.create_connection(("127.0.0.1", server.port))
        line.sendall(begins[k % len(begins)])
        lines.append(line)
    begin, waits, closed_at = time.monotonic(), [], []
    left = set(lines)
    while (now := time.monotonic() - begin) < SECONDS:
        start = time.monotonic()
        with urllib.request.urlopen(f"{server.url}/v1/jobs", timeout=10.0) as answer:
            answer.read()
        waits.append(time.monotonic() - start)
        for line in select.select(list(left), [], [], 0.05)[0] if left else []:
            try:
                over = line.recv(65536) == b""
            except ConnectionError:
                over = True
            if over:
                left.discard(line)
                closed_at.append(now)
        time.sleep(0.02)
    server.end()
    shutil.rmtree(folder)
    waits.sort()
    print(f"{len(closed_at)} of {COUNT} closed, the last after {max(closed_at, default=0.0):.1f} s")
    print(
        f"{len(waits)} requests meanwhile: median {1e3 * waits[len(waits) // 2]:.0f} ms, "
        f"longest {1e3 * waits[-1]:.0f} ms"
    )
    return 0 if len(closed_at) == COUNT and waits[-1] < 1.0 else 1


if __name__ == "__main__":
    raise SystemExit(main())

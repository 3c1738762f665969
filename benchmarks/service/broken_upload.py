"""One upload of 2 GiB by tus with 20 forced disconnects: the same SHA-256, and the server's memory."""

from __future__ import annotations

import argparse
import hashlib
import http.client
import json
import random
import shutil
import socket
import struct
import tempfile
import time
import urllib.request
from contextlib import suppress
from pathlib import Path

from rig import Server

TUS = {"Tus-Resumable": "1.0.0"}
BLOCK = 1 << 20


def content(k: int) -> bytes:
    """The k-th MiB: made anew each time, so that nothing needs to be kept."""
    return hashlib.shake_128(struct.pack("<Q", k // 16)).digest(64) * (BLOCK // 64)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mib", type=int, default=2048)
    parser.add_argument("--breaks", type=int, default=20)
    arguments = parser.parse_args()
    size = arguments.mib * BLOCK
    folder = Path(tempfile.mkdtemp(prefix="hsloc-upload-"))
    server = Server(folder / "data").start()
    before = server.memory_mib()
    place = ask(server, "POST", "/v1/tus", {**TUS, "Upload-Length": str(size)})["location"]
    rng = random.Random(1)
    ends = [*sorted(rng.randrange(size) for _ in range(arguments.breaks)), size]
    begin, longest = time.monotonic(), 0.0
    for end in ends:
        offset = int(ask(server, "HEAD", place, TUS)["upload-offset"])
        send(server, place, offset, end, size)
        if end < size:
            time.sleep(0.2)
            start = time.monotonic()
            ask(server, "GET", "/healthz", {})
            longest = max(longest, time.monotonic() - start)
    seconds = time.monotonic() - begin
    with urllib.request.urlopen(server.url + place.replace("tus", "files")) as answer:
        found = json.load(answer)
    digest = hashlib.sha256()
    for k in range(arguments.mib):
        digest.update(content(k))
    same = found["sha256"] == digest.hexdigest() and found["state"] == "complete"
    peak = server.memory_mib(peak=True)
    server.end()
    shutil.rmtree(folder)
    print(
        f"{arguments.mib} MiB with {arguments.breaks} disconnects in {seconds:.1f} s, "
        f"SHA-256 {'equal' if same else 'OTHER'}"
    )
    print(
        f"server's memory: {before:.0f} MiB before, {peak:.0f} MiB at its peak; /healthz at most {1e3 * longest:.0f} ms"
    )
    return 0 if same and peak < 200 else 1


def ask(server: Server, method: str, path: str, headers: dict[str, str]) -> dict[str, str]:
    """Ask until the upload is no longer held by the broken request."""
    line = http.client.HTTPConnection("127.0.0.1", server.port, timeout=30.0)
    line.request(method, path, headers=headers)
    with line.getresponse() as answer:
        answer.read()
        found = {name.lower(): value for name, value in answer.getheaders()}
    line.close()
    return found


def send(server: Server, place: str, offset: int, end: int, size: int) -> None:
    """Announce all that is left, send up to `end`, and cut the line with a reset (or, at the end, read the answer)."""
    head = (
        f"PATCH {place} HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\nTus-Resumable: 1.0.0\r\n"
        f"Upload-Offset: {offset}\r\n"
        f"Content-Type: application/offset+octet-stream\r\nContent-Length: {size - offset}\r\n\r\n"
    )
    with socket.create_connection(("127.0.0.1", server.port), 60.0) as line, suppress(ConnectionError):
        line.sendall(head.encode())
        at = offset
        while at < end:
            block = content(at // BLOCK)[at % BLOCK :][: end - at]
            line.sendall(block)
            at += len(block)
        if end < size:
            line.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        else:
            line.recv(4096)


if __name__ == "__main__":
    raise SystemExit(main())

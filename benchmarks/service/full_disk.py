"""A disk that becomes full: 507, old jobs can be deleted, and the service goes on. Mounts a small tmpfs: needs root."""

from __future__ import annotations

import shutil
import signal
import subprocess
import tempfile
import time
from contextlib import suppress
from pathlib import Path

from rig import Server

from hsloc.client import Client, ClientError


def main() -> int:
    folder = Path(tempfile.mkdtemp(prefix="hsloc-full-"))
    disk = folder / "disk"
    disk.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=32m", "none", str(disk)], check=True)
    server = Server(disk / "data", HSLOC_MIN_FREE_BYTES="4M").start()
    try:
        return run(server, folder, disk)
    finally:
        server.end()
        subprocess.run(["umount", str(disk)], check=True)
        shutil.rmtree(folder)


def run(server: Server, folder: Path, disk: Path) -> int:
    client = Client(server.url, attempts=3)
    small, large = folder / "small.mcap", folder / "large.mcap"
    small.write_bytes(b"ok" + bytes(5 << 20))
    large.write_bytes(b"ok" + bytes(40 << 20))
    logs = [client.upload(small) for _ in range(3)]
    jobs = [client.submit(log)["id"] for log in logs]
    assert all(client.wait(job)["state"] == "succeeded" for job in jobs)
    print("announced beyond the disk:", refusal(lambda: client.upload(large)))
    print("not announced:            ", refusal(lambda: chunked(server, 40)))
    # Somebody else takes the last byte: the service's own floor is gone, too.
    fill(disk / "somebody-else")
    print("upload on a full disk:    ", refusal(lambda: chunked(server, 1)))
    print("job on a full disk:       ", refusal(lambda: client.submit(logs[0])))
    print("readyz:                   ", refusal(lambda: client.request("GET", "/readyz")))
    server.end(signal.SIGKILL)
    server.start()
    print("killed with -9 and started again on the full disk")
    fill(disk / "somebody-else-again")  # also what the server gave up in order to start
    client.request("DELETE", f"/v1/jobs/{jobs[0]}")
    client.request("DELETE", f"/v1/files/{logs[0]}")
    client.request("DELETE", f"/v1/files/{logs[1]}")
    print("deleted a job and two files on the full disk")
    (disk / "somebody-else").unlink()
    (disk / "somebody-else-again").unlink()
    time.sleep(0.2)
    again = client.submit(client.upload(small))
    state = client.wait(again["id"])["state"]
    print(f"afterwards an upload and a job: {state}")
    return 0 if state == "succeeded" else 1


def fill(path: Path) -> None:
    with suppress(OSError), path.open("wb") as file:
        while True:
            file.write(bytes(1 << 16))
            file.flush()


def refusal(work: object) -> str:
    try:
        work()  # type: ignore[operator]
    except ClientError as error:
        return f"{error.status} {error}"
    raise AssertionError("it was taken")


def chunked(server: Server, mib: int) -> None:
    """An upload that does not say how long it is."""
    import http.client

    line = http.client.HTTPConnection("127.0.0.1", server.port, timeout=30.0)
    blocks = (bytes(1 << 20) for _ in range(mib))
    with suppress(ConnectionError):  # the server may answer before the end
        line.request("POST", "/v1/files", body=blocks, encode_chunked=True)
    with line.getresponse() as answer:
        text = answer.read().decode()
        line.close()
        if answer.status >= 400:
            raise ClientError(text, answer.status)


if __name__ == "__main__":
    raise SystemExit(main())

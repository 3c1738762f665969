"""Slow clients are cut off, others are served meanwhile."""

from __future__ import annotations

import contextlib
import select
import socket
import threading
import time
from typing import TYPE_CHECKING

import httpx2 as httpx
import pytest
from live_service import Live, submit

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

QUICK = {"HSLOC_HEADER_TIMEOUT_S": "1", "HSLOC_BODY_TIMEOUT_S": "1", "HSLOC_WRITE_TIMEOUT_S": "2"}


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """One server for all of these, impatient."""
    server = Live(tmp_path_factory.mktemp("protocol"), **QUICK).start()
    yield server
    assert server.end() == 0


def closed(lines: list[socket.socket], seconds: float) -> int:
    """How many of the connections the other side ends within the time."""
    left, deadline = set(lines), time.monotonic() + seconds
    while left and time.monotonic() < deadline:
        for line in select.select(list(left), [], [], 0.1)[0]:
            try:
                if line.recv(65536) == b"":
                    left.discard(line)
            except ConnectionError:
                left.discard(line)
    return len(lines) - len(left)


def test_half_open_requests_are_closed_and_others_served(live: Live) -> None:
    lines = [socket.create_connection(("127.0.0.1", live.port)) for _ in range(120)]
    host = f"Host: 127.0.0.1:{live.port}\r\n"
    begin = "GET /v1/jobs HTTP/1.1\r\n" + host
    body = "POST /v1/files HTTP/1.1\r\n" + host + "Content-Length: 1000\r\n\r\n123"
    for k, line in enumerate(lines):
        line.sendall((b"", begin.encode(), body.encode())[k % 3])
    try:
        for _ in range(5):
            start = time.monotonic()
            assert httpx.get(f"{live.url}/v1/jobs").status_code == 200
            assert time.monotonic() - start < 1.0
        assert closed(lines, 5.0) == len(lines)
    finally:
        for line in lines:
            line.close()
    deadline = time.monotonic() + 5.0
    while (left := list((live.data / "uploads").iterdir())) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert left == []


def test_a_header_in_drops_does_not_win_time(live: Live) -> None:
    with socket.create_connection(("127.0.0.1", live.port)) as line:
        begin = time.monotonic()
        try:
            for byte in b"GET /healthz HTTP/1.1\r\nX: " + b"a" * 1000:
                line.sendall(bytes([byte]))
                time.sleep(0.05)
                if select.select([line], [], [], 0)[0] and line.recv(1) == b"":
                    break
        except ConnectionError:
            pass
        assert time.monotonic() - begin < 4.0


def test_a_second_request_on_a_connection_may_take_its_time_but_not_for_ever(live: Live) -> None:
    request = f"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1:{live.port}\r\n\r\n".encode()
    with socket.create_connection(("127.0.0.1", live.port)) as line:
        for _ in range(2):
            line.sendall(request)
            answer = b""
            while not answer.endswith(b'{"status":"ok"}'):
                answer += line.recv(4096)
            assert answer.startswith(b"HTTP/1.1 200")
            time.sleep(1.5)  # idle between requests: that is keep-alive's business
        line.sendall(request[:20])
        assert closed([line], 4.0) == 1


def test_a_slow_but_steady_upload_passes(live: Live) -> None:

    def drops() -> object:
        for _ in range(8):
            time.sleep(0.3)
            yield b"x" * 100

    answer = httpx.post(f"{live.url}/v1/files", content=drops())  # type: ignore[arg-type]
    assert (answer.status_code, answer.json()["size"]) == (201, 800)


def test_a_client_that_takes_nothing_is_cut_off(live: Live) -> None:
    httpx.get(f"{live.url}/openapi.json", timeout=60.0)  # the first one is built, which takes seconds
    with socket.socket() as line:
        line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        line.connect(("127.0.0.1", live.port))
        request = f"GET /openapi.json HTTP/1.1\r\nHost: 127.0.0.1:{live.port}\r\n\r\n".encode()
        line.sendall(request * 400)  # takes none of the answers
        time.sleep(5.0)
        line.settimeout(5.0)
        got = 0
        try:
            while block := line.recv(1 << 20):
                got += block.count(b"HTTP/1.1 200")
        except ConnectionError:
            pass
    assert got < 400  # only what the kernel had taken before


def test_event_streams_that_come_at_once_are_counted_all(make_live: Callable[..., Live]) -> None:
    live = make_live(HSLOC_MAX_STREAMS="8")
    with live.client() as client, contextlib.ExitStack() as lines:
        job = submit(client, b"slow 30")
        opened = [lines.enter_context(socket.create_connection(("127.0.0.1", live.port))) for _ in range(60)]
        for line in opened:
            line.sendall(f"GET /v1/jobs/{job}/events HTTP/1.1\r\nHost: 127.0.0.1:{live.port}\r\n\r\n".encode())
        codes = [line.recv(12)[-3:] for line in opened]
        assert (codes.count(b"200"), codes.count(b"429")) == (8, 52)
        for line in opened:
            line.close()
        deadline = time.monotonic() + 10.0
        while True:  # their places are free again
            with client.stream("GET", f"/v1/jobs/{job}/events") as answer:
                if answer.status_code == 200:
                    return
            assert time.monotonic() < deadline
            time.sleep(0.1)


def test_the_description_is_made_beside_all_else(make_live: Callable[..., Live]) -> None:
    """The first request takes seconds, and anybody may send it."""
    live = make_live()
    longest, done = 0.0, threading.Event()

    def ask() -> None:
        with live.client() as client:
            assert client.get("/openapi.json").json()["openapi"]
        done.set()

    with live.client() as client:
        client.get("/healthz")
        asking = [threading.Thread(target=ask) for _ in range(50)]  # more than there are threads for all routes
        for thread in asking:
            thread.start()
        begin = time.monotonic()
        while not done.is_set() and time.monotonic() - begin < 30.0:
            before = time.monotonic()
            client.get("/v1/info")
            longest = max(longest, time.monotonic() - before)
        took = time.monotonic() - begin
        for thread in asking:
            thread.join()
    assert longest < 0.5 * took


def test_a_body_in_drops_is_cut_off_and_a_slow_but_steady_one_is_not(live: Live) -> None:
    head = f"POST /v1/files HTTP/1.1\r\nHost: 127.0.0.1:{live.port}\r\nContent-Length: 6000\r\n\r\n".encode()
    ends: dict[int, bytes] = {}

    def send(size: int) -> None:
        with socket.create_connection(("127.0.0.1", live.port)) as line, contextlib.suppress(ConnectionError):
            line.settimeout(10.0)
            line.sendall(head)
            for _ in range(0, 6000, size):
                line.sendall(b"x" * size)
                time.sleep(0.2)
                if select.select([line], [], [], 0)[0]:
                    break
            ends[size] = line.recv(100)

    threads = [threading.Thread(target=send, args=(size,)) for size in (10, 400)]  # 50 B/s, for two minutes; 2 kB/s
    begin = time.monotonic()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert time.monotonic() - begin < 15.0
    assert ends.get(10, b"") == b""
    assert ends[400].startswith(b"HTTP/1.1 201 ")

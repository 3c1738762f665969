"""Slow clients are cut off, others are served meanwhile."""

from __future__ import annotations

import contextlib
import select
import socket
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING

import httpx2 as httpx
import pytest
from live_service import Live, submit, with_coverage
from waiting import LIMIT_S, until

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

QUICK = {"HSLOC_HEADER_TIMEOUT_S": "1", "HSLOC_BODY_TIMEOUT_S": "1.5", "HSLOC_WRITE_TIMEOUT_S": "2"}
PATIENT = {"HSLOC_HEADER_TIMEOUT_S": "600", "HSLOC_BODY_TIMEOUT_S": "600"}


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """One server for all of these, impatient."""
    server = Live(tmp_path_factory.mktemp("protocol"), **QUICK, **with_coverage()).start()
    yield server
    assert server.end() == 0


def closed(lines: list[socket.socket]) -> int:
    """How many of the connections the other side has ended, of all that have something to say."""
    count = 0
    for line in select.select(lines, [], [], 0)[0]:
        try:
            count += line.recv(65536, socket.MSG_PEEK) == b""
        except ConnectionError:
            count += 1
    return count


def half_open(live: Live) -> list[socket.socket]:
    """Connections without a request, with a part of its headers, or of its body."""
    lines = [socket.create_connection(("127.0.0.1", live.port)) for _ in range(120)]
    host = f"Host: 127.0.0.1:{live.port}\r\n"
    begin = "GET /v1/jobs HTTP/1.1\r\n" + host
    body = "POST /v1/files HTTP/1.1\r\n" + host + "Content-Length: 1000\r\n\r\n123"
    for k, line in enumerate(lines):
        line.sendall((b"", begin.encode(), body.encode())[k % 3])
    return lines


def test_half_open_requests_do_not_delay_others(make_live: Callable[..., Live]) -> None:
    live = make_live(**PATIENT)
    with contextlib.ExitStack() as stack:
        lines = [stack.enter_context(line) for line in half_open(live)]
        uploads = live.data / "uploads"
        until(lambda: len(list(uploads.iterdir())), "all bodies are waited for", lambda count: count == 40)
        for _ in range(5):
            assert httpx.get(f"{live.url}/v1/jobs", timeout=LIMIT_S).status_code == 200
        assert closed(lines) == 0


def test_half_open_requests_are_closed(live: Live) -> None:
    with contextlib.ExitStack() as stack:
        lines = [stack.enter_context(line) for line in half_open(live)]
        until(lambda: closed(lines), "all are closed", lambda count: count == len(lines))
    until(lambda: not list((live.data / "uploads").iterdir()), "nothing is left of what they sent")


def test_a_header_in_drops_does_not_win_time(live: Live) -> None:
    with socket.create_connection(("127.0.0.1", live.port)) as line:
        drops, sent = b"GET /healthz HTTP/1.1\r\nX: " + b"a" * 1000, 0
        with contextlib.suppress(ConnectionError):
            while sent < len(drops) and closed([line]) == 0:
                line.sendall(drops[sent : sent + 1])
                sent += 1
                time.sleep(0.05)
    assert sent < len(drops) / 2


def test_a_second_request_on_a_connection_may_take_its_time_but_not_for_ever(live: Live) -> None:
    request = f"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1:{live.port}\r\n\r\n".encode()

    def ask(line: socket.socket) -> None:
        line.sendall(request)
        answer = b""
        while not answer.endswith(b'{"status":"ok"}'):
            block = line.recv(4096)
            assert block, answer
            answer += block
        assert answer.startswith(b"HTTP/1.1 200")

    begin = time.monotonic()
    with contextlib.ExitStack() as stack:
        idle, late = (stack.enter_context(socket.create_connection(("127.0.0.1", live.port))) for _ in range(2))
        for line in (idle, late, late):
            ask(line)
        late.sendall(request[:20])
        until(lambda: closed([late]), "the request that does not come is given up")
        until(lambda: closed([idle]), "the connection without a request is given up")
    assert time.monotonic() - begin > 4.0  # idle between requests, it has the 5 s of keep-alive


def test_a_slow_but_steady_upload_passes(live: Live) -> None:

    def drops() -> object:
        for _ in range(8):
            time.sleep(0.3)
            yield b"x" * 5000

    answer = httpx.post(f"{live.url}/v1/files", content=drops(), timeout=LIMIT_S)  # type: ignore[arg-type]
    assert (answer.status_code, answer.json()["size"]) == (201, 40_000)


def is_held(line: socket.socket, port: int) -> bool:
    """Whether the server on the port has not given the connection up; asked of the kernel, as nothing is read."""
    ends = [f"{end:04X}" for end in (port, line.getsockname()[1])]
    rows = [row.split() for row in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    return any([row[1].rpartition(":")[2], row[2].rpartition(":")[2], row[3]] == [*ends, "01"] for row in rows)


def test_a_client_that_takes_nothing_is_cut_off(live: Live) -> None:
    httpx.get(f"{live.url}/openapi.json", timeout=LIMIT_S)  # the first one is built, which takes seconds
    with socket.socket() as line:
        line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        line.connect(("127.0.0.1", live.port))
        request = f"GET /openapi.json HTTP/1.1\r\nHost: 127.0.0.1:{live.port}\r\n\r\n".encode()
        line.sendall(request * 400)  # takes none of the answers
        assert is_held(line, live.port)
        until(lambda: not is_held(line, live.port), "it is cut off")
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
        job = submit(client, b"slow 600")
        opened = [lines.enter_context(socket.create_connection(("127.0.0.1", live.port))) for _ in range(60)]
        for line in opened:
            line.sendall(f"GET /v1/jobs/{job}/events HTTP/1.1\r\nHost: 127.0.0.1:{live.port}\r\n\r\n".encode())
        codes = [line.recv(12)[-3:] for line in opened]
        assert (codes.count(b"200"), codes.count(b"429")) == (8, 52)
        for line in opened:
            line.close()

        def status() -> int:
            with client.stream("GET", f"/v1/jobs/{job}/events") as answer:
                return int(answer.status_code)

        until(status, "their places are free again", lambda found: found == 200)


def test_the_description_is_made_beside_all_else(make_live: Callable[..., Live]) -> None:
    """The first request takes seconds, and anybody may send it."""
    live = make_live()
    answered, done = 0, threading.Event()

    def ask() -> None:
        with live.client() as client:
            assert client.get("/openapi.json").json()["openapi"]
        done.set()

    with live.client() as client:
        client.get("/healthz")
        asking = [threading.Thread(target=ask) for _ in range(50)]  # more than there are threads for all routes
        for thread in asking:
            thread.start()
        while not done.is_set():
            assert client.get("/v1/info").status_code == 200
            answered += 1
        for thread in asking:
            thread.join()
    assert answered > 3  # some before it was made


def test_a_body_in_drops_is_cut_off_and_a_slow_but_steady_one_is_not(live: Live) -> None:
    head = f"POST /v1/files HTTP/1.1\r\nHost: 127.0.0.1:{live.port}\r\nContent-Length: 30000\r\n\r\n".encode()
    ends: dict[int, bytes] = {}
    sent = dict.fromkeys((10, 1500), 0)

    def send(size: int) -> None:
        with socket.create_connection(("127.0.0.1", live.port)) as line, contextlib.suppress(ConnectionError):
            line.settimeout(LIMIT_S)
            line.sendall(head)
            while sent[size] < 30_000 and not select.select([line], [], [], 0)[0]:
                line.sendall(b"x" * size)
                sent[size] += size
                time.sleep(0.25)
            ends[size] = line.recv(100)

    # 40 B/s, for ten minutes, and 6 kB/s, for longer than the rate is averaged.
    threads = [threading.Thread(target=send, args=(size,)) for size in sent]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sent[10] < 3000
    assert ends.get(10, b"") == b""
    assert ends[1500].startswith(b"HTTP/1.1 201 ")

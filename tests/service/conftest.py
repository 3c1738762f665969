"""Services on a temporary folder, in this process or in one of their own."""

from __future__ import annotations

import contextlib
import signal
from typing import TYPE_CHECKING, Any

import postgresql as postgresql_server
import pytest
from fastapi.testclient import TestClient
from live_service import Live, settings

from hsloc_service.http.app import create_app

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path


@pytest.fixture
def make_client(tmp_path: Path) -> Iterator[Callable[..., TestClient]]:
    """Clients of services in this process; with `raise_server_exceptions=False`, as over the wire."""
    with contextlib.ExitStack() as stack:

        def make(**changes: Any) -> TestClient:
            app = create_app(settings(tmp_path, **changes))
            client = TestClient(app, raise_server_exceptions=False)
            return stack.enter_context(client)

        yield make


@pytest.fixture
def client(make_client: Callable[..., TestClient]) -> TestClient:
    return make_client()


@pytest.fixture
def make_live(tmp_path: Path) -> Iterator[Callable[..., Live]]:
    made: list[Live] = []

    def make(**variables: str) -> Live:
        made.append(Live(tmp_path, **variables).start())
        return made[-1]

    yield make
    for each in made:
        if each.process is not None and each.process.poll() is None:
            each.end(signal.SIGKILL)


@pytest.fixture(scope="session")
def postgresql() -> Iterator[postgresql_server.Server]:
    """A PostgreSQL, started when the first test asks for it."""
    with postgresql_server.running() as server:
        yield server


@pytest.fixture(params=["sqlite", "postgresql"])
def database_url(request: pytest.FixtureRequest) -> str:
    """The database's URL for the settings: of each kind in turn."""
    if request.param == "sqlite":
        return ""
    server: postgresql_server.Server = request.getfixturevalue("postgresql")
    return server.new_database()

"""Services on a temporary folder, in this process or in one of their own."""

from __future__ import annotations

import contextlib
import shutil
import signal
from importlib.resources import files
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
        made.append(Live(tmp_path, **variables))
        return made[-1].start()

    yield make
    for each in made:
        if each.process is not None and each.process.poll() is None:
            each.end(signal.SIGKILL)


@pytest.fixture(scope="session")
def postgresql() -> Iterator[postgresql_server.Server]:
    """A PostgreSQL, started when the first test needs it."""
    with postgresql_server.running() as server:
        yield server


@pytest.fixture(params=["sqlite", "postgresql"])
def database_url(request: pytest.FixtureRequest) -> str:
    """The database's URL for the settings: of each kind in turn."""
    if request.param == "sqlite":
        return ""
    server: postgresql_server.Server = request.getfixturevalue("postgresql")
    return server.new_database()


_FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A Chromium; without Playwright or Chromium the test is skipped with that reason."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="THE PAGE IS NOT TESTED: playwright is not installed")
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("THE PAGE IS NOT TESTED: no chromium (apt-get install chromium)")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=[*_FLAGS, "--disable-component-update"])
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def need_accessible() -> Callable[[Any], None]:
    """Fails with what axe-core finds against WCAG 2.2 AA and good practice on a page as it is now."""
    source = files("axe_playwright_python").joinpath("axe.min.js").read_text(encoding="utf-8")

    def check(page: Any) -> None:
        page.evaluate(source)  # not as a script of the page, whose policy forbids it
        found = page.evaluate("() => axe.run()")
        assert len(found["passes"]) > 10
        bad = [(each["id"], [node["html"][:200] for node in each["nodes"]][:3]) for each in found["violations"]]
        assert bad == []

    return check


@pytest.fixture
def open_page(browser: Any) -> Iterator[Callable[..., Any]]:
    """Pages that fail the test on a dialogue, an error in the console or a breach of the content policy."""
    contexts, complaints = [], []

    def make(url: str, **options: Any) -> Any:
        contexts.append(browser.new_context(accept_downloads=True, **options))
        page = contexts[-1].new_page()
        page.on("dialog", lambda dialog: (complaints.append(f"dialog: {dialog.message}"), dialog.dismiss()))  # type: ignore[func-returns-value]
        page.on("pageerror", lambda error: complaints.append(f"error: {error}"))
        page.on(
            "console",
            lambda message: (
                complaints.append(message.text)
                if message.type == "error" and "the server responded with a status of 401" not in message.text
                else None
            ),
        )
        page.set_default_timeout(120_000)  # reached by a busy machine alone
        page.goto(url)
        return page

    yield make
    for context in contexts:
        context.close()
    assert complaints == []

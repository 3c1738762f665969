"""The page requires a token, and goes on with an upload after a broken line, a killed server and a reload."""

from __future__ import annotations

import hashlib
import os
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from live_service import Live

pytestmark = pytest.mark.unmeasured


def test_a_token_is_required(make_live: Callable[..., Live], open_page: Callable[..., Any]) -> None:
    token = "a-token-of-the-operator-0123456789"
    live = make_live(HSLOC_TOKEN=token)
    page = open_page(live.url)
    page.wait_for_selector("#token-form:not([hidden])")
    page.fill("#token", token)
    page.keyboard.press("Enter")
    page.wait_for_function("() => document.querySelector('#server').textContent.includes('version')")
    assert page.is_hidden("#token-form")
    page.click("#try-sample")  # with one click, and nothing of one's own
    page.wait_for_selector("#job-state .succeeded")
    assert page.text_content("#job-title") == "office.mcap"


def test_an_upload_survives_a_server_that_drops_it(
    make_live: Callable[..., Live], open_page: Callable[..., Any], tmp_path: Path, browser: Any
) -> None:
    live = make_live(HSLOC_FAULT_DROP_UPLOADS="0.5")
    log = tmp_path / "large.log"
    log.write_bytes(b"ok " + os.urandom(20_000_000))
    context = browser.new_context()
    page = context.new_page()  # the failures are in the console, as they should be
    page.goto(live.url)
    page.set_input_files("#log", str(log))
    page.click("#go")
    page.wait_for_selector("#job-state .succeeded", timeout=120_000)
    with live.client() as client:
        file = client.get("/v1/files").json()["files"][0]
    assert file["sha256"] == hashlib.sha256(log.read_bytes()).hexdigest()
    assert '"status": 503' in live.log.read_text()
    context.close()


def test_an_upload_goes_on_after_a_broken_line_and_after_a_reload(
    make_live: Callable[..., Live], tmp_path: Path, browser: Any
) -> None:
    live = make_live()
    log = tmp_path / "large.log"
    log.write_bytes(b"ok " + os.urandom(40_000_000))
    context = browser.new_context()
    page = context.new_page()  # the broken line is in the console, as it should be
    offsets: list[int] = []

    def line(route: Any, request: Any) -> None:
        if request.method != "PATCH":
            route.continue_()
            return
        offsets.append(int(request.headers["upload-offset"]))
        if len(offsets) == 2:
            route.abort("connectionreset")
        elif len(offsets) == 4:
            page.evaluate("document.querySelector('#stop').click()")  # pauses
            route.abort("aborted")
        else:
            route.continue_()

    page.route("**/v1/tus/*", line)
    page.goto(live.url)
    page.set_input_files("#log", str(log))
    page.click("#go")
    page.wait_for_function("() => document.querySelector('#upload-text').textContent.includes('the line broke')")
    page.wait_for_function("() => document.querySelector('#upload-text').textContent.includes('paused')")
    assert 0.0 < page.evaluate("document.querySelector('#upload-bar').value") < 1.0
    page.reload()
    page.set_input_files("#log", str(log))
    page.click("#go")
    page.wait_for_selector("#job-state .succeeded", timeout=120_000)
    block = 8 << 20
    assert offsets == [0, block, block, 2 * block, 2 * block, 3 * block, 4 * block]
    with live.client() as client:
        (file,) = client.get("/v1/files").json()["files"]
    assert file["sha256"] == hashlib.sha256(log.read_bytes()).hexdigest()
    context.close()

"""Behind nginx and Caddy with their defaults and the lines of the README: uploads, live events, the page."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import socket
import subprocess
from typing import TYPE_CHECKING, Any

import httpx2 as httpx
import pytest
from live_service import Live, free_port, go_on, submit
from waiting import LIMIT_S, until

from hsloc.client import Client

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

pytestmark = pytest.mark.unmeasured

NGINX = shutil.which("nginx") or shutil.which("nginx", path="/usr/sbin")
CADDY = shutil.which("caddy")
NGINX_CONFIG = """
daemon off; pid {folder}/nginx.pid; error_log {folder}/error.log; worker_processes 1; {user}
events {{}}
http {{
  access_log off; client_body_temp_path {folder}/body; proxy_temp_path {folder}/proxy;
  fastcgi_temp_path {folder}/f; uwsgi_temp_path {folder}/u; scgi_temp_path {folder}/s;
  server {{
    listen 127.0.0.1:{port};
    location / {{
      proxy_pass {upstream};
      proxy_set_header Host $http_host;
    }}
  }}
}}
"""


def listens(port: int) -> bool:
    with socket.socket() as line:
        return line.connect_ex(("127.0.0.1", port)) == 0


@pytest.fixture(params=["nginx", "caddy"], scope="module")
def proxied(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Live, str]]:
    """A server, and the URL of a proxy before it."""
    program = NGINX if request.param == "nginx" else CADDY
    if program is None:
        pytest.skip(f"{request.param.upper()} IS NOT TESTED: apt-get install {request.param}")
    folder = tmp_path_factory.mktemp(request.param)
    live, port = Live(folder).start(), free_port()
    if request.param == "nginx":
        config = folder / "nginx.conf"
        user = "user root;" if os.getuid() == 0 else ""
        config.write_text(NGINX_CONFIG.format(folder=folder, port=port, upstream=live.url, user=user))
        command = [program, "-c", str(config), "-p", str(folder), "-e", str(folder / "error.log")]
    else:
        config = folder / "Caddyfile"
        config.write_text(
            f"{{\n admin off\n auto_https off\n}}\nhttp://127.0.0.1:{port} {{\n reverse_proxy {live.url[7:]}\n}}\n"
        )
        command = [program, "run", "--config", str(config), "--adapter", "caddyfile"]
    environment = {**os.environ, "HOME": str(folder), "XDG_DATA_HOME": str(folder)}
    with (folder / "proxy.log").open("wb") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log, env=environment)
    try:
        until(lambda: listens(port), "the proxy has started")
        yield live, f"http://127.0.0.1:{port}"
    finally:
        process.terminate()
        process.wait(LIMIT_S)
        live.end()


def test_a_large_upload_passes(proxied: tuple[Live, str], tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    log.write_bytes(b"ok " + os.urandom(5_000_000))
    client = Client(proxied[1])
    ident = client.upload(log)
    assert client.wait(client.submit(ident)["id"])["state"] == "succeeded"
    with proxied[0].client() as direct:
        file = direct.get(f"/v1/files/{ident}").json()
    assert file["sha256"] == hashlib.sha256(log.read_bytes()).hexdigest()


def test_events_come_while_the_job_runs(proxied: tuple[Live, str]) -> None:
    live, url = proxied
    with live.client() as direct:
        job = submit(direct, b"held")
    states = []
    with httpx.stream("GET", f"{url}/v1/jobs/{job}/events", timeout=LIMIT_S) as answer:
        for line in answer.iter_lines():
            if line.startswith("data: "):
                states.append(json.loads(line[6:]).get("state", "progress"))
                if states.count("progress") == 1 and states[-1] == "progress":
                    go_on(live.data, job)  # never reached where the proxy keeps events until the end
    assert states[-1] == "succeeded"


def test_the_page_works(proxied: tuple[Live, str], tmp_path: Path, browser: Any) -> None:
    log = tmp_path / "run.mcap"
    log.write_bytes(b"held " + bytes(3_000_000))
    page = browser.new_page()
    page.set_default_timeout(1000 * LIMIT_S)
    page.goto(proxied[1])
    page.set_input_files("#log", str(log))
    page.click("#go")
    page.wait_for_selector("#job-state .running")
    page.wait_for_function("() => document.querySelector('#job-state').textContent.includes('replay')")
    go_on(proxied[0].data, page.url.partition("job=")[2])
    page.wait_for_selector("#job-state .succeeded")
    page.close()

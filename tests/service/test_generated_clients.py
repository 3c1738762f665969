"""Clients generated from our OpenAPI upload a log, submit a job, wait for it and download its results.

openapi-python-client comes with the extra `dev`. For openapi-typescript set TYPESCRIPT_NODE_MODULES to a `node_modules`
made by `npm install openapi-typescript@7 openapi-fetch@0.17 typescript@5`, as .ci/run does where there is npm.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from collections.abc import Callable

    from live_service import Live

pytestmark = pytest.mark.unmeasured

TOKEN = "a-token-of-the-operator-0123456789"
PYTHON_CLIENT = """
import hashlib, io, sys, time
from generated import AuthenticatedClient
from generated.api.files import files_upload
from generated.api.jobs import jobs_get, jobs_submit
from generated.api.results import results_archive, results_asset, results_manifest
from generated.models import JobRequest
from generated.types import File

client = AuthenticatedClient(base_url=sys.argv[1], token=sys.argv[2])
file = files_upload.sync(client=client, body=File(payload=io.BytesIO(b"ok by a client")), name="run.mcap")
job = jobs_submit.sync(client=client, body=JobRequest(log=file.id, seed=7))
assert job.request["seed"] == 7 and job.request["preset"] == "default", job
while (job := jobs_get.sync(job.id, client=client)).ended is None:
    time.sleep(0.05)
assert job.state == "succeeded", job
for asset in results_manifest.sync(job.id, client=client).assets:
    content = results_asset.sync(job.id, asset.name, client=client).payload.read()
    assert hashlib.sha256(content).hexdigest() == asset.sha256
assert results_archive.sync(job.id, client=client).payload.read(2) == b"PK"
print(results_asset.sync(job.id, "trajectory.tum", client=client).payload.read().decode())
"""
TYPESCRIPT_CLIENT = """
import createClient from "openapi-fetch";
import type { components, paths } from "./schema.js";

declare const process: { argv: string[] };
const [, , baseUrl, token] = process.argv;
const client = createClient<paths>({ baseUrl, headers: { Authorization: `Bearer ${token}` } });
const body = new Blob(["ok by a client"]);
const { data: file } = await client.POST("/v1/files", {
  params: { query: { name: "run.mcap" } }, body: body as unknown as string, bodySerializer: (it) => it,
  headers: { "Content-Type": "application/octet-stream" },
});
const wanted: components["schemas"]["JobRequest"] = { log: file!.id, seed: 7 };
let { data: job } = await client.POST("/v1/jobs", { body: wanted });
const path = { job_id: job!.id };
while (!job!.ended) {
  await new Promise((resolve) => setTimeout(resolve, 50));
  ({ data: job } = await client.GET("/v1/jobs/{job_id}", { params: { path } }));
}
const { data: manifest } = await client.GET("/v1/jobs/{job_id}/results", { params: { path } });
if (manifest!.assets.length < 2) throw new Error("results are missing");
const { data: text } = await client.GET("/v1/jobs/{job_id}/results/{name}", {
  params: { path: { ...path, name: "trajectory.tum" } }, parseAs: "text",
});
console.log(text);
"""


def describe(live: Live, folder: Path) -> Path:
    with live.client() as client:
        (folder / "openapi.json").write_text(client.get("/openapi.json").text)
    return folder / "openapi.json"


def run(*command: str, folder: Path) -> str:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.skipif(
    importlib.util.find_spec("openapi_python_client") is None,
    reason="GENERATED CLIENTS ARE NOT TESTED: openapi-python-client is not installed (pip install 'hsloc[dev]')",
)
def test_openapi_python_client(make_live: Callable[..., Live], tmp_path: Path) -> None:
    live = make_live(HSLOC_TOKEN=TOKEN)
    document = describe(live, tmp_path)
    (tmp_path / "config.yaml").write_text("post_hooks: []\n")
    options = ["--meta", "none", "--output-path", "generated", "--config", "config.yaml", "--fail-on-warning"]
    run(sys.executable, "-m", "openapi_python_client", "generate", "--path", str(document), *options, folder=tmp_path)
    (tmp_path / "client.py").write_text(PYTHON_CLIENT)
    assert "7 ['by', 'a', 'client']" in run(sys.executable, "client.py", live.url, TOKEN, folder=tmp_path)


@pytest.mark.skipif(
    "TYPESCRIPT_NODE_MODULES" not in os.environ or shutil.which("node") is None,
    reason="TYPESCRIPT CLIENTS ARE NOT TESTED: node and TYPESCRIPT_NODE_MODULES are needed",
)
def test_openapi_typescript(make_live: Callable[..., Live], tmp_path: Path) -> None:
    live = make_live(HSLOC_TOKEN=TOKEN)
    document = describe(live, tmp_path)
    modules = Path(os.environ["TYPESCRIPT_NODE_MODULES"])
    (tmp_path / "node_modules").symlink_to(modules)
    (tmp_path / "package.json").write_text('{"type": "module"}')
    (tmp_path / "client.ts").write_text(TYPESCRIPT_CLIENT)
    run("node", str(modules / "openapi-typescript/bin/cli.js"), str(document), "-o", "schema.d.ts", folder=tmp_path)
    target = ["--target", "es2022", "--module", "nodenext", "--moduleResolution", "nodenext", "--lib", "es2022,dom"]
    run("node", str(modules / "typescript/bin/tsc"), "--strict", *target, "client.ts", folder=tmp_path)
    assert "7 ['by', 'a', 'client']" in run("node", "client.js", live.url, TOKEN, folder=tmp_path)

"""The API keeps to its OpenAPI: requests made from the schema by schemathesis, to a server over the wire.

No answer is a 5xx; status, content type, headers and body are those that are described; what fits the schema is taken,
what does not is refused, and so is whoever has no token.
"""

from __future__ import annotations

import re
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import uuid4

import hypothesis
import pytest
import requests
import schemathesis
from hypothesis import HealthCheck, Phase
from live_service import IN_MEMORY, Live, settings, submit, upload, wait
from schemathesis.checks import load_all_checks
from schemathesis.generation.hypothesis.builder import HypothesisTestConfig, HypothesisTestMode, create_test
from schemathesis.specs.openapi.checks import negative_data_rejection

from hsloc_service.http import tus
from hsloc_service.http.app import create_app
from hsloc_service.http.openapi import describe
from hsloc_service.http.validation import UUID_PATTERN

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.unmeasured

TOKEN = "a-token-of-the-operator-0123456789"
FEW = {
    "Config": ("matcher", "hide"),
    "RunRequest": ("mode", "seed"),
    "RerunRequest": ("mode", "seed", "map"),
    "SweepOptions": ("matcher", "priority"),
}
"""Of the parameters, which one table checks, some will do; a rerun takes what `/v1/jobs` does, which is all tried."""
OF_HIDE = ("budget", "consideration_rate", "count_improvisations")
"""A number, a share and a switch. Each parameter more takes 40 requests: all its bounds, in each place."""

LONGEST_LIST = 100
"""To find 1,000 different ids, and names and values of 4,096 characters, takes schemathesis 20 s at each collection."""


def described() -> dict[str, Any]:
    """The OpenAPI of the service."""
    with tempfile.TemporaryDirectory() as folder:
        app = create_app(settings(Path(folder)))
        app.state.context.database.close()
        app.state.context.storage.close()
        found = describe(app, complete=True)
    for model, names in FEW.items():
        known = found["components"]["schemas"][model]["properties"]
        found["components"]["schemas"][model]["properties"] = {name: known[name] for name in names}
    job = found["components"]["schemas"]["JobRequest"]
    job["oneOf"] = job["oneOf"][:1]  # with `log`: else all fields are tried again with `logs`, which a sweep has, too
    del job["properties"]["logs"]
    hide = found["components"]["schemas"]["Config"]["properties"]["hide"]
    hide["properties"] = {name: hide["properties"][name] for name in OF_HIDE}
    for parameter in found["paths"]["/v1/tus"]["post"]["parameters"]:
        parameter["schema"].pop("maxLength", None)
    for model in ("JobRequest", "SweepRequest"):
        for each in found["components"]["schemas"][model]["properties"].values():
            for schema in (each, *each.get("anyOf", ())):
                if schema.get("maxItems", 0) > LONGEST_LIST:
                    del schema["maxItems"]
    return found


def configuration() -> schemathesis.Config:
    config = schemathesis.Config()
    project = config.projects.default
    # A query or a header that no route has is ignored, as everywhere in HTTP: none is expected to be refused.
    project.generation.allow_extra_parameters = False
    # The token is given to every request below; schemathesis itself tries each route without, and with a wrong one.
    project.generation.with_security_parameters = False
    # tus has numbers of its own: 412 for its version, before all else, and 460 for a checksum. What is larger than a
    # setting allows (413) fits the schema, and may be the answer to a request that does not.
    checks = project.checks
    for check in (checks.negative_data_rejection, checks.positive_data_acceptance, checks.missing_required_header):
        check.expected_statuses = [*check.expected_statuses, "412", "413", "460"]
    return config


schemathesis.serializer.alias(tus.OFFSET_TYPE, "application/octet-stream")


class World:
    """A server with a file, an upload that waits for more, and a job; what a request removes is made again."""

    def __init__(self, live: Live) -> None:
        self.session = requests.Session()
        self.session.trust_env = False  # else each request looks for proxies and passwords, 1 ms
        self.statuses: set[int] = set()
        self.connect(live)
        self.file, self.job = upload(self.client), submit(self.client)
        wait(self.client, self.job)

    def connect(self, live: Live) -> None:
        self.live, self.client = live, live.client()
        self.client.headers["Authorization"] = f"Bearer {TOKEN}"

    def settle(self, case: Any) -> None:
        """Let half of the ids that fit the schema be ids of things that are there, else all answers were 404."""
        for name, value in case.path_parameters.items():
            if name == "name" and isinstance(value, str) and len(value) % 2:
                case.path_parameters[name] = "trajectory.tum"
            elif picked(value):
                case.path_parameters[name] = self._known(name, case.method, case.path)
        if isinstance(case.body, dict) and picked(case.body.get("log")):
            case.body["log"] = self.file
        logs = case.body.get("logs") if case.path == "/v1/sweeps" and isinstance(case.body, dict) else None
        if isinstance(logs, list) and logs and picked(logs[0]):
            case.body["logs"] = [self.file]
        # schemathesis 4.32 fills this header with "0" in requests that it holds for right: its pattern is too hard.
        if case.meta.generation.mode.is_positive and (case.headers or {}).get("Upload-Checksum") == "0":
            case.headers["Upload-Checksum"] = "sha1 2jmj7l5rSw0yVb/vlWAYkK/YBwk="

    def _known(self, name: str, method: str, path: str) -> str:
        if name == "share_id":
            return str(self.client.post(f"/v1/jobs/{self.job}/shares").json().get("id", uuid4()))
        if name == "job_id":
            return submit(self.client) if method == "DELETE" else self.job
        if "/tus/" in path:
            headers = {"Tus-Resumable": "1.0.0", "Upload-Length": "1000"}
            return str(self.client.post("/v1/tus", headers=headers).headers["location"]).rsplit("/", 1)[1]
        return upload(self.client) if method == "DELETE" else self.file


def picked(value: object) -> bool:
    return isinstance(value, str) and re.match(UUID_PATTERN, value) is not None and int(value[0], 16) % 2 == 0


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir=IN_MEMORY) as made:
        yield Path(made)


@pytest.fixture(scope="module")
def world(folder: Path) -> Iterator[World]:
    limits = {
        "HSLOC_TOKEN": TOKEN,
        "HSLOC_REQUESTS_PER_S": "1e6",
        "HSLOC_REFUSALS_PER_S": "1e6",
        "HSLOC_MAX_UPLOAD_BYTES": "64K",
        "HSLOC_MAX_QUEUED": "100000",
        "HSLOC_WEBHOOK_ATTEMPTS": "1",
    }
    made = World(Live(folder, **limits).start())
    # The hundreds of jobs that follow are queued and not run, which would take longer than the requests.
    assert made.live.end() == 0
    made.client.close()
    made.connect(Live(folder, **limits, HSLOC_SLOTS="0").start())
    yield made
    made.session.close()
    made.client.close()
    assert made.live.end() == 0


@hypothesis.settings(
    max_examples=6,  # beside all bounds of all fields, which schemathesis tries one by one
    derandomize=True,
    database=None,
    phases=[Phase.explicit, Phase.generate],  # to shrink takes minutes, and a request is readable as it is
    suppress_health_check=[HealthCheck.filter_too_much, HealthCheck.too_slow, HealthCheck.data_too_large],
)
def answer_is_as_described(case: Any, world: World) -> None:
    world.settle(case)
    headers = {"Authorization": f"Bearer {TOKEN}"}
    # What is wrong about a part of a multipart body (null, a number) is gone once it is bytes, and those are right.
    excluded = [negative_data_rejection] if case.path == "/v1/run" else []
    answer = case.call_and_validate(
        base_url=world.live.url, session=world.session, headers=headers, excluded_checks=excluded
    )
    world.statuses.add(answer.status_code)


def test_answers_are_as_described(world: World, subtests: pytest.Subtests) -> None:
    """`schema.parametrize()` would make the requests while tests are collected: 6 s in each process of pytest."""
    schema = schemathesis.openapi.from_dict(described(), config=configuration())
    load_all_checks()
    config = HypothesisTestConfig(project=schema.config, modes=list(HypothesisTestMode))
    operations = [found.ok() for found in schema.get_all_operations()]  # type: ignore[union-attr]
    assert len(operations) > 40
    for operation in operations:
        with subtests.test(operation.label):
            create_test(operation=operation, test_func=answer_is_as_described, config=config)(world=world)


def test_the_requests_got_beyond_the_door(world: World) -> None:
    """That the above saw more than refusals."""
    assert world.statuses >= {200, 201, 202, 204, 400, 404, 405, 409, 412, 413, 415, 422}
    assert 401 not in world.statuses

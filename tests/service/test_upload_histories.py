"""Resumable uploads in any order of requests, against a model: the offset is true, the bytes are those that came."""

from __future__ import annotations

import base64
import hashlib
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, invariant, rule
from live_service import IN_MEMORY
from live_service import settings as service_settings
from test_uploads import TUS, append, begin

from hsloc_service.housekeeping import Housekeeping
from hsloc_service.http.app import create_app

pytestmark = pytest.mark.unmeasured

TTL = 1000.0


class Model:
    """What an upload should be."""

    def __init__(self, size: int) -> None:
        self.size, self.content, self.born = size, b"", time.time()
        self.gone = False

    @property
    def whole(self) -> bool:
        return len(self.content) == self.size


class Histories(RuleBasedStateMachine):
    """A client, a server that is killed, and the clock."""

    uploads = Bundle("uploads")
    bodies = st.binary(max_size=40)

    def __init__(self) -> None:
        super().__init__()
        self.root = Path(tempfile.mkdtemp(dir=IN_MEMORY))
        self.models: dict[str, Model] = {}
        self.checked: dict[str, tuple[int, bool]] = {}
        self.up()

    def up(self) -> None:
        self.client = TestClient(create_app(service_settings(self.root, upload_ttl_s=TTL)))
        self.client.__enter__()
        self.context: Any = self.client.app.state.context  # type: ignore[attr-defined]
        self.checked.clear()

    def teardown(self) -> None:
        self.checked.clear()
        self.the_server_agrees()
        self.client.__exit__(None, None, None)
        shutil.rmtree(self.root)

    def file(self, path: str) -> Path:
        found: Path = self.context.storage.upload_path(path.rsplit("/", 1)[1])
        return found

    def expect(self, path: str, answer: Any, status: int) -> None:
        """The status, or what stands before it: an upload that is gone, or whole."""
        model = self.models[path]
        self.checked.pop(path, None)
        expected = 404 if model.gone else 409 if model.whole else status
        assert answer.status_code == expected, answer.text

    @rule(target=uploads, size=st.integers(1, 100))
    def create(self, size: int) -> str:
        path = begin(self.client, size)
        self.models[path] = Model(size)
        return path

    @rule(path=uploads, body=bodies, algorithm=st.sampled_from([None, "sha1", "sha256", "md5"]))
    def patch(self, path: str, body: bytes, algorithm: str | None) -> None:
        model = self.models[path]
        headers = {} if algorithm is None else {"Upload-Checksum": checksum(algorithm, body)}
        answer = append(self.client, path, len(model.content), body, **headers)
        fits = len(model.content) + len(body) <= model.size
        self.expect(path, answer, 204 if fits else 413)
        if answer.status_code == 204:
            model.content += body
            assert answer.headers["upload-offset"] == str(len(model.content))

    @rule(path=uploads, body=bodies, by=st.integers(-50, 50).filter(bool))
    def patch_elsewhere(self, path: str, body: bytes, by: int) -> None:
        at = max(len(self.models[path].content) + by, 0)
        if at != len(self.models[path].content):
            self.expect(path, append(self.client, path, at, body), 409)

    @rule(path=uploads, body=bodies)
    def patch_with_a_wrong_checksum(self, path: str, body: bytes) -> None:
        model = self.models[path]
        wrong = {"Upload-Checksum": checksum("sha1", body + b"x")}
        fits = len(model.content) + len(body) <= model.size
        self.expect(path, append(self.client, path, len(model.content), body, **wrong), 460 if fits else 413)

    @rule(path=uploads)
    def finish(self, path: str) -> None:
        model = self.models[path]
        rest = bytes(range(model.size - len(model.content)))
        answer = append(self.client, path, len(model.content), rest)
        self.expect(path, answer, 204)
        if answer.status_code == 204:
            model.content += rest

    @rule(path=uploads)
    def terminate(self, path: str) -> None:
        answer = self.client.delete(path, headers=TUS)
        assert answer.status_code == (404 if self.models[path].gone else 204)
        self.models[path].gone = True

    @rule(path=uploads, junk=bodies, lost=st.integers(0, 30))
    def the_server_is_killed(self, path: str, junk: bytes, lost: int) -> None:
        """Behind the offset may be bytes that were never acknowledged; a bad disk may have lost some before it."""
        model = self.models[path]
        self.client.__exit__(None, None, None)
        if not model.gone and not model.whole and self.file(path).exists():
            kept = model.content[: max(len(model.content) - lost, 0)]
            self.file(path).write_bytes(model.content + junk if lost == 0 else kept)
        self.up()
        if not model.gone and not model.whole and lost and model.content:
            answer = append(self.client, path, len(model.content), b"")  # the server finds it when it checks
            assert answer.status_code == 409
            model.content = kept

    @rule(later=st.floats(0.0, 2.0 * TTL))
    def time_goes_by(self, later: float) -> None:
        now = time.time() + later
        context = self.context
        Housekeeping(context.database, context.storage, context.settings, context.deletions).tidy(now)
        for model in self.models.values():
            if not model.whole and now > model.born + TTL + 60.0:
                model.gone = True
        for path, model in self.models.items():  # within a minute of the end, either is right
            if not model.gone and not model.whole and now > model.born + TTL - 60.0:
                model.gone = self.client.head(path, headers=TUS).status_code == 404

    @invariant()
    def the_server_agrees(self) -> None:
        for path, model in self.models.items():
            # What no request was for is looked at again after a restart, and at the end.
            if self.checked.get(path) == (now := (len(model.content), model.gone)):
                continue
            self.checked[path] = now
            answer = self.client.head(path, headers=TUS)
            found = self.client.get(path.replace("tus", "files"))
            if model.gone:
                assert (answer.status_code, found.status_code) == (404, 404)
                assert not self.file(path).exists()
                continue
            assert answer.headers["upload-offset"] == str(len(model.content))
            assert answer.headers["upload-length"] == str(model.size)
            assert ("upload-expires" in answer.headers) == (not model.whole)
            assert found.json()["state"] == ("complete" if model.whole else "receiving")
            if model.whole:
                assert found.json()["sha256"] == hashlib.sha256(model.content).hexdigest()
                assert self.file(path).read_bytes() == model.content


def checksum(algorithm: str, body: bytes) -> str:
    return f"{algorithm} {base64.b64encode(hashlib.new(algorithm, body).digest()).decode()}"


Histories.TestCase.settings = settings(
    max_examples=12,
    stateful_step_count=20,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow],
)
TestHistories = Histories.TestCase

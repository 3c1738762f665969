"""A client of the service: uploads that resume, requests that are sent again, downloads that are checked.

Standard library only. ::

    client = Client("http://127.0.0.1:8000", token="hsl_...")
    job = client.submit(client.upload(Path("run.mcap")), seed=3)
    ended = client.wait(job["id"])
    client.download(job["id"], Path("results"))

What the server says counts: a broken connection is tried again, a refusal is raised as `ClientError` with its reason.
"""

from __future__ import annotations

import base64
import hashlib
import http.client
import json
import time
import urllib.error
import urllib.request
import uuid
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from hsloc.errors import HslocError, no_such, not_read, not_written

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from os import PathLike

TUS = {"Tus-Resumable": "1.0.0"}
MIN_BLOCK = 64 << 10
ENDED = ("succeeded", "failed", "crashed", "cancelled")
_AGAIN = (408, 423, 429, 500, 502, 503, 504)
_LONGEST_WAIT_S = 30.0
FIRST_CONTACT_S = 3.0
"""A server that has never answered is given up after this time; one that has answered is waited for."""


class ClientError(HslocError):
    """The service refused, or could not be reached."""

    def __init__(self, message: str, status: int | None = None) -> None:
        super().__init__(message)
        self.status = status


class Answer(NamedTuple):
    """What the server said."""

    status: int
    headers: Mapping[str, str]
    body: bytes

    def json(self) -> Any:
        """The body as plain data."""
        return json.loads(self.body)


class Client:
    """Speaks to one service. `attempts` for each request; `timeout_s` without a byte."""

    def __init__(
        self, url: str, token: str | None = None, *, attempts: int = 10, timeout_s: float = 30.0, block: int = 8 << 20
    ) -> None:
        if not url.startswith(("http://", "https://")):
            raise ClientError(f"{url}: not the address of a service; it begins with http:// or https://")
        self.url = url.rstrip("/")
        self._token, self._attempts, self._timeout_s, self._block = token, attempts, timeout_s, block
        self._has_answered = False

    def upload(self, path: str | PathLike[str], progress: Callable[[int, int], None] | None = None) -> str:
        """Upload a file in blocks and check its SHA-256; the id that the server gave it.

        `progress` gets bytes done and bytes in all.
        """
        path = Path(path)
        try:
            with path.open("rb") as file:
                size = file.seek(0, 2)
                if size == 0:
                    raise ClientError(f"{path}: is empty (0 bytes); copy it again, or record again")
                name = base64.b64encode(path.name.encode()).decode()
                headers = {**TUS, "Upload-Length": str(size), "Upload-Metadata": f"filename {name}"}
                place = self.request("POST", "/v1/tus", headers=headers).headers["Location"]
                self._send(file, place, size, progress)
                digest = hashlib.sha256()
                file.seek(0)
                while part := file.read(1 << 20):
                    digest.update(part)
        except FileNotFoundError as error:
            raise ClientError(no_such(path)) from error
        except OSError as error:
            raise ClientError(not_read(path, error)) from error
        ident = place.rsplit("/", 1)[1]
        if self.request("GET", f"/v1/files/{ident}").json()["sha256"] != digest.hexdigest():
            raise ClientError(f"{path}: arrived changed; was it written to meanwhile?")
        return ident

    def _send(self, file: Any, place: str, size: int, progress: Callable[[int, int], None] | None) -> None:
        offset, failures = 0, 0
        while offset < size:
            file.seek(offset)
            block = file.read(self._block)
            if not block:
                raise ClientError("the file became shorter while it was read")
            headers = {**TUS, "Upload-Offset": str(offset), "Content-Type": "application/offset+octet-stream"}
            headers["Upload-Checksum"] = f"sha256 {base64.b64encode(hashlib.sha256(block).digest()).decode()}"
            try:
                offset = int(self._once("PATCH", place, block, headers).headers["Upload-Offset"])
                failures = 0
            except ClientError as error:
                failures += 1
                if error.status == 413 and self._block > MIN_BLOCK:
                    self._block //= 2  # a proxy takes smaller bodies only: nginx 1 MiB, unless it is configured
                    continue
                if failures >= self._attempts or (error.status not in (None, 409, 460, *_AGAIN)):
                    raise
                time.sleep(min(0.2 * 2.0**failures, _LONGEST_WAIT_S))
                offset = int(self.request("HEAD", place, headers=TUS).headers["Upload-Offset"])
            if progress is not None:
                progress(offset, size)

    def submit(self, log: str | Sequence[str], **request: Any) -> dict[str, Any]:
        """Queue a job on an uploaded log, or on several that are parts of one run; options as in the API.

        Among them `relations`, the id of an upload, `resume`, the id of a job whose map is extended, and `map` and
        `align_to`, `{"yaml": ..., "image": ...}` with the ids of two uploads. Sent again without harm
        (Idempotency-Key).
        """
        logs = [log] if isinstance(log, str) else list(log)
        return self._post_once("/v1/jobs", {**({"log": logs[0]} if len(logs) == 1 else {"logs": logs}), **request})

    def submit_sweep(self, logs: Sequence[str], **request: Any) -> dict[str, Any]:
        """Queue a job for each uploaded log, configuration and seed: `seeds`, `configs`, `run`, `name` as in the API.

        Sent again without harm (Idempotency-Key).
        """
        return self._post_once("/v1/sweeps", {"logs": list(logs), **request})

    def _post_once(self, path: str, values: Mapping[str, Any]) -> dict[str, Any]:
        """The answer to values under an Idempotency-Key of their own."""
        headers = {"Content-Type": "application/json", "Idempotency-Key": str(uuid.uuid4())}
        found: dict[str, Any] = self.request("POST", path, json.dumps(values).encode(), headers).json()
        return found

    def wait_sweep(
        self, sweep_id: str, progress: Callable[[dict[str, Any]], None] | None = None, every_s: float = 1.0
    ) -> list[dict[str, Any]]:
        """The table of a sweep when all its jobs have ended; `progress` gets the sweep now and then."""
        self._wait(f"/v1/sweeps/{sweep_id}", lambda sweep: bool(sweep["ended"]), progress, every_s)
        rows: list[dict[str, Any]] = self.request("GET", f"/v1/sweeps/{sweep_id}/table").json()["rows"]
        return rows

    def job(self, job_id: str) -> dict[str, Any]:
        """The state of a job."""
        found: dict[str, Any] = self.request("GET", f"/v1/jobs/{job_id}").json()
        return found

    def workers(self) -> list[dict[str, Any]]:
        """The servers and workers that share the service's database; the token needs the scope `admin`."""
        found: list[dict[str, Any]] = self.request("GET", "/v1/workers").json()["workers"]
        return found

    def cancel(self, job_id: str) -> dict[str, Any]:
        """Ask for the end of a job."""
        found: dict[str, Any] = self.request("POST", f"/v1/jobs/{job_id}/cancel").json()
        return found

    def wait(
        self, job_id: str, progress: Callable[[dict[str, Any]], None] | None = None, every_s: float = 0.5
    ) -> dict[str, Any]:
        """The job when it has ended; `progress` gets it now and then. A server that is away for a while is no end."""
        return self._wait(f"/v1/jobs/{job_id}", lambda job: job["state"] in ENDED, progress, every_s)

    def _wait(
        self,
        path: str,
        has_ended: Callable[[dict[str, Any]], bool],
        progress: Callable[[dict[str, Any]], None] | None,
        every_s: float,
    ) -> dict[str, Any]:
        while True:
            found: dict[str, Any] = self.request("GET", path).json()
            if progress is not None:
                progress(found)
            if has_ended(found):
                return found
            time.sleep(every_s)

    def download(self, job_id: str, folder: str | PathLike[str]) -> list[Path]:
        """All files of the results into a folder, each checked against the manifest."""
        folder = Path(folder)
        manifest = self.request("GET", f"/v1/jobs/{job_id}/results").json()
        paths = []
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for asset in manifest["assets"]:
                if "/" in asset["name"] or asset["name"].startswith("."):
                    raise ClientError(f"the server names a file {asset['name']!r}, which is no plain name")
                paths.append(self._fetch(asset, folder / asset["name"]))
        except OSError as error:
            raise ClientError(not_written(folder, error)) from error
        return paths

    def _fetch(self, asset: Mapping[str, Any], path: Path) -> Path:
        """One file, by ranges, so that a broken line costs one block."""
        partial = path.with_name(f".{path.name}.partial")
        digest = hashlib.sha256()
        with partial.open("wb") as file:
            while (at := file.tell()) < asset["size"]:
                headers = {"Range": f"bytes={at}-{min(at + self._block, asset['size']) - 1}"}
                answer = self.request("GET", asset["href"], headers=headers)
                if answer.status != 206 or not answer.body:
                    raise ClientError(f"{asset['name']}: the server does not send the range that was asked for")
                digest.update(answer.body)
                file.write(answer.body)
        if digest.hexdigest() != asset["sha256"]:
            partial.unlink()
            raise ClientError(f"{asset['name']}: arrived changed; download it again")
        partial.replace(path)
        return path

    def request(
        self, method: str, path: str, body: bytes | None = None, headers: Mapping[str, str] | None = None
    ) -> Answer:
        """A request that may be sent again, and is, with growing waits or as the server says."""
        begin = time.monotonic()
        for attempt in range(1, self._attempts + 1):
            try:
                return self._once(method, path, body, headers)
            except _Again as error:
                if attempt == self._attempts:
                    raise ClientError(str(error), error.status) from error
                if not self._has_answered and time.monotonic() - begin > FIRST_CONTACT_S:
                    raise ClientError(f"{error}; is the server running, and the address right?") from error
                time.sleep(min(error.wait_s or 0.2 * 2.0**attempt, _LONGEST_WAIT_S))
        raise ClientError(f"{self.url}: no attempt was allowed")

    def _once(
        self, method: str, path: str, body: bytes | None = None, headers: Mapping[str, str] | None = None
    ) -> Answer:
        # A place that the server names may lead elsewhere; the token must not.
        if not path.startswith("/") or path.startswith("//"):
            raise ClientError(f"{self.url}: the server names a place elsewhere: {path[:100]!r}")
        request = urllib.request.Request(self.url + path, data=body, method=method, headers=dict(headers or {}))
        if self._token:
            request.add_header("Authorization", f"Bearer {self._token}")
        try:
            with urllib.request.urlopen(request, timeout=self._timeout_s) as answer:
                self._has_answered = True
                return Answer(answer.status, answer.headers, answer.read())
        except urllib.error.HTTPError as error:
            self._has_answered = True
            with error:
                message = f"{self.url}: {_reason(error)}"
                if error.code in _AGAIN:
                    raise _Again(message, error.code, _seconds(error.headers.get("Retry-After"))) from error
                raise ClientError(message, error.code) from error
        except (OSError, http.client.HTTPException) as error:
            cause = getattr(error, "reason", error)
            raise _Again(f"{self.url}: cannot be reached: {cause}") from error


class _Again(ClientError):
    """Worth another attempt."""

    def __init__(self, message: str, status: int | None = None, wait_s: float | None = None) -> None:
        super().__init__(message, status)
        self.wait_s = wait_s


def _reason(error: urllib.error.HTTPError) -> str:
    try:
        return str(json.loads(error.read(65536))["message"])
    except (ValueError, KeyError, TypeError, OSError):
        return f"answered {error.code} {error.reason}"


def _seconds(text: str | None) -> float | None:
    return float(text) if text is not None and text.isdecimal() else None

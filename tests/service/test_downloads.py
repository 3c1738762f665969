"""Downloads: whole also when their job is deleted meanwhile, 404 where the disk lost them, HEAD."""

from __future__ import annotations

import hashlib
import io
import shutil
import zipfile
from typing import TYPE_CHECKING

from live_service import submit, wait

if TYPE_CHECKING:
    from collections.abc import Callable

    from live_service import Live


def test_a_download_ends_whole_when_its_job_is_deleted_meanwhile(make_live: Callable[..., Live]) -> None:
    live = make_live()
    with live.client() as client:
        job = submit(client, b"large 60")
        wait(client, job)
        digests = {a["name"]: a["sha256"] for a in client.get(f"/v1/jobs/{job}/results").json()["assets"]}
        with (
            client.stream("GET", f"/v1/jobs/{job}/results/large.bin") as file,
            client.stream("GET", f"/v1/jobs/{job}/results.zip") as archive,
        ):
            parts, zipped = file.iter_bytes(1 << 16), archive.iter_bytes(1 << 16)
            begun, begun_zip = next(parts), next(zipped)
            with live.client() as other:
                assert other.delete(f"/v1/jobs/{job}").status_code == 204
            content, packed = begun + b"".join(parts), begun_zip + b"".join(zipped)
        assert hashlib.sha256(content).hexdigest() == digests["large.bin"]
        assert hashlib.sha256(zipfile.ZipFile(io.BytesIO(packed)).read("large.bin")).hexdigest() == digests["large.bin"]
        assert client.get(f"/v1/jobs/{job}/results/large.bin").status_code == 404
    assert "Traceback" not in live.log.read_text()


def test_results_that_vanished_from_the_disk_are_not_found(make_live: Callable[..., Live]) -> None:
    live = make_live()
    with live.client() as client:
        job = submit(client)
        wait(client, job)
        shutil.rmtree(live.data / "results" / f"{job}.1")
        for name in ("results/trajectory.tum", "results.zip"):
            assert client.get(f"/v1/jobs/{job}/{name}").status_code == 404
    assert "Traceback" not in live.log.read_text()


def test_head_has_the_headers_of_get_and_no_body(make_live: Callable[..., Live]) -> None:
    live = make_live()
    with live.client() as client:
        job = submit(client)
        wait(client, job)
        for path in (f"/v1/jobs/{job}/results/trajectory.tum", f"/v1/jobs/{job}", "/", "/healthz"):
            got, head = client.get(path), client.head(path)
            assert (head.status_code, head.content) == (200, b"")
            assert head.headers["content-length"] == got.headers["content-length"]
            assert head.headers.get("etag") == got.headers.get("etag")
        assert client.head("/v1/jobs/absent").status_code in (404, 422)

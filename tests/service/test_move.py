"""A data folder moved to PostgreSQL: everything is there, goes on, and nothing is mixed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fastapi.testclient import TestClient
from live_service import settings, submit, wait

from hsloc.cli.main import main
from hsloc_service.errors import StoreError
from hsloc_service.http.app import create_app
from hsloc_service.results.stores import ObjectStore

if TYPE_CHECKING:
    from pathlib import Path

    import pytest
    from postgresql import Server

    from hsloc_service.results.store import Asset


def test_a_data_folder_goes_on_with_postgresql(
    tmp_path: Path, postgresql: Server, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, url = tmp_path / "data", postgresql.new_database()
    words = ["serve", "--data", str(folder), "--move-to"]

    def refused(*more: str) -> str:
        assert main([*words, *more]) == 1
        return capsys.readouterr().err

    assert "no data folder of hsloc" in refused(url)
    with TestClient(create_app(settings(tmp_path))) as client:
        jobs = [submit(client, b"ok"), submit(client, b"exit 3")]
        before = [wait(client, job) for job in jobs]
        asset = client.get(f"/v1/jobs/{jobs[0]}/results/trajectory.tum").content
        manifest = client.get(f"/v1/jobs/{jobs[0]}/results").json()["assets"]
        assert "is using this folder" in refused(url)
    assert "a move is to PostgreSQL" in refused(f"sqlite:///{tmp_path}/other.db")
    assert main([*words, url]) == 0
    assert "2 jobs, 2 uploads" in capsys.readouterr().out
    assert "has rows; give an empty database" in refused(url)

    # With a store, also uploads and results; broken off, it goes on from there.
    shared = {"database_url": postgresql.new_database(), "store_url": f"file://{tmp_path}/store"}
    monkeypatch.setenv("HSLOC_STORE_URL", shared["store_url"])
    publish = ObjectStore.publish
    with monkeypatch.context() as context:
        fail_at = iter([False, False, True])

        def fail(store: ObjectStore, output: Path, name: str, assets: list[Asset]) -> None:
            if next(fail_at):
                raise StoreError("the store is away")
            publish(store, output, name, assets)

        context.setattr(ObjectStore, "publish", fail)
        assert "the store is away; when it is mended, run the same again" in refused(shared["database_url"])
    assert main([*words, shared["database_url"]]) == 0
    assert f" {sum(each['size'] for each in manifest)} bytes copied to file://" in capsys.readouterr().out
    with TestClient(create_app(settings(tmp_path / "elsewhere", **shared))) as client:
        assert client.get(f"/v1/jobs/{jobs[0]}/results/trajectory.tum").content == asset
        assert wait(client, client.post(f"/v1/jobs/{jobs[0]}/rerun").json()["id"])["state"] == "succeeded"
    monkeypatch.delenv("HSLOC_STORE_URL")
    upload = tmp_path / "data" / "uploads" / before[0]["request"]["log"]
    upload.chmod(0o600)
    upload.write_bytes(b"no")
    monkeypatch.setenv("HSLOC_STORE_URL", f"file://{tmp_path}/third")
    assert "it is not what the database says" in refused(postgresql.new_database())
    monkeypatch.delenv("HSLOC_STORE_URL")

    with TestClient(create_app(settings(tmp_path, database_url=url))) as client:
        after = client.get("/v1/jobs").json()["jobs"]
        assert [(job["id"], job["seq"], job["state"]) for job in after] == [
            (job["id"], job["seq"], job["state"]) for job in reversed(before)
        ]
        assert client.get(f"/v1/jobs/{jobs[0]}/results/trajectory.tum").content == asset
        events = client.get(f"/v1/jobs/{jobs[0]}/events").text
        later = submit(client)
        assert wait(client, later)["seq"] == 3
        assert client.get(f"/v1/jobs/{jobs[0]}/events").text == events
        assert client.delete(f"/v1/jobs/{jobs[1]}").status_code == 204

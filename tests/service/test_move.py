"""A data folder moved to PostgreSQL: everything is there, goes on, and nothing is mixed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fastapi.testclient import TestClient
from live_service import settings, submit, wait

from hsloc.cli.main import main
from hsloc_service.http.app import create_app

if TYPE_CHECKING:
    from pathlib import Path

    import pytest
    from postgresql import Server


def test_a_data_folder_goes_on_with_postgresql(
    tmp_path: Path, postgresql: Server, capsys: pytest.CaptureFixture[str]
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
        assert "is using this folder" in refused(url)
    assert "a move is to PostgreSQL" in refused(f"sqlite:///{tmp_path}/other.db")
    assert main([*words, url]) == 0
    assert "2 jobs, 2 uploads" in capsys.readouterr().out
    assert "has rows; give an empty database" in refused(url)
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

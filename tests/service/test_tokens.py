"""Tokens: made, listed, revoked, kept as hashes alone, and in the audit log."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from fastapi.testclient import TestClient
from live_service import settings, submit, wait

from hsloc.cli.main import main as program
from hsloc_service.auth import Tokens
from hsloc_service.db.database import Database
from hsloc_service.http.app import create_app
from hsloc_service.main import with_tokens
from hsloc_service.settings import SettingsError
from hsloc_service.storage import Storage

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from live_service import Live


def test_it_does_not_listen_beyond_loopback_without_a_token(tmp_path: Path) -> None:
    chosen = settings(tmp_path)
    with pytest.raises(SettingsError, match="no token exists"):
        with_tokens(chosen, "0.0.0.0", open_to_all=False, first_token=False, secret=None)
    assert not with_tokens(chosen, "127.0.0.1", False, False, None).require_token
    assert not with_tokens(chosen, "0.0.0.0", True, False, None).require_token
    with pytest.raises(SettingsError, match="24 or more"):
        with_tokens(chosen, "0.0.0.0", False, False, "short")
    assert with_tokens(chosen, "0.0.0.0", False, False, "x" * 32).require_token
    assert with_tokens(chosen, "127.0.0.1", True, False, None).require_token  # now there is a token


def test_the_token_is_not_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    chosen = settings(tmp_path)
    assert with_tokens(chosen, "0.0.0.0", False, True, None).require_token
    token = capsys.readouterr().out.split(": ")[1].strip()
    assert token.startswith("hsl_")
    with_tokens(chosen, "0.0.0.0", False, True, None)
    assert capsys.readouterr().out == ""  # the first start only
    files = [path for path in chosen.data.rglob("*") if path.is_file()]
    assert chosen.data / "hsloc.db" in files
    for path in files:
        assert token.encode() not in path.read_bytes()
        assert token[-20:].encode() not in path.read_bytes(), "nor the end of it"


def test_tokens_are_listed_and_revoked_while_the_service_runs(
    make_live: Callable[..., Live], capsys: pytest.CaptureFixture[str]
) -> None:
    live = make_live(HSLOC_REQUIRE_TOKEN="1")

    def serve(*options: str) -> tuple[int, str, str]:
        code = program(["serve", "--data", str(live.data), *options])
        out, err = capsys.readouterr()
        return code, out, err

    token = serve("--new-token", "one", "--scopes", "read", "--expires-days", "2")[1].split(": ")[1].strip()
    code, listed, _ = serve("--list-tokens")
    ident, tenant, scopes = listed.split()[:3]
    assert (code, tenant, scopes) == (0, "one", "read")
    assert "expires 2" in listed
    assert token not in listed
    with live.client() as client:
        client.headers["Authorization"] = f"Bearer {token}"
        assert client.get("/v1/info").status_code == 200
        assert serve("--revoke-token", ident)[0] == 0
        assert client.get("/v1/info").status_code == 401
    assert serve("--list-tokens")[1].rstrip().endswith("revoked")
    for options, expected in ((["--revoke-token", "nothing"], "no token 'nothing'"), ([], "no data folder")):
        folder = [] if options else ["--data", str(live.data / "elsewhere"), "--list-tokens"]
        code, _, err = serve(*options, *folder)
        assert code == 1
        assert expected in err
        assert err.count("\n") == 1


def test_another_token_of_the_operator_ends_the_one_before(tmp_path: Path) -> None:
    chosen = settings(tmp_path)
    for secret in ("a" * 32, "b" * 32, "b" * 32):
        with_tokens(chosen, "127.0.0.1", False, False, secret)
    database = Database(chosen.data / "hsloc.db")
    tokens = Tokens(database)
    made = tokens.issue("default")
    assert tokens.principal("a" * 32) is None
    assert tokens.principal("b" * 32) is not None
    assert tokens.principal(made) is not None
    database.close()


def test_a_server_that_may_not_start_changes_nothing(tmp_path: Path) -> None:
    """Its folder is held by another, perhaps an older one, whose database it would migrate."""
    chosen = settings(tmp_path)
    storage = Storage(chosen.data)
    with pytest.raises(SettingsError, match="another hsloc service"):
        with_tokens(chosen, "127.0.0.1", False, False, "a" * 32)
    assert not (chosen.data / "hsloc.db").exists()
    storage.close()


def test_a_token_made_while_an_open_server_runs_closes_it(
    make_live: Callable[..., Live], capsys: pytest.CaptureFixture[str]
) -> None:
    live = make_live()
    with live.client() as client:
        assert client.get("/v1/jobs").status_code == 200
        assert program(["serve", "--data", str(live.data), "--new-token", "one"]) == 0
        token = capsys.readouterr().out.split(": ")[1].strip()
        assert client.get("/v1/jobs").status_code == 401
        assert client.get("/v1/jobs", headers={"Authorization": f"Bearer {token}"}).status_code == 200


def test_tokens_and_deletions_are_in_the_audit_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    app = create_app(chosen := settings(tmp_path, require_token=True))
    with TestClient(app) as client:
        tokens = Tokens(app.state.context.database)
        one, other = tokens.issue("one"), tokens.issue("two")
        client.headers["Authorization"] = f"Bearer {one}"
        job = submit(client)
        wait(client, job)
        file = client.get(f"/v1/jobs/{job}").json()["request"]["log"]
        assert client.delete(f"/v1/jobs/{job}").status_code == 204
        assert client.delete(f"/v1/files/{file}").status_code == 204
        tokens.revoke(other.split("_")[1])
        found = client.get("/v1/audit", params={"limit": 2}).json()
        actor = one.split("_")[1]
        assert [(each["actor"], each["action"], each["target"]) for each in found["entries"]] == [
            (actor, "file.delete", file), (actor, "job.delete", job),
        ]  # fmt: skip
        more = client.get("/v1/audit", params={"before": found["next"]}).json()["entries"]
        assert [(each["actor"], each["action"], each["target"]) for each in more] == [
            ("operator", "token.issue", actor)
        ]
    assert program(["serve", "--data", str(chosen.data), "--audit"]) == 0
    lines = [line.split("  ")[1:] for line in capsys.readouterr().out.splitlines()]
    assert lines[-1] == ["two", "operator", "token.revoke", other.split("_")[1]]
    assert len(lines) == 5

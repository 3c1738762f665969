"""Start the service: check what it listens on, make the first token, run uvicorn."""

from __future__ import annotations

import dataclasses
import ipaddress
import os
import resource
import signal
import socket
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import uvicorn

from hsloc_service import audit
from hsloc_service.auth import SCOPES, Tokens
from hsloc_service.backup import back_up, move
from hsloc_service.db.database import database_place, open_database
from hsloc_service.http.app import create_app
from hsloc_service.http.middleware import protocol_class
from hsloc_service.logs import configure
from hsloc_service.settings import Settings, SettingsError
from hsloc_service.storage import Storage, make_data_folder

if TYPE_CHECKING:
    from collections.abc import Iterator

    from fastapi import FastAPI

    from hsloc_service.db.database import Database

AUDIT_LINES = 1000
SHUTDOWN_S = 10
BACKLOG = 2048


class Server(uvicorn.Server):
    """Ends the event streams when it is asked to stop; else it would wait for them."""

    def __init__(self, config: uvicorn.Config, app: FastAPI) -> None:
        super().__init__(config)
        self._hsloc = app

    def handle_exit(self, sig: int, frame: Any) -> None:
        """SIGTERM or SIGINT."""
        self._hsloc.state.context.stopping.set()
        super().handle_exit(sig, frame)


def serve(
    settings: Settings,
    host: str = "127.0.0.1",
    port: int = 8000,
    *,
    open_to_all: bool = False,
    first_token: bool = False,
    secret: str | None = None,
) -> int:
    """Serve until SIGTERM; the exit code.

    Without any token the service answers loopback only, unless `open_to_all`. `first_token` makes one on the first
    start and writes it to stdout; `secret` is a token that the operator chose. Raises SettingsError.
    """
    listener = listen(host, port)  # before anything is recovered, by a server that cannot be reached
    try:
        app = create_app(settings := with_tokens(settings, host, open_to_all, first_token, secret))
    except BaseException:
        listener.close()
        raise
    configure()
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, min(hard, 65536) if hard > 0 else 65536), hard))
    config = uvicorn.Config(
        app,
        http=protocol_class(
            settings.header_timeout_s,
            settings.body_timeout_s,
            settings.write_timeout_s,
            settings.max_connections,
            settings.min_body_bytes_per_s,
        ),
        ws="none",
        loop="asyncio",
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers=bool(settings.trusted_proxies),
        forwarded_allow_ips=list(settings.trusted_proxies),
        timeout_keep_alive=5,
        timeout_graceful_shutdown=SHUTDOWN_S,
    )
    server = Server(config, app)
    for which in (signal.SIGTERM, signal.SIGINT):
        # uvicorn raises the signal once more when it is done; being asked to stop is no failure.
        signal.signal(which, lambda *_: None)
    try:
        server.run(sockets=[listener])
    finally:
        listener.close()
    return 0 if server.started else 1


def listen(host: str, port: int) -> socket.socket:
    """A socket that listens at the address. Raises SettingsError where it cannot."""
    try:
        family, _, _, _, address = socket.getaddrinfo(host.strip("[]"), port, type=socket.SOCK_STREAM)[0]
        return socket.create_server(address, family=family, backlog=BACKLOG)
    except OSError as error:
        number = error.errno or 0
        cause = os.strerror(number) if number > 0 else error.strerror
        raise SettingsError(f"{host}:{port}: cannot be listened at: {cause}; give another --host or --port") from error


def with_tokens(settings: Settings, host: str, open_to_all: bool, first_token: bool, secret: str | None) -> Settings:
    """The settings, with tokens required where they must be. Raises SettingsError where none is there."""
    # A server that holds the folder must not find its database migrated, or its token gone, by one that may not start.
    Storage(settings.data, settings.min_free_bytes).close()
    database = open_database(settings)
    try:
        tokens = Tokens(database)
        if secret is not None:
            if len(secret) < 24:
                raise SettingsError(f"the token has {len(secret)} characters; it must have 24 or more")
            tokens.issue_operators("default", secret)
        elif first_token and not tokens.any():
            show_token(tokens.issue("default", label="first"))
        required = settings.require_token or tokens.any()
    finally:
        database.close()
    if not required and not open_to_all and not is_loopback(host):
        raise SettingsError(
            f"host is {host}, and no token exists: everybody who reaches it could do everything; "
            "make one with --first-token or `hsloc serve --new-token TENANT`, or pass --open-to-all"
        )
    hosts = settings.allowed_hosts if host in settings.allowed_hosts else (*settings.allowed_hosts, host)
    return dataclasses.replace(settings, require_token=required, allowed_hosts=hosts)


def back_up_folder(settings: Settings, target: Path) -> int:
    """Make a backup and show what it holds; works while the service runs. Raises SettingsError."""
    if settings.database_url:
        raise SettingsError(
            "--backup is for a data folder with its own database; back up HSLOC_DATABASE_URL by pg_dump"
        )
    report = back_up(settings.data, target)
    lost = f"; {report.deleted} were deleted meanwhile" if report.deleted else ""
    counts = f"{report.uploads} uploads, {report.jobs} jobs, {report.results} results, {report.bytes} bytes"
    sys.stdout.write(f"{target}: {counts}{lost}\n")
    return 0


def move_database(settings: Settings, url: str) -> int:
    """Move the data folder to PostgreSQL, and to the store that is set; show what was moved. Raises SettingsError."""
    report = move(settings, url)
    counts = f"{report.jobs} jobs, {report.uploads} uploads, {report.rows} rows"
    if settings.store_url:
        rest = (
            f"{report.copied} bytes copied to {settings.store_url}; start with HSLOC_DATABASE_URL and HSLOC_STORE_URL"
        )
    else:
        rest = "start with HSLOC_DATABASE_URL and the same --data, which keeps uploads and results"
    sys.stdout.write(f"{counts}; {rest}\n")
    return 0


def new_token(settings: Settings, tenant: str, scopes: str = ",".join(SCOPES), days: float | None = None) -> int:
    """Make a token and show it; works while the service runs. Raises SettingsError."""
    make_data_folder(settings.data)
    database = open_database(settings)
    try:
        chosen = tuple(part.strip() for part in scopes.split(",") if part.strip())
        expires = None if days is None else time.time() + days * 86400.0
        show_token(Tokens(database).issue(tenant, chosen, expires=expires))
    except ValueError as error:
        raise SettingsError(str(error)) from error
    finally:
        database.close()
    return 0


def list_tokens(settings: Settings) -> int:
    """Show what tokens there are; works while the service runs. Raises SettingsError."""
    with _tokens(settings) as tokens:
        for row in tokens.rows():
            state = "revoked" if row.revoked is not None else "never expires"
            if row.revoked is None and row.expires is not None:
                state = f"expires {time.strftime('%Y-%m-%dT%H:%MZ', time.gmtime(row.expires))}"
            made = time.strftime("%Y-%m-%dT%H:%MZ", time.gmtime(row.created))
            sys.stdout.write(f"{row.id}  {row.tenant}  {row.scopes.replace(' ', ',')}  made {made}  {state}\n")
    return 0


def show_audit(settings: Settings) -> int:
    """Show the newest tokens and deletions of all tenants; works while the service runs. Raises SettingsError."""
    with _database(settings) as database:
        for row in reversed(audit.entries(database, None, None, AUDIT_LINES)):
            at = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(row.at))
            sys.stdout.write(f"{at}  {row.tenant}  {row.actor or 'without a token'}  {row.action}  {row.target}\n")
    return 0


def revoke_token(settings: Settings, ident: str) -> int:
    """Make a token worthless from the next request on; works while the service runs. Raises SettingsError."""
    with _tokens(settings) as tokens:
        if not tokens.revoke(ident):
            raise SettingsError(f"there is no token {ident!r}; `hsloc serve --list-tokens` shows what there is")
    return 0


@contextmanager
def _tokens(settings: Settings) -> Iterator[Tokens]:
    with _database(settings) as database:
        yield Tokens(database)


@contextmanager
def _database(settings: Settings) -> Iterator[Database]:
    """The database of a data folder that exists already."""
    place = database_place(settings)
    if isinstance(place, Path) and not place.is_file():
        raise SettingsError(f"{settings.data}: no data folder of hsloc; name it with --data")
    database = open_database(settings)
    try:
        yield database
    finally:
        database.close()


def show_token(token: str) -> None:
    """Once, on stdout."""
    sys.stdout.write(f"token (shown this once): {token}\n")
    sys.stdout.flush()


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches it."""
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"

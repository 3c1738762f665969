"""Serve the HTTP API and the web page: upload a log, watch the job, look at the result."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from hsloc.cli import service_module

if TYPE_CHECKING:
    import argparse

HELP = "serve the HTTP API and the web page"
EXAMPLES = """
  hsloc serve                                  on http://127.0.0.1:8000, for this machine
  hsloc serve --host 0.0.0.0 --first-token --slots 2

Everything else, such as limits, is set by variables HSLOC_<NAME>: HSLOC_MAX_UPLOAD_BYTES=2G, HSLOC_JOB_MEMORY_BYTES=4G,
HSLOC_MIN_FREE_BYTES=256M, HSLOC_RETENTION_S, ...; HSLOC_TOKEN is a token of your own choice.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Where to listen, where to keep, who may ask."""
    parser.add_argument("--host", default="127.0.0.1", help="Address to listen on (default: 127.0.0.1).")
    parser.add_argument("--port", type=int, default=8000, help="Port to listen on (default: 8000).")
    parser.add_argument(
        "--data", type=Path, metavar="DIR", help="Folder of all data (default: $HSLOC_SERVE_DATA, else hsloc-data)."
    )
    parser.add_argument("--slots", type=int, metavar="N", help="Jobs at the same time (default: 1).")
    parser.add_argument(
        "--allowed-host", action="append", metavar="NAME", help="Answer requests for this host name, too; * for any."
    )
    parser.add_argument(
        "--retention-days", type=float, metavar="D", help="Remove jobs that ended more than this many days ago."
    )
    parser.add_argument(
        "--backup", type=Path, metavar="DIR", help="Copy the data folder to DIR, also while a server runs, and exit."
    )
    parser.add_argument(
        "--move-to", metavar="URL",
        help="Copy the data folder's database to an empty PostgreSQL, postgresql://USER@HOST/NAME, its uploads and "
        "results to $HSLOC_STORE_URL if that is set, and exit. Broken off, it is run again and goes on.",
    )  # fmt: skip
    group = parser.add_argument_group("tokens")
    group.add_argument("--first-token", action="store_true", help="Make a token on the first start and print it.")
    group.add_argument("--open-to-all", action="store_true", help="Listen beyond loopback without any token.")
    group.add_argument("--new-token", metavar="TENANT", help="Make a token for a tenant, print it, and exit.")
    group.add_argument("--scopes", default="read,write,admin", help="Scopes of the new token (default: all).")
    group.add_argument("--expires-days", type=float, metavar="D", help="Validity of the new token [days].")
    group.add_argument("--list-tokens", action="store_true", help="Show the ids and tenants of the tokens, and exit.")
    group.add_argument("--audit", action="store_true", help="Show the newest tokens and deletions, and exit.")
    group.add_argument("--revoke-token", metavar="ID", help="Revoke a token, and exit.")


def run(arguments: argparse.Namespace) -> int:
    """Serve until SIGTERM."""
    from hsloc.errors import ConfigError

    service, settings = service_module("main"), service_module("settings")
    try:
        retention = None if arguments.retention_days is None else arguments.retention_days * 86400.0
        chosen = settings.from_environment(data=arguments.data, slots=arguments.slots, retention_s=retention)
        if arguments.allowed_host:
            from dataclasses import replace

            chosen = replace(chosen, allowed_hosts=(*chosen.allowed_hosts, *arguments.allowed_host))
        if arguments.backup is not None:
            return int(service.back_up_folder(chosen, arguments.backup))
        if arguments.move_to is not None:
            return int(service.move_database(chosen, arguments.move_to))
        if arguments.new_token is not None:
            return int(service.new_token(chosen, arguments.new_token, arguments.scopes, arguments.expires_days))
        if arguments.list_tokens:
            return int(service.list_tokens(chosen))
        if arguments.audit:
            return int(service.show_audit(chosen))
        if arguments.revoke_token is not None:
            return int(service.revoke_token(chosen, arguments.revoke_token))
        return int(
            service.serve(
                chosen,
                arguments.host,
                arguments.port,
                open_to_all=arguments.open_to_all,
                first_token=arguments.first_token,
                secret=os.environ.get("HSLOC_TOKEN"),
            )
        )
    except settings.SettingsError as error:
        raise ConfigError(str(error)) from error

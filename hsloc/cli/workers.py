"""Show the servers and workers of a running service: slots, jobs, last heartbeat."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from hsloc.cli.arguments import add_service, service_client

if TYPE_CHECKING:
    import argparse

HELP = "show the servers and workers of a service"
EXAMPLES = """
  hsloc workers
  hsloc workers --url https://robots.example.com --json

The token, if the service asks for one, is read from $HSLOC_TOKEN; it needs the scope admin.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Whom to ask."""
    add_service(parser)
    parser.add_argument("--json", action="store_true", help="Print what the service answers.")


def run(arguments: argparse.Namespace) -> int:
    """Ask and print; 1 if one of them is not alive."""
    from hsloc.cli.main import EXIT_FAILED, EXIT_OK
    from hsloc.text_table import table

    found: list[dict[str, Any]] = service_client(arguments).workers()
    if arguments.json:
        print(json.dumps(found, indent=2))
    elif not found:
        print("the service has a database of its own, which no worker shares")
    else:
        head = ("kind", "host", "pid", "slots", "busy", "heartbeat", "state", "your jobs")
        print("\n".join(table(head, [_row(each) for each in found])).rstrip())
    return EXIT_OK if all(each["alive"] for each in found) else EXIT_FAILED


def _row(worker: dict[str, Any]) -> tuple[str, ...]:
    state = "gone" if not worker["alive"] else "draining" if worker["draining"] else "ok"
    numbers = (str(worker[name]) for name in ("pid", "slots", "busy"))
    age = f"{worker['heartbeat_age_s']:.1f} s ago"
    return (worker["kind"], worker["host"], *numbers, age, state, ", ".join(worker["jobs"]) or "-")

"""Run the jobs of services on other machines: a worker, without HTTP.

It shares the services' database (HSLOC_DATABASE_URL, PostgreSQL) and object store (HSLOC_STORE_URL).
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from hsloc.cli import service_module

if TYPE_CHECKING:
    import argparse

HELP = "run the jobs of services on other machines"
EXAMPLES = """
  export HSLOC_DATABASE_URL=postgresql://hsloc@db/hsloc HSLOC_STORE_URL=s3://bucket/hsloc
  hsloc work --slots 2
  hsloc work --data /var/tmp/hsloc --tags big-memory --drain-s 600

SIGTERM: no job is begun any more, those that run may end for --drain-s seconds; a second one ends at once.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Where to work, and how much."""
    parser.add_argument(
        "--data", type=Path, metavar="DIR",
        help="Folder of this worker alone, on a local disk (default: $HSLOC_SERVE_DATA, else hsloc-data).",
    )  # fmt: skip
    parser.add_argument("--slots", type=int, metavar="N", help="Jobs at the same time (default: 1).")
    parser.add_argument(
        "--tags", metavar="A,B",
        help="Run jobs with these tags, too, such as big-memory; those without a tag run everywhere.",
    )  # fmt: skip
    parser.add_argument(
        "--metrics", metavar="[HOST:]PORT",
        help="Address of metrics for Prometheus, without a token (default: none; HOST by default 127.0.0.1).",
    )  # fmt: skip
    parser.add_argument(
        "--drain-s", type=float, default=3600.0, metavar="S",
        help="Time for the running jobs to end after SIGTERM [s]; then they go back into the queue (default: 3600).",
    )  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """Work until SIGTERM."""
    from hsloc.errors import ConfigError

    settings = service_module("settings")
    try:
        tags = None if arguments.tags is None else tuple(filter(None, arguments.tags.split(",")))
        chosen = settings.from_environment(data=arguments.data, slots=arguments.slots, tags=tags)
        return int(service_module("work").work(chosen, max(arguments.drain_s, 0.0), arguments.metrics))
    except settings.SettingsError as error:
        raise ConfigError(str(error)) from error

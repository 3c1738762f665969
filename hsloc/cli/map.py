"""Build a map from a recorded log, as `hsloc replay --mode slam` does; it is compared with a map in the log."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hsloc.cli import replay

if TYPE_CHECKING:
    import argparse

HELP = "build a map from a recorded log (replay --mode slam)"
EXAMPLES = """
  hsloc map run.mcap --out floor
  hsloc map second.mcap --resume floor --out both          extend an earlier map
  hsloc map run.clf --no-odom --scan-topic FLASER
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Those of `hsloc replay`; the built map is compared with one that the log holds."""
    replay.add_arguments(parser, "map")
    parser.set_defaults(mode="slam")


def run(arguments: argparse.Namespace) -> int:
    """As `hsloc replay`."""
    return replay.run(arguments)

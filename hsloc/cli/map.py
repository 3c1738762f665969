"""Draw a map from a recorded log: `hsloc replay --mode slam` by the name that people look for first."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hsloc.cli import replay

if TYPE_CHECKING:
    import argparse

HELP = "draw a map from a recorded log (replay --mode slam)"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Those of `hsloc replay`; a map that is given is what the drawn one is compared with."""
    replay.add_arguments(parser)
    parser.set_defaults(mode="slam")


def run(arguments: argparse.Namespace) -> int:
    """As `hsloc replay`."""
    return replay.run(arguments)

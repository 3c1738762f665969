"""Print the parameters of a run as YAML with comments: those of a preset, or of a file on top of it, checked."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hsloc.cli.arguments import add_config_arguments, config

if TYPE_CHECKING:
    import argparse

HELP = "print the parameters as YAML"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Preset and file."""
    add_config_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> int:
    """Print the configuration."""
    from hsloc.config import to_dict
    from hsloc.parameter_reference import commented_yaml

    chosen = config(arguments)
    if arguments.json:
        import json

        print(json.dumps(to_dict(chosen), indent=2))
    else:
        print(commented_yaml(chosen), end="")
    return 0

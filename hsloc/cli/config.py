"""Print the parameters of a run as YAML with comments: those of a preset, or of a file on top of it, checked."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hsloc.cli.arguments import CONFIG_OPTIONS, add_options, run_request

if TYPE_CHECKING:
    import argparse

HELP = "print the parameters as YAML"
EXAMPLES = """
  hsloc config > mine.yaml
  hsloc config --preset paper --set hide.budget=400
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Preset and file."""
    add_options(parser, "replay", CONFIG_OPTIONS)
    parser.add_argument("--json", action="store_true", help="Print JSON.")


def run(arguments: argparse.Namespace) -> int:
    """Print the configuration."""
    from hsloc.config import to_dict
    from hsloc.parameter_reference import commented_yaml

    chosen = run_request(arguments).config
    if arguments.json:
        import json

        print(json.dumps(to_dict(chosen), indent=2))
    else:
        print(commented_yaml(chosen), end="")
    return 0

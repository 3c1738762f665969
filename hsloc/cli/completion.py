"""Print the completion of all commands and flags for a shell: bash, zsh or fish."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

HELP = "print the completion for a shell"
EXAMPLES = """
  eval "$(hsloc completion bash)"                                  in ~/.bashrc
  hsloc completion zsh > ~/.zfunc/_hsloc
  hsloc completion fish > ~/.config/fish/completions/hsloc.fish
"""
_FILES = ("log", "files")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The shell."""
    parser.add_argument("shell", choices=("bash", "zsh", "fish"))


def run(arguments: argparse.Namespace) -> int:
    """Print the script."""
    import shtab

    from hsloc.cli.main import build_parser

    parser = build_parser()
    for action in _actions(parser):
        if action.type is Path or action.dest in _FILES:
            action.complete = shtab.FILE  # type: ignore[attr-defined]
    print(shtab.complete(parser, arguments.shell))
    return 0


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    for action in parser._actions:  # argparse has no public way to them, and shtab goes the same
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield from _actions(command)

"""argparse as this program uses it: errors of one line with a hint, poses with a minus, examples below the help."""

from __future__ import annotations

import argparse
import difflib
import re
from typing import TYPE_CHECKING, Any, NoReturn

if TYPE_CHECKING:
    from collections.abc import Sequence

_NEGATIVE = re.compile(r"-[\d.][\d.,eE+\- ]*")
"""A number, or several with commas, of which the first is negative."""
_FLAG = re.compile(r"--[a-z][a-z-]*")


class Formatter(argparse.HelpFormatter):
    """Keeps the lines of the examples, and wraps everything else."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=28)

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        fill = super()._fill_text
        parts = text.rstrip().split("\n\n")
        return "\n\n".join(part if "\n  " in part else fill(part, width, indent) for part in parts) + "\n"


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**{"formatter_class": Formatter, **options})
        self.commands: dict[str, Parser] = {}

    def parse(self, words: Sequence[str]) -> argparse.Namespace:
        """As `parse_args`; what is not known is reported by the command that it was given to."""
        found, unknown = self.parse_known_args(_joined(words))
        if unknown:
            parser = self.commands.get(getattr(found, "command", ""), self)
            parser.error(f"unrecognized arguments: {' '.join(unknown)}")
        return found

    def error(self, message: str) -> NoReturn:
        """One line on stderr, and exit code 2."""
        self.exit(2, f"{self.prog}: error: {message}{self._hint(message)} (see {self.prog} --help)\n")

    def _hint(self, message: str) -> str:
        unknown = message.removeprefix("unrecognized arguments: ")
        if unknown == message:
            return ""
        close = difflib.get_close_matches(unknown.split()[0].partition("=")[0], self.flags(), 1)
        return f"; did you mean {close[0]}?" if close else ""

    def flags(self) -> list[str]:
        """The long flags."""
        return [flag for action in self._actions for flag in action.option_strings if _FLAG.fullmatch(flag)]

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is None or value in action.choices:
            return
        names = [str(choice) for choice in action.choices]
        close = difflib.get_close_matches(str(value), names, 1)
        hint = f"did you mean {close[0]}?" if close else f"choose from {', '.join(names)}"
        raise argparse.ArgumentError(action, f"invalid choice {value!r}; {hint}")


def _joined(words: Sequence[str]) -> list[str]:
    """The words of a command line, a negative value joined to its flag: argparse takes `-1,2,0` for another flag."""
    found: list[str] = []
    for word in words:
        if found and _NEGATIVE.fullmatch(word) and _FLAG.fullmatch(found[-1]):
            found[-1] += f"={word}"
        else:
            found.append(word)
    return found

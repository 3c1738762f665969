"""`hsloc`: the command line.

Only argparse is imported here. A command is a module `hsloc.cli.<name>` with `HELP: str`,
`add_arguments(parser)` and `run(arguments) -> int`; it is imported when it is called, and its heavy imports
stand inside `run`, so that `hsloc --help` answers at once.
"""

from __future__ import annotations

import argparse
import atexit
import difflib
import errno
import importlib
import logging
import os
import re
import signal
import sys
import threading
import warnings
from contextlib import suppress
from io import TextIOWrapper
from typing import TYPE_CHECKING, Any, NoReturn

from hsloc.errors import HslocError
from hsloc.garbage_collection import rarely_collected
from hsloc.interrupts import interrupt_again
from hsloc.version import __version__

if TYPE_CHECKING:
    from collections.abc import Sequence

_NEGATIVE = re.compile(r"-[\d.][\d.,eE+\- ]*")
"""A number, or several with commas, of which the first is negative."""
_FLAG = re.compile(r"--[a-z][a-z-]*")

COMMANDS = (
    "record",
    "replay",
    "map",
    "merge",
    "diff",
    "info",
    "check",
    "eval",
    "compare",
    "sweep",
    "convert",
    "calibrate",
    "reproduce",
    "bench",
    "config",
    "completion",
    "serve",
    "submit",
    "work",
    "workers",
)
EXIT_OK, EXIT_FAILED, EXIT_USAGE, EXIT_DATA_LOST, EXIT_BELOW_LIMIT = 0, 1, 2, 3, 4
"""Exit codes: done; failed; wrong use; done, but part of the input was lost; done, but a limit was not kept."""
EXAMPLES = """
  hsloc record office.mcap --world office      a simulated log to try
  hsloc replay office.mcap                     where was the robot?
  hsloc info run.mcap                          what is in a log
  hsloc COMMAND --help                         options and examples of a command

exit codes:
  0 done    1 failed    2 wrong use    3 done, part of the log lost    4 done, a limit not kept
"""
_CLOSE = 0.7
"""How alike (0 to 1) a flag must be to the wrong one to be suggested: `out` is none for `bogus`, `seed` for `sede`."""
_NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


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
        # Without the dashes, which all have in common.
        word, names = unknown.split()[0].partition("=")[0].lstrip("-"), [flag[2:] for flag in self.flags()]
        close = difflib.get_close_matches(word, names, 1, _CLOSE)
        close += [name for name in names if min(len(word), len(name)) > 2 and (word in name or name in word)]
        return f"; did you mean --{close[0]}?" if close else ""

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


def build_parser(names: Sequence[str] = COMMANDS) -> Parser:
    """The parser of all commands, or of those that are named."""
    parser = Parser(
        prog="hsloc",
        description="Where was the robot? Offline localisation and mapping for recorded 2D-lidar logs.",
        epilog=f"examples:{EXAMPLES}",
    )
    parser.add_argument("--version", action="version", version=f"hsloc {__version__}", help="Print the version.")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    for name in names:
        module = importlib.import_module(f"hsloc.cli.{name}")
        command = commands.add_parser(
            name, help=module.HELP, description=module.__doc__, epilog=f"examples:{module.EXAMPLES}"
        )
        module.add_arguments(command)
        command.set_defaults(run=module.run)
        parser.commands[name] = command
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code. Errors of `HslocError` are one line on stderr."""
    try:
        words = sys.argv[1:] if argv is None else argv
        # The parsers of the other commands take 0.03 s to build; only messages about an unknown one need them.
        parser = build_parser(words[:1] if words and words[0] in COMMANDS else COMMANDS)
        arguments = parser.parse(words)
        if arguments.command is None:
            parser.print_help()
            return EXIT_USAGE
        status = int(arguments.run(arguments))
        sys.stdout.flush()
        return status
    except HslocError as error:
        print(f"hsloc: error: {error}", file=sys.stderr)
        return EXIT_FAILED
    except KeyboardInterrupt:
        return _interrupted()
    except SystemError as error:
        # In a kernel's first call Ctrl-C may come where numba does not expect it.
        if not isinstance(error.__cause__, KeyboardInterrupt):
            raise
        return _interrupted()
    except BrokenPipeError:  # Whoever read the output has enough; `program` leaves the rest.
        return EXIT_FAILED
    except OSError as error:
        if isinstance(error, PermissionError) and error.filename is not None:
            remedy = "check its rights, and those of the folders above it"
            print(f"hsloc: error: {error.filename}: cannot be reached ({error.strerror}); {remedy}", file=sys.stderr)
            return EXIT_FAILED
        if error.errno not in _NO_SPACE:
            raise
        where = error.filename or "standard output"
        print(f"hsloc: error: {where}: cannot be written ({error.strerror}); check the free space", file=sys.stderr)
        return EXIT_FAILED


def _interrupted() -> int:
    print("hsloc: interrupted", file=sys.stderr)
    return 130


def program() -> None:
    """The program `hsloc`. Once the work is done, or given up, a Ctrl-C comes too late to matter.

    Names that the terminal has no letters for are printed escaped, as on stderr: no result is lost for want of a font.
    """
    if isinstance(sys.stdout, TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")
    # Without a writable home matplotlib keeps its fonts among the temporary files, and says so in two long lines.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    sys.unraisablehook = interrupt_again
    warnings.formatwarning = lambda message, *_, **__: f"hsloc: warning: {message}\n"
    # To the very end: with Python's own limit all objects would be looked at once more, just before they are left.
    with rarely_collected():
        status = main()
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            sys.stdout.flush()
        except OSError:  # Reported already; Python itself would report what is left again, with another exit code.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        _leave(status)


def _leave(status: int) -> NoReturn:
    """End the process without freeing each object before, which takes a quarter of a second of what numba holds."""
    if threading.active_count() > 1:
        sys.exit(status)  # It waits for them.
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, AttributeError):  # A stream that was closed from the start is None.
            stream.flush()
    os._exit(status)


if __name__ == "__main__":
    program()

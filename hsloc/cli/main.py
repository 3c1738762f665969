"""`hsloc`: the command line's front door.

Only argparse is imported here. A command is a module `hsloc.cli.<name>` with `HELP: str`,
`add_arguments(parser)` and `run(arguments) -> int`; it is imported when it is called, and its heavy imports
stand inside `run`, so that `hsloc --help` answers at once.
"""

from __future__ import annotations

import errno
import importlib
import logging
import os
import signal
import sys
import warnings
from io import TextIOWrapper
from typing import TYPE_CHECKING

from hsloc.errors import HslocError
from hsloc.version import __version__

if TYPE_CHECKING:
    from collections.abc import Sequence

    from hsloc.cli.parser import Parser

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
_NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def build_parser() -> Parser:
    """The parser of all commands."""
    from hsloc.cli.parser import Parser

    parser = Parser(
        prog="hsloc",
        description="Where was the robot? Offline localisation and mapping for recorded 2D-lidar logs.",
        epilog=f"examples:{EXAMPLES}",
    )
    parser.add_argument("--version", action="version", version=f"hsloc {__version__}", help="Print the version.")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    for name in COMMANDS:
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
        parser = build_parser()
        arguments = parser.parse(sys.argv[1:] if argv is None else argv)
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
        print("hsloc: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        sys.stderr.close()
        return EXIT_FAILED
    except OSError as error:
        if error.errno not in _NO_SPACE:
            raise
        where = error.filename or "standard output"
        print(f"hsloc: error: {where}: cannot be written ({error.strerror}); check the free space", file=sys.stderr)
        return EXIT_FAILED


def program() -> None:
    """The program `hsloc`. Once the work is done, or given up, a Ctrl-C comes too late to matter.

    Names that the terminal has no letters for are printed escaped, as on stderr: no result is lost for want of a font.
    """
    if isinstance(sys.stdout, TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")
    # Without a writable home matplotlib keeps its fonts among the temporary files, and says so in two long lines.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    warnings.formatwarning = lambda message, *_, **__: f"hsloc: warning: {message}\n"
    status = main()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        sys.stdout.flush()
    except OSError:  # Told already; what is left would be told once more by Python itself, with another exit code.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(status)


if __name__ == "__main__":
    program()

"""Measure on this machine what the project promises: speed, memory, accuracy within a cell, and peers beside it."""

from __future__ import annotations

import argparse
from pathlib import Path

from hsloc.cli.progress import ProgressLine

HELP = "measure speed, memory and matching beside peers"
EXAMPLES = """
  hsloc bench --quick
  hsloc bench kernel --json
"""

_PARTS = ("kernel", "match", "replay", "memory", "sub-cell", "cases", "certificates", "whole-map")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Parts, cases, output."""
    parser.add_argument(
        "parts", nargs="*", type=_part, metavar="PART", help=f"of {', '.join(_PARTS)} (default: all)"
    )  # fmt: skip
    parser.add_argument(
        "--cases", type=Path, metavar="FILE.npz", help="Matching cases: real scans, a map, and starts with an error."
    )
    parser.add_argument(
        "--quick", action="store_true", help="Use small inputs and few repetitions, to see that it works."
    )
    parser.add_argument("--json", action="store_true", help="Print the results as JSON on stdout.")
    parser.add_argument("-q", "--quiet", action="store_true", help="Show no progress.")


def run(arguments: argparse.Namespace) -> int:
    """Measure and print. A promise that is not kept is printed, and no failure: the machine may be busy."""
    from hsloc.benchmark.results import markdown
    from hsloc.benchmark.run import run_bench
    from hsloc.errors import ConfigError
    from hsloc.evaluation.metrics import format_json

    parts = arguments.parts or list(_PARTS)
    for part in ("cases", "certificates"):
        if part in arguments.parts and arguments.cases is None:
            raise ConfigError(f"the part {part} needs a file; name an .npz with --cases")
    with ProgressLine(arguments.quiet) as line:
        bench = run_bench(parts, arguments.cases, quick=arguments.quick, progress=line.show)
    if arguments.json:
        print(format_json(bench.to_dict()), end="")
        return 0
    print(markdown(bench))
    if arguments.cases is None:
        print("No --cases FILE.npz: the tables of matching and of certificates were left out.")
    return 0


def _part(text: str) -> str:
    if text not in _PARTS:
        raise argparse.ArgumentTypeError(f"{text!r} is none of {', '.join(_PARTS)}")
    return text

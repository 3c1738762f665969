"""Compare the results of runs: their figures with differences, their paths on one map, their errors over time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import argparse

HELP = "compare the results of runs: a table, and one page that needs no network"
EXAMPLES = """
  hsloc compare results/hide results/icp                       a table; changes are relative to the first
  hsloc compare results/* --out compare.html                   paths on one map, and curves over each other
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Results and output."""
    parser.add_argument(
        "results", nargs="+", type=Path, help="Folders of results, or their report.html; the first is the standard."
    )
    parser.add_argument("--out", type=Path, metavar="HTML", help="Write the comparison as one page, compare.html.")
    parser.add_argument("--overwrite", action="store_true", help="Replace the page if it exists.")
    parser.add_argument("--json", action="store_true", help="Print the figures as JSON on stdout.")


def run(arguments: argparse.Namespace) -> int:
    """Print the table, write the page."""
    from hsloc.atomic_write import is_there
    from hsloc.cli.main import EXIT_OK
    from hsloc.cli.output import print_lines
    from hsloc.errors import OutputError
    from hsloc.evaluation.metrics import format_json
    from hsloc.report.html import comparison_rows, over_seeds, read_runs, write_comparison
    from hsloc.text_table import table

    out: Path | None = arguments.out
    if out is not None and is_there(out) and not arguments.overwrite:
        raise OutputError(f"{out}: exists already; choose another --out, or pass --overwrite")
    runs = read_runs(arguments.results)
    if arguments.json:
        print(format_json({run.name: list(run.figures.values()) for run in runs}), end="")
    else:
        print_lines(table(("", *(run.name for run in runs)), comparison_rows(runs)))
        if (seeds := over_seeds(runs)) is not None:
            print_lines(("over seeds: mean ± standard deviation [95 % interval of the mean, by bootstrap]", ""))
            print_lines(table(("", *seeds["names"]), seeds["rows"]))
    if out is not None:
        write_comparison(out, runs)
        if not arguments.json:
            print(f"comparison: {out}")
    return EXIT_OK

"""Replay a recorded log on a map, or build one: trajectory, error metrics, a picture and a recording to look at."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from hsloc.cli import BEGIN
from hsloc.cli.arguments import add_no_progress, add_options, run_request
from hsloc.cli.output import default_folder, link_latest, print_warnings, refuse_early
from hsloc.cli.progress import ProgressLine

if TYPE_CHECKING:
    import argparse

    from hsloc.options import Interface
    from hsloc.replay.progress import Progress
    from hsloc.replay.run import Result
    from hsloc.warnings import RunWarning

HELP = "localise the robot of a recorded log, or build a map"


EXAMPLES = """
  hsloc replay run.mcap                                    on the map in the log
  hsloc replay run.mcap --map floor.yaml --initial-pose -1,2,0
  hsloc replay run.mcap --map floor.yaml --unknown-start --set hide.budget=400
  hsloc replay run.mcap --min-localised 0.95 --max-warnings 0 -q || echo "look at it"
"""


def add_arguments(parser: argparse.ArgumentParser, interface: Interface = "replay") -> None:
    """Logs, options of the run, output."""
    parser.add_argument("log", nargs="+", type=Path, help="MCAP, ROS 1 or ROS 2 bag, CARMEN log; several are one run.")
    output = parser.add_argument_group("output")
    output.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="Folder of the results (default: results/NAME-TIME, to which results/latest links).",
    )
    output.add_argument("--overwrite", action="store_true", help="Replace the folder if it exists.")
    output.add_argument("--json", action="store_true", help="Print the metrics as JSON on stdout.")
    output.add_argument("-q", "--quiet", action="store_true", help="Print losses and errors only.")
    output.add_argument("-v", "--verbose", action="store_true", help="Print what was found in the log, too.")
    add_no_progress(output)
    add_options(parser, interface)


def run(arguments: argparse.Namespace) -> int:
    """Run, write the results, print the table; 4 where a limit is not kept, else 3 where part of the input was lost."""
    from hsloc.analysis.quality import exceeded_limits
    from hsloc.cli.main import EXIT_BELOW_LIMIT, EXIT_DATA_LOST, EXIT_OK
    from hsloc.cli.output import import_matplotlib, print_summary
    from hsloc.evaluation.metrics import format_json
    from hsloc.replay.progress import COMPILING
    from hsloc.replay.run import run as run_replay

    import_matplotlib()
    from hsloc.export.results_folder import write_results

    request = run_request(arguments)
    folder = arguments.out or default_folder(arguments.log[0].name.split(".")[0] or "run")
    refuse_early(folder, arguments.overwrite)
    with ProgressLine(arguments.quiet or arguments.no_progress) as line:

        def show(progress: Progress) -> None:
            if progress.phase == "compile":
                line.show_clock("compile", 20.0, COMPILING)
                return
            speed = progress.done_s / max(line.elapsed, 1e-9)
            line.show(
                progress.phase,
                progress.done_s / progress.total_s if progress.total_s > 0 else 1.0,
                f"{progress.done_s:.0f} s of {progress.total_s:.0f} s, {speed:.0f}x real time",
            )

        result = run_replay(request, show)
        written = write_results(
            result,
            folder,
            overwrite=arguments.overwrite,
            progress=lambda share: line.show("writing", share),
        )
    if arguments.out is None:
        link_latest(folder)
    _warn(result, written.metrics.warnings, arguments)
    if arguments.json:
        values = {**written.metrics.to_json(), "timings": written.timings.to_json(), "results": str(folder)}
        print(format_json(values), end="")
    elif not arguments.quiet:
        print_summary(written.metrics, written.timings, folder)
        print(f"whole command: {time.perf_counter() - BEGIN:.1f} s, reading and writing included")
    exceeded = exceeded_limits(request, written.metrics)
    for limit in exceeded:
        print(f"hsloc: limit not kept: {limit}", file=sys.stderr)
    if exceeded:
        return EXIT_BELOW_LIMIT
    return EXIT_DATA_LOST if result.losses.data_lost else EXIT_OK


def _warn(result: Result, warnings: tuple[RunWarning, ...], arguments: argparse.Namespace) -> None:
    """Warnings and losses, on stderr; with --quiet losses only, which an exit code stands for."""
    if arguments.quiet and not result.losses.data_lost:
        return
    candidates = result.summary.reference_candidates
    if not arguments.quiet:
        print_warnings(warnings)
        if result.reference is None and candidates:
            print(f"hsloc: the log has poses to compare with: --truth-topic {' or '.join(candidates)}", file=sys.stderr)
    lines, reasons = result.losses.lines(), result.losses.reasons
    if lines and not arguments.verbose:
        # The first says which file it is.
        reasons = [f"{reasons[0]}; hsloc check shows all"] if reasons and result.losses.data_lost else []
    for line in (*lines, *reasons):
        print(f"hsloc: log: {line}", file=sys.stderr)

"""Convert a log (CARMEN, Wean, ROS 1 or ROS 2 bag, MCAP) to MCAP of ROS 2 messages."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from hsloc.cli.arguments import add_read_arguments, read_options
from hsloc.cli.output import pose_text
from hsloc.cli.progress import ProgressLine

if TYPE_CHECKING:
    import argparse
    from collections.abc import Sequence

    from hsloc.log import Conversion, LogSummary
    from hsloc.warnings import RunWarning

HELP = "convert a log to MCAP"
EXAMPLES = """
  hsloc convert intel.clf intel.mcap
  hsloc convert bag_folder run.mcap --start 10 --duration 60
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `hsloc convert`."""
    parser.add_argument("log", metavar="IN", help="Log, or a folder with its parts.")
    parser.add_argument("out", metavar="OUT.mcap", help="File to write.")
    add_read_arguments(parser)
    parser.add_argument("--force", action="store_true", help="Overwrite OUT.mcap.")
    parser.add_argument("--json", action="store_true", help="Print the counts as JSON.")
    parser.add_argument("-q", "--quiet", action="store_true", help="Print losses and errors only.")


def run(arguments: argparse.Namespace) -> int:
    """Convert; returns the exit code: 3 where part of the input was lost."""
    from dataclasses import replace
    from pathlib import Path

    from hsloc.atomic_write import is_there
    from hsloc.errors import OutputError
    from hsloc.log import convert_log, open_log
    from hsloc.slam.front_end_parameters import FrontEndParameters
    from hsloc.slam.mounting_choice import with_chosen_mountings
    from hsloc.warnings import WarningCode

    target = Path(arguments.out)
    if is_there(target) and not target.is_dir():
        if Path(arguments.log).exists() and target.samefile(arguments.log):
            raise OutputError(f"{target}: is the input itself; name another file")
        if not arguments.force:
            raise OutputError(f"{target}: exists; give --force to overwrite it, or name another file")
    options = replace(read_options(arguments), require_odometry=False)
    log = open_log(arguments.log, options)
    chosen, of_mountings = with_chosen_mountings(log, [Path(arguments.log)], options, FrontEndParameters())
    # Where the data do not decide, all mountings are written, for whoever reads the file.
    decided = [
        mounting
        for mounting, warning in zip(reversed(chosen.mountings), reversed(of_mountings), strict=False)
        if warning.code == WarningCode.EXTRINSICS_CHOSEN
    ]
    if decided:
        log = open_log(arguments.log, replace(options, mountings=tuple(decided)))
    span = max(log.summary.end_ns - log.summary.origin_ns, 1)
    with ProgressLine(arguments.quiet or arguments.no_progress) as line:
        conversion = convert_log(
            log, target, lambda stamp: line.show("convert", (stamp - log.summary.origin_ns) / span)
        )
    _report(arguments, log.summary, (*log.summary.warnings, *of_mountings), conversion)
    return 3 if conversion.losses.data_lost else 0


def _report(
    arguments: argparse.Namespace, summary: LogSummary, warnings: Sequence[RunWarning], conversion: Conversion
) -> None:
    from json import dumps

    from hsloc.dataclass_json import to_json

    losses = conversion.losses.lines()
    if arguments.json:
        values = {
            "path": str(conversion.path),
            "format": summary.format,
            "scans": conversion.scans,
            "odometry": conversion.odometry,
            "truths": conversion.truths,
            "map": conversion.has_map,
            "stamps_backwards": conversion.stamps_backwards,
            "data_lost": conversion.losses.data_lost,
            "losses": losses + conversion.losses.reasons,
            "warnings": [to_json(warning) for warning in warnings],
        }
        print(dumps(values))
        return
    if not arguments.quiet:
        parts = [f"{conversion.scans} scans", f"{conversion.odometry} odometry messages"]
        parts += [f"{conversion.truths} poses of the truth"] if conversion.truths else []
        parts += ["a map"] if conversion.has_map else []
        print(f"{conversion.path}: {', '.join(parts)}, from {summary.format}")
        print(f"laser: {pose_text(summary.T_base_laser)} on the base ({summary.extrinsics})")
        print(f"stamps that run backwards: {conversion.stamps_backwards}, kept as they are")
        for warning in warnings:
            print(f"hsloc: warning: {warning}", file=sys.stderr)
    if not arguments.quiet or conversion.losses.data_lost:
        for line in losses + conversion.losses.reasons:
            print(f"hsloc: warning: {line}", file=sys.stderr)

"""Replay a recorded log on its map: trajectory, error metrics, a picture and a recording to look at."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from hsloc.cli.arguments import add_config_arguments, add_read_arguments, config, pose, read_options, to_pose
from hsloc.cli.progress import ProgressLine

if TYPE_CHECKING:
    import argparse

    from hsloc.replay.run import Progress, Result

HELP = "localise the robot of a recorded log on a map"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Logs, map, start, output; reading; algorithms."""
    parser.add_argument("log", nargs="+", type=Path, help="MCAP, ROS 1 or ROS 2 bag, CARMEN log; several are one run")
    parser.add_argument("--map", type=Path, metavar="YAML", help="map as nav2 writes it (default: /map in the log)")
    start = parser.add_mutually_exclusive_group()
    start.add_argument("--initial-pose", type=pose, metavar="X,Y,YAW", help="start, in metres and radians")
    start.add_argument("--unknown-start", action="store_true", help="search the whole map, whatever the log says")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="exactly this folder (default: results/<name>-<time>, and results/latest)",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace the folder if it exists")
    parser.add_argument(
        "--alignment", choices=("none", "origin", "se2"), default="none", help="move the estimate onto the truth first"
    )
    parser.add_argument("--json", action="store_true", help="print the metrics as JSON on stdout")
    parser.add_argument("-q", "--quiet", action="store_true", help="print errors only")
    parser.add_argument("-v", "--verbose", action="store_true", help="print what was found in the log, too")
    add_read_arguments(parser)
    add_config_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run, write the results, print the table; 3 where part of the input was lost."""
    from hsloc.cli.main import EXIT_DATA_LOST, EXIT_OK
    from hsloc.cli.table import print_summary
    from hsloc.evaluation.metrics import format_json
    from hsloc.replay.results import timings, write_results
    from hsloc.replay.run import RunSpec
    from hsloc.replay.run import run as run_replay

    spec = RunSpec(
        logs=tuple(arguments.log),
        map_path=arguments.map,
        config=config(arguments),
        read=read_options(arguments),
        initial_pose=to_pose(arguments.initial_pose),
        unknown_start=arguments.unknown_start,
        seed=arguments.seed,
        preset=arguments.preset,
    )
    folder = arguments.out or _default_folder(arguments.log[0])
    _refuse_early(folder, arguments.overwrite)
    with ProgressLine(arguments.quiet) as line:

        def show(progress: Progress) -> None:
            speed = progress.done_s / max(line.elapsed, 1e-9)
            line.show(
                progress.phase,
                progress.done_s / progress.total_s if progress.total_s > 0 else 1.0,
                f"{progress.done_s:.0f} s of {progress.total_s:.0f} s, {speed:.0f}x real time",
            )

        result = run_replay(spec, show)
        metrics = write_results(
            result,
            folder,
            overwrite=arguments.overwrite,
            alignment=arguments.alignment,
            progress=lambda share: line.show("writing", share),
        )
    if arguments.out is None:
        _link_latest(folder)
    _tell(result, arguments)
    if arguments.json:
        print(format_json({**metrics, "timings": timings(result), "results": str(folder)}), end="")
    elif not arguments.quiet:
        print_summary(metrics, timings(result), folder)
    return EXIT_DATA_LOST if result.losses.data_lost else EXIT_OK


def _tell(result: Result, arguments: argparse.Namespace) -> None:
    """Warnings and losses, on stderr."""
    if arguments.quiet:
        return
    for warning in result.warnings:
        print(f"hsloc: warning: {warning}", file=sys.stderr)
    for line in result.losses.lines():
        print(f"hsloc: log: {line}", file=sys.stderr)
    if arguments.verbose:
        for reason in result.losses.reasons:
            print(f"hsloc: log: {reason}", file=sys.stderr)


def _default_folder(log: Path) -> Path:
    from datetime import datetime

    stamp = datetime.now().astimezone().strftime("%Y-%m-%d_%H-%M-%S")
    return Path("results") / f"{log.name.split('.')[0] or 'run'}-{stamp}"


def _refuse_early(folder: Path, overwrite: bool) -> None:
    """A folder that cannot be written is told before the work, not after it."""
    import os

    from hsloc.errors import OutputError

    if folder.exists() and not overwrite and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputError(f"{folder}: exists already; choose another --out, or pass --overwrite")
    parent = folder.absolute().parent
    while not parent.exists():
        parent = parent.parent
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise OutputError(f"{folder}: cannot be written: {parent} is not a folder that may be written to")


def _link_latest(folder: Path) -> None:
    """`results/latest` points to the newest results; without it (no symbolic links here) nothing is lost."""
    import contextlib

    link = folder.parent / "latest"
    with contextlib.suppress(OSError):
        if link.is_symlink():
            link.unlink()
        link.symlink_to(folder.name, target_is_directory=True)

"""Replay a recorded log, on a map or drawing one: trajectory, error metrics, a picture and a recording to look at."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from hsloc.cli.arguments import add_config_arguments, add_read_arguments, config, pose, read_options, to_pose
from hsloc.cli.folders import default_folder, link_latest, refuse_early
from hsloc.cli.progress import ProgressLine

if TYPE_CHECKING:
    import argparse

    from hsloc.replay.run import Progress, Result

HELP = "localise the robot of a recorded log, or map while it goes"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Logs, map, start, output; reading; algorithms."""
    parser.add_argument("log", nargs="+", type=Path, help="MCAP, ROS 1 or ROS 2 bag, CARMEN log; several are one run")
    parser.add_argument(
        "--map",
        type=Path,
        metavar="MAP",
        help="map as nav2 writes it, or folder or map.npz of a run that drew one (default: /map in the log)",
    )
    parser.add_argument(
        "--resume", type=Path, metavar="MAP", help="extend the map of an earlier mapping run: its folder or map.npz"
    )
    parser.add_argument(
        "--mode", choices=("auto", "localise", "slam"), default="auto", help="default: localise if there is a map"
    )
    parser.add_argument("--no-odom", action="store_true", help="draw a map without looking at the log's odometry")
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
        "--alignment",
        choices=("none", "origin", "se2"),
        help="move the estimate onto the truth first (default: none on a given map, se2 on a drawn one)",
    )
    parser.add_argument(
        "--reference", metavar="POSES",
        help="compare with a TUM or CSV file, LOG, LOG:TOPIC, TOPIC or /tf:map.base_link (default: truth in the log)",
    )  # fmt: skip
    parser.add_argument(
        "--relations", type=Path, metavar="FILE", help="score by relations: `t1 t2 x y z roll pitch yaw`"
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
    from hsloc.export.results_folder import timings, write_results
    from hsloc.replay.run import run as run_replay
    from hsloc.request import RunRequest

    spec = RunRequest(
        logs=tuple(arguments.log),
        map_path=arguments.map,
        resume=arguments.resume,
        config=config(arguments),
        read=read_options(arguments),
        initial_pose=to_pose(arguments.initial_pose),
        unknown_start=arguments.unknown_start,
        seed=arguments.seed,
        preset=arguments.preset,
        mode=arguments.mode,
        no_odometry=arguments.no_odom,
        reference=arguments.reference,
    )
    folder = arguments.out or default_folder(arguments.log[0].name.split(".")[0] or "run")
    refuse_early(folder, arguments.overwrite)
    with ProgressLine(arguments.quiet or arguments.no_progress) as line:

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
            relations=arguments.relations,
            progress=lambda share: line.show("writing", share),
        )
    if arguments.out is None:
        link_latest(folder)
    _tell(result, metrics["warnings"], arguments)
    if arguments.json:
        print(format_json({**metrics, "timings": timings(result), "results": str(folder)}), end="")
    elif not arguments.quiet:
        print_summary(metrics, timings(result), folder)
    return EXIT_DATA_LOST if result.losses.data_lost else EXIT_OK


def _tell(result: Result, warnings: object, arguments: argparse.Namespace) -> None:
    """Warnings and losses, on stderr."""
    if arguments.quiet:
        return
    for warning in warnings if isinstance(warnings, list) else ():
        print(f"hsloc: warning: {warning}", file=sys.stderr)
    candidates = result.summary.reference_candidates
    if result.reference is None and candidates:
        print(f"hsloc: the log has poses to compare with: --truth-topic {' or '.join(candidates)}", file=sys.stderr)
    for line in result.losses.lines():
        print(f"hsloc: log: {line}", file=sys.stderr)
    if arguments.verbose:
        for reason in result.losses.reasons:
            print(f"hsloc: log: {reason}", file=sys.stderr)

"""Calibrate a robot from its own log: scale and track of the odometry, place and clock of a lidar.

The motion that the scans show is compared with the odometry; no target is needed, and a map only where the scans
cannot be mapped. What the robot's motion does not determine is named.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from hsloc.cli.arguments import add_options, add_read_arguments, run_request
from hsloc.cli.output import need_writable, print_warnings
from hsloc.cli.progress import ProgressLine

if TYPE_CHECKING:
    import argparse

HELP = "calibrate odometry and lidar from a log"
EXAMPLES = """
  hsloc calibrate run.mcap                     calibration.yaml and calibration.urdf
  hsloc calibrate run.mcap --scan-topic /front/scan --out front.yaml
  hsloc calibrate run.mcap --map floor.yaml --initial-pose 2.6,8.1,1.57
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `hsloc calibrate`."""
    parser.add_argument("log", nargs="+", type=Path, metavar="LOG", help="Log: a file, its parts, or a folder.")
    parser.add_argument(
        "--out", type=Path, metavar="FILE.yaml", default=Path("calibration.yaml"),
        help="File to write, with FILE.urdf beside it (default: calibration.yaml).",
    )  # fmt: skip
    parser.add_argument(
        "--map", type=Path, metavar="MAP",
        help="Localise the scans on this map: a YAML of nav2, or the folder or map.npz of a mapping run (default: the "
        "scans are mapped).",
    )  # fmt: skip
    add_options(parser, "replay", ("initial_pose", "unknown_start"))
    add_read_arguments(parser)
    parser.add_argument("--force", action="store_true", help="Overwrite the files.")
    parser.add_argument("--json", action="store_true", help="Print everything as JSON.")
    parser.add_argument("-q", "--quiet", action="store_true", help="Print errors only.")


def run(arguments: argparse.Namespace) -> int:
    """Calibrate; returns the exit code."""
    from json import dumps

    from hsloc.atomic_write import is_there, write_text_atomically
    from hsloc.calibration.calibrate import calibrate
    from hsloc.calibration.written import as_json, as_lines, as_static_transform, as_urdf, as_yaml
    from hsloc.errors import ConfigError, OutputError

    targets = (arguments.out, arguments.out.with_suffix(".urdf"))
    if arguments.out.suffix == ".urdf":
        raise OutputError(f"{arguments.out}: the URDF is written beside the YAML; name a .yaml file")
    for target in targets:
        if is_there(target) and not arguments.force:
            raise OutputError(f"{target}: exists; give --force to overwrite it, or name another file with --out")
        if not target.parent.is_dir():
            raise OutputError(f"{target}: its folder does not exist; create it, or name another file with --out")
        need_writable(target)
    request = run_request(arguments)
    if request.map_path is None and (request.initial_pose is not None or request.unknown_start):
        raise ConfigError("--initial-pose and --unknown-start are for a map; give one with --map, or leave them out")
    with ProgressLine(arguments.quiet or arguments.json or arguments.no_progress) as line:
        found = calibrate(request, lambda number, share: line.show(f"pass {number}", share))
    write_text_atomically(targets[0], as_yaml(found))
    write_text_atomically(targets[1], as_urdf(found))
    if arguments.json:
        print(dumps(as_json(found), indent=2))
    elif not arguments.quiet:
        print_warnings(found.warnings)
        print("\n".join(as_lines(found)))
        if found.estimate.determined[3:6].any():
            print(as_static_transform(found))
        print(f"written: {targets[0]}, {targets[1]}")
    return 0

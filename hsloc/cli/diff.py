"""Show what changed between two maps: things and walls that appeared or vanished, where both maps know the place."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import argparse

    from hsloc.evaluation.maps import MapChanges
    from hsloc.model import OccupancyGrid, Pose2

HELP = "what changed between two maps"
EXAMPLES = """
  hsloc diff results/monday results/friday --align      maps built from two logs
  hsloc diff map.yaml results/run --json                a floor plan and a map in its frame
"""
_MOST_LINES = 20
_GREEN, _RED = (0, 150, 60), (210, 30, 30)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `hsloc diff`."""
    parser.add_argument("first", metavar="BEFORE", help="Map: a YAML of nav2, or the folder of a mapping run.")
    parser.add_argument("second", metavar="AFTER", help="Map to compare with it.")
    parser.add_argument(
        "--align", action="store_true",
        help="Find where AFTER lies in BEFORE by their scans, as hsloc merge does (default: both have one frame).",
    )  # fmt: skip
    parser.add_argument("--min-size", type=float, default=0.3, metavar="M", help="Smallest change shown [m] (0.3).")
    parser.add_argument("--png", metavar="FILE", help="Picture to write: appeared green, vanished red.")
    parser.add_argument("--json", action="store_true", help="Print the changes as JSON.")


def run(arguments: argparse.Namespace) -> int:
    """Compare; returns the exit code."""
    from json import dumps

    from hsloc.dataclass_json import to_json
    from hsloc.errors import MapError
    from hsloc.evaluation.maps import MOST_GONE, map_changes
    from hsloc.replay.map_and_start import load_grid
    from hsloc.replay.map_merge import merge_maps

    first, second = (load_grid(Path(name))[0] for name in (arguments.first, arguments.second))
    pose: Pose2 | None = None
    if arguments.align:
        pose = merge_maps([Path(arguments.first), Path(arguments.second)]).T_first_map[1]
    found = map_changes(first, second, pose, arguments.min_size)
    if found.shared == 0.0:
        raise MapError(
            f"{arguments.second}: no cell is known in {arguments.first} as well; "
            "are both in one frame? maps built from logs are compared with --align"
        )
    if arguments.png:
        _draw(Path(arguments.png), first, found)
    if not arguments.align and found.gone > MOST_GONE:
        text = (
            f"{100.0 * found.gone:.0f} % of the walls of {arguments.first} that lie in {arguments.second} are free "
            "ground there: is it the same building, and are both in one frame? see --align"
        )
        print(f"hsloc: warning: {text}", file=sys.stderr)
    if arguments.json:
        print(dumps({"shared": found.shared, "changes": [to_json(change) for change in found.changes]}))
        return 0
    print(f"known in both maps: {100.0 * found.shared:.0f} % of {arguments.first}")
    kinds = [change.kind for change in found.changes]
    print(f"appeared: {kinds.count('appeared')}, vanished: {kinds.count('vanished')}")
    for change in found.changes[:_MOST_LINES]:
        print(f"  {change.kind:9s} {change.size:5.2f} m  at x {change.x:7.2f} m, y {change.y:7.2f} m")
    if len(kinds) > _MOST_LINES:
        print(f"  and {len(kinds) - _MOST_LINES} smaller ones; --json lists all")
    return 0


def _draw(path: Path, grid: OccupancyGrid, found: MapChanges) -> None:
    import numpy as np
    from PIL import Image

    from hsloc.atomic_write import write_atomically

    grey = np.full(grid.cells.shape, 205, dtype=np.uint8)
    grey[grid.free()], grey[grid.occupied()] = 254, 120
    picture = np.repeat(grey[:, :, None], 3, axis=2)
    picture[found.appeared], picture[found.vanished] = _GREEN, _RED
    image = Image.fromarray(picture[::-1])
    write_atomically(path, lambda stream: image.save(stream, format="PNG"))

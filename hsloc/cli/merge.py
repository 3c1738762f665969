"""Join maps that hsloc built of one building: in the frame of the first, with the loops between them closed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from hsloc.cli.arguments import add_no_progress, whole
from hsloc.cli.output import refuse_early
from hsloc.cli.progress import ProgressLine

if TYPE_CHECKING:
    import argparse

    from hsloc.replay.map_merge import MapMerge

HELP = "join maps of one building"
EXAMPLES = """
  hsloc merge results/morning results/evening --out results/building
  hsloc merge results/floor-a results/floor-b results/floor-c --out results/building
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `hsloc merge`."""
    parser.add_argument("maps", nargs="+", metavar="MAP", help="Folder or map.npz of a mapping run; two or more.")
    parser.add_argument("--out", required=True, metavar="DIR", help="Folder to write, which must not exist.")
    parser.add_argument("--seed", type=whole, default=0, metavar="N", help="Seed of all random numbers (default: 0).")
    parser.add_argument("--json", action="store_true", help="Print merge.json.")
    parser.add_argument("-q", "--quiet", action="store_true", help="Print errors only.")
    add_no_progress(parser)


def run(arguments: argparse.Namespace) -> int:
    """Merge and write; returns the exit code."""
    from json import dumps

    from hsloc.atomic_write import is_there
    from hsloc.errors import OutputError
    from hsloc.export.results_folder import merge_summary, write_merged_map
    from hsloc.replay.map_merge import merge_maps

    out = Path(arguments.out)
    if is_there(out):
        raise OutputError(f"{out}: exists already; choose another --out")
    refuse_early(out, overwrite=False)
    with ProgressLine(arguments.quiet or arguments.json or arguments.no_progress) as line:
        merge = merge_maps(
            [Path(name) for name in arguments.maps], arguments.seed, lambda part: line.show("merge", part)
        )
    write_merged_map(merge, out.resolve())
    if arguments.json:
        print(dumps(merge_summary(merge)))
    elif not arguments.quiet:
        _report(merge, out)
    return 0


def _report(merge: MapMerge, out: Path) -> None:
    evidence = merge.mapping.evidence
    print(f"verdict: {evidence.verdict}")
    for reason in evidence.reasons:
        print(f"  {reason.text}")
    for name, pose, joints in zip(merge.names, merge.T_first_map, merge.joints, strict=True):
        place = f"at x {pose.x:z.2f} m, y {pose.y:z.2f} m, yaw {pose.theta:z.3f} rad, by {joints} loops"
        print(f"{name}: {place if joints else 'its frame is kept'}")
    print(f"results: {out}")

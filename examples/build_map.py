"""Build a map from one part of a log, save it, and localise another part on it.

python examples/build_map.py recordings/office.mcap --split 40 --out results/example-map
"""

from __future__ import annotations

import argparse
from pathlib import Path

from hsloc.evaluation import evaluate
from hsloc.log import ReadOptions
from hsloc.maps import save_map
from hsloc.replay.run import run
from hsloc.request import RunRequest


def main() -> None:
    """Run it from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path)
    parser.add_argument("--split", type=float, default=40.0, help="seconds of the log to map; the rest is localised")
    parser.add_argument("--end", type=float, help="stop after so many seconds of the log")
    parser.add_argument("--out", type=Path, default=Path("results/example-map"), help="folder of the map")
    arguments = parser.parse_args()

    mapped = run(RunRequest(logs=(arguments.log,), read=ReadOptions(end_s=arguments.split), mode="slam"))
    arguments.out.mkdir(parents=True, exist_ok=True)
    save_map(mapped.grid, arguments.out)
    height, width = mapped.grid.cells.shape
    side = mapped.grid.resolution
    print(f"map of {width * side:.0f} x {height * side:.0f} m at {side:g} m: {arguments.out / 'map.yaml'}")

    rest = ReadOptions(start_s=arguments.split, end_s=arguments.end)
    found = run(RunRequest(logs=(arguments.log,), read=rest, map_path=arguments.out / "map.yaml", unknown_start=True))
    print(f"{100 * found.localised.mean():.0f} % of the rest localised on it")
    if found.reference is not None:
        # The built map has a frame of its own, so the truth is aligned first.
        errors = evaluate(found.trajectory, found.reference, alignment="se2").ape
        print(f"APE rmse: {100 * errors.trans_part.rmse:.1f} cm")


if __name__ == "__main__":
    main()

"""Localise a recorded robot on the map in its log, and print how good that is.

python examples/localise.py recordings/office.mcap --out results/example
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from hsloc.evaluation import evaluate
from hsloc.export.results_folder import write_results
from hsloc.log import ReadOptions
from hsloc.replay.run import run
from hsloc.request import RunRequest


def main() -> None:
    """Run it from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path)
    parser.add_argument("--out", type=Path, help="write all results here")
    parser.add_argument("--end", type=float, help="stop after so many seconds of the log")
    arguments = parser.parse_args()

    result = run(RunRequest(logs=(arguments.log,), read=ReadOptions(end_s=arguments.end), unknown_start=True))

    seconds = (result.trajectory.stamps_ns - result.trajectory.stamps_ns[0]) / 1e9
    print(f"{len(seconds)} poses over {seconds[-1]:.1f} s, {100 * result.localised.mean():.0f} % localised")
    first = int(np.argmax(result.localised))
    x, y, theta = result.trajectory.poses[first]
    print(f"first localised pose: x {x:.3f} m, y {y:.3f} m, heading {np.degrees(theta):.1f} deg")
    if result.reference is not None:
        errors = evaluate(result.trajectory, result.reference).ape
        print(f"APE rmse: {100 * errors.trans_part.rmse:.1f} cm, {errors.angle_deg.rmse:.2f} deg")
    if arguments.out is not None:
        write_results(result, arguments.out)
        print(f"look at {arguments.out / 'report.html'}")


if __name__ == "__main__":
    main()

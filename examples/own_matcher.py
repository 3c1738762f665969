"""A matcher of your own: a grid search, and how it compares with HIDE on the scans of a log.

python examples/own_matcher.py recordings/office.mcap
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hsloc.log import ReadOptions, open_log
from hsloc.matching import Hide, LikelihoodField, Match, Matcher, StopReason, Window
from hsloc.model import Pose2, Scan, Truth

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray


@dataclass(frozen=True)
class GridSearch:
    """Tries `steps` values of x, of y and of the heading, each on all points."""

    steps: int = 11

    def match(self, points: NDArray[np.float64], field: LikelihoodField, window: Window, rng: Generator) -> Match:
        """Match points (n, 2), in metres and seen from the base, against a field."""
        centre = np.array((window.centre.x, window.centre.y, window.centre.theta))
        axes = [np.linspace(-half, half, self.steps) for half in window.half_widths()]
        poses = centre + np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        fitness = np.array([field.fitness(points, Pose2(*pose)) for pose in poses])
        best = int(fitness.argmax())
        spacing = np.array([axis[1] - axis[0] for axis in axes])
        return Match(
            Pose2(*poses[best]), float(fitness[best]), np.diag(spacing**2 / 12.0), len(poses), StopReason.BUDGET
        )


def main() -> None:
    """Run it from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path, help="a log with a map and a truth")
    parser.add_argument("--scans", type=int, default=20, help="number of scans to match")
    arguments = parser.parse_args()

    log = open_log(arguments.log, ReadOptions(end_s=20.0))
    grid = log.map()
    assert grid is not None
    field = LikelihoodField.from_grid(grid)
    events = list(log.events())
    truth = {event.stamp_ns: event.T_map_base for event in events if isinstance(event, Truth)}
    scans = [event for event in events if isinstance(event, Scan) and event.stamp_ns in truth][: arguments.scans]

    matchers: dict[str, Matcher] = {"grid search": GridSearch(), "HIDE": Hide()}
    for name, matcher in matchers.items():
        rng = np.random.default_rng(0)
        begin, errors, evaluations = time.perf_counter(), [], 0
        for scan in scans:
            pose = truth[scan.stamp_ns]
            offset = rng.uniform((-0.2, -0.2, -0.1), (0.2, 0.2, 0.1))
            guess = Pose2(pose.x + offset[0], pose.y + offset[1], pose.theta + offset[2])
            found = matcher.match(scan.points_base(), field, Window(guess, 0.25, 0.25, 0.15), rng)
            errors.append(found.pose.distance(pose))
            evaluations += found.evaluations
        ms = 1000 * (time.perf_counter() - begin) / len(scans)
        print(
            f"{name:12} median error {100 * np.median(errors):5.2f} cm, "
            f"{evaluations / len(scans):6.0f} evaluations and {ms:6.1f} ms a scan"
        )


if __name__ == "__main__":
    main()

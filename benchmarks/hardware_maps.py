"""Maps of drives with faults of real hardware: how far the poses are from the truth, and the verdict.

    python benchmarks/hardware_maps.py [--seeds N ...] [--shapes SHAPE ...] [KIND ...]

Drives and kinds are those of `hardware.py`, without a map, as `hsloc map` gets them. A line for each run: root mean
square and largest error of the poses (cm), relative to the first one, and the verdict with the codes of its reasons.
"""

from __future__ import annotations

import argparse
import tempfile
from itertools import product
from pathlib import Path

import numpy as np
from confusion import SHAPES
from hardware import KINDS, written

from hsloc import run
from hsloc.analysis.analyse import analyse
from hsloc.model import Pose2
from hsloc.model.pose2 import compose_poses


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--shapes", nargs="+", default=["rooms", "ring", "hall"], choices=SHAPES)
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"of {'; '.join(KINDS)}".replace("%", "%%"))
    arguments = parser.parse_args()
    for name, shape, seed in product(arguments.kinds or KINDS, arguments.shapes, arguments.seeds):
        with tempfile.TemporaryDirectory() as folder:
            path, drive = written(KINDS[name], shape, seed, Path(folder))
            result = run(path, mode="slam")
            metrics = analyse(result).metrics
        true, found = drive.truth().interpolated(result.trajectory.stamps_ns), result.trajectory.poses
        begin = Pose2.from_array(true[0]) @ Pose2.from_array(found[0]).inverse()
        off = compose_poses(begin.to_array(), found) - true
        error = 100.0 * np.hypot(off[:, 0], off[:, 1])
        reasons = " ".join(reason.code for reason in metrics.verdict_reasons)
        errors = f"{np.sqrt(np.mean(error**2)):7.1f} {error.max():7.1f}"
        print(f"{name:22s} {shape:5s} {seed} {errors} {metrics.verdict.value:6s} {reasons}", flush=True)


if __name__ == "__main__":
    main()

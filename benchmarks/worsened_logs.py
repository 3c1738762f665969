"""A CARMEN log, worsened in one of the ways in which recorders, lidars and wheels are wrong.

    python benchmarks/worsened_logs.py LOG.clf.gz OUT.clf KIND

What is wrong is known, so the result of `hsloc map OUT.clf` is compared with that of the log as it was.
`real_maps.py --degrade benchmarks/worsened_logs.py --kinds gap reset` maps such logs and judges the results.
"""

from __future__ import annotations

import argparse
import gzip
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hsloc.model import Pose2

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    F64 = NDArray[np.float64]

NO_RETURN_M = 70.0
"""Ranges beyond this are those of beams that came back from nowhere [m]."""


class Line:
    """A FLASER or ODOM line: the ranges (n,), the poses as rows of x, y and theta, and its stamp in seconds."""

    def __init__(self, fields: list[str]) -> None:
        beams = int(fields[1]) if fields[0] == "FLASER" else 0
        start = 2 + beams if fields[0] == "FLASER" else 1
        poses = 2 if fields[0] == "FLASER" else 1
        self.name = fields[0]
        self.ranges = np.array(fields[2 : 2 + beams], dtype=np.float64)
        self.poses = np.array(fields[start : start + 3 * poses], dtype=np.float64).reshape(poses, 3)
        self.between = fields[start + 3 * poses : -3]
        self.seconds = float(fields[-3])
        self.end = fields[-2:]

    @property
    def is_scan(self) -> bool:
        return self.name == "FLASER"

    def __str__(self) -> str:
        ranges = [str(len(self.ranges)), *(f"{each:.3f}" for each in self.ranges)] if self.is_scan else []
        poses = [f"{each:.6f}" for each in self.poses.ravel()]
        return " ".join((self.name, *ranges, *poses, *self.between, f"{self.seconds:.6f}", *self.end))


def stamps_of(decimals: int) -> Callable[[list[Line]], None]:
    """Stamps are cut to this number of decimals."""

    def change(lines: list[Line]) -> None:
        for line in lines:
            line.seconds = np.floor(line.seconds * 10**decimals) / 10**decimals

    return change


def drift(lines: list[Line]) -> None:
    """The lidar's clock runs 0.2 % fast."""
    first = lines[0].seconds
    for line in lines:
        if line.is_scan:
            line.seconds = first + (line.seconds - first) * 1.002


def gap(lines: list[Line]) -> None:
    """A minute in the middle was not recorded."""
    begin = lines[0].seconds + 0.45 * (lines[-1].seconds - lines[0].seconds)
    lines[:] = [line for line in lines if not begin < line.seconds < begin + 60.0]


def reset(lines: list[Line]) -> None:
    """The odometry begins at zero again half-way."""
    middle = 0.5 * (lines[0].seconds + lines[-1].seconds)
    zero = None
    for line in lines:
        if line.seconds >= middle:
            zero = Pose2.from_array(line.poses[-1]) if zero is None else zero
            line.poses = np.array([zero.between(Pose2.from_array(pose)).to_array() for pose in line.poses])


def wheels(lines: list[Line]) -> None:
    """The wheels are a tenth smaller than is assumed."""
    for line in lines:
        line.poses[:, :2] *= 1.1


def twice(lines: list[Line]) -> None:
    """Each line was recorded twice, 1 ms apart."""
    for line in list(lines):
        again = Line(str(line).split())
        again.seconds += 0.001
        lines.append(again)
    lines.sort(key=lambda line: line.seconds)


def with_ranges(change: Callable[[F64], F64]) -> Callable[[list[Line]], None]:
    """Ranges (n,) of each scan are changed."""

    def each(lines: list[Line]) -> None:
        for line in lines:
            if line.is_scan:
                line.ranges = change(line.ranges)

    return each


def noise_of_range(share: float) -> Callable[[list[Line]], None]:
    """Noise that is a share of the range, as of triangulating lidars."""
    rng = np.random.default_rng(1)

    def noisy(ranges: F64) -> F64:
        return np.where(ranges < NO_RETURN_M, ranges * (1.0 + share * rng.standard_normal(len(ranges))), ranges)

    return with_ranges(noisy)


def stuck(ranges: F64) -> F64:
    """A part of the robot hides a quarter of the beams."""
    changed = ranges.copy()
    changed[3 * len(ranges) // 8 : 5 * len(ranges) // 8] = 0.4
    return changed


KINDS: dict[str, Callable[[list[Line]], None]] = {
    "stamps-1s": stamps_of(0),
    "stamps-0.1s": stamps_of(1),
    "drift": drift,
    "gap": gap,
    "reset": reset,
    "wheels": wheels,
    "twice": twice,
    "steps-10cm": with_ranges(lambda ranges: np.round(ranges, 1)),
    "noise-1%": noise_of_range(0.01),
    "noise-2%": noise_of_range(0.02),
    "noise-3%": noise_of_range(0.03),
    "blind-1m": with_ranges(lambda ranges: np.where(ranges > 1.0, ranges, 0.0)),
    "cut-5m": with_ranges(lambda ranges: np.minimum(ranges, 5.0)),
    "scale-2%": with_ranges(lambda ranges: ranges * 1.02),
    "stuck": with_ranges(stuck),
    "mirrored": with_ranges(lambda ranges: ranges[::-1]),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("kind", choices=KINDS)
    arguments = parser.parse_args()
    opened = gzip.open if arguments.log.suffix == ".gz" else open
    with opened(arguments.log, "rt", errors="replace") as file:
        lines = [Line(text.split()) for text in file if text.startswith(("FLASER ", "ODOM "))]
    KINDS[arguments.kind](lines)
    arguments.out.write_text("".join(f"{line}\n" for line in lines))


if __name__ == "__main__":
    main()

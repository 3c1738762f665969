"""Loops that several places bear out, though walls are looked through.

Where people stand, furniture was moved or a lidar is tilted, the scans of the right place look through walls, too, and
a loop is refused that a single place shows. What is found by chance, or in a place that only looks alike, rarely
agrees with the path and with what the next place finds.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hsloc.model.pose2 import Pose2, mahalanobis_distances, pose_differences, rotated
from hsloc.slam.pair_sums import summed_across
from hsloc.slam.slips import motions_by_steps

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.slam.loop_matcher import Loop
    from hsloc.slam.submaps import Submaps

    F64 = NDArray[np.float64]

_PLACES = 3
"""Places that bear a loop out, itself included: 9 m. Two ends of corridors looked alike over two places."""
_AROUND = 3
"""Places before and after, up to which loops are held against each other."""
_LOOPS = 2
"""Accepted loops that hold a step which the scans refused: a single one shares out the errors of what it spans."""
_AGREES = 3.4
"""Distance of two of them, in standard deviations, up to which they agree: 99 of 100 of three degrees of freedom."""


def corroborated(loops: list[Loop], places: Submaps) -> list[Loop]:
    """The loops that only look through walls, and that such loops of other places around bear out.

    Of those that lead over a step which the scans refused and fewer than two loops hold: elsewhere the path is known,
    and such a loop of a place that looks alike would bend it. Those that join pieces of a path have to pass all tests.
    """
    accepted = np.array([(loop.first, loop.second) for loop in loops if loop.accepted], dtype=np.int64).reshape(-1, 2)
    over_open = np.cumsum(open_steps(np.concatenate(([False], places.uncertain)), accepted))
    refused = [
        loop
        for loop in loops
        if loop.looks_through
        and over_open[loop.second] > over_open[loop.first]
        and places.piece[loop.first] == places.piece[loop.second]
    ]
    return [loop for loop in refused if len(_bearing_out(loop, refused, places)) >= _PLACES - 1]


def open_steps(refused: NDArray[np.bool_], loops: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Steps (n,), to each keyscan or place from the one before, that scans `refused` and odometry alone holds.

    Fewer than two of the accepted `loops` (k, 2) lead over them.
    """
    return np.asarray(refused & (summed_across(len(refused), loops, np.ones(len(loops))) < _LOOPS), dtype=np.bool_)


def _bearing_out(loop: Loop, loops: list[Loop], places: Submaps) -> set[int]:
    """The other places, of the later ones, that have a loop which leads to the same pose."""
    return {
        other.second
        for other in loops
        if abs(other.first - loop.first) <= _AROUND
        and 0 < abs(other.second - loop.second) <= _AROUND
        and _distance(loop, other, places) <= _AGREES
    }


def _distance(loop: Loop, other: Loop, places: Submaps) -> float:
    """Distance (standard deviations) of the other loop from where this one and the path lead."""
    first, of_first = _along(other.first, loop.first, places)
    second, of_second = _along(loop.second, other.second, places)
    steps = np.array([first, loop.T_first_second.to_array(), second])
    expected, covariance = motions_by_steps(
        steps, np.array([of_first, loop.covariance, of_second]), np.array([[0, 3]], dtype=np.int64)
    )
    off = pose_differences(other.T_first_second.to_array()[None], expected)
    return float(mahalanobis_distances(off, covariance + other.covariance)[0])


def _along(begin: int, end: int, places: Submaps) -> tuple[F64, F64]:
    """The way from one place to another along the path, (3,), and its covariance (3, 3)."""
    if begin == end:
        return np.zeros(3), np.zeros((3, 3))
    ends = np.array([[min(begin, end), max(begin, end)]], dtype=np.int64)
    (motion,), (covariance,) = motions_by_steps(places.steps, places.covariances, ends)
    if begin < end:
        return motion, covariance
    back = Pose2.from_array(motion).inverse()
    return back.to_array(), rotated(covariance, back.theta)

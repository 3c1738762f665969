"""Places of a built map at which the robot would have moved faster than it can: loops between places that look alike
tore the path there, or it was carried."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hsloc.model.verdict import spans_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]

_STEPS = (1, 2, 4, 8)
"""Numbers of steps over which the motion is looked at: a path may be torn over several."""
_OF_ODOMETRY, _OF_MAP = 0.99, 0.95
"""Parts of the steps that are slower than the robot's top speed: by odometry, whose wheels spin now and then, and by
the map, of which one step in twenty may be torn."""
_FASTER = 1.5
"""Factor by which the robot may be faster still between two keyscans."""
_LEAST_M = 0.5
"""Least jump (m) beyond what the robot can drive: twice the error from which on a map is wrong."""


def jumps(stamps_ns: I64, poses: F64, odometry: F64 | None) -> list[tuple[int, int]]:
    """First and last keyscan of each stretch of the poses (n, 3) that is too long for its time.

    `stamps_ns` (n,) are the times of the keyscans, `odometry` (n, 3) their poses as recorded, where there are any.
    """
    if len(poses) < 2:
        return []
    seconds = (stamps_ns * 1e-9).astype(np.float64)
    torn = np.zeros(len(poses), dtype=np.bool_)
    top = _speed(seconds, poses, _OF_MAP)
    if odometry is not None:
        top = max(top, _speed(seconds, odometry, _OF_ODOMETRY))
    for steps in _STEPS:
        if steps >= len(poses):
            break
        moved = np.hypot(*(poses[steps:, :2] - poses[:-steps, :2]).T)
        # Stamps that run backwards, as between two logs, say nothing of a speed; nor do those of Intel's 0.9 s.
        driven = _FASTER * top * np.abs(seconds[steps:] - seconds[:-steps])
        if odometry is not None:
            driven = np.maximum(driven, np.hypot(*(odometry[steps:, :2] - odometry[:-steps, :2]).T))
        for k in np.flatnonzero(moved > driven + _LEAST_M).tolist():
            # Where a shorter stretch has it already, that is the place.
            if not torn[k + 1 : k + steps + 1].any():
                torn[k + 1 : k + steps + 1] = True
    return [(first - 1, last) for first, last in spans_of(torn)]


def tears(found: list[tuple[int, int]], poses: F64, odometry: F64 | None) -> list[tuple[int, int]]:
    """The jumps at which the path is torn: also from some keyscans before to some after it disagrees with the odometry.

    At the others only keyscans on one side of the jump are misplaced, and the map around them is not.
    """
    return [jump for jump in found if odometry is None or not _is_bridged(poses, odometry, jump)]


def _is_bridged(poses: F64, odometry: F64, jump: tuple[int, int]) -> bool:
    """Whether poses are as far apart as by the odometry if a few keyscans before the jump, or after it, are left out.

    Lengths are compared: odometry may be wrong in its direction there, as some count backwards as forwards.
    """
    (first, last), few, end = jump, _STEPS[-1], len(poses)
    for before, after in (
        (range(first - 2 * few, first - few + 1), range(last, last + few + 1)),
        (range(first - few, first + 1), range(last + few, last + 2 * few + 1)),
    ):
        rows = [k for k in before if k >= 0], [k for k in after if k < end]
        moved, driven = (
            np.hypot(*(path[rows[1], None, :2] - path[None, rows[0], :2]).transpose(2, 0, 1))
            for path in (poses, odometry)
        )
        if moved.size and np.median(np.abs(moved - driven)) <= _LEAST_M:
            return True
    return False


def _speed(seconds: F64, path: F64, quantile: float) -> float:
    speed = np.hypot(*np.diff(path[:, :2], axis=0).T) / np.maximum(np.abs(np.diff(seconds)), 1e-3)
    return float(np.quantile(speed, quantile))

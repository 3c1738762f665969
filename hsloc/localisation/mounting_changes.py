"""When the laser was turned on the robot: a knock, a screw that gave way, by the steps of matches and odometry.

A laser whose yaw is wrong from a moment on puts each match after it there, as `mounting_error` has it of a whole run:
driving straight on looks like driving aslant. The moment is the one at which two yaws explain the steps best; the parts
before and after it are divided again. Then neighbours are joined whose yaws do not differ beyond doubt.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from hsloc.localisation.mounting_error import (
    LEAST_RAD,
    MIN_SIGMAS,
    PRIOR,
    UNKNOWN_M,
    YAW,
    Steps,
    equal_parts,
    robust_solution,
    without_each_part,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from hsloc.model.trajectory import Trajectory

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]

_FEWEST = 20
"""Minimum number of steps on each side of a change: about 4 m."""
_PARTS = 5
"""Parts of each piece whose errors count as independent of each other."""
_DEPTH = 3
"""How often pieces are divided: into eight at most."""


@dataclass(frozen=True, slots=True)
class YawPiece:
    """From a stamp on (ns; of the first piece the log's first) the laser looks `yaw` ± `sigma` (rad) elsewhere."""

    begin_ns: int
    yaw: float
    sigma: float

    @property
    def is_turned(self) -> bool:
        """Whether it does so beyond doubt, and by enough to matter."""
        return abs(self.yaw) > max(LEAST_RAD, MIN_SIGMAS * self.sigma)


def yaw_pieces(steps: Steps, stamps_ns: I64) -> tuple[YawPiece, ...]:
    """Parts of the run in which the laser looks the same way, in order; none where it never turned.

    `stamps_ns` (m,) are those of the poses between which the `steps` are.
    """
    rows, apart = steps.rows, steps.apart
    bounds = [0, *_divisions(rows, apart, 0, _DEPTH), len(rows)]
    while len(bounds) > 2:
        yaws, sigmas, apart_by = _fitted(rows, apart, bounds)
        doubt = np.abs(np.diff(yaws)) / np.maximum(LEAST_RAD, MIN_SIGMAS * apart_by)
        least = int(np.argmin(doubt))
        if doubt[least] > 1.0:
            begins = [stamps_ns[0], *stamps_ns[steps.second[bounds[1:-1]]]]
            return tuple(map(YawPiece, map(int, begins), yaws.tolist(), sigmas.tolist()))
        del bounds[least + 1]
    return ()


def piece_errors(pieces: Sequence[YawPiece], trajectory: Trajectory) -> F64:
    """What it makes of poses on a map, as absolute errors (n, 3) in m, m, rad; 0 where a piece is not turned.

    What turned a laser moved it as well, by as much as is assumed where nothing shows the place.
    """
    errors = np.zeros((len(trajectory), 3))
    begins = np.array([piece.begin_ns for piece in pieces[1:]])
    which = np.searchsorted(begins, trajectory.stamps_ns, side="right")
    turned = np.array([piece.is_turned for piece in pieces])[which]
    errors[turned] = UNKNOWN_M, UNKNOWN_M, 0.0
    errors[:, 2] = np.where(turned, np.abs([piece.yaw for piece in pieces])[which], 0.0)
    return errors


def _divisions(rows: F64, apart: F64, first: int, depth: int) -> list[int]:
    """Numbers of the steps, of which the first is `first`, at which the yaw may have changed, in order."""
    if depth == 0 or len(rows) < 2 * _FEWEST:
        return []
    _, information, vectors = robust_solution(rows, apart)
    at = _best_division(information, vectors)
    early = _divisions(rows[:at], apart[:at], first, depth - 1)
    return [*early, first + at, *_divisions(rows[at:], apart[at:], first + at, depth - 1)]


def _fitted(rows: F64, apart: F64, bounds: list[int]) -> tuple[F64, F64, F64]:
    """Yaws of the pieces (p,) between these steps, all else the same in all of them, and their standard deviations.

    And those of the differences of neighbours (p - 1,), rad.
    """
    n, pieces = len(rows), len(bounds) - 1
    yaws, part = np.zeros((n, 2, pieces)), np.empty(n, dtype=np.intp)
    for k, (begin, end) in enumerate(pairwise(bounds)):
        yaws[begin:end, :, k] = rows[begin:end, :, YAW]
        part[begin:end] = k * _PARTS + equal_parts(end - begin, _PARTS)
    values, information, vectors = robust_solution(np.concatenate((rows[..., :YAW], yaws), axis=2), apart)
    without = without_each_part(information, vectors, part)[:, YAW:].reshape(pieces, _PARTS, pieces)
    difference = np.diff(without, axis=2)

    def deviation(found: F64) -> F64:
        squares = (found - found.mean(axis=1, keepdims=True)) ** 2
        return np.asarray(np.sqrt((_PARTS - 1) / _PARTS * squares.sum(axis=(0, 1))))

    return values[YAW:], deviation(without), deviation(difference)


def _best_division(information: F64, vectors: F64) -> int:
    """The step at which two yaws, all else the same, lower the sum of squares most."""
    n, p = vectors.shape
    # Sums of the steps before each possible change, and of all.
    before, before_vectors = np.cumsum(information, axis=0), np.cumsum(vectors, axis=0)
    total, total_vectors = before[-1], before_vectors[-1]
    before, before_vectors = before[_FEWEST - 1 : n - _FEWEST], before_vectors[_FEWEST - 1 : n - _FEWEST]
    of_two = np.zeros((len(before), p + 1, p + 1))
    of_two[:, :YAW, :YAW] = total[:YAW, :YAW]
    of_two[:, :YAW, YAW] = of_two[:, YAW, :YAW] = before[:, :YAW, YAW]
    of_two[:, :YAW, p] = of_two[:, p, :YAW] = total[:YAW, YAW] - before[:, :YAW, YAW]
    of_two[:, YAW, YAW], of_two[:, p, p] = before[:, YAW, YAW], total[YAW, YAW] - before[:, YAW, YAW]
    right = np.empty((len(before), p + 1))
    right[:, :YAW] = total_vectors[:YAW]
    right[:, YAW], right[:, p] = before_vectors[:, YAW], total_vectors[YAW] - before_vectors[:, YAW]
    found = np.linalg.solve(of_two + PRIOR * np.eye(p + 1), right[..., None])[..., 0]
    return _FEWEST + int(np.argmax(np.sum(found * right, axis=1)))

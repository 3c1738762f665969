"""What the scans of a short stretch say of the motion along it, without odometry."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from hsloc.kernels.normal_equations import Blocks, PairTerms, add_relative_term, relative
from hsloc.kernels.point_to_line import Term

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]

_PRIOR = 0.1
"""Information (1/m^2; 1/rad^2) of each pose by itself. Internal: keeps the equations solvable if nothing is seen."""


@njit(cache=True, nogil=True)
def window_motions(
    poses: F64, pairs: I64, terms: PairTerms, weight: float, windows: I64, motions: F64, covariances: F64
) -> None:
    """Write the pose of the last scan of each window (m, 2), seen from its first, and its covariance.

    Of the `pairs` (k, 2), sorted, those within a window are solved for with `terms` that were evaluated at `poses`
    (n, 3), times `weight`: `motions` (m, 3) and `covariances` (m, 3, 3), in the frame of the first.
    """
    starts = np.searchsorted(pairs[:, 0], np.arange(len(poses) + 1))
    rel = np.empty(3)
    ha = np.empty((3, 3))
    jj = np.empty((3, 3))
    ji = np.empty((3, 3))
    ii = np.empty((3, 3))
    gj = np.empty(3)
    gi = np.empty(3)
    for w in range(len(windows)):
        begin = windows[w, 0]
        end = windows[w, 1]
        size = 3 * (end - begin)
        matrix = np.zeros((size, size))
        right = np.zeros((size, 4))
        for k in range(size):
            matrix[k, k] = _PRIOR
        for m in range(starts[begin], starts[end]):
            if pairs[m, 1] > end:
                continue
            # The first scan stays: it has no rows.
            j = 3 * (pairs[m, 0] - begin - 1)
            i = 3 * (pairs[m, 1] - begin - 1)
            pose_j = poses[pairs[m, 0]]
            relative(pose_j, poses[pairs[m, 1]], rel)
            jj[:] = 0.0
            ji[:] = 0.0
            ii[:] = 0.0
            gj[:] = 0.0
            gi[:] = 0.0
            term = Term(weight * terms.information[m], weight * terms.gradient[m])
            add_relative_term(pose_j, rel, term, Blocks(jj, ji, ii, gj, gi), ha)
            for a in range(3):
                right[i + a, 3] -= gi[a]
                if j >= 0:
                    right[j + a, 3] -= gj[a]
                for b in range(3):
                    matrix[i + a, i + b] += ii[a, b]
                    if j >= 0:
                        matrix[j + a, j + b] += jj[a, b]
                        matrix[j + a, i + b] += ji[a, b]
                        matrix[i + b, j + a] += ji[a, b]
        for a in range(3):
            right[size - 3 + a, a] = 1.0
        solved = np.linalg.solve(matrix, right)
        last = poses[end] + solved[size - 3 :, 3]
        relative(poses[begin], last, motions[w])
        c = np.cos(poses[begin, 2])
        s = np.sin(poses[begin, 2])
        turn = np.array(((c, s, 0.0), (-s, c, 0.0), (0.0, 0.0, 1.0)))
        covariances[w] = turn @ np.ascontiguousarray(solved[size - 3 :, :3]) @ turn.T


@njit(cache=True, nogil=True)
def composed_motions(steps: F64, step_covariances: F64, windows: I64, motions: F64, covariances: F64) -> None:
    """Write the motion along each window (m, 2) by `steps` (n - 1, 3) with `step_covariances` (n - 1, 3, 3) alone.

    `motions` (m, 3) and `covariances` (m, 3, 3) are in the frame of the first scan, to first order.
    """
    for w in range(len(windows)):
        x = y = theta = 0.0
        total = np.zeros((3, 3))
        for k in range(windows[w, 0], windows[w, 1]):
            c = np.cos(theta)
            s = np.sin(theta)
            dx = c * steps[k, 0] - s * steps[k, 1]
            dy = s * steps[k, 0] + c * steps[k, 1]
            along = np.array(((1.0, 0.0, -dy), (0.0, 1.0, dx), (0.0, 0.0, 1.0)))
            turn = np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))
            total = along @ total @ along.T + turn @ np.ascontiguousarray(step_covariances[k]) @ turn.T
            x += dx
            y += dy
            theta += steps[k, 2]
        motions[w, 0] = x
        motions[w, 1] = y
        motions[w, 2] = theta
        covariances[w] = total

"""Motions along windows of a path: by the pairs of scans in them, and by the steps of the odometry."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from hsloc.kernels.normal_equations import PairTerms
from hsloc.kernels.registration import composed_motions, window_motions
from hsloc.model.pose2 import compose_poses, relative_poses

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    F64 = NDArray[np.float64]

STEP = 1e-6


def derivative(function: Callable[[F64], F64], at: F64) -> F64:
    """Of three values by all entries of `at`: shape (3, at.size)."""
    columns = []
    for k in range(at.size):
        change = (STEP * np.eye(at.size)[k]).reshape(at.shape)
        columns.append((function(at + change) - function(at - change)) / (2.0 * STEP))
    return np.column_stack(columns)


def spread(rng: Any, n: int) -> F64:
    roots = rng.normal(size=(n, 3, 3))
    found: F64 = roots @ roots.transpose(0, 2, 1) + np.eye(3)
    return found


def test_steps_are_composed_with_their_covariances(rng: Any) -> None:
    steps, covariances = rng.normal(size=(7, 3)), spread(rng, 7)
    windows = np.array([[0, 7], [2, 5], [3, 4]])
    motions, found = np.empty((3, 3)), np.empty((3, 3, 3))
    composed_motions(steps, covariances, windows, motions, found)

    def along(some: F64) -> F64:
        pose = np.zeros(3)
        for each in some:
            pose = np.append(compose_poses(pose, each[None])[0, :2], pose[2] + each[2])
        return pose

    for (first, last), motion, covariance in zip(windows.tolist(), motions, found, strict=True):
        np.testing.assert_allclose(motion, along(steps[first:last]), atol=1e-12)
        jacobian = derivative(along, steps[first:last]).reshape(3, last - first, 3)
        expected = np.einsum("akb,kbc,dkc->ad", jacobian, covariances[first:last], jacobian)
        np.testing.assert_allclose(covariance, expected, rtol=1e-6, atol=1e-7)


def test_pairs_in_a_window_give_its_motion(rng: Any) -> None:
    """The least squares over the poses behind the first, which stands still, by numeric derivatives."""
    poses = np.cumsum(rng.uniform(0.1, 0.4, (6, 3)), axis=0)
    pairs = np.array([[0, 1], [0, 2], [1, 2], [1, 3], [2, 3], [2, 5], [3, 4], [4, 5]])
    information, weight = 50.0 * spread(rng, len(pairs)), 3.0
    gradient = rng.normal(size=(len(pairs), 3))
    terms = PairTerms(information, gradient, np.zeros((len(pairs), 5)), information)
    windows = np.array([[0, 3], [1, 4], [2, 5]])
    motions, found = np.empty((3, 3)), np.empty((3, 3, 3))
    window_motions(poses, pairs, terms, weight, windows, motions, found)
    for (first, last), motion, covariance in zip(windows.tolist(), motions, found, strict=True):
        size = 3 * (last - first)
        # What holds a pose that no pair holds: a standard deviation of 3 m.
        matrix, right = 0.1 * np.eye(size), np.zeros(size)
        for (j, i), h, g in zip(pairs.tolist(), information, gradient, strict=True):
            if j < first or i > last:
                continue

            def seen(behind: F64, j: int = j, i: int = i, first: int = first) -> F64:
                every = np.concatenate((poses[first : first + 1], behind))
                return np.asarray(relative_poses(every[j - first][None], every[i - first][None])[0], dtype=np.float64)

            jacobian = derivative(seen, poses[first + 1 : last + 1])
            matrix += weight * jacobian.T @ h @ jacobian
            right -= weight * jacobian.T @ g
        moved = poses[last] + np.linalg.solve(matrix, right)[-3:]
        np.testing.assert_allclose(motion, relative_poses(poses[first][None], moved[None])[0], atol=1e-5)
        c, s = np.cos(poses[first, 2]), np.sin(poses[first, 2])
        turn = np.array(((c, s, 0.0), (-s, c, 0.0), (0.0, 0.0, 1.0)))
        expected = turn @ np.linalg.inv(matrix)[-3:, -3:] @ turn.T
        np.testing.assert_allclose(covariance, expected, rtol=1e-6, atol=1e-10)

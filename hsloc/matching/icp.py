"""Iterative closest point, point to point: the baseline of the course report ([P] II)."""

from __future__ import annotations

import weakref
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hsloc.matching.covariance import match_covariance
from hsloc.matching.harmony_search import half_widths_in, information_at
from hsloc.matching.match import Match, StopReason
from hsloc.model.pose2 import Pose2
from hsloc.parameters import Count, NonNegative, Parameters, Positive

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray
    from scipy.spatial import cKDTree

    from hsloc.matching.likelihood_field import LikelihoodField
    from hsloc.matching.window import Window

    F64 = NDArray[np.float64]

_trees: weakref.WeakKeyDictionary[LikelihoodField, cKDTree] = weakref.WeakKeyDictionary()


@dataclass(frozen=True, slots=True, kw_only=True)
class Icp(Parameters):
    """Pair each point with the nearest wall, solve for the rigid motion in closed form (Arun et al. 1987), repeat.

    It starts at the window's centre and knows no window otherwise.
    """

    iterations: Count = 50
    """Maximum number of iterations."""
    max_distance: Positive = 1.0
    """Maximum distance of a point from the wall that it is paired with [m]."""
    tolerance: NonNegative = 1e-4
    """Step below which the iteration has converged, in metres and radians alike."""

    def match(self, points: F64, field: LikelihoodField, window: Window, rng: Generator) -> Match:
        """See `Matcher`; `rng` is not used."""
        half = half_widths_in(field, window)
        tree = _tree(field)
        if len(points) == 0 or tree.n == 0:
            return Match(window.centre, 0.0, np.diag(half**2 / 3.0), 0, StopReason.NO_POINTS)
        pose, stopped, rounds = window.centre, StopReason.BUDGET, 0
        for _ in range(self.iterations):
            rounds += 1
            moved = pose @ points
            distance, nearest = tree.query(moved, distance_upper_bound=self.max_distance)
            paired = np.isfinite(distance)
            if paired.sum() < 3:
                break
            step = rigid_motion(moved[paired], tree.data[np.asarray(nearest)[paired]])
            pose = step @ pose
            if max(abs(step.x), abs(step.y), abs(step.theta)) < self.tolerance:
                stopped = StopReason.CONVERGED
                break
        fitness = field.fitness(points, pose)
        information = information_at(field, field.scale(points), field.to_cells(pose))
        covariance = match_covariance(information, len(points), fitness, field, window)
        return Match(pose, fitness, covariance, rounds + 1, stopped)


def rigid_motion(source: F64, target: F64) -> Pose2:
    """The motion that brings points (n, 2) onto their partners with the least sum of squares."""
    a, b = source.mean(axis=0), target.mean(axis=0)
    p, q = source - a, target - b
    theta = float(np.arctan2((p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum(), (p * q).sum()))
    moved = Pose2(0.0, 0.0, theta) @ a
    return Pose2(float(b[0] - moved[0]), float(b[1] - moved[1]), theta)


def _tree(field: LikelihoodField) -> cKDTree:
    tree = _trees.get(field)
    if tree is None:
        from scipy.spatial import cKDTree

        tree = _trees[field] = cKDTree(field.wall_points())
    return tree

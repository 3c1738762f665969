"""How well a map's poses are known: marginal covariances of the solved graph, and the graph with all that holds it.

The information of a pair of scans is that of its paired points, whose noise is measured in the log itself
(`noise_of`), without what the noise of the normals adds to it (`hsloc.kernels.point_to_line.PairTerm`). What is not
modelled is not in it: stamps that are wrong, lidars that tilt, walls that moved.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hsloc.kernels.normal_equations import Equations, add_edges
from hsloc.model.pose2 import pose_differences, relative_poses, wrap_angles
from hsloc.slam.joint_registration import normal_equations
from hsloc.slam.pose_graph import Edges, anchored, edge_errors
from hsloc.slam.sparse_solver import BlockSystem

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.kernels.normal_equations import PairTerms
    from hsloc.slam.joint_registration import Registration

    F64 = NDArray[np.float64]

_VARIANCES = 4.0
"""Variances of a point in the variance of a paired point: a pair compares each wall twice, from either side, with the
same noise, and the noise of both scans is in it."""
_FLAT_M = 0.0055
"""Standard deviation (m) of a wall from the line that is fitted to it, where it bends or ends, however good the lidar.
Chosen with `_SCALE`: of 60 simulated drives in random worlds and ten in large buildings (benchmarks/README.md) the
normalised error squared is 3.1 and 2.6 with 6 mm and 0.07 %, 3.5 and 3.1 with 5 mm and 0.05 %."""
FLAT_IN_A_STRETCH_M = 0.014
"""The same where few scans are compared, which see the same walls: it does not average out there as over a map."""
_SCALE = 0.0006
"""Standard deviation of the scale of a map that scans hold: what they get wrong of motions along walls they get wrong
alike everywhere. In ten simulated buildings of 60 to 120 m the scale is off by 0.08 %, in which the noise of the poses
is, too."""
_LEAST_REAL = 0.02
"""Part of the information of a pair, in any direction, that is kept at least: so that it can be inverted."""
_NOISES = np.geomspace(0.003, 0.1, 60)
"""Standard deviations (m) of points that are distinguished: from a good lidar's on a flat wall to that of rubble."""
_SAMPLES = 300
"""Distances at which the density is summed up. Internal: enough for three digits."""
_UNOBSERVED = 1e-6
"""Part of a pair's information below which a direction counts as not measured. Internal: makes it invertible."""


class CommonErrors(NamedTuple):
    """Errors (k,) that the first m edges have in common: their covariance (k, k), and what they change (k, m, 3)."""

    changes: F64
    covariance: F64


def marginal_covariances(
    refined: Registration, terms: PairTerms, edges: Edges, common: CommonErrors | None = None
) -> F64:
    """Covariance (n, 3, 3) of each pose over (x, y, theta), relative to the first pose, in its frame, the map's.

    `terms` are those of `observed_terms`. Errors that the first edges have in `common` move all poses together, and are
    added, as is that of the map's scale.
    """
    poses = refined.linearised_at
    pairs = np.concatenate((refined.pairs, edges.pairs))
    system = BlockSystem(len(poses), pairs[:, 0], pairs[:, 1])
    of_a_point = information_of_a_point(refined)
    diagonal, off_diagonal, _ = normal_equations(poses, refined.pairs, terms, of_a_point, edges)
    covariances = system.inverse_blocks(anchored(diagonal), off_diagonal)
    if common is not None:
        rights = right_sides(poses, edges[: common.changes.shape[1]], common.changes)
        moved = system.solve_each(anchored(diagonal), off_diagonal, rights)
        covariances = covariances + np.einsum("kni,kl,lnj->nij", moved, common.covariance, moved)
    way = poses[:, :2] - poses[0, :2]
    covariances[:, :2, :2] += _SCALE**2 * way[:, :, None] * way[:, None, :]
    covariances[0] = 0.0
    return covariances


def right_sides(poses: F64, edges: Edges, changes: F64) -> F64:
    """Right sides (k, n, 3) of the equations by changes (k, m, 3) of what the edges measure."""
    information = edges.information * robust_weights(poses, edges)[:, None, None]
    found = np.zeros((len(changes), len(poses), 3))
    relative, trusted = relative_poses(poses[edges.pairs[:, 0]], poses[edges.pairs[:, 1]]), np.full(len(edges), np.inf)
    diagonal, off_diagonal = np.zeros((len(poses), 3, 3)), np.empty((len(edges), 3, 3))
    for change, right in zip(changes, found, strict=True):
        equations = Equations(diagonal, off_diagonal, right)
        add_edges(poses, edges.pairs, relative - change, information, trusted, equations)
    return found


def robust_weights(poses: F64, edges: Edges) -> F64:
    """Weights (m,) of the edges in the equations."""
    _, _, chi = edge_errors(poses, edges)
    finite = np.isfinite(edges.scale)
    scale2 = np.where(finite, edges.scale, 1.0) ** 2
    return np.where(finite, scale2 / (scale2 + chi**2), 1.0)


def observed_terms(refined: Registration) -> PairTerms:
    """The terms of the pairs with the information that is not due to the noise of the normals.

    In no direction it is more than theirs; of the part that is left at least `_LEAST_REAL` is kept.
    """
    before = refined.terms
    added = 1e-9 * np.trace(before.information, axis1=1, axis2=2)[:, None, None] + 1e-12
    root = np.linalg.cholesky(before.information + added * np.eye(3))
    # In coordinates in which the terms' information is the identity.
    half = np.linalg.solve(root, before.observed)
    parts, axes = np.linalg.eigh(np.linalg.solve(root, half.transpose(0, 2, 1)))
    axes = root @ axes
    information = np.einsum("mik,mk,mjk->mij", axes, np.clip(parts, _LEAST_REAL, 1.0), axes)
    return before._replace(information=information)


def all_edges(refined: Registration, terms: PairTerms, edges: Edges) -> Edges:
    """The `edges`, with the weights that they have in the solved graph, and the pairs of scans as edges.

    What a pair measures is the pose at which its own points agree best, to second order, brought nearer to the solved
    one as far as its information is larger than its weight in the solution: so other solvers find the same poses, and
    the same covariances, but for errors that edges have in common. All edges are trusted, for their robust weights are
    in their information. `terms` are those of `observed_terms`.
    """
    before, poses = refined.linearised_at, refined.poses
    weights = robust_weights(before, edges)
    # A pair without a paired point holds nothing.
    of_pairs = refined.counts[:, 0] > 0.0
    pairs, hessian = refined.pairs[of_pairs], terms.information[of_pairs]
    first, second = pairs[:, 0], pairs[:, 1]
    relative = relative_poses(poses[first], poses[second])
    moved = pose_differences(relative, relative_poses(before[first], before[second]))
    solved = refined.terms.information[of_pairs]
    gradient = refined.terms.gradient[of_pairs] + np.einsum("mij,mj->mi", solved, moved)
    # The gradient lies in the span of the information: what is added hardly moves the pose that solves for it.
    added = _UNOBSERVED * np.trace(hessian, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    offset = np.linalg.solve(hessian + added, gradient[:, :, None])[:, :, 0]
    of_a_point = information_of_a_point(refined)
    measured = relative - refined.weight / of_a_point * offset
    measured[:, 2] = wrap_angles(measured[:, 2])
    return Edges(
        np.concatenate((edges.pairs, pairs)),
        np.concatenate((edges.measured, measured)),
        np.concatenate((edges.information * weights[:, None, None], of_a_point * hessian)),
        np.full(len(edges) + len(pairs), np.inf),
    )


def information_of_a_point(refined: Registration, flat: float = _FLAT_M) -> float:
    """Information of a paired point (1/m^2), by the noise of this log's points; `flat` is that of the walls (m)."""
    return 1.0 / (_VARIANCES * (noise_of(refined.rms, refined.gate, refined.scale) ** 2 + flat**2))


def noise_of(rms: float, gate: float, scale: float) -> float:
    """Standard deviation (m) of normal distances whose root mean square is `rms`, robustly weighted, within a gate.

    Geman-McClure's weights take the larger distances out: the plain figure would be too small.
    """
    distance = np.linspace(0.0, gate, _SAMPLES)
    density = np.exp(-0.5 * (distance / _NOISES[:, None]) ** 2) / (1.0 + (distance / scale) ** 2) ** 2
    weighted = np.sqrt((density * distance**2).sum(axis=1) / density.sum(axis=1))
    return float(np.interp(rms, weighted, _NOISES)) if rms == rms else float(_NOISES[-1])

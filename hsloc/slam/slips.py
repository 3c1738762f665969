"""Where wheels slipped: stretches over which the scans contradict the odometry.

A slip of half a metre over a second is shared out over ten steps, each of which passes for noise; where few points fix
the position along a corridor the solution follows the odometry. Over the whole stretch the two are distinguished: the
motion by the scans alone, and that by the odometry alone, with the covariances of both (an innovation test). Where they
contradict each other, the odometry loses its weight.

A slip along a bare corridor is not noticed by this: recesses and door frames that are displaced by more than the gate
of the registration are not paired, and the side walls agree. Where the scans hardly fix the motion, the scans before
and after the stretch are therefore held against each other with the motion as found, and displaced.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hsloc.kernels.normal_equations import Equations, add_edges
from hsloc.kernels.registration import composed_motions, displaced_agreement, window_motions
from hsloc.model.pose2 import mahalanobis_distances, pose_differences, relative_poses
from hsloc.slam.joint_registration import normal_equations
from hsloc.slam.marginals import FLAT_IN_A_STRETCH_M, information_of_a_point
from hsloc.slam.pose_graph import Edges, anchored
from hsloc.slam.sparse_solver import BlockSystem

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.kernels.normal_equations import PairTerms
    from hsloc.kernels.point_to_line import ScanArrays
    from hsloc.slam.joint_registration import Registration

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]

_STEPS = 20
"""Steps of a stretch, at most."""
_LONGEST_M = 2.5
"""Way [m] from which on a stretch ends before: longer than wheels slip in one go, a second or two at walking pace, and
short enough that scans before and after see the same walls, and that the odometry says something."""
STRETCHES_DEEP = 4
"""Stretches that lie over each step."""
_CONTRADICTION = 3.5
"""Normalised difference from which on the two contradict each other. Of some 50,000 stretches of simulated drives none
without a slip reaches 3, and most slips have 5 to 60; along bare walls the points within the gate show a part of one,
and a slip of 0.7 m had less than 4. With 3, Intel and Freiburg 079 with cut ranges became worse by 1 to 2 mm."""
_LEFT_OUT = 100.0
"""Variance (m^2) of a step above which it joins two logs, and no stretch leads over it."""
_HARDLY_M = 0.05
"""Standard deviation [m] of the scans' motion from which on displacements are tried: five of it hide a slip that
matters, and along bare walls points that are paired with others than their own make it too small."""
_DISPLACEMENTS = np.concatenate((np.arange(-24, -4), np.arange(5, 25))) * 0.05
"""Displacements [m] that are tried: from a quarter of a metre, beyond the gate, up to 1.2 m."""
_HERE = np.array((-0.1, -0.05, 0.0, 0.05, 0.1))
"""Displacements [m] that count as none."""
_LEAST_MARGIN = 0.03
"""Margin (`Stretches.margin`) from which on a displaced stretch would be noticed after all. In random worlds (seeds
1000 to 1038 of benchmarks/map_league.py) one of 82 weak stretches that were wrong has more, and none 0.05; of 888 right
ones, most along bare walls, a tenth has."""
_COMPARED = 4
"""Keyscans before and after a stretch that are held against each other, up to every third."""
_NEAR = 30
"""Keyscans from one to another up to which a pair is of one visit."""
_SLIPPED = np.diag((0.1**2, 0.1**2, 0.1**2))
"""Covariance (m^2, rad^2) that is added to each step of such a stretch: as much as the step is long."""


@dataclass(frozen=True, slots=True, eq=False)
class Motions:
    """Stretches of the path, and the motions along each by scans and by odometry.

    `ends` (m, 2) are their first and last keyscans. `difference` (m, 3) is the motion by the scans less that by the
    odometry, in the frame of the first, `normalised` (m,) its length in standard deviations.
    """

    ends: I64
    difference: F64
    normalised: F64

    @property
    def contradicted(self) -> NDArray[np.bool_]:
        """Which of them contradict the odometry, shape (m,)."""
        return self.normalised > _CONTRADICTION

    def slipped(self, steps: int) -> NDArray[np.bool_]:
        """Steps, of that number, in such stretches."""
        slipped = np.zeros(steps, dtype=np.bool_)
        for first, last in self.ends[self.contradicted].tolist():
            slipped[first:last] = True
        return slipped


@dataclass(frozen=True, slots=True, eq=False)
class Stretches(Motions):
    """The same with what the scans know of the motion along each.

    `sigma` (m,) is the standard deviation (m) of the scans' motion in its worst direction. `margin` (m,) is by how much
    more of the points of the scans before and after agree with the motion as found than with any that is displaced in
    that direction, a ratio; 1 where the scans fix the motion. `axis` (m, 2) is that direction, in the map.
    """

    sigma: F64
    margin: F64
    axis: F64

    @property
    def hidden(self) -> NDArray[np.bool_]:
        """Those (m,) whose own scans do not show a slip: no wall fixes the motion, and displaced it fits as well."""
        return (self.sigma > _HARDLY_M) & (self.margin < _LEAST_MARGIN)


def compare_with_odometry(refined: Registration, steps: Edges) -> Motions:
    """Hold the scans of each stretch against the odometry's `steps` (n - 1) along it."""
    covariances: F64 = np.asarray(np.linalg.inv(steps.information), dtype=np.float64)
    ends = stretch_ends(steps, covariances)
    seen, seen_covariance = motions_by_scans(refined, refined.terms, ends)
    driven, driven_covariance = motions_by_steps(steps.measured, covariances, ends)
    difference = pose_differences(seen, driven)
    return Motions(ends, difference, mahalanobis_distances(difference, seen_covariance + driven_covariance))


def motions_by_scans(refined: Registration, terms: PairTerms, ends: I64) -> tuple[F64, F64]:
    """Motions (m, 3) between `ends` (m, 2) by the `terms` of the pairs alone, and their covariances (m, 3, 3)."""
    motions, covariances = np.empty((len(ends), 3)), np.empty((len(ends), 3, 3))
    of_a_point = information_of_a_point(refined, FLAT_IN_A_STRETCH_M)
    window_motions(refined.linearised_at, refined.pairs, terms, of_a_point, ends, motions, covariances)
    return motions, covariances


def motions_by_steps(steps: F64, of_steps: F64, ends: I64) -> tuple[F64, F64]:
    """Motions (m, 3) between `ends` (m, 2) by steps (n - 1, 3) of covariances `of_steps` (n - 1, 3, 3); theirs."""
    motions, covariances = np.empty((len(ends), 3)), np.empty((len(ends), 3, 3))
    composed_motions(steps, of_steps, ends, motions, covariances)
    return motions, covariances


def known_by_scans(motions: Motions, refined: Registration, scans: ScanArrays, observed: PairTerms) -> Stretches:
    """The stretches with what the scans know of them; `observed` are the terms of `marginals.observed_terms`."""
    ends = motions.ends
    _, covariance = motions_by_scans(refined, observed, ends)
    variances, axes = np.linalg.eigh(covariance[:, :2, :2])
    sigma = np.sqrt(np.maximum(variances[:, -1], 0.0))
    headings = refined.poses[ends[:, 0], 2]
    c, s, weakest = np.cos(headings), np.sin(headings), axes[:, :, -1]
    axis = np.column_stack((c * weakest[:, 0] - s * weakest[:, 1], s * weakest[:, 0] + c * weakest[:, 1]))
    margin = np.ones(len(ends))
    for k in np.flatnonzero(sigma > _HARDLY_M).tolist():
        margin[k] = _margin(refined, scans, ends[k], axis[k])
    return Stretches(ends, motions.difference, motions.normalised, sigma, margin, axis)


def stretch_ends(steps: Edges, covariances: F64) -> I64:
    """First and last keyscans (m, 2) of stretches, none of which leads from one log to another."""
    joints = covariances[:, 0, 0] > _LEFT_OUT
    way = np.concatenate(([0.0], np.cumsum(np.hypot(steps.measured[:, 0], steps.measured[:, 1]))))
    last = np.minimum(np.searchsorted(way, way + _LONGEST_M), np.arange(len(way)) + _STEPS)
    before = np.concatenate(([0], np.cumsum(joints)))
    ends, first = [], 0
    while last[first] < len(way):
        if before[last[first]] == before[first]:
            ends.append((first, last[first]))
        first += max((last[first] - first) // STRETCHES_DEEP, 1)
    return np.array(ends, dtype=np.int64).reshape(-1, 2)


def joined(ends: I64) -> list[tuple[int, int]]:
    """Stretches (m, 2) in ascending order as runs: those that overlap are one."""
    runs: list[tuple[int, int]] = []
    for first, last in ends.tolist():
        runs[-1:] = [(runs[-1][0], last)] if runs and first <= runs[-1][1] else [*runs[-1:], (first, last)]
    return runs


def _margin(refined: Registration, scans: ScanArrays, ends: I64, axis: F64) -> float:
    """Agreement across a stretch as found, less the best agreement displaced along `axis` (2,) in the map."""
    first, last = ends.tolist()
    # As far apart as the stretches begin: every third keyscan where these are dense.
    every = max((last - first) * 3 // _STEPS, 1)
    reach = every * _COMPARED
    before = np.arange(max(first - reach + every, 0), first + 1, every)
    after = np.arange(last, min(last + reach - every + 1, len(refined.poses)), every)
    tried = np.concatenate((_HERE, _DISPLACEMENTS))[:, None] * axis
    sums = np.empty((len(tried), 2))
    every_wall = (0.0, 0.0)
    displaced_agreement(refined.poses, (before, after), tried, every_wall, scans, refined.gate, refined.scale, sums)
    agreement = sums[:, 0] / np.maximum(sums[:, 1], 1.0)
    return float(agreement[: len(_HERE)].max() - agreement[len(_HERE) :].max())


def without_slips(steps: Edges, slipped: NDArray[np.bool_]) -> Edges:
    """The steps, those that are `slipped` (n - 1,) with next to no weight."""
    information = steps.information.copy()
    information[slipped] = np.linalg.inv(np.linalg.inv(steps.information[slipped]) + _SLIPPED)
    return replace(steps, information=information)


@dataclass(frozen=True, slots=True, eq=False)
class Held:
    """What the rest of the map says of the motion along hidden stretches, their own odometry left out.

    `stretches` (h,) are their numbers. `sigma` (h,) is the standard deviation (m) of the motion in the direction that
    their own scans do not fix, `difference` (h,) how much farther (m) the odometry went in it, and `odometry_sigma`
    (h,) the standard deviation (m) of that.
    """

    stretches: I64
    sigma: F64
    difference: F64
    odometry_sigma: F64

    @property
    def normalised(self) -> F64:
        """The differences (h,) in standard deviations."""
        return np.asarray(np.abs(self.difference) / np.hypot(self.sigma, self.odometry_sigma), dtype=np.float64)

    def marked(self, stretches: Stretches) -> Stretches:
        """The stretches, those that contradict the odometry by this among the others that do."""
        normalised = stretches.normalised.copy()
        normalised[self.stretches] = np.maximum(normalised[self.stretches], self.normalised)
        return replace(stretches, normalised=normalised)


def held_by_the_rest(
    refined: Registration, observed: PairTerms, edges: Edges, steps: Edges, stretches: Stretches
) -> Held:
    """The motions along hidden stretches by all that holds them but their own odometry.

    `edges` are those of the graph, of which the first n - 1 are the odometry as weighed; `steps` are the same as
    recorded. Of scans in hidden stretches nothing is believed in their direction: bare walls agree wherever they are.
    """
    chosen = np.flatnonzero(stretches.hidden)
    ends, axes = stretches.ends[chosen], stretches.axis[chosen]
    sigma, difference, odometry_sigma = np.empty((3, len(chosen)))
    if len(chosen) == 0:
        return Held(chosen, sigma, difference, odometry_sigma)
    poses, pairs = refined.linearised_at, np.concatenate((refined.pairs, edges.pairs))
    terms, of_a_point = (
        _without_hidden(refined, observed, stretches),
        information_of_a_point(refined, FLAT_IN_A_STRETCH_M),
    )
    diagonal, off_diagonal, right = normal_equations(poses, refined.pairs, terms, of_a_point, edges)
    # The covariances between all poses of a stretch are wanted: they are in the pattern, with zeros.
    wanted = [first + np.column_stack(np.triu_indices(last + 1 - first)) for first, last in ends.tolist()]
    between = np.unique(np.concatenate(wanted), axis=0)
    between = between[between[:, 0] < between[:, 1]]
    pairs = np.concatenate((pairs, between))
    off_diagonal = np.concatenate((off_diagonal, np.zeros((len(between), 3, 3))))
    system, held = BlockSystem(len(poses), pairs[:, 0], pairs[:, 1]), anchored(diagonal)
    moved = system.solve(held, off_diagonal, -right)
    blocks = system.inverse_at(held, off_diagonal, np.concatenate(wanted))
    begins = np.concatenate(([0], np.cumsum([len(each) for each in wanted])))
    covariances: F64 = np.asarray(np.linalg.inv(steps.information), dtype=np.float64)
    driven, driven_covariance = motions_by_steps(steps.measured, covariances, ends)
    for k, (first, last) in enumerate(ends.tolist()):
        own = edges[first:last]
        chain = replace(own, pairs=own.pairs - first)
        # The other information on these poses is what is known of them less what their own odometry says.
        known = np.linalg.inv(_joint(blocks[begins[k] : begins[k + 1]], last + 1 - first))
        local, matrix, gradient = poses[first : last + 1], *_dense(poses[first : last + 1], chain)
        left = known - matrix
        shift = np.linalg.solve(left, known @ moved[first : last + 1].reshape(-1) + gradient)
        rest = local + shift.reshape(-1, 3)
        axis, between = axes[k], local[-1, :2] - local[0, :2]
        by = np.zeros(len(shift))
        by[:2], by[-3:-1], by[2] = -axis, axis, axis[0] * between[1] - axis[1] * between[0]
        sigma[k] = np.sqrt(max(float(by @ np.linalg.solve(left, by)), 0.0))
        c, s = np.cos(local[0, 2]), np.sin(local[0, 2])
        along = np.array((c * axis[0] + s * axis[1], c * axis[1] - s * axis[0]))
        difference[k] = along @ (driven[k] - relative_poses(rest[:1], rest[-1:])[0])[:2]
        odometry_sigma[k] = np.sqrt(along @ driven_covariance[k, :2, :2] @ along)
    return Held(chosen, sigma, difference, odometry_sigma)


def _joint(blocks: F64, n: int) -> F64:
    """The symmetric matrix (3 n, 3 n) of its `blocks` (n (n + 1) / 2, 3, 3) on and above the diagonal, row by row."""
    matrix = np.empty((n, 3, n, 3))
    row, column = np.triu_indices(n)
    matrix[column, :, row] = blocks.transpose(0, 2, 1)
    matrix[row, :, column] = blocks
    return matrix.reshape(3 * n, 3 * n)


def _dense(poses: F64, edges: Edges) -> tuple[F64, F64]:
    """Information (3 n, 3 n) and gradient (3 n,) of edges between `poses` (n, 3) that follow each other."""
    n = len(poses)
    blocks, diagonal, right = np.empty((n - 1, 3, 3)), np.zeros((n, 3, 3)), np.zeros((n, 3))
    scale = edges.scale
    add_edges(poses, edges.pairs, edges.measured, edges.information, scale, Equations(diagonal, blocks, right))
    matrix = np.zeros((n, 3, n, 3))
    at = np.arange(n)
    matrix[at, :, at] = diagonal
    matrix[at[:-1], :, at[1:]] = blocks
    matrix[at[1:], :, at[:-1]] = blocks.transpose(0, 2, 1)
    return matrix.reshape(3 * n, 3 * n), right.reshape(-1)


def _without_hidden(refined: Registration, observed: PairTerms, stretches: Stretches) -> PairTerms:
    """Terms of the pairs without what they say in the direction of hidden stretches.

    These are pairs of one visit with both scans in such a stretch, and pairs of two visits with a scan of which all
    stretches are hidden. The others keep the pose at which their own points agree best.
    """
    hidden = np.flatnonzero(stretches.hidden)
    ends, n = stretches.ends[hidden], len(refined.poses)
    i, j = refined.pairs.T
    of_scan = np.full(n, -1)
    for k in hidden.tolist():
        first, last = stretches.ends[k]
        of_scan[first : last + 1] = k
    for first, last in stretches.ends[~stretches.hidden].tolist():
        of_scan[first : last + 1] = -1
    # Of the stretches around a pair that which begins last before it is shifted least.
    of_pair = np.full(len(i), -1)
    near = j - i <= _NEAR
    begun = np.searchsorted(ends[:, 0], i, side="right") - 1
    for back in range(STRETCHES_DEEP + 1):
        k = np.maximum(begun - back, 0)
        inside = near & (begun >= back) & (ends[k, 1] >= j) & (of_pair < 0)
        of_pair[inside] = hidden[k[inside]]
    visits = ~near
    of_pair[visits] = np.maximum(of_scan[i[visits]], of_scan[j[visits]])
    m = np.flatnonzero(of_pair >= 0)
    information, before = observed.information.copy(), refined.terms.information
    added = 1e-9 * np.trace(before, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-12 * np.eye(3)
    offset = np.linalg.solve(before + added, refined.terms.gradient[:, :, None])
    gradient = (information @ offset)[:, :, 0]
    heading, axis = refined.linearised_at[i[m], 2], stretches.axis[of_pair[m]]
    c, s = np.cos(heading), np.sin(heading)
    along = np.column_stack((c * axis[:, 0] + s * axis[:, 1], c * axis[:, 1] - s * axis[:, 0], np.zeros(len(m))))
    held = np.einsum("mij,mj->mi", information[m], along)
    share = held / np.maximum((along * held).sum(axis=1), 1e-12)[:, None]
    information[m] -= held[:, :, None] * share[:, None, :]
    gradient[m] -= share * (along * gradient[m]).sum(axis=1)[:, None]
    return observed._replace(information=information, gradient=gradient)

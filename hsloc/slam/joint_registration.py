"""Joint registration: the poses at which every scan agrees best with all the scans that see the same walls.

Where a scan-to-map matcher holds the map fixed, here both sides of each pair may move, and all pairs are solved for
at once (a bundle adjustment of planar scans). Each round associates again, assembles the normal equations of all pairs
(hsloc/kernels/normal_equations.py) and of the edges, the odometry among them, and solves them sparsely.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hsloc.kernels.normal_equations import Equations, Evaluated, PairTerms, add_edges, add_pairs, evaluate_pairs
from hsloc.kernels.registration import Grid, nearest_partners
from hsloc.parameters import Count, CountOrNone, NonNegative, Parameters, Positive
from hsloc.slam.keyscans import views
from hsloc.slam.pose_graph import apply_increment, solve_anchored
from hsloc.slam.sparse_solver import BlockSystem

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from hsloc.kernels.point_to_line import ScanArrays
    from hsloc.slam.pose_graph import Edges

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class JointRegistrationParameters(Parameters):
    """Which scans are compared, and how their differences are weighted."""

    radius: Positive = 3.0
    """Maximum distance between the poses of two scans that are compared [m]."""
    max_partners: Count = 8
    """Maximum number of scans that each scan is compared with, each in another place or with another heading."""
    max_scans_per_view: Count = 16
    """Maximum number of scans with one place and heading that are used as partners."""
    temporal: CountOrNone = 3
    """Number of scans just before a scan that it is compared with in any case."""
    gates: tuple[Positive, ...] = (0.3, 0.2, 0.15)
    """Maximum distance of a point to the wall that it is paired with [m], round by round; the last one stays."""
    scale_of_gate: Positive = 0.33
    """Scale of the Geman-McClure weight as a ratio to the gate."""
    sigma: Positive = 0.02
    """Standard deviation of a point's distance to its wall [m]."""
    correlated_points: Positive = 20.0
    """Number of points that count as one independent measurement, as neighbouring beams share their errors."""
    points_per_scan: Count = 90
    """Approximate number of hits of a scan that are used."""
    rounds: Count = 3
    """Maximum number of rounds in a pass."""
    convergence_tolerance: NonNegative = 0.002
    """Step below which a pass has converged [m], the 99th percentile over the poses; angles count 5 m/rad."""


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """What a pass found: the final `poses` (n, 3), and the `terms` of the `pairs` (m, 2) in its last round.

    `linearised_at` (n, 3) are the poses at which those were evaluated, before the last, small, step.
    """

    poses: F64
    pairs: I64
    terms: PairTerms
    linearised_at: F64
    weight: float
    """Weight of one paired point [1/m^2] in the equations."""
    gate: float
    """Gate of the last round [m]."""
    scale: float
    """Scale of the Geman-McClure weight in it [m]."""
    rounds: int
    moved: float
    """What 99 of 100 poses moved less than in the last round (m; rad: a fifth)."""
    evaluated: Evaluated
    """Where the terms were evaluated last."""

    @property
    def counts(self) -> F64:
        """Shape (m, 5), as in `kernels.point_to_line.pair_terms`."""
        return self.terms.counts

    @property
    def rms(self) -> float:
        """Root mean square distance of points to the walls of other scans, robustly weighted (m)."""
        weights = self.counts[:, 4].sum()
        return float(np.sqrt(self.counts[:, 3].sum() / weights)) if weights > 0.0 else float("nan")

    @property
    def conflict(self) -> float:
        """Part of the points seen by another scan that lie where it looked through."""
        seen = self.counts[:, 2].sum()
        return float(self.counts[:, 1].sum() / seen) if seen > 0.0 else float("nan")


def refine(
    poses: F64,
    scans: ScanArrays,
    edges: Edges,
    parameters: JointRegistrationParameters,
    progress: Callable[[float], None] | None = None,
    previous: Registration | None = None,
) -> Registration:
    """Move `poses` (n, 3) until all pairs of scans and all edges agree best; the first pose stays.

    What a `previous` pass over the same scans has found of pairs that have hardly moved since is used again.
    """
    p = parameters
    pairs = neighbour_pairs(poses, p.radius, p.max_partners, p.temporal, p.max_scans_per_view)
    system = BlockSystem(
        len(poses), np.concatenate((pairs[:, 0], edges.pairs[:, 0])), np.concatenate((pairs[:, 1], edges.pairs[:, 1]))
    )
    terms, evaluated = _known_terms(pairs, len(poses), previous)
    weight = 1.0 / (p.sigma**2 * p.correlated_points)
    before, gate, moved, rounds = poses, previous.gate if previous is not None else 0.0, 0.0, 0
    for rounds in range(1, p.rounds + 1):
        last, gate = gate, p.gates[min(rounds, len(p.gates)) - 1]
        if gate != last:
            evaluated.at[:] = np.nan
        evaluate_pairs(poses, pairs, scans, gate, p.scale_of_gate * gate, terms, evaluated)
        diagonal, off_diagonal, right = normal_equations(poses, pairs, terms, weight, edges)
        step = solve_anchored(system, diagonal, off_diagonal, right)
        before, poses = poses, apply_increment(poses, step)
        moved = moved_scans(step)
        if progress is not None:
            progress(rounds / p.rounds)
        if rounds >= len(p.gates) and moved < p.convergence_tolerance:
            break
    return Registration(poses, pairs, terms, before, weight, gate, p.scale_of_gate * gate, rounds, moved, evaluated)


def _known_terms(pairs: I64, scans: int, previous: Registration | None) -> tuple[PairTerms, Evaluated]:
    """Terms of the pairs (m, 2), and where they were evaluated: those that a previous pass has, the others to be."""
    m = len(pairs)
    terms = PairTerms(np.empty((m, 3, 3)), np.empty((m, 3)), np.zeros((m, 5)), np.empty((m, 3, 3)))
    evaluated = Evaluated(np.full((len(pairs), 3), np.nan), np.empty((len(pairs), 3)))
    if previous is not None:
        old, new = (numbers[:, 0] * scans + numbers[:, 1] for numbers in (previous.pairs, pairs))
        _, of_new, of_old = np.intersect1d(new, old, assume_unique=True, return_indices=True)
        for to, source in zip((*terms, *evaluated), (*previous.terms, *previous.evaluated), strict=True):
            to[of_new] = source[of_old]
    return terms, evaluated


def normal_equations(poses: F64, pairs: I64, terms: PairTerms, weight: float, edges: Edges) -> tuple[F64, F64, F64]:
    """Blocks on the diagonal (n, 3, 3) and off it (pairs, then edges), and the right side (n, 3) of both together."""
    diagonal, right = np.zeros((len(poses), 3, 3)), np.zeros((len(poses), 3))
    off_diagonal = np.empty((len(pairs) + len(edges), 3, 3))
    of_edges = Equations(diagonal, off_diagonal[len(pairs) :], right)
    add_edges(poses, edges.pairs, edges.measured, edges.information, edges.scale, of_edges)
    add_pairs(poses, pairs, terms, weight, Equations(diagonal, off_diagonal[: len(pairs)], right))
    return diagonal, off_diagonal, right


def moved_scans(step: F64) -> float:
    """What 99 of 100 poses moved less than, of a step (n, 3): m, or rad as fifths of a metre.

    Not the longest move: a scan with a handful of pairs may swing for ever between two walls.
    """
    return float(np.percentile(np.abs(step * (1.0, 1.0, 5.0)).max(axis=1), 99.0))


def neighbour_pairs(poses: F64, radius: float, most: int, temporal: int, crowd: int) -> I64:
    """Pairs of scans that should see the same walls: those just before, and the near ones in space.

    Among the scans within `radius` metres the nearest of each of `most` sorts is taken, the sorts being
    places (a grid) and headings: a hundred scans from one place add less than ten from ten. Of a sort with more than
    `crowd` scans only `crowd`, even in time, are taken as partners, so that the equations stay sparse.
    Returns (m, 2), the earlier first, sorted.
    """
    n = len(poses)
    sort = views(poses, 0.5 * radius)
    known = _thinned(sort, crowd)
    grid, order = Grid.of(poses[known, :2], radius)
    partners = np.empty((n, most), dtype=np.int64)
    nearest_partners(poses, sort, known[order], grid, most, partners)
    scan, partner = np.repeat(np.arange(n), most), partners.reshape(-1)
    scan, partner = scan[partner >= 0], partner[partner >= 0]
    keys = [np.arange(n - gap) * n + np.arange(gap, n) for gap in range(1, temporal + 1)]
    unique = np.unique(np.concatenate((*keys, np.minimum(scan, partner) * n + np.maximum(scan, partner))))
    return np.column_stack((unique // n, unique % n)).astype(np.int64)


def _thinned(sort: I64, crowd: int) -> I64:
    """Of each sort all scans, or `crowd` of them, even in time; ascending."""
    order = np.argsort(sort, kind="stable")
    _, start, count = np.unique(sort[order], return_index=True, return_counts=True)
    rank, of = np.arange(len(sort)) - np.repeat(start, count), np.repeat(count, count)
    # Bresenham: of `of` in a row, `crowd` at even distances.
    stands = (of <= crowd) | ((rank + 1) * crowd // of > rank * crowd // of)
    return np.sort(order[stands])

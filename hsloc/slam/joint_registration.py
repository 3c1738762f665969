"""All scans against all: the poses at which every scan agrees best with all the scans that see the same walls.

Where a scan-to-map matcher holds the map fixed, here both sides of each pair may move, and all pairs are solved for
at once (a bundle adjustment of planar scans). Each round associates anew, assembles the normal equations of all pairs
(hsloc/kernels/normal_equations.py) and of the edges, the odometry among them, and solves them sparsely.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hsloc.errors import ConfigError
from hsloc.kernels.normal_equations import add_edges, assemble_pairs
from hsloc.model.pose2 import wrap_angles
from hsloc.slam.pose_graph import apply_increment, solve_anchored
from hsloc.slam.sparse_solver import BlockSystem

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from hsloc.slam.keyscans import KeyScans
    from hsloc.slam.pose_graph import Edges

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class JointRegistrationParameters:
    """Which scans are compared, and how they are pulled onto each other."""

    radius: float = 3.0
    """Scans taken so near to each other are compared (m)."""
    max_partners: int = 8
    """Each scan chooses so many of them, of different places and headings."""
    max_scans_per_view: int = 16
    """Of more scans of one place and heading, so many stand for all: a room crossed all day is known by then."""
    temporal: int = 3
    """And is compared with so many scans before it."""
    gates: tuple[float, ...] = (0.3, 0.2, 0.15)
    """Points farther than this from the other scan's wall are not paired (m), round by round; the last one stays."""
    scale_of_gate: float = 0.33
    """Scale of the Geman-McClure weight, as a part of the gate."""
    sigma: float = 0.02
    """Standard deviation of a point from a wall (m)."""
    correlated_points: float = 20.0
    """So many points count as one: neighbouring beams, and pairs of neighbouring scans, share their errors."""
    points_per_scan: int = 90
    """About so many hits of a scan are used."""
    rounds: int = 3
    """At most, in a pass."""
    convergence_tolerance: float = 0.002
    """Nothing moves when 99 of 100 poses move less than this (m; rad: a fifth)."""

    def __post_init__(self) -> None:
        for name in ("radius", "sigma", "correlated_points", "scale_of_gate"):
            if not getattr(self, name) > 0.0:
                raise ConfigError(f"joint_registration: {name} is {getattr(self, name)}; it must be positive")
        if not self.gates or min(self.gates) <= 0.0:
            raise ConfigError(f"joint_registration: gates is {self.gates}; it must hold at least one positive length")
        if min(self.points_per_scan, self.rounds, self.max_scans_per_view) < 1:
            raise ConfigError("joint_registration: points_per_scan, rounds and max_scans_per_view must be at least 1")


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """What a pass found; `counts` (m, 5) of the pairs (m, 2) as in `kernels.surfels.pair_terms`."""

    poses: F64
    pairs: I64
    counts: F64
    rounds: int
    moved: float
    """What 99 of 100 poses moved less than in the last round (m; rad: a fifth)."""

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
    scans: KeyScans,
    edges: Edges,
    parameters: JointRegistrationParameters,
    progress: Callable[[float], None] | None = None,
) -> Registration:
    """Move `poses` (n, 3) until all pairs of scans and all edges agree best; the first pose stays."""
    p = parameters
    pairs = neighbour_pairs(poses, p.radius, p.max_partners, p.temporal, p.max_scans_per_view)
    system = BlockSystem(
        len(poses), np.concatenate((pairs[:, 0], edges.pairs[:, 0])), np.concatenate((pairs[:, 1], edges.pairs[:, 1]))
    )
    chosen, chosen_start = scans.chosen(p.points_per_scan)
    weights = np.full(len(pairs), 1.0 / (p.sigma**2 * p.correlated_points))
    counts = np.zeros((len(pairs), 5))
    pair_blocks, edge_blocks = np.empty((len(pairs), 3, 3)), np.empty((len(edges), 3, 3))
    moved, rounds = 0.0, 0
    for rounds in range(1, p.rounds + 1):
        gate = p.gates[min(rounds, len(p.gates)) - 1]
        diagonal, right = np.zeros((len(poses), 3, 3)), np.zeros((len(poses), 3))
        add_edges(poses, edges.pairs, edges.measured, edges.information, edges.scale, diagonal, edge_blocks, right)
        assemble_pairs(
            poses, pairs, weights, scans.points, scans.normals, scans.centroids, scans.start, scans.hit_of_beam,
            scans.ranges, scans.table_start, scans.geometry, chosen, chosen_start, gate, p.scale_of_gate * gate,
            diagonal, pair_blocks, right, counts,
        )  # fmt: skip
        step = solve_anchored(system, diagonal, np.concatenate((pair_blocks, edge_blocks)), right)
        poses = apply_increment(poses, step)
        moved = moved_scans(step)
        if progress is not None:
            progress(rounds / p.rounds)
        if rounds >= len(p.gates) and moved < p.convergence_tolerance:
            break
    return Registration(poses, pairs, counts, rounds, moved)


def moved_scans(step: F64) -> float:
    """What 99 of 100 poses moved less than, of a step (n, 3): m, or rad as fifths of a metre.

    Not the longest move: a scan with a handful of pairs may swing for ever between two walls.
    """
    return float(np.percentile(np.abs(step * (1.0, 1.0, 5.0)).max(axis=1), 99.0))


_HEADINGS = 8
_AT_ONCE = 512
"""Scans whose neighbours are listed together: of all at once the lists would fill the memory."""


def neighbour_pairs(poses: F64, radius: float, most: int, temporal: int, crowd: int) -> I64:
    """Pairs of scans that should see the same walls: those just before, and the near ones in space.

    Among the scans within `radius` metres the nearest of each of `most` sorts is taken, the sorts being
    places (a grid) and headings: a hundred scans from one spot say less than ten from ten. Of a sort with more than
    `crowd` scans only so many, even in time, are taken as partners, so that the equations stay sparse.
    Returns (m, 2), the earlier first, sorted.
    """
    from scipy.spatial import cKDTree

    n = len(poses)
    sector = np.floor(poses[:, 2] / (2.0 * np.pi) * _HEADINGS).astype(np.int64) % _HEADINGS
    cell = np.floor(poses[:, :2] / (0.5 * radius)).astype(np.int64)
    sort = (cell[:, 0] * 1000003 + cell[:, 1]) * _HEADINGS + sector
    known = _standing_for_all(sort, crowd)
    tree = cKDTree(poses[known, :2])
    keys = [np.arange(n - gap) * n + np.arange(gap, n) for gap in range(1, temporal + 1)]
    for begin in range(0, n, _AT_ONCE):
        lists = tree.query_ball_point(poses[begin : begin + _AT_ONCE, :2], radius, return_sorted=True)
        for k, found in enumerate(lists, start=begin):
            near = known[np.array(found, dtype=np.int64)]
            near = near[near != k]
            if len(near) == 0:
                continue
            offset = poses[near] - poses[k]
            distance = np.hypot(offset[:, 0], offset[:, 1]) + 0.5 * np.abs(wrap_angles(offset[:, 2]))
            order = np.argsort(distance, kind="stable")
            _, first = np.unique(sort[near[order]], return_index=True)
            chosen = near[order[np.sort(first)[:most]]]
            keys.append(np.minimum(chosen, k) * n + np.maximum(chosen, k))
    unique = np.unique(np.concatenate(keys)) if keys else np.zeros(0, dtype=np.int64)
    return np.column_stack((unique // n, unique % n)).astype(np.int64)


def _standing_for_all(sort: I64, crowd: int) -> I64:
    """Of each sort all scans, or `crowd` of them, even in time; ascending."""
    order = np.argsort(sort, kind="stable")
    _, start, count = np.unique(sort[order], return_index=True, return_counts=True)
    rank, of = np.arange(len(sort)) - np.repeat(start, count), np.repeat(count, count)
    # Bresenham: of `of` in a row, `crowd` at even distances.
    stands = (of <= crowd) | ((rank + 1) * crowd // of > rank * crowd // of)
    return np.sort(order[stands])

"""The field that a scan is matched against: exp(-d / sigma), d being the distance to the nearest wall.

[P] III-B scores a point by exp(-d) with d in metres; sigma generalises its unit. The field is computed on the nodes of
a grid and is bilinear between them. A node lies in the *centre* of a cell of the map, so that a wall through the
centres of cells is found where it is, without half a cell of bias.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hsloc.errors import MapError
from hsloc.kernels.fitness import fitness_many, pack, point_scores
from hsloc.kernels.score_field import column_distances, squared_distances
from hsloc.model.pose2 import IDENTITY, Pose2, wrap_angle

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from hsloc.model.occupancy_grid import OccupancyGrid

    F32 = NDArray[np.float32]
    F64 = NDArray[np.float64]

_MOST_CELLS = 2e8
"""Maximum number of cells of a field. Internal: 22 bytes a cell while it is made, 4.4 GB."""
_ROWS = 64
"""Rows of a map whose distances are worked out in one go. Internal: bounds the memory."""


def distances_to_walls(occupied: NDArray[np.bool_], margin: int = 0, overlap: int = 0) -> Iterator[tuple[int, F64]]:
    """Of cells (h, w), with `margin` free ones on each side, the distance in cells to the nearest occupied one.

    Yields some rows (k, w + 2 margin) at a time: the number of the first, and the distances; `overlap` rows at the end
    are those that come next. All at once would take more memory than what is made of them.
    """
    height, width = occupied.shape[0] + 2 * margin, occupied.shape[1] + 2 * margin
    far = height + width
    columns = np.empty((height, width), dtype=np.uint16 if far < 1 << 16 else np.int32)
    column_distances(occupied, margin, far, columns)
    return _distances_in_rows(columns, overlap)


def _distances_in_rows(columns: NDArray[np.uint16] | NDArray[np.int32], overlap: int) -> Iterator[tuple[int, F64]]:
    """The rows of `distances_to_walls`; the cells are not needed any more, and may be freed by then."""
    for row in range(0, len(columns) - overlap, _ROWS):
        yield row, np.sqrt(squared_distances(columns[row : row + _ROWS + overlap]))


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class LikelihoodField:
    """Scores in [0, 1] on the nodes of a grid, packed for the kernels.

    `packed` is float32 of shape (h - 1, w - 1, 4), see hsloc/kernels/fitness.py. `T_map_field` is the pose in the map
    of node [0, 0], with the x axis along the columns; `resolution` is the distance of two nodes in metres; `sigma` the
    decay of the score in metres.
    """

    packed: F32
    resolution: float
    T_map_field: Pose2
    sigma: float
    walls: F64 | None = None
    """The points that the field was made of, shape (n, 2) in metres in the map frame; see `wall_points`."""

    def __repr__(self) -> str:
        height, width = self.packed.shape[:2]
        return f"<LikelihoodField: {width} x {height} squares of {self.resolution:g} m, sigma {self.sigma:g} m>"

    @staticmethod
    def from_scores(
        scores: F32, resolution: float, T_map_field: Pose2, sigma: float, walls: F64 | None = None
    ) -> LikelihoodField:
        """From scores on the nodes, shape (h, w)."""
        height, width = scores.shape
        packed = np.empty((height - 1, width - 1, 4), dtype=np.float32)
        pack(np.ascontiguousarray(scores, dtype=np.float32), packed, 0, height - 1, 0, width - 1)
        return LikelihoodField(packed, resolution, T_map_field, sigma, walls)

    @staticmethod
    def from_grid(grid: OccupancyGrid, sigma: float = 0.2, margin: float = 1.0) -> LikelihoodField:
        """Of the occupied cells of a map (exact Euclidean distance transform), with a `margin` in metres around it.

        Raises MapError for a map without an occupied cell.
        """
        occupied = grid.occupied()
        if not occupied.any():
            raise MapError("the map has no occupied cell; check occupied_thresh and negate in its YAML")
        pad = max(int(np.ceil(margin / grid.resolution)), 1)
        cells = (occupied.shape[0] + 2 * pad) * (occupied.shape[1] + 2 * pad)
        if cells > _MOST_CELLS:
            raise MapError(
                f"the field of the map, with a margin of {margin:g} m in cells of {grid.resolution:g} m, has "
                f"{cells:.2g} cells; at most {_MOST_CELLS:.0e} fit: "
                "choose a smaller likelihood_field.margin or a coarser map"
            )
        height, width = occupied.shape[0] + 2 * pad, occupied.shape[1] + 2 * pad
        distances = distances_to_walls(occupied, pad, overlap=1)
        del occupied  # A byte a cell that is not needed while the field is filled.
        packed = np.empty((height - 1, width - 1, 4), dtype=np.float32)
        for row, distance in distances:
            scores = np.exp(-(distance * grid.resolution) / sigma).astype(np.float32)
            pack(scores, packed[row : row + _ROWS], 0, len(scores) - 1, 0, width - 1)
        corner = (0.5 - pad) * grid.resolution
        T_map_field = grid.origin @ Pose2(corner, corner, 0.0)
        return LikelihoodField(packed, grid.resolution, T_map_field, sigma)

    @staticmethod
    def from_points(
        points: F64, sigma: float, resolution: float, margin: float, max_distance: float | None = None
    ) -> LikelihoodField:
        """Of a set of points, shape (n, 2) in metres: the distances at the nodes are exact.

        `margin` metres around the points are covered; beyond `max_distance` (default: never) the score is zero.
        """
        from scipy.spatial import cKDTree

        if len(points) == 0:
            raise MapError("a map needs at least one point")
        low = points.min(axis=0) - margin
        high = points.max(axis=0) + margin
        width, height = (int(n) for n in np.ceil((high - low) / resolution).astype(int) + 1)
        xs = low[0] + resolution * np.arange(width)
        ys = low[1] + resolution * np.arange(height)
        tree = cKDTree(points)
        bound = np.inf if max_distance is None else max_distance
        scores = np.empty((height, width), dtype=np.float32)
        for row in range(height):
            nodes = np.column_stack((xs, np.full(width, ys[row])))
            distance, _ = tree.query(nodes, distance_upper_bound=bound)
            scores[row] = np.exp(-distance / sigma)
        T_map_field = Pose2(float(low[0]), float(low[1]), 0.0)
        return LikelihoodField.from_scores(scores, resolution, T_map_field, sigma, points)

    def wall_points(self) -> F64:
        """The points of the map, shape (n, 2) in metres in the map frame, for matchers that pair points (ICP).

        Where the field was not made of points, the nodes that lie in a wall: those whose score is 1.
        """
        if self.walls is not None:
            return self.walls
        rows, columns = np.nonzero(self.packed[..., 0] == 1.0)
        nodes: F64 = np.column_stack((columns, rows)).astype(np.float64) * self.resolution
        return self.T_map_field @ nodes

    def to_cells(self, pose: Pose2) -> F64:
        """A pose in the map as (x, y, theta) in cells of the field, shape (3,)."""
        if self.T_map_field.theta == 0.0:
            x, y, theta = pose.x - self.T_map_field.x, pose.y - self.T_map_field.y, pose.theta
        else:
            local = self.T_map_field.between(pose)
            x, y, theta = local.x, local.y, local.theta
        return np.array((x / self.resolution, y / self.resolution, theta))

    def from_cells(self, cells: F64) -> Pose2:
        """The inverse of `to_cells`."""
        return self.T_map_field @ Pose2(
            float(cells[0]) * self.resolution, float(cells[1]) * self.resolution, wrap_angle(float(cells[2]))
        )

    def scale(self, points: F64) -> F32:
        """Points in metres, shape (n, 2), in cells as the kernels want them: float32, contiguous."""
        with np.errstate(over="ignore"):  # a point too far for float32 is outside the field as infinity is, too
            return np.ascontiguousarray(points / self.resolution, dtype=np.float32)

    def fitness(self, points: F64, pose: Pose2) -> float:
        """Mean score of points (n, 2), in metres and seen from `pose`; 0 for no point."""
        return float(fitness_many(self.packed, self.scale(points), self.to_cells(pose)[None, :])[0])

    def distances(self, points: F64, pose: Pose2 = IDENTITY) -> F64:
        """Distance in metres from each point, seen from `pose`, to the nearest wall, from the field's score.

        Infinite outside the field.
        """
        scores = np.empty(len(points), dtype=np.float32)
        x, y, theta = self.to_cells(pose)
        point_scores(self.packed, self.scale(points), x, y, theta, scores)
        with np.errstate(divide="ignore"):
            return -self.sigma * np.log(np.maximum(scores.astype(np.float64), 0.0))

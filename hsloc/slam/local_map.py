"""A likelihood field that grows with every scan that is added."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hsloc.kernels.score_field import decay_table, splat
from hsloc.matching.likelihood_field import LikelihoodField
from hsloc.model.pose2 import Pose2

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F32 = NDArray[np.float32]
    F64 = NDArray[np.float64]


class LocalMap:
    """exp(-d / sigma) of the distance d to the nearest point added so far, on nodes `resolution` metres apart.

    Beyond `max_distance` metres from every point the score is zero. The array grows by half its size where points fall
    outside; adding is local. `field` is what matchers take; it stays valid until the next `add`.
    """

    def __init__(self, resolution: float, sigma: float, max_distance: float) -> None:
        self._resolution = resolution
        self._sigma = sigma
        self._radius = max_distance / resolution
        self._table = decay_table(sigma / resolution, self._radius)
        self._margin = int(self._radius) + 4
        self._scores = np.zeros((0, 0), dtype=np.float32)
        self._packed = np.zeros((0, 0, 4), dtype=np.float32)
        self._corner = np.zeros(2, dtype=np.int64)
        self._low = np.zeros(2)
        self._high = np.zeros(2)
        self.added = 0

    @property
    def field(self) -> LikelihoodField:
        """The field as it is now."""
        corner = self._corner * self._resolution
        pose = Pose2(float(corner[0]), float(corner[1]), 0.0)
        return LikelihoodField(self._packed, self._resolution, pose, self._sigma)

    @property
    def scores(self) -> F32:
        """Scores on the nodes, shape (h, w)."""
        return self._scores

    def add(self, points: F64, saturation_score: float = 0.98) -> int:
        """Add points (n, 2) in metres in the map's frame but those whose nearest node has `saturation_score` already.

        Returns how many points were new.
        """
        if len(points) == 0:
            return 0
        self._make_room(points)
        cells = np.ascontiguousarray(points / self._resolution - self._corner, dtype=np.float32)
        added = int(splat(self._scores, self._packed, cells, self._table, self._radius, saturation_score))
        self.added += added
        return added

    def _make_room(self, points: F64) -> None:
        low = np.floor(points.min(axis=0) / self._resolution).astype(np.int64) - self._margin
        high = np.ceil(points.max(axis=0) / self._resolution).astype(np.int64) + self._margin
        height, width = self._scores.shape
        old_low, old_high = self._corner, self._corner + np.array((width, height))
        if height == 0:
            new_low, new_high = low, high
        elif (low >= old_low).all() and (high <= old_high).all():
            return
        else:
            spare = (old_high - old_low) // 4
            new_low = np.where(low < old_low, np.minimum(low, old_low) - spare, old_low)
            new_high = np.where(high > old_high, np.maximum(high, old_high) + spare, old_high)
        size = new_high - new_low
        scores = np.zeros((int(size[1]), int(size[0])), dtype=np.float32)
        packed = np.zeros((int(size[1]) - 1, int(size[0]) - 1, 4), dtype=np.float32)
        if height:
            du, dv = (int(n) for n in old_low - new_low)
            scores[dv : dv + height, du : du + width] = self._scores
            packed[dv : dv + height - 1, du : du + width - 1] = self._packed
            # The old border is nowhere near a point: its score is zero, and so are the squares across it.
        self._corner, self._scores, self._packed = new_low, scores, packed


def field_of_points(points: F64, resolution: float, sigma: float, max_distance: float) -> LikelihoodField:
    """The field of a set of points at once."""
    local = LocalMap(resolution, sigma, max_distance)
    local.add(points, saturation_score=2.0)
    return local.field

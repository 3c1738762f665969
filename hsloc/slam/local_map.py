"""A likelihood field that grows with every scan that is added."""

from __future__ import annotations

from math import ceil, floor
from typing import TYPE_CHECKING

import numpy as np

from hsloc.kernels.score_field import GrowingField, bounds, decay_table, mean_score, pack_stale, splat
from hsloc.matching.likelihood_field import LikelihoodField
from hsloc.model.pose2 import Pose2

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F32 = NDArray[np.float32]
    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]


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
        self._grown = GrowingField(
            np.zeros((0, 0), dtype=np.float32),
            np.zeros((1, 1), dtype=np.uint8),
            np.zeros(2, dtype=np.int64),
            resolution,
        )
        self._packed: F32 | None = None
        self.added = 0

    @property
    def field(self) -> LikelihoodField:
        """The field as it is now."""
        if self._packed is None:
            height, width = self._grown.scores.shape
            self._packed = np.zeros((max(height - 1, 0), max(width - 1, 0), 4), dtype=np.float32)
        pack_stale(self._grown, self._packed)
        return LikelihoodField(self._packed, self._resolution, self._origin(), self._sigma)

    @property
    def scores(self) -> F32:
        """Scores on the nodes, shape (h, w)."""
        return self._grown.scores

    def fitness(self, points: F64, pose: Pose2) -> float:
        """That of `field`, of points (n, 2) in metres, seen from `pose`; 0 for no point."""
        origin = self._origin()
        cells = np.array(((pose.x - origin.x) / self._resolution, (pose.y - origin.y) / self._resolution, pose.theta))
        return float(mean_score(self._grown, points, cells))

    def add(self, points: F64, saturation_score: float = 0.98) -> int:
        """Add points (n, 2) in metres in the map's frame but those whose nearest node has `saturation_score` already.

        Returns how many points were new.
        """
        if len(points) == 0:
            return 0
        self._make_room(points)
        added = int(splat(self._grown, points, self._table, self._radius, saturation_score))
        self.added += added
        return added

    def _origin(self) -> Pose2:
        u, v = (int(n) for n in self._grown.corner)
        return Pose2(u * self._resolution, v * self._resolution, 0.0)

    def _make_room(self, points: F64) -> None:
        low_x, low_y, high_x, high_y = (value / self._resolution for value in bounds(points))
        low = floor(low_x) - self._margin, floor(low_y) - self._margin
        high = ceil(high_x) + self._margin, ceil(high_y) + self._margin
        if self._covers(low, high):
            return
        self._grow(np.array(low, dtype=np.int64), np.array(high, dtype=np.int64))

    def _covers(self, low: tuple[int, int], high: tuple[int, int]) -> bool:
        # Python's own numbers: this is asked for each scan.
        u, v = (int(n) for n in self._grown.corner)
        height, width = self._grown.scores.shape
        return height > 0 and low[0] >= u and low[1] >= v and high[0] <= u + width and high[1] <= v + height

    def _grow(self, low: I64, high: I64) -> None:
        grown = self._grown
        height, width = grown.scores.shape
        old_low, old_high = grown.corner, grown.corner + np.array((width, height))
        if height == 0:
            new_low, new_high = low, high
            self._packed = None  # That of an empty map, where the field was asked for before the first point.
        else:
            spare = (old_high - old_low) // 4
            new_low = np.where(low < old_low, np.minimum(low, old_low) - spare, old_low)
            new_high = np.where(high > old_high, np.maximum(high, old_high) + spare, old_high)
        size = new_high - new_low
        scores = np.zeros((int(size[1]), int(size[0])), dtype=np.float32)
        tiles = (new_high >> 3) - (new_low >> 3) + 1
        stale = np.zeros((int(tiles[1]), int(tiles[0])), dtype=np.uint8)
        if height:
            # The old border is nowhere near a point: its score is zero, and so are the squares across it.
            du, dv = (int(n) for n in old_low - new_low)
            scores[dv : dv + height, du : du + width] = grown.scores
            tile_u, tile_v = (int(n) for n in (old_low >> 3) - (new_low >> 3))
            rows, columns = grown.stale.shape
            stale[tile_v : tile_v + rows, tile_u : tile_u + columns] = grown.stale
            if self._packed is not None:
                packed = np.zeros((int(size[1]) - 1, int(size[0]) - 1, 4), dtype=np.float32)
                packed[dv : dv + height - 1, du : du + width - 1] = self._packed
                self._packed = packed
        self._grown = GrowingField(scores, stale, new_low, self._resolution)

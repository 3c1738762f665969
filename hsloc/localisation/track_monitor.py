"""Watches a track while it is followed: what each scan says for it, and when it has gone astray."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

import numpy as np

from hsloc.localisation.track_evidence import TrackFilter, TrackRow
from hsloc.model.estimate import Evidence, Status

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.localisation.place_check import PlaceCheck
    from hsloc.model.events import PairedScan
    from hsloc.model.pose2 import Pose2

    F64 = NDArray[np.float64]

_FEWEST_JOINED = 4
"""Scans that a place is compared by, at least."""
_FIRST_COMPARISON_M = 3.0
"""A new track is compared with the whole map after this path length (m), or after the usual one if that is shorter."""


class TrackMonitor:
    """State: the scans of the last metres, the path length, and the probability that the track is right."""

    def __init__(self, check: PlaceCheck) -> None:
        self._check = check
        self._filter = TrackFilter()
        self._trail: deque[tuple[float, Pose2, F64]] = deque()
        self._path_length = 0.0
        self._compared_at = 0.0
        self._seen_at = 0.0
        self.begin()

    @property
    def usual_explained(self) -> float:
        """The explained fitness that is usual on this map, as far as it is known."""
        return self._filter.usual

    def begin(self) -> None:
        """A new track begins; it is compared with the whole map soon."""
        self._filter.start()
        self._trail.clear()
        self._compared_at = self._path_length - max(self._check.parameters.interval - _FIRST_COMPARISON_M, 0.0)

    def move(self, distance: float) -> None:
        """The robot moved on (m)."""
        self._path_length += distance

    def skipped(self) -> Evidence:
        """A scan could not be matched: it says nothing."""
        return Evidence(self._distance())

    def refused(self) -> Evidence:
        """The match of a scan was refused."""
        evidence = Evidence(self._distance())
        self._filter.add(TrackRow(Status.REJECTED, evidence))
        return evidence

    def matched(self, paired: PairedScan, pose: Pose2, points: F64) -> Evidence:
        """A scan with points (n, 2) was matched; now and then its place is compared with the whole map."""
        p = self._check.parameters
        distance = self._distance()
        self._trail.append((self._path_length, pose, self._check.few(points)))
        while self._trail[0][0] < self._path_length - p.length:
            self._trail.popleft()
        rival, other = float("nan"), None
        if self._path_length - self._compared_at >= p.interval and len(self._trail) >= _FEWEST_JOINED:
            self._compared_at = self._path_length
            chosen = np.unique(np.linspace(0, len(self._trail) - 1, p.scans).astype(np.int64))
            rival, other = self._check.rival([self._trail[k][1:] for k in chosen], pose)
        found = self._check.explain(paired, pose)
        evidence = Evidence(distance, found.fitness, found.short, found.through, found.unmapped, rival, other)
        self._filter.add(TrackRow(Status.MATCHED, evidence))
        return evidence

    def is_astray(self, evidence: Evidence, probability: float) -> bool:
        """Whether the track is astray with at least this probability, and another place was found that fits as well."""
        return evidence.rival >= 1.0 and self._filter.states[2] > probability

    def _distance(self) -> float:
        """Path length since the scan before."""
        distance = self._path_length - self._seen_at
        self._seen_at = self._path_length
        return distance

"""What the localiser asks of whatever finds an unknown pose on the whole map."""

from __future__ import annotations

from dataclasses import dataclass
from math import exp
from typing import TYPE_CHECKING, Protocol

from hsloc.localisation.track_evidence import rival_evidence
from hsloc.model.estimate import LikelyPlace, State

if TYPE_CHECKING:
    from collections.abc import Iterable

    import numpy as np
    from numpy.typing import NDArray

    from hsloc.model.estimate import Evidence, Revised
    from hsloc.model.events import PairedScan
    from hsloc.model.pose2 import Pose2

MOST_PLACES = 8
"""Places that are kept where several fit; a picture with more of them shows none."""


def most_likely(found: Iterable[tuple[Pose2, float]]) -> tuple[LikelyPlace, ...]:
    """The most probable of places with the mean fitness of the same scans there, if one of all these is the right one.

    The odds of two places are what the ratio of their fitness says (see `rival_evidence`).
    """
    places = sorted(found, key=lambda each: -each[1])
    best = max((fitness for _, fitness in places), default=0.0)
    weights = [exp(-max(rival_evidence(fitness / max(best, 1e-9)), 0.0)) for _, fitness in places]
    pairs = zip(places[:MOST_PLACES], weights, strict=False)
    return tuple(LikelyPlace(pose, weight / sum(weights)) for (pose, _), weight in pairs)


@dataclass(frozen=True, slots=True, eq=False)
class RelocaliserResult:
    """The state of a search after a scan.

    `pose` is the best hypothesis, T_map_base at the scan (None while there is none); `covariance` (3, 3) is set once
    it `is_sure`. `fitness` is that of the scan at the pose, None where it was not matched.
    """

    pose: Pose2 | None
    covariance: NDArray[np.float64] | None
    fitness: float | None
    evaluations: int
    is_sure: bool
    reason: str
    track: tuple[Revised, ...] = ()
    """Once it is sure: the poses at the scans since the search began."""
    track_is_whole: bool = False
    """Whether the track goes back to the first scan of the search."""
    state: State = State.LOST
    """While it is not sure: whether several places fit, none does, or too few scans were seen."""
    evidence: Evidence | None = None
    """Once it is sure: what its scans say for the place."""
    places: tuple[LikelyPlace, ...] = ()
    """While several places fit: the most probable ones, T_map_base at the last scan that was used."""


class GlobalSearch(Protocol):
    """Finds an unknown pose from several scans.

    Contract: the same scans since `start` and the same state of its random generator give the same results.
    """

    def start(self, usual_explained: float | None = None) -> None:
        """Begin a new search: nothing of the scans before is kept.

        `usual_explained` is the explained fitness (see `Evidence`) at places of this map that were sure, if known.
        """
        ...

    def update(self, paired: PairedScan, odometry_count: int) -> RelocaliserResult:
        """Take a scan and the number of odometry messages before it."""
        ...

"""The probability that a track is right: a hidden Markov model of two states over its scans.

A track is right or wrong. It begins right with a prior, may turn wrong as the robot moves on (seldom) or where a scan
is refused (more often), and does not turn right again by itself. Scans are evidence by what the map explains of them,
comparisons with the whole map by whether another place fits as well. Forward alone it is a filter; forward and backward
it is what an offline service can say: the scans to come count as well.

Evidence is bounded so that what the map gets wrong does not add up like evidence. A scan that fits is none at all: the
wrong one of two look-alike places fits as well. A scan that does not fit counts by the metre and not by the scan. A
comparison counts for the place only where it leaves the others clearly behind.

The figures of the likelihoods are from simulation: 24 kinds of runs in three worlds, right and wrong, two seeds (see
benchmarks/README.md). Right places: explained 0.93 to 0.97, rival 0.80 to 1.05; wrong ones: 0.4 to 0.85, 0.93 to 1.8.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, log
from typing import TYPE_CHECKING

import numpy as np

from hsloc.model.estimate import Status

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from hsloc.model.estimate import Evidence

    F64 = NDArray[np.float64]

PRIOR_RIGHT = 0.98
"""Probability that a given start, or a place that the relocaliser was sure of, is right."""
_TURNS_WRONG_PER_M = 0.002
"""Rate at which a track turns wrong (1/m): once in 500 m."""
_TURNS_WRONG_REFUSED = 0.05
"""Probability that it turned wrong where a scan was refused."""
_UNIQUE, _NOT_UNIQUE = 0.85, 0.93
"""A rival ratio up to the first is full evidence for the place, from the second on it is none."""
_RIVALLED, _BEATEN = 1.08, 1.25
"""A rival ratio from the second on is full evidence against the place, up to the first it is none."""
MOST_FROM_RIVAL = 4.0
"""Log of the odds that one comparison changes, at most: 55 to 1."""
_GOOD_FIT, _FIT_SCALE = 0.95, 0.03
"""Explained fitness by the usual one that is no evidence against a track, and the step below it that counts 1 a metre."""
_MOST_FROM_FIT = 3.0
"""Log of the odds that a metre of bad fit changes, at most."""
_REFUSED = -1.0
"""Log of the odds that a refused scan changes."""
USUAL_EXPLAINED = 0.93
"""Explained fitness at right places of a good map; the usual one of a run is not taken for higher."""
_LEAST_USUAL = 0.75
"""Nor for lower: wrong places reach it."""
_CERTIFIED_M = 6.0
"""A comparison that leaves the others behind vouches for the scans of this path length before it (m)."""
_MOST_LOG_ODDS = 30.0


def rival_evidence(ratio: float) -> float:
    """Log of the likelihood ratio, right to wrong, of a rival ratio; 0 for NaN."""
    if ratio <= _NOT_UNIQUE:
        return MOST_FROM_RIVAL * min((_NOT_UNIQUE - ratio) / (_NOT_UNIQUE - _UNIQUE), 1.0)
    if ratio >= _RIVALLED:
        return -MOST_FROM_RIVAL * min((ratio - _RIVALLED) / (_BEATEN - _RIVALLED), 1.0)
    return 0.0


def fit_evidence(evidence: Evidence, usual: float) -> float:
    """Log of the likelihood ratio of what the map explains of a scan; never positive, 0 for NaN."""
    if not evidence.explained >= 0.0:
        return 0.0
    per_metre = (evidence.explained / usual - _GOOD_FIT) / _FIT_SCALE
    seen = 1.0 - evidence.short
    return max(min(per_metre, 0.0), -_MOST_FROM_FIT) * min(evidence.distance, 1.0) * seen


@dataclass(frozen=True, slots=True)
class TrackRow:
    """A scan of a track: its status, its evidence, and whether a new track begins with it."""

    status: Status
    evidence: Evidence
    begins: bool = False

    def log_likelihood_ratio(self, usual: float) -> float:
        """Of right to wrong."""
        refused = _REFUSED if self.status is Status.REJECTED else 0.0
        return refused + fit_evidence(self.evidence, usual) + rival_evidence(self.evidence.rival)

    def turns_wrong(self) -> float:
        """Probability that a right track turned wrong since the scan before."""
        moved = 1.0 - exp(-_TURNS_WRONG_PER_M * self.evidence.distance)
        return moved + (_TURNS_WRONG_REFUSED if self.status is Status.REJECTED else 0.0)


class TrackFilter:
    """The forward pass. State: the log of the odds that the track is right, given the scans so far."""

    def __init__(self) -> None:
        self.log_odds = log(PRIOR_RIGHT / (1.0 - PRIOR_RIGHT))

    def start(self) -> None:
        """A new track begins."""
        self.__init__()  # type: ignore[misc]

    def add(self, row: TrackRow) -> float:
        """Take a scan; the log of the odds."""
        self.log_odds = _moved_on(self.log_odds, row.turns_wrong()) + row.log_likelihood_ratio(USUAL_EXPLAINED)
        self.log_odds = min(max(self.log_odds, -_MOST_LOG_ODDS), _MOST_LOG_ODDS)
        return self.log_odds


def smooth(rows: Sequence[TrackRow]) -> F64:
    """The probability that the track is right at each row, shape (n,), given all rows."""
    n = len(rows)
    usual = usual_explained(rows)
    ratios = [row.log_likelihood_ratio(usual) for row in rows]
    # Backward: log of P(rows to come | right) / P(rows to come | wrong); the wrong state keeps itself.
    backward = np.zeros(n)
    for k in range(n - 2, -1, -1):
        following = rows[k + 1]
        if not following.begins:
            right = ratios[k + 1] + backward[k + 1]
            stays = 1.0 - following.turns_wrong()
            backward[k] = float(np.logaddexp(log(stays) + right, log(max(1.0 - stays, 1e-300))))
    probability = np.zeros(n)
    odds = 0.0
    for k, row in enumerate(rows):
        if k == 0 or row.begins:
            odds = log(PRIOR_RIGHT / (1.0 - PRIOR_RIGHT)) + ratios[k]
        else:
            odds = _moved_on(odds, row.turns_wrong()) + ratios[k]
        odds = min(max(odds, -_MOST_LOG_ODDS), _MOST_LOG_ODDS)
        probability[k] = 1.0 / (1.0 + exp(-min(max(odds + backward[k], -700.0), 700.0)))
    return probability


def usual_explained(rows: Sequence[TrackRow]) -> float:
    """The explained fitness that is usual at places that comparisons vouch for; that of a good map where none does."""
    path = np.cumsum([row.evidence.distance for row in rows])
    explained = np.array([row.evidence.explained for row in rows])
    vouched = np.zeros(len(rows), dtype=np.bool_)
    for k, row in enumerate(rows):
        if rival_evidence(row.evidence.rival) >= 0.5 * MOST_FROM_RIVAL:
            vouched |= (path <= path[k]) & (path >= path[k] - _CERTIFIED_M)
    values = explained[vouched & np.isfinite(explained)]
    if len(values) == 0:
        return USUAL_EXPLAINED
    return float(np.clip(np.percentile(values, 75.0), _LEAST_USUAL, USUAL_EXPLAINED))


def _moved_on(log_odds: float, turns_wrong: float) -> float:
    """The log of the odds after a step in which a right track turns wrong with a probability."""
    right = 1.0 / (1.0 + exp(-log_odds))
    right *= 1.0 - turns_wrong
    right = min(max(right, 1e-13), 1.0 - 1e-13)
    return log(right / (1.0 - right))

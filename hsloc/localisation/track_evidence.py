"""The probability that a track is right: a hidden Markov model of three states over its scans.

A track is right, in a look-alike of the right place, or astray: where the scans do not fit, off the map perhaps. It
begins right with a prior, and may go astray as the robot moves on or where a scan is refused; it does not come back by
itself. Forward alone the model is a filter; forward and backward it is what an offline service can say: the scans to
come count as well.

Scans are evidence by what the map explains of them, by the metre and not by the scan. One that fits is evidence against
being astray, but none against a look-alike, so that errors of the map in one of two like places do not add up. A
comparison with the whole map is evidence against both where it leaves all other places clearly behind, and against the
place where another one fits clearly better.

The figures of the likelihoods are from simulation: 24 kinds of runs in three worlds, right and wrong, two seeds (see
benchmarks/README.md). Right places: explained 0.93 to 0.97, rival 0.80 to 1.05; wrong ones: 0.4 to 0.85, 0.93 to 1.8.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from math import exp, isfinite, log
from typing import TYPE_CHECKING

import numpy as np

from hsloc.localisation.place_check import MIRRORED_NEEDED, USUAL_EXPLAINED, Comparison
from hsloc.model.estimate import Evidence, Status

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    F64 = NDArray[np.float64]
    from hsloc.localisation.place_check import Explanation, PlaceCheck
    from hsloc.model.events import PairedScan
    from hsloc.model.pose2 import Pose2

States = tuple[float, float, float]
"""A number for each state: right, alike, astray."""

CONFIDENCE = 0.9
"""Least probability that the track is right for a pose to be called localised."""
PRIOR_RIGHT, _PRIOR_ALIKE, _PRIOR_ASTRAY = 0.98, 0.01, 0.01
"""Probabilities of the states where a track begins: with a given start, or where the relocaliser was sure."""
PRIOR: States = (PRIOR_RIGHT, _PRIOR_ALIKE, _PRIOR_ASTRAY)
_SMALLEST = 1e-30
_ASTRAY_PER_M = 0.005
"""Rate at which a track goes astray (1/m): once in 200 m."""
_ASTRAY_REFUSED = 0.05
"""Probability that it went astray where a scan was refused."""
_ALIKE_REFUSED = 0.002
"""Probability that a right track ended in a look-alike place where a scan was refused: a parallel corridor."""
_ALIKE_PER_M = 0.0008
"""Rate at which a track gets into a place that looks the same (1/m): after 110 m without a comparison that leaves all
other places behind it is no surer than the 0.9 that a localised pose needs."""
_ALIKE_ENDS = 0.5
"""Probability that a look-alike of the right place differs from it where a scan is refused."""
_UNIQUE, NOT_UNIQUE = 0.85, 0.93
"""A rival ratio up to the first is full evidence for the place, from the second on it is none."""
_RIVALLED, _BEATEN = 1.12, 1.3
"""A rival ratio from the second on is full evidence against the place, up to the first it is none."""
MOST_FROM_RIVAL = 4.0
"""Log of the odds that one comparison changes, at most: 55 to 1."""
_FULL_M = 3.0
"""Comparisons of a place that was searched for count in full over this path length (m)."""
_STRAY = 0.05
"""Share of beams that may end where nothing is mapped at any place: through windows, at the border of the map."""
_ON_THE_SPOT = 0.5
"""How much they count on the spot: of 120 scans of another building none fitted as usual and had no rival."""
_GOOD_FIT, _FIT_SCALE = 0.95, 0.03
"""Explained fitness by the usual one that is no evidence, and the step from it that counts 1 a metre."""
_POOR_FIT, _MOST_FROM_POOR = 0.9, 1.5
"""Explained fitness by the usual one up to which having no rival counts for no more than this: of 230 scans of another
building 12 % had none, of 111 right ones in a crowd 65 %; of those that fitted as usual none and 80 %."""
_MOST_FROM_FIT, _MOST_FROM_MISFIT = 1.0, 3.0
"""Log of the odds that a metre of good or of bad fit changes, at most."""
_REFUSED = -1.0
"""Log of the odds that a refused scan changes."""
_LEAST_USUAL = 0.75
"""Nor for lower: wrong places reach it."""
_SEVERAL, _LEAST_USUAL_OF_SEVERAL = 3, 0.65
"""So many comparisons that vouch for the track show what is usual even on a poor map; not below this, though."""
_CERTIFIED_M = 6.0
"""A comparison that leaves the others behind vouches for the scans of this path length before it (m)."""

_PRIOR_MIRRORED = 0.01
"""Probability that a map is mirrored. Assumed: one of a hundred maps that are given."""
_MIRROR_FITS, _FOR_MIRRORED, _AGAINST_MIRRORED = 1.05, 1.5, -4.0
"""Where the mirrored scans fit better by the first than the place and all others, that changes the log of the odds of a
mirrored map by the second; where they fit worse than `MIRRORED_NEEDED`, by the third. Of 260 comparisons on mirrored
maps of rooms and rings none was below 1.01, and nine tenths in rooms were above the first; on right maps four fifths
fell below, in the changed parts of a ring a quarter rose above (benchmarks/confusion.py, seeds 1 to 6)."""

_FEWEST_JOINED = 4
"""Scans that a place is compared by, at least."""
_RAREST = 4
"""Intervals that pass between two comparisons where the last ones said the same, at most: over 32 m a look-alike has a
probability of 3 %, and a jump into one is noticed in the scans, after which comparisons are frequent again."""
_LATER_M = 1.0
"""Path length (m) after which it is checked whether something that beams ended at still stands. Assumed: long enough
for people around the robot to be elsewhere, short enough for most of it to be in sight."""
_FIRST_COMPARISON_M = 3.0
"""A new track is compared with the whole map after this path length (m), or after the usual one if that is shorter."""


def rival_evidence(ratio: float) -> float:
    """Log of the likelihood ratio, right to wrong, of a rival ratio; 0 for NaN."""
    if ratio <= NOT_UNIQUE:
        return MOST_FROM_RIVAL * min((NOT_UNIQUE - ratio) / (NOT_UNIQUE - _UNIQUE), 1.0)
    if ratio >= _RIVALLED:
        return -MOST_FROM_RIVAL * min((ratio - _RIVALLED) / (_BEATEN - _RIVALLED), 1.0)
    return 0.0


def comparison_evidence(evidence: Evidence, usual: float) -> float:
    """`rival_evidence` of a scan; in favour of a place it counts in full only where the map explains as much as usual.

    Off the map the best place is unique now and then, but it does not fit (see `_MOST_FROM_POOR`).
    """
    return min(rival_evidence(evidence.rival), _most_in_favour(evidence, usual))


def _most_in_favour(evidence: Evidence, usual: float) -> float:
    part = (evidence.explained / usual - _POOR_FIT) / (1.0 - _POOR_FIT)
    return _MOST_FROM_POOR + (MOST_FROM_RIVAL - _MOST_FROM_POOR) * min(max(part, 0.0), 1.0)


def fit_evidence(evidence: Evidence, usual: float) -> float:
    """Log of the likelihood ratio, fitting place to astray, of what the map explains of a scan; 0 for NaN."""
    if not evidence.explained >= 0.0:
        return 0.0
    per_metre = (evidence.explained / usual - _GOOD_FIT) / _FIT_SCALE
    seen = 1.0 - evidence.short - evidence.unmapped
    return min(max(per_metre, -_MOST_FROM_MISFIT), _MOST_FROM_FIT) * min(evidence.distance, 1.0) * seen


def place_evidence(evidence: Evidence, of_rivals: float, usual: float) -> float:
    """Log of the odds that a place that was searched for is the right one.

    `evidence` is that of its scans together, `of_rivals` what the other hypotheses say for it. Beams that end where
    nothing is mapped vouch for no place; on the spot one view is repeated.
    """
    metres = min(evidence.distance, _FULL_M)
    weight = max(metres / _FULL_M, _ON_THE_SPOT) * min(1.0 + _STRAY - evidence.unmapped, 1.0)
    fit = max(metres, 1.0) * min(fit_evidence(replace(evidence, distance=1.0), usual), 0.0)
    of_rivals = min(of_rivals, _most_in_favour(evidence, usual))
    return weight * (of_rivals + comparison_evidence(evidence, usual)) + fit


@dataclass(frozen=True, slots=True)
class TrackRow:
    """A scan of a track: its status, its evidence, and whether a new track begins with it."""

    status: Status
    evidence: Evidence
    begins: bool = False

    def likelihoods(self, usual: float) -> States:
        """Of right, alike and astray, up to a common factor."""
        fit = fit_evidence(self.evidence, usual) + (_REFUSED if self.status is Status.REJECTED else 0.0)
        rival = comparison_evidence(self.evidence, usual)
        return exp(fit + rival), exp(fit + min(rival, 0.0)), 1.0

    def moved_on(self, before: States) -> States:
        """Probabilities of the states after the step to this scan, before its evidence."""
        alike, astray, ends = self._rates()
        right = before[0] * (1.0 - astray - alike)
        return (
            right,
            before[0] * alike + before[1] * (1.0 - ends),
            before[2] + before[0] * astray + before[1] * ends,
        )

    def looked_back(self, after: States) -> States:
        """Likelihoods of all that follows, from before the step to this scan; the transpose of `moved_on`."""
        alike, astray, ends = self._rates()
        right = (1.0 - astray - alike) * after[0] + alike * after[1] + astray * after[2]
        return right, (1.0 - ends) * after[1] + ends * after[2], after[2]

    def _rates(self) -> States:
        """Probabilities that a right track ends up in a look-alike or astray here, and that a look-alike ends here."""
        is_refused = self.status is Status.REJECTED
        alike = 1.0 - exp(-_ALIKE_PER_M * self.evidence.distance) + (_ALIKE_REFUSED if is_refused else 0.0)
        astray = 1.0 - exp(-_ASTRAY_PER_M * self.evidence.distance)
        return alike, astray + (_ASTRAY_REFUSED if is_refused else 0.0), astray + (_ALIKE_ENDS if is_refused else 0.0)


class TrackFilter:
    """The forward pass. State: the probabilities of right, alike and astray, and the scans of all tracks so far."""

    def __init__(self) -> None:
        self.states: States = PRIOR
        self.usual = USUAL_EXPLAINED
        """Explained fitness that is usual on this map as far as it is known (see `usual_explained`)."""
        self._rows: list[TrackRow] = []

    def start(self) -> None:
        """A new track begins; what is usual on the map stays known."""
        self.states = PRIOR

    def add(self, row: TrackRow) -> States:
        """Take a scan; the probabilities."""
        self._rows.append(row)
        if row.evidence.rival <= NOT_UNIQUE:
            self.usual = usual_explained(self._rows)
        self.states = _product(row.moved_on(self.states), row.likelihoods(self.usual))
        return self.states


def smooth(rows: Sequence[TrackRow], begins: Sequence[States] | None = None) -> F64:
    """The probabilities of right, alike and astray at each row, shape (n, 3), given all rows.

    `begins` are those with which each track begins, its own scans left aside; by default `PRIOR` for each.
    """
    likelihoods, backward = _looked_back(rows)
    probabilities = np.zeros((len(rows), 3))
    states, tracks = PRIOR, 0
    for k, row in enumerate(rows):
        if k == 0 or row.begins:
            states = PRIOR if begins is None else begins[tracks]
            tracks += 1
        else:
            states = row.moved_on(states)
        states = _product(states, likelihoods[k])
        probabilities[k] = _product(states, backward[k])
    return probabilities


def entry_likelihoods(rows: Sequence[TrackRow]) -> list[States]:
    """Of the evidence of each track, if it begins right, in a look-alike or astray; up to a common factor."""
    likelihoods, backward = _looked_back(rows)
    starts = [k for k, row in enumerate(rows) if k == 0 or row.begins]
    return [_product(likelihoods[k], backward[k]) for k in starts]


def _looked_back(rows: Sequence[TrackRow]) -> tuple[list[States], list[States]]:
    """The likelihoods of each row, and of all that follows it in its track."""
    usual = usual_explained(rows)
    likelihoods = [row.likelihoods(usual) for row in rows]
    backward: list[States] = [(1.0, 1.0, 1.0)] * len(rows)
    for k in range(len(rows) - 2, -1, -1):
        following = rows[k + 1]
        if not following.begins:
            after = _product(likelihoods[k + 1], backward[k + 1])
            backward[k] = _product(following.looked_back(after), (1.0, 1.0, 1.0))
    return likelihoods, backward


def mirrored_map(rows: Sequence[TrackRow]) -> float:
    """The probability that the map is mirrored, by all comparisons of a run."""
    odds = log(_PRIOR_MIRRORED / (1.0 - _PRIOR_MIRRORED))
    for row in rows:
        evidence = row.evidence
        if evidence.mirrored <= MIRRORED_NEEDED + 1e-9:  # found nothing above it
            odds += _AGAINST_MIRRORED
        elif evidence.mirrored >= _MIRROR_FITS * max(evidence.rival, 1.0):
            odds += _FOR_MIRRORED
    return 1.0 / (1.0 + exp(min(-odds, 700.0)))


def usual_explained(rows: Sequence[TrackRow]) -> float:
    """The explained fitness that is usual at places that comparisons vouch for; that of a good map where none does.

    Where several comparisons vouch for the track, three quarters of the scans between them reach it: people and
    furniture are usual there. With few, a quarter of the scans does. The
    comparison of a relocalisation does not count: the place was chosen by it.
    """
    path = np.cumsum([row.evidence.distance for row in rows])
    explained = np.array([row.evidence.explained for row in rows])
    vouched = np.zeros(len(rows), dtype=np.bool_)
    comparisons = 0
    for k, row in enumerate(rows):
        vouches = rival_evidence(row.evidence.rival) >= 0.5 * MOST_FROM_RIVAL and row.evidence.explained >= _LEAST_USUAL
        if row.status is Status.MATCHED and vouches:
            comparisons += 1
            vouched |= (path <= path[k]) & (path >= path[k] - _CERTIFIED_M)
    values = explained[vouched & np.isfinite(explained)]
    if len(values) == 0:
        return USUAL_EXPLAINED
    if comparisons < _SEVERAL:
        return float(np.clip(np.percentile(values, 75.0), _LEAST_USUAL, USUAL_EXPLAINED))
    return float(np.clip(np.percentile(values, 25.0), _LEAST_USUAL_OF_SEVERAL, USUAL_EXPLAINED))


def _product(first: States, second: States) -> States:
    """State by state, normalised to the sum 1; none becomes zero, so that no state is ruled out for ever."""
    (a, b, c), (x, y, z) = first, second
    a, b, c = max(a * x, _SMALLEST), max(b * y, _SMALLEST), max(c * z, _SMALLEST)
    total = a + b + c
    return a / total, b / total, c / total


class TrackMonitor:
    """State: the scans of the last metres, the path length, and the probability that the track is right."""

    def __init__(self, check: PlaceCheck) -> None:
        self._check = check
        self._filter = TrackFilter()
        self._trail: deque[tuple[float, Pose2, F64]] = deque()
        self._ends: deque[tuple[float, F64]] = deque()
        self._path_length = 0.0
        self._compared_at = 0.0
        self._unchanged = 1
        self._seen_at = 0.0
        self.begin()

    @property
    def usual_explained(self) -> float:
        """The explained fitness that is usual on this map, as far as it is known."""
        return self._filter.usual

    def begin(self) -> None:
        """A new track begins; it is compared with the whole map soon."""
        self._filter.start()
        self._unchanged = 1
        self._trail.clear()
        self._ends.clear()
        self._compared_at = self._path_length - max(self._check.parameters.interval - _FIRST_COMPARISON_M, 0.0)

    def move(self, distance: float) -> None:
        """The robot moved on (m)."""
        self._path_length += distance

    def skipped(self) -> Evidence:
        """A scan could not be matched: it says nothing."""
        return Evidence(self._distance())

    def is_hidden(self, paired: PairedScan, pose: Pose2) -> bool:
        """See `PlaceCheck.is_hidden`."""
        return self._check.is_hidden(paired, pose, self.usual_explained)

    def astray(self, paired: PairedScan, pose: Pose2) -> float:
        """The share of beams of a scan that end behind walls or where nothing is mapped."""
        found = self._check.explain(paired, pose)
        return found.through + found.unmapped

    def refused(self) -> Evidence:
        """The match of a scan was refused."""
        evidence = Evidence(self._distance())
        self._unchanged = 1
        self._filter.add(TrackRow(Status.REJECTED, evidence))
        return evidence

    def matched(self, paired: PairedScan, pose: Pose2, points: F64) -> Evidence:
        """A scan with points (n, 2) was matched; now and then its place is compared with the whole map."""
        p = self._check.parameters
        distance = self._distance()
        self._trail.append((self._path_length, pose, self._check.few(points)))
        while self._trail[0][0] < self._path_length - p.length:
            self._trail.popleft()
        compared = Comparison(float("nan"), None)
        if self._path_length - self._compared_at >= self._unchanged * p.interval and len(self._trail) >= _FEWEST_JOINED:
            self._compared_at = self._path_length
            chosen = np.unique(np.linspace(0, len(self._trail) - 1, p.scans).astype(np.int64))
            compared = self._check.compare([self._trail[k][1:] for k in chosen], pose)
        found = self._check.explain(paired, pose)
        lasting = self._lasting(paired, pose, found)
        evidence = Evidence(distance, found.fitness, found.short, found.through, found.unmapped, *compared, lasting)
        self._weigh_change(evidence)
        self._filter.add(TrackRow(Status.MATCHED, evidence))
        return evidence

    def _lasting(self, paired: PairedScan, pose: Pose2, found: Explanation) -> float:
        """See `Evidence.lasting`; by what beams ended at the last time that it was far enough back."""
        before = self._path_length - _LATER_M
        while len(self._ends) > 1 and self._ends[1][0] <= before:
            self._ends.popleft()
        share = float("nan")
        if self._ends and self._ends[0][0] <= before and found.short > 0.0:
            share = self._check.still_stands(paired, pose, self._ends[0][1])
        self._ends.append((self._path_length, found.ends))
        return found.short * share if found.short > 0.0 else 0.0

    def _weigh_change(self, evidence: Evidence) -> None:
        """Comparisons that say the same again become rarer; where a scan fits worse than usual they do not."""
        if not evidence.explained >= _GOOD_FIT * self._filter.usual or evidence.unmapped > _STRAY:
            self._unchanged = 1
        elif isfinite(evidence.rival):
            self._unchanged = min(2 * self._unchanged, _RAREST) if evidence.rival <= _UNIQUE else 1

    def is_astray(self, evidence: Evidence, probability: float) -> bool:
        """Whether the track is astray with at least this probability, and another place was found that fits as well."""
        return evidence.rival >= 1.0 and self._filter.states[2] > probability

    def _distance(self) -> float:
        """Path length since the scan before."""
        distance = self._path_length - self._seen_at
        self._seen_at = self._path_length
        return distance

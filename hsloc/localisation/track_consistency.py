"""Which of the tracks of a run are right: tracks that the odometry does not join exclude each other.

A track begins where the relocaliser was sure and ends where the robot was lost. Each is judged by its own scans in
`track_evidence`; but half a building often fits where the other half is not mapped, however long the robot drives
there, and no scan contradicts that. The odometry does: from a track that is right it leads to the next one, as far as
its errors allow. Two tracks that it does not join are both right only if somebody carried the robot, which is rare.
Where it leads off the mapped ground, a place that fits elsewhere on the map is a look-alike of one that is not mapped;
in such places more beams end in free space or behind walls. And where it leads over mapped ground, the robot should
have been found there.

All tracks may be look-alikes, too, on the map of another building. There beams end at things that are not on the map
and stand where they are, which people do not, other places fit as well, and soon the track fits no longer.

All subsets of right tracks are weighed: each track by its own evidence, neighbours in the subset by the odometry
between them, the others as wrong. The sum over all subsets is one over paths through the tracks in their order.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from math import ceil, exp, isfinite, log, pi
from typing import TYPE_CHECKING

import numpy as np

from hsloc.localisation.odometry_errors import Errors
from hsloc.localisation.track_evidence import MOST_FROM_RIVAL, NOT_UNIQUE, rival_evidence
from hsloc.model.pose2 import Pose2, rotated, wrap_angle

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from hsloc.localisation.odometry_errors import Way
    from hsloc.model.estimate import Evidence
    from hsloc.model.occupancy_grid import OccupancyGrid

    F64 = NDArray[np.float64]
    Bools = NDArray[np.bool_]

_MOST_BENT = 2.0
"""Variance of a heading (rad^2) up to which it bends what is known of a place: beyond it the place may be anywhere."""
_KIDNAPPED = 1e-2
"""Probability that somebody carried the robot while it was lost. Assumed: a claim that others contradict needs 100
times the evidence."""
_SLIPPED = 0.1
"""Probability that wheels slipped by more than the noise, once while it was lost."""
_SLIP = np.diag((0.5**2, 0.5**2, 0.35**2))
"""Covariance of such a slip: half a metre, as the window that is searched after a refused match, and 20 deg."""
_DISTORTION = np.diag((0.3**2, 0.3**2, 0.05**2))
"""Covariance of two places of a map, one by the other: a built map bends."""
_GIVEN_ALIKE = 0.1
"""A given start is this much less likely to be in a look-alike of the right place than one that was searched for."""
_MOST_SUPPORT = 10.0
"""Ratio by which a track supports another one that odometry joins to it, at most: both may be look-alikes of one
stretch that is not mapped."""
_LOOK_ALIKE = 0.1
"""Probability that a place is claimed where the robot is on ground that is not mapped: nearly 1 in simulated halls of
which half is mapped, nearly 0 in rooms, corridors and on maps of parts of Intel, Freiburg and ACES; one for all."""
_FEW_SHORT, _CROWDED, _WIDELY = 0.02, 0.3, 0.6
"""Share of beams that end before a wall at right places, at what still stands there later if that is known: the first
on the mean, but in a part of the runs, the second, where much of the map has changed, anything up to the third; in
look-alikes anything up to it. On maps of parts of these logs and on simulated half maps (seeds 1 to 6) it was 0 to 0.04
in right tracks, 0.04 to 0.4 in wrong ones. With people in half of the view 0.03 to 0.06 of 0.24 to 0.48 still stood."""
_FEW_THROUGH, _MANY_THROUGH, _HIDDEN = 0.012, 0.06, 0.3
"""Mean share of beams that end behind a wall at right places (0 to 0.03, also where 30 % of the map has changed), and
at look-alikes (0 to 0.15) but for a part of them, the third, that have the same walls."""
_MOST_MISFITS = 30.0
"""Most that both count."""
_OTHER_MAP = 3e-2
"""Probability that the map is of another building, or mirrored. Assumed: a few of a hundred maps that are given."""
_RIVALLED, _UNRIVALLED, _MOST_RIVALLED = 3.0, 0.2, 30.0
"""Ratio of the probabilities, on another map and on the right one, that a comparison leaves another place as good, and
that it leaves none: of 230 scans of another building 88 % had one within 0.85, of 231 right ones 20 to 40 %; and the
most that several count, which see the same map."""
_ALIKE_M, _LEAST_LASTS, _ENDS, _OVER_M = 20.0, 0.1, 10.0, 3.0
"""On another map a track fits for about the first (m), where a right one goes astray once in 200 m: that it ended
counts the third, and its length against another map, but no less than the second, for a place may be a copy. It has
ended where the robot went on for more than the last (m) on mapped ground. Assumed, and looked at on seed 81 of
benchmarks/confusion.py."""
_ASTRAY = 0.03
"""Weight of being astray from the beginning on another map. There it is the rule, and on the right one the prior of all
starts is 0.01; but of those that do not fit many are wrong, or stand where the map has changed, so that another map
gains 3 by it and not 100. Assumed; from 0.01 to 0.1 the states of 125 runs (benchmarks/confusion.py) differ in one."""
_FOUND_AFTER_M, _LOST_M, _MOST_FROM_LOST = 6.0, 5.0, 6.0
"""A robot on mapped ground is found again within the first (m); each further stretch of the second (m) counts 1, up to
the third in all."""
_DRIFT = 0.01
"""Standard deviation of the drift of the odometry in heading (rad/m): that of wheels that are not calibrated, as in
benchmarks/calibration.py."""
_DRIFT_OVER_M, _DRIFT_KNOWN = 5.0, 2
"""The drift is measured over stretches of the first (m); the assumption weighs like the second of them."""
_NEAR_BORDER, _FARTHEST_BORDER = 0.5, 5.0
"""The odometry leaves the mapped ground where nothing is mapped beside it within the first (m) and two standard
deviations, the second at most; anywhere else it leads through a wall."""
_LEAST_NOISE = 0.25
"""Least variance of the odometry's noise by the assumed one."""
_LOOKED_AT = 6
"""Places of a search at which it is asked how well its way is known."""
LEAST = 1e-100
"""Weights and probabilities are this at least. Internal: what follows divides by them, and takes their logarithms."""
_HORIZON = 12
"""Tracks between two right ones of which the odometry says anything, at most."""


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """A track: where it is sure for the first and for the last time, and what its own scans say.

    `enters` and `leaves` are indices of odometry messages with the poses T_map_base there, `messages` those of its
    scans, `headings` the headings in the map there. `alike` and `astray` are the likelihoods of its evidence if it
    began there by the one if it began right. `lost` are the messages of the scans of the search after it. `is_found`
    says that a search led to it, and no given start. `said` is the evidence of the scans that were matched until it
    leaves. `noise_scale` is that of the odometry's variances.
    """

    enters: int
    entry: Pose2
    leaves: int
    exit: Pose2
    messages: NDArray[np.int64]
    headings: F64
    alike: float
    astray: float
    lost: NDArray[np.int64]
    is_found: bool
    said: tuple[Evidence, ...] = ()
    noise_scale: float = 1.0

    def wrong(self, priors: tuple[float, float, float]) -> float:
        """Weight of the track if it does not begin right: in a look-alike or astray."""
        alike = priors[1] if self.is_found else _GIVEN_ALIKE * priors[1]
        return alike * self.alike + priors[2] * self.astray

    def look_alike(self) -> float:
        """Likelihood of its beams in a look-alike by that at the right place, times the probability of a claim."""
        lasting = [each.lasting for each in self.said if isfinite(each.lasting)] or [each.short for each in self.said]
        short = float(np.mean(lasting)) if lasting else 0.0
        through = float(np.mean([each.through for each in self.said])) if self.said else 0.0
        right = (1.0 - _CROWDED) * exp(-short / _FEW_SHORT) / _FEW_SHORT + _CROWDED / _WIDELY
        behind = exp(through / _FEW_THROUGH - through / _MANY_THROUGH) * _FEW_THROUGH / _MANY_THROUGH
        ratio = (_HIDDEN + (1.0 - _HIDDEN) * behind) / (_WIDELY * right)
        return _LOOK_ALIKE * min(ratio, _MOST_MISFITS)

    def on_another_map(self, way: Way, went_on: float) -> float:
        """The same on a map of another building: there other places often fit as well, and soon the scans do not.

        `went_on` is how far the robot drove on mapped ground after it (m). A track may be astray from its beginning
        there, above all from a start that is given.
        """
        rivalled = sum(each.rival > NOT_UNIQUE for each in self.said)
        unique = sum(rival_evidence(each.rival) > 0.99 * MOST_FROM_RIVAL for each in self.said)
        of_rivals = min(max(_RIVALLED**rivalled * _UNRIVALLED**unique, 1.0 / _MOST_RIVALLED), _MOST_RIVALLED)
        metres = float(np.diff(way.metres(np.array((self.enters, self.leaves))))[0])
        lasts = max(exp(-metres / _ALIKE_M), _LEAST_LASTS)
        return self.look_alike() * of_rivals * lasts * (_ENDS if went_on > _OVER_M else 1.0) + _ASTRAY * self.astray


class MappedGround:
    """Where a map knows something, and where one gets from there to what it does not know."""

    def __init__(self, grid: OccupancyGrid) -> None:
        self._known = grid.cells >= 0
        self._free = grid.free()
        self._inverse = grid.origin.inverse()
        self._resolution = grid.resolution
        self.volume = 2.0 * pi * float(self._free.sum()) * grid.resolution**2
        """Of all poses on free ground (m^2 rad)."""

    @cached_property
    def is_closed(self) -> bool:
        """Whether no free ground borders on the unknown, or on the edge of the map: then a robot cannot leave it."""
        unknown = np.pad(~self._known, 1, constant_values=True)
        return not (self._free & _beside(unknown)).any()

    def holds(self, points: F64) -> Bools:
        """Which of the points (n, 2) in the map lie on known cells."""
        cells = self._cells(points)
        height, width = self._known.shape
        inside = (cells >= 0).all(axis=1) & (cells < (width, height)).all(axis=1)
        result = np.zeros(len(points), dtype=np.bool_)
        result[inside] = self._known[cells[inside, 1], cells[inside, 0]]
        return result

    def is_open(self, point: F64, within: float) -> bool:
        """Whether free ground borders on what is unknown, or on the edge of the map, near a point (2,)."""
        (u, v), reach = self._cells(point[None])[0].tolist(), ceil(within / self._resolution)
        height, width = self._known.shape
        if not (-reach <= u < width + reach and -reach <= v < height + reach):
            return False
        rows, columns = slice(max(v - reach, 0), v + reach + 1), slice(max(u - reach, 0), u + reach + 1)
        unknown = np.pad(~self._known[rows, columns], 1)
        # The edge of the map is as good as unknown, that of the part that is looked at is not.
        unknown[0], unknown[-1] = v - reach <= 0, v + reach >= height - 1
        unknown[:, 0] |= u - reach <= 0
        unknown[:, -1] |= u + reach >= width - 1
        return bool((self._free[rows, columns] & _beside(unknown)).any())

    def _cells(self, points: F64) -> NDArray[np.int64]:
        cells: NDArray[np.int64] = np.floor((self._inverse @ points) / self._resolution).astype(np.int64)
        return cells


def _beside(cells: Bools) -> Bools:
    """Which cells (h, w) are next to one of `cells` (h + 2, w + 2), which has a margin of one around them."""
    result: Bools = cells[:-2, 1:-1] | cells[2:, 1:-1] | cells[1:-1, :-2] | cells[1:-1, 2:]
    return result


def _left_open(way: Way, start: tuple[int, Pose2], last: int, ground: MappedGround, errors: Errors) -> Bools:
    """Where the odometry from a message and its pose to another message has left the mapped ground, not through walls.

    One for each message on the way, the first included; before the first message they are in reverse order.
    """
    first, pose = start
    messages = np.arange(first, last + 1) if last >= first else np.arange(first, last - 1, -1)
    poses = way.led_to(pose, first, messages)
    known = ground.holds(poses[:, :2])
    leaves = np.flatnonzero(known[:-1] & ~known[1:])
    result = np.zeros(len(known), dtype=np.bool_)
    result[: leaves[0] if len(leaves) else len(known)] = True
    for k, end in pairwise([*leaves.tolist(), len(known)]):
        spread = way.between(first, int(messages[k]), errors)
        within = _NEAR_BORDER + 2.0 * float(np.sqrt(np.linalg.eigvalsh(spread[:2, :2])[-1]))
        result[k:end] = ground.is_open(poses[k, :2], min(within, _FARTHEST_BORDER))
    return result & ~known


def right_tracks(tracks: Sequence[Track], way: Way, ground: MappedGround, priors: tuple[float, float, float]) -> F64:
    """The probability that each of the n tracks begins right, shape (n,), given all of them.

    `priors` are those of right, alike and astray where a track begins.
    """
    n = len(tracks)
    pairs = _Pairs.of(tracks, way, ground)
    own = np.maximum([each.wrong(priors) for each in tracks], LEAST)
    look_alike = np.array([each.look_alike() if each.is_found else 0.0 for each in tracks])
    # Log weight of a step from one right track to the next, row and column 0 and n + 1 for none before and none after:
    # of the tracks between, which are wrong, and of the next one.
    wrong = np.concatenate(((0.0,), np.cumsum(np.log(own))))
    step = np.full((n + 2, n + 2), -np.inf)
    for i in range(-1, n):
        for j in range(i + 1, n + 1):
            if j - i - 1 > _HORIZON:
                step[i + 1, j + 1] = wrong[j] - wrong[i + 1]
            else:
                step[i + 1, j + 1] = pairs.between(i, j, own, look_alike)
            step[i + 1, j + 1] += log(priors[0]) if j < n else 0.0
    forward, backward = np.full(n + 2, -np.inf), np.full(n + 2, -np.inf)
    forward[0] = backward[n + 1] = 0.0
    for j in range(1, n + 2):
        forward[j] = np.logaddexp.reduce(forward[:j] + step[:j, j])
    for i in range(n, -1, -1):
        backward[i] = np.logaddexp.reduce(backward[i + 1 :] + step[i, i + 1 :])
    other_map = log(_OTHER_MAP) + sum(
        log(each.on_another_map(way, metres)) for each, metres in zip(tracks, pairs.went_on.tolist(), strict=True)
    )
    total = np.logaddexp(forward[n + 1], other_map)
    result: F64 = np.exp(np.clip(forward[1:-1] + backward[1:-1] - total, log(LEAST), 0.0))
    return result


@dataclass(frozen=True, slots=True, eq=False)
class _Pairs:
    """What the odometry says of pairs of n tracks, each (n, n), the first of a pair being right.

    `joined` is the log of how much more probable that makes the second, `unmapped` how likely the second was on ground
    off the map, and `lost` the metres of the search after the second that were on mapped ground. `went_on` (n,) are the
    metres on mapped ground after each, if it is right, as far as its last scan or the search after it.
    """

    joined: F64
    unmapped: F64
    lost: F64
    went_on: F64

    @staticmethod
    def of(tracks: Sequence[Track], way: Way, ground: MappedGround) -> _Pairs:
        n = len(tracks)
        joined, unmapped, lost, went_on = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n)), np.zeros(n)
        drift = _drift(tracks, way)
        for i, one in enumerate(tracks):
            errors = Errors(max(one.noise_scale, _LEAST_NOISE), drift)
            last = int(max((one.leaves, *one.messages[-1:], *one.lost[-1:])))
            gone = _left_open(way, (one.leaves, one.exit), last, ground, errors)
            went_on[i] = np.diff(way.metres(np.arange(one.leaves, last + 1))) @ ~gone[1:]
            for j in range(max(i - _HORIZON, 0), min(i + _HORIZON + 1, n)):
                other = tracks[j]
                if j > i:
                    joined[i, j] = _joined(one, other, way, ground.volume, errors)
                if j != i:
                    start = (one.leaves, one.exit) if j > i else (one.enters, one.entry)
                    unmapped[i, j] = _unmapped(start, other.messages, way, ground, errors)
                if j >= i and len(other.lost):
                    lost[i, j] = _lost_way(one, other, way, ground, errors)
        return _Pairs(joined, unmapped, lost, went_on)

    def between(self, i: int, j: int, own: F64, look_alike: F64) -> float:
        """Log weight of two right tracks i and j by each other, -1 and n for none, and of those between, all wrong."""
        n = len(own)
        k = np.arange(i + 1, j)
        share = np.zeros(len(k))
        weight = 0.0
        if i >= 0:
            share = self.unmapped[i, k]
            metres = float(self.lost[i, i:j].sum())
            weight -= min(max(metres - _FOUND_AFTER_M, 0.0) / _LOST_M, _MOST_FROM_LOST)
        if j < n:
            share = np.maximum(share, self.unmapped[j, k])
            weight += float(self.joined[i, j]) if i >= 0 else 0.0
        return weight + float(np.log(own[k] + look_alike[k] * share).sum())


def _drift(tracks: Sequence[Track], way: Way) -> float:
    """Standard deviation of the drift of the odometry's heading (rad/m), as the tracks show it."""
    squares, count = _DRIFT_KNOWN * _DRIFT**2, _DRIFT_KNOWN
    for track in tracks:
        off = np.unwrap(track.headings - way.poses[track.messages, 2])
        path = way.metres(track.messages)
        edges = np.unique(np.searchsorted(path, np.arange(path[0], path[-1], _DRIFT_OVER_M)))
        if len(edges) > 1:
            squares += float(((np.diff(off[edges]) / np.diff(path[edges])) ** 2).sum())
            count += len(edges) - 1
    return float(np.sqrt(squares / count))


def _joined(one: Track, other: Track, way: Way, volume: float, errors: Errors) -> float:
    """Log of how much more probable the second track's entry is, the first being right, than any other pose."""
    predicted = way.led_to(one.exit, one.leaves, np.array([other.enters]))[0]
    error = other.entry.to_array() - predicted
    error[2] = wrap_angle(float(error[2]))
    spread = way.between(one.leaves, other.enters, errors)
    # Where the heading is uncertain by more than a little, the place lies on an arc and beside its tangent.
    bent = 0.5 * min(float(spread[2, 2]), _MOST_BENT) * float(np.linalg.eigvalsh(spread[:2, :2])[-1])
    turn = one.exit.theta - way.poses[one.leaves, 2]
    covariance = rotated(spread, turn) + _DISTORTION + np.diag((bent, bent, 0.0))
    found = 0.0
    for weight, each in ((1.0 - _SLIPPED, covariance), (_SLIPPED, covariance + _SLIP)):
        highest = volume / np.sqrt((2.0 * pi) ** 3 * np.linalg.det(each))
        found += weight * max(float(highest), 1.0) * exp(-0.5 * float(error @ np.linalg.solve(each, error)))
    return log(min(found, _MOST_SUPPORT) + _KIDNAPPED)


def _unmapped(
    start: tuple[int, Pose2], messages: NDArray[np.int64], way: Way, ground: MappedGround, errors: Errors
) -> float:
    """Share of the scans at `messages` that are on ground off the map, all before or all after a right pose."""
    apart = np.abs(messages - start[0])
    gone = _left_open(way, start, int(messages[apart.argmax()]), ground, errors)
    return way.known(start[0], int(messages[len(messages) // 2]), errors) * float(gone[apart].mean())


def _lost_way(one: Track, other: Track, way: Way, ground: MappedGround, errors: Errors) -> float:
    """Metres of the search after a track that, the first track being right, did not lead to ground off the map."""
    gone = _left_open(way, (one.leaves, one.exit), int(other.lost[-1]), ground, errors)
    some = np.unique(np.linspace(0, len(other.lost) - 1, _LOOKED_AT).astype(np.int64))
    known = [1.0 if ground.is_closed else way.known(one.leaves, int(other.lost[k]), errors) for k in some]
    weights = np.interp(np.arange(1, len(other.lost)), some, known)
    weights[gone[other.lost[1:] - one.leaves]] = 0.0
    return float(np.diff(way.metres(other.lost)) @ weights)

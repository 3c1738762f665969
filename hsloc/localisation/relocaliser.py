"""The relocaliser: where on the whole map the robot could be, until one hypothesis wins.

Branch and bound searches the whole map with the first scans, and every place that fits becomes a hypothesis; later
scans may add others, for there may be people around at first. Each further scan moves the hypotheses with the odometry,
matches them again in a small window and adds to their record. Hypotheses that fall behind are dropped, those that meet
are merged. The winner must be ahead of all others by a sum of fitness that grows over several scans and some way: in a
place that exists twice, no answer is sure. The scans seen until then are matched again, backwards, so that the
trajectory can be completed.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from itertools import pairwise
from math import hypot
from typing import TYPE_CHECKING

import numpy as np

from hsloc.localisation.gates import MotionGate
from hsloc.localisation.global_search import RelocaliserResult, most_likely
from hsloc.localisation.hypotheses import (
    RECORDED,
    CandidateLimits,
    DistinctPoses,
    Hypothesis,
    bounded_search,
    fits_better,
    likely_places,
    quick_matcher,
    search_text,
)
from hsloc.localisation.place_check import USUAL_EXPLAINED, PlaceCheck
from hsloc.localisation.retraced_scans import STEP_WINDOW, RetracedScan, Retracer
from hsloc.localisation.track_evidence import MOST_FROM_RIVAL, place_evidence, rival_evidence
from hsloc.localisation.whole_map_search import join_scans
from hsloc.matching.window import Window
from hsloc.model.estimate import Evidence, State
from hsloc.model.pose2 import Pose2
from hsloc.parameters import Count, NonNegative, Parameters, Positive, Ratio

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

    from hsloc.localisation.motion_models import MotionModel
    from hsloc.localisation.whole_map_search import WholeMapSearch
    from hsloc.matching.likelihood_field import LikelihoodField
    from hsloc.matching.match import Matcher
    from hsloc.model.estimate import LikelyPlace
    from hsloc.model.events import PairedScan
    from hsloc.model.occupancy_grid import OccupancyGrid

    F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class RelocaliserParameters(Parameters):
    """How the whole map is searched, and when a hypothesis is accepted."""

    search_margin: Ratio = 0.2
    """Fitness below the best within which a place of the whole map becomes a hypothesis."""
    search_boxes: Count = 10_000_000
    """Maximum number of boxes of poses in one search of the whole map; a million take about 0.1 s."""
    search_points: Count = 60
    """Maximum number of points that the whole map is searched with, and a hypothesis is matched with."""
    budget: Count = 240
    """Number of fitness evaluations of a match of a hypothesis."""
    hypotheses: Count = 400
    """Maximum number of hypotheses."""
    step_min_d: NonNegative = 0.3
    """Minimum translation between two scans that update the hypotheses [m]; a larger rotation is enough, too."""
    step_min_a: NonNegative = 0.3
    """Minimum rotation between two scans that update the hypotheses [rad]; a larger translation is enough, too."""
    seed_scans: Count = 3
    """Number of first scans that are joined for a search of the whole map; the first is searched for by itself, too."""
    min_points: Count = 20
    """Minimum number of hits of a scan that updates the hypotheses."""
    min_scans: Count = 4
    """Minimum number of scans before a hypothesis is accepted."""
    min_fitness: Ratio = 0.35
    """Minimum mean fitness of an accepted hypothesis."""
    min_margin: NonNegative = 1.0
    """Minimum difference between the summed fitness of an accepted hypothesis and that of any other."""
    drop: NonNegative = 2.5
    """Difference to the best summed fitness at which a hypothesis is dropped."""
    max_rival_ratio: Ratio = 0.93
    """Maximum ratio of another hypothesis's mean fitness to that of an accepted one, unless the paired test passes."""
    keep_ratio: Ratio = 0.85
    """Ratio to the best mean fitness from which a hypothesis is kept, however far its sum falls behind."""
    confidence: Ratio = 0.99
    """Confidence of the paired test that an accepted hypothesis fits better than every other one."""
    min_evidence: NonNegative = 4.0
    """Minimum logarithm of the odds that its scans and the whole map give an accepted hypothesis."""
    renew_distance: Positive = 3.0
    """Path length after which the whole map is searched again [m]; doubled each time while a hypothesis fits."""
    restart_below: Ratio = 0.3
    """Mean fitness of the best hypothesis below which the search starts again."""


_REFINE_POINTS = 120
"""Points with which a place is refined before its record is made."""
_OF_SEVERAL = 0.5
"""Part of the margin where several scans are joined: they distinguish places better than one."""
_JOINED = 6
"""Scans that are joined for a later search: about two metres, over which odometry is good to some centimetres."""
_NEW_MARGIN = 0.05
"""Mean fitness below the best hypothesis's from which a place that is found late is one, too."""
_FITS = 0.8
"""Going backwards, a scan fits with at least this part of the winner's fitness."""
_WEIGHED = 12
"""Scans that the winner is weighed by, at most."""
_WEIGHED_AGAIN = 4
"""It is weighed again after at most this number of scans: on a large map that takes a second."""
_OFF_MAP = 0.87
"""Explained fitness by the usual one below which the best place does not fit."""
REMEMBERED = 1000
"""Scans of a search that are kept to retrace the way; older ones are forgotten, so that memory is bounded."""


class Relocaliser:
    """A `GlobalSearch` by branch and bound; its state is a list of hypotheses."""

    def __init__(
        self,
        grid: OccupancyGrid,
        likelihood: LikelihoodField,
        matcher: Matcher,
        parameters: RelocaliserParameters,
        motion_model: MotionModel,
        rng: Generator,
        *,
        place_check: PlaceCheck | None = None,
    ) -> None:
        self._check = place_check
        self._path_length = 0.0
        self._searched_at = 0.0
        self._search_after = parameters.renew_distance
        self._explained: float | None = None
        self._weigh_at = 0
        self._state = State.LOST
        self._places: tuple[LikelyPlace, ...] = ()
        self._usual = USUAL_EXPLAINED
        self._field = likelihood
        self._matcher = matcher
        self._quick = quick_matcher(matcher, parameters.budget, parameters.search_points)
        self._parameters = parameters
        self._motion_model = motion_model
        self._gate = MotionGate(parameters.step_min_d, parameters.step_min_a)
        self._rng = rng
        self._retracer = Retracer(likelihood, matcher, motion_model, rng, self._is_hidden)
        self._grid = grid
        self._map_search: WholeMapSearch | None = None
        self._hypotheses: list[Hypothesis] = []
        self._T_odom_last: Pose2 | None = None
        self._seen: deque[tuple[int, F64, PairedScan]] = deque(maxlen=REMEMBERED)

    def start(self, usual_explained: float | None = None) -> None:
        """See `GlobalSearch`."""
        self._usual = USUAL_EXPLAINED if usual_explained is None else usual_explained
        self._hypotheses = []
        self._T_odom_last = self._explained = None
        self._weigh_at = 0
        self._state, self._places = State.LOST, ()
        self._seen.clear()

    def places(self) -> list[Pose2]:
        """The hypotheses at the last scan that was used, T_map_base, the best first."""
        return [h.pose for h in self._hypotheses]

    def update(self, paired: PairedScan, odometry_count: int) -> RelocaliserResult:
        """Take a scan, and how many odometry messages there were until now."""
        p = self._parameters
        T_odom_base = paired.T_odom_base
        motion = Pose2() if self._T_odom_last is None else self._T_odom_last.between(T_odom_base)
        if self._hypotheses and not self._gate.is_open(motion):
            return self._verdict(motion, 0, False)
        points = paired.points_base()
        if len(points) < p.min_points:
            return self._verdict(motion, 0, False)
        self._T_odom_last = T_odom_base
        self._seen.append((odometry_count, points, paired))
        if self._hypotheses and self._hypotheses[0].mean < p.restart_below:
            self._hypotheses = []
        evaluations = self._advance(points, motion)
        scans = self._hypotheses[0].scans if self._hypotheses else 1
        self._path_length += hypot(motion.x, motion.y)
        if scans == 1 or scans == p.seed_scans:
            evaluations += self._find(scans, p.min_fitness)
            self._searched_at, self._search_after = self._path_length, p.renew_distance
        elif self._path_length - self._searched_at >= (p.renew_distance if self._is_poor() else self._search_after):
            self._searched_at = self._path_length
            self._search_after *= 2.0
            evaluations += self._find(_JOINED, max(self._hypotheses[0].mean - _NEW_MARGIN, p.min_fitness))
        self._keep()
        return self._verdict(Pose2(), evaluations, True)

    def _find(self, scans: int, needed: float) -> int:
        """Search the whole map with the last `scans` scans, joined by odometry; new places become hypotheses.

        They are matched in the scans before as well, so that a place that is found late has a record of its own.
        """
        p = self._parameters
        if self._map_search is None:
            self._map_search = bounded_search(self._grid, self._field) if self._check is None else self._check.search
        last = list(self._seen)[-scans:]
        joined = join_scans([points for _, points, _ in last], [paired.T_odom_base for _, _, paired in last])
        limits = CandidateLimits(
            count=p.hypotheses,
            margin=p.search_margin if scans == 1 else _OF_SEVERAL * p.search_margin,
            min_fitness=needed,
            points=p.search_points,
            refined_points=_REFINE_POINTS,
            max_boxes=p.search_boxes,
        )
        taken = DistinctPoses()
        for hypothesis in self._hypotheses:
            taken.add(hypothesis.pose)
        evaluations = 0
        known = tuple(self._hypotheses)
        count = max((hypothesis.scans for hypothesis in self._hypotheses), default=1)
        # At the right place the scans before fit as well, unless nothing known fits: the others are no rivals.
        plausible = 0.0 if self._is_poor() else max((p.max_rival_ratio * h.mean for h in known), default=0.0)
        for pose in likely_places(self._map_search, self._field, joined, limits):
            if taken.add(pose):
                hypothesis, more = self._with_record(pose, count)
                evaluations += more
                if hypothesis.mean < plausible:
                    continue
                # A place whose record leads back to a hypothesis is its continuation with the odometry left aside.
                first, n = hypothesis.trail[0], len(hypothesis.trail)
                if n == 1 or not any(other.was_at(first, n) for other in known):
                    self._hypotheses.append(hypothesis)
        return evaluations

    def _with_record(self, pose: Pose2, count: int) -> tuple[Hypothesis, int]:
        """A hypothesis for the last scan that is matched backwards in up to `count` remembered scans."""
        history: list[float] = []
        trail: deque[Pose2] = deque(maxlen=RECORDED)
        at, covariance = pose, np.empty((3, 3))
        evaluations = 0
        # Where no hypothesis fits, the robot may have been off the map before.
        seen = list(self._seen)[-min(count, _JOINED if self._is_poor() else RECORDED) :]
        for k in range(len(seen) - 1, -1, -1):
            _, points, paired = seen[k]
            match = self._quick.match(points, self._field, Window(at, *STEP_WINDOW), self._rng)
            evaluations += match.evaluations
            history.append(match.fitness)
            if not trail:
                covariance = match.covariance
            trail.appendleft(match.pose)
            at = match.pose @ paired.to(seen[max(k - 1, 0)][2])
        history.reverse()
        total = float(np.mean(history)) * count
        return Hypothesis(trail[-1], covariance, history[-1], total, count, history, trail), evaluations

    def _advance(self, points: F64, motion: Pose2) -> int:
        """Move the hypotheses with the odometry and match them again."""
        evaluations = 0
        half, _, half_angle = STEP_WINDOW
        spread = 3.0 * np.sqrt(np.diag(self._motion_model.covariance(motion)))
        half = max(half, float(spread[:2].max()))
        half_angle = max(half_angle, float(spread[2]))
        for hypothesis in self._hypotheses:
            window = Window(hypothesis.pose @ motion, half, half, half_angle)
            match = self._quick.match(points, self._field, window, self._rng)
            evaluations += match.evaluations
            hypothesis.follow(match)
        return evaluations

    def _keep(self) -> None:
        """Drop the hypotheses that fell behind, merge those that met: of each place the best stays."""
        p = self._parameters
        self._hypotheses.sort(key=lambda h: -h.total)
        taken = DistinctPoses()
        kept: list[Hypothesis] = []
        for hypothesis in self._hypotheses:
            best = self._hypotheses[0]
            behind = hypothesis.total < best.total - p.drop and hypothesis.mean < p.keep_ratio * best.mean
            if len(kept) >= p.hypotheses or behind:
                break
            if taken.add(hypothesis.pose):
                kept.append(hypothesis)
        self._hypotheses = kept

    def _verdict(self, motion: Pose2, evaluations: int, fresh: bool) -> RelocaliserResult:
        if not self._hypotheses:
            return RelocaliserResult(None, None, None, evaluations, False, "searching the whole map")
        p = self._parameters
        best = self._hypotheses[0]
        alone = len(self._hypotheses) == 1
        lead = p.drop if alone else best.total - self._hypotheses[1].total
        ratio = 0.0 if alone else self._hypotheses[1].mean / max(best.mean, 1e-9)
        ahead = len(best.history) >= p.min_scans and best.mean >= p.min_fitness and lead >= p.min_margin
        pose = best.pose @ motion
        evidence: Evidence | None = None
        if fresh:
            self._state = self._judge(best, pose)
            several = self._hypotheses if self._state is State.AMBIGUOUS else ()
            self._places = most_likely((each.pose, each.mean) for each in several)
        others = self._hypotheses[1:]
        proven = bool(others) and all(fits_better(best.history, other.history, p.confidence) for other in others)
        sure = fresh and ahead and (proven or ratio <= p.max_rival_ratio)
        if sure and self._check is not None and best.scans < self._weigh_at:
            sure = False
        elif sure and self._check is not None:
            self._weigh_at = best.scans + min(1 + best.scans // 8, _WEIGHED_AGAIN)
            evidence = self._weigh(best, motion)
            of_rivals = MOST_FROM_RIVAL if proven else max(rival_evidence(ratio), 0.0)
            sure = place_evidence(evidence, of_rivals, self._usual) >= p.min_evidence
        track, fits = self._retracer.revised(self._trace(best, motion, REMEMBERED)) if sure else ((), False)
        return RelocaliserResult(
            pose,
            best.covariance if sure else None,
            best.fitness if fresh else None,
            evaluations,
            sure,
            search_text(best, len(self._hypotheses), lead),
            track,
            fits and len(self._seen) < REMEMBERED,
            self._state,
            evidence if sure else None,
            self._places,
        )

    def _is_poor(self) -> bool:
        """Whether the map explains too little of the scans at the best hypothesis."""
        return self._explained is not None and self._explained < _OFF_MAP * self._usual

    def _judge(self, best: Hypothesis, pose: Pose2) -> State:
        """Why it is not sure: the best place does not fit, or several do."""
        p = self._parameters
        if self._check is not None and self._seen:
            said = self._check.explain(self._seen[-1][2], pose).fitness
            self._explained = said if self._explained is None else self._explained + 0.3 * (said - self._explained)
        if best.scans < p.min_scans:
            return State.LOST
        if self._is_poor():
            return State.OFF_MAP
        alike = sum(hypothesis.mean >= p.max_rival_ratio * best.mean for hypothesis in self._hypotheses)
        return State.AMBIGUOUS if alike > 1 else State.LOST

    def _weigh(self, winner: Hypothesis, motion: Pose2) -> Evidence:
        """What the last scans say for the winner: how the map explains them, and whether another place fits as well."""
        assert self._check is not None
        traced = self._trace(winner, motion, _WEIGHED)
        said = [self._check.explain(each.paired, each.pose) for each in traced]
        scans = [(each.pose, self._check.few(each.paired.points_base())) for each in traced]
        path = sum(a.pose.distance(b.pose) for a, b in pairwise(traced))
        means = np.mean([(e.fitness, e.short, e.through, e.unmapped) for e in said], axis=0)
        compared = self._check.compare(scans, winner.pose @ motion)
        return Evidence(path, float(means[0]), float(means[1]), float(means[2]), float(means[3]), *compared)

    def _trace(self, winner: Hypothesis, motion: Pose2, most: int) -> list[RetracedScan]:
        """The last scans, back to where none fits."""
        least = max(self._parameters.min_fitness, _FITS * winner.fitness)
        return self._retracer.trace(winner.pose @ motion, winner.covariance, least, reversed(self._seen), most)

    def _is_hidden(self, paired: PairedScan, pose: Pose2) -> bool:
        """What hides the walls is no reason to lose the trace."""
        return self._check is not None and self._check.is_hidden(paired, pose, self._usual)

"""Matches of a robot that is followed: near the prediction, and in wider windows where that may be wrong."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hsloc.matching.certificate import certify
from hsloc.matching.exact import heuristic
from hsloc.matching.local_refinement import refine
from hsloc.matching.window import Window

if TYPE_CHECKING:
    import numpy as np
    from numpy.random import Generator
    from numpy.typing import NDArray

    from hsloc.localisation.contradicted_odometry import ContradictedOdometry
    from hsloc.localisation.gates import MatchGate
    from hsloc.localisation.parameters import LocaliserParameters
    from hsloc.matching.likelihood_field import LikelihoodField
    from hsloc.matching.match import Match, Matcher
    from hsloc.model.pose2 import Pose2

    F64 = NDArray[np.float64]

_AS_USUAL = 0.98
"""Ratio to the usual fitness from which the optimum next to the prediction is taken without a search."""


class TrackMatcher:
    """Matches a scan in the window that the covariance of the prediction gives, and beyond it.

    A match that is not as fit as usual, that lies on the border of its window, or that follows a slip of the wheels,
    may give way to one in a wider window. Gate and odometry are those of the localiser, and are not changed.
    """

    def __init__(
        self,
        likelihood: LikelihoodField,
        matcher: Matcher,
        parameters: LocaliserParameters,
        gate: MatchGate,
        contradicted: ContradictedOdometry,
        rng: Generator,
    ) -> None:
        self._field = likelihood
        self._matcher = matcher
        self._parameters = parameters
        self._gate = gate
        self._contradicted = contradicted
        self._rng = rng
        self._evaluations = 0
        # Where a proof is asked for, the optimum next to the prediction has none.
        proves = parameters.certify or heuristic(matcher) is not matcher
        self._refines = parameters.refine_first and not proves

    def match(self, points: F64, T_odom_base: Pose2, predicted: Pose2, covariance: F64) -> tuple[Match, int]:
        """The match, and the number of evaluations of the fitness; points (n, 2) are in the frame of the base."""
        self._evaluations = 0
        return self._match(points, T_odom_base, predicted, covariance), self._evaluations

    def _match(self, points: F64, T_odom_base: Pose2, predicted: Pose2, covariance: F64) -> Match:
        p, gate, contradicted = self._parameters, self._gate, self._contradicted
        window = Window.from_covariance(predicted, covariance, p.window_sigmas, (p.window_min, p.window_min_angle))
        if self._refines and gate.usual is not None:
            refined = refine(points, self._field, window)
            self._evaluations += refined.evaluations
            is_fit = refined.fitness >= _AS_USUAL * gate.usual and gate.refusals == 0
            if is_fit and not contradicted.is_slipping and not window.has_on_border(refined.pose):
                return refined
        best = self._match_in(points, window)
        is_cut = contradicted.is_slipping or window.has_on_border(best.pose)
        if gate.fits_as_usual(best.fitness) and not is_cut:
            return best
        wide = window.at_least(p.wide_window, p.wide_window, p.wide_window_angle)
        match = self._match_in(points, wide)
        is_fit = gate.gives_way(best.fitness, match.fitness)
        is_better = is_cut and match.fitness > best.fitness
        if is_fit or (is_better and contradicted.is_seen(T_odom_base, match.pose, points)):
            return match
        x, y = contradicted.half_widths(predicted)
        if max(x, y) > p.wide_window:
            match = self._match_in(points, wide.at_least(window.half_x + x, window.half_y + y, wide.half_theta))
            is_fit = gate.gives_way(best.fitness, match.fitness)
            if is_fit and contradicted.is_seen(T_odom_base, match.pose, points):
                return match
        return best

    def _match_in(self, points: F64, window: Window) -> Match:
        match = self._matcher.match(points, self._field, window, self._rng)
        self._evaluations += match.evaluations
        if self._parameters.certify and match.certificate is None:
            return certify(match, points, self._field, window, self._parameters.certificate)
        return match

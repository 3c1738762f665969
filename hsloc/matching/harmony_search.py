"""Harmony Search over a box of poses ([P] III-B, [M] 4), and the frame it shares with HIDE."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import ceil, log, radians
from typing import TYPE_CHECKING, Annotated, ClassVar, Self

import numpy as np

from hsloc.kernels.fitness import normal_equations
from hsloc.kernels.search import STOPPED_AGREEMENT, Box, Found, SearchParameters, search, search_boxes
from hsloc.matching.covariance import match_covariance
from hsloc.matching.match import Match, StopReason
from hsloc.parameters import LARGEST, Count, CountOrNone, Parameters, Positive, Range, Ratio

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

    from hsloc.matching.likelihood_field import LikelihoodField
    from hsloc.matching.window import Window
    from hsloc.model.pose2 import Pose2

    F64 = NDArray[np.float64]

_GOLDEN = 0.6180339887498949
"""The golden ratio less 1, which spreads a sequence most evenly."""
_ALL = 10**9
"""Number of points that no scan has."""
_ONE_BASIN = 0.2 * 0.2 * radians(8.0)
"""Size of a window of +-0.2 m and 8 degrees (m^2 rad), about the basin of one optimum of an indoor scan. Internal:
`agreement` is what is to be set, this scales it with the window."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HarmonySearch(Parameters):
    """Harmony Search; the algorithm is its parameters.

    A memory of `memory_size` poses (HMS), the prediction first, the others uniform in the box. Each improvisation takes
    every coordinate from a random row with probability `consideration_rate` (HMCR), and then moves it by up to the
    bandwidth with probability PAR; otherwise it is uniform in the box. It replaces the worst row if it is fitter.
    PAR rises linearly from `par_min` to `par_max`, the bandwidth falls exponentially ([IHS]).

    Readings of the papers (design choices, all of them can be set):

    - `bandwidth_max`, `bandwidth_min`: with `relative_bandwidth` fractions of the window's half-width in each
      coordinate (8 -> 0.2 of [M], cm and degrees on windows of 30 cm, is 0.27 -> 0.007); without it metres and radians
      alike, as [P] prints them.
    - `budget` (NI, NFE) counts fitness evaluations, the initial ones included ([M]); with `count_improvisations` it
      counts improvisations alone, as the program of [P] does. The evaluations reported are the true number always.

    Ours, and off in the presets of the papers: `restarts` of the whole search, ended early when `agreement` of them
    found the same best pose (one more for each time the window is four times as large as +-0.2 m, 8 degrees);
    `search_points`, the maximum number of the scan's points, evenly chosen, while searching; `polish_iterations`
    Gauss-Newton steps on the interpolated field at the end of each restart, and for the winner on all points.
    """

    PAPER_BUDGET: ClassVar[int] = 250
    """NI of the scan matching in [P] and [M]."""

    memory_size: Annotated[int, Range(2, LARGEST)] = 30
    """Number of poses in the harmony memory (HMS)."""
    consideration_rate: Ratio = 0.88
    """Probability that a coordinate is taken from the memory (HMCR); otherwise it is uniform in the window."""
    par_min: Ratio = 0.55
    """Probability at the beginning that a coordinate from the memory is moved (PAR)."""
    par_max: Ratio = 0.98
    """Probability at the end that a coordinate from the memory is moved (PAR)."""
    bandwidth_max: Positive = 0.3
    """Maximum move of a coordinate at the beginning, as a ratio to the window's half-width or in metres and radians."""
    bandwidth_min: Positive = 0.003
    """Maximum move of a coordinate at the end, as a ratio to the window's half-width or in metres and radians."""
    relative_bandwidth: bool = True
    """Whether the bandwidths are ratios to the window's half-width; otherwise they are metres and radians alike."""
    budget: Count = 240
    """Number of fitness evaluations in each restart (NI, NFE)."""
    count_improvisations: bool = False
    """Whether the budget counts improvisations alone; otherwise it counts every fitness evaluation."""
    restarts: Count = 24
    """Maximum number of searches in a match."""
    agreement: Count = 2
    """Number of restarts with the same best pose that end a match; larger windows ask for more."""
    search_points: Count = 80
    """Maximum number of points of a scan that the search uses; the result is refined on all of them."""
    polish_iterations: CountOrNone = 15
    """Maximum number of Gauss-Newton steps at the end of each restart, and on all points at the end of a match."""

    @classmethod
    def paper(cls) -> Self:
        """[M] read in proportion: bandwidth 27 % -> 0.7 % of the half-width; one run, no polish, all points."""
        return replace(
            cls(),
            bandwidth_max=8.0 / 30.0,
            bandwidth_min=0.2 / 30.0,
            budget=cls.PAPER_BUDGET,
            restarts=1,
            agreement=1,
            search_points=_ALL,
            polish_iterations=0,
        )

    @classmethod
    def paper_literal(cls) -> Self:
        """[P] to the letter: bandwidth 8 -> 0.2 in metres and radians, 250 improvisations counted."""
        return replace(
            cls.paper(),
            bandwidth_max=8.0,
            bandwidth_min=0.2,
            relative_bandwidth=False,
            budget=250,
            count_improvisations=True,
        )

    def match(
        self,
        points: F64,
        field: LikelihoodField,
        window: Window,
        rng: Generator,
        *,
        keep_history: bool = False,
    ) -> Match:
        """See `Matcher`. With `keep_history` the Match has the best fitness after each evaluation."""
        return run_search(self, self._parameters(field, window), points, field, window, rng, keep_history)

    def match_boxes(
        self, points: F64, field: LikelihoodField, windows: list[Window], rng: Generator
    ) -> tuple[list[Pose2], F64, int]:
        """`match` in many windows of one size: the fittest pose in each, their fitness (n,), and the evaluations."""
        if not windows or len(points) == 0:
            return [window.centre for window in windows], np.zeros(len(windows)), 0
        scaled = field.scale(points[low_discrepancy_order(len(points))])
        cells = np.array([field.to_cells(window.centre) for window in windows])
        poses, fitness = np.empty_like(cells), np.empty(len(cells))
        evaluations = search_boxes(
            field.packed,
            scaled,
            scaled[: self.search_points],
            Box(cells, half_widths_in(field, windows[0]) * (1.0 / field.resolution, 1.0 / field.resolution, 1.0)),
            self._parameters(field, windows[0]),
            rng,
            poses,
            fitness,
        )
        return [field.from_cells(pose) for pose in poses], fitness, int(evaluations)

    def _differential_evolution(self) -> tuple[int, float, float]:
        """HRT, lambda and F: none in plain Harmony Search."""
        return 0, 0.0, 0.0

    def _parameters(self, field: LikelihoodField, window: Window) -> SearchParameters:
        scale = np.array((1.0 / field.resolution, 1.0 / field.resolution, 1.0))
        if self.relative_bandwidth:
            scale *= half_widths_in(field, window)
        widest = scale * self.bandwidth_max
        passes, attraction, weight = self._differential_evolution()
        return SearchParameters(
            memory_size=self.memory_size,
            consideration_rate=self.consideration_rate,
            par_min=self.par_min,
            par_max=self.par_max,
            bandwidth_max=(float(widest[0]), float(widest[1]), float(widest[2])),
            bandwidth_ratio=self.bandwidth_min / self.bandwidth_max,
            improvisations_per_pass=passes,
            attraction=attraction,
            differential_weight=weight,
            budget=self.budget,
            count_improvisations=self.count_improvisations,
            restarts=self.restarts,
            agreement=self.agreement + _more_to_agree(window),
            polish_iterations=self.polish_iterations,
        )


def half_widths_in(field: LikelihoodField, window: Window) -> F64:
    """Half-widths of the window along the axes of the field, which may be turned in the map."""
    half = window.half_widths()
    c, s = abs(np.cos(field.T_map_field.theta)), abs(np.sin(field.T_map_field.theta))
    return np.array((c * half[0] + s * half[1], s * half[0] + c * half[1], half[2]))


def low_discrepancy_order(n: int) -> NDArray[np.int64]:
    """An order of n beams in which every beginning is spread evenly over the turn (golden-ratio sequence)."""
    return np.argsort((np.arange(n) * _GOLDEN) % 1.0, kind="stable")


def run_search(
    matcher: HarmonySearch,
    parameters: SearchParameters,
    points: F64,
    field: LikelihoodField,
    window: Window,
    rng: Generator,
    keep_history: bool,
) -> Match:
    """Scale to cells, search, and convert the result to metres."""
    half = half_widths_in(field, window)
    if len(points) == 0:
        return Match(window.centre, 0.0, np.diag(half**2 / 3.0), 0, StopReason.NO_POINTS)
    scaled = field.scale(points[low_discrepancy_order(len(points))])
    few = scaled[: matcher.search_points]
    pose = np.empty(3)
    information = np.zeros((3, 3))
    history = np.full(most_evaluations(parameters) if keep_history else 0, np.nan)
    fitness, evaluations, restarts, stopped = search(
        field.packed,
        scaled,
        few,
        Box(field.to_cells(window.centre), half * (1.0 / field.resolution, 1.0 / field.resolution, 1.0)),
        parameters,
        rng,
        Found(pose, information, history),
    )
    if parameters.polish_iterations == 0:
        information = information_at(field, scaled, pose)
    return Match(
        pose=field.from_cells(pose),
        fitness=float(fitness),
        covariance=match_covariance(information, len(points), fitness, field, window),
        evaluations=int(evaluations),
        stopped=StopReason.AGREEMENT if stopped == STOPPED_AGREEMENT else StopReason.BUDGET,
        restarts=int(restarts),
        history=history[~np.isnan(history)] / len(few) if keep_history else None,
    )


def most_evaluations(parameters: SearchParameters) -> int:
    """No restart evaluates more often before its polish, whatever the budget counts."""
    hrt = parameters.improvisations_per_pass
    passes = -(-parameters.budget // hrt) if hrt > 0 else 0
    return parameters.budget + parameters.memory_size * (1 + passes)


def _more_to_agree(window: Window) -> int:
    """A larger window holds more false optima, and the same one is found twice by chance more often."""
    size = window.half_x * window.half_y * window.half_theta / _ONE_BASIN
    return max(ceil(log(size, 4.0)), 0) if size > 0.0 else 0


def information_at(field: LikelihoodField, scaled: NDArray[np.float32], pose: F64) -> F64:
    """Sum of J^T J of the scores of scaled points at a pose in cells, shape (3, 3)."""

    information = np.zeros((3, 3))
    normal_equations(field.packed, scaled, pose[0], pose[1], pose[2], information, np.zeros(3))
    return information

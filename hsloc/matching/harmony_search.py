"""Harmony Search over a box of poses ([P] III-B, [M] 4), and the frame it shares with HIDE."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import ceil, log, radians
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from hsloc.errors import ConfigError
from hsloc.kernels.fitness import normal_equations
from hsloc.kernels.search import STOPPED_AGREEMENT, SearchParameters, search, search_boxes
from hsloc.matching.covariance import match_covariance
from hsloc.matching.match import Match, StopReason

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

    from hsloc.matching.likelihood_field import LikelihoodField
    from hsloc.matching.window import Window
    from hsloc.model.pose2 import Pose2

    F64 = NDArray[np.float64]

_GOLDEN = 0.6180339887498949
_ALL = 10**9
_ONE_BASIN = 0.2 * 0.2 * radians(8.0)
"""A window of +-0.2 m and 8 degrees, m^2 rad: about what one optimum of an indoor scan draws in."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HarmonySearch:
    """Harmony Search; the algorithm is its parameters.

    A memory of `memory_size` poses (HMS), the prediction first, the others uniform in the box. Each improvisation takes
    every coordinate from a random row with probability `consideration_rate` (HMCR), and then moves it by up to the
    bandwidth with probability PAR; otherwise it draws it anew. It replaces the worst row if it is fitter.
    PAR rises linearly from `par_min` to `par_max`, the bandwidth falls exponentially ([IHS]).

    Readings of the papers (design choices, all of them can be set):

    - `bandwidth_max`, `bandwidth_min`: with `relative_bandwidth` fractions of the window's half-width in each
      coordinate (8 -> 0.2 of [M], cm and degrees on windows of 30 cm, is 0.27 -> 0.007); without it metres and radians
      alike, as [P] prints them.
    - `budget` (NI, NFE) counts fitness evaluations, the initial ones included ([M]); with `count_improvisations` it
      counts improvisations alone, as the program of [P] does. The evaluations reported are the true number always.

    Ours, and off in the presets of the papers: `restarts` of the whole search, ended early when `agreement` of them
    found the same best pose (one more for each time the window is four times as large as +-0.2 m, 8 degrees);
    `search_points`, at most so many of the scan's points, evenly chosen, while searching; `polish_iterations`
    Gauss-Newton steps on the interpolated field at the end of each restart, and for the winner on all points.
    """

    PAPER_BUDGET: ClassVar[int] = 250
    """NI of the scan matching in [P] and [M]."""

    memory_size: int = 30
    consideration_rate: float = 0.88
    par_min: float = 0.55
    par_max: float = 0.98
    bandwidth_max: float = 0.3
    bandwidth_min: float = 0.003
    relative_bandwidth: bool = True
    budget: int = 240
    count_improvisations: bool = False
    restarts: int = 24
    agreement: int = 2
    search_points: int = 80
    polish_iterations: int = 15

    def __post_init__(self) -> None:
        check(self.memory_size >= 2, "memory_size", self.memory_size, "at least 2")
        for name in ("consideration_rate", "par_min", "par_max"):
            check(0.0 <= getattr(self, name) <= 1.0, name, getattr(self, name), "in [0, 1]")
        check(self.bandwidth_max > 0.0, "bandwidth_max", self.bandwidth_max, "positive")
        check(self.bandwidth_min > 0.0, "bandwidth_min", self.bandwidth_min, "positive")
        for name in ("budget", "restarts", "agreement", "search_points"):
            check(getattr(self, name) >= 1, name, getattr(self, name), "at least 1")
        check(self.polish_iterations >= 0, "polish_iterations", self.polish_iterations, "0 or more")

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
        """See `Matcher`. With `keep_history` the Match tells the best fitness after each evaluation."""
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
            cells,
            half_widths_in(field, windows[0]) * (1.0 / field.resolution, 1.0 / field.resolution, 1.0),
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


def check(ok: bool, name: str, value: object, rule: str) -> None:
    """Raise ConfigError for a parameter outside its range."""
    if not ok:
        raise ConfigError(f"matcher: {name} is {value}; it must be {rule}")


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
    """Scale to cells, search, and dress the answer."""
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
        field.to_cells(window.centre),
        half * (1.0 / field.resolution, 1.0 / field.resolution, 1.0),
        parameters,
        rng,
        pose,
        information,
        history,
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

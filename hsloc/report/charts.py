"""The curves over time that the reports show, each with what it is and what is usual."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hsloc.model import Status
from hsloc.report.data import Curve

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from hsloc.report.data import ReportData

    Floats = NDArray[np.float64]
    Spans = tuple[tuple[float, float], ...]


LOG_ABOVE = 25.0
"""A curve whose highest value is this many times its median is drawn on a logarithmic scale."""


@dataclass(frozen=True, slots=True, eq=False)
class Chart:
    """A curve with its heading. The curve breaks at NaN; `marks` are single points, shown as crosses."""

    name: str
    """Its key in the page."""
    title: str
    unit: str
    """Empty for a number without one."""
    curve: Curve
    explanation: str
    """What it is and what is usual."""
    top: float | None = None
    """The highest value of the axis; None: that of the curve."""
    marks: Curve | None = None
    over_time: bool = True
    """Over seconds since the first pose; else over numbers of fitness evaluations."""

    @property
    def is_logarithmic(self) -> bool:
        """Whether the highest value is so far above the median that only powers of ten show both."""
        known = self.curve.values[np.isfinite(self.curve.values)]
        if self.top is not None or not len(known):
            return False
        middle = float(np.median(known))
        return middle > 0.0 and float(known.max()) > LOG_ABOVE * middle


def run_charts(data: ReportData) -> list[Chart]:
    """What is known over time: errors where there is a reference, distance to the map, certainty of a localiser.

    The fitness of a mapper is not among them: it is that on a map of the last few scans, and says little of the whole.
    """
    charts = []
    if data.errors is not None:
        in_cm = _scaled(data.errors.translation_m, 100.0)
        charts.append(Chart("error_cm", "Translation error", "cm", in_cm, _ERROR))
        charts.append(Chart("error_deg", "Rotation error", "°", data.errors.rotation_deg, _ERROR))
    if data.far is not None:
        charts.append(Chart("far_cm", "Scan to map, 90 % of points", "cm", _scaled(data.far, 100.0), _FAR))
    scans = data.scans
    if scans is not None:
        about = _SIGMA_BUILT if data.is_built else _SIGMA
        sigma = Curve(scans.seconds, scans.sigma_m * 100.0)
        charts.append(Chart("sigma_cm", "Standard deviation of the position", "cm", sigma, about))
        sigma = Curve(scans.seconds, scans.sigma_deg)
        charts.append(Chart("sigma_deg", "Standard deviation of the heading", "°", sigma, about))
    if scans is not None and not data.is_built:
        refused = scans.where(Status.REJECTED) & np.isfinite(scans.fitness)
        fitness = Curve(scans.seconds, np.where(refused, np.nan, scans.fitness))
        marks = Curve(scans.seconds[refused], scans.fitness[refused])
        charts.append(Chart("fitness", "Fitness of the match", "", fitness, _FITNESS, top=1.0, marks=marks))
    return [_without_gaps(chart, data.lost) for chart in charts if np.isfinite(chart.curve.values).any()]


_ERROR = "Distance, or angle, to the reference pose at the same time. Steps and peaks show where the pose was wrong."
_FAR = (
    "Nine of ten points of a scan are nearer to a wall of the map than this. One or two cells are usual; a peak is a "
    "wrong pose, a place that has changed, or people around the robot."
)
_SIGMA = (
    "What the localiser itself expects its error to be. It grows where no scan determines the pose, as in a corridor."
)
_SIGMA_BUILT = (
    "How well the pose is known relative to the first one, by the walls, steps and loops that hold it. It grows with "
    "the way to the start, and falls where a loop is closed."
)
_FITNESS = "How well the scan lies on the map, from 0 to 1. Above 0.8 is usual; crosses are matches that were refused."


def convergence_charts(convergence: Mapping[str, tuple[Floats, Floats]]) -> list[Chart]:
    """How fast the search finds the pose: curves over the number of evaluations."""
    return [
        Chart(
            f"convergence{index}",
            f"Convergence: {name}",
            "median best fitness over evaluations",
            Curve(np.asarray(evaluations, dtype=np.float64), np.asarray(fitness, dtype=np.float64)),
            "Best fitness after this number of evaluations, in searches of some scans of this run from a shifted "
            "start. Where the curve is flat, a larger budget does not help.",
            top=1.0,
            over_time=False,
        )
        for index, (name, (evaluations, fitness)) in enumerate(convergence.items())
        if len(evaluations)
    ]


def _scaled(curve: Curve, factor: float) -> Curve:
    return Curve(curve.seconds, curve.values * factor)


def _without_gaps(chart: Chart, lost: Spans) -> Chart:
    """Without the NaN of scans that were not matched; where the pose was lost the line still breaks."""
    curve, known = chart.curve, np.isfinite(chart.curve.values)
    seconds, values = curve.seconds[known], curve.values[known]
    for begin, until in lost:
        if not ((seconds >= begin) & (seconds < until)).any():
            row = int(np.searchsorted(seconds, begin))
            seconds, values = np.insert(seconds, row, begin), np.insert(values, row, np.nan)
    return replace(chart, curve=Curve(seconds, values))

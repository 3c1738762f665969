"""What a report shows, made ready once for the picture (report.png) and for the page (report.html)."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hsloc.errors import EvaluationError
from hsloc.evaluation.association import interpolate_poses
from hsloc.evaluation.metrics import compare
from hsloc.model import IDENTITY, Pose2, Status, Trajectory
from hsloc.model.pose2 import compose_poses
from hsloc.trajectory_io.tum import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from hsloc.evaluation.metrics import Comparison
    from hsloc.model import ScanDiagnostics

    Floats = NDArray[np.float64]


LOG_ABOVE = 25.0
"""A curve whose highest value is this many times its median is drawn on a logarithmic scale."""


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """Values over seconds since the start, in order of time: two columns of length n."""

    seconds: Floats
    values: Floats

    def thinned(self, most: int) -> Curve:
        """At most about `most` points, of which each stretch's lowest and highest are kept: no peak is lost."""
        n = len(self.seconds)
        if n <= most:
            return self
        edges = np.linspace(0, n, max(most // 2, 1) + 1).astype(int)
        start, stretch = edges[:-1], np.repeat(np.arange(len(edges) - 1), np.diff(edges))
        known = np.isfinite(self.values)
        # By stretch, and within it by value; the sort is stable, so that of equal values the first counts.
        lowest, highest = (
            np.lexsort((np.where(known, sign * self.values, np.inf), stretch))[start] for sign in (1.0, -1.0)
        )
        nothing = ~np.logical_or.reduceat(known, start)
        lowest[nothing] = highest[nothing] = start[nothing]
        rows = np.unique(np.concatenate(([0, n - 1], lowest, highest)))
        return Curve(self.seconds[rows], self.values[rows])


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
    """Errors against the reference over time: metres and degrees; and of odometry alone, if there is any."""

    translation_m: Curve
    rotation_deg: Curve
    comparison: Comparison
    odometry_alone: Comparison | None


@dataclass(frozen=True, slots=True, eq=False)
class Scans:
    """What became of the scans, over time. `xy` (n, 2) is where the robot then was on its trajectory."""

    seconds: Floats
    status: tuple[str, ...]
    reason: tuple[str, ...]
    fitness: Floats
    sigma_m: Floats
    sigma_deg: Floats
    evaluations: NDArray[np.int64]
    xy: Floats
    lost: tuple[tuple[float, float], ...]

    def where(self, *statuses: str) -> NDArray[np.bool_]:
        """Which scans have one of these statuses."""
        return np.array([status in statuses for status in self.status], dtype=bool)


@dataclass(frozen=True, slots=True, eq=False)
class ReportData:
    """Everything in the frame of the map: metres, and seconds since the first pose.

    `path` (n, 2) and `seconds` (n,) are the trajectory as it came; `believed` (n,) says where the robot knew its
    pose. `odometry` sets out from the trajectory's first such pose; `reference` has been moved onto the
    trajectory where an alignment was asked for.
    """

    path: Floats
    seconds: Floats
    believed: NDArray[np.bool_]
    duration_s: float
    length_m: float
    odometry: Floats | None
    reference: Floats | None
    errors: Errors | None
    scans: Scans | None


def prepare(
    trajectory: Trajectory,
    odometry: Trajectory | None,
    reference: Trajectory | None,
    diagnostics: ScanDiagnostics | None,
    metrics: Mapping[str, object],
) -> ReportData:
    """Make ready what a report shows; where reference and trajectory do not meet in time there are no errors."""
    start_ns = int(trajectory.stamps_ns.min()) if len(trajectory) else _first(diagnostics)
    seconds = _since(trajectory.stamps_ns, start_ns)
    scans = None if diagnostics is None or not len(diagnostics) else _scans(diagnostics, trajectory, start_ns)
    believed = np.ones(len(trajectory), dtype=bool)
    for begin, end in () if scans is None else scans.lost:
        believed &= (seconds < begin) | (seconds >= end)
    placed = None if odometry is None else start_together(odometry, trajectory, believed)
    errors = None if reference is None else _errors(trajectory, placed, reference, metrics, start_ns)
    T_map_reference = IDENTITY if errors is None else errors.comparison.T_reference_estimate.inverse()
    return ReportData(
        path=trajectory.poses[:, :2],
        seconds=seconds,
        believed=believed,
        duration_s=float(seconds.max() - seconds.min()) if len(seconds) else 0.0,
        length_m=trajectory.length(),
        odometry=None if placed is None else placed.poses[:, :2],
        reference=None if reference is None else T_map_reference @ reference.poses[:, :2],
        errors=errors,
        scans=scans,
    )


def start_together(odometry: Trajectory, trajectory: Trajectory, believed: NDArray[np.bool_]) -> Trajectory:
    """Odometry moved as a whole, so that it agrees with the first pose in time that was believed.

    Of a trajectory that never was, with its first pose.
    """
    if not len(odometry) or not len(trajectory):
        return odometry
    rows = np.flatnonzero(believed) if believed.any() else np.arange(len(trajectory))
    row = int(rows[np.argmin(trajectory.stamps_ns[rows])])
    there = interpolate_poses(odometry, trajectory.stamps_ns[row : row + 1])[0]
    T_map_odom = Pose2.from_array(trajectory.poses[row]) @ Pose2.from_array(there).inverse()
    return Trajectory(odometry.stamps_ns, compose_poses(T_map_odom.to_array(), odometry.poses))


def status_counts(scans: Scans) -> dict[str, int]:
    """How many scans had each status, in the order in which `Status` lists them."""
    counts = Counter(scans.status)
    known = [status.value for status in Status]
    return {name: counts[name] for name in (*known, *sorted(set(counts) - set(known))) if counts[name]}


def reason_counts(scans: Scans) -> list[tuple[str, str, int]]:
    """(status, reason, how many scans) for all scans that were not used, the most frequent first.

    Reasons that differ in their figures alone are one; the first of them stands for the others.
    """
    skipped: dict[tuple[str, str], list[str]] = {}
    for status, reason in zip(scans.status, scans.reason, strict=True):
        if reason or status in (Status.REJECTED, Status.NO_RETURNS, Status.SEARCHING):
            skipped.setdefault((status, _FIGURES.sub("…", reason)), []).append(reason)
    counts = [
        (status, kind if len(set(reasons)) > 1 else reasons[0], reasons[0], len(reasons))
        for (status, kind), reasons in skipped.items()
    ]
    counts.sort(key=lambda entry: (-entry[3], entry[:2]))
    return [
        (status, reason if reason == example else f"{reason} (first: {example})", count)
        for status, reason, example, count in counts
    ]


_FIGURES = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


def _first(diagnostics: ScanDiagnostics | None) -> int:
    return int(diagnostics.stamps_ns.min()) if diagnostics is not None and len(diagnostics) else 0


def _since(stamps_ns: NDArray[np.int64], start_ns: int) -> Floats:
    result: Floats = (stamps_ns - start_ns) / NS_PER_S
    return result


def _errors(
    trajectory: Trajectory,
    odometry: Trajectory | None,
    reference: Trajectory,
    metrics: Mapping[str, object],
    start_ns: int,
) -> Errors | None:
    limit = metrics.get("t_max_diff")
    alignment = metrics.get("alignment")
    method = "interpolation" if metrics.get("association") == "interpolation" else "nearest"
    options = {
        "max_difference_s": limit if isinstance(limit, float) else 0.01,
        "alignment": alignment if isinstance(alignment, str) else "none",
        "association": method,
    }
    try:
        found = compare(trajectory, reference, **options)  # type: ignore[arg-type]
    except EvaluationError:
        return None
    alone = None
    if odometry is not None:
        try:
            alone = compare(odometry, reference, **options)  # type: ignore[arg-type]
        except EvaluationError:
            alone = None
    order = np.argsort(found.pairs.stamps_ns, kind="stable")
    seconds = _since(found.pairs.stamps_ns, start_ns)[order]
    return Errors(
        Curve(seconds, found.errors.trans_part[order]), Curve(seconds, found.errors.angle_deg[order]), found, alone
    )


def _scans(diagnostics: ScanDiagnostics, trajectory: Trajectory, start_ns: int) -> Scans:
    order = np.argsort(diagnostics.stamps_ns, kind="stable")
    stamps = diagnostics.stamps_ns[order]
    seconds = _since(stamps, start_ns)
    status = tuple(str(diagnostics.status[row]) for row in order)
    sigma = diagnostics.sigma[order]
    xy = interpolate_poses(trajectory, stamps)[:, :2] if len(trajectory) else np.full((len(stamps), 2), np.nan)
    return Scans(
        seconds=seconds,
        status=status,
        reason=tuple(diagnostics.reason[row] for row in order),
        fitness=diagnostics.fitness[order],
        sigma_m=np.hypot(sigma[:, 0], sigma[:, 1]),
        sigma_deg=np.degrees(sigma[:, 2]),
        evaluations=diagnostics.evaluations[order],
        xy=xy,
        lost=_lost_spans(seconds, status),
    )


def _lost_spans(seconds: Floats, status: tuple[str, ...]) -> tuple[tuple[float, float], ...]:
    """From each first scan that did not know its pose to the next that did."""
    spans = []
    begin = None
    for second, name in zip(seconds.tolist(), status, strict=True):
        if name == Status.SEARCHING and begin is None:
            begin = second
        elif name != Status.SEARCHING and begin is not None:
            spans.append((begin, second))
            begin = None
    if begin is not None:
        spans.append((begin, float("inf")))
    return tuple(spans)

"""What a report shows, prepared once for report.png and report.html."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from hsloc.evaluation.association import interpolate_poses
from hsloc.model import IDENTITY, Status
from hsloc.report.table import format_probability
from hsloc.trajectory_io.tum import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from hsloc.analysis.map_changes import SeenChanges
    from hsloc.analysis.scan_statistics import Coverage, ScanOverlay
    from hsloc.evaluation import Comparison
    from hsloc.model import OccupancyGrid, ScanDiagnostics, Trajectory
    from hsloc.model.estimate import Ambiguity
    from hsloc.run_metrics import RunMetrics
    from hsloc.slam.result import MappingResult

    Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Provenance:
    """What it takes to repeat the run: the command as typed, the effective configuration as text, the versions
    of the programs, and the sha256 of the input files, both by name; and the options that decide its result, but for
    the seed and the configuration, the same wherever the files are.
    """

    command: str = ""
    config: str = ""
    versions: Mapping[str, str] = field(default_factory=dict)
    hashes: Mapping[str, str] = field(default_factory=dict)
    options: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ReportParts:
    """The parts of a run that report.png and report.html show. All but title and trajectory may be missing.

    All poses are in the map frame, but for the reference, which `comparison` aligns.
    """

    title: str
    """Name of the run: the names of its logs."""
    trajectory: Trajectory
    """The estimated poses."""
    odometry: Trajectory | None = None
    """The odometry, moved as a whole into the map frame."""
    reference: Trajectory | None = None
    """The reference in its own frame."""
    grid: OccupancyGrid | None = None
    """The map that was used or built."""
    diagnostics: ScanDiagnostics | None = None
    """What became of each scan."""
    metrics: RunMetrics | None = None
    """All figures."""
    comparison: Comparison | None = None
    """Pairs of trajectory and reference, which give the error curves; without it there are no errors."""
    localised: NDArray[np.bool_] | None = None
    """Which poses (n,) are known; without it this is derived from the diagnostics."""
    states: tuple[str, ...] | None = None
    """State of each pose, of a localiser that judges them (n)."""
    covariances: Floats | None = None
    """Covariance (n, 3, 3) of each pose over x, y, theta (m^2, m rad, rad^2); NaN where unknown."""
    overlay: ScanOverlay | None = None
    """The scans, to be drawn on the map."""
    coverage: Coverage | None = None
    """By how many scans each place of the map was seen."""
    map_changes: SeenChanges | None = None
    """What changed since the given map was made."""
    mapping: MappingResult | None = None
    """Loops and keyscans of a map that the run built."""
    points: Floats | None = None
    """Points (n, 2) that are drawn as a map [m]."""
    provenance: Provenance = field(default_factory=Provenance)
    """How to repeat the run."""
    ambiguities: tuple[Ambiguity, ...] = ()
    """Stretches in which several places of the map fit."""
    convergence: Mapping[str, tuple[Floats, Floats]] = field(default_factory=dict)
    """By heading, the best fitness over the number of evaluations: two arrays (n,) each."""


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """Values over seconds since the start, in order of time: two columns of length n."""

    seconds: Floats
    values: Floats

    def thinned(self, most: int) -> Curve:
        """At most about `most` points, of which each stretch's lowest and highest are kept: no peak is lost."""
        rows = peak_rows(self.values, most)
        return Curve(self.seconds[rows], self.values[rows])


def peak_rows(values: Floats, most: int) -> NDArray[np.intp]:
    """Rows of at most about `most` of n values in order: the lowest and highest of each stretch, and both ends."""
    n = len(values)
    if n <= most:
        return np.arange(n)
    edges = np.linspace(0, n, max(most // 2, 1) + 1).astype(int)
    start, stretch = edges[:-1], np.repeat(np.arange(len(edges) - 1), np.diff(edges))
    known = np.isfinite(values)
    # By stretch, and within it by value; the sort is stable, so that of equal values the first counts.
    lowest, highest = (np.lexsort((np.where(known, sign * values, np.inf), stretch))[start] for sign in (1.0, -1.0))
    nothing = ~np.logical_or.reduceat(known, start)
    lowest[nothing] = highest[nothing] = start[nothing]
    return np.unique(np.concatenate(([0, n - 1], lowest, highest)))


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
    """Errors against the reference over time, in metres and degrees."""

    translation_m: Curve
    rotation_deg: Curve


@dataclass(frozen=True, slots=True, eq=False)
class Scans:
    """What became of the scans, over time. `xy` (n, 2) is where the robot then was on its trajectory."""

    seconds: Floats
    status: tuple[str, ...]
    reason: tuple[str, ...]
    fitness: Floats
    sigma_m: Floats
    sigma_deg: Floats
    xy: Floats

    def where(self, *statuses: str) -> NDArray[np.bool_]:
        """Which scans have one of these statuses."""
        return np.array([status in statuses for status in self.status], dtype=bool)


@dataclass(frozen=True, slots=True, eq=False)
class ReportData:
    """Everything in the frame of the map: metres, and seconds since `start_ns`.

    `start_ns` is the stamp of the first pose, without poses that of the first scan. `path` (n, 2) and `seconds` (n,)
    are the trajectory; `localised` (n,) marks its known poses. `reference` has been moved onto the trajectory where an
    alignment was asked for.
    """

    start_ns: int
    path: Floats
    seconds: Floats
    localised: NDArray[np.bool_]
    duration_s: float
    length_m: float
    odometry: Floats | None
    reference: Floats | None
    errors: Errors | None
    scans: Scans | None
    lost: tuple[tuple[float, float], ...]
    """Spans (begin, end) in which the pose was not known [s]."""
    jumps: NDArray[np.bool_]
    """Poses (n,) to which no line leads from the one before: the estimate jumped, or nothing was recorded between."""
    reference_jumps: NDArray[np.bool_] | None
    """The same of the reference."""
    far: Curve | None
    """Distance to the map that nine of ten points of each scan stay below [m]."""
    loops: Floats | None
    """Both ends (k, 2, 2) of the loops that were closed [m]."""
    is_built: bool
    """Whether the map was built by the run."""
    ambiguities: tuple[Ambiguity, ...] = ()
    """Stretches in which several places of the map fit, the longest `MOST_AMBIGUITIES`, in order of time."""

    @property
    def places(self) -> Floats:
        """Positions (k, 2) of these places [m]."""
        xy = [(place.pose.x, place.pose.y) for each in self.ambiguities for place in each.places]
        return np.array(xy, dtype=np.float64).reshape(-1, 2)

    @property
    def place_labels(self) -> list[list[str]]:
        """For each stretch what is written at its places: the probability, and the time where there are several."""
        found = []
        for each in self.ambiguities:
            at = "" if len(self.ambiguities) == 1 else f" at {(each.stamp_ns - self.start_ns) / NS_PER_S:.0f} s"
            found.append([format_probability(place.probability) + at for place in each.places])
        return found


MOST_AMBIGUITIES = 6
"""Stretches whose places are drawn: a map with more arrows shows none."""
_JUMP_M, _JUMP_SPEED = 0.5, 10.0
"""A step that is longer than this [m] and would have needed this speed [m/s] is no motion of a ground robot."""
_PAUSE_S, _PAUSE_STEPS = 2.0, 10.0
"""A time without poses that is longer than this [s] and than this number of usual steps is a gap in the recording."""


def jumps_of(stamps_ns: NDArray[np.int64], poses: Floats) -> NDArray[np.bool_]:
    """Which of n poses (n, 3) the robot cannot have driven to, or is not known to have, from the one before."""
    found = np.zeros(len(poses), dtype=bool)
    if len(poses) < 2:
        return found
    seconds = np.diff(stamps_ns) / NS_PER_S
    length = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    usual = float(np.median(np.abs(seconds)))
    too_fast = length > _JUMP_SPEED * np.abs(seconds)
    paused = np.abs(seconds) > max(_PAUSE_S, _PAUSE_STEPS * usual)
    found[1:] = (length > _JUMP_M) & (too_fast | paused)
    return found


def with_gaps(xy: Floats, jumps: NDArray[np.bool_] | None) -> Floats:
    """A path (n, 2) with a row of NaN before each jump."""
    rows = np.zeros(0, dtype=np.intp) if jumps is None else np.flatnonzero(jumps)
    return np.insert(xy, rows, np.nan, axis=0)


def prepare(parts: ReportParts) -> ReportData:
    """Prepare what a report shows."""
    trajectory, reference, odometry = parts.trajectory, parts.reference, parts.odometry
    diagnostics, comparison, localised = parts.diagnostics, parts.comparison, parts.localised
    start_ns = int(trajectory.stamps_ns.min()) if len(trajectory) else _first(diagnostics)
    seconds = since(trajectory.stamps_ns, start_ns)
    scans = None if diagnostics is None or not len(diagnostics) else _scans(diagnostics, trajectory, start_ns)
    if localised is None:
        localised = np.ones(len(trajectory), dtype=bool)
        for begin, end in () if scans is None else _searched(scans):
            localised &= (seconds < begin) | (seconds >= end)
    T_map_reference = IDENTITY if comparison is None else comparison.T_reference_estimate.inverse()
    return ReportData(
        start_ns=start_ns,
        path=trajectory.poses[:, :2],
        seconds=seconds,
        localised=localised,
        duration_s=float(seconds.max() - seconds.min()) if len(seconds) else 0.0,
        length_m=trajectory.length(),
        odometry=None if odometry is None else odometry.poses[:, :2],
        reference=None if reference is None else T_map_reference @ reference.poses[:, :2],
        errors=None if comparison is None else _errors(comparison, start_ns),
        scans=scans,
        lost=_lost_spans(seconds, localised),
        jumps=jumps_of(trajectory.stamps_ns, trajectory.poses),
        reference_jumps=None if reference is None else jumps_of(reference.stamps_ns, reference.poses),
        far=None if parts.overlay is None else _far(parts.overlay, start_ns),
        loops=None if parts.mapping is None else _closed(parts.mapping),
        is_built=parts.metrics is not None and parts.metrics.run.mode == "slam",
        ambiguities=_longest(parts.ambiguities),
    )


def _longest(ambiguities: Sequence[Ambiguity]) -> tuple[Ambiguity, ...]:
    longest = sorted(ambiguities, key=lambda each: each.begin_ns - each.end_ns)[:MOST_AMBIGUITIES]
    return tuple(sorted(longest, key=lambda each: each.begin_ns))


def _closed(mapping: MappingResult) -> Floats:
    """Positions (k, 2, 2) of the submaps that accepted loops join."""
    accepted = np.array([loop.accepted for loop in mapping.loops], dtype=bool)
    return mapping.keyscan_poses[mapping.loop_ends()[accepted], :2]


def _far(overlay: ScanOverlay, start_ns: int) -> Curve:
    order = np.argsort(overlay.stamps_ns, kind="stable")
    return Curve(since(overlay.stamps_ns, start_ns)[order], overlay.far[order])


def status_counts(scans: Scans) -> dict[str, int]:
    """How many scans had each status, in the order in which `Status` lists them."""
    counts = Counter(scans.status)
    known = [status.value for status in Status]
    return {name: counts[name] for name in (*known, *sorted(set(counts) - set(known))) if counts[name]}


def reason_counts(scans: Scans) -> list[tuple[str, str, int]]:
    """(status, reason, how many scans) for all scans that were not used, the most frequent first.

    Reasons that differ in their figures alone are one; the first is the example.
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


def since(stamps_ns: NDArray[np.int64], start_ns: int) -> Floats:
    """Seconds (n,) from `start_ns` to each stamp (n,)."""
    result: Floats = (stamps_ns - start_ns) / NS_PER_S
    return result


def _errors(comparison: Comparison, start_ns: int) -> Errors:
    order = np.argsort(comparison.pairs.stamps_ns, kind="stable")
    seconds = since(comparison.pairs.stamps_ns, start_ns)[order]
    errors = comparison.errors
    return Errors(Curve(seconds, errors.trans_part[order]), Curve(seconds, errors.angle_deg[order]))


def _scans(diagnostics: ScanDiagnostics, trajectory: Trajectory, start_ns: int) -> Scans:
    order = np.argsort(diagnostics.stamps_ns, kind="stable")
    stamps = diagnostics.stamps_ns[order]
    seconds = since(stamps, start_ns)
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
        xy=xy,
    )


def _searched(scans: Scans) -> list[tuple[float, float]]:
    """From each first scan that did not know its pose to the next that did."""
    spans = []
    begin = None
    for second, name in zip(scans.seconds.tolist(), scans.status, strict=True):
        if name == Status.SEARCHING and begin is None:
            begin = second
        elif name != Status.SEARCHING and begin is not None:
            spans.append((begin, second))
            begin = None
    if begin is not None:
        spans.append((begin, float("inf")))
    return spans


def _lost_spans(seconds: Floats, localised: NDArray[np.bool_]) -> tuple[tuple[float, float], ...]:
    """From each first pose that is not known to the next that is, else to the last."""
    order = np.argsort(seconds, kind="stable")
    times, known = seconds[order], localised[order]
    edges = np.flatnonzero(np.diff(np.concatenate(([True], known, [True])).astype(np.int8)))
    return tuple(
        (float(times[first]), float(times[min(end, len(times) - 1)])) for first, end in edges.reshape(-1, 2).tolist()
    )

"""`analyse`: from the result of a run to its metrics, its comparison with the reference, and its warnings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hsloc.analysis.map_changes import MapChangeFinder
from hsloc.analysis.metrics import (
    certificate_metrics,
    evaluation_counts,
    fitness_metrics,
    localised_metrics,
    log_metrics,
    loss_metrics,
    map_metrics,
    run_identity,
    scan_counts,
)
from hsloc.analysis.quality import change_warnings, offset_warnings, quality_warnings, verdict_reasons
from hsloc.analysis.scan_statistics import (
    ConvergenceSample,
    CoverageCounter,
    ExtrinsicsCheck,
    Residuals,
    ScanOverlayBuilder,
)
from hsloc.analysis.second_pass import posed_events
from hsloc.errors import EvaluationError
from hsloc.evaluation import evaluate_relations, read_relations
from hsloc.evaluation.association import interpolate_poses
from hsloc.evaluation.error_metrics import ErrorMetrics
from hsloc.evaluation.metrics import compare_run
from hsloc.matching.harmony_search import HarmonySearch
from hsloc.matching.likelihood_field import LikelihoodField
from hsloc.model.events import PairedScan
from hsloc.model.pose2 import Pose2, compose_poses
from hsloc.model.trajectory import Trajectory
from hsloc.model.verdict import verdict_of
from hsloc.run_metrics import RunMetrics
from hsloc.trajectory_io.tum import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from hsloc.analysis.map_changes import SeenChanges
    from hsloc.analysis.scan_statistics import Coverage, ScanOverlay
    from hsloc.analysis.second_pass import PosedEvent
    from hsloc.evaluation import Comparison, RelationsResult
    from hsloc.replay.run import Result
    from hsloc.warnings import RunWarning

    Convergence = dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]


_SAME_STAMP_NS = 1000
"""Difference of stamps that are the same: files state seconds with six decimals."""


@dataclass(frozen=True, slots=True, eq=False)
class Analysis:
    """What the result of a run shows.

    `comparison` pairs the trajectory with the reference, and `odometry_alone` the odometry: None where there is no
    reference, or where they do not meet in time. `odometry` is the odometry in the frame of the map, moved as a whole
    to the trajectory's first localised pose. `convergence` holds, by heading, the median best fitness over the
    evaluations of the search. `overlay` are the scans to be looked at on the map, and
    `coverage` counts how many of those with a known pose saw each place of it.
    `map_changes` is what changed since a given map was made; None of a built map, and where too few scans show it.
    Whatever shows errors over time uses these pairs: association happens here alone.
    """

    metrics: RunMetrics
    comparison: Comparison | None
    odometry_alone: Comparison | None
    odometry: Trajectory | None
    convergence: Convergence
    overlay: ScanOverlay
    coverage: Coverage
    map_changes: SeenChanges | None = None

    def __repr__(self) -> str:
        compared = "no reference" if self.comparison is None else repr(self.comparison)
        return f"<Analysis: {self.metrics.verdict.value}, {len(self.metrics.warnings)} warnings, {compared}>"


def analyse(
    result: Result,
    *,
    observer: Callable[[PosedEvent], None] | None = None,
    progress: Callable[[float], None] | None = None,
) -> Analysis:
    """Read the scans of the log a second time, and measure how well they, the map and the reference agree.

    Alignment with the reference and relations are those of the request; the alignment is by default none on a given
    map, and se2 on a built one, whose frame is its own. `observer` sees each event of the second pass, for a
    recording of it. Raises EvaluationError for relations that cannot be used, and LogError where the log has changed.
    """
    scans, request, lasers = len(result.diagnostics), result.request, len(result.summary.lasers)
    likelihood, matcher = _likelihood(result), request.matcher
    residuals = Residuals(result.grid)
    check = ExtrinsicsCheck(likelihood, matcher, scans, lasers)
    sample = ConvergenceSample(likelihood, matcher, scans)
    overlay = ScanOverlayBuilder(scans, _not_matched(result))
    coverage = CoverageCounter(result.grid)
    finder = MapChangeFinder(result.grid) if result.mode == "localise" else None
    for posed in posed_events(result, progress):
        if observer is not None:
            observer(posed)
        if isinstance(posed.event, PairedScan):
            scan, T_map_base = posed.event.scan, posed.T_map_base
            points = scan.points_base()
            distance = residuals.distances(points, T_map_base)
            if posed.localised:
                residuals.add(scan, distance)
                coverage.add(scan, points, T_map_base)
                check.add(scan, T_map_base)
                sample.add(scan, T_map_base)
            if posed.known and finder is not None:
                finder.add(scan, points, T_map_base)
            overlay.add(scan, T_map_base, distance)
    errors = _Errors(result, request.alignment or ("se2" if result.mode == "slam" else "none"))
    changes = None if finder is None else finder.changes()
    found = (
        *quality_warnings(result),
        *change_warnings(changes, result.trajectory),
        *offset_warnings(result),
        *residuals.warnings(),
        *check.warnings(),
        *errors.warnings(),
    )
    warnings = (*result.warnings, *found)
    reasons = verdict_reasons(result, warnings)
    metrics = RunMetrics(
        verdict=verdict_of(reasons),
        verdict_reasons=reasons,
        run=run_identity(result),
        log=log_metrics(result),
        scans=scan_counts(result),
        evaluations=evaluation_counts(result),
        fitness=fitness_metrics(result),
        certificates=certificate_metrics(result),
        map=map_metrics(result, residuals.metrics(), errors.whole, changes),
        localised=localised_metrics(result),
        losses=loss_metrics(result),
        warnings=warnings,
        errors=_metrics_of(errors.whole),
        evaluation_error=errors.reason,
        localised_only=_metrics_of(errors.localised),
        localised_only_error=errors.localised_reason,
        odometry_alone=_metrics_of(errors.odometry_alone),
        relations=_relations(result),
    )
    return Analysis(
        metrics=metrics,
        comparison=errors.whole,
        odometry_alone=errors.odometry_alone,
        odometry=errors.odometry,
        convergence=sample.curves(request.matcher_name.upper()),
        overlay=overlay.overlay(),
        coverage=coverage.coverage(),
        map_changes=changes,
    )


def _not_matched(result: Result) -> NDArray[np.int64]:
    """Stamps of the scans that were refused or searched for, or ended a search."""
    wanted = ("rejected", "searching", "relocalised")
    return result.diagnostics.stamps_ns[np.isin(result.diagnostics.status, wanted)]


def _likelihood(result: Result) -> LikelihoodField | None:
    """The field that was matched on, else one of the built map, which may take seconds; None where nothing needs it."""
    needed = isinstance(result.request.matcher, HarmonySearch) or len(result.summary.lasers) > 1
    if not needed or not result.grid.occupied().any():
        return None
    parameters = result.request.config.likelihood_field
    return result.likelihood or LikelihoodField.from_grid(result.grid, parameters.sigma)


def _relations(result: Result) -> RelationsResult | None:
    path = result.request.relations
    if path is None:
        return None
    stated, trajectory = read_relations(path), result.trajectory
    first, second = (_in_clock_of_poses(result, stamps) for stamps in (stated.first_ns, stated.second_ns))
    if result.mapping is not None and first is not stated.first_ns and second is not stated.second_ns:
        stamps = np.concatenate((trajectory.stamps_ns, result.diagnostics.stamps_ns))
        trajectory = Trajectory(stamps, np.concatenate((trajectory.poses, result.mapping.scan_poses)))
    return evaluate_relations(trajectory, replace(stated, first_ns=first, second_ns=second))


def _in_clock_of_poses(result: Result, stamps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Stamps (n,) of reference poses in the clock of the trajectory, that of the odometry.

    References that were made of a log's scans bear their stamps as recorded: where these were corrected, they are, too.
    """
    given = result.reading.offsets_s() if result.corrected_offsets and result.reading else {}
    odometry = (result.summary.odom_topic or "").lstrip("/")
    shifts = {offset_s for topic, offset_s in given.items() if topic != odometry}
    scans = np.sort(result.diagnostics.stamps_ns)
    if len(shifts) != 1 or len(stamps_ns) == 0 or len(scans) < 2:
        return stamps_ns
    moved = stamps_ns + round(shifts.pop() * NS_PER_S)
    after = np.clip(np.searchsorted(scans, moved), 1, len(scans) - 1)
    apart = np.minimum(np.abs(moved - scans[after]), np.abs(moved - scans[after - 1]))
    return moved if float((apart <= _SAME_STAMP_NS).mean()) > 0.5 else stamps_ns


class _Errors:
    """Comparisons with the reference: of the whole trajectory, of its localised poses, and of the odometry alone."""

    def __init__(self, result: Result, alignment: str) -> None:
        self._alignment = alignment
        self._reference = result.reference
        if self._reference is not None and result.request.reference is not None:
            stamps = _in_clock_of_poses(result, self._reference.stamps_ns)
            self._reference = Trajectory(stamps, self._reference.poses)
        self.odometry = start_together(result.odometry, result.trajectory, result.localised)
        self.whole, self.reason = self._compare(result.trajectory)
        self.localised, self.localised_reason = None, None
        if self._reference is not None and result.localised.any() and not result.localised.all():
            known = Trajectory(result.trajectory.stamps_ns[result.localised], result.trajectory.poses[result.localised])
            self.localised, self.localised_reason = self._compare(known)
        self._known = self.whole if result.localised.all() else self.localised
        self.odometry_alone = None
        if self.whole is not None and self.odometry is not None:
            self.odometry_alone = self._compare(self.odometry)[0]

    def warnings(self) -> list[RunWarning]:
        """That the known poses are displaced from the reference as a whole; no evidence for the verdict."""
        found = None if self._known is None else self._known.displaced()
        return [] if found is None else [found]

    def _compare(self, trajectory: Trajectory) -> tuple[Comparison | None, str | None]:
        """The comparison, or why there is none; a reference of one pose is no trajectory to compare with."""
        if self._reference is None or len(self._reference) < 2:
            return None, None
        try:
            return compare_run(trajectory, self._reference, alignment=self._alignment), None
        except EvaluationError as error:
            return None, str(error)


def _metrics_of(comparison: Comparison | None) -> ErrorMetrics | None:
    return None if comparison is None else ErrorMetrics.of(comparison.evaluation())


def start_together(odometry: Trajectory, trajectory: Trajectory, localised: NDArray[np.bool_]) -> Trajectory | None:
    """Odometry moved as a whole, so that it agrees with the trajectory's first localised pose in time.

    With the first pose of all where none is localised; None without odometry.
    """
    if not len(odometry) or not len(trajectory):
        return None
    rows = np.flatnonzero(localised) if localised.any() else np.arange(len(trajectory))
    row = int(rows[np.argmin(trajectory.stamps_ns[rows])])
    there = interpolate_poses(odometry, trajectory.stamps_ns[row : row + 1])[0]
    T_map_odom = Pose2.from_array(trajectory.poses[row]) @ Pose2.from_array(there).inverse()
    return Trajectory(odometry.stamps_ns, compose_poses(T_map_odom.to_array(), odometry.poses))

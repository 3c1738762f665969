"""From a result and what its second pass found to `RunMetrics`."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict
from math import isfinite
from typing import TYPE_CHECKING

import numpy as np

from hsloc.errors import EvaluationError
from hsloc.evaluation.maps import ChangeCounts, compare_maps, crispness
from hsloc.evaluation.metrics import compare_run
from hsloc.log import LaserSummary
from hsloc.matching import summarise
from hsloc.options import AUTO
from hsloc.run_metrics import (
    CertificateMetrics,
    ClockOffsetMetrics,
    EvaluationCounts,
    FitnessMetrics,
    LaserMetrics,
    LocalisedMetrics,
    LogMetrics,
    LossMetrics,
    MapMetrics,
    PlanMetrics,
    ResidualMetrics,
    RunIdentity,
    RunTimings,
    ScaleMetrics,
    ScanCounts,
)
from hsloc.version import __version__

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from hsloc.analysis.map_changes import SeenChanges
    from hsloc.evaluation import Comparison
    from hsloc.replay.run import Result


def run_identity(result: Result) -> RunIdentity:
    """What was run."""
    request = result.request
    return RunIdentity(
        hsloc=__version__,
        mode=result.mode,
        inputs=request.names(),
        input_sha256=result.input_sha256,
        map=_map_name(result),
        seed=request.seed,
        preset=request.preset,
        matcher=result.matcher_name,
    )


def _map_name(result: Result) -> str:
    if result.mode == "slam":
        return "built" if result.request.resume is None else f"{result.request.resume.name}, extended"
    return "log" if result.request.map_path is None else result.request.map_path.name


def log_metrics(result: Result) -> LogMetrics:
    """What of the log was read, and from when on."""
    summary, stamps = result.summary, result.trajectory.stamps_ns
    lasers = summary.lasers or (
        LaserSummary(summary.scan_topic or "", summary.laser_frame or "", summary.T_base_laser, summary.laser_flipped,
                     summary.extrinsics),
    )  # fmt: skip
    reference = result.request.reference_name or summary.truth_topic
    return LogMetrics(
        duration_s=duration(result),
        odometry_messages=len(result.odometry),
        path_length_m=_path_length(result),
        first_stamp_ns=int(stamps.min()) if len(stamps) else None,
        odometry=None if result.lidar_only else summary.odom_topic,
        reference=None if result.reference is None else reference,
        lasers=tuple(LaserMetrics.of(laser) for laser in lasers),
        clock_offsets=_clock_offsets(result),
        time_offset=_time_offset(result),
    )


def _time_offset(result: Result) -> str | None:
    found = (result.reading or result.request.reading()).time_offset
    return None if found == AUTO else found


def _clock_offsets(result: Result) -> tuple[ClockOffsetMetrics, ...] | None:
    """Those that were corrected, else those that are left; None without any."""
    is_corrected = bool(result.corrected_offsets)
    offsets = (result.corrected_offsets if is_corrected else result.clock_offsets) or {}
    found = [(topic, each) for topic, each in sorted(offsets.items()) if isfinite(each.sigma)]
    return tuple(
        ClockOffsetMetrics(topic=topic, seconds=each.seconds, sigma=each.sigma, corrected=is_corrected)
        for topic, each in found
    ) or None  # fmt: skip


def _path_length(result: Result) -> float:
    """Of the trajectory; of the odometry where a pose is a guess, which jumps from place to place."""
    if len(result.odometry) != len(result.trajectory) or result.mapping is not None:
        return result.trajectory.length()
    steps, by_odometry = (
        np.hypot(*np.diff(path.poses[:, :2], axis=0).T) for path in (result.trajectory, result.odometry)
    )
    known = result.localised if result.tracked is None else result.tracked
    return float(np.where(known[1:] & known[:-1], steps, by_odometry).sum())


def scan_counts(result: Result) -> ScanCounts:
    """What became of the scans."""
    diagnostics = result.diagnostics
    status = Counter(diagnostics.status)
    pairs = zip(diagnostics.status, diagnostics.reason, strict=True)
    reasons = Counter(f"{state}: {_without_figures(reason)}" if reason else state for state, reason in pairs)
    return ScanCounts(
        total=len(diagnostics),
        used=status["matched"] + status["relocalised"],
        by_status=dict(sorted(status.items())),
        by_reason=dict(sorted(reasons.items())),
    )


def evaluation_counts(result: Result) -> EvaluationCounts:
    """Effort of the matcher."""
    spent = result.diagnostics.evaluations
    return EvaluationCounts(total=int(spent.sum()), median_per_match=_median(spent[spent > 0]))


def fitness_metrics(result: Result) -> FitnessMetrics:
    """Fitness of the matches."""
    fitness = result.diagnostics.fitness[np.isfinite(result.diagnostics.fitness)]
    return FitnessMetrics(median=_median(fitness), p05=float(np.percentile(fitness, 5)) if len(fitness) else None)


def certificate_metrics(result: Result) -> CertificateMetrics | None:
    """What was proven about the matches; None where none was certified."""
    summary = summarise(result.diagnostics.certificates)
    return None if summary is None else CertificateMetrics(**asdict(summary))


def map_metrics(
    result: Result, residuals: ResidualMetrics, comparison: Comparison | None, changes: SeenChanges | None = None
) -> MapMetrics:
    """How well scans and map agree; for a built map also how crisp and how consistent it is, and against a true one."""
    if result.mode != "slam":
        return MapMetrics(residuals=residuals, scale=_scale_metrics(result), changes=_change_metrics(changes))
    compared = error_text = None
    if result.true_grid is not None and result.reference is not None:
        try:
            # The frame of a built map is that of its first pose, whatever alignment the errors were asked for with.
            if comparison is None or comparison.alignment != "se2":
                comparison = compare_run(result.trajectory, result.reference, alignment="se2")
            moved = comparison.T_reference_estimate
            compared = compare_maps(result.grid, result.true_grid, T_truth_map=moved)
        except EvaluationError as error:
            error_text = str(error)
    return MapMetrics(
        residuals=residuals,
        crispness=crispness(result.grid),
        mapping=None if result.mapping is None else result.mapping.quality,
        comparison=compared,
        comparison_error=error_text,
        odometry=None if result.mapping is None else result.mapping.odometry_errors,
        plan=_plan_metrics(result),
    )


def _scale_metrics(result: Result) -> ScaleMetrics | None:
    scale = result.map_scale
    if scale is None or not isfinite(scale.sigma):
        return None
    return ScaleMetrics(
        value=scale.of_given_map,
        sigma=scale.sigma,
        resolution=result.grid.resolution,
        corrected=result.given_resolution is not None,
    )


def _change_metrics(changes: SeenChanges | None) -> ChangeCounts | None:
    if changes is None:
        return None
    kinds = Counter(each.kind for each in changes.changes)
    return ChangeCounts(
        appeared=kinds["appeared"],
        vanished=kinds["vanished"],
        gone=changes.gone,
        hidden=float(changes.hidden.mean()),
        hidden_max=float(changes.hidden.max()),
    )


def _plan_metrics(result: Result) -> PlanMetrics | None:
    path, mapping = result.request.align_to, result.mapping
    if path is None or mapping is None or mapping.plan is None:
        return None
    fit = mapping.plan
    pose, compared = fit.T_plan_map, fit.comparison
    return PlanMetrics(
        name=path.name,
        certain=fit.is_certain,
        pose=None if pose is None else (pose.x, pose.y, pose.theta),
        fitness=fit.fitness,
        elsewhere=fit.elsewhere,
        walls_near=None if compared is None else compared.precision,
        mean_distance=None if compared is None else compared.mean_distance_to_truth,
    )


def localised_metrics(result: Result) -> LocalisedMetrics:
    """How much of the trajectory is known."""
    return LocalisedMetrics(share_of_poses=float(result.localised.mean()) if len(result.localised) else 0.0)


def loss_metrics(result: Result) -> LossMetrics:
    """What of the log could not be read."""
    return LossMetrics(data_lost=result.losses.data_lost, notes=tuple(result.losses.lines()))


def run_timings(result: Result, further: Mapping[str, float] | None = None) -> RunTimings:
    """Wall times; `further` are those of the phases after the replay (s)."""
    work = result.seconds["replay"] + result.seconds.get("finish", 0.0)
    return RunTimings(
        seconds={**result.seconds, **(further or {})},
        times_real_time=duration(result) / work if work > 0.0 else None,
        evaluations_per_second=int(result.diagnostics.evaluations.sum()) / work if work > 0.0 else None,
    )


def duration(result: Result) -> float:
    """Seconds of the log from the first to the last pose."""
    stamps = result.trajectory.stamps_ns
    return float(stamps.max() - stamps.min()) / 1e9 if len(stamps) else 0.0


def _without_figures(reason: str) -> str:
    """A reason without its figures, so that reasons can be counted."""
    return " ".join(word for word in reason.split() if not any(c.isdigit() for c in word)).rstrip(",")


def _median(values: NDArray[np.float64] | NDArray[np.int64]) -> float | None:
    return float(np.median(values)) if len(values) else None

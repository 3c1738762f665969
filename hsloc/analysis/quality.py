"""Quality of a run's result: warnings, the verdict with its reasons, and the limits that the user gave."""

from __future__ import annotations

from math import degrees
from typing import TYPE_CHECKING

import numpy as np

from hsloc.analysis.map_changes import HIDDEN
from hsloc.analysis.mounting_warnings import mounting_warnings, mounting_warnings_of_map
from hsloc.evaluation.maps import MOST_GONE
from hsloc.localisation.reasons import localisation_reasons
from hsloc.model.verdict import Verdict, VerdictReason, spans_of
from hsloc.replay.clock_offset import KNOWN, matched_headings
from hsloc.slam.heading_offset import find_offset
from hsloc.slam.time_offset import clock_warnings, drift_warning, find_drift, offsets_of_log
from hsloc.trajectory_io.tum import NS_PER_S
from hsloc.warnings import RunWarning, WarningCode

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from hsloc.analysis.map_changes import SeenChanges
    from hsloc.model.trajectory import Trajectory
    from hsloc.replay.run import Result
    from hsloc.request import RunRequest
    from hsloc.run_metrics import RunMetrics
    from hsloc.slam.result import MappingResult

_MAX_WITHOUT_PLACE = 0.5
"""Fraction of scans without a place from which on the poses of the others are not to be trusted."""
_VERDICTS = {
    WarningCode.LASER_MISFIT: Verdict.CHECK,
    WarningCode.EXTRINSICS_WRONG: Verdict.CHECK,
    WarningCode.EXTRINSICS_DISAGREE: Verdict.CHECK,
    WarningCode.LASER_TURNED: Verdict.CHECK,
    WarningCode.EXTRINSICS_UNDECIDED: Verdict.CHECK,
    WarningCode.SCANS_FROZEN: Verdict.CHECK,
    WarningCode.SCAN_STAMPS_STUCK: Verdict.CHECK,
    WarningCode.CLOCK_SET: Verdict.CHECK,
    WarningCode.ODOMETRY_JUMPS: Verdict.CHECK,
    WarningCode.CLOCK_OFFSET_LARGE: Verdict.CHECK,
    WarningCode.MAP_SCALE: Verdict.CHECK,
    WarningCode.PLAN_NOT_FOUND: Verdict.CHECK,
    WarningCode.MAP_MIRRORED: Verdict.FAILED,
}
"""Warnings that concern the whole result, with the verdict that each alone gives."""

_FITS = 0.5
"""Fitness of scans at several places from which on these fit: people and furniture hide at most half of the beams."""
_MOST_NAMED = 5
"""Stray scans whose times a warning names."""
_RANGES_REMEDY = "see what the lidar measured: hsloc check; correct its limits with --scan-fix, or choose --scan-topic"
"""Where beams or whole scans have no return, nothing else helps."""
_FAILING = {"failed": (Verdict.FAILED,), "check": (Verdict.FAILED, Verdict.CHECK)}


def quality_warnings(result: Result) -> list[RunWarning]:
    """Localisation: the map has another scale, the laser another mounting, or most scans left the pose open.

    A pose found once may then be a chance fit. Mapping: single scans that are beside their place.
    """
    if result.mapping is not None:
        of_map = [*_stray_warnings(result.mapping, result), *_plan_warnings(result.mapping, result)]
        return [*of_map, *mounting_warnings_of_map(result.mapping, result)]
    if result.mode != "localise":
        return []
    of_sensor = [*_mirror_warnings(result), *_scale_warnings(result), *mounting_warnings(result)]
    without, scans = int(_without_place(result).sum()), len(result.diagnostics)
    if without <= _MAX_WITHOUT_PLACE * scans:
        return of_sensor
    share = _share(result)
    meaning = "every pose is a guess" if share == 0.0 else f"the {100 * share:.0f} % localised poses may be wrong"
    return [
        *of_sensor,
        RunWarning(
            WarningCode.SCANS_WITHOUT_PLACE,
            f"{without} of {scans} scans found no place on the map, so {meaning}",
            "is it the map of this building? If so, check the mounting (--laser-pose) and the odometry (hsloc check), "
            "or give the start (--initial-pose)",
        ),
    ]


def _stray_warnings(mapping: MappingResult, result: Result) -> list[RunWarning]:
    begin, spans = _first_keyscan(result), mapping.evidence.stray_scans
    if not spans:
        return []
    named = ", ".join(f"{end + begin:.1f}" for _, end in spans[:_MOST_NAMED])
    times = f"{named} s" if len(spans) <= _MOST_NAMED else f"{named} s and {len(spans) - _MOST_NAMED} more"
    return [
        RunWarning(
            WarningCode.STRAY_SCAN,
            f"rejected scans do not fit the scans around them, and are drawn beside their place: at {times}",
            "look for doubled walls there; cut that part off (--start, --end) if they matter",
        )
    ]


def _plan_warnings(mapping: MappingResult, result: Result) -> list[RunWarning]:
    fit, path = mapping.plan, result.request.align_to
    if fit is None or path is None or fit.is_certain:
        return []
    remedy = "check that it is the plan of this building, with doors and walls dark, and resolution in its YAML"
    if fit.T_plan_map is None:
        why = f"no place on it has a fitness of {fit.elsewhere:.2f}"
    elif len(fit.places) > 1:
        named = ", ".join(f"({pose.x:.1f}, {pose.y:.1f}, {degrees(pose.theta):.0f} deg)" for pose in fit.places)
        why = f"{len(fit.places)} places fit about as well, with the frame of the map at {named}"
        remedy = f"cut the plan to the part that was driven; if none is right, {remedy}"
    else:
        why = f"it fits with {fit.fitness:.2f}, and that no other place fits better was not proven in the boxes allowed"
    return [
        RunWarning(
            WarningCode.PLAN_NOT_FOUND, f"the map was not found on {path.name} and is in its own frame: {why}", remedy
        )
    ]


def _scale_warnings(result: Result) -> list[RunWarning]:
    scale, given = result.map_scale, result.given_resolution
    if scale is None or not (scale.is_significant or given is not None):
        return []
    value, cell = scale.of_given_map, result.grid.resolution if given is None else given
    size = "larger" if value > 1.0 else "smaller"
    if given is None:
        so = f"poses are off by {abs(value - 1.0):.3f} m per metre from the map's corner"
        remedy = f"if the ranges are right, set resolution: {cell / value:.5g} in the map's YAML (it is {cell:g})"
    else:
        so = "the odometry agrees with the lidar, so the poses are on a map with the resolution that both measure"
        remedy = (
            f"set resolution: {result.grid.resolution:.5g} in the map's YAML (it is {cell:g}); "
            "for poses on the map as it is, --set localiser.correct_map_scale=false"
        )
    return [
        RunWarning(
            WarningCode.MAP_SCALE,
            f"the map is {100 * abs(value - 1.0):.1f} % {size} than the lidar measures: scale {value:.4f} "
            f"± {scale.sigma:.4f}; {so}",
            remedy,
        )
    ]


def _mirror_warnings(result: Result) -> list[RunWarning]:
    if result.states is None or result.states.mirrored <= 0.5:
        return []
    return [
        RunWarning(
            WarningCode.MAP_MIRRORED,
            f"the scans fit the map better when they are mirrored, at every place; with a probability of "
            f"{100.0 * result.states.mirrored:.0f} % the image of the map or the laser is mirrored",
            "flip the map's image; or, if the laser is mounted upside down, state it (--laser-pose, /tf_static)",
        )
    ]


def change_warnings(changes: SeenChanges | None, trajectory: Trajectory) -> list[RunWarning]:
    """That the given map has changed so much that it is to be made again, by scans whose pose is known."""
    if changes is None:
        return []
    start, text = int(trajectory.stamps_ns.min()), []
    spans = [((begin - start) / NS_PER_S, (end - start) / NS_PER_S) for begin, end in changes.hidden_spans_ns()]
    if spans:
        times = ", ".join(f"{begin:.1f} to {end:.1f} s" for begin, end in spans[:_MOST_NAMED])
        more = f" and {len(spans) - _MOST_NAMED} more" if len(spans) > _MOST_NAMED else ""
        text.append(f"{100 * HIDDEN:.0f} % of the beams and more end at things that it lacks, from {times}{more}")
    if changes.gone >= MOST_GONE:
        text.append(f"{100 * changes.gone:.0f} % of its walls that were seen are gone")
    if not text:
        return []
    return [
        RunWarning(
            WarningCode.MAP_CHANGED,
            f"the map has changed: {'; '.join(text)}",
            "see changes.csv; make the map again, or extend it with this log (hsloc map --resume)",
        )
    ]


def offset_warnings(result: Result) -> list[RunWarning]:
    """Whether scans and odometry are stamped by clocks, or at moments, that differ: by the headings of the result."""
    if result.lidar_only or not len(result.odometry) or any(warning.code in KNOWN for warning in result.warnings):
        return []
    odometry = result.odometry
    given = result.request.read.offsets_s()
    if result.clock_offsets is not None:
        return [warning for _, warning in clock_warnings(result.clock_offsets, given)]
    scans, turned = matched_headings(result.diagnostics, odometry, result.trajectory)
    offset = find_offset(scans, turned)
    if not offset.is_significant:
        drift = find_drift(scans, turned, offset.seconds)
        return [drift_warning(result.summary.scan_topic or "the scans", drift)] if drift else []
    # Poses are weighed with the odometry, which hides a part of the offset: the scans alone show the whole of it.
    request = result.request
    reading = result.reading or request.reading()
    found = offsets_of_log(request.logs, reading, request.config.graph_mapper.front_end)
    return [warning for _, warning in clock_warnings(found, given)]


def verdict_reasons(result: Result, warnings: Sequence[RunWarning]) -> tuple[VerdictReason, ...]:
    """The evidence against the result, from its warnings and from its poses. Never from the truth."""
    reasons = []
    for warning in warnings:
        if warning.code == WarningCode.SCANS_WITHOUT_PLACE:
            verdict = Verdict.FAILED if _share(result) == 0.0 else Verdict.CHECK
            reasons.append(VerdictReason(verdict, warning.code, warning.text, warning.remedy, times=_unplaced(result)))
        elif warning.code in _VERDICTS:
            verdict = _VERDICTS[WarningCode(warning.code)]
            reasons.append(VerdictReason(verdict, warning.code, warning.text, warning.remedy))
    if result.mapping is not None:
        reasons += _of_the_map(result.mapping, result)
    if result.states is not None:
        of_poses = localisation_reasons(result.states, result.trajectory, result.ambiguities)
        codes = {reason.code for reason in reasons}
        if _share(result) == 0.0 and codes:  # That every pose is a guess is said already, but not why.
            of_poses = tuple(reason for reason in of_poses if reason.code == "poses_ambiguous")
        if WarningCode.SCANS_WITHOUT_PLACE in codes:  # Where most fit nowhere, several places fit badly and none well.
            of_poses = tuple(reason for reason in of_poses if reason.code != "poses_ambiguous")
        reasons += of_poses
    return tuple(reasons)


def _of_the_map(mapping: MappingResult, result: Result) -> list[VerdictReason]:
    """What the mapper found against its own map."""
    begin = _first_keyscan(result)
    return [
        VerdictReason(
            Verdict(reason.verdict),
            reason.code.replace("-", "_"),
            reason.text,
            _map_remedy(reason.code, result),
            places=reason.places,
            times=tuple((a + begin, b + begin) for a, b in reason.times_s),
        )
        for reason in mapping.evidence.reasons
    ]


def _map_remedy(code: str, result: Result) -> str:
    if code in {"blind", "no-returns"}:
        return _RANGES_REMEDY
    if code in {"relocated", "record-gap"}:
        return "look at the places on the map; where it is wrong, --forbid-loop T1,T2, or cut the log (--start, --end)"
    if code == "uncertain":
        return "add a drive that joins far places another way (hsloc merge), or hold the map to a plan (--align-to)"
    without_odometry = "" if result.lidar_only else " --no-odom,"
    return f"look at the places on the map; try another --seed,{without_odometry} or a cut of the log (--start, --end)"


def _first_keyscan(result: Result) -> float:
    """Seconds of the first keyscan, with which the mapper's times begin, since the first pose, with which others do."""
    stamps, first = result.diagnostics.stamps_ns, result.trajectory.stamps_ns
    return (int(stamps[0]) - int(first[0])) / NS_PER_S if len(stamps) and len(first) else 0.0


def _share(result: Result) -> float:
    return float(result.localised.mean()) if len(result.localised) else 0.0


def _unplaced(result: Result) -> tuple[tuple[float, float], ...]:
    """Spans in which no scan found a place."""
    return _times(result.diagnostics.stamps_ns, spans_of(_without_place(result)), result)


def _without_place(result: Result) -> NDArray[np.bool_]:
    """Which scans found no place; those that fit at several are ambiguous, and some have one in hindsight."""
    stamps, fitness = result.diagnostics.stamps_ns, result.diagnostics.fitness
    without: NDArray[np.bool_] = np.isin(result.diagnostics.status, ("searching", "rejected"))
    if result.states is not None and len(result.trajectory):
        order = np.argsort(result.trajectory.stamps_ns, kind="stable")
        after = np.searchsorted(result.trajectory.stamps_ns[order], stamps)
        without &= ~result.localised[order[np.minimum(after, len(order) - 1)]]
    for each in result.ambiguities:
        within = (stamps >= each.begin_ns) & (stamps <= each.end_ns)
        known = fitness[within & np.isfinite(fitness)]
        if len(known) and np.median(known) >= _FITS:
            without &= ~within
    return without


def _times(
    stamps_ns: NDArray[np.int64], spans: list[tuple[int, int]], result: Result
) -> tuple[tuple[float, float], ...]:
    start = int(result.trajectory.stamps_ns.min())
    seconds = ((stamps_ns - start) / NS_PER_S).tolist()
    return tuple((seconds[first], seconds[end]) for first, end in spans)


def exceeded_limits(request: RunRequest, metrics: RunMetrics) -> tuple[str, ...]:
    """A line for each limit that is not kept: its flag, its value, and what was measured. Empty if all are kept."""
    found = []
    share = metrics.localised.share_of_poses
    if request.min_localised is not None and share < request.min_localised:
        found.append(f"--min-localised {request.min_localised:g}: {share:.4f} of the poses are localised")
    if request.max_ape is not None:
        if metrics.errors is None:
            reason = metrics.evaluation_error or "there is no reference to compare with"
            found.append(f"--max-ape {request.max_ape:g}: cannot be checked: {reason}")
        elif not (rmse := metrics.errors.ape.trans_part.rmse) <= request.max_ape:
            found.append(f"--max-ape {request.max_ape:g}: the RMSE of the position is {rmse:.4f} m")
    if request.max_warnings is not None and len(metrics.warnings) > request.max_warnings:
        found.append(f"--max-warnings {request.max_warnings}: there are {len(metrics.warnings)}")
    if request.fail_if is not None and metrics.verdict in _FAILING[request.fail_if]:
        found.append(f"--fail-if {request.fail_if}: the verdict is {metrics.verdict}")
    return tuple(found)

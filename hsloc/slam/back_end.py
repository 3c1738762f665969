"""After the log: loops, graph, refinement and the map, from what the front end has gathered."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hsloc.errors import MapError
from hsloc.model.occupancy_grid import OccupancyGrid
from hsloc.model.pose2 import Pose2, relative_poses
from hsloc.slam.calibration import OdometryCalibration
from hsloc.slam.displaced import mended
from hsloc.slam.evidence import nothing_seen, weigh
from hsloc.slam.loop_closer import TORN, loop_edges
from hsloc.slam.map_extension import connect, unconnected
from hsloc.slam.map_session import LEFT_THE_MAP
from hsloc.slam.map_state import MapState, fingerprint
from hsloc.slam.marginals import CommonErrors, all_edges, marginal_covariances, observed_terms
from hsloc.slam.occupancy_mapper import build_grid
from hsloc.slam.open_joints import close_and_join
from hsloc.slam.plan_alignment import find_on_plan
from hsloc.slam.pose_graph import Edges, PoseGraph, compose_steps, edge_errors
from hsloc.slam.recorded import Recorded
from hsloc.slam.refinement import near_the_end, refine_map, refine_with_calibration, silent
from hsloc.slam.result import MappingQuality, MappingResult
from hsloc.slam.slips import compare_with_odometry, held_by_the_rest, known_by_scans, without_slips
from hsloc.slam.stray_scans import put_back

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.random import Generator
    from numpy.typing import NDArray

    from hsloc.kernels.normal_equations import PairTerms
    from hsloc.kernels.point_to_line import ScanArrays
    from hsloc.slam.joint_registration import Registration
    from hsloc.slam.keyscans import KeyScans
    from hsloc.slam.loop_matcher import Loop
    from hsloc.slam.map_session import MapSession, Tie
    from hsloc.slam.parameters import GraphMapperParameters, Resume
    from hsloc.slam.slips import Held, Stretches
    from hsloc.slam.trajectory_correction import EventLog

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]

_CONTRADICTED = 3.0
"""Residual [standard deviations] in the finished map from which on a loop contradicts it."""
_MOST_REPAIRS = 3
"""Times that odometry is taken out and the map refined again: by the scans, by the rest of the map, and once more."""
_RESIDUAL_SCANS = 400
"""Scans whose residuals are measured. Internal: a sample for the metrics, no pose depends on it."""


def finish(
    gathered: MapSession | None,
    track: EventLog,
    parameters: GraphMapperParameters,
    rng: Generator,
    progress: Callable[[float], None] | None = None,
    resume: Resume | None = None,
    plan: OccupancyGrid | None = None,
) -> MappingResult:
    """Close loops, refine, build the map; with `resume`, in and with a saved map. None: the log had no keyscan.

    With a floor `plan` the map is in its frame, if it fits one place of it only.
    Raises MapError if the log cannot be connected with the saved map.
    """
    report = progress if progress is not None else silent
    if gathered is None:
        if resume is not None:
            raise MapError(unconnected(resume.state))
        return _empty(track)
    if resume is not None:
        gathered = connect(resume, gathered, parameters, rng)
    extended = resume.state if resume is not None else None
    return finish_session(gathered, track, parameters, rng, report, extended, plan)


def solve(gathered: MapSession, parameters: GraphMapperParameters, rng: Generator) -> MapSession:
    """Close the loops of a session and refine it, so that the log can go on from there: its keyscans as solved."""
    arrays = gathered.scans.arrays(parameters.joint_registration.points_per_scan)
    gathered = mended(gathered, arrays)
    gathered, poses, loops, edges = close_and_join(gathered, parameters, rng, silent)
    gathered, refined, _ = refine_with_calibration(poses, arrays, gathered, edges, parameters, silent)
    return replace(gathered, poses=refined.poses, known=tuple(loops))


def finish_session(
    gathered: MapSession,
    track: EventLog,
    parameters: GraphMapperParameters,
    rng: Generator,
    report: Callable[[float], None],
    extended: MapState | None,
    plan: OccupancyGrid | None = None,
) -> MappingResult:
    """Close the loops of a session, refine, build the map; `track` has the events of the log that was read.

    Raises MapError if in the end no loop joins the session with the map that it extends.
    """
    arrays = gathered.scans.arrays(parameters.joint_registration.points_per_scan)
    gathered = mended(gathered, arrays)
    gathered, poses, loops, loop_edges = close_and_join(gathered, parameters, rng, lambda part: report(0.5 * part))
    if extended is not None and not any(loop.accepted and _connects(loop, gathered) for loop in loops):
        raise MapError(unconnected(extended))
    gathered, refined, passes = refine_with_calibration(
        poses, arrays, gathered, loop_edges, parameters, lambda part: report(0.5 + 0.4 * part)
    )
    steps = gathered.believed_steps(parameters.joint_registration)
    fit, edges = None, Edges.concatenate([steps, loop_edges])
    if plan is not None:
        fit = find_on_plan(plan, build_grid(refined.poses, gathered.scans, parameters.occupancy), refined.poses)
        if fit.is_certain:
            refined, more = refine_map(fit.moved(refined.poses), arrays, edges, near_the_end(parameters), silent)
            passes += more
    refined, more = put_back(refined, gathered, arrays, edges, parameters)
    passes += more
    repaired = _without_slips(refined, gathered, loop_edges, arrays, parameters)
    refined, observed, edges = repaired.refined, repaired.observed, repaired.edges
    gathered, passes = replace(gathered, steps=repaired.steps), passes + repaired.passes
    covariances = marginal_covariances(refined, observed, edges, _common(gathered))
    grid = build_grid(refined.poses, gathered.scans, parameters.occupancy)
    report(1.0)
    of_log = refined.poses[gathered.first :]
    calibration = track.calibrated(of_log) if parameters.use_odometry else OdometryCalibration()
    odometry_poses, scan_poses = track.corrected(of_log, calibration)
    odometry_covariances, scan_covariances = track.covariances(of_log, covariances[gathered.first :], calibration)
    return MappingResult(
        odometry_poses=odometry_poses,
        scan_poses=scan_poses,
        keyscan_stamps_ns=gathered.stamps_ns,
        keyscan_poses=refined.poses,
        grid=grid,
        keyscan_covariances=covariances,
        odometry_covariances=odometry_covariances,
        scan_covariances=scan_covariances,
        graph=PoseGraph(gathered.stamps_ns, refined.poses, all_edges(refined, observed, edges)),
        loops=tuple(loops),
        submap_references=gathered.places.reference,
        quality=_quality(refined, covariances, passes, loops, loop_edges, grid, gathered.scans, track.anchored),
        calibration=calibration,
        state=_state(gathered, refined.poses, loop_edges, grid, parameters),
        evidence=weigh(_recorded(gathered, loops, repaired, covariances, parameters.use_odometry)),
        odometry_errors=None if gathered.systematic is None else gathered.systematic.summary(),
        plan=None if plan is None or fit is None else fit.compared(grid, plan),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Repaired:
    """A refined map, its terms and edges, with the odometry `steps` as weighed at last, and what is known of slips."""

    refined: Registration
    observed: PairTerms
    edges: Edges
    steps: Edges
    stretches: Stretches
    held: Held
    passes: int


def _without_slips(
    refined: Registration,
    gathered: MapSession,
    loop_edges: Edges,
    scans: ScanArrays,
    parameters: GraphMapperParameters,
) -> _Repaired:
    """Take the weight from odometry that is contradicted and refine again, until no more is.

    The rest of the map is compared when none is left that the scans of a stretch show by themselves.
    """
    slipped, passes = gathered.slipped, 0
    steps, known = without_slips(gathered.steps, slipped), None
    for repairs_left in range(_MOST_REPAIRS if parameters.use_odometry else 0, -1, -1):
        edges = Edges.concatenate([steps, loop_edges])
        if known is not None:
            refined, more = refine_map(refined.poses, scans, edges, near_the_end(parameters), silent, refined)
            passes += more
        motions = compare_with_odometry(refined, gathered.steps if known is None else steps)
        if known is not None:
            # Odometry without weight contradicts nothing any more.
            motions = replace(motions, normalised=np.maximum(motions.normalised, known))
        settled = repairs_left == 0 or not (motions.slipped(len(steps)) & ~slipped).any()
        if settled:
            observed = observed_terms(refined)
            stretches = known_by_scans(motions, refined, scans, observed)
            held = held_by_the_rest(refined, observed, edges, gathered.steps, stretches)
            motions = stretches = held.marked(stretches)
        known, more_slipped = motions.normalised, slipped | motions.slipped(len(steps))
        if settled and (repairs_left == 0 or (more_slipped == slipped).all()):
            break
        slipped = more_slipped
        steps = without_slips(gathered.steps, slipped)
    return _Repaired(refined, observed, edges, steps, stretches, held, passes)


def _common(gathered: MapSession) -> CommonErrors | None:
    """What the steps of the odometry have in common and is not known."""
    errors = gathered.systematic
    return None if errors is None else CommonErrors(errors.changes(gathered.steps.measured), errors.covariance)


def _recorded(
    gathered: MapSession,
    loops: list[Loop],
    repaired: _Repaired,
    covariances: F64,
    use_odometry: bool,
) -> Recorded:
    reference, refined = gathered.places.reference, repaired.refined
    ends = np.array([(reference[loop.first], reference[loop.second]) for loop in loops], dtype=np.int64).reshape(-1, 2)
    accepted = ends[[loop.accepted and loop.reason != LEFT_THE_MAP for loop in loops]]
    motions, steps = gathered.motions, gathered.steps.measured
    after = np.array([*(tie.second for tie in gathered.ties), *gathered.joints], dtype=np.int64)
    if len(after):
        # Across a gap nothing was driven that the map could be held against.
        motions, steps = motions.copy(), steps.copy()
        motions[after] = 0.0
        steps[after - 1] = relative_poses(refined.poses[after - 1], refined.poses[after])
        accepted = verified_stretches(accepted, gathered.ties)
    ranges = gathered.scans.ranges
    measured = max(int((~np.isnan(ranges)).sum()), 1)
    torn = [loop for loop in loops if loop.reason.startswith(TORN)]
    # A loop may have been torn by a slip that was found later.
    _, _, chi = edge_errors(refined.poses, loop_edges(torn, reference, np.inf))
    return Recorded(
        stamps_ns=gathered.stamps_ns,
        poses=refined.poses,
        motions=motions,
        covariances=gathered.covariances,
        refused=gathered.refused,
        odometry=compose_steps(steps) if use_odometry else None,
        pairs=refined.pairs,
        counts=refined.counts,
        loops=accepted,
        torn=ends[[loop.reason.startswith(TORN) for loop in loops]][chi > _CONTRADICTED],
        joints=np.array(gathered.joints, dtype=np.int64),
        after_gaps=gathered.after_gaps,
        no_return_share=float(np.isposinf(ranges).sum()) / measured,
        stretches=repaired.stretches,
        held=repaired.held,
        pose_covariances=covariances,
    )


def verified_stretches(loops: I64, ties: tuple[Tie, ...]) -> I64:
    """The stretches (m, 2) that loops (k, 2) verify: before a gap the path goes on where the map was left."""
    begin = [tie.second for tie in ties]
    cut: list[tuple[int, int]] = []
    for first, second in loops.tolist():
        a, b = bisect_right(begin, first), bisect_right(begin, second)
        while a != b:
            if a > b:
                first, second, a, b = second, first, b, a
            cut.append((begin[b - 1], second))
            second = ties[b - 1].first
            b = bisect_right(begin, second)
        cut.append((min(first, second), max(first, second)))
    return np.array(cut, dtype=np.int64).reshape(-1, 2)


def _connects(loop: Loop, gathered: MapSession) -> bool:
    return loop.first < gathered.first_place <= loop.second


def _state(
    gathered: MapSession, poses: F64, loops: Edges, grid: OccupancyGrid, parameters: GraphMapperParameters
) -> MapState:
    return MapState(
        scans=gathered.scans,
        stamps_ns=gathered.stamps_ns,
        poses=poses,
        covariances=gathered.covariances,
        refused=gathered.refused,
        steps=gathered.steps,
        loops=loops,
        grid=grid,
        fingerprint=fingerprint(parameters),
    )


def _quality(
    refined: Registration,
    covariances: F64,
    passes: int,
    loops: list[Loop],
    edges: Edges,
    grid: OccupancyGrid,
    scans: KeyScans,
    followed: int,
) -> MappingQuality:
    nan = float("nan")
    distance, angle, _ = edge_errors(refined.poses, edges)
    residuals = _residuals(refined.poses, scans, grid)
    median, p95 = np.percentile(residuals, (50.0, 95.0)) if len(residuals) else (nan, nan)
    sigma = np.sqrt(np.trace(covariances[:, :2, :2], axis1=1, axis2=2))
    return MappingQuality(
        residual_median=float(median),
        residual_p95=float(p95),
        scan_rms=refined.rms,
        conflict=refined.conflict,
        loops=len(edges),
        loops_refused=sum(not loop.accepted for loop in loops),
        loop_median=float(np.median(distance)) if len(edges) else nan,
        loop_max=float(distance.max()) if len(edges) else nan,
        loop_angle_median_deg=float(np.degrees(np.median(angle))) if len(edges) else nan,
        loop_angle_max_deg=float(np.degrees(angle.max())) if len(edges) else nan,
        sigma_median=float(np.median(sigma)),
        sigma_max=float(sigma.max()),
        sigma_angle_max_deg=float(np.degrees(np.sqrt(covariances[:, 2, 2].max()))),
        keyscans=len(scans),
        followed=followed,
        passes=passes,
        moved=refined.moved,
    )


def _residuals(poses: F64, scans: KeyScans, grid: OccupancyGrid) -> F64:
    """Distances (m) of points to the nearest occupied cell's centre, of scans evenly chosen."""
    if not grid.occupied().any():
        return np.zeros(0)
    chosen = np.unique(np.linspace(0, len(scans) - 1, _RESIDUAL_SCANS).astype(np.int64))
    parts = [Pose2.from_array(poses[k]) @ scans.hits(int(k)).astype(np.float64) for k in chosen]
    return grid.wall_distances(np.concatenate(parts))


def _empty(track: EventLog) -> MappingResult:
    """No scan had a return: odometry is all there is."""
    nan = float("nan")
    odometry_poses, scan_poses = track.corrected(np.zeros((0, 3)))
    odometry_covariances, scan_covariances = track.covariances(np.zeros((0, 3)), np.zeros((0, 3, 3)))
    none = np.zeros(0, dtype=np.int64)
    return MappingResult(
        odometry_poses=odometry_poses,
        scan_poses=scan_poses,
        keyscan_stamps_ns=none,
        keyscan_poses=np.zeros((0, 3)),
        keyscan_covariances=np.zeros((0, 3, 3)),
        odometry_covariances=odometry_covariances,
        scan_covariances=scan_covariances,
        grid=OccupancyGrid(np.full((1, 1), -1, dtype=np.int8), 0.05),
        graph=PoseGraph(none, np.zeros((0, 3)), Edges.none()),
        loops=(),
        submap_references=np.zeros(0, dtype=np.int64),
        quality=MappingQuality(nan, nan, nan, nan, 0, 0, nan, nan, nan, nan, nan, nan, nan, 0, 0, 0, 0.0),
        calibration=OdometryCalibration(),
        state=None,
        evidence=nothing_seen(),
    )

"""Passes of the joint registration over a whole log, and the odometry that they use, freed of its systematic errors."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from hsloc.model.pose2 import pose_differences
from hsloc.slam.joint_registration import moved_scans, refine
from hsloc.slam.pose_graph import Edges
from hsloc.slam.systematic_errors import find_systematic_errors

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from hsloc.kernels.point_to_line import ScanArrays
    from hsloc.slam.joint_registration import Registration
    from hsloc.slam.map_session import MapSession
    from hsloc.slam.parameters import GraphMapperParameters

    F64 = NDArray[np.float64]

_UNSETTLED_M = 0.01
"""Another pass is made if 1 of 100 keyscans moved farther than this [m] in the last round: a fifth of a cell."""


def refine_map(
    poses: F64,
    scans: ScanArrays,
    edges: Edges,
    parameters: GraphMapperParameters,
    progress: Callable[[float], None],
    previous: Registration | None = None,
) -> tuple[Registration, int]:
    """Passes over the whole log, each with partners chosen again, until nothing moves, and their number."""
    most = parameters.passes
    refined = refine(poses, scans, edges, parameters.joint_registration, lambda part: progress(part / most), previous)
    return _settled(refined, scans, edges, parameters, progress)


def refine_with_calibration(
    poses: F64,
    scans: ScanArrays,
    gathered: MapSession,
    loop_edges: Edges,
    parameters: GraphMapperParameters,
    progress: Callable[[float], None],
) -> tuple[MapSession, Registration, int]:
    """The session without the systematic errors of its odometry, the refined map, and the number of passes.

    They are found after the first pass, and taken out of the steps of the log that was read: a map that it extends has
    been freed of its own.
    """
    most = parameters.passes
    edges = Edges.concatenate([gathered.believed_steps(parameters.joint_registration), loop_edges])
    refined = refine(poses, scans, edges, parameters.joint_registration, lambda part: progress(part / most))
    if parameters.use_odometry:
        errors = find_systematic_errors(refined, gathered.steps, gathered.first)
        gathered = replace(gathered, steps=errors.added_to(gathered.steps), systematic=errors)
        if errors.are_found:
            edges = Edges.concatenate([gathered.believed_steps(parameters.joint_registration), loop_edges])
            refined = replace(refined, moved=np.inf)
    return gathered, *_settled(refined, scans, edges, parameters, progress)


def _settled(
    refined: Registration,
    scans: ScanArrays,
    edges: Edges,
    parameters: GraphMapperParameters,
    progress: Callable[[float], None],
) -> tuple[Registration, int]:
    """Further passes after the first one, and the number of all."""
    most, p = parameters.passes, parameters.joint_registration
    later = near_the_end(parameters).joint_registration
    passes = 1
    while passes < most and refined.moved >= _UNSETTLED_M:
        begin = refined.poses
        done = passes
        refined = refine(begin, scans, edges, later, lambda part: progress((done + part) / most), refined)  # noqa: B023
        passes += 1
        if moved_scans(pose_differences(refined.poses, begin)) < p.convergence_tolerance:
            break
    return refined, passes


def silent(_: float) -> None:
    """Progress without a listener."""


def near_the_end(parameters: GraphMapperParameters) -> GraphMapperParameters:
    """Without the wide gates of the first rounds."""
    registration = parameters.joint_registration
    return replace(parameters, joint_registration=replace(registration, gates=registration.gates[-1:]))

"""Warnings about where the laser is mounted, by the steps of matches and odometry."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from math import degrees, hypot, isfinite
from typing import TYPE_CHECKING

import numpy as np

from hsloc.evaluation.association import interpolate_poses
from hsloc.localisation.mounting_changes import yaw_pieces
from hsloc.localisation.mounting_error import mounting_error, steps_of_poses
from hsloc.model.pose2 import Pose2, wrap_angle
from hsloc.replay.clock_offset import matched_headings
from hsloc.slam.heading_offset import find_offset
from hsloc.slam.mounting_choice import laser_pose_option, right_mounting
from hsloc.trajectory_io.tum import NS_PER_S
from hsloc.warnings import RunWarning, WarningCode

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from hsloc.localisation.mounting_changes import YawPiece
    from hsloc.localisation.mounting_error import Steps
    from hsloc.replay.run import Result
    from hsloc.slam.result import MappingResult

    I64 = NDArray[np.int64]

_MOST_NAMED = 3
"""Changes that a warning names."""
_ONE_SIDED = "; all turns go to one side, where slip of the wheels may be a part of that"


def mounting_warnings(result: Result) -> list[RunWarning]:
    """Localisation: that the only laser is elsewhere than stated, or was turned on the way."""
    if result.yaw_pieces:
        return [_turned(result.yaw_pieces, result)]
    found = result.mounting_error
    if found is None or not found.is_significant or len(result.summary.lasers) != 1:
        return []
    (laser,) = result.summary.lasers
    error, yaw = found.error, found.sigma[2]
    place = f"{hypot(error.x, error.y):.3f} ± {sigma:.3f} m and " if isfinite(sigma := found.place_sigma) else ""
    return [
        RunWarning(
            WarningCode.EXTRINSICS_WRONG,
            f"scans and odometry agree if the laser is {place}"
            f"{degrees(error.theta):.1f} ± {degrees(yaw):.1f} deg from where it is stated, and so are the poses"
            f"{_ONE_SIDED if found.slip else ''}",
            f"measure it, or hsloc calibrate; {laser_pose_option(error @ laser.T_base_laser)}",
        )
    ]


def mounting_warnings_of_map(mapping: MappingResult, result: Result) -> list[RunWarning]:
    """Mapping: the same, by the finished map and the odometry."""
    steps, stamps = _steps_of_map(mapping, result)
    pieces = () if steps is None else yaw_pieces(steps, stamps)
    if pieces:
        return [_turned(pieces, result)]
    return _direction_warnings(result) or _place_warnings(steps, stamps, result)


def _turned(pieces: Sequence[YawPiece], result: Result) -> RunWarning:
    first, stated = int(result.trajectory.stamps_ns[0]), result.summary.T_base_laser

    def seconds(piece: YawPiece) -> str:
        return f"{(piece.begin_ns - first) / NS_PER_S:.1f} s"

    changes = list(pairwise(pieces))
    named = ", ".join(
        f"at {seconds(after)} by {degrees(after.yaw - before.yaw):.1f} "
        f"± {max(degrees(hypot(before.sigma, after.sigma)), 0.1):.1f} deg"
        for before, after in changes[:_MOST_NAMED]
    )
    more = f" and {len(changes) - _MOST_NAMED} times more" if len(changes) > _MOST_NAMED else ""
    options = "; ".join(
        f"from {seconds(piece)} on {laser_pose_option(Pose2(stated.x, stated.y, wrap_angle(stated.theta + piece.yaw)))}"
        for piece in [each for each in pieces if each.is_turned][:_MOST_NAMED]
    )
    return RunWarning(
        WarningCode.LASER_TURNED,
        f"by scans and odometry the laser was turned on the robot: {named}{more}; headings are wrong by as much",
        f"fasten the laser; cut this log there (--start, --end){f' and give {options}' if options else ''}",
    )


def _steps_of_map(mapping: MappingResult, result: Result) -> tuple[Steps | None, I64]:
    """Steps between the keyscans of this log, and their stamps."""
    odometry, stamps = result.odometry, mapping.keyscan_stamps_ns
    if result.lidar_only or len(odometry) == 0 or len(result.summary.lasers) > 1:
        return None, stamps
    # Those of a map that is extended are of other logs.
    own = (stamps >= odometry.stamps_ns[0]) & (stamps <= odometry.stamps_ns[-1])
    stamps = stamps[own]
    return steps_of_poses(interpolate_poses(odometry, stamps), mapping.keyscan_poses[own]), stamps


def _direction_warnings(result: Result) -> list[RunWarning]:
    """Where the mounting was given, or a map with the other one shows as much of an error."""
    shown, request = result.mounting_error, result.request
    if shown is None or not shown.is_turned or result.direction_is_right:
        return []
    if WarningCode.EXTRINSICS_WRONG in {each.code for each in result.warnings}:
        return []
    reading, front_end = result.reading or request.reading(), request.config.graph_mapper.front_end
    found = right_mounting(request.logs, reading, front_end, used=False)
    return [] if found is None else [found[1]]


def _place_warnings(steps: Steps | None, stamps: I64, result: Result) -> list[RunWarning]:
    """Where a laser is that is not where it is stated or assumed to be.

    Clocks that differ move it ahead or back, by the robot's way in that time: that much is no other place.
    """
    found = None if steps is None else mounting_error(steps)
    if found is None or not found.is_displaced:
        return []
    odometry = result.odometry
    offset = find_offset(*matched_headings(result.diagnostics, odometry, result.trajectory))
    if not isfinite(offset.sigma):
        return []
    by_clocks = 0.0
    if offset.is_significant:
        by_odometry = interpolate_poses(odometry, stamps)
        metres, seconds = np.hypot(*np.diff(by_odometry[:, :2], axis=0).T), np.diff(stamps) / NS_PER_S
        by_clocks = abs(offset.seconds) * float(np.quantile(metres / np.maximum(seconds, 1e-3), 0.95))
        left = replace(found.error, x=max(abs(found.error.x) - by_clocks, 0.0))
        if not replace(found, error=left).is_displaced:
            return []
    stated = result.summary.T_base_laser
    right, sigma = found.error @ stated, hypot(found.place_sigma, by_clocks)
    option = laser_pose_option(Pose2(right.x, right.y, stated.theta))
    if result.summary.extrinsics == "identity":
        text = f"by scans and odometry the laser is at ({right.x:.3f}, {right.y:.3f}) ± {sigma:.3f} m in the base frame"
        remedy = f"the poses are those of the laser; {option} makes them those of the base"
        return [RunWarning(WarningCode.EXTRINSICS_MEASURED, text, remedy)]
    by = hypot(found.error.x, found.error.y)
    text = (
        f"scans and odometry agree if the laser is {by:.3f} ± {sigma:.3f} m from where it is stated; where no wall "
        "fixes the motion, the map is off by as much after each turn"
        f"{_ONE_SIDED if found.slip else ''}"
    )
    return [RunWarning(WarningCode.EXTRINSICS_WRONG, text, f"measure it, or hsloc calibrate; {option}")]

"""A second pass over the log of a finished run: its scans and odometry once more, now with the poses of the result."""

from __future__ import annotations

from math import pi
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hsloc.garbage_collection import rarely_collected
from hsloc.log import open_log
from hsloc.model.events import Odometry, PairedScan, Scan
from hsloc.model.pose2 import IDENTITY, Pose2, wrap_angle
from hsloc.preprocessing.scans import pair
from hsloc.replay.prepared_events import PreparedEvents, Surroundings

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from numpy.typing import NDArray

    from hsloc.model.events import Event
    from hsloc.replay.run import Result

    F64 = NDArray[np.float64]

_BLOCK = 4096
"""Poses that are Python's numbers at a time."""


class PosedEvent(NamedTuple):
    """A scan or an odometry message with the result's poses at its stamp, whether these follow a track, and are known.

    A pose on a track that fits badly, or at one of several places that fit, is followed but not known.
    """

    event: Odometry | PairedScan
    T_map_odom: Pose2
    T_map_base: Pose2
    localised: bool
    known: bool


def posed_events(result: Result, progress: Callable[[float], None] | None = None) -> Iterator[PosedEvent]:
    """The events of the log in their order, the odometry continued over its resets, as the run saw it.

    They are read from the log once more, so that memory does not grow with it. The pose of a scan is composed with the
    odometry since the last message: within one message the correction hardly changes. `progress` is called with the
    part that is done.
    """
    log = result.log or open_log(result.request.logs, result.reading or result.request.reading())
    poses = result.trajectory.poses
    known = result.localised
    localised = known if result.tracked is None else result.tracked
    preparation = result.preparation
    row = -1
    corrections = _corrections(result, localised)
    T_map_odom: Pose2 | None = None

    with rarely_collected():
        recorded = Surroundings(log.events(), preparation)
        events = _with_recorded_odometry(recorded, result) if preparation.lidar_only else recorded
        prepared = PreparedEvents(events, preparation)
        for event in pair(prepared, deskew=preparation.deskewed, first=preparation.first):
            if isinstance(event, PairedScan):
                if result.follows_scans:
                    row += 1
                    yield PosedEvent(event, IDENTITY, Pose2(*poses[row].tolist()), True, bool(known[row]))
                else:
                    if T_map_odom is None:
                        T_map_odom = next(_corrections(result, localised))[0]
                    T_map_base, at = T_map_odom @ event.T_odom_base, max(row, 0)
                    yield PosedEvent(event, T_map_odom, T_map_base, bool(localised[at]), bool(known[at]))
            elif isinstance(event, Odometry) and not result.follows_scans:
                row += 1
                T_map_odom, T_map_base, follows = next(corrections)
                yield PosedEvent(event, T_map_odom, T_map_base, follows, bool(known[row]))
            if progress is not None and row % 500 == 0:
                progress(row / len(result.trajectory))


def _corrections(result: Result, localised: NDArray[np.bool_]) -> Iterator[tuple[Pose2, Pose2, bool]]:
    """T_map_odom and T_map_base at each odometry message, and whether the pose follows a track.

    Computed for a few thousand at once: for each alone it takes ten times as long, and a long run has many.
    """
    for at in range(0, len(result.odometry), _BLOCK):
        rows = slice(at, at + _BLOCK)
        poses = result.trajectory.poses[rows]
        corrections = _after_inverse(poses, result.odometry.poses[rows]).tolist()
        for T_map_odom, T_map_base, known in zip(corrections, poses.tolist(), localised[rows].tolist(), strict=True):
            yield Pose2(*T_map_odom), Pose2(*T_map_base), known


def _after_inverse(first: F64, second: F64) -> F64:
    """`first @ second^-1` row by row (n, 3), to the last digit as `Pose2` has it."""
    c, s = np.cos(second[:, 2]), np.sin(second[:, 2])
    x, y = -c * second[:, 0] - s * second[:, 1], s * second[:, 0] - c * second[:, 1]
    c, s = np.cos(first[:, 2]), np.sin(first[:, 2])
    theta = _wrapped(first[:, 2] + _wrapped(-second[:, 2]))
    return np.column_stack((first[:, 0] + c * x - s * y, first[:, 1] + s * x + c * y, theta))


def _wrapped(angles: F64) -> F64:
    """Angles (n,) in (-pi, pi], those that are there already as they were."""
    outside = np.flatnonzero(~((angles > -pi) & (angles <= pi)))
    angles[outside] = [wrap_angle(angle) for angle in angles[outside].tolist()]
    return angles


def _with_recorded_odometry(events: Iterable[Event], result: Result) -> Iterator[Event]:
    """Events without the log's odometry; before each scan comes the odometry that the run made of the scans, if any."""
    recorded = iter(zip(result.odometry.stamps_ns.tolist(), result.odometry.poses.tolist(), strict=True))
    for event in events:
        if isinstance(event, Odometry):
            continue
        if isinstance(event, Scan) and (found := next(recorded, None)) is not None:
            yield Odometry(found[0], Pose2(*found[1]))
        yield event

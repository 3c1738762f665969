"""A second pass over the log of a finished run: its scans and odometry once more, now with the poses of the result."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from hsloc.garbage_collection import rarely_collected
from hsloc.log import open_log
from hsloc.model.events import Odometry, PairedScan, Scan
from hsloc.model.pose2 import IDENTITY, Pose2
from hsloc.preprocessing.odometry import ContinuousOdometry
from hsloc.preprocessing.scans import ScanWatch, pair

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from hsloc.model.events import Event
    from hsloc.replay.run import Result


class PosedEvent(NamedTuple):
    """A scan or an odometry message with the result's poses at its stamp, and whether these follow a track."""

    event: Odometry | PairedScan
    T_map_odom: Pose2
    T_map_base: Pose2
    localised: bool


def posed_events(result: Result, progress: Callable[[float], None] | None = None) -> Iterator[PosedEvent]:
    """The events of the log in their order, the odometry continued over its resets, as the run saw it.

    They are read from the log once more, so that memory does not grow with it. The pose of a scan is composed with the
    odometry since the last message: within one message the correction hardly changes. `progress` is called with the
    part that is done.
    """
    log = result.log or open_log(result.request.logs, result.reading or result.request.reading())
    poses, odometry = result.trajectory.poses, result.odometry.poses
    localised = result.localised if result.tracked is None else result.tracked
    first = None if result.follows_scans else Pose2.from_array(odometry[0])
    row = -1
    known: tuple[Pose2, Pose2] | None = None

    def correction(row: int) -> tuple[Pose2, Pose2]:
        # In Python's own numbers, which are ten times as fast as numpy's single ones.
        T_map_base = Pose2(*poses[row].tolist())
        return T_map_base @ Pose2(*odometry[row].tolist()).inverse(), T_map_base

    with rarely_collected():
        events = _with_recorded_odometry(log.events(), result) if result.lidar_only else log.events()
        joined = ContinuousOdometry(events)
        watched = joined if result.lidar_only else ScanWatch(joined)
        for event in pair(watched, deskew=result.deskewed, first=first):
            if isinstance(event, PairedScan):
                if result.follows_scans:
                    row += 1
                    yield PosedEvent(event, IDENTITY, Pose2(*poses[row].tolist()), True)
                else:
                    T_map_odom = (known or correction(0))[0]
                    yield PosedEvent(event, T_map_odom, T_map_odom @ event.T_odom_base, bool(localised[max(row, 0)]))
            elif isinstance(event, Odometry) and not result.follows_scans:
                row += 1
                known = correction(row)
                yield PosedEvent(event, *known, bool(localised[row]))
            if progress is not None and row % 500 == 0:
                progress(row / len(result.trajectory))


def _with_recorded_odometry(events: Iterable[Event], result: Result) -> Iterator[Event]:
    """Events without the log's odometry; before each scan comes the odometry that the run made of the scans, if any."""
    recorded = iter(zip(result.odometry.stamps_ns.tolist(), result.odometry.poses.tolist(), strict=True))
    for event in events:
        if isinstance(event, Odometry):
            continue
        if isinstance(event, Scan) and (found := next(recorded, None)) is not None:
            yield Odometry(found[0], Pose2(*found[1]))
        yield event

"""The laser's own path through a log, from its scans alone: what a calibration compares the odometry with."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hsloc.calibration.estimator import Track, Undetermined
from hsloc.model.calibration import corrected_odometry
from hsloc.model.events import Odometry, PairedScan, Scan
from hsloc.model.pose2 import IDENTITY
from hsloc.preprocessing.odometry import ContinuousOdometry
from hsloc.preprocessing.scans import pair
from hsloc.slam.mapper import Mapper
from hsloc.slam.time_offset import half_sweep_ns

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from hsloc.calibration.estimator import Estimate
    from hsloc.model.events import Event
    from hsloc.slam.parameters import GraphMapperParameters


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """The laser's poses in a map of its own, and the odometry as the log has it.

    The laser's stamps are those of the middle of each sweep, or, of deskewed scans, of the first beam. `is_swept` says
    whether the beams of a scan have times of their own.
    """

    laser: Track
    odometry: Track
    is_swept: bool


def tracks(
    events: Iterable[Event],
    parameters: GraphMapperParameters,
    known: Estimate | None = None,
    progress: Callable[[int], None] | None = None,
) -> Tracks:
    """Map a log without its odometry, in the frame of its laser: the scans of `events` must be mounted at the origin.

    `known` is a calibration by which scans are deskewed; its time offset is part of the stamps already. `progress` is
    called with stamps (ns). Raises Undetermined where there is nothing to compare.
    """
    odometry: list[tuple[int, float, float, float]] = []
    mapper = Mapper(replace(parameters, use_odometry=False), np.random.default_rng(0))
    is_swept = False
    middles: dict[int, int] = {}
    for event in _paired(_noted(events, odometry), known):
        scan = event.scan
        is_swept |= scan.time_increment != 0.0
        middles[scan.stamp_ns] = scan.stamp_ns + (0 if scan.T_base_beam is not None else half_sweep_ns(scan))
        mapper.update(event)
        if progress is not None:
            progress(scan.stamp_ns)
    if len(odometry) < 2:
        raise Undetermined("there is no odometry")
    found = mapper.finish()
    if len(found.keyscan_poses) < 2:
        raise Undetermined("the scans show no motion")
    stamps = np.array([middles[stamp] for stamp in found.keyscan_stamps_ns.tolist()], dtype=np.int64)
    return Tracks(
        Track.of(stamps, found.keyscan_poses),
        Track.of(np.array([row[0] for row in odometry], dtype=np.int64), np.array([row[1:] for row in odometry])),
        is_swept,
    )


def _noted(events: Iterable[Event], odometry: list[tuple[int, float, float, float]]) -> Iterator[Event]:
    """Scans and odometry, the latter kept in `odometry`."""
    for event in ContinuousOdometry(events):
        if isinstance(event, Odometry):
            pose = event.T_odom_base
            odometry.append((event.stamp_ns, pose.x, pose.y, pose.theta))
            yield event
        elif isinstance(event, Scan):
            yield event


def _paired(events: Iterable[Event], known: Estimate | None) -> Iterator[PairedScan]:
    """The scans, in the frame of the laser as their base; deskewed by what is known of the motion."""
    if known is None:
        yield from (PairedScan(event, IDENTITY) for event in events if isinstance(event, Scan))
        return
    mounting = known.T_base_laser
    of_laser = (
        replace(event, T_odom_base=event.T_odom_base @ mounting) if isinstance(event, Odometry) else event
        for event in corrected_odometry(events, known.correction)
    )
    yield from (event for event in pair(of_laser, deskew=True) if isinstance(event, PairedScan))

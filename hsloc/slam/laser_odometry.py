"""Odometry from scans alone: what the front end of the mapper says of the motion from scan to scan.

A localiser that predicts with it follows a robot on a given map without wheels.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hsloc.model.events import Heading, Odometry, PairedScan, Scan
from hsloc.model.pose2 import IDENTITY
from hsloc.slam.front_end import FrontEnd

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from numpy.random import Generator

    from hsloc.model.events import Event
    from hsloc.slam.front_end_parameters import FrontEndParameters


def with_laser_odometry(events: Iterable[Event], parameters: FrontEndParameters, rng: Generator) -> Iterator[Event]:
    """Events whose odometry is replaced: before each scan comes the pose that the scans so far say it was taken from.

    Headings, where there are any, predict the rotations. Scans too sparse to match keep the last pose. The odometry
    begins at the origin, with the first scan.
    """
    front_end = FrontEnd(parameters, rng, use_odometry=False)
    heading: float | None = None
    for event in events:
        if isinstance(event, Odometry):
            continue
        if isinstance(event, Heading):
            heading = event.theta
            continue
        if isinstance(event, Scan):
            paired = PairedScan(event, IDENTITY, heading=heading)
            found = front_end.update(paired)
            yield Odometry(event.stamp_ns, found.pose)
        yield event

"""What stands behind a `Log`: ROS messages in containers, or lines of text."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol

if TYPE_CHECKING:
    from collections.abc import Iterator

    from hsloc.log.messages.decode import LinkMessage, OdometryMessage, ScanMessage
    from hsloc.log.summary import LogSummary, Losses
    from hsloc.model import Event, OccupancyGrid, Pose2


class Observation(NamedTuple):
    """A message as the log has it, in the order of the log: nothing is sorted, chosen or put right."""

    topic: str
    log_time_ns: int
    message: ScanMessage | OdometryMessage | list[LinkMessage]


class Source(Protocol):
    """A log's events in a total order.

    Contract: `events` yields (effective stamp, event); called twice it yields the same twice. It raises nothing but
    LogError, and counts what it cannot read in `losses`. `losses_at_opening` were already found at opening.
    """

    summary: LogSummary
    losses_at_opening: Losses

    def events(self, losses: Losses) -> Iterator[tuple[int, Event]]:
        """All events."""
        ...

    def observations(self, losses: Losses) -> Iterator[Observation]:
        """All scans, odometry and transforms of all topics, for checks."""
        ...

    def map(self) -> OccupancyGrid | None:
        """The map in the log, if there is one."""
        ...

    def initial_pose(self) -> tuple[int, Pose2] | None:
        """A start pose that the log states."""
        ...

    def verify(self) -> Losses:
        """Read everything, also what events are not made of, and count what is damaged."""
        ...

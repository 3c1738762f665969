"""What stands behind a `Log`: ROS messages in containers, or lines of text."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Iterator

    from hsloc.log.summary import LogSummary, Losses
    from hsloc.model import Event, OccupancyGrid, Pose2


class Source(Protocol):
    """A log's events in a total order.

    Law: `events` yields (effective stamp, event); called twice it yields the same twice. It raises nothing but
    LogError, and counts what it cannot read in `losses`. `losses_at_opening` were already found at opening.
    """

    summary: LogSummary
    losses_at_opening: Losses

    def events(self, losses: Losses) -> Iterator[tuple[int, Event]]:
        """All events."""
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

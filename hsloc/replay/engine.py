"""The replay engine: events in, estimates out, in one repeatable order.

Pull-based: the next event is read when the estimator is done with the last, so that nothing is ever dropped and the
clock has no say.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from hsloc.model.events import Odometry, PairedScan, Truth
from hsloc.preprocessing.scans import merged_scans, pair

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from hsloc.model.estimate import Estimate
    from hsloc.model.events import Event
    from hsloc.model.pose2 import Pose2


class Estimator(Protocol):
    """Localiser or mapper. Contract: the same events and seed give the same estimates; the truth never reaches it."""

    def update(self, event: Odometry | PairedScan) -> Estimate:
        """Take the next event; the estimate at its stamp."""
        ...


def replay(
    events: Iterable[Event], estimator: Estimator, *, deskew: bool = False, first: Pose2 | None = None
) -> Iterator[tuple[Odometry | PairedScan | Truth, Estimate | None]]:
    """Each event with what the estimator says to it (None for the truth, which it does not see)."""
    for event in merged_scans(pair(events, deskew=deskew, first=first)):
        yield event, None if isinstance(event, Truth) else estimator.update(event)

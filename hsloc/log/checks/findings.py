"""What a check finds: counted, with the first place and the remedy; memory does not grow with the log."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Collection

NANOSECONDS = 1_000_000_000
EDGES_MS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000)
"""Upper edges of the histogram of intervals, ms."""


class Severity(StrEnum):
    """How bad a finding is: `error` spoils results, `warning` may, `info` is good to know, `damage` is data lost."""

    ERROR = "error"
    WARNING = "warning"
    INFO = "info"
    DAMAGE = "damage"


class Place(NamedTuple):
    """A message: its number on its topic (from 0), its stamp and when the log received it."""

    topic: str
    number: int
    stamp_ns: int
    log_time_ns: int


@dataclass(slots=True)
class Finding:
    """One kind of trouble on one topic: how often, where first, what it means, and what to do."""

    code: str
    severity: Severity
    topic: str
    text: str
    remedy: str
    count: int = 0
    first: Place | None = None


@dataclass(slots=True)
class Findings:
    """Findings by code and topic, in the order in which they were first met."""

    found: dict[tuple[str, str], Finding] = field(default_factory=dict)

    def add(self, severity: Severity, code: str, place: Place | str, text: str, remedy: str, count: int = 1) -> None:
        """Count a finding; text, remedy and place are those of the first."""
        topic = place if isinstance(place, str) else place.topic
        known = self.found.get((code, topic))
        if known is None:
            known = self.found[code, topic] = Finding(code, severity, topic, text, remedy)
            known.first = None if isinstance(place, str) else place
        known.count += count

    def drop(self, codes: Collection[str], topic: str | None = None) -> None:
        """Forget findings of some codes, of one topic or of all."""
        self.found = {
            (code, of): finding
            for (code, of), finding in self.found.items()
            if code not in codes or topic not in (None, of)
        }

    def sorted(self) -> list[Finding]:
        """The worst first; of one severity, in the order in which they were met."""
        order = (Severity.DAMAGE, Severity.ERROR, Severity.WARNING, Severity.INFO)
        return sorted(self.found.values(), key=lambda finding: order.index(finding.severity))


@dataclass(slots=True)
class Intervals:
    """Times between a topic's messages, by their stamps: a histogram, and what is usual.

    `usual_ns` is the median of the first 50 positive intervals, None until there are 50 (or `settle` is called).
    """

    usual_ns: int | None = None
    count: int = 0
    shortest_ns: int | None = None
    longest_ns: int | None = None
    histogram: list[int] = field(default_factory=lambda: [0] * (len(EDGES_MS) + 1))
    waiting: list[tuple[int, Place]] = field(default_factory=list)

    def add(self, interval_ns: int, place: Place) -> list[tuple[int, Place]]:
        """Take an interval; returns those that can now be compared with what is usual."""
        self.count += 1
        self.shortest_ns = interval_ns if self.shortest_ns is None else min(self.shortest_ns, interval_ns)
        self.longest_ns = interval_ns if self.longest_ns is None else max(self.longest_ns, interval_ns)
        milliseconds = interval_ns / 1e6
        self.histogram[sum(milliseconds > edge for edge in EDGES_MS)] += 1
        if self.usual_ns is not None:
            return [(interval_ns, place)]
        self.waiting.append((interval_ns, place))
        return self.settle() if len(self.waiting) >= 50 else []

    def settle(self) -> list[tuple[int, Place]]:
        """Call what was seen so far usual."""
        waiting, self.waiting = self.waiting, []
        if self.usual_ns is None and len(waiting) >= 5:
            values = sorted(interval for interval, _ in waiting)
            self.usual_ns = values[len(values) // 2]
        return waiting if self.usual_ns is not None else []

    def to_dict(self) -> dict[str, Any]:
        """Seconds, and the histogram as pairs of upper edge (s, None: no limit) and count."""
        edges = [edge / 1000.0 for edge in EDGES_MS] + [None]

        def seconds(value: int | None) -> float | None:
            return None if value is None else value / NANOSECONDS

        return {
            "usual_s": seconds(self.usual_ns),
            "shortest_s": seconds(self.shortest_ns),
            "longest_s": seconds(self.longest_ns),
            "histogram": [[edge, n] for edge, n in zip(edges, self.histogram, strict=True) if n],
        }

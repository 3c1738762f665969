"""The verdict on a map, and its reasons."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

Verdict = Literal["good", "check", "failed"]


@dataclass(frozen=True, slots=True)
class Reason:
    """Why a map should be looked at: a code for scripts, a sentence, and where and when.

    `places` are positions in the map (m), `times_s` pairs of seconds since the first keyscan. `verdict` is "check" or
    "failed".
    """

    code: str
    text: str
    verdict: Verdict
    places: tuple[tuple[float, float], ...] = ()
    times_s: tuple[tuple[float, float], ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "code": self.code,
            "text": self.text,
            "verdict": self.verdict,
            "places": [list(place) for place in self.places],
            "times_s": [list(times) for times in self.times_s],
        }


@dataclass(frozen=True, slots=True)
class Evidence:
    """The verdict on a map: the worst of its reasons, "good" without one."""

    verdict: Verdict
    reasons: tuple[Reason, ...] = ()
    stray_scans: tuple[tuple[float, float], ...] = ()
    """Seconds since the first keyscan of single scans beside their place: they spoil what they draw, not the map."""

    @staticmethod
    def of(reasons: list[Reason], stray_scans: tuple[tuple[float, float], ...] = ()) -> Evidence:
        """The worst first."""
        ordered = sorted(reasons, key=lambda reason: reason.verdict != "failed")
        return Evidence(ordered[0].verdict if ordered else "good", tuple(ordered), stray_scans)

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {"verdict": self.verdict, "reasons": [reason.to_dict() for reason in self.reasons]}

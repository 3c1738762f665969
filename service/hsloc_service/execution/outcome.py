"""How an attempt at a job ended."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Outcome:
    """`kind` is `done`, `failed`, `crashed`, `again` (to be tried again) or `lost` (another attempt holds the job)."""

    kind: str
    reason: str = ""
    message: str = ""
    summary: dict[str, Any] | None = None


def interrupted(reason: str) -> Outcome:
    """The outcome of an attempt that had to stop, by the reason that the heartbeat gave."""
    return {
        "shutdown": Outcome("again", "shutdown", "the server was stopped"),
        "cancelled": Outcome("failed", "cancelled", "cancelled"),
        "lost": Outcome("lost"),
    }[reason]

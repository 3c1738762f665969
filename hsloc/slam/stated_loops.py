"""Loops that the user states: that two times of a log saw one place, or that they did not."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from typing import TYPE_CHECKING

import numpy as np

from hsloc.errors import ConfigError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.slam.submaps import Submaps

_FARTHEST_S = 10.0
"""Time [s] from a stated one to the nearest keyscan beyond which it names no place: longer than robots wait."""


@dataclass(frozen=True, slots=True)
class StatedLoops:
    """Pairs of times, seconds after the first event of the log: of one place, and not of one place."""

    asserted: tuple[tuple[float, float], ...] = ()
    forbidden: tuple[tuple[float, float], ...] = ()

    @staticmethod
    def parsed(asserted: str | None, forbidden: str | None) -> StatedLoops:
        """From the texts of `--assert-loop` and `--forbid-loop`. Raises ConfigError."""
        return StatedLoops(_pairs("--assert-loop", asserted), _pairs("--forbid-loop", forbidden))


def _pairs(flag: str, text: str | None) -> tuple[tuple[float, float], ...]:
    if text is None:
        return ()
    try:
        times = [float(part) for part in text.split(",")]
    except ValueError:
        times = []
    if not times or len(times) % 2 or not all(isfinite(time) and time >= 0.0 for time in times):
        raise ConfigError(f"{flag} is {text!r}; it must be two times T1,T2 in seconds after the beginning of the log")
    return tuple((min(pair), max(pair)) for pair in zip(times[::2], times[1::2], strict=True))


def stated_places(
    pairs: tuple[tuple[float, float], ...], seconds: NDArray[np.float64], places: Submaps, flag: str
) -> list[tuple[int, int]]:
    """The submaps of pairs of times; `seconds` (n,) are those of the keyscans. Raises ConfigError.

    The nearest keyscan in time counts: a robot that stands still makes none.
    """
    found = []
    for pair in pairs:
        rows = [int(np.argmin(np.abs(seconds - time))) for time in pair]
        for time, row in zip(pair, rows, strict=True):
            if abs(seconds[row] - time) > _FARTHEST_S:
                raise ConfigError(
                    f"{flag} {pair[0]:g},{pair[1]:g}: no scan of the map was taken about {time:g} s; the scans last "
                    f"from {seconds.min():.1f} to {seconds.max():.1f} s"
                )
        first, second = sorted(places.place_of(row) for row in rows)
        found.append((first, second))
    return found

"""What readings at the end of a scanner's scale mean, in logs that do not say: limits, codes and no return."""

from __future__ import annotations

from dataclasses import dataclass
from math import acos
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

NO_RETURN_CM = 8183
"""Reading (cm) of a SICK LMS without a return."""
CLIP_REPEATS = 3
"""Minimum number of equal largest readings of a log that make them a clipping value."""
CLIP_MIN = 5.0
"""Minimum clipping value (m)."""
RANGE_MIN = 0.02
"""Minimum range (m); readings of zero are invalid."""


@dataclass(slots=True)
class RangeRule:
    """Special values of a SICK scanner, learned from a whole log before its events are made.

    The scanners of the classic logs measure in 13 bits of centimetres, of which the last are codes (telegram
    listing LMS2xx): 8183 is *more than the maximum*, 8184 to 8191 are *no valid value*. So 81.83 m becomes +inf
    (no return), and what is above it NaN. Some logs were clipped afterwards: where the largest reading below the
    codes is a whole number of metres (5 at least) and occurs three times or more, it is the clipping value and
    becomes +inf.
    """

    largest: float = 0.0
    repeats: int = 0

    def learn(self, ranges: NDArray[np.float32]) -> None:
        """Take in a scan's readings (m)."""
        plain = ranges[ranges < (NO_RETURN_CM - 0.5) / 100.0]
        if not len(plain):
            return
        top = float(plain.max())
        if top > self.largest:
            self.largest, self.repeats = top, 0
        if top == self.largest:
            self.repeats += int(np.count_nonzero(plain == np.float32(top)))

    @property
    def clip(self) -> float | None:
        """The value at which readings were clipped, metres, or None."""
        whole = self.largest >= CLIP_MIN and abs(self.largest - round(self.largest)) < 1e-4
        return self.largest if whole and self.repeats >= CLIP_REPEATS else None

    @property
    def _first_special_cm(self) -> float:
        """No reading up to this one (cm) is special."""
        return NO_RETURN_CM - 1.0 if self.clip is None else min(100.0 * self.clip, NO_RETURN_CM) - 1.0

    @property
    def range_max(self) -> float:
        """The largest range that can be measured, metres."""
        return NO_RETURN_CM / 100.0 if self.clip is None else self.clip

    def apply(self, ranges: NDArray[np.float32]) -> NDArray[np.float32]:
        """Readings with their special values as in ROS (REP 117); the same array where there is none."""
        centimetres = ranges * np.float32(100.0)
        if not (centimetres > self._first_special_cm).any():
            return ranges
        result = ranges.copy()
        result[np.abs(centimetres - NO_RETURN_CM) < 0.5] = np.inf
        result[np.isfinite(ranges) & (centimetres > NO_RETURN_CM + 0.5)] = np.nan
        if self.clip is not None:
            result[(ranges >= self.clip - 1e-4) & (centimetres < NO_RETURN_CM - 0.5)] = np.inf
        return result


_BAND = 0.005
"""Width of a code as a part of its value: some drivers add the noise of a measurement to it."""
_STEP = 0.02
"""Rounding of common lidars and their noise (m), both ways: as much do equal readings of a wall differ."""
_MIN_BEAMS = 8
_MIN_SCANS = 3
"""Number of scans that must prove a code."""
_SAFETY = 1.5
"""Ratio of the angle of a proof to that over which a straight wall could be so even."""
_MAX_BEYOND = 0.005
"""Maximum part of the readings beyond a code: it is at the far end of the scale, but for stray ones."""


@dataclass(slots=True)
class NoReturnCode:
    """A finite reading at the far end of the scale that stands for no return, known by a shape that no wall has.

    A straight wall at the distance d is measured at d / cos(a) at the angle a beside its perpendicular: over an angle
    of width w the readings differ by a part of at least 1 / cos(w / 2) - 1. Beams side by side that are more even than
    that, at the end of the scale, and in several scans, measured no wall. Found while the log is read; `low` and `high`
    (m) bound the values.
    """

    low: float = 0.0
    high: float = 0.0
    scans: int = 0
    readings: int = 0
    beyond: int = 0

    @property
    def is_known(self) -> bool:
        """Whether it is proved."""
        return self.scans >= _MIN_SCANS and self.beyond <= _MAX_BEYOND * self.readings

    def learn(self, ranges: NDArray[np.float32], increment: float, limits: tuple[float, float]) -> None:
        """Take in a scan's readings (m), the angle between beams (rad) and the limits of valid readings (m)."""
        with np.errstate(invalid="ignore"):
            valid = (ranges >= limits[0]) & (ranges <= limits[1])
        readings = ranges[valid]
        if len(readings) < _MIN_BEAMS:
            return
        top = float(readings.max())
        self.readings += len(readings)
        self.beyond += int(np.count_nonzero(readings > self.high + _STEP)) if self.scans else 0
        if top < CLIP_MIN or (self.scans and top < self.low * (1.0 - _BAND)):
            return
        even = valid & (ranges >= top * (1.0 - _BAND) - _STEP)
        if np.count_nonzero(even) < _MIN_BEAMS:
            return
        edges = np.flatnonzero(np.diff(np.concatenate(([False], even, [False]))))
        begins, ends = edges[::2], edges[1::2]
        longest = int(np.argmax(ends - begins))
        run = ranges[begins[longest] : ends[longest]]
        low, high = float(run.min()), float(run.max())
        widest_wall = 2.0 * acos(1.0 / (1.0 + (high - low + _STEP) / low))
        if not (len(run) >= _MIN_BEAMS and (len(run) - 1) * abs(increment) > _SAFETY * widest_wall):
            return
        if self.scans and abs(high - self.high) <= _BAND * high + _STEP:
            self.low, self.high, self.scans = min(low, self.low), max(high, self.high), self.scans + 1
        elif high > self.high:
            self.low, self.high, self.scans, self.beyond, self.readings = low, high, 1, 0, len(readings)

    def apply(self, ranges: NDArray[np.float32]) -> NDArray[np.float32]:
        """The readings (m), +inf in place of the code."""
        if not self.is_known:
            return ranges
        with np.errstate(invalid="ignore"):
            coded = (ranges >= self.low - 1e-3) & (ranges <= self.high + 1e-3)
        return np.where(coded, np.float32(np.inf), ranges) if coded.any() else ranges

    def __str__(self) -> str:
        values = f"{self.low:.2f}" if self.high - self.low < 0.005 else f"{self.low:.2f} to {self.high:.2f}"
        return f"readings of {values} m at the end of the scale follow no wall: they are read as no return"

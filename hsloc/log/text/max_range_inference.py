"""What readings at the end of a scanner's scale mean, in logs that do not say."""

from __future__ import annotations

from dataclasses import dataclass
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
    def range_max(self) -> float:
        """The largest range that can be measured, metres."""
        return NO_RETURN_CM / 100.0 if self.clip is None else self.clip

    def apply(self, ranges: NDArray[np.float32]) -> NDArray[np.float32]:
        """Readings with their special values as in ROS (REP 117)."""
        centimetres = ranges * np.float32(100.0)
        result = ranges.copy()
        result[np.abs(centimetres - NO_RETURN_CM) < 0.5] = np.inf
        result[np.isfinite(ranges) & (centimetres > NO_RETURN_CM + 0.5)] = np.nan
        if self.clip is not None:
            result[(ranges >= self.clip - 1e-4) & (centimetres < NO_RETURN_CM - 0.5)] = np.inf
        return result

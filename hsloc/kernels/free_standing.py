"""Things near a lidar that stand free: runs of beams that see nearer than those beside them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F32 = NDArray[np.float32]
    F64 = NDArray[np.float64]


@njit(cache=True, nogil=True)
def _seen(ranges: F32, k: int, limits: F32) -> float:
    """The range of beam k; infinite without a hit."""
    value = ranges[k]
    is_hit = np.isfinite(value) and limits[0] <= value <= limits[1]
    return np.float64(value) if is_hit else np.inf


@njit(cache=True, nogil=True)
def find_free_standing(
    ranges: F32, limits: F32, directions: F64, is_turn: bool, sizes: tuple[float, float, float], found: F64
) -> int:
    """Write first and last beam and the middle x, y (m) of each to `found` (n, 4); returns how many there are.

    `sizes` are the reach (m), the difference of range (m) to the beams on both sides, and the largest extent (m). Beams
    of one thing differ by less than that from one to the next; it is seen by two at least. The beams on one side may
    be nearer: something else hides a part of it. Of what is at the first or the last beam nothing is known. Where the
    beams go all the way round (`is_turn`) the first follows the last: a thing may end at a beam of number n and more.
    Hits are within the `limits` (2,); `directions` (n, 2) are unit vectors along the beams.
    """
    reach, gap, widest = sizes
    n = len(ranges)
    count = 0
    for first in range(n):
        here = _seen(ranges, first, limits)
        if here > reach or (first == 0 and not is_turn):
            continue
        before = _seen(ranges, first - 1 if first > 0 else n - 1, limits)
        if abs(before - here) <= gap:
            continue
        begin_x, begin_y = here * directions[first, 0], here * directions[first, 1]
        end_x, end_y, x, y = begin_x, begin_y, begin_x, begin_y
        last, edge, after, is_whole = first, here, np.inf, True
        while last - first < n - 1:
            k = (last + 1) % n
            after = _seen(ranges, k, limits)
            if last + 1 >= n and not is_turn:
                is_whole = False
                break
            if after > reach or abs(after - edge) > gap:
                break
            last += 1
            edge = after
            end_x, end_y = after * directions[k, 0], after * directions[k, 1]
            x += end_x
            y += end_y
        size = last - first + 1
        is_wide = (end_x - begin_x) ** 2 + (end_y - begin_y) ** 2 > widest * widest
        is_free = abs(after - edge) > gap and not (before < here and after < edge)
        if not is_whole or size < 2 or size == n or is_wide or not is_free:
            continue
        found[count, 0] = first
        found[count, 1] = last
        found[count, 2] = x / size
        found[count, 3] = y / size
        count += 1
    return count

"""Drawing points into a score field, one scan at a time: the field of a map that grows.

The field holds exp(-d / sigma), d being the distance to the nearest point added so far; a further point can only
raise it, so it is added by taking the maximum over its neighbourhood. Nothing is computed twice and no
distance transform is needed. All lengths are in cells, as in hsloc/kernels/fitness.py.
"""

from __future__ import annotations

from math import exp, sqrt
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from hsloc.kernels.fitness import pack

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F32 = NDArray[np.float32]
    F64 = NDArray[np.float64]

_STEPS = 64
"""Entries of the decay table per squared cell."""


@njit(cache=True, nogil=True)
def decay_table(sigma: float, radius: float) -> F32:
    """exp(-sqrt(q / 64) / sigma) for q = 0, 1, ... up to radius^2 * 64: an exponential by look-up."""
    n = int(radius * radius * _STEPS) + 2
    table = np.empty(n, dtype=np.float32)
    for q in range(n):
        table[q] = exp(-sqrt(q / _STEPS) / sigma)
    return table


@njit(cache=True, nogil=True)
def splat(scores: F32, packed: F32, points: F32, table: F32, radius: float, known: float) -> int:
    """Add points (n, 2) to `scores` (h, w) and bring `packed` (h - 1, w - 1, 4) up to date around them.

    `table` is `decay_table(sigma, radius)`; a node farther than `radius` from a point is not touched. A point whose
    nearest node already scores more than `known` is passed over: the map has it. Points outside are
    left out. Returns the number of points added.
    """
    height, width = scores.shape
    reach = int(radius) + 1
    added = 0
    steps = np.float32(_STEPS)
    limit = np.float32(radius * radius)
    for i in range(len(points)):
        x = points[i, 0]
        y = points[i, 1]
        if not (x > reach and y > reach and x < width - 2 - reach and y < height - 2 - reach):
            continue
        iu = int(x + np.float32(0.5))
        iv = int(y + np.float32(0.5))
        if scores[iv, iu] > known:
            continue
        added += 1
        for v in range(iv - reach, iv + reach + 1):
            dy = np.float32(v) - y
            for u in range(iu - reach, iu + reach + 1):
                dx = np.float32(u) - x
                squared = dx * dx + dy * dy
                if squared <= limit:
                    score = table[int(squared * steps)]
                    scores[v, u] = max(scores[v, u], score)
        pack(scores, packed, iv - reach - 1, iv + reach + 1, iu - reach - 1, iu + reach + 1)
    return added

"""Rays against line segments and circles, exactly: what the simulated lidar measures.

Serves the simulator alone. The localiser matches against a grid and has no ray caster; were one shared between
them, the errors of a discretisation would cancel and flatter the results.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

OVERLAP = 1e-9
"""Segments reach this fraction of their length beyond their ends, so that no ray slips through a corner."""


@njit(cache=True)
def cast_rays(
    origins: NDArray[np.float64],
    directions: NDArray[np.float64],
    segments: NDArray[np.float64],
    circles: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Distance along each ray to the first thing it meets, +inf where it meets nothing, shape (n,).

    `origins` and unit `directions` have shape (n, 2); `segments` (m, 4) are x0 y0 x1 y1; `circles` (k, 3) are
    x y radius. Segments parallel to the ray are not seen (a line has no thickness). A circle around the origin
    of a ray is not seen by it. All lengths have the same unit.
    """
    n = len(origins)
    distances = np.full(n, np.inf)
    for i in range(n):
        ox, oy = origins[i, 0], origins[i, 1]
        dx, dy = directions[i, 0], directions[i, 1]
        nearest = np.inf
        for j in range(len(segments)):
            # ox + t dx = ax + u ex and the same in y, solved by Cramer's rule
            ax, ay = segments[j, 0] - ox, segments[j, 1] - oy
            ex, ey = segments[j, 2] - segments[j, 0], segments[j, 3] - segments[j, 1]
            determinant = dx * ey - dy * ex
            if determinant == 0.0:
                continue
            t = (ax * ey - ay * ex) / determinant
            if t < 0.0 or t >= nearest:
                continue
            u = (ax * dy - ay * dx) / determinant
            if -OVERLAP <= u <= 1.0 + OVERLAP:
                nearest = t
        for j in range(len(circles)):
            cx, cy, radius = circles[j, 0] - ox, circles[j, 1] - oy, circles[j, 2]
            along = cx * dx + cy * dy
            beyond = cx * cx + cy * cy - radius * radius
            under_root = along * along - beyond
            if beyond <= 0.0 or along <= 0.0 or under_root < 0.0:
                continue
            t = along - np.sqrt(under_root)
            if t < nearest:
                nearest = t
        distances[i] = nearest
    return distances

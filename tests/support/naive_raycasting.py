"""The slow, obvious version of hsloc.kernels.raycasting: every ray against every shape, by solving for both."""

from __future__ import annotations

from typing import Any

import numpy as np


def cast_rays(origins: Any, directions: Any, segments: Any, circles: Any) -> Any:
    distances = np.full(len(origins), np.inf)
    for i, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
        hits = [np.inf]
        for segment in segments:
            start, end = segment[:2], segment[2:]
            # origin + t * direction == start + u * (end - start)
            system = np.column_stack((direction, start - end))
            if abs(np.linalg.det(system)) < 1e-15:
                continue
            t, u = np.linalg.solve(system, start - origin)
            if t >= 0 and -1e-9 <= u <= 1 + 1e-9:
                hits.append(t)
        for x, y, radius in circles:
            # |origin + t * direction - centre|^2 == radius^2
            offset = origin - (x, y)
            if np.linalg.norm(offset) <= radius:
                continue
            roots = np.roots((1.0, 2 * offset @ direction, offset @ offset - radius**2))
            hits += [root.real for root in roots if abs(root.imag) < 1e-12 and root.real >= 0]
        distances[i] = min(hits)
    return distances

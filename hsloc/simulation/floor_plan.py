"""Floor plans: rooms are cut out of solid material, furniture is put into them, and their faces are the walls."""

from __future__ import annotations

from math import cos, hypot, pi, sin
from typing import TYPE_CHECKING

import numpy as np

from hsloc.simulation.rasterise import outline

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    Array = NDArray[np.float64]
    Box = tuple[float, float, float, float]
    Point = tuple[float, float]


def floor_plan(rooms: Sequence[Box], blocks: Sequence[Box] = ()) -> Array:
    """Wall faces of a building, segments of shape (n, 4), in metres.

    `rooms` are boxes (x0, y0, x1, y1) of open floor: rooms, corridors and door openings, which must overlap or
    touch to be joined. `blocks` are boxes of solid in them: furniture, pillars. What is neither is wall.
    """
    boxes = np.array([*rooms, *blocks], dtype=np.float64)
    xs, ys = np.unique(boxes[:, (0, 2)]), np.unique(boxes[:, (1, 3)])
    xs, ys = (np.concatenate(((line[0] - 1.0,), line, (line[-1] + 1.0,))) for line in (xs, ys))
    solid = np.ones((len(ys) - 1, len(xs) - 1), dtype=np.bool_)
    for index, (x0, y0, x1, y1) in enumerate(boxes):
        columns = slice(int(np.searchsorted(xs, x0)), int(np.searchsorted(xs, x1)))
        rows = slice(int(np.searchsorted(ys, y0)), int(np.searchsorted(ys, y1)))
        solid[rows, columns] = index >= len(rooms)
    return outline(solid, xs, ys)


def polygon(corners: Iterable[Point]) -> Array:
    """A closed line through `corners` as segments of shape (n, 4)."""
    points = np.array(list(corners), dtype=np.float64)
    return np.hstack((points, np.roll(points, -1, axis=0)))


def box_at(x: float, y: float, length: float, width: float, degrees: float) -> Array:
    """A rectangle about its centre (x, y), turned by `degrees`: a desk that is not parallel to a wall."""
    c, s = cos(degrees * pi / 180), sin(degrees * pi / 180)
    half = [(a * length / 2, b * width / 2) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return _rounded(polygon((x + c * a - s * b, y + s * a + c * b) for a, b in half))


def pillar(x: float, y: float, radius: float, corners: int = 12) -> Array:
    """A round pillar as a regular polygon."""
    turns = [2 * pi * (i + 0.3) / corners for i in range(corners)]
    return _rounded(polygon((x + radius * cos(turn), y + radius * sin(turn)) for turn in turns))


def notched_wall(start: Point, end: Point, notches: Sequence[tuple[float, float, float]]) -> list[Point]:
    """The corners of a wall from `start` up to, not including, `end`, with recesses and pillars in it.

    A notch is (position along the wall, width, depth), metres: depth > 0 goes to the left of the wall's
    direction, < 0 to the right. Notches must be in order and not overlap.
    """
    length = hypot(end[0] - start[0], end[1] - start[1])
    tx, ty = (end[0] - start[0]) / length, (end[1] - start[1]) / length
    corners = [start]
    for at, width, depth in notches:
        for along, aside in ((at, 0.0), (at, depth), (at + width, depth), (at + width, 0.0)):
            corners.append((start[0] + along * tx - aside * ty, start[1] + along * ty + aside * tx))
    return [(round(x, 6), round(y, 6)) for x, y in corners]


def inset(corners: Sequence[Point], distance: float) -> list[Point]:
    """A polygon whose sides lie `distance` metres to the left of the given one's (inside, if counter-clockwise)."""
    result = []
    count = len(corners)
    for i in range(count):
        (ax, ay), (bx, by), (cx, cy) = corners[i - 1], corners[i], corners[(i + 1) % count]
        first, second = hypot(bx - ax, by - ay), hypot(cx - bx, cy - by)
        ux, uy, vx, vy = (bx - ax) / first, (by - ay) / first, (cx - bx) / second, (cy - by) / second
        # the corner moves along both normals: b + distance * (n_u + n_v) / (1 + u . v)
        scale = distance / (1.0 + ux * vx + uy * vy)
        result.append((bx - scale * (uy + vy), by + scale * (ux + vx)))
    return result


def _rounded(segments: Array) -> Array:
    """To the micrometre, so that the last bits of a sine do not depend on the machine."""
    return np.round(segments, 6)

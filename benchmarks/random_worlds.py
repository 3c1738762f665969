"""Worlds that are drawn at random for the league of maps: six kinds, none of them built in.

A seed gives a world. Bare stretches, long halls and look-alikes are among them on purpose.
"""

from __future__ import annotations

from itertools import pairwise
from math import cos, hypot, pi, sin
from typing import TYPE_CHECKING

import numpy as np

from hsloc.simulation.floor_plan import box_at, floor_plan, inset, notched_wall, pillar, polygon
from hsloc.simulation.world import World

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.random import Generator

    from hsloc.simulation.floor_plan import Box, Point


def loop(random: Generator) -> World:
    """A ring of corridors with three to eight corners, 1.5 to 3.5 m wide, with few or many recesses."""
    corners = int(random.integers(3, 9))
    angles = 2.0 * pi * (np.arange(corners) + random.uniform(-0.25, 0.25, corners)) / corners
    radii = random.uniform(9.0, 22.0) * random.uniform(0.75, 1.25, corners)
    centre = [(float(r * cos(a)), float(r * sin(a))) for r, a in zip(radii, angles, strict=True)]
    half, gap = random.uniform(0.75, 1.75), random.uniform(1.0, 9.0)
    walls = [
        polygon(_notched(inset(centre, -half), random, -1.0, gap)),
        polygon(_notched(inset(centre, half), random, 1.0, gap)),
    ]
    return World("loop", np.round(np.vstack(walls), 6), np.round(centre, 6), closed=True)


def rooms(random: Generator) -> World:
    """A corridor with rooms on both sides, some of which are visited; desks stand along the walls."""
    width, length = random.uniform(1.6, 3.0), random.uniform(18.0, 45.0)
    half = 0.5 * width
    boxes: list[Box] = [(0.0, -half, length, half)]
    furniture = []
    stops: list[tuple[float, list[Point]]] = []
    for side in (1.0, -1.0):
        at = random.uniform(0.0, 1.5)
        while at < length - 3.0:
            size, depth = random.uniform(2.8, 7.5), random.uniform(3.0, 6.5)
            end = min(at + size, length)
            near, far = half + 0.12, half + 0.12 + depth
            boxes.append((at, near, end, far) if side > 0.0 else (at, -far, end, -near))
            door = random.uniform(at + 0.4, end - 1.5)
            boxes.append((door, half, door + 0.95, near) if side > 0.0 else (door, -near, door + 0.95, -half))
            middle = side * (near + 0.5 * depth)
            if door > at + 1.4:
                furniture.append(box_at(at + 0.5, middle, 0.7, random.uniform(0.4, 1.6), random.uniform(-10.0, 10.0)))
            if random.random() < 0.5:
                furniture.append(box_at(0.5 * (at + end), side * (far - 0.4), random.uniform(0.6, 1.8), 0.6, 0.0))
            if random.random() < 0.6:
                x = door + 0.475
                stops.append((x, [(x, 0.0), (x, middle), (x, 0.0)]))
            at = end + 0.13
    stops.sort(key=lambda stop: stop[0])
    path: list[Point] = [(1.0, 0.0), *(point for _, stop in stops for point in stop), (length - 1.0, 0.0), (1.0, 0.0)]
    walls = np.vstack((floor_plan(boxes), *furniture))
    return World("rooms", np.round(walls, 6), np.round(_apart(path), 6), closed=True)


def tee(random: Generator) -> World:
    """A long corridor with side corridors, which are driven to their ends and back: no ring."""
    width, length = random.uniform(1.6, 3.2), random.uniform(20.0, 40.0)
    boxes: list[Box] = [(0.0, -0.5 * width, length, 0.5 * width)]
    path: list[Point] = [(1.5, 0.0)]
    at = random.uniform(4.0, 9.0)
    while at < length - 3.0:
        reach, side = random.uniform(6.0, 18.0), random.choice((-1.0, 1.0))
        half = 0.5 * random.uniform(1.5, 2.5)
        boxes.append((at - half, min(0.0, side * reach), at + half, max(0.0, side * reach)))
        path += [(at, 0.0), (at, side * (reach - 1.2)), (at, 0.0)]
        at += random.uniform(5.0, 12.0)
    path += [(length - 1.5, 0.0), (1.5, 0.0)]
    recesses, blocks = _irregular(boxes, random, random.uniform(1.0, 6.0))
    walls = floor_plan([*boxes, *recesses], blocks)
    return World("tee", np.round(walls, 6), np.round(_apart(path), 6), closed=True)


def hall(random: Generator) -> World:
    """A hall of 15 to 60 m with pillars and racks, driven round."""
    x, y = random.uniform(15.0, 60.0), random.uniform(12.0, 30.0)
    boxes: list[Box] = [(0.0, 0.0, x, y), (0.4 * x, y, 0.4 * x + 2.0, y + 1.0), (x, 0.3 * y, x + 0.6, 0.3 * y + 1.7)]
    posts = [
        pillar(random.uniform(0.25, 0.75) * x, random.uniform(0.3, 0.7) * y, random.uniform(0.15, 0.5))
        for _ in range(int(random.integers(1, 9)))
    ]
    blocks: list[Box] = []
    for _ in range(int(random.integers(0, 4))):
        a, size = random.uniform(0.1, 0.7) * x, random.uniform(0.8, 4.0)
        blocks.append((a, 0.0, a + size, random.uniform(0.3, 1.0)))
    margin = 2.2
    path = [(margin, margin), (x - margin, margin), (x - margin, y - margin), (margin, y - margin)]
    return World("hall", np.round(np.vstack((floor_plan(boxes, blocks), *posts)), 6), np.round(path, 6), closed=True)


def twins(random: Generator) -> World:
    """Two equal corridors side by side, with equal recesses, joined at both ends."""
    length, apart, width = random.uniform(14.0, 35.0), random.uniform(5.0, 12.0), random.uniform(1.7, 2.6)
    half = 0.5 * width
    ends: list[Box] = [(-half, -half, half, apart + half), (length - half, -half, length + half, apart + half)]
    recesses, blocks = _irregular([(0.0, -half, length, half)], random, random.uniform(1.5, 5.0))
    corridors: list[Box] = [(0.0, -half, length, half), (0.0, apart - half, length, apart + half)]
    again: list[Box] = [(a, b + apart, c, d + apart) for a, b, c, d in recesses]
    blocks = [*blocks, *((a, b + apart, c, d + apart) for a, b, c, d in blocks)]
    walls = floor_plan([*corridors, *ends, *recesses, *again], blocks)
    path = [(3.0, 0.0), (length, 0.0), (length, apart), (0.0, apart), (0.0, 0.0)]
    return World("twins", np.round(walls, 6), np.round(path, 6), closed=True)


def grid(random: Generator) -> World:
    """Crossing corridors, a block of four cells, driven as an eight: places are met from several sides."""
    xs = np.cumsum([0.0, *random.uniform(7.0, 16.0, 2)])
    ys = np.cumsum([0.0, *random.uniform(7.0, 16.0, 2)])
    half = 0.5 * random.uniform(1.6, 2.6)
    boxes: list[Box] = [(xs[0] - half, y - half, xs[-1] + half, y + half) for y in ys]
    boxes += [(x - half, ys[0] - half, x + half, ys[-1] + half) for x in xs]
    recesses, blocks = _irregular(boxes, random, random.uniform(1.0, 6.0))
    corners = [(0, 0), (1, 0), (1, 1), (2, 1), (2, 2), (1, 2), (1, 1), (0, 1)]
    path = [(float(xs[a]), float(ys[b])) for a, b in corners]
    return World("grid", np.round(floor_plan([*boxes, *recesses], blocks), 6), np.round(path, 6), closed=True)


KINDS: tuple[Callable[[Generator], World], ...] = (loop, rooms, tee, hall, twins, grid)


def building(random: Generator, metres: float) -> World:
    """Crossing corridors of 28 to 150 m with rooms, in half of the buildings evenly apart, driven at random so far."""
    columns, rows = int(random.integers(3, 5)), int(random.integers(2, 5))
    xs = np.cumsum([0.0, *random.uniform(14.0, 50.0, columns - 1)])
    ys = np.cumsum([0.0, *random.uniform(14.0, 40.0, rows - 1)])
    if random.random() < 0.5:
        xs, ys = np.linspace(0.0, xs[-1], columns), np.linspace(0.0, ys[-1], rows)
    half = 0.5 * random.uniform(1.7, 3.0)
    boxes: list[Box] = [(xs[0] - half, y - half, xs[-1] + half, y + half) for y in ys]
    boxes += [(x - half, ys[0] - half, x + half, ys[-1] + half) for x in xs]
    recesses, blocks = _irregular(boxes, random, random.uniform(2.0, 7.0))
    for y, above, below in zip(ys, [*np.diff(ys), np.inf], [np.inf, *np.diff(ys)], strict=True):
        for start, end in pairwise(xs):
            at = start + half + 0.5
            while at < end - half - 4.0:
                side = 1.0 if random.random() < 0.5 else -1.0
                size, depth = random.uniform(3.0, 6.0), random.uniform(3.0, 4.5)
                last = min(at + size, end - half - 0.3)
                if random.random() < 0.5 and (above if side > 0.0 else below) > 2.0 * half + 6.0:
                    wall, near, far = (y + side * (half + out) for out in (0.0, 0.12, 0.12 + depth))
                    door = random.uniform(at + 0.3, last - 1.3)
                    boxes.append((at, min(near, far), last, max(near, far)))
                    boxes.append((door, min(wall, near), door + 0.95, max(wall, near)))
                at = last + 0.15
    place, before, path, way = (0, 0), None, [(float(xs[0]), float(ys[0]))], 0.0
    while way < metres:
        i, j = place
        near_by = [(i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)]
        ways = [(a, b) for a, b in near_by if 0 <= a < columns and 0 <= b < rows and (a, b) != before]
        before, place = place, ways[random.integers(len(ways))]
        path.append((float(xs[place[0]]), float(ys[place[1]])))
        way += abs(path[-1][0] - path[-2][0]) + abs(path[-1][1] - path[-2][1])
    walls = floor_plan([*boxes, *recesses], blocks)
    return World("building", np.round(walls, 6), np.round(path, 6), closed=False)


def random_world(random: Generator) -> World:
    """A world of one of the kinds."""
    return KINDS[random.integers(len(KINDS))](random)


def _apart(path: list[Point]) -> list[Point]:
    """Without corners that nearly coincide."""
    kept = [path[0]]
    for point in path[1:]:
        if hypot(point[0] - kept[-1][0], point[1] - kept[-1][1]) > 0.3:
            kept.append(point)
    if hypot(kept[-1][0] - kept[0][0], kept[-1][1] - kept[0][1]) <= 0.3:
        kept.pop()
    return kept


def _notch(random: Generator) -> tuple[float, float]:
    """Width and depth of a door that is set back (depth > 0), or of a pillar that stands forth."""
    if random.random() < 0.6:
        return random.uniform(0.8, 1.4), random.uniform(0.08, 0.4)
    return random.uniform(0.2, 0.7), random.uniform(-0.28, -0.1)


def _notched(corners: list[Point], random: Generator, side: float, gap: float) -> list[Point]:
    """A polygon's walls with recesses and pillars, `gap` metres apart on average."""
    result: list[Point] = []
    for start, end in zip(corners, [*corners[1:], corners[0]], strict=True):
        length, notches = hypot(end[0] - start[0], end[1] - start[1]), []
        at = 0.8 + random.exponential(gap)
        while at < length - 2.2:
            width, depth = _notch(random)
            notches.append((at, width, side * depth))
            at += width + 0.5 + random.exponential(gap)
        result += notched_wall(start, end, notches)
    return result


def _irregular(corridors: list[Box], random: Generator, gap: float) -> tuple[list[Box], list[Box]]:
    """Recesses and pillars along the long walls of corridors that are given as boxes."""
    recesses: list[Box] = []
    pillars: list[Box] = []
    for x0, y0, x1, y1 in corridors:
        lengthwise = x1 - x0 > y1 - y0
        start, end, low, high = (x0, x1, y0, y1) if lengthwise else (y0, y1, x0, x1)
        for wall, outwards in ((low, -1.0), (high, 1.0)):
            at = start + 1.5 + random.exponential(gap)
            while at < end - 3.0:
                width, depth = _notch(random)
                a, b = sorted((wall, wall + outwards * depth))
                (recesses if depth > 0.0 else pillars).append(
                    (at, a, at + width, b) if lengthwise else (a, at, b, at + width)
                )
                at += width + 0.5 + random.exponential(gap)
    return recesses, pillars

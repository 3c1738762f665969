"""The worlds that come with the package. Dimensions are odd on purpose: no wall falls on a grid by design."""

from __future__ import annotations

from itertools import pairwise
from random import Random
from typing import TYPE_CHECKING

import numpy as np

from hsloc.errors import ConfigError
from hsloc.simulation.floor_plan import box_at, floor_plan, inset, notched_wall, pillar, polygon
from hsloc.simulation.world import World, rotated

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from hsloc.simulation.floor_plan import Box, Point


def office() -> World:
    """Nine rooms on both sides of a corridor, 27 x 16 m, with doors, furniture and one path from room to room."""
    rooms: list[Box] = [
        (0.523, 7.034, 27.317, 9.171),  # the corridor
        (0.523, 9.312, 5.631, 15.874),
        (5.774, 9.312, 11.943, 15.874),
        (12.081, 9.312, 15.217, 14.262),
        (15.356, 9.312, 21.773, 15.874),
        (21.911, 9.312, 27.317, 13.428),
        (0.523, 0.434, 7.487, 6.893),
        (7.622, 1.737, 12.894, 6.893),
        (13.033, 0.434, 19.362, 6.893),
        (19.504, 2.118, 27.317, 6.893),
    ]
    doors: list[Box] = [
        (2.114, 9.171, 3.057, 9.312),
        (9.838, 9.171, 10.781, 9.312),
        (13.177, 9.171, 14.120, 9.312),
        (16.232, 9.171, 17.175, 9.312),
        (24.381, 9.171, 25.324, 9.312),
        (4.914, 6.893, 5.857, 7.034),
        (8.213, 6.893, 10.674, 7.034),  # the kitchen has no door but an opening
        (17.641, 6.893, 18.584, 7.034),
        (22.087, 6.893, 23.030, 7.034),
        (11.943, 12.436, 12.081, 13.379),  # from room to room
        (19.362, 3.527, 19.504, 4.470),
    ]
    recesses: list[Box] = [
        (6.871, 9.171, 7.732, 9.283),  # a fire extinguisher
        (18.913, 9.171, 20.467, 9.259),  # a notice board
        (14.268, 6.917, 15.189, 7.034),
        (27.317, 7.663, 27.521, 8.604),  # the exit
    ]
    blocks: list[Box] = [
        (0.523, 14.217, 2.341, 15.874),
        (3.918, 15.362, 5.631, 15.874),
        (5.774, 11.318, 6.427, 13.962),
        (8.113, 15.277, 10.862, 15.874),
        (12.081, 9.312, 12.534, 11.217),
        (14.613, 10.731, 15.217, 14.262),
        (15.356, 13.413, 16.172, 15.874),
        (21.267, 10.113, 21.773, 13.738),
        (25.873, 12.817, 27.317, 13.428),
        (21.911, 10.362, 22.438, 12.117),
        (0.523, 0.434, 1.147, 4.187),
        (7.622, 1.737, 8.231, 5.341),  # the kitchen's counter
        (8.231, 1.737, 11.213, 2.362),
        (13.033, 0.434, 15.768, 1.071),
        (13.033, 5.412, 13.618, 6.893),
        (25.767, 2.118, 27.317, 2.743),
        (24.163, 6.437, 27.317, 6.893),
        (26.931, 7.034, 27.317, 7.412),
        (0.523, 7.034, 0.874, 7.903),  # lockers
    ]
    furniture = [
        box_at(4.463, 12.471, 1.604, 0.803, 87.0),
        box_at(9.217, 13.518, 1.597, 0.798, 4.0),
        box_at(18.613, 13.867, 1.803, 0.896, -11.0),
        box_at(18.237, 11.914, 0.523, 0.517, 31.0),
        box_at(24.874, 11.743, 1.597, 0.803, 93.0),
        box_at(3.268, 3.371, 2.397, 1.204, 14.0),
        box_at(4.817, 1.264, 0.612, 0.608, 40.0),
        box_at(11.237, 4.318, 1.204, 0.797, -6.0),
        box_at(15.871, 3.463, 3.193, 1.297, 2.0),
        box_at(23.917, 4.317, 2.604, 1.103, -3.0),
        pillar(15.237, 8.963, 0.173),
        pillar(21.317, 7.263, 0.173),
        pillar(17.113, 11.367, 0.219),
    ]
    waypoints = [
        (2.6, 8.1),
        (2.6, 10.6),
        (2.6, 13.2),
        (2.6, 10.6),
        (2.6, 8.1),
        (5.4, 8.0),
        (5.4, 5.6),
        (5.6, 3.3),
        (5.4, 5.6),
        (5.5, 8.0),
        (10.3, 8.1),
        (10.3, 10.3),
        (10.9, 12.9),
        (13.4, 12.9),
        (13.65, 10.6),
        (13.65, 8.0),
        (18.1, 8.0),
        (18.1, 5.5),
        (18.2, 4.1),
        (20.9, 4.0),
        (22.55, 5.6),
        (22.55, 8.1),
        (24.85, 8.2),
        (24.85, 9.9),
        (23.5, 11.6),
        (24.85, 9.9),
        (24.85, 8.2),
        (16.7, 8.1),
        (16.7, 10.0),
        (19.6, 10.6),
        (16.7, 10.0),
        (16.7, 8.1),
        (9.3, 8.1),
        (9.3, 5.4),
        (9.4, 3.6),
        (9.3, 5.4),
        (9.2, 8.1),
    ]
    walls = floor_plan([*rooms, *doors, *recesses], blocks)
    return World("office", np.vstack((walls, *furniture)), np.array(waypoints), closed=True)


def corridor_loop() -> World:
    """One loop of corridors, 2 m wide and 132 m around, with recesses and pillars at irregular places."""
    centre = [(0.0, 0.0), (37.4, -1.3), (41.8, 13.6), (33.2, 25.1), (11.7, 23.4), (3.1, 29.2), (-5.3, 17.7)]
    random = Random(20130913)
    outer, inner = inset(centre, -1.03), inset(centre, 1.01)
    # seen along the wall, the corridor lies to the left of the outer wall and to the right of the inner one
    walls = [polygon(_irregular(outer, random, -1.0)), polygon(_irregular(inner, random, 1.0))]
    first, second = np.array(centre[0]), np.array(centre[1])
    start = first + 0.4 * (second - first)
    waypoints = np.array([tuple(start.round(3)), *centre[1:], centre[0]])
    return World("corridor-loop", np.vstack(walls), waypoints, closed=True)


def hall() -> World:
    """A hall of 42 x 31 m with six pillars, two gates and bare walls."""
    rooms: list[Box] = [
        (0.0, 0.0, 41.683, 30.547),
        (12.317, 30.547, 16.428, 31.762),
        (41.683, 7.163, 42.237, 10.041),
        (-0.713, 19.378, 0.0, 23.117),
    ]
    blocks: list[Box] = [
        (28.163, 29.314, 33.447, 30.547),
        (0.0, 0.0, 2.271, 4.463),
        (20.417, 0.0, 20.943, 0.371),
        (35.113, 16.347, 37.862, 17.519),
    ]
    pillars = [
        pillar(9.763, 8.217, 0.447),
        pillar(19.417, 10.163, 0.447),
        pillar(31.218, 7.914, 0.447),
        pillar(8.364, 21.913, 0.447),
        pillar(20.863, 20.117, 0.613),
        pillar(30.113, 22.413, 0.447),
    ]
    waypoints = [(5.0, 6.5), (15.0, 5.0), (26.0, 4.0), (36.0, 6.0), (37.0, 12.5), (26.0, 14.0), (28.0, 19.0)]
    waypoints += [(35.0, 22.0), (25.0, 26.5), (14.0, 25.5), (5.0, 25.5), (4.5, 16.0), (14.0, 15.0)]
    turn = 0.131
    walls = np.vstack((floor_plan(rooms, blocks), *pillars))
    return World("hall", rotated(walls, turn), rotated(np.array(waypoints), turn), closed=True)


def paper() -> World:
    """The course report's set-up on a site of our own: some 400 points on the outlines of what stands there."""
    random = Random(25)
    outlines: list[list[Point]] = [
        [(-78, -62), (-20, -81), (44, -92), (98, -70), (139, -41)],
        [(139, -41), (131, 12), (118, 58), (62, 77)],
        [(62, 77), (8, 66), (-43, 83), (-88, 51)],
        [(-88, 51), (-94, -8), (-78, -62)],
        [(22, -13), (41, -19), (52, -4), (33, 3), (22, -13)],
        [(-31, -4), (-12, -9), (-8, 8), (-24, 13), (-31, -4)],
        [(84, 21), (103, 14), (109, 29), (91, 36), (84, 21)],
        [(-14, 49), (3, 44), (9, 57)],
        [(58, -55), (71, -59), (74, -47)],
        [(-52, -37), (-41, -46), (-35, -33)],
    ]
    points = []
    for corners in outlines:
        for (ax, ay), (bx, by) in pairwise(corners):
            steps = max(1, round(((bx - ax) ** 2 + (by - ay) ** 2) ** 0.5 / 2.35))
            for i in range(steps):
                fraction = (i + 0.7 * (random.random() - 0.5)) / steps
                aside = 0.9 * (random.random() - 0.5)
                points.append((ax + fraction * (bx - ax) + aside, ay + fraction * (by - ay) + aside))
    waypoints = [(0.0, 0.0), (48.0, -36.0), (103.0, -14.0), (58.0, 47.0), (-37.0, 32.0), (-58.0, -34.0)]
    return World("paper", np.empty((0, 4)), np.array(waypoints), points=np.round(points, 6), start_heading=0.0)


def figure_of_eight() -> World:
    """Two loops of corridors, 148 m in all, that share their crossing: it is passed twice, at right angles."""
    random = Random(8)
    rooms: list[Box] = [
        (0.0, 0.0, 21.317, 2.043),
        (0.0, 0.0, 2.061, 17.413),
        (0.0, 15.387, 21.317, 17.413),
        (19.274, 0.0, 21.317, 33.862),
        (19.274, 15.387, 44.163, 17.413),
        (42.117, 15.387, 44.163, 33.862),
        (19.274, 31.813, 44.163, 33.862),
    ]
    recesses, pillars = _irregular_boxes(rooms, random)
    walls = floor_plan([*rooms, *recesses], pillars)
    waypoints = [(12.0, 16.4), (1.0, 16.4), (1.0, 1.0), (20.3, 1.0), (20.3, 16.4)]
    waypoints += [(20.3, 32.8), (43.1, 32.8), (43.1, 16.4), (20.3, 16.4)]
    turn = -0.217
    return World("figure-of-eight", rotated(walls, turn), rotated(np.array(waypoints), turn), closed=True)


def symmetric_corridor() -> World:
    """A corridor of 60 m whose every 5 m look the same, with a room at each end that look alike, too, but for a box.

    Scans do not determine the position along it: a mapper that accepts every likeness closes wrong loops here.
    """
    rooms: list[Box] = [
        (0.0, 0.0, 60.117, 2.043),
        (-6.213, -2.531, 0.0, 4.574),
        (60.117, -2.531, 66.33, 4.574),
    ]
    doors = [(round(2.06 + 5.0 * i, 3), round(3.003 + 5.0 * i, 3)) for i in range(12)]
    recesses = [(a, y0, b, y1) for a, b in doors for y0, y1 in ((-0.18, 0.0), (2.043, 2.223))]
    blocks: list[Box] = [(64.913, 3.117, 66.33, 4.574)]
    waypoints = np.array([(-3.1, 1.02), (30.0, 1.02), (63.2, 1.02)])
    walls = rotated(floor_plan([*rooms, *recesses], blocks), 0.047)
    return World("symmetric-corridor", walls, rotated(waypoints, 0.047))


def _irregular(corners: Sequence[Point], random: Random, side: float) -> list[Point]:
    """A polygon's walls with doors set back and pillars set forth, no two gaps between them alike.

    `side` is +1 where the wall's solid lies to its left, else -1.
    """
    result: list[Point] = []
    for start, end in zip(corners, [*corners[1:], corners[0]], strict=True):
        length = float(np.hypot(end[0] - start[0], end[1] - start[1]))
        notches = []
        at = 1.2 + 2.4 * random.random()
        while at < length - 2.6:
            is_door = random.random() < 0.6
            width = 0.86 + 0.5 * random.random() if is_door else 0.24 + 0.5 * random.random()
            depth = 0.09 + 0.3 * random.random() if is_door else -0.1 - 0.18 * random.random()
            notches.append((at, width, side * depth))
            at += width + 0.7 + 3.8 * random.random()
        result += notched_wall(start, end, notches)
    return result


def _irregular_boxes(rooms: Sequence[Box], random: Random) -> tuple[list[Box], list[Box]]:
    """Recesses and pillars as boxes along the long walls of corridors given as boxes."""
    recesses: list[Box] = []
    pillars: list[Box] = []
    for x0, y0, x1, y1 in rooms:
        lengthwise = x1 - x0 > y1 - y0
        start, end, low, high = (x0, x1, y0, y1) if lengthwise else (y0, y1, x0, x1)
        for wall, outwards in ((low, -1.0), (high, 1.0)):
            at = start + 2.6 + 2.0 * random.random()
            while at < end - 3.6:
                is_door = random.random() < 0.6
                width = 0.86 + 0.5 * random.random() if is_door else 0.24 + 0.5 * random.random()
                depth = 0.09 + 0.3 * random.random() if is_door else -0.1 - 0.18 * random.random()
                a, b = sorted((wall, wall + outwards * depth))
                box = (at, a, at + width, b) if lengthwise else (a, at, b, at + width)
                (recesses if is_door else pillars).append((*(round(value, 6) for value in box),))  # type: ignore[arg-type]
                at += width + 0.9 + 4.1 * random.random()
    return recesses, pillars


WORLDS: dict[str, Callable[[], World]] = {
    "office": office,
    "corridor-loop": corridor_loop,
    "hall": hall,
    "paper": paper,
    "figure-of-eight": figure_of_eight,
    "symmetric-corridor": symmetric_corridor,
}
"""The built-in worlds by name."""


def built_in(name: str) -> World:
    """A built-in world. Raises ConfigError for an unknown name."""
    key = name.replace("_", "-")
    if key not in WORLDS:
        raise ConfigError(f"world {name!r} is unknown; choose from {', '.join(WORLDS)}, or give a file")
    return WORLDS[key]()

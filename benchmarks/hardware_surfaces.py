"""Surfaces that a lidar does not see as walls, a base that pitches, a laser that is knocked, things that are moved.

Each change takes a drive of `hardware_drives.py` and gives another one. Used by `hardware.py`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from hsloc.kernels.raycasting import cast_rays
from hsloc.model import Odometry, Pose2, Scan

if TYPE_CHECKING:
    from collections.abc import Callable

    from hardware_drives import Drive
    from numpy.typing import NDArray

    from hsloc.model import Event

    F64 = NDArray[np.float64]

PIECE_M = 1.5
"""Length of the pieces of walls that are of another material."""
RANGE_NOISE_M = 0.01
LASER_HEIGHT_M = 0.22


def _pieces(segments: F64) -> F64:
    """The walls cut into pieces of about `PIECE_M`."""
    found = []
    for x0, y0, x1, y1 in segments:
        ends = np.linspace(0.0, 1.0, max(round(float(np.hypot(x1 - x0, y1 - y0)) / PIECE_M), 1) + 1)
        x, y = x0 + ends * (x1 - x0), y0 + ends * (y1 - y0)
        found.append(np.column_stack((x[:-1], y[:-1], x[1:], y[1:])))
    return np.concatenate(found)


def _hits(origin: F64, directions: F64, pieces: F64) -> tuple[F64, NDArray[np.int64]]:
    """Distance (m) along each ray, and which piece is met; +inf and -1 where none is."""
    start = pieces[:, :2] - origin
    along = pieces[:, 2:] - pieces[:, :2]
    dx, dy = directions[:, 0, None], directions[:, 1, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        determinant = dx * along[:, 1] - dy * along[:, 0]
        t = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0]) / determinant
        u = (start[:, 0] * dy - start[:, 1] * dx) / determinant
        t = np.where((t > 1e-6) & (u >= 0.0) & (u <= 1.0), t, np.inf)
    which = np.argmin(t, axis=1)
    distance = t[np.arange(len(t)), which]
    return distance, np.where(np.isfinite(distance), which, -1)


def _of_material(share: float, seen: Callable[[Drive, F64, F64, F64, F64, F64], F64]) -> Callable[[Drive], Drive]:
    """A share of the walls is of a material: `seen` gives ranges of the beams that meet it.

    It gets the drive, the point where each beam meets it, the direction, the wall's normal towards the laser, the
    distance and the other walls, and returns ranges (n,).
    """

    def change(drive: Drive) -> Drive:
        pieces = _pieces(drive.world.segments)
        is_it = drive.rng.random(len(pieces)) < share
        others, truth = np.ascontiguousarray(pieces[~is_it]), drive.truth()

        def measured(scan: Scan) -> Scan:
            (pose,) = truth.interpolated(np.array([scan.stamp_ns]))
            at = Pose2.from_array(pose) @ scan.T_base_laser
            angles = at.theta + scan.angles()
            directions = np.column_stack((np.cos(angles), np.sin(angles)))
            distance, which = _hits(np.array((at.x, at.y)), directions, pieces)
            with np.errstate(invalid="ignore"):
                # Not the beams that a person or a limit of range ends before.
                meets = (which >= 0) & is_it[which] & ~(scan.ranges < distance - 0.1)
            wall = pieces[which[meets]]
            normal = np.column_stack((wall[:, 1] - wall[:, 3], wall[:, 2] - wall[:, 0]))
            normal /= np.hypot(*normal.T)[:, None]
            normal *= -np.sign(np.sum(normal * directions[meets], axis=1))[:, None]
            point = np.array((at.x, at.y)) + distance[meets, None] * directions[meets]
            ranges = scan.ranges.copy()
            new = seen(drive, point, directions[meets], normal, distance[meets], others)
            new = new + drive.rng.normal(0.0, RANGE_NOISE_M, len(new))
            ranges[meets] = np.where(new > scan.range_max, np.inf, new)
            return replace(scan, ranges=ranges)

        return drive.scans(measured)

    return change


def _through_glass(drive: Drive, point: F64, direction: F64, normal: F64, distance: F64, others: F64) -> F64:
    """Met at less than 12 deg from the normal it returns the beam; else what is behind is seen, or nothing."""
    cosine = -np.sum(direction * normal, axis=1)
    behind = distance + cast_rays(point + 1e-4 * direction, direction, others, np.empty((0, 3)))
    lost = drive.rng.random(len(point)) < 0.2
    return np.where(cosine > np.cos(np.radians(12.0)), distance, np.where(lost, np.inf, behind))


def _mirrored(_: Drive, point: F64, direction: F64, normal: F64, distance: F64, others: F64) -> F64:
    """What the beam meets after it was reflected, at the length of its whole way."""
    reflected = direction - 2.0 * np.sum(direction * normal, axis=1)[:, None] * normal
    return distance + cast_rays(point + 1e-4 * reflected, np.ascontiguousarray(reflected), others, np.empty((0, 3)))


def _dark(_: Drive, __: F64, direction: F64, normal: F64, distance: F64, ___: F64) -> F64:
    """It returns a beam within 4 m and 45 deg of the normal."""
    cosine = -np.sum(direction * normal, axis=1)
    return np.where((distance < 4.0) & (cosine > np.sqrt(0.5)), distance, np.inf)


def glass(share: float) -> Callable[[Drive], Drive]:
    """A share of the walls is of glass."""
    return _of_material(share, _through_glass)


def mirrors(share: float) -> Callable[[Drive], Drive]:
    """A share of the walls is of polished metal."""
    return _of_material(share, _mirrored)


def dark(share: float) -> Callable[[Drive], Drive]:
    """A share of the walls is black."""
    return _of_material(share, _dark)


def pitching(largest: float) -> Callable[[Drive], Drive]:
    """The base pitches for half a second every three (rad, at most): beams that point down end at the floor."""

    def change(drive: Drive) -> Drive:
        sizes = drive.rng.uniform(-largest, largest, 200)

        def measured(scan: Scan) -> Scan:
            seconds = drive.elapsed_s(scan)
            phase = seconds % 3.0
            if phase > 0.5:
                return scan
            pitch = sizes[int(seconds / 3.0)] * np.sin(np.pi * phase / 0.5)
            down = np.sin(pitch) * np.cos(scan.angles() + scan.T_base_laser.theta)
            with np.errstate(divide="ignore"):
                floor = np.where(down > 0.0, LASER_HEIGHT_M / down, np.inf)
            floor += drive.rng.normal(0.0, RANGE_NOISE_M, len(floor))
            return replace(scan, ranges=np.fmin(scan.ranges, floor.astype(np.float32)))

        return drive.scans(measured)

    return change


def knocked(at_s: float, turn: float) -> Callable[[Drive], Drive]:
    """From a time (s) on the laser looks elsewhere (rad) than it is stated to."""

    def change(drive: Drive) -> Drive:
        return drive.scans(lambda s: replace(s, angle_min=s.angle_min + turn) if drive.elapsed_s(s) > at_s else s)

    return change


def knocked_twice(drive: Drive) -> Drive:
    """By 4 deg at 20 s, and back at 40 s."""
    return knocked(40.0, np.radians(4.0))(knocked(20.0, np.radians(-4.0))(drive))


def rearranged(drive: Drive) -> Drive:
    """Forty round things of 0.3 to 0.5 m, half a metre to 3 m beside the path, are all moved by 1 m half way."""
    rng, poses = drive.rng, drive.truth().poses
    near = poses[rng.integers(len(poses), size=400), :2]
    angle = rng.uniform(-np.pi, np.pi, 400)
    places = near + rng.uniform(0.8, 3.0, 400)[:, None] * np.column_stack((np.cos(angle), np.sin(angle)))
    moved = places + np.column_stack((np.cos(angle + 2.0), np.sin(angle + 2.0)))
    radii = rng.uniform(0.15, 0.25, 400)

    def is_clear(places: F64) -> NDArray[np.bool_]:
        apart = np.hypot(*(places[:, None] - poses[None, ::10, :2]).transpose(2, 0, 1)).min(axis=1)
        return np.asarray((apart > 0.6) & (drive.world.distance_to_walls(places) > 0.3))

    kept = np.flatnonzero(is_clear(places) & is_clear(moved))[:40]
    before, after = (np.column_stack((each, radii))[kept] for each in (places, moved))
    half_s = drive.elapsed_s(drive.events[-1]) / 2.0
    return drive.among(lambda seconds, _: before if seconds < half_s else after)


def giving_way(begin_s: float, end_s: float, turn: float) -> Callable[[Drive], Drive]:
    """Between two times (s) the laser turns slowly, by this angle (rad) in all."""

    def change(drive: Drive) -> Drive:
        def turned(scan: Scan) -> Scan:
            part = np.clip((drive.elapsed_s(scan) - begin_s) / (end_s - begin_s), 0.0, 1.0)
            return replace(scan, angle_min=scan.angle_min + float(part) * turn)

        return drive.scans(turned)

    return change


def shaking(sigma: float) -> Callable[[Drive], Drive]:
    """In each scan the laser looks elsewhere by chance (rad)."""

    def change(drive: Drive) -> Drive:
        return drive.scans(lambda s: replace(s, angle_min=s.angle_min + float(drive.rng.normal(0.0, sigma))))

    return change


def from_then_on(at_s: float, change: Callable[[Drive], Drive]) -> Callable[[Drive], Drive]:
    """The scans from a time (s) on as `change` leaves them."""

    def changed(drive: Drive) -> Drive:
        late = iter([e for e in change(drive).events if isinstance(e, Scan)])
        events: list[Event] = []
        for event in drive.events:
            other = next(late) if isinstance(event, Scan) else event
            events.append(other if drive.elapsed_s(event) > at_s else event)
        return replace(drive, events=events)

    return changed


def without_odometry_from(at_s: float) -> Callable[[Drive], Drive]:
    """The odometry ends at a time (s)."""

    def change(drive: Drive) -> Drive:
        kept = [e for e in drive.events if not (isinstance(e, Odometry) and drive.elapsed_s(e) > at_s)]
        return replace(drive, events=kept)

    return change

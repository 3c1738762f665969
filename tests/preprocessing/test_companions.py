"""Those who walk with the robot are left out, and nothing else is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hsloc.kernels.raycasting import cast_rays
from hsloc.model.events import Event, Odometry, Scan
from hsloc.model.pose2 import Pose2
from hsloc.preprocessing.companions import WithoutCompanions
from hsloc.warnings import WarningCode

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

ROOM = np.array([(-6.0, -5.0, 40.0, -5.0), (40.0, -5.0, 40.0, 6.0), (40.0, 6.0, -6.0, 6.0), (-6.0, 6.0, -6.0, -5.0)])
ANGLES = np.radians(np.arange(-180.0, 180.0))
PERIOD_NS = 50_000_000


@dataclass
class Drive:
    """Ten messages of odometry and five scans a half second; which beams of each scan see a circle."""

    events: list[Event]
    seen: dict[int, np.ndarray]


def drive(
    path: Iterable[Pose2],
    circles: Callable[[int, Pose2], np.ndarray],
    odometry: Callable[[int, Pose2], Pose2] = lambda _, pose: pose,
    boxes: np.ndarray | None = None,
) -> Drive:
    """A robot on a path (a pose each 50 ms) among `circles`, x y radius (k, 3) by the number and the pose."""
    rng, found = np.random.default_rng(3), Drive([], {})
    walls = ROOM if boxes is None else np.vstack((ROOM, boxes))
    for k, pose in enumerate(path):
        stamp = k * PERIOD_NS
        found.events.append(Odometry(stamp, odometry(k, pose)))
        if k % 2:
            continue
        angles = ANGLES + pose.theta
        directions = np.column_stack((np.cos(angles), np.sin(angles)))
        origins = np.tile((pose.x, pose.y), (len(angles), 1))
        distances = cast_rays(origins, directions, walls, np.empty((0, 3)))
        of_circles = cast_rays(origins, directions, np.empty((0, 4)), np.ascontiguousarray(circles(k, pose)))
        found.seen[stamp] = of_circles < distances
        ranges = np.minimum(distances, of_circles) + rng.normal(0.0, 0.01, len(angles))
        found.events.append(
            Scan(stamp, ranges.astype(np.float32), float(ANGLES[0]), float(ANGLES[1] - ANGLES[0]), 0.05, 12.0)
        )
    return found


def winding(seconds: float, speed: float = 0.8) -> list[Pose2]:
    """Straight on and in bends to both sides."""
    pose, path = Pose2(0.0, 0.0, 0.0), []
    for k in range(round(seconds * 1e9) // PERIOD_NS):
        path.append(pose)
        pose = pose @ Pose2(speed * PERIOD_NS * 1e-9, 0.0, 0.5 * np.cos(0.05 * k) * PERIOD_NS * 1e-9)
    return path


def behind(k: int, pose: Pose2) -> np.ndarray:
    """A person 0.8 to 1 m behind the robot, who sways."""
    at = pose @ Pose2(-0.9 + 0.1 * np.sin(0.02 * k), 0.25 * np.sin(0.035 * k), 0.0)
    return np.array(((at.x, at.y, 0.2),))


def left_out(found: Drive) -> tuple[float, int, WithoutCompanions]:
    """Part of the beams on circles that are left out, and how many others are that are not beside one."""
    without = WithoutCompanions(iter(found.events))
    events = list(without)
    assert [(type(event), event.stamp_ns) for event in events] == [(type(e), e.stamp_ns) for e in found.events]
    hidden, seen, others = 0, 0, 0
    for before, after in zip(found.events, events, strict=True):
        if not isinstance(before, Scan) or not isinstance(after, Scan):
            assert before is after
            continue
        gone, on = np.isnan(after.ranges), found.seen[before.stamp_ns]
        near = on | np.roll(on, 1) | np.roll(on, -1)
        np.testing.assert_array_equal(after.ranges[~gone], before.ranges[~gone])
        hidden, seen, others = hidden + int((gone & on).sum()), seen + int(on.sum()), others + int((gone & ~near).sum())
    return hidden / max(seen, 1), others, without


def test_someone_behind_the_robot_is_left_out_from_the_start() -> None:
    part, others, without = left_out(drive(winding(20.0), behind))
    assert part > 0.97
    assert others == 0
    (warning,) = without.warnings()
    assert warning.code == WarningCode.SCAN_COMPANIONS
    assert "from 0.0 s on: " in warning.text


def test_legs_are_one_person() -> None:
    def legs(k: int, pose: Pose2) -> np.ndarray:
        swing = 0.15 * np.sin(0.3 * k)
        places = [pose @ Pose2(-0.9 + sign * swing, 0.12 * sign, 0.0) for sign in (-1.0, 1.0)]
        return np.array([(at.x, at.y, 0.07) for at in places])

    part, others, _ = left_out(drive(winding(20.0), legs))
    assert part > 0.9
    assert others == 0


def test_what_stands_is_not_left_out() -> None:
    """Posts along the path, so close that the next is soon where the last one was, and here and there."""
    rng = np.random.default_rng(0)
    path = winding(30.0)
    for spacing in (0.5, 0.7, 1.1, 2.0):
        x = np.arange(0.0, 24.0, spacing)
        row = np.column_stack((x, np.full(len(x), -1.0), np.full(len(x), 0.06)))
        assert left_out(drive(path, lambda *_, row=row: row))[:2] == (0.0, 0)
    beside = np.array([pose.to_array()[:2] for pose in path[::12]]) + rng.choice((-1.6, 1.6), (50, 1)) * (0.0, 1.0)
    posts = np.column_stack((beside, rng.uniform(0.05, 0.2, 50)))
    assert left_out(drive(path, lambda *_: posts))[:2] == (0.0, 0)


def test_someone_who_stays_behind_is_left_out_no_longer() -> None:
    stays = winding(20.0)[200]

    def leaves(k: int, pose: Pose2) -> np.ndarray:
        return behind(min(k, 200), pose if k < 200 else stays)

    found = drive(winding(20.0), leaves)
    events = [event for event in WithoutCompanions(iter(found.events)) if isinstance(event, Scan)]
    assert np.isnan(events[95].ranges).any()
    assert not any(np.isnan(event.ranges).any() for event in events[120:])


def test_where_the_robot_stands_and_its_wheels_spin_nothing_walks() -> None:
    """All that is near keeps its place: the robot does."""
    post = np.array(((1.2, 0.3, 0.2), (-0.8, 1.0, 0.15)))
    standing = [Pose2(0.0, 0.0, 0.0)] * 400

    def spins(k: int, _: Pose2) -> Pose2:
        return Pose2(0.04 * k, 0.0, 0.0)

    assert left_out(drive(standing, lambda *_: post, spins))[:2] == (0.0, 0)


def test_where_many_things_keep_their_place_it_is_the_odometry_that_errs() -> None:
    """Between boxes that hide what is farther, but for a window in which people pass."""
    angles = np.radians(np.arange(0.0, 300.0, 60.0))
    posts = np.column_stack((1.5 * np.cos(angles), 1.5 * np.sin(angles), np.full(len(angles), 0.15)))

    def scene(k: int, _: Pose2) -> np.ndarray:
        crowd = np.array(
            [(3.5 * np.cos(a + 0.3 * k), 3.5 * np.sin(a + 0.3 * k), 0.3) for a in np.arange(0.0, 6.2, 0.4)]
        )
        return np.vstack((posts, crowd))

    found = drive([Pose2(0.0, 0.0, 0.0)] * 400, scene, lambda k, _: Pose2(0.04 * k, 0.0, 0.0))
    assert left_out(found)[:2] == (0.0, 0)


def test_events_are_not_held_for_longer_than_is_of_use() -> None:
    taken = 0

    def counted() -> Iterable[Event]:
        nonlocal taken
        for event in drive([Pose2(0.0, 0.0, 0.0)] * 1200, lambda *_: np.empty((0, 3))).events:
            taken += 1
            yield event

    first = next(iter(WithoutCompanions(counted())))
    assert first.stamp_ns == 0
    assert taken <= 30 * 20 + 4  # 20 s of odometry and scans


def test_without_odometry_nothing_is_told() -> None:
    scans = [event for event in drive(winding(10.0), behind).events if isinstance(event, Scan)]
    assert list(WithoutCompanions(iter(scans))) == scans

"""People who walk with the robot while its map is made: returns that keep their place beside it while it drives.

Whoever steers a robot to map a building walks behind it. Matched, such returns say that the robot stands still, and in
the map they are a trail that later scans look through. Two predictions tell them apart from everything else: what
stands still is passed; what walks along stays where it was, seen from the robot.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace
from itertools import product
from math import cos, hypot, pi, sin
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np

from hsloc.kernels.free_standing import find_free_standing
from hsloc.model.events import Odometry, Scan
from hsloc.model.pose2 import IDENTITY, Pose2
from hsloc.preprocessing.body_returns import changed_share
from hsloc.warnings import RunWarning, WarningCode

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from hsloc.model.events import Event

    F64 = NDArray[np.float64]
    Bools = NDArray[np.bool_]

_REACH_M = 2.5
"""Range (m) up to which someone walks with a robot."""
_GAP_M = 0.3
"""Difference of range (m) to the beams on both sides, which see farther: things that stand free."""
_WIDEST_M = 1.2
"""Largest extent (m) of one that walks, with a cart or a bag, and of legs together."""
_TOGETHER_M = 0.5
"""Distance (m) of the legs of a person."""
_VIEW_M, _VIEW_RAD = 0.2, 0.3
"""Motion (m, rad) by the odometry after which the scans are compared: more than what stands is uncertain by."""
_STANDS_M = 0.12
"""Distance (m) of a return from where one that stands is expected: by the odometry, and as another side is seen."""
_NEAR_M = 0.3
"""What one who walks with the robot may come nearer or go farther (m) from view to view; from one thing that stands to
the next it is more, or both are where such things are expected."""
_SWAY_M = 0.5
"""What one who walks with the robot may be nearer or farther (m): a pace."""
_LONGEST_M = 1.0
"""Longest step of the robot (m) from view to view: after it something else may be at the same place beside it."""
_WAY_M, _VIEWS = 2.0, 6
"""Way (m) and number of views for which it has to keep its place: two paces, and more than things are apart that might
be taken for each other."""
_MOST_WALKING = 3
"""Where more of them seem to, it is the robot that stands, and its odometry that counts."""
_MISSED = 2
"""Views in a row in which it may be hidden."""
_STANDING = 0.3
"""Part of these views in which a thing may be where one that stands is expected."""
_CHANGED_SHARE = 0.2
"""The robot has driven where a fifth of the beams that see beyond the reach changed: along walls only what is ahead
does, and where wheels spin nothing."""
_PARTS, _TURNS = (-1.0, 0.0, 0.15, 0.33, 0.5), (0.6, 0.8, 1.0, 1.25, 1.6)
"""Parts of the counted way and turn that a robot may have made whose wheels spin, or count wrongly."""
_BETTER, _FAR_OFF_M = 0.8, 0.5
"""It made a part of the way if returns are off by less than this share then; each by this (m) at most."""
_KEPT_VIEWS = 64
"""Views that are kept to be compared: 2 m of them, and what turns on the spot has."""
_HELD_M, _HELD_S, _MOST_HELD = 3.0, 20.0, 5000
"""Way (m) and time (s) for which events are held back, and how many at most: of a base at 200 Hz and a lidar at 40."""
_UNSEEN_M = 1.5
"""Way (m) by the odometry in which nothing changed, after which nothing new is said: then the wheels may spin."""


class _Thing(NamedTuple):
    """What stands free near the robot: its middle in the base's frame (m), and its parts, as legs.

    Of each part the first and the last beam, and the middle.
    """

    x: float
    y: float
    parts: tuple[tuple[int, int, tuple[float, float]], ...]


class _Place(NamedTuple):
    """Where a thing was in a view (m), the way until then (m), and whether what stood in the view before is there."""

    view: int
    way: float
    thing: _Thing
    stood: bool

    @property
    def x(self) -> float:
        return self.thing.x

    @property
    def y(self) -> float:
        return self.thing.y


@dataclass(slots=True)
class _Track:
    """Places of a thing in the last views."""

    places: list[_Place]
    is_with_another: bool = False
    """Whether it appeared beside one that walks with the robot: two people came apart."""
    missed: int = 0
    is_walking: bool = False

    def decide(self) -> bool:
        """Whether it has kept its place beside the robot, which drove on; true if it had not before."""
        first, last, count = self.places[0], self.places[-1], len(self.places)
        was, self.is_walking = self.is_walking, False
        if was or self.is_with_another or (count >= _VIEWS and last.way - first.way >= _WAY_M):
            x, y = sum(each.x for each in self.places) / count, sum(each.y for each in self.places) / count
            sway = max(hypot(each.x - x, each.y - y) for each in self.places)
            self.is_walking = sway <= _SWAY_M and sum(each.stood for each in self.places) <= _STANDING * count
        return self.is_walking and not was

    def add(self, place: _Place) -> None:
        self.missed = 0
        self.places.append(place)
        while len(self.places) > _VIEWS and place.way - self.places[1].way >= _WAY_M:
            del self.places[0]

    def forget(self) -> None:
        """Begin anew at the last place."""
        self.is_walking = False
        del self.places[:-1]

    def at(self, view: int) -> _Place | None:
        """Where it was in this view, or last before it; from the view before the first one on."""
        if view == self.places[0].view - 1:
            return self.places[0]
        return next((each for each in reversed(self.places) if each.view <= view), None)


@dataclass(slots=True)
class _Laser:
    """What was seen by one laser."""

    at: Pose2
    """Odometry of the last view."""
    ranges: F64
    """Of the last view in which the rest had changed."""
    way: float = 0.0
    unseen: float = 0.0
    """Way by the odometry since then."""
    view: int = 0
    views: deque[tuple[int, Pose2, F64]] = field(default_factory=lambda: deque(maxlen=_KEPT_VIEWS))
    """Number, odometry and ranges of the last views."""
    tracks: list[_Track] = field(default_factory=list)
    hits: int = 0
    left_out: int = 0
    first_ns: int | None = None


@dataclass(slots=True)
class _Held:
    """An event that waits for what comes after it, and the beams (n,) of it that are to be left out."""

    event: Event
    way: float
    laser: _Laser | None = None
    view: int = 0
    things: list[_Thing] | None = None
    hidden: Bools | None = None

    def hide(self, places: Sequence[_Place]) -> None:
        """Leave out the things that are at these places."""
        scan = cast("Scan", self.event)
        if self.things is None:
            self.things = _things(scan)
        for thing in self.things:
            if any(hypot(thing.x - place.x, thing.y - place.y) <= _SWAY_M for place in places):
                if self.hidden is None:
                    self.hidden = np.zeros(len(scan.ranges), dtype=np.bool_)
                for first, last, _ in thing.parts:
                    self.hidden[np.arange(first - 1, last + 2) % len(scan.ranges)] = True


class WithoutCompanions:
    """Events without the returns of those who walk with the robot. To be gone through once; then `warnings`.

    They are held back while the robot drives so far that it shows who does.
    """

    def __init__(self, events: Iterable[Event]) -> None:
        self._events = events
        self._lasers: dict[str, _Laser] = {}
        self._held: deque[_Held] = deque()
        self._start_ns: int | None = None
        self._pose: Pose2 | None = None
        self._way = 0.0

    def __iter__(self) -> Iterator[Event]:
        for event in self._events:
            if isinstance(event, Odometry):
                step = IDENTITY if self._pose is None else self._pose.between(event.T_odom_base)
                self._pose, self._way = event.T_odom_base, self._way + hypot(step.x, step.y)
            if self._start_ns is None:
                self._start_ns = event.stamp_ns
            held = _Held(event, self._way)
            self._held.append(held)
            if isinstance(event, Scan) and self._pose is not None:
                self._look(event, self._pose, held)
            while self._is_known(self._held[0], event.stamp_ns):
                yield self._released()
        while self._held:
            yield self._released()

    def _is_known(self, held: _Held, now_ns: int) -> bool:
        """Whether nothing more will be known of it."""
        waited_s = abs(now_ns - held.event.stamp_ns) / 1e9
        return self._way - held.way > _HELD_M or waited_s > _HELD_S or len(self._held) > _MOST_HELD

    def _released(self) -> Event:
        held = self._held.popleft()
        if held.hidden is None or held.laser is None or not isinstance(held.event, Scan):
            return held.event
        scan, laser = held.event, held.laser
        if laser.first_ns is None:
            laser.first_ns = scan.stamp_ns
        hits = scan.hits()
        laser.hits += int(hits.sum())
        laser.left_out += int((held.hidden & hits).sum())
        return replace(scan, ranges=np.where(held.hidden, np.float32(np.nan), scan.ranges))

    def _look(self, scan: Scan, pose: Pose2, held: _Held) -> None:
        """Follow what is near the robot, and hide what walks along in this scan and in those before it."""
        laser = self._lasers.get(scan.frame_id)
        if laser is None or len(laser.ranges) != len(scan.ranges):
            self._lasers[scan.frame_id] = laser = _Laser(pose, scan.hit_ranges())
        held.laser = laser
        step = laser.at.between(pose)
        if hypot(step.x, step.y) >= _VIEW_M or abs(step.theta) >= _VIEW_RAD:
            held.things = _things(scan)
            self._view(laser, held, pose, step)
        held.view = laser.view
        walking = [track.places[-1] for track in laser.tracks if track.is_walking]
        if walking:
            held.hide(walking)

    def _view(self, laser: _Laser, held: _Held, pose: Pose2, step: Pose2) -> None:
        """Follow what is near the robot from the last view, `step` before, to this one."""
        scan = cast("Scan", held.event)
        ranges = scan.hit_ranges()
        laser.at, laser.view = pose, laser.view + 1
        moved = hypot(step.x, step.y)
        laser.unseen += moved
        if moved > _LONGEST_M:
            laser.tracks, laser.unseen, laser.ranges = [], 0.0, ranges
        elif changed_share(ranges, laser.ranges, (ranges > _REACH_M) & (laser.ranges > _REACH_M)) > _CHANGED_SHARE:
            laser.way, laser.unseen, laser.ranges = laser.way + laser.unseen, 0.0, ranges
        elif laser.unseen > _UNSEEN_M:
            laser.tracks = [track for track in laser.tracks if track.is_walking]
            laser.unseen, laser.ranges = 0.0, ranges
        laser.tracks = _followed(laser, scan, held.things or [], step)
        began = [
            track for track in laser.tracks if track.decide() and not _forgotten(track, laser.views, scan, ranges, pose)
        ]
        laser.views.append((laser.view, pose, ranges))
        if sum(track.is_walking for track in laser.tracks) > _MOST_WALKING:
            laser.tracks = []
            return
        earlier = [each for each in self._held if each.laser is laser and each is not held]
        for track, each in product(began, earlier):
            place = track.at(each.view)
            if place is not None:
                each.hide([place])

    def warnings(self) -> tuple[RunWarning, ...]:
        """What was left out."""
        start_ns = self._start_ns or 0
        return tuple(
            RunWarning(
                WarningCode.SCAN_COMPANIONS,
                f"someone or something moved along with the robot from {(laser.first_ns - start_ns) / 1e9:.1f} s "
                f"on: {100.0 * laser.left_out / max(laser.hits, 1):.0f} % of the returns of {frame} then, left out",
                "keep 3 m away from the robot, or where the lidar does not look",
            )
            for frame, laser in self._lasers.items()
            if laser.first_ns is not None
        )


def _forgotten(track: _Track, views: Iterable[tuple[int, Pose2, F64]], scan: Scan, ranges: F64, pose: Pose2) -> bool:
    """Whether the places of a track are forgotten, as the robot hardly moved since the first of them."""
    since = next((each for each in views if each[0] >= track.places[0].view), None)
    if since is None or not _moved_less(since[2], scan, ranges, since[1].between(pose)):
        return False
    track.forget()
    return True


def _moved_less(before: F64, scan: Scan, ranges: F64, step: Pose2) -> bool:
    """Whether since it measured the ranges `before` (n,) the robot rather moved by a part of the way than by all of it.

    Its turn may be counted wrongly.
    """
    kept = np.flatnonzero(np.isfinite(before))
    points = scan.directions()[kept] * before[kept, None]
    seen = np.append(ranges, np.nan)  # the last is what is beyond the view: as far off as may be
    laser = scan.T_base_laser

    def off(part: float, turned: float) -> float:
        moved = laser.inverse() @ Pose2(part * step.x, part * step.y, turned * step.theta).inverse() @ laser
        c, s = cos(moved.theta), sin(moved.theta)
        x = moved.x + c * points[:, 0] - s * points[:, 1]
        y = moved.y + s * points[:, 0] + c * points[:, 1]
        beams = np.minimum(scan.beams_towards(x, y), len(ranges))
        return float(np.fmin(np.abs(seen[beams] - np.hypot(x, y)), _FAR_OFF_M).mean())

    whole, *parts = (min(off(part, turned) for turned in _TURNS) for part in (1.0, *_PARTS))
    return len(kept) > 0 and min(parts) < _BETTER * whole


def _things(scan: Scan) -> list[_Thing]:
    """What stands free within reach, legs put together."""
    n, mounting = len(scan.ranges), scan.T_base_laser
    is_turn = abs(scan.angle_increment) * n > 2.0 * pi - 2.0 * abs(scan.angle_increment)
    limits = np.array((scan.range_min, scan.range_max)).astype(np.float32)
    found = np.empty((n, 4))
    count = find_free_standing(
        np.ascontiguousarray(scan.ranges), limits, scan.directions(), is_turn, (_REACH_M, _GAP_M, _WIDEST_M), found
    )
    c, s = cos(mounting.theta), sin(mounting.theta)
    things = []
    for first, last, ahead, aside in found[:count].tolist():
        x, y = mounting.x + c * ahead - s * aside, mounting.y + s * ahead + c * aside
        things.append(_Thing(x, y, ((int(first), int(last), (x, y)),)))
    return _put_together(things)


def _put_together(things: list[_Thing]) -> list[_Thing]:
    """Things close to each other as one; those that are too wide together are left out."""
    groups: list[list[_Thing]] = []
    for thing in things:
        near = [group for group in groups if any(_apart(thing, each) <= _TOGETHER_M for each in group)]
        groups = [group for group in groups if group not in near]
        groups.append([thing, *(each for group in near for each in group)])
    found = []
    for group in groups:
        if max(_apart(a, b) for a in group for b in group) > _WIDEST_M:
            continue
        x, y = (sum(each) / len(group) for each in zip(*((thing.x, thing.y) for thing in group), strict=True))
        found.append(_Thing(x, y, tuple(part for thing in group for part in thing.parts)))
    return found


def _apart(a: _Thing, b: _Thing) -> float:
    return hypot(a.x - b.x, a.y - b.y)


def _followed(laser: _Laser, scan: Scan, things: list[_Thing], step: Pose2) -> list[_Track]:
    """The tracks with the things that are nearest to where they were, seen from the robot, and new ones of the rest.

    `step` is the robot's motion since, by which one that stands has moved the other way.
    """
    free, kept = list(things), []
    for track in sorted(laser.tracks, key=lambda each: -len(each.places)):
        thing_before = track.places[-1].thing
        x, y = thing_before.x, thing_before.y
        nearest = min(free, key=lambda thing: hypot(thing.x - x, thing.y - y), default=None)
        if nearest is None or hypot(nearest.x - x, nearest.y - y) > _NEAR_M:
            track.missed += 1
            if track.missed <= _MISSED:
                kept.append(track)
            continue
        free.remove(nearest)
        there = [_is_there(scan, step.inverse() @ Pose2(*middle, 0.0)) for *_, middle in thing_before.parts]
        # Of one who walks one leg stands at any time.
        track.add(_Place(laser.view, laser.way, nearest, stood=all(there)))
        kept.append(track)
    walking = [track.places[-1] for track in kept if track.is_walking and not track.is_with_another]
    for thing in free:
        with_another = any(hypot(thing.x - each.x, thing.y - each.y) <= _WIDEST_M for each in walking)
        kept.append(_Track([_Place(laser.view, laser.way, thing, stood=False)], with_another))
    return kept


def _is_there(scan: Scan, place: Pose2) -> bool:
    """Whether one of the beams towards a place in the base's frame ends there."""
    seen = scan.T_base_laser.inverse() @ place
    (beam,) = scan.beams_towards(np.array([seen.x]), np.array([seen.y]))
    ranges = scan.ranges[max(beam - 1, 0) : max(beam + 2, 0)]
    with np.errstate(invalid="ignore"):
        return bool((np.abs(ranges - hypot(seen.x, seen.y)) <= _STANDS_M).any())

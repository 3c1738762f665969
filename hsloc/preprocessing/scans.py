"""Scans paired with odometry, deskewed, and those of several lasers merged.

A scan is paired with the odometry at its own stamp: that of a message with just this stamp if there is one, else
interpolated between the messages before and after, for which the scan waits.

A lidar that turns while the robot drives measures each beam from another place. Beam i was measured at
`stamp + i * time_increment`; odometry gives the pose of the base at that time. The scan waits for the odometry of its
last beam.

Scans of several lasers taken at about the same time are matched as one cloud. Matched one by one, lasers that measure
together would not all be used: the first scan after each step of the robot passes the motion gate, and that is always
the same laser's. One laser's view also determines less than all of them together. So a scan is held until every laser
has a scan of about the same time; the last of them has the others as companions.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from hsloc.model.events import Heading, Odometry, PairedScan, Scan, Truth
from hsloc.model.pose2 import IDENTITY, Pose2, relative_poses
from hsloc.model.trajectory import Trajectory
from hsloc.preprocessing.interpolation import Interpolations
from hsloc.warnings import RunWarning, WarningCode

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from hsloc.model.events import Event, Interpolation

    Paired = Odometry | PairedScan | Truth

_RECENT_ODOMETRY = 64
"""Odometry messages remembered for pairing; logs with jumping clocks need more than two."""
_WAITING_SCANS = 256
"""Scans that may wait for odometry, of 5 s at 50 Hz; then the last odometry must do."""
_RECENT_SWEEP = 512
"""Odometry messages that are kept. Internal: a fifth of a second at 2.5 kHz, longer than a sweep."""
_WAITING_SWEEPS = 16
"""Maximum number of scans that wait for odometry; then the odometry until now is used. Internal: bounds the memory."""
_LONGEST_SWEEP_NS = 2_000_000_000
"""Maximum duration of a sweep. Internal: no lidar turns more slowly, a longer one is an error of the log."""
_LONGEST_HALF_S = 0.5
"""Half of a sweep that is longer (s) is an error of time_increment, not a lidar that turns so slowly."""

_JITTER = 0.1
"""Tolerance for jitter of stamps as a ratio to the period.

Scans of n lasers are merged within (n - 1) / n of the slowest laser's period plus this: where all turn equally fast,
(n - 1) / n of it always contain a scan of each. Internal: it follows from how drivers stamp."""
_USUAL_PERIOD_NS, _LONGEST_PERIOD_NS = 100_000_000, 400_000_000
"""A laser's period before it is known, and its maximum. Internal: 2D lidars turn at 5 to 40 Hz."""
_LEAST_HITS = 20
"""Least number of returns of a scan that differs from others. Internal: as the front end's."""
_MOVED_M, _MOVED_RAD = 0.05, 0.05
"""Motion (m, rad) after which no scan is the same: several times the steps in which lidars give ranges."""
_FROZEN_M = 0.5
"""Way (m) without a scan from which on a result is worth a look: then odometry errs by centimetres."""
_STUCK_SHARE = 0.5
"""Scans with the stamp of the one before that are no chance, as a part of all."""
_END_S, _LONGEST_END_S = 2.0, 1e6
"""Time (s) by which topics may end apart: recorders stop one after the other; and beyond which clocks differ."""
_SILENT_NS = 500_000_000
"""Silence after which a laser is not waited for. Internal: longer than the longest period."""


def pair(
    events: Iterable[Event], *, deskew: bool = False, first: Pose2 | None = None
) -> Iterator[Odometry | PairedScan | Truth]:
    """Pair the scans with odometry, and deskew them if asked for; other events pass through in their order.

    `first` is the first odometry to come, where it is known: scans long before it are paired with it, else with the
    identity, as those of a log without any odometry are. Of headings each scan gets the last one before it.
    """
    paired = _pair(events, IDENTITY if first is None else first)
    return deskewed(paired) if deskew else paired


def _pair(events: Iterable[Event], first: Pose2) -> Iterator[Odometry | PairedScan | Truth]:
    recent: deque[Odometry] = deque(maxlen=_RECENT_ODOMETRY)
    waiting: deque[Scan] = deque()
    interpolations = Interpolations()
    heading: float | None = None

    def paired(scan: Scan, following: Odometry | None) -> PairedScan:
        T_odom_base, interpolation = _at(scan.stamp_ns, recent, following, first, interpolations)
        return PairedScan(scan, T_odom_base, interpolation=interpolation)

    for event in events:
        if isinstance(event, Truth):
            yield event
        elif isinstance(event, Heading):
            # A log with headings has no odometry that scans would wait for.
            heading = event.theta
            while waiting:
                yield paired(waiting.popleft(), None)
        elif isinstance(event, Scan):
            if heading is not None and not recent:
                yield PairedScan(event, first, heading=heading)
                continue
            exact = _exact(recent, event.stamp_ns)
            if exact is not None and not waiting:
                yield PairedScan(event, exact.T_odom_base, interpolation=exact.interpolation)
                continue
            waiting.append(event)
            if len(waiting) > _WAITING_SCANS:
                yield paired(waiting.popleft(), None)
        else:
            while waiting and _earliest(waiting) < event.stamp_ns:
                yield paired(waiting.popleft(), event)
            recent.append(event)
            interpolations.follow(event)
            yield event
            while waiting and _earliest(waiting) <= event.stamp_ns:
                yield paired(waiting.popleft(), None)
    while waiting:
        yield paired(waiting.popleft(), None)


def _earliest(waiting: deque[Scan]) -> int:
    """Scans keep their order: one with a stamp from the future may not hold up those behind it."""
    return min(scan.stamp_ns for scan in waiting)


def _exact(recent: deque[Odometry], stamp_ns: int) -> Odometry | None:
    for odometry in reversed(recent):
        if odometry.stamp_ns == stamp_ns:
            return odometry
    return None


def _at(
    stamp_ns: int, recent: deque[Odometry], following: Odometry | None, first: Pose2, interpolations: Interpolations
) -> tuple[Pose2, Interpolation | None]:
    """The odometry at a stamp: exact, else between neighbours in the log that enclose it, else the last one."""
    exact = _exact(recent, stamp_ns)
    if exact is not None:
        return exact.T_odom_base, exact.interpolation
    after = following
    for before in reversed(recent):
        if after is not None and before.stamp_ns < stamp_ns <= after.stamp_ns:
            fraction = (stamp_ns - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
            interpolation = before.interpolation or after.interpolation or interpolations.between(before, after)
            return before.T_odom_base.interpolate(after.T_odom_base, fraction), interpolation
        after = before
    if recent and (following is None or following.stamp_ns >= stamp_ns):
        return recent[-1].T_odom_base, None
    return following.T_odom_base if following is not None else first, None


def deskewed(events: Iterable[Paired]) -> Iterator[Paired]:
    """Events as `pair` gives them, each scan with where the base was at each of its beams.

    A scan comes behind the odometry of its last beam; scans keep their order. Without `time_increment` (or with one
    that makes a turn of over two seconds) a scan stays as it is.
    """
    recent: deque[Odometry] = deque(maxlen=_RECENT_SWEEP)
    waiting: deque[PairedScan] = deque()
    for event in events:
        if isinstance(event, PairedScan):
            waiting.append(event)
        else:
            yield event
            if isinstance(event, Odometry):
                recent.append(event)
        while waiting and (len(waiting) > _WAITING_SWEEPS or (recent and _is_covered(waiting[0].scan, recent[-1]))):
            yield _moved(waiting.popleft(), recent)
    while waiting:
        yield _moved(waiting.popleft(), recent)


def _sweep_ns(scan: Scan) -> int:
    """Time from the first beam to the last; negative where the last one was first."""
    sweep = (len(scan.ranges) - 1) * scan.time_increment * 1e9
    return round(sweep) if abs(sweep) <= _LONGEST_SWEEP_NS else 0


def half_sweep_ns(scan: Scan) -> int:
    """From the first beam to the middle of a scan: a lidar that turns shows the heading of then (ns)."""
    half = 0.5 * max(len(scan.ranges) - 1, 0) * scan.time_increment
    return round(half * 1e9) if abs(half) <= _LONGEST_HALF_S else 0


def _is_covered(scan: Scan, latest: Odometry) -> bool:
    sweep = _sweep_ns(scan)
    return sweep <= 0 or latest.stamp_ns >= scan.stamp_ns + sweep


def _moved(paired: PairedScan, recent: Iterable[Odometry]) -> PairedScan:
    scan = paired.scan
    sweep = _sweep_ns(scan)
    if sweep == 0 or len(scan.ranges) == 0:
        return paired
    first, last = scan.stamp_ns + min(sweep, 0) - _LONGEST_SWEEP_NS, scan.stamp_ns + max(sweep, 0) + _LONGEST_SWEEP_NS
    poses_then = [(o.stamp_ns, o.T_odom_base) for o in recent if first <= o.stamp_ns <= last]
    track = Trajectory.from_pairs([*poses_then, (scan.stamp_ns, paired.T_odom_base)])
    beams = np.arange(len(scan.ranges), dtype=np.float64)
    stamps = scan.stamp_ns + np.round(beams * (scan.time_increment * 1e9)).astype(np.int64)
    poses = track.interpolated(stamps)
    base = np.broadcast_to(paired.T_odom_base.to_array(), poses.shape)
    return replace(paired, scan=replace(scan, T_base_beam=relative_poses(base, poses)))


def merged_scans(events: Iterable[Paired]) -> Iterator[Paired]:
    """Events as `pair` gives them, scans of several lasers (by `frame_id`) merged.

    All events pass in their order. Each scan is either held (`is_held`), or is to be matched together with its
    `companions`, which were. Without odometry the motion between two scans is unknown: none is held then.
    """
    lasers = _Lasers()
    has_odometry = False
    for event in events:
        has_odometry = has_odometry or isinstance(event, Odometry)
        yield lasers.merge(event) if has_odometry and isinstance(event, PairedScan) else event


class ScanWatch:
    """Events without scans that repeat the one before while the odometry moves. To be gone through once.

    A driver that hangs, or a node that publishes the last scan again, gives such scans new stamps; matched, they hold
    the robot where it was. Real scans have noise, and none is the same from another place. Afterwards `warnings` also
    gives whether stamps of scans stand still, and whether scans or odometry end early.
    """

    def __init__(self, events: Iterable[Event], topic: str | None = None) -> None:
        self._events = events
        self._topic = topic or "the scans"
        self._last: dict[str, Scan] = {}
        self._since: dict[str, Pose2 | None] = {}
        """Where the odometry was at the first of the scans that are alike, by the laser's frame."""
        self._pose: Pose2 | None = None
        self._left_out = self._stuck = self._scans = 0
        self._first_s = self._frozen_m = 0.0
        self._start_ns: int | None = None
        self._ends: dict[type, tuple[int, Pose2 | None]] = {}

    def __iter__(self) -> Iterator[Event]:
        for event in self._events:
            if isinstance(event, Scan):
                self._start_ns = event.stamp_ns if self._start_ns is None else self._start_ns
                self._scans += 1
                self._ends[Scan] = (event.stamp_ns, self._pose)
                if self._is_repeated(event):
                    continue
            elif isinstance(event, Odometry):
                self._pose = event.T_odom_base
                self._ends[Odometry] = (event.stamp_ns, self._pose)
            yield event

    def _is_repeated(self, scan: Scan) -> bool:
        before = self._last.get(scan.frame_id)
        self._last[scan.frame_id] = scan
        # The same scan again has the same bytes.
        is_alike = before is not None and scan.ranges.tobytes() == before.ranges.tobytes()
        if before is not None and not is_alike:
            self._stuck += scan.stamp_ns == before.stamp_ns
        if not is_alike or _is_bare(scan):
            self._since[scan.frame_id] = self._pose
            return False
        since = self._since[scan.frame_id]
        if since is None or self._pose is None:
            return False
        step = since.between(self._pose)
        moved_m = float(np.hypot(step.x, step.y))
        if moved_m <= _MOVED_M and abs(step.theta) <= _MOVED_RAD:
            return False
        if self._left_out == 0 and self._start_ns is not None:
            self._first_s = (scan.stamp_ns - self._start_ns) / 1e9
        self._left_out += 1
        self._frozen_m = max(self._frozen_m, moved_m)
        return True

    def warnings(self) -> tuple[RunWarning, ...]:
        """What was found."""
        found = []
        if self._left_out:
            frozen = self._frozen_m >= _FROZEN_M
            found.append(
                RunWarning(
                    WarningCode.SCANS_FROZEN if frozen else WarningCode.SCANS_REPEATED,
                    f"{self._left_out} of {self._scans} scans on {self._topic} repeat the one before while the "
                    f"odometry moves (by up to {self._frozen_m:.2f} m, first at {self._first_s:.1f} s): they are left "
                    "out, and poses follow the odometry there",
                    "restart the lidar's driver" if frozen else "record the driver's own topic",
                )
            )
        if self._scans and self._stuck > _STUCK_SHARE * self._scans:
            found.append(
                RunWarning(
                    WarningCode.SCAN_STAMPS_STUCK,
                    f"{self._stuck} of {self._scans} scans on {self._topic} have the stamp of the one before",
                    "--stamps log takes the times at which messages were recorded",
                )
            )
        return (*found, *self._of_ends())

    def _of_ends(self) -> Iterator[RunWarning]:
        if len(self._ends) < 2 or self._pose is None:
            return
        (scan_ns, at), (odometry_ns, _) = self._ends[Scan], self._ends[Odometry]
        seconds = (odometry_ns - scan_ns) / 1e9
        if seconds > _END_S and at is not None:
            step = at.between(self._pose)
            way = float(np.hypot(step.x, step.y))
            if way > _FROZEN_M:
                yield RunWarning(
                    WarningCode.TOPICS_END_APART,
                    f"the scans end {seconds:.1f} s before the odometry: the last poses, {way:.1f} m away, follow the "
                    "odometry alone",
                    "cut the log with --end, or look why the lidar stopped",
                )
        elif seconds < -_END_S and seconds > -_LONGEST_END_S:
            yield RunWarning(
                WarningCode.TOPICS_END_APART,
                f"the odometry ends {-seconds:.1f} s before the scans, and the trajectory with it",
                "--no-odom follows the scans to their end",
            )


class _Lasers:
    """The last scan and the last match of each laser, and the scans that are held."""

    def __init__(self) -> None:
        self._last: dict[str, int] = {}
        self._period: dict[str, int] = {}
        self._held: dict[str, PairedScan] = {}
        self._matched: dict[str, int] = {}

    def merge(self, paired: PairedScan) -> PairedScan:
        """The scan, held or with its companions."""
        frame, stamp = paired.scan.frame_id, paired.scan.stamp_ns
        self._record(frame, stamp)
        if len(self._last) == 1:
            self._matched[frame] = stamp
            return paired
        lasers, period = len(self._last), max(self._period.values())
        max_age = round(((lasers - 1) / lasers + _JITTER) * period)
        self._held = {name: held for name, held in self._held.items() if abs(stamp - held.scan.stamp_ns) <= max_age}
        self._held.pop(frame, None)
        awake = {name for name, last in self._last.items() if abs(stamp - last) < _SILENT_NS}
        # A laser whose scans never come near the others' must not wait for ever.
        starved = abs(stamp - self._matched[frame]) > 2 * period
        if awake <= {frame, *self._held} or starved:
            companions = tuple(self._held.values())
            self._matched |= dict.fromkeys((frame, *self._held), stamp)
            self._held = {}
            return replace(paired, companions=companions)
        self._held[frame] = paired
        return replace(paired, is_held=True)

    def _record(self, frame: str, stamp_ns: int) -> None:
        last = self._last.get(frame)
        if last is None:
            self._period[frame] = _USUAL_PERIOD_NS
            self._matched[frame] = stamp_ns
        elif 0 < stamp_ns - last < _LONGEST_PERIOD_NS:
            self._period[frame] = stamp_ns - last
        self._last[frame] = stamp_ns


def _is_bare(scan: Scan) -> bool:
    """Whether a scan may look the same from another place: it has few returns, or all at one range."""
    ranges = scan.ranges[np.isfinite(scan.ranges)]
    return len(ranges) < _LEAST_HITS or bool(np.ptp(ranges) == 0.0)

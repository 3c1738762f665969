"""The offset between the stamps of scans and odometry: before a run where it is asked for, after it where it shows.

The pose of a matched scan follows what the lidar saw; odometry with the same stamp should have turned as much. Where it
did not, the correction of each match belongs to another moment, and poses are wrong by what the robot moved meanwhile.
Stamps are then corrected, or the beams of a lidar that turns while the robot does, and the log is replayed once more;
as a map is where the laser looks elsewhere than the log states.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import isfinite
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from hsloc.log import LONGEST_OFFSET_S, open_log
from hsloc.options import AUTO
from hsloc.replay.matched_scans import are_matched, is_lost
from hsloc.slam.heading_offset import Headings, find_offset
from hsloc.slam.mounting_choice import direction_warnings, right_mounting, with_chosen_mountings
from hsloc.slam.time_offset import HINT_S, clock_warnings, offsets_of_log
from hsloc.warnings import RunWarning, WarningCode

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from hsloc.localisation.mounting_error import MountingError
    from hsloc.log import Log, LogSummary, ReadOptions
    from hsloc.model.estimate import ScanDiagnostics
    from hsloc.model.trajectory import Trajectory
    from hsloc.replay.run_history import RunHistory
    from hsloc.request import RunRequest
    from hsloc.slam.heading_offset import Offset

R = TypeVar("R")
_TRANSFORMS = ("TFMessage", "foxglove.FrameTransform", "foxglove.FrameTransforms")
"""Types of messages that hold transforms of other frames, too."""
_MILLISECOND = 1e-3
"""Rest of an offset (s) that is left as it is: a millimetre."""


class LateScans(Exception):
    """The scans that were matched show an offset that is certain; internal: whoever maps corrects it, and begins again.

    `offsets` (s) are by topic; `option` is the value of `--time-offset` that removes them.
    """

    def __init__(self, offsets: Mapping[str, Offset], option: str) -> None:
        super().__init__(option)
        self.offsets = offsets
        self.option = option

    def with_rest(self, left: Mapping[str, Offset]) -> dict[str, Offset]:
        """The whole offsets: with what is `left` after the correction, which the prediction had hidden."""
        whole = dict(self.offsets)
        for topic, removed in self.offsets.items():
            if topic in left and isfinite(left[topic].sigma):
                seconds, sigma = removed.seconds + left[topic].seconds, left[topic].sigma
                whole[topic] = removed._replace(seconds=seconds, sigma=sigma)
        return whole


class SweptScans(Exception):
    """The lidar turned while the robot did, for `half_sweep_s` to the middle; internal: who maps begins again.

    `fitness` is the mean of the matches as recorded.
    """

    def __init__(self, request: RunRequest, half_sweep_s: float, fitness: float) -> None:
        super().__init__()
        self._request, self._half_s, self._fitness = request, half_sweep_s, fitness

    def best(self, attempt: Callable[[RunRequest, RunWarning], R], fitness: Callable[[R], float]) -> R | None:
        """Of replays that deskew in the order of the header and in the opposite one that which fits better.

        None where neither fits better than without. The order is not known from the header: drivers of lidars that turn
        clockwise list the beams the other way round, with a `time_increment` that is positive all the same.
        """
        read = replace(self._request.read, deskew=True)
        fixes = self._request.read.scan_fix
        moved = "in which the robot moved: beams were put where it was"
        text = f"a sweep of the lidar takes {2.0 * abs(self._half_s):.3f} s, {moved}"
        ways = [(read, "", "--deskew does that from the start, and saves replays")]
        if fixes is None or "time_increment" not in fixes:
            fix = "time_increment=reverse" if fixes is None else f"{fixes},time_increment=reverse"
            remedy = f"--deskew --scan-fix {fix} does that from the start, and saves replays"
            ways.append((replace(read, scan_fix=fix), "; the last beam was measured first", remedy))
        tried = [
            attempt(replace(self._request, read=each), RunWarning(WarningCode.SCANS_DESKEWED, text + order, remedy))
            for each, order, remedy in ways
        ]
        found = max(tried, key=fitness)
        return found if fitness(found) > self._fitness else None


class TurnedLaser(Exception):
    """The laser looks elsewhere than the log states, beyond doubt; internal: who maps begins again.

    `request` has the right mounting, `warning` says so.
    """

    def __init__(self, request: RunRequest, warning: RunWarning, yaw: float) -> None:
        super().__init__()
        self.request, self.warning, self._yaw = request, warning, yaw

    def is_mended(self, left: MountingError | None) -> bool:
        """Whether a run with that mounting has less than half of the error `left`."""
        return left is None or abs(left.error.theta) < 0.5 * abs(self._yaw)


MAPS_CORRECTED_FROM_S = 0.15
"""Offset (s) from which on a map is built again with corrected stamps.

Of smaller ones the clock of the odometry may be the wrong one as well, and a corrected trajectory no longer has the
stamps of the scans, which references are often made of. Chosen on two logs: Freiburg 079, 0.13 s, is mapped to 0.032 m
as it is and to 0.035 m corrected; with ACES' 0.04 s corrected its map with half the field of view is lost.
"""
KNOWN = (
    WarningCode.CLOCK_OFFSET,
    WarningCode.CLOCK_OFFSET_LARGE,
    WarningCode.CLOCK_OFFSET_APPLIED,
    WarningCode.CLOCK_SET,
)
"""Warnings of a run that has looked for the offset, or that has none: it is not one where a clock was set."""


def open_as_meant(
    request: RunRequest, lidar_only: bool, time_offset: str | None = None
) -> tuple[Log, ReadOptions, tuple[RunWarning, ...]]:
    """The log, and how it is read: with the right one of several mountings, and the offset of its scans if asked for.

    Otherwise that is estimated only where log times hint at it: smaller ones show in the result. `time_offset` is known
    from a run before, empty: there is none. Stamps of different epochs give way to the log's times.
    """
    front_end = request.config.graph_mapper.front_end
    plain, of_epochs = request.reading(), list[RunWarning]()
    log = open_log(request.logs, plain)
    apart_s = abs(log.summary.clocks_apart_s)
    if apart_s > LONGEST_OFFSET_S and plain.time_offset is None:
        text = (
            f"the stamps of scans and odometry are {apart_s:.0f} s apart, of different epochs: the times at which "
            "messages were recorded are used in their place"
        )
        of_epochs = [RunWarning(WarningCode.CLOCKS_APART, text, "put the clocks of lidar and base right")]
        plain = replace(plain, stamps="log")
        log = open_log(request.logs, plain)
    reading, of_mountings = with_chosen_mountings(log, request.logs, plain, front_end)
    of_directions = () if lidar_only else direction_warnings(log, request.logs, reading, front_end, stated=False)
    warnings = (*of_epochs, *of_mountings, *of_directions)
    looks = time_offset is None and not lidar_only
    automatic = looks and request.read.time_offset == AUTO
    apart = looks and abs(log.summary.clocks_apart_s) > HINT_S and request.read.time_offset is None
    if automatic or apart:
        found = offsets_of_log(request.logs, reading, front_end)
        if automatic:
            time_offset = as_option(found, own_odometry(log.summary), deskew=reading.deskew or log.summary.segments > 1)
        warnings = (*warnings, *(warning for _, warning in clock_warnings(found, removed=time_offset)))
    if time_offset is not None:
        reading = replace(reading, time_offset=time_offset or reading.time_offset)
    return (log if reading == plain else open_log(request.logs, reading)), reading, warnings


def matched_headings(scans: ScanDiagnostics, odometry: Trajectory, trajectory: Trajectory) -> tuple[Headings, Headings]:
    """Headings of the scans that were matched on a given map, by the result, and those of the odometry."""
    # A match corrects the poses from the next odometry message on.
    rows = np.searchsorted(odometry.stamps_ns, scans.stamps_ns)
    matched = are_matched(scans.status) & (rows < len(odometry))
    rows = np.minimum(rows, len(odometry) - 1)
    there = np.interp(scans.stamps_ns, odometry.stamps_ns, np.unwrap(odometry.poses[:, 2]))
    theta = trajectory.poses[rows, 2] - odometry.poses[rows, 2] + there
    turned = Headings.of(odometry.stamps_ns, odometry.poses[:, 2])
    return Headings.of(scans.stamps_ns[matched], theta[matched]), turned


@dataclass(frozen=True, slots=True)
class ClockEvidence:
    """What the result of a localiser shows of the clocks.

    `offset` is what is left of an offset in the headings of its matches; a part of it is hidden, for poses also follow
    the odometry. `localised` is the share of its poses that are localised; `is_lost` says that most scans found no
    match, which an offset of seconds causes.
    """

    offset: Offset
    localised: float
    is_lost: bool

    @classmethod
    def of(
        cls, scans: ScanDiagnostics, odometry: Trajectory, trajectory: Trajectory, localised: NDArray[np.bool_]
    ) -> ClockEvidence:
        """Of a localiser's result with odometry; `localised` (n,) says which of its poses are."""
        offset = find_offset(*matched_headings(scans, odometry, trajectory))
        return cls(offset, float(localised.mean()), is_lost(scans.status))

    @property
    def hints(self) -> bool:
        """Whether it is worth while to look for an offset in the scans themselves, which takes a part of a run."""
        return self.is_lost or self.offset.is_significant

    def is_better(self, before: ClockEvidence) -> bool:
        """Whether a run with corrected stamps shows less of an offset than before, or was found where that was lost."""
        if not before.offset.is_significant:
            return self.localised > before.localised
        return not self.offset.is_significant or abs(self.offset.seconds) < 0.5 * abs(before.offset.seconds)


def offsets_of_mapping(
    request: RunRequest, log: Log, reading: ReadOptions, history: RunHistory, *, deskew: bool, correct: bool
) -> dict[str, Offset]:
    """The offsets (s) by topic that a log shows which has been matched, before its map is solved.

    Raises LateScans where one is certain and the user has given none, if these are to be corrected: from
    `MAPS_CORRECTED_FROM_S` on; and SweptScans where the scans are of the middle of their sweeps (`is_of_sweep`), which
    is as certainly another time than that of the stamps.
    """
    if reading.stamps != "header":
        return {}
    # Corrected stamps are those of the middle.
    offset = history.clock_offset(sweeps=correct and not deskew)
    if offset is None or (history.lasers > 1 and offset.is_significant):
        # Several lasers have clocks of their own.
        found, option = clock_offsets(request, reading, log.summary, deskew=deskew)
    else:
        found = {log.summary.scan_topic or "": offset}
        is_free = offset.is_certain and not _is_given(request)
        option = as_option(found, own_odometry(log.summary), deskew=deskew) if is_free else None
    if correct and offset is not None and offset.is_of_sweep and not _is_given(request):
        of_stamps = offset._replace(seconds=-offset.half_sweep_s)
        if of_stamps.is_certain:
            raise SweptScans(request, offset.half_sweep_s, history.mean_fitness())
    is_large = any(each.is_certain and abs(each.seconds) >= MAPS_CORRECTED_FROM_S for each in found.values())
    if correct and option is not None and is_large:
        raise LateScans({name: each for name, each in found.items() if each.is_certain}, option)
    return found


def require_direction(request: RunRequest, log: Log, reading: ReadOptions, history: RunHistory) -> bool:
    """Raise TurnedLaser where the matches of a map show it, and the scans by themselves; whether these were asked."""
    shown, _ = history.mounting()
    is_given = reading.laser_pose is not None or reading.calibration is not None
    if shown is None or not shown.is_turned or is_given or log.summary.laser_flipped:
        return False
    found = right_mounting(request.logs, reading, request.config.graph_mapper.front_end, used=True)
    if found is not None:
        pose, warning = found
        read = replace(request.read, laser_pose=pose)
        raise TurnedLaser(replace(request, read=read), warning, shown.error.theta)
    return True


def _is_given(request: RunRequest) -> bool:
    return request.read.time_offset is not None or bool(request.reading().offsets_s())


def swept_scans(
    request: RunRequest, evidence: ClockEvidence, found: Mapping[str, Offset], fitness: float
) -> SweptScans | None:
    """Whether the result of a localiser, with that mean `fitness`, shows that its scans have to be deskewed.

    A scan shows the robot in the middle of its sweep. Where that is the whole offset of the matches, and the clocks
    have none by themselves (`found`), the header's `time_increment` is right, and poses are wrong by what the robot
    moved in half a sweep.
    """
    known = [offset for offset in found.values() if isfinite(offset.sigma) and not offset.is_mirrored]
    halves = [offset.half_sweep_s for offset in known if not offset.is_significant and not offset.drift_s]
    if evidence.is_lost or _is_given(request) or not halves or len(halves) < len(found):
        return None
    half = float(np.mean(halves))
    if not evidence.offset.is_significant or evidence.offset.seconds * half >= 0.0:
        return None
    return SweptScans(request, half, fitness)


def clock_offsets(
    request: RunRequest, reading: ReadOptions, summary: LogSummary, *, deskew: bool
) -> tuple[dict[str, Offset], str | None]:
    """The offsets (s) by topic that the scans of a log, as it was read, show by themselves, and what removes them.

    That is a value of `--time-offset`; None where there is no offset that is certain, and where the user has given one.
    `deskew` says whether the scans of the run are.
    """
    # Poses are weighed with the odometry, which hides a part of the offset: the scans alone show the whole of it.
    found = offsets_of_log(request.logs, reading, request.config.graph_mapper.front_end)
    certain = {topic: offset for topic, offset in found.items() if offset.is_certain}
    odometry = own_odometry(summary) if len(certain) == len(found) else None
    return found, None if _is_given(request) else as_option(certain, odometry, deskew=deskew)


def as_option(offsets: Mapping[str, Offset], odometry: str | None, *, deskew: bool) -> str | None:
    """The value of `--time-offset` that removes the offsets that are significant; None where none is.

    Messages wait, and are stamped late, not early. Where the scans of all lidars are early it is therefore the topic of
    the `odometry` that is moved, as far as they have it in common; None: it cannot be. A scan that is not deskewed
    shows the robot as it was in the middle of the sweep: it gets the stamp of then. Of the kinds of lines of a text
    log, which are joined by plus signs, the first is named.
    """
    late_s = -max((offset.seconds if offset.is_significant else 0.0 for offset in offsets.values()), default=0.0)
    late_s = max(late_s, 0.0) if odometry is not None else 0.0
    moved = [f"{odometry}={-late_s:.3f}"] if late_s else []
    for topic, offset in offsets.items():
        left_s = (0.0 if deskew else offset.half_sweep_s) - offset.seconds - late_s
        if offset.is_significant and not (moved and abs(left_s) < _MILLISECOND):
            moved.append(f"{topic.partition(' + ')[0]}={left_s:.3f}")
    return ",".join(moved) or None


def own_odometry(summary: LogSummary) -> str | None:
    """The topic of the odometry, if it has stamps of its own: neither those of other transforms nor of scans."""
    kinds = {each.topic: each.typename.rpartition("/")[2] for each in summary.topics}
    topic = summary.odom_topic
    is_own = kinds.get(topic or "", _TRANSFORMS[0]) not in _TRANSFORMS and topic != summary.scan_topic
    return topic if is_own and summary.heading_topic is None else None

"""Which of several mountings is right that a log states for one laser: the one under which scans and odometry agree.

Scans are matched one to the next without odometry. What the base did then follows from the mounting: a laser that
stands elsewhere moves otherwise in each turn, one that looks elsewhere drives in another direction. Steps of the scans
are compared with those of the odometry under each mounting, step by step, so that what the odometry itself gets wrong
counts for all of them alike. The same steps show a laser that looks elsewhere than it is assumed to, as backwards.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import degrees, inf, pi, radians, sqrt
from typing import TYPE_CHECKING

import numpy as np

from hsloc.errors import HslocError
from hsloc.localisation.mounting_error import (
    MIN_SIGMAS,
    PARTS,
    PRIOR,
    MountingError,
    equal_parts,
    without_each_part,
)
from hsloc.log import laser_mounting, open_log
from hsloc.model.events import Odometry, Scan
from hsloc.model.pose2 import Pose2, relative_poses, wrap_angle, wrap_angles
from hsloc.options import AUTO
from hsloc.preprocessing.odometry import ContinuousOdometry
from hsloc.preprocessing.scans import half_sweep_ns
from hsloc.slam.heading_offset import Headings, find_offset
from hsloc.slam.laser_odometry import with_laser_odometry
from hsloc.slam.time_offset import LEAST_AGREEMENT
from hsloc.warnings import RunWarning, WarningCode

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from hsloc.log import LaserSummary, Log, ReadOptions, Transform3
    from hsloc.model.events import Event
    from hsloc.slam.front_end_parameters import FrontEndParameters

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]

_MOST_SCANS = 3000
"""Scans that are matched: minutes, in which a robot turns."""
_STEP_M, _STEP_RAD, _LONGEST_S = 0.2, 0.2, 5.0
"""Steps that are compared (m, rad), as in the calibration, and the time (s) beyond which one holds a gap."""
_FEWEST = 10
"""Minimum number of steps."""
_BLOCKS = 30
"""Parts of the log whose errors count as independent of each other, as in the calibration."""
_SCALES = (0.9, 1.1)
"""Scale of the odometry that is allowed for: worn or wrongly measured wheels."""
_LEVER_M = 0.3
"""Distance (m) at which a rotation counts as its displacement, that of the wheels from the middle of a small robot."""
_LEAST_M = 1e-3
"""Smallest scale of the misfits (m): less is not measured."""
_HUBER = 1.345
_LEAST_T = 3.0
"""Minimum t of the difference of two mountings: were both equally wrong, one would be chosen in one of 200 logs."""


_LOOKS = (40, 60, 90, 135, 200, 300, 450, 600)
"""Numbers of scans after which it is looked whether it is settled where a laser looks: each half as many again, so that
few are matched in vain. The last are a minute, in which a robot drives 20 m."""
_LEAST_RAD = radians(10.0)
"""Smallest error of a yaw that is looked for here. Smaller ones leave the matches on a map right, and show in them."""
_FEWEST_OF_DIRECTION = 20
"""Minimum number of steps: 4 m, two in each part."""
_SCALES_OF_DIRECTION = (0.5, 2.0)
"""Ratio of the steps of scans and odometry outside of which one of the two says nothing."""
_PLACE_M = 0.02
"""Standard deviation (m) up to which the place of such a laser is stated, too: what a ruler finds."""
_LEAST_TURNED = 0.5
"""Rotation (rad) by the odometry from which the scans must turn the same way."""
_MOST_IN_VAIN = 2
"""Looks one after the other in which they do not, after which no more scans are matched: half as many more did not
help. Where scans are 0.7 m apart (ACES) 600 were matched in vain, a fifth of the time of the run."""
_NOTHING = Pose2(), inf, inf
"""Of the place and the yaw of a laser nothing is known."""


@dataclass(frozen=True, slots=True, eq=False)
class _Motion:
    """Steps (n, 3) of the base by the scans and by the odometry, and its path by the odometry at the scans (m, 3)."""

    stamps_ns: I64
    by_scans: F64
    by_odometry: F64


def with_chosen_mountings(
    log: Log, paths: Sequence[Path], options: ReadOptions, parameters: FrontEndParameters
) -> tuple[ReadOptions, tuple[RunWarning, ...]]:
    """The options with a mounting for each laser that the log states several of, and a warning for each of these.

    `log` is the opened log of these `paths` and `options`, which are returned as they are where nothing is to be
    chosen. Raises LogError as `open_log` does.
    """
    chosen, warnings = list(options.mountings), []
    for laser in log.summary.lasers:
        if len(laser.alternatives) > 1:
            best, warning = _choice(laser, paths, options, parameters)
            chosen.append((laser.frame, laser.alternatives[best]))
            warnings.append(warning)
    return (replace(options, mountings=tuple(chosen)) if warnings else options), tuple(warnings)


def direction_warnings(
    log: Log, paths: Sequence[Path], options: ReadOptions, parameters: FrontEndParameters, *, stated: bool
) -> list[RunWarning]:
    """A warning for each laser that looks elsewhere than assumed, or where `stated`, than the log states it.

    `log` is the opened log of these `paths` and `options`, before mountings were chosen. Raises LogError as `open_log`
    does.
    """
    if options.mountings:
        log = open_log(paths, options)
    summary = log.summary
    if summary.odom_topic is None or summary.scan_topic is None:
        return []
    # A text log has no topics to choose from.
    lasers = [(laser.topic, laser.T_base_laser, laser.extrinsics) for laser in summary.lasers]
    lasers = lasers or [("", summary.T_base_laser, summary.extrinsics)]
    found = []
    for topic, mounting, extrinsics in lasers:
        if not stated and extrinsics != "identity":
            continue
        reading = replace(
            options, deskew=False, start_s=None, end_s=None,
            scan_topic=topic if len(lasers) > 1 else options.scan_topic,
            time_offset=None if options.time_offset == AUTO else options.time_offset,
        )  # fmt: skip
        opened = log if reading == options else open_log(paths, reading)
        error, place_sigma, sigma = _direction(_motions(opened.events(), parameters, _LOOKS))
        yaw = error.theta
        if abs(yaw) <= max(_LEAST_RAD, MIN_SIGMAS * sigma):
            continue
        looks = f"turned by {degrees(yaw):.0f} deg" if abs(yaw) < pi - _LEAST_RAD else "backwards"
        where = "is assumed to" if extrinsics == "identity" else f"is stated to ({extrinsics})"
        is_placed = place_sigma < _PLACE_M
        pose = error @ mounting if is_placed else Pose2(mounting.x, mounting.y, wrap_angle(mounting.theta + yaw))
        text = (
            f"the laser{f' of {topic}' if topic else ''} looks {looks} from where it {where}, by its scans and the "
            f"odometry (± {degrees(sigma):.1f} deg)"
        )
        place = "the place exactly" if is_placed else "the place, which is not known yet"
        remedy = f"{laser_pose_option(pose)}; hsloc calibrate finds {place}"
        found.append(RunWarning(WarningCode.EXTRINSICS_WRONG, text, remedy))
    return found


def right_mounting(
    paths: Sequence[Path], options: ReadOptions, parameters: FrontEndParameters, *, used: bool
) -> tuple[Pose2, RunWarning] | None:
    """How the only laser of a log is mounted, and a warning of that; None where it may look to where it is stated to.

    Its place stays as it is stated. `used` says that a map will be built with that. Raises LogError as `open_log` does.
    """
    log = open_log(paths, replace(options, deskew=False, start_s=None, end_s=None))
    stated, source = log.summary.T_base_laser, log.summary.extrinsics
    *_, motion = _motions(log.events(), parameters, (_MOST_SCANS,))
    error, _, sigma = _direction_by(motion)
    if not MountingError(error, (inf, inf, sigma)).is_turned:
        return None
    pose = Pose2(stated.x, stated.y, wrap_angle(stated.theta + error.theta))
    where = "is assumed to" if source == "identity" else f"is stated to ({source})"
    return pose, RunWarning(
        WarningCode.EXTRINSICS_WRONG,
        f"the laser looks {degrees(error.theta):.1f} ± {degrees(sigma):.1f} deg from where it {where}, by its scans "
        f"alone and the odometry{': the map is built with that' if used else ''}",
        f"measure it, or hsloc calibrate; {laser_pose_option(pose)}",
    )


def laser_pose_option(T_base_laser: Pose2) -> str:
    """The option that states this mounting, in m and rad."""
    return f"--laser-pose={T_base_laser.x:z.3f},{T_base_laser.y:z.3f},{T_base_laser.theta:z.4f}"


def _direction(motions: Iterable[_Motion]) -> tuple[Pose2, float, float]:
    """As `_direction_by`, of the first of these motions, each longer than the one before, that settles it, or the last.

    Settled is that the laser looks where it is said to, as far beyond doubt as an error must be, and that its steps
    agree with those of the odometry: among pillars some matches are wrong, in either direction. Of a laser that looks
    elsewhere the pose is stated, and all that is measured of it counts. It is given up where the scans turn otherwise
    than the odometry in two motions one after the other: with more of such matches nothing is settled either.
    """
    found, in_vain = _NOTHING, 0
    for motion in motions:
        in_vain = 0 if _turns_agree(motion) else in_vain + 1
        if in_vain == _MOST_IN_VAIN:
            return _NOTHING
        found = _direction_by(motion)
        seen, driven = motion.by_scans[:, :2], motion.by_odometry[:, :2]
        agree = np.sum(seen * driven) >= LEAST_AGREEMENT * sqrt(float(np.sum(seen**2) * np.sum(driven**2)))
        if agree and abs(found[0].theta) + MIN_SIGMAS * found[2] < _LEAST_RAD:
            break
    return found


def _direction_by(motion: _Motion) -> tuple[Pose2, float, float]:
    """The laser is at this pose `@` its mounting; standard deviations of place (m) and yaw (rad), infinite: not known.

    A laser that is mounted elsewhere by a place p and a yaw sees a step S of the base as
    `R(-yaw) (S + (R(turn) - 1) p)`. In complex numbers that is linear in two of them, which are found by robust least
    squares.
    """
    if len(motion.by_scans) < _FEWEST_OF_DIRECTION or not _turns_agree(motion):
        return _NOTHING
    turned = motion.by_scans[:, 2]
    seen, driven = (each[:, 0] + 1j * each[:, 1] for each in (motion.by_scans, motion.by_odometry))
    rows = np.stack((driven, np.exp(1j * turned) - 1.0), axis=1)
    values = np.zeros(2, dtype=np.complex128)
    for _ in range(10):
        misfit = np.abs(seen - rows @ values)
        scale = max(1.4826 * float(np.median(misfit)), _LEAST_M)
        weight = 1.0 / (1.0 + (misfit / scale) ** 2)
        information = np.einsum("np,n,nq->npq", rows.conj(), weight, rows)
        vectors = rows.conj() * (weight * seen)[:, None]
        values = np.linalg.solve(information.sum(axis=0) + PRIOR * np.eye(2), vectors.sum(axis=0))
    without = without_each_part(information, vectors, equal_parts(len(vectors), PARTS))
    low, high = _SCALES_OF_DIRECTION
    if not all(low < abs(each) < high for each in (values[0], *without[:, 0])):
        return _NOTHING
    every = np.vstack((values, without))
    turns = every[:, 0].conj() / np.abs(every[:, 0])  # e^(i yaw)
    places = every[:, 1] * turns
    spread = (PARTS - 1) / PARTS
    yaw_sigma = sqrt(spread * float(np.sum(np.angle(turns[1:] / turns[0]) ** 2)))
    place_sigma = sqrt(spread * float(np.sum(np.abs(places[1:] - places[0]) ** 2)))
    error = Pose2(float(places[0].real), float(places[0].imag), float(np.angle(turns[0])))
    return error, place_sigma, yaw_sigma


def _turns_agree(motion: _Motion) -> bool:
    """Whether scans and odometry turn alike; if not, the scans are mirrored, or one of the two is wrong."""
    if len(motion.by_scans) < _FEWEST_OF_DIRECTION:
        return True
    by_scans, by_odometry = motion.by_scans[:, 2], motion.by_odometry[:, 2]
    length = sqrt(float(np.sum(by_scans**2) * np.sum(by_odometry**2)))
    little = float(np.abs(by_odometry).sum()) <= _LEAST_TURNED
    return little or float(np.sum(by_scans * by_odometry)) >= LEAST_AGREEMENT * length


def _choice(
    laser: LaserSummary, paths: Sequence[Path], options: ReadOptions, parameters: FrontEndParameters
) -> tuple[int, RunWarning]:
    """The number of the mounting that is to be used, the last one where the data do not say."""
    names = [_in_words(each) for each in laser.alternatives]
    stated = f"{len(names)} mountings of {laser.frame} are stated ({' and '.join(names)})"
    last = len(names) - 1
    reading = replace(
        options, scan_topic=laser.topic, deskew=False, start_s=None, end_s=None,
        time_offset=None if options.time_offset == AUTO else options.time_offset,
    )  # fmt: skip
    try:
        misfits = [
            _misfits(replace(reading, mountings=((laser.frame, each),)), paths, parameters)
            for each in laser.alternatives
        ]
    except HslocError as error:  # No odometry, for example.
        return last, _undecided(stated, names[last], str(error).rpartition(": ")[2])
    length = min(map(len, misfits))
    if length < _FEWEST:
        return last, _undecided(stated, names[last], "the robot moves too little to decide which is right")
    table = np.array([each[:length] for each in misfits])
    best = int(np.argmin(_bounded(table).mean(axis=1)))
    if not all(_is_better(table[best], other) for k, other in enumerate(table) if k != best):
        return last, _undecided(stated, names[last], "scans and odometry agree about as well under each")
    medians = np.median(table, axis=1)
    others = " and ".join(f"{100 * medians[k]:.1f} cm" for k in range(len(names)) if k != best)
    return best, RunWarning(
        WarningCode.EXTRINSICS_CHOSEN,
        f"{stated}; {names[best]} is used, under which scans and odometry agree: their steps differ by "
        f"{100 * medians[best]:.1f} cm, against {others}",
        "remove the wrong one from the robot's description or launch files, or give --laser-pose x,y,yaw",
    )


def _undecided(stated: str, used: str, reason: str) -> RunWarning:
    return RunWarning(
        WarningCode.EXTRINSICS_UNDECIDED, f"{stated}; {used}, the last, is used: {reason}",
        "choose with --laser-pose x,y,yaw",
    )  # fmt: skip


def _in_words(transform: Transform3) -> str:
    mounting = laser_mounting(transform)
    pose = mounting.T_base_laser
    turned = " upside down" if mounting.flipped else ""
    return f"{pose.x:.3f},{pose.y:.3f},{pose.theta:.3f}{turned}"


def _misfits(options: ReadOptions, paths: Sequence[Path], parameters: FrontEndParameters) -> F64:
    """What the steps of scans and odometry differ in (m), a scale of the odometry allowed for; rotations by a lever."""
    *_, motion = _motions(open_log(paths, options).events(), parameters, (_MOST_SCANS,))
    seen, driven = motion.by_scans[:, :2], motion.by_odometry[:, :2]
    scale = np.clip(np.sum(seen * driven) / max(float(np.sum(driven**2)), 1e-12), *_SCALES)
    apart = seen - scale * driven
    turned = _LEVER_M * wrap_angles(motion.by_scans[:, 2] - motion.by_odometry[:, 2])
    return np.asarray(np.sqrt(np.sum(apart**2, axis=1) + turned**2))


def _motions(events: Iterable[Event], parameters: FrontEndParameters, looks: Sequence[int]) -> Iterator[_Motion]:
    """The motion of the base by scans and odometry, their clocks put together, after each of these numbers of scans.

    The last is that of all scans, where there are fewer.
    """
    odometry: list[tuple[int, float, float, float]] = []
    middles: dict[int, int] = {}
    most = looks[-1]

    def kept() -> Iterator[Event]:
        for event in ContinuousOdometry(events):
            if isinstance(event, Odometry):
                odometry.append((event.stamp_ns, *event.T_odom_base.to_array().tolist()))
                if len(middles) >= most:
                    return
            elif isinstance(event, Scan) and len(middles) < most:
                middles[event.stamp_ns] = event.stamp_ns + half_sweep_ns(event)
                yield event

    scans: list[tuple[int, float, float, float]] = []
    for event in with_laser_odometry(kept(), parameters, np.random.default_rng(0)):
        if isinstance(event, Odometry):
            scans.append((middles[event.stamp_ns], *event.T_odom_base.to_array().tolist()))
            if len(scans) in looks[:-1]:
                yield _compared(scans, odometry)
    yield _compared(scans, odometry)


def _compared(scans: list[tuple[int, float, float, float]], odometry: list[tuple[int, float, float, float]]) -> _Motion:
    """Steps of the poses (stamp, x, y, theta) by scans and by odometry."""
    nothing = np.zeros((0, 3))
    if len(scans) < 2 or len(odometry) < 2:
        return _Motion(np.zeros(0, dtype=np.int64), nothing, nothing)
    at, seen = _sorted(scans)
    stamps, driven = _sorted(odometry)
    offset = find_offset(Headings(at, seen[:, 2]), Headings(stamps, driven[:, 2]))
    if offset.is_significant:
        at = at - round(offset.seconds * 1e9)
    inside = (at >= stamps[0]) & (at <= stamps[-1])
    at, seen = at[inside], seen[inside]
    origin = int(stamps[0])
    there = np.column_stack([np.interp(at - origin, stamps - origin, driven[:, k]) for k in range(3)])
    first, second = _steps(at, there)
    return _Motion(at, relative_poses(seen[first], seen[second]), relative_poses(there[first], there[second]))


def _sorted(rows: list[tuple[int, float, float, float]]) -> tuple[I64, F64]:
    """Stamps (n,), each once, and poses (n, 3) with unwrapped headings."""
    stamps, first = np.unique(np.array([row[0] for row in rows], dtype=np.int64), return_index=True)
    poses = np.array([row[1:] for row in rows])[first]
    poses[:, 2] = np.unwrap(poses[:, 2])
    return stamps, poses


def _steps(stamps_ns: I64, poses: F64) -> tuple[list[int], list[int]]:
    """First and last scans of steps one after the other, by the odometry."""
    first, second, begin = [], [], 0
    for k in range(1, len(poses)):
        if (stamps_ns[k] - stamps_ns[begin]) / 1e9 > _LONGEST_S:
            begin = k
            continue
        x, y, turn = poses[k] - poses[begin]
        if np.hypot(x, y) >= _STEP_M or abs(turn) >= _STEP_RAD:
            first.append(begin)
            second.append(k)
            begin = k
    return first, second


def _bounded(misfits: F64) -> F64:
    """Huber's cost of misfits, scaled by the smallest usual one of all rows: matches that slipped count little."""
    scale = _HUBER * max(float(np.median(misfits, axis=-1).min()), _LEAST_M)
    small = np.minimum(misfits, scale)
    return np.asarray(small**2 + 2.0 * scale * (misfits - small))


def _is_better(best: F64, other: F64) -> bool:
    """Whether misfits (n,) are smaller than others, step by step, beyond chance: t of the means of parts of the log."""
    apart = np.diff(_bounded(np.array((best, other))), axis=0)[0]
    means = np.array([part.mean() for part in np.array_split(apart, min(_BLOCKS, len(apart) // 2))])
    deviation = float(np.std(means, ddof=1)) / sqrt(len(means))
    return float(means.mean()) > _LEAST_T * deviation

"""The poses of a run between two matches of its track, and how uncertain they are.

Between two matches the errors of odometry are a random walk whose ends are known: its mean is the mean of what both
ends predict, weighted by the share of the motion, as the variance grows with it.
"""

from __future__ import annotations

from math import cos, hypot, sin
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hsloc.localisation.interpolated_odometry import AtStamp, Sides, sides
from hsloc.localisation.kalman_filter import Anchor, SmoothedMatches, noise_around
from hsloc.model.pose2 import Pose2, compose_poses, pose_differences, rotated, wrap_angles

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from hsloc.localisation.motion_models import MotionModel

    F64 = NDArray[np.float64]

_METRES_PER_RADIAN = 0.5
"""Metres that a radian counts for in the share of the motion: about the track width of an indoor robot."""
_STEP_M, _FEW_STEPS = 0.2, 3.0
"""Motions (m) whose noise is independent, as the filter takes it from match to match, and the number of them from which
on the noise of a motion between two matches is theirs: taken as one, it is three times as large over 2 m."""
_STILL_M = 1e-6
"""Motion (m) that an odometry message counts for that states none, as where it is frozen and the robot is not."""
_MOST_ACCELERATION = 5.0
"""Acceleration of a robot (m/s^2), at most: that of half its weight, which is what tyres on a floor hold."""


class _Between(NamedTuple):
    """Poses between two matches of a track: rows, anchors before and after, and the share (n, 1) of the motion.

    `steps` (n,) are the motions of `_STEP_M` between the two. `sides` is what interpolation adds, if it adds anything.
    """

    rows: NDArray[np.int64]
    first: NDArray[np.int64]
    second: NDArray[np.int64]
    share: F64
    steps: F64
    sides: Sides | None

    def weights(self, motion: F64) -> F64:
        """Weights (n, 3) of what the second match predicts; `motion` (m, 3) are variances up to each anchor."""
        if self.sides is None:
            return np.broadcast_to(self.share, (len(self.rows), 3))
        before = self.share * motion[self.second] + self.sides.before
        total = motion[self.second] + self.sides.before + self.sides.after
        weights: F64 = np.divide(before, total, out=np.tile(self.share, 3), where=total > 0.0)
        return weights


def _between(odometry: F64, anchors: Sequence[Anchor], interpolated: Mapping[int, AtStamp]) -> _Between:
    counts = np.array([anchor.count for anchor in anchors])
    begins = np.array([anchor.begins for anchor in anchors])
    before = np.searchsorted(counts, np.arange(len(odometry)), side="right") - 1
    rows = np.flatnonzero((before >= 0) & (before + 1 < len(anchors)))
    rows = rows[~begins[before[rows] + 1]]
    first, second = before[rows], before[rows] + 1
    moved = np.cumsum(_STILL_M + _way(np.diff(odometry, axis=0, prepend=odometry[:1])))
    # Messages may be seconds apart: the motion from the last one before a scan to the scan counts, too.
    last = np.maximum(counts - 1, 0)
    at = np.array([anchor.T_odom_base.to_array() for anchor in anchors])
    at_anchors = moved[last] + np.where(counts > 0, _way(at - odometry[last]), 0.0)
    begin, end = at_anchors[first], at_anchors[second]
    share = np.clip((moved[rows] - begin) / np.maximum(end - begin, 1e-9), 0.0, 1.0)[:, None]
    around = None
    if interpolated or any(anchor.at.interpolation for anchor in anchors):
        around = sides(rows, (first, second), [anchor.at for anchor in anchors], interpolated)
    return _Between(rows, first, second, share, (end - begin) / _STEP_M, around)


def _way(steps: F64) -> F64:
    """Metres of each step (n, 3), its rotation with them."""
    way: F64 = np.hypot(steps[:, 0], steps[:, 1]) + _METRES_PER_RADIAN * np.abs(wrap_angles(steps[:, 2]))
    return way


def between_matches(
    poses: F64,
    odometry: F64,
    anchors: Sequence[Anchor],
    matched: SmoothedMatches,
    *,
    leads_to_first: bool = False,
    interpolated: Mapping[int, AtStamp] | None = None,
) -> F64:
    """The poses (n, 3) of a run, those between two matches of a track replaced by the mean of what both predict.

    With `leads_to_first` those before the first match lead to it: a start that is given is a guess.
    `odometry` (n, 3) belongs to the poses, those of its rows that are no messages are `interpolated`.
    """
    if len(anchors) < 2:
        return poses
    at_odometry = np.array([anchor.T_odom_base.inverse().to_array() for anchor in anchors])
    T_map_odom = compose_poses(matched.poses, at_odometry)
    between = _between(odometry, anchors, interpolated or {})
    rows, first, second = between.rows, between.first, between.second
    ahead = compose_poses(T_map_odom[first], odometry[rows])
    back = compose_poses(T_map_odom[second], odometry[rows])
    smoothed = poses.copy()
    begin = anchors[0].count if leads_to_first else 0
    smoothed[:begin] = compose_poses(T_map_odom[0], odometry[:begin])
    smoothed[rows] = ahead + between.weights(matched.motion) * pose_differences(back, ahead)
    smoothed[rows, 2] = wrap_angles(smoothed[rows, 2])
    return smoothed


def bridge_variances(
    odometry: F64,
    anchors: Sequence[Anchor],
    matched: SmoothedMatches,
    motion_model: MotionModel,
    interpolated: Mapping[int, AtStamp] | None = None,
    *,
    stamps_ns: NDArray[np.int64] | None = None,
) -> tuple[F64, NDArray[np.bool_]]:
    """What the odometry (n, 3) adds to the variances (n, 3) of poses between two matches: a walk whose ends are known.

    Of the variances of the odometry up to a match a quarter is left half-way. Where wheels slipped between two matches
    it is not known when: the slip may lie before or after a pose, as far as a robot that has a mass can go in the time
    between; `stamps_ns` (n,) are those of the odometry. Rows of it that are no messages are `interpolated`. Also
    returns to which poses (n,) interpolation or a slip adds.
    """
    unsure = np.zeros(len(odometry), dtype=np.bool_)
    variances = np.zeros((len(odometry), 3))
    for row, at in (interpolated or {}).items():
        variances[row], unsure[row] = at.variances(), True
    if len(anchors) >= 2:
        between = _between(odometry, anchors, interpolated or {})
        weights = between.weights(matched.motion)
        rows, _, second, share, steps, around = between
        motion = matched.motion.copy()
        for k in np.unique(second[steps > _FEW_STEPS]).tolist():
            way = odometry[max(anchors[k - 1].count - 1, 0) : anchors[k].count]
            turned = anchors[k].T_map_base.theta - anchors[k].T_odom_base.theta
            motion[k] = noise_around(anchors, k) * _walk_variances(way, turned, motion_model)
        left = (1.0 - weights) ** 2 * share + weights**2 * (1.0 - share)
        variances[rows] = left * motion[second]
        if around is not None:
            variances[rows] += around.mean
            unsure[rows] = (around.before + around.after).any(axis=1)
            measured = ~np.isin(rows, list(interpolated or {}))[:, None]
            variances[rows] += measured * ((1.0 - weights) ** 2 * around.before + weights**2 * around.after)
        of_slips = (1.0 / 3.0 - weights * (1.0 - weights)) * matched.slips[second]
        if stamps_ns is not None:
            of_slips = np.minimum(of_slips, _in_time(stamps_ns[rows], anchors, between, weights, matched.slips))
        variances[rows] += of_slips
        unsure[rows] |= matched.slips[second].any(axis=1)
    return variances, unsure


def _in_time(
    stamps_ns: NDArray[np.int64], anchors: Sequence[Anchor], between: _Between, weights: F64, slips: F64
) -> F64:
    """What slips (m, 3), squared, can add to the variances (n, 3) of poses between two matches in the time there was.

    A path with an acceleration of at most `a` is within `a t u / 2` of one of even speed with its ends, `t` and `u` the
    times to these. So are robot and odometry, which may differ by twice that. The slip was put on by the share of the
    motion, not of the time.
    """
    at_ns = np.array([anchor.at.stamp_ns for anchor in anchors])
    since = np.maximum(stamps_ns - at_ns[between.first], 0)[:, None] / 1e9
    left = np.maximum(at_ns[between.second] - stamps_ns, 0)[:, None] / 1e9
    apart = _MOST_ACCELERATION * since * left * np.array((1.0, 1.0, 1.0 / _METRES_PER_RADIAN))
    part = since / np.maximum(since + left, 1e-9)
    found: F64 = apart**2 / 3.0 + (weights - part) ** 2 * slips[between.second]
    return found


def _walk_variances(way: F64, turned: float, motion_model: MotionModel) -> F64:
    """Variances (3,) of odometry (n, 3) as a walk of short motions, in a frame in which its own is `turned`."""
    total, last = np.zeros((3, 3)), Pose2.from_array(way[0])
    for k, row in enumerate(way[1:], start=2):
        here = Pose2.from_array(row)
        step = last.between(here)
        size = hypot(step.x, step.y) + _METRES_PER_RADIAN * abs(step.theta)
        if size >= _STEP_M or k == len(way):
            covariance = min(_STEP_M / max(size, _STILL_M), 1.0) * motion_model.covariance(step)
            total += rotated(covariance, last.theta + turned)
            last = here
    # A walk of the heading takes the way aside; where that is known at both ends, 1/192 of its square is left half-way.
    x, y = (way[-1, :2] - way[0, :2]).tolist()
    c, s = cos(turned), sin(turned)
    aside = np.array((s * x + c * y, c * x - s * y, 0.0)) ** 2
    variances: F64 = np.diag(total) + total[2, 2] * aside / 48.0
    return variances

"""Odometry, mounting and time offset from the motion of the laser: robust least squares with covariance.

Between two scans the laser moved by what the scans show, and by what follows from the odometry with the parameters that
are sought; these make the two agree best over all pairs. Source: Censi, Franchi, Marchionni, Oriolo, *Simultaneous
calibration of odometry and sensor parameters for mobile robots*, T-RO 2013: the closed form for the mounting and the
scale, here the start of a Gauss-Newton iteration that also has the time offset; instead of trimming, steps that do not
fit are weighed down.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import atan2, pi, radians
from typing import TYPE_CHECKING

import numpy as np

from hsloc.model.calibration import OdometryCorrection
from hsloc.model.pose2 import Pose2, compose_poses, relative_poses, wrap_angle, wrap_angles
from hsloc.slam.heading_offset import Headings, find_offset
from hsloc.slam.time_offset import RANGE_S

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]

NAMES = ("scale", "rotation_scale", "turn_per_metre", "x", "y", "yaw", "time_offset")
"""The parameters, in the order of vectors and covariances."""
UNITS = ("", "", "rad/m", "m", "m", "rad", "s")
_NOMINAL = np.array((1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0))
LIMITS = np.array((0.05, 0.05, 0.05, 0.05, 0.05, radians(3.0), 0.1))
"""Standard deviations above which a parameter counts as not determined: a value that uncertain is worse than a ruler or
the data sheet. Internal."""
NEEDS = (
    "the robot drove too little",
    "the robot turned too little",
    "the robot drove straight on for too little of the way",
    "the robot turned too little",
    "the robot turned too little",
    "the robot drove too little",
    "the robot turned too evenly or too little",
)
"""What the motion lacks where a parameter is not determined."""
ONE_SIDED = "the robot turned to one side only, where slip looks like another mounting"
_MIN_OTHER_SIDE = 0.1
"""Minimum part of the rotation that goes to the other side: there slip has another sign, the mounting has not."""
_STEP_M, _STEP_RAD = 0.2, 0.2
"""Length of a step (m, rad): long against the noise of single scans, short against the way on which wheels slip."""
_LONGEST_S = 5.0
"""Steps that take longer hold a pause or a gap (s)."""
_FEWEST = 20
"""Minimum number of steps of an estimate."""
_CHI = 4.033
"""99.9th percentile of the chi of three degrees of freedom: what lies beyond is no noise, and is weighed down."""
_BLOCKS = 30
"""Parts of the log whose errors count as independent of each other; each lasts for many steps."""
_DELTA = np.array((1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 2e-3))
"""Steps of the numeric derivatives; that of the time is of the order of a period of the odometry."""


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Poses (n, 3) at stamps (n,) in nanoseconds, sorted, each stamp once; headings unwrapped."""

    stamps_ns: I64
    poses: F64

    @staticmethod
    def of(stamps_ns: I64, poses: F64) -> Track:
        """Sorted by time, and of each stamp the first."""
        stamps, first = np.unique(stamps_ns, return_index=True)
        return Track(stamps, np.column_stack((poses[first, :2], np.unwrap(poses[first, 2]))))

    def headings(self) -> Headings:
        """Its headings alone."""
        return Headings(self.stamps_ns, self.poses[:, 2])


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Values (7,) in the order of `NAMES`, their covariance (7, 7), and which of them the motion determines.

    What is not determined has its nominal value and no covariance. `quantile` times a standard deviation is half of
    the 95 % interval. `steps` is how many were compared, `outliers` how many were weighed down to less than half;
    `residual_m` and `residual_rad` are the medians of what is left of a step.
    """

    values: F64
    covariance: F64
    determined: NDArray[np.bool_]
    quantile: float
    steps: int
    outliers: int
    residual_m: float
    residual_rad: float
    driven_m: float
    turned_rad: float
    reasons: dict[str, str] = field(default_factory=dict)
    """What the motion lacks, by the name of each parameter that it does not determine."""

    @property
    def sigmas(self) -> F64:
        """Standard deviations (7,); NaN where undetermined."""
        return np.where(self.determined, np.sqrt(np.diag(self.covariance)), np.nan)

    @property
    def correction(self) -> OdometryCorrection:
        """That of the odometry."""
        return OdometryCorrection(*(float(value) for value in self.values[:3]))

    @property
    def T_base_laser(self) -> Pose2:
        """The mounting."""
        return Pose2.from_array(self.values[3:6])

    @property
    def track(self) -> tuple[float, float]:
        """True track of a differential drive over the assumed one, and its standard deviation."""
        factor = self.correction.track_factor
        slope = factor * np.array((1.0 / self.values[0], -1.0 / self.values[1]))
        return factor, float(np.sqrt(slope @ self.covariance[:2, :2] @ slope))

    def wheels(self, radius: float, track: float) -> dict[str, tuple[float, float]]:
        """Radii of the left and the right wheel and the track (m) with standard deviations, of those assumed.

        With radii that differ by a part d, the base that drives straight is d track / 4 beside the middle of the axle.
        """

        def of(values: F64) -> F64:
            scale, rotation, turn = values
            apart = 0.5 * turn * track / rotation
            return np.array((scale * radius * (1.0 - apart), scale * radius * (1.0 + apart), scale * track / rotation))

        values = self.values[:3]
        slopes = np.column_stack([(of(values + d) - of(values - d)) / 2e-6 for d in 1e-6 * np.eye(3)])
        sigmas = np.sqrt(np.diag(slopes @ self.covariance[:3, :3] @ slopes.T))
        names = ("left_radius", "right_radius", "track")
        return dict(zip(names, zip(of(values).tolist(), sigmas.tolist(), strict=True), strict=True))


class Undetermined(ValueError):
    """Nothing can be estimated; the text says why."""


def estimate(laser: Track, odometry: Track, nominal_mounting: Pose2) -> Estimate:
    """Estimate all parameters that the motion determines; the others stay, the mounting at `nominal_mounting`.

    Raises Undetermined where there are too few steps.
    """
    problem = _Problem(laser, odometry)
    nominal = _NOMINAL.copy()
    nominal[3:6] = nominal_mounting.to_array()
    free = np.ones(7, dtype=bool)
    values = problem.start(nominal)
    one_sided = problem.is_one_sided()
    if one_sided:
        free[3:5] = False
        values[3:5] = nominal[3:5]
    while True:
        found, certain = problem.solve(values, free)
        if found.values[0] < 0.0 and free[0] and free[3:6].all():
            # The same motion, seen from a base that drives backwards: mounted the other way round.
            values = found.values * (-1.0, 1.0, 1.0, -1.0, -1.0, 1.0, 1.0)
            values[5] = wrap_angle(float(found.values[5]) + pi)
            found, certain = problem.solve(values, free)
        reasons = {
            name: ONE_SIDED if one_sided and name in ("x", "y") else NEEDS[k]
            for k, name in enumerate(NAMES)
            if not free[k]
        }
        found = replace(found, reasons=reasons)
        # What the equations do not hold at all has no spread either.
        sigmas = np.maximum(np.sqrt(np.diag(found.covariance)), certain)
        ratio = np.where(free, sigmas / LIMITS, 0.0)
        worst = int(np.argmax(ratio))
        if ratio[worst] <= 1.0:
            return found
        # The worst first: what is left may be determined once that is held.
        free[worst] = False
        values = np.where(free, found.values, nominal)


class _Problem:
    """Steps of the laser, and what the odometry says to them."""

    def __init__(self, laser: Track, odometry: Track) -> None:
        if len(laser.poses) < 2 or len(odometry.poses) < 2:
            raise Undetermined("there is no odometry, or there are no scans that could be matched")
        self.odometry = odometry
        self.origin_ns = int(odometry.stamps_ns[0])
        self.t_odometry = (odometry.stamps_ns - self.origin_ns) / 1e9
        self.t_laser = (laser.stamps_ns - self.origin_ns) / 1e9
        self.laser = laser
        self.first, self.second = _steps(laser)
        self.seen = relative_poses(laser.poses[self.first], laser.poses[self.second])
        self.seen[:, 2] = laser.poses[self.second, 2] - laser.poses[self.first, 2]

    def start(self, nominal: F64) -> F64:
        """The time offset by the headings, then scale and mounting in closed form."""
        values = nominal.copy()
        for near_s in (0.5, RANGE_S):
            offset = find_offset(self.laser.headings(), self.odometry.headings(), near_s)
            if np.isfinite(offset.sigma) and (near_s == RANGE_S or self._inside(offset.seconds).mean() > 0.9):
                values[6] = offset.seconds
                break
        moved = self._odometry_steps(values)
        inside = self._inside(values[6])
        if inside.sum() < _FEWEST:
            raise Undetermined(
                f"{int(inside.sum())} steps of {_STEP_M:g} m or {_STEP_RAD:g} rad are seen by both scans and odometry; "
                f"{_FEWEST} are needed"
            )
        moved, seen = moved[inside], self.seen[inside]
        c, s = np.cos(moved[:, 2]), np.sin(moved[:, 2])
        # R(yaw) / k seen = odometry + (R(turn) - 1) l / k, linear in (cos yaw, sin yaw) / k and l / k.
        rows = np.concatenate(
            (
                np.column_stack((seen[:, 0], -seen[:, 1], 1.0 - c, s)),
                np.column_stack((seen[:, 1], seen[:, 0], -s, 1.0 - c)),
            )
        )
        wanted = np.concatenate((moved[:, 0], moved[:, 1]))
        for _ in range(5):
            found, *_rest = np.linalg.lstsq(rows, wanted, rcond=1e-6)
            apart = np.abs(rows @ found - wanted)
            keep = apart <= max(3.0 * float(np.median(apart)), 1e-6)
            rows, wanted = rows[keep], wanted[keep]
        size = float(np.hypot(found[0], found[1]))
        if 0.5 < size < 2.0:
            values[0] = 1.0 / size
            values[3:5] = found[2:] / size
            values[5] = atan2(found[1], found[0])
        return values

    def is_one_sided(self) -> bool:
        """Whether nearly all of the rotation goes to one side; then part of the mounting is not determined."""
        turned = self.seen[:, 2]
        total = float(np.abs(turned).sum())
        other = min(float(turned[turned > 0.0].sum()), -float(turned[turned < 0.0].sum()))
        return total > 1.0 and other < _MIN_OTHER_SIDE * total

    def _inside(self, offset_s: float) -> NDArray[np.bool_]:
        at = self.t_laser - offset_s
        inside = (at >= self.t_odometry[0]) & (at <= self.t_odometry[-1])
        return np.asarray(inside[self.first] & inside[self.second])

    def _odometry_steps(self, values: F64) -> F64:
        """Steps (m, 3) of the base between the times of the scans, with unwrapped rotations."""
        correction = OdometryCorrection(float(values[0]), float(values[1]), float(values[2]))
        track = correction(self.odometry.poses)
        at = self.t_laser - values[6]
        poses = np.column_stack([np.interp(at, self.t_odometry, track[:, column]) for column in range(3)])
        steps = relative_poses(poses[self.first], poses[self.second])
        steps[:, 2] = poses[self.second, 2] - poses[self.first, 2]
        return steps

    def residuals(self, values: F64) -> F64:
        """Seen minus predicted steps of the laser (m, 3), in the frame of each step's beginning."""
        mounting = values[3:6]
        steps = self._odometry_steps(values)
        T_laser_base = Pose2.from_array(mounting).inverse().to_array()
        predicted = compose_poses(compose_poses(T_laser_base, steps), mounting)
        apart = self.seen - predicted
        apart[:, 2] = wrap_angles(self.seen[:, 2] - steps[:, 2])
        return apart

    def solve(self, start: F64, free: NDArray[np.bool_]) -> tuple[Estimate, F64]:
        """Gauss-Newton on the free parameters with weights by the residuals' own robust covariance.

        Also standard deviations (7,) as if all steps were independent, which are huge where the equations are singular.
        """
        values = start.copy()
        which = np.flatnonzero(free)
        for _ in range(30):
            inside = self._inside(values[6])
            if inside.sum() < _FEWEST:
                raise Undetermined("the stamps of scans and odometry do not overlap")
            residual = self.residuals(values)[inside]
            jacobian = self._jacobian(values, which)[inside]
            information, weight = _weights(residual)
            gradients = np.einsum("nip,ij,nj,n->np", jacobian, information, residual, weight)
            hessians = np.einsum("nip,ij,njq,n->npq", jacobian, information, jacobian, weight)
            change = np.linalg.lstsq(hessians.sum(axis=0), gradients.sum(axis=0), rcond=1e-10)[0]
            # The equations are linear but for the angles and the time: no step may leave their neighbourhood.
            change = np.clip(change, -0.2, 0.2)
            values[which] += change
            values[5] = wrap_angle(float(values[5]))
            if np.all(np.abs(change) < 1e-7):
                break
        covariance, quantile = _covariance(hessians, gradients, which)
        apart = np.median(np.abs(residual), axis=0)
        scale = LIMITS[which]
        size, axes = np.linalg.eigh(hessians.sum(axis=0) * np.outer(scale, scale))
        certain = np.zeros(7)
        certain[which] = scale * np.sqrt((axes**2 / np.maximum(size, 1e-12)).sum(axis=1))
        estimate = Estimate(
            values,
            covariance,
            free.copy(),
            quantile,
            len(residual),
            int((weight < 0.5).sum()),
            float(np.hypot(apart[0], apart[1])),
            float(apart[2]),
            float(np.hypot(self.seen[:, 0], self.seen[:, 1]).sum()),
            float(np.abs(self.seen[:, 2]).sum()),
        )
        return estimate, certain

    def _jacobian(self, values: F64, which: NDArray[np.intp]) -> F64:
        """Derivatives of the predicted steps (m, 3, p)."""
        columns = []
        for k in which.tolist():
            delta = np.zeros(7)
            delta[k] = _DELTA[k]
            apart = self.residuals(values - delta) - self.residuals(values + delta)
            apart[:, 2] = wrap_angles(apart[:, 2])
            columns.append(apart / (2.0 * _DELTA[k]))
        return np.stack(columns, axis=2)


def _weights(residual: F64) -> tuple[F64, F64]:
    """Information (3, 3) of the residuals, and the weight of each."""
    scale = np.maximum(1.4826 * np.median(np.abs(residual), axis=0), 1e-6)
    covariance = np.diag(scale**2)
    weight = np.ones(len(residual))
    for _ in range(5):
        information = np.linalg.inv(covariance)
        distance = np.sqrt(np.einsum("ni,ij,nj->n", residual, information, residual))
        weight = np.minimum(1.0, (_CHI / np.maximum(distance, 1e-9)) ** 2)
        covariance = (residual * weight[:, None]).T @ residual / max(float(weight.sum()), 1.0)
        covariance += 1e-12 * np.eye(3)
    return np.asarray(information), weight


def _covariance(hessians: F64, gradients: F64, which: NDArray[np.intp]) -> tuple[F64, float]:
    """Covariance (7, 7) that allows for errors that last, and the 97.5th percentile of its t distribution.

    Slip and drift last for seconds, so that steps are not independent, parts of the log are: the estimate without each
    part in turn says how far it depends on chance (block jackknife; Efron and Tibshirani 1993, chapter 11). To first
    order, from the equations (n, p, p) and (n, p) of each step. The parts that the parameters use up do not count.
    """
    from scipy.stats import t as student

    blocks = min(_BLOCKS, len(gradients) // 2)
    whole = hessians.sum(axis=0)
    changes = np.array(
        [
            np.linalg.lstsq(whole - part.sum(axis=0), rest.sum(axis=0), rcond=1e-12)[0]
            for part, rest in zip(np.array_split(hessians, blocks), np.array_split(gradients, blocks), strict=True)
        ]
    )
    covariance = np.zeros((7, 7))
    left = max(blocks - 1 - len(which), 1)
    covariance[np.ix_(which, which)] = changes.T @ changes * ((blocks - 1.0) / blocks * (blocks - 1.0) / left)
    return covariance, float(student.ppf(0.975, left))


def _steps(laser: Track) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First and last scans of steps one after the other, each `_STEP_M` long or with `_STEP_RAD` of rotation."""
    first, second = [], []
    begin, driven, turned = 0, 0.0, 0.0
    moves = relative_poses(laser.poses[:-1], laser.poses[1:])
    lengths, turns = np.hypot(moves[:, 0], moves[:, 1]), np.abs(moves[:, 2])
    for k in range(len(moves)):
        if (laser.stamps_ns[k + 1] - laser.stamps_ns[begin]) / 1e9 > _LONGEST_S:
            begin, driven, turned = k + 1, 0.0, 0.0
            continue
        driven, turned = driven + float(lengths[k]), turned + float(turns[k])
        if driven >= _STEP_M or turned >= _STEP_RAD:
            first.append(begin)
            second.append(k + 1)
            begin, driven, turned = k + 1, 0.0, 0.0
    return np.array(first, dtype=np.intp), np.array(second, dtype=np.intp)

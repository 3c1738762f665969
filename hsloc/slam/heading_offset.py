"""The offset between two clocks by which a heading was recorded: of scans and of odometry.

Steps of one heading are compared with those of the other, which is interpolated. Interpolation averages noise, most of
all half-way between two samples: a search for the smallest residual prefers offsets of half an interval to none, and
does so the more the noisier the odometry is. A B-spline as wide as the samples are apart averages alike at every
offset, but blurs what is sharp where scans and odometry were recorded together and share the jitter of their stamps.
So the offset is found without it, and again with it; by how much the two differ is a part of the uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot, isfinite, sqrt
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]

NANOSECONDS = 1e9
_GRID_S = 0.05
"""Step of the coarse search (s): a lidar turns at 5 to 40 Hz, and headings are interpolated between."""
NEAR_S = 0.5
"""Half-width of the search where nothing is known of the clocks but that the run did not get lost (s)."""
_LEAST_TURNED = 1.0
"""Sum of rotation (rad) without which the offset is not determined."""
MIN_STEPS = 20
_SPARSE_S = 0.25
"""Time (s) between messages beyond which the odometry is not interpolated: half-way it would miss 8 mrad of a turn that
starts with 1 rad/s^2, several times the noise of a matched scan, and show an offset that is none."""
_HUBER = 1.345
"""Scale of the robust weights in standard deviations (Huber 1981): 95 % efficient on Gaussian errors."""
SIGNIFICANT = 4.0
"""Minimum ratio of an offset to its standard deviation; under Gaussian errors once in 16,000 runs."""
_CERTAIN = 10.0
"""The same for an offset that is removed without being asked for: odometry that is 20 times noisier than usual shows
offsets of 4 to 6 standard deviations where there are none, as its errors last for a turn."""
SMALLEST_S = 0.02
"""Offsets below this (s) are not worth a word: they move a beam by 2 cm at 1 m/s."""
_NODES = 4
"""Times within a width at which a heading is looked up. Internal: sums over them are integrals enough."""
_BOX = np.full(_NODES, 1.0 / _NODES)
_SPLINE = np.convolve(np.convolve(_BOX, _BOX), _BOX)
"""Weights of the nodes: a box, smoothed by itself twice."""
_APART = 0.5
"""Standard deviation of an offset as a part of the difference between what is found with the spline and without. In
simulated logs of 0.02 to 1 s between messages, whose odometry errs by 2 to 10 % of each step or by 45 mrad a root
second, offsets were up to 0.09 s and 24 standard deviations off without it."""


class Offset(NamedTuple):
    """The scans' stamps are `seconds` later than the odometry's; `sigma` is the standard deviation (s).

    0.1 means that a scan stamped t shows the robot where the odometry has it at t - 0.1 s.
    """

    seconds: float
    sigma: float
    drift_s: float = 0.0
    """By how much it grows from the first scan to the last (s), where that matters and is not chance."""
    is_mirrored: bool = False
    """The scans turn the other way than the odometry: then there is no offset."""
    half_sweep_s: float = 0.0
    """From the first beam, whose stamp is meant, to the middle of a scan (s)."""

    @property
    def is_significant(self) -> bool:
        """Whether it is neither chance nor too small to matter."""
        return isfinite(self.sigma) and abs(self.seconds) > max(SIGNIFICANT * self.sigma, SMALLEST_S)

    @property
    def is_certain(self) -> bool:
        """Whether it may be removed without being asked for: it is far from chance, and the same all the time."""
        return self.is_significant and abs(self.seconds) > _CERTAIN * self.sigma and not self.drift_s

    @property
    def is_of_sweep(self) -> bool:
        """Whether an offset from the middle of the sweeps, if there is one, may be that of scans in which robots moved.

        They show the time at which the lidar looked at what fixes the heading, the middle only where walls are all
        round. What is nearer to the ends of the sweep than to its middle is an offset of the clocks.
        """
        return not self.is_significant or abs(self.seconds) < 0.5 * self.half_sweep_s


UNKNOWN = Offset(0.0, float("inf"))
"""What is known of a robot that does not turn."""


@dataclass(frozen=True, slots=True, eq=False)
class Headings:
    """Headings (n,) in radians, unwrapped, at stamps (n,) in nanoseconds that do not run backwards."""

    stamps_ns: I64
    theta: F64

    @staticmethod
    def of(stamps_ns: I64, theta: F64) -> Headings:
        """Sorted by time, and of each stamp the first."""
        order = np.argsort(stamps_ns, kind="stable")
        stamps, first = np.unique(stamps_ns[order], return_index=True)
        return Headings(stamps, np.unwrap(theta[order])[first])


def find_offset(scans: Headings, odometry: Headings, near_s: float = NEAR_S, start_s: float = 0.0) -> Offset:
    """The offset at which steps of the scans' heading agree best with those of the odometry.

    Searched within `near_s` of `start_s`: first on a grid, then by robust least squares on the steps, whose residuals
    give the standard deviation. Sparse odometry is compared where it is, with the scans interpolated.
    """
    if len(scans.theta) < MIN_STEPS or len(odometry.theta) < MIN_STEPS:
        return UNKNOWN
    if is_sparse(odometry, scans):
        found = find_offset(odometry, scans, near_s, -start_s)
        return found._replace(seconds=-found.seconds)
    origin = int(odometry.stamps_ns[0])
    t_odom = (odometry.stamps_ns - origin) / NANOSECONDS
    t_scan = (scans.stamps_ns - origin) / NANOSECONDS
    seen = np.diff(scans.theta)

    def steps(offset: float) -> F64:
        """The odometry's steps between the scans, NaN outside of its time."""
        at = t_scan - offset
        inside = (at >= t_odom[0]) & (at <= t_odom[-1])
        return np.diff(np.where(inside, np.interp(at, t_odom, odometry.theta), np.nan))

    def cost(offset: float) -> float:
        difference = seen - steps(offset)
        known = difference[~np.isnan(difference)]
        if len(known) < max(MIN_STEPS, len(seen) // 4):
            return float("inf")
        return float(np.mean(np.minimum(np.abs(known), 0.5)))

    if float(np.abs(seen).sum()) < _LEAST_TURNED:
        return UNKNOWN
    # Steps are taken between scans, wherever these are; a grid finer than they are finds the valley.
    grid = start_s + np.arange(-near_s, near_s + _GRID_S / 2.0, _GRID_S)
    costs = np.array([cost(float(offset)) for offset in grid])
    if not np.isfinite(costs).any():
        return UNKNOWN
    best = float(grid[int(np.argmin(costs))])
    found = _refined(best, seen, steps)
    width = float(np.median(np.diff(t_odom)))
    smoothed = _refined(best, seen, lambda offset: np.diff(_smoothed(t_scan - offset, t_odom, odometry.theta, width)))
    # Where the ends of a short log are all there is the spline knows nothing.
    apart = found.seconds - smoothed.seconds if isfinite(smoothed.sigma) else 0.0
    return found._replace(sigma=hypot(found.sigma, _APART * apart))


def _smoothed(at: F64, stamps: F64, theta: F64, width: float) -> F64:
    """A heading at times (m,), averaged by a quadratic B-spline of three times `width` (s); NaN near the ends."""
    nodes = (np.arange(len(_SPLINE)) - 0.5 * (len(_SPLINE) - 1)) * width / _NODES
    values = np.interp((at + nodes[:, None]).ravel(), stamps, theta).reshape(len(nodes), -1)
    inside = (at + nodes[0] >= stamps[0]) & (at + nodes[-1] <= stamps[-1])
    return np.where(inside, _SPLINE @ values, np.nan)


def _refined(best: float, seen: F64, steps: Callable[[float], F64]) -> Offset:
    """Gauss-Newton on the offset, with Huber's weights; the standard deviation from the spread of the residuals.

    The odometry's `steps` at an offset are NaN where they are not known.
    """
    half = 0.5 * _GRID_S
    sigma = float("inf")
    for _ in range(20):
        slope = (steps(best + half) - steps(best - half)) / (2.0 * half)
        residual = seen - steps(best)
        known = ~np.isnan(slope) & ~np.isnan(residual)
        if not known.any():
            return UNKNOWN
        slope, residual = slope[known], residual[known]
        scale = max(1.4826 * float(np.median(np.abs(residual - np.median(residual)))), 1e-5)
        weight = np.minimum(1.0, _HUBER * scale / np.maximum(np.abs(residual), 1e-12))
        information = float(np.sum(weight * slope**2))
        if information <= 0.0:
            return UNKNOWN
        change = float(np.sum(weight * slope * residual)) / information
        change = min(max(change, -_GRID_S), _GRID_S)
        best += change
        # Sandwich estimate: steps that follow each other share the error of the scan between them.
        moments = weight * slope * residual
        spread = float(np.sum(moments**2) + 2.0 * np.sum(moments[1:] * moments[:-1]))
        sigma = sqrt(max(spread, float(np.sum(moments**2)))) / information
        if abs(change) < 1e-5:
            break
    return Offset(best, sigma)


def thinned(headings: Headings, step_s: float = 0.2) -> Headings:
    """Headings at least `step_s` apart."""
    kept = [0] if len(headings.theta) else []
    for k, stamp in enumerate(headings.stamps_ns.tolist()):
        if stamp - int(headings.stamps_ns[kept[-1]]) >= step_s * NANOSECONDS:
            kept.append(k)
    return Headings(headings.stamps_ns[kept], headings.theta[kept])


def is_sparse(headings: Headings, others: Headings) -> bool:
    """Whether headings are too far apart to be interpolated, and farther than others."""
    if min(len(headings.theta), len(others.theta)) < 2:
        return False
    interval_ns, other_ns = (float(np.median(np.diff(each.stamps_ns))) for each in (headings, others))
    return interval_ns > max(other_ns, _SPARSE_S * NANOSECONDS)

"""The scans that were seen while a pose was unknown, matched backwards from where it is known."""

from __future__ import annotations

from math import radians
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hsloc.localisation.interpolated_odometry import AtStamp
from hsloc.localisation.kalman_filter import (
    SETTLED,
    Anchor,
    Innovations,
    difference,
    fuse_match,
    predict_covariance,
    smooth_matches,
)
from hsloc.matching.covariance import match_information
from hsloc.matching.window import Window
from hsloc.model.estimate import Revised
from hsloc.model.pose2 import Pose2, rotated

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from numpy.random import Generator
    from numpy.typing import NDArray

    from hsloc.localisation.motion_models import MotionModel
    from hsloc.matching.likelihood_field import LikelihoodField
    from hsloc.matching.match import Matcher
    from hsloc.model.events import PairedScan

    F64 = NDArray[np.float64]
    SeenScan = tuple[int, F64, PairedScan]
    """Odometry messages before a scan, its points in the frame of the base, and the scan."""

STEP_WINDOW = (0.25, 0.25, radians(8.0))
"""Half-widths (m, m, rad) of the window from one scan of a search to the next."""
_TRACE_LOST = 3
"""Scans in a row that fit nowhere near, going backwards: before them the robot was elsewhere, or is not known."""


class RetracedScan(NamedTuple):
    """A scan and where it was taken: odometry messages before, T_map_base and its covariance (3, 3), if it fits.

    The odometry up to here is `noise_scale` times as noisy as assumed (variances).
    """

    odometry_count: int
    pose: Pose2
    covariance: F64
    paired: PairedScan
    fits: bool
    noise_scale: float = 1.0


class Retracer:
    """Matches scans one after the other backwards, as the localiser does forwards."""

    def __init__(
        self,
        likelihood: LikelihoodField,
        matcher: Matcher,
        motion_model: MotionModel,
        rng: Generator,
        is_hidden: Callable[[PairedScan, Pose2], bool],
    ) -> None:
        """`is_hidden` says of a match that does not fit whether it is right but for what hides the walls."""
        self._field = likelihood
        self._matcher = matcher
        self._motion_model = motion_model
        self._rng = rng
        self._is_hidden = is_hidden

    def trace(
        self, pose: Pose2, covariance: F64, least: float, seen: Iterable[SeenScan], most: int
    ) -> list[RetracedScan]:
        """The last of the `seen` scans, at most `most` of them, back to where none fits with the fitness `least`.

        The robot was at `pose` at the first of them, the last one that was seen.
        """
        traced: list[RetracedScan] = []
        misses = 0
        innovations, noise = Innovations(), np.zeros((3, 3))
        propagated = covariance
        T_odom_next: Pose2 | None = None
        for count, points, paired in seen:
            T_odom_base = paired.T_odom_base
            if T_odom_next is not None:
                motion = T_odom_next.between(T_odom_base)
                propagated = predict_covariance(covariance, pose, motion, np.zeros((3, 3)))
                noise = rotated(self._motion_model.covariance(motion), pose.theta)
                covariance = propagated + max(innovations.noise_scale, 1.0) * noise
                pose = pose @ motion
            T_odom_next = T_odom_base
            match = self._matcher.match(points, self._field, Window(pose, *STEP_WINDOW), self._rng)
            misses += 1
            fits = match.fitness >= least or self._is_hidden(paired, match.pose)
            if fits:
                information = match_information(points, self._field, match.pose)
                if information is not None:
                    innovations.add(difference(match.pose, pose), information, propagated, noise)
                pose, covariance = fuse_match(pose, covariance, match, information)
                misses = 0
            traced.append(
                RetracedScan(count, pose, innovations.excess * covariance, paired, fits, innovations.noise_scale)
            )
            if misses == _TRACE_LOST or len(traced) == most:
                break
        return traced

    def revised(self, traced: Sequence[RetracedScan]) -> tuple[tuple[Revised, ...], bool]:
        """Poses of a trace from its begin on, without the scans there that do not fit; and whether there are none such.

        They know the scans after them, and are smoothed by those before. The covariances of the first scans that were
        traced know how the trace began; those are as sure as the next ones.
        """
        misses = next((k for k, each in enumerate(reversed(traced)) if each.fits), len(traced))
        kept = traced[: len(traced) - misses]
        anchors = []
        for k, each in enumerate(kept):
            settled = kept[max(k, min(SETTLED, len(kept) - 1))]
            T_odom_base, at = each.paired.T_odom_base, AtStamp(each.paired.scan.stamp_ns, each.paired.interpolation)
            anchors.append(
                Anchor(each.odometry_count, T_odom_base, each.pose, settled.covariance, k == 0, each.noise_scale, at=at)
            )
        smoothed = smooth_matches(anchors, self._motion_model)
        found = [
            Revised(anchor.count, Pose2.from_array(pose) @ anchor.T_odom_base.inverse(), covariance)
            for anchor, pose, covariance in zip(anchors, smoothed.poses, smoothed.covariances, strict=True)
        ]
        return tuple(reversed(found)), misses == 0

"""Scans in a room of 6 x 4 m by hand, and the equations of a pair of them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from hsloc.kernels.point_to_line import PairTerm, pair_terms
from hsloc.model import Pose2, Scan

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.slam.keyscans import KeyScans

DEGREE = np.radians(1.0)


def room_scan(pose: Pose2, *, beams: int = 181, noise: float = 0.0, seed: int = 0, increment: Any = DEGREE) -> Scan:
    """What a laser in a room of 6 x 4 m sees, by hand: the nearest of four walls."""
    angles = pose.theta - increment * (beams - 1) / 2 + increment * np.arange(beams)
    with np.errstate(divide="ignore"):
        to_x = np.where(np.cos(angles) > 0, 6.0 - pose.x, -pose.x) / np.cos(angles)
        to_y = np.where(np.sin(angles) > 0, 4.0 - pose.y, -pose.y) / np.sin(angles)
    ranges = np.minimum(np.abs(to_x), np.abs(to_y))
    ranges = ranges + noise * np.random.default_rng(seed).standard_normal(beams)
    return Scan(0, ranges.astype(np.float32), -increment * (beams - 1) / 2, increment, 0.05, 30.0)


def terms(
    scans: KeyScans,
    i: int,
    j: int,
    pose: NDArray[np.float64] | tuple[float, float, float],
    *,
    gate: float = 0.3,
    scale: float = 1e6,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    term, counts = pair_term(scans, i, j, pose, gate=gate, scale=scale)
    return term.information, term.gradient, counts


def pair_term(
    scans: KeyScans,
    i: int,
    j: int,
    pose: NDArray[np.float64] | tuple[float, float, float],
    *,
    gate: float = 0.3,
    scale: float = 1e6,
) -> tuple[PairTerm, NDArray[np.float64]]:
    """The whole term, and its counts."""
    term, counts = PairTerm(np.empty((3, 3)), np.empty(3), np.empty((3, 3))), np.empty(5)
    pair_terms(i, j, np.array(pose, dtype=float), scans.arrays(10_000), gate, scale, term, counts)
    return term, counts

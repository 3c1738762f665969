"""What can be proven about a match: that no pose of the window is fitter, and how fit any other place can be at most.

A search such as HIDE finds a pose and knows nothing of those it did not look at. Branch and bound over continuous boxes
(hsloc/kernels/branch_and_bound.py) starts from that pose, rules out all others, or finds the fitter one. See
docs/certificates.md for what this states about a robot, and what it does not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import radians
from typing import TYPE_CHECKING, Annotated

import numpy as np

from hsloc.kernels.branch_and_bound import BoxSearch, maximise
from hsloc.matching.covariance import match_covariance
from hsloc.matching.harmony_search import half_widths_in, information_at, low_discrepancy_order
from hsloc.matching.score_pyramid import score_pyramid
from hsloc.model.certificate import Certificate
from hsloc.parameters import Angle, Count, Parameters, Positive, Range, Ratio

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from hsloc.matching.likelihood_field import LikelihoodField
    from hsloc.matching.match import Match
    from hsloc.matching.window import Window

    F64 = NDArray[np.float64]

_SMALLEST = 0.01
"""Cells by which a box moves points at least: smaller ones are below the rounding of the field."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CertificateParameters(Parameters):
    """What is to be proven about a match, and how much work may be spent on it."""

    epsilon: Annotated[float, Range(1e-6, 1.0)] = 0.01
    """Fitness by which another pose of the window may be fitter than the match: the gap that is proven."""
    margin: Ratio = 0.05
    """Fitness by which every pose farther away than radius or angle is to be worse than the match."""
    radius: Positive = 0.3
    """Distance from the match within which another pose counts as the same place [m]."""
    angle: Angle = radians(3.0)
    """Rotation from the match within which another pose counts as the same place [rad]."""
    max_boxes: Count = 50_000
    """Maximum number of boxes of poses that each of the two proofs bounds; beyond that a gap stays open."""


def certify(
    match: Match, points: F64, field: LikelihoodField, window: Window, parameters: CertificateParameters
) -> Match:
    """The match with its certificate, or the fitter pose that the proof found, with the certificate of that.

    `points` (n, 2), `field` and `window` are those of the match. A match without points stays as it is.
    """
    if len(points) == 0:
        return match
    p = parameters
    n = len(points)
    scaled = field.scale(points[low_discrepancy_order(n)])
    pyramid = score_pyramid(field)
    centre = field.to_cells(window.centre)
    half = half_widths_in(field, window) * (1.0 / field.resolution, 1.0 / field.resolution, 1.0)
    half[2] = min(half[2], np.pi)
    window_box = np.concatenate((centre, half))[None, :]
    search = BoxSearch(
        epsilon=p.epsilon * n,
        radius=p.radius / field.resolution,
        angle=p.angle,
        lever=lever(scaled),
        smallest=_SMALLEST,
        max_boxes=p.max_boxes,
    )
    pose = field.to_cells(match.pose)
    nothing = np.empty((0, 3))
    best, bound, boxes, is_better = maximise(
        pyramid, field.packed, scaled, window_box, nothing, search, match.fitness * n, pose
    )
    floor = best - (p.margin + p.epsilon) * n
    rival = np.empty(3)
    _, rival_bound, more, is_found = maximise(
        pyramid, field.packed, scaled, window_box, pose[None, :], search, floor, rival
    )
    fitness = best / n
    certificate = Certificate(
        gap=max(min(bound / n, 1.0) - fitness, 0.0),
        # What bounds the whole window bounds the rest of it.
        rival_bound=min(rival_bound / n, bound / n, 1.0),
        rival=field.from_cells(rival) if is_found else None,
        boxes=boxes + more,
        # Sums of n terms are compared: a billionth more is not a gap.
        is_optimal=bound <= best + (p.epsilon + 1e-9) * n,
        is_distinct=rival_bound <= best - (p.margin - 1e-9) * n,
        gain=fitness - match.fitness if is_better else 0.0,
    )
    if not is_better:
        return replace(match, certificate=certificate)
    information = information_at(field, scaled, pose)
    return replace(
        match,
        pose=field.from_cells(pose),
        fitness=fitness,
        covariance=match_covariance(information, n, fitness, field, window),
        certificate=certificate,
    )


def lever(scaled: NDArray[np.float32]) -> float:
    """Radius in cells that stands for the points (n, 2) when a rotation is compared with a translation, at least 1."""
    return max(float(np.percentile(np.hypot(scaled[:, 0], scaled[:, 1]), 75.0)), 1.0)


@dataclass(frozen=True, slots=True)
class CertificateSummary:
    """The certificates of a run: how many, the shares proven, the median gap, the largest gain."""

    scans: int
    optimal: float
    distinct: float
    median_gap: float
    max_gain: float


def summarise(certificates: Iterable[Certificate]) -> CertificateSummary | None:
    """Of the scans that were certified; None without any."""
    given = list(certificates)
    if not given:
        return None
    return CertificateSummary(
        scans=len(given),
        optimal=float(np.mean([one.is_optimal for one in given])),
        distinct=float(np.mean([one.is_distinct for one in given])),
        median_gap=float(np.median([one.gap for one in given])),
        max_gain=max(one.gain for one in given),
    )

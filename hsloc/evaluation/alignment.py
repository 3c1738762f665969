"""Moving an estimate onto its reference before they are compared."""

from __future__ import annotations

from math import atan2
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from hsloc.errors import EvaluationError
from hsloc.model import IDENTITY, Pose2

if TYPE_CHECKING:
    from numpy.typing import NDArray

Alignment = Literal["none", "origin", "se2"]
ALIGNMENTS: tuple[Alignment, ...] = get_args(Alignment)


def parse_alignment(name: str) -> Alignment:
    """The alignment of that name; "se3", evo's word, means "se2" in the plane. Raises `EvaluationError`."""
    for alignment in ALIGNMENTS:
        if name == alignment or (name == "se3" and alignment == "se2"):
            return alignment
    raise EvaluationError(f"alignment {name!r} is unknown; choose one of {', '.join(ALIGNMENTS)}")


def align(reference: NDArray[np.float64], estimate: NDArray[np.float64], alignment: Alignment = "none") -> Pose2:
    """The pose T_reference_estimate that `alignment` moves the estimate by; poses (n, 3), row by row.

    "none": the identity. "origin": the first poses come to lie on each other. "se2": least squares over the
    positions. Raises `EvaluationError` where the positions do not fix a rotation.
    """
    if alignment == "origin":
        return Pose2.from_array(reference[0]) @ Pose2.from_array(estimate[0]).inverse()
    if alignment == "se2":
        return umeyama(reference[:, :2], estimate[:, :2])
    return IDENTITY


def umeyama(reference: NDArray[np.float64], estimate: NDArray[np.float64]) -> Pose2:
    """The rigid motion of the plane that brings points (n, 2) nearest to others in the sense of least squares.

    S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns", IEEE PAMI
    13(4), 1991, without scale. In the plane the rotation has a closed form, and unlike the form in space it
    cannot turn the path upside down.
    """
    mean_reference, mean_estimate = reference.mean(axis=0), estimate.mean(axis=0)
    a, b = estimate - mean_estimate, reference - mean_reference
    dot = float((a * b).sum())
    cross = float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())
    size = float(np.sqrt((a * a).sum() * (b * b).sum()))
    if not np.hypot(dot, cross) > 1e-9 * size or size <= 1e-12 * len(a):
        raise EvaluationError("se2 alignment needs a path that moves; choose alignment origin or none")
    rotation = Pose2(0.0, 0.0, atan2(cross, dot))
    shift = mean_reference - rotation @ mean_estimate
    return Pose2(float(shift[0]), float(shift[1]), rotation.theta)

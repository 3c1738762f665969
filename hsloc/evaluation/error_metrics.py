"""An evaluation in the form that metrics.json has, with RPE per frame, per metre and per second."""

from __future__ import annotations

from dataclasses import dataclass

from hsloc.evaluation.metrics import Evaluation, RelativeError
from hsloc.evaluation.statistics import PoseStatistics


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanarValues:
    """A value for each degree of freedom in the plane."""

    x: float
    """Along x [m]."""
    y: float
    """Along y [m]."""
    theta: float
    """Of the heading [rad]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PathLengths:
    """Lengths of the compared trajectories."""

    reference: float
    """Length of the reference [m]."""
    estimate: float
    """Length of the estimate [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorMetrics:
    """Errors of a trajectory against the reference, by the definitions of evo."""

    alignment: str
    """How the estimate was aligned with the reference: none, origin or se2."""
    alignment_transform: PlanarValues
    """The alignment, as the pose of the estimate's frame in the reference's frame."""
    association: str
    """How poses were paired: nearest in time, or by interpolation of the denser trajectory."""
    t_max_diff: float
    """Largest time difference of a pair [s]."""
    t_offset: float
    """Time added to the stamps of the estimate [s]."""
    matched: int
    """Number of pairs."""
    unmatched_reference: int
    """Number of reference poses without a partner."""
    unmatched_estimate: int
    """Number of estimated poses without a partner."""
    ape: PoseStatistics
    """Absolute pose error."""
    rpe: RelativeError
    """Relative pose error from pair to pair."""
    rpe_1m: RelativeError
    """Relative pose error over pieces of 1 m."""
    rpe_1s: RelativeError
    """Relative pose error over pieces of 1 s."""
    axis_rmse: PlanarValues
    """Root mean square error of each axis."""
    path_length: PathLengths
    """Lengths of both trajectories."""

    @staticmethod
    def of(found: Evaluation) -> ErrorMetrics:
        """Of an evaluation with RPE per frame, per metre and per second."""
        moved = found.T_reference_estimate
        per_frame, per_metre, per_second = found.rpe
        x, y, theta = found.axis_rmse
        return ErrorMetrics(
            alignment=found.alignment,
            alignment_transform=PlanarValues(x=moved.x, y=moved.y, theta=moved.theta),
            association=found.association,
            t_max_diff=found.max_difference_s,
            t_offset=found.offset_s,
            matched=found.matched,
            unmatched_reference=found.unmatched_reference,
            unmatched_estimate=found.unmatched_estimate,
            ape=found.ape,
            rpe=per_frame,
            rpe_1m=per_metre,
            rpe_1s=per_second,
            axis_rmse=PlanarValues(x=x, y=y, theta=theta),
            path_length=PathLengths(reference=found.length_reference, estimate=found.length_estimate),
        )

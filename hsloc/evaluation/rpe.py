"""RPE, the relative pose error: how well each piece of the path keeps its shape (evo's `evo_rpe`).

J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012. The pieces are chosen on the
estimate, as evo does by default.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from hsloc.errors import EvaluationError
from hsloc.evaluation.association import seconds
from hsloc.evaluation.statistics import PoseErrors
from hsloc.model.pose2 import relative_poses

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.evaluation.association import Pairs

    Indices = NDArray[np.intp]

DeltaUnit = Literal["frames", "m", "s"]
DELTA_UNITS: tuple[DeltaUnit, ...] = get_args(DeltaUnit)

RELATIVE_TOLERANCE = 0.1
"""With all pairs, how much longer or shorter than delta a piece may be, as a part of delta (evo's default)."""


@dataclass(frozen=True, slots=True)
class Delta:
    """Length of a piece: `value` frames, metres of path, or seconds.

    Pieces follow each other end to end; with `all_pairs` a piece starts at every pose.
    Raises `EvaluationError` for a length that is not positive, or a part of a frame.
    """

    value: float = field(default=1.0, metadata={"key": "delta"})
    """Length of a piece, in `delta_unit`."""
    unit: DeltaUnit = field(default="frames", metadata={"key": "delta_unit"})
    """Unit of the length: frames (pairs), m (path) or s."""
    all_pairs: bool = False
    """Whether a piece starts at every pose; else the pieces follow each other."""

    def __post_init__(self) -> None:
        if self.unit not in DELTA_UNITS:
            raise EvaluationError(f"delta unit {self.unit!r} is unknown; choose one of {', '.join(DELTA_UNITS)}")
        if not 0.0 < self.value < float("inf"):
            raise EvaluationError(f"delta is {self.value:g} {self.unit}; it must be positive")
        if self.unit == "frames" and self.value != int(self.value):
            raise EvaluationError(f"delta is {self.value:g} frames; it must be whole")

    def __str__(self) -> str:
        unit = "frame" if self.unit == "frames" and self.value == 1.0 else self.unit
        return f"{self.value:g} {unit}"


def rpe(pairs: Pairs, delta: Delta) -> PoseErrors:
    """Errors of the pieces of a path; none where the path is shorter than one piece."""
    starts, ends = pieces(pairs, delta)
    moved_reference = relative_poses(pairs.reference[starts], pairs.reference[ends])
    moved_estimate = relative_poses(pairs.estimate[starts], pairs.estimate[ends])
    return PoseErrors.of(relative_poses(moved_reference, moved_estimate))


def pieces(pairs: Pairs, delta: Delta) -> tuple[Indices, Indices]:
    """First and last row of each piece, in order."""
    if delta.unit == "frames":
        step = int(delta.value)
        starts = np.arange(0, len(pairs) - step, 1 if delta.all_pairs else step)
        return starts, starts + step
    if delta.unit == "m":
        steps = np.sqrt(np.square(np.diff(pairs.estimate[:, :2], axis=0)).sum(axis=1))
        return _all_pieces(steps, delta.value) if delta.all_pairs else _pieces_end_to_end(steps, delta.value)
    # Time, unlike the path, may run backwards in a log: its pieces are cut in the order of time.
    order = np.argsort(pairs.stamps_ns, kind="stable")
    steps = np.diff(seconds(pairs.stamps_ns[order] - pairs.stamps_ns[order[0]]))
    starts, ends = _all_pieces(steps, delta.value) if delta.all_pairs else _pieces_end_to_end(steps, delta.value)
    return order[starts], order[ends]


def _pieces_end_to_end(steps: NDArray[np.float64], length: float) -> tuple[Indices, Indices]:
    """Cut as soon as the steps since the last cut add up to `length`, and start again there."""
    cuts = [0]
    gone = 0.0
    for row, step in enumerate(steps.tolist(), start=1):
        gone += step
        if gone >= length:
            cuts.append(row)
            gone = 0.0
    bounds = np.array(cuts, dtype=np.intp)
    return bounds[:-1], bounds[1:]


def _all_pieces(steps: NDArray[np.float64], length: float) -> tuple[Indices, Indices]:
    """From every row to the later row (the first of several) whose path length from it is nearest to `length`."""
    path = np.concatenate(((0.0,), np.cumsum(steps)))
    starts = np.arange(len(path) - 1)
    after = np.clip(np.searchsorted(path, path[starts] + length, side="left"), starts + 1, len(path) - 1)
    # Where the robot stands still, many rows share one path length: the first row of the plateau, but after the start.
    before = np.maximum(np.searchsorted(path, path[after - 1], side="left"), starts + 1)
    after = np.maximum(np.searchsorted(path, path[after], side="left"), starts + 1)
    miss_before = np.abs(path[before] - path[starts] - length)
    miss_after = np.abs(path[after] - path[starts] - length)
    ends = np.where(miss_before <= miss_after, before, after)
    near = np.minimum(miss_before, miss_after) <= RELATIVE_TOLERANCE * length
    return starts[near], ends[near]

"""One call from two trajectories to the figures of metrics.json."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hsloc.atomic_write import write_text_atomically
from hsloc.dataclass_json import to_json
from hsloc.errors import EvaluationError
from hsloc.evaluation.alignment import Alignment, align, parse_alignment
from hsloc.evaluation.association import AssociationMethod, associate
from hsloc.evaluation.rpe import Delta, rpe
from hsloc.evaluation.statistics import PoseErrors, PoseStatistics
from hsloc.model.pose2 import compose_poses, pose_differences
from hsloc.trajectory_io.tum import NS_PER_S
from hsloc.warnings import RunWarning, WarningCode

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from hsloc.evaluation.association import Pairs
    from hsloc.model import Pose2, Trajectory

    Floats = NDArray[np.float64]

DELTAS = (Delta(1.0, "frames"), Delta(1.0, "m"), Delta(1.0, "s"))
_MIN_PAIRED = 0.5
"""Fraction of the sparser trajectory's poses that must have a partner within 10 ms."""
_DISPLACED = 0.25
"""RMSE of the positions (m) from which on poses count as wrong, as in the states of poses."""
_SAME_SHAPE = 0.1
"""Share of that error that may be left once the estimate is moved as a whole: the rest is one constant motion."""


@dataclass(frozen=True, slots=True)
class RelativeError:
    """RPE over pieces of one length; the statistics are NaN where the path is shorter than one piece."""

    delta: Delta = field(metadata={"inline": True})
    """Length of a piece."""
    statistics: PoseStatistics = field(metadata={"inline": True})
    """Statistics of the errors."""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """How well an estimate agrees with its reference. Metres and degrees, but `axis_rmse`: m, m, rad."""

    alignment: Alignment
    T_reference_estimate: Pose2
    association: AssociationMethod
    max_difference_s: float
    offset_s: float
    matched: int
    unmatched_reference: int
    unmatched_estimate: int
    ape: PoseStatistics
    rpe: tuple[RelativeError, ...]
    axis_rmse: tuple[float, float, float]
    length_reference: float
    length_estimate: float

    def to_dict(self) -> dict[str, object]:
        """For JSON: the first RPE is called "rpe", a further one by its length, as "rpe_1m"."""
        moved = self.T_reference_estimate
        further = {f"rpe_{error.delta.value:g}{error.delta.unit}": to_json(error) for error in self.rpe[1:]}
        return {
            "alignment": self.alignment,
            "alignment_transform": {"x": moved.x, "y": moved.y, "theta": moved.theta},
            "association": self.association,
            "t_max_diff": self.max_difference_s,
            "t_offset": self.offset_s,
            "matched": self.matched,
            "unmatched_reference": self.unmatched_reference,
            "unmatched_estimate": self.unmatched_estimate,
            "ape": to_json(self.ape),
            **({"rpe": to_json(self.rpe[0])} if self.rpe else {}),
            **further,
            "axis_rmse": dict(zip(("x", "y", "theta"), self.axis_rmse, strict=True)),
            "path_length": {"reference": self.length_reference, "estimate": self.length_estimate},
        }


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """An estimate paired with its reference and moved onto it, with the error of each pair.

    `pairs` holds the estimate as it came; `aligned` (n, 3) are its poses in the reference's frame. The other fields
    are how it was paired and aligned, and the lengths of both trajectories (m).
    """

    pairs: Pairs
    alignment: Alignment
    association: AssociationMethod
    max_difference_s: float
    offset_s: float
    length_reference: float
    length_estimate: float
    T_reference_estimate: Pose2
    aligned: Floats
    errors: PoseErrors

    def __repr__(self) -> str:
        return f"<Comparison: {len(self.aligned)} pairs, alignment {self.alignment}, APE rmse {self._rmse():.4f} m>"

    def _rmse(self) -> float:
        return float(np.sqrt(np.mean(np.square(self.errors.trans_part))))

    def displaced(self) -> RunWarning | None:
        """That nearly all of the error is one constant motion; None where it is small, or of another kind."""
        whole = self._rmse()
        if self.alignment != "none" or whole < _DISPLACED:
            return None
        try:
            moved = align(self.pairs.reference, self.pairs.estimate, "se2")
        except EvaluationError:
            return None
        left = ape(self.pairs.reference, compose_poses(moved.to_array(), self.pairs.estimate)).statistics()
        if left.trans_part.rmse > _SAME_SHAPE * whole:
            return None
        return RunWarning(
            WarningCode.REFERENCE_DISPLACED,
            f"{whole:.3g} m from the reference, but {left.trans_part.rmse:.2g} m once moved as a whole by "
            f"x {moved.x:z.2f} m, y {moved.y:z.2f} m, {math.degrees(moved.theta):z.1f} deg: their frames differ, "
            "or the robot was localised at another place",
            "if the frames differ, compare with --alignment se2",
        )

    def evaluation(self, deltas: tuple[Delta, ...] = DELTAS) -> Evaluation:
        """The statistics of the errors, with RPE over pieces of each of `deltas`."""
        pairs = self.pairs
        return Evaluation(
            alignment=self.alignment,
            T_reference_estimate=self.T_reference_estimate,
            association=self.association,
            max_difference_s=self.max_difference_s,
            offset_s=self.offset_s,
            matched=len(pairs),
            unmatched_reference=pairs.unmatched_reference,
            unmatched_estimate=pairs.unmatched_estimate,
            ape=self.errors.statistics(),
            rpe=tuple(RelativeError(delta, rpe(pairs, delta).statistics()) for delta in deltas),
            axis_rmse=axis_rmse(pairs.reference, self.aligned),
            length_reference=self.length_reference,
            length_estimate=self.length_estimate,
        )


def ape(reference: Floats, estimate: Floats) -> PoseErrors:
    """Absolute pose errors (evo's `evo_ape`) of poses (n, 3) against reference poses (n, 3), row by row."""
    return PoseErrors.of(pose_differences(estimate, reference))


def axis_rmse(reference: Floats, estimate: Floats) -> tuple[float, float, float]:
    """RMSE of x (m), y (m) and theta (rad, wrapped): the figures of [P]'s experiments, which did not wrap."""
    x, y, theta = np.sqrt(np.square(pose_differences(estimate, reference)).mean(axis=0))
    return float(x), float(y), float(theta)


def compare(
    estimate: Trajectory,
    reference: Trajectory,
    *,
    alignment: str = "none",
    max_difference_s: float = 0.01,
    association: AssociationMethod = "nearest",
    offset_s: float = 0.0,
) -> Comparison:
    """Associate, align, and take the error of each pair; arguments and errors as in `evaluate`."""
    chosen = parse_alignment(alignment)
    pairs = associate(reference, estimate, max_difference_s=max_difference_s, method=association, offset_s=offset_s)
    moved = align(pairs.reference, pairs.estimate, chosen)
    aligned = pairs.estimate if chosen == "none" else compose_poses(moved.to_array(), pairs.estimate)
    return Comparison(
        pairs=pairs,
        alignment=chosen,
        association=association,
        max_difference_s=max_difference_s,
        offset_s=offset_s,
        length_reference=reference.length(),
        length_estimate=estimate.length(),
        T_reference_estimate=moved,
        aligned=aligned,
        errors=ape(pairs.reference, aligned),
    )


def compare_run(estimate: Trajectory, reference: Trajectory, *, alignment: str = "none") -> Comparison:
    """`compare` with the pairing that suits the two rates; raises `EvaluationError` as it does.

    The nearest pose within 10 ms, as evo does, if at least half of the sparser trajectory's poses have one. Else the
    denser one is interpolated, across gaps of up to a second: a reference at 1 Hz has no pose within 10 ms of one of a
    robot's that was seen at 7 Hz.
    """
    try:
        found = compare(estimate, reference, alignment=alignment)
        if len(found.pairs) >= _MIN_PAIRED * min(len(reference), len(estimate)):
            return found
    except EvaluationError:
        pass
    denser = max(estimate, reference, key=len)
    usual = float(np.median(np.diff(np.sort(denser.stamps_ns)))) / NS_PER_S if len(denser) > 1 else 0.0
    gap = min(max(0.75 * usual, 0.01), 1.0)
    return compare(estimate, reference, alignment=alignment, association="interpolation", max_difference_s=gap)


def evaluate(
    estimate: Trajectory,
    reference: Trajectory,
    *,
    alignment: str = "none",
    max_difference_s: float = 0.01,
    association: AssociationMethod = "nearest",
    offset_s: float = 0.0,
    deltas: tuple[Delta, ...] = DELTAS,
) -> Evaluation:
    """Compare an estimate with a reference: APE, RPE over pieces of each of `deltas`, RMSE of each axis.

    `alignment` is "none", "origin" or "se2" ("se3" means the same here); poses are paired within
    `max_difference_s` seconds after `offset_s` has been added to the estimate's stamps. The figures equal
    those of `evo_ape` and `evo_rpe`. Raises `EvaluationError` where nothing matches or an argument is unknown.
    """
    return compare(
        estimate,
        reference,
        alignment=alignment,
        max_difference_s=max_difference_s,
        association=association,
        offset_s=offset_s,
    ).evaluation(deltas)


def format_json(values: Mapping[str, object]) -> str:
    """JSON that is the same for the same values: order as given, floats in their shortest form, NaN as null.

    Numpy's numbers and arrays become plain ones. Raises `EvaluationError` for a value that JSON has no form for.
    """
    return json.dumps(_plain(values), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def write_json(path: str | Path, values: Mapping[str, object]) -> None:
    """Write `format_json(values)`, whole or not at all; raises `OutputError`."""
    write_text_atomically(Path(path), format_json(values))


def _plain(value: object) -> object:
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, np.bool_ | np.integer):
        return value.item()
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, Path):
        return str(value)
    raise EvaluationError(f"{value!r} of type {type(value).__name__} has no form in JSON; give numbers, text or lists")

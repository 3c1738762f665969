"""One call from two trajectories to the figures of metrics.json."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hsloc.atomic_write import write_text_atomically
from hsloc.errors import EvaluationError
from hsloc.evaluation.alignment import Alignment, align, parse_alignment
from hsloc.evaluation.ape import ape, axis_rmse
from hsloc.evaluation.association import AssociationMethod, associate
from hsloc.evaluation.rpe import Delta, rpe
from hsloc.model.pose2 import compose_poses

if TYPE_CHECKING:
    from collections.abc import Mapping

    from hsloc.evaluation.association import Pairs
    from hsloc.evaluation.statistics import PoseErrors, PoseStatistics
    from hsloc.model import Pose2, Trajectory

PER_FRAME, PER_METRE, PER_SECOND = Delta(1.0, "frames"), Delta(1.0, "m"), Delta(1.0, "s")


@dataclass(frozen=True, slots=True)
class RelativeError:
    """RPE over pieces of one length; the statistics are NaN where the path is shorter than one piece."""

    delta: Delta
    statistics: PoseStatistics

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return {
            "delta": self.delta.value,
            "delta_unit": self.delta.unit,
            "all_pairs": self.delta.all_pairs,
            **self.statistics.to_dict(),
        }


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
        further = {f"rpe_{error.delta.value:g}{error.delta.unit}": error.to_dict() for error in self.rpe[1:]}
        return {
            "alignment": self.alignment,
            "alignment_transform": {"x": moved.x, "y": moved.y, "theta": moved.theta},
            "association": self.association,
            "t_max_diff": self.max_difference_s,
            "t_offset": self.offset_s,
            "matched": self.matched,
            "unmatched_reference": self.unmatched_reference,
            "unmatched_estimate": self.unmatched_estimate,
            "ape": self.ape.to_dict(),
            **({"rpe": self.rpe[0].to_dict()} if self.rpe else {}),
            **further,
            "axis_rmse": dict(zip(("x", "y", "theta"), self.axis_rmse, strict=True)),
            "path_length": {"reference": self.length_reference, "estimate": self.length_estimate},
        }


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """An estimate paired with its reference and moved onto it, with the error of each pair.

    `pairs` holds the estimate as it came; `aligned` (n, 3) are its poses in the reference's frame.
    """

    pairs: Pairs
    T_reference_estimate: Pose2
    aligned: np.ndarray[tuple[int, int], np.dtype[np.float64]]
    errors: PoseErrors


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
    return Comparison(pairs, moved, aligned, ape(pairs.reference, aligned))


def evaluate(
    estimate: Trajectory,
    reference: Trajectory,
    *,
    alignment: str = "none",
    max_difference_s: float = 0.01,
    association: AssociationMethod = "nearest",
    offset_s: float = 0.0,
    deltas: tuple[Delta, ...] = (PER_FRAME, PER_METRE, PER_SECOND),
) -> Evaluation:
    """Compare an estimate with a reference: APE, RPE over pieces of each of `deltas`, RMSE of each axis.

    `alignment` is "none", "origin" or "se2" ("se3" means the same here); poses are paired within
    `max_difference_s` seconds after `offset_s` has been added to the estimate's stamps. The figures equal
    those of `evo_ape` and `evo_rpe`. Raises `EvaluationError` where nothing matches or an argument is unknown.
    """
    result = compare(
        estimate,
        reference,
        alignment=alignment,
        max_difference_s=max_difference_s,
        association=association,
        offset_s=offset_s,
    )
    pairs = result.pairs
    return Evaluation(
        alignment=parse_alignment(alignment),
        T_reference_estimate=result.T_reference_estimate,
        association=association,
        max_difference_s=max_difference_s,
        offset_s=offset_s,
        matched=len(pairs),
        unmatched_reference=pairs.unmatched_reference,
        unmatched_estimate=pairs.unmatched_estimate,
        ape=result.errors.statistics(),
        rpe=tuple(RelativeError(delta, rpe(pairs, delta).statistics()) for delta in deltas),
        axis_rmse=axis_rmse(pairs.reference, result.aligned),
        length_reference=reference.length(),
        length_estimate=estimate.length(),
    )


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

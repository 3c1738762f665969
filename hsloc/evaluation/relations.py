"""The relations metric [K]: errors of relative poses that were verified by hand

R. Kümmerle et al., "On measuring the accuracy of SLAM algorithms", Autonomous Robots 27, 2009. It needs no
alignment, and one early error does not count in all later poses.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hsloc.dataclass_json import to_json
from hsloc.errors import EvaluationError
from hsloc.evaluation.association import interpolate_poses
from hsloc.evaluation.statistics import PoseErrors, PoseStatistics
from hsloc.model import wrap_angles
from hsloc.model.pose2 import relative_poses
from hsloc.trajectory_io.tum import NS_PER_S, parse_numbers, parse_stamp_field, read_lines

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.model import Trajectory


@dataclass(frozen=True, slots=True, eq=False)
class Relations:
    """n relations: the pose at `second_ns` seen from the pose at `first_ns` is `poses` (n, 3), in the plane."""

    first_ns: NDArray[np.int64]
    second_ns: NDArray[np.int64]
    poses: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.first_ns)


@dataclass(frozen=True, slots=True)
class RelationsResult:
    """Errors of the relations whose two poses the trajectory has; [K] states mean and std."""

    matched: int
    """Number of relations whose two poses the trajectory has."""
    unmatched: int
    """Number of the other relations."""
    statistics: PoseStatistics = field(metadata={"inline": True})
    """Statistics of the errors."""

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        result: dict[str, object] = to_json(self)
        return result


def read_relations(path: str | Path) -> Relations:
    """Read lines `t1 t2 x y z roll pitch yaw` (s, m, rad); z, roll and pitch are left out: the robot is planar.

    Raises `EvaluationError` that names the file and the line.
    """
    path = Path(path)
    stamps: list[tuple[int, int]] = []
    poses: list[tuple[float, float, float]] = []
    for number, line in read_lines(path):
        fields = line.split()
        try:
            if len(fields) != 8:
                raise ValueError(f"{len(fields)} columns; a relation has 8: t1 t2 x y z roll pitch yaw")
            stamps.append((parse_stamp_field(fields[0]), parse_stamp_field(fields[1])))
            x, y, _, _, _, yaw = parse_numbers(fields[2:])
        except ValueError as error:
            raise EvaluationError(f"{path}, line {number}: {error}") from None
        poses.append((x, y, yaw))
    if not stamps:
        raise EvaluationError(f"{path}: holds no relation; its lines are t1 t2 x y z roll pitch yaw")
    columns, relative = np.array(stamps, dtype=np.int64), np.array(poses, dtype=np.float64)
    relative[:, 2] = wrap_angles(relative[:, 2])
    return Relations(columns[:, 0].copy(), columns[:, 1].copy(), relative)


def evaluate_relations(trajectory: Trajectory, relations: Relations, *, max_gap_s: float = 1.0) -> RelationsResult:
    """Score a trajectory by relations: e = relation^-1 * (pose(t1)^-1 * pose(t2)).

    The pose at a stamp is the one with that very stamp (the last of several, which an estimator has corrected most);
    else it is interpolated between neighbours at most `max_gap_s` apart; else the relation is unmatched.
    Raises `EvaluationError` where no relation matches.
    """
    errors = relation_errors(trajectory, relations, max_gap_s=max_gap_s)
    return RelationsResult(len(errors), len(relations) - len(errors), errors.statistics())


def relation_errors(trajectory: Trajectory, relations: Relations, *, max_gap_s: float = 1.0) -> PoseErrors:
    """The errors of the relations that match, in the order of the file."""
    if len(trajectory) == 0:
        raise EvaluationError("the trajectory holds no pose: no relation can be checked")
    first, has_first = _poses_at(trajectory, relations.first_ns, max_gap_s)
    second, has_second = _poses_at(trajectory, relations.second_ns, max_gap_s)
    known = has_first & has_second
    if not known.any():
        start, end = trajectory.stamps_ns.min() / NS_PER_S, trajectory.stamps_ns.max() / NS_PER_S
        asked = np.concatenate((relations.first_ns, relations.second_ns)) / NS_PER_S
        raise EvaluationError(
            f"none of {len(relations)} relations ({asked.min():.3f} .. {asked.max():.3f} s) has both its poses in "
            f"the trajectory ({start:.3f} .. {end:.3f} s); check that both belong to the same log"
        )
    moved = relative_poses(first[known], second[known])
    return PoseErrors.of(relative_poses(relations.poses[known], moved))


def _poses_at(
    trajectory: Trajectory, stamps_ns: NDArray[np.int64], max_gap_s: float
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Poses (n, 3) at stamps, and which of them are known."""
    ordered = trajectory.sorted()
    times = ordered.stamps_ns
    # The last pose at or before each stamp, and the first after it.
    before = np.searchsorted(times, stamps_ns, side="right") - 1
    exact = (before >= 0) & (times[np.maximum(before, 0)] == stamps_ns)
    inside = (before >= 0) & (before < len(times) - 1)
    gap_ns = np.where(inside, times[np.minimum(before + 1, len(times) - 1)] - times[np.maximum(before, 0)], 0)
    poses = interpolate_poses(trajectory, stamps_ns)
    poses[exact] = ordered.poses[before[exact]]
    return poses, exact | (inside & (gap_ns <= max_gap_s * NS_PER_S))

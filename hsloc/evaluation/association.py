"""Which pose of the estimate belongs to which pose of the reference: by time, as evo pairs them.

The sparser trajectory leads (of equally long ones the estimate): each of its poses takes the nearest in time of
the other, if it is near enough. One pose may so be taken twice, or never.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from hsloc.errors import EvaluationError
from hsloc.model import wrap_angles
from hsloc.trajectory_io.tum import NS_PER_S

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.model import Trajectory

    Floats = NDArray[np.float64]
    Stamps = NDArray[np.int64]
    Indices = NDArray[np.intp]

AssociationMethod = Literal["nearest", "interpolation"]
ASSOCIATION_METHODS: tuple[AssociationMethod, ...] = get_args(AssociationMethod)


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Poses that belong together, row by row: n pairs in the order of the sparser trajectory.

    `reference` and `estimate` are poses (n, 3); `stamps_ns` (n,) are the stamps of the estimate's poses (by
    interpolation: the stamps it was interpolated at). `unmatched_*` count the poses that found no partner.
    """

    stamps_ns: Stamps
    reference: Floats
    estimate: Floats
    unmatched_reference: int
    unmatched_estimate: int

    def __len__(self) -> int:
        return len(self.stamps_ns)


def associate(
    reference: Trajectory,
    estimate: Trajectory,
    *,
    max_difference_s: float = 0.01,
    method: AssociationMethod = "nearest",
    offset_s: float = 0.0,
) -> Pairs:
    """Pair the poses of two trajectories by time; `offset_s` is added to the stamps of the estimate.

    "interpolation" chooses the same pairs as "nearest", but moves the pose of the denser trajectory to the exact
    stamp. Stamps may repeat and run backwards. Costs O((n + m) log(n + m)).
    Raises `EvaluationError` where nothing matches, with the overlap and the nearest gap.
    """
    if method not in ASSOCIATION_METHODS:
        raise EvaluationError(f"association {method!r} is unknown; choose one of {', '.join(ASSOCIATION_METHODS)}")
    if not max_difference_s >= 0.0:
        raise EvaluationError(f"the largest time difference is {max_difference_s} s; it must not be negative")
    for name, trajectory in (("reference", reference), ("estimate", estimate)):
        if len(trajectory) == 0:
            raise EvaluationError(f"the {name} holds no pose: nothing to compare")
    reference_leads = len(estimate) > len(reference)
    leading, other = (reference, estimate) if reference_leads else (estimate, reference)
    other_offset_s = offset_s if reference_leads else -offset_s
    rows, partners = _nearest(seconds(leading.stamps_ns), seconds(other.stamps_ns) + other_offset_s, max_difference_s)
    if len(rows) == 0:
        raise EvaluationError(_why_nothing_matches(reference, estimate, max_difference_s, offset_s))
    leading_stamps = leading.stamps_ns[rows]
    if method == "interpolation":
        other_stamps = leading_stamps - round(other_offset_s * NS_PER_S)
        other_poses = interpolate_poses(other, other_stamps)
    else:
        other_stamps, other_poses = other.stamps_ns[partners], other.poses[partners]
    alone_leading = len(leading) - len(rows)
    alone_other = len(other) - len(np.unique(partners))
    if reference_leads:
        return Pairs(other_stamps, leading.poses[rows], other_poses, alone_leading, alone_other)
    return Pairs(leading_stamps, other_poses, leading.poses[rows], alone_other, alone_leading)


def seconds(stamps_ns: Stamps) -> Floats:
    """Stamps as float64 seconds, each the float nearest to its decimal text in a TUM file.

    Only for deciding which pose is nearest: so evo sees the stamps, and where two poses are equally near (a
    reference at 50 Hz, an estimate between its beats) its rounding decides, which our figures must share.
    """
    whole, rest = np.divmod(stamps_ns, NS_PER_S)
    result: Floats = whole + rest / NS_PER_S
    return result


def interpolate_poses(trajectory: Trajectory, stamps_ns: Stamps) -> Floats:
    """Poses at any stamps, shape (n, 3): linear in x and y, by the smaller angle in theta, held at the ends.

    At the very stamp of several poses the first of them counts.
    """
    ordered = trajectory.sorted()
    times, poses = ordered.stamps_ns, ordered.poses
    if len(times) == 1:
        return np.repeat(poses, len(stamps_ns), axis=0)
    after = np.clip(np.searchsorted(times, stamps_ns, side="left"), 1, len(times) - 1)
    span = times[after] - times[after - 1]
    fraction = np.where(span > 0, (stamps_ns - times[after - 1]) / np.maximum(span, 1), 0.0)
    fraction = np.clip(fraction, 0.0, 1.0)[:, None]
    delta = poses[after] - poses[after - 1]
    delta[:, 2] = wrap_angles(delta[:, 2])
    result: Floats = poses[after - 1] + fraction * delta
    result[:, 2] = wrap_angles(result[:, 2])
    return result


def _nearest(leading: Floats, other: Floats, limit: float) -> tuple[Indices, Indices]:
    """Rows of `leading` that have a partner within `limit` seconds, and their partners in `other`.

    Where `other` is sorted, the earlier of two equally near partners wins (and the last of equal stamps); where
    it is not, the one that is first in the file. Both are what evo does.
    """
    if np.all(np.diff(other) >= 0.0):
        partners, near = _nearest_sorted(leading, other, limit)
    else:
        partners, near = _nearest_unsorted(leading, other, limit)
    rows = np.flatnonzero(near)
    return rows, partners[rows]


def _nearest_sorted(leading: Floats, other: Floats, limit: float) -> tuple[Indices, NDArray[np.bool_]]:
    after = np.minimum(np.searchsorted(other, leading, side="right"), len(other) - 1)
    ahead = other[after] - leading
    behind = np.where(after > 0, leading - other[after - 1], np.inf)
    take_after = ahead < behind
    inside = (leading >= other[0] - limit) & (leading <= other[-1] + limit)
    return np.where(take_after, after, after - 1), inside & (np.where(take_after, ahead, behind) <= limit)


def _nearest_unsorted(leading: Floats, other: Floats, limit: float) -> tuple[Indices, NDArray[np.bool_]]:
    order = np.argsort(other, kind="stable")
    times = other[order]
    position = np.searchsorted(times, leading, side="left")
    after = np.minimum(position, len(times) - 1)
    # The first of equal stamps before: the stable order has put it where the file has it.
    before = np.searchsorted(times, times[np.maximum(position - 1, 0)], side="left")
    ahead, behind = np.abs(times[after] - leading), np.abs(times[before] - leading)
    take_after = (ahead < behind) | ((ahead == behind) & (order[after] < order[before]))
    return np.where(take_after, order[after], order[before]), np.minimum(ahead, behind) <= limit


def _why_nothing_matches(reference: Trajectory, estimate: Trajectory, limit: float, offset_s: float) -> str:
    ours = np.sort(seconds(estimate.stamps_ns)) + offset_s
    theirs = np.sort(seconds(reference.stamps_ns))
    after = np.clip(np.searchsorted(theirs, ours), 1, max(len(theirs) - 1, 1))
    gap = float(np.minimum(abs(ours - theirs[after - 1]), abs(ours - theirs[np.minimum(after, len(theirs) - 1)])).min())
    overlap = float(min(ours[-1], theirs[-1]) - max(ours[0], theirs[0]))
    remedy = (
        f"allow a time difference of {gap * 1.01:.3g} s"
        if overlap >= 0.0
        else "check that both come from the same log, or give the offset between their clocks"
    )
    return (
        f"no pose of the estimate ({ours[0]:.3f} .. {ours[-1]:.3f} s) lies within {limit:g} s of a pose of the "
        f"reference ({theirs[0]:.3f} .. {theirs[-1]:.3f} s): they overlap by {max(overlap, 0.0):.3f} s and the "
        f"nearest gap is {gap:.6g} s; {remedy}"
    )

"""What is not known of a motion because the odometry is interpolated: at its ends, and of poses between two matches."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from hsloc.model.events import Interpolation

    F64 = NDArray[np.float64]


class AtStamp(NamedTuple):
    """When odometry was taken (ns), and its interpolation, if it is between messages that are far apart."""

    stamp_ns: int = 0
    interpolation: Interpolation | None = None

    def variances(self) -> F64:
        """Variances (3,) of its x, y and theta (m^2, m^2, rad^2)."""
        return np.zeros(3) if self.interpolation is None else self.interpolation.variances(self.stamp_ns)

    def is_between_those_of(self, other: AtStamp) -> bool:
        """Whether both are interpolated between the same two messages."""
        mine, theirs = self.interpolation, other.interpolation
        return mine is not None and theirs is not None and mine.before_ns == theirs.before_ns


def motion_variances(first: AtStamp, second: AtStamp) -> F64:
    """Variances (3,) of a motion by odometry from a stamp to another, as far as its ends are interpolated.

    Between the same two messages it is the speed that is wrong, and the motion by the time for which it is.
    """
    of = second.interpolation
    if of is None or not first.is_between_those_of(second):
        return np.asarray(first.variances() + second.variances())
    part = min(2.0 * abs(second.stamp_ns - first.stamp_ns) / (of.after_ns - of.before_ns), 1.0)
    return part**2 * _halfway(of)


class Sides(NamedTuple):
    """Of poses between two matches: what interpolation adds to the variances (n, 3) of the prediction from the match
    before, from that after, and to those of their mean."""

    before: F64
    after: F64
    mean: F64


def sides(
    rows: NDArray[np.int64],
    matches: tuple[NDArray[np.int64], NDArray[np.int64]],
    at: list[AtStamp],
    interpolated: Mapping[int, AtStamp],
) -> Sides:
    """For the poses `rows` (n,) of a run, each between two `matches` (n,), which were taken `at`.

    The prediction of a pose that was measured is wrong where the match is between messages. One that is `interpolated`
    itself lies between messages and matches around it, whichever is nearer: from one to the other the mean goes evenly,
    and is wrong as an interpolation over that time.
    """
    variances = np.array([each.variances() for each in at])
    found = Sides(variances[matches[0]], variances[matches[1]], np.zeros((len(rows), 3)))
    for k in np.flatnonzero(np.isin(rows, list(interpolated))).tolist():
        here, first, second = interpolated[int(rows[k])], at[matches[0][k]], at[matches[1][k]]
        of = here.interpolation
        assert of is not None
        begin_ns, end_ns = max(first.stamp_ns, of.before_ns), min(second.stamp_ns, of.after_ns)
        whole_ns = of.after_ns - of.before_ns
        before_ns, after_ns = max(here.stamp_ns - begin_ns, 0), max(end_ns - here.stamp_ns, 0)
        piece_ns = max(before_ns + after_ns, 1)
        far = [np.zeros(3) if here.is_between_those_of(each) else each.variances() for each in (first, second)]
        found.before[k] = before_ns / whole_ns * _halfway(of) + far[0]
        found.after[k] = after_ns / whole_ns * _halfway(of) + far[1]
        part = before_ns / piece_ns
        over_piece = min(piece_ns / whole_ns, 1.0) ** 3 * (4.0 * part * (1.0 - part)) ** 2
        found.mean[k] = over_piece * _halfway(of) + (1.0 - part) ** 2 * far[0] + part**2 * far[1]
    return found


def _halfway(of: Interpolation) -> F64:
    return np.array((of.way, of.way, of.turn))

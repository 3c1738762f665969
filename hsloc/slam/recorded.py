"""What is recorded of a map while it is built, from which its verdict is found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hsloc.slam.pair_sums import summed_across, summed_at
from hsloc.slam.verdict import Reason

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.slam.slips import Held, Stretches

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]
    Bools = NDArray[np.bool_]

HARM_M = 0.25
"""Displacement [m] of a part of the map from which on it is wrong: a doorway is missed by a quarter of its width."""
_MOST_NAMED = 20
"""Places named in a reason, at most."""


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """What the verdict is found from; n keyscans.

    `poses` (n, 3) are final. `motions` and `covariances` lead to each keyscan from the one before, as the front end
    had them; `refused` (n,) where it had not the scans' word. `odometry` (n, 3) is as recorded, None without any.
    `pairs` (m, 2) of keyscans that see the same walls, with `counts` (m, 5) as in
    `kernels.point_to_line.pair_terms`. `loops` (k, 2) are pairs of keyscans that accepted loops join, `torn` (j, 2)
    those of loops that were contradicted by the others, and are by the finished map. `joints` are keyscans at which
    pieces begin that were found on the map of the others, `after_gaps` those before which nothing was recorded, and
    for how many seconds. `no_return_share` is the part of the beams that met nothing. `stretches` are what the
    scans alone say of the motion along short parts of the path, `held` what the rest of the map does.
    `pose_covariances` (n, 3, 3) are those of the final poses.
    """

    stamps_ns: I64
    poses: F64
    motions: F64
    covariances: F64
    refused: Bools
    odometry: F64 | None
    pairs: I64
    counts: F64
    loops: I64
    torn: I64
    joints: I64
    after_gaps: tuple[tuple[int, float], ...]
    no_return_share: float
    stretches: Stretches
    held: Held
    pose_covariances: F64

    def lengths(self) -> F64:
        """Metres to each keyscan from the one before."""
        return np.asarray(np.hypot(self.motions[:, 0], self.motions[:, 1]), dtype=np.float64)

    def spanned(self) -> Bools:
        """Steps (n,) between the two ends of an accepted loop: a wrong step would have kept it open."""
        return np.asarray(self.summed_across(self.loops, np.ones(len(self.loops))) >= 1)

    def summed_across(self, pairs: I64, weights: F64) -> F64:
        """For each step (n, ...) the sum of the `weights` (m, ...) of the pairs (m, 2) of keyscans around it."""
        return summed_across(len(self.poses), pairs, weights)

    def summed_at(self, pairs: I64, weights: F64) -> F64:
        """For each keyscan (n,) the sum of the `weights` (m,) of the pairs (m, 2) that it is in."""
        return summed_at(len(self.poses), pairs, weights)


def reason_at(r: Recorded, code: str, text: str, runs: list[tuple[int, int]], *, failed: bool) -> Reason:
    """A reason with the places and times of runs of keyscans."""
    named = runs[:_MOST_NAMED]
    return Reason(
        code,
        text,
        "failed" if failed else "check",
        tuple((float(r.poses[last, 0]), float(r.poses[last, 1])) for _, last in named),
        seconds_of(r, named),
    )


def seconds_of(r: Recorded, runs: list[tuple[int, int]]) -> tuple[tuple[float, float], ...]:
    """From the keyscan before each run to its last."""
    seconds = (r.stamps_ns - r.stamps_ns[0]) * 1e-9
    return tuple((float(seconds[max(first - 1, 0)]), float(seconds[last])) for first, last in runs)

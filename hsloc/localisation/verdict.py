"""What the states of its poses say against the result of a localisation run."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from hsloc.model.estimate import State
from hsloc.model.verdict import Verdict, VerdictReason

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.localisation.states import StateRows
    from hsloc.model.trajectory import Trajectory

USABLE_SHARE = 0.5
"""Least share of localised poses of a result that is usable as a whole."""
TOLERATED_SHARE = 0.01
"""Share of poses in another state than localised and predicted that is no reason against a result."""
TOLERATED_PREDICTED = 0.05
"""Share of predicted poses that is no reason against a result."""
_REMEDIES = {
    State.PREDICTED: "use the standard deviations in states.csv; a lidar with more range or field of view sees more",
    State.AMBIGUOUS: "give the start (--initial-pose), or a longer log",
    State.OFF_MAP: "give a map that covers the way, or extend this one (--resume)",
    State.LOST: "give the start (--initial-pose); check map, mounting (--laser-pose) and odometry (hsloc check)",
}
_WORDS = {
    State.PREDICTED: "predicted: no scan holds them well enough",
    State.AMBIGUOUS: "ambiguous: several places of the map fit",
    State.OFF_MAP: "off the map, or the map has changed there",
    State.LOST: "lost",
}


def localisation_reasons(rows: StateRows, trajectory: Trajectory) -> tuple[VerdictReason, ...]:
    """A reason for each state that more poses are in than is tolerated, with where and when; none for a good result.

    The result is to be checked, or has failed where less than half of the poses are localised.
    """
    n = len(rows)
    if n == 0:
        return ()
    share = {state: count / n for state, count in Counter(rows.state).items()}
    verdict = Verdict.CHECK if share.get(State.LOCALISED, 0.0) >= USABLE_SHARE else Verdict.FAILED
    reasons = []
    for state in (State.OFF_MAP, State.LOST, State.AMBIGUOUS, State.PREDICTED):
        part = share.get(state, 0.0)
        if part <= (TOLERATED_PREDICTED if state is State.PREDICTED else TOLERATED_SHARE):
            continue
        spans = _spans(np.array([each is state for each in rows.state]))
        firsts = [first for first, _ in spans]
        start = int(trajectory.stamps_ns.min())
        seconds = ((trajectory.stamps_ns - start) / 1e9).tolist()
        reasons.append(
            VerdictReason(
                verdict,
                f"poses_{state.value}",
                f"{100.0 * part:.1f} % of the poses are {_WORDS[state]}",
                _REMEDIES[state],
                places=tuple((float(x), float(y)) for x, y in trajectory.poses[firsts, :2]),
                times=tuple((seconds[first], seconds[last]) for first, last in spans),
            )
        )
    return tuple(reasons)


def _spans(rows: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last row of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], rows, [False]))))
    return [(int(first), int(end) - 1) for first, end in edges.reshape(-1, 2)]

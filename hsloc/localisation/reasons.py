"""Why a localised run is to be checked, or has failed: the shares of its poses that are in other states."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from hsloc.model.estimate import State
from hsloc.model.verdict import Verdict, VerdictReason, spans_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from hsloc.localisation.states import StateRows
    from hsloc.model.estimate import Ambiguity
    from hsloc.model.trajectory import Trajectory

_NAMED = 3
"""Places that are named where several fit."""
USABLE_SHARE = 0.5
"""Least share of localised poses of a result that is usable as a whole."""
TOLERATED_SHARE = 0.01
"""Share of poses in another state than localised and predicted that is no reason against a result."""
TOLERATED_PREDICTED = 0.05
"""Share of predicted poses that is no reason against a result."""
_REMEDIES = {
    State.PREDICTED: "use the standard deviations in states.csv; a lidar with more range or field of view sees more",
    State.AMBIGUOUS: "give the start (--initial-pose), or a longer log",
    State.OFF_MAP: "give a map that covers the path, or extend this one (--resume)",
    State.LOST: "give the start (--initial-pose); check map, mounting (--laser-pose) and odometry (hsloc check)",
}
_WORDS = {
    State.PREDICTED: "predicted: no scan holds them well enough",
    State.AMBIGUOUS: "ambiguous: several places of the map fit",
    State.OFF_MAP: "off the map, or the map has changed there",
    State.LOST: "lost",
}


def _named_places(ambiguities: Sequence[Ambiguity]) -> str:
    """The most probable places of the longest stretch."""
    if not ambiguities:
        return ""
    longest = max(ambiguities, key=lambda each: each.end_ns - each.begin_ns)
    places = [f"x {pose.x:.1f} m, y {pose.y:.1f} m ({100.0 * p:.0f} %)" for pose, p in longest.places[:_NAMED]]
    return f", at {' or '.join(places)} {'' if len(longest.places) <= _NAMED else 'or others '}(hypotheses.csv)"


def localisation_reasons(
    rows: StateRows, trajectory: Trajectory, ambiguities: Sequence[Ambiguity] = ()
) -> tuple[VerdictReason, ...]:
    """A reason for each state that more poses are in than is tolerated, with where and when; none for a good result.

    Of the longest of `ambiguities` it names the most probable places.
    The result is to be checked, or has failed where less than half of the poses are localised.
    """
    n = len(rows)
    if n == 0:
        return ()
    share = {state: count / n for state, count in Counter(rows.state).items()}
    verdict = Verdict.CHECK if share.get(State.LOCALISED, 0.0) >= USABLE_SHARE else Verdict.FAILED
    reasons = []
    kinds = (State.OFF_MAP, State.LOST, State.AMBIGUOUS, State.PREDICTED)
    for state in sorted(kinds, key=lambda each: -share.get(each, 0.0)):
        part = share.get(state, 0.0)
        if part <= (TOLERATED_PREDICTED if state is State.PREDICTED else TOLERATED_SHARE):
            continue
        spans = spans_of(np.array([each is state for each in rows.state]))
        firsts = [first for first, _ in spans]
        names = _named_places(ambiguities) if state is State.AMBIGUOUS else ""
        start = int(trajectory.stamps_ns.min())
        seconds = ((trajectory.stamps_ns - start) / 1e9).tolist()
        reasons.append(
            VerdictReason(
                verdict,
                f"poses_{state.value}",
                f"{100.0 * part:.1f} % of the poses are {_WORDS[state]}{names}",
                _REMEDIES[state],
                places=() if names else tuple((float(x), float(y)) for x, y in trajectory.poses[firsts, :2]),
                times=tuple((seconds[first], seconds[last]) for first, last in spans),
            )
        )
    return tuple(reasons)

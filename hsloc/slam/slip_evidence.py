"""Which stretches of a map may hold a slip of the wheels that neither its scans nor the rest of the map show."""

from __future__ import annotations

from math import erfc
from typing import TYPE_CHECKING

import numpy as np

from hsloc.model.verdict import counted
from hsloc.slam.recorded import HARM_M, Recorded, reason_at
from hsloc.slam.slips import STRETCHES_DEEP, joined

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.slam.verdict import Reason

    F64 = NDArray[np.float64]
    Bools = NDArray[np.bool_]

_SLIPS_M = np.linspace(HARM_M, 1.0, 16)
"""Displacements [m] by slips, each as likely: to the largest that wheels were seen to make in a stretch."""
_LIKELY = 0.01
"""Expected number of slips that nothing shows, in the whole map, from which on it has to be looked at: a map that is
called good has a hidden slip in one case of a hundred at most, if slips are as frequent there as where they show."""
_DENIED_MARGIN, _DENIED_STRETCHES = -0.07, 2
"""Margin (`Stretches.margin`) below which a stretch agrees better with a slip, and their number; one is a door. Of 89
simulated drives with slips (seeds 21401 to 21489) none of 51 good maps has two, five of 13 wrong ones have."""
_MOST_OF_IT = 0.9
"""Share of the expected slips whose stretches are named."""


def slips(r: Recorded) -> Reason | None:
    """Slips of the wheels of which neither the scans nor the rest of the map say how long they were."""
    slipped = r.stretches.contradicted[r.held.stretches]
    # The odometry was left out there: what is left is the uncertainty of all else.
    harmful = _off(r.held.sigma[slipped])
    if _number(harmful) < _LIKELY:
        return None
    runs, sigma = _most_likely(r, slipped, harmful)
    text = f"the wheels slipped in {counted(len(runs), 'stretch')} where the scans fix the motion to {sigma:.2f} m only"
    return reason_at(r, "slip", text, runs, failed=False)


def unobserved(r: Recorded) -> Reason | None:
    """Stretches in which a slip would not be noticed: plain corridors, long halls that nothing else measures."""
    slipped = r.stretches.contradicted
    # How often wheels slip in this log is known where it shows (Laplace's rule of succession).
    slips = len(joined(r.stretches.ends[slipped]))
    seen = _number((~slipped & ~r.stretches.hidden).astype(np.float64))
    prior = (slips + 1.0) / (seen + slips + 2.0)
    quiet = ~slipped[r.held.stretches]
    difference = r.held.difference[quiet]
    sigma2 = r.held.sigma[quiet] ** 2 + r.held.odometry_sigma[quiet] ** 2
    displaced = difference[:, None] - np.concatenate((_SLIPS_M, -_SLIPS_M))
    # By how much more likely the difference is with a slip than without.
    ratio = np.exp(0.5 * (difference[:, None] ** 2 - displaced**2) / sigma2[:, None]).mean(axis=1)
    harmful = prior * ratio / (1.0 - prior + prior * ratio)
    if r.odometry is None:
        harmful = _off(r.held.sigma[quiet])
    if _number(harmful) < _LIKELY:
        return None
    runs, sigma = _most_likely(r, quiet, harmful)
    text = (
        f"in {counted(len(runs), 'stretch')} the scans and the rest of the map fix the motion to {sigma:.2f} m only: "
        "the position along them rests on the odometry, and a slip would not be noticed"
    )
    return reason_at(r, "unobserved", text, runs, failed=False)


def hidden_slips(r: Recorded) -> Reason | None:
    """Stretches along bare walls that would agree better with a slip."""
    denied = r.stretches.hidden & ~r.stretches.contradicted & (r.stretches.margin < _DENIED_MARGIN)
    if np.count_nonzero(denied) < _DENIED_STRETCHES:
        return None
    runs = joined(r.stretches.ends[denied])
    text = f"in {counted(len(runs), 'stretch')} along bare walls the scans before and after agree better displaced"
    return reason_at(r, "hidden-slip", f"{text}: the wheels may have slipped", runs, failed=False)


def _off(sigma: F64) -> F64:
    """Probability (h,) that a motion with such standard deviations (m) is off by what does harm."""
    return np.array([erfc(HARM_M / (2.0**0.5 * one)) for one in sigma.tolist()])


def _number(stretches: F64) -> float:
    """Their sum as a number of stretches that do not overlap."""
    return float(stretches.sum()) / STRETCHES_DEEP


def _most_likely(r: Recorded, of_held: Bools, harmful: F64) -> tuple[list[tuple[int, int]], float]:
    """Runs of the stretches that count most, in all but a tenth of what is expected, and their largest sigma (m)."""
    order = np.argsort(-harmful, kind="stable")
    before = np.cumsum(harmful[order]) - harmful[order]
    chosen = np.sort(order[before < _MOST_OF_IT * harmful.sum()])
    numbers = np.flatnonzero(of_held)[chosen]
    return joined(r.stretches.ends[r.held.stretches[numbers]]), float(r.held.sigma[numbers].max())

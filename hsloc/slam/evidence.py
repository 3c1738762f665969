"""Is the map right? What was recorded is held against the finished map.

The scans' residuals cannot answer: each scan fits a map that was built from it, also where a corridor was built twice.
What can is what the map was not built from, or not from alone: steps that the scans refused and no loop bridges, second
visits that look through walls, the odometry over stretches that no loop spans, loops that were believed and then
contradicted, stretches driven without seeing a wall.
"""

from __future__ import annotations

from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np

from hsloc.model.pose2 import relative_poses, wrap_angles
from hsloc.model.verdict import counted, spans_of
from hsloc.slam.jumps import jumps, tears
from hsloc.slam.loop_groups import open_steps
from hsloc.slam.recorded import HARM_M, Recorded, reason_at, seconds_of
from hsloc.slam.slip_evidence import hidden_slips, slips, unobserved
from hsloc.slam.stray_scans import inconsistent
from hsloc.slam.verdict import Evidence, Reason

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]
    Bools = NDArray[np.bool_]


_SECOND_VISIT_M = 12.0
"""Metres of the way after which a place is visited again."""
_VISIT_SEEN = 60.0
"""Points that both visits could see, of a keyscan, without which its second visit says nothing."""
_INCONSISTENT = 0.6
"""Consistency of a second visit (points on walls, of those on walls or looked through) below which it is wrong."""
_INCONSISTENT_M = 1.0
"""Metres of such visits in a row: people and doors are passed sooner."""
_FAILED_SHARE = 0.1
"""Share of all second visits that fail a map."""
_OPEN_STEPS = 3
"""Refused steps in a row that no loop spans: fewer are bridged by the scans around them."""
_OPEN_SIGMA_M = 0.4
"""Standard deviation [m] of such steps together, of which one is enough: that of a step that the scans contradicted."""
_HEALED = 0.9
"""Consistency of the scans before and after refused steps at which these did no harm, as is asked of a loop."""
_HEALED_WITHIN = 10
"""Keyscans before and after that are compared."""
_WINDOW = 20
"""Keyscans over which odometry and map are compared."""
_ODOMETRY_SHARE = 0.5
"""Difference of the two, as a part of the way, that is not a matter of calibration."""
_ODOMETRY_TURN = 0.5
"""The same of the heading [rad]."""
_WEAK_M = 0.125
"""Standard deviation [m] of the motion by the scans from which on a slip of half a metre, the largest that wheels were
seen to make in a second, may go unnoticed: it is four of these."""
_UNCERTAIN_M = HARM_M / NormalDist().inv_cdf(0.9)
"""Standard deviation [m] of a position with which one in five maps is wrong there, though nothing contradicts it."""
_BLIND_M = 2.0
"""A step longer than this [m], and than five times the usual one, was driven without enough returns."""
_BLIND_SHARE = 0.1
_NO_RETURN_SHARE = 0.4
"""On five real logs at most 0.03 of the beams meet nothing, cut to 4 m 0.27; where they erased walls 0.52 and more."""


def weigh(recorded: Recorded) -> Evidence:
    """The verdict on a map of at least one keyscan."""
    bridged = _bridged(recorded)
    found = [
        _open_joints(recorded, bridged),
        _relocated(recorded),
        _record_gaps(recorded),
        _second_visits(recorded),
        _against_odometry(recorded, bridged),
        slips(recorded),
        unobserved(recorded),
        hidden_slips(recorded),
        _uncertain(recorded),
        _torn_loops(recorded),
        _jumps(recorded),
        _blind(recorded),
        _no_returns(recorded),
    ]
    return Evidence.of([reason for reason in found if reason is not None], _strays(recorded))


def nothing_seen() -> Evidence:
    """The verdict where no scan had a return."""
    return Evidence.of([Reason("blind", "no scan had enough returns: there is no map", "failed")])


def _open_joints(r: Recorded, bridged: Bools) -> Reason | None:
    """Runs of steps that only odometry holds: one loop over several of them shares out their errors as it likes."""
    wrong = []
    for first, last in spans_of(open_steps(r.refused, r.loops)):
        sigma = float(np.sqrt(np.trace(r.covariances[first : last + 1, :2, :2].sum(axis=0))))
        is_long = last - first + 1 >= _OPEN_STEPS or sigma > _OPEN_SIGMA_M
        if is_long and not bridged[first : last + 1].all() and not _healed(r, first, last):
            wrong.append((first, last))
    if not wrong:
        return None
    text = f"odometry alone holds {counted(len(wrong), 'joint')}: the scans refused it, fewer than two loops span it"
    return reason_at(r, "open-joint", text, wrong, failed=False)


def _relocated(r: Recorded) -> Reason | None:
    """Where the path goes on at a place that a search of the whole map found."""
    if len(r.joints) == 0:
        return None
    text = f"neither scans nor odometry say how the robot moved at {counted(len(r.joints), 'place')}, as if it was "
    text += "carried: where it went on was found by a search of the whole map"
    return reason_at(r, "relocated", text, [(int(joint), int(joint)) for joint in r.joints], failed=False)


def _record_gaps(r: Recorded) -> Reason | None:
    """Where the record goes on after a gap, and it is not known whether the robot was moved."""
    gaps = [(keyscan, seconds) for keyscan, seconds in r.after_gaps if keyscan not in r.joints]
    if not gaps:
        return None
    longest = max(seconds for _, seconds in gaps)
    text = f"nothing was recorded for {longest:.0f} s, in {counted(len(gaps), 'gap')}: only the scans say that "
    text += "the robot was not moved meanwhile, and places that look alike could be mixed up"
    return reason_at(r, "record-gap", text, [(keyscan, keyscan) for keyscan, _ in gaps], failed=False)


def _healed(r: Recorded, first: int, last: int) -> bool:
    """Whether the scans just before and after refused steps agree in the finished map after all."""
    i, j = r.pairs.min(axis=1), r.pairs.max(axis=1)
    across = (i < first) & (j >= last) & (j - i <= last - first + _HEALED_WITHIN)
    paired, conflict = r.counts[across, :2].sum(axis=0)
    return bool(paired >= _VISIT_SEEN and paired >= _HEALED * (paired + conflict))


def _bridged(r: Recorded) -> Bools:
    """Steps (n,) over which the scans agree in the finished map, and fix the motion: a slip there was measured.

    Across each step keyscans near each other are paired and hardly look through walls of each other; and every stretch
    that holds the step has its motion by the scans alone, to a half of what a slip would need to hide in.
    """
    near = np.abs(r.pairs[:, 1] - r.pairs[:, 0]) <= _HEALED_WITHIN
    paired, conflict = r.summed_across(r.pairs[near], r.counts[near, :2]).T
    agrees = (paired >= _VISIT_SEEN) & (paired >= _HEALED * (paired + conflict))
    uncertain = r.stretches.sigma > 0.5 * _WEAK_M
    known, weak = r.summed_across(r.stretches.ends, np.column_stack((np.ones(len(uncertain)), uncertain))).T
    return np.asarray(agrees & (known > 0) & (weak == 0), dtype=np.bool_)


def _second_visits(r: Recorded) -> Reason | None:
    """Second visits that look through the walls of the first."""
    way = np.cumsum(r.lengths())
    far = np.abs(way[r.pairs[:, 1]] - way[r.pairs[:, 0]]) > _SECOND_VISIT_M
    paired, conflict = (r.summed_at(r.pairs[far], r.counts[far, k]) for k in (0, 1))
    known = paired + conflict >= _VISIT_SEEN
    if not known.any():
        return None
    bad = known & (paired < _INCONSISTENT * (paired + conflict))
    wrong = [run for run in spans_of(bad) if way[run[1]] - way[max(run[0] - 1, 0)] >= _INCONSISTENT_M]
    if not wrong:
        return None
    share = sum(last - first + 1 for first, last in wrong) / int(known.sum())
    text = (
        f"{100.0 * share:.0f} % of second visits look through walls of the first, in {counted(len(wrong), 'stretch')}"
    )
    return reason_at(r, "second-visit", text, wrong, failed=share > _FAILED_SHARE)


def _strays(r: Recorded) -> tuple[tuple[float, float], ...]:
    """Refused keyscans that fit nowhere: single scans beside their place, as while wheels slip, draw walls twice."""
    return seconds_of(r, spans_of(r.refused & inconsistent(len(r.poses), r.pairs, r.counts)))


def _against_odometry(r: Recorded, bridged: Bools) -> Reason | None:
    """Stretches over which map and odometry differ by what no calibration explains, and that no loop spans."""
    if r.odometry is None or len(r.poses) <= _WINDOW:
        return None
    ours = relative_poses(r.poses[:-_WINDOW], r.poses[_WINDOW:])
    theirs = relative_poses(r.odometry[:-_WINDOW], r.odometry[_WINDOW:])
    lengths, turns = zip(*(_driven(poses) for poses in (r.poses, r.odometry)), strict=True)
    length, turn = np.minimum(*lengths), np.minimum(*turns)
    apart = np.hypot(*(ours - theirs)[:, :2].T)
    angle = np.abs(wrap_angles(ours[:, 2] - theirs[:, 2]))
    # A turn at the beginning that is off by an angle swings the whole stretch.
    off = (apart > _ODOMETRY_SHARE * length + 0.3) | (angle > _ODOMETRY_TURN + 0.2 * turn)
    open_steps = np.cumsum(~r.spanned())
    off &= open_steps[_WINDOW:] - open_steps[:-_WINDOW] == _WINDOW
    ends = [(first, min(last + _WINDOW, len(r.poses) - 1)) for first, last in spans_of(off)]
    wrong = [(first, last) for first, last in ends if not bridged[first + 1 : last + 1].all()]
    if not wrong:
        return None
    text = f"map and odometry contradict each other over {counted(len(wrong), 'stretch')} that no loop spans"
    return reason_at(r, "odometry", text, wrong, failed=False)


def _uncertain(r: Recorded) -> Reason | None:
    """Poses that are known so little as a whole: far from where a map of a large building begins."""
    sigma = np.sqrt(np.maximum(np.linalg.eigvalsh(r.pose_covariances[:, :2, :2])[:, 1], 0.0))
    uncertain = sigma > _UNCERTAIN_M
    if not uncertain.any():
        return None
    text = (
        f"positions are known to {sigma.max():.2f} m only (standard deviation, relative to the first pose): "
        f"more than one in five such maps is off by more than {HARM_M} m there"
    )
    return reason_at(r, "uncertain", text, spans_of(uncertain), failed=False)


def _driven(poses: F64) -> tuple[F64, F64]:
    """Path length (m) and sum of turns (rad) of each window."""
    steps = relative_poses(poses[:-1], poses[1:])
    way = np.concatenate(([0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))))
    turned = np.concatenate(([0.0], np.cumsum(np.abs(wrap_angles(steps[:, 2])))))
    return way[_WINDOW:] - way[:-_WINDOW], turned[_WINDOW:] - turned[:-_WINDOW]


def _torn_loops(r: Recorded) -> Reason | None:
    """Loops that passed every test and were contradicted by the others."""
    if len(r.torn) == 0 or len(r.torn) < 0.1 * (len(r.loops) + len(r.torn)):
        return None
    text = f"{len(r.torn)} of {len(r.loops) + len(r.torn)} loops contradict the others: one side is wrong"
    ends = [(int(pair.max()), int(pair.max())) for pair in r.torn]
    return reason_at(r, "torn-loop", text, ends, failed=False)


def _jumps(r: Recorded) -> Reason | None:
    wrong = jumps(r.stamps_ns, r.poses, r.odometry)
    torn = tears(wrong, r.poses, r.odometry)
    text = f"the map moves the robot faster than it drives in {counted(len(wrong), 'stretch')}: "
    text += "loops join places that only look alike, or it was carried" if torn else "scans within them are misplaced"
    return reason_at(r, "jump", text, wrong, failed=bool(torn)) if wrong else None


def _blind(r: Recorded) -> Reason | None:
    """Stretches driven without enough returns to match."""
    lengths = r.lengths()
    if len(lengths) < 2 or lengths.sum() <= 0.0:
        return None
    long = lengths > max(_BLIND_M, 5.0 * float(np.median(lengths[1:])))
    share = float(lengths[long].sum() / lengths.sum())
    if share < _BLIND_SHARE:
        return None
    text = f"{100.0 * share:.0f} % of the path was driven with too few returns: the lidar sees too little here"
    return reason_at(r, "blind", text, spans_of(long), failed=share > 0.5)


def _no_returns(r: Recorded) -> Reason | None:
    if r.no_return_share < _NO_RETURN_SHARE:
        return None
    text = f"{100.0 * r.no_return_share:.0f} % of the beams met nothing: where that is a fault they erase walls"
    return Reason("no-returns", text, "check")

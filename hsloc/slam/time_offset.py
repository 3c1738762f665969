"""How far the stamps of the scans are from those of the odometry, from the data alone.

A driver that stamps a scan when it arrives, a lidar with a clock of its own: the odometry at the scan's stamp is then
that of another moment, and every turn bends the pose. The offset is found where the heading that the scans show agrees
best with the heading of the odometry, as in Censi et al. (T-RO 2013) for the rotation alone; a robot that never turns
does not determine it. The odometry's errors in single turns average out over many, and are counted in the uncertainty.
"""

from __future__ import annotations

from dataclasses import replace
from math import isfinite, sqrt
from typing import TYPE_CHECKING

import numpy as np

from hsloc.log import LONGEST_OFFSET_S, ReadOptions, open_log
from hsloc.model.events import Heading, Odometry, Scan
from hsloc.options import AUTO
from hsloc.preprocessing.odometry_stalls import UnstalledOdometry
from hsloc.preprocessing.scans import half_sweep_ns
from hsloc.slam.heading_offset import (
    MIN_STEPS,
    NANOSECONDS,
    NEAR_S,
    UNKNOWN,
    Headings,
    Offset,
    find_offset,
    is_sparse,
    thinned,
)
from hsloc.slam.laser_odometry import with_laser_odometry
from hsloc.warnings import RunWarning, WarningCode

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from numpy.random import Generator
    from numpy.typing import NDArray

    from hsloc.model.events import Event
    from hsloc.slam.front_end_parameters import FrontEndParameters

    F64 = NDArray[np.float64]

RANGE_S = 40.0
"""Offsets that are searched (s), either way; clocks that are farther apart are of different epochs."""
LEAST_AGREEMENT = 0.8
"""Correlation of the rotations of scans and odometry from which on an offset is believed: what is left explains a third
of the rotation at most. Offsets of scans whose angles are wrong reach less."""
_GAP = 5.0
"""Ratio of the time between scans to the usual one from which on it is a gap: matches say little across it."""
_CORRELATED_S = 0.5
"""Time (s) over which rotations are correlated: longer than the noise of a scan, shorter than a turn."""
HINT_S = 0.15
"""Difference of stamps and log times between scans and odometry (s) from which on the offset is estimated before a run:
drivers and networks delay messages by less."""
_WORTH_A_WORD_S = 0.005
"""Difference of an offset and its correction (s) that is explained: less is 5 mm at 1 m/s."""
LARGE_S = 0.1
"""From here on (s) poses are wrong by 10 cm at 1 m/s and by 6 degrees at 1 rad/s: a wrong result by any standard."""


def estimate_offset(
    events: Iterable[Event], parameters: FrontEndParameters, rng: Generator, most_scans: int = 1500
) -> Offset:
    """The offset of a log: its scans are matched one to the next without odometry, up to `most_scans` of them.

    The whole range of `RANGE_S` is searched; where two offsets fit nearly alike, the smaller one counts.
    """
    odometry: list[tuple[int, float]] = []
    middles: dict[int, int] = {}
    halves: list[int] = []

    def kept() -> Iterable[Event]:
        count, last_ns = 0, 0
        for event in UnstalledOdometry(events):
            if isinstance(event, Odometry | Heading):
                theta = event.theta if isinstance(event, Heading) else event.T_odom_base.theta
                odometry.append((event.stamp_ns, theta))
                if count >= most_scans and event.stamp_ns > last_ns + RANGE_S * NANOSECONDS:
                    return
            elif isinstance(event, Scan):
                count += 1
                if count <= most_scans:
                    last_ns = event.stamp_ns
                    halves.append(half_sweep_ns(event))
                    middles[event.stamp_ns] = event.stamp_ns + halves[-1]
                    yield event

    matched = with_laser_odometry(kept(), parameters, rng)
    scans = [(middles[event.stamp_ns], event.T_odom_base.theta) for event in matched if isinstance(event, Odometry)]
    if not scans or not odometry:
        return UNKNOWN
    turns, odometry_turns = _headings(scans), _headings(odometry)
    found = best_offset(turns, odometry_turns)
    if agreement(turns, odometry_turns, found.seconds) >= LEAST_AGREEMENT:
        half = float(np.median(halves)) / NANOSECONDS
        return found._replace(drift_s=find_drift(turns, odometry_turns, found.seconds), half_sweep_s=half)
    mirrored = Headings(turns.stamps_ns, -turns.theta)
    back = find_offset(thinned(mirrored), odometry_turns)
    if isfinite(back.sigma) and agreement(mirrored, odometry_turns, back.seconds) >= LEAST_AGREEMENT:
        return UNKNOWN._replace(is_mirrored=True)
    return UNKNOWN


def best_offset(turns: Headings, odometry: Headings) -> Offset:
    """The offset over the whole range of `RANGE_S`; a small one, unless it explains the rotation much worse."""
    # By steps of half a second and more the rotation stands out of the noise of single scans.
    steps = turns if is_sparse(odometry, turns) else thinned(turns)
    near = find_offset(steps, odometry)
    # Turns in a building are alike: what scans got wrong at one of them is no reason to look for the next one.
    is_near = isfinite(near.sigma) and abs(near.seconds) < NEAR_S
    if is_near and agreement(turns, odometry, near.seconds) >= LEAST_AGREEMENT:
        return near
    whole = find_offset(steps, odometry, near_s=RANGE_S)
    if not isfinite(whole.sigma):
        return near
    limit = 1.2 * _misfit(turns, odometry, whole.seconds)
    return near if isfinite(near.sigma) and _misfit(turns, odometry, near.seconds) <= limit else whole


def find_drift(scans: Headings, odometry: Headings, offset_s: float) -> float:
    """By how much the offset grows from the first scan to the last (s); 0 where that may be chance or does not matter.

    The offsets of both halves of the scans are compared, each as far from the other as half of the whole.
    """
    scans = scans if is_sparse(odometry, scans) else thinned(scans)
    middle = len(scans.theta) // 2
    halves = [
        find_offset(Headings(scans.stamps_ns[part], scans.theta[part]), odometry, start_s=offset_s)
        for part in (slice(0, middle), slice(middle, None))
    ]
    change = Offset(halves[1].seconds - halves[0].seconds, sqrt(halves[0].sigma ** 2 + halves[1].sigma ** 2))
    return 2.0 * change.seconds if change.is_significant and 2.0 * abs(change.seconds) >= LARGE_S else 0.0


def agreement(scans: Headings, odometry: Headings, offset_s: float) -> float:
    """The correlation (-1 to 1) of the rotations between scans with those of the odometry, an offset removed."""
    seen, turned = _rotations(thinned(scans, _CORRELATED_S), odometry, offset_s)
    if len(seen) < 2:
        return 0.0
    return float(np.sum(seen * turned) / max(sqrt(float(np.sum(seen**2) * np.sum(turned**2))), 1e-12))


def _headings(pairs: list[tuple[int, float]]) -> Headings:
    return Headings.of(np.array([stamp for stamp, _ in pairs], dtype=np.int64), np.array([theta for _, theta in pairs]))


def _misfit(scans: Headings, odometry: Headings, offset_s: float) -> float:
    """Mean difference of the steps (rad), large ones bounded."""
    seen, turned = _rotations(scans, odometry, offset_s)
    if len(seen) + 1 < MIN_STEPS:
        return float("inf")
    return float(np.mean(np.minimum(np.abs(seen - turned), 0.5)))


def _rotations(scans: Headings, odometry: Headings, offset_s: float) -> tuple[F64, F64]:
    """Turns (rad) from scan to scan but over gaps, by scans and odometry, within its time; an offset is removed."""
    at = scans.stamps_ns - round(offset_s * NANOSECONDS)
    inside = (at >= odometry.stamps_ns[0]) & (at <= odometry.stamps_ns[-1])
    turned = np.interp(at[inside].astype(np.float64), odometry.stamps_ns.astype(np.float64), odometry.theta)
    times = np.diff(at[inside])
    near = times <= _GAP * np.median(times) if len(times) else np.zeros(0, dtype=np.bool_)
    return np.diff(scans.theta[inside])[near], np.diff(turned)[near]


def offsets_of_log(paths: Sequence[Path], options: ReadOptions, parameters: FrontEndParameters) -> dict[str, Offset]:
    """The offset of each scan topic that is read, those that are determined; the whole log counts.

    What the options add to the stamps is part of them.

    Raises LogError and TopicError as `open_log` does.
    """
    given = None if options.time_offset == AUTO else options.time_offset
    options = replace(options, time_offset=given, deskew=False, start_s=None, end_s=None)
    topics = (open_log(paths, options).summary.scan_topic or "").split(",")
    found = {}
    for topic in topics if options.stamps == "header" else ():
        # A text log has no topics to choose from.
        named = replace(options, scan_topic=topic) if len(topics) > 1 else options
        log = open_log(paths, named)
        # Clocks that are far apart are searched around what the log's times show.
        apart = log.summary.clocks_apart_s
        apart = apart if 0.5 * RANGE_S < abs(apart) <= LONGEST_OFFSET_S else 0.0
        if apart:
            items = [*([given] if given else []), f"{topic.partition(' + ')[0]}={-apart!r}"]
            log = open_log(paths, replace(named, time_offset=",".join(items)))
        offset = estimate_offset(log.events(), parameters, np.random.default_rng(0))
        if isfinite(offset.sigma) or offset.is_mirrored:
            found[topic] = offset._replace(seconds=offset.seconds + apart)
    return found


def in_words(offset: Offset) -> str:
    """An offset with its uncertainty, to be followed by what it is counted from."""
    word = "later than" if offset.seconds > 0.0 else "earlier than"
    return f"{abs(offset.seconds):.3f} ± {offset.sigma:.3f} s {word}"


def clock_warnings(
    found: Mapping[str, Offset], given: Mapping[str, float] | None = None, removed: str | None = None
) -> list[tuple[str, RunWarning]]:
    """(topic, warning) of the offsets that are none by chance, of clocks that drift, and of scans that are mirrored.

    `given` is what the user adds to the stamps already (s) by topic, without its leading slash; `removed` is the value
    of `--time-offset` by which the offsets were removed.
    """
    warnings = []
    for topic, offset in found.items():
        if offset.is_mirrored:
            text = (
                f"the scans of {topic} turn the other way than the odometry: the lidar is mounted upside down, or its "
                "angles have the wrong sign"
            )
            remedy = "--scan-fix angles=negate turns them; increment=negate, if only that has the wrong sign"
            warnings.append((topic, RunWarning(WarningCode.SCANS_MIRRORED, text, remedy)))
        if offset.is_significant and removed is not None:
            by = f"which was corrected (--time-offset {removed})"
            kept = _kept_in_words(offset, offset.seconds + _added_s(topic, found, removed))
            text = f"the stamps of {topic} were {in_words(offset)} those of the odometry, {by}{kept}"
            warnings.append((topic, RunWarning(WarningCode.CLOCK_OFFSET_APPLIED, text)))
        elif offset.is_significant:
            warnings.append((topic, offset_warning(topic, offset, (given or {}).get(topic.lstrip("/"), 0.0))))
        if offset.drift_s:
            warnings.append((topic, drift_warning(topic, offset.drift_s)))
    return warnings


def _added_s(topic: str, found: Mapping[str, Offset], removed: str) -> float:
    """What `--time-offset` adds to the stamps of a scan topic more than to those of the odometry (s)."""
    added, scans = ReadOptions(time_offset=removed).offsets_s(), [_name(each) for each in found]
    return added.get(_name(topic), 0.0) - sum(seconds for name, seconds in added.items() if name not in scans)


def _name(topic: str) -> str:
    """As `--time-offset` has it: of joined kinds of lines the first, without a leading slash."""
    return topic.partition(" + ")[0].lstrip("/")


def _kept_in_words(offset: Offset, kept_s: float) -> str:
    """Why a correction is not the whole offset."""
    half_s = offset.half_sweep_s
    if abs(kept_s) < _WORTH_A_WORD_S:
        return ""
    if abs(kept_s - half_s) < _WORTH_A_WORD_S:
        return (
            f"; half a sweep, {half_s:.3f} s, is kept: without --deskew a scan shows the robot in the middle of the "
            "sweep, and is stamped at its first beam"
        )
    return f"; {kept_s:.3f} s of it are left, as the corrected run shows"


def drift_warning(topic: str, drift_s: float) -> RunWarning:
    """The warning of clocks that do not run equally fast; `drift_s` is by how much they part from start to end (s)."""
    return RunWarning(
        WarningCode.CLOCK_DRIFT,
        f"the clocks of {topic} and the odometry drift apart by about {abs(drift_s):.1f} s, by their headings",
        "--stamps log takes the times at which messages were recorded; synchronise the clocks (chrony, PTP)",
    )


def offset_warning(topic: str, offset: Offset, given_s: float = 0.0) -> RunWarning:
    """The warning of an offset that was not removed; `given_s` is what the user adds to the stamps already (s)."""
    return RunWarning(
        WarningCode.CLOCK_OFFSET_LARGE if abs(offset.seconds) >= LARGE_S else WarningCode.CLOCK_OFFSET,
        f"the stamps of {topic} are {in_words(offset)} those of the odometry, by their headings",
        f"--time-offset {topic.partition(' + ')[0]}={given_s - offset.seconds:.3f} removes it, or --time-offset auto",
    )

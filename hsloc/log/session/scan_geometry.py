"""Scans as drivers publish them: fields that contradict each other, and turns that come in segments.

`survey` looks at the first scans of a topic and says what does not fit; `ScanFixes` are what the user wants overridden;
`TurnAssembler` makes one scan of the segments of a turn.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from math import copysign, inf, isfinite, nan, pi, radians
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hsloc.errors import ConfigError
from hsloc.log.messages.decode import strongest_echoes
from hsloc.log.range_codes import NoReturnCode
from hsloc.warnings import WarningCode

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from hsloc.log.messages.decode import ScanMessage

_TURN = 2.0 * pi
_LONGEST_TURN = 1.25 * _TURN
"""Some lidars measure a little more than a turn (rad)."""
_WIDEST_SEGMENT = pi
"""A segment of a turn spans at most half of it (rad)."""
_SPARE_BEAMS = 2.5
"""Error of drivers that count the last beam, or round (beams)."""
_LEAST_DISAGREEMENT = radians(2.0)
"""Angles that fit within this are not worth a word (rad)."""
_LONGEST_SWEEP, _SHORTEST_SWEEP = 1.5, 0.25
"""A lidar that turns once between two scans measures its beams in as large a part of the interval as they span of a
turn; a sweep that takes a smaller or larger part of that than this is an error of the driver, or of another lidar."""
_FAR_SHARE = 0.05
"""Finite readings beyond range_max that are worth a word, as a part of all finite ones: cheap lidars have stray ones, a
hundredth of all in a real log."""
_CODE_SHARE = 0.5
"""Readings beyond range_max of which more than this part have one value are a code for no return."""


_NEAR_SHARE = 0.5
"""Finite readings below range_min that are worth a word, as a part of all finite ones."""
_FARTHEST_M = 500.0
"""No planar lidar measures as far [m]: readings that are larger are not in metres."""


_WIDEST_OVERLAP = 0.25
"""Part of a segment that the one before may have, too."""
_FAR_M = 100.0
"""Half of the readings of a planar lidar are never farther [m]: it would have to stand in an empty field."""
_ONLY = {"angles": ("degrees", "negate"), "echo": ("strongest",), "ranges": ("millimetres", "centimetres")}
"""Fields of `--scan-fix` that take a word alone."""


_NUMBERS = ("increment", "time_increment", "range_min", "range_max")


class Problem(NamedTuple):
    """What does not fit in the scans of a topic, and what to do."""

    code: str
    text: str
    remedy: str


@dataclass(frozen=True, slots=True)
class ScanFixes:
    """Fields of scans that are overridden (`--scan-fix`). None and False leave the field as it is.

    `increment` is an angle in radians, or `angles` (from angle_min, angle_max and the number of beams) or `negate`;
    `degrees` says that all angles are in degrees, `negate` that all have the wrong sign; `time_increment` is a time in
    seconds, or `interval` (from the time between scans), or `reverse` (the last beam was measured first, in the same
    time); `range_min` and `range_max` are in metres; `millimetres` and `centimetres` say that ranges are, and their
    limits, too, if no lidar measures as far; `strongest` takes of each beam the strongest echo, not the first.
    """

    increment: float | str | None = None
    degrees: bool = False
    time_increment: float | str | None = None
    range_min: float | None = None
    range_max: float | None = None
    strongest: bool = False
    millimetres: bool = False
    centimetres: bool = False
    negate: bool = False

    @staticmethod
    def parse(text: str | None) -> ScanFixes:
        """From `name=value` items with commas between. Raises ConfigError naming the item."""
        items = [item.strip() for item in text.split(",")] if text else []
        values: dict[str, float | str | bool] = {}
        words = {"increment": ("angles", "negate"), "time_increment": ("interval", "reverse"), **_ONLY}
        for item in items:
            name, _, text = item.partition("=")
            if name not in (*_NUMBERS, *_ONLY):
                raise ConfigError(f"--scan-fix {item}: {name!r} is unknown; known are {', '.join((*_NUMBERS, *_ONLY))}")
            if text in words.get(name, ()):
                values[text if name in _ONLY else name] = True if name in _ONLY else text
                continue
            try:
                number = float(text)
            except ValueError:
                number = nan
            allowed = " or ".join([*words.get(name, ()), *(["a number"] if name not in _ONLY else [])])
            if not isfinite(number) or name in _ONLY or (name.startswith("range_") and number < 0.0):
                raise ConfigError(f"--scan-fix {item}: {text!r} must be {allowed}")
            values[name] = number
        return ScanFixes(**values)  # type: ignore[arg-type]

    def apply(self, message: ScanMessage, interval_s: float | None) -> ScanMessage:
        """The message with the fields overridden; `interval_s` is the usual time between scans."""
        low, increment, high = message.angle_min, message.angle_increment, message.angle_max
        if self.degrees:
            low, increment, high = radians(low), radians(increment), radians(high)
        if self.negate:
            low, increment, high = -low, -increment, -high
        if self.increment == "angles" and len(message.ranges) > 1 and isfinite(high):
            increment = (high - low) / (len(message.ranges) - 1)
        elif self.increment == "negate":
            increment = -increment
        elif isinstance(self.increment, float):
            increment = self.increment
        step, stamp_ns = message.time_increment, message.stamp_ns
        if self.time_increment == "reverse" and isfinite(step):
            stamp_ns += round(max(len(message.ranges) - 1, 0) * step * 1e9)
            step = -step
        elif self.time_increment == "interval":
            step = abs(increment) / _TURN * interval_s if interval_s is not None else step
        elif isinstance(self.time_increment, float):
            step = self.time_increment
        if self.strongest and message.echoes is not None:
            ranges, intensities = strongest_echoes(*message.echoes)
            message = message._replace(ranges=ranges, intensities=intensities)
        nearest, farthest = message.range_min, message.range_max
        unit = 0.001 if self.millimetres else 0.01 if self.centimetres else 1.0
        if unit < 1.0:
            message = message._replace(ranges=message.ranges * np.float32(unit))
            if farthest > _FARTHEST_M:
                nearest, farthest = unit * nearest, unit * farthest
        return message._replace(
            stamp_ns=stamp_ns,
            angle_min=low,
            angle_increment=increment,
            angle_max=high,
            time_increment=step,
            range_min=nearest if self.range_min is None else self.range_min,
            range_max=farthest if self.range_max is None else self.range_max,
            echoes=None,
        )


@dataclass(frozen=True, slots=True)
class ScanSurvey:
    """What the first scans of a topic say: the usual time between them (s), segments of a turn, and what is wrong.

    `segments` is how many messages make a turn, 1 where each is a whole scan; `first_angle` that of the segment with
    which a turn begins (rad). `sweep_is_wrong`: time_increment cannot be that of the lidar. `no_return` is what is
    known so far of a code for no return.
    """

    interval_s: float | None = None
    segments: int = 1
    first_angle: float = 0.0
    sweep_is_wrong: bool = False
    problems: tuple[Problem, ...] = ()
    no_return: NoReturnCode = field(default_factory=NoReturnCode)


def survey(messages: Iterable[ScanMessage]) -> ScanSurvey:
    """Look at scans of one topic, in the order of the log."""
    scans = [message for message in messages if len(message.ranges) > 1]
    if not scans:
        return ScanSurvey()
    steps = np.diff([scan.stamp_ns for scan in scans])
    steps = steps[steps > 0]
    interval = float(np.median(steps)) / 1e9 if len(steps) else None
    segments, first_angle = _segments(scans)
    turn = None if interval is None else interval * segments
    problems = [problem for problem in (_angles(scans[0]), _ranges(scans)) if problem is not None]
    sweep = _sweep(scans[0], turn)
    if sweep is not None:
        problems.append(sweep)
    code = NoReturnCode()
    for scan in scans:
        code.learn(scan.ranges, scan.angle_increment, (scan.range_min, scan.range_max))
    if code.is_known:
        problems.append(Problem(WarningCode.SCAN_NO_RETURN_CODE, str(code), ""))
    return ScanSurvey(turn, segments, first_angle, sweep is not None, tuple(problems), code)


def _angles(scan: ScanMessage) -> Problem | None:
    """Whether angle_min, angle_max, the increment and the number of beams fit each other."""
    low, increment, high, beams = scan.angle_min, scan.angle_increment, scan.angle_max, len(scan.ranges)
    if not (isfinite(low) and isfinite(increment)) or increment == 0.0:
        return None
    known = [angle for angle in (low, high) if isfinite(angle)]
    if max(map(abs, known)) > _TURN + _LEAST_DISAGREEMENT and abs(increment) * (beams - 1) > 1.5 * _TURN:
        span = abs(increment) * (beams - 1)
        if span <= 3.0 * _TURN:  # as degrees this would be a slit
            turn = f"{copysign(_TURN / beams, increment):.6g}"
            text = f"{beams} beams of angle_increment {increment:g} make {span / _TURN:.1f} turns"
            return Problem(
                WarningCode.SCAN_ANGLE_INCREMENT, text, f"--scan-fix increment={turn} makes it one, or give your own"
            )
        fits = span <= 360.0 + _SPARE_BEAMS * abs(increment)
        text = f"angles from {low:g} to {high:g} with steps of {increment:g} are no radians"
        return Problem(
            WarningCode.SCAN_ANGLE_UNIT, text, "--scan-fix angles=degrees reads them as degrees" if fits else _REPAIR
        )
    if not isfinite(high):
        return None
    end = low + (beams - 1) * increment
    tolerance = max(_LEAST_DISAGREEMENT, _SPARE_BEAMS * abs(increment))
    # A full turn may be written to end where it began, and angles may be written with or without a turn.
    is_one_turn = abs(increment) * (beams - 1) <= _LONGEST_TURN
    if is_one_turn and min(abs(end - high + turn) for turn in (-_TURN, 0.0, _TURN)) <= tolerance:
        return None
    mixed = _mixed_units(low, high, increment, beams - 1, tolerance)
    if mixed is not None:
        return mixed
    text = (
        f"angle_min {low:.4f} and {beams} beams of angle_increment {increment:.5f} end at {end:.4f} rad, angle_max is "
        f"{high:.4f}"
    )
    remedy = "find out which is right: --scan-fix increment=angles takes angle_max's, increment=VALUE any other"
    if abs(low - (beams - 1) * increment - high) <= tolerance:
        text += ": they differ by the sign of the increment, and the scan is mirrored if that is wrong"
        remedy = "--scan-fix increment=negate takes the sign of angle_max's"
    return Problem(WarningCode.SCAN_ANGLE_INCREMENT, text, remedy)


def _mixed_units(low: float, high: float, increment: float, steps: int, tolerance: float) -> Problem | None:
    """Whether the angles fit each other if the increment alone is in degrees, or the limits alone are."""
    if abs(low + steps * radians(increment) - high) <= tolerance:
        text, remedy = f"angle_increment {increment:g} fits the other angles as degrees", "--scan-fix increment=angles"
    elif abs(radians(low) + steps * increment - radians(high)) <= tolerance:
        text = f"angle_min {low:g} and angle_max {high:g} fit angle_increment {increment:g} as degrees"
        remedy = "--scan-fix angles=degrees,increment=angles"
    else:
        return None
    return Problem(WarningCode.SCAN_ANGLE_UNIT, text, f"{remedy} reads them so")


_REPAIR = "repair the driver; --scan-fix overrides a field"


def _ranges(scans: Sequence[ScanMessage]) -> Problem | None:
    """Whether readings beyond the limits are measured: then they are dropped, and a limit or the unit is wrong."""
    limit, nearest = scans[0].range_max, scans[0].range_min
    readings = np.concatenate([scan.ranges[np.isfinite(scan.ranges)] for scan in scans])
    measured = readings[readings > 0.0]
    middle = float(np.median(measured)) if len(measured) else 0.0
    is_odd = not middle < limit < _FARTHEST_M  # The limit makes no sense in metres either.
    if middle > _FARTHEST_M or (middle > _FAR_M and is_odd):
        units = ("millimetres", "centimetres") if middle > _FARTHEST_M else ("centimetres", "millimetres")
        return Problem(
            WarningCode.SCAN_RANGE_UNIT,
            f"half of the readings are beyond {middle:.0f} m, farther than planar lidars measure",
            f"--scan-fix ranges={units[0]} reads them as {units[0]}; or ranges={units[1]}",
        )
    if np.count_nonzero(measured < nearest) > _NEAR_SHARE * max(len(measured), 1):
        share, first = 100.0 * float(np.mean(measured < nearest)), float(np.percentile(measured, 1.0))
        return Problem(
            WarningCode.SCAN_RANGE_MIN,
            f"{share:.0f} % of the finite readings lie below range_min, {nearest:g} m, and are discarded",
            f"--scan-fix range_min={np.floor(50.0 * first) / 100.0:g} uses them, if the lidar measures as near",
        )
    if not (isfinite(limit) and limit > 0.0):
        return None
    beyond = readings[readings > limit * (1.0 + 1e-6)]
    if len(beyond) <= _FAR_SHARE * max(len(readings), 1):
        return None
    _, counts = np.unique(beyond, return_counts=True)
    if counts.max() > _CODE_SHARE * len(beyond):
        return None
    share, farthest = 100.0 * len(beyond) / len(readings), float(np.percentile(beyond, 99.0))
    return Problem(
        WarningCode.SCAN_RANGE_MAX,
        f"{share:.0f} % of the finite readings lie beyond range_max, {limit:g} m, and are discarded, as the message's "
        "definition asks",
        f"--scan-fix range_max={np.ceil(farthest + 0.5):g} uses them, if the lidar measures as far",
    )


def _sweep(scan: ScanMessage, interval_s: float | None) -> Problem | None:
    """Whether time_increment fits the time between scans, for a lidar that turns once a scan."""
    beams, step = len(scan.ranges), scan.time_increment
    span = abs(scan.angle_increment) * (beams - 1)
    if interval_s is None or interval_s > 1.0 or not isfinite(step) or step == 0.0 or not 0.0 < span <= 2.0 * _TURN:
        return None
    sweep, expected = abs(step) * (beams - 1), interval_s * min(span / _TURN, 1.0)
    if _SHORTEST_SWEEP * expected <= sweep <= max(_LONGEST_SWEEP * expected, 1.05 * interval_s):
        return None
    return Problem(
        WarningCode.SCAN_TIME_INCREMENT,
        f"{beams} beams of time_increment {step:g} s take {sweep:g} s, a scan comes every {interval_s:.3f} s",
        "--scan-fix time_increment=interval takes the time between scans; it matters for --deskew alone",
    )


def _segments(scans: Sequence[ScanMessage]) -> tuple[int, float]:
    """How many messages make a turn, and the angle with which it begins; (1, 0.0) where each is a scan of its own."""
    first = scans[0]
    span = len(first.ranges) * abs(first.angle_increment)
    if len(scans) < 6 or not 0.0 < span <= _WIDEST_SEGMENT + _LEAST_DISAGREEMENT:
        return 1, 0.0
    starts = [scan.angle_min for scan in scans]
    alike = sum(_follows(a, b) for a, b in pairwise(scans))
    if alike < 0.5 * (len(scans) - 1) or len({round(start, 3) for start in starts}) < 2:
        return 1, 0.0
    rising = first.angle_increment > 0.0
    begin = min(starts) if rising else max(starts)
    spare = _SPARE_BEAMS * abs(first.angle_increment)
    if sum(abs(start - begin) <= spare for start in starts) < 2:
        return 1, 0.0
    # Segments may be missing; a turn has as many as there are different beginnings.
    return 1 + int(np.count_nonzero(np.diff(np.sort(starts)) > spare)), begin


def _follows(first: ScanMessage, second: ScanMessage) -> bool:
    """Whether a segment begins where the one before ended, or a little before that."""
    tolerance = _SPARE_BEAMS * abs(first.angle_increment) + 1e-3
    overlap = _overlap(first, second)
    widest = _WIDEST_OVERLAP * len(second.ranges) * abs(second.angle_increment)
    same = abs(second.angle_increment - first.angle_increment) <= 1e-6
    return same and -tolerance <= overlap <= max(widest, tolerance)


def _overlap(first: ScanMessage, second: ScanMessage) -> float:
    """By how much (rad) a segment begins before the end of the one before; negative for a gap."""
    end = first.angle_min + len(first.ranges) * first.angle_increment
    return float(copysign(1.0, first.angle_increment) * ((end - second.angle_min + pi) % _TURN - pi))


def _without_overlap(first: ScanMessage, second: ScanMessage) -> ScanMessage:
    """A segment without the beams that the one before has."""
    shared = round(_overlap(first, second) / abs(second.angle_increment))
    if not _SPARE_BEAMS < shared < len(second.ranges):
        return second
    strengths = None if second.intensities is None else second.intensities[shared:]
    begin = second.angle_min + shared * second.angle_increment
    return second._replace(ranges=second.ranges[shared:], intensities=strengths, angle_min=begin)


class TurnAssembler:
    """Makes one scan of the segments of each turn, every beam at the time of its segment.

    A turn begins with the segment at `first_angle`; one that lacks a segment is given as far as it goes without a gap.
    """

    def __init__(self, survey: ScanSurvey) -> None:
        self._survey = survey
        self._parts: list[ScanMessage] = []

    def add(self, message: ScanMessage) -> Iterator[ScanMessage]:
        """Take a segment; the turns that are complete with it."""
        begins = abs(message.angle_min - self._survey.first_angle) <= _SPARE_BEAMS * abs(message.angle_increment)
        if self._parts and (begins or not _follows(self._parts[-1], message)):
            yield self._turn()
        self._parts.append(message)
        if len(self._parts) >= self._survey.segments:
            yield self._turn()

    def _turn(self) -> ScanMessage:
        parts, self._parts = self._parts, []
        parts = [parts[0], *(_without_overlap(a, b) for a, b in pairwise(parts))]
        first, last = parts[0], parts[-1]
        before = sum(len(part.ranges) for part in parts[:-1])
        step = (last.stamp_ns - first.stamp_ns) / 1e9 / before if before else first.time_increment
        intensities = [part.intensities for part in parts if part.intensities is not None]
        return first._replace(
            ranges=np.concatenate([part.ranges for part in parts]),
            intensities=np.concatenate(intensities) if len(intensities) == len(parts) else None,
            time_increment=step,
            scan_time=self._survey.interval_s or first.scan_time,
            angle_max=last.angle_max,
            range_max=max((part.range_max for part in parts), default=inf),
        )

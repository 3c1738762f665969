"""Trajectories as other tools write them: TUM, EuRoC, KITTI, planar text, CSV with a head; in whatever unit of time.

What a file means is taken from its head (also behind `#`, or `%` as `rostopic echo -p` writes it), from the number of
its columns, and from its values. Where these leave a choice, the reading is refused with the remedy, or made and named
in `warnings`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hsloc.errors import EvaluationError
from hsloc.model import Pose2, Trajectory
from hsloc.trajectory_io.tum import QUATERNION_TOLERANCE, parse_numbers, parse_stamp, read_comments, read_lines
from hsloc.warnings import RunWarning, WarningCode

_UNITS = (("ns", 10**17, 0), ("us", 10**14, 3), ("ms", 10**11, 6))
"""Stamps of our time in these units are larger than the second (those in seconds are some 10^9); digits to ns."""
_LEAST_DISTINCT = 0.9
"""If less than this part of the stamps differ, they were written with too few digits, or several poses share one."""
_FLAT = 0.02
"""Sine of half an angle of roll or pitch: a robot on a floor leans less."""
_SEGMENT = 0.05
"""Metres of the shortest step whose direction is compared with the heading."""


@dataclass(frozen=True, slots=True)
class LoadedTrajectory:
    """A trajectory, and what its user should know about how it was read."""

    trajectory: Trajectory
    warnings: tuple[RunWarning, ...] = ()


class _Columns(NamedTuple):
    """Where the values of a pose are in a row: t, x, y, z (or -1) and the quaternion, or the heading alone.

    `nanoseconds` is the column of a stamp's second part, where `t` has whole seconds, or -1.
    """

    t: int
    position: tuple[int, int, int]
    quaternion: tuple[int, int, int, int] | None = None
    heading: int = -1
    unit: str = ""
    in_degrees: bool = False
    nanoseconds: int = -1


_TUM = _Columns(0, (1, 2, 3), (4, 5, 6, 7))
_EUROC = _Columns(0, (1, 2, 3), (5, 6, 7, 4))
_PLANAR = _Columns(0, (1, 2, -1), heading=3)


def read_trajectory(path: Path | str) -> LoadedTrajectory:
    """Read poses from a text file (also `.gz`): metres, radians or degrees, stamps in s, ms, us or ns.

    8 columns are TUM, 4 are `t x y theta`, 17 are EuRoC, 12 are KITTI (with the stamps in `times.txt` beside it).
    Raises EvaluationError that names the file, the line and the remedy.
    """
    path = Path(path)
    head = _head(path)
    rows: list[list[str]] = []
    numbers: list[int] = []
    for number, line in read_lines(path):
        fields = line.replace(",", " ").replace(";", " ").split()
        if not rows and _is_head(fields):
            head = head or _columns(path, line)
            continue
        rows.append(fields)
        numbers.append(number)
    if not rows:
        raise EvaluationError(f"{path}: holds no pose; a TUM file has lines `t x y z qx qy qz qw`")
    if head is None and len(rows[0]) == 12:
        return _read_kitti(path, rows, numbers)
    warnings: list[RunWarning] = []
    columns = head or _by_count(path, rows[0], numbers[0])
    if head is None and columns is _TUM and _begins_with_w(rows):
        warnings.append(
            RunWarning(
                WarningCode.REFERENCE_READ_AS,
                f"{path}: its quaternions begin with w (the robot would lean otherwise); they are read so",
            )
        )
        columns = _TUM._replace(quaternion=(5, 6, 7, 4))
    stamps, poses = [], []
    unit = _unit(rows, columns)
    for number, fields in zip(numbers, rows, strict=True):
        try:
            stamps.append(_stamp(fields, columns, unit))
            poses.append(_pose(fields, columns))
        except (ValueError, IndexError) as error:
            reason = f"{len(fields)} columns, as many as the first line has are needed"
            raise EvaluationError(f"{path}, line {number}: {reason if type(error) is IndexError else error}") from None
    trajectory = Trajectory(np.array(stamps, dtype=np.int64), np.array(poses, dtype=np.float64).reshape(-1, 3))
    if columns.heading >= 0 and not columns.in_degrees and _is_in_degrees(trajectory.poses, _headings(rows, columns)):
        warnings.append(
            RunWarning(
                WarningCode.REFERENCE_READ_AS, f"{path}: its headings fit the way only as degrees; they are read so"
            )
        )
        trajectory = Trajectory(trajectory.stamps_ns, _from_degrees(trajectory.poses, _headings(rows, columns)))
    if unit:
        warnings.append(RunWarning(WarningCode.REFERENCE_READ_AS, f"{path}: its stamps are read as {unit}"))
    return LoadedTrajectory(trajectory, (*warnings, *_repeated(path, trajectory.stamps_ns)))


def read_tum(path: Path | str) -> Trajectory:
    """The trajectory of a file, as `read_trajectory` reads it."""
    return read_trajectory(path).trajectory


def _head(path: Path) -> _Columns | None:
    """What a comment at the beginning says of the columns."""
    for line in read_comments(path):
        fields = line.lstrip("#").replace(",", " ").replace(";", " ").split()
        if _is_head(fields):
            found = _columns(path, line.lstrip("#"))
            if found is not None:
                return found
    return None


_MARKS = "\"'[]()%"
"""What stands around the names of a head."""


def _is_head(fields: list[str]) -> bool:
    names = [field.strip(_MARKS).lower() for field in fields if field.strip(_MARKS)]
    return bool(names) and all(name[:1].isalpha() and name not in ("nan", "inf", "infinity") for name in names)


def _columns(path: Path, line: str) -> _Columns | None:
    """The columns that a head names; None where it names no pose."""
    line = line.lstrip("% ")
    separator = "," if "," in line else ";" if ";" in line else None
    names = [name.strip().strip("\"'").lower() for name in (line.split(separator) if separator else line.split())]
    units = ("[s]", "[m]", "[]", "[ns]", "[us]", "[ms]", "(s)", "(m)")
    names = names if separator else [name for name in names if name not in units]

    def find(*words: str) -> int:
        for index, name in enumerate(names):
            bare = name.split("[")[0].split("(")[0].strip().replace(".", "_")
            if bare in words or any(bare.endswith(f"_{word}") for word in words if len(word) <= 2 or "_" in word):
                return index
        return -1

    t = find("header_stamp", "stamp_sec", "stamp_secs")
    if t < 0:
        t = find("t", "time", "timestamp", "stamp", "#timestamp", "sec", "secs", "seconds")
    nanoseconds = find(
        "nanosec", "nanosecs", "nsec", "nsecs", "nanoseconds", "stamp_nanosec", "stamp_nsec", "stamp_nsecs"
    )
    x, y, z = (find(f"t{axis}", f"p{axis}", f"p_{axis}", f"pos_{axis}", f"position_{axis}", axis) for axis in "xyz")
    q = [find(f"q{axis}", f"q_{axis}", f"q_rs_{axis}", f"orientation_{axis}", f"rot_{axis}") for axis in "xyzw"]
    if t < 0:
        t = 0
    if min(x, y) < 0:
        return None
    unit = next((unit for unit in ("ns", "us", "ms") if f"[{unit}]" in names[t] or names[t].endswith(f"_{unit}")), "")
    if min(q) >= 0:
        quaternion = (q[0], q[1], q[2], q[3])
        return _Columns(t, (x, y, z), quaternion, unit=unit, nanoseconds=nanoseconds)
    angles = ("theta", "yaw", "heading", "phi")
    heading = find(*angles, *(f"{angle}_{unit}" for angle in angles for unit in ("rad", "deg", "radians", "degrees")))
    if heading >= 0:
        in_degrees = "deg" in names[heading]
        return _Columns(t, (x, y, z), heading=heading, unit=unit, in_degrees=in_degrees, nanoseconds=nanoseconds)
    return None


def _by_count(path: Path, fields: list[str], number: int) -> _Columns:
    found = {4: _PLANAR, 8: _TUM, 17: _EUROC}.get(len(fields))
    if found is None:
        raise EvaluationError(
            f"{path}, line {number}: {len(fields)} columns; a TUM line has 8: t x y z qx qy qz qw, and a first line "
            "with the columns' names says what any other has"
        )
    return found


def _begins_with_w(rows: list[list[str]]) -> bool:
    """Whether quaternions of eight columns lean unless they begin with w."""
    try:
        values = np.array([[float(field) for field in row[4:8]] for row in rows if len(row) == 8])
    except ValueError:
        return False
    if not len(values) or not np.isfinite(values).all():
        return False
    first, second, third, last = np.abs(values).max(axis=0)
    plain = max(first, second) <= _FLAT
    return bool(not plain and first > _FLAT and max(second, third) <= _FLAT and (first > 0.5 or last > 0.5))


def _unit(rows: list[list[str]], columns: _Columns) -> str:
    """The unit of the stamps by their size; empty for seconds."""
    if columns.unit:
        return columns.unit
    try:
        largest = max(abs(float(row[columns.t])) for row in (rows[0], rows[-1]))
    except (ValueError, IndexError, OverflowError):
        return ""
    return next((unit for unit, least, _ in _UNITS if largest >= least), "")


def _stamp(fields: list[str], columns: _Columns, unit: str) -> int:
    text = fields[columns.t]
    if columns.nanoseconds >= 0:
        parts = text, fields[columns.nanoseconds]
        if not all(part.isdecimal() and len(part) <= 10 for part in parts):
            raise ValueError(f"{' '.join(parts)!r} are no seconds and nanoseconds of a stamp")
        return int(parts[0]) * 1_000_000_000 + int(parts[1])
    digits = {name: count for name, _, count in _UNITS}
    if not unit:
        try:
            return parse_stamp(text)
        except ValueError:
            raise ValueError(f"{text!r} is not a stamp in seconds") from None
    if text.lstrip("-").isdigit() and len(text) <= 20:
        return _in_64_bits(int(text) * 10 ** digits[unit], text, unit)
    try:
        return _in_64_bits(round(float(text) * 10 ** digits[unit]), text, unit)
    except (ValueError, OverflowError):
        raise ValueError(f"{text!r} is not a stamp in {unit}") from None


def _in_64_bits(stamp: int, text: str, unit: str) -> int:
    if abs(stamp) >= 2**63:
        raise ValueError(f"{text!r} is not a stamp in {unit}")
    return stamp


def _pose(fields: list[str], columns: _Columns) -> tuple[float, float, float]:
    x, y = parse_numbers([fields[index] for index in columns.position[:2]])
    if columns.quaternion is None:
        (theta,) = parse_numbers([fields[columns.heading]])
        return x, y, math.remainder(math.radians(theta) if columns.in_degrees else theta, math.tau)
    quaternion = parse_numbers([fields[index] for index in columns.quaternion])
    norm = math.hypot(*quaternion)
    if abs(norm - 1.0) > QUATERNION_TOLERANCE:
        raise ValueError(f"the quaternion has length {norm:.3g} instead of 1; its order is qx qy qz qw")
    return x, y, Pose2.from_quaternion(x, y, *quaternion).theta


def _headings(rows: list[list[str]], columns: _Columns) -> list[float]:
    return [float(row[columns.heading]) for row in rows]


def _is_in_degrees(poses: np.ndarray, raw: list[float]) -> bool:
    """Whether headings agree with the direction of motion, forwards or backwards, as degrees and not as radians."""
    if max(map(abs, raw)) <= math.tau + 0.1:
        return False
    kept = [0]
    for k in range(1, len(poses)):
        if math.hypot(*(poses[k, :2] - poses[kept[-1], :2])) >= _SEGMENT:
            kept.append(k)
    if len(kept) < 10:
        return False
    steps = np.diff(poses[kept, :2], axis=0)
    direction = np.arctan2(steps[:, 1], steps[:, 0])
    theta = np.array(raw)[kept[:-1]]
    as_radians, as_degrees = (float(np.mean(np.cos(direction - angle) ** 2)) for angle in (theta, np.radians(theta)))
    return as_degrees > as_radians + 0.2


def _from_degrees(poses: np.ndarray, raw: list[float]) -> np.ndarray:
    turned = poses.copy()
    turned[:, 2] = [math.remainder(math.radians(angle), math.tau) for angle in raw]
    return turned


def _repeated(path: Path, stamps: np.ndarray) -> list[RunWarning]:
    distinct = len(np.unique(stamps))
    if len(stamps) < 2 or distinct >= _LEAST_DISTINCT * len(stamps):
        return []
    warning = RunWarning(
        WarningCode.REFERENCE_STAMPS_REPEAT,
        f"{path}: {len(stamps)} poses have only {distinct} different stamps: they were written with too few digits, so "
        "that figures compare poses of different times",
        "write stamps with at least three decimals",
    )
    return [warning]


def _read_kitti(path: Path, rows: list[list[str]], numbers: list[int]) -> LoadedTrajectory:
    """KITTI's rows of a 3 x 4 matrix, the stamps in `times.txt` or `<name>_times.txt` beside them.

    KITTI's cameras look along z; poses in that frame turn about y, those of a robot's frame about z.
    """
    beside = [path.with_name(f"{path.stem}_times.txt"), path.with_name("times.txt")]
    times = next((each for each in beside if each.is_file()), None)
    if times is None:
        raise EvaluationError(
            f"{path}: holds KITTI poses, which have no stamps; put one stamp a line (s) into {beside[0].name} beside it"
        )
    try:
        stamps = np.array([parse_stamp(line.split()[0]) for _, line in read_lines(times)], dtype=np.int64)
    except ValueError as error:
        raise EvaluationError(f"{times}: {error} is not a stamp in seconds") from None
    if len(stamps) != len(rows):
        raise EvaluationError(f"{times}: holds {len(stamps)} stamps for the {len(rows)} poses of {path}")
    matrices = []
    for number, fields in zip(numbers, rows, strict=True):
        try:
            matrices.append(parse_numbers(fields))
            if len(fields) != 12:
                raise ValueError(f"{len(fields)} columns; a KITTI pose has 12")
        except ValueError as error:
            raise EvaluationError(f"{path}, line {number}: {error}") from None
    m = np.array(matrices).reshape(-1, 3, 4)
    if np.abs(m[:, 2, 2]).min() > np.abs(m[:, 1, 1]).min():
        poses = np.column_stack((m[:, 0, 3], m[:, 1, 3], np.arctan2(m[:, 1, 0], m[:, 0, 0])))
        return LoadedTrajectory(Trajectory(stamps, poses), tuple(_repeated(path, stamps)))
    poses = np.column_stack((m[:, 2, 3], -m[:, 0, 3], np.arctan2(-m[:, 0, 2], m[:, 2, 2])))
    text = f"{path}: its poses are of a camera's frame (z ahead); x is taken from z, and y from -x"
    return LoadedTrajectory(
        Trajectory(stamps, poses), (RunWarning(WarningCode.REFERENCE_READ_AS, text), *_repeated(path, stamps))
    )

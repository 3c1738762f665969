"""Trajectories as TUM files: `t x y z qx qy qz qw`, one pose a line, the format that evo reads.

Stamps go from text to integer nanoseconds and back without passing through float64, which resolves only some
240 ns at today's epoch.
"""

from __future__ import annotations

import gzip
import math
import zlib
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hsloc.atomic_write import write_atomically
from hsloc.errors import EvaluationError
from hsloc.model import Pose2, Trajectory

if TYPE_CHECKING:
    from collections.abc import Iterator

NS_PER_S = 1_000_000_000
MAX_NS = 2**63 - 1
_BLOCK = 4096
QUATERNION_TOLERANCE = 0.01
"""How far a quaternion's norm may be from 1: files with four decimals are common, all-zero ones are broken."""


def format_stamp(stamp_ns: int) -> str:
    """Integer nanoseconds as decimal seconds with 9 decimals: 1500000000 -> "1.500000000"."""
    seconds, rest = divmod(abs(stamp_ns), NS_PER_S)
    return f"{'-' if stamp_ns < 0 else ''}{seconds}.{rest:09d}"


def parse_stamp(text: str) -> int:
    """Decimal seconds as integer nanoseconds, exactly; also "1.5e+09"; digits after the ninth are rounded.

    Raises ValueError where the text is no finite number, or one beyond 64 bits.
    """
    whole, _, fraction = text.partition(".")
    if whole.isascii() and whole.isdigit() and len(fraction) <= 9 and (not fraction or fraction.isdigit()):
        stamp_ns = int(whole) * NS_PER_S + int(fraction.ljust(9, "0"))
    else:
        try:
            # The exponent is checked before the number is written out: 1e999999999 would fill the memory.
            value = Decimal(text)
            if not text.isascii() or not value.is_finite() or value.adjusted() > 12:
                raise ValueError(text)
            stamp_ns = int((value * NS_PER_S).to_integral_value())
        except InvalidOperation:
            raise ValueError(text) from None
    if abs(stamp_ns) > MAX_NS:
        raise ValueError(text)
    return stamp_ns


def format_tum(trajectory: Trajectory) -> str:
    """A trajectory as the text of a TUM file: single spaces, no header, a picometre and a picoradian exact."""
    return "".join(_blocks(trajectory))


def _blocks(trajectory: Trajectory) -> Iterator[str]:
    """The text in blocks of a few thousand lines: an hour's poses are not all in memory as text."""
    for at in range(0, len(trajectory), _BLOCK):
        yield _lines(Trajectory(trajectory.stamps_ns[at : at + _BLOCK], trajectory.poses[at : at + _BLOCK]))


def _lines(trajectory: Trajectory) -> str:
    half = trajectory.poses[:, 2] / 2.0
    # Adding 0.0 turns -0.0 into 0.0: the same pose always gives the same text.
    columns = np.round(np.column_stack((trajectory.poses[:, :2], np.sin(half), np.cos(half))), 12) + 0.0
    stamps = trajectory.stamps_ns.tolist()
    return "".join(
        f"{format_stamp(stamp)} {x:.12f} {y:.12f} 0 0 0 {qz:.12f} {qw:.12f}\n"
        for stamp, (x, y, qz, qw) in zip(stamps, columns.tolist(), strict=True)
    )


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write a trajectory as a TUM file, whole or not at all; raises `OutputError`."""
    write_atomically(Path(path), lambda stream: stream.writelines(text.encode() for text in _blocks(trajectory)))


def read_tum(path: str | Path) -> Trajectory:
    """Read a TUM file, or the planar form `t x y theta` (metres, radians); `.gz` is unpacked.

    Comments, blank lines, tabs, several spaces and commas do not matter, nor does a first line of column names; the
    order of the file is kept.
    Raises `EvaluationError` that names the file and the line.
    """
    path = Path(path)
    stamps: list[int] = []
    poses: list[tuple[float, float, float]] = []
    for number, line in read_lines(path):
        fields = line.replace(",", " ").split()
        if not stamps and number == 1 and _names_columns(path, fields):
            continue
        try:
            stamp_ns, pose = _parse_pose(fields)
        except ValueError as error:
            raise EvaluationError(f"{path}, line {number}: {error}") from None
        stamps.append(stamp_ns)
        poses.append(pose)
    if not stamps:
        raise EvaluationError(f"{path}: holds no pose; a TUM file has lines `t x y z qx qy qz qw`")
    return Trajectory(np.array(stamps, dtype=np.int64), np.array(poses, dtype=np.float64).reshape(-1, 3))


def _names_columns(path: Path, fields: list[str]) -> bool:
    """Whether a line is the head of a CSV. Raises `EvaluationError` where it has the quaternion begin with w."""
    names = [field.strip("\"'").lower() for field in fields]
    if not all(name[:1].isalpha() and name not in ("nan", "inf", "infinity") for name in names):
        return False
    w, x = ([row for row, name in enumerate(names) if name in (f"q{axis}", f"q_{axis}", axis)] for axis in "wx")
    if w and x and w[0] < x[-1] and len(names) == 8:
        raise EvaluationError(f"{path}: its quaternions begin with w; the order must be t x y z qx qy qz qw")
    return True


def read_lines(path: Path) -> Iterator[tuple[int, str]]:
    """The lines of a text file (or .gz) that hold something, with their numbers; raises `EvaluationError`."""
    try:
        raw = path.read_bytes()
        text = (gzip.decompress(raw) if path.suffix == ".gz" else raw).decode("utf-8-sig")
    except FileNotFoundError:
        raise EvaluationError(f"{path}: no such file") from None
    except UnicodeDecodeError:
        raise EvaluationError(f"{path}: not a text file; expected lines of numbers") from None
    except (OSError, EOFError, zlib.error) as error:
        raise EvaluationError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from error
    for number, line in enumerate(text.splitlines(), start=1):
        stripped = line.strip()
        if stripped and not stripped.startswith("#"):
            yield number, stripped


def parse_numbers(fields: list[str]) -> list[float]:
    """Fields as finite numbers; raises ValueError that says which field is none."""
    numbers = []
    for field in fields:
        try:
            number = float(field)
        except ValueError:
            raise ValueError(f"{field!r} is not a number") from None
        if not math.isfinite(number):
            raise ValueError(f"{field!r} is not a finite number")
        numbers.append(number)
    return numbers


def parse_stamp_field(field: str) -> int:
    """Like `parse_stamp`, with a sentence in the ValueError."""
    try:
        return parse_stamp(field)
    except ValueError:
        raise ValueError(f"{field!r} is not a stamp in seconds") from None


def _parse_pose(fields: list[str]) -> tuple[int, tuple[float, float, float]]:
    if len(fields) not in (4, 8):
        raise ValueError(f"{len(fields)} columns; a TUM line has 8: t x y z qx qy qz qw")
    stamp_ns = parse_stamp_field(fields[0])
    numbers = parse_numbers(fields[1:])
    if len(fields) == 4:
        x, y, theta = numbers
        return stamp_ns, (x, y, math.remainder(theta, math.tau))
    x, y, _, qx, qy, qz, qw = numbers
    norm = math.hypot(qx, qy, qz, qw)
    if abs(norm - 1.0) > QUATERNION_TOLERANCE:
        raise ValueError(f"the quaternion has length {norm:.3g} instead of 1; its order is qx qy qz qw")
    return stamp_ns, (x, y, Pose2.from_quaternion(x, y, qx, qy, qz, qw).theta)

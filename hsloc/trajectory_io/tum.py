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
from hsloc.errors import EvaluationError, no_such, not_read
from hsloc.model import Trajectory

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

NS_PER_S = 1_000_000_000
MAX_NS = 2**63 - 1
_BLOCK = 4096
QUATERNION_TOLERANCE = 0.01
"""How far a quaternion's norm may be from 1: files with four decimals are common, all-zero ones are broken."""


def format_stamp(stamp_ns: int) -> str:
    """Integer nanoseconds as decimal seconds with 9 decimals: 1500000000 -> "1.500000000"."""
    seconds, rest = divmod(abs(stamp_ns), NS_PER_S)
    return f"{'-' if stamp_ns < 0 else ''}{seconds}.{rest:09d}"


def format_stamps(stamps_ns: NDArray[np.int64]) -> list[str]:
    """`format_stamp` of each of n stamps: in half the time, as long as none is before 1970."""
    if len(stamps_ns) and stamps_ns.min() < 0:
        return list(map(format_stamp, stamps_ns.tolist()))
    parts = np.divmod(stamps_ns, NS_PER_S)
    return list(map("%d.%09d".__mod__, zip(*(part.tolist() for part in parts), strict=True)))


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
    form = "%s %.12f %.12f 0 0 0 %.12f %.12f\n"
    rows = zip(format_stamps(trajectory.stamps_ns), *columns.T.tolist(), strict=True)
    return "".join(map(form.__mod__, rows))


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write a trajectory as a TUM file, whole or not at all; raises `OutputError`."""
    write_atomically(Path(path), lambda stream: stream.writelines(text.encode() for text in _blocks(trajectory)))


def read_lines(path: Path) -> Iterator[tuple[int, str]]:
    """The lines of a text file (or .gz) that hold something, with their numbers; raises `EvaluationError`."""
    for number, line in enumerate(_text(path).splitlines(), start=1):
        stripped = line.strip()
        if stripped and not stripped.startswith("#"):
            yield number, stripped


def read_comments(path: Path) -> Iterator[str]:
    """The comments (`#`) before the first line that holds something; raises `EvaluationError`."""
    for line in _text(path).splitlines():
        stripped = line.strip()
        if stripped and not stripped.startswith("#"):
            return
        if stripped:
            yield stripped


def _text(path: Path) -> str:
    try:
        raw = path.read_bytes()
        text = (gzip.decompress(raw) if path.suffix == ".gz" else raw).decode("utf-8-sig")
    except FileNotFoundError:
        raise EvaluationError(no_such(path)) from None
    except UnicodeDecodeError:
        raise EvaluationError(f"{path}: not a text file; expected lines of numbers") from None
    except (OSError, EOFError, zlib.error) as error:
        if isinstance(error, OSError) and error.strerror:
            raise EvaluationError(not_read(path, error)) from error
        raise EvaluationError(f"{path}: cannot be read ({error}); copy it again, or unpack it first") from error
    return text


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

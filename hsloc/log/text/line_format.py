"""What a format of text logs must provide, and the fields that CARMEN and Wean logs share."""

from __future__ import annotations

from decimal import Decimal, InvalidOperation
from typing import TYPE_CHECKING, NamedTuple, Protocol

from hsloc.model import Odometry, Pose2, Scan, Truth

if TYPE_CHECKING:
    from collections.abc import Sequence


_DECIMALS = 9
"""Decimals of a nanosecond."""


class Line(NamedTuple):
    """Content of a line; ranges as written (metres)."""

    odometry: Odometry | None = None
    scan: Scan | None = None
    truth: Truth | None = None


class LineFormat(Protocol):
    """A format that says one thing a line, its first word telling what.

    `states_mounting` are the keywords whose lines say where the laser stands, `may_state_mounting` those that do if
    all lines say the same, `laser_odometry` whether the odometry of laser lines counts in place of that of odometry
    lines.
    """

    name: str
    keywords: frozenset[str]
    states_mounting: frozenset[str]
    may_state_mounting: frozenset[str]
    laser_odometry: bool

    def parse(self, words: Sequence[str]) -> Line:
        """A line that starts with a keyword. Raises ValueError or IndexError where it is not what it says."""
        ...


def stamp_ns(seconds: str) -> int:
    """Decimal seconds as integer nanoseconds, exactly. Raises ValueError."""
    whole, _, decimals = seconds.partition(".")
    is_plain = 0 < len(whole) <= 10 and len(decimals) <= _DECIMALS and (whole + decimals).isdecimal()
    if is_plain and int(whole) < 2**31:  # As nearly all stamps are written.
        return int(whole) * 1_000_000_000 + int(decimals.ljust(_DECIMALS, "0"))
    try:
        value = Decimal(seconds)
        if not value.is_finite() or abs(value) >= 2**31:
            raise ValueError(f"stamp {seconds}")
        return int((value * 1_000_000_000).to_integral_value())
    except InvalidOperation as error:
        raise ValueError(f"stamp {seconds}") from error


def pose(words: Sequence[str], scale: float = 1.0) -> Pose2:
    """x, y, theta; `scale` makes metres of the first two. Raises ValueError for what is not finite."""
    x, y, theta = map(float, words)
    found = Pose2(x * scale, y * scale, theta)
    if not found.is_finite():
        raise ValueError("a pose is not finite")
    return found


def rounded(mounting: Pose2) -> Pose2:
    """A difference of two poses that stand in a log with six decimals, without the noise of that size."""
    return Pose2(round(mounting.x, 4) + 0.0, round(mounting.y, 4) + 0.0, round(mounting.theta, 5) + 0.0)

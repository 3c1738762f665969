"""The gates of localiser and mapper: which scans are matched, and which matches are accepted.

The motion gate opens after the robot has moved ([P] V; AMCL's update_min_d and update_min_a). The match gate measures a
match by its fitness and by the usual fitness, an exponentially weighted mean over the matches accepted before, and
counts refusals in a row. Localiser and mapper share it; their limits differ.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hsloc.model.pose2 import Pose2

_LEAST_TRUST = 0.05
"""Part of the information of the worst match that is accepted."""
_NEARLY_USUAL = 0.95
"""Ratio to the usual fitness below which a match may lie beside the right place: half a metre along a corridor, where
wheels slipped, most walls still fit."""
_AS_USUAL = 0.98
"""Ratio to the usual fitness that a match in a wide window reaches there."""
_REGAINED = 0.05
"""Least gain in fitness of a match in a wide window over one that is not as fit as usual: fitness at the right place
scatters by 0.02 from scan to scan, so that two of them differ by as much once in thirteen times."""
_STILL_M, _STILL_RAD = 1e-3, 1e-3
"""Motion (m, rad) from message to message up to which the odometry stands still: less than wheels that turn."""
_NO_WAY_M, _NO_TURN_RAD = 0.01, 0.005
"""Motion (m, rad) from scan to scan that counts as none: a tenth of what makes a keyscan."""
_FEW_SCANS = 2
"""Scans in a row in which the odometry counts nothing, from which on it does so for longer than stamps jitter."""
_AS_LAST = 0.97
"""Ratio to the fitness of the last match, or of one nearby, that scans at rest reach, unless people pass."""
_NEAR_LAST = 0.9
"""The same of scans a few centimetres from it: a robot that is 0.1 m elsewhere fits 0.7 to 0.9 times as well, where the
decay length of a score is 0.1 m."""
_MOST_LEFT_OUT = 7
"""Scans that are left out between two that are searched for, at most, where these found nothing: people pass by."""
_WEIGHT_OF_NEW = 0.05
"""Weight of a new match in the usual fitness: its memory is about 20 matches."""


@dataclass(frozen=True, slots=True)
class MotionGate:
    """Open where a motion is long enough or turns far enough."""

    min_distance: float
    """Least translation that opens the gate [m], 0 or more."""
    min_angle: float
    """Least rotation that opens the gate [rad], 0 or more."""

    def is_open(self, motion: Pose2, unsure: tuple[float, float] = (0.0, 0.0)) -> bool:
        """Whether a motion since the last scan that was used may reach one of the limits.

        It may be longer than stated by `unsure` (m, rad).
        """
        way, turn = unsure
        return hypot(motion.x, motion.y) + way >= self.min_distance or abs(motion.theta) + turn >= self.min_angle


class StandingOdometry:
    """For how many scans in a row the odometry has counted no way, and no turn.

    Stamps that jitter pair scans of a robot that drives with odometry that is a few centimetres off: one scan in which
    nothing is counted says little.
    """

    def __init__(self) -> None:
        self._last: Pose2 | None = None
        self._way = self._turn = 0

    def follow(self, T_odom_base: Pose2) -> None:
        """The odometry at the next scan."""
        if self._last is not None:
            step = self._last.between(T_odom_base)
            self._way = self._way + 1 if hypot(step.x, step.y) < _NO_WAY_M else 0
            self._turn = self._turn + 1 if abs(step.theta) < _NO_TURN_RAD else 0
        self._last = T_odom_base

    @property
    def counts_no_way(self) -> bool:
        """Whether it has counted no way for some scans."""
        return self._way >= _FEW_SCANS

    @property
    def counts_no_turn(self) -> bool:
        """Whether it has counted no turn for some scans."""
        return self._turn >= _FEW_SCANS


class RestGate:
    """Open where a scan fits worse than the last match although the odometry stands still: the robot may be moved.

    State: the last odometry, and how often the scans of this rest were searched for in vain.
    """

    def __init__(self) -> None:
        self._before: Pose2 | None = None
        self._T_odom_base: Pose2 | None = None
        self._fitness = 0.0
        self._left_out = self._in_vain = 0

    def follow(self, T_odom_base: Pose2) -> None:
        """The next odometry message."""
        self._before, self._T_odom_base = self._T_odom_base, T_odom_base

    @property
    def stands(self) -> bool:
        """Whether the odometry stands still, by its last two messages. Few are asked for of all that come."""
        if self._before is None or self._T_odom_base is None:
            return False
        step = self._before.between(self._T_odom_base)
        return hypot(step.x, step.y) < _STILL_M and abs(step.theta) < _STILL_RAD

    def is_open(self, fitness: float) -> bool:
        """Whether a scan of this fitness where the odometry says, at the last match or near it, is worth a search."""
        if fitness >= (_AS_LAST if self.stands else _NEAR_LAST) * self._fitness:
            return False
        self._left_out += 1
        return self._left_out > min(self._in_vain // 2, _MOST_LEFT_OUT)

    def searched(self, is_moved: bool) -> None:
        """A scan was searched for."""
        self._left_out = 0
        self._in_vain = 0 if is_moved else self._in_vain + 1

    def matched(self, fitness: float) -> None:
        """A match was accepted."""
        self._fitness, self._left_out, self._in_vain = fitness, 0, 0


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchLimits:
    """The limits of a match gate."""

    min_fitness: float
    """Least fitness of an accepted match, in [0, 1]."""
    min_fitness_ratio: float
    """Least ratio of an accepted match's fitness to the usual fitness, in [0, 1]."""
    recovery_fitness_ratio: float
    """Least ratio to the usual fitness of a match that was found in a wide window after a refusal, in [0, 1]."""
    recovery_gain: float = 0.1
    """Least gain in fitness of a match in a wide window over the refused one: similar places compete there."""


class MatchGate:
    """State: the usual fitness, and the number of refusals in a row."""

    def __init__(self, limits: MatchLimits) -> None:
        self._limits = limits
        self.usual: float | None = None
        self.refusals = 0

    @property
    def is_fresh(self) -> bool:
        """Whether no match was accepted or refused yet."""
        return self.usual is None and self.refusals == 0

    def refusal(self, fitness: float) -> str:
        """Why a match of this fitness is refused; empty if it is accepted."""
        limits = self._limits
        if fitness < limits.min_fitness:
            return f"fitness {fitness:.2f} below {limits.min_fitness:.2f}"
        if self.usual is not None and fitness < limits.min_fitness_ratio * self.usual:
            return f"fitness {fitness:.2f} far below the usual {self.usual:.2f}"
        return ""

    def is_recovered(self, refused: float, wide: float) -> bool:
        """Whether a match of fitness `wide` in a wide window takes the place of one of fitness `refused`.

        While no fitness is usual yet, the minimum fitness is used instead.
        """
        limits = self._limits
        usual = limits.min_fitness if self.usual is None else self.usual
        return wide >= max(refused + limits.recovery_gain, limits.recovery_fitness_ratio * usual)

    def fits_as_usual(self, fitness: float) -> bool:
        """Whether a match of this fitness is as fit as usual, or nearly so; true while nothing is usual yet."""
        return self.usual is None or fitness >= _NEARLY_USUAL * self.usual

    def is_regained(self, worse: float, wide: float) -> bool:
        """Whether a match of fitness `wide` in a wide window takes the place of one that was not as fit as usual."""
        return self.usual is not None and wide >= max(worse + _REGAINED, _AS_USUAL * self.usual)

    def gives_way(self, narrow: float, wide: float) -> bool:
        """Whether a match of fitness `narrow` gives way to one of fitness `wide` in a wide window, refused or not."""
        return self.is_recovered(narrow, wide) if self.refusal(narrow) else self.is_regained(narrow, wide)

    def is_elsewhere(self, here: float, elsewhere: float) -> bool:
        """Whether a match of fitness `elsewhere` is as fit as usual, and one at rest of fitness `here` is not."""
        return self.fits_as_usual(elsewhere) and here <= _AS_LAST * elsewhere

    def trust(self, fitness: float) -> float:
        """Part of the information of an accepted match that counts: all at the usual fitness, little at the least.

        A match that fits worse than usual is often a local optimum beside the right one, where wheels slip.
        """
        if self.usual is None:
            return 1.0
        least = self._limits.min_fitness_ratio * self.usual
        return min(max((fitness - least) / max(self.usual - least, 1e-9), _LEAST_TRUST), 1.0)

    def accept(self, fitness: float) -> None:
        """Count an accepted match."""
        self.refusals = 0
        self.usual = fitness if self.usual is None else self.usual + _WEIGHT_OF_NEW * (fitness - self.usual)

    def accept_hidden(self) -> None:
        """Count a match in which something hid the walls: it is no refusal, and no measure of what is usual."""
        self.refusals = 0

    def refuse(self) -> int:
        """Count a refused match; the number of refusals in a row."""
        self.refusals += 1
        return self.refusals

    def restart(self, fitness: float | None) -> None:
        """Begin from a pose that was found with a known fitness."""
        self.refusals = 0
        self.usual = fitness

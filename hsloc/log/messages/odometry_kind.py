"""A kind of odometry: one type of message, how it is read, when it is chosen, and what it says of the motion.

To read another type as odometry, write an `OdometryKind` in `odometry_kinds` and add it to the table there; its fields
belong into `definitions.FIELDS`. Topic selection, warnings, decoders and events follow from the table.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

    from hsloc.log.summary import ReadOptions
    from hsloc.log.transforms import Transform3

    Motion3 = tuple[float, float, float]
    """A motion of the base along an arc: forwards and to the left (m), and the rotation (rad)."""
    Mounting3 = Callable[[str], Transform3]
    """T_base_frame of a frame's name; the identity where no transform leads there."""


class Rank(IntEnum):
    """Which kind is read where a log has several and the user names none: the lowest."""

    REQUESTED = 0
    """What an option asks for."""
    ODOMETRY = 1
    POSE = 2
    TRANSFORMS = 3
    """Odometry as a transform, which is no topic of its own."""
    VELOCITY = 4
    HEADING = 5
    """A heading without a position."""
    NEVER = 6
    """Read only if it is named."""


class Motion(ABC):
    """What the messages of one topic say of the motion, taken one after the other."""

    def concerns(self, message: Any) -> bool:
        """Whether a message is about the motion at all."""
        return True

    @abstractmethod
    def step(self, message: Any, seconds: float) -> Motion3 | None:
        """The motion since the message before, `seconds` ago (0 where that is not known); None if it is not usable."""


@dataclass(frozen=True, slots=True)
class OdometryKind:
    """One type of message that odometry is read from.

    `from_object` makes a tuple with `stamp_ns`, `frame_id` and `child_frame_id` of a message object. `motion` makes
    what sums up the messages; without one the messages are poses. `rank_of` says of a topic's name when it is read
    without being named. `says` is the warning's text where a log has nothing better, with the topic in place of `{}`.
    `missing` names the option without which the kind cannot be read and is not ranked, or nothing. Without
    `has_position` the messages give the heading alone.
    """

    typename: str
    from_object: Callable[[Any], Any]
    rank_of: Callable[[str], Rank]
    motion: Callable[[ReadOptions, Mounting3], Motion] | None = None
    says: str = ""
    missing: Callable[[ReadOptions], str] = lambda _: ""
    has_position: bool = True

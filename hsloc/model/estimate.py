"""An estimate after an event, and the columns of all estimates of a run."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from hsloc.model.certificate import Certificate
    from hsloc.model.pose2 import Pose2


class Status(StrEnum):
    """How an estimate came about."""

    PREDICTED = "predicted"
    """From odometry since the last match: an odometry message, or a scan the motion gate passed over."""
    MATCHED = "matched"
    """The scan was matched and the match was accepted."""
    REJECTED = "rejected"
    """The scan was matched, the match was refused; the prediction stands."""
    NO_RETURNS = "no_returns"
    """The scan has too few valid returns; the prediction stands."""
    SEARCHING = "searching"
    """The pose is unknown (at the start, or lost): the whole map is being searched. The pose is a guess."""
    RELOCALISED = "relocalised"
    """The search ended: one hypothesis won."""

    @property
    def is_localised(self) -> bool:
        """Whether the pose that comes with this status may be believed."""
        return self is not Status.SEARCHING


class State(StrEnum):
    """What is known of a pose, in hindsight: the scans after it count as well."""

    LOCALISED = "localised"
    """The pose is right with high probability, and known to within a decimetre or two."""
    PREDICTED = "predicted"
    """The track is right with high probability, but no scan holds the pose well enough here."""
    AMBIGUOUS = "ambiguous"
    """Several places of the map fit about as well."""
    OFF_MAP = "off_map"
    """No place of the map fits: the robot is not on it, or it has changed here."""
    LOST = "lost"
    """The pose is being searched for, or the track is probably wrong."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """What a scan says for or against the track that it continues.

    `distance` is the path length since the scan before (m). `explained` is the mean score of the beams that no object
    in free space cut short, `short`, `through` and `unmapped` are the shares of all beams that end before a wall,
    behind one, or where the map has nothing. `rival` is the fitness of the fittest other place on the map divided by
    that of this one, NaN where the places were not compared; `other` is that place, where one was found. `mirrored` is
    that of the fittest place for the mirrored scans, NaN where it is not known. `lasting` is the part of `short` that
    ends at what still stands there after the robot has moved on, which people do not; NaN where it is not known.
    """

    distance: float
    explained: float = float("nan")
    short: float = 0.0
    through: float = 0.0
    unmapped: float = 0.0
    rival: float = float("nan")
    other: Pose2 | None = None
    mirrored: float = float("nan")
    lasting: float = float("nan")


class LikelyPlace(NamedTuple):
    """A place where the robot may be, T_map_base, and the probability that it is the right one."""

    pose: Pose2
    probability: float


@dataclass(frozen=True, slots=True)
class Ambiguity:
    """A stretch of a run, from stamp to stamp, in which several places of the map fit about as well.

    `places` are the most probable ones, the first the most, at the stamp `stamp_ns`; there may be more.
    """

    begin_ns: int
    end_ns: int
    stamp_ns: int
    places: tuple[LikelyPlace, ...]


class Revised(NamedTuple):
    """What is known of earlier poses: T_map_odom from an odometry message (counted from 0) on, until the next.

    `covariance` (3, 3) is that of T_map_base there, where a scan was matched; None where an end of those holds.
    """

    odometry_count: int
    T_map_odom: Pose2
    covariance: NDArray[np.float64] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """The pose of the base in the map at a stamp, and how it came about.

    `covariance` is 3 x 3 over (x, y, theta) in the map frame (m^2, m rad, rad^2). `fitness` is in (0, 1] where
    a scan was matched, else None. `evaluations` counts the fitness evaluations spent. `reason` is a text on
    why a scan was skipped or refused. `revision` corrects earlier estimates.
    """

    stamp_ns: int
    T_map_base: Pose2
    status: Status
    covariance: NDArray[np.float64] | None = None
    fitness: float | None = None
    evaluations: int = 0
    reason: str = ""
    revision: tuple[Revised, ...] = ()
    state: State | None = None
    """What is known at once; None where the scans to come decide."""
    evidence: Evidence | None = None
    """What the scan says about the track, of an estimator that weighs it."""
    certificate: Certificate | None = None
    """What was proven about the match, where it was asked for."""
    noise_scale: float = 1.0
    """Variance of the odometry by the assumed one, as the scans so far show it."""
    fits_as_usual: bool = True
    """Whether the match was as fit as usual, or nearly so."""
    places: tuple[LikelyPlace, ...] = ()
    """While several places fit: the most probable ones."""


@dataclass(frozen=True, slots=True, eq=False)
class ScanDiagnostics:
    """One row for each scan of a run, as columns of length n.

    `status` holds values of `Status`; `fitness` is NaN where nothing was matched; `sigma` (n, 3) are the standard
    deviations of x, y (m) and theta (rad), and `covariance` (n, 3, 3) is over them in the map frame, NaN where unknown;
    `evaluations` counts fitness evaluations; `reason` is empty where there is no reason to state.
    """

    stamps_ns: NDArray[np.int64]
    status: tuple[str, ...]
    fitness: NDArray[np.float64]
    sigma: NDArray[np.float64]
    evaluations: NDArray[np.int64]
    reason: tuple[str, ...]
    covariance: NDArray[np.float64]
    certificates: tuple[Certificate, ...] = ()
    """Of those scans that have one, in their order."""

    def __len__(self) -> int:
        return len(self.stamps_ns)

"""The table of what odometry is read from; of a topic with several types the first counts."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hsloc.log.messages import definitions, imu, joint_states, velocities
from hsloc.log.messages.from_objects import object_odometry, object_pose
from hsloc.log.messages.odometry_kind import OdometryKind, Rank

if TYPE_CHECKING:
    from collections.abc import Collection

    from hsloc.log.summary import ReadOptions


def _named_like_odometry(topic: str, _: ReadOptions) -> Rank:
    # Poses may be of anything: they count if their name says so.
    parts = topic.lower().split("/")
    return Rank.POSE if "odom" in parts or "odometry" in parts else Rank.NEVER


ODOMETRY_KINDS = (
    OdometryKind(definitions.ODOMETRY, object_odometry, lambda *_: Rank.ODOMETRY),
    OdometryKind(definitions.POSE_STAMPED, object_pose, _named_like_odometry),
    OdometryKind(definitions.POSE_WITH_COVARIANCE_STAMPED, object_pose, _named_like_odometry),
    *velocities.KINDS,
    *joint_states.KINDS,
    *imu.KINDS,
)
POSE_TYPES = tuple(kind.typename for kind in ODOMETRY_KINDS if kind.motion is None)
"""Types that hold poses: these may be the truth, too."""


def kind_among(typenames: Collection[str]) -> OdometryKind | None:
    """The kind that is read of messages of these types."""
    return next((kind for kind in ODOMETRY_KINDS if kind.typename in typenames), None)

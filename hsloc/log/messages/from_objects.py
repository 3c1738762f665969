"""From message objects of rosbags (ROS 1, big endian, other definitions) or of JSON to the tuples of `decode`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from hsloc.log.messages import definitions
from hsloc.log.messages.decode import (
    NANOSECONDS,
    GridMessage,
    LinkMessage,
    OdometryMessage,
    PoseMessage,
    ScanMessage,
    first_echoes,
    make_grid,
    plane_covariance,
)
from hsloc.log.transforms import Transform3
from hsloc.model import Pose2

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray


def object_header(message: Any) -> tuple[int, str]:
    """(stamp in ns, frame_id) of a message object."""
    stamp = message.header.stamp
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec), str(message.header.frame_id).lstrip("/")


def _object_pose(pose: Any) -> Pose2:
    p, q = pose.position, pose.orientation
    return Pose2.from_quaternion(float(p.x), float(p.y), float(q.x), float(q.y), float(q.z), float(q.w))


def object_laser_scan(message: Any) -> ScanMessage:
    """From a message object."""
    ranges = np.array(message.ranges, dtype=np.float32)
    return _object_scan(message, ranges, np.array(message.intensities, dtype=np.float32))


def object_multi_echo_laser_scan(message: Any) -> ScanMessage:
    """From a message object: the first echo of each beam, and all of them."""
    echoes, strengths = ([beam.echoes for beam in beams] for beams in (message.ranges, message.intensities))
    scan = _object_scan(message, first_echoes(echoes), first_echoes(strengths))
    return scan._replace(echoes=(echoes, strengths)) if len(strengths) == len(echoes) else scan


def _object_scan(message: Any, ranges: NDArray[np.float32], intensities: NDArray[np.float32]) -> ScanMessage:
    return ScanMessage(
        *object_header(message),
        float(message.angle_min),
        float(message.angle_increment),
        float(message.time_increment),
        float(message.range_min),
        float(message.range_max),
        ranges,
        intensities if len(intensities) else None,
        float(message.scan_time),
        angle_max=float(message.angle_max),
    )


def object_odometry(message: Any) -> OdometryMessage:
    """From a message object."""
    raw = np.array(message.pose.covariance, dtype="<f8").tobytes()
    child = str(message.child_frame_id).lstrip("/")
    pose, q = _object_pose(message.pose.pose), message.pose.pose.orientation
    quaternion = (float(q.x), float(q.y), float(q.z), float(q.w))
    return OdometryMessage(*object_header(message), child, pose, plane_covariance(raw), quaternion)


def object_transforms(message: Any) -> list[LinkMessage]:
    """From a message object."""
    links = []
    for item in message.transforms:
        t, q = item.transform.translation, item.transform.rotation
        transform = Transform3((float(t.x), float(t.y), float(t.z)), (float(q.x), float(q.y), float(q.z), float(q.w)))
        links.append(LinkMessage(*object_header(item), str(item.child_frame_id).lstrip("/"), transform))
    return links


def object_occupancy_grid(message: Any) -> GridMessage:
    """From a message object."""
    info = message.info
    cells = np.array(message.data, dtype=np.int8)
    grid = make_grid(cells, int(info.width), int(info.height), float(info.resolution), _object_pose(info.origin))
    return GridMessage(*object_header(message), grid)


def object_pose(message: Any) -> PoseMessage:
    """From a PoseStamped, or a PoseWithCovarianceStamped."""
    pose = getattr(message.pose, "pose", message.pose)
    return PoseMessage(*object_header(message), _object_pose(pose))


FROM_OBJECT: dict[str, Callable[[Any], Any]] = {
    definitions.LASER_SCAN: object_laser_scan,
    definitions.MULTI_ECHO_LASER_SCAN: object_multi_echo_laser_scan,
    definitions.ODOMETRY: object_odometry,
    definitions.TF_MESSAGE: object_transforms,
    definitions.OCCUPANCY_GRID: object_occupancy_grid,
    definitions.POSE_STAMPED: object_pose,
    definitions.POSE_WITH_COVARIANCE_STAMPED: object_pose,
}

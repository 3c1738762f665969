"""sensor_msgs/PointCloud2: the x, y, z of its points, and a scan as a slice of them."""

from __future__ import annotations

from math import inf, pi
from struct import Struct
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hsloc.log.messages import decode
from hsloc.log.messages.decode import ScanMessage
from hsloc.log.messages.from_objects import object_header

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.log.messages.decode import Payload
    from hsloc.log.transforms import Transform3

BEAMS = 1440
"""Beams of a slice: a quarter of a degree, as wide as the columns of common 3D lidars."""
RANGE_MIN = 0.05
"""Points nearer to the lidar than this (m) are its own housing, or a code for no return."""
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_MAX_FIELDS = 100
_TWO, _FIELD, _LAYOUT, _SIZE = Struct("<II"), Struct("<IBxxxI"), Struct("<II"), Struct("<I")


class CloudMessage(NamedTuple):
    """sensor_msgs/PointCloud2: points (n, 3) in metres, in the order of the message."""

    stamp_ns: int
    frame_id: str
    points: NDArray[np.float32]


def point_cloud(data: Payload) -> CloudMessage:
    """From CDR."""
    decode.alignment(data)
    stamp, frame, at = decode.header(data, 4)
    at = decode.aligned(at, 4)
    height, width = _TWO.unpack_from(data, at)
    (count,) = _SIZE.unpack_from(data, at + 8)
    if count > _MAX_FIELDS:
        raise ValueError(f"a cloud of {count} fields")
    at += 12
    fields: dict[str, tuple[int, int]] = {}
    for _ in range(count):
        name, at = decode.string(data, at)
        offset, kind, _ = _FIELD.unpack_from(data, at := decode.aligned(at, 4))
        fields[name] = offset, kind
        at += _FIELD.size
    big = bool(data[at])
    point_step, _ = _LAYOUT.unpack_from(data, at := decode.aligned(at + 1, 4))
    (size,) = _SIZE.unpack_from(data, at + 8)
    at += 12
    if at + size > len(data):
        raise ValueError("more points than the message holds")
    return CloudMessage(stamp, frame, _points(data[at : at + size], fields, point_step, height * width, big))


def object_point_cloud(message: Any) -> CloudMessage:
    """From a message object."""
    fields = {str(field.name): (int(field.offset), int(field.datatype)) for field in message.fields}
    count, data = int(message.height) * int(message.width), np.asarray(message.data, dtype=np.uint8).tobytes()
    points = _points(data, fields, int(message.point_step), count, bool(message.is_bigendian))
    return CloudMessage(*object_header(message), points)


def _points(data: Payload, fields: dict[str, tuple[int, int]], step: int, count: int, big: bool) -> NDArray[np.float32]:
    if not {"x", "y", "z"} <= fields.keys():
        raise ValueError(f"a cloud without x, y, z (it has {', '.join(sorted(fields))[:80]})")
    kinds = [_TYPES.get(fields[name][1]) for name in "xyz"]
    if None in kinds or step <= 0:
        raise ValueError("a cloud of unknown layout")
    order = ">" if big else "<"
    layout = np.dtype(
        {
            "names": list("xyz"),
            "formats": [f"{order}{kind}" for kind in kinds],
            "offsets": [fields[name][0] for name in "xyz"],
            "itemsize": step,
        }
    )
    rows = np.frombuffer(data, layout, min(count, len(data) // step))
    points: NDArray[np.float32] = np.stack([rows[name] for name in "xyz"], axis=1).astype(np.float32)
    return points


def slice_of(cloud: CloudMessage, T_base_lidar: Transform3, low: float, high: float) -> ScanMessage:
    """The nearest point of each direction between two heights above the base (m), as a scan in the lidar's place.

    Directions are those of the base; a direction without a point is NaN: what a slice has not met is not free.
    """
    points = cloud.points[np.isfinite(cloud.points).all(axis=1)].astype(np.float64)
    x, y, z = _rotation(T_base_lidar) @ points.T
    height = z + T_base_lidar.translation[2]
    distance = np.hypot(x, y)
    chosen = (height >= low) & (height <= high) & (distance >= RANGE_MIN)
    beams = np.floor((np.arctan2(y[chosen], x[chosen]) + pi) / (2.0 * pi) * BEAMS).astype(np.int64) % BEAMS
    ranges = np.full(BEAMS, np.inf)
    np.minimum.at(ranges, beams, distance[chosen])
    ranges[np.isinf(ranges)] = np.nan
    step = 2.0 * pi / BEAMS
    return ScanMessage(
        cloud.stamp_ns, cloud.frame_id, 0.5 * step - pi, step, 0.0, RANGE_MIN, inf, ranges.astype(np.float32), None
    )


def _rotation(transform: Transform3) -> NDArray[np.float64]:
    axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    return np.array([transform.rotate(axis) for axis in axes]).T

"""Poses in columns: messages of one topic that are laid out alike, decoded together.

Odometry is most of a log's messages, and one topic's messages differ in nothing but their numbers: the same names, the
same length, every number at the same place. So the numbers of many messages are taken out at once. What comes out is,
to the last bit, what `hsloc.log.decode` makes of them one by one, and where messages are not alike it has the word.
"""

from __future__ import annotations

from math import atan2
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hsloc.log import decode, definitions
from hsloc.log.decode import NANOSECONDS

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from hsloc.log.decode import Payload

_STAMP = slice(4, 12)
"""Where the stamp is, the one field before the pose that differs from message to message."""


class PoseColumns(NamedTuple):
    """n messages with poses: stamps in nanoseconds (n,), x, y (metres) and theta (radians), n covariances.

    A covariance is 3 x 3 over (x, y, theta), or None where a message states none.
    """

    stamps_ns: NDArray[np.int64]
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    theta: list[float]
    covariances: Sequence[NDArray[np.float64] | None]


def odometry(payloads: Sequence[Payload]) -> PoseColumns | None:
    """nav_msgs/Odometry from CDR; None where the messages are not laid out alike."""
    return _decoded(payloads, decode.odometry_pose_at, has_covariance=True)


def pose_stamped(payloads: Sequence[Payload]) -> PoseColumns | None:
    """geometry_msgs/PoseStamped or PoseWithCovarianceStamped from CDR; None where they are not laid out alike."""
    return _decoded(payloads, decode.stamped_pose_at, has_covariance=False)


def _decoded(
    payloads: Sequence[Payload], pose_at: Callable[[Payload], int], has_covariance: bool
) -> PoseColumns | None:
    length = len(payloads[0])
    try:
        at = pose_at(payloads[0])
    except decode.BAD_PAYLOAD:
        return None
    end = at + decode.POSE_BYTES + (decode.COVARIANCE_BYTES if has_covariance else 0)
    if end > length or set(map(len, payloads)) != {length}:
        return None
    joined = np.frombuffer(b"".join(payloads), dtype=np.uint8).reshape(len(payloads), length)
    head = joined[:, :at]
    alike = head == head[0]
    alike[:, _STAMP] = True
    if not alike.all():
        return None
    stamps = joined[:, _STAMP].copy()
    seconds, nanoseconds = stamps.view("<i4")[:, 0], stamps.view("<u4")[:, 1]
    x, y, _, qx, qy, qz, qw = joined[:, at : at + decode.POSE_BYTES].copy().view("<f8").T
    with np.errstate(all="ignore"):  # Damaged numbers overflow; the feed refuses them.
        sines, cosines = 2.0 * (qw * qz + qx * qy), qw * qw + qx * qx - qy * qy - qz * qz
    # Not numpy's arctan2, whose last bit depends on the processor.
    theta = list(map(atan2, sines.tolist(), cosines.tolist()))
    covariances: Sequence[NDArray[np.float64] | None] = (None,) * len(payloads)
    if has_covariance:
        covariances = _covariances(joined[:, at + decode.POSE_BYTES : end])
    return PoseColumns(seconds.astype(np.int64) * NANOSECONDS + nanoseconds, x, y, theta, covariances)


def _covariances(raw: NDArray[np.uint8]) -> Sequence[NDArray[np.float64] | None]:
    """Of each row of 36 doubles the part in the plane. Where all rows are the same, one for all."""
    if (raw == raw[0]).all():
        return (decode.plane_covariance(raw[0].tobytes()),) * len(raw)
    plane = raw.copy().view("<f8")[:, decode.PLANE].reshape(-1, 3, 3)
    plane.setflags(write=False)
    stated = np.any(plane, axis=(1, 2))
    return [row if stated[k] else None for k, row in enumerate(plane)]


BY_HAND: dict[str, Callable[[Sequence[Payload]], PoseColumns | None]] = {
    definitions.ODOMETRY: odometry,
    definitions.POSE_STAMPED: pose_stamped,
    definitions.POSE_WITH_COVARIANCE_STAMPED: pose_stamped,
}
"""Column decoders of the types whose definition is the known one (see `hsloc.log.decode.BY_HAND`)."""

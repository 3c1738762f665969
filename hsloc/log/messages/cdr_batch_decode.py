"""Poses in columns: messages of one topic that are laid out alike, decoded together.

Odometry is most of a log's messages, and one topic's messages differ in nothing but their numbers: the same names, the
same length, every number at the same place. So the numbers of many messages are taken out at once. What comes out
is, to the last bit, what `hsloc.log.messages.decode` makes of them one by one, and where messages are not alike it has
the word.
"""

from __future__ import annotations

from functools import lru_cache
from math import atan2
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from hsloc.log.messages import decode, definitions
from hsloc.log.messages.decode import NANOSECONDS
from hsloc.log.transforms import states_rotation

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from hsloc.log.messages.decode import Payload

    class ColumnDecoder(Protocol):
        """Many messages' poses; None where they are to be decoded one by one."""

        def __call__(self, payloads: Sequence[Payload], *, covariances: bool) -> PoseColumns | None:
            """Covariances are None where they are not asked for."""
            ...


_FORMATS = {"seconds": "<i4", "nanoseconds": "<u4", "pose": "7<f8", "covariance": "36<f8"}
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
    has_headings: bool = True
    """Whether each quaternion states a rotation."""


def odometry(payloads: Sequence[Payload], *, covariances: bool = True) -> PoseColumns | None:
    """nav_msgs/Odometry from CDR; None where the messages are not laid out alike. Covariances are read if asked for."""
    found = _rows(payloads, decode.odometry_pose_at, ("pose", "covariance"))
    if found is None:
        return None
    return _poses(found, _covariances(found["covariance"]) if covariances else (None,) * len(found))


def pose_stamped(payloads: Sequence[Payload], *, covariances: bool = False) -> PoseColumns | None:
    """geometry_msgs/PoseStamped or PoseWithCovarianceStamped from CDR; None where they are not laid out alike."""
    del covariances  # not read one by one either
    found = _rows(payloads, decode.stamped_pose_at, ("pose",))
    return None if found is None else _poses(found, (None,) * len(found))


def _rows(
    payloads: Sequence[Payload], pose_at: Callable[[Payload], int], fields: tuple[str, ...]
) -> NDArray[np.void] | None:
    """The stamps of the messages, and the fields from the pose on; None where the messages are not laid out alike."""
    length = len(payloads[0])
    try:
        at = pose_at(payloads[0])
    except decode.BAD_PAYLOAD:
        return None
    layout = _layout(fields, at, length)
    if layout is None or set(map(len, payloads)) != {length}:
        return None
    joined = b"".join(payloads)
    head = np.frombuffer(joined, np.uint8).reshape(len(payloads), length)[:, :at]
    alike = head == head[0]
    alike[:, _STAMP] = True
    if not alike.all():
        return None
    return np.frombuffer(joined, layout)


@lru_cache(maxsize=16)
def _layout(fields: tuple[str, ...], at: int, length: int) -> np.dtype[np.void] | None:
    """The layout of messages of this length, whose pose is `at` this byte; None where the fields do not fit in."""
    names = ("seconds", "nanoseconds", *fields)
    offsets = [4, 8, at, at + decode.POSE_BYTES][: len(names)]
    if offsets[-1] + np.dtype(_FORMATS[names[-1]]).itemsize > length:
        return None
    formats = [_FORMATS[name] for name in names]
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": length})


def _poses(rows: NDArray[np.void], covariances: Sequence[NDArray[np.float64] | None]) -> PoseColumns:
    x, y, _, qx, qy, qz, qw = np.ascontiguousarray(rows["pose"].T)
    with np.errstate(all="ignore"):  # Damaged numbers overflow; the feed refuses them.
        sines, cosines = 2.0 * (qw * qz + qx * qy), qw * qw + qx * qx - qy * qy - qz * qz
    # Not numpy's arctan2, whose last bit depends on the processor.
    theta = list(map(atan2, sines.tolist(), cosines.tolist()))
    stamps = rows["seconds"].astype(np.int64) * NANOSECONDS + rows["nanoseconds"]
    doubtful = (qw == 0.0) | ((qw == 1.0) & ((qx != 0.0) | (qy != 0.0) | (qz != 0.0)))
    has_headings = all(map(states_rotation, rows["pose"][doubtful, 3:].tolist()))
    return PoseColumns(stamps, x, y, theta, covariances, has_headings)


def _covariances(full: NDArray[np.float64]) -> Sequence[NDArray[np.float64] | None]:
    """Of each row of 36 the part in the plane. Where the first is that of all, one for all."""
    first = full[0].tobytes()
    if full[-1].tobytes() == first and full.tobytes() == first * len(full):
        return (decode.plane_covariance(first),) * len(full)
    plane = full[:, decode.PLANE].reshape(-1, 3, 3)
    plane.setflags(write=False)
    if (plane[:, 0, 0] > 0.0).all():
        return list(plane)
    return [row if row.any() else None for row in plane]


BY_HAND: dict[str, ColumnDecoder] = {
    definitions.ODOMETRY: odometry,
    definitions.POSE_STAMPED: pose_stamped,
    definitions.POSE_WITH_COVARIANCE_STAMPED: pose_stamped,
}
"""Column decoders of the types whose definition is the known one (see `hsloc.log.messages.decode.BY_HAND`)."""

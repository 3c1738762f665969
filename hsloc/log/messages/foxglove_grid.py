"""foxglove.Grid as an occupancy grid, where its values are occupancies beyond doubt.

The message says where cells lie and of which type their values are, but not what they mean. Taken is what converters of
nav_msgs/OccupancyGrid write: one byte a cell, 0 to 100, and -1 (or 255, the same byte) for unknown.
"""

from __future__ import annotations

from base64 import b64decode
from math import isfinite
from typing import TYPE_CHECKING, Any

import numpy as np

from hsloc.model import OccupancyGrid, Pose2

if TYPE_CHECKING:
    from collections.abc import Callable

    Get = Callable[[Any, str], Any]

_UINT8, _INT8 = 1, 2
"""foxglove.NumericType."""
_NAMES = {"UINT8": _UINT8, "INT8": _INT8}
_MOST_CELLS = 400_000_000
"""Maximum number of cells. Internal: guards the memory against a hostile file."""


def occupancy(message: Any, get: Get, origin: Pose2) -> OccupancyGrid:
    """The grid, its lower-left corner at `origin`. Raises ValueError or TypeError for what is no occupancy grid."""
    fields = list(get(message, "fields") or ())
    if len(fields) != 1:
        raise ValueError(f"{len(fields)} values a cell, not one occupancy")
    kind = get(fields[0], "type")
    if _NAMES.get(kind, kind) not in (_UINT8, _INT8):
        raise ValueError(f"values of type {kind}, not bytes")
    data = get(message, "data") or b""
    raw = np.frombuffer(b64decode(data, validate=True) if isinstance(data, str) else bytes(data), dtype=np.uint8)
    size = get(message, "cell_size")
    side, other = (0.0, 0.0) if size is None else (float(get(size, axis) or 0.0) for axis in "xy")
    if not (isfinite(side) and side > 0.0 and abs(side - other) <= 1e-6 * side):
        raise ValueError(f"cells of {side:g} x {other:g} m, not squares")
    columns, stride, step, offset = (
        _count(value)
        for value in (
            get(message, "column_count"),
            get(message, "row_stride"),
            get(message, "cell_stride"),
            get(fields[0], "offset"),
        )
    )
    if columns < 1 or step < offset + 1 or stride < columns * step or len(raw) < stride or len(raw) > _MOST_CELLS:
        raise ValueError(f"{columns} columns, rows of {stride} bytes and cells of {step} in {len(raw)} bytes")
    rows = len(raw) // stride
    cells = raw[: rows * stride].reshape(rows, stride)[:, offset : offset + columns * step : step].astype(np.int16)
    cells = np.where(cells == 255, -1, cells)
    if cells.max() > 100:
        raise ValueError(f"values up to {cells.max()}, not occupancies of 0 to 100")
    return OccupancyGrid(np.ascontiguousarray(cells, dtype=np.int8), float(str(np.float32(side))), origin)


def _count(value: Any) -> int:
    if value is None:
        return 0
    if type(value) is not int or not 0 <= value < 1 << 31:
        raise TypeError("a count that is no whole number")
    return value

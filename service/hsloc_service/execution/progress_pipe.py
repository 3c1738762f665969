"""What a job's process says on its pipe: JSON of a process that may have gone mad."""

from __future__ import annotations

import json
import math
from typing import Any

DEPTH = 20
"""Deeper than anything that a worker says; an answer with much more could not be written."""


def plain_line(line: bytes) -> dict[str, Any]:
    """An object that the database and every reader of JSON take.

    What is no number to them (NaN, infinity, an integer of more than 64 bits) becomes null, half a surrogate pair a
    question mark. Raises ValueError, or RecursionError, for what is no object of JSON or too deep.
    """
    found = _plain(json.loads(line), DEPTH)
    if not isinstance(found, dict):
        raise ValueError("not an object")
    return found


def _plain(value: Any, depth: int) -> Any:
    if depth == 0:
        raise ValueError("too deep")
    if isinstance(value, str):
        return value.encode("utf-8", "replace").decode()
    if isinstance(value, dict):
        return {_plain(key, depth): _plain(each, depth - 1) for key, each in value.items()}
    if isinstance(value, list):
        return [_plain(each, depth - 1) for each in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return None if isinstance(value, int) and abs(value) >= 1 << 63 else value

"""ROS messages as JSON, as rosbridge and some recorders write them: fields by their ROS names.

Times are `{"sec", "nanosec"}` (ROS 2) or `{"secs", "nsecs"}` (ROS 1). What JSON has no number for is null, or one of
the words NaN, Infinity and -Infinity.
"""

from __future__ import annotations

import json
from base64 import b64decode
from math import inf, nan
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from hsloc.log.messages.decode import Payload

MAX_PAYLOAD_BYTES = 64 << 20
_WORDS = {"nan": nan, "inf": inf, "infinity": inf, "+infinity": inf, "-inf": -inf, "-infinity": -inf}
_ALIASES = {"secs": "sec", "nsecs": "nanosec", "nsec": "nanosec"}
_NUMBERS = ("ranges", "intensities", "covariance")
_DEFAULTS: dict[str, Any] = {"intensities": [], "scan_time": 0.0, "time_increment": 0.0, "child_frame_id": ""}


class _Message(SimpleNamespace):
    """An object of a JSON message; what a message may leave out has its default."""

    def __getattr__(self, name: str) -> Any:
        if name == "covariance":
            return [0.0] * 36
        try:
            return _DEFAULTS[name]
        except KeyError:
            raise ValueError(f"the field {name} is missing") from None


def decoder(convert: Callable[[Any], Any]) -> Callable[[Payload], Any]:
    """A function from payload to what `convert` makes of a message object; it raises whatever JSON may lead to."""

    def decode(data: Payload) -> Any:
        if len(data) > MAX_PAYLOAD_BYTES:
            raise ValueError(f"a message of {len(data)} bytes, at most {MAX_PAYLOAD_BYTES} are read")
        message = json.loads(bytes(data))
        if isinstance(message, dict) and set(message) == {"op", "topic", "msg"}:  # as rosbridge sends it
            message = message["msg"]
        return convert(_object(message, ""))

    return decode


def _object(value: Any, name: str) -> Any:
    if isinstance(value, dict):
        fields = {str(_ALIASES.get(key, key)): _object(item, str(key)) for key, item in value.items()}
        return _Message(**fields)
    if name in _NUMBERS and isinstance(value, list):
        return np.array([_number(item) for item in value])
    if name == "data" and isinstance(value, str):  # rosbridge writes int8[] in base64
        return np.frombuffer(b64decode(value, validate=True), dtype=np.int8)
    if isinstance(value, list):
        return [_object(item, name) for item in value]
    if value is None or (isinstance(value, str) and value.lower() in _WORDS and not name.endswith("frame_id")):
        return _number(value)
    return value


def _number(value: Any) -> float:
    if value is None:
        return nan
    if isinstance(value, str):
        return _WORDS[value.lower()]
    return float(value)

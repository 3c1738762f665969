"""Calibration files: YAML that `hsloc calibrate` writes and `--calibration` reads.

::

    odometry: {scale: 1.012, rotation_scale: 0.987, turn_per_metre: 0.0004}
    lidars:
      /scan: {x: 0.21, y: 0.0, yaw: 0.012, time_offset: -0.031}

Metres, radians and seconds; `time_offset` is added to the stamps of the topic. What is left out stays as it is; `x`,
`y` and `yaw` are given together or not at all. Further keys, such as the intervals of an estimate, are for people.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from hsloc.errors import ConfigError
from hsloc.model import Pose2, wrap_angle
from hsloc.model.calibration import Calibration, LidarCalibration, OdometryCorrection
from hsloc.yaml_table import is_number, load_table

if TYPE_CHECKING:
    from pathlib import Path

_ODOMETRY = {"scale": (0.5, 2.0), "rotation_scale": (0.5, 2.0), "turn_per_metre": (-1.0, 1.0)}
"""Keys and limits: what lies beyond is a mistake of units or of the file."""
_LIDAR = {"x": (-100.0, 100.0), "y": (-100.0, 100.0), "yaw": (-7.0, 7.0), "time_offset": (-1e6, 1e6)}
_REMEDY = "; write it with `hsloc calibrate`"


def read_calibration(path: Path) -> Calibration:
    """Read a calibration file. Raises ConfigError that names the file and the key."""
    values = load_table(path, "calibration", _REMEDY)
    if not {"odometry", "lidars"} & values.keys():
        raise ConfigError(f"{path}: has neither odometry nor lidars, so it is no calibration{_REMEDY}")
    odometry = _numbers(path, "odometry", values.get("odometry") or {}, _ODOMETRY)
    lidars = values.get("lidars") or {}
    if not isinstance(lidars, dict):
        raise ConfigError(f"{path}: lidars must be a table of topics{_REMEDY}")
    found = []
    for topic, each in lidars.items():
        numbers = _numbers(path, f"lidars: {topic}", each or {}, _LIDAR)
        place = [numbers.get(name) for name in ("x", "y", "yaw")]
        given = [number for number in place if number is not None]
        if len(given) not in (0, 3):
            raise ConfigError(f"{path}: lidars: {topic}: give x, y and yaw together, or none of them")
        pose = Pose2(given[0], given[1], wrap_angle(given[2])) if given else None
        found.append((str(topic), LidarCalibration(pose, numbers.get("time_offset", 0.0))))
    return Calibration(OdometryCorrection(**odometry), tuple(found))


def _numbers(path: Path, where: str, values: Any, limits: dict[str, tuple[float, float]]) -> dict[str, float]:
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: {where} must be a table of {', '.join(limits)}{_REMEDY}")
    for name, value in values.items():
        if name not in limits:
            raise ConfigError(f"{path}: {where}: unknown key {name!r}; they are {', '.join(limits)}")
        low, high = limits[name]
        if not is_number(value) or not low <= value <= high:
            raise ConfigError(f"{path}: {where}: {name} is {value!r}; it must be a number from {low:g} to {high:g}")
    return {name: float(value) for name, value in values.items()}

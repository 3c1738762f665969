"""The YAML beside a map's image, as nav2's map server reads it."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from typing import TYPE_CHECKING, Any

from hsloc.errors import MapError
from hsloc.model import Pose2
from hsloc.yaml_table import load_table

if TYPE_CHECKING:
    from pathlib import Path

MODES = ("trinary", "scale", "raw")


@dataclass(frozen=True, slots=True)
class MapMetadata:
    """The content of map.yaml. `origin` is the pose of the lower-left corner of the image in the map frame."""

    image: Path
    resolution: float
    origin: Pose2
    negate: bool
    occupied_thresh: float
    free_thresh: float
    mode: str = "trinary"


def read_metadata(path: Path) -> MapMetadata:
    """Read map.yaml. Raises MapError naming the file and the key that is missing or wrong."""
    values = load_yaml(path)
    image = _value(path, values, "image")
    if not isinstance(image, str) or not image:
        raise MapError(f"{path}: image must name a file, not {image!r}")
    resolution = _number(path, values, "resolution")
    if not 0.0 < resolution < 1e3:
        raise MapError(f"{path}: resolution must be above 0 metres, not {resolution}")
    occupied, free = _number(path, values, "occupied_thresh"), _number(path, values, "free_thresh")
    if not 0.0 <= free <= occupied <= 1.0:
        raise MapError(f"{path}: free_thresh {free} and occupied_thresh {occupied} must lie in order between 0 and 1")
    mode = values.get("mode", "trinary")
    if mode not in MODES:
        raise MapError(f"{path}: mode must be one of {', '.join(MODES)}, not {mode!r}")
    return MapMetadata(
        image=_image(path, image),
        resolution=resolution,
        origin=_origin(path, values),
        negate=_negate(path, values),
        occupied_thresh=occupied,
        free_thresh=free,
        mode=str(mode),
    )


def _image(path: Path, image: str) -> Path:
    """The image that a YAML names; where that path is of another machine, the file of that name beside the YAML."""
    named = path.parent / image
    name = image.replace("\\", "/").rstrip("/").rpartition("/")[2]
    beside = path.parent / name
    return beside if name and not named.exists() and beside.exists() else named


def load_yaml(path: Path) -> dict[str, Any]:
    """The keys of map.yaml. Raises MapError for what is no YAML of a map."""
    return load_table(path, "map", "; name the map's .yaml file, which has keys such as image", kind=MapError)


def _value(path: Path, values: dict[str, Any], key: str) -> Any:
    if key not in values:
        raise MapError(f"{path}: {key} is missing")
    return values[key]


def _number(path: Path, values: dict[str, Any], key: str) -> float:
    value = _value(path, values, key)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not isfinite(value):
        raise MapError(f"{path}: {key} must be a number, not {value!r}")
    return float(value)


def _origin(path: Path, values: dict[str, Any]) -> Pose2:
    value = _value(path, values, "origin")
    numbers = value if isinstance(value, list) else []
    if len(numbers) != 3 or not all(
        isinstance(n, (int, float)) and not isinstance(n, bool) and isfinite(n) for n in numbers
    ):
        raise MapError(f"{path}: origin must be [x, y, yaw] in metres and radians, not {value!r}")
    return Pose2(*(float(number) for number in numbers))


def _negate(path: Path, values: dict[str, Any]) -> bool:
    value = _value(path, values, "negate")
    if not isinstance(value, (bool, int)):
        raise MapError(f"{path}: negate must be 0 or 1, not {value!r}")
    return bool(value)


def metadata_text(image: str, resolution: float, origin: Pose2) -> str:
    """map.yaml of a trinary map, key by key as nav2's map saver writes it."""
    x, y, yaw = (_decimal(value) for value in (origin.x, origin.y, origin.theta))
    yaw = "0" if origin.theta == 0.0 else yaw
    return (
        f"image: {image}\nmode: trinary\nresolution: {_decimal(resolution)}\norigin: [{x}, {y}, {yaw}]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )


def _decimal(value: float) -> str:
    """Three decimals where they are exact, else every digit: what is read back is what was written."""
    short = f"{value:.3f}"
    return short if float(short) == value else repr(float(value))

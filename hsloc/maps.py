"""Maps as nav2 reads and writes them: PGM and YAML."""

from __future__ import annotations

import os
import warnings
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hsloc.errors import MapError, OutputError, not_written
from hsloc.model import OccupancyGrid, Pose2
from hsloc.model.occupancy_grid import FREE, OCCUPIED, UNKNOWN
from hsloc.warnings import RunWarning, WarningCode
from hsloc.yaml_table import is_number, load_table

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from PIL.Image import Image

    Plane = NDArray[np.float64]

MODES = ("trinary", "scale", "raw")

FREE_PIXEL, UNKNOWN_PIXEL, OCCUPIED_PIXEL = 254, 205, 0
UNKNOWN_PROBABILITY = (255 - UNKNOWN_PIXEL) / 255
"""Occupancy of pixel 205, 0.19608. A free_thresh at or above makes the unknown free."""
MAX_CELLS = 100_000_000
"""Maximum number of cells of a map that is read. Internal: guards the memory against a damaged file."""
IMAGES = (".pgm", ".png", ".bmp", ".pnm")
FORMATS = ("PPM", "PNG", "BMP")
"""Pillow's decoders that a map's image may reach, by its content: PGM belongs to PPM. Among the other 40 are programs
such as Ghostscript, which a hostile upload must not start."""


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


def map_file(path: Path) -> Path:
    """The file meant by --map: in a folder of results its map.yaml, of an image the YAML beside it.

    Raises MapError where there is none.
    """
    if path.is_dir():
        inside = path / "map.yaml"
        if not inside.exists():
            raise MapError(f"{path}: a folder without a map.yaml; name a map, or the folder of a mapping run")
        return inside
    if path.suffix.lower() in IMAGES:
        beside = path.with_suffix(".yaml")
        if not beside.exists():
            raise MapError(f"{path}: is the image of a map; its resolution and origin should be in {beside}")
        return beside
    return path


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
    image = image.strip()
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
    if not is_number(value):
        raise MapError(f"{path}: {key} must be a number, not {value!r}")
    return float(value)


def _origin(path: Path, values: dict[str, Any]) -> Pose2:
    value = _value(path, values, "origin")
    numbers = value if isinstance(value, list) else []
    if len(numbers) != 3 or not all(map(is_number, numbers)):
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


@dataclass(frozen=True, slots=True, eq=False)
class LoadedMap:
    """A map, and what its user should know about it."""

    grid: OccupancyGrid
    warnings: tuple[RunWarning, ...] = ()


class _Pixels(NamedTuple):
    """Brightness 0 .. 1 and opacity, first row on top.

    For grey images there is one for each level of grey, and `level` is the level of each pixel.
    """

    shade: Plane
    opaque: NDArray[np.bool_]
    level: NDArray[Any] | None = None


def load_map(path: Path | str) -> OccupancyGrid:
    """The map of a map.yaml; see `read_map`."""
    return read_map(path).grid


def read_map(path: Path | str) -> LoadedMap:
    """Read map.yaml and its image (PGM plain or raw, PNG, BMP), as nav2's map_io does.

    A folder or an image may be named too, as for `map_file`. Raises MapError.
    """
    path = map_file(Path(path))
    metadata = read_metadata(path)
    pixels = _read_image(path, metadata)
    cells = _cells(metadata, pixels.shade, pixels.opaque)
    if pixels.level is not None:
        cells = cells[pixels.level]
    grid = OccupancyGrid(np.ascontiguousarray(np.flipud(cells)), metadata.resolution, metadata.origin)
    return LoadedMap(grid, _warnings(path, metadata, pixels, grid))


def _read_image(path: Path, metadata: MapMetadata) -> _Pixels:
    from PIL import Image, UnidentifiedImageError

    image = metadata.image
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(image, formats=FORMATS) as opened:
                width, height = opened.size
                if width * height > MAX_CELLS:
                    raise MapError(f"{image}: {width} x {height} cells are too many, at most {MAX_CELLS} are read")
                opened.load()
                return _planes(opened, metadata.mode)
    except FileNotFoundError as error:
        others = sorted(each.name for each in path.parent.iterdir() if each.suffix.lower() in IMAGES)
        there = f"; there is {', '.join(others[:3])}" if others else ""
        raise MapError(
            f"{path}: its image {image} does not exist; put {image.name} beside the YAML, or name it under `image:`"
            f"{there}"
        ) from error
    except UnidentifiedImageError as error:
        raise MapError(f"{image}: is no PGM, PNG or BMP image; convert it to one of them") from error
    except MapError:
        raise
    except Exception as error:  # Decoders of images raise whatever they please on damage.
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise MapError(f"{image}: cannot be read as an image ({reason})") from error


def _planes(image: Image, mode: str) -> _Pixels:
    if image.mode == "P":
        image = image.convert("RGBA" if "transparency" in image.info else "RGB")
    elif image.mode == "1":
        image = image.convert("L")
    values = np.asarray(image)
    if values.ndim == 2:
        deep = image.mode.startswith("I")  # 16 bits of grey, held in 16 or 32
        if not deep and values.dtype != np.uint8:
            raise ValueError(f"pixels of mode {image.mode}")
        largest = 65535 if deep else 255
        shade = np.arange(largest + 1) / float(largest)
        return _Pixels(shade, np.ones(shade.shape, dtype=bool), np.clip(values, 0, largest))
    bands = values.astype(np.float64) / 255.0
    has_alpha = image.mode in ("LA", "RGBA")
    opaque = values[..., -1] == 255 if has_alpha else np.ones(bands.shape[:2], dtype=bool)
    colours = bands[..., :-1] if has_alpha else bands
    if colours.shape[-1] == 1:
        colours = np.repeat(colours, 3, axis=-1)
    # nav2 averages alpha in with the colours in trinary mode, "to preserve existing behavior".
    if has_alpha and mode == "trinary":
        colours = np.concatenate((colours, bands[..., -1:]), axis=-1)
    return _Pixels(colours.mean(axis=-1), opaque)


def _cells(metadata: MapMetadata, shade: Plane, opaque: NDArray[np.bool_]) -> NDArray[np.int8]:
    """Occupancy of each pixel, or level of grey."""
    if metadata.mode == "raw":
        percent = np.round(shade * 255.0)
        return np.where(percent <= OCCUPIED, percent, UNKNOWN).astype(np.int8)
    p = shade if metadata.negate else 1.0 - shade
    occupied, free = p >= metadata.occupied_thresh, p <= metadata.free_thresh
    between: Plane | int = UNKNOWN
    if metadata.mode == "scale":
        span = max(metadata.occupied_thresh - metadata.free_thresh, 1e-12)
        between = np.clip(np.rint((p - metadata.free_thresh) / span * 100.0), 0, 100)
    cells = np.where(occupied, OCCUPIED, np.where(free, FREE, between))
    if metadata.mode == "scale":
        cells = np.where(opaque, cells, UNKNOWN)
    return cells.astype(np.int8)


def _warnings(path: Path, metadata: MapMetadata, pixels: _Pixels, grid: OccupancyGrid) -> tuple[RunWarning, ...]:
    found = []
    probability = pixels.shade if metadata.negate else 1.0 - pixels.shade
    unknown = np.abs(probability - UNKNOWN_PROBABILITY) < 1e-6
    if pixels.level is not None:
        unknown = unknown[pixels.level]
    if metadata.mode == "trinary" and metadata.free_thresh >= UNKNOWN_PROBABILITY and unknown.any():
        found.append(
            RunWarning(
                WarningCode.MAP_UNKNOWN_READ_AS_FREE,
                f"{path}: free_thresh {metadata.free_thresh} makes {int(unknown.sum())} pixels of value 205 free, "
                "which usually mean unknown",
                "write free_thresh: 0.196 if they do",
            )
        )
    if not grid.occupied().any():
        found.append(
            RunWarning(
                WarningCode.MAP_EMPTY, f"{path}: the map has no occupied cell", "check negate and occupied_thresh"
            )
        )
    return tuple(found)


def save_map(grid: OccupancyGrid, target: Path | str) -> Path:
    """Write a trinary map as nav2's map saver does; returns the path of the YAML.

    `target` is a folder (then map.pgm and map.yaml are written in it) or a path without suffix (or with .yaml):
    `save_map(grid, "out/office")` writes out/office.pgm and out/office.yaml. Occupied is 65 and more, free is 20
    and less, as in nav2. Raises OutputError.
    """
    target = Path(target)
    if target.is_dir():
        target = target / "map"
    elif target.suffix == ".yaml":
        target = target.with_suffix("")
    image, text = target.with_name(target.name + ".pgm"), target.with_name(target.name + ".yaml")
    pixels = np.full(grid.cells.shape, UNKNOWN_PIXEL, dtype=np.uint8)
    pixels[(grid.cells >= 0) & (grid.cells <= 20)] = FREE_PIXEL
    pixels[grid.cells >= 65] = OCCUPIED_PIXEL
    height, width = grid.cells.shape
    _write(image, f"P5\n{width} {height}\n255\n".encode() + np.flipud(pixels).tobytes())
    _write(text, metadata_text(image.name, grid.resolution, grid.origin).encode())
    return text


def _write(path: Path, data: bytes) -> None:
    """All of it or nothing."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        partial.write_bytes(data)
        partial.replace(path)
    except OSError as error:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
        raise OutputError(not_written(path, error)) from error

"""The state of a map on disk: what it takes to go on mapping from there.

A `.npz` that NumPy reads, with the same bytes for the same state: its entries bear no date. It holds the keyscans,
their poses, the edges of the pose graph, and the grid, so that a localiser needs nothing else.
"""

from __future__ import annotations

import hashlib
import zipfile
from dataclasses import dataclass
from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np

from hsloc.errors import MapError, OutputError, not_read, not_written
from hsloc.model.occupancy_grid import OccupancyGrid
from hsloc.model.pose2 import Pose2
from hsloc.slam.keyscans import KeyScans
from hsloc.slam.pose_graph import Edges

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]

VERSION = 1
"""Version of the format of a saved map."""
STATE_FILE = "map.npz"
_COMPRESSION = 1
"""Level of zlib: 3 % more bytes than with its usual 6, in half the time."""
_FLAT = {
    "points": "f4", "hit_of_beam": "i4", "ranges": "f4", "point_start": "i8", "beam_start": "i8", "geometry": "f8",
    "stamps_ns": "i8", "poses": "f8", "covariances": "f8", "refused": "b1", "edge_pairs": "i8", "edge_measured": "f8",
    "edge_information": "f8", "edge_scale": "f8", "edge_is_loop": "b1", "cells": "i1", "grid": "f8",
    "fingerprint": "u1",
}  # fmt: skip
"""Arrays of the file and their types."""


@dataclass(frozen=True, slots=True, eq=False)
class MapState:
    """A finished map: keyscans at `poses` (n, 3), stamped.

    `covariances` (n, 3, 3) are those of the motion in the front end to each keyscan from the one before it,
    in whose frame they are; `refused` (n,) where it had odometry alone. `steps` are the odometry from keyscan to
    keyscan (n - 1), `loops` the accepted ones. `fingerprint` is that of the mapper's parameters.
    """

    scans: KeyScans
    stamps_ns: I64
    poses: F64
    covariances: F64
    refused: NDArray[np.bool_]
    steps: Edges
    loops: Edges
    grid: OccupancyGrid
    fingerprint: str
    name: str = "the saved map"
    """The file, in messages."""


def fingerprint(parameters: object) -> str:
    """Of parameters (dataclasses, whose repr is complete): differs where a value does."""
    return hashlib.sha256(repr(parameters).encode()).hexdigest()


def write_state(state: MapState, path: Path) -> None:
    """Write the state; the same state gives the same bytes. Raises OutputError."""
    edges = Edges.concatenate([state.steps, state.loops])
    origin = state.grid.origin
    arrays: dict[str, Any] = {
        "version": np.int64(VERSION),
        "points": state.scans.points,
        "hit_of_beam": state.scans.hit_of_beam,
        "ranges": state.scans.ranges,
        "point_start": state.scans.start,
        "beam_start": state.scans.table_start,
        "geometry": state.scans.geometry,
        "stamps_ns": state.stamps_ns,
        "poses": state.poses,
        "covariances": state.covariances,
        "refused": state.refused,
        "edge_pairs": edges.pairs,
        "edge_measured": edges.measured,
        "edge_information": edges.information,
        "edge_scale": edges.scale,
        "edge_is_loop": np.arange(len(edges)) >= len(state.steps),
        "cells": state.grid.cells,
        "grid": np.array((state.grid.resolution, origin.x, origin.y, origin.theta)),
        "fingerprint": np.frombuffer(state.fingerprint.encode("ascii"), dtype=np.uint8),
    }
    try:
        with zipfile.ZipFile(path, "w") as archive:
            for name, array in arrays.items():
                entry = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
                entry.compress_type = zipfile.ZIP_DEFLATED
                stream = BytesIO()
                np.lib.format.write_array(stream, np.asarray(array), allow_pickle=False)
                archive.writestr(entry, stream.getbuffer(), compresslevel=_COMPRESSION)
    except OSError as error:
        raise OutputError(not_written(path, error)) from error


def read_state(path: Path) -> MapState:
    """Read what `write_state` wrote. Raises MapError for anything else, and for another version."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            arrays: dict[str, Any] = dict(archive)
    except OSError as error:
        raise MapError(not_read(path, error)) from error
    except Exception as error:  # zipfile, zlib and NumPy raise what they like at damaged files
        raise MapError(f"{path}: not a saved map, or damaged; give the map.npz of a mapping run") from error
    if "version" not in arrays:
        raise MapError(f"{path}: not a saved map; give the map.npz of a mapping run")
    if arrays["version"].shape != () or int(arrays["version"]) != VERSION:
        raise MapError(
            f"{path}: a saved map of version {arrays['version']}, this hsloc reads {VERSION}; build the map again"
        )
    wrong = _flaw(arrays)
    if wrong:
        raise MapError(f"{path}: a damaged saved map: {wrong}; build the map again")
    return _state(arrays, str(path))


def _state(a: dict[str, Any], name: str) -> MapState:
    resolution, x, y, theta = (float(value) for value in a["grid"])
    edges = [
        Edges(a["edge_pairs"][rows], a["edge_measured"][rows], a["edge_information"][rows], a["edge_scale"][rows])
        for rows in (~a["edge_is_loop"], a["edge_is_loop"])
    ]
    return MapState(
        scans=KeyScans.fitted(
            a["points"], a["point_start"], a["hit_of_beam"], a["ranges"], a["beam_start"], a["geometry"]
        ),
        stamps_ns=a["stamps_ns"],
        poses=a["poses"],
        covariances=a["covariances"],
        refused=a["refused"],
        steps=edges[0],
        loops=edges[1],
        grid=OccupancyGrid(a["cells"], resolution, Pose2(x, y, theta)),
        fingerprint=a["fingerprint"].tobytes().decode("ascii", "replace"),
        name=name,
    )


def _flaw(a: dict[str, Any]) -> str:
    """What is wrong with the arrays, in a word: compiled code reads them without looking at their ends."""
    for name, kind in _FLAT.items():
        if name not in a or a[name].dtype != np.dtype(kind):
            return f"{name} is missing or of another type"
    n, m, p, b = len(a["stamps_ns"]), len(a["edge_pairs"]), len(a["points"]), len(a["ranges"])
    shapes = {
        "points": (p, 2), "hit_of_beam": (b,), "ranges": (b,), "point_start": (n + 1,), "beam_start": (n + 1,),
        "geometry": (n, 5), "stamps_ns": (n,), "poses": (n, 3), "covariances": (n, 3, 3), "refused": (n,),
        "edge_pairs": (m, 2), "edge_measured": (m, 3), "edge_information": (m, 3, 3), "edge_scale": (m,),
        "edge_is_loop": (m,), "grid": (4,),
    }  # fmt: skip
    for name, shape in shapes.items():
        if a[name].shape != shape:
            return f"{name} has the shape {a[name].shape}, not {shape}"
    finite = ("points", "geometry", "poses", "covariances", "edge_measured", "edge_information", "grid")
    for name in finite:
        if not np.isfinite(a[name]).all():
            return f"{name} is not finite"
    for name, end in (("point_start", p), ("beam_start", b)):
        if n == 0 or a[name][0] != 0 or a[name][-1] != end or (np.diff(a[name]) < 0).any():
            return f"{name} does not divide what it should"
    named = np.concatenate(([0], np.cumsum(a["hit_of_beam"] >= 0)))
    hits = named[a["beam_start"][1:]] - named[a["beam_start"][:-1]]
    rows = a["hit_of_beam"][a["hit_of_beam"] >= 0]
    if not np.array_equal(hits, np.diff(a["point_start"])) or not np.array_equal(rows, _counted(a["point_start"])):
        return "hit_of_beam does not name the points"
    if m and not (a["edge_pairs"].min() >= 0 and a["edge_pairs"].max() < n):
        return "edge_pairs names keyscans that are not there"
    if int((~a["edge_is_loop"]).sum()) != n - 1 or a["cells"].ndim != 2 or not a["grid"][0] > 0.0:
        return "edges or grid are incomplete"
    return ""


def _counted(start: I64) -> NDArray[np.int64]:
    """0, 1, 2 ... within each scan."""
    counts: NDArray[np.int64] = np.arange(start[-1]) - np.repeat(start[:-1], np.diff(start))
    return counts

"""Results as evo saves them (`evo_ape --save_results`), for `evo_res` and whatever else reads its zip files.

One file holds one measure of one estimate: `info.json` (title, names), `stats.json`, the error of each pair in
`error_array.npy`, and its place: `timestamps.npy` and `seconds_from_start.npy` (s), `distances_from_start.npy`
and `distances.npy` (m along reference and estimate); `alignment_transformation_sim3.npy` (4, 4) where one was moved.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from io import BytesIO
from typing import TYPE_CHECKING
from zipfile import ZipFile, ZipInfo

import numpy as np

from hsloc.atomic_write import write_atomically
from hsloc.evaluation.association import seconds
from hsloc.evaluation.rpe import pieces, rpe
from hsloc.evaluation.statistics import Statistics

if TYPE_CHECKING:
    from pathlib import Path
    from typing import BinaryIO

    from numpy.typing import NDArray

    from hsloc.evaluation.alignment import Alignment
    from hsloc.evaluation.metrics import Comparison
    from hsloc.evaluation.rpe import Delta
    from hsloc.model import Pose2

    Floats = NDArray[np.float64]

RELATIONS = {"trans_part": ("translation part", "m"), "angle_deg": ("rotation angle in degrees", "deg")}
"""evo's names of the relations and their units."""
_ALIGNED = {
    "none": "\n(not aligned)",
    "origin": "\n(with origin alignment)",
    "se2": "\n(with SE(3) Umeyama alignment)",
}
_TIME = (1980, 1, 1, 0, 0, 0)
"""The time of all members, so that the same results are the same bytes."""


def write_evo_results(
    folder: Path, name: str, comparison: Comparison, alignment: Alignment, delta: Delta, names: tuple[str, str]
) -> list[Path]:
    """Write `<name>.ape_trans_part.zip` and its like for APE and RPE, both relations; returns the files.

    `names` are those of reference and estimate. No RPE is written where the path is shorter than one piece, since
    evo knows no empty results. Raises OutputError.
    """
    pairs = comparison.pairs
    measures = [("ape", comparison.errors, "", comparison.aligned, np.arange(len(pairs)))]
    relative = rpe(pairs, delta)
    if len(relative):
        length = int(delta.value) if delta.unit == "frames" else float(delta.value)
        which = "all" if delta.all_pairs else "consecutive"
        text = f"\nfor delta = {length} ({delta.unit}) using {which} pairs"
        measures.append(("rpe", relative, text, comparison.aligned, np.concatenate(((0,), pieces(pairs, delta)[1]))))
    written = []
    for measure, errors, text, poses, rows in measures:
        for relation, (words, unit) in RELATIONS.items():
            values: Floats = getattr(errors, relation)
            label = measure.upper()
            info = {
                "title": f"{label} w.r.t. {words} ({unit}){text}{_ALIGNED[alignment]}",
                "ref_name": names[0],
                "est_name": names[1],
                "label": f"{label} ({unit})",
            }
            arrays = {"error_array": values, **_places(pairs.stamps_ns, pairs.reference, poses, rows, len(values))}
            if alignment != "none":
                arrays["alignment_transformation_sim3"] = _matrix(comparison.T_reference_estimate)
            path = folder / f"{name}.{measure}_{relation}.zip"
            write_atomically(path, _Archive(info, arrays))
            written.append(path)
    return written


class _Archive:
    """What is in a file, and how it is written."""

    def __init__(self, info: dict[str, str], arrays: dict[str, Floats]) -> None:
        statistics = asdict(Statistics.of(arrays["error_array"]))
        del statistics["count"]
        self._texts = {"info.json": json.dumps(info), "stats.json": json.dumps(statistics)}
        self._arrays = arrays

    def __call__(self, stream: BinaryIO) -> None:
        with ZipFile(stream, "w") as archive:
            for name, text in self._texts.items():
                archive.writestr(ZipInfo(name, _TIME), text)
            for name, array in self._arrays.items():
                buffer = BytesIO()
                np.save(buffer, array)
                archive.writestr(ZipInfo(f"{name}.npy", _TIME), buffer.getvalue())


def _places(
    stamps_ns: NDArray[np.int64], reference: Floats, estimate: Floats, rows: NDArray[np.intp], count: int
) -> dict[str, Floats]:
    """When and where each error is; of RPE at the end of its piece, `rows` leading with the first pose."""
    times = seconds(stamps_ns[rows])
    return {
        "seconds_from_start": (times - times[0])[-count:],
        "timestamps": times[-count:],
        "distances_from_start": _path_lengths(reference[rows])[-count:],
        "distances": _path_lengths(estimate[rows])[-count:],
    }


def _path_lengths(poses: Floats) -> Floats:
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    return np.concatenate(((0.0,), np.cumsum(steps)))


def _matrix(pose: Pose2) -> Floats:
    matrix = np.eye(4)
    c, s = np.cos(pose.theta), np.sin(pose.theta)
    matrix[:2, :2] = ((c, -s), (s, c))
    matrix[:2, 3] = pose.x, pose.y
    return matrix

"""Maps as foxglove.Grid: taken where the values are occupancies, reported where they may be anything else."""

from __future__ import annotations

import json
from base64 import b64encode
from typing import TYPE_CHECKING, Any

import log_formats
import numpy as np
import pytest
from log_builders import START, write_raw
from paths import RECORDINGS

from hsloc.cli.main import main
from hsloc.log.container import Channel
from hsloc.log.messages.decoders import Undecodable, decoder_for
from hsloc.log.reader import open_log

if TYPE_CHECKING:
    from pathlib import Path

    from hsloc.model import OccupancyGrid

HALL = RECORDINGS / "hall.mcap"
CELLS = np.array(((-1, 0, 100), (50, 7, 0)), dtype=np.int8)


def message(cells: Any = CELLS, **changes: Any) -> dict[str, Any]:
    return {
        "timestamp": {"sec": 5, "nsec": 0},
        "frame_id": "map",
        "pose": {"position": {"x": 1.0, "y": -2.0, "z": 0.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}},
        "column_count": cells.shape[1],
        "cell_size": {"x": 0.05, "y": 0.05},
        "row_stride": cells.shape[1],
        "cell_stride": 1,
        "fields": [{"name": "value", "offset": 0, "type": 2}],
        "data": cells.tobytes(),
    } | changes


def decoded(content: dict[str, Any], encoding: str) -> OccupancyGrid:
    schema = log_formats.DESCRIPTORS.SerializeToString()
    decode = decoder_for(Channel(1, "/map", "foxglove.Grid", encoding, encoding, schema))
    return decode(payload(content, encoding)).grid  # type: ignore[no-any-return]


def payload(content: dict[str, Any], encoding: str) -> bytes:
    if encoding == "protobuf":
        return bytes(log_formats.to_protobuf("foxglove.Grid", content).SerializeToString())
    return json.dumps(content | {"data": b64encode(content["data"]).decode()}).encode()


@pytest.mark.parametrize("encoding", ["json", "protobuf"])
def test_occupancies_become_a_grid(encoding: str) -> None:
    grid = decoded(message(), encoding)
    np.testing.assert_array_equal(grid.cells, CELLS)
    assert (grid.resolution, grid.origin.x, grid.origin.y, grid.origin.theta) == (0.05, 1.0, -2.0, 0.0)


def test_cells_and_rows_may_have_bytes_between_them() -> None:
    padded = np.full((2, 10), 77, dtype=np.uint8)
    padded[:, 1:9:3] = CELLS.astype(np.uint8)  # 255 is unknown
    fields = [{"name": "occupancy", "offset": 1, "type": 1}]
    content = message(column_count=3, row_stride=10, cell_stride=3, fields=fields, data=padded.tobytes())
    np.testing.assert_array_equal(decoded(content, "protobuf").cells, CELLS)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"data": bytes((0, 254, 205, 0, 0, 0))}, "values up to 254, not occupancies"),
        ({"fields": [{"name": "value", "offset": 0, "type": 7}]}, "values of type 7, not bytes"),
        ({"fields": [{"name": n, "offset": k, "type": 1} for k, n in enumerate("rgb")]}, "3 values a cell"),
        ({"cell_size": {"x": 0.05, "y": 0.1}}, "not squares"),
        ({"cell_size": {"x": 0.0, "y": 0.0}}, "not squares"),
        ({"row_stride": 2}, "3 columns, rows of 2 bytes"),
        ({"data": b""}, "in 0 bytes"),
        ({"column_count": 0}, "0 columns"),
        ({"pose": {"position": {"x": float("inf"), "y": 0.0, "z": 0.0}}}, "not finite"),
    ],
)
@pytest.mark.parametrize("encoding", ["json", "protobuf"])
def test_what_is_no_occupancy_grid(encoding: str, changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(Undecodable, match=reason):
        decoded(message(**changes), encoding)


def grid_log(path: Path, **changes: Any) -> Path:
    grid = open_log(HALL).map()
    assert grid is not None
    place = {"position": {"x": grid.origin.x, "y": grid.origin.y, "z": 0.0}}
    content = message(grid.cells, pose=place) | changes
    schema = "foxglove.Grid", "protobuf", log_formats.DESCRIPTORS.SerializeToString()
    return write_raw(path, [("/map", START, payload(content, "protobuf"))], schema=schema, encoding="protobuf")


def without_map(path: Path) -> Path:
    return log_formats.write(path, (m for m in log_formats.messages(HALL) if m[1].topic != "/map"), HALL)


def test_a_log_with_such_a_map_is_localised_in(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    logs = [str(without_map(tmp_path / "hall.mcap")), str(grid_log(tmp_path / "grid.mcap"))]
    assert main(["replay", *logs, "--end", "5", "--out", str(tmp_path / "out"), "--json"]) == 0
    metrics = json.loads(capsys.readouterr().out)
    assert metrics["run"]["mode"] == "localise"
    assert metrics["ape"]["trans_part"]["rmse"] < 0.02


def test_a_map_that_cannot_be_used_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fields = [{"name": "value", "offset": 0, "type": 7}]
    logs = [str(without_map(tmp_path / "hall.mcap")), str(grid_log(tmp_path / "grid.mcap", fields=fields))]
    assert main(["replay", *logs, "--end", "2", "--out", str(tmp_path / "out")]) == 0
    assert "cannot use /map (foxglove.Grid), so a map is built; to localise on a map give it with --map" in (
        capsys.readouterr().err
    )
    assert main(["replay", *logs, "--mode", "localise", "--out", str(tmp_path / "no")]) == 1
    assert "cannot use /map (foxglove.Grid); give one with --map map.yaml" in capsys.readouterr().err


@pytest.mark.unmeasured
def test_a_map_beside_the_log_is_reported_but_not_taken(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = str(without_map(tmp_path / "hall.mcap"))
    options = ["--end", "2", "--overwrite", "--out", str(tmp_path / "out" / "run")]
    (tmp_path / "config.yaml").write_text("resolution: 1\n")
    assert main(["replay", log, *options]) == 0
    assert "built" not in capsys.readouterr().err
    (tmp_path / "floor.yaml").write_text("image: floor.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n")
    assert main(["replay", log, *options]) == 0
    captured = capsys.readouterr()
    assert f"so a map is built; to localise on a map give it with --map {tmp_path / 'floor.yaml'}" in captured.err
    assert "Built a map from" in captured.out
    # With the option, or with the map of the log, there is nothing to report.
    assert main(["replay", log, *options, "--mode", "slam"]) == 0
    assert "built" not in capsys.readouterr().err

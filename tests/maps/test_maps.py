"""Maps against nav2's rules, pixel by pixel, and there and back."""

from __future__ import annotations

from math import pi
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from memory import at_most_bytes
from PIL import Image

from hsloc.errors import MapError, OutputError
from hsloc.maps import load_map, read_map, save_map
from hsloc.model import OccupancyGrid, Pose2

if TYPE_CHECKING:
    from pathlib import Path

YAML = """image: {image}
mode: {mode}
resolution: 0.05
origin: [-1.5, -2.5, {yaw}]
negate: {negate}
occupied_thresh: {occupied}
free_thresh: {free}
"""


def write_map(
    folder: Path,
    image: str = "map.pgm",
    mode: str = "trinary",
    negate: str = "0",
    occupied: float = 0.65,
    free: float = 0.196,
    yaw: float = 0.0,
) -> Path:
    path = folder / "map.yaml"
    path.write_text(YAML.format(image=image, mode=mode, negate=negate, occupied=occupied, free=free, yaw=yaw))
    return path


def write_grey(folder: Path, rows: list[list[int]], name: str = "map.pgm") -> None:
    Image.fromarray(np.array(rows, dtype=np.uint8)).save(folder / name)


@pytest.mark.parametrize("suffix", ["pgm", "png", "bmp"])
def test_pixels_mean_what_they_mean_in_nav2(tmp_path: Path, suffix: str) -> None:
    write_grey(tmp_path, [[254, 205, 0], [100, 90, 89]], f"map.{suffix}")
    grid = load_map(write_map(tmp_path, image=f"map.{suffix}"))
    # Row 0 of the grid is the lowest of the image. (255 - 90) / 255 = 0.647, (255 - 89) / 255 = 0.651.
    np.testing.assert_array_equal(grid.cells, [[-1, -1, 100], [0, -1, 100]])
    assert grid.cells.dtype == np.int8
    assert (grid.resolution, grid.origin) == (0.05, Pose2(-1.5, -2.5, 0.0))


def test_both_kinds_of_pgm_may_hold_comments(tmp_path: Path) -> None:
    path = write_map(tmp_path)
    (tmp_path / "map.pgm").write_bytes(b"P5\n# CREATOR: cartographer\n3 1\n# more\n255\n\xfe\xcd\x00")
    raw = load_map(path)
    (tmp_path / "map.pgm").write_bytes(b"P2\n# by hand\n3 1\n255\n254 205 0\n")
    np.testing.assert_array_equal(raw.cells, [[0, -1, 100]])
    np.testing.assert_array_equal(load_map(path).cells, raw.cells)


def test_sixteen_bits_are_scaled(tmp_path: Path) -> None:
    pixels = (np.array([[254, 205, 0]], dtype=np.uint16)) * 257
    Image.fromarray(pixels).save(tmp_path / "map.png")
    np.testing.assert_array_equal(load_map(write_map(tmp_path, image="map.png")).cells, [[0, -1, 100]])
    (tmp_path / "map.pgm").write_bytes(b"P5\n3 1\n65535\n" + pixels.astype(">u2").tobytes())
    np.testing.assert_array_equal(load_map(write_map(tmp_path)).cells, [[0, -1, 100]])


@pytest.mark.parametrize("negate", ["1", "true"])
def test_negate(tmp_path: Path, negate: str) -> None:
    write_grey(tmp_path, [[255, 50, 49]])  # 50 / 255 = 0.19608: the mirror of pixel 205
    np.testing.assert_array_equal(load_map(write_map(tmp_path, negate=negate)).cells, [[100, -1, 0]])


def test_scale_is_linear_between_the_thresholds_and_transparent_is_unknown(tmp_path: Path) -> None:
    rows = [[[0, 0, 0, 255], [255, 255, 255, 255], [128, 128, 128, 255], [128, 128, 128, 254]]]
    Image.fromarray(np.array(rows, dtype=np.uint8)).save(tmp_path / "map.png")
    grid = load_map(write_map(tmp_path, image="map.png", mode="scale"))
    # (127 / 255 - 0.196) / (0.65 - 0.196) = 0.665
    np.testing.assert_array_equal(grid.cells, [[100, 0, 67, -1]])


def test_raw_takes_the_pixel_as_percent(tmp_path: Path) -> None:
    write_grey(tmp_path, [[0, 50, 100, 101, 255]])
    np.testing.assert_array_equal(load_map(write_map(tmp_path, mode="raw")).cells, [[0, 50, 100, -1, -1]])


def test_trinary_averages_alpha_with_the_colours(tmp_path: Path) -> None:
    rows = [[[0, 0, 0, 255], [254, 254, 254, 255], [205, 205, 205, 255], [0, 0, 0, 0]]]
    Image.fromarray(np.array(rows, dtype=np.uint8)).save(tmp_path / "map.png")
    # nav2: (205 * 3 + 255) / 4 = 217.5, that is 0.147: opaque unknown pixels of RGBA images read as free.
    np.testing.assert_array_equal(load_map(write_map(tmp_path, image="map.png")).cells, [[100, 0, 0, 100]])


def test_mode_may_be_missing_and_origin_may_be_turned(tmp_path: Path) -> None:
    write_grey(tmp_path, [[0, 254]])
    path = write_map(tmp_path, yaw=0.5)
    path.write_text(path.read_text().replace("mode: trinary\n", ""))
    grid = load_map(path)
    assert grid.origin.theta == 0.5
    np.testing.assert_array_equal(grid.cells, [[100, 0]])


@pytest.mark.parametrize(("free", "warned"), [(0.25, True), (0.2, True), (0.1961, True), (0.196, False)])
def test_the_trap_of_free_thresh_is_reported(tmp_path: Path, free: float, warned: bool) -> None:
    write_grey(tmp_path, [[205, 254, 0]])
    loaded = read_map(write_map(tmp_path, free=free))
    assert any(each.code == "map_unknown_read_as_free" for each in loaded.warnings) is warned
    assert loaded.grid.cells[0, 0] == (0 if warned else -1)


def test_a_map_without_walls_is_reported(tmp_path: Path) -> None:
    write_grey(tmp_path, [[254, 205]])
    (warning,) = read_map(write_map(tmp_path)).warnings
    assert warning.code == "map_empty"


def test_written_bytes_are_those_of_nav2(tmp_path: Path) -> None:
    grid = OccupancyGrid(np.array([[0, 100, -1], [20, 65, 50]], dtype=np.int8), 0.05, Pose2(-12.35, -8.1, 0.0))
    yaml = save_map(grid, tmp_path)
    assert yaml == tmp_path / "map.yaml"
    assert (tmp_path / "map.pgm").read_bytes() == b"P5\n3 2\n255\n" + bytes([254, 0, 205, 254, 0, 205])
    assert yaml.read_text() == (
        "image: map.pgm\nmode: trinary\nresolution: 0.050\norigin: [-12.350, -8.100, 0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    assert sorted(p.name for p in tmp_path.iterdir()) == ["map.pgm", "map.yaml"]


@settings(max_examples=40)
@given(
    cells=arrays(
        np.int8,
        st.tuples(st.integers(1, 6), st.integers(1, 6)),
        elements=st.sampled_from([-1, 0, 100]),
    ),
    resolution=st.floats(1e-3, 10.0),
    x=st.floats(-1e4, 1e4),
    y=st.floats(-1e4, 1e4),
    theta=st.floats(-pi, pi),
)
def test_there_and_back(
    tmp_path_factory: pytest.TempPathFactory,
    cells: np.ndarray[tuple[int, int], np.dtype[np.int8]],
    resolution: float,
    x: float,
    y: float,
    theta: float,
) -> None:
    grid = OccupancyGrid(cells, resolution, Pose2(x, y, theta))
    found = load_map(save_map(grid, tmp_path_factory.mktemp("map") / "office"))
    np.testing.assert_array_equal(found.cells, cells)
    assert (found.resolution, found.origin) == (resolution, grid.origin)


def test_the_image_may_be_named_if_its_yaml_stands_beside_it(tmp_path: Path) -> None:
    write_grey(tmp_path, [[0]])
    with pytest.raises(MapError, match=r"image of a map.*map\.yaml"):
        load_map(tmp_path / "map.pgm")
    write_map(tmp_path)
    assert load_map(tmp_path / "map.pgm").cells[0, 0] == 100


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("resolution: 0.05", "resolution: 0"), "resolution must be above 0"),
        (("resolution: 0.05", "resolution: fine"), "resolution must be a number"),
        (("resolution: 0.05\n", ""), "resolution is missing"),
        (("image: map.pgm", "image: other.pgm"), r"other\.pgm does not exist"),
        (("image: map.pgm", "image: 3"), "image must name a file"),
        (("mode: trinary", "mode: quaternary"), "mode must be one of"),
        (("negate: 0", "negate: maybe"), "negate must be 0 or 1"),
        (("[-1.5, -2.5, 0.0]", "[0, 0]"), "origin must be"),
        (("[-1.5, -2.5, 0.0]", "[0, 0, .nan]"), "origin must be"),
        (("free_thresh: 0.196", "free_thresh: 0.9"), "in order between 0 and 1"),
        (("image: map.pgm", "image: [unclosed"), "is not YAML"),
    ],
)
def test_each_mistake_is_one_line_that_names_the_file(tmp_path: Path, change: tuple[str, str], message: str) -> None:
    write_grey(tmp_path, [[0]])
    path = write_map(tmp_path)
    path.write_text(path.read_text().replace(*change))
    with pytest.raises(MapError, match=message) as caught:
        load_map(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_is_no_map_at_all(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="no such map"):
        load_map(tmp_path / "missing.yaml")
    with pytest.raises(MapError, match=r"a folder without a map\.yaml"):
        load_map(tmp_path)
    (tmp_path / "list.yaml").write_text("- 1\n")
    with pytest.raises(MapError, match="is not a map: it holds no keys"):
        load_map(tmp_path / "list.yaml")
    (tmp_path / "run.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    with pytest.raises(MapError, match="is not YAML"):
        load_map(tmp_path / "run.mcap")
    path = write_map(tmp_path)
    (tmp_path / "map.pgm").write_bytes(b"P5\n3 3\n255\n\0")
    with pytest.raises(MapError, match="cannot be read as an image"):
        load_map(path)
    (tmp_path / "map.pgm").write_bytes(b"P5\n100000 100000\n255\n\0")
    with pytest.raises(MapError, match=r"too many|cannot be read as an image"):
        load_map(path)


@settings(max_examples=60)
@given(data=st.data())
def test_damaged_files_raise_nothing_but_a_map_error(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    folder = tmp_path_factory.mktemp("map")
    write_grey(folder, [[0, 205], [254, 254]])
    path = write_map(folder)
    victim = data.draw(st.sampled_from([path, folder / "map.pgm"]))
    content = bytearray(victim.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    victim.write_bytes(content)
    message = ""
    try:
        cells = load_map(path).cells.size
    except MapError as error:
        cells, message = 0, str(error)
    assert cells > 0 or message
    assert "\n" not in message


def test_an_unwritable_target_is_an_output_error(tmp_path: Path) -> None:
    grid = OccupancyGrid(np.zeros((1, 1), np.int8), 0.05)
    with pytest.raises(OutputError, match=r"missing/map\.pgm: cannot be written"):
        save_map(grid, tmp_path / "missing" / "map")
    assert list(tmp_path.iterdir()) == []


EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\n%%EndComments\nshowpage\n%%EOF\n"


@pytest.mark.parametrize("kind", ["EPS", "GIF", "TIFF", "JPEG", "WEBP"])
def test_an_image_of_another_format_is_refused_by_its_content(tmp_path: Path, kind: str) -> None:
    (tmp_path / "map.yaml").write_text(
        "image: map.pgm\nresolution: 0.1\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    if kind == "EPS":
        (tmp_path / "map.pgm").write_bytes(EPS)
    else:
        Image.new("L", (4, 4)).save(tmp_path / "map.pgm", format=kind)
    with pytest.raises(MapError, match="no PGM, PNG or BMP image; convert it"):
        load_map(tmp_path / "map.yaml")


def yaml_bomb(levels: int = 22) -> str:
    """Merge keys of merge keys: each level doubles what the loader copies."""
    lines = ["a0: &a0 {k: 1}"]
    lines += [f"a{k}: &a{k} {{<<: [*a{k - 1}, *a{k - 1}]}}" for k in range(1, levels)]
    return "\n".join([*lines, "image: map.pgm", ""])


def test_a_yaml_bomb_is_refused_without_work(tmp_path: Path) -> None:
    (tmp_path / "map.yaml").write_text(yaml_bomb())
    with at_most_bytes(1 << 20), pytest.raises(MapError, match="has a YAML alias"):
        load_map(tmp_path / "map.yaml")

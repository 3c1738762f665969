from __future__ import annotations

import gzip
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from evaluation_paths import make_path
from hypothesis import given
from hypothesis import strategies as st

from hsloc.errors import EvaluationError, OutputError
from hsloc.model import Trajectory
from hsloc.trajectory_io.reader import read_tum
from hsloc.trajectory_io.tum import format_stamp, format_tum, parse_stamp, write_tum

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

HALF = 2**-0.5


@given(st.integers(-(2**62), 2**62))
def test_stamps_pass_through_text_unchanged(stamp_ns: Any) -> None:
    assert parse_stamp(format_stamp(stamp_ns)) == stamp_ns


@pytest.mark.parametrize(
    ("text", "stamp_ns"),
    [
        ("0", 0),
        ("12", 12_000_000_000),
        ("12.", 12_000_000_000),
        ("1700000000.000000001", 1_700_000_000_000_000_001),
        ("1700000000.5", 1_700_000_000_500_000_000),
        ("-1.5", -1_500_000_000),
        ("1.305031102175304413e+09", 1_305_031_102_175_304_413),
        ("1.23456789051", 1_234_567_891),
        ("+3.25", 3_250_000_000),
    ],
)
def test_stamp_tables(text: str, stamp_ns: int) -> None:
    assert parse_stamp(text) == stamp_ns


@pytest.mark.parametrize("text", ["", "abc", "nan", "inf", "1e400", "1e999999999", "1.2.3", "99999999999999", "1٣"])
def test_no_stamp(text: str) -> None:
    with pytest.raises(ValueError):
        parse_stamp(text)


def test_the_text_is_what_evo_reads() -> None:
    text = format_tum(Trajectory(np.array([1, 2_000_000_000]), np.array([[1.5, -2.0, 0.0], [-0.0, 0.0, np.pi / 2]])))
    first, second = text.splitlines()
    assert first == "0.000000001 1.500000000000 -2.000000000000 0 0 0 0.000000000000 1.000000000000"
    assert second == "2.000000000 0.000000000000 0.000000000000 0 0 0 0.707106781187 0.707106781187"
    assert text.endswith("\n")


def test_round_trip_and_evo_reads_the_same(
    tmp_path: Path, rng: np.random.Generator, as_evo: Callable[..., Any]
) -> None:
    path = make_path(rng, 300)
    theirs = as_evo(path)
    back = read_tum(tmp_path / "trajectory.tum")
    np.testing.assert_array_equal(back.stamps_ns, path.stamps_ns)
    np.testing.assert_allclose(back.poses, path.poses, atol=1e-11)
    np.testing.assert_allclose(theirs.positions_xyz[:, :2], path.poses[:, :2], atol=1e-11)
    np.testing.assert_array_equal(theirs.timestamps, [float(format_stamp(stamp)) for stamp in path.stamps_ns.tolist()])


def test_the_reader_is_tolerant(tmp_path: Path) -> None:
    file = tmp_path / "odd.tum"
    file.write_text(f"\ufeff# t x y\n\n 1.0   2\t3 0 0 0 {HALF} {HALF} \r\n#x\n0.5 1 1 9 0 0 0 1", encoding="utf-8")
    path = read_tum(file)
    assert path.stamps_ns.tolist() == [1_000_000_000, 500_000_000]
    np.testing.assert_allclose(path.poses, [[2, 3, np.pi / 2], [1, 1, 0]], atol=1e-12)  # type: ignore[arg-type]


def test_planar_lines_and_gzip(tmp_path: Path) -> None:
    file = tmp_path / "poses.txt.gz"
    file.write_bytes(gzip.compress(b"# t x y theta\n3.25 1 2 3.5\n"))
    path = read_tum(file)
    np.testing.assert_allclose(path.poses, [[1, 2, 3.5 - 2 * np.pi]])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "holds no pose"),
        ("# only a comment\n", "holds no pose"),
        ("1 2 3\n", "line 1: 3 columns"),
        ("\n1 2 3 0 0 0 0 1\nx 2 3 0 0 0 0 1\n", "line 3: 'x' is not a stamp"),
        ("1 2 nan 0 0 0 0 1\n", "line 1: 'nan' is not a finite number"),
        ("1 2 y 0 0 0 0 1\n", "line 1: 'y' is not a number"),
        ("1 2 3 0 0 0 0 0\n", "line 1: the quaternion has length 0"),
    ],
)
def test_errors_name_file_and_line(tmp_path: Path, content: str, message: str) -> None:
    file = tmp_path / "bad.tum"
    file.write_text(content)
    with pytest.raises(EvaluationError, match=message) as caught:
        read_tum(file)
    assert str(file) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_no_such_file_and_no_text(tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match="no such file"):
        read_tum(tmp_path / "none.tum")
    (tmp_path / "binary.tum").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(EvaluationError, match="not a text file"):
        read_tum(tmp_path / "binary.tum")
    (tmp_path / "broken.gz").write_bytes(gzip.compress(b"1 2 3 4\n" * 99)[:30])
    with pytest.raises(EvaluationError, match="cannot be read"):
        read_tum(tmp_path / "broken.gz")
    with pytest.raises(EvaluationError, match="cannot be read"):
        read_tum(tmp_path)


def test_writing_is_whole_or_not_at_all(tmp_path: Path) -> None:
    path = Trajectory(np.array([1]), np.zeros((1, 3)))
    with pytest.raises(OutputError, match="cannot be written"):
        write_tum(tmp_path / "missing" / "trajectory.tum", path)
    (tmp_path / "taken.tum").mkdir()
    with pytest.raises(OutputError):
        write_tum(tmp_path / "taken.tum", path)
    assert [entry.name for entry in tmp_path.iterdir()] == ["taken.tum"]

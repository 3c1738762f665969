from __future__ import annotations

import gzip
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from evaluation_paths import make_path

from hsloc.errors import EvaluationError
from hsloc.evaluation.relations import Relations, evaluate_relations, read_relations, relation_errors
from hsloc.model import Pose2, Trajectory
from hsloc.model.pose2 import compose_poses, relative_poses
from hsloc.trajectory_io.reader import read_tum
from hsloc.trajectory_io.tum import parse_stamp

if TYPE_CHECKING:
    from pathlib import Path

S = 1_000_000_000


def trajectory(*rows: tuple[Any, ...]) -> Trajectory:
    return Trajectory(np.array([int(t * S) for t, *_ in rows]), np.array([pose for _, *pose in rows], dtype=float))


def relation(first_s: float, second_s: float, x: float, y: float, theta: float) -> Relations:
    return Relations(np.array([int(first_s * S)]), np.array([int(second_s * S)]), np.array([[x, y, theta]]))


def test_by_hand() -> None:
    # One metre ahead and a quarter turn left, where the checked relation has 1.03 m, 0.04 m and 80 degrees.
    path = trajectory((0, 5, 5, np.pi / 2), (1, 5, 6, np.pi))
    errors = relation_errors(path, relation(0, 1, 1.03, 0.04, np.radians(80)))
    assert errors.trans_part == pytest.approx([0.05])
    assert errors.angle_deg == pytest.approx([10.0])


def test_true_relations_score_zero_wherever_the_path_lies(rng: np.random.Generator) -> None:
    path = make_path(rng, 100)
    first, second = rng.integers(0, 100, 50), rng.integers(0, 100, 50)
    relations = Relations(
        path.stamps_ns[first], path.stamps_ns[second], relative_poses(path.poses[first], path.poses[second])
    )
    moved = Trajectory(path.stamps_ns, compose_poses(Pose2(9.0, -4.0, 2.0).to_array(), path.poses))
    result = evaluate_relations(moved, relations)
    assert (result.matched, result.unmatched) == (50, 0)
    assert result.statistics.trans_part.max == pytest.approx(0.0, abs=1e-9)
    assert result.statistics.angle_deg.max == pytest.approx(0.0, abs=1e-9)


def test_of_several_poses_with_one_stamp_the_last_counts() -> None:
    path = trajectory((0, 0, 0, 0), (1, 7, 0, 0), (2, 2, 0, 0), (1, 1, 0, 0))
    assert relation_errors(path, relation(0, 1, 1, 0, 0)).trans_part == pytest.approx([0.0])


def test_between_two_poses_it_is_interpolated_but_not_over_a_hole() -> None:
    path = trajectory((0, 0, 0, 0), (0.5, 0.5, 0, 0), (5, 5, 0, 0))
    assert relation_errors(path, relation(0, 0.25, 0.25, 0, 0)).trans_part == pytest.approx([0.0])
    with pytest.raises(EvaluationError, match="none of 1 relations"):
        relation_errors(path, relation(0, 3, 3, 0, 0))
    assert relation_errors(path, relation(0, 3, 3, 0, 0), max_gap_s=5.0).trans_part == pytest.approx([0.0])
    assert relation_errors(path, relation(0, 5, 5, 0, 0)).trans_part == pytest.approx([0.0])


def test_beyond_the_ends_nothing_matches() -> None:
    path = trajectory((0, 0, 0, 0), (1, 1, 0, 0))
    for first, second in ((-0.1, 0.5), (0.5, 1.1)):
        with pytest.raises(EvaluationError, match="same log"):
            relation_errors(path, relation(first, second, 0, 0, 0))
    both = Relations(np.array([0, 0]), np.array([S, 9 * S]), np.array([[1.0, 0, 0], [1.0, 0, 0]]))
    result = evaluate_relations(path, both)
    assert (result.matched, result.unmatched) == (1, 1)
    assert result.to_dict()["matched"] == 1
    assert result.to_dict()["trans_part"]["mean"] == pytest.approx(0.0)


def test_reading(tmp_path: Path) -> None:
    file = tmp_path / "x.relations"
    file.write_text("# c\n976052905.167303 976052911.885496 -0.05 -0.12 0 0 0 -1.68\n\n1 2 0 0 9 9 9 4\n")
    relations = read_relations(file)
    assert relations.first_ns.tolist() == [976052905_167303000, 1 * S]
    np.testing.assert_allclose(relations.poses, [[-0.05, -0.12, -1.68], [0, 0, 4 - 2 * np.pi]])


@pytest.mark.parametrize(
    ("content", "message"),
    [("", "holds no relation"), ("1 2 3\n", "line 1: 3 columns"), ("1 b 0 0 0 0 0 0\n", "line 1: 'b' is not a stamp")],
)
def test_bad_files(tmp_path: Path, content: str, message: str) -> None:
    file = tmp_path / "bad.relations"
    file.write_text(content)
    with pytest.raises(EvaluationError, match=message):
        read_relations(file)


@pytest.mark.data
def test_intel_scores_as_published(data: Path) -> None:
    """Raw odometry 7.37 m +- 14.3, GMapping's poses 0.046 m +- 0.040: figures found by others on these files."""
    relations = read_relations(data / "intel" / "intel.relations")
    with gzip.open(data / "intel" / "intel.clf.gz", "rt") as log:
        lines = [line.split() for line in log if line.startswith("ODOM ")]
    odometry = Trajectory(
        np.array([parse_stamp(line[7]) for line in lines]), np.array([line[1:4] for line in lines], dtype=float)
    )
    raw = evaluate_relations(odometry, relations)
    assert (raw.matched, raw.unmatched) == (2984, 0)
    assert raw.statistics.trans_part.mean == pytest.approx(7.37, abs=0.01)
    assert raw.statistics.trans_part.std == pytest.approx(14.3, abs=0.1)
    mapped = evaluate_relations(read_tum(data / "intel" / "intel.rbpf.txt.gz"), relations)
    assert mapped.statistics.trans_part.mean == pytest.approx(0.046, abs=0.001)
    assert mapped.statistics.trans_part.std == pytest.approx(0.040, abs=0.001)

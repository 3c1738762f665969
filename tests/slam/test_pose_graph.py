from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from hsloc.errors import LogFormatError, OutputError
from hsloc.model.pose2 import compose_poses, relative_poses
from hsloc.slam.pose_graph import Edges, PoseGraph, edge_errors, solve_edges

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

TIGHT = np.diag((1e4, 1e4, 1e5))


def circle(n: int = 40, radius: float = 5.0) -> NDArray[np.float64]:
    angle = 2 * np.pi * np.arange(n) / n
    return np.column_stack((radius * np.cos(angle), radius * np.sin(angle), angle + np.pi / 2))


def edges_of(poses: NDArray[np.float64], links: list[tuple[int, int]], scale: float = np.inf) -> Edges:
    pairs = np.array(links, dtype=np.int64)
    measured = relative_poses(poses[pairs[:, 0]], poses[pairs[:, 1]])
    return Edges(pairs, measured, np.broadcast_to(TIGHT, (len(pairs), 3, 3)).copy(), np.full(len(pairs), scale))


def dead_reckoned(true: NDArray[np.float64], edges: Edges) -> NDArray[np.float64]:
    poses = [true[0]]
    for step in edges.measured:
        poses.append(compose_poses(poses[-1], step)[0])
    return np.array(poses)


def test_a_loop_takes_the_drift_out() -> None:
    true = circle()
    steps = edges_of(true, [(k, k + 1) for k in range(39)])
    steps.measured[:] += np.random.default_rng(1).normal(0, (0.02, 0.02, 0.01), steps.measured.shape)
    drifted = dead_reckoned(true, steps)
    closed = solve_edges(drifted, Edges.concatenate([steps, edges_of(true, [(39, 0), (30, 2), (20, 5)])]))
    before, after = (np.hypot(*(poses - true)[:, :2].T).max() for poses in (drifted, closed))
    assert before > 0.3
    assert after < 0.4 * before
    np.testing.assert_allclose(closed[0], true[0], atol=1e-6)


def test_a_wrong_loop_with_a_robust_weight_is_harmless() -> None:
    true = circle()
    steps = edges_of(true, [(k, k + 1) for k in range(39)])
    right = edges_of(true, [(39, 0), (30, 1)], scale=1.0)
    wrong = edges_of(true, [(35, 10)], scale=1.0)
    wrong.measured[:] += (2.0, -1.0, 0.4)
    poses = solve_edges(dead_reckoned(true, steps), Edges.concatenate([steps, right, wrong]))
    assert np.hypot(*(poses - true)[:, :2].T).max() < 0.05
    _, _, chi = edge_errors(poses, wrong)
    assert chi[0] > 50.0


def test_a_doubtful_step_yields_to_loops_that_begin_far_off() -> None:
    """Robust weights alone leave it where it is: at the start all loops look like outliers."""
    true = np.column_stack((0.5 * np.arange(20), np.zeros(20), np.zeros(20)))

    def edges(pairs: list[tuple[int, int]], sigma: float, scale: float) -> Edges:
        ends = np.array(pairs)
        information = np.tile(np.diag(1.0 / np.array((sigma, sigma, 0.2 * sigma)) ** 2), (len(pairs), 1, 1))
        measured = relative_poses(true[ends[:, 0]], true[ends[:, 1]])
        return Edges(ends, measured, information, np.full(len(pairs), scale))

    chain = edges([(k, k + 1) for k in range(19)], 0.02, np.inf)
    chain.measured[10, 0] += 1.0
    chain.scale[10] = 1.0
    both = Edges.concatenate([chain, edges([(4, 14), (5, 16)], 0.05, 2.0)])
    start = dead_reckoned(true, chain)
    assert np.abs(solve_edges(start, both) - true).max() > 0.9
    assert np.abs(solve_edges(start, both, widened=(16.0, 8.0, 4.0, 2.0)) - true).max() < 0.01


def test_without_edges_nothing_moves() -> None:
    poses = circle(5)
    np.testing.assert_array_equal(solve_edges(poses, Edges.none()), poses)


def test_g2o_is_read_as_it_was_written(tmp_path: Path) -> None:
    true = circle(7)
    graph = PoseGraph(np.arange(7), true, edges_of(true, [(k, k + 1) for k in range(6)] + [(6, 0)]))
    graph.write_g2o(tmp_path / "graph.g2o")
    read = PoseGraph.read_g2o(tmp_path / "graph.g2o")
    np.testing.assert_array_equal(read.poses, true)
    np.testing.assert_array_equal(read.edges.pairs, graph.edges.pairs)
    np.testing.assert_allclose(read.edges.measured, graph.edges.measured, atol=1e-9)
    np.testing.assert_allclose(read.edges.information, graph.edges.information, atol=1e-3)
    assert (tmp_path / "graph.g2o").read_text().startswith("VERTEX_SE2 0 5.0 0.0 ")


def test_the_information_of_a_g2o_edge_is_in_the_frame_of_its_second_node(tmp_path: Path) -> None:
    """An edge that turns left by a right angle, well known along x of the first node: that is -y of the second."""
    turned = Edges(
        np.array([[0, 1]]), np.array([[1.0, 0.0, np.pi / 2]]), np.diag((100.0, 1.0, 5.0))[None], np.array([np.inf])
    )
    graph = PoseGraph(np.zeros(2, int), np.array([[0.0, 0.0, 0.0], [1.0, 0.0, np.pi / 2]]), turned)
    graph.write_g2o(tmp_path / "graph.g2o")
    numbers = [float(word) for word in (tmp_path / "graph.g2o").read_text().splitlines()[-1].split()[6:]]
    np.testing.assert_allclose(numbers, (1.0, 0.0, 0.0, 100.0, 0.0, 5.0), atol=1e-9)
    read = PoseGraph.read_g2o(tmp_path / "graph.g2o")
    np.testing.assert_allclose(read.edges.information, turned.information, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("VERTEX_SE2 0 1 2\n", "line 1"),
        ("VERTEX_SE2 0 0 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n", "vertex 1"),
        ("VERTEX_SE2 0 nan 0 0\n", "finite"),
        ("hello\n", "no VERTEX_SE2"),
    ],
)
def test_a_damaged_g2o_is_named(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.g2o"
    path.write_text(text)
    with pytest.raises(LogFormatError, match=message):
        PoseGraph.read_g2o(path)


def test_g2o_that_cannot_be_read_or_written(tmp_path: Path) -> None:
    with pytest.raises(LogFormatError, match=r"none\.g2o"):
        PoseGraph.read_g2o(tmp_path / "none.g2o")
    with pytest.raises(OutputError, match=r"x\.g2o"):
        PoseGraph(np.zeros(1, int), np.zeros((1, 3)), Edges.none()).write_g2o(tmp_path / "no" / "x.g2o")

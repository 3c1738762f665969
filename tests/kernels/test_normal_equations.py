""""""

from __future__ import annotations

from typing import Any

import numpy as np
from room_scans import pair_term, room_scan

from hsloc.kernels.normal_equations import (
    Blocks,
    Equations,
    Evaluated,
    PairTerms,
    add_edges,
    add_inverse_term,
    add_pairs,
    add_relative_term,
    evaluate_pairs,
    path_lengths,
)
from hsloc.kernels.point_to_line import Term, relative
from hsloc.model import Pose2
from hsloc.model.pose2 import relative_poses
from hsloc.slam.keyscans import KeyScan, KeyScans


def test_terms_of_poses_are_those_of_the_chain_rule() -> None:
    random = np.random.default_rng(1)
    pose_j, pose_i = random.normal(size=(2, 3))
    root, gradient = random.normal(size=(3, 3)), random.normal(size=3)
    information = root @ root.T
    rel = np.empty(3)
    relative(pose_j, pose_i, rel)
    np.testing.assert_allclose(rel[:2], relative_poses(pose_j[None], pose_i[None])[0, :2])

    def jacobian(moving: Any) -> Any:
        columns = []
        for k in range(3):
            ends = []
            for sign in (1.0, -1.0):
                j, i = pose_j.copy(), pose_i.copy()
                (j if moving == "j" else i)[k] += sign * 1e-6
                out = np.empty(3)
                relative(j, i, out)
                ends.append(out)
            columns.append((ends[0] - ends[1]) / 2e-6)
        return np.column_stack(columns)

    a, b = jacobian("i"), jacobian("j")
    hjj, hji, hii = np.zeros((3, 3, 3))
    gj, gi = np.zeros((2, 3))
    add_relative_term(pose_j, rel, Term(information, gradient), Blocks(hjj, hji, hii, gj, gi), np.empty((3, 3)))
    for got, expected in ((hjj, b.T @ information @ b), (hji, b.T @ information @ a), (hii, a.T @ information @ a)):
        np.testing.assert_allclose(got, expected, atol=1e-6)
    np.testing.assert_allclose(gj, b.T @ gradient, atol=1e-6)
    np.testing.assert_allclose(gi, a.T @ gradient, atol=1e-6)


def empty(poses: int, edges: int) -> Equations:
    return Equations(np.zeros((poses, 3, 3)), np.zeros((edges, 3, 3)), np.zeros((poses, 3)))


def test_the_right_side_of_edges_is_half_the_derivative_of_their_sum_of_squares(rng: Any) -> None:
    edges = np.array([[0, 1], [1, 2], [0, 2], [2, 3]])
    poses = rng.normal(size=(4, 3))
    roots = rng.normal(size=(4, 3, 3))
    information = roots @ roots.transpose(0, 2, 1)
    # Headings are whole turns away from what was measured: only the remainder counts.
    measured = relative_poses(poses[edges[:, 0]], poses[edges[:, 1]]) + 0.1 * rng.normal(size=(4, 3))
    measured[:, 2] += 2.0 * np.pi * np.array([0, 1, -2, 0])

    def squares(at: Any) -> float:
        return add_edges(at, edges, measured, information, np.full(4, np.inf), empty(4, 4))

    equations = empty(4, 4)
    total = add_edges(poses, edges, measured, information, np.full(4, np.inf), equations)
    assert 0.0 < total == squares(poses)
    derivative = np.zeros((4, 3))
    for k in np.ndindex(4, 3):
        step = np.zeros((4, 3))
        step[k] = 1e-6
        derivative[k] = (squares(poses + step) - squares(poses - step)) / 2e-6
    np.testing.assert_allclose(equations.right, 0.5 * derivative, atol=1e-5)
    # A motion of all poses together changes nothing: the blocks of a row add up to nothing for a shift.
    rows = equations.diagonal[:, :, :2].copy()
    for m, (j, i) in enumerate(edges):
        rows[j] += equations.off_diagonal[m][:, :2]
        rows[i] += equations.off_diagonal[m].T[:, :2]
    np.testing.assert_allclose(rows, 0.0, atol=1e-9)


def test_an_edge_that_contradicts_the_graph_weighs_less_by_cauchy(rng: Any) -> None:
    poses, edges = rng.normal(size=(2, 3)), np.array([[0, 1]])
    measured = relative_poses(poses[:1], poses[1:]) + np.array([[0.3, -0.2, 0.1]])
    information = np.eye(3)[None] * 25.0
    plain, robust = empty(2, 1), empty(2, 1)
    chi2 = add_edges(poses, edges, measured, information, np.array([np.inf]), plain)
    assert abs(chi2 - 25.0 * (0.3**2 + 0.2**2 + 0.1**2)) < 1e-9
    weighted = add_edges(poses, edges, measured, information, np.array([2.0]), robust)
    weight = 4.0 / (4.0 + chi2)
    np.testing.assert_allclose(weighted, weight * chi2)
    for got, expected in zip(robust, plain, strict=True):
        np.testing.assert_allclose(got, weight * expected)


def test_a_term_in_the_inverse_pose_is_one_in_the_pose(rng: Any) -> None:
    """The residual `q - m` of the inverse pose q, seen as one of the pose itself."""
    rel, root, measured = rng.normal(size=3), rng.normal(size=(3, 3)), rng.normal(size=3)

    def inverse(pose: Any) -> Any:
        out = np.empty(3)
        relative(pose, np.zeros(3), out)
        return out

    steps = 1e-6 * np.eye(3)
    derivative = np.column_stack([(inverse(rel + step) - inverse(rel - step)) / 2e-6 for step in steps])
    weight, error = root @ root.T, inverse(rel) - measured
    information, gradient = np.ones((3, 3)), np.ones(3)
    add_inverse_term(rel, Term(weight, weight @ error), information, gradient)
    np.testing.assert_allclose(information, 1.0 + derivative.T @ weight @ derivative, atol=1e-6)
    np.testing.assert_allclose(gradient, 1.0 + derivative.T @ weight @ error, atol=1e-6)


def test_path_lengths_are_those_of_dijkstra_over_chain_and_links(rng: Any) -> None:
    chain, links, lengths = rng.uniform(1.0, 3.0, 29), rng.integers(0, 33, (12, 2)), rng.uniform(0.1, 8.0, 12)
    distance = np.full((33, 33), np.inf)
    ends = [*((k, k + 1) for k in range(29)), *links.tolist()]
    for (i, j), length in zip(ends, [*chain, *lengths], strict=True):
        distance[i, j] = distance[j, i] = min(distance[i, j], length)
    np.fill_diagonal(distance, 0.0)
    for middle in range(33):
        distance = np.minimum(distance, distance[:, [middle]] + distance[[middle]])
    found = np.empty(33)
    for source in (0, 7, 29, 32):
        path_lengths(chain, links, lengths, source, found)
        np.testing.assert_allclose(found, distance[source])


def test_terms_of_pairs_are_those_of_both_directions_and_are_kept_while_nothing_moves() -> None:
    true = [Pose2(1.0, 1.5, 0.2), Pose2(2.5, 2.0, 0.9), Pose2(4.0, 1.5, -2.0)]
    scans = KeyScans.from_scans([KeyScan.of(room_scan(pose)) for pose in true])
    poses = np.array([pose.to_array() for pose in true])
    poses[1:] += ((0.03, -0.02, 0.01), (-0.02, 0.04, -0.01))
    pairs = np.array([[0, 1], [2, 0], [1, 2]])

    def between(j: int, i: int) -> Any:
        return relative_poses(poses[j][None], poses[i][None])[0]

    def evaluate(terms: PairTerms, before: Evaluated) -> None:
        evaluate_pairs(poses, pairs, scans.arrays(10_000), 0.3, 1e6, terms, before)

    def fresh() -> tuple[PairTerms, Evaluated]:
        matrices, vectors = np.full((2, 3, 3, 3), np.nan), np.full((3, 3, 3), np.nan)
        return PairTerms(matrices[0], vectors[0], np.empty((3, 5)), matrices[1]), Evaluated(vectors[1], vectors[2])

    terms, before = fresh()
    evaluate(terms, before)
    for m, (j, i) in enumerate(pairs.tolist()):
        there, counts = pair_term(scans, i, j, between(j, i))
        back, more = pair_term(scans, j, i, between(i, j))
        observed = there.observed.copy()
        add_inverse_term(between(j, i), Term(back.observed, np.zeros(3)), observed, np.zeros(3))
        add_inverse_term(between(j, i), Term(back.information, back.gradient), there.information, there.gradient)
        assert counts[0] > 10
        np.testing.assert_allclose(terms.information[m], there.information, rtol=1e-9, atol=1e-6)
        np.testing.assert_allclose(terms.gradient[m], there.gradient, rtol=1e-9, atol=1e-6)
        np.testing.assert_allclose(terms.observed[m], observed, rtol=1e-9, atol=1e-6)
        np.testing.assert_array_equal(terms.counts[m], counts + more)

    first = terms.gradient.copy(), between(0, 1), terms.information[0].copy()
    poses[1] += (2e-4, -1e-4, 1e-5)
    evaluate(terms, before)
    np.testing.assert_array_equal(terms.information[0], first[2])
    np.testing.assert_allclose(terms.gradient[0], first[0][0] + first[2] @ (between(0, 1) - first[1]))
    poses[1] += (0.01, 0.0, 0.0)
    evaluate(terms, before)
    expected, _ = again = fresh()
    evaluate(*again)
    for got, wanted in zip(terms, expected, strict=True):
        np.testing.assert_array_equal(got[[0, 2]], wanted[[0, 2]])

    found, by_hand = empty(3, 3), empty(3, 3)
    found.off_diagonal[:] = np.nan
    add_pairs(poses, pairs, terms, 4.0, found)
    for m, (j, i) in enumerate(pairs.tolist()):
        blocks = Blocks(
            by_hand.diagonal[j], by_hand.off_diagonal[m], by_hand.diagonal[i], by_hand.right[j], by_hand.right[i]
        )
        term = Term(4.0 * terms.information[m], 4.0 * terms.gradient[m])
        add_relative_term(poses[j], between(j, i), term, blocks, np.empty((3, 3)))
    for got, wanted in zip(found, by_hand, strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-9, atol=1e-6)

from __future__ import annotations

from typing import Any

import numpy as np

from hsloc.kernels.normal_equations import Blocks, add_relative_term, relative
from hsloc.kernels.point_to_line import Term
from hsloc.model.pose2 import relative_poses


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
    for got, want in ((hjj, b.T @ information @ b), (hji, b.T @ information @ a), (hii, a.T @ information @ a)):
        np.testing.assert_allclose(got, want, atol=1e-6)
    np.testing.assert_allclose(gj, b.T @ gradient, atol=1e-6)
    np.testing.assert_allclose(gi, a.T @ gradient, atol=1e-6)

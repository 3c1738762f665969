"""Classes of beams against a naive walk along each beam."""

from __future__ import annotations

import naive
import numpy as np

from hsloc.kernels.beam_classes import FITS, SHORT, THROUGH, UNMAPPED, classify_beams

CELLS = np.array(
    [
        [-1, -1, -1, -1, -1, -1, -1, -1],
        [-1, 0, 0, 0, 100, 0, 0, -1],
        [-1, 0, 0, 0, 100, 0, 0, -1],
        [-1, 0, 0, 0, 0, 0, 0, -1],
        [-1, -1, -1, -1, -1, -1, -1, -1],
    ],
    dtype=np.int8,
)


def classes(ends: list[tuple[float, float]], scores: list[float], margin: float = 0.0) -> list[int]:
    found = np.empty(len(ends), dtype=np.int8)
    origin = np.array((1.5, 1.5))
    classify_beams(CELLS, np.array(ends), origin, np.array(scores, dtype=np.float32), 0.3, margin, 65, found)
    return list(found)


def test_a_beam_ends_at_a_wall_before_it_behind_it_or_where_nothing_is_mapped() -> None:
    ends = [(4.2, 1.5), (3.2, 1.5), (6.2, 1.5), (1.5, 4.5), (1.5, 40.0)]
    assert classes(ends, [0.9, 0.1, 0.1, 0.1, 0.1]) == [FITS, SHORT, THROUGH, UNMAPPED, UNMAPPED]


def test_a_wall_just_before_the_end_is_the_one_it_ends_at() -> None:
    assert classes([(5.2, 1.5)], [0.1]) == [THROUGH]
    assert classes([(5.2, 1.5)], [0.1], margin=1.5) == [SHORT]


def test_is_the_naive_walk() -> None:
    rng = np.random.default_rng(0)
    cells = rng.choice(np.array([-1, 0, 0, 0, 100], dtype=np.int8), (30, 40))
    ends = rng.uniform(-5.0, 45.0, (400, 2))
    scores = rng.uniform(0.0, 0.6, 400).astype(np.float32)
    origin = np.array((20.3, 15.7))
    found = np.empty(400, dtype=np.int8)
    classify_beams(cells, ends, origin, scores, 0.3, 2.0, 65, found)
    np.testing.assert_array_equal(found, naive.beam_classes(cells, ends, origin, scores, 0.3, 2.0))

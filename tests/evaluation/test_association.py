from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pytest
from evaluation_paths import START_NS, disturb, make_path
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hsloc.errors import EvaluationError
from hsloc.evaluation.association import Pairs, associate, interpolate_poses
from hsloc.model import Trajectory

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import SimpleNamespace

MS = 1_000_000


def at(*milliseconds: int) -> Trajectory:
    """Poses at stamps in ms whose x is the number of their row."""
    stamps = np.array(milliseconds, dtype=np.int64) * MS
    poses = np.zeros((len(stamps), 3))
    poses[:, 0] = np.arange(len(stamps))
    return Trajectory(stamps, poses)


def rows(pairs: Pairs) -> tuple[list[int], list[int]]:
    return pairs.reference[:, 0].astype(int).tolist(), pairs.estimate[:, 0].astype(int).tolist()


def test_a_table_by_hand() -> None:
    pairs = associate(at(0, 100, 200, 300, 400), at(1, 104, 250, 395))
    assert rows(pairs) == ([0, 1, 4], [0, 1, 3])
    assert pairs.stamps_ns.tolist() == [1 * MS, 104 * MS, 395 * MS]
    assert (pairs.unmatched_reference, pairs.unmatched_estimate) == (2, 1)


def test_of_two_equally_near_the_earlier() -> None:
    assert rows(associate(at(0, 10, 20), at(5, 15), max_difference_s=0.006)) == ([0, 1], [0, 1])


def test_the_sparser_leads_and_a_partner_may_be_taken_twice() -> None:
    pairs = associate(at(0, 1, 2, 100, 200), at(1, 101), max_difference_s=0.01)
    assert rows(pairs) == ([1, 3], [0, 1])
    pairs = associate(at(0, 1, 2), at(1, 300, 400, 500), max_difference_s=0.01)
    assert rows(pairs) == ([0, 1, 2], [0, 0, 0])
    assert (pairs.unmatched_reference, pairs.unmatched_estimate) == (0, 3)


def test_the_offset_is_added_to_the_estimate() -> None:
    assert rows(associate(at(1000, 1100, 1200), at(0, 100, 200), offset_s=1.0)) == ([0, 1, 2], [0, 1, 2])
    assert rows(associate(at(1000, 1100), at(0, 100, 200), offset_s=1.0)) == ([0, 1], [0, 1])
    with pytest.raises(EvaluationError):
        associate(at(1000, 1100), at(0, 100, 200), offset_s=-1.0)


def test_interpolation_by_hand() -> None:
    pairs = associate(at(0, 100, 200), at(4, 97), method="interpolation")
    np.testing.assert_allclose(pairs.reference[:, 0], [0.04, 0.97])
    assert pairs.estimate[:, 0].tolist() == [0, 1]
    pairs = associate(at(4, 97), at(0, 100, 200), method="interpolation", offset_s=0.001)
    np.testing.assert_allclose(pairs.estimate[:, 0], [0.03, 0.96])
    assert pairs.stamps_ns.tolist() == [3 * MS, 96 * MS]


def test_interpolation_turns_the_short_way_round() -> None:
    path = Trajectory(np.array([0, 10]), np.array([[0.0, 0.0, 3.0], [1.0, 2.0, -3.0]]))
    poses = interpolate_poses(path, np.array([-5, 0, 5, 10, 15]))
    np.testing.assert_allclose(poses[:, 0], [0, 0, 0.5, 1, 1])
    np.testing.assert_allclose(np.cos(poses[:, 2] - [3.0, 3.0, np.pi, -3.0, -3.0]), 1.0)


@pytest.mark.parametrize("method", ["nearest", "interpolation"])
@pytest.mark.parametrize("offset_s", [0.0, 0.004, -0.1])
@pytest.mark.parametrize(("every", "shift_ns"), [(1, 0), (1, 3 * MS), (3, 10 * MS), (7, -999)])
def test_equals_evo(
    evo: SimpleNamespace,
    as_evo: Callable[..., Any],
    rng: np.random.Generator,
    method: Literal["nearest", "interpolation"],
    offset_s: float,
    every: int,
    shift_ns: int,
) -> None:
    # Near zero, as a simulator's clock: at today's epoch evo interpolates at stamps that float64 rounds to 240 ns.
    start_ns = START_NS if method == "nearest" else 36 * 1000 * MS
    reference = make_path(rng, 200, period_ns=20 * MS, jitter_ns=2 * MS, start_ns=start_ns)
    estimate = disturb(rng, reference, every=every, shift_ns=shift_ns)
    for first, second in ((reference, estimate), (estimate, reference)):
        ours = associate(first, second, max_difference_s=0.01, method=method, offset_s=offset_s)
        theirs = evo.associate(
            as_evo(first, "a"), as_evo(second, "b"), max_diff=0.01, sync_method=evo.methods[method], offset_2=offset_s
        )
        assert len(ours) == theirs[0].num_poses
        np.testing.assert_allclose(ours.reference[:, :2], theirs[0].positions_xyz[:, :2], atol=1e-9)
        np.testing.assert_allclose(ours.estimate[:, :2], theirs[1].positions_xyz[:, :2], atol=1e-9)


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(st.integers(0, 60), min_size=1, max_size=25),
    st.lists(st.integers(0, 60), min_size=1, max_size=25),
    st.booleans(),
    st.sampled_from([0.0, 0.0005, 0.001, 0.01]),
)
def test_equals_evo_with_ties_duplicates_and_backward_stamps(
    as_evo: Any, evo: Any, first: Any, second: Any, ordered: Any, limit: Any
) -> None:
    # Stamps on a grid of 1 ms at today's epoch: float64 rounding decides ties and limits, and ours is evo's.
    if ordered:
        first, second = sorted(first), sorted(second)
    reference, estimate = at(*first), at(*second)
    reference = Trajectory(reference.stamps_ns + START_NS, reference.poses)
    estimate = Trajectory(estimate.stamps_ns + START_NS, estimate.poses)
    try:
        theirs = evo.associate(as_evo(reference, "a"), as_evo(estimate, "b"), max_diff=limit)
        expected = [trajectory.positions_xyz[:, 0].astype(int).tolist() for trajectory in theirs]
    except evo.NothingMatches:
        with pytest.raises(EvaluationError):
            associate(reference, estimate, max_difference_s=limit)
        return
    assert list(rows(associate(reference, estimate, max_difference_s=limit))) == expected


@given(
    st.sets(st.integers(0, 10_000), min_size=1, max_size=40), st.sets(st.integers(0, 10_000), min_size=1, max_size=40)
)
def test_swapping_the_two_swaps_the_pairs(first: Any, second: Any) -> None:
    if len(first) == len(second):
        second = second | {20_000}
    a, b = at(*sorted(first)), at(*sorted(second))
    try:
        forth = associate(a, b, max_difference_s=0.5)
    except EvaluationError:
        with pytest.raises(EvaluationError):
            associate(b, a, max_difference_s=0.5)
        return
    back = associate(b, a, max_difference_s=0.5)
    assert rows(forth) == rows(back)[::-1]
    assert (forth.unmatched_reference, forth.unmatched_estimate) == (
        back.unmatched_estimate,
        back.unmatched_reference,
    )


def test_backward_stamps_find_their_nearest() -> None:
    pairs = associate(at(0, 300, 100, 200, 50), at(101, 2, 199))
    assert rows(pairs) == ([2, 0, 3], [0, 1, 2])


def test_nothing_matches_and_the_message_has_the_reason() -> None:
    with pytest.raises(EvaluationError) as caught:
        associate(at(0, 1000), at(100, 500))
    message = str(caught.value)
    assert "overlap by 0.400 s" in message
    assert "nearest gap is 0.1 s" in message
    assert "allow a time difference of 0.101 s" in message
    associate(at(0, 1000), at(100, 500), max_difference_s=0.101)
    with pytest.raises(EvaluationError, match=r"overlap by 0\.000 s .* gap is 9 s; check that both"):
        associate(at(0, 1000), at(10_000))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [({"method": "magic"}, "magic"), ({"max_difference_s": -1.0}, "negative"), ({"max_difference_s": np.nan}, "nan")],
)
def test_bad_arguments(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(EvaluationError, match=message):
        associate(at(0), at(0), **arguments)


def test_an_empty_trajectory() -> None:
    with pytest.raises(EvaluationError, match="the estimate holds no pose"):
        associate(at(0), at())


def test_large_and_unsorted_is_fast(rng: np.random.Generator) -> None:
    n = 200_000
    stamps = rng.permutation(n).astype(np.int64) * 10 * MS
    reference = Trajectory(stamps, np.zeros((n, 3)))
    assert len(associate(reference, Trajectory(stamps[: n // 2] + MS, np.zeros((n // 2, 3))))) == n // 2

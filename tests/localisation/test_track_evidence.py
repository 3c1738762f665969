"""Evidence for and against a track, and the probability that follows, forward and backward."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from math import exp, log

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hsloc.localisation import track_evidence
from hsloc.localisation.track_evidence import (
    MOST_FROM_RIVAL,
    PRIOR,
    TrackFilter,
    TrackRow,
    fit_evidence,
    mirrored_map,
    rival_evidence,
    smooth,
    usual_explained,
)
from hsloc.model import Evidence, Status

GOOD, POOR = 0.95, 0.6
rows = st.builds(
    TrackRow,
    st.sampled_from([Status.MATCHED, Status.REJECTED]),
    st.builds(
        Evidence,
        st.floats(0.0, 2.0),
        st.floats(0.3, 1.0),
        st.floats(0.0, 0.5),
        st.just(0.0),
        st.floats(0.0, 0.5),
        st.one_of(st.just(float("nan")), st.floats(0.8, 1.5)),
    ),
)


def track(*explained: float, rivals: dict[int, float] | None = None, step: float = 0.25) -> list[TrackRow]:
    """Matched scans, `step` metres apart."""
    found = (rivals or {}).get
    return [
        TrackRow(Status.MATCHED, Evidence(step if k else 0.0, value, rival=found(k, float("nan"))), begins=k == 0)
        for k, value in enumerate(explained)
    ]


def test_a_comparison_is_evidence_only_where_one_place_is_clearly_behind() -> None:
    assert rival_evidence(0.8) == MOST_FROM_RIVAL
    assert rival_evidence(1.0) == 0.0
    assert rival_evidence(float("nan")) == 0.0
    assert rival_evidence(2.0) == -MOST_FROM_RIVAL
    assert rival_evidence(0.89) == pytest.approx(MOST_FROM_RIVAL / 2.0)


def test_a_map_is_mirrored_where_the_mirrored_scans_fit_better_at_every_place() -> None:
    def said(*ratios: float, rival: float = 0.9) -> float:
        return mirrored_map([TrackRow(Status.MATCHED, Evidence(8.0, GOOD, rival=rival, mirrored=m)) for m in ratios])

    assert said() == said(float("nan"), 1.0, 1.04) == pytest.approx(0.01)  # a symmetric hall
    assert said(1.2) < 0.1 < said(1.2, 1.1) < 0.5 < said(1.2, 1.1, 1.3, 1.3) < 0.9 < said(*[1.06] * 5)
    assert said(1.2, 1.2, rival=1.2) == said()  # another place fits as well: this one is wrong, and not the map
    assert said(0.97, *[1.2] * 3) < 0.1
    assert 0.0 < said(*[0.97] * 500) < said(*[1.2] * 500) <= 1.0


def test_the_fit_counts_by_the_metre() -> None:
    assert fit_evidence(Evidence(0.5, POOR), 0.93) == pytest.approx(2.0 * fit_evidence(Evidence(0.25, POOR), 0.93))
    assert fit_evidence(Evidence(0.5, GOOD), 0.93) > 0.0 > fit_evidence(Evidence(0.5, POOR), 0.93)
    assert fit_evidence(Evidence(0.5), 0.93) == 0.0


def test_a_scan_of_which_a_crowd_hides_half_counts_by_half() -> None:
    assert fit_evidence(Evidence(1.0, POOR, short=0.5), 0.93) == pytest.approx(
        fit_evidence(Evidence(1.0, POOR), 0.93) / 2.0
    )


def test_a_long_track_that_fits_stays_right() -> None:
    assert smooth(track(*[GOOD] * 100))[:, 0].min() > 0.95
    # Where no comparison leaves the other places behind, a hundred metres are the most.
    assert 0.9 < smooth(track(*[GOOD] * 400))[:, 0].min() < 0.95


def test_a_track_that_ends_in_refused_scans_may_have_been_in_a_look_alike_before() -> None:
    rows = track(*[GOOD] * 200)
    refused = [TrackRow(Status.REJECTED, Evidence(0.25)) for _ in range(5)]
    before, after = smooth(rows), smooth([*rows, *refused])
    assert after[150, 1] > before[150, 1]
    assert after[150, 0] < 0.9 < before[150, 0]


def test_good_fit_does_not_rule_out_a_look_alike() -> None:
    alike = smooth(track(*[GOOD] * 400))[:, 1]
    assert alike.min() == pytest.approx(PRIOR[1], rel=0.2)


def test_where_scans_stop_fitting_the_track_has_gone_astray_and_was_right_before() -> None:
    right = smooth(track(*[GOOD] * 40, *[POOR] * 40))[:, 0]
    assert right[:30].min() > 0.9  # the last metres before it may belong to either side
    assert right[45:].max() < 0.1


def test_a_track_that_never_fitted_was_astray_from_its_beginning() -> None:
    assert smooth(track(*[POOR] * 40))[:, 0].max() < 0.3


def test_a_stretch_of_poor_fit_is_forgiven_where_good_fit_follows() -> None:
    right = smooth(track(*[GOOD] * 40, *[POOR] * 4, *[GOOD] * 40))[:, 0]
    assert right.min() > 0.9


def test_a_poor_map_on_which_comparisons_vouch_for_the_place_is_no_evidence_against_it() -> None:
    rivals = dict.fromkeys(range(20, 100, 20), 0.8)
    assert usual_explained(track(*[0.8] * 100, rivals=rivals)) == pytest.approx(0.8)
    assert smooth(track(*[0.8] * 100, rivals=rivals))[:, 0].min() > 0.9
    assert smooth(track(*[0.8] * 100))[:, 0].max() < 0.3


def test_a_new_track_is_independent_of_the_one_before() -> None:
    first, second = track(*[POOR] * 30), track(*[GOOD] * 30)
    right = smooth([*first, *second])[:, 0]
    assert right[:30].max() < 0.3
    assert right[30:].min() > 0.95


@given(st.lists(rows, min_size=1, max_size=5))
def test_smoothing_sums_over_all_sequences_of_states(sequence: list[TrackRow]) -> None:
    sequence = [replace(sequence[0], begins=True), *sequence[1:]]
    usual = usual_explained(sequence)
    n = len(sequence)
    weights = np.zeros((n, 3))
    for states in product(range(3), repeat=n):
        weight = PRIOR[states[0]]
        for k, row in enumerate(sequence):
            if k > 0:
                start = [0.0, 0.0, 0.0]
                start[states[k - 1]] = 1.0
                weight *= row.moved_on((start[0], start[1], start[2]))[states[k]]
            weight *= row.likelihoods(usual)[states[k]]
        for k in range(n):
            weights[k, states[k]] += weight
    np.testing.assert_allclose(smooth(sequence), weights / weights.sum(axis=1, keepdims=True), rtol=1e-6, atol=1e-9)


def test_the_filter_is_the_forward_half_of_the_smoothing() -> None:
    sequence = track(GOOD, GOOD, POOR, POOR, GOOD)
    forward = TrackFilter()
    for row in sequence:
        states = forward.add(row)
    np.testing.assert_allclose(states, smooth(sequence)[-1], rtol=1e-9)


def test_full_evidence_is_at_most_the_stated_odds() -> None:
    assert log(exp(rival_evidence(0.0))) <= MOST_FROM_RIVAL
    assert track_evidence.PRIOR_RIGHT + PRIOR[1] + PRIOR[2] == pytest.approx(1.0)

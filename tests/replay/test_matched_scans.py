"""Which scans were matched, and when a run counts as lost."""

import pytest

from hsloc.replay.matched_scans import are_matched, is_lost


def test_matched_are_those_of_the_tracker_and_of_the_search() -> None:
    found = are_matched(["matched", "predicted", "rejected", "relocalised", "searching", "no_returns"])
    assert found.tolist() == [True, False, False, True, False, False]
    assert are_matched([]).tolist() == []


@pytest.mark.parametrize(
    ("status", "lost"),
    [
        ([], False),
        (["predicted"] * 9, False),  # the motion gate passed over them
        (["predicted"] * 9 + ["matched"] * 2 + ["rejected"] * 2, False),
        (["predicted"] * 9 + ["matched"] * 2 + ["searching"] * 3, True),
    ],
)
def test_lost_is_a_run_in_which_most_matches_failed(status: list[str], lost: bool) -> None:
    assert is_lost(status) is lost

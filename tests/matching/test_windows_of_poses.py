"""The boxes of poses that are searched."""

from __future__ import annotations

import pytest

from hsloc.matching import Window
from hsloc.model import Pose2


@pytest.mark.parametrize(
    ("pose", "is_on_border"),
    [
        (Pose2(1.0, 2.0, 0.5), False),
        (Pose2(1.09, 2.19, 0.59), False),
        (Pose2(1.1, 2.0, 0.5), True),
        (Pose2(0.9005, 2.0, 0.5), True),
        (Pose2(1.0, 1.8, 0.5), True),
        (Pose2(1.0, 2.0, 0.6), True),
    ],
)
def test_an_optimum_on_the_border_may_lie_beyond(pose: Pose2, is_on_border: bool) -> None:
    assert Window(Pose2(1.0, 2.0, 0.5), 0.1, 0.2, 0.1).has_on_border(pose) == is_on_border


def test_a_window_grows_to_half_widths_and_never_shrinks() -> None:
    assert Window(Pose2(), 0.1, 0.4, 0.1).at_least(0.2, 0.3, 0.2) == Window(Pose2(), 0.2, 0.4, 0.2)

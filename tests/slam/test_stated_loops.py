"""Loops that the user asserts or forbids."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hsloc.errors import ConfigError, MapError
from hsloc.slam.mapper import Mapper
from hsloc.slam.parameters import GraphMapperParameters
from hsloc.slam.stated_loops import StatedLoops

_DEFAULT = GraphMapperParameters()
_NONE_IS_SURE = replace(_DEFAULT, loops=replace(_DEFAULT.loops, max_rival=0.0, max_rival_low=0.0))
"""So that every loop is ambiguous."""


def mapped(events: Any, stated: StatedLoops, parameters: GraphMapperParameters = _DEFAULT) -> Any:
    mapper = Mapper(parameters, np.random.default_rng(0), stated_loops=stated)
    for event in events:
        mapper.update(event)
    return mapper.finish()


def test_a_loop_that_is_ambiguous_is_closed_where_the_user_asserts_it(loop: Any) -> None:
    events, truth = loop
    poses = truth.poses[:, :2]
    # Where the drive ends it was before: the first pose beside the last one.
    end = len(poses) - 400
    again = int(np.argmin(np.hypot(*(poses[: len(poses) // 2] - poses[end]).T)))
    times = tuple(float(truth.stamps_ns[k] - truth.stamps_ns[0]) * 1e-9 for k in (again, end))
    result = mapped(events, StatedLoops(asserted=(times,)), _NONE_IS_SURE)  # type: ignore[arg-type]
    (closed,) = (one for one in result.loops if one.accepted)
    assert closed.reason == "asserted"
    forbidden = mapped(events, StatedLoops(forbidden=(times,)))  # type: ignore[arg-type]
    first, second = closed.first, closed.second
    near = [one for one in forbidden.loops if abs(one.first - first) <= 1 and abs(one.second - second) <= 1]
    assert near == [], "neither closed nor searched for"


def test_places_that_disagree_are_not_asserted(office: Any) -> None:
    with pytest.raises(MapError, match="the scans of the two places disagree"):
        mapped(office[0], StatedLoops(asserted=((1.0, 20.0),)))
    with pytest.raises(ConfigError, match=r"taken about 900 s; the scans last from 0.0 to 9.9 s"):
        mapped(office[0][:600], StatedLoops(forbidden=((1.0, 900.0),)))


@pytest.mark.parametrize("text", ["12", "a,b", "1,2,3", "-1,4", "nan,2", ""])
def test_what_is_no_pair_of_times_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match=r"--assert-loop is .*; it must be two times T1,T2 in seconds"):
        StatedLoops.parsed(text, None)


def test_pairs_are_read_in_any_order() -> None:
    assert StatedLoops.parsed("1,2,8.5,3", None) == StatedLoops(asserted=((1.0, 2.0), (3.0, 8.5)))

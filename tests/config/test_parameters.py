"""Every parameter states its range and what it means; every parameter class checks its ranges when it is made."""

from __future__ import annotations

import dataclasses
import math
import re
from typing import TYPE_CHECKING, Any

import pytest

from hsloc.config import Config
from hsloc.errors import ConfigError
from hsloc.parameters import LARGEST, SMALLEST, Parameters, Range, describe, plain

if TYPE_CHECKING:
    from collections.abc import Iterator


def classes(kind: Any = Config) -> Iterator[Any]:
    yield kind
    for parameter in describe(kind).values():
        if dataclasses.is_dataclass(parameter.type):
            yield from classes(parameter.type)


CLASSES = sorted(set(classes()), key=lambda kind: kind.__name__)
LEAVES = [
    (kind, parameter)
    for kind in CLASSES
    for parameter in describe(kind).values()
    if not dataclasses.is_dataclass(parameter.type)
]
NUMBERS = [(kind, parameter) for kind, parameter in LEAVES if isinstance(parameter.range, Range)]


def name_of(value: Any) -> Any:
    return getattr(value, "__name__", None) or getattr(value, "name", None)


def outside(parameter: Any) -> Iterator[Any]:
    """Values that the range of a parameter excludes."""
    yield from (math.nan, math.inf, -math.inf, -1, 10 * LARGEST)
    if parameter.range.low >= SMALLEST:
        yield 0
    if parameter.range.is_open:
        yield from (parameter.range.low, parameter.range.high)


def test_there_are_classes_to_look_at() -> None:
    assert len(CLASSES) >= 13
    assert len(NUMBERS) > 100


@pytest.mark.parametrize(("kind", "parameter"), NUMBERS, ids=name_of)
def test_a_value_outside_its_range_is_refused_by_name_when_the_object_is_made(kind: Any, parameter: Any) -> None:
    for value in outside(parameter):
        given = (value,) if isinstance(getattr(kind(), parameter.name), tuple) else value
        with pytest.raises(ConfigError) as refused:
            kind(**{parameter.name: given})
        assert str(refused.value).startswith(f"{kind.__name__}.{parameter.name} is {value}; it must be ")


@pytest.mark.parametrize(("kind", "parameter"), LEAVES, ids=name_of)
def test_every_number_has_a_range_and_every_parameter_a_sentence(kind: Any, parameter: Any) -> None:
    if plain(parameter.type) in (int, float):
        assert parameter.range is not None
    assert re.fullmatch(r"[A-Z][^\n]+\.", parameter.description), parameter.description
    assert len(parameter.description.split()) >= 3
    assert not re.match(r"(And|Or|But|Of|Its|At most|So) ", parameter.description)
    assert re.findall(r"\(m\)|\(rad\)", parameter.description) == []


@pytest.mark.parametrize("kind", CLASSES, ids=name_of)
def test_parameter_classes_are_frozen_and_checked(kind: Any) -> None:
    assert issubclass(kind, Parameters)
    assert kind.__dataclass_params__.frozen
    kind()


@pytest.mark.parametrize("value", ["3", None, True])
def test_what_is_no_number_is_refused(value: Any) -> None:
    with pytest.raises(ConfigError, match=r"LocaliserParameters\.window_min is .*; it must be a number from"):
        Config().localiser.__class__(window_min=value)


def test_a_fraction_is_no_count() -> None:
    with pytest.raises(ConfigError, match=r"Hide\.restarts is 2\.5; it must be a whole number from 1"):
        Config().hide.__class__(restarts=2.5)  # type: ignore[arg-type]


def test_a_list_must_not_be_empty() -> None:
    with pytest.raises(ConfigError, match=r"gates is empty; it must hold at least one value"):
        Config().graph_mapper.joint_registration.__class__(gates=())

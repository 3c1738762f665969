"""Parameters: frozen dataclasses that state each value's range in its type, its unit and meaning in its docstring.

::

    @dataclass(frozen=True, slots=True, kw_only=True)
    class GateParameters(Parameters):
        update_min_d: NonNegative = 0.2
        \"\"\"Minimum translation between two matched scans [m].\"\"\"

Ranges are checked whenever such an object is made. `describe` reads all of it back, for the JSON Schema, the comments
of `hsloc config` and the reference page (`hsloc.parameter_reference`).
"""

from __future__ import annotations

import ast
import dataclasses
import functools
import inspect
import itertools
import re
import textwrap
import types
import typing
from dataclasses import dataclass
from numbers import Integral, Real
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

from hsloc.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Hashable

SMALLEST, LARGEST = 1e-9, 1e9
"""No length, angle, ratio or count of use is smaller or larger; squares and quotients of these fit a float."""
UNITS = ("m", "rad", "cells", "rad^2 / rad^2", "rad^2 / m^2", "m^2 / m^2", "m^2 / rad^2")
"""Units of parameters; one without is a number of something, a ratio or a probability."""


def number(value: float) -> str:
    """A number as short as it goes: 0.5, 1e-9."""
    return f"{value:g}".replace("e-0", "e-").replace("e+0", "e")


@dataclass(frozen=True, slots=True)
class Range:
    """The values from `low` to `high`, both included unless `is_open`."""

    low: float
    high: float
    is_open: bool = False

    def __contains__(self, value: float) -> bool:
        return self.low < value < self.high if self.is_open else self.low <= value <= self.high

    def __str__(self) -> str:
        words = f"from {number(self.low)} to {number(self.high)}"
        return f"{words}, both excluded" if self.is_open else words


@dataclass(frozen=True, slots=True)
class OneOf:
    """One of some words."""

    choices: tuple[str, ...]

    def __contains__(self, value: object) -> bool:
        return value in self.choices

    def __str__(self) -> str:
        return f"one of {', '.join(self.choices)}"


Positive: TypeAlias = Annotated[float, Range(SMALLEST, LARGEST)]
NonNegative: TypeAlias = Annotated[float, Range(0, LARGEST)]
Ratio: TypeAlias = Annotated[float, Range(0, 1)]
Angle: TypeAlias = Annotated[float, Range(SMALLEST, 3.141592653589793)]
Count: TypeAlias = Annotated[int, Range(1, LARGEST)]
CountOrNone: TypeAlias = Annotated[int, Range(0, LARGEST)]


class Parameters:
    """Base of the parameter classes: checks the ranges of all fields when an object is made."""

    __slots__ = ()

    def __post_init__(self) -> None:
        for name, hint in hints(type(self)).items():
            check(getattr(self, name), hint, f"{type(self).__name__}.{name}")
        self.check_relations()

    def check_relations(self) -> None:
        """Raise ConfigError for values that are each within their range but do not fit each other."""


def hints(kind: type[Any]) -> dict[str, Any]:
    """Types of the fields of a dataclass by name, with their ranges."""
    return _hints(typing.cast("Hashable", kind))


@functools.cache
def _hints(kind: Any) -> dict[str, Any]:
    known = typing.get_type_hints(kind, include_extras=True)
    return {each.name: known[each.name] for each in dataclasses.fields(kind)}


def constraint(hint: Any) -> Range | OneOf | None:
    """The range of a type; for a tuple that of its items."""
    if typing.get_origin(hint) is tuple:
        return constraint(typing.get_args(hint)[0])
    return next((each for each in getattr(hint, "__metadata__", ()) if isinstance(each, Range | OneOf)), None)


def plain(hint: Any) -> Any:
    """A type without its range."""
    return hint.__origin__ if typing.get_origin(hint) is Annotated else hint


def check(value: object, hint: Any, where: str) -> None:
    """Raise ConfigError, naming `where`, the value and the range, for a value outside the range of its type."""
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        if value is None:
            return
        hint = next(kind for kind in typing.get_args(hint) if kind is not type(None))
    if typing.get_origin(hint) is tuple:
        if constraint(hint) is None:
            return
        if not value:
            raise ConfigError(f"{where} is empty; it must hold at least one value")
        for item in typing.cast("tuple[object, ...]", value):
            check(item, typing.get_args(hint)[0], where)
        return
    allowed = constraint(hint)
    if isinstance(allowed, OneOf) and value not in allowed:
        raise ConfigError(f"{where} is {value!r}; it must be {allowed}")
    if not isinstance(allowed, Range):
        return
    if type(value) is not float and (isinstance(value, bool) or not isinstance(value, Real)):
        raise ConfigError(f"{where} is {value!r}; it must be a number {allowed}")
    if plain(hint) is int and not isinstance(value, Integral):
        raise ConfigError(f"{where} is {value}; it must be a whole number {allowed}")
    if float(value) not in allowed:
        raise ConfigError(f"{where} is {value}; it must be {allowed}")
    if 0.0 < abs(float(value)) < SMALLEST:
        raise ConfigError(f"{where} is {value}; it must be 0, or at least {number(SMALLEST)} in size")


@dataclass(frozen=True, slots=True)
class Parameter:
    """A field of a parameter class. `unit` is empty for a number without one, and for a group of parameters."""

    name: str
    type: Any
    range: Range | OneOf | None
    unit: str
    description: str


_UNIT = re.compile(r" \[([^\]]+)\]")


def describe(kind: type[Any]) -> dict[str, Parameter]:
    """What is known of the fields of a dataclass: by name, in their order."""
    documented = _docstrings(kind)
    found: dict[str, Parameter] = {}
    for name, hint in hints(kind).items():
        text = documented.get(name, "")
        unit = next((each for each in _UNIT.findall(text) if each in UNITS), "")
        found[name] = Parameter(name, plain(hint), constraint(hint), unit, text)
    return found


def summary(kind: type[Any]) -> str:
    """The first paragraph of a class's docstring on one line."""
    return " ".join((inspect.getdoc(kind) or "").split("\n\n")[0].split())


def _docstrings(kind: type[Any]) -> dict[str, str]:
    """The attribute docstrings of a class and its bases, each on one line; read from the source."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if not dataclasses.is_dataclass(base):
            continue
        body = typing.cast("ast.ClassDef", ast.parse(textwrap.dedent(inspect.getsource(base))).body[0]).body
        for field, following in itertools.pairwise(body):
            if (
                isinstance(field, ast.AnnAssign)
                and isinstance(field.target, ast.Name)
                and isinstance(following, ast.Expr)
                and isinstance(following.value, ast.Constant)
                and isinstance(following.value.value, str)
            ):
                found[field.target.id] = " ".join(following.value.value.split())
    return found

"""What is known of the parameters, for readers and programs: JSON Schema, YAML with comments, a page of reference.

All of it is read from the parameter classes (`hsloc.parameters.describe`). `python -m hsloc.parameter_reference` writes
docs/parameters.md to standard output.
"""

from __future__ import annotations

import dataclasses
import sys
import textwrap
import types
import typing
from io import StringIO
from typing import Any

from hsloc.config import Config, preset, to_dict
from hsloc.options import PRESETS
from hsloc.parameters import OneOf, Range, describe, hints, number, plain, summary

if typing.TYPE_CHECKING:
    from collections.abc import Iterator

    from hsloc.parameters import Parameter

_WIDTH = 100
_ITEMS = 1000
_JSON_TYPES = {float: "number", int: "integer", bool: "boolean", str: "string"}


def json_schema(kind: type[Any] = Config, default: Any = None) -> dict[str, Any]:
    """JSON Schema (2020-12) of a parameter class with ranges, descriptions, and the values of `default`."""
    values = kind() if default is None else default
    known = describe(kind)
    properties = {}
    for name, hint in hints(kind).items():
        found = _schema(hint, getattr(values, name))
        if known[name].description:
            found["description"] = known[name].description
        properties[name] = found
    return {
        "type": "object",
        "description": summary(kind),
        "additionalProperties": False,
        "properties": properties,
    }


def _schema(hint: Any, default: Any) -> dict[str, Any]:
    if dataclasses.is_dataclass(hint):
        return json_schema(typing.cast("type[Any]", hint), default)
    if isinstance(hint, types.UnionType):
        inner = next(kind for kind in hint.__args__ if kind is not type(None))
        return {"anyOf": [_schema(inner, default), {"type": "null"}]}
    if typing.get_origin(hint) is tuple:
        items = _schema(typing.get_args(hint)[0], None)
        return {"type": "array", "items": items, "minItems": 1, "maxItems": _ITEMS, "default": list(default or ())}
    kind = plain(hint)
    found: dict[str, Any] = {"type": _JSON_TYPES[kind]}
    for each in getattr(hint, "__metadata__", ()):
        if isinstance(each, Range):
            exclusive = "exclusiveM" if each.is_open else "m"
            found |= {f"{exclusive}inimum": kind(each.low), f"{exclusive}aximum": kind(each.high)}
        elif isinstance(each, OneOf):
            found["enum"] = list(each.choices)
    if default is not None:
        found["default"] = default
    return found


def commented_yaml(config: Config) -> str:
    """A configuration as YAML that `hsloc.config.load` reads back, with a comment on each parameter."""
    return "\n".join(_lines(config, "")) + "\n"


def _lines(values: Any, indent: str) -> Iterator[str]:
    for name, parameter in describe(type(values)).items():
        value = getattr(values, name)
        if dataclasses.is_dataclass(value):
            yield from _comment(parameter.description or summary(type(value)), indent)
            yield f"{indent}{name}:"
            yield from _lines(value, indent + "  ")
        else:
            yield from _comment(_sentences(parameter), indent)
            yield from (indent + line for line in _scalar(name, value))


def _comment(text: str, indent: str) -> list[str]:
    return textwrap.wrap(text, _WIDTH, initial_indent=f"{indent}# ", subsequent_indent=f"{indent}# ")


def _sentences(parameter: Parameter) -> str:
    if parameter.range is None:
        return parameter.description
    return f"{parameter.description} Range: {str(parameter.range).removeprefix('from ')}."


def _scalar(name: str, value: Any) -> list[str]:
    from ruamel.yaml import YAML

    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = False
    stream = StringIO()
    yaml.dump({name: to_dict(value)}, stream)
    return stream.getvalue().splitlines()


def page() -> str:
    """docs/parameters.md: every parameter with unit, default, range and meaning, as Markdown."""
    lines = [
        "# All parameters",
        "",
        "This page is generated from the parameter classes; `hsloc config` prints the same as YAML, and",
        "[configuration.md](configuration.md) shows how to set them. A value outside its range is refused by name.",
        "",
        "In a `--config` file the headings are the keys that lead to a parameter: `localiser.relocaliser` is the table",
        "`relocaliser` in the table `localiser`. A preset has a column where one of its values is not the default.",
        "[P], [M], [IHS] and [DE] are sources, see the README.",
    ]
    lines += _tables(Config, {name: preset(name) for name in PRESETS}, "")
    return "\n".join(lines) + "\n"


def _tables(kind: type[Any], values: dict[str, Any], path: str) -> Iterator[str]:
    known = describe(kind)
    groups = {name: each for name, each in known.items() if dataclasses.is_dataclass(each.type)}
    leaves = {name: each for name, each in known.items() if name not in groups}
    yield from ("", f"## {path or 'Top level'}", "", summary(kind))
    if leaves:
        differing = [
            preset_name
            for preset_name in values
            if preset_name != "default"
            and any(getattr(values[preset_name], name) != getattr(values["default"], name) for name in leaves)
        ]
        columns = ["Parameter", "Unit", "Default", *(f"Preset `{name}`" for name in differing), "Range", "Meaning"]
        yield from ("", f"| {' | '.join(columns)} |", f"|{'---|' * len(columns)}")
        for name, each in leaves.items():
            shown = [_value(getattr(values[preset_name], name)) for preset_name in ("default", *differing)]
            allowed = "" if each.range is None else str(each.range).removeprefix("from ")
            yield f"| {' | '.join([f'`{name}`', each.unit, *shown, allowed, each.description])} |"
    for name, each in groups.items():
        inner = {preset_name: getattr(value, name) for preset_name, value in values.items()}
        yield from _tables(each.type, inner, f"{path}.{name}".strip("."))


def _value(value: Any) -> str:
    if isinstance(value, tuple):
        return ", ".join(_value(each) for each in value)
    if isinstance(value, bool):
        return str(value).lower()
    return number(value) if isinstance(value, int | float) else str(value)


if __name__ == "__main__":
    sys.stdout.write(page())

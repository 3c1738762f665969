"""Frozen dataclasses to JSON and back, and their JSON Schema: one description for writers, readers and documents.

The rules, for each field of a dataclass:

- its docstring (the string below it) is its description in the schema;
- a field whose default is None is left out where it is None; `X | None` without a default is written as null;
- a float that is not finite is written as null, and null is read as NaN; the schema allows null for `Measured` alone;
- the metadata `key` is its name in JSON, where that is no name in Python; with `inline` the fields of its dataclass
  are written beside the others instead of in an object of their own.
"""

from __future__ import annotations

import ast
import dataclasses
import functools
import inspect
import math
import sys
import textwrap
import types
from enum import StrEnum
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

T = TypeVar("T")

Measured = Annotated[float, "null where it cannot be measured"]
"""A float that is NaN in Python, and null in JSON, where there is nothing to measure."""

_KINDS = {str: "string", bool: "boolean", int: "integer", float: "number"}


def to_json(value: Any) -> Any:
    """A dataclass, and whatever it holds, as values that `json` can write."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        result: dict[str, Any] = {}
        for field in dataclasses.fields(value):
            entry = getattr(value, field.name)
            if entry is None and field.default is None:
                continue
            if field.metadata.get("inline"):
                result |= to_json(entry)
            else:
                result[_key(field)] = to_json(entry)
        return result
    if isinstance(value, dict):
        return {str(key): to_json(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [to_json(entry) for entry in value]
    if isinstance(value, StrEnum):
        return value.value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return value


def from_json(kind: type[T], values: Any) -> T:
    """The dataclass `kind` from what `to_json` made of it; keys that it does not know are ignored.

    Raises ValueError that names the key which is missing or has a wrong type.
    """
    result: T = _read(kind, values, kind.__name__)
    return result


def json_schema(kind: type, title: str, ident: str) -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of a dataclass, each dataclass that it holds under `$defs`."""
    definitions: dict[str, Any] = {}
    schema = _object(kind, definitions)
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": ident,
        "title": title,
        **schema,
        "$defs": dict(sorted(definitions.items())),
    }


def _key(field: dataclasses.Field[Any]) -> str:
    key: str = field.metadata.get("key", field.name)
    return key


@functools.cache
def _hints(kind: type) -> dict[str, Any]:
    """Types of the fields, `Annotated` kept."""
    return get_type_hints(kind, vars(sys.modules[kind.__module__]), include_extras=True)


def _read(kind: Any, value: Any, where: str) -> Any:
    if get_origin(kind) is Annotated:
        kind = get_args(kind)[0]
    if isinstance(kind, types.UnionType):
        if value is None:
            return None
        return _read(next(each for each in get_args(kind) if each is not type(None)), value, where)
    if dataclasses.is_dataclass(kind):
        return _read_object(kind, value, where)
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is tuple and isinstance(value, list):
        if arguments[-1] is Ellipsis:
            return tuple(_read(arguments[0], entry, where) for entry in value)
        return tuple(_read(each, entry, where) for each, entry in zip(arguments, value, strict=True))
    if origin is dict and isinstance(value, dict):
        return {key: _read(arguments[1], entry, f"{where}.{key}") for key, entry in value.items()}
    if origin is Literal and value in arguments:
        return value
    if kind is float and value is None:
        return math.nan
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if isinstance(kind, type) and issubclass(kind, StrEnum) and value in list(kind):
        return kind(value)
    if kind in _KINDS and type(value) is kind:
        return value
    raise ValueError(f"{where} is {value!r:.80}; it must be of type {getattr(kind, '__name__', kind)}")


def _read_object(kind: Any, value: Any, where: str) -> Any:
    if not isinstance(value, dict):
        raise ValueError(f"{where} is {value!r:.80}; it must be an object")
    hints, found = _hints(kind), {}
    for field in dataclasses.fields(kind):
        key, hint = _key(field), hints[field.name]
        if field.metadata.get("inline"):
            inner = _inner(hint)
            first = _key(dataclasses.fields(inner)[0])
            found[field.name] = _read_object(inner, value, where) if first in value else None
        elif key in value:
            found[field.name] = _read(hint, value[key], f"{where}.{key}")
        elif field.default is dataclasses.MISSING:
            raise ValueError(f"{where}.{key} is missing")
    return kind(**found)


def _inner(hint: Any) -> Any:
    """The dataclass of a field that may be None."""
    return next(each for each in get_args(hint) or (hint,) if each is not type(None))


def _object(kind: type, definitions: dict[str, Any]) -> dict[str, Any]:
    hints, texts = _hints(kind), _field_docstrings(kind)
    properties: dict[str, Any] = {}
    required: list[str] = []
    for field in dataclasses.fields(kind):
        if field.metadata.get("inline"):
            part = _object(_inner(hints[field.name]), definitions)
            properties |= part["properties"]
            if field.default is dataclasses.MISSING:
                required += part["required"]
            continue
        schema = _type(hints[field.name], definitions, optional=field.default is None)
        properties[_key(field)] = {"description": texts[field.name], **schema, **field.metadata.get("schema", {})}
        if field.default is dataclasses.MISSING or field.default is not None:
            required.append(_key(field))
    return {
        "description": _sentence(inspect.getdoc(kind)), "type": "object", "properties": properties, "required": required
    }  # fmt: skip


def _type(kind: Any, definitions: dict[str, Any], *, optional: bool = False) -> dict[str, Any]:
    if get_origin(kind) is Annotated:
        return {"type": ["number", "null"]}
    if isinstance(kind, types.UnionType):
        inner = _type(_inner(kind), definitions)
        if optional:
            return inner
        if isinstance(inner.get("type"), str):
            return {**inner, "type": [inner["type"], "null"]}
        return {"anyOf": [inner, {"type": "null"}]}
    if dataclasses.is_dataclass(kind):
        name = kind.__name__  # type: ignore[union-attr]
        if name not in definitions:
            definitions[name] = {}
            definitions[name] = _object(kind, definitions)  # type: ignore[arg-type]
        return {"$ref": f"#/$defs/{name}"}
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is tuple:
        if arguments[-1] is Ellipsis:
            return {"type": "array", "items": _type(arguments[0], definitions)}
        items = [_type(each, definitions) for each in arguments]
        return {"type": "array", "prefixItems": items, "minItems": len(items), "maxItems": len(items)}
    if origin is dict:
        return {"type": "object", "additionalProperties": _type(arguments[1], definitions)}
    if origin is Literal:
        return {"type": "string", "enum": list(arguments)}
    if isinstance(kind, type) and issubclass(kind, StrEnum):
        return {"type": "string", "enum": [each.value for each in kind]}
    return {"type": _KINDS[kind]}


def _sentence(text: str | None) -> str:
    """The first paragraph of a docstring on one line."""
    return " ".join((text or "").split("\n\n")[0].split())


@functools.cache
def _field_docstrings(kind: type) -> dict[str, str]:
    """The strings below the fields of a dataclass, which Python itself does not keep."""
    texts = dict[str, str]()
    for base in kind.__mro__[-2:0:-1]:
        texts |= _field_docstrings(base)
    body = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]
    assert isinstance(body, ast.ClassDef)
    for field, below in zip(body.body, body.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
            texts[getattr(field.target, "id", "")] = " ".join(str(below.value.value).split())
    missing = [field.name for field in dataclasses.fields(kind) if field.name not in texts]
    if missing:
        raise TypeError(f"{kind.__name__}: fields without a docstring: {', '.join(missing)}")
    return texts

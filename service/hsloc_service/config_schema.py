"""The JSON Schema of the parameters, made from the dataclasses of the library.

It is made in a process of its own (`python -m hsloc_service.config_schema`): importing the algorithms costs 100 MB and
a second, and the server needs none of them.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import subprocess
import sys
import threading
import types
import typing
from typing import Any

from hsloc_service.errors import ServiceError

_KINDS = {float: "number", int: "integer", bool: "boolean", str: "string"}
_LARGEST: dict[str, float] = {"number": 1e300, "integer": (1 << 63) - 1}
"""What the schema allows; the ranges that make sense are the job's to check."""
_ITEMS = 1000
_making = threading.Lock()


def options() -> dict[str, Any]:
    """`config_schema` and `presets`; whoever asks while they are being made waits for the same process."""
    with _making:
        return _options()


@functools.cache
def _options() -> dict[str, Any]:
    command = [sys.executable, "-P", "-m", "hsloc_service.config_schema"]
    done = subprocess.run(command, capture_output=True, check=True, timeout=120)
    return typing.cast("dict[str, Any]", json.loads(done.stdout))


def check(config: dict[str, Any]) -> dict[str, Any]:
    """The parameters, whole numbers as such (to JSON Schema, 30.0 is an integer); ranges are checked by the job.

    Raises ServiceError 422 for an unknown key or a value of the wrong type.
    """
    return typing.cast("dict[str, Any]", _check(config, options()["config_schema"], "config"))


def whole(value: object) -> object:
    """A number without a fraction as an integer; anything else as it is."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _check(value: Any, schema: dict[str, Any], where: str) -> Any:
    if "anyOf" in schema:
        if value is None:
            return None
        schema = next(each for each in schema["anyOf"] if each != {"type": "null"})
    kind = schema["type"]
    if kind == "object":
        if not isinstance(value, dict):
            raise _wrong(where, "must be an object")
        for key in value:
            if key not in schema["properties"]:
                raise _wrong(f"{where}.{key[:60]}", f"is unknown; known are {', '.join(schema['properties'])}")
        return {key: _check(item, schema["properties"][key], f"{where}.{key}") for key, item in value.items()}
    if kind == "array":
        if not isinstance(value, list) or len(value) > _ITEMS:
            raise _wrong(where, f"must be a list of at most {_ITEMS}")
        return [_check(item, schema["items"], where) for item in value]
    if kind == "integer":
        value = whole(value)
    fits = {
        "number": isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _LARGEST["number"],
        "integer": isinstance(value, int) and not isinstance(value, bool) and abs(value) <= _LARGEST["integer"],
        "boolean": isinstance(value, bool),
        "string": isinstance(value, str),
    }
    if not fits[kind]:
        raise _wrong(where, f"must be of type {kind}")
    if "enum" in schema and value not in schema["enum"]:
        raise _wrong(where, f"must be one of {', '.join(schema['enum'])}")
    return value


def _wrong(where: str, what: str) -> ServiceError:
    return ServiceError(422, "invalid", f"{where} {what}")


def _describe() -> dict[str, Any]:
    from hsloc.config import Config, preset, to_dict
    from hsloc.options import MAPPERS, MATCHER_ALIASES, MATCHERS, PRESETS

    schema = _schema(Config, Config())
    schema["properties"]["matcher"]["enum"] = [*MATCHERS, *MATCHER_ALIASES]
    schema["properties"]["mapper"]["enum"] = list(MAPPERS)
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    return {"config_schema": schema, "presets": {name: to_dict(preset(name)) for name in PRESETS}}


def _schema(hint: Any, default: Any) -> dict[str, Any]:
    """JSON Schema of a type of the configuration."""
    if dataclasses.is_dataclass(hint):
        hints = typing.get_type_hints(hint)
        names = [each.name for each in dataclasses.fields(hint)]
        properties = {name: _schema(hints[name], getattr(default, name)) for name in names}
        return {"type": "object", "additionalProperties": False, "properties": properties}
    if isinstance(hint, types.UnionType):
        inner = next(kind for kind in hint.__args__ if kind is not type(None))
        return {"anyOf": [_schema(inner, default), {"type": "null"}]}
    if typing.get_origin(hint) is tuple:
        inner = typing.get_args(hint)[0]
        items = _bounded(_KINDS.get(inner, "number"))
        return {"type": "array", "items": items, "maxItems": _ITEMS, "default": list(default or ())}
    found = _bounded(_KINDS.get(typing.get_origin(hint) or hint, "string"))
    if typing.get_origin(hint) is typing.Literal:
        found = {"type": "string", "enum": list(typing.get_args(hint))}
    if default is not None:
        found["default"] = default
    return found


def _bounded(kind: str) -> dict[str, Any]:
    if kind not in _LARGEST:
        return {"type": kind}
    return {"type": kind, "minimum": -_LARGEST[kind], "maximum": _LARGEST[kind]}


if __name__ == "__main__":
    sys.stdout.write(json.dumps(_describe()))

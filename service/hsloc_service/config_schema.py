"""The JSON Schema of the parameters, made from the dataclasses of the library.

It is made in a process of its own (`python -m hsloc_service.config_schema`): importing the algorithms costs 100 MB and
a second, and the server needs none of them.
"""

from __future__ import annotations

import functools
import json
import subprocess
import sys
import threading
import typing
from typing import Any

from hsloc_service.errors import ServiceError

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
    """The parameters, whole numbers as such (to JSON Schema, 30.0 is an integer).

    Raises ServiceError 422 for an unknown key, and for a value of the wrong type or outside its range.
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
        if not isinstance(value, list) or not schema["minItems"] <= len(value) <= schema["maxItems"]:
            raise _wrong(where, f"must be a list of {schema['minItems']} to {schema['maxItems']} values")
        return [_check(item, schema["items"], where) for item in value]
    if kind == "integer":
        value = whole(value)
    fits = {
        "number": isinstance(value, int | float) and not isinstance(value, bool),
        "integer": isinstance(value, int) and not isinstance(value, bool),
        "boolean": isinstance(value, bool),
        "string": isinstance(value, str),
    }
    if not fits[kind]:
        raise _wrong(where, f"must be of type {kind}")
    if "enum" in schema and value not in schema["enum"]:
        raise _wrong(where, f"must be one of {', '.join(schema['enum'])}")
    low = schema.get("minimum", schema.get("exclusiveMinimum"))
    high = schema.get("maximum", schema.get("exclusiveMaximum"))
    if low is not None and high is not None:
        is_open = "exclusiveMinimum" in schema
        if not (low < value < high if is_open else low <= value <= high):
            raise _wrong(where, f"must be from {low:g} to {high:g}{', both excluded' if is_open else ''}")
    return value


def _wrong(where: str, what: str) -> ServiceError:
    return ServiceError(422, "invalid", f"{where} {what}")


def _describe() -> dict[str, Any]:
    from hsloc.config import preset, to_dict
    from hsloc.options import PRESETS
    from hsloc.parameter_reference import json_schema

    schema = json_schema()
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    return {"config_schema": schema, "presets": {name: to_dict(preset(name)) for name in PRESETS}}


if __name__ == "__main__":
    sys.stdout.write(json.dumps(_describe()))

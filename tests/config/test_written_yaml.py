"""Tables are written as ruamel would write them, and read back as they were."""

from __future__ import annotations

from io import StringIO
from typing import Any

import pytest
from ruamel.yaml import YAML

from hsloc.config import preset, to_dict
from hsloc.options import PRESETS
from hsloc.yaml_table import written


def by_ruamel(table: dict[str, Any]) -> str:
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = False
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    stream = StringIO()
    yaml.dump(table, stream)
    return stream.getvalue()


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_written_as_ruamel_writes_them(name: str) -> None:
    values = to_dict(preset(name))
    assert written(values) == by_ruamel(values)


NUMBERS = (0, -3, 10**30, 0.0, -0.0, 1e-05, -3e-300, 1.5e-07, 1e16, 0.1)
OTHERS: tuple[Any, ...] = (
    True,
    False,
    None,
    "hide",
    "Harmony_search",
    [],
    {},
    [1, 2.0, None],
    {"a": {"b": [0.5], "c": {}}, "d": 1},
)


@pytest.mark.parametrize("value", [*NUMBERS, *OTHERS])
def test_values_are_written_as_ruamel_writes_them(value: Any) -> None:
    table = {"before": 1, "value": value, "after": "x"}
    assert written(table) == by_ruamel(table)
    assert written({"outer": table}) == by_ruamel({"outer": table})


@pytest.mark.parametrize("text", ["", "1", "1e5", "~", "null", "True", "Off", "y", "a: b", "# a", "a\nb", "ä", "-"])
def test_text_that_could_be_taken_for_something_else_is_read_back(text: str) -> None:
    assert YAML(typ="safe", pure=True).load(written({"value": text})) == {"value": text}

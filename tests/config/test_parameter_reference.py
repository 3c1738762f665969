"""Schema, comments and the page of reference are what the parameter classes state."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from hsloc.cli.main import main
from hsloc.config import from_dict, load, preset, to_dict
from hsloc.errors import ConfigError
from hsloc.options import PRESETS
from hsloc.parameter_reference import commented_yaml, json_schema, page

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(__file__).resolve().parents[2]


def test_the_page_is_up_to_date() -> None:
    """Otherwise: python -m hsloc.parameter_reference > docs/parameters.md."""
    assert (ROOT / "docs" / "parameters.md").read_text(encoding="utf-8") == page()


def test_the_schema_states_range_default_and_meaning() -> None:
    localiser = json_schema()["properties"]["localiser"]["properties"]
    assert localiser["update_min_d"] == {
        "type": "number",
        "minimum": 0.0,
        "maximum": 1e9,
        "default": 0.2,
        "description": "Minimum translation between two matched scans [m]; a larger rotation alone is enough, too.",
    }
    mapper = json_schema()["properties"]["graph_mapper"]["properties"]
    assert (mapper["passes"]["type"], mapper["passes"]["minimum"]) == ("integer", 1)
    assert mapper["occupancy"]["properties"]["hit_probability"]["exclusiveMinimum"] == 0.5
    assert mapper["joint_registration"]["properties"]["gates"]["items"]["minimum"] == 1e-9


@pytest.mark.parametrize("name", PRESETS)
def test_yaml_with_comments_is_read_back(name: str, tmp_path: Path) -> None:
    (tmp_path / "all.yaml").write_text(commented_yaml(preset(name)))
    assert load(tmp_path / "all.yaml") == preset(name)


def leaves(schema: Any, path: tuple[str, ...] = ()) -> Iterator[Any]:
    for name, each in schema["properties"].items():
        if each["type"] == "object":
            yield from leaves(each, (*path, name))
        else:
            yield (*path, name), each


@pytest.mark.parametrize(("path", "schema"), list(leaves(json_schema())), ids=lambda value: ".".join(value)[:60])
def test_the_limits_of_the_schema_are_those_that_are_checked(path: Any, schema: Any) -> None:
    def nested(value: Any) -> Any:
        for name in reversed(path):
            value = {name: value}
        return value

    values = to_dict(from_dict(type(preset("default")), {}))
    for name in path:
        values = values[name]
    assert schema["default"] == values
    if "minimum" not in schema:
        return
    kind = type(schema["default"])
    step = max(1e-6 * abs(schema["maximum"]), 1)
    for value in (schema["minimum"] - step, schema["maximum"] + step):
        with pytest.raises(ConfigError, match=path[-1]):
            from_dict(type(preset("default")), nested(kind(value)))


def test_the_command_prints_comments(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config"]) == 0
    printed = capsys.readouterr().out
    assert "  # Minimum translation between two matched scans [m]; a larger rotation alone is enough, too." in printed
    assert "Range: 0 to 1e9.\n  update_min_d: 0.2\n" in printed
